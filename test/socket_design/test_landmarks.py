"""Frames from landmarks: their pose, how sure it is, and landmarks that cannot give one."""

from itertools import islice, permutations

import numpy as np
import pytest
from scipy.stats import chi2, f, kstest
from support.motive_takes import CELL
from support.problems import random_pose

from socket_testbed.errors import RegistrationError
from socket_testbed.geometry.pose import Pose
from socket_testbed.socket_design.landmarks import LandmarkFit, register_landmarks

TARGET = np.array([0.02, -0.03, 0.25])  # [m]; off the landmarks, as the limb is
NOISE = 4e-4  # [m]


@pytest.fixture
def rng():
    return np.random.default_rng(17)


def names_of(count: int) -> tuple[str, ...]:
    return tuple(f"LC{i + 1}" for i in range(count))


def measure(known: np.ndarray, pose: Pose, rng: np.random.Generator, noise: float = NOISE):
    return pose.apply(known) + rng.normal(0.0, noise, known.shape)


@pytest.mark.parametrize("count", [3, 4, 5])
def test_landmarks_without_error_give_the_pose(rng, count):
    pose = random_pose(rng, 1.0)
    fit = register_landmarks(CELL[:count], pose.apply(CELL[:count]), names_of(count))
    np.testing.assert_allclose(fit.pose.rotation, pose.rotation, atol=1e-12)
    np.testing.assert_allclose(fit.pose.translation, pose.translation, atol=1e-12)
    assert fit.rms < 1e-12 and fit.noise < 1e-12 and fit.degrees == 3 * count - 6


def test_no_small_motion_fits_better(rng):
    known = CELL[:4]
    measured = measure(known, random_pose(rng, 1.0), rng)
    fit = register_landmarks(known, measured, names_of(4))
    squares = (fit.residual**2).sum()
    assert fit.rms == pytest.approx(np.sqrt(squares / 4))
    for _ in range(100):
        small = Pose.from_quaternion(
            rng.normal(0.0, 1e-5, 3), np.array([*rng.normal(0.0, 1e-4, 3), 1])
        )
        moved = (small @ fit.pose).apply(known)
        assert ((moved - measured) ** 2).sum() > squares


def normalised(fit: LandmarkFit, pose: Pose) -> float:
    """Squared error at the target over its stated covariance."""
    error = pose.rotation.T @ (fit.pose.apply(TARGET) - pose.apply(TARGET))
    return float(error @ np.linalg.solve(fit.uncertainty.at(TARGET), error))


@pytest.mark.parametrize("count", [3, 5])
def test_the_error_is_within_the_stated_uncertainty(rng, count):
    """Of a known noise it is a chi square of 3, of one from the residuals an F of 3, 3k - 6."""
    known, given, own = CELL[:count], [], []
    for _ in range(400):
        pose = random_pose(rng, 1.0)
        measured = measure(known, pose, rng)
        given.append(normalised(register_landmarks(known, measured, names_of(count), NOISE), pose))
        own.append(normalised(register_landmarks(known, measured, names_of(count)), pose) / 3.0)
    assert kstest(given, chi2(3).cdf).pvalue > 1e-3
    assert kstest(own, f(3, 3 * count - 6).cdf).pvalue > 1e-3


def test_the_noise_comes_from_the_residuals(rng):
    squares = [
        register_landmarks(CELL, measure(CELL, random_pose(rng), rng), names_of(5)).noise ** 2
        for _ in range(300)
    ]
    # A chi square of 9 over 9: its standard deviation is sqrt(2 / 9).
    assert np.mean(squares) == pytest.approx(NOISE**2, rel=4.0 * np.sqrt(2.0 / 9.0 / 300.0))


def refused(known: np.ndarray, measured: np.ndarray) -> RegistrationError:
    with pytest.raises(RegistrationError) as caught:
        register_landmarks(known, measured, names_of(len(known)))
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_landmarks_are_refused(rng, count):
    error = refused(CELL[:count], random_pose(rng).apply(CELL[:count]))
    assert f"{count} landmarks" in error.fact and "3 or more" in error.hint


def test_landmarks_at_one_place_are_refused(rng):
    known = CELL.copy()
    known[3] = known[1] + [0.001, 0.0, 0.002]
    error = refused(known, random_pose(rng).apply(known))
    assert "LC2 and LC4" in error.fact and "2.2 mm apart" in error.fact
    assert "were measured" in refused(CELL, random_pose(rng).apply(known)).fact


def test_landmarks_on_a_line_are_refused(rng):
    line = np.linspace([0.0, 0.0, 0.0], [0.06, 0.08, 0.0], 4) + rng.normal(0.0, 1e-3, (4, 3))
    error = refused(line, random_pose(rng).apply(line))
    assert "LC1, LC2, LC3, LC4" in error.fact and "on one line" in error.fact
    assert "were measured on one line" in refused(CELL[:4], random_pose(rng).apply(line)).fact


@pytest.mark.parametrize("pair", [(0, 1), (1, 3), (2, 4)])
@pytest.mark.parametrize("count", [5, 7])
def test_swapped_names_are_named(rng, pair, count):
    known = rng.uniform(-0.08, 0.08, (count, 3))
    measured = measure(known, random_pose(rng), rng)
    measured[list(pair)] = measured[list(pair)[::-1]]
    error = refused(known, measured)
    assert f"LC{pair[0] + 1} and LC{pair[1] + 1} fit with" in error.fact
    assert "if they are swapped" in error.fact and "exchange" in error.hint


def test_names_in_a_ring_are_named(rng):
    known = CELL[:4]
    measured = measure(known, random_pose(rng), rng)[[1, 2, 0, 3]]
    assert "LC1 and LC2 and LC3 fit" in refused(known, measured).fact
    assert "taken for LC3 and LC1 and LC2" in refused(known, measured).fact


def test_a_mirrored_frame_is_refused(rng):
    error = refused(CELL, measure(CELL * [1.0, -1.0, 1.0], random_pose(rng), rng))
    assert "mirrored" in error.fact and "right-handed" in error.hint


@pytest.mark.parametrize("count", [4, 5])
def test_mirrored_landmarks_are_refused_in_every_order(count):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        known = CELL[:count] + rng.normal(0.0, 0.005, (count, 3))
        measured = measure(known * np.roll([-1.0, 1.0, 1.0], seed), random_pose(rng), rng)
        assert "mirrored" in refused(known, measured).fact
        for order in islice(permutations(range(count)), 1, None, count):
            assert "mirrored" in refused(known, measured[list(order)]).fact


def test_landmarks_that_nothing_explains_well_get_no_advice_to_exchange(rng):
    swapped = measure(CELL, random_pose(rng), rng, 5e-3)[[1, 0, 2, 3, 4]]
    error = refused(CELL, swapped)
    assert "LC1 and LC2" in error.fact and "measure their coordinates again" in error.hint
    assert "exchange" not in error.hint


@pytest.mark.parametrize("seed", range(5))
def test_landmarks_that_are_merely_bad_are_not_called_swapped(seed):
    rng = np.random.default_rng(seed)
    fit = register_landmarks(CELL, measure(CELL, random_pose(rng), rng, 4e-3), names_of(5))
    assert fit.rms > 1e-3


def test_landmarks_that_could_be_swapped_unseen_are_named(rng):
    isosceles = np.array([[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0], [0.001, 0.07, 0.0], [0.0, 0.0, 0.1]])
    fit = register_landmarks(isosceles, measure(isosceles, random_pose(rng), rng), names_of(4))
    swapped = measure(isosceles, random_pose(rng), rng)[[1, 0, 2, 3]]
    assert fit.blind == ()  # out of the plane, a swap would be a mirror image
    assert "LC1 and LC2" in refused(isosceles, swapped).fact
    fit = register_landmarks(isosceles[:3], random_pose(rng).apply(isosceles[:3]), names_of(3))
    assert "LC1 and LC2 could be swapped unseen" in fit.blind[0]


def test_landmarks_in_a_plane_are_said_to_hide_a_sign(rng):
    flat = CELL * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.02]
    fit = register_landmarks(flat, random_pose(rng).apply(flat), names_of(5))
    assert "one plane" in fit.blind[-1]
    other_sign = flat * [1.0, 1.0, -1.0]
    assert register_landmarks(other_sign, random_pose(rng).apply(flat), names_of(5)).rms < 1e-12
    assert register_landmarks(CELL, random_pose(rng).apply(CELL), names_of(5)).blind == ()
