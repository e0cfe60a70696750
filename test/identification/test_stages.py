"""Stage 1 and Stage 2 of the paper's law against the problems written out row by row."""

import itertools

import numpy as np
import pytest
from support.problems import (
    FAR,
    LEFT_OUT,
    make_case,
    naive_gated,
)
from support.stacked import (
    MILLIMETRE,
    OPTIMUM,
    relative,
    stack_stage_one,
    stack_stage_two,
)

from socket_testbed.identification.box_qp import solve_box_qp
from socket_testbed.identification.objective import build_objective
from socket_testbed.identification.problem import Problem
from socket_testbed.settings.identification import PAPER_VARIANTS


def by_axis(points):
    """From a row of x, y, z per tile, as the stacked problems have it, to the programs' order."""
    return points.reshape(-1, 3).T.reshape(-1)


def by_tile(x):
    return x.reshape(3, -1).T.reshape(-1)


class Stages:
    """Both programs of a case, with the rest positions of Stage 2 given."""

    def __init__(self, samples, geometry, settings, rest=None):
        self.settings = settings
        self.problem = Problem(build_objective(samples, geometry, settings))
        if rest is not None:
            self.x = self.problem.start.copy()
            self.x[3:] = (rest - self.problem.law.reference_pose[:3]).T / MILLIMETRE
            self.moments = self.problem.moments(self.x)
            self.program = self.problem.stage_two(self.moments)

    def solve(self, program):
        return solve_box_qp(program, self.settings.solver, self.settings.solver_tolerance).x

    def stiffness(self):
        """Solution of Stage 2, tile by tile [kN/m], and its model."""
        self.x[:3] = self.solve(self.program).reshape(3, -1)
        return by_tile(self.x[:3]), self.problem.model(self.x)


def assert_same_up_to_scale_and_constant(program, rows, points):
    ours = np.array([program.objective(by_axis(x)) for x in points])
    stacked = np.array([rows.cost(x) for x in points])
    scale = (ours[1] - ours[0]) / (stacked[1] - stacked[0])
    assert scale > 0.0
    np.testing.assert_allclose(
        ours - ours[0], scale * (stacked - stacked[0]), rtol=0.0, atol=1e-9 * np.ptp(ours)
    )
    np.testing.assert_allclose(program.P, program.P.T, atol=1e-12)
    assert np.linalg.eigvalsh(program.P).min() > -1e-12


@pytest.mark.parametrize("leave_out", LEFT_OUT)
@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_both_stages_are_the_stacked_objective_up_to_scale_and_constant(variant, leave_out):
    weights = "raw" if len(leave_out) == 1 else "size"
    geometry, bed, samples, settings = make_case(
        21, variant, gaps=True, leave_out=leave_out, weights=weights, theta=0.3
    )
    rng, size = np.random.default_rng(24), 3 * len(geometry)
    stages = Stages(samples, geometry, settings, bed.rest_positions)
    assert_same_up_to_scale_and_constant(
        stages.problem.stage_one(),
        stack_stage_one(samples, geometry, settings),
        rng.uniform(-8.0, 8.0, (12, size)),  # [mm]
    )
    assert_same_up_to_scale_and_constant(
        stages.program,
        stack_stage_two(samples, geometry, settings, bed.rest_positions),
        rng.uniform(0.0, 10.0, (12, size)) * (rng.random((12, size)) < 0.7),  # [kN/m]
    )


def test_stage_one_agrees_with_bounded_least_squares_on_the_rows():
    for seed, limit in itertools.product(range(3), (0.008, 0.0008)):
        geometry, _, samples, settings = make_case(seed, gaps=True, rest_position_limit=limit)
        expected = MILLIMETRE * stack_stage_one(samples, geometry, settings).solve()
        stages = Stages(samples, geometry, settings)
        found = MILLIMETRE * by_tile(stages.solve(stages.problem.stage_one()))
        assert relative(found, expected) < OPTIMUM
        assert np.abs(found).max() <= limit + 1e-11
        if limit < 0.001:
            assert np.isclose(np.abs(found), limit, rtol=1e-9).any()  # the bound matters here


def test_products_keep_their_digits_on_a_hold():
    """Against extended precision: what is centred after the product loses eight digits here."""
    geometry, bed, samples, settings = make_case(4, "stiffness_bias")
    samples.position[:] = FAR + 1e-5 * samples.position  # a hold of some nanometres
    rest = FAR + bed.rest_positions
    found = Stages(samples, geometry, settings, rest).moments.wrench
    wide = np.longdouble
    position = samples.position.astype(wide)
    S = naive_gated(position[:, None] - rest.astype(wide), wide(2000.0))
    S = S.transpose(0, 2, 1).reshape(len(position), -1)
    Y = samples.wrench.astype(wide)
    np.testing.assert_allclose(found.mean, S.mean(axis=0).astype(float), rtol=1e-12, atol=1e-18)
    S, Y = S - S.mean(axis=0), Y - Y.mean(axis=0)
    spread = np.sqrt(np.diag(S.T @ S) / len(S)).astype(float)
    limit = 1e-7 * np.outer(spread, spread) + 1e-30
    assert (np.abs(found.gram - S.T @ S / len(S)) <= limit).all()
    limit = np.outer(1e-7 * spread + 1e-16, Y.std(axis=0).astype(float))
    assert (np.abs(found.cross - S.T @ Y / len(S)) <= limit).all()


def test_many_samples_are_multiplied_in_blocks():
    """Every sample 20 times is more than a block, and changes nothing."""
    geometry, bed, samples, settings = make_case(63, gaps=True)
    many = samples[np.repeat(np.arange(len(samples)), 20)]
    once, model = Stages(samples, geometry, settings, bed.rest_positions).stiffness()
    again, other = Stages(many, geometry, settings, bed.rest_positions).stiffness()
    assert relative(again, once) < 1e-8
    np.testing.assert_allclose(other.wrench_bias, model.wrench_bias, rtol=1e-8)


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_determined_directions_are_the_trace_of_the_hat_matrix(variant):
    geometry, bed, samples, settings = make_case(64, variant)
    rest = bed.rest_positions + 5e-4  # [m]; beside the truth, so that bounds become active
    stages = Stages(samples, geometry, settings, rest)
    x, _ = stages.stiffness()
    rows = stack_stage_two(samples, geometry, settings, rest)
    offsets = rows.A.shape[1] - len(x)
    free = np.concatenate([np.flatnonzero(x > 0.0), len(x) + np.arange(offsets)])
    A = rows.A[:, free]
    data = A[: len(A) - 3 * len(geometry.neighbours)]
    hat = data @ np.linalg.solve(A.T @ A, data.T)
    expected = np.trace(hat) - offsets  # each offset takes one direction for itself
    found = stages.problem.determined_directions(stages.x, stages.moments)
    assert found == pytest.approx(expected, abs=1e-5)
    assert stages.problem.determined_directions(0.0 * stages.x, stages.moments) == 0.0
