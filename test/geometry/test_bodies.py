"""Bodies of four to eight markers to poses: occluded, mislabelled and false markers."""

from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.problems import random_pose

from socket_testbed.geometry.marker_bodies import (
    body_fault,
    fit_body,
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


def check(fit, body, pose, tolerance=20.0 * NOISE) -> None:
    """Poses are right wherever there is one."""
    found = fit.found
    probe = body.mean(axis=0)
    points = fit.pose.rotation @ probe + fit.pose.translation
    true = pose.rotation @ probe + pose.translation
    assert np.linalg.norm(points - true, axis=1)[found].max(initial=0.0) < tolerance
    turned = Rotation.from_matrix(fit.pose.rotation[found].swapaxes(1, 2) @ pose.rotation[found])
    assert turned.magnitude().max(initial=0.0) < 0.05


SIZES = (4, 5, 6, 8)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def test_the_pose_is_fitted_to_all_markers_that_are_seen(rng):
    for size in SIZES:
        body, pose = body_of(size), random_pose(rng, count=COUNT)
        observed = observe(body, pose, rng)
        for k in range(0, COUNT, 2):  # in every other frame one is occluded
            observed[k, k // 2 % size] = np.nan
        fit = fit_body(body, observed)
        np.testing.assert_array_equal(fit.found, (fit.order >= 0).any(axis=1))
        assert fit.found[1::2].all()
        check(fit, body, pose)
        for k in np.flatnonzero(fit.found):
            seen = np.isfinite(observed[k]).all(axis=1)
            np.testing.assert_array_equal(fit.order[k], np.where(seen, np.arange(size), -1))
            arms = body[seen] - body[seen].mean(axis=0)
            centred = observed[k, seen] - observed[k, seen].mean(axis=0)
            turn = Rotation.align_vectors(centred, arms)[0].as_matrix()
            np.testing.assert_allclose(fit.pose.rotation[k], turn, atol=1e-9)


def test_with_three_markers_left_there_is_a_pose_or_none_but_no_wrong_one(rng):
    for size in SIZES:
        body, pose = body_of(size), random_pose(rng, count=200)
        observed = observe(body, pose, rng)
        for frame in observed:
            frame[rng.permutation(size)[3:]] = np.nan
        fit = fit_body(body, observed)
        assert fit.found.mean() > 0.3  # the others are a part of the body that it has twice
        check(fit, body, pose, 0.01)
        observed[:, 2:] = np.nan
        assert not fit_body(body, observed).found.any()


def test_labels_in_any_order_are_put_right_and_a_reflection_is_left_out(rng):
    for size in SIZES:
        body, pose = body_of(size), random_pose(rng, count=COUNT)
        truth = observe(body, pose, rng)
        for hidden in (0, 1):
            orders = np.array([rng.permutation(size) for _ in range(COUNT)])
            observed = np.take_along_axis(truth, orders[:, :, None], axis=1)
            for frame in observed:
                frame[rng.permutation(size)[:hidden]] = np.nan
            fit = fit_body(body, observed)
            # Three markers that changed their labels might fit by chance: they are left alone.
            assert fit.found.mean() >= (1.0 if not hidden else 0.5 if size > 4 else 0.0)
            check(fit, body, pose)
            for k in np.flatnonzero(fit.found):
                used = fit.order[k] >= 0
                np.testing.assert_array_equal(observed[k, fit.order[k][used]], truth[k][used])
        truth[:, 1] += rng.uniform(0.01, 0.05, (COUNT, 3))
        fit = fit_body(body, truth)
        assert fit.found.all() and (fit.order[:, 1] == -1).all()
        check(fit, body, pose)


def test_another_body_and_a_mirrored_one_have_no_pose(rng):
    for size in SIZES:
        body, pose = body_of(size), random_pose(rng, count=COUNT)
        for other in (1.2 * body, body * np.array([1.0, 1.0, -1.0]), body_of(size, seed=5)):
            assert not fit_body(body, observe(other, pose, rng)).found.any()


def test_the_residuals_give_the_noise_and_the_uncertainty_of_the_pose(rng):
    probe, stated = np.array([0.05, -0.03, -0.2]), []
    for size in SIZES:
        body, pose = body_of(8)[:size], random_pose(rng, count=1)
        count = 4000
        repeated = Pose(np.repeat(pose.rotation, count, 0), np.repeat(pose.translation, count, 0))
        observed = observe(body, repeated, rng)
        observed[1::2, 0] = np.nan
        fit = fit_body(body, observed)
        assert fit.noise == pytest.approx(NOISE, rel=0.03)
        off = (fit.pose.rotation @ probe + fit.pose.translation)[::2]
        off -= pose.rotation[0] @ probe + pose.translation[0]
        stated.append(np.trace(pose_uncertainty(body, fit.noise).at(probe)))
        assert (off**2).sum(axis=1).mean() == pytest.approx(stated[-1], rel=0.1)
    assert stated == sorted(stated, reverse=True)  # more markers make a surer pose


SQUARE = np.array([[0.0, 0.0, 0.0], [0.06, 0.0, 0.0], [0.06, 0.06, 0.0], [0.0, 0.06, 0.0]])


def test_bodies_whose_labels_cannot_be_found_are_refused():
    row = np.array([[0, 0, 0], [3, 0, 0], [7, 0, 0], [12, 0, 0]]) * 0.01
    for markers, fact, hint in (
        (SQUARE, "look alike with labels", "differ by 4 mm"),
        (row, "on one line", "10 mm"),
        (np.vstack([body_of(4), body_of(4)[1] + 0.002]), "markers 2 and 5 are 3.5 mm apart", "10"),
        (np.vstack([SQUARE, [[0.03, 0.03, 0.05]]]), "look alike", "differ"),
    ):
        found = body_fault(markers)
        assert found is not None and fact in found[0] and hint in found[1]


def test_whatever_happens_to_the_markers_a_pose_is_right_or_missing():
    """Occluded, exchanged and false markers together, far more of them than in a lab."""
    rng = np.random.default_rng(1)
    wrong = found = count = 0
    for size, seed in product((4, 5, 8), range(4)):
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
