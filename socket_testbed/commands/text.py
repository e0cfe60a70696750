"""Tables and progress for a terminal."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence

_PROGRESS_PERIOD = 0.5  # [s]


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with the first column to the left and the others to the right."""
    widths = [max(len(str(row[i])) for row in (header, *rows)) for i in range(len(header))]
    lines = []
    for row in (header, ["-" * width for width in widths], *rows):
        first, *others = (str(cell) for cell in row)
        cells = [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True)]
        lines.append("  ".join([first.ljust(widths[0]), *cells]).rstrip())
    return "\n".join(lines)


def number(value: float, digits: int = 3) -> str:
    """A number for a table; a dash where there is none."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


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
