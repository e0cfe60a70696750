"""Fits beside named references, in one run: Stage 2, a front over theta, and every variant.

Usage:
    python benchmarks/benchmark_fit.py [--quick] [--samples 1000 10000] [--thetas 101]

Stage 2 with offsets is solved by the package (moments, OSQP, pivoting, certificate, offsets), and
as everyone writes it first: a dense row per sample and channel, with the offsets as variables, in
columns of norm 1. A product S'S of the N x 3n matrix of its columns is the floor of Stage 2, and a
Cholesky factor per program that of the front. The trials are simulated: a hold, and a limb that is
pushed from all sides, on which every variant is fitted. Seconds are of the processor: compare
ratios. `above` is J / J_ours - 1.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import qpsolvers
from machine import describe_machine, repeat
from scipy import sparse
from scipy.optimize import lsq_linear
from threadpoolctl import threadpool_limits

import socket_testbed as st
from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import gate, wrench_map
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.pareto import pareto_front
from socket_testbed.identification.problem import Objective, Problem, build_objective
from socket_testbed.identification.solver import solve_box_qp
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import PAPER_VARIANTS, VARIANTS, IdentificationSettings

# The default, with which hardly a stiffness of a hold is at its bound, and one so weak that a
# third and more are: a solver has to find them.
SMOOTHNESS = (IdentificationSettings().smoothness, 1e-7)  # [-]
SCENARIOS = ("static_hold", "multi_direction")
RATE = 4.0  # [Hz]; of the simulated trials' trigger
PREDICTIONS = 500
TIGHT: dict[str, Any] = {"eps_abs": 1e-9, "eps_rel": 0.0, "polishing": True, "max_iter": 200_000}

Rows = tuple[FloatArray, FloatArray, int]
"""Rows A z = y of Stage 2, and how many of the unknowns z are stiffnesses."""


class Stage(NamedTuple):
    """What every way to solve Stage 2 is given."""

    samples: Samples
    geometry: SocketGeometry
    settings: IdentificationSettings
    objective: Objective  # the samples with the weight of each channel
    x: FloatArray  # the parameters with the rest positions of Stage 1 [mm], shape (6, n)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="1000 samples, few runs")
    parser.add_argument("--samples", type=int, nargs="+", help="numbers of samples (1000 10000)")
    parser.add_argument("--thetas", type=int, default=101, help="values from 0 to 1 (101)")
    parser.add_argument(
        "--scenarios", nargs="+", choices=SCENARIOS, default=SCENARIOS, help="of the trials (both)"
    )
    arguments = parser.parse_args()
    budget = 1.0 if arguments.quick else 6.0
    # OSQP prints from C, past sys.stdout, which would split the table.
    sys.stdout = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    print(describe_machine(1))
    for count in arguments.samples or ([1000] if arguments.quick else [1000, 10000]):
        for scenario in arguments.scenarios:
            samples, geometry = simulate(scenario, count)
            for smoothness in SMOOTHNESS:
                stage = stage_two(samples, geometry, smoothness)
                print(
                    f"\n{scenario}: n = {len(geometry)}, N = {count}, smoothness {smoothness:.0e}"
                )
                measure_stage_two(stage, budget)
                if smoothness == SMOOTHNESS[0]:
                    measure_front(stage, np.linspace(0.0, 1.0, arguments.thetas), budget)
        measure_variants(samples, geometry)


def simulate(scenario: Any, count: int) -> tuple[Samples, SocketGeometry]:
    """A simulated trial's samples that are complete, and its socket."""
    with tempfile.TemporaryDirectory() as folder:
        trial = st.simulate(Path(folder) / "t", scenario, duration=count / RATE, rate=RATE)
        samples = trial.samples()
        return samples[samples.has_pose_and_wrench], trial.geometry


def stage_two(samples: Samples, geometry: SocketGeometry, smoothness: float) -> Stage:
    """Weigh the samples and solve Stage 1."""
    settings = IdentificationSettings(variant="stiffness_bias", smoothness=smoothness)
    objective = build_objective(samples, geometry, settings)
    problem = Problem(objective)
    x = problem.start.copy()
    rest = solve_box_qp(problem.stage_one(), settings.solver, settings.solver_tolerance)
    x[3:] = rest.x.reshape(3, -1)
    return Stage(samples, geometry, settings, objective, x)


def measure_stage_two(stage: Stage, budget: float) -> None:
    """Print a row for each way to solve Stage 2."""
    s = columns_of(stage)
    floor = statistics.median(repeat(lambda: s.T @ s, budget))
    row("product S'S alone", [floor], floor)
    ours = solve(stage)
    row("ours, certified", repeat(partial(solve, stage), budget), floor)
    rivals = {"qpsolvers + OSQP": by_qpsolvers, "scipy lsq_linear": by_lsq_linear}
    A, y, springs = stack(stage)
    best = np.sum((A @ ours - y) ** 2)
    for name, rival in rivals.items():
        z = by_rows(stage, rival)
        z[:springs] = np.maximum(z[:springs], 0.0)  # outside the bounds it would gain
        times = repeat(partial(by_rows, stage, rival), budget)
        row(name, times, floor, f"above {np.sum((A @ z - y) ** 2) / best - 1.0:.1e}")


def measure_front(stage: Stage, thetas: FloatArray, budget: float) -> None:
    """Print a row for a front over theta of both variants."""
    problem = Problem(stage.objective)
    matrix = problem.stage_two(problem.moments(stage.x)).P

    def factorise() -> None:
        for _ in range(len(PAPER_VARIANTS) * len(thetas)):
            np.linalg.cholesky(matrix)

    front = partial(pareto_front, stage.samples, stage.geometry, stage.settings, thetas)
    floor = statistics.median(repeat(factorise, budget))
    row(f"front of {len(thetas)} thetas", repeat(front, budget), floor, "/ Cholesky factors")


def measure_variants(samples: Samples, geometry: SocketGeometry) -> None:
    """Print a row for the whole fit of each variant, and for one prediction."""
    pose = samples.pose[:1]
    print(f"\nwhole fits: n = {len(geometry)}, N = {len(samples)}")
    for variant in VARIANTS:
        settings = IdentificationSettings(variant=variant)
        model = fit_contact_model(samples, geometry, settings).model
        (spent,) = repeat(partial(fit_contact_model, samples, geometry, settings), 0.0)

        def predict(model: Any = model) -> None:
            for _ in range(PREDICTIONS):
                model.wrench(pose), model.forces(pose)

        each = min(repeat(predict, 1.0)) / PREDICTIONS
        print(f"{variant:32} {spent:9.2f} s, one prediction {1e6 * each:.0f} us", flush=True)


def row(what: str, times: list[float], floor: float, more: str = "") -> None:
    """Print the median of processor times [s] and its ratio to the floor."""
    seconds = statistics.median(times)
    print(f"{what:32} {seconds:9.4f} s {seconds / floor:9.1f}  {more}", flush=True)


def columns_of(stage: Stage) -> FloatArray:
    """The columns S of Stage 2, tile by tile, shape (N, 3n) [m]."""
    position = stage.objective.samples.position
    rest = Problem(stage.objective).law.reference_pose[:3] + 1e-3 * stage.x[3:].T  # [m]
    displacement = position[:, None] - rest
    s = displacement * gate(displacement, stage.settings.gate_sharpness)
    return s.reshape(len(position), -1)


def solve(stage: Stage) -> FloatArray:
    """The package's own Stage 2: stiffnesses [N/m], offsets of the wrench and the clusters."""
    problem, settings = Problem(stage.objective), stage.settings
    x = stage.x.copy()
    program = problem.stage_two(problem.moments(x))
    x[:3] = solve_box_qp(program, settings.solver, settings.solver_tolerance).x.reshape(3, -1)
    model = problem.model(x)
    bias = [model.force_bias[c.cluster][c.axis] for c in stage.objective.channels]
    return np.concatenate([model.stiffness.ravel(), model.wrench_bias, bias])


def stack(stage: Stage) -> Rows:
    """The rows of Stage 2, weighted so that its objective is |A z - y|^2, in SI units."""
    objective, s, pairs = stage.objective, columns_of(stage), stage.geometry.neighbours
    (count, springs), theta = s.shape, stage.settings.theta
    measured = sum(len(channel.force) for channel in objective.channels)
    A = np.zeros((6 * count + measured + 3 * len(pairs), springs + 6 + len(objective.channels)))
    y, start = np.zeros(len(A)), 0
    mapping = wrench_map(stage.geometry.anchors)
    for k, weight in enumerate(theta * objective.wrench_shares):
        rows, root = slice(start, start + count), np.sqrt(weight / count)
        A[rows, :springs], A[rows, springs + k] = root * s * mapping[k], root
        y[rows] = root * objective.wrench[:, k]
        start += count
    for k, channel in enumerate(objective.channels):
        own = slice(3 * channel.point, 3 * channel.point + 3)
        rows = slice(start, start + len(channel.force))
        root = np.sqrt((1.0 - theta) * objective.channel_shares[k] / len(channel.force))
        A[rows, own] = root * s[channel.rows, own] * channel.direction
        A[rows, springs + 6 + k], y[rows] = root, root * channel.force
        start += len(channel.force)
    expected = stage.settings.stiffness_difference
    root = np.sqrt(stage.settings.smoothness / (3.0 * len(pairs) * expected**2))
    difference = np.eye(len(stage.geometry))[pairs[:, 0]] - np.eye(len(stage.geometry))[pairs[:, 1]]
    A[start:, :springs] = root * np.kron(difference, np.eye(3))
    return A, y, springs


def by_rows(stage: Stage, rival: Callable[..., FloatArray]) -> FloatArray:
    """Stack the rows, scale the columns to norm 1, and solve: all of it is timed."""
    A, y, springs = stack(stage)
    unit = 1.0 / np.linalg.norm(A, axis=0)
    A *= unit
    lower = np.where(np.arange(A.shape[1]) < springs, 0.0, -np.inf)
    return unit * rival(A, y, lower)


def by_qpsolvers(A: FloatArray, y: FloatArray, lower: FloatArray) -> FloatArray:
    """OSQP on the normal equations."""
    matrix = sparse.csc_matrix(A.T @ A)
    answer = qpsolvers.solve_qp(matrix, -(A.T @ y), lb=lower, solver="osqp", **TIGHT)
    assert answer is not None
    return answer


def by_lsq_linear(A: FloatArray, y: FloatArray, lower: FloatArray) -> FloatArray:
    """Bounded least squares of scipy, with the tightest tolerance with which it ends."""
    found: FloatArray = lsq_linear(A, y, (lower, np.inf), tol=1e-14, max_iter=300).x
    return found


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
