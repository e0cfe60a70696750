"""Tables and progress for a terminal."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence

_PROGRESS_PERIOD = 0.5  # [s]


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with numbers to the right and texts to the left."""
    columns = list(zip(*(header, *rows), strict=True))
    widths = [max(len(cell) for cell in column) for column in columns]
    numeric = [any(cell[-1:].isdigit() for cell in column[1:]) for column in columns]
    numeric[0] = False
    lines = []
    for row in (header, ["-" * width for width in widths], *rows):
        cells = [
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def number(value: float, digits: int = 3) -> str:
    """A number for a table; a dash where there is none."""
    return f"{round(value, digits) + 0.0:.{digits}f}" if math.isfinite(value) else "-"


class Progress:
    """A line on standard error that says how far long work is.

    Args:
        what: What is being done.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._last = time.monotonic()
        self._shown = False

    def __call__(self, done: int, total: int) -> None:
        """Say how many steps are done."""
        now = time.monotonic()
        end = done == total
        if (end and self._shown) or now - self._last > _PROGRESS_PERIOD:
            self._last, self._shown = now, True
            tail = "\n" if end or not sys.stderr.isatty() else ""
            start = "\r" if sys.stderr.isatty() else ""
            print(f"{start}{self._what}: {100 * done // total} %", end=tail, file=sys.stderr)
