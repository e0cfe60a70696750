"""What a trial's bag holds, put together by the stamp of the trigger; nothing by nearest."""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray, StatusArray
from socket_testbed.calibration import Status
from socket_testbed.errors import TrialError
from socket_testbed.trials.bag import RawMessage
from socket_testbed.trials.messages import decode, stamp_of
from socket_testbed.trials.topics import CAPACITANCE, PYLON_POSE, SOCKET_POSE, TRIGGER, WRENCH
from socket_testbed.trials.trial import Trial, required_topics


@dataclass(frozen=True)
class Measurements:
    """Measurements as they were recorded, one row a trigger; what is missing is NaN.

    Attributes:
        stamps: Times of the triggers since the epoch, shape (N,) [ns].
        wrench: Measured wrench [M; F], shape (N, 6) [N m, N].
        socket: Position [m] and quaternion (x, y, z, w) of the socket's body, shape (N, 7).
        pylon: The same of the pylon's body, shape (N, 7).
        clusters: Names of the c clusters.
        capacitance: Capacitances by the converter's input, shape (N, c, 4) [pF].
        status: Status of each of them, shape (N, c, 4).
    """

    stamps: IntArray
    wrench: FloatArray
    socket: FloatArray
    pylon: FloatArray
    clusters: tuple[str, ...]
    capacitance: FloatArray
    status: StatusArray


class _Column:
    """Values by stamp, packed: an hour at 100 Hz is 360,000 of them."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._stamps = array("q")
        self._values = array("d")

    def add(self, stamp: int, values: tuple[float, ...]) -> None:
        self._stamps.append(stamp)
        self._values.extend(values)

    @property
    def stamps(self) -> IntArray:
        return np.array(self._stamps, dtype=np.int64)

    def at(self, stamps: IntArray) -> FloatArray:
        """Rows for sorted stamps, NaN where there is none; a later one replaces an earlier."""
        rows = np.full((len(stamps), self._width), np.nan)
        rows[np.searchsorted(stamps, self.stamps)] = np.array(self._values).reshape(-1, self._width)
        return rows


def read_measurements(trial: Trial) -> Measurements:
    """Read all measurements of a trial.

    Raises:
        TrialError: If the trial cannot be read or lacks a topic.
    """
    widths = {TRIGGER: 0, WRENCH: 6, SOCKET_POSE: 7, PYLON_POSE: 7}
    columns = {topic: _Column(width) for topic, width in widths.items()}
    clusters: dict[str, _Column] = {}
    with trial.open() as bag:
        topics = required_topics(bag)
        names = {topics[topic]: topic for topic in topics if topic.required}
        for raw in bag.messages(names):
            topic = names[raw.topic]
            message = decode_message(trial, raw)
            stamp = stamp_of(message)
            if topic is CAPACITANCE:
                for cluster in message.clusters:
                    column = clusters.setdefault(cluster.name, _Column(8))
                    column.add(stamp, (*cluster.capacitance, *cluster.status))
            elif topic is WRENCH:
                columns[topic].add(stamp, wrench_vector(message.wrench))
            elif topic is TRIGGER:
                columns[topic].add(stamp, ())
            else:
                columns[topic].add(stamp, pose_vector(message.pose))
    every = [column.stamps for column in (*columns.values(), *clusters.values())]
    stamps = np.unique(np.concatenate(every))
    readings = np.array([column.at(stamps) for column in clusters.values()])
    readings = readings.reshape(len(clusters), len(stamps), 8).swapaxes(0, 1)
    status = np.nan_to_num(readings[:, :, 4:], nan=float(Status.MISSING))
    return Measurements(
        stamps=stamps,
        wrench=columns[WRENCH].at(stamps),
        socket=columns[SOCKET_POSE].at(stamps),
        pylon=columns[PYLON_POSE].at(stamps),
        clusters=tuple(clusters),
        capacitance=readings[:, :, :4],
        status=status.astype(np.uint8),
    )


def decode_message(trial: Trial, raw: RawMessage) -> Any:
    """A message of a trial.

    Raises:
        TrialError: If it cannot be decoded.
    """
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
