"""The moments from one pass over the data, and the errors from the moments."""

import numpy as np
import pytest
from support.problems import FAR, make_case, moving_limb, naive_gated

from socket_testbed.identification.box_qp import (
    factorise,
    is_definite,
    least_pivot,
    solve_factored,
)
from socket_testbed.identification.moments import (
    GateSeries,
    Moments,
    gate_moments,
    series_is_cheaper,
)
from socket_testbed.identification.pareto import channel_mean_squares, mean_square_residuals
from socket_testbed.identification.problem import SharedMoments, build_objective, stage_two_moments
from socket_testbed.settings.identification import VARIANTS

FIELDS = ("mean", "gram", "target_mean", "cross", "target_power")
MOTIONS = {
    "hold": lambda rng: FAR + rng.normal(0.0, 1e-5, (300, 3)),
    "hold with a stray sample": lambda rng: np.vstack([rng.normal(0.0, 1e-6, (299, 3)), FAR / 5]),
    "one axis": lambda rng: np.linspace(-0.002, 0.003, 200)[:, None] * [1.0, 0.0, 0.0],
    "multi-directional": lambda rng: FAR + moving_limb(rng, 300),
    "more rows than one block": lambda rng: moving_limb(rng, 5001, 0.001),
    "still": lambda rng: np.tile(FAR, (50, 1)),
    "single": lambda rng: FAR[None],
}


def assert_same_moments(found, expected, precision=1e-9):
    assert found.count == expected.count
    spread = np.sqrt(np.diag(expected.gram)) + np.sqrt(expected.count) * 1e-16
    target = np.sqrt(expected.target_power) + np.sqrt(expected.count) * 1e-13
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found.target_mean, expected.target_mean, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.target_power, expected.target_power, rtol=1e-9, atol=1e-20)
    assert (np.abs(found.gram - expected.gram) <= precision * np.outer(spread, spread)).all()
    assert (np.abs(found.cross - expected.cross) <= precision * np.outer(spread, target)).all()


@pytest.mark.parametrize("kind", MOTIONS)
def test_one_pass_gives_the_moments_at_any_rest_positions(kind):
    rng = np.random.default_rng(1)
    position = MOTIONS[kind](rng)
    targets = rng.normal(3.0, 50.0, (len(position), 6))
    series = GateSeries(position, 2000.0, targets)
    for _ in range(3):
        rest = position.mean(axis=0) + rng.uniform(-0.004, 0.004, (5, 3))
        expected = gate_moments(position, rest, 2000.0, targets, "direct")
        # Where the limb hardly moves, both lose digits to the rounding of q itself.
        assert_same_moments(series.moments(rest), expected, 1e-6 if "hold" in kind else 1e-9)


def test_a_series_knows_the_whole_gram_matrix_as_symmetric():
    rng = np.random.default_rng(2)
    position = moving_limb(rng, 100, 5e-4)
    gram = GateSeries(position, 2000.0, position).moments(rng.uniform(-0.001, 0.001, (4, 3))).gram
    np.testing.assert_allclose(gram, gram.T, rtol=0.0, atol=1e-14 * np.abs(gram).max())
    assert np.linalg.eigvalsh(gram).min() > -1e-12 * np.abs(gram).max()


def test_a_series_pays_on_a_hold_and_not_on_a_few_samples_of_a_wide_motion():
    rng = np.random.default_rng(3)
    assert series_is_cheaper(rng.normal(0.0, 1e-5, (300, 3)), 2000.0, 60)
    assert not series_is_cheaper(rng.normal(0.0, 0.01, (300, 3)), 2000.0, 60)


@pytest.mark.parametrize("gaps", [False, True])
def test_shared_moments_are_those_of_the_samples(gaps):
    geometry, bed, samples, settings = make_case(4, gaps=gaps, leave_out=("Mz", "cluster_1.Fx"))
    samples.position[:] = FAR + 0.02 * samples.position  # a hold, for which the series pays
    objective = build_objective(samples, geometry, settings)
    assert series_is_cheaper(objective.position, settings.gate_sharpness, len(geometry))
    shared = SharedMoments(objective, settings, len(geometry))
    for shift in (0.0, 1e-3):
        rest = FAR + bed.rest_positions + shift
        found = shared.at(rest)
        expected = stage_two_moments(objective, settings, rest)
        assert_same_moments(found.wrench, expected.wrench, 1e-7)
        assert len(found.channels) == len(expected.channels) == 8
        for one, other in zip(found.channels, expected.channels, strict=True):
            assert_same_moments(one, other, 1e-7)


@pytest.mark.parametrize("with_offset", [False, True])
def test_mean_squares_are_those_of_the_residuals(with_offset):
    rng = np.random.default_rng(5)
    position, rest = moving_limb(rng, 80), rng.uniform(-0.002, 0.002, (3, 3))
    targets, rows = rng.normal(2.0, 5.0, (80, 4)), rng.normal(0.0, 2000.0, (4, 9))
    moments = gate_moments(position, rest, 2000.0, targets)
    residual = targets - naive_gated(position[:, None] - rest, 2000.0).reshape(80, 9) @ rows.T
    if with_offset:
        residual -= residual.mean(axis=0)
    found = mean_square_residuals(moments, rows, with_offset)
    np.testing.assert_allclose(found, np.mean(residual**2, axis=0), rtol=1e-10)


def test_rounding_leaves_no_negative_square():
    one = np.ones((1, 1))
    power = np.array([1.0 - 1e-15])  # a hair less than its own prediction
    moments = Moments(10, np.zeros(1), one, np.zeros(1), one, power)
    assert mean_square_residuals(moments, one, with_offset=True) == [0.0]


def test_a_perfect_prediction_leaves_nothing():
    rng = np.random.default_rng(6)
    position, rest = moving_limb(rng, 80), rng.uniform(-0.002, 0.002, (3, 3))
    rows = rng.normal(0.0, 2000.0, (4, 9))
    targets = naive_gated(position[:, None] - rest, 2000.0).reshape(80, 9) @ rows.T
    moments = gate_moments(position, rest, 2000.0, targets)
    found = mean_square_residuals(moments, rows, with_offset=False)
    assert (np.sqrt(found) <= 1e-7 * targets.std(axis=0)).all()


@pytest.mark.parametrize("leave_out", [(), ("Mx", "My", "Mz"), ("Fy", "cluster_0.Fz")])
@pytest.mark.parametrize("variant", VARIANTS)
def test_predicting_zero_makes_both_normalised_errors_one(variant, leave_out):
    geometry, bed, samples, settings = make_case(7, variant, leave_out=leave_out)
    objective = build_objective(samples, geometry, settings)
    moments = stage_two_moments(objective, settings, bed.rest_positions)
    nothing = np.zeros((len(geometry), 3))
    wrench, local = channel_mean_squares(objective, geometry, moments, nothing, with_bias=False)
    assert objective.wrench_shares @ wrench == pytest.approx(1.0)
    assert objective.channel_share * local.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("size", [1, 7, 48, 49, 130])
def test_a_factored_system_is_solved(size):
    rng = np.random.default_rng(size)
    root = rng.normal(size=(size, size))
    matrix, x = root @ root.T + np.eye(size), rng.normal(size=size)
    found = solve_factored(factorise(matrix), matrix @ x)
    np.testing.assert_allclose(found, x, rtol=1e-9, atol=1e-9)


def test_definite_is_what_has_no_flat_direction():
    rng = np.random.default_rng(8)
    root = rng.normal(size=(6, 6))
    definite = root @ root.T + np.eye(6)
    flat = root[:, :5] @ root[:, :5].T
    assert is_definite(definite, 1e-12)
    assert not is_definite(flat, 1e-12)
    assert not is_definite(-definite, 1e-12)
    assert not is_definite(1e-13 * definite, 1e-11)
    assert least_pivot(np.diag([3.0, 2.0])) == 4.0
    assert is_definite(np.zeros((0, 0)), 1e-12)  # nothing is open where nothing is free
