"""Bodies between frames: against the true motion, through swaps, occlusions and gaps."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.natnet import NAMES, TRIADS, markers_at, pose_at

from socket_testbed import clocks
from socket_testbed.drivers.natnet.messages import LabelledMarker, MocapFrame, RigidBodyDefinition
from socket_testbed.drivers.natnet.tracker import BodyTracker, SeenBody
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
    velocity, rate = np.array([0.2, -0.1, 0.3]), np.array([0.5, 0.8, -0.6])  # [m/s], [rad/s]
    place = np.array([0.4, -0.3, 0.7 + 0.2 * body])
    first = Rotation.from_rotvec([0.3, 0.2 * body, -0.4])
    return place + velocity * moment, first * Rotation.from_rotvec(rate * moment)


def frame_at(
    moment, swapped=(), labels=slice(None), wrong=0.0, references=TRIADS, pose=pose_at, ids=IDS,
    hidden=(), gone=(),
) -> MocapFrame:  # fmt: skip
    """A frame of the true motion; `swapped` names (body, label, label), others (body, label)."""
    placed = [(markers_at(body, moment, references, pose) + wrong)[labels] for body in range(2)]
    for body, a, b in swapped:
        placed[body][[a, b]] = placed[body][[b, a]]
    for body, label in hidden:
        placed[body][label] = 0.0
    markers = [LabelledMarker(0, 77, (1.0, 1.0, 1.0), True)]
    for body, places in enumerate(placed):
        for label, place in enumerate(places):
            at = (body, label)
            if at not in gone:
                markers.append(LabelledMarker(ids[body], label + 1, tuple(place), at not in hidden))
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
    found: SeenBody, body: int, moment: float, references=TRIADS, pose=pose_at
) -> tuple[float, float, float]:
    """Errors of position [m], orientation [rad] and the worst marker [m]; NaN if missing."""
    position, rotation = pose(body, moment)
    angle = np.nan
    if np.isfinite(found.pose[3:]).all():
        angle = (Rotation.from_quat(found.pose[3:]).inv() * rotation).magnitude()
    off = np.linalg.norm(found.markers - markers_at(body, moment, references, pose), axis=1)
    away = float(np.linalg.norm(found.pose[:3] - position))
    return away, float(angle), float(np.nanmax(off, initial=0.0))


def assert_right(tracker: BodyTracker, moment: float, within: float = 5e-5) -> None:
    for body, found in enumerate(tracker.sample(moment)):
        assert found.fault == ""
        assert max(errors_of(found, body, moment)) < within


def seen(found: SeenBody) -> list[bool]:
    return np.isfinite(found.markers).all(axis=1).tolist()


def assert_no_pose(found: SeenBody, fault: str) -> None:
    assert np.isnan(found.pose).all()
    assert found.frames == 0 and fault in found.fault


def test_six_of_eight_markers_make_a_pose() -> None:
    references = (EIGHT, TRIADS[1])
    tracker = tracker_of(frames(), references=references, hidden=lambda _: [(0, 0), (0, 7)])
    socket, pylon = tracker.sample(9.3 * PERIOD, 10.0 * PERIOD)
    assert max(errors_of(pylon, 1, 9.3 * PERIOD)) < 3e-4
    assert max(errors_of(socket, 0, 9.3 * PERIOD, references)) < 3e-4
    assert seen(socket) == [k not in (0, 7) for k in range(8)]


def test_labels_that_could_be_exchanged_make_no_pose() -> None:
    """Of the first four, the first and the fourth are as far from the third to within 2 mm."""
    references = (EIGHT[:4], TRIADS[1])
    tracker = tracker_of(frames(), references=references, hidden=lambda _: [(0, 1)])
    socket, pylon = tracker.sample(9.3 * PERIOD, 10.0 * PERIOD)
    assert max(errors_of(pylon, 1, 9.3 * PERIOD)) < 3e-4
    assert_no_pose(socket, "marker 2 of rigid body 'socket' is occluded, and the others")


def test_frames_without_a_pose_are_bridged() -> None:
    hidden = [((0, 2),) if i in (9, 10) else () for i in range(20)]
    assert_right(tracker_of(frames(), hidden=hidden.__getitem__), 9.5 * PERIOD, 1e-4)


def test_occlusions_beyond_the_largest_gap_leave_none() -> None:
    short = MocapSettings(stale=1.5 * PERIOD)
    tracker = tracker_of(frames(), short, hidden=lambda i: ((0, 2),) if i == 9 else ())
    socket, _ = tracker.sample(9.5 * PERIOD)
    assert_no_pose(socket, "marker 3 of rigid body 'socket' is occluded")
    assert seen(socket) == [True, True, False]


@pytest.mark.parametrize(
    "trigger", [0.1, -0.01, 0.25], ids=["in-a-gap", "before-the-first", "after-the-last"]
)
def test_no_pose_is_made_far_from_frames(trigger: float) -> None:
    tracker = tracker_of(np.concatenate([frames(10), frames(10, 0.2)]))
    for found in tracker.sample(trigger):
        assert_no_pose(found, "no two frames within 0.05 s")
        assert np.isnan(found.markers).all()
    assert_right(tracker, 0.205)


def test_frames_are_kept_for_a_second() -> None:
    tracker = tracker_of(frames(500))
    assert_no_pose(tracker.sample(200.5 * PERIOD)[0], "no two frames")
    assert_right(tracker, 400.5 * PERIOD)


@pytest.mark.parametrize(
    ("models", "text"),
    [
        pytest.param(
            models_of("socket", "A"),
            "no rigid body 'pylon' (there are: A, socket): name it so",
            id="unknown",
        ),
        pytest.param(
            models_of(*NAMES, references=(TRIADS[0], EIGHT[:4])),
            "rigid body 'pylon' has 4 markers in Motive, and 3",
            id="too-many-markers",
        ),
    ],
)
def test_another_body_in_motive_is_named(models, text: str) -> None:
    tracker = tracker_of(frames(), models=models)
    assert tracker.ready(5.5 * PERIOD)
    assert_no_pose(tracker.sample(5.5 * PERIOD)[1], text)


@pytest.mark.parametrize("scale", [1.2, 0.8], ids=["too-large", "too-small"])
def test_another_triad_is_reported(scale: float) -> None:
    tracker = BodyTracker(SETTINGS, scale * TRIADS[0], TRIADS[1])
    for moment in frames():
        tracker.add(frame_at(moment), moment, MODELS)
    socket, _ = tracker.sample(5.5 * PERIOD)
    assert_no_pose(socket, "do not fit its triad: check the geometry")
    assert errors_of(socket, 0, 5.5 * PERIOD)[2] < 1e-5  # its markers are kept


@pytest.mark.parametrize(
    ("ids", "scale", "fault"),
    [
        pytest.param(IDS[::-1], 1.0, "do not fit its triad", id="exchanged"),
        pytest.param(IDS, 1000.0, "streams in millimetres", id="millimetres"),
    ],
)
def test_markers_of_another_body_or_unit_are_missing(ids, scale: float, fault: str) -> None:
    """They are neither the body's as the server defines it, nor in metres."""
    references = tuple(scale * triad for triad in TRIADS)
    tracker = BodyTracker(SETTINGS, *TRIADS)
    for moment in frames():
        frame = frame_at(moment, references=references, ids=ids)
        tracker.add(frame, moment, models_of(*NAMES, references=references))
    for found in tracker.sample(5.5 * PERIOD):
        assert_no_pose(found, fault)
        assert np.isnan(found.markers).all()


def test_ready_means_that_frames_are_on_both_sides() -> None:
    tracker = tracker_of(frames(10))
    assert tracker.ready(9.0 * PERIOD) and not tracker.ready(9.1 * PERIOD)


def test_an_occluded_marker_is_waited_for() -> None:
    occluded = tracker_of(frames(10), hidden=lambda i: ((1, 1),) if i >= 9 else ())
    assert not occluded.ready(8.5 * PERIOD)  # the next frame may show the marker
    occluded.add(frame_at(10 * PERIOD), 10 * PERIOD, MODELS)
    assert occluded.ready(8.5 * PERIOD)
    assert_right(occluded, 8.5 * PERIOD, 1e-4)


def test_a_window_is_waited_for_to_its_end() -> None:
    tracker = tracker_of(frames(20))
    assert tracker.ready(10.2 * PERIOD, 19.0 * PERIOD)
    assert not tracker.wait(10.2 * PERIOD, clocks.monotonic(), 20.0 * PERIOD)
    tracker.add(frame_at(20 * PERIOD), 20 * PERIOD, MODELS)
    assert tracker.wait(10.2 * PERIOD, clocks.monotonic(), 20.0 * PERIOD)


def test_the_pose_is_the_mean_of_the_window() -> None:
    """The markers are those at the trigger."""
    noise = np.random.default_rng(0).normal(0.0, 1e-4, (81, 3, 3))
    moments, still = 0.005 * np.arange(-40, 41), lambda body, _: steady(body, 0.0)
    tracker = tracker_of(moments, pose=still, wrong=noise.__getitem__)
    socket, pylon = tracker.sample(0.0, 0.251)
    assert (socket.frames, pylon.frames, socket.fault, pylon.fault) == (51, 51, "", "")
    markers, middle = (markers_at(0, 0.0, pose=steady) + noise)[15:66], TRIADS[0].mean(axis=0)
    arms = TRIADS[0] - middle
    rotations = [Rotation.align_vectors(m - m.mean(axis=0), arms)[0] for m in markers]
    positions = markers.mean(axis=1) - [rotation.apply(middle) for rotation in rotations]
    np.testing.assert_allclose(socket.pose[:3], positions.mean(axis=0), atol=1e-9)
    # Markley et al. 2007, doi:10.2514/1.28949: largest eigenvector of the sum of q q^T.
    quaternions = np.array([rotation.as_quat() for rotation in rotations])
    mean = Rotation.from_quat(np.linalg.eigh(quaternions.T @ quaternions)[1][:, -1])
    assert (Rotation.from_quat(socket.pose[3:]).inv() * mean).magnitude() < 1e-8
    between = tracker.sample(0.0, 0.002)[0]  # of a frame or none in the window
    np.testing.assert_array_equal(socket.markers, between.markers)
    assert between.frames == 2


def test_frames_beyond_the_window_do_not_count() -> None:
    """At 4 m/s^2 t^2 the two frames 5 ms from the trigger are at 0.1 mm, the next two at 0.9 mm."""

    def thrown(body: int, moment: float) -> tuple[np.ndarray, Rotation]:
        return np.array([4.0 * moment**2, 0.0, 0.0]), Rotation.identity()

    tracker = tracker_of([-0.015, -0.005, 0.005, 0.015], pose=thrown)
    socket, _ = tracker.sample(0.0, 0.02)
    assert socket.frames == 2
    np.testing.assert_allclose(socket.pose[:3], [1e-4, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("share", [1.0, 0.5], ids=["every-frame", "half-of-the-frames"])
def test_a_mean_does_not_lag_behind_a_motion(share: float) -> None:
    """Wherever the trigger is between frames, and whichever are missing or without a pose."""
    rng = np.random.default_rng(round(10 * share))
    times = np.arange(-0.3, 0.3, PERIOD)
    tracker = tracker_of(times[rng.random(len(times)) < share], pose=steady)
    for trigger, window in itertools.product(rng.uniform(-0.1, 0.1, 10), (0.01, 0.05, 0.25)):
        for body, found in enumerate(tracker.sample(trigger, window)):
            if not found.fault:
                assert max(errors_of(found, body, trigger, pose=steady)[:2]) < 1e-7


def test_a_window_occluded_around_the_trigger_gives_none() -> None:
    """Though the window has other frames."""
    times = PERIOD * np.arange(-60, 60)
    around = [((0, 1),) if abs(time) < 0.04 else () for time in times]
    tracker = tracker_of(times, pose=steady, hidden=around.__getitem__)
    assert_no_pose(tracker.sample(0.0, 0.25)[0], "marker 2 of rigid body 'socket' is occluded")


@pytest.mark.parametrize("seed", range(3))
def test_a_pose_is_right_or_missing(seed):
    rng = np.random.default_rng(seed)
    labels = rng.permutation(3)
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
        gone = [pair for pair in pairs if rng.random() < 0.015]
        frame = frame_at(
            moment, swapped, labels, wrong=rng.normal(0.0, 1e-5, (3, 3)), hidden=hidden, gone=gone,
            ids=ids,
        )  # fmt: skip
        models = models_of(*(NAMES if ids == IDS else NAMES[::-1]))
        tracker.add(frame, moment, models if rng.random() > 0.02 else None)
        trigger = moment - rng.uniform(0.0, 0.06)
        around = {
            max((m for m in moments if m < trigger), default=0.0),
            min(m for m in moments if m >= trigger),
        }
        for body, found in enumerate(tracker.sample(trigger)):
            position, angle, markers_off = errors_of(found, body, trigger)
            missing = bool(np.isnan(found.pose).all())
            assert missing == bool(found.fault) == bool(np.isnan(found.pose).any())
            if not missing:
                right += 1
                assert position < 2e-4 and angle < 2e-3
            # Two visible markers that are swapped alike in both frames are beyond telling.
            if not missing or not around <= swaps[body]:
                assert markers_off < 3e-4
    assert right > 250
