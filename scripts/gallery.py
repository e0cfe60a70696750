"""Run every example and write the page docs/examples.md with what it prints and draws.

    python scripts/gallery.py [NAME ...]

With names, such as `own_regions`, only their pictures and sections change.
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "examples.md"
PICTURES = ROOT / "docs" / "examples"
NAMES = (
    "own_regions", "two_sockets", "pressure_limit", "to_opensim", "calibrate_cluster",
    "repair_trial", "many_trials", "own_law", "cycles", "long_table",
)  # fmt: skip
INTRODUCTION = """# Examples

Each script in `examples/` answers one question. It simulates what it needs, and writes into the
folder that it is given, by default the current one: `.venv/bin/python examples/own_regions.py`.
`scripts/gallery.py` makes this page; the slow tests check a number of each script against the
simulated truth, or a value worked out by hand.
"""
_WIDTH = 620  # [pixels]
_COLOURS = 32
_LONGEST = 300.0  # [s]


def question(name: str) -> str:
    """The first paragraph of an example's docstring."""
    text = ast.get_docstring(ast.parse((ROOT / "examples" / f"{name}.py").read_text()))
    assert text, name
    return " ".join(text.split("\n\n")[0].split())


def run(name: str, folder: Path) -> str:
    """Run an example in a folder; returns what it prints.

    Raises:
        subprocess.CalledProcessError: It failed; its standard error was shown.
    """
    script = ROOT / "examples" / f"{name}.py"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    done = subprocess.run(
        [sys.executable, str(script)], check=True, cwd=folder, env=environment,
        stdout=subprocess.PIPE, text=True, timeout=_LONGEST,
    )  # fmt: skip
    return done.stdout


def shrink(source: Path, target: Path) -> None:
    """Write a picture at the page's width, in few colours."""
    with Image.open(source) as picture:
        height = round(picture.height * _WIDTH / picture.width)
        small = picture.convert("RGB").resize((_WIDTH, height), Image.Resampling.LANCZOS)
    small.quantize(_COLOURS, dither=Image.Dither.NONE).save(target, optimize=True)


def section(name: str, printed: str) -> str:
    """The section of an example: its question, its output and its picture."""
    parts = [
        f"## {name}",
        f"[{name}.py](../examples/{name}.py): {question(name)}",
        f"```text\n{printed.rstrip()}\n```",
    ]
    if (PICTURES / f"{name}.png").is_file():
        parts.append(f"![What {name}.py draws](examples/{name}.png)")
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Run the examples and write the page."""
    wanted = sys.argv[1:] or NAMES
    old = PAGE.read_text() if PAGE.is_file() else ""
    sections = {part.split("\n")[0]: part for part in re.split(r"^## ", old, flags=re.M)[1:]}
    PICTURES.mkdir(exist_ok=True)
    for name in wanted:
        with tempfile.TemporaryDirectory() as folder:
            printed = run(name, Path(folder))
            if (picture := Path(folder) / f"{name}.png").is_file():
                shrink(picture, PICTURES / picture.name)
        sections[name] = section(name, printed).removeprefix("## ")
        print(f"{name}: done")
    kept = [f"## {sections[name].rstrip()}\n" for name in NAMES if name in sections]
    PAGE.write_text("\n".join([INTRODUCTION, *kept]))


if __name__ == "__main__":
    main()
