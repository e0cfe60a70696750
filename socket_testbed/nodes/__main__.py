"""Nodes in one process: `python -m socket_testbed.nodes NODE... --ros-args ...`."""

from __future__ import annotations

import sys
from importlib import import_module

from socket_testbed.nodes.runtime import run_node


def main() -> None:
    """Run the nodes named on the command line, such as trigger_node cluster_node."""
    names = sys.argv[1:]
    if "--ros-args" in names:
        names = names[: names.index("--ros-args")]
    classes = ["".join(part.capitalize() for part in name.split("_")) for name in names]
    run_node(
        *(
            getattr(import_module(f"socket_testbed.nodes.{name}"), kind)
            for name, kind in zip(names, classes, strict=True)
        )
    )


if __name__ == "__main__":
    main()
