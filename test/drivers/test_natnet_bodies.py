"""Bodies of four to eight markers from Motive to the poses, beside one of three."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.natnet import NAMES, TRIADS, Link, pose_at

from socket_testbed.drivers.natnet.messages import (
    LabelledMarker,
    MocapFrame,
    RigidBodyDefinition,
)
from socket_testbed.drivers.natnet.tracker import BodyTracker, MocapSample
from socket_testbed.geometry.marker_bodies import body_fault
from socket_testbed.settings.acquisition import MocapSettings

PERIOD = 1.0 / 240.0  # [s]
EIGHT = 0.001 * np.array(
    [[0, 0, 0], [61, 4, 9], [13, 47, 2], [40, 72, 31], [-35, 20, 44], [22, -58, 15], [70, 45, -20],
     [-28, -36, -9]]
)  # fmt: skip


def markers_at(body: int, reference: np.ndarray, moment: float) -> np.ndarray:
    position, rotation = pose_at(body, moment)
    return rotation.apply(reference) + position


def tracker_of(references, hidden=(), swapped=(), count=20) -> BodyTracker:
    """A tracker that saw frames; markers of the socket are hidden or exchanged in all of them."""
    tracker = BodyTracker(MocapSettings(), *references)
    models = {
        name: RigidBodyDefinition(name, k + 1, tuple(map(tuple, reference)))
        for k, (name, reference) in enumerate(zip(NAMES, references, strict=True))
    }
    for number in range(count):
        markers = []
        for body, reference in enumerate(references):
            places = markers_at(body, reference, number * PERIOD)
            if body == 0 and swapped:
                places[list(swapped)] = places[list(swapped)[::-1]]
            markers += [
                LabelledMarker(body + 1, k + 1, tuple(place), body == 0 and k in hidden, False)
                for k, place in enumerate(places)
            ]
        frame = MocapFrame(number, (), tuple(markers), 0.0, 0, False, False, False)
        tracker.add(frame, number * PERIOD, models)
    return tracker


def error(sample: MocapSample, body: int) -> float:
    """Error of a pose, of a point 0.1 m from its origin [m]."""
    position, rotation = pose_at(body, sample.time)
    turn = Rotation.from_quat(sample.quaternions[body]).inv() * rotation
    return np.linalg.norm(sample.positions[body] - position) + 0.1 * turn.magnitude()


def test_the_eight_markers_here_and_their_first_ones_are_bodies():
    for count in range(4, 9):
        assert body_fault(EIGHT[:count]) is None


@pytest.mark.parametrize("count", [4, 5, 8])
def test_a_body_has_its_pose_whatever_few_of_its_markers_are_seen(count):
    references = (EIGHT[:count], TRIADS[1])
    for hidden in [(), (1,), (0, count - 1)] if count > 4 else [(), (0,)]:
        sample = tracker_of(references, hidden).sample(9.3 * PERIOD, 10.0 * PERIOD)
        assert sample.faults == ("", "")
        assert error(sample, 0) < 1e-4 and error(sample, 1) < 1e-4
        seen = np.isfinite(sample.markers).all(axis=2)
        assert sample.markers.shape == (2, count, 3)
        assert seen[0].tolist() == [k not in hidden for k in range(count)]
        assert seen[1].tolist() == [k < 3 for k in range(count)]
        truth = markers_at(0, references[0], sample.time)
        assert np.nanmax(np.abs(sample.markers[0] - truth)) < 1e-4


def test_three_markers_left_that_two_labels_could_exchange_make_no_pose():
    """Of the first four, the first and the fourth are as far from the third to within 2 mm."""
    sample = tracker_of((EIGHT[:4], TRIADS[1]), hidden=(1,)).sample(9.5 * PERIOD)
    assert np.isnan(sample.positions[0]).all()
    assert sample.faults[0] == (
        "marker 2 of rigid body 'socket' is occluded, and the others do not make its pose certain"
    )


def test_too_few_markers_make_no_pose_and_say_so():
    references = (EIGHT[:5], TRIADS[1])
    sample = tracker_of(references, hidden=(0, 1, 3)).sample(9.5 * PERIOD)
    assert np.isnan(sample.positions[0]).all()
    assert sample.faults == ("marker 1, 2, 4 of rigid body 'socket' is occluded", "")
    assert error(sample, 1) < 1e-4


def test_swapped_labels_of_a_larger_body_are_put_right():
    references = (EIGHT[:6], TRIADS[1])
    sample = tracker_of(references, hidden=(3,), swapped=(1, 4)).sample(9.5 * PERIOD)
    assert sample.faults == ("", "") and error(sample, 0) < 1e-4
    truth = markers_at(0, references[0], sample.time)
    assert np.nanmax(np.abs(sample.markers[0] - truth)) < 1e-4


def test_another_number_of_markers_in_motive_is_reported():
    tracker = tracker_of((EIGHT[:5], TRIADS[1]))
    other = BodyTracker(MocapSettings(), EIGHT[:4], TRIADS[1])
    other._frames = tracker._frames
    fault = other.sample(9.5 * PERIOD).faults[0]
    assert "'socket' has 5 markers in Motive, and 4 in the geometry file" in fault


@pytest.mark.parametrize("count", [4, 8])
def test_a_server_streams_bodies_of_as_many_markers(count):
    references = (EIGHT[:count], TRIADS[1])

    def bodies(moment: float):
        found = []
        for body, (name, reference) in enumerate(zip(NAMES, references, strict=True)):
            position, rotation = pose_at(body, moment)
            markers = markers_at(body, reference, moment)
            found.append((name, markers, position, rotation.as_quat()))
        return found

    with Link(bodies=bodies, references=references) as link:
        link.until_fine()
        link.faults.update({"mocap.occlude": 2.0 if count == 8 else 0.0, "mocap.swap": 0.3})
        sample = link.sample(body=0)
        assert error(sample, 0) < 1e-3
