"""Bodies between frames: against the true motion, through swaps, occlusions and gaps."""

import itertools
import threading

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from support.natnet import NAMES, TRIADS, markers_at, pose_at
from support.wording import check_line

from socket_testbed import clocks
from socket_testbed.drivers.natnet.messages import (
    BodiesByName,
    LabelledMarker,
    MocapFrame,
    RigidBodyDefinition,
)
from socket_testbed.drivers.natnet.tracker import BodyTracker, MocapSample
from socket_testbed.settings.acquisition import MocapSettings

PERIOD = 1.0 / 240.0  # [s]
SETTINGS = MocapSettings(stale=0.05)
IDS = (5, 9)
TRIAD = tuple((0.0, 0.0, 0.0) for _ in range(3))


def models_of(*names: str, markers=TRIAD) -> BodiesByName:
    return {
        name: RigidBodyDefinition(name, identity, markers)
        for name, identity in zip(names, IDS, strict=False)
    }


MODELS = models_of(*NAMES)


def frame_at(
    moment, hidden=(), swapped=(), filled=(), labels=(0, 1, 2), lies=(), gone=(), wrong=0.0
) -> MocapFrame:
    """A frame; the other arguments name (body, label) pairs, `swapped` (body, label, label)."""
    markers = []
    for body, identity in enumerate(IDS):
        positions = markers_at(body, moment)[list(labels)] + wrong
        for other, a, b in swapped:
            if other == body:
                positions[[a, b]] = positions[[b, a]]
        for label in range(3):
            if (body, label) in gone:
                continue
            position = positions[label] if (body, label) not in lies else np.zeros(3)
            markers.append(
                LabelledMarker(
                    identity, label + 1, tuple(position), (body, label) in hidden,
                    (body, label) in filled,
                )
            )  # fmt: skip
    markers.append(LabelledMarker(0, 77, (1.0, 1.0, 1.0), False, False))
    return MocapFrame(round(moment / PERIOD), (), tuple(markers), moment, 0, False, False, False)


def tracker_of(moments, settings=SETTINGS, models=MODELS, **faults) -> BodyTracker:
    """A tracker that saw frames; a fault is a function of the frame's index."""
    tracker = BodyTracker(settings, *TRIADS)
    for index, moment in enumerate(moments):
        frame = frame_at(moment, **{name: fault(index) for name, fault in faults.items()})
        tracker.add(frame, moment, models)
    for index in (0.5, 1.5):  # the order of the labels is learnt from fits
        tracker.sample(index * PERIOD)
    return tracker


def frames(count=20, start=0.0):
    return start + PERIOD * np.arange(count)


def errors_of(sample: MocapSample, body: int) -> tuple[float, float, float]:
    """Errors of position [m], orientation [rad] and the worst marker [m]; NaN if missing."""
    position, rotation = pose_at(body, sample.time)
    angle = np.nan
    if np.isfinite(sample.quaternions[body]).all():
        angle = (Rotation.from_quat(sample.quaternions[body]).inv() * rotation).magnitude()
    markers = np.linalg.norm(sample.markers[body] - markers_at(body, sample.time), axis=1)
    return (
        float(np.linalg.norm(sample.positions[body] - position)),
        float(angle),
        float(np.nanmax(markers, initial=0.0)),
    )


def test_between_frames_the_bodies_are_where_they_were_and_at_a_frame_it_is_the_frame():
    for start, labels in ((0.0, (0, 1, 2)), (0.3, (2, 0, 1)), (1234.5, (1, 0, 2))):
        tracker = tracker_of(frames(start=start), labels=lambda _, labels=labels: labels)
        for trigger in np.linspace(start + 0.002, start + 17.9 * PERIOD, 97):
            assert tracker.ready(trigger)
            sample = tracker.sample(trigger)
            assert sample.faults == ("", "")
            for body in range(2):
                position, angle, markers = errors_of(sample, body)
                assert position < 1e-5 and angle < 5e-5 and markers < 1e-5
    tracker = tracker_of(frames())
    for index in (1, 7, 19):
        assert max(errors_of(tracker.sample(index * PERIOD), 0)) < 1e-7


def test_the_error_falls_with_the_square_of_the_gap():
    errors = []
    for period in (0.04, 0.02, 0.01):
        tracker = tracker_of(period * np.arange(30))
        triggers = np.linspace(0.2, 0.27, 40)
        errors.append(max(errors_of(tracker.sample(t), 0)[0] for t in triggers))
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.3)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.3)


def test_swapped_labels_do_not_move_a_body():
    swaps = [((0, 0, 1),), (), ((0, 1, 2), (1, 0, 2)), ((1, 1, 2),), ((0, 0, 2),)]
    tracker = tracker_of(frames(), swapped=lambda index: swaps[index % 5])
    for trigger in np.linspace(PERIOD, 18 * PERIOD, 50):
        sample = tracker.sample(trigger)
        assert sample.faults == ("", "")
        assert max(max(errors_of(sample, body)) for body in range(2)) < 5e-5


def test_an_occluded_marker_is_missing_and_never_where_it_was():
    for kind in ("hidden", "filled"):
        fault = {kind: lambda index: ((0, 1),) if index >= 10 else ()}
        tracker = tracker_of(frames(), lies=lambda index: ((0, 1),) if index >= 10 else (), **fault)
        sample = tracker.sample(15.3 * PERIOD)
        assert np.isnan(sample.positions[0]).all() and np.isnan(sample.quaternions[0]).all()
        assert np.isnan(sample.markers[0, 1]).all()
        assert errors_of(sample, 0)[2] < 1e-5
        assert np.isfinite(sample.markers[0, [0, 2]]).all()
        assert sample.faults == ("marker 2 of rigid body 'socket' is occluded", "")
        assert max(errors_of(sample, 1)) < 5e-5


def test_a_marker_that_is_not_streamed_is_missing_too():
    tracker = tracker_of(frames(), gone=lambda i: ((1, 0),) if i > 2 else ())
    sample = tracker.sample(5.5 * PERIOD)
    assert np.isnan(sample.markers[1, 0]).all() and np.isfinite(sample.markers[1, 1:]).all()
    assert sample.faults[1] == "marker 1 of rigid body 'pylon' is occluded"


def test_frames_without_a_pose_are_bridged_over_the_largest_gap_at_most():
    for first, last in ((9, 9), (10, 10), (9, 10)):
        hidden = [((0, 2),) if first <= i <= last else () for i in range(20)]
        sample = tracker_of(frames(), hidden=hidden.__getitem__).sample(9.5 * PERIOD)
        assert sample.faults == ("", "")
        assert max(errors_of(sample, 0)) < 1e-4
    settings = MocapSettings(stale=1.5 * PERIOD)
    tracker = tracker_of(frames(), settings, hidden=lambda i: ((0, 2),) if i == 9 else ())
    sample = tracker.sample(9.5 * PERIOD)
    assert np.isnan(sample.positions[0]).all()
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


def test_labels_that_the_edges_contradict_tell_no_markers():
    tracker = tracker_of(
        frames(),
        labels=lambda _: (1, 0, 2),
        swapped=lambda i: ((0, 0, 2),) if i > 5 else (),
        hidden=lambda i: ((0, 0),) if i > 5 else (),
    )
    assert np.isnan(tracker.sample(8.5 * PERIOD).markers[0]).all()


def test_a_marker_that_jumps_is_not_interpolated():
    tracker = tracker_of(
        frames(),
        hidden=lambda i: ((0, 0),) if i > 4 else (),
        swapped=lambda i: ((0, 1, 2),) if i in (9, 10) else (),
    )
    sample = tracker.sample(8.5 * PERIOD)  # before the swap and after
    assert np.isnan(sample.markers[0]).all()
    assert np.isnan(sample.positions[0]).all()


def test_a_gap_between_frames_gives_nothing():
    moments = np.concatenate([frames(10), frames(10, 0.2)])
    tracker = tracker_of(moments)
    for trigger in (0.1, 0.199, -0.01, 0.25):
        sample = tracker.sample(trigger)
        assert np.isnan(sample.markers).all() and np.isnan(sample.positions).all()
        assert all("no two frames within 0.05 s" in fault for fault in sample.faults)
    assert tracker.sample(0.205).faults == ("", "")
    nothing = BodyTracker(SETTINGS, *TRIADS).sample(1.0)
    assert nothing.markers.shape == (2, 3, 3) and nothing.quaternions.shape == (2, 4)


def test_only_the_last_second_of_later_and_later_frames_is_kept():
    tracker = tracker_of(frames(1000))
    assert tracker.sample(500.5 * PERIOD).faults[0].startswith("no two frames")
    assert tracker.sample(900.5 * PERIOD).faults == ("", "")
    assert len(tracker._frames) < 250
    tracker = tracker_of([0.0, PERIOD, PERIOD, 0.5 * PERIOD, 2 * PERIOD])
    assert tracker.sample(1.5 * PERIOD).faults == ("", "")
    assert max(errors_of(tracker.sample(0.5 * PERIOD), 1)) < 5e-5


def test_unknown_bodies_and_another_triad_are_reported():
    for models, text in (
        (None, "has not sent its rigid bodies yet"),
        (models_of("socket", "A"), "no rigid body 'pylon' (there are: A, socket): name it so"),
        (models_of(), "(there are: none): name it so there, or set pylon_body"),
        (models_of(*NAMES, markers=4 * TRIAD[:1]), "rigid body 'pylon' has 4 markers in Motive"),
    ):
        tracker = tracker_of(frames(), models=models)
        sample = tracker.sample(5.5 * PERIOD)
        assert text in sample.faults[1]
        assert np.isnan(sample.markers[1]).all()
        assert tracker.ready(5.5 * PERIOD)
    tracker = BodyTracker(SETTINGS, 1.2 * TRIADS[0], TRIADS[1])
    for moment in frames():
        tracker.add(frame_at(moment), moment, MODELS)
    sample = tracker.sample(5.5 * PERIOD)
    check_line(sample.faults[0], "do not fit its triad: check the geometry")
    assert np.isnan(sample.positions[0]).all()
    assert errors_of(sample, 0)[2] < 1e-5  # its markers are kept
    assert sample.faults[1] == ""


def test_ids_may_change_between_frames():
    tracker = BodyTracker(SETTINGS, *TRIADS)
    other = models_of(*reversed(NAMES))  # the ids the other way round
    for index, moment in enumerate(frames()):
        markers = frame_at(moment)
        if index >= 10:
            swap = {5: 9, 9: 5, 0: 0}
            markers = MocapFrame(
                index, (), tuple(m._replace(model=swap[m.model]) for m in markers.markers), moment,
                0, False, False, False,
            )  # fmt: skip
        tracker.add(markers, moment, other if index >= 10 else MODELS)
    for trigger in (5.5, 9.5, 15.5):
        sample = tracker.sample(trigger * PERIOD)
        assert max(max(errors_of(sample, body)) for body in range(2)) < 5e-5


def test_ready_means_that_no_later_frame_makes_it_better():
    tracker = tracker_of(frames(10))
    assert tracker.ready(8.5 * PERIOD) and tracker.ready(9.0 * PERIOD)
    assert not tracker.ready(9.1 * PERIOD)
    occluded = tracker_of(frames(10), hidden=lambda i: ((1, 1),) if i >= 9 else ())
    assert not occluded.ready(8.5 * PERIOD)  # the next frame may show the marker
    occluded.add(frame_at(10 * PERIOD), 10 * PERIOD, MODELS)
    assert occluded.ready(8.5 * PERIOD)
    assert occluded.sample(8.5 * PERIOD).faults == ("", "")


def test_waiting_ends_with_the_frame_or_the_deadline():
    start = clocks.monotonic()
    tracker = tracker_of([start - PERIOD])
    assert not tracker.wait(start, start + 0.02)
    assert clocks.monotonic() >= start + 0.02
    sender = threading.Timer(
        0.02, lambda: tracker.add(frame_at(start + 1e-3), start + 1e-3, MODELS)
    )
    sender.start()
    assert tracker.wait(start, start + 10.0)
    sender.join()
    assert tracker.sample(start).faults == ("", "")


class Walk:
    """Two bodies that move and turn steadily, seen with noise; frames may be missing.

    Args:
        times: Times of the frames [s].
        noise: Noise of a marker's coordinate [m].
        speed: Speed of the bodies against the usual one [-].
        hidden: Times [s] at which a marker of the socket is occluded.
    """

    def __init__(self, times, noise=0.0, seed=0, speed=1.0, hidden=()) -> None:
        self._speed = speed
        self._rng = np.random.default_rng(seed)
        self.tracker = BodyTracker(SETTINGS, *TRIADS)
        self._seen = []  # of the socket
        for time in times:
            markers = []
            for body, identity in enumerate(IDS):
                position, rotation = self.pose(body, time)
                seen = rotation.apply(TRIADS[body]) + position
                seen += self._rng.normal(0.0, noise, (3, 3))
                if body == 0:
                    self._seen.append(seen)
                occluded = body == 0 and time in hidden
                markers += [
                    LabelledMarker(identity, k + 1, tuple(seen[k]), occluded and k == 1, False)
                    for k in range(3)
                ]
            frame = MocapFrame(0, (), tuple(markers), time, 0, False, False, False)
            self.tracker.add(frame, time, MODELS)

    def pose(self, body, time):
        velocity, rate = np.array([0.2, -0.1, 0.3]), np.array([0.5, 0.8, -0.6])  # [m/s], [rad/s]
        place = np.array([0.4, -0.3, 0.7 + 0.2 * body])
        first = Rotation.from_rotvec([0.3, 0.2 * body, -0.4])
        moved = self._speed * time
        return place + velocity * moved, first * Rotation.from_rotvec(rate * moved)

    def errors(self, sample, body=0):
        """Errors of position [m] and orientation [rad]."""
        position, rotation = self.pose(body, sample.time)
        turn = Rotation.from_quat(sample.quaternions[body]).inv() * rotation
        return np.linalg.norm(sample.positions[body] - position), turn.magnitude()

    def fitted(self, first, last):
        """Positions [m] and orientations of the socket in some frames, by another method."""
        arms = TRIADS[0] - TRIADS[0].mean(axis=0)
        positions, rotations = [], []
        for seen in self._seen[first:last]:
            rotation, _ = Rotation.align_vectors(seen - seen.mean(axis=0), arms)
            rotations.append(rotation)
            positions.append(seen.mean(axis=0) - rotation.apply(TRIADS[0].mean(axis=0)))
        return np.array(positions), rotations


def quaternion_mean(rotations) -> Rotation:
    """Markley et al. 2007, doi:10.2514/1.28949: largest eigenvector of the sum of q q^T."""
    quaternions = np.array([rotation.as_quat() for rotation in rotations])
    return Rotation.from_quat(np.linalg.eigh(quaternions.T @ quaternions)[1][:, -1])


def test_the_pose_is_the_mean_of_the_frames_in_the_window():
    walk = Walk(0.005 * np.arange(-40, 41), noise=1e-4, speed=0.0)
    sample = walk.tracker.sample(0.0, 0.251)
    assert sample.frames == (51, 51) and sample.faults == ("", "")
    positions, rotations = walk.fitted(15, 66)
    np.testing.assert_allclose(sample.positions[0], positions.mean(axis=0), atol=1e-9)
    turn = Rotation.from_quat(sample.quaternions[0]).inv() * quaternion_mean(rotations)
    assert turn.magnitude() < 1e-8


@pytest.mark.parametrize("share", [1.0, 0.7, 0.5])
def test_a_mean_does_not_lag_behind_a_steady_motion(share):
    """Wherever the trigger is between frames, and whichever of them are missing."""
    rng = np.random.default_rng(round(10 * share))
    times = np.arange(-0.3, 0.3, PERIOD)
    walk = Walk(times[rng.random(len(times)) < share])
    for trigger, window in itertools.product(rng.uniform(-0.1, 0.1, 20), (0.01, 0.05, 0.25)):
        sample = walk.tracker.sample(trigger, window)
        if sample.faults == ("", ""):
            for body in range(2):
                position, angle = walk.errors(sample, body)
                assert position < 1e-9 and angle < 1e-7


def test_a_mean_of_a_bent_path_is_that_of_the_path():
    tracker = tracker_of(frames(240))
    for trigger in (0.3, 0.4567, 0.7):
        sample = tracker.sample(trigger, 0.25)
        assert sample.frames[0] in (59, 60, 61)
        path = [pose_at(0, t) for t in trigger + np.linspace(-0.125, 0.125, 1001)]
        position = np.mean([position for position, _ in path], axis=0)
        assert np.linalg.norm(sample.positions[0] - position) < 5e-5
        turn = Rotation.from_quat(sample.quaternions[0]).inv() * quaternion_mean(
            [rotation for _, rotation in path]
        )
        assert turn.magnitude() < 5e-4
        # And the markers are those at the trigger's time.
        np.testing.assert_array_equal(sample.markers, tracker.sample(trigger).markers)


def test_noise_falls_with_the_root_of_the_number_of_frames():
    errors = {1: [], 5: [], 15: [], 61: []}
    for seed in range(60):
        walk = Walk(PERIOD * np.arange(-31, 32), noise=5e-5, seed=seed, speed=0.0)
        position, rotation = walk.pose(0, 0.0)
        for count, found in errors.items():
            # At the time of a frame, where the interpolation is that frame.
            sample = walk.tracker.sample(0.0, (count - 0.5) * PERIOD if count > 1 else 0.0)
            assert count == 1 or sample.frames[0] == count
            turn = Rotation.from_quat(sample.quaternions[0]).inv() * rotation
            found.append(np.concatenate([sample.positions[0] - position, turn.as_rotvec()]))
    single = np.sqrt(np.mean(np.square(errors[1]), axis=0))
    for count, found in errors.items():
        spread = np.sqrt(np.mean(np.square(found), axis=0))
        np.testing.assert_allclose(spread * np.sqrt(count), single, rtol=0.35)


def test_occluded_frames_are_left_out_of_the_mean_and_nothing_lags():
    times = PERIOD * np.arange(-60, 60)
    late = times[times > 2.5 * PERIOD]
    walk = Walk(times, hidden=late)
    sample = walk.tracker.sample(0.4 * PERIOD, 0.25)
    assert sample.frames == (32, 60) and sample.faults == ("", "")
    assert max(walk.errors(sample)) < 1e-7
    # All frames around the trigger are occluded: there is no pose, though the window has frames.
    around = times[np.abs(times) < 0.04]
    walk = Walk(times, hidden=around)
    sample = walk.tracker.sample(0.0, 0.25)
    assert sample.frames[0] == 0 and np.isnan(sample.positions[0]).all()
    assert sample.faults == ("marker 2 of rigid body 'socket' is occluded", "")


def test_with_a_frame_or_none_in_the_window_the_pose_is_interpolated():
    walk = Walk(PERIOD * np.arange(-5, 6), noise=1e-4)
    positions, rotations = walk.fitted(5, 7)
    between = Slerp([0.0, 1.0], Rotation.concatenate(rotations))(0.2)
    for window in (0.0, 0.5 * PERIOD, 1.9 * PERIOD):
        sample = walk.tracker.sample(0.2 * PERIOD, window)
        np.testing.assert_allclose(sample.positions[0], [0.8, 0.2] @ positions, atol=1e-12)
        assert (Rotation.from_quat(sample.quaternions[0]).inv() * between).magnitude() < 1e-7
        assert sample.frames == (2, 2)
    # Two frames at the end of a window, carried to the trigger's time, would be noisier.
    walk = Walk(np.array([-0.02, 0.004, 0.005]), noise=1e-4)
    sample, interpolated = walk.tracker.sample(0.0, 0.012), walk.tracker.sample(0.0)
    np.testing.assert_array_equal(sample.positions, interpolated.positions)
    np.testing.assert_array_equal(sample.quaternions, interpolated.quaternions)
    assert sample.frames == interpolated.frames == (2, 2)


def test_a_window_is_waited_for_to_its_last_frame():
    tracker = tracker_of(frames(20))  # the last at 19, the next at 20
    assert tracker.ready(10.2 * PERIOD, 19.0 * PERIOD)
    assert not tracker.ready(10.2 * PERIOD, 20.0 * PERIOD)
    assert not tracker.wait(10.2 * PERIOD, clocks.monotonic(), 20.0 * PERIOD)
    tracker.add(frame_at(20 * PERIOD), 20 * PERIOD, MODELS)
    assert tracker.wait(10.2 * PERIOD, clocks.monotonic(), 20.0 * PERIOD)
    assert not BodyTracker(SETTINGS, *TRIADS).ready(0.0, 0.25)


@pytest.mark.parametrize("seed", range(4))
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
        swapped = [(b, *rng.permutation(3)[:2]) for b in range(2) if rng.random() < 0.15]
        for body, *_ in swapped:
            swaps[body].add(moment)
        frame = frame_at(
            moment,
            labels=labels,
            hidden=[pair for pair in pairs if rng.random() < 0.08],
            filled=[pair for pair in pairs if rng.random() < 0.015],
            gone=[pair for pair in pairs if rng.random() < 0.015],
            swapped=swapped,
            wrong=rng.normal(0.0, 1e-5, (3, 3)),
        )
        # What is hidden or filled in lies as it likes.
        markers = tuple(
            m._replace(position=tuple(rng.normal(size=3))) if m.occluded or m.model_filled else m
            for m in frame.markers
        )
        frame = MocapFrame(frame.number, (), markers, moment, 0, False, False, False)
        tracker.add(frame, moment, MODELS if rng.random() > 0.02 else None)
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
