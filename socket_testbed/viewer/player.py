"""A trial as the page shows it: played, paused, sought, with nothing estimated beforehand.

The beginning is read before the page opens, the rest while it plays. The map, the prediction and
the outputs by region are computed for the instant that is drawn.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.errors import TestbedError
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.regions import all_regions
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import ForceMap, map_trial
from socket_testbed.identification.model_file import StoredModel
from socket_testbed.identification.noise import smooth_poses
from socket_testbed.identification.plausibility import require_position
from socket_testbed.identification.pressure import THRESHOLD, measured_rows, pressure_outputs
from socket_testbed.samples import Samples, Status
from socket_testbed.trials.bag import required_topics
from socket_testbed.trials.topics import TRIGGER
from socket_testbed.trials.trial import Trial
from socket_testbed.viewer.source import HISTORY, Instant, Playback, RegionsNow, SensorState

_AT_ONCE = 3000  # samples, read before the page opens
_TINY = 1e-6  # [s]; rounding of the samples' times
_GAP = 3.0  # usual steps between samples; a longer one is a gap
_RATE_OVER = 5.0  # [s] up to the position, over which rates are counted
_REGIONS_EVERY = 1.0  # [s] at least between joint draws
_WORDS = {
    Status.OK: "measures",
    Status.SATURATED: "saturated",
    Status.MISSING: "missing",
    Status.OUT_OF_RANGE: "outside the calibrated range",
}


@dataclass(frozen=True, eq=False)
class _Part:
    """A trial, read from its start to some time."""

    samples: Samples  # N samples as recorded
    time: FloatArray  # their times since the first one, shape (N,) [s]
    gap: float  # time after a sample from which on there is a gap [s]
    trusted: Samples  # the samples without single outliers and channels that are left out
    poses: FloatArray  # the limb's poses as the model takes them, shape (N, 6) [m, rad]
    socket: Pose  # poses of {S} in the world, N of them
    limb: Pose  # poses of the limb in the world, N of them
    map: ForceMap  # the force map of the samples' clusters
    # Statuses (`Status`) of every sensor by its name, shape (N,) each
    sensors: dict[str, StatusArray]


class Player:
    """A trial, played: a `Source` of the page.

    Args:
        trial: The trial.
        model: Predicts the wrench; None for no prediction.
        now: The time [s].
    """

    controls = None  # a recorded trial has no services

    def __init__(
        self,
        trial: Trial,
        model: StoredModel | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.geometry: SocketGeometry = trial.geometry
        if model is not None:
            model.require_socket(trial.geometry)
        self._trial, self._model, self._now = trial, model, now
        self._places = all_regions(trial.geometry, trial.metadata.side)
        with trial.open() as bag:
            duration, triggers = bag.duration, bag.counts[required_topics(bag)[TRIGGER]]
        long = triggers > 2 * _AT_ONCE and not trial.needs_all
        self._part = self._read(duration * _AT_ONCE / triggers if long else math.inf)
        # At the end of the part, measurements of the last trigger may be missing.
        end = float(self._part.time[-2 if long else -1])
        self.playback = Playback(end, now)
        self.playback.limit(end, duration if long else end, self._events())
        self._reading = ""  # how far it is, in words
        if long:
            self._reading = f"the first {end:.0f} s are read, the rest is being read"
            threading.Thread(target=self._read_on, name="read", daemon=True).start()
        self._shown: Instant | None = None
        self._regions: RegionsNow | None = None
        self._next_regions = -math.inf

    def instant(self) -> Instant:
        """The sample at the position, the same object again until there is another one."""
        part, position = self._part, self.playback.position
        row = _row_at(part, position)
        if position - part.time[row] > part.gap:
            self._shown = None
            unknown = np.full(6, np.nan)
            stamp = int(part.samples.stamps[0]) + round(1e9 * position)
            return Instant(stamp, position, None, unknown, unknown, None, None)
        stamp = int(part.samples.stamps[row])
        if self._shown is None or self._shown.stamp != stamp:
            trusted = part.trusted
            known = bool(measured_rows(trusted[row : row + 1])[0])
            self._shown = Instant(
                stamp=stamp,
                time=float(part.time[row]),
                map=part.map.estimate(trusted[row : row + 1]) if known else None,
                wrench=part.samples.wrench[row],
                predicted=self._predicted(part, slice(row, row + 1))[0],
                socket_in_world=_pose_at(part.socket, row),
                limb_in_world=_pose_at(part.limb, row),
            )
        return self._shown

    def wrenches(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Times, measured and predicted wrenches of the 30 s before the position."""
        part, position = self._part, self.playback.position
        first = int(np.searchsorted(part.time, position - HISTORY, "right"))
        rows = slice(first, _row_at(part, position) + 1)
        return part.time[rows], part.samples.wrench[rows], self._predicted(part, rows)

    def sensors(self) -> list[SensorState]:
        """The state of every sensor at the position, and its missing values over the trial."""
        part, position = self._part, self.playback.position
        states = [_sensor_state(part, name, position) for name in part.sensors]
        if self._reading:
            states.insert(0, SensorState(self._trial.name, 1, self._reading, math.nan, 0.0))
        return states

    def recording(self) -> None:
        """Nothing is recorded."""

    def regions(self) -> RegionsNow | None:
        """The standard outputs of the sample at the position."""
        if self._now() < self._next_regions:
            return self._regions
        part = self._part
        row = _row_at(part, self.playback.position)
        at = float(part.time[row])
        instant = part.trusted[row : row + 1]
        if self._regions is None or self._regions.time != at:
            self._regions = None
            if measured_rows(instant)[0]:
                found = pressure_outputs(part.map, instant, self.geometry, self._places, THRESHOLD)
                self._regions = RegionsNow(at, self._places, found.regions)
            self._next_regions = self._now() + _REGIONS_EVERY
        return self._regions

    def watched(self, on: bool) -> None:
        """Nothing to switch off: values are computed when they are drawn."""

    def _read(self, duration: float) -> _Part:
        """Read the trial from its start, for so long [s]."""
        trial, geometry, model = self._trial, self.geometry, self._model
        measured = trial.measurements(duration)
        samples = trial.samples_of(measured)
        bodies = (measured.socket, measured.pylon)
        socket, pylon = (Pose.from_quaternion(body[:, :3], body[:, 3:]) for body in bodies)
        if model is not None:
            require_position(samples, geometry)
        smoothing = 0.0 if model is None else model.settings.pose_smoothing
        settings = trial.estimator
        period = float(np.median(np.diff(samples.time))) if len(samples) > 1 else 0.0
        force_map, trusted = map_trial(
            samples, geometry, settings.force_map, settings.identification.leave_out
        )
        return _Part(
            samples=samples,
            time=samples.time,
            gap=_GAP * period,
            trusted=trusted,
            poses=smooth_poses(samples, smoothing).pose,
            socket=socket @ geometry.socket_body.inverse(),
            limb=pylon @ geometry.limb,
            map=force_map,
            sensors={
                "load cell": _missing(samples.wrench),
                **{name: samples.status[:, i] for i, name in enumerate(samples.clusters)},
                "socket pose": _missing(measured.socket),
                "pylon pose": _missing(measured.pylon),
            },
        )

    def _read_on(self) -> None:
        """Read all of the trial; the page goes on meanwhile."""
        try:
            self._part = part = self._read(math.inf)
        except TestbedError as error:
            self._reading = f"only the first {self._part.time[-1]:.0f} s are read: {error}"
            return
        end = float(part.time[-1])
        self.playback.limit(end, end, self._events())
        self._reading = ""

    def _events(self) -> list[tuple[float, str]]:
        events = self._trial.events_of(self._part.samples)
        return [(event.time, event.label) for event in events]

    def _predicted(self, part: _Part, rows: slice) -> FloatArray:
        """Predicted wrenches of some samples, shape (k, 6) [N m, N]."""
        if self._model is None:
            return np.full((rows.stop - rows.start, 6), np.nan)
        return self._model.model.wrench(part.poses[rows])


def _row_at(part: _Part, position: float) -> int:
    """The newest sample at a time [s]."""
    return max(int(np.searchsorted(part.time, position + _TINY, "right")) - 1, 0)


def _pose_at(poses: Pose, row: int) -> Pose | None:
    """One of several poses; None if it is not known."""
    pose = Pose(poses.rotation[row], poses.translation[row])
    known = np.isfinite(pose.rotation).all() and np.isfinite(pose.translation).all()
    return pose if known else None


def _missing(values: FloatArray) -> StatusArray:
    """The status of samples by whether all values of the row are there, shape (N,)."""
    missing = ~np.isfinite(values).all(axis=1)
    return np.where(missing, Status.MISSING, Status.OK).astype(np.uint8)


def _sensor_state(part: _Part, name: str, position: float) -> SensorState:
    """How a sensor is at a time [s], and how much it measured over the trial."""
    row = _row_at(part, position)
    statuses = part.sensors[name]
    fine = statuses == Status.OK
    start = int(np.searchsorted(part.time, position - _RATE_OVER))
    recent = part.time[start : row + 1][fine[start : row + 1]]
    before = np.flatnonzero(fine[: row + 1])
    age = position - float(part.time[before[-1]] if len(before) else part.time[0])
    silent = position - float(part.time[row])
    level = 0 if fine[row] else 1
    words = _WORDS[Status(int(statuses[row]))]
    if silent > part.gap:
        level, words = 2, f"not triggered for {silent:.1f} s"
    if not fine.all():
        words += f"; without a value at {int((~fine).sum())} of {len(fine)} triggers"
    rate = (len(recent) - 1) / np.ptp(recent) if len(recent) > 1 else math.nan
    return SensorState(name, level, words, float(rate), age)
