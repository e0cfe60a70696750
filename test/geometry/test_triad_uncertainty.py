"""How sure a rigid fit is: against random trials and the published formula."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from support.problems import PYLON_TRIAD, SOCKET_TRIAD, random_pose

from socket_testbed.geometry.marker_bodies import fit_rigid, fit_triad, misfit, pose_uncertainty
from socket_testbed.geometry.pose import Pose

FRAMES = 6000
NOISE = 1.5e-4  # [m]
LIMB = np.array([-0.045, -0.03, -0.22])  # far from the triad, as the lumped mass is


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def points_of(count: int, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-0.08, 0.08, (count, 3))


def observe(points: np.ndarray, pose: Pose, rng: np.random.Generator) -> np.ndarray:
    """The points FRAMES times, with noise."""
    return pose.apply(points) + rng.normal(0.0, NOISE, (FRAMES, *points.shape))


@pytest.mark.parametrize("triad", [SOCKET_TRIAD, PYLON_TRIAD])
def test_the_residuals_of_a_triad_give_the_noise_of_its_markers(rng, triad):
    fit = fit_triad(triad, observe(triad, random_pose(rng), rng))
    # 3 degrees of freedom a frame: the estimate itself is good to 1 / sqrt(6 N).
    assert fit.noise == pytest.approx(NOISE, rel=4.0 / math.sqrt(6.0 * FRAMES))


def test_occluded_frames_do_not_count_as_noise(rng):
    observed = observe(SOCKET_TRIAD, random_pose(rng), rng)
    seen = fit_triad(SOCKET_TRIAD, observed[::2]).noise
    observed[1::2, 1] = np.nan
    assert fit_triad(SOCKET_TRIAD, observed).noise == pytest.approx(seen, rel=1e-12)


def test_without_a_frame_the_noise_is_unknown():
    assert math.isnan(fit_triad(SOCKET_TRIAD, np.full((4, 3, 3), np.nan)).noise)


@pytest.mark.parametrize("triad", [SOCKET_TRIAD, PYLON_TRIAD])
def test_the_covariance_at_the_limb_is_that_of_random_trials(rng, triad):
    pose = random_pose(rng)
    fit = fit_triad(triad, observe(triad, pose, rng))
    off = (fit.pose.apply(np.tile(LIMB, (FRAMES, 1))) - pose.apply(LIMB)) @ pose.rotation
    stated = pose_uncertainty(triad, fit.noise).at(LIMB)
    whitened = np.linalg.solve(np.linalg.cholesky(stated), off.T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(3), atol=5.0 / math.sqrt(FRAMES))
    np.testing.assert_allclose(whitened.mean(axis=1), 0.0, atol=5.0 / math.sqrt(FRAMES))


@pytest.mark.parametrize("count", [3, 4, 7])
def test_position_and_rotation_are_those_of_random_trials(rng, count):
    points, pose = points_of(count, rng), random_pose(rng)
    fit = fit_rigid(points, observe(points, pose, rng))
    stated = pose_uncertainty(points, NOISE)
    centre = points.mean(axis=0)
    shift = (fit.apply(np.tile(centre, (FRAMES, 1))) - pose.apply(centre)) @ pose.rotation
    turn = Rotation.from_matrix(pose.rotation.T @ fit.rotation).as_rotvec()
    for found, expected in ((shift, stated.shift), (turn, stated.rotation)):
        white = np.linalg.solve(np.linalg.cholesky(expected), found.T)
        np.testing.assert_allclose(np.cov(white), np.eye(3), atol=5.0 / math.sqrt(FRAMES))
    both = np.corrcoef(shift.T, turn.T)[:3, 3:]
    np.testing.assert_allclose(both, 0.0, atol=5.0 / math.sqrt(FRAMES))


@pytest.mark.parametrize("count", [3, 5])
def test_the_residual_of_the_fit_has_the_degrees_of_freedom_that_are_claimed(rng, count):
    points, pose = points_of(count, rng), random_pose(rng)
    observed = observe(points, pose, rng)
    squares = (misfit(points, observed, fit_rigid(points, observed)) ** 2).sum(axis=1) / NOISE**2
    for share in (0.1, 0.5, 0.9):
        below = (squares < chi2.ppf(share, 3 * count - 6)).mean()
        assert below == pytest.approx(share, abs=5.0 * math.sqrt(share * (1 - share) / FRAMES))


@pytest.mark.parametrize("count", [3, 4, 6])
def test_the_variance_is_the_published_target_registration_error(rng, count):
    """Fitzpatrick, West and Maurer 1998: <TRE^2> = <FLE^2>/k (1 + 1/3 sum(d_i^2 / f_i^2))."""
    points, target = points_of(count, rng), rng.uniform(-0.3, 0.3, 3)
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    arm = target - points.mean(axis=0)
    ratios = 0.0
    for axis in axes.T:
        away = np.eye(3) - np.outer(axis, axis)
        ratios += (away @ arm) @ (away @ arm) / ((centred @ away) ** 2).sum(axis=1).mean()
    published = 3.0 * NOISE**2 / count * (1.0 + ratios / 3.0)
    assert np.trace(pose_uncertainty(points, NOISE).at(target)) == pytest.approx(published)


def test_the_mean_of_many_frames_is_surer_by_the_root_of_their_number(rng):
    pose = random_pose(rng)
    means = observe(SOCKET_TRIAD, pose, rng).reshape(-1, 25, 3, 3).mean(axis=1)
    off = fit_rigid(SOCKET_TRIAD, means).apply(np.tile(LIMB, (len(means), 1))) - pose.apply(LIMB)
    stated = pose_uncertainty(SOCKET_TRIAD, NOISE / 5.0).at(LIMB)
    assert (off**2).sum(axis=1).mean() == pytest.approx(np.trace(stated), rel=0.25)


def test_many_points_fit_as_scipy_fits_them(rng):
    points = points_of(6, rng)
    observed = observe(points, random_pose(rng), rng)[:10]
    fit = fit_rigid(points, observed)
    for R, t, markers in zip(fit.rotation, fit.translation, observed, strict=True):
        centred = markers - markers.mean(axis=0)
        best, _ = Rotation.align_vectors(centred, points - points.mean(axis=0))
        np.testing.assert_allclose(R, best.as_matrix(), atol=1e-9)
        np.testing.assert_allclose(R @ points.mean(axis=0) + t, markers.mean(axis=0), atol=1e-12)
