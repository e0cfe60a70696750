"""Tables, numbers and progress for a terminal."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence

_PROGRESS_PERIOD = 0.5  # [s]
_LOGGED_PERIOD = 10.0  # [s]; where it is not overwritten


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with numbers to the right and texts to the left."""
    columns = list(zip(*(header, *rows), strict=True))
    widths = [max(map(len, column)) for column in columns]
    lines = []
    for row in (header, ["-" * width for width in widths], *rows):
        cells = [
            cell.rjust(width) if all(map(_is_number, column[1:])) else cell.ljust(width)
            for cell, width, column in zip(row, widths, columns, strict=True)
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def _is_number(cell: str) -> bool:
    return cell in {"", "-"} or cell.lstrip("-").replace(".", "", 1).isdigit()


def number(value: float | None, digits: int = 3) -> str:
    """A number for a table; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{round(value, digits) + 0.0:.{digits}f}"


def say(line: str) -> None:
    """Print a line of what happens on standard error."""
    print(line, file=sys.stderr, flush=True)


class Progress:
    """A line on standard error with the progress of long work.

    Args:
        what: What is being done.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._last = time.monotonic()
        self._shown = False

    def __call__(self, done: int, total: int) -> None:
        """Report how many steps are done."""
        now = time.monotonic()
        end = done == total
        terminal = sys.stderr.isatty()
        period = _PROGRESS_PERIOD if terminal else _LOGGED_PERIOD
        if (end and self._shown) or now - self._last > period:
            self._last, self._shown = now, not end
            tail = "\n" if end or not terminal else ""
            start = "\r" if terminal else ""
            print(f"{start}{self._what}: {100 * done // total} %", end=tail, file=sys.stderr)

    def stop(self) -> None:
        """Leave the work undone: what is printed next stands in a line of its own."""
        if self._shown and sys.stderr.isatty():
            print(file=sys.stderr)
        self._shown = False
