"""Fits beside named references, in one run: Stage 2, a front over theta, and every variant.

Usage:
    python benchmarks/benchmark_fit.py [--quick] [--points 100] [--samples 1000 10000]
        [--thetas 101] [--no-cvxpy]

Stage 2 with offsets is solved by the package (moments, OSQP, pivoting, certificate, offsets), and
as everyone writes it first: a dense row per sample and channel, with the offsets as variables, in
columns of norm 1. A product S'S of the N x 3n matrix of its columns is the floor of Stage 2, and a
Cholesky factor per program that of the front. The variants are fitted on a simulated limb that is
pushed from all sides. Seconds are of the processor: compare ratios. `above` is J / J_ours - 1.

Needs requirements/benchmarks.txt unless --no-cvxpy is given.
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
from typing import Any

import numpy as np
import qpsolvers
from machine import describe_machine, repeat
from problems import MOTIONS, StageTwoInput, gated_displacement, make_problem, with_rest
from scipy import sparse
from scipy.optimize import lsq_linear
from threadpoolctl import threadpool_limits

import socket_testbed as st
from socket_testbed.arrays import FloatArray
from socket_testbed.identification.box_qp import solve_box_qp
from socket_testbed.identification.contact import wrench_map
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.pareto import pareto_front
from socket_testbed.identification.problem import Problem
from socket_testbed.settings.identification import (
    PAPER_VARIANTS,
    VARIANTS,
    IdentificationSettings,
)

# The default, with which hardly a stiffness of a hold is at its bound, and one so weak that a
# third and more are: a solver has to find them.
SMOOTHNESS = (IdentificationSettings().smoothness, 1e-7)  # [-]
RATE = 4.0  # [Hz]; of the simulated trial's trigger
PREDICTIONS = 500
TIGHT: dict[str, Any] = {"eps_abs": 1e-9, "eps_rel": 0.0, "polishing": True, "max_iter": 200_000}

Rows = tuple[FloatArray, FloatArray, int]
"""Rows A z = y of Stage 2, and how many of the unknowns z are stiffnesses."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="60 points, 1000 samples, few runs")
    parser.add_argument("--points", type=int, help="number of points of interest (100)")
    parser.add_argument("--samples", type=int, nargs="+", help="numbers of samples (1000 10000)")
    parser.add_argument("--thetas", type=int, default=101, help="values from 0 to 1 (101)")
    parser.add_argument("--no-cvxpy", action="store_true", help="leave CVXPY out")
    arguments = parser.parse_args()
    points = arguments.points or (60 if arguments.quick else 100)
    budget = 1.0 if arguments.quick else 6.0
    # OSQP prints from C, past sys.stdout, which would split the table.
    sys.stdout = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    print(describe_machine(1))
    for count in arguments.samples or ([1000] if arguments.quick else [1000, 10000]):
        for motion in MOTIONS:
            for smoothness in SMOOTHNESS:
                stage = make_problem(points, count, motion, smoothness)
                print(f"\n{motion}: n = {points}, N = {count}, smoothness {smoothness:.0e}")
                measure_stage_two(stage, budget, arguments.no_cvxpy)
                if smoothness == SMOOTHNESS[0]:
                    measure_front(stage, np.linspace(0.0, 1.0, arguments.thetas), budget)
        measure_variants(count)


def measure_stage_two(stage: StageTwoInput, budget: float, no_cvxpy: bool) -> None:
    """Print a row for each way to solve Stage 2."""
    s = columns_of(stage)
    floor = statistics.median(repeat(lambda: s.T @ s, budget))
    row("product S'S alone", [floor], floor)
    ours = solve(stage)
    row("ours, certified", repeat(partial(solve, stage), budget), floor)
    rivals = {"qpsolvers + OSQP": by_qpsolvers, "scipy lsq_linear": by_lsq_linear}
    if not no_cvxpy:
        rivals["CVXPY + OSQP"] = by_cvxpy
    A, y, springs = stack(stage)
    best = np.sum((A @ ours - y) ** 2)
    for name, rival in rivals.items():
        z = by_rows(stage, rival)
        z[:springs] = np.maximum(z[:springs], 0.0)  # outside the bounds it would gain
        times = repeat(partial(by_rows, stage, rival), budget)
        row(name, times, floor, f"above {np.sum((A @ z - y) ** 2) / best - 1.0:.1e}")


def measure_front(stage: StageTwoInput, thetas: FloatArray, budget: float) -> None:
    """Print a row for a front over theta of both variants."""
    problem = Problem(stage.objective)
    matrix = problem.stage_two(problem.moments(with_rest(problem, stage.rest_positions))).P

    def factorise() -> None:
        for _ in range(len(PAPER_VARIANTS) * len(thetas)):
            np.linalg.cholesky(matrix)

    front = partial(pareto_front, stage.samples, stage.geometry, stage.settings, thetas)
    floor = statistics.median(repeat(factorise, budget))
    row(f"front of {len(thetas)} thetas", repeat(front, budget), floor, "/ Cholesky factors")


def measure_variants(count: int) -> None:
    """Print a row for the whole fit of each variant, and for one prediction."""
    with tempfile.TemporaryDirectory() as folder:
        duration = count / RATE
        trial = st.simulate(Path(folder) / "t", "multi_direction", duration=duration, rate=RATE)
        samples, geometry = trial.samples(), trial.geometry
    pose = samples.pose[samples.complete][:1]
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


def columns_of(stage: StageTwoInput) -> FloatArray:
    """The columns S of Stage 2, tile by tile, shape (N, 3n) [m]."""
    position = stage.objective.samples.position
    s = gated_displacement(position, stage.rest_positions, stage.settings.gate_sharpness)
    return s.reshape(len(position), -1)


def solve(stage: StageTwoInput) -> FloatArray:
    """The package's own Stage 2: stiffnesses [N/m], offsets of the wrench and the clusters."""
    problem, settings = Problem(stage.objective), stage.settings
    x = with_rest(problem, stage.rest_positions)
    program = problem.stage_two(problem.moments(x))
    x[:3] = solve_box_qp(program, settings.solver, settings.solver_tolerance).x.reshape(3, -1)
    model = problem.model(x)
    bias = [model.force_bias[c.cluster][c.axis] for c in stage.objective.channels]
    return np.concatenate([model.stiffness.ravel(), model.wrench_bias, bias])


def stack(stage: StageTwoInput) -> Rows:
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


def by_rows(stage: StageTwoInput, rival: Callable[..., FloatArray]) -> FloatArray:
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


def by_cvxpy(A: FloatArray, y: FloatArray, lower: FloatArray) -> FloatArray:
    """CVXPY with OSQP on the sparse rows, to our accuracy."""
    import cvxpy

    z = cvxpy.Variable(A.shape[1])
    bounded = np.isfinite(lower)
    squares = cvxpy.sum_squares(sparse.csr_array(A) @ z - y)
    cvxpy.Problem(cvxpy.Minimize(squares), [z[bounded] >= 0]).solve(solver="OSQP", **TIGHT)
    found: FloatArray = z.value
    return found


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
