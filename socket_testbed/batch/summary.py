"""One table of all trials: a row a trial, with units in the names of its columns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from socket_testbed.batch.job import Cell, Outcome, Row, Status
from socket_testbed.evaluation import ChannelErrors, summarise_errors
from socket_testbed.identification.fit import Fit
from socket_testbed.identification.model_file import finite_or_null
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.table_file import Column, write_table

NAME = "summary"
MEANS = {
    "mean moment RMSE": "mean_moment_rmse [N m]",
    "mean force RMSE": "mean_force_rmse [N]",
    "median local RMSE": "median_local_rmse [N]",
}


def segment_columns(segment: Segment) -> Row:
    """The segment of a trial."""
    return {
        "segment": segment.kind,
        "segment_start [s]": segment.start,
        "segment_end [s]": segment.end,
    }


def error_columns(errors: Sequence[ChannelErrors]) -> Row:
    """The means and the median that the paper quotes, then the errors of every channel."""
    summary = summarise_errors(errors)
    means = (summary.moment_rmse, summary.force_rmse, summary.local_rmse)
    row: Row = dict(zip(MEANS.values(), means, strict=True))
    for error in errors:
        row |= {
            f"{error.name}_rmse [{error.unit}]": error.rmse,
            f"{error.name}_mae [{error.unit}]": error.mae,
            f"{error.name}_sigma [{error.unit}]": error.sigma,
            f"{error.name}_skill [-]": error.skill,
        }
    return {name: finite_or_null(value) for name, value in row.items()}


def certificate_columns(fit: Fit) -> Row:
    """How well both stages are solved, the worse of them, in scaled units."""
    certificates = (fit.stage_one.certificate, fit.stage_two.certificate)
    return {
        "kkt_residual [-]": max(c.stationarity for c in certificates),
        "duality_gap [-]": max(c.gap for c in certificates),
    }


def main_figures(row: Row) -> str:
    """The means and the median of a row in words."""
    return ", ".join(
        f"{words} {value:.3f} {_unit(name)}"
        for words, name in MEANS.items()
        if isinstance(value := row.get(name), float)
    )


def write_summary(outcomes: Sequence[Outcome], folder: Path) -> tuple[Path, Path]:
    """Write the table as `summary.csv` and `summary.parquet`, a row an outcome.

    A job that was skipped is `ok`: the table says what there is, not in which run it was made.

    Returns:
        The paths of both files.

    Raises:
        ConfigurationError: If they cannot be written.
    """
    rows = [_full_row(outcome) for outcome in outcomes]
    names = dict.fromkeys(name for row in rows for name in row)
    columns = [_column(name, [row.get(name) for row in rows]) for name in names]
    paths = folder / f"{NAME}.csv", folder / f"{NAME}.parquet"
    for path in paths:
        write_table(columns, path)
    return paths


def _full_row(outcome: Outcome) -> Row:
    status = Status.OK if outcome.status is Status.SKIPPED else outcome.status
    return {
        "trial": outcome.name,
        "status": status.value,
        "error": outcome.error,
        **outcome.row,
    }


def _column(title: str, cells: list[Cell]) -> Column:
    unit = _unit(title)
    return Column(title.removesuffix(f" [{unit}]"), unit, cells)


def _unit(title: str) -> str:
    return title.partition(" [")[2].removesuffix("]")
