"""The ways to a front: the package's own, the same programs cold, single fits, CVXPY."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import qpsolvers
from methods import pivot_from_zero, prepare_cvxpy_plain, prepare_cvxpy_scaled
from problems import (
    KILONEWTON_PER_METRE,
    Motion,
    StageTwoInput,
    make_problem,
    rest_positions_of,
    with_rest,
)

from socket_testbed.arrays import FloatArray
from socket_testbed.identification.box_qp import BoxQP, solve_box_qp
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.pareto import pareto_front
from socket_testbed.identification.problem import Problem
from socket_testbed.settings.identification import PAPER_VARIANTS

_MOST_RUNS = 15

OSQP_TIGHT = {"eps_abs": 1e-9, "eps_rel": 0.0, "polishing": True, "max_iter": 200_000}

Stiffness = dict[tuple[str, float], FloatArray]  # [N/m] by variant and theta
Solve = Callable[[BoxQP, FloatArray | None], FloatArray]


@dataclass(frozen=True)
class FrontTask:
    """What is measured.

    Attributes:
        method: Key of the method.
        points: Number n of points of interest.
        samples: Number N of samples.
        motion: Motion of the limb.
        thetas: Number of thetas from 0 to 1.
        budget: Time to spend on repetitions [s].
    """

    method: str
    points: int
    samples: int
    motion: Motion
    thetas: int
    budget: float


@dataclass(frozen=True)
class FrontMeasurement:
    """What came out of it.

    Attributes:
        seconds: Median processor time of the front [s], scaled up where few thetas were
            measured.
        spread: Fastest and slowest run [s], likewise.
        runs: Runs in the median.
        stiffness: Stiffnesses of every solution.
    """

    seconds: float
    spread: tuple[float, float]
    runs: int
    stiffness: Stiffness


@dataclass(frozen=True)
class FrontMethod:
    """One row of the table.

    Attributes:
        label: What the table calls it.
        work: What is timed, in words.
        solve: The method, given the problem and the thetas.
        slow: Whether it is measured on a few thetas and scaled up.
        share: Part of a front that it makes with all thetas [-].
    """

    label: str
    work: str
    solve: Callable[[StageTwoInput, FloatArray], Stiffness]
    slow: bool = False
    share: float = 1.0


def measure_front(task: FrontTask) -> FrontMeasurement:
    """Time one method on one problem, after a warm-up unless it is slow."""
    # OSQP prints from C, past sys.stdout, which would split the table.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    problem = make_problem(task.points, task.samples, task.motion, 1e-3)
    method = METHODS[task.method]
    thetas = np.linspace(0.0, 1.0, task.thetas)
    if method.slow:
        thetas = thetas[few_of(task.thetas)]
    stiffness: Stiffness = {}

    def run() -> None:
        stiffness.update(method.solve(problem, thetas))

    scale = task.thetas / len(thetas) / method.share
    times = [scale * seconds for seconds in repeat_on_cpu(run, task.budget)]
    spread = (min(times), max(times))
    return FrontMeasurement(statistics.median(times), spread, len(times), stiffness)


def repeat_on_cpu(run: Callable[[], object], budget: float) -> list[float]:
    """Processor times of repeated runs after a warm-up; of one run alone where it is slow [s].

    With one thread it is the time that a run takes on an idle machine, nearly independent of
    what else runs on this one.
    """
    times = [_cpu_seconds(run)]
    if times[0] > budget / 3.0:
        return times
    times.clear()
    while len(times) < _MOST_RUNS and (len(times) < 3 or sum(times) < budget):
        times.append(_cpu_seconds(run))
    return times


def _cpu_seconds(run: Callable[[], object]) -> float:
    start = time.process_time()
    run()
    return time.process_time() - start


def few_of(thetas: int) -> list[int]:
    """Which of the thetas a slow method is measured on: none of the two ends.

    There a group has no weight, and the columns of its offsets have no length.
    """
    return np.round((thetas - 1) * np.array([0.1, 0.3, 0.5, 0.7, 0.9])).astype(int).tolist()


def solve_ours(problem: StageTwoInput, thetas: FloatArray) -> Stiffness:
    """`pareto_front` itself."""
    fronts = pareto_front(problem.samples, problem.geometry, problem.settings, thetas)
    return {
        (front.variant, theta): model.stiffness.ravel()
        for front in fronts.values()
        for theta, model in zip(front.theta.tolist(), front.models, strict=True)
        if model is not None
    }


def solve_by_single_fits(problem: StageTwoInput, thetas: FloatArray) -> Stiffness:
    """A fit for each theta and variant, independent of the others."""
    found: Stiffness = {}
    for theta in thetas.tolist():
        for variant in PAPER_VARIANTS:
            settings = replace(problem.settings, theta=theta, variant=variant)
            fit = fit_contact_model(problem.samples, problem.geometry, settings)
            found[variant, theta] = fit.model.stiffness.ravel()
    return found


def walk_with(solve: Solve) -> Callable[[StageTwoInput, FloatArray], Stiffness]:
    """The programs that `pareto_front` makes, from shared moments, solved in another way."""

    def walk(problem: StageTwoInput, thetas: FloatArray) -> Stiffness:
        last: dict[str, FloatArray] = {}
        found: Stiffness = {}
        for theta in thetas.tolist():
            objective = problem.objective.with_settings(theta=theta)
            shared = Problem(objective)
            last["rest"] = solve(shared.stage_one(), last.get("rest"))
            x = with_rest(shared, rest_positions_of(shared, last["rest"]))
            moments = shared.moments(x)
            for variant in PAPER_VARIANTS:
                of_variant = Problem(objective.with_settings(variant=variant))
                last[variant] = solve(of_variant.stage_two(moments), last.get(variant))
                by_tile = last[variant].reshape(3, -1).T
                found[variant, theta] = KILONEWTON_PER_METRE * by_tile.ravel()
        return found

    return walk


def _call(solver: str, program: BoxQP, near: FloatArray | None, **options: object) -> FloatArray:
    sparse = solver == "osqp"
    answer = qpsolvers.solve_problem(program.to_qpsolvers(sparse), solver, initvals=near, **options)
    if answer.x is None:
        return np.full(len(program.q), np.nan)
    return np.clip(answer.x, program.lower, program.upper)


def solve_by_cvxpy(tight: bool) -> Callable[[StageTwoInput, FloatArray], Stiffness]:
    """CVXPY on the stacked rows of Stage 2 with offsets, at our rest positions."""

    def solve(problem: StageTwoInput, thetas: FloatArray) -> Stiffness:
        prepare = prepare_cvxpy_scaled if tight else prepare_cvxpy_plain
        found: Stiffness = {}
        for theta, rest in zip(thetas.tolist(), _rest_positions(problem, thetas), strict=True):
            objective = problem.objective.with_settings(theta=theta)
            run = prepare(replace(problem, objective=objective, rest_positions=rest))
            solution = run()
            assert solution is not None
            found["stiffness_bias", theta] = solution.stiffness
        return found

    return solve


def _rest_positions(problem: StageTwoInput, thetas: FloatArray) -> list[FloatArray]:
    """Rest positions of Stage 1 for each theta, shape (n, 3) each [m]."""
    settings = problem.settings
    rest = []
    for theta in thetas.tolist():
        at_theta = Problem(problem.objective.with_settings(theta=theta))
        x = solve_box_qp(at_theta.stage_one(), settings.solver, settings.solver_tolerance).x
        rest.append(rest_positions_of(at_theta, x))
    return rest


def factorise_each(problem: StageTwoInput, thetas: FloatArray) -> Stiffness:
    """A factor of each program of Stage 2, which any way to its exact optimum needs."""
    one = Problem(problem.objective)
    matrix = one.stage_two(one.moments(with_rest(one, problem.rest_positions))).P
    for _ in range(len(PAPER_VARIANTS) * len(thetas)):
        np.linalg.cholesky(matrix)
    return {}


METHODS: dict[str, FrontMethod] = {
    "ours": FrontMethod(
        "ours: pareto_front",
        "everything: both stages, both variants, certificates, errors of all channels; each"
        " program starts from the active set of the theta before",
        solve_ours,
    ),
    "floor": FrontMethod(
        "a Cholesky factor for each program",
        "numpy's factor of one matrix of Stage 2, as often as there are programs of it: no moments,"
        " no Stage 1, nothing solved",
        factorise_each,
    ),
    "cold": FrontMethod(
        "the same programs, pivoting, cold",
        "both stages from shared moments, no errors; block pivoting from zero, each time",
        walk_with(lambda program, _: pivot_from_zero(program).x),
    ),
    "ours cold": FrontMethod(
        "the same programs, OSQP and pivoting, cold",
        "likewise; OSQP as in a fit, then pivoting, each time",
        walk_with(lambda program, _: solve_box_qp(program, "osqp", 1e-8).x),
    ),
    "osqp warm": FrontMethod(
        "the same programs, OSQP warm",
        "likewise, OSQP alone from the last solution: eps_abs 1e-9, eps_rel 0, polish",
        walk_with(lambda program, near: _call("osqp", program, near, **OSQP_TIGHT)),
    ),
    "osqp cold": FrontMethod(
        "the same programs, OSQP cold",
        "likewise, without a start",
        walk_with(lambda program, _: _call("osqp", program, None, **OSQP_TIGHT)),
    ),
    "daqp": FrontMethod(
        "the same programs, DAQP cold",
        "likewise, at its defaults; it takes no start",
        walk_with(lambda program, _: _call("daqp", program, None)),
    ),
    "fits": FrontMethod(
        "single fits, cold",
        "fit_contact_model for each theta and variant: Gram parts, both stages, errors",
        solve_by_single_fits,
    ),
    "cvxpy": FrontMethod(
        "CVXPY + OSQP, to our accuracy",
        "Stage 2 with offsets from sparse rows, columns of norm 1, eps_abs 1e-9, polish, at"
        " few thetas; scaled up to all thetas and doubled for the other variant",
        solve_by_cvxpy(tight=True),
        slow=True,
        share=0.5,
    ),
    "cvxpy plain": FrontMethod(
        "CVXPY + OSQP, its defaults",
        "likewise, in kN/m, N and N m at CVXPY's own settings",
        solve_by_cvxpy(tight=False),
        slow=True,
        share=0.5,
    ),
}
