"""The content of the page as plain data, and the two kinds of sources behind it.

A `Source` is a running testbed or a trial. The page asks it for what it draws, while a browser is
open, from the thread that draws.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.regions import Region
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.pressure import RegionOutputs

HISTORY = 30.0  # [s]; of the wrenches that a source keeps
_FASTEST, _SLOWEST = 100.0, 0.01  # [-]; speeds


@dataclass(frozen=True, eq=False)
class Instant:
    """The newest sample."""

    stamp: int  # since the epoch [ns]
    time: float  # the same since the first sample [s]
    map: MapEstimate | None  # the force map, with N = 1; None while there is none
    # Measured wrench [M; F] in {S}, shape (6,) [N m, N]; NaN where it is missing
    wrench: FloatArray
    predicted: FloatArray  # predicted wrench, likewise
    socket_in_world: Pose | None  # pose of {S} in the world; None where the socket is not tracked
    limb_in_world: Pose | None  # pose of the limb in the world; None where the limb is not tracked


@dataclass(frozen=True)
class SensorState:
    """The state of a sensor, or of a node that works on its data."""

    name: str
    level: int  # 0 ok, 1 warning, 2 error
    words: str  # its state in words
    rate: float  # how often it measures [Hz]; NaN where that is not known
    age: float  # how long ago it last reported [s]


@dataclass(frozen=True)
class Recording:
    """A trial that is being recorded."""

    trial: str  # its name; empty while none is being recorded
    elapsed: float  # how long it has been recorded [s]
    free: float  # free space on its disk [bytes]; NaN where that is not known


@dataclass(frozen=True, eq=False)
class RegionsNow:
    """The standard outputs of the newest sample."""

    time: float  # time of the sample since the first one [s]
    places: tuple[Region, ...]  # the R regions; the last one is the socket
    outputs: RegionOutputs  # their outputs, shape (R,)


class Controls(Protocol):
    """The services of a running testbed.

    Each returns its outcome in one line, or raises a TestbedError.
    """

    def tare(self) -> str:
        """Tare the load cell."""

    def fit(self) -> str:
        """Fit the contact model."""

    def record(self, name: str, metadata: dict[str, str]) -> str:
        """Record a trial with this name, empty for one by the time, and this metadata."""

    def stop_recording(self) -> str:
        """Close the trial that is being recorded."""

    def event(self, label: str) -> str:
        """Mark an event."""

    def trigger(self, on: bool) -> str:
        """Switch the trigger on or off."""


class Playback:
    """The position in a trial that is played in real time, paused and sought."""

    def __init__(self, duration: float, now: Callable[[], float] = time.monotonic) -> None:
        self.duration = duration  # from the first sample to the last [s]
        self.speed = 1.0  # [-]; 1 is as recorded
        self.events: list[tuple[float, str]] = []  # times [s] and labels
        self._now = now
        self._playing = False
        self._end = duration  # [s]; as far as it has been read
        self._anchor, self._since = 0.0, now()  # the position when it was last set, and that time
        self._lock = threading.RLock()

    def limit(self, end: float, duration: float, events: list[tuple[float, str]]) -> None:
        """Go no farther than the trial has been read [s]; duration and events as far as known."""
        with self._lock:
            self.seek(self.position)
            self._end, self.duration, self.events = end, duration, events

    @property
    def position(self) -> float:
        """Time since the first sample [s]."""
        with self._lock:
            run = (self._now() - self._since) * self.speed if self._playing else 0.0
            if self._anchor + run >= self._end:  # wait for the reader
                self.seek(self._end)
                self._playing = self._playing and self._end < self.duration
                return self._anchor
            return self._anchor + run

    @property
    def playing(self) -> bool:
        """Whether it is played on; not at the end."""
        _ = self.position  # at the end it stops
        return self._playing

    def seek(self, time: float) -> None:
        """Go to a time since the first sample, or to the nearest that has been read [s]."""
        with self._lock:
            self._anchor = min(max(time, 0.0), self._end)
            self._since = self._now()

    def play(self) -> None:
        """Play on; from the start at the end."""
        with self._lock:
            self.seek(0.0 if self.position >= self.duration else self.position)
            self._playing = True

    def pause(self) -> None:
        """Stay at the position."""
        with self._lock:
            self.seek(self.position)
            self._playing = False

    def set_speed(self, speed: float) -> None:
        """Set the speed, 0.01 to 100 times that of the recording [-]."""
        with self._lock:
            self.seek(self.position)
            self.speed = min(max(speed, _SLOWEST), _FASTEST)


class Source(Protocol):
    """A running testbed or a trial.

    Attributes:
        geometry: Geometry of the socket.
        controls: What its services do; None where it has none, or none may be called.
        playback: How it is played; None if it is a running testbed.
    """

    @property
    def geometry(self) -> SocketGeometry: ...  # noqa: D102
    @property
    def controls(self) -> Controls | None: ...  # noqa: D102
    @property
    def playback(self) -> Playback | None: ...  # noqa: D102

    def instant(self) -> Instant | None:
        """The newest sample; None before the first."""

    def wrenches(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The last `HISTORY` seconds.

        Returns:
            Times since the first sample, shape (N,) [s], ascending; measured and predicted
            wrenches [M; F], shape (N, 6) each [N m, N], NaN where they are missing.
        """

    def sensors(self) -> list[SensorState]:
        """The state of every sensor."""

    def recording(self) -> Recording | None:
        """The trial that is being recorded; None where nothing can be."""

    def regions(self) -> RegionsNow | None:
        """The standard outputs by region, computed anew at most once a second."""

    def watched(self, on: bool) -> None:
        """The first browser was opened, or the last one was closed."""
