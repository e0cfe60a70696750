"""A bag as another laboratory records it: its own topics, stamps, rates and clocks."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.interpolate import make_interp_spline

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.calibration.model import read_calibration
from socket_testbed.files import packaged
from socket_testbed.geometry.marker_bodies import fit_body
from socket_testbed.geometry.socket import read_socket
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
_CELL_SPAN = 0.25  # [s]; of the mean to which the noise of the simulated load cell refers


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
    lab = lab or ForeignLab()
    geometry = read_socket(packaged("config", "socket.yaml"))
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    errors = sensors.SensorErrors(force_offset=0.0, moment_offset=0.0)
    with patch.object(limb, "_HAND_PERIODS", limb._HAND_PERIODS / pace):
        trial = simulate(geometry, calibration, scenario, duration, rate, seed, errors)
    since = (trial.stamps - trial.stamps[0]) * 1e-9
    random = np.random.default_rng(seed + 1000)
    start = int(trial.stamps[0])

    def course(values: FloatArray, at: FloatArray) -> FloatArray:
        return np.asarray(make_interp_spline(since, values, k=1)(at))

    def every(hz: float) -> FloatArray:
        return np.arange(0.0, since[-1], 1.0 / hz)

    def stamps(times: FloatArray) -> IntArray:
        return start + np.round(1e9 * times).astype(np.int64)

    truth = trial.truth
    at = every(lab.wrench_rate)
    values = course(truth.wrench, at)
    values += random.normal(0.0, 1.0, values.shape) * errors.wrench_noise(1.0 / lab.wrench_rate)
    late = stamps(at + lab.wrench_delay + random.uniform(0.0, lab.jitter, len(at)))
    wrench = [
        (s + 200_000, {"header": header(s, "ft_sensor"), "wrench": wrench_fields(v)})
        for s, v in zip(late.tolist(), values, strict=True)
    ]
    at = every(lab.pose_rate)
    bodies = sensors.MarkerBodies(geometry, errors, random_streams(seed)[4])
    motion = [course(v, at) for v in (truth.position, truth.rotation, truth.wrench)]
    own = stamps(at * (1.0 + lab.pose_drift))
    arrival = stamps(at + random.exponential(0.0005, len(at)))
    poses = {}
    for name, body, pose in zip((SOCKET, LIMB), geometry.markers, bodies.poses(*motion),
                                strict=True):  # fmt: skip
        markers = geometry.markers[body]
        seen = sensors.observe_markers(pose, markers, errors, random)
        fitted = fit_body(markers, seen).pose.vector
        poses[name] = [
            (a, {"header": header(s, "world"), "pose": pose_fields(v)})
            for a, s, v in zip(arrival.tolist(), own.tolist(), fitted, strict=True)
            if np.isfinite(v).all()
        ]
    at = every(lab.cluster_rate)
    capacitance = np.hstack([course(v, at) for v in trial.capacitance.values()])
    clusters = [
        (s, {"data": v.tolist()}) for s, v in zip(stamps(at).tolist(), capacitance, strict=True)
    ]
    messages = {WRENCH: wrench, **poses, CAPACITANCES: clusters}
    write_bag(path, {name: (TYPES[name], messages[name]) for name in TYPES})
    return trial
