"""Samples of a trial: recorded values, matched by trigger timestamp.

`read_measurements` arranges the recorded values in rows, one per trigger; `reprocess` may replace
some. `make_samples` computes the stresses and forces, with a calibration, and the limb position.
`Trial.samples` does all of this with the trial's own configuration.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from socket_testbed.arrays import FloatArray, IntArray, StatusArray
from socket_testbed.calibration.model import Calibration
from socket_testbed.errors import TrialError, listed
from socket_testbed.geometry.marker_bodies import MAX_MARKERS
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.samples import Samples, Status
from socket_testbed.trials.bag import BagReader, required_topics
from socket_testbed.trials.bag_parts import MAX_APART
from socket_testbed.wire import topics
from socket_testbed.wire.messages import Reader, VectorPacker, pose_packer, wrench_packer


@dataclass(frozen=True)
class Measurements:
    """Measurements as recorded, one row per trigger; missing values are NaN.

    Attributes:
        stamps: Times of the triggers since the epoch, ascending, shape (N,) [ns].
        wrench: Force and moment of the limb on the socket, tared, [M; F] in {S}, shape (N, 6)
            [N m, N].
        socket: Position [m] and quaternion (x, y, z, w) of the socket's marker body in the world,
            shape (N, 7).
        pylon: Position [m] and quaternion (x, y, z, w) of the pylon's marker body in the world,
            shape (N, 7).
        clusters: Names of the c clusters.
        capacitance: By converter input, shape (N, c, 4) [pF].
        status: `Status` of each capacitance, shape (N, c, 4).
        ratios: Ratios of the load cell's bridges, shape (N, 6) [mV/V]; shape (0, 6) unless
            requested.
        tares: What was subtracted from the wrenches, [M; F] in {S}, shape (N, 6) [N m, N]; shape
            (0, 6) unless requested.
        tared: When each of these tares was taken, since the epoch, shape (N,) [ns]; 0 without a
            tare or a reading; shape (0,) unless requested.
        markers: Markers in the world by body, shape (N, k, 3) [m], with k the largest number that
            any body may have; rows beyond a body's own number are NaN. Empty unless requested.
    """

    stamps: IntArray
    wrench: FloatArray
    socket: FloatArray
    pylon: FloatArray
    clusters: tuple[str, ...]
    capacitance: FloatArray
    status: StatusArray
    ratios: FloatArray
    tares: FloatArray
    tared: IntArray
    markers: dict[str, FloatArray]

    @property
    def time(self) -> FloatArray:
        """Time since the first trigger, shape (N,) [s]."""
        return (self.stamps - self.stamps[0]) * 1e-9

    def without_raw(self) -> Measurements:
        """The measurements without ratios, tares and markers, which only their check needs."""
        nothing, never = np.empty((0, 6)), np.empty(0, np.int64)
        return replace(self, ratios=nothing, tares=nothing, tared=never, markers={})

    def packed(self) -> tuple[tuple[topics.Topic, VectorPacker, FloatArray], ...]:
        """Topic, packer of a row, and rows of the wrenches (N, 6) and of the poses (N, 7)."""
        return (
            (topics.WRENCH, wrench_packer(), self.wrench),
            (topics.SOCKET_POSE, pose_packer(), self.socket),
            (topics.PYLON_POSE, pose_packer(), self.pylon),
        )


_BLOCK_SIZE = 10_000  # [samples]; bounds the memory for rotation matrices
_MAX_LISTED = 3  # stamps in a note
_WIDTHS = {topics.WRENCH: 6, topics.SOCKET_POSE: 7, topics.PYLON_POSE: 7}
_MISSING = {"f": np.nan, "i": 0, "u": Status.MISSING}  # by the kind of number
_MISSING_TOPICS = {
    topics.LOAD_CELL_RAW: ("its wrenches cannot be recomputed", "leave out --load-cell and --tare"),
    topics.MARKERS: (
        "its poses cannot be refitted to other markers",
        "give --geometry with the trial's own",
    ),
}
_MAX_VALUE = 1e6  # [N m, N, m, pF]; beyond any sensor of the testbed

_Columns: TypeAlias = list[NDArray[Any]]
"""Columns of values in recording order; the first holds stamps [ns]."""


def read_measurements(
    bag: BagReader, notify: Callable[[str], None], more: Collection[topics.Topic] = ()
) -> Measurements:
    """Read the measurements of a bag; a row for each stamp on any required topic.

    Args:
        bag: The open bag.
        notify: Called with one line on missing poses, on messages that cannot be decoded, on
            impossible values, and on stamps that are far off, jump back or occur more than once in
            a topic.
        more: Topics to read in addition, of LOAD_CELL_RAW (fills `ratios`, `tares` and `tared`) and
            MARKERS (fills `markers`).

    Raises:
        TrialError: If the bag cannot be read, or lacks a required topic other than a pose or one of
            `more`.
    """
    recorded = required_topics(bag)
    if not all(bag.counts.get(recorded.get(topic, "")) for topic in topics.POSES.values()):
        notify("the trial has no limb positions: a fit and the limb's motion need them")
        more = set(more) - {topics.MARKERS}
    for topic in more:
        if not bag.counts.get(recorded.get(topic, "")):
            why, hint = _MISSING_TOPICS[topic]
            raise TrialError(f"{bag.path}: holds no '{topic.name}', so {why}", hint)
    wanted = {recorded[t]: t for t in recorded if t.required or t in more}
    series = _read_series(bag, wanted, notify)
    _drop_strays(series, notify)
    clusters = tuple(name for topic, name in series if topic is topics.CAPACITANCE)
    for note in _stamp_notes(series):
        notify(note)
    stamps = np.empty(0, dtype=np.int64)
    for (topic, _), (found, *_) in series.items():
        # Most are equal, and a union is slow.
        if topic.required and not np.array_equal(found, stamps):
            stamps = np.union1d(stamps, found)
    capacitance = np.empty((len(stamps), len(clusters), 4))
    status = np.empty(capacitance.shape, dtype=np.uint8)
    for number, name in enumerate(clusters):
        own = series.pop((topics.CAPACITANCE, name))
        capacitance[:, number], status[:, number] = _rows(own, stamps)
    tables = {topics.CAPACITANCE: capacitance}
    for topic, width in _WIDTHS.items():
        nothing = [np.empty(0, dtype=np.int64), np.empty((0, width))]
        (tables[topic],) = _rows(series.pop((topic, topic.name), nothing), stamps)
    raw: _Columns = [np.empty((0, 6)), np.empty((0, 6)), np.empty((0, 1), dtype=np.int64)]
    if topics.LOAD_CELL_RAW in more:
        key = topics.LOAD_CELL_RAW, topics.LOAD_CELL_RAW.name
        raw = _rows(series.pop(key, [np.empty(0, dtype=np.int64), *raw]), stamps)
    ratios, tares, tared = raw
    for topic, values in tables.items():
        impossible = (values > _MAX_VALUE) | (values < -_MAX_VALUE)
        if impossible.any():
            values[impossible] = np.nan
            notify(
                f"{topic.name} holds {int(impossible.sum())} values beyond {_MAX_VALUE:g}, which"
                " count as missing: check the recording"
            )
    return Measurements(
        stamps=stamps,
        wrench=tables[topics.WRENCH],
        socket=tables[topics.SOCKET_POSE],
        pylon=tables[topics.PYLON_POSE],
        clusters=clusters,
        capacitance=capacitance,
        status=status,
        ratios=ratios,
        tares=tares,
        tared=tared[:, 0],
        markers={
            name: _rows(own, stamps)[0].reshape(-1, MAX_MARKERS, 3)
            for (topic, name), own in series.items()
            if topic is topics.MARKERS
        },
    )


def marker_count(seen: FloatArray) -> int:
    """Number of a body's markers: up to the last one ever seen, from an array (N, k, 3) [m]."""
    return int(np.flatnonzero(np.isfinite(seen).any(axis=(0, 2))).max(initial=-1)) + 1


def _read_series(
    bag: BagReader, wanted: dict[str, topics.Topic], notify: Callable[[str], None]
) -> dict[tuple[topics.Topic, str], _Columns]:
    """Recorded columns by topic and name: of a cluster, a body, or the topic itself."""
    readers = {topic: Reader(topic, bag.path) for topic in wanted.values()}
    parts: dict[tuple[topics.Topic, str], list[_Columns]] = defaultdict(list)
    for topic_name, messages in bag.blocks(wanted):
        topic = wanted[topic_name]
        found: dict[str, list[_Columns]] = defaultdict(list)
        for places, stamps, values in readers[topic].parts(messages):
            for name, columns in _columns(topic, values):
                found[name].append([places, stamps, *columns])
        for name, own in found.items():
            places, *columns = _joined(own)
            order = np.argsort(places, kind="stable")
            parts[topic, name].append([column[order] for column in columns])
    for topic, reader in readers.items():
        if reader.refused:
            if not any(own is topic for own, _ in parts):
                raise reader.refused[0]
            notify(f"{len(reader.refused)} times {reader.refused[0]}: left out")
    return {key: _joined(parts.pop(key)) for key in list(parts)}


def _joined(parts: list[_Columns]) -> _Columns:
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


def _columns(topic: topics.Topic, values: Any) -> Iterator[tuple[str, _Columns]]:
    """Values of messages, one row each, by name of the cluster, body or topic."""
    if topic is topics.CAPACITANCE:
        for number, name in enumerate(values.names):
            yield name, [values.capacitance[:, number], values.status[:, number]]
    elif topic is topics.LOAD_CELL_RAW:
        yield topic.name, [values.ratios, values.tare, values.tared[:, np.newaxis]]
    elif topic is topics.MARKERS:
        for name, markers in values:
            seen = np.full((len(markers), MAX_MARKERS, 3), np.nan)
            own = markers[:, :MAX_MARKERS]  # another program's body may have more
            seen[:, : own.shape[1]] = own
            yield name, [seen.reshape(len(markers), -1)]
    else:
        yield topic.name, [] if topic is topics.TRIGGER else [values]


def _rows(columns: _Columns, stamps: IntArray) -> _Columns:
    """The values at sorted stamps and no others: missing without one, of duplicates the last."""
    own, *values = columns
    if np.array_equal(stamps, own):
        return values
    kept = np.isin(own, stamps)
    rows = np.searchsorted(stamps, own[kept])
    tables = []
    for column in values:
        missing = _MISSING[column.dtype.kind]
        tables.append(np.full((len(stamps), column.shape[1]), missing, column.dtype))
        tables[-1][rows] = column[kept]
    return tables


def _drop_strays(
    series: dict[tuple[topics.Topic, str], _Columns], notify: Callable[[str], None]
) -> None:
    """Leave out messages whose stamp is far from the middle one, such as zero."""
    stamps = np.sort(np.concatenate([columns[0] for columns in series.values()]))
    middle, strays = int(stamps[len(stamps) // 2]), []
    for key, columns in series.items():
        near = np.abs(columns[0] - middle) <= MAX_APART
        if not near.all():
            strays.append(f"{key[1]} ({int((~near).sum())})")
            series[key] = [column[near] for column in columns]
    if strays:
        notify(f"stamps that are days from the others are left out: {', '.join(strays)}")


def _stamp_notes(series: dict[tuple[topics.Topic, str], _Columns]) -> Iterator[str]:
    """Notes on out-of-order and duplicate stamps, one for all topics with the same problem."""
    series = {key: columns for key, columns in series.items() if len(columns[0])}
    first = min(int(stamps.min()) for stamps, *_ in series.values())
    found: dict[str, list[str]] = defaultdict(list)
    for (topic, name), (stamps, *_) in series.items():
        own = f"{topics.MARKERS.name} of {name}" if topic is topics.MARKERS else name
        time = (stamps - first) * 1e-9
        back = np.flatnonzero(np.diff(stamps) < 0)
        if len(back):
            jumps = [f"from {time[i]:.2f} s to {time[i + 1]:.2f} s" for i in back]
            found[
                f"jump back, {_times(jumps)}; samples are in the order of their stamps: check the"
                " clock of the recording"
            ].append(own)
        values, counts = np.unique(stamps, return_counts=True)
        again = (values[counts > 1] - first) * 1e-9
        if len(again):
            times, lost = _times([f"at {at:.2f} s" for at in again]), len(stamps) - len(values)
            text = f"are doubled, {times}: {lost} earlier values are replaced by later ones"
            found[text].append(own)
    for text, names in found.items():
        yield f"the stamps of {', '.join(names)} {text}"


def _times(parts: list[str]) -> str:
    times = "once" if len(parts) == 1 else f"{len(parts)} times"
    return f"{times} ({listed(parts, _MAX_LISTED)})"


def make_samples(
    measured: Measurements, calibration: Calibration, geometry: SocketGeometry
) -> Samples:
    """Samples from corrected measurements: calibrated forces, and the limb's pose in {S}.

    Args:
        measured: The measurements, one row per trigger.
        calibration: Gives the stress of each cluster from its capacitances; it must know all of
            them.
        geometry: Gives the area and frame of each cluster's tile, and the pose of the limb from
            those of the marker bodies; it must know all clusters.
    """
    position, rotation = np.empty((2, len(measured.stamps), 3))
    for start in range(0, len(position), _BLOCK_SIZE):
        rows = slice(start, start + _BLOCK_SIZE)
        limb = geometry.limb_of(measured.socket[rows], measured.pylon[rows])
        position[rows], rotation[rows] = limb.translation, limb.rotation_vector()
    status = np.empty(measured.status.shape[:2], dtype=np.uint8)
    forces = np.empty((*status.shape, 3))
    for column, name in enumerate(measured.clusters):
        stress, status[:, column] = calibration.clusters[name].apply(
            measured.capacitance[:, column], measured.status[:, column]
        )
        forces[:, column] = geometry.cluster_force(name, stress)
    return Samples(
        stamps=measured.stamps,
        position=position,
        rotation=rotation,
        wrench=measured.wrench,
        clusters=measured.clusters,
        local_forces=forces,
        status=status,
    )
