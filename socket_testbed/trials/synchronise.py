"""Samples of a trial: the recorded values, put together by the stamp of the trigger.

`read_measurements` puts the recorded values in rows, one per trigger. `correct_measurements`
removes the drift of the clusters, if spans without load are known. `make_samples` computes the
stresses and forces, with a calibration, and the limb position. `sample_table` shows the values of
every step. `Trial.samples` does it all with the trial's own configuration.
"""

from __future__ import annotations

import dataclasses
import math
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import median_filter

from socket_testbed.arrays import FloatArray, IntArray, StatusArray
from socket_testbed.calibration.bench_data import STRESSES
from socket_testbed.calibration.drift import (
    DRIFT_LIMIT,
    Drift,
    average_baseline,
    correct_drift,
    measure_drift,
)
from socket_testbed.calibration.model import Calibration
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.samples import LOCAL_CHANNELS, Samples, Status, channel_unit
from socket_testbed.trials.bag import BagReader, decode_message, required_topics, stamp_of
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.topics import CAPACITANCE, PYLON_POSE, SOCKET_POSE, TRIGGER, WRENCH

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Measurements:
    """Measurements as they were recorded, one row per trigger; what is missing is NaN.

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

    @property
    def time(self) -> FloatArray:
        """Time since the first trigger, shape (N,) [s]."""
        return (self.stamps - self.stamps[0]) * 1e-9


_NAMED = 3  # how many stamps a note names
_IMPOSSIBLE = 1e6  # [N m, N, m, pF]; no sensor of the testbed reads it


class _Series:
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


def read_measurements(
    bag: BagReader, notify: Callable[[str], None], duration: float = math.inf
) -> Measurements:
    """Read the measurements of a bag.

    Args:
        bag: The bag, open.
        notify: Called with a note on stamps that jump back, and on stamps that a topic holds more
            than once.
        duration: How much of the recording is read, from its first measurement [s].

    Raises:
        TrialError: If the bag cannot be read or lacks a topic.
    """
    widths = {TRIGGER: 0, WRENCH: 6, SOCKET_POSE: 7, PYLON_POSE: 7}
    columns = {topic: _Series(width) for topic, width in widths.items()}
    clusters: dict[str, _Series] = {}
    topics = required_topics(bag)
    names = {topics[topic]: topic for topic in topics if topic.required}
    end = math.inf
    for raw in bag.messages(names):
        end = min(end, raw.time + 1e9 * duration)
        if raw.time > end:
            break
        topic = names[raw.topic]
        message = decode_message(raw, bag.path)
        stamp = stamp_of(message)
        if topic is CAPACITANCE:
            for cluster in message.clusters:
                column = clusters.setdefault(cluster.name, _Series(8))
                column.add(stamp, (*cluster.capacitance, *cluster.status))
        elif topic is WRENCH:
            columns[topic].add(stamp, wrench_vector(message.wrench))
        elif topic is TRIGGER:
            columns[topic].add(stamp, ())
        else:
            columns[topic].add(stamp, pose_vector(message.pose))
    every = {topic.name: column.stamps for topic, column in columns.items()}
    every |= {name: column.stamps for name, column in clusters.items()}
    every = {name: stamps for name, stamps in every.items() if len(stamps)}  # not at the beginning
    for note in _stamp_notes(every):
        notify(note)
    stamps = np.unique(np.concatenate([*every.values()]))
    readings = np.array([column.at(stamps) for column in clusters.values()])
    readings = readings.reshape(len(clusters), len(stamps), 8).swapaxes(0, 1)
    status = np.nan_to_num(readings[:, :, 4:], nan=float(Status.MISSING))
    tables = {topic.name: columns[topic].at(stamps) for topic in (WRENCH, SOCKET_POSE, PYLON_POSE)}
    tables |= {CAPACITANCE.name: readings[:, :, :4]}
    for name, values in tables.items():
        impossible = np.abs(values) > _IMPOSSIBLE
        if impossible.any():
            values[impossible] = np.nan
            notify(
                f"{name} holds {int(impossible.sum())} values beyond {_IMPOSSIBLE:g}, which count"
                " as missing: check the recording"
            )
    return Measurements(
        stamps=stamps,
        wrench=tables[WRENCH.name],
        socket=tables[SOCKET_POSE.name],
        pylon=tables[PYLON_POSE.name],
        clusters=tuple(clusters),
        capacitance=tables[CAPACITANCE.name],
        status=status.astype(np.uint8),
    )


def _stamp_notes(every: dict[str, IntArray]) -> Iterator[str]:
    """Notes on stamps out of order and on doubled stamps.

    Args:
        every: Stamps of each topic or cluster in the order of recording [ns].
    """
    first = min(int(stamps.min()) for stamps in every.values())
    backward: dict[str, list[str]] = {}
    doubled: dict[str, list[str]] = {}
    for name, stamps in every.items():
        time = (stamps - first) * 1e-9
        back = np.flatnonzero(np.diff(stamps) < 0)
        if len(back):
            jumps = [f"from {time[i]:.2f} s to {time[i + 1]:.2f} s" for i in back[:_NAMED]]
            backward.setdefault(_listed(jumps, len(back)), []).append(name)
        values, counts = np.unique(stamps, return_counts=True)
        again = (values[counts > 1] - first) * 1e-9
        if len(again):
            times = [f"at {at:.2f} s" for at in again[:_NAMED]]
            lost = int((counts - 1).sum())
            text = f"{_listed(times, len(again))}: {lost} earlier values are replaced by later ones"
            doubled.setdefault(text, []).append(name)
    for text, names in backward.items():
        yield (
            f"the stamps of {', '.join(names)} jump back, {text}; samples are in the order of their"
            " stamps: check the clock of the recording"
        )
    for text, names in doubled.items():
        yield f"the stamps of {', '.join(names)} are doubled, {text}"


def _listed(parts: list[str], count: int) -> str:
    more = f" and {count - len(parts)} more" if count > len(parts) else ""
    times = "once" if count == 1 else f"{count} times"
    return f"{times} ({', '.join(parts)}{more})"


def wrench_vector(wrench: Any) -> tuple[float, ...]:
    """[M; F] of a Wrench message [N m, N]."""
    torque, force = wrench.torque, wrench.force
    return (torque.x, torque.y, torque.z, force.x, force.y, force.z)


def pose_vector(pose: Any) -> tuple[float, ...]:
    """Position [m] and quaternion (x, y, z, w) of a Pose message."""
    p, q = pose.position, pose.orientation
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)


def correct_measurements(
    measured: Measurements,
    spans: Sequence[tuple[float, float]],
    calibration: Calibration,
    least_force: float,
    where: str,
    notify: Callable[[str], None],
) -> Measurements:
    """Bring the clusters' readings to the baseline of their calibration.

    The drift is linear between two spans without load. The baseline of a calibration
    is that of an unloaded cluster. If it stores none, or the load cell measured a load in the
    first span (a pylon alone has a weight, too), only the drift since the first span is corrected.

    Args:
        measured: The measurements of a trial.
        spans: One or two spans without load, since the first sample [s].
        calibration: Calibration of the clusters.
        least_force: Force that is a load [N].
        where: Name of the trial in an error.
        notify: Called with the drift between two spans, a large one flagged, and with what is not
            corrected.

    Raises:
        CalibrationError: If a span holds too few readings of a cluster.
        TrialError: If the load cell measured clearly more in a span than at its least load.
    """
    loads = _loads_without_load(measured, spans, least_force, where)
    stored = any(calibration.clusters[name].baseline is not None for name in measured.clusters)
    free = not loads or loads[0] <= least_force
    if not free and stored:
        start, end = spans[0]
        notify(
            f"the load cell measured {loads[0]:.0f} N in {start:g}:{end:g}, so the stored baseline"
            " of the clusters is not used: only their drift since then is corrected"
        )
    time = measured.time
    capacitance = measured.capacitance.copy()
    unchanged = []
    for column, name in enumerate(measured.clusters):
        readings = capacitance[:, column]
        baselines = [
            average_baseline(
                0.5 * (start + end),
                readings[(time >= start) & (time <= end)],
                f"{where}: {name} from {start:g} s to {end:g} s",
            )
            for start, end in spans
        ]
        cluster = calibration.clusters[name]
        before, after = baselines[0], baselines[1] if len(baselines) > 1 else None
        reference = cluster.baseline if free else None
        capacitance[:, column] = correct_drift(readings, time, before, after, reference)
        if after is not None:
            notify(f"{name} {_describe(measure_drift(cluster, before, after))}")
        elif reference is None:
            unchanged.append(name)
    if unchanged:
        notify(
            f"one span without load and no stored baseline in use: the drift of"
            f" {', '.join(unchanged)} is not corrected: give a second span, after the load"
        )
    return dataclasses.replace(measured, capacitance=capacitance)


_REST = 1.0  # [s]; what is shorter is no rest


def _loads_without_load(
    measured: Measurements, spans: Sequence[tuple[float, float]], least_force: float, where: str
) -> list[float]:
    """Median force in every span [N], nothing if none is known; a loaded span is refused."""
    force = np.linalg.norm(measured.wrench[:, 3:], axis=1)
    known = np.isfinite(force)
    time, force = measured.time[known], force[known]
    if len(force) == 0:
        return []
    width = max(3, int(_REST * len(time) / max(float(time[-1] - time[0]), _REST)))
    steady = median_filter(force, width, mode="nearest")
    least = float(steady.min())
    loads = []
    for start, end in spans:
        within = force[(time >= start) & (time <= end)]
        load = float(np.median(within)) if len(within) else least
        if load > least + least_force:
            raise TrialError(
                f"{where}: {start:g}:{end:g} is not without load, the load cell measured"
                f" {load:.0f} N there",
                f"give a span as at {time[steady.argmin()]:.1f} s, where it measured {least:.0f} N",
            )
        loads.append(load)
    return loads


def _describe(drift: Drift) -> str:
    normal, shear_x, shear_y = 1e-3 * drift.stress
    flag = f", more than {1e-3 * DRIFT_LIMIT:g} kPa" if drift.flagged else ""
    return (
        f"drifted by {normal:+.2f} kPa normal, {shear_x:+.2f} and {shear_y:+.2f} kPa shear without"
        f" load, corrected{flag}"
    )


def make_samples(
    measured: Measurements, calibration: Calibration, geometry: SocketGeometry
) -> Samples:
    """Samples from the corrected measurements of a trial, whose clusters both others know."""
    local_forces, status = _local_forces(measured, calibration, geometry)
    socket, pylon = (
        Pose.from_quaternion(pose[:, :3], pose[:, 3:]) for pose in (measured.socket, measured.pylon)
    )
    limb = geometry.limb_pose(socket, pylon)
    return Samples(
        stamps=measured.stamps,
        position=limb.translation,
        rotation=limb.rotation_vector(),
        wrench=measured.wrench,
        clusters=measured.clusters,
        local_forces=local_forces,
        status=status,
    )


def _local_forces(
    measured: Measurements, calibration: Calibration, geometry: SocketGeometry
) -> tuple[FloatArray, StatusArray]:
    shape = (len(measured.stamps), len(measured.clusters))
    forces = np.full((*shape, 3), np.nan)
    status = np.full(shape, Status.MISSING, dtype=np.uint8)
    for column, name in enumerate(measured.clusters):
        stress, status[:, column] = calibration.clusters[name].apply(
            measured.capacitance[:, column], measured.status[:, column]
        )
        forces[:, column] = geometry.cluster_force(name, stress)
    return forces, status


_SHARED = 1 + 6 + 6  # columns besides the clusters': time, wrench, the limb's pose


def sample_table(
    measured: Measurements,
    samples: Samples,
    calibration: Calibration,
    segment: Segment,
    predicted: FloatArray | None = None,
) -> pd.DataFrame:
    """The samples of a trial as a table, with what the clusters' forces were computed from.

    Args:
        measured: All that was measured, corrected for drift.
        samples: All samples made of it.
        calibration: Calibration of the clusters.
        segment: Which of them are wanted.
        predicted: What a model predicts for all samples, added as `predicted.*`; see
            `predict_channels`.

    Returns:
        A row per sample, with the units in the titles: stamp [ns], time since the trial's first
        sample [s], wrench and the limb's pose in {S}; for each cluster its capacitances by the
        converter's input [pF], its status (0 ok, 1 saturated, 2 missing, 3 out of the calibrated
        range), its stress along its own axes [Pa] and force in {L} [N]. NaN where there is none.
    """
    import pandas as pd

    table = samples.to_dataframe().iloc[segment.rows].reset_index()
    stamps = samples.stamps[segment.rows]
    capacitance, status = measured.capacitance[segment.rows], measured.status[segment.rows]
    columns: dict[str, Any] = {"stamp [ns]": stamps, **table.iloc[:, :_SHARED]}
    for number, name in enumerate(samples.clusters):
        readings = capacitance[:, number]
        stress, _ = calibration.clusters[name].apply(readings, status[:, number])
        columns |= {f"{name}.C{i} [pF]": readings[:, i] for i in range(4)}
        columns[f"{name}.status [-]"] = table[f"{name}.status [-]"]
        columns |= {f"{name}.{axis} [Pa]": stress[:, i] for i, axis in enumerate(STRESSES)}
        columns |= {title: table[title] for title in (f"{name}.{f} [N]" for f in LOCAL_CHANNELS)}
    if predicted is not None:
        for channel, values in zip(samples.channels, predicted[segment.rows].T, strict=True):
            columns[f"predicted.{channel} [{channel_unit(channel)}]"] = values
    return pd.DataFrame(columns)


def check_unloaded(spans: tuple[tuple[float, float], ...]) -> None:
    """Refuse spans without load that are more than two, reversed, overlapping or out of order.

    Args:
        spans: Their starts and ends [s].

    Raises:
        ConfigurationError: Naming the spans.
    """
    if len(spans) > 2:
        raise ConfigurationError(
            f"--unloaded has {len(spans)} spans", "give one before, or one before and one after"
        )
    for start, end in spans:
        if not start < end:
            raise ConfigurationError(
                f"--unloaded is '{start:g}:{end:g}'", "give seconds as T0:T1, with T0 before T1"
            )
    if len(spans) == 2 and not spans[0][1] < spans[1][0]:
        first, second = (f"{start:g}:{end:g}" for start, end in spans)
        raise ConfigurationError(
            f"--unloaded: {second} does not begin after {first}",
            "give the span before the load first, the one after it second",
        )


def parse_unloaded(spans: list[str]) -> tuple[tuple[float, float], ...]:
    """Spans without load written as `T0:T1`, in seconds since the trial's first sample.

    Raises:
        ConfigurationError: If one is none, or they are wrong together: see `check_unloaded`.
    """
    parsed = tuple(_parse(span) for span in spans)
    check_unloaded(parsed)
    return parsed


def _parse(span: str) -> tuple[float, float]:
    try:
        start, end = (float(part) for part in span.split(":"))
    except ValueError:
        raise ConfigurationError(
            f"--unloaded is '{span}'", "give seconds as T0:T1, with T0 before T1"
        ) from None
    return start, end
