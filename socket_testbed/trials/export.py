"""Exports of a trial: the table of its samples, and files for other programs.

- `.mot`, `.sto`: the wrench of the limb on the socket as an OpenSim external load, in the frame of
  the load cell and about its origin or a given point: `socket_force_v*` [N], the point
  `socket_force_p*` [m], and `socket_torque_*` [N m]. In OpenSim, express it in the body that
  carries the load cell. Samples without a wrench are left out: OpenSim would stop reading there.
- `.trc`: the markers of the bodies in the motion-capture frame [mm]; an unseen one is `nan`, as
  OpenSim writes it.
- `.c3d`: both; the wrench as six analog channels, a gap as empty frames. Requires the library
  ezc3d.
- `.mcap`: `load_cell/wrench` (geometry_msgs/WrenchStamped), `mocap/*/pose` (PoseStamped), and a
  std_msgs/Float64 for every column of the table that `export` writes but stamps and statuses, such
  as `/distal/normal_Pa`, so that plotting tools need none of our message types.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from mcap.writer import Writer

from socket_testbed.arrays import BREAK, BoolArray, FloatArray, gaps, runs, usual_period
from socket_testbed.calibration.bench_data import STRESSES
from socket_testbed.calibration.model import Calibration
from socket_testbed.errors import ConfigurationError, TrialError, listed
from socket_testbed.files import TABLES, atomic_output, write_text
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples, moments_about
from socket_testbed.tables import split_unit
from socket_testbed.trials.bag import required_topics
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.synchronise import Measurements, marker_count, read_measurements
from socket_testbed.trials.trial import Trial
from socket_testbed.wire.cdr import typestore
from socket_testbed.wire.topics import MARKERS

_CDR_HEADER = b"\x00\x01\x00\x00"  # little endian
GAIT_FORMATS = (".mot", ".sto", ".trc", ".c3d")
EXPORT_FORMATS = (*TABLES, *GAIT_FORMATS, ".mcap")
_LOAD_COLUMNS = [f"socket_{name}{i}" for name in ("force_v", "force_p", "torque_") for i in "xyz"]


def sample_table(
    measured: Measurements,
    samples: Samples,
    calibration: Calibration,
    segment: Segment,
    predicted: FloatArray | None = None,
) -> pd.DataFrame:
    """The samples of a segment as a table, with the readings behind the clusters' forces.

    Args:
        measured: All measurements of the trial, corrected for drift.
        samples: All N samples of the trial; their moments may refer to any point.
        calibration: Gives the stresses; it must know all clusters of the samples.
        segment: The part of the trial that becomes the table.
        predicted: A model's predictions of all channels, shape (N, 6 + 3c) [N m, N], in the order
            of `Samples.channels`, which become columns `predicted.*`; None for none.

    Returns:
        A row per sample, with units in the titles: stamp [ns], time since the trial's first sample
        [s], wrench and limb pose in {S} [N m, N, m, rad]; for each cluster its capacitances by
        converter input [pF], its status (0 ok, 1 saturated, 2 missing, 3 out of the calibrated
        range), its stress along its own axes [Pa] and force in {L} [N]. Missing values are NaN.
    """
    table = samples.to_dataframe().iloc[segment.rows].reset_index()
    stamps = samples.stamps[segment.rows]
    capacitance, status = measured.capacitance[segment.rows], measured.status[segment.rows]
    of_clusters = tuple(f"{name}." for name in samples.clusters)
    shared = [title for title in table if not title.startswith(of_clusters)]
    columns: dict[str, Any] = {"stamp [ns]": stamps, **table[shared]}
    for number, name in enumerate(samples.clusters):
        readings = capacitance[:, number]
        stress, _ = calibration.clusters[name].apply(readings, status[:, number])
        columns |= {f"{name}.C{i} [pF]": readings[:, i] for i in range(4)}
        columns[f"{name}.status [-]"] = table[f"{name}.status [-]"]
        columns |= {f"{name}.{axis} [Pa]": stress[:, i] for i, axis in enumerate(STRESSES)}
        columns |= {title: table[title] for title in (f"{name}.{f} [N]" for f in LOCAL_CHANNELS)}
    if predicted is not None:
        for title, values in zip(samples.titles, predicted[segment.rows].T, strict=True):
            columns[f"predicted.{title}"] = values
    return pd.DataFrame(columns)


def write_gait_file(
    trial: Trial, rows: slice, path: Path, about: Sequence[float] | None = None
) -> pd.DataFrame:
    """Write some samples of a trial for motion analysis, see the module for the formats.

    Args:
        trial: The trial.
        rows: Rows of its samples to write.
        path: The file; its suffix, one of `GAIT_FORMATS`, gives the format.
        about: Point in {S} that the moments refer to, shape (3,) [m]; None for the origin.

    Returns:
        The written table, a row per sample, indexed by `time [s]` since the trial's first sample.
        `.mot` and `.sto`: the force of the limb on the socket [N], its point [m] and moment [N m],
        in {S}. `.trc`: the markers in the motion-capture frame [mm]. `.c3d`: the markers, then the
        wrench as six channels [N m, N]. Missing values are NaN; `.mot` and `.sto` have none, as
        their rows are those with a wrench. Its `attrs["notes"]` say what is missing, a line each.

    Raises:
        TrialError: For `.mot` and `.sto`, if no sample has a wrench; for `.trc` and `.c3d`, if the
            trial has no markers; for `.c3d` also if the rate changes within the rows or they are
            too many frames for the format.
        ConfigurationError: For `.c3d`, if the library ezc3d is not installed.
    """
    samples = trial.samples()
    time = pd.Index(samples.time[rows], name="time [s]")
    wrench = moments_about(samples.wrench[rows], about)
    suffix = path.suffix.lower()
    seconds = time.to_numpy()
    if suffix in {".mot", ".sto"}:
        places = np.broadcast_to(np.zeros(3) if about is None else about, (len(wrench), 3))
        loads = np.hstack([wrench[:, 3:], places, wrench[:, :3]])
        whole = np.isfinite(wrench).all(axis=1)
        if not whole.any():
            fact = f"{trial.path}: no sample of the segment has a wrench"
            raise TrialError(fact, "export another segment, or the markers as .trc")
        table = pd.DataFrame(loads[whole], columns=_LOAD_COLUMNS, index=time[whole])
        write_text(path, _storage(table))
        notes = missing_notes(seconds, wrench, "a wrench", _LEFT_OUT)
        table.attrs["notes"] = (*notes, *_pause_notes(seconds[whole]))
        return table
    labels, points = _markers(trial)
    columns = [f"{label}_{axis}" for label in labels for axis in "xyz"]
    table = pd.DataFrame(points[rows].reshape(len(time), -1), columns=columns, index=time)
    seen = table.to_numpy().mean(axis=1, keepdims=True)  # NaN if a marker is unseen
    notes = missing_notes(seconds, seen, "all markers", _UNSEEN)
    if suffix == ".trc":
        write_text(path, _markers_text(table, labels, path.name))
    else:
        table[list(WRENCH_CHANNELS)] = wrench
        empty = _write_c3d(path, table, labels)
        if empty:
            frames = "1 empty frame stands" if empty == 1 else f"{empty} empty frames stand"
            notes += (f"{frames} for times without samples",)
        notes += missing_notes(seconds, wrench, "a wrench", _AS_NAN)
    table.attrs["notes"] = notes
    return table


def write_standard_bag(
    measured: Measurements, rows: slice, table: pd.DataFrame, path: Path
) -> tuple[str, ...]:
    """Write some samples as one MCAP file of standard messages, without missing values.

    Returns:
        What is left out, one line each. Measured components of a wrench that lacks another one are
        still among the numbers of `table`.

    Args:
        measured: All measurements of the trial; wrenches [N m, N] and poses [m] are written.
        rows: Rows of the measurements to write.
        table: One row for each of them; every column of floats becomes a std_msgs/Float64 in the
            unit of its title.
        path: The file.
    """
    stamps = measured.stamps[rows].tolist()
    standard = [(topic, pack, vectors[rows]) for topic, pack, vectors in measured.packed()]
    numbers = table.select_dtypes("float")
    series = {_topic_name(title): values.to_numpy() for title, values in numbers.items()}
    with atomic_output(path) as staging, staging.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")

        def add_channels(message_type: str, topics: Iterable[str]) -> list[int]:
            text, _ = typestore().generate_msgdef(message_type, ros_version=2)
            schema = writer.register_schema(message_type, "ros2msg", text.encode())
            return [writer.register_channel(topic, "cdr", schema) for topic in topics]

        channels = [add_channels(topic.type, [f"/{topic.name}"])[0] for topic, _, _ in standard]
        numbered = add_channels("std_msgs/msg/Float64", series)
        columns = list(zip(numbered, series.values(), strict=True))
        for row, stamp in enumerate(stamps):
            for channel, (_, pack, vectors) in zip(channels, standard, strict=True):
                if np.isfinite(vectors[row]).all():
                    writer.add_message(channel, stamp, pack(stamp, vectors[row]), stamp)
            for channel, values in columns:
                if np.isfinite(values[row]):
                    data = _CDR_HEADER + struct.pack("<d", values[row])
                    writer.add_message(channel, stamp, data, stamp)
        writer.finish()  # type: ignore[no-untyped-call]
    return tuple(
        note
        for topic, _, vectors in standard
        for note in missing_notes(
            measured.time[rows], vectors, f"a complete {topic.name}", _LEFT_OUT
        )
    )


def missing_notes(
    time: FloatArray, values: FloatArray, what: str, fate: tuple[str, str]
) -> tuple[str, ...]:
    """A note on samples that lack values, with their number and the longest gap; none without any.

    Args:
        time: Times of the samples, ascending, shape (N,) [s].
        values: Their values in any unit, NaN where missing, shape (N, m).
        what: What they lack, such as `a wrench`.
        fate: What becomes of one in the file, and of several, such as `are left out`.
    """
    finite = np.isfinite(values)
    lacking: BoolArray = np.any(~finite, axis=1)
    if not lacking.any():
        return ()
    count, partly = int(lacking.sum()), int((finite.any(axis=1) & lacking).sum())
    # A gap reaches from the last complete sample to the next one, or to the end.
    ends = [(max(first - 1, 0), min(last, len(time) - 1)) for first, last in runs(lacking)]
    longest = max(time[after] - time[before] for before, after in ends)
    return (
        f"{_samples(count)} without {what} {fate[min(count, 2) - 1]}"
        + (f" ({partly} of them measured in part)" if partly else "")
        + f", the longest gap {_seconds(longest)} s",
    )


def _pause_notes(time: FloatArray) -> tuple[str, ...]:
    """A note on the pauses that OpenSim would bridge, if any, by times of samples, shape (N,)."""
    pauses = [
        f"{time[row]:.2f} s to {time[row + 1]:.2f} s" for row in np.flatnonzero(gaps(time, BREAK))
    ]
    if not pauses:
        return ()
    return (
        f"OpenSim draws a spline across the pause{'s' * (len(pauses) > 1)} from"
        f" {listed(pauses, _MAX_PAUSES)}: analyse the times before and after apart",
    )


def _samples(count: int) -> str:
    return "1 sample" if count == 1 else f"{count} samples"


def _seconds(duration: float) -> str:
    """A duration [s] to a tenth of a second, or a shorter one to two digits."""
    return f"{duration:.1f}" if duration >= 1.0 else f"{duration:.2g}"


def _topic_name(title: str) -> str:
    """Topic name from a column title: distal.normal [Pa] gives /distal/normal_Pa."""
    name, unit = (re.sub(r"[^\w.]+", "_", part) for part in split_unit(title))
    return "/" + f"{name.replace('.', '/')}_{unit}".strip("_")


def _markers(trial: Trial) -> tuple[list[str], FloatArray]:
    """Names of the m markers and their positions at every sample, shape (N, m, 3) [mm]."""
    with trial.open() as bag:
        more = [MARKERS] if bag.counts.get(required_topics(bag).get(MARKERS, "")) else []
        bodies = read_measurements(bag, lambda note: None, more=more).markers
    found = {
        f"{body}_{number}": 1e3 * seen[:, number - 1]
        for body, seen in bodies.items()
        for number in range(1, marker_count(seen) + 1)
    }
    if not found:
        raise TrialError(f"{trial.path}: has no markers", "export the wrench as .mot")
    return list(found), np.stack([*found.values()], axis=1)


_LEFT_OUT = ("is left out", "are left out")
_AS_NAN = ("is NaN in the file", "are NaN in the file")
_UNSEEN = ("holds NaN for those unseen", "hold NaN for those unseen")
_MAX_PAUSES = 3  # in a note
_MAX_OFF = 1.5  # frames; of a sample from its time, by jitter
_MAX_FRAMES = 65_535  # of a C3D file, whose header counts them in 16 bits


def _storage(table: pd.DataFrame) -> str:
    """The text of an OpenSim storage file."""
    columns = len(table.columns) + 1
    header = ["socket", "version=1", f"nRows={len(table)}", f"nColumns={columns}", "inDegrees=no"]
    rows = table.to_csv(sep="\t", index_label="time", float_format="%.6f")
    return "\n".join([*header, "endheader", rows])


def _markers_text(table: pd.DataFrame, labels: list[str], name: str) -> str:
    """The text of a TRC file.

    Unseen markers are `nan`: OpenSim refuses a row whose last one is blank.
    """
    count = len(table)
    rate = f"{1.0 / usual_period(table.index.to_numpy()):.6g}" if count > 1 else "1"
    fields = "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame"
    values = [rate, rate, count, len(labels), "mm", rate, 1, count]
    axes = [f"{axis}{k}" for k in range(1, len(labels) + 1) for axis in "XYZ"]
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        "\t".join([*fields.split(), "OrigNumFrames"]),
        "\t".join(map(str, values)),
        "\t".join(["Frame#", "Time", *(f"{label}\t\t" for label in labels)]),
        "\t".join(["", "", *axes]),
        "",
    ]
    rows = table.set_index([pd.RangeIndex(1, count + 1), table.index.map("{:.6f}".format)])
    return "\n".join(
        [*lines, rows.to_csv(sep="\t", float_format="%.4f", na_rep="nan", header=False)]
    )


def _write_c3d(path: Path, table: pd.DataFrame, labels: list[str]) -> int:
    """Write markers and wrench as C3D; returns the number of frames added for gaps in time."""
    try:
        import ezc3d
    except ImportError:
        raise ConfigurationError(
            f"{path}: needs the library ezc3d", "install it: pip install ezc3d"
        ) from None
    # The format has one rate and no times: a gap is empty frames.
    file, time = ezc3d.c3d(), table.index.to_numpy()
    usual = np.diff(time)[~gaps(time)]
    rate = 1.0 / usual.mean() if len(usual) else 1.0
    order, place = np.arange(len(time)), (time - time[0]) * rate
    frames = np.maximum.accumulate(np.round(place).astype(int) - order) + order  # each its own
    if np.abs(frames - place).max() > _MAX_OFF:
        raise TrialError(f"{path}: the rate changes within the segment", "export spans of one rate")
    if frames[-1] >= _MAX_FRAMES:
        fact = f"{path}: {frames[-1] + 1} frames are more than C3D holds ({_MAX_FRAMES})"
        raise TrialError(fact, "export a shorter segment")
    table = table.set_axis(frames).reindex(range(frames[-1] + 1))
    points = table.to_numpy()[:, : 3 * len(labels)].reshape(len(table), -1, 3)
    place = np.ones((4, len(labels), len(table)))
    place[:3] = points.transpose(2, 1, 0)
    for group, names, units in (
        ("POINT", labels, ["mm"]),
        ("ANALOG", list(WRENCH_CHANNELS), ["Nm"] * 3 + ["N"] * 3),
    ):
        for name, value in (("RATE", [rate]), ("LABELS", names), ("UNITS", units)):
            file["parameters"][group][name]["value"] = value
    file["data"]["points"] = place
    file["data"]["analogs"] = table[list(WRENCH_CHANNELS)].to_numpy().T[None]
    with atomic_output(path) as staging:
        written = staging.with_suffix(".c3d")  # the library appends this to any other suffix
        file.write(str(written))
        written.replace(staging)
    return len(table) - len(time)
