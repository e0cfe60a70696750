"""Bodies between frames: against the true motion, through swaps, occlusions and gaps."""

import itertools
import threading

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from support.natnet import NAMES, TRIADS, markers_at, pose_at
from support.wording import check_line

from socket_testbed import clocks
from socket_testbed.drivers.natnet.messages import LabelledMarker, MocapFrame, RigidBodyDefinition
from socket_testbed.drivers.natnet.tracker import BodyTracker, MocapSample
from socket_testbed.settings.acquisition import MocapSettings

PERIOD = 1.0 / 240.0  # [s]
SETTINGS = MocapSettings(stale=0.05)
IDS = (5, 9)
EIGHT = 0.001 * np.array(
    [[0, 0, 0], [61, 4, 9], [13, 47, 2], [40, 72, 31], [-35, 20, 44], [22, -58, 15], [70, 45, -20],
     [-28, -36, -9]]
)  # fmt: skip


def models_of(*names, references=TRIADS):
    return {
        name: RigidBodyDefinition(name, identity, tuple(map(tuple, reference)))
        for name, identity, reference in zip(names, IDS, references, strict=False)
    }


MODELS = models_of(*NAMES)


def steady(body, moment):
    """Position [m] and orientation of a body that moves and turns steadily."""
    velocity, rate = np.array([0.2, -0.1, 0.3]), np.array([0.5, 0.8, -0.6])  # [m/s], [rad/s]
    place = np.array([0.4, -0.3, 0.7 + 0.2 * body])
    first = Rotation.from_rotvec([0.3, 0.2 * body, -0.4])
    return place + velocity * moment, first * Rotation.from_rotvec(rate * moment)


def frame_at(
    moment,
    swapped=(),
    labels=None,
    lies=(),
    wrong=0.0,
    references=TRIADS,
    pose=pose_at,
    ids=IDS,
    hidden=(),
    filled=(),
    gone=(),
) -> MocapFrame:
    """A frame of the true motion; `swapped` names (body, label, label), others (body, label)."""
    placed = [markers_at(body, moment, references, pose) + wrong for body in range(2)]
    if labels is not None:
        placed = [places[list(labels)] for places in placed]
    for body, a, b in swapped:
        placed[body][[a, b]] = placed[body][[b, a]]
    for body, label in lies:
        placed[body][label] = 0.0
    markers = [LabelledMarker(0, 77, (1.0, 1.0, 1.0), True)]
    for body, places in enumerate(placed):
        for label, place in enumerate(places):
            at = (body, label)
            if at not in gone:
                seen = at not in hidden and at not in filled
                markers.append(LabelledMarker(ids[body], label + 1, tuple(place), seen))
    return MocapFrame(0, (), tuple(markers), 0, False, False)


def tracker_of(
    moments, settings=SETTINGS, models=..., references=TRIADS, pose=pose_at, **faults
) -> BodyTracker:
    """A tracker that saw frames; a fault is a function of the frame's index."""
    tracker = BodyTracker(settings, *references)
    models = models_of(*NAMES, references=references) if models is ... else models
    for index, moment in enumerate(moments):
        of_frame = {name: fault(index) for name, fault in faults.items()}
        frame = frame_at(moment, references=references, pose=pose, **of_frame)
        tracker.add(frame, moment, models)
    for index in (0.5, 1.5):  # the order of the labels is learnt from fits
        tracker.sample(index * PERIOD)
    return tracker


def frames(count=20, start=0.0):
    return start + PERIOD * np.arange(count)


def errors_of(
    sample: MocapSample, body: int, references=TRIADS, pose=pose_at
) -> tuple[float, float, float]:
    """Errors of position [m], orientation [rad] and the worst marker [m]; NaN if missing."""
    position, rotation = pose(body, sample.time)
    angle = np.nan
    if np.isfinite(sample.quaternions[body]).all():
        angle = (Rotation.from_quat(sample.quaternions[body]).inv() * rotation).magnitude()
    own = sample.markers[body, : len(references[body])]
    off = np.linalg.norm(own - markers_at(body, sample.time, references, pose), axis=1)
    away = float(np.linalg.norm(sample.positions[body] - position))
    return away, float(angle), float(np.nanmax(off, initial=0.0))


def assert_right(sample: MocapSample, within: float = 5e-5, references=TRIADS) -> None:
    """Both bodies have their pose, and their markers are in place."""
    assert sample.faults == ("", "")
    assert max(max(errors_of(sample, body, references)) for body in range(2)) < within


def test_between_frames_the_bodies_are_where_they_were_and_at_a_frame_it_is_the_frame():
    for start, labels in ((0.0, (0, 1, 2)), (0.3, (2, 0, 1)), (1234.5, (1, 0, 2))):
        tracker = tracker_of(frames(start=start), labels=lambda _, labels=labels: labels)
        for trigger in np.linspace(start + 0.002, start + 17.9 * PERIOD, 40):
            assert tracker.ready(trigger)
            assert_right(tracker.sample(trigger))
    tracker = tracker_of(frames())
    for index in (1, 7, 19):
        assert max(errors_of(tracker.sample(index * PERIOD), 0)) < 1e-7


def test_a_body_of_more_markers_has_its_pose_whatever_few_of_them_are_seen():
    for count in (4, 5, 8):
        references = (EIGHT[:count], TRIADS[1])
        for labels in [(), (1,), (0, count - 1)] if count > 4 else [(), (0,)]:
            hidden = [(0, label) for label in labels]
            tracker = tracker_of(frames(), references=references, hidden=lambda _, h=hidden: h)
            sample = tracker.sample(9.3 * PERIOD, 10.0 * PERIOD)
            assert_right(sample, 3e-4, references)
            seen = np.isfinite(sample.markers).all(axis=2)
            assert seen[0].tolist() == [k not in labels for k in range(count)]
            assert seen[1].tolist() == [k < 3 for k in range(count)]


def test_too_few_markers_or_those_that_two_labels_could_exchange_make_no_pose():
    """Of the first four, the first and the fourth are as far from the third to within 2 mm."""
    for count, labels, fault in (
        (4, (1,), "marker 2 of rigid body 'socket' is occluded, and the others do not make its pose"
         " certain"),
        (5, (0, 1, 3), "marker 1, 2, 4 of rigid body 'socket' is occluded"),
    ):  # fmt: skip
        references = (EIGHT[:count], TRIADS[1])
        hidden = [(0, label) for label in labels]
        tracker = tracker_of(frames(), references=references, hidden=lambda _, h=hidden: h)
        sample = tracker.sample(9.5 * PERIOD)
        assert np.isnan(sample.positions[0]).all()
        assert sample.faults == (fault, "")
        assert max(errors_of(sample, 1)) < 1e-4


def test_frames_without_a_pose_are_bridged_over_the_largest_gap_at_most():
    for first, last in ((9, 9), (10, 10), (9, 10)):
        hidden = [((0, 2),) if first <= i <= last else () for i in range(20)]
        assert_right(tracker_of(frames(), hidden=hidden.__getitem__).sample(9.5 * PERIOD), 1e-4)
    sample = tracker_of(
        frames(), MocapSettings(stale=1.5 * PERIOD), hidden=lambda i: ((0, 2),) if i == 9 else ()
    ).sample(9.5 * PERIOD)
    assert np.isnan(sample.positions[0]).all() and np.isnan(sample.quaternions[0]).all()
    assert np.isfinite(sample.markers[0]).all(axis=1).tolist() == [True, True, False]
    assert sample.faults == ("marker 3 of rigid body 'socket' is occluded", "")


def test_of_a_lasting_occlusion_the_other_markers_keep_their_places():
    """By the order of the labels in the fits before it; without one, none is used."""
    labels, hidden = (2, 0, 1), ((0, 0), (0, 1))
    tracker = tracker_of(
        frames(200), labels=lambda _: labels, hidden=lambda i: hidden if i >= 10 else ()
    )
    alone = tracker_of(frames(200), labels=lambda _: labels, hidden=lambda _: hidden)
    assert np.isnan(alone.sample(190.5 * PERIOD).markers[0]).all()
    sample = tracker.sample(190.5 * PERIOD)
    assert np.isfinite(sample.markers[0]).all(axis=1).tolist() == [False, True, False]
    assert errors_of(sample, 0)[2] < 1e-5


def test_markers_whose_distances_contradict_their_labels_are_missing():
    tracker = tracker_of(
        frames(),
        labels=lambda _: (1, 0, 2),
        swapped=lambda i: ((0, 0, 2),) if i > 5 else (),
        hidden=lambda i: ((0, 0),) if i > 5 else (),
    )
    assert np.isnan(tracker.sample(8.5 * PERIOD).markers[0]).all()


def test_a_gap_between_frames_gives_nothing_and_frames_are_kept_for_a_second():
    tracker = tracker_of(np.concatenate([frames(10), frames(10, 0.2)]))
    for trigger in (0.1, 0.199, -0.01, 0.25):
        sample = tracker.sample(trigger)
        assert np.isnan(sample.markers).all() and np.isnan(sample.positions).all()
        assert all("no two frames within 0.05 s" in fault for fault in sample.faults)
    assert tracker.sample(0.205).faults == ("", "")
    tracker = tracker_of(frames(500))
    assert tracker.sample(200.5 * PERIOD).faults[0].startswith("no two frames")
    assert tracker.sample(400.5 * PERIOD).faults == ("", "")
    assert len(tracker._bodies[0]._frames) < 250
    tracker = tracker_of([0.0, PERIOD, PERIOD, 0.5 * PERIOD, 2 * PERIOD])  # late ones are dropped
    assert max(errors_of(tracker.sample(0.5 * PERIOD), 1)) < 5e-5


def test_unknown_bodies_and_another_triad_are_reported():
    four = (TRIADS[0], EIGHT[:4])
    for models, text in (
        (None, "has not sent its rigid bodies yet"),
        (models_of("socket", "A"), "no rigid body 'pylon' (there are: A, socket): name it so"),
        ({}, "(there are: none): name it so there, or set pylon_body"),
        (models_of(*NAMES, references=four), "rigid body 'pylon' has 4 markers in Motive, and 3"),
    ):
        tracker = tracker_of(frames(), models=models)
        assert tracker.ready(5.5 * PERIOD)
        sample = tracker.sample(5.5 * PERIOD)
        assert text in sample.faults[1] and np.isnan(sample.markers[1]).all()
    tracker = BodyTracker(SETTINGS, 1.2 * TRIADS[0], TRIADS[1])
    for moment in frames():
        tracker.add(frame_at(moment), moment, MODELS)
    sample = tracker.sample(5.5 * PERIOD)
    check_line(sample.faults[0], "do not fit its triad: check the geometry")
    assert np.isnan(sample.positions[0]).all()
    assert errors_of(sample, 0)[2] < 1e-5  # its markers are kept
    assert sample.faults[1] == ""


def test_ready_means_that_no_later_frame_makes_it_better():
    tracker = tracker_of(frames(10))
    assert tracker.ready(8.5 * PERIOD) and tracker.ready(9.0 * PERIOD)
    assert not tracker.ready(9.1 * PERIOD)
    occluded = tracker_of(frames(10), hidden=lambda i: ((1, 1),) if i >= 9 else ())
    assert not occluded.ready(8.5 * PERIOD)  # the next frame may show the marker
    occluded.add(frame_at(10 * PERIOD), 10 * PERIOD, MODELS)
    assert occluded.ready(8.5 * PERIOD)
    assert occluded.sample(8.5 * PERIOD).faults == ("", "")
    tracker = tracker_of(frames(20))  # a window is waited for to its last frame
    assert tracker.ready(10.2 * PERIOD, 19.0 * PERIOD)
    assert not tracker.ready(10.2 * PERIOD, 20.0 * PERIOD)
    assert not tracker.wait(10.2 * PERIOD, clocks.monotonic(), 20.0 * PERIOD)
    tracker.add(frame_at(20 * PERIOD), 20 * PERIOD, MODELS)
    assert tracker.wait(10.2 * PERIOD, clocks.monotonic(), 20.0 * PERIOD)
    assert not BodyTracker(SETTINGS, *TRIADS).ready(0.0, 0.25)


def test_waiting_ends_with_the_frame_or_the_deadline():
    start = clocks.monotonic()
    tracker = tracker_of([start - PERIOD])
    assert not tracker.wait(start, start + 0.02)
    assert clocks.monotonic() >= start + 0.02
    frame = frame_at(start + 1e-3)
    sender = threading.Timer(0.02, lambda: tracker.add(frame, start + 1e-3, MODELS))
    sender.start()
    assert tracker.wait(start, start + 10.0)
    sender.join()
    assert tracker.sample(start).faults == ("", "")


def fitted(seen) -> tuple[np.ndarray, list[Rotation]]:
    """Positions [m] and orientations of the socket in some frames, by another method."""
    arms = TRIADS[0] - TRIADS[0].mean(axis=0)
    rotations = [Rotation.align_vectors(m - m.mean(axis=0), arms)[0] for m in seen]
    centres = [rotation.apply(TRIADS[0].mean(axis=0)) for rotation in rotations]
    return seen.mean(axis=1) - centres, rotations


def test_the_pose_is_the_mean_of_the_frames_in_the_window_and_markers_are_at_the_trigger():
    noise = np.random.default_rng(0).normal(0.0, 1e-4, (81, 3, 3))
    tracker = tracker_of(
        0.005 * np.arange(-40, 41), pose=lambda body, _: steady(body, 0.0), wrong=noise.__getitem__
    )
    sample = tracker.sample(0.0, 0.251)
    assert sample.frames == (51, 51) and sample.faults == ("", "")
    positions, rotations = fitted((markers_at(0, 0.0, pose=steady) + noise)[15:66])
    np.testing.assert_allclose(sample.positions[0], positions.mean(axis=0), atol=1e-9)
    # Markley et al. 2007, doi:10.2514/1.28949: largest eigenvector of the sum of q q^T.
    quaternions = np.array([rotation.as_quat() for rotation in rotations])
    mean = Rotation.from_quat(np.linalg.eigh(quaternions.T @ quaternions)[1][:, -1])
    assert (Rotation.from_quat(sample.quaternions[0]).inv() * mean).magnitude() < 1e-8
    np.testing.assert_array_equal(sample.markers, tracker.sample(0.0).markers)


def test_a_mean_does_not_lag_behind_a_steady_motion():
    """Wherever the trigger is between frames, and whichever are missing or without a pose."""
    for share in (1.0, 0.7, 0.5):
        rng = np.random.default_rng(round(10 * share))
        times = np.arange(-0.3, 0.3, PERIOD)
        tracker = tracker_of(times[rng.random(len(times)) < share], pose=steady)
        for trigger, window in itertools.product(rng.uniform(-0.1, 0.1, 10), (0.01, 0.05, 0.25)):
            sample = tracker.sample(trigger, window)
            if sample.faults == ("", ""):
                for body in range(2):
                    assert max(errors_of(sample, body, pose=steady)[:2]) < 1e-7
    times = PERIOD * np.arange(-60, 60)
    late = [((0, 1),) if time > 2.5 * PERIOD else () for time in times]
    sample = tracker_of(times, pose=steady, hidden=late.__getitem__).sample(0.4 * PERIOD, 0.25)
    assert sample.frames == (32, 60) and sample.faults == ("", "")
    assert max(errors_of(sample, 0, pose=steady)[:2]) < 1e-7
    # All frames around the trigger are occluded: there is no pose, though the window has frames.
    around = [((0, 1),) if abs(time) < 0.04 else () for time in times]
    sample = tracker_of(times, pose=steady, hidden=around.__getitem__).sample(0.0, 0.25)
    assert sample.frames[0] == 0 and np.isnan(sample.positions[0]).all()
    assert sample.faults == ("marker 2 of rigid body 'socket' is occluded", "")


def test_with_a_frame_or_none_in_the_window_the_pose_is_interpolated():
    noise = np.random.default_rng(0).normal(0.0, 1e-4, (11, 3, 3))
    times = PERIOD * np.arange(-5, 6)
    tracker = tracker_of(times, pose=steady, wrong=noise.__getitem__)
    seen = [markers_at(0, times[k], pose=steady) + noise[k] for k in (5, 6)]
    positions, rotations = fitted(np.array(seen))
    between = Slerp([0.0, 1.0], Rotation.concatenate(rotations))(0.2)
    for window in (0.0, 0.5 * PERIOD, 1.9 * PERIOD):
        sample = tracker.sample(0.2 * PERIOD, window)
        np.testing.assert_allclose(sample.positions[0], [0.8, 0.2] @ positions, atol=1e-12)
        assert (Rotation.from_quat(sample.quaternions[0]).inv() * between).magnitude() < 1e-7
        assert sample.frames == (2, 2)
    # Two frames at the end of a window, carried to the trigger's time, would be noisier.
    tracker = tracker_of([-0.02, 0.004, 0.005], pose=steady, wrong=noise.__getitem__)
    np.testing.assert_array_equal(
        tracker.sample(0.0, 0.012).positions, tracker.sample(0.0).positions
    )


@pytest.mark.parametrize("seed", range(3))
def test_whatever_happens_to_the_frames_a_pose_is_right_or_missing(seed):
    rng = np.random.default_rng(seed)
    labels = tuple(rng.permutation(3))
    tracker = BodyTracker(SETTINGS, *TRIADS)
    pairs = [(body, label) for body in range(2) for label in range(3)]
    moment = 10.0 * seed
    moments, swaps = [], [set(), set()]
    right = 0
    for _ in range(400):
        moment += PERIOD * (1.0 + rng.integers(1, 20) * (rng.random() < 0.1))
        moments.append(moment)
        ids = IDS if rng.random() > 0.02 else IDS[::-1]
        swapped = [(b, *rng.permutation(3)[:2]) for b in range(2) if rng.random() < 0.15]
        for body, *_ in swapped:
            swaps[body].add(moment)
        hidden = [pair for pair in pairs if rng.random() < 0.08]
        filled = [pair for pair in pairs if rng.random() < 0.015]
        gone = [pair for pair in pairs if rng.random() < 0.015]
        frame = frame_at(
            moment, swapped, labels, lies=hidden + filled, wrong=rng.normal(0.0, 1e-5, (3, 3)),
            hidden=hidden, filled=filled, gone=gone, ids=ids,
        )  # fmt: skip
        models = models_of(*(NAMES if ids == IDS else NAMES[::-1]))
        tracker.add(frame, moment, models if rng.random() > 0.02 else None)
        trigger = moment - rng.uniform(0.0, 0.06)
        sample = tracker.sample(trigger)
        around = {
            max((m for m in moments if m < trigger), default=0.0),
            min(m for m in moments if m >= trigger),
        }
        for body in range(2):
            position, angle, markers_off = errors_of(sample, body)
            missing = bool(np.isnan(sample.positions[body]).any())
            assert missing == bool(sample.faults[body])
            assert missing == bool(np.isnan(sample.quaternions[body]).any())
            if not missing:
                right += 1
                assert position < 2e-4 and angle < 2e-3
            # Two visible markers that are swapped alike in both frames are beyond telling.
            if not missing or not around <= swaps[body]:
                assert markers_off < 3e-4
    assert right > 250
