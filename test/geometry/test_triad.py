"""Marker triads to poses: labels, occlusions, the uncertainty, and a recording of a real system."""

import csv
import math
from itertools import permutations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import SHARED_DATA
from support.problems import PYLON_TRIAD, SOCKET_TRIAD, random_pose

from socket_testbed.geometry.marker_bodies import (
    edge_lengths,
    fit_body,
    fit_rigid,
    fit_triad,
    pose_uncertainty,
)
from socket_testbed.geometry.pose import Pose

TAKE = SHARED_DATA / "motive_csv" / "sample_optitrack_take.csv"


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def markers_at(pose: Pose, reference: np.ndarray = SOCKET_TRIAD) -> np.ndarray:
    """The body's markers in the frame of N poses, (N, 3, 3) [m]."""
    return reference @ np.swapaxes(pose.rotation, 1, 2) + pose.translation[:, None]


def angles_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between rotations, (N,) [rad]."""
    return (Rotation.from_matrix(a).inv() * Rotation.from_matrix(b)).magnitude()


def test_edge_lengths_of_a_right_triangle():
    triangle = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [3.0, 4.0, 0.0]])
    found = edge_lengths(np.stack([triangle, 2 * triangle]))
    np.testing.assert_allclose(found, [[3, 4, 5], [6, 8, 10]])


def test_any_order_of_labels_gives_the_pose_and_an_occluded_marker_none(rng):
    orders = np.array([*permutations(range(3))])
    pose = random_pose(rng, 2.0, 60)
    true = markers_at(pose)
    observed = np.take_along_axis(true, np.tile(orders, (10, 1))[:, :, None], axis=1)
    lost = np.array([0, 7, 8, 59])
    observed[lost, 1] = np.nan
    fit, seen = fit_triad(SOCKET_TRIAD, observed), np.setdiff1d(np.arange(60), lost)
    np.testing.assert_allclose(fit.pose.rotation[seen], pose.rotation[seen], atol=1e-10)
    np.testing.assert_allclose(fit.pose.translation[seen], pose.translation[seen], atol=1e-12)
    np.testing.assert_allclose(fit.residual[seen], 0.0, atol=1e-12)
    relabelled = np.take_along_axis(observed, fit.order[:, :, None], axis=1)
    np.testing.assert_allclose(relabelled[seen], true[seen], atol=1e-15)
    for values in (fit.pose.rotation, fit.pose.translation, fit.residual):
        assert np.isnan(values[lost]).all()
    assert (fit.order[lost] == -1).all()
    alike = fit_body(SOCKET_TRIAD, observed)
    np.testing.assert_array_equal(alike.pose.translation, fit.pose.translation)
    none = fit_triad(SOCKET_TRIAD, np.zeros((0, 3, 3)))
    assert none.pose.rotation.shape == (0, 3, 3) and none.pose.translation.shape == (0, 3)


def test_another_triad_gives_no_pose_by_the_tolerance_of_its_edges(rng):
    for stretch in (0.9, 1.1, 1000.0):
        observed = markers_at(random_pose(rng, count=5), stretch * SOCKET_TRIAD)
        fit = fit_triad(SOCKET_TRIAD, observed)
        assert np.isnan(fit.pose.rotation).all() and np.isnan(fit.residual).all()
    reference = np.array([[0.0, 0.0, 0.0], [0.08, 0.0, 0.0], [0.0, 0.15, 0.0]])
    longer = reference.copy()
    longer[1, 0] += 0.002  # one edge by 2 mm, another by 1 mm
    observed = markers_at(random_pose(rng, count=4), longer)
    observed[0] = observed[0, [1, 0, 2]]
    for tolerance, found in ((0.0019, False), (0.0021, True)):
        assert (fit_triad(reference, observed, tolerance).found == found).all()


def test_the_rotation_is_the_proper_one_of_least_squares_whatever_the_noise(rng):
    for noise, tolerance in ((2e-4, 0.002), (1e-3, 0.02)):
        pose = random_pose(rng, count=40)
        observed = markers_at(pose) + rng.normal(0.0, noise, (40, 3, 3))
        fit = fit_triad(SOCKET_TRIAD, observed, tolerance)
        assert fit.found.sum() > 35
        for frame in np.flatnonzero(fit.found):
            centred = observed[frame, fit.order[frame]]
            centred = centred - centred.mean(axis=0)
            arms = SOCKET_TRIAD - SOCKET_TRIAD.mean(axis=0)
            best, distance = Rotation.align_vectors(centred, arms)
            np.testing.assert_allclose(fit.pose.rotation[frame], best.as_matrix(), atol=1e-9)
            assert fit.residual[frame] == pytest.approx(distance / np.sqrt(3.0), rel=1e-6)
            assert np.linalg.det(fit.pose.rotation[frame]) == pytest.approx(1.0)


def test_noise_never_turns_a_rightly_labelled_isosceles_triad_over(rng):
    for off in (0.0, 2e-5, 2e-4):  # from the line of symmetry [m]
        isosceles = np.array([[-0.04, 0.0, 0.0], [0.04, 0.0, 0.0], [off, 0.07, 0.0]])
        pose = random_pose(rng, count=100)
        observed = markers_at(pose, isosceles) + rng.normal(0.0, 1e-4, (100, 3, 3))
        fit = fit_triad(isosceles, observed)
        known = fit.found  # no pose would be honest, too
        assert (angles_between(fit.pose.rotation[known], pose.rotation[known]) < 0.02).all()


# --- how sure the fit is: against random trials

FRAMES = 6000
NOISE = 1.5e-4  # [m]
LIMB = np.array([-0.045, -0.03, -0.22])  # far from the triad, as the lumped mass is


def test_the_residuals_give_the_noise_and_the_covariance_at_the_limb(rng):
    for triad in (SOCKET_TRIAD, PYLON_TRIAD):
        pose = random_pose(rng)
        observed = pose.apply(triad) + rng.normal(0.0, NOISE, (FRAMES, 3, 3))
        fit = fit_triad(triad, observed)
        # 3 degrees of freedom a frame: the estimate itself is good to 1 / sqrt(6 N).
        assert fit.noise == pytest.approx(NOISE, rel=4.0 / math.sqrt(6.0 * FRAMES))
        off = (fit.pose.apply(np.tile(LIMB, (FRAMES, 1))) - pose.apply(LIMB)) @ pose.rotation
        stated = pose_uncertainty(triad, fit.noise).at(LIMB)
        whitened = np.linalg.solve(np.linalg.cholesky(stated), off.T)
        np.testing.assert_allclose(np.cov(whitened), np.eye(3), atol=5.0 / math.sqrt(FRAMES))
        np.testing.assert_allclose(whitened.mean(axis=1), 0.0, atol=5.0 / math.sqrt(FRAMES))
        half = fit_triad(triad, observed[::2]).noise
        observed[1::2, 1] = np.nan  # occluded frames do not count as noise
        assert fit_triad(triad, observed).noise == pytest.approx(half, rel=1e-12)
        assert math.isnan(fit_triad(triad, observed[1::2]).noise)


def test_position_and_rotation_are_those_of_random_trials(rng):
    for count in (3, 4, 7):
        points, pose = rng.uniform(-0.08, 0.08, (count, 3)), random_pose(rng)
        fit = fit_rigid(points, pose.apply(points) + rng.normal(0.0, NOISE, (FRAMES, count, 3)))
        stated = pose_uncertainty(points, NOISE)
        centre = points.mean(axis=0)
        shift = (fit.apply(np.tile(centre, (FRAMES, 1))) - pose.apply(centre)) @ pose.rotation
        turn = Rotation.from_matrix(pose.rotation.T @ fit.rotation).as_rotvec()
        for found, expected in ((shift, stated.shift), (turn, stated.rotation)):
            white = np.linalg.solve(np.linalg.cholesky(expected), found.T)
            np.testing.assert_allclose(np.cov(white), np.eye(3), atol=5.0 / math.sqrt(FRAMES))
        both = np.corrcoef(shift.T, turn.T)[:3, 3:]
        np.testing.assert_allclose(both, 0.0, atol=5.0 / math.sqrt(FRAMES))


def test_the_variance_is_the_published_target_registration_error(rng):
    """Fitzpatrick, West and Maurer 1998: <TRE^2> = <FLE^2>/k (1 + 1/3 sum(d_i^2 / f_i^2))."""
    for count in (3, 4, 6):
        points, target = rng.uniform(-0.08, 0.08, (count, 3)), rng.uniform(-0.3, 0.3, 3)
        centred, arm = points - points.mean(axis=0), target - points.mean(axis=0)
        ratios = 0.0
        for axis in np.linalg.eigh(centred.T @ centred)[1].T:
            away = np.eye(3) - np.outer(axis, axis)
            ratios += (away @ arm) @ (away @ arm) / ((centred @ away) ** 2).sum(axis=1).mean()
        published = 3.0 * NOISE**2 / count * (1.0 + ratios / 3.0)
        assert np.trace(pose_uncertainty(points, NOISE).at(target)) == pytest.approx(published)


@pytest.mark.skipif(not TAKE.exists(), reason="the recording is not here")
def test_a_real_recording_gives_the_poses_of_motive(rng):
    with TAKE.open(newline="", encoding="utf-8") as stream:
        lines = list(csv.reader(stream))
    kinds, names, axes = lines[2], lines[3], lines[6]
    table = np.array(
        [[float(cell) if cell else np.nan for cell in line] for line in lines[7:] if line]
    )
    body = [i for i, kind in enumerate(kinds) if kind == "Rigid Body"]
    solved = [i for i, kind in enumerate(kinds) if kind == "Rigid Body Marker" and axes[i]]
    measured = [i for i, name in enumerate(names) if name.startswith("Rigid Body 1:Marker")]
    motive = Pose(Rotation.from_quat(table[:, body[:4]]).as_matrix(), table[:, body[4:7]])
    expected_markers = table[:, solved].reshape(-1, 3, 3)
    arms = expected_markers - motive.translation[:, None]
    reference = (arms @ motive.rotation).mean(axis=0)
    move = random_pose(rng, 1.0)  # the recorded body hardly moves: turn the whole scene
    for markers, tolerance, labels in (
        (expected_markers, 5e-6, (2, 0, 1)),
        # Motive's position is the centroid of its solved markers; that of the measured ones
        # is 0.060 mm off throughout the take, before any fit.
        (table[:, measured].reshape(-1, 3, 3), 7e-5, (0, 1, 2)),
        (table[:, measured].reshape(-1, 3, 3), 7e-5, (1, 0, 2)),
    ):
        observed = (markers @ move.rotation.T + move.translation)[:, labels]
        expected, fit = move @ motive, fit_triad(reference, observed)
        assert fit.found.all()
        assert angles_between(fit.pose.rotation, expected.rotation).max() < 3e-4
        difference = fit.pose.translation - expected.translation
        assert np.linalg.norm(difference, axis=1).max() < tolerance
        drift = np.linalg.norm(difference - difference.mean(axis=0), axis=1)
        assert drift.max() < 5e-5
