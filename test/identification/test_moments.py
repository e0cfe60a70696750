"""The moments of the gated displacements against their naive sums, and the errors from them."""

import numpy as np
import pytest
from support.problems import FAR, make_case, moving_limb, naive_gated

from socket_testbed.identification.contact import gated_displacement
from socket_testbed.identification.moments import (
    LEAST_KEPT,
    GatedMoments,
    Group,
    Moments,
    noise_products,
    series_is_cheaper,
    subtract_noise,
)
from socket_testbed.identification.pareto import channel_mean_squares
from socket_testbed.identification.problem import StageTwoData, build_objective
from socket_testbed.settings.identification import PAPER_VARIANTS

FIELDS = ("mean", "gram", "target_mean", "cross", "target_power")
NEAR = {
    "hold": lambda rng: np.array([0.001, -0.002, 0.0005]) + rng.normal(0.0, 1e-5, (300, 3)),
    "ramp": lambda rng: np.linspace([0.0, 0.0, 0.0], [0.002, -0.004, 0.006], 300),
    "one axis": lambda rng: np.linspace(-0.002, 0.003, 200)[:, None] * [1.0, 0.0, 0.0],
    "multi-directional": lambda rng: moving_limb(rng, 300),
    "more rows than one block": lambda rng: moving_limb(rng, 9001),
    "still": lambda rng: np.tile([[0.001, -0.002, 0.0005]], (50, 1)),
    "single": lambda rng: np.array([[0.001, -0.002, 0.0005]]),
}
AWAY = {
    "hold": lambda rng: FAR + rng.normal(0.0, 1e-5, (300, 3)),
    "hold with a stray sample": lambda rng: np.vstack([rng.normal(0.0, 1e-6, (299, 3)), FAR / 5]),
    "one axis": NEAR["one axis"],
    "multi-directional": lambda rng: FAR + moving_limb(rng, 300),
    "more rows than one block": lambda rng: moving_limb(rng, 5001, 0.001),
    "still": lambda rng: np.tile(FAR, (50, 1)),
    "single": lambda rng: FAR[None],
}


def every_sample(position, targets, points):
    """The targets as one group that was measured in every sample."""
    return Group(np.ones(len(position), dtype=bool), targets, points)


def moments_at(position, rest, sharpness, targets, method="auto"):
    groups = [every_sample(position, targets, range(len(rest)))]
    return GatedMoments(position, sharpness, groups, method=method).at(rest)[0]


def naive_moments(position, rest_positions, sharpness, targets):
    """Means and centred products in extended precision."""
    wide = np.longdouble
    S = naive_gated(position.astype(wide)[:, None] - rest_positions.astype(wide), wide(sharpness))
    S, Y = S.reshape(len(position), -1), targets.astype(wide)
    means = S.mean(axis=0), Y.mean(axis=0)
    S, Y = S - means[0], Y - means[1]
    return *means, S.T @ S, S.T @ Y, (Y**2).sum(axis=0)


@pytest.mark.parametrize("method", ["direct", "series", "auto"])
@pytest.mark.parametrize("kind", NEAR)
def test_moments_are_those_of_the_naive_sums(kind, method):
    rng = np.random.default_rng(11)
    position = NEAR[kind](rng)
    rest = rng.uniform(-0.004, 0.004, (4, 3))
    targets = rng.normal(0.0, 50.0, (len(position), 6))
    found = moments_at(position, rest, 2000.0, targets, method)
    mean, target_mean, gram, cross, power = naive_moments(position, rest, 2000.0, targets)
    assert found.count == len(position)
    np.testing.assert_allclose(found.mean, mean.astype(float), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found.target_mean, target_mean.astype(float), atol=1e-11)
    # Each product against the size of its two columns, which carry a rounding of their own.
    rounding = np.sqrt(len(position)) * 1e-16  # [m]
    spread = np.sqrt(np.diag(gram)).astype(float)
    limit = 1e-10 * np.outer(spread, spread) + rounding * np.add.outer(spread, spread)
    assert (np.abs(found.gram - gram) <= limit + rounding**2).all()
    target_size = np.sqrt(power).astype(float)
    limit = np.outer(1e-10 * spread + rounding, target_size)
    assert (np.abs(found.cross - cross) <= limit + 1e-24).all()
    np.testing.assert_allclose(found.target_power, power.astype(float), rtol=1e-10, atol=1e-20)


@pytest.mark.parametrize("sharpness", [1.0, 300.0, 2e4])
def test_both_ways_to_the_moments_agree_for_any_sharpness(sharpness):
    rng = np.random.default_rng(12)
    position, rest = moving_limb(rng, 200, 0.002), rng.uniform(-0.002, 0.002, (5, 3))
    targets = rng.normal(size=(200, 6))
    direct = moments_at(position, rest, sharpness, targets, "direct")
    series = moments_at(position, rest, sharpness, targets, "series")
    for name in FIELDS:
        a, b = getattr(direct, name), getattr(series, name)
        assert np.abs(a - b).max() <= 1e-9 * np.abs(a).max(), name


def test_moments_about_zero_are_the_plain_sums():
    rng = np.random.default_rng(13)
    position, rest = moving_limb(rng, 60), rng.uniform(-0.002, 0.002, (3, 3))
    targets = rng.normal(3.0, 1.0, (60, 2))
    found = moments_at(position, rest, 2000.0, targets).about_zero()
    S = naive_gated(position[:, None] - rest, 2000.0).reshape(60, -1)
    np.testing.assert_allclose(found.gram, S.T @ S, rtol=1e-9, atol=1e-16)
    np.testing.assert_allclose(found.cross, S.T @ targets, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(found.target_power, (targets**2).sum(axis=0), rtol=1e-12)
    assert not found.mean.any()
    assert not found.target_mean.any()


def assert_same_moments(found, expected, precision=1e-9):
    assert found.count == expected.count
    spread = np.sqrt(np.diag(expected.gram)) + np.sqrt(expected.count) * 1e-16
    target = np.sqrt(expected.target_power) + np.sqrt(expected.count) * 1e-13
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found.target_mean, expected.target_mean, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.target_power, expected.target_power, rtol=1e-9, atol=1e-20)
    assert (np.abs(found.gram - expected.gram) <= precision * np.outer(spread, spread)).all()
    assert (np.abs(found.cross - expected.cross) <= precision * np.outer(spread, target)).all()


@pytest.mark.parametrize("kind", AWAY)
def test_one_pass_gives_the_moments_at_any_rest_positions(kind):
    rng = np.random.default_rng(1)
    position = AWAY[kind](rng)
    targets = rng.normal(3.0, 50.0, (len(position), 6))
    groups = [every_sample(position, targets, range(5))]
    series = GatedMoments(position, 2000.0, groups, method="series")
    for _ in range(3):
        rest = position.mean(axis=0) + rng.uniform(-0.004, 0.004, (5, 3))
        expected = moments_at(position, rest, 2000.0, targets, "direct")
        # Where the limb hardly moves, both lose digits to the rounding of q itself.
        (found,) = series.at(rest)
        assert_same_moments(found, expected, 1e-6 if "hold" in kind else 1e-9)


def test_the_gram_matrix_of_a_series_is_symmetric():
    rng = np.random.default_rng(2)
    position = moving_limb(rng, 100, 5e-4)
    rest = rng.uniform(-0.001, 0.001, (4, 3))
    gram = moments_at(position, rest, 2000.0, position, "series").gram
    np.testing.assert_allclose(gram, gram.T, rtol=0.0, atol=1e-14 * np.abs(gram).max())
    assert np.linalg.eigvalsh(gram).min() > -1e-12 * np.abs(gram).max()


def test_a_series_pays_on_a_hold_and_not_on_a_few_samples_of_a_wide_motion():
    rng = np.random.default_rng(3)
    assert series_is_cheaper(rng.normal(0.0, 1e-5, (300, 3)), 2000.0, 60)
    assert not series_is_cheaper(rng.normal(0.0, 0.01, (300, 3)), 2000.0, 60)


def test_what_does_not_pay_for_one_set_may_pay_for_many():
    motion = moving_limb(np.random.default_rng(9), 3000, 5e-4)
    assert not series_is_cheaper(motion, 2000.0, 8, sets=1)
    assert series_is_cheaper(motion, 2000.0, 8, sets=101)


def one_of(stacked, k):
    return Moments(*(getattr(stacked, name)[k] for name in ("count", *FIELDS)))


@pytest.mark.parametrize("gaps", [False, True])
def test_the_moments_of_stage_two_do_not_depend_on_the_way(gaps):
    geometry, bed, samples, settings = make_case(4, gaps=gaps, leave_out=("Mz", "cluster_1.Fx"))
    samples.position[:] = FAR + 0.02 * samples.position  # a hold, for which the series pays
    objective = build_objective(samples, geometry, settings)
    data = {method: StageTwoData(objective, method=method) for method in ("series", "direct")}
    for shift in (0.0, 1e-3):
        rest = FAR + bed.rest_positions + shift
        found, expected = (data[method].moments(rest) for method in data)
        assert_same_moments(found.wrench, expected.wrench, 1e-7)
        assert len(found.channels.count) == len(expected.channels.count) == 8
        for k in range(8):
            assert_same_moments(one_of(found.channels, k), one_of(expected.channels, k), 1e-7)


@pytest.mark.parametrize("with_offset", [False, True])
def test_mean_squares_are_those_of_the_residuals(with_offset):
    rng = np.random.default_rng(5)
    position, rest = moving_limb(rng, 80), rng.uniform(-0.002, 0.002, (3, 3))
    targets, rows = rng.normal(2.0, 5.0, (80, 4)), rng.normal(0.0, 2000.0, (4, 9))
    moments = moments_at(position, rest, 2000.0, targets)
    residual = targets - naive_gated(position[:, None] - rest, 2000.0).reshape(80, 9) @ rows.T
    if with_offset:
        residual -= residual.mean(axis=0)
    found = moments.mean_square_residuals(rows, with_offset)
    np.testing.assert_allclose(found, np.mean(residual**2, axis=0), rtol=1e-10)


def test_rounding_leaves_no_negative_square():
    one = np.ones((1, 1))
    power = np.array([1.0 - 1e-15])  # a hair less than its own prediction
    moments = Moments(10, np.zeros(1), one, np.zeros(1), one, power)
    assert moments.mean_square_residuals(one, with_offset=True) == [0.0]


def test_a_perfect_prediction_leaves_nothing():
    rng = np.random.default_rng(6)
    position, rest = moving_limb(rng, 80), rng.uniform(-0.002, 0.002, (3, 3))
    rows = rng.normal(0.0, 2000.0, (4, 9))
    targets = naive_gated(position[:, None] - rest, 2000.0).reshape(80, 9) @ rows.T
    moments = moments_at(position, rest, 2000.0, targets)
    found = moments.mean_square_residuals(rows, with_offset=False)
    assert (np.sqrt(found) <= 1e-7 * targets.std(axis=0)).all()


@pytest.mark.parametrize("weights", ["size", "noise"])
@pytest.mark.parametrize("leave_out", [(), ("Mx", "My", "Mz"), ("Fy", "cluster_0.Fz")])
@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_predicting_zero_makes_both_normalised_errors_one(variant, leave_out, weights):
    geometry, bed, samples, settings = make_case(7, variant, leave_out=leave_out, weights=weights)
    objective = build_objective(samples, geometry, settings)
    moments = StageTwoData(objective).moments(bed.rest_positions)
    nothing = np.zeros((len(geometry), 3))
    wrench, local = channel_mean_squares(objective, moments, nothing, with_bias=False)
    assert objective.wrench_shares @ wrench == pytest.approx(1.0)
    assert objective.channel_shares @ local == pytest.approx(1.0)


def random_covariance(rng, size=1e-4):
    """Covariance of a noise of about this size [m]."""
    root = size * rng.normal(size=(3, 3))
    return root @ root.T


def test_noise_products_are_what_noise_adds_to_the_gram():
    rng = np.random.default_rng(50)
    rest, position = rng.uniform(-0.002, 0.002, (4, 3)), moving_limb(rng, 40)
    covariance = random_covariance(rng, 2e-5)

    def products(q):
        s = gated_displacement(q, rest, 2000.0).reshape(len(q), -1)
        return s.T @ s

    # Noise of either sign: the parts of odd order cancel.
    noise = rng.multivariate_normal(np.zeros(3), covariance, (4000, 40))
    grown = np.mean(
        [0.5 * (products(position + e) + products(position - e)) for e in noise], axis=0
    )
    expected = noise_products(position, rest, 2000.0, covariance)
    curvature = np.mean([bent(position, rest, e) for e in noise[:500]], axis=0)
    found = grown - products(position) - curvature
    assert np.abs(found - expected).max() < 0.05 * np.abs(expected).max()


def bent(position, rest, noise):
    """What the mean of the gated displacements gains where they bend, in the products."""
    here, up, down = (
        gated_displacement(q, rest, 2000.0).reshape(len(position), -1)
        for q in (position, position + noise, position - noise)
    )
    gain = 0.5 * (up + down) - here
    return here.T @ gain + gain.T @ here


@pytest.mark.parametrize("size", [1e-6, 1e-4, 1e-3])
def test_a_gram_without_its_noise_stays_positive_and_keeps_a_share(size):
    rng = np.random.default_rng(51)
    rest, position = rng.uniform(-0.002, 0.002, (6, 3)), moving_limb(rng, 200)
    moments = moments_at(position, rest, 2000.0, np.zeros((200, 1)))
    noise = noise_products(position, rest, 2000.0, random_covariance(rng, size))
    corrected = subtract_noise(moments.gram, noise)
    for x in np.vstack([np.eye(18), rng.normal(size=(200, 18)), np.linalg.eigh(noise)[1].T]):
        whole, kept = x @ moments.gram @ x, x @ corrected @ x
        assert LEAST_KEPT * whole * (1.0 - 1e-6) <= kept <= whole * (1.0 + 1e-12)
    if size == 1e-6:  # no share is near its limit: all of it is subtracted
        np.testing.assert_allclose(corrected, moments.gram - noise, atol=1e-9 * noise.max())


@pytest.mark.parametrize("centred", [True, False])
def test_the_noise_of_a_channel_is_the_block_of_its_point(centred):
    rng = np.random.default_rng(52)
    rest, position = rng.uniform(-0.002, 0.002, (4, 3)), moving_limb(rng, 100)
    covariance = random_covariance(rng)
    group = every_sample(position, np.zeros((100, 2)), range(4))
    (found,) = GatedMoments(position, 2000.0, [group], noise=covariance).at(rest)
    found = found if centred else found.about_zero()
    block = found.select(slice(3, 6), slice(1, 2)).noise
    assert block is not None
    np.testing.assert_allclose(block, noise_products(position, rest[1:2], 2000.0, covariance))
    assert moments_at(position, rest, 2000.0, np.zeros((100, 1))).noise is None
