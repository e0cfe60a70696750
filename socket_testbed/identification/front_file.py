"""Fronts as a table on the disk, and as a document for JSON."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from socket_testbed.evaluation import channel_unit
from socket_testbed.files import whole_output
from socket_testbed.identification.front import Front
from socket_testbed.identification.model_file import finite_or_null

_HEADER = (
    *("variant", "theta [-]", "wrench error [-]", "local error [-]", "non-dominated", "mark"),
    *("mean moment RMSE [N m]", "mean force RMSE [N]", "median local RMSE [N]"),
    *("KKT residual or gap [-]", "flaw"),
)


def write_fronts(fronts: Iterable[Front], path: Path) -> None:
    """Write fronts as CSV: a row a solution, units in the header, empty where there is none.

    Args:
        fronts: Fronts of the same samples.
        path: File to write; an older one is replaced.

    Raises:
        ConfigurationError: If the file cannot be written.
    """
    fronts = list(fronts)
    channels = [f"RMSE {name} [{channel_unit(name)}]" for name in fronts[0].channels]
    with whole_output(path) as staging, staging.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow([*_HEADER, *channels])
        for front in fronts:
            writer.writerows(_rows(front))


def _rows(front: Front) -> Iterator[list[str]]:
    names = {index: name for name, index in front.marks.items()}
    means = (front.moment_rmse, front.force_rmse, front.local_rmse)
    for i, flaw in enumerate(front.flaws):
        errors = (front.theta[i], front.wrench_error[i], front.local_error[i])
        yield [
            front.variant,
            *map(_cell, errors),
            str(int(front.non_dominated[i])),
            names.get(i, ""),
            *(_cell(mean[i]) for mean in means),
            _cell(front.residual[i]),
            flaw,
            *map(_cell, front.rmse[i]),
        ]


def _cell(value: float) -> str:
    return f"{value:.10g}" if math.isfinite(value) else ""


def front_document(front: Front) -> dict[str, Any]:
    """A front for JSON: what stands out on it, and every solution."""
    return {
        "variant": front.variant,
        "knee": {
            "theta": None if front.knee.index is None else float(front.theta[front.knee.index]),
            "depth": finite_or_null(front.knee.depth),
            "span": [finite_or_null(span) for span in front.knee.span],
            "verdict": front.knee.verdict,
        },
        "marks": {name: _solution(front, index) for name, index in front.marks.items()},
        "non_dominated": int(front.non_dominated.sum()),
        "worst_residual": finite_or_null(front.worst_residual),
        "solutions": [_solution(front, index) for index in range(len(front.theta))],
    }


def _solution(front: Front, index: int) -> dict[str, Any]:
    figures = {
        "theta": front.theta,
        "wrench_error": front.wrench_error,
        "local_error": front.local_error,
        "mean_moment_rmse": front.moment_rmse,
        "mean_force_rmse": front.force_rmse,
        "median_local_rmse": front.local_rmse,
        "residual": front.residual,
    }
    document: dict[str, Any] = {
        name: finite_or_null(float(values[index])) for name, values in figures.items()
    }
    rmse = zip(front.channels, front.rmse[index].tolist(), strict=True)
    return document | {
        "rmse": {name: finite_or_null(value) for name, value in rmse},
        "non_dominated": bool(front.non_dominated[index]),
        "flaw": front.flaws[index] or None,
    }
