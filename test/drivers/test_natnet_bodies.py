"""Rigid bodies that no longer are as the server defined them, on a clock of the tests' own."""

import numpy as np
import pytest
from support.natnet import NAMES, TRIADS

from socket_testbed.drivers.natnet.bodies import BodyWatch
from socket_testbed.drivers.natnet.messages import LabelledMarker, MocapFrame, RigidBodyDefinition

PLACE = np.array([0.4, -0.3, 0.7])


def models(ids=(1, 2), triads=TRIADS):
    return {
        name: RigidBodyDefinition(name, identity, tuple(map(tuple, triad)))
        for name, identity, triad in zip(NAMES, ids, triads, strict=True)
    }


def frame(ids=(1, 2), order=(0, 1, 2), hidden=(), wrong=0.0) -> MocapFrame:
    """The triads moved to a place; `hidden` members are not seen, `wrong` stretches by x [m]."""
    markers = [
        LabelledMarker(
            identity, k + 1, tuple(triad[at] + PLACE + [wrong * k, 0, 0]), k not in hidden
        )
        for identity, triad in zip(ids, TRIADS, strict=True)
        for k, at in enumerate(order)
    ]
    return MocapFrame(0, ids, tuple(markers), 0, False, False)


def times_asked(watch: BodyWatch, found: MocapFrame, start: float, stop: float) -> list[float]:
    asked = []
    for moment in np.arange(start, stop, 0.125):
        watch.observe(found, models(), moment)
        if watch.stale(moment):
            asked.append(float(moment))
    return asked


@pytest.mark.parametrize(
    "found",
    [
        pytest.param(frame(), id="as-defined"),
        pytest.param(frame(order=(2, 0, 1)), id="relabelled"),
        pytest.param(frame(hidden=(1,)), id="occluded"),
        pytest.param(frame(wrong=0.0009), id="noisy"),
        pytest.param(MocapFrame(0, (), (), 0, False, False), id="empty"),
    ],
)
def test_bodies_as_defined_are_not_asked_for(found: MocapFrame) -> None:
    assert times_asked(BodyWatch(), found, 0.0, 5.0) == []


def test_exchanged_bodies_are_asked_for_after_a_second() -> None:
    """An answer that changes nothing doubles the wait for the next request."""
    asked = times_asked(BodyWatch(), frame(ids=(2, 1)), 10.0, 50.0)
    assert asked == [11.0, 12.0, 14.0, 18.0, 26.0, 42.0]


def test_a_fitting_frame_starts_the_second_anew() -> None:
    watch = BodyWatch()
    assert times_asked(watch, frame(ids=(2, 1)), 10.0, 10.75) == []
    assert times_asked(watch, frame(), 10.75, 11.0) == []
    assert times_asked(watch, frame(ids=(2, 1)), 11.0, 12.25) == [12.0]


def test_changed_ids_are_reported_for_three_seconds() -> None:
    watch = BodyWatch()
    watch.renewed(None, models(), 0.0)
    times_asked(watch, frame(), 0.0, 10.0)
    times_asked(watch, frame(ids=(2, 1)), 10.0, 11.0)
    watch.renewed(models(), models(ids=(2, 1)), 11.0)
    times_asked(watch, frame(), 11.0, 14.25)
    assert watch.warning(13.9) == (
        "Motive has changed the ids of its rigid bodies (socket 2 instead of 1, pylon 1 instead of"
        " 2): they are read again, after 1.1 s without poses"
    )
    assert watch.warning(14.0) == ""


# When frames have other ids of socket and pylon [s], their new ids, and what is said at 12 s
LOSSES = {
    "socket first": ((10.0, 11.0), (9, 7), "socket 9 instead of 1, pylon 7 instead of 2", "2.1"),
    "pylon first": ((11.0, 10.0), (9, 7), "socket 9 instead of 1, pylon 7 instead of 2", "2.1"),
    "pylon alone": ((99.0, 11.0), (1, 7), "pylon 7 instead of 2", "1.1"),
    "socket alone": ((10.0, 99.0), (9, 2), "socket 9 instead of 1", "2.1"),
    "socket hidden": ((10.0, 11.0), (1, 7), "pylon 7 instead of 2", "1.1"),
}


@pytest.mark.parametrize("case", LOSSES)
def test_the_longest_loss_of_poses_is_told(case: str) -> None:
    """The last poses are 0.125 s before the first frame with another id."""
    (socket, pylon), renumbered, ids, seconds = LOSSES[case]
    watch = BodyWatch()
    for moment in np.arange(9.0, 12.0, 0.125):
        ids_seen = 1 if moment < socket else 9, 2 if moment < pylon else 7
        watch.observe(frame(ids=ids_seen), models(), moment)
    watch.renewed(models(), models(ids=renumbered), 12.0)
    assert watch.warning(12.0) == (
        f"Motive has changed the ids of its rigid bodies ({ids}): they are read again, after"
        f" {seconds} s without poses"
    )


def test_equal_definitions_are_no_change() -> None:
    watch = BodyWatch()
    watch.renewed(models(), models(), 5.0)
    assert watch.warning(5.0) == ""
