"""The moments of the gated displacements against their naive sums."""

import numpy as np
import pytest
from support.problems import moving_limb, naive_gated

from socket_testbed.identification.moments import gate_moments

MOTIONS = {
    "hold": lambda rng: np.array([0.001, -0.002, 0.0005]) + rng.normal(0.0, 1e-5, (300, 3)),
    "ramp": lambda rng: np.linspace([0.0, 0.0, 0.0], [0.002, -0.004, 0.006], 300),
    "one axis": lambda rng: np.linspace(-0.002, 0.003, 200)[:, None] * [1.0, 0.0, 0.0],
    "multi-directional": lambda rng: moving_limb(rng, 300),
    "more rows than one block": lambda rng: moving_limb(rng, 9001),
    "still": lambda rng: np.tile([[0.001, -0.002, 0.0005]], (50, 1)),
    "single": lambda rng: np.array([[0.001, -0.002, 0.0005]]),
}


def naive_moments(position, rest_positions, sharpness, targets):
    """Means and centred products in extended precision."""
    wide = np.longdouble
    S = naive_gated(position.astype(wide)[:, None] - rest_positions.astype(wide), wide(sharpness))
    S, Y = S.reshape(len(position), -1), targets.astype(wide)
    means = S.mean(axis=0), Y.mean(axis=0)
    S, Y = S - means[0], Y - means[1]
    return *means, S.T @ S, S.T @ Y, (Y**2).sum(axis=0)


@pytest.mark.parametrize("method", ["direct", "chebyshev", "auto"])
@pytest.mark.parametrize("kind", MOTIONS)
def test_moments_are_those_of_the_naive_sums(kind, method):
    rng = np.random.default_rng(11)
    position = MOTIONS[kind](rng)
    rest = rng.uniform(-0.004, 0.004, (4, 3))
    targets = rng.normal(0.0, 50.0, (len(position), 6))
    found = gate_moments(position, rest, 2000.0, targets, method)
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
    direct = gate_moments(position, rest, sharpness, targets, "direct")
    series = gate_moments(position, rest, sharpness, targets, "chebyshev")
    for name in ("mean", "gram", "cross", "target_mean", "target_power"):
        a, b = getattr(direct, name), getattr(series, name)
        assert np.abs(a - b).max() <= 1e-9 * np.abs(a).max(), name


def test_moments_about_zero_are_the_plain_sums():
    rng = np.random.default_rng(13)
    position, rest = moving_limb(rng, 60), rng.uniform(-0.002, 0.002, (3, 3))
    targets = rng.normal(3.0, 1.0, (60, 2))
    found = gate_moments(position, rest, 2000.0, targets).about_zero()
    S = naive_gated(position[:, None] - rest, 2000.0).reshape(60, -1)
    np.testing.assert_allclose(found.gram, S.T @ S, rtol=1e-9, atol=1e-16)
    np.testing.assert_allclose(found.cross, S.T @ targets, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(found.target_power, (targets**2).sum(axis=0), rtol=1e-12)
    assert not found.mean.any()
    assert not found.target_mean.any()
