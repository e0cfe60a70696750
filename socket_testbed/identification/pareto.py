r"""The trade-off between the wrench and the clusters: both stages, for a sequence of thetas.

Stage 1 and the gates depend on theta: each theta has its own rest positions, shared by both of
the paper's variants. The solver runs for the first theta only; every later one starts from the
previous solution.

The two errors of a front have the normalisation of the objective, the same for every theta and
both variants:

.. math:: e_w = \sqrt{\frac{1}{|W|} \sum_{c \in W} (RMSE_c / r_c)^2}, \qquad
          e_f = \sqrt{\frac{1}{|L|} \sum_{c \in L} (RMSE_c / r_f)^2}

with W the channels of the wrench and L those of the clusters in the objective; r_c is the
root mean square of all measured moments of the segment for a moment, of all measured forces
for a force, and r_f that of all measured cluster forces, if the weights are by size: then
predicting zero gives errors of 1. They are the square roots of J_w and J_f of
docs/identification.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from socket_testbed.arrays import BoolArray, FloatArray, evenly, finite_mean
from socket_testbed.documents import finite_or_null
from socket_testbed.errors import IdentificationError
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.channel_errors import QUOTED
from socket_testbed.identification.problem import Objective, Problem, build_objective
from socket_testbed.identification.solver import (
    BoxQP,
    BoxSolution,
    UncertifiedSolutionError,
    solve_box_qp,
)
from socket_testbed.samples import Samples, channel_unit
from socket_testbed.settings.identification import PAPER_VARIANTS, IdentificationSettings, Variant

RESOLUTION = 1e-3  # [-]; a smaller span of an error is no trade-off
MIN_DEPTH = 0.05  # [-]; a shallower front has no knee

SENSOR_ONLY, KNEE, WRENCH_ONLY = "sensor-only", "knee", "wrench-only"
_MAX_SAMPLES = 4000  # of a front


# Figures of a solution: attribute of `Front` and key in JSON, and title of the table's column.
FIGURES = {
    "theta": "theta [-]",
    "wrench_error": "wrench error [-]",
    "local_error": "local error [-]",
    **QUOTED,
    "residual": "KKT residual or gap [-]",
}


@dataclass(frozen=True)
class FrontPoint:
    """The solution of both stages at one theta; its errors are NaN if a stage was not certified.

    Attributes:
        theta: Weight of the wrench against the clusters, 0 to 1 [-].
        residual: Largest KKT residual or gap of both stages, in scaled units [-].
        rmse: RMSE of the m channels in the objective, the wrench's first, shape (m,) [N m, N].
        flaw: Why the solution must not be used; empty if it is sound.
        wrench_error: Normalised error e_w of the wrench [-].
        local_error: Normalised error e_f of the clusters [-].
        mean_moment_rmse: Mean RMSE of the moments in the objective [N m].
        mean_force_rmse: Mean RMSE of the forces in the objective [N].
        median_local_rmse: Median RMSE of the clusters' channels in the objective [N].
    """

    theta: float
    residual: float
    rmse: FloatArray
    flaw: str = ""
    wrench_error: float = np.nan
    local_error: float = np.nan
    mean_moment_rmse: float = np.nan
    mean_force_rmse: float = np.nan
    median_local_rmse: float = np.nan


@dataclass(frozen=True)
class Knee:
    """Where a front bends most, or why it has no knee.

    Attributes:
        index: Index of the solution among the thetas; None without a knee.
        depth: Distance below the chord between the front's ends, relative to the span [-]: 0 on the
            chord, 1 if both errors reach their minima at once. NaN without a sound solution.
        span: Differences of e_w and e_f between the front's ends [-]; NaN without a sound solution.
        verdict: The result in words.
    """

    index: int | None
    depth: float
    span: tuple[float, float]
    verdict: str


class Front:
    """The solutions of one variant at T rising thetas.

    Errors are NaN where a stage was not certified.

    Args:
        variant: The variant of the model.
        channels: Names of the m channels in the objective, the wrench's first.
        points: The solutions in the order of the thetas.

    Attributes:
        theta: Weights of the wrench against the clusters, 0 to 1, shape (T,) [-].
        wrench_error: Normalised errors e_w of the wrench, shape (T,) [-].
        local_error: Normalised errors e_f of the clusters, shape (T,) [-].
        mean_moment_rmse: Mean RMSE of the moments in the objective, shape (T,) [N m].
        mean_force_rmse: Mean RMSE of the forces in the objective, shape (T,) [N].
        median_local_rmse: Median RMSE of the clusters' channels in the objective, shape (T,) [N].
        residual: Largest KKT residuals or gaps of both stages, in scaled units, shape (T,) [-].
        variant: The variant of the model.
        channels: Names of the m channels in the objective, the wrench's first.
        rmse: RMSE of the channels in the objective, shape (T, m) [N m, N].
        flaws: Why each solution must not be used, T texts; empty if it is sound.
        sound: Solutions without a flaw, shape (T,).
        non_dominated: Sound solutions that no other one dominates, shape (T,).
        knee: Where the front bends most.
    """

    theta: FloatArray
    wrench_error: FloatArray
    local_error: FloatArray
    mean_moment_rmse: FloatArray
    mean_force_rmse: FloatArray
    median_local_rmse: FloatArray
    residual: FloatArray

    def __init__(
        self, variant: Variant, channels: tuple[str, ...], points: Sequence[FrontPoint]
    ) -> None:
        self.variant = variant
        self.channels = channels
        for name in FIGURES:
            setattr(self, name, np.array([getattr(point, name) for point in points]))
        self.rmse = np.array([point.rmse for point in points]).reshape(len(points), len(channels))
        self.flaws = tuple(point.flaw for point in points)
        self.sound = np.array([not flaw for flaw in self.flaws], dtype=bool)
        self.non_dominated = find_non_dominated(self.wrench_error, self.local_error, self.sound)
        self.knee = find_knee(self.wrench_error, self.local_error, self.non_dominated)

    def __repr__(self) -> str:
        return (
            f"Front({self.variant}, {len(self.theta)} solutions, {self.non_dominated.sum()} not"
            f" dominated; {self.knee.verdict})"
        )

    @property
    def marks(self) -> dict[str, int]:
        """Indices of the notable solutions that exist, by `SENSOR_ONLY`, `KNEE`, `WRENCH_ONLY`."""
        marks = {SENSOR_ONLY: np.flatnonzero(self.sound & (self.theta == 0.0))}
        if self.knee.index is not None:
            marks[KNEE] = np.array([self.knee.index])
        marks[WRENCH_ONLY] = np.flatnonzero(self.sound & (self.theta == 1.0))
        return {name: int(index[0]) for name, index in marks.items() if len(index)}

    @property
    def worst_residual(self) -> float:
        """Largest KKT residual or gap of the solutions without flaw [-]; NaN without any."""
        return float(self.residual[self.sound].max()) if self.sound.any() else float("nan")

    def to_dataframe(self) -> pd.DataFrame:
        """The solutions as a pandas table, one row per theta, with the units in the names.

        Errors are NaN without a solution; `mark` names the notable solutions, `flaw` says why a
        solution must not be used.
        """
        marks = {index: name for name, index in self.marks.items()}
        figures = {title: getattr(self, name) for name, title in FIGURES.items()}
        table = pd.DataFrame({"variant": self.variant, **figures, "flaw": self.flaws})
        table.insert(4, "non-dominated", self.non_dominated.astype(int))
        table.insert(5, "mark", [marks.get(i, "") for i in range(len(self.theta))])
        for name, rmse in zip(self.channels, self.rmse.T, strict=True):
            table[f"RMSE {name} [{channel_unit(name)}]"] = rmse
        return table


def pareto_front(
    samples: Samples,
    geometry: SocketGeometry,
    settings: IdentificationSettings,
    thetas: Sequence[float] | FloatArray,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[Variant, Front]:
    """Identify the contact model for every theta, for both of the paper's variants.

    At theta 0 the wrench has no weight, at theta 1 the clusters have none: directions that the
    other group does not determine then depend on the smoothness alone. Solutions that are not
    certified or not unique carry a flaw and are not on the front. Longer data is thinned to 4000
    samples.

    Args:
        samples: Samples of a loaded segment.
        geometry: The socket, which has the clusters of the samples.
        settings: Settings of the fits; their theta and variant are ignored.
        thetas: Weights of the wrench against the clusters, ascending within 0 to 1, shape (T,) [-].
        progress: Called after each theta with the number done and the total.

    Returns:
        The front of each of the paper's variants, by its name.

    Raises:
        IdentificationError: If the wrench or the clusters have no channel in the objective, if no
            theta gives a sound solution, or if the samples cannot be fitted.
    """
    objective = build_objective(samples, geometry, replace(settings, variant=PAPER_VARIANTS[0]))
    objective = objective.part(evenly(len(objective.samples), _MAX_SAMPLES))
    if not objective.wrench_counts.any() or not objective.channels:
        group = "clusters" if objective.wrench_counts.any() else "wrench"
        raise IdentificationError(
            f"no channel of the {group} is in the objective: there is nothing to trade off",
            "leave fewer channels out, or fit a single model with 'fit'",
        )
    problems = {
        variant: Problem(objective.with_settings(variant=variant)) for variant in PAPER_VARIANTS
    }
    points: dict[Variant, list[FrontPoint]] = {variant: [] for variant in PAPER_VARIANTS}
    last: dict[str, FloatArray] = {}
    for done, theta in enumerate(thetas, start=1):
        for variant, point in _solve_at(problems, float(theta), last).items():
            points[variant].append(point)
        progress(done, len(thetas))
    channels = objective.names
    fronts = {variant: Front(variant, channels, found) for variant, found in points.items()}
    if not any(front.sound.any() for front in fronts.values()):
        raise IdentificationError(
            f"no theta gives a solution without flaw: {next(iter(fronts.values())).flaws[-1]}",
            "give more smoothness, another solver or a longer segment",
        )
    return fronts


def _solve_at(
    problems: Mapping[Variant, Problem], theta: float, last: dict[str, FloatArray]
) -> dict[Variant, FrontPoint]:
    """The solution of each variant at a theta; each program starts from its last solution.

    Stage 1 and the moments at its rest positions are the same for all variants.
    """
    problems = {variant: problem.at(theta) for variant, problem in problems.items()}
    first = next(iter(problems.values()))
    settings, names = first.settings, first.objective.names

    def solve(program: BoxQP, kind: str) -> BoxSolution:
        found = solve_box_qp(program, settings.solver, settings.solver_tolerance, last.get(kind))
        last[kind] = found.x
        return found

    stage_one = first.stage_one()
    try:
        rest = solve(stage_one, "rest positions")
    except UncertifiedSolutionError as error:
        return dict.fromkeys(problems, _flawed(theta, len(names), error))
    x = first.start.copy()
    x[3:] = rest.x.reshape(3, -1)
    moments = first.moments(x)
    points = {}
    for variant, problem in problems.items():
        stage_two = problem.stage_two(moments)
        try:
            springs = solve(stage_two, variant)
        except UncertifiedSolutionError as error:
            points[variant] = _flawed(theta, len(names), error)
            continue
        x[:3] = springs.x.reshape(3, -1)
        points[variant] = FrontPoint(
            theta=theta,
            residual=max(springs.certificate.worst, rest.certificate.worst),
            flaw=_undetermined(stage_two, springs) or _undetermined(stage_one, rest),
            **_errors(problem.objective, problem.rmse(x, moments)),
        )
    return points


def _errors(objective: Objective, rmse: FloatArray) -> dict[str, Any]:
    """The fields of a `FrontPoint` that follow from its `rmse`, with it."""
    counts = objective.wrench_counts
    moments, forces, local = np.split(rmse, np.cumsum([counts[:3].sum(), counts[3:].sum()]))
    wrench = np.concatenate([moments, forces])
    return {
        "rmse": rmse,
        "wrench_error": float(np.sqrt(objective.wrench_shares[counts] @ wrench**2)),
        "local_error": float(np.sqrt(objective.channel_shares @ local**2)),
        "mean_moment_rmse": finite_mean(moments),
        "mean_force_rmse": finite_mean(forces),
        "median_local_rmse": finite_mean(local, np.median),
    }


def _flawed(theta: float, channels: int, error: UncertifiedSolutionError) -> FrontPoint:
    """The point at a theta for which a stage was not certified."""
    return FrontPoint(theta, error.residual, np.full(channels, np.nan), error.fact)


def _undetermined(program: BoxQP, solution: BoxSolution) -> str:
    """The flaw of a solution that is not unique; empty otherwise."""
    open_flaw = f"{program.name}: neither the data nor the smoothness determines all of them"
    return "" if solution.determined else open_flaw


def find_non_dominated(
    wrench_error: FloatArray, local_error: FloatArray, sound: BoolArray
) -> BoolArray:
    """Solutions for which no other is as good in both errors and better in one, shape (T,).

    Args:
        wrench_error: Errors of the wrench, shape (T,) [-].
        local_error: Errors of the clusters, shape (T,) [-].
        sound: Solutions without a flaw, shape (T,); others neither dominate nor are kept.
    """
    kept = np.zeros(len(sound), dtype=bool)
    order = np.lexsort((local_error, wrench_error))
    best = (np.inf, np.inf)  # of the last one kept: (local, wrench)
    for index in order[sound[order]]:
        errors = (local_error[index], wrench_error[index])
        if errors[0] < best[0] or errors == best:
            kept[index], best = True, errors
    return kept


def find_knee(wrench_error: FloatArray, local_error: FloatArray, kept: BoolArray) -> Knee:
    """The kept solution farthest below the chord between the front's ends.

    The choice is invariant to scaling of the axes.

    Args:
        wrench_error: Errors e_w of the wrench, shape (T,) [-].
        local_error: Errors e_f of the clusters, shape (T,) [-].
        kept: The solutions on the front, shape (T,).
    """
    front = np.flatnonzero(kept)
    if len(front) == 0:
        return Knee(None, np.nan, (np.nan, np.nan), "no knee: no solution is without flaw")
    errors = np.stack([wrench_error[front], local_error[front]])
    span = np.ptp(errors, axis=1)
    extent = f"the front spans {span[0]:.2g} by {span[1]:.2g}"
    ends = (float(span[0]), float(span[1]))
    if span.min() < RESOLUTION:
        return Knee(None, 0.0, ends, f"no knee: {extent}, nothing to trade off")
    depths = 1.0 - ((errors.T - errors.min(axis=1)) / span).sum(axis=1)
    deepest = int(depths.argmax())
    depth = float(depths[deepest])
    if depth < MIN_DEPTH:
        return Knee(None, depth, ends, f"no knee: {extent} and is straight")
    return Knee(int(front[deepest]), depth, ends, f"knee of depth {depth:.2f}: {extent}")


def front_table(fronts: Iterable[Front]) -> pd.DataFrame:
    """Several fronts as one table, a row per solution: see `Front.to_dataframe`."""
    return pd.concat([front.to_dataframe() for front in fronts], ignore_index=True)


def front_document(front: Front) -> dict[str, Any]:
    """A front for JSON: its knee and marks, and every solution."""
    return {
        "variant": front.variant,
        "knee": {
            "theta": None if front.knee.index is None else float(front.theta[front.knee.index]),
            "depth": finite_or_null(front.knee.depth),
            "span": finite_or_null(front.knee.span),
            "verdict": front.knee.verdict,
        },
        "marks": {name: _solution(front, index) for name, index in front.marks.items()},
        "non_dominated": int(front.non_dominated.sum()),
        "worst_residual": finite_or_null(front.worst_residual),
        "solutions": [_solution(front, index) for index in range(len(front.theta))],
    }


def _solution(front: Front, index: int) -> dict[str, Any]:
    rmse = zip(front.channels, front.rmse[index].tolist(), strict=True)
    return {
        **{name: finite_or_null(float(getattr(front, name)[index])) for name in FIGURES},
        "rmse": {name: finite_or_null(value) for name, value in rmse},
        "non_dominated": bool(front.non_dominated[index]),
        "flaw": front.flaws[index] or None,
    }
