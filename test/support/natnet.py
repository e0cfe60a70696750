"""Two moving bodies, a simulated NatNet server that streams them, and a client beside it."""

import threading
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from socket_testbed import clocks
from socket_testbed.drivers import OK
from socket_testbed.drivers.natnet.client import NatNetClient
from socket_testbed.drivers.natnet.tracker import BodyTracker
from socket_testbed.live import doctor
from socket_testbed.settings.acquisition import MocapSettings
from socket_testbed.simulation.devices.natnet_server import NatNetServer
from support import HANGS
from support.clocks import FakeClock
from support.problems import PYLON_TRIAD, SOCKET_TRIAD

_POLL = 0.005  # [s]
TRIADS = (SOCKET_TRIAD, PYLON_TRIAD)
NAMES = ("socket", "pylon")


def pose_at(body: int, moment: float) -> tuple[np.ndarray, Rotation]:
    """Position [m] and orientation of a body: a slow walk on the spot."""
    phase = 2.0 * np.pi * 0.35 * moment + body
    position = np.array(
        [0.4 + 0.05 * np.sin(phase), -0.3 + 0.03 * np.cos(1.3 * phase), 0.7 + 0.2 * body]
    )
    return position, Rotation.from_rotvec([0.3 * np.sin(phase), 0.2 * body, 0.4 * np.cos(phase)])


def markers_at(
    body: int,
    moment: float,
    references: tuple[np.ndarray, ...] = TRIADS,
    pose: Callable[[int, float], tuple[np.ndarray, Rotation]] = pose_at,
) -> np.ndarray:
    """Markers of a body in the world, shape (m, 3) [m]."""
    position, rotation = pose(body, moment)
    return rotation.apply(references[body]) + position


def scene(moment: float):
    found = []
    for body, name in enumerate(NAMES):
        position, rotation = pose_at(body, moment)
        found.append((name, markers_at(body, moment), position, rotation.as_quat()))
    return found


def until(condition: Callable[[], bool], what: str = "it") -> float:
    """Wait for a condition with a deadline; how long it took, stalls of the machine apart [s]."""
    start = last = clocks.monotonic()
    took = 0.0
    pause = threading.Event()
    while not condition():
        assert last - start < HANGS, f"{what} did not come"
        pause.wait(_POLL)
        now = clocks.monotonic()
        took += min(now - last, 2.0 * _POLL)
        last = now
    return took


class Link:
    """A server with its faults, and a client of some settings whose frames go to a tracker."""

    def __init__(self, multicast=None, bodies=scene, client=True, settings=None, **server: Any):
        self.faults: dict[str, float] = {}
        self.frames: list[tuple[int, float]] = []
        self.server = NatNetServer(bodies, faults=self.faults, multicast=multicast, **server)
        host, port = self.server.address
        self.settings = MocapSettings(server=host, command_port=port)
        if multicast:
            group, port = multicast
            self.settings = replace(self.settings, interface=host, multicast=group, data_port=port)
        self.settings = replace(self.settings, **(settings or {}))
        self.tracker = BodyTracker(self.settings, *TRIADS)
        self.client = NatNetClient(self.settings, self.take)
        if client:
            self.client.start()

    def take(self, frame, moment, models):
        self.frames.append((frame.number, moment))
        self.tracker.add(frame, moment, models)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.client.close()
        self.server.close()

    def health(self) -> tuple[int, str]:
        return self.client.health(clocks.monotonic())

    def until_level(self, level: int, text: str = "") -> float:
        def reached() -> bool:
            now, message = self.health()
            return now == level and text in message

        return until(reached, f"level {level} '{text}'")

    def restart(self) -> None:
        sessions = self.client.figures()["sessions"]
        self.faults["mocap.restart"] = 1.0
        until(lambda: self.client.figures()["sessions"] > sessions, "a session")
        self.until_level(0)

    def worst(self) -> float:
        """The largest error of a marker, at a trigger from now or soon with both poses [m]."""
        deadline = clocks.monotonic() + HANGS
        while True:
            trigger = clocks.monotonic()
            assert trigger < deadline, "no sample came"
            self.tracker.wait(trigger, trigger + self.settings.stale)
            sample = self.tracker.sample(trigger)
            if not any(body.fault for body in sample):
                off = [body.markers - markers_at(n, trigger) for n, body in enumerate(sample)]
                return float(np.linalg.norm(off, axis=2).max())


def capture_by_hand(
    patch: pytest.MonkeyPatch,
    clock: FakeClock,
    sample: Callable[[float], Any],
    rate: float,
    uncertainty: float,
) -> SimpleNamespace:
    """Give `doctor` a client that is well, at a rate [Hz] with a clock known so well [s].

    `sample` is what its tracker sees at a time; waiting for it takes until the deadline.
    """
    client = SimpleNamespace(
        start=lambda: None,
        health=lambda now: (OK, ""),
        server="Motive 3.1",
        figures=lambda: {"rate": rate, "clock_uncertainty": uncertainty},
        close=lambda: None,
    )
    tracker = SimpleNamespace(
        add=None,
        wait=lambda trigger, deadline: clock.sleep(deadline - trigger),
        sample=sample,
    )
    patch.setattr(doctor, "NatNetClient", lambda settings, add: client)
    patch.setattr(doctor, "BodyTracker", lambda settings, *markers: tracker)
    return client
