"""Samples of a trial: the recorded values, put together by the stamp of the trigger.

`read_measurements` puts the recorded values in rows, one per trigger. `correct_measurements`
removes the drift of the clusters, if spans without load are known. `make_samples` computes the
stresses and forces, with the trial's calibration, and the limb position. `read_samples` does all
of it, and `sample_table` shows the values of every step.
"""

from __future__ import annotations

import dataclasses
from array import array
from collections.abc import Collection, Iterator
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
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.geometry.pose import Pose
from socket_testbed.samples import LOCAL_CHANNELS, Samples, Status, channel_unit
from socket_testbed.trials.bag import RawMessage, decode, stamp_of
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.topics import CAPACITANCE, PYLON_POSE, SOCKET_POSE, TRIGGER, WRENCH
from socket_testbed.trials.trial import Trial, check_unloaded, required_topics

if TYPE_CHECKING:
    import pandas as pd


def read_samples(trial: Trial) -> Samples:
    """Read a trial as synchronised samples, one per trigger.

    The stresses are computed from the capacitances with the trial's calibration.

    Args:
        trial: The trial.

    Returns:
        Samples in the order of their stamps; what is missing at a trigger is NaN.

    Raises:
        TrialError: If the trial cannot be read or lacks a topic.
        CalibrationError: If the calibration lacks a cluster of the trial, or a span without load
            holds too few readings.
        ConfigurationError: If the stored configuration is wrong.
    """
    return make_samples(trial, correct_measurements(trial, read_measurements(trial)))


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


def read_measurements(trial: Trial) -> Measurements:
    """Read all measurements of a trial.

    The trial reports stamps that jump back, and stamps that a topic holds more than once.

    Raises:
        TrialError: If the trial cannot be read or lacks a topic.
    """
    widths = {TRIGGER: 0, WRENCH: 6, SOCKET_POSE: 7, PYLON_POSE: 7}
    columns = {topic: _Series(width) for topic, width in widths.items()}
    clusters: dict[str, _Series] = {}
    with trial.open() as bag:
        topics = required_topics(bag)
        names = {topics[topic]: topic for topic in topics if topic.required}
        for raw in bag.messages(names):
            topic = names[raw.topic]
            message = _decode(trial, raw)
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
    if trial.notify is not None:
        for note in _stamp_notes(every):
            trial.notify(note)
    stamps = np.unique(np.concatenate([*every.values()]))
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


def correct_measurements(trial: Trial, measured: Measurements) -> Measurements:
    """Bring the clusters' readings to the baseline of their calibration.

    The drift is linear between the trial's two spans without load. The baseline of a calibration
    is that of an unloaded cluster. If it stores none, or the load cell measured a load in the
    first span (a pylon alone has a weight, too), only the drift since the first span is corrected.
    The trial reports the drift between two spans, flags a large one, and reports what is not
    corrected.

    Args:
        trial: The trial, with its spans without load.
        measured: Its measurements.

    Returns:
        The corrected measurements; without a span those that were given.

    Raises:
        CalibrationError: If a span holds too few readings of a cluster, or the calibration lacks
            a cluster.
        TrialError: If the load cell measured clearly more in a span than at its least load.
    """
    if not trial.unloaded:
        return measured
    _require_clusters(measured.clusters, trial)
    free = _require_unloaded(trial, measured)
    time = measured.time
    capacitance = measured.capacitance.copy()
    notify = trial.notify or _ignore
    unchanged = []
    for column, name in enumerate(measured.clusters):
        readings = capacitance[:, column]
        baselines = [
            average_baseline(
                0.5 * (start + end),
                readings[(time >= start) & (time <= end)],
                f"{trial.path}: {name} from {start:g} s to {end:g} s",
            )
            for start, end in trial.unloaded
        ]
        cluster = trial.calibration.clusters[name]
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


def _require_unloaded(trial: Trial, measured: Measurements) -> bool:
    """Refuse a span that the load cell contradicts.

    Returns:
        Whether the clusters were free of load in the first span.
    """
    force = np.linalg.norm(measured.wrench[:, 3:], axis=1)
    known = np.isfinite(force)
    time, force = measured.time[known], force[known]
    if len(force) == 0:
        return True
    width = max(3, int(_REST * len(time) / max(float(time[-1] - time[0]), _REST)))
    steady = median_filter(force, width, mode="nearest")
    least = float(steady.min())
    limit = trial.estimator.plateau.least_force  # [N]; less is no load
    loads = []
    for start, end in trial.unloaded:
        within = force[(time >= start) & (time <= end)]
        load = float(np.median(within)) if len(within) else least
        if load > least + limit:
            raise TrialError(
                f"{trial.path}: {start:g}:{end:g} is not without load, the load cell measured"
                f" {load:.0f} N there",
                f"give a span as at {time[steady.argmin()]:.1f} s, where it measured {least:.0f} N",
            )
        loads.append(load)
    baselines = [trial.calibration.clusters[name].baseline for name in measured.clusters]
    free = loads[0] <= limit
    if not free and trial.notify is not None and any(b is not None for b in baselines):
        start, end = trial.unloaded[0]
        trial.notify(
            f"the load cell measured {loads[0]:.0f} N in {start:g}:{end:g}, so the stored baseline"
            " of the clusters is not used: only their drift since then is corrected"
        )
    return free


def _ignore(note: str) -> None:
    pass


def _describe(drift: Drift) -> str:
    normal, shear_x, shear_y = 1e-3 * drift.stress
    flag = f", more than {1e-3 * DRIFT_LIMIT:g} kPa" if drift.flagged else ""
    return (
        f"drifted by {normal:+.2f} kPa normal, {shear_x:+.2f} and {shear_y:+.2f} kPa shear without"
        f" load, corrected{flag}"
    )


def make_samples(trial: Trial, measured: Measurements) -> Samples:
    """Samples from the corrected measurements of a trial; see `read_samples`."""
    _require_clusters(measured.clusters, trial)
    local_forces, status = _local_forces(trial, measured)
    socket, pylon = (
        Pose.from_quaternion(pose[:, :3], pose[:, 3:]) for pose in (measured.socket, measured.pylon)
    )
    limb = trial.geometry.limb_pose(socket, pylon)
    return Samples(
        stamps=measured.stamps,
        position=limb.translation,
        rotation=limb.rotation_vector(),
        wrench=measured.wrench,
        clusters=measured.clusters,
        local_forces=local_forces,
        status=status,
    )


def _local_forces(trial: Trial, measured: Measurements) -> tuple[FloatArray, StatusArray]:
    shape = (len(measured.stamps), len(measured.clusters))
    forces = np.full((*shape, 3), np.nan)
    status = np.full(shape, Status.MISSING, dtype=np.uint8)
    for column, name in enumerate(measured.clusters):
        stress, status[:, column] = trial.calibration.clusters[name].apply(
            measured.capacitance[:, column], measured.status[:, column]
        )
        forces[:, column] = trial.geometry.cluster_force(name, stress)
    return forces, status


def _require_clusters(clusters: Collection[str], trial: Trial) -> None:
    trial.calibration.require(clusters, f"the trial {trial.path}")
    for name in clusters:
        if name not in trial.geometry.clusters:
            raise TrialError(
                f"{trial.path}: its cluster '{name}' is on no tile of the socket"
                f" (which has {', '.join(trial.geometry.clusters)})",
                "give the socket.yaml of this trial with --geometry",
            )


_SHARED = 1 + 6 + 6  # columns besides the clusters': time, wrench, the limb's pose


def sample_table(
    trial: Trial,
    measured: Measurements,
    samples: Samples,
    segment: Segment,
    predicted: FloatArray | None = None,
) -> pd.DataFrame:
    """The samples of a trial as a table, with what the clusters' forces were computed from.

    Args:
        trial: The trial.
        measured: All that was measured, corrected for drift.
        samples: All samples made of it.
        segment: Which of them are wanted.
        predicted: What a model predicts for all samples, added as `predicted.*`; see
            `predict_channels`.

    Returns:
        A row per sample, with the units in the titles: stamp [ns], time since the trial's first
        sample [s], wrench and the limb's pose in {S}; for each cluster its capacitances by the
        converter's input [pF], its status (0 ok, 1 saturated, 2 missing, 3 out of the calibrated
        range), and its stress [Pa] and force [N] in its own frame. NaN where there is none.
    """
    import pandas as pd

    table = samples.to_dataframe().iloc[segment.rows].reset_index()
    stamps = samples.stamps[segment.rows]
    capacitance, status = measured.capacitance[segment.rows], measured.status[segment.rows]
    columns: dict[str, Any] = {"stamp [ns]": stamps, **table.iloc[:, :_SHARED]}
    for number, name in enumerate(samples.clusters):
        readings = capacitance[:, number]
        stress, _ = trial.calibration.clusters[name].apply(readings, status[:, number])
        columns |= {f"{name}.C{i} [pF]": readings[:, i] for i in range(4)}
        columns[f"{name}.status [-]"] = table[f"{name}.status [-]"]
        columns |= {f"{name}.{axis} [Pa]": stress[:, i] for i, axis in enumerate(STRESSES)}
        columns |= {title: table[title] for title in (f"{name}.{f} [N]" for f in LOCAL_CHANNELS)}
    if predicted is not None:
        for channel, values in zip(samples.channels, predicted[segment.rows].T, strict=True):
            columns[f"predicted.{channel} [{channel_unit(channel)}]"] = values
    return pd.DataFrame(columns)


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
