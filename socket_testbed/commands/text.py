"""Tables and progress for a terminal, and the columns of summaries."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence

from socket_testbed.batch import Row
from socket_testbed.identification.evaluation import ChannelErrors, summarise_errors
from socket_testbed.identification.model_file import finite_or_null, quoted_figures
from socket_testbed.trials.metadata import TrialMetadata
from socket_testbed.trials.segment import Segment

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


def metadata_table(metadata: TrialMetadata) -> str:
    """The metadata of a trial, as far as they are stated."""
    rows = [[name, text] for name, text in metadata.described().items()]
    return table(["metadata", "value"], rows) if rows else "no metadata: 'annotate' states them"


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


def errors_table(errors: Sequence[ChannelErrors]) -> str:
    """RMSE, MAE, sigma and skill per channel, with their means and the median."""
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
        f" {number(summary.force_rmse)} N, median local RMSE {number(summary.local_rmse)} N,"
        " of the channels in the objective"
    )
    lines.append(
        f"median skill of the wrench {number(summary.wrench_skill, 2)}, of the local forces"
        f" {number(summary.local_skill, 2)}"
    )
    if any(error.skill < 0.0 for error in errors):
        lines.append("negative skill: the channel's mean would have been a better prediction")
    if summary.without_value:
        lines.append(f"without a value, in none of these: {', '.join(summary.without_value)}")
    return "\n".join(lines)


def segment_columns(segment: Segment) -> Row:
    """The segment of a trial, for a summary."""
    return {
        "segment": segment.kind,
        "segment_start [s]": segment.start,
        "segment_end [s]": segment.end,
    }


def skill_columns(errors: Sequence[ChannelErrors], suffix: str = "") -> Row:
    """Median skills of the wrench's and the clusters' channels, for a summary.

    Args:
        errors: Errors of all channels; none where they are unknown.
        suffix: What the names of the columns end with, such as `_in_sample`.
    """
    summary = summarise_errors(errors)
    skills = {"wrench": summary.wrench_skill, "local": summary.local_skill}
    return {f"median_{n}_skill{suffix} [-]": finite_or_null(skill) for n, skill in skills.items()}


def error_columns(errors: Sequence[ChannelErrors], skills: Row) -> Row:
    """Columns of errors for a summary: what the paper quotes, skills, then every channel.

    Args:
        errors: Errors of all channels.
        skills: What `skill_columns` made of these and of others.
    """
    row: Row = {**quoted_figures(errors), **skills}
    for error in errors:
        row |= {
            f"{error.name}_rmse [{error.unit}]": error.rmse,
            f"{error.name}_mae [{error.unit}]": error.mae,
            f"{error.name}_sigma [{error.unit}]": error.sigma,
            f"{error.name}_skill [-]": error.skill,
        }
    return {name: finite_or_null(value) for name, value in row.items()}
