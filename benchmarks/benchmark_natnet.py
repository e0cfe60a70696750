"""Motion capture beside its frame period: parsing a frame, and placing the bodies at a trigger.

Both run in mocap_node's threads, 240 and up to 200 times a second.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from machine import describe_machine

from socket_testbed.drivers.natnet.messages import RigidBodyDefinition, parse_frame
from socket_testbed.drivers.natnet.tracker import BodyTracker
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.settings.acquisition import MocapSettings
from socket_testbed.simulation.devices.natnet_encoding import Body, Content, Marker, encode_frame

_VERSION = (4, 1)
_PERIOD = 1.0 / 240.0  # [s]
_FRAMES = 240


def main() -> None:
    """Print processor times beside the limits that they should keep."""
    settings = MocapSettings()
    names = (settings.socket_body, settings.pylon_body)
    geometry = read_socket(packaged("config", "socket.yaml"))
    triads = (geometry.socket_markers, geometry.pylon_markers)
    payload = _payload(triads)
    models = {
        name: RigidBodyDefinition(name, identity, tuple(map(tuple, triad.tolist())))
        for identity, (name, triad) in enumerate(zip(names, triads, strict=True), start=1)
    }
    tracker = BodyTracker(settings, *triads)
    frame = parse_frame(payload, _VERSION)
    for k in range(_FRAMES):
        tracker.add(frame, k * _PERIOD, models)
    sample = tracker.sample(100.5 * _PERIOD)
    assert sample.faults == ("", ""), sample.faults

    print(describe_machine(1))
    _report("parse a frame of two bodies", _best(lambda: parse_frame(payload, _VERSION)), 0.2)
    _report("place two bodies at a trigger", _best(lambda: tracker.sample(100.5 * _PERIOD)), 1.0)
    average = _best(lambda: tracker.sample(100.5 * _PERIOD, 0.25), repeats=20)
    _report("the same with the mean of 60 frames, 4 times a second", average, 10.0)


def _payload(triads: tuple[np.ndarray, np.ndarray]) -> bytes:
    """A frame with two bodies and their markers, without its header."""
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    content = Content(
        number=1,
        bodies=[Body(k, np.zeros(3), identity) for k in (1, 2)],
        markers=[
            Marker(k, label, position)
            for k, triad in enumerate(triads, start=1)
            for label, position in enumerate(triad, start=1)
        ],
    )
    return bytes(encode_frame(content, _VERSION).data)[4:]


def _best(work: Callable[[], object], rounds: int = 10, repeats: int = 100) -> float:
    """Processor time of a piece of work, the best of some rounds [s]."""

    def once() -> float:
        start = time.process_time()
        for _ in range(repeats):
            work()
        return (time.process_time() - start) / repeats

    return min(once() for _ in range(rounds))


def _report(what: str, spent: float, limit: float) -> None:
    verdict = "ok" if spent * 1e3 < limit else "too slow"
    share = spent / _PERIOD
    print(f"{what}: {spent * 1e3:.3f} ms, {share:.0%} of a period; limit {limit:g} ms: {verdict}")


if __name__ == "__main__":
    main()
