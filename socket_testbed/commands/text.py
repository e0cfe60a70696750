"""Tables and progress for a terminal."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence

from socket_testbed.identification.evaluation import ChannelErrors, summarise_errors

_PROGRESS_PERIOD = 0.5  # [s]
_LOGGED_PERIOD = 10.0  # [s]; where it is not overwritten


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with numbers to the right and texts to the left."""
    columns = list(zip(*(header, *rows), strict=True))
    widths = [max(len(cell) for cell in column) for column in columns]
    numeric = [all(map(_is_number, column[1:])) for column in columns]
    lines = []
    for row in (header, ["-" * width for width in widths], *rows):
        cells = [
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def _is_number(cell: str) -> bool:
    return cell in {"", "-"} or cell.lstrip("-").replace(".", "", 1).isdigit()


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
        terminal = sys.stderr.isatty()
        period = _PROGRESS_PERIOD if terminal else _LOGGED_PERIOD
        if (end and self._shown) or now - self._last > period:
            self._last, self._shown = now, not end
            tail = "\n" if end or not terminal else ""
            start = "\r" if terminal else ""
            print(f"{start}{self._what}: {100 * done // total} %", end=tail, file=sys.stderr)


def errors_table(errors: Sequence[ChannelErrors]) -> str:
    """RMSE, MAE, sigma and skill a channel, with the means and the median the paper quotes."""
    rows = [
        [
            error.name,
            error.unit,
            number(error.rmse),
            number(error.mae),
            number(error.sigma),
            number(error.skill, 2),
            "" if error.in_objective else "not in objective",
        ]
        for error in errors
    ]
    lines = [table(["channel", "unit", "RMSE", "MAE", "sigma", "skill", ""], rows), ""]
    summary = summarise_errors(errors)
    lines.append(
        f"mean moment RMSE {number(summary.moment_rmse)} N m, mean force RMSE"
        f" {number(summary.force_rmse)} N, median local RMSE {number(summary.local_rmse)} N"
    )
    if summary.without_value:
        lines.append(f"without a value, in none of these: {', '.join(summary.without_value)}")
    return "\n".join(lines)
