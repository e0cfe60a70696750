"""Bodies of three to eight markers to poses: occluded, mislabelled and false markers."""

import math
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.problems import SOCKET_TRIAD, random_pose

from socket_testbed.geometry.marker_bodies import body_fault, fit_body, fit_rigid, pose_uncertainty
from socket_testbed.geometry.pose import Pose

NOISE = 1e-4  # [m]
COUNT = 40
EVERY_SIZE = pytest.mark.parametrize("size", [3, 4, 5, 6, 8])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def observe(body: np.ndarray, pose: Pose, rng: np.random.Generator) -> np.ndarray:
    """Markers as the cameras measure them, (N, k, 3) [m]."""
    markers = pose.place(body)
    return markers + rng.normal(0.0, NOISE, markers.shape)


def body_of(size: int, seed: int = 0) -> np.ndarray:
    """Markers of a body as a lab would place them, shape (size, 3) [m]."""
    if size == 3:
        return SOCKET_TRIAD
    rng = np.random.default_rng(seed)
    while True:
        markers = rng.uniform(-0.08, 0.08, (size, 3))
        if body_fault(markers) is None:
            return markers


def errors_of(fit, body, pose) -> tuple[np.ndarray, np.ndarray]:
    """How far the middle of the markers [m] and the rotation [rad] of the poses found are off."""
    found, middle = fit.found, np.tile(body.mean(axis=0), (len(fit.found), 1))
    off = np.linalg.norm(fit.pose.apply(middle) - pose.apply(middle), axis=1)
    turned = fit.pose.rotation[found].swapaxes(1, 2) @ pose.rotation[found]
    angles = [Rotation.from_matrix(each).magnitude() for each in turned]
    return off[found], np.array(angles)


def check(fit, body, pose) -> None:
    off, turned = errors_of(fit, body, pose)
    assert off.max(initial=0.0) < 20.0 * NOISE and turned.max(initial=0.0) < 0.05


@pytest.mark.parametrize("off", [0.0, 2e-5, 2e-4], ids=["symmetric", "20-um", "200-um"])
def test_noise_never_turns_an_isosceles_triad_over(rng, off: float):
    """Whose apex is off the line of symmetry by so much, and whose labels are right."""
    isosceles = np.array([[-0.04, 0.0, 0.0], [0.04, 0.0, 0.0], [off, 0.07, 0.0]])
    pose = random_pose(rng, count=100)
    fit = fit_body(isosceles, observe(isosceles, pose, rng))
    check(fit, isosceles, pose)  # to find no pose is honest, too


@EVERY_SIZE
def test_the_pose_is_that_of_least_squares(rng, size: int):
    """Of all markers that are seen."""
    body, pose = body_of(size), random_pose(rng, count=COUNT)
    observed = observe(body, pose, rng)
    for k in range(0, COUNT, 2):  # in every other frame one is occluded
        observed[k, k // 2 % size] = np.nan
    fit = fit_body(body, observed)
    np.testing.assert_array_equal(fit.found, (fit.order >= 0).any(axis=1))
    assert fit.found[1::2].all()
    for k in np.flatnonzero(fit.found):
        seen = np.isfinite(observed[k]).all(axis=1)
        np.testing.assert_array_equal(fit.order[k], np.where(seen, np.arange(size), -1))
        arms = body[seen] - body[seen].mean(axis=0)
        centred = observed[k, seen] - observed[k, seen].mean(axis=0)
        turn, distance = Rotation.align_vectors(centred, arms)
        np.testing.assert_allclose(fit.pose.rotation[k], turn.as_matrix(), atol=1e-9)
        assert fit.residual[k] == pytest.approx(distance / math.sqrt(seen.sum()), rel=1e-6)


@EVERY_SIZE
def test_complete_frames_have_the_same_poses_alone_as_among_others(rng, size: int):
    """Frames as usual take a shorter way than those beside an occluded one."""
    body = body_of(size)
    seen = observe(body, random_pose(rng, count=COUNT), rng)
    hidden = np.full((1, size, 3), np.nan)
    alone, among = fit_body(body, seen), fit_body(body, np.concatenate([seen, hidden]))
    assert among.found.tolist() == [True] * COUNT + [False] and alone.found.all()
    np.testing.assert_array_equal(alone.order, among.order[:-1])
    np.testing.assert_allclose(alone.residual, among.residual[:-1], rtol=1e-12)
    np.testing.assert_allclose(alone.pose.rotation, among.pose.rotation[:-1], atol=1e-15)
    np.testing.assert_allclose(alone.pose.translation, among.pose.translation[:-1], atol=1e-15)
    assert len(fit_body(body, seen[:0]).order) == 0


@pytest.mark.parametrize("hidden", [0, 1], ids=["all-seen", "one-occluded"])
@EVERY_SIZE
def test_labels_in_any_order_are_put_right(rng, size: int, hidden: int):
    body, pose = body_of(size), random_pose(rng, count=COUNT)
    truth = observe(body, pose, rng)
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


def test_exchanged_labels_are_learnt_from_the_fullest_frame(rng) -> None:
    """The first frame lacks a marker; its order alone would leave out that of the second."""
    body, pose = body_of(5), random_pose(rng, count=2)
    observed = observe(body, pose, rng)[:, [2, 0, 1, 4, 3]]
    observed[0, 3] = np.nan  # which is the body's last marker
    fit = fit_body(body, observed)
    assert fit.order.tolist() == [[1, 2, 0, 4, -1], [1, 2, 0, 4, 3]]


@EVERY_SIZE
def test_a_false_marker_is_not_used(rng, size: int):
    body, pose = body_of(size), random_pose(rng, count=COUNT)
    observed = observe(body, pose, rng)
    observed[:, 1] += rng.uniform(0.01, 0.05, (COUNT, 3))
    fit = fit_body(body, observed)
    assert fit.found.all() == (size > 3) and (fit.order[:, 1] == -1).all()
    check(fit, body, pose)


@pytest.mark.parametrize(
    ("size", "other"),
    [
        *(pytest.param(k, lambda b: 1.2 * b, id=f"larger-{k}") for k in (3, 4, 5, 6, 8)),
        *(pytest.param(k, lambda b: 0.8 * b, id=f"smaller-{k}") for k in (3, 4, 5, 6, 8)),
        # A triad has no mirror image.
        *(
            pytest.param(k, lambda b: b * [1.0, 1.0, -1.0], id=f"mirrored-{k}")
            for k in (4, 5, 6, 8)
        ),
        *(
            pytest.param(k, lambda b: body_of(len(b), seed=5), id=f"other-{k}")
            for k in (4, 5, 6, 8)
        ),
    ],
)
def test_other_bodies_have_no_pose(rng, size: int, other):
    body, pose = body_of(size), random_pose(rng, count=COUNT)
    assert not fit_body(body, observe(other(body), pose, rng)).found.any()


SQUARE = 0.06 * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
ROW = 0.01 * np.array([[0, 0, 0], [3, 0, 0], [7, 0, 0], [12, 0, 0]])
NEAR = np.vstack([body_of(4), body_of(4)[1] + 0.002])


@pytest.mark.parametrize(
    ("markers", "fact"),
    [
        pytest.param(SQUARE, "look alike", id="square"),
        pytest.param(ROW, "on one line", id="row"),
        pytest.param(NEAR, "3.5 mm apart", id="too-near"),
    ],
)
def test_bodies_whose_labels_cannot_be_found_are_refused(markers: np.ndarray, fact: str):
    found = body_fault(markers)
    assert found is not None and fact in found[0]


def test_a_pose_is_right_or_missing(rng):
    """Occluded, exchanged and false markers together, far more of them than in a lab."""
    off, count = [], 0
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
        off.extend(errors_of(fit_body(body, observed), body, pose)[0])
        count += len(observed)
    assert (np.array(off) > 0.002).sum() <= 0.002 * count
    assert len(off) > 0.6 * count


# --- the uncertainty of a pose: against random trials and a published formula

FRAMES = 6000
LIMB = np.array([-0.045, -0.03, -0.22])  # far from the markers, as the lumped mass is


@pytest.mark.parametrize("occluded", [False, True], ids=["all-seen", "one-occluded"])
@EVERY_SIZE
def test_the_residuals_give_the_noise(rng, size: int, occluded: bool):
    body = body_of(size)
    observed = observe(body, random_pose(rng, count=FRAMES), rng)
    tolerance = 4.0 / math.sqrt(2.0 * (3 * size - 6) * FRAMES)  # by the degrees of freedom
    if occluded:
        observed[1::2, 0] = np.nan
        tolerance *= 2.0
    assert fit_body(body, observed).noise == pytest.approx(NOISE, rel=tolerance)


@pytest.mark.parametrize("size", [3, 4, 7])
def test_covariances_are_those_of_random_trials(rng, size: int):
    points, pose = rng.uniform(-0.08, 0.08, (size, 3)), random_pose(rng)
    fit = fit_rigid(points, pose.apply(points) + rng.normal(0.0, NOISE, (FRAMES, size, 3)))
    stated = pose_uncertainty(points, NOISE)
    shift, limb = (
        (fit.apply(np.tile(point, (FRAMES, 1))) - pose.apply(point)) @ pose.rotation
        for point in (points.mean(axis=0), LIMB)
    )
    turn = Rotation.from_matrix(pose.rotation.T @ fit.rotation).as_rotvec()
    pairs = (shift, stated.shift), (turn, stated.rotation), (limb, stated.at(LIMB))
    for found, expected in pairs:
        white = np.linalg.solve(np.linalg.cholesky(expected), found.T)
        np.testing.assert_allclose(np.cov(white), np.eye(3), atol=5.0 / math.sqrt(FRAMES))
        np.testing.assert_allclose(white.mean(axis=1), 0.0, atol=5.0 / math.sqrt(FRAMES))


@pytest.mark.parametrize("size", [3, 4, 7])
def test_covariances_are_those_of_the_published_formula(rng, size: int):
    """Fitzpatrick, West and Maurer 1998: <TRE^2> = <FLE^2>/k (1 + 1/3 sum(d_i^2 / f_i^2))."""
    points = rng.uniform(-0.08, 0.08, (size, 3))
    middle = points.mean(axis=0)
    centred, ratios = points - middle, 0.0
    for axis in np.linalg.eigh(centred.T @ centred)[1].T:
        away = np.eye(3) - np.outer(axis, axis)
        ratios += ((LIMB - middle) @ away @ (LIMB - middle)) / (centred @ away * centred).sum()
    published = 3.0 * NOISE**2 / size * (1.0 + ratios * size / 3.0)
    assert np.trace(pose_uncertainty(points, NOISE).at(LIMB)) == pytest.approx(published)
