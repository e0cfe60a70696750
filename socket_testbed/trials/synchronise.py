"""Measurements put together by the stamp of their trigger; nothing is matched by nearest."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray, StatusArray
from socket_testbed.calibration import Status
from socket_testbed.errors import TrialError
from socket_testbed.geometry.pose import Pose
from socket_testbed.samples import Samples
from socket_testbed.trials.bag import RawMessage
from socket_testbed.trials.messages import decode, stamp_of
from socket_testbed.trials.topics import CAPACITANCE, PYLON_POSE, SOCKET_POSE, TRIGGER, WRENCH
from socket_testbed.trials.trial import Trial, required_topics


@dataclass
class _Columns:
    """What each topic said, by the stamp of the trigger [ns]."""

    triggers: dict[int, None] = field(default_factory=dict)
    wrench: dict[int, tuple[float, ...]] = field(default_factory=dict)
    socket_pose: dict[int, tuple[float, ...]] = field(default_factory=dict)
    pylon_pose: dict[int, tuple[float, ...]] = field(default_factory=dict)
    capacitance: dict[int, dict[str, tuple[Any, Any]]] = field(default_factory=dict)


def check_trial(trial: Trial) -> tuple[str, ...]:
    """Refuse a trial that cannot be worked on, before long work or a graph is started.

    Returns:
        Names of the trial's clusters.

    Raises:
        TrialError: If the trial cannot be read or lacks a topic.
        CalibrationError: If the calibration lacks a cluster of the trial.
        ConfigurationError: If the stored configuration is wrong.
    """
    with trial.open() as bag:
        name = required_topics(bag)[CAPACITANCE]
        first = next(bag.messages([name]))
    clusters = tuple(cluster.name for cluster in _decode(trial, first).clusters)
    _require_clusters(clusters, trial)
    return clusters


def read_samples(trial: Trial) -> Samples:
    """Read a trial as synchronised samples, one a trigger.

    The stresses are computed anew from the capacitances with the trial's calibration.

    Args:
        trial: The trial.

    Returns:
        Samples in the order of their stamps; what is missing at a trigger is NaN.

    Raises:
        TrialError: If the trial cannot be read or lacks a topic.
        CalibrationError: If the calibration lacks a cluster of the trial.
        ConfigurationError: If the stored configuration is wrong.
    """
    columns = _read_columns(trial)
    stamps = np.array(
        sorted(
            columns.triggers.keys()
            | columns.wrench.keys()
            | columns.socket_pose.keys()
            | columns.pylon_pose.keys()
            | columns.capacitance.keys()
        ),
        dtype=np.int64,
    )
    socket = _poses(columns.socket_pose, stamps)
    pylon = _poses(columns.pylon_pose, stamps)
    clusters, local_forces, status = _local_forces(columns, stamps, trial)
    return Samples(
        stamps=stamps,
        position=trial.geometry.limb_position(socket, pylon),
        wrench=_table(columns.wrench, stamps, 6),
        clusters=clusters,
        local_forces=local_forces,
        status=status,
    )


def _read_columns(trial: Trial) -> _Columns:
    columns = _Columns()
    with trial.open() as bag:
        topics = required_topics(bag)
        names = {topics[topic]: topic for topic in topics if topic.required}
        for raw in bag.messages(names):
            topic = names[raw.topic]
            message = _decode(trial, raw)
            stamp = stamp_of(message)
            if topic is TRIGGER:
                columns.triggers[stamp] = None
            elif topic is WRENCH:
                columns.wrench[stamp] = wrench_vector(message.wrench)
            elif topic is SOCKET_POSE:
                columns.socket_pose[stamp] = pose_vector(message.pose)
            elif topic is PYLON_POSE:
                columns.pylon_pose[stamp] = pose_vector(message.pose)
            elif topic is CAPACITANCE:
                columns.capacitance[stamp] = {
                    cluster.name: (cluster.capacitance, cluster.status)
                    for cluster in message.clusters
                }
    return columns


def _decode(trial: Trial, raw: RawMessage) -> Any:
    try:
        return decode(raw.data, raw.type)
    except Exception as error:  # the library raises whatever the bytes lead it to
        raise TrialError(
            f"{trial.path}: a message on {raw.topic} cannot be decoded ({error})",
            "check that the trial was recorded with this version's messages",
        ) from None


def wrench_vector(wrench: Any) -> tuple[float, ...]:
    """[M; F] of a Wrench message [N m, N]."""
    torque, force = wrench.torque, wrench.force
    return (torque.x, torque.y, torque.z, force.x, force.y, force.z)


def pose_vector(pose: Any) -> tuple[float, ...]:
    """Position [m] and quaternion (x, y, z, w) of a Pose message."""
    p, q = pose.position, pose.orientation
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)


def _table(values: dict[int, tuple[float, ...]], stamps: IntArray, width: int) -> FloatArray:
    missing = (float("nan"),) * width
    return np.array([values.get(stamp, missing) for stamp in stamps.tolist()]).reshape(-1, width)


def _poses(values: dict[int, tuple[float, ...]], stamps: IntArray) -> Pose:
    table = _table(values, stamps, 7)
    return Pose.from_quaternion(table[:, :3], table[:, 3:])


def _local_forces(
    columns: _Columns, stamps: IntArray, trial: Trial
) -> tuple[tuple[str, ...], FloatArray, StatusArray]:
    clusters = tuple(
        dict.fromkeys(name for entry in columns.capacitance.values() for name in entry)
    )
    _require_clusters(clusters, trial)
    forces = np.full((len(stamps), len(clusters), 3), np.nan)
    status = np.full((len(stamps), len(clusters)), Status.MISSING, dtype=np.uint8)
    unread = (np.full(4, np.nan), np.full(4, Status.MISSING, dtype=np.uint8))
    for column, name in enumerate(clusters):
        readings = [
            columns.capacitance.get(stamp, {}).get(name, unread) for stamp in stamps.tolist()
        ]
        stress, status[:, column] = trial.calibration.clusters[name].apply(
            np.array([capacitance for capacitance, _ in readings]),
            np.array([channel_status for _, channel_status in readings]),
        )
        forces[:, column] = trial.geometry.cluster_force(name, stress)
    return clusters, forces, status


def _require_clusters(clusters: Collection[str], trial: Trial) -> None:
    trial.calibration.require(clusters, f"the trial {trial.path}")
    for name in clusters:
        if name not in trial.geometry.clusters:
            raise TrialError(
                f"{trial.path}: its cluster '{name}' is on no tile of the socket"
                f" (which has {', '.join(trial.geometry.clusters)})",
                "give the socket.yaml of this trial with --geometry",
            )
