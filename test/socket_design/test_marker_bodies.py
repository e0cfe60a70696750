"""Marker triads to bodies, and whether a take is static."""

import numpy as np
import pytest
from support.motive_takes import (
    between,
    own_frame_of,
)
from support.problems import PYLON_TRIAD, SOCKET_TRIAD, random_pose

from socket_testbed.errors import RegistrationError
from socket_testbed.geometry.pose import Pose
from socket_testbed.socket_design.registration import (
    average_still,
    fit_labels,
    own_frame,
    relabel,
    tracked_frame,
)


@pytest.fixture
def rng():
    return np.random.default_rng(23)


@pytest.mark.parametrize("triad", [SOCKET_TRIAD, PYLON_TRIAD])
def test_a_triads_own_frame_is_as_it_is_stated(rng, triad):
    pose = random_pose(rng)
    frame = own_frame(pose.apply(triad))
    expected = pose @ own_frame_of(triad)
    np.testing.assert_allclose(frame.rotation, expected.rotation, atol=1e-12)
    in_own = frame.inverse().apply(pose.apply(triad))
    assert in_own[0] == pytest.approx(0.0, abs=1e-12) and in_own[1, 0] > 0.0 and in_own[2, 1] > 0.0
    assert [in_own[1, 1], in_own[1, 2], in_own[2, 2]] == pytest.approx([0.0] * 3, abs=1e-12)


def test_labels_swapped_in_single_frames_are_put_right(rng):
    pose = random_pose(rng, 1.0, 50)
    observed = np.array([p.apply(PYLON_TRIAD) for p in map(Pose, pose.rotation, pose.translation)])
    observed += rng.normal(0.0, 1e-4, observed.shape)
    spoilt = observed.copy()
    for frame in rng.permutation(50)[:20]:
        spoilt[frame] = spoilt[frame][rng.permutation(3)]
    spoilt[7, 1], observed[7, 1] = np.nan, np.nan
    spoilt[8] *= 1.5  # no order of the labels makes this the triad
    fit = fit_labels(spoilt, "take")
    np.testing.assert_array_equal(np.flatnonzero(fit.order[:, 0] < 0), [7, 8])
    others = np.setdiff1d(np.arange(50), [7, 8])
    np.testing.assert_array_equal(relabel(spoilt, fit.order)[others], observed[others])


@pytest.mark.parametrize(
    ("triad", "fact", "hint"),
    [
        (
            [[0, 0, 0], [0.08, 0, 0], [0.04, 0.069, 0]],
            "differ by 0.0 mm only (edges 80.0, 79.8",
            "4 mm",
        ),
        ([[0, 0, 0], [0.08, 0, 0], [0.0, 0.083, 0]], "differ by 3.0 mm only", "4 mm"),
        ([[0, 0, 0], [0.08, 0, 0], [0.03, 0.0005, 0]], "on one line", "triangle"),
        ([[0, 0, 0], [0.008, 0, 0], [0, 0.014, 0]], "too close (edges 8.0,", "10 mm"),
    ],
)
def test_a_triad_that_is_no_body_is_refused_with_its_edges(rng, triad, fact, hint):
    observed = np.tile(random_pose(rng).apply(np.array(triad)), (30, 1, 1))
    with pytest.raises(RegistrationError) as caught:
        fit_labels(observed, "take.csv: socket")
    assert "take.csv: socket" in caught.value.fact and fact in caught.value.fact
    assert hint in caught.value.hint


def test_a_triad_that_is_never_whole_is_refused():
    with pytest.raises(RegistrationError, match="no frame shows all three"):
        fit_labels(np.full((30, 3, 3), np.nan), "take")


def test_a_tracked_frame_is_found_though_its_tracking_goes_wrong_at_times(rng):
    pose, count = random_pose(rng), 60
    markers = pose.apply(SOCKET_TRIAD) + rng.normal(0.0, 1e-4, (count, 3, 3))
    tracked = Pose(np.tile(pose.rotation, (count, 1, 1)), np.tile(pose.translation, (count, 1)))
    tracked.rotation[:9] = random_pose(rng, count=9).rotation
    tracked.rotation[9:20] = np.nan
    distance, angle = between(tracked_frame(markers, tracked, "take"), pose)
    assert distance < 2e-4 and angle < 2e-3
    tracked.translation[20:40] = np.nan
    with pytest.raises(RegistrationError, match="rigid body in 29 of 60 frames"):
        tracked_frame(markers, tracked, "take")


# --- stillness


def still_markers(rng, frames: int = 60, noise: float = 1e-4) -> np.ndarray:
    return rng.uniform(-1.0, 1.0, (4, 3)) + rng.normal(0.0, noise, (frames, 4, 3))


def average(positions: np.ndarray, fits: np.ndarray | None = None):
    fits = np.ones(len(positions), dtype=bool) if fits is None else fits
    return average_still("ABCD", positions, fits, "take.csv: socket")


def test_frames_are_counted_by_what_is_wrong_with_them(rng):
    positions, fits = still_markers(rng), np.ones(60, dtype=bool)
    positions[3:8, 1], positions[6:10, 2] = np.nan, np.nan
    fits[20:23] = False
    positions[30:32, 0] += 0.02
    still = average(positions, fits)
    left_out = [*range(3, 10), 20, 21, 22, 30, 31]
    np.testing.assert_array_equal(np.flatnonzero(~still.used), left_out)
    np.testing.assert_array_equal(still.occluded, [0, 5, 4, 0])
    assert (still.mislabelled, still.jumped, still.notes) == (3, 2, ())
    np.testing.assert_allclose(still.mean, np.delete(positions, left_out, 0).mean(0), atol=1e-15)
    np.testing.assert_allclose(still.spread, np.sqrt(3.0) * 1e-4, rtol=0.2)


def test_the_noise_of_a_mean_is_that_of_independent_frames_where_they_are(rng):
    variances = [average(still_markers(rng)).noise ** 2 for _ in range(100)]
    # 108 degrees of freedom each: 9 of the blocks for 12 coordinates.
    assert np.mean(variances) == pytest.approx(1e-8 / 60.0, rel=4.0 * np.sqrt(2.0 / 10_800.0))


def test_the_noise_of_a_mean_counts_what_frames_have_in_common(rng):
    slow = np.repeat(rng.normal(0.0, 1e-4, (10, 4, 3)), 60, axis=0)
    still = average(np.ones(3) + slow)
    assert still.noise > 5.0 * still.spread.mean() / np.sqrt(3.0 * 600.0)


@pytest.mark.parametrize(("moved", "noted"), [(1e-4, False), (6e-4, True)])
def test_a_little_drift_is_noted(rng, moved, noted):
    positions = still_markers(rng, 300)
    positions[:, 2, 0] += np.linspace(0.0, moved, 300)
    still = average(positions)
    assert still.drift[2] == pytest.approx(2.0 * moved / 3.0, abs=6e-5)
    assert [note.split()[0] for note in still.notes] == (["C"] if noted else [])


def test_much_scatter_is_noted(rng):
    positions = still_markers(rng)
    positions[:, 1] += rng.normal(0.0, 4e-4, (60, 3))
    (note,) = [note for note in average(positions).notes if "about" in note]
    assert note.startswith("B moved about by 0.")


def slide(positions: np.ndarray) -> None:
    positions[:, 2, 0] += np.linspace(0.0, 0.003, 60)


def shake(positions: np.ndarray) -> None:
    positions[:, 2, 0] += 0.002 * (-1.0) ** np.arange(60)


def bump(positions: np.ndarray) -> None:
    positions[40:, 2] += [0.0, 0.03, 0.0]


def hide(positions: np.ndarray) -> None:
    positions[15:, 2] = np.nan


@pytest.mark.parametrize(
    ("move", "fact", "hint"),
    [
        (slide, "C drifted by 2.0", "nothing moves"),
        (shake, "C moved about by 2.0", "nothing moves"),
        (bump, "in 20 of 60 frames a marker, mostly C, is more than 5 mm", "nothing moves"),
        (hide, "15 of 60 frames show all of A, B, C, D (C is occluded in 45", "20 frames"),
    ],
)
def test_a_take_that_is_not_static_is_refused(rng, move, fact, hint):
    positions = still_markers(rng, noise=2e-5)
    move(positions)
    with pytest.raises(RegistrationError) as caught:
        average(positions)
    assert "take.csv: socket" in caught.value.fact and fact in caught.value.fact
    assert hint in caught.value.hint


@pytest.mark.parametrize("size", [4, 6, 8])
def test_the_labels_of_a_larger_body_are_found_by_its_distances(rng, size):
    body = np.vstack([SOCKET_TRIAD, SOCKET_TRIAD.mean(axis=0) + rng.normal(0.0, 0.07, (5, 3))])
    body = body[:size]
    pose = random_pose(rng, count=60)
    observed = np.array([p.apply(body) for p in map(Pose, pose.rotation, pose.translation)])
    observed += rng.normal(0.0, 1e-4, observed.shape)
    spoilt = observed.copy()
    spoilt[:20, [0, size - 1]] = observed[:20, [size - 1, 0]]
    spoilt[50, 1] = np.nan
    fit = fit_labels(spoilt, "take")
    whole = np.arange(60) != 50
    np.testing.assert_array_equal(relabel(spoilt, fit.order)[whole], observed[whole])
    assert fit.noise == pytest.approx(1e-4, rel=0.1)
    np.testing.assert_array_equal(relabel(spoilt, fit.order)[50], spoilt[50])
    with pytest.raises(RegistrationError, match=f"no frame shows all {size} markers"):
        fit_labels(np.full((30, size, 3), np.nan), "take")
