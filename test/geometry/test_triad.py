"""Marker triads to poses, on random motions and on a recording of a real system."""

import csv
from itertools import permutations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import SHARED_DATA
from support.problems import SOCKET_TRIAD, random_pose

from socket_testbed.geometry.marker_bodies import edge_lengths, fit_triad
from socket_testbed.geometry.pose import Pose

TAKE = SHARED_DATA / "motive_csv" / "sample_optitrack_take.csv"


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def markers_at(pose: Pose, reference: np.ndarray = SOCKET_TRIAD) -> np.ndarray:
    """The body's markers in the frame of N poses, (N, 3, 3) [m]."""
    return np.array(
        [reference @ R.T + t for R, t in zip(pose.rotation, pose.translation, strict=True)]
    )


def angles_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between rotations, (N,) [rad]."""
    return (Rotation.from_matrix(a).inv() * Rotation.from_matrix(b)).magnitude()


def test_edge_lengths_of_a_right_triangle():
    triangle = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [3.0, 4.0, 0.0]])
    np.testing.assert_allclose(
        edge_lengths(np.stack([triangle, 2 * triangle])), [[3, 4, 5], [6, 8, 10]]
    )


@pytest.mark.parametrize("labels", list(permutations(range(3))))
def test_any_order_of_labels_gives_the_pose(rng, labels):
    pose = random_pose(rng, 2.0, 40)
    observed = markers_at(pose)[:, labels]
    fit = fit_triad(SOCKET_TRIAD, observed)
    np.testing.assert_allclose(fit.pose.rotation, pose.rotation, atol=1e-10)
    np.testing.assert_allclose(fit.pose.translation, pose.translation, atol=1e-12)
    np.testing.assert_allclose(fit.residual, 0.0, atol=1e-12)
    relabelled = np.take_along_axis(observed, fit.order[:, :, None], axis=1)
    np.testing.assert_allclose(relabelled, markers_at(pose), atol=1e-15)


def test_labels_swapped_in_single_frames_do_not_disturb_the_motion(rng):
    turn = Rotation.from_rotvec(np.linspace(0.0, 1.0, 60)[:, None] * [0.3, -0.5, 0.7])
    pose = Pose(turn.as_matrix(), np.linspace([0.0, 1.0, 0.0], [0.1, 1.2, 0.3], 60))
    observed = markers_at(pose) + rng.normal(0.0, 1e-4, (60, 3, 3))
    calm = fit_triad(SOCKET_TRIAD, observed)
    swapped = observed.copy()
    for frame in rng.permutation(60)[:15]:
        swapped[frame] = swapped[frame][rng.permutation(3)]
    disturbed = fit_triad(SOCKET_TRIAD, swapped)
    np.testing.assert_allclose(disturbed.pose.rotation, calm.pose.rotation, atol=1e-12)
    np.testing.assert_allclose(disturbed.pose.translation, calm.pose.translation, atol=1e-12)
    assert angles_between(disturbed.pose.rotation, pose.rotation).max() < 0.02


@pytest.mark.parametrize("frames", [[0], [3, 4], list(range(6))])
def test_an_occluded_marker_gives_no_pose_and_not_an_older_one(rng, frames):
    pose = random_pose(rng, count=6)
    observed = markers_at(pose)
    observed[frames, 1] = np.nan
    fit = fit_triad(SOCKET_TRIAD, observed)
    seen = np.setdiff1d(np.arange(6), frames)
    for lost in (fit.pose.rotation, fit.pose.translation, fit.residual):
        assert np.isnan(lost[frames]).all()
    assert (fit.order[frames] == -1).all()
    np.testing.assert_allclose(fit.pose.rotation[seen], pose.rotation[seen], atol=1e-10)


def test_no_frames_give_no_poses():
    fit = fit_triad(SOCKET_TRIAD, np.zeros((0, 3, 3)))
    assert fit.pose.rotation.shape == (0, 3, 3)
    assert fit.pose.translation.shape == (0, 3)


@pytest.mark.parametrize("stretch", [0.9, 1.1, 1000.0])
def test_another_triad_gives_no_pose(rng, stretch):
    observed = markers_at(random_pose(rng, count=5), stretch * SOCKET_TRIAD)
    fit = fit_triad(SOCKET_TRIAD, observed)
    assert np.isnan(fit.pose.rotation).all()
    assert np.isnan(fit.residual).all()


@pytest.mark.parametrize(("tolerance", "found"), [(0.0019, False), (0.0021, True)])
def test_the_tolerance_is_one_of_edge_lengths(rng, tolerance, found):
    reference = np.array([[0.0, 0.0, 0.0], [0.08, 0.0, 0.0], [0.0, 0.15, 0.0]])
    longer = reference.copy()
    longer[1, 0] += 0.002  # one edge by 2 mm, another by 1 mm
    fit = fit_triad(reference, markers_at(random_pose(rng, count=4), longer), tolerance)
    assert np.isfinite(fit.residual).all() == found


def test_the_residual_grows_with_the_noise(rng):
    observed = markers_at(random_pose(rng, count=200))
    direction = rng.normal(size=observed.shape)
    mean = [
        fit_triad(SOCKET_TRIAD, observed + noise * direction).residual.mean()
        for noise in (0.0, 2e-5, 1e-4, 3e-4)
    ]
    assert (np.diff(mean) > 0.0).all()
    assert mean[2] < 3e-4  # no more than the noise of the three coordinates


def test_the_rotation_is_proper_whatever_the_noise(rng):
    pose = random_pose(rng, count=300)
    observed = markers_at(pose) + rng.normal(0.0, 1e-3, (300, 3, 3))
    fit = fit_triad(SOCKET_TRIAD, observed, tolerance=0.02)
    R = fit.pose.rotation[np.isfinite(fit.residual)]
    assert len(R) > 250
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)
    np.testing.assert_allclose(
        np.swapaxes(R, 1, 2) @ R, np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-12
    )


def test_the_rotation_is_the_least_squares_one(rng):
    pose = random_pose(rng, count=20)
    observed = markers_at(pose) + rng.normal(0.0, 2e-4, (20, 3, 3))
    fit = fit_triad(SOCKET_TRIAD, observed)
    for frame in range(20):
        centred = observed[frame] - observed[frame].mean(axis=0)
        best, distance = Rotation.align_vectors(centred, SOCKET_TRIAD - SOCKET_TRIAD.mean(axis=0))
        np.testing.assert_allclose(fit.pose.rotation[frame], best.as_matrix(), atol=1e-9)
        assert fit.residual[frame] == pytest.approx(distance / np.sqrt(3.0), rel=1e-6)


def test_the_fit_does_not_depend_on_where_the_camera_frame_is(rng):
    observed = markers_at(random_pose(rng, count=10)) + rng.normal(0.0, 1e-4, (10, 3, 3))
    move = random_pose(rng, 3.0)
    fit = fit_triad(SOCKET_TRIAD, observed)
    moved = fit_triad(SOCKET_TRIAD, observed @ move.rotation.T + move.translation)
    expected = move @ fit.pose
    np.testing.assert_allclose(moved.pose.rotation, expected.rotation, atol=1e-9)
    np.testing.assert_allclose(moved.pose.translation, expected.translation, atol=1e-9)
    np.testing.assert_allclose(moved.residual, fit.residual, atol=1e-12)


@pytest.mark.parametrize("off", [0.0, 2e-5, 2e-4])  # from the line of symmetry [m]
def test_noise_never_turns_a_rightly_labelled_isosceles_triad_over(rng, off):
    isosceles = np.array([[-0.04, 0.0, 0.0], [0.04, 0.0, 0.0], [off, 0.07, 0.0]])
    pose = random_pose(rng, count=100)
    observed = markers_at(pose, isosceles) + rng.normal(0.0, 1e-4, (100, 3, 3))
    fit = fit_triad(isosceles, observed)
    known = np.isfinite(fit.residual)  # no pose would be honest, too
    assert (angles_between(fit.pose.rotation[known], pose.rotation[known]) < 0.02).all()


@pytest.fixture(scope="module")
def take() -> dict[str, np.ndarray]:
    """Motive's own pose, its solved markers and the measured ones, 250 frames."""
    if not TAKE.exists():
        pytest.skip("the recording is not here")
    with TAKE.open(newline="", encoding="utf-8") as stream:
        lines = list(csv.reader(stream))
    kinds, names, axes = lines[2], lines[3], lines[6]
    table = np.array(
        [[float(cell) if cell else np.nan for cell in line] for line in lines[7:] if line]
    )
    body = [i for i, kind in enumerate(kinds) if kind == "Rigid Body"]
    solved = [i for i, kind in enumerate(kinds) if kind == "Rigid Body Marker" and axes[i]]
    measured = [i for i, name in enumerate(names) if name.startswith("Rigid Body 1:Marker")]
    quaternion, position = table[:, body[:4]], table[:, body[4:7]]
    motive = Pose(Rotation.from_quat(quaternion).as_matrix(), position)
    solved_markers = table[:, solved].reshape(-1, 3, 3)
    in_body = np.einsum("nji,nkj->nki", motive.rotation, solved_markers - position[:, None])
    return {
        "rotation": motive.rotation,
        "position": position,
        "solved": solved_markers,
        "measured": table[:, measured].reshape(-1, 3, 3),
        "reference": in_body.mean(axis=0),
    }


@pytest.mark.parametrize("labels", [(0, 1, 2), (2, 0, 1), (1, 0, 2)])
@pytest.mark.parametrize(
    ("markers", "position_tolerance"),
    [
        ("solved", 5e-6),
        # Motive's position is the centroid of its solved markers; that of the measured ones
        # is 0.060 mm off throughout the take, before any fit.
        ("measured", 7e-5),
    ],
)
def test_a_real_recording_gives_the_poses_of_motive(rng, take, markers, position_tolerance, labels):
    move = random_pose(rng, 1.0)  # the recorded body hardly moves: turn the whole scene
    observed = (take[markers] @ move.rotation.T + move.translation)[:, labels]
    motive = move @ Pose(take["rotation"], take["position"])
    fit = fit_triad(take["reference"], observed)
    assert np.isfinite(fit.residual).all()
    assert angles_between(fit.pose.rotation, motive.rotation).max() < 3e-4
    difference = fit.pose.translation - motive.translation
    assert np.linalg.norm(difference, axis=1).max() < position_tolerance
    drift = np.linalg.norm(difference - difference.mean(axis=0), axis=1)
    assert drift.max() < 5e-5
