"""Correct the CMake files of the ROS wheels in this Python's environment.

Their exported targets name include folders of the machine that built them, and CMake
refuses a target whose include folder does not exist. This puts this Python's own there.
"""

import re
import sys
import sysconfig
from pathlib import Path

import numpy as np

INCLUDES = (
    (re.compile(r'/opt/python/[^;"]*?/include/python3\.\d+'), sysconfig.get_paths()["include"]),
    (re.compile(r'/opt/python/[^;"]*?/numpy/_?core/include'), np.get_include()),
)


def main() -> None:
    """Correct every exported target of the generated Python messages."""
    share = Path(sys.prefix, "share")
    for file in share.glob("*/cmake/*__rosidl_generator_pyExport.cmake"):
        text = corrected = file.read_text(encoding="utf-8")
        for pattern, include in INCLUDES:
            corrected = pattern.sub(include, corrected)
        if corrected != text:
            file.write_text(corrected, encoding="utf-8")


if __name__ == "__main__":
    main()
