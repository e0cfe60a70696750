"""Bodies of four to eight markers to poses: occluded, mislabelled and false markers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.problems import PYLON_TRIAD, SOCKET_TRIAD, random_pose

from socket_testbed.geometry.marker_bodies import (
    EDGE_TOLERANCE,
    body_fault,
    distances,
    fit_body,
    fit_triad,
    pose_uncertainty,
)
from socket_testbed.geometry.pose import Pose

NOISE = 1e-4  # [m]
COUNT = 40


def body_of(size: int, seed: int = 0) -> np.ndarray:
    """Markers of a body as a lab would place them, shape (size, 3) [m]."""
    rng = np.random.default_rng(seed)
    while True:
        markers = rng.uniform(-0.08, 0.08, (size, 3))
        if body_fault(markers) is None:
            return markers


def observe(body: np.ndarray, pose: Pose, rng: np.random.Generator, noise=NOISE) -> np.ndarray:
    """What the cameras see in each frame, shape (N, k, 3) [m]."""
    seen = body @ np.swapaxes(pose.rotation, 1, 2) + pose.translation[:, None]
    return seen + rng.normal(0.0, noise, seen.shape)


def aligned(body: np.ndarray, seen: np.ndarray) -> Rotation:
    """The rotation of one frame by another implementation."""
    return Rotation.align_vectors(seen - seen.mean(axis=0), body - body.mean(axis=0))[0]


def check(fit, body, pose, rng, tolerance=20.0 * NOISE) -> None:
    """Poses are right wherever there is one."""
    found = fit.found
    probe = body.mean(axis=0)
    points = fit.pose.rotation @ probe + fit.pose.translation
    true = pose.rotation @ probe + pose.translation
    assert np.linalg.norm(points - true, axis=1)[found].max(initial=0.0) < tolerance
    turned = Rotation.from_matrix(fit.pose.rotation[found].swapaxes(1, 2) @ pose.rotation[found])
    assert turned.magnitude().max(initial=0.0) < 0.05


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture(params=[4, 5, 6, 8])
def body(request) -> np.ndarray:
    return body_of(request.param)


def test_the_pose_is_fitted_to_all_markers_that_are_seen(rng, body):
    pose = random_pose(rng, count=COUNT)
    observed = observe(body, pose, rng)
    for k in range(0, COUNT, 2):  # in every other frame one is occluded
        observed[k, k // 2 % len(body)] = np.nan
    fit = fit_body(body, observed)
    np.testing.assert_array_equal(fit.found, (fit.order >= 0).any(axis=1))
    assert fit.found[1::2].all()
    check(fit, body, pose, rng)
    for k in np.flatnonzero(fit.found):
        seen = np.isfinite(observed[k]).all(axis=1)
        np.testing.assert_array_equal(fit.order[k], np.where(seen, np.arange(len(body)), -1))
        turn = aligned(body[seen], observed[k, seen]).as_matrix()
        np.testing.assert_allclose(fit.pose.rotation[k], turn, atol=1e-9)


def test_with_three_markers_left_there_is_a_pose_or_none_but_no_wrong_one(rng, body):
    pose = random_pose(rng, count=200)
    observed = observe(body, pose, rng)
    for frame in observed:
        frame[rng.permutation(len(body))[3:]] = np.nan
    fit = fit_body(body, observed)
    assert fit.found.mean() > 0.3  # the others are a part of the body that it has twice
    check(fit, body, pose, rng, 0.01)
    observed[:, 0] = observed[:, 1] = np.nan
    observed[:, 2:] = np.where(np.arange(len(body) - 2)[:, None] > 1, np.nan, observed[:, 2:])
    assert not fit_body(body, observed).found.any()


@pytest.mark.parametrize("hidden", [0, 1])
def test_labels_in_any_order_are_put_right(rng, body, hidden):
    pose = random_pose(rng, count=COUNT)
    truth = observe(body, pose, rng)
    observed = truth.copy()
    orders = np.array([rng.permutation(len(body)) for _ in range(COUNT)])
    for k in range(COUNT):
        observed[k] = truth[k][orders[k]]
        observed[k, rng.permutation(len(body))[:hidden]] = np.nan
    fit = fit_body(body, observed)
    # Three markers that changed their labels might fit by chance: they are left alone.
    assert fit.found.mean() >= (1.0 if not hidden else 0.5 if len(body) > 4 else 0.0)
    check(fit, body, pose, rng)
    for k in np.flatnonzero(fit.found):
        used = fit.order[k] >= 0
        np.testing.assert_array_equal(observed[k, fit.order[k][used]], truth[k][used])


@pytest.mark.parametrize("size", [4, 5, 6, 8])
def test_a_reflection_taken_for_a_marker_is_left_out(rng, size):
    body = body_of(size)
    pose = random_pose(rng, count=COUNT)
    observed = observe(body, pose, rng)
    observed[:, 1] += rng.uniform(0.01, 0.05, (COUNT, 3))
    fit = fit_body(body, observed)
    assert fit.found.all() and (fit.order[:, 1] == -1).all()
    check(fit, body, pose, rng)


def test_another_body_and_a_mirrored_one_have_no_pose(rng, body):
    pose = random_pose(rng, count=COUNT)
    assert not fit_body(body, observe(1.2 * body, pose, rng)).found.any()
    mirrored = body * np.array([1.0, 1.0, -1.0])
    assert not fit_body(body, observe(mirrored, pose, rng)).found.any()
    assert not fit_body(body, observe(body_of(len(body), seed=5), pose, rng)).found.any()


def test_the_residuals_give_the_noise_and_the_uncertainty_of_the_pose(rng, body):
    pose = random_pose(rng, count=1)
    repeated = Pose(np.repeat(pose.rotation, 4000, axis=0), np.repeat(pose.translation, 4000, 0))
    observed = observe(body, repeated, rng)
    observed[1::2, 0] = np.nan
    fit = fit_body(body, observed)
    assert fit.noise == pytest.approx(NOISE, rel=0.03)
    probe = np.array([0.05, -0.03, -0.2])
    off = (fit.pose.rotation @ probe + fit.pose.translation)[::2] - (
        repeated.rotation @ probe + repeated.translation
    )[::2]
    stated = np.trace(pose_uncertainty(body, fit.noise).at(probe))
    assert (off**2).sum(axis=1).mean() == pytest.approx(stated, rel=0.1)


def test_more_markers_make_a_surer_pose(rng):
    eight = body_of(8)
    scatter = [np.trace(pose_uncertainty(eight[:k], NOISE).at(np.zeros(3))) for k in (3, 5, 8)]
    assert scatter == sorted(scatter, reverse=True)


@pytest.mark.parametrize("triad", [SOCKET_TRIAD, PYLON_TRIAD])
def test_three_markers_are_fitted_as_a_triad(rng, triad):
    observed = observe(triad, random_pose(rng, count=COUNT), rng)
    observed[::3] = observed[::3][:, [1, 0, 2]]
    observed[5, 1] = np.nan
    one, other = fit_body(triad, observed), fit_triad(triad, observed)
    np.testing.assert_array_equal(one.order, other.order)
    np.testing.assert_array_equal(one.pose.translation, other.pose.translation)


SQUARE = np.array([[0.0, 0.0, 0.0], [0.06, 0.0, 0.0], [0.06, 0.06, 0.0], [0.0, 0.06, 0.0]])


@pytest.mark.parametrize(
    ("markers", "fact", "hint"),
    [
        (SQUARE, "look alike with labels", "differ by 4 mm"),
        (np.array([[0, 0, 0], [3, 0, 0], [7, 0, 0], [12, 0, 0]]) * 0.01, "on one line", "10 mm"),
        (np.vstack([body_of(4), body_of(4)[1] + 0.002]), "markers 2 and 5 are 3.5 mm apart", "10"),
        (np.vstack([SQUARE, [[0.03, 0.03, 0.05]]]), "look alike", "differ"),
    ],
)
def test_bodies_whose_labels_cannot_be_found_are_refused(markers, fact, hint):
    found = body_fault(markers)
    assert found is not None and fact in found[0] and hint in found[1]


def test_distances_that_differ_by_more_than_the_tolerance_make_a_body(body):
    assert body_fault(body) is None
    apart = distances(body)[np.triu_indices(len(body), 1)]
    assert apart.min() > 5.0 * EDGE_TOLERANCE


@pytest.mark.parametrize("size", [4, 5, 8])
def test_whatever_happens_to_the_markers_a_pose_is_right_or_missing(size):
    """Occluded, exchanged and false markers together, far more of them than in a lab."""
    rng = np.random.default_rng(size)
    wrong = found = count = 0
    for seed in range(4):
        body, pose = body_of(size, seed), random_pose(rng, count=100)
        observed = observe(body, pose, rng)
        for frame in observed:
            if rng.random() < 0.3:
                a, b = rng.permutation(size)[:2]
                frame[[a, b]] = frame[[b, a]]
            false, hidden = rng.random((2, size)) < [[0.08], [0.15]]
            frame[false] += rng.uniform(-0.05, 0.05, (int(false.sum()), 3))
            frame[hidden] = np.nan
        fit = fit_body(body, observed)
        probe = body.mean(axis=0)
        off = fit.pose.rotation @ probe + fit.pose.translation
        off -= pose.rotation @ probe + pose.translation
        wrong += int((np.linalg.norm(off[fit.found], axis=1) > 0.002).sum())
        found, count = found + int(fit.found.sum()), count + len(observed)
    assert wrong <= 0.002 * count
    assert found > 0.6 * count
