r"""Trade-off fronts of the wrench's error against the clusters', their knee, and as a table.

Both errors are normalised by the sizes that the objective is normalised by, so that they are
the same for every theta and both variants:

.. math:: e_w = \sqrt{\frac{1}{|W|} \sum_{c \in W} (RMSE_c / r_c)^2}, \qquad
          e_f = \sqrt{\frac{1}{|L|} \sum_{c \in L} (RMSE_c / r_f)^2}

with W the channels of the wrench and L those of the clusters in the objective; r_c is the
root mean square of all measured moments of the segment for a moment, of all measured forces
for a force, and r_f that of all measured cluster forces. Predicting zero makes both errors 1.
They are the square roots of J_w and J_f of docs/identification.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.files import atomic_output
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.model_file import finite_or_null
from socket_testbed.samples import WRENCH_CHANNELS, channel_unit

if TYPE_CHECKING:
    import pandas as pd
from socket_testbed.settings.identification import Variant

RESOLUTION = 1e-3  # [-]; a thousandth of what was measured is nothing to trade off
LEAST_DEPTH = 0.05  # [-]; a front that bends less has no knee

SENSOR_ONLY, KNEE, WRENCH_ONLY = "sensor-only", "knee", "wrench-only"


@dataclass(frozen=True)
class FrontPoint:
    """The solution of both stages at one theta.

    Attributes:
        theta: Weight of the wrench against the clusters [-].
        model: The contact model; None where a stage was not certified.
        rmse: Root-mean-square error of each channel in the objective, shape (m,)
            [N m, N]; NaN without a model.
        wrench_error: Normalised error e_w of the wrench [-].
        local_error: Normalised error e_f of the clusters [-].
        residual: Largest KKT residual or gap of both stages, in scaled units [-].
        flaw: Why the errors are not to be used; empty where they are.
    """

    theta: float
    model: ContactModel | None
    rmse: FloatArray
    wrench_error: float
    local_error: float
    residual: float
    flaw: str = ""


@dataclass(frozen=True)
class Knee:
    """Where a front bends most, or why it has no knee.

    Attributes:
        index: Which solution it is; None without a knee.
        depth: Distance below the chord between the front's ends, in units of the ends' own
            differences [-]: 0 on the chord, 1 where both errors are at their best at once.
        span: Differences of e_w and e_f between the ends [-].
        verdict: The same in words.
    """

    index: int | None
    depth: float
    span: tuple[float, float]
    verdict: str


@dataclass(frozen=True)
class Front:
    """The solutions of one variant along theta.

    Attributes:
        variant: Which offsets the models carry.
        channels: Names of the m channels in the objective, the wrench's first.
        theta: Weights of the wrench against the clusters, rising, shape (T,) [-].
        wrench_error: Normalised errors e_w of the wrench, shape (T,) [-].
        local_error: Normalised errors e_f of the clusters, shape (T,) [-].
        rmse: Root-mean-square errors of the channels, shape (T, m) [N m, N].
        residual: Largest KKT residual or gap of both stages, shape (T,) [-].
        flaws: Why a solution is not to be used, T texts; empty where it is.
        models: The contact models; None where a stage was not certified.
        non_dominated: Solutions without flaw that no other one surpasses, shape (T,).
        knee: Where the non-dominated ones bend most.
    """

    variant: Variant
    channels: tuple[str, ...]
    theta: FloatArray
    wrench_error: FloatArray
    local_error: FloatArray
    rmse: FloatArray
    residual: FloatArray
    flaws: tuple[str, ...]
    models: tuple[ContactModel | None, ...]
    non_dominated: BoolArray
    knee: Knee

    @property
    def sound(self) -> BoolArray:
        """Solutions without flaw: certified in both stages, and determined, shape (T,)."""
        return np.array([not flaw for flaw in self.flaws], dtype=bool)

    @property
    def marks(self) -> dict[str, int]:
        """The solutions that stand out, by name, where there are such."""
        marks = {SENSOR_ONLY: np.flatnonzero(self.sound & (self.theta == 0.0))}
        if self.knee.index is not None:
            marks[KNEE] = np.array([self.knee.index])
        marks[WRENCH_ONLY] = np.flatnonzero(self.sound & (self.theta == 1.0))
        return {name: int(index[0]) for name, index in marks.items() if len(index)}

    @property
    def worst_residual(self) -> float:
        """Largest KKT residual or gap of the solutions without flaw [-]; NaN without any."""
        return float(self.residual[self.sound].max()) if self.sound.any() else float("nan")

    @property
    def moment_rmse(self) -> FloatArray:
        """Mean RMSE of the moments in the objective, shape (T,) [N m]; NaN without any."""
        return self._mean_rmse("M")

    @property
    def force_rmse(self) -> FloatArray:
        """Mean RMSE of the forces in the objective, shape (T,) [N]; NaN without any."""
        return self._mean_rmse("F")

    @property
    def local_rmse(self) -> FloatArray:
        """Median RMSE of the clusters' channels in the objective, shape (T,) [N]."""
        return np.median(self.rmse[:, ["." in name for name in self.channels]], axis=1)

    def _mean_rmse(self, kind: str) -> FloatArray:
        columns = [name in WRENCH_CHANNELS and name[0] == kind for name in self.channels]
        if not any(columns):
            return np.full(len(self.theta), np.nan)
        return self.rmse[:, columns].mean(axis=1)


def make_front(variant: Variant, channels: tuple[str, ...], points: Sequence[FrontPoint]) -> Front:
    """The front of solutions, in the order of their thetas."""
    wrench_error = np.array([point.wrench_error for point in points])
    local_error = np.array([point.local_error for point in points])
    sound = np.array([not point.flaw for point in points], dtype=bool)
    kept = find_non_dominated(wrench_error, local_error, sound)
    return Front(
        variant=variant,
        channels=channels,
        theta=np.array([point.theta for point in points]),
        wrench_error=wrench_error,
        local_error=local_error,
        rmse=np.array([point.rmse for point in points]).reshape(len(points), len(channels)),
        residual=np.array([point.residual for point in points]),
        flaws=tuple(point.flaw for point in points),
        models=tuple(point.model for point in points),
        non_dominated=kept,
        knee=find_knee(wrench_error, local_error, kept),
    )


def find_non_dominated(
    wrench_error: FloatArray, local_error: FloatArray, sound: BoolArray
) -> BoolArray:
    """Solutions for which no other is as good in both errors and better in one, shape (T,).

    Args:
        wrench_error: Normalised errors e_w, shape (T,) [-].
        local_error: Normalised errors e_f, shape (T,) [-].
        sound: Which solutions count, shape (T,); the others neither dominate nor are kept.
    """
    kept = np.zeros(len(sound), dtype=bool)
    order = np.lexsort((local_error, wrench_error))
    best = (np.inf, np.inf)  # the last one kept: (local, wrench)
    for index in order[sound[order]]:
        errors = (local_error[index], wrench_error[index])
        if errors[0] < best[0] or errors == best:
            kept[index], best = True, errors
    return kept


def find_knee(wrench_error: FloatArray, local_error: FloatArray, kept: BoolArray) -> Knee:
    """The solution that lies farthest below the chord between the ends of a front.

    The farthest is the same one whatever the axes are scaled by.

    Args:
        wrench_error: Normalised errors e_w, shape (T,) [-].
        local_error: Normalised errors e_f, shape (T,) [-].
        kept: The non-dominated solutions, shape (T,).
    """
    front = np.flatnonzero(kept)
    if len(front) == 0:
        return Knee(None, np.nan, (np.nan, np.nan), "no knee: no solution is without flaw")
    errors = np.stack([wrench_error[front], local_error[front]])
    width, height = np.ptp(errors, axis=1).tolist()
    extent = f"the front spans {width:.2g} by {height:.2g}"
    if min(width, height) < RESOLUTION:
        verdict = f"no knee: {extent}, nothing to trade off"
        return Knee(None, 0.0, (width, height), verdict)
    low = errors.min(axis=1)
    depths = 1.0 - (errors[0] - low[0]) / width - (errors[1] - low[1]) / height
    deepest = int(depths.argmax())
    depth = float(depths[deepest])
    if depth < LEAST_DEPTH:
        return Knee(None, depth, (width, height), f"no knee: {extent} and is straight")
    verdict = f"knee of depth {depth:.2f}: {extent}"
    return Knee(int(front[deepest]), depth, (width, height), verdict)


def front_table(fronts: Iterable[Front]) -> pd.DataFrame:
    """Fronts of the same samples as a table, a row per solution, with the units in the names."""
    import pandas as pd

    rows = []
    for front in fronts:
        marks = {index: name for name, index in front.marks.items()}
        rmse = [f"RMSE {name} [{channel_unit(name)}]" for name in front.channels]
        rows += [
            {
                "variant": front.variant,
                "theta [-]": front.theta[i],
                "wrench error [-]": front.wrench_error[i],
                "local error [-]": front.local_error[i],
                "non-dominated": int(front.non_dominated[i]),
                "mark": marks.get(i, ""),
                "mean moment RMSE [N m]": front.moment_rmse[i],
                "mean force RMSE [N]": front.force_rmse[i],
                "median local RMSE [N]": front.local_rmse[i],
                "KKT residual or gap [-]": front.residual[i],
                "flaw": flaw,
                **dict(zip(rmse, front.rmse[i], strict=True)),
            }
            for i, flaw in enumerate(front.flaws)
        ]
    return pd.DataFrame(rows)


def write_fronts(fronts: Iterable[Front], path: Path) -> None:
    """Write fronts as CSV: see `front_table`; a missing value is an empty cell.

    Args:
        fronts: Fronts of the same samples.
        path: File to write; an older one is replaced.

    Raises:
        ConfigurationError: If the file cannot be written.
    """
    table = front_table(fronts)
    with atomic_output(path) as staging:
        table.to_csv(staging, index=False)


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
