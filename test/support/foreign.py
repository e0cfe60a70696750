"""A bag as another laboratory records it: its own topics, stamps, rates and clocks."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.interpolate import make_interp_spline

from socket_testbed.alignment.align import align
from socket_testbed.alignment.series import PoseSeries, WrenchSeries
from socket_testbed.alignment.source_clock import source_clock
from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.calibration.model import read_calibration
from socket_testbed.files import packaged
from socket_testbed.geometry.marker_bodies import fit_body
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import read_socket
from socket_testbed.settings.alignment import SourceSettings
from socket_testbed.settings.options import Scenario
from socket_testbed.simulation import limb, sensors
from socket_testbed.simulation.trial import SimulatedTrial, random_streams, simulate
from socket_testbed.trials.bag import BagWriter
from socket_testbed.wire import cdr
from socket_testbed.wire.topics import Topic

WRENCH, SOCKET, LIMB = "/ft_sensor/wrench", "/vicon/socket/pose", "/vicon/limb/pose"
CAPACITANCES = "/clusters_uc"
TYPES = {
    WRENCH: "geometry_msgs/msg/WrenchStamped",
    SOCKET: "geometry_msgs/msg/PoseStamped",
    LIMB: "geometry_msgs/msg/PoseStamped",
    CAPACITANCES: "std_msgs/msg/Float64MultiArray",
}
_MARGIN = 1.0  # [s]; at either end of a trial, not judged


def header(stamp: int, frame: str) -> dict[str, Any]:
    sec, nanosec = divmod(stamp, 1_000_000_000)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def vector(values: Iterable[float], names: str = "xyz") -> dict[str, float]:
    return dict(zip(names, values, strict=True))


def wrench_fields(values: FloatArray) -> dict[str, Any]:
    """Fields of a Wrench from [M; F] [N m, N]."""
    return {"torque": vector(values[:3]), "force": vector(values[3:])}


def pose_fields(values: FloatArray) -> dict[str, Any]:
    """Fields of a Pose from position [m] and quaternion x, y, z, w."""
    return {"position": vector(values[:3]), "orientation": vector(values[3:], "xyzw")}


_RANDOM = np.random.default_rng(0)
_PERIODS = _RANDOM.uniform(0.6, 3.0, (12, 3))  # [s]; of pushes along three axes
_PHASES = _RANDOM.uniform(0.0, 6.0, (12, 3))


def pushes(time: FloatArray) -> FloatArray:
    """Brisk forces along three axes of which none is in step with another, shape (N, 3) [N]."""
    phases = 2.0 * np.pi * time[:, None, None] / _PERIODS + _PHASES
    return np.asarray(10.0 * np.sin(phases).sum(axis=1) + 20.0)


Messages = Iterable[tuple[int, dict[str, Any]]]
"""Times of arrival [ns], and the fields of the messages."""


def write_bag(path: Path, content: Mapping[str, tuple[str, Messages]]) -> Path:
    """Write a bag: types and messages by topic."""
    entries = [
        (time, name, cdr.encode(cdr.make_message(kind, **fields), kind))
        for name, (kind, messages) in content.items()
        for time, fields in messages
    ]
    with BagWriter(path) as bag:
        for name, (kind, _) in content.items():
            bag.add_topic(name, Topic(name, kind))
        for time, name, data in sorted(entries):
            bag.write(name, time, data)
    return path


@dataclass(frozen=True)
class ForeignLab:
    """How another laboratory measures.

    Attributes:
        wrench_delay: Delay of the wrench's stamps [s].
        jitter: Largest further delay of each of them [s].
        pose_drift: Drift of the clock of the cameras [-].
        wrench_rate: Rate of the wrench [Hz].
        pose_rate: Rate of the poses [Hz].
        cluster_rate: Rate of the capacitances [Hz].
    """

    wrench_delay: float = 0.02
    jitter: float = 0.003
    pose_drift: float = 50e-6
    wrench_rate: float = 500.0
    pose_rate: float = 100.0
    cluster_rate: float = 20.0

    @property
    def mean_delay(self) -> float:
        """Mean delay of the wrench's stamps [s]."""
        return self.wrench_delay + 0.5 * self.jitter


OUR_LAB = ForeignLab(wrench_delay=0.0, jitter=0.0, pose_drift=0.0, pose_rate=sensors.CAMERA_RATE)
"""How our own drivers measure: stamps without error."""


@dataclass(frozen=True)
class Readings:
    """What a source sends.

    Attributes:
        arrivals: When each reading is received, shape (N,) [ns].
        stamps: Its stamp by the source's clock, shape (N,) [ns]; None for a source without.
        values: A wrench [M; F], a pose as `Pose.vector`, or capacitances, shape (N, k).
    """

    arrivals: IntArray
    stamps: IntArray | None
    values: FloatArray


def course_of(trial: SimulatedTrial, values: FloatArray, at: FloatArray) -> FloatArray:
    """Values at times since the first trigger [s], linear between triggers."""
    since = (trial.stamps - trial.stamps[0]) * 1e-9
    return np.asarray(make_interp_spline(since, values, k=1)(at))


def measure(trial: SimulatedTrial, lab: ForeignLab, seed: int = 0) -> dict[str, Readings]:
    """What a laboratory's sources send of a simulated trial, by topic.

    The noise of wrench and markers is that of the simulated drivers, at their rates.
    """
    geometry = read_socket(packaged("config", "socket.yaml"))
    errors = sensors.SensorErrors()
    random = np.random.default_rng(seed + 1000)
    start, end = int(trial.stamps[0]), (trial.stamps[-1] - trial.stamps[0]) * 1e-9

    def every(hz: float) -> FloatArray:
        return np.arange(0.0, end, 1.0 / hz)

    def stamps(times: FloatArray) -> IntArray:
        return start + np.round(1e9 * times).astype(np.int64)

    truth = trial.truth
    at = every(lab.wrench_rate)
    values = course_of(trial, truth.wrench, at)
    values += random.normal(0.0, 1.0, values.shape) * errors.wrench_noise(1.0 / lab.wrench_rate)
    late = stamps(at + lab.wrench_delay + random.uniform(0.0, lab.jitter, len(at)))
    sent = {WRENCH: Readings(late + 200_000, late, values)}
    at = every(lab.pose_rate)
    bodies = sensors.MarkerBodies(geometry, errors, random_streams(seed)[4])
    motion = [course_of(trial, v, at) for v in (truth.position, truth.rotation, truth.wrench)]
    own = stamps(at * (1.0 + lab.pose_drift))
    arrivals = stamps(at + random.exponential(0.0005, len(at)))
    for topic, body, pose in zip((SOCKET, LIMB), geometry.markers, bodies.poses(*motion),
                                 strict=True):  # fmt: skip
        markers = geometry.markers[body]
        seen = sensors.observe_markers(pose, markers, errors, random)
        fitted = fit_body(markers, seen).pose.vector
        known = np.isfinite(fitted).all(axis=1)
        sent[topic] = Readings(arrivals[known], own[known], fitted[known])
    at = every(lab.cluster_rate)
    capacitance = np.hstack([course_of(trial, v, at) for v in trial.capacitance.values()])
    sent[CAPACITANCES] = Readings(stamps(at), None, capacitance)
    return sent


def errors_of(
    trial: SimulatedTrial,
    lab: ForeignLab,
    rate: float,
    seed: int,
    corrected: float | None = None,
) -> FloatArray:
    """Errors of a force [N] and of a coordinate of the limb in the socket's body [um], shape (2,).

    Args:
        trial: The truth.
        lab: How the sources measure it.
        rate: Rate of the triggers [Hz].
        seed: That of the trial; of its bodies and the noise.
        corrected: Delay of the wrench that is corrected [s]; None for its mean delay.
    """
    sent = measure(trial, lab, seed)
    end = (trial.stamps[-1] - trial.stamps[0]) * 1e-9 - _MARGIN
    at = np.arange(_MARGIN, end, 1.0 / rate)
    triggers = trial.stamps[0] + np.round(1e9 * at).astype(np.int64)
    settings = SourceSettings(delay=lab.mean_delay if corrected is None else corrected)
    found = align(WrenchSeries(*_ascending(sent[WRENCH])), triggers, settings, 1.0 / rate)
    force = found.values[:, 3:] - course_of(trial, trial.truth.wrench, at)[:, 3:]
    poses = [_poses_at(triggers, sent[topic], rate) for topic in (SOCKET, LIMB)]
    truth = trial.truth
    motion = [course_of(trial, v, at) for v in (truth.position, truth.rotation, truth.wrench)]
    geometry = read_socket(packaged("config", "socket.yaml"))
    bodies = sensors.MarkerBodies(geometry, sensors.SensorErrors(), random_streams(seed)[4])
    true = bodies.poses(*motion)
    moved = (poses[0].inverse() @ poses[1]).translation
    position = 1e6 * (moved - (true[0].inverse() @ true[1]).translation)
    return np.array([np.sqrt(np.nanmean(own**2)) for own in (force, position)])


def _poses_at(triggers: IntArray, sent: Readings, rate: float) -> Pose:
    times, values = _ascending(sent)
    series = PoseSeries(times, values[:, :3], values[:, 3:])
    return Pose.from_vector(align(series, triggers, SourceSettings(), 1.0 / rate).values)


def _ascending(sent: Readings) -> tuple[IntArray, FloatArray]:
    """Times on the recording's clock [ns], and values."""
    assert sent.stamps is not None
    clock = source_clock(sent.stamps, sent.arrivals)
    times = clock.to_recording(sent.stamps) if clock.is_another else sent.stamps
    order = np.argsort(times, kind="stable")
    return times[order], sent.values[order]


def simulate_foreign(
    path: Path,
    scenario: Scenario = "protocol",
    duration: float = 60.0,
    seed: int = 0,
    lab: ForeignLab | None = None,
    rate: float = 50.0,
    pace: float = 1.0,
) -> SimulatedTrial:
    """Write a foreign bag of a simulated trial; returns the truth, linear between its triggers.

    The noise of wrench and markers is that of the simulated drivers. The hands push `pace` times
    faster than those of the scenario.
    """
    geometry = read_socket(packaged("config", "socket.yaml"))
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    errors = sensors.SensorErrors(force_offset=0.0, moment_offset=0.0)
    with patch.object(limb, "_HAND_PERIODS", limb._HAND_PERIODS / pace):
        trial = simulate(geometry, calibration, scenario, duration, rate, seed, errors)
    sent = measure(trial, lab or ForeignLab(), seed)
    write_bag(path, {topic: (TYPES[topic], _messages(topic, own)) for topic, own in sent.items()})
    return trial


def _messages(topic: str, readings: Readings) -> Messages:
    stamps = readings.arrivals if readings.stamps is None else readings.stamps
    rows = zip(readings.arrivals.tolist(), stamps.tolist(), readings.values, strict=True)
    for arrival, stamp, values in rows:
        if topic == WRENCH:
            fields = {"header": header(stamp, "ft_sensor"), "wrench": wrench_fields(values)}
        elif topic == CAPACITANCES:
            fields = {"data": values.tolist()}
        else:
            fields = {"header": header(stamp, "world"), "pose": pose_fields(values)}
        yield arrival, fields
