"""Reads and packs the numbers in the testbed's messages, without ROS.

A `Reader` reuses the layouts of earlier messages; the rosbags library decodes only the first one
of each layout. Packing fills in a serialised blank message.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray, StatusArray
from socket_testbed.errors import TrialError
from socket_testbed.samples import Status
from socket_testbed.wire import cdr, topics

if TYPE_CHECKING:
    from socket_testbed.identification.fit import FittedModel
    from socket_testbed.identification.force_map import MapEstimate
    from socket_testbed.identification.pressure import RegionOutputs

WORLD_FRAME = "world"  # of the motion capture
LOAD_CELL_FRAME = "load_cell"  # the paper's {S}

_SECOND = 1_000_000_000  # [ns]
_MAX_LAYOUTS = 8  # remembered per topic; messages of other layouts are decoded one by one
_MAX_REMEMBERED = 2**18  # [bytes] of the messages of these layouts, which take up to 60 times that

Values: TypeAlias = Callable[[cdr.Record, Any], Any]
"""Values of messages of one layout, from their numbers and one decoded sample: names and lengths
are equal in all. Shapes begin with that of the records."""


class Reader:
    """Reads serialised messages of a topic, all of one layout at once.

    The values of one message, or with a leading axis of many, by the type of the topic:

    - Trigger: the sequence number [-];
    - WrenchStamped: [M; F], shape (..., 6) [N m, N];
    - LoadCellRaw: `RawLoad`;
    - PoseStamped: position [m] and quaternion (x, y, z, w) of the body, shape (..., 7);
    - ClusterCapacitanceArray: `Capacitances`;
    - ClusterStressArray, one message only: by cluster the normal stress (positive in compression)
      and shears along x and y of the cluster's own frame, shape (3,) [Pa], and the `Status`;
    - RigidBodyMarkersArray: name and markers in the world, shape (..., m, 3) [m], of each body;
    - LocalForceArray: forces on the socket in {S}, shape (..., n, 3) [N];
    - ForceMap: names of the n tiles, and the fields of a `MapEstimate` by name;
    - RegionPressures: names of the R regions, and `RegionOutputs`;
    - Event, one message only: the label.

    Args:
        topic: The topic.
        where: Where the messages come from, for errors, such as the path of the bag.

    Attributes:
        refused: Errors of messages that `parts` could not decode and left out.
    """

    def __init__(self, topic: topics.Topic, where: object = "this graph") -> None:
        self._topic = topic
        self._where = where
        self._values = VALUES[topic.type]
        cdr.fields_of(topic.type)  # cached now, so that a node's first message is not delayed
        self._known: list[tuple[cdr.Layout, Any]] = []
        self.refused: list[TrialError] = []

    def read(self, data: bytes) -> tuple[int, Any]:
        """Stamp since the epoch [ns] and values of one message (CDR).

        Raises:
            TrialError: If the message cannot be decoded.
        """
        for layout, sample in self._known:
            if (record := layout.record(data)) is not None:
                return self._stamped(record, sample)
        layout, sample = self._learn(data)
        if len(data) <= _MAX_REMEMBERED:
            self._known = [(layout, sample), *self._known[: _MAX_LAYOUTS - 1]]
            while sum(known.dtype.itemsize for known, _ in self._known) > _MAX_REMEMBERED:
                self._known.pop()
        record = layout.record(data)
        assert record is not None
        return self._stamped(record, sample)

    def _stamped(self, record: cdr.Record, sample: Any) -> tuple[int, Any]:
        """Stamp since the epoch [ns] and values of one message of the sample's layout."""
        stamp = record["header"]["stamp"]  # `stamps_of` takes 10 us
        seconds, nanoseconds = int(stamp["sec"]), int(stamp["nanosec"])
        if nanoseconds >= _SECOND:
            raise self._refusal(f"its stamp has {nanoseconds} ns")
        return _SECOND * seconds + nanoseconds, self._values(record, sample)

    def parts(self, messages: Sequence[bytes]) -> Iterator[tuple[IntArray, IntArray, Any]]:
        """Many serialised messages in parts, each of one layout.

        Yields:
            Indices of the part's k messages, shape (k,), their stamps since the epoch [ns], shape
            (k,), and their values, with the leading axis k.
        """
        left, tried = np.arange(len(messages)), 0
        while len(left):
            chosen = left
            if tried < len(self._known):
                layout, sample = self._known[tried]
            else:
                try:
                    layout, sample = self._learn(messages[left[0]])
                except TrialError as error:
                    self.refused.append(error)
                    left = left[1:]
                    continue
                if tried < _MAX_LAYOUTS:
                    self._known.append((layout, sample))
                else:
                    chosen = left[:1]
            tried += 1
            records, fits = layout.records([messages[place] for place in chosen.tolist()])
            if len(records):
                yield chosen[fits], cdr.stamps_of(records), self._values(records, sample)
            left = np.concatenate([chosen[~fits], left[len(chosen) :]])

    def _learn(self, data: bytes) -> tuple[cdr.Layout, Any]:
        try:
            layout = cdr.Layout(data, self._topic.type)
            sample = cdr.decode(data, self._topic.type)
            check_lengths(sample, self._topic.type)
            self._values(np.ndarray((), layout.dtype, data), sample)
            return layout, sample
        except Exception as error:  # the library may raise any exception
            raise self._refusal(error) from None

    def _refusal(self, why: object) -> TrialError:
        return TrialError(
            f"{self._where}: a message on {self._topic.name} cannot be decoded ({why})",
            "check that it was recorded or sent with this version's messages",
        )


class Template:
    """A serialised message with a header, in which only the numbers change.

    Args:
        message_type: Its type, as `package/msg/Type`.
        frame: Its header's frame.
        content: Its strings and the lengths of its sequences, as in `make_message`.

    Attributes:
        numbers: A view of its numbers by field name, shape (), for callers to fill in, in the units
            of the message definition; see `Layout`.
    """

    def __init__(self, message_type: str, frame: str = LOAD_CELL_FRAME, **content: Any) -> None:
        self._content, self.numbers = cdr.blank(message_type, header={"frame_id": frame}, **content)
        self._stamp = self.numbers["header"]["stamp"]

    def serialised(self, stamp: int, **numbers: Any) -> bytes:
        """The message (CDR) with a stamp and some numbers; the others keep their last values.

        Args:
            stamp: Stamp of its header since the epoch [ns].
            numbers: Values by field name, in the units of the message definition.
        """
        self._stamp[()] = divmod(stamp, 1_000_000_000)
        for field, values in numbers.items():
            self.numbers[field] = values
        return bytes(self._content)


def trigger_packer() -> Callable[[int, int], bytes]:
    """Packs a Trigger from its stamp since the epoch [ns] and sequence number [-]."""
    template = Template(topics.TRIGGER.type)
    return lambda stamp, sequence: template.serialised(stamp, sequence=sequence)


VectorPacker: TypeAlias = Callable[[int, FloatArray], bytes]
"""Packs a serialised message from a stamp since the epoch [ns] and its numbers."""


def wrench_packer() -> VectorPacker:
    """Packs a WrenchStamped in {S} from its stamp [ns] and [M; F], shape (6,) [N m, N]."""
    return _vector_packer(Template(topics.WRENCH.type), "wrench", "torque", "force")


def pose_packer() -> VectorPacker:
    """Packs a PoseStamped in the world: stamp [ns]; position [m], quaternion (x, y, z, w), (7,)."""
    return _vector_packer(
        Template(topics.SOCKET_POSE.type, WORLD_FRAME), "pose", "position", "orientation"
    )


def _joined(record: cdr.Record, *fields: str) -> FloatArray:
    return np.concatenate([record[field] for field in fields], axis=-1)


def _vector_packer(template: Template, field: str, *halves: str) -> VectorPacker:
    first, second = (template.numbers[field][half] for half in halves)

    def pack(stamp: int, values: FloatArray) -> bytes:
        first[:], second[:] = values[: len(first)], values[len(first) :]
        return template.serialised(stamp)

    return pack


class RawLoad(NamedTuple):
    """Readings of the load cell, of one message or with a leading axis of many.

    Attributes:
        ratios: Ratios of the bridges, shape (..., 6) [mV/V].
        tare: What is subtracted from the wrench, [M; F] in {S}, shape (..., 6) [N m, N].
        tared: When the tare was taken, since the epoch, shape (...) [ns]; 0 without a tare.
    """

    ratios: FloatArray
    tare: FloatArray
    tared: IntArray


def _raw(records: cdr.Record, sample: Any) -> RawLoad:
    tare = _joined(records["tare"], "torque", "force")
    return RawLoad(1e3 * records["ratios"], tare, cdr.times_of(records["tared"]))


def load_cell_raw_packer() -> Callable[[int, FloatArray, FloatArray, int, int], bytes]:
    """Packs a LoadCellRaw.

    From its stamp [ns], the ratios, shape (6,) [mV/V], the tare [M; F], shape (6,) [N m, N], the
    tare's time [ns], and a `Status`.
    """
    template = Template(topics.LOAD_CELL_RAW.type)

    def pack(stamp: int, ratios: FloatArray, tare: FloatArray, tared: int, status: int) -> bytes:
        own = template.numbers["tare"]
        own["torque"], own["force"] = tare[:3], tare[3:]
        taken = divmod(tared, 1_000_000_000)
        return template.serialised(stamp, ratios=1e-3 * ratios, tared=taken, status=status)

    return pack


class Capacitances(NamedTuple):
    """Capacitances of c clusters, of one message or with a leading axis of many.

    Attributes:
        names: Names of the clusters, in the order of the message.
        capacitance: By converter input, shape (..., c, 4) [pF]; NaN where it could not be read.
        status: `Status` of each capacitance, shape (..., c, 4).
    """

    names: tuple[str, ...]
    capacitance: FloatArray
    status: StatusArray


def _capacitances(records: cdr.Record, sample: Any) -> Capacitances:
    """Clusters that share a name are ambiguous and count as missing."""
    names = tuple(cluster.name for cluster in sample.clusters)
    capacitance = np.full((*records.shape, len(names), 4), np.nan)
    status = np.full(capacitance.shape, Status.MISSING, np.uint8)
    for i, own in enumerate(cdr.elements(records, "clusters")):
        if names.count(names[i]) == 1:
            capacitance[..., i, :], status[..., i, :] = own["capacitance"], own["status"]
    return Capacitances(names, capacitance, status)


def capacitance_packer(names: Sequence[str]) -> Callable[[int, FloatArray, StatusArray], bytes]:
    """Packs a ClusterCapacitanceArray of c clusters, given by name.

    From its stamp [ns], the capacitances by converter input, shape (c, 4) [pF], and the `Status` of
    each, shape (c, 4).
    """
    template = Template(topics.CAPACITANCE.type, clusters=[{"name": name} for name in names])
    clusters = cdr.elements(template.numbers, "clusters")

    def pack(stamp: int, capacitance: FloatArray, status: StatusArray) -> bytes:
        for own, values, states in zip(clusters, capacitance, status, strict=True):
            own["capacitance"], own["status"] = values, states
        return template.serialised(stamp)

    return pack


def _stress(records: cdr.Record, sample: Any) -> dict[str, tuple[FloatArray, int]]:
    """Normal stress, shear x and y [Pa], and status by cluster, of one message."""
    found = {}
    for cluster, own in zip(sample.clusters, cdr.elements(records, "clusters"), strict=True):
        *stress, status = own.tolist()
        found[cluster.name] = np.array(stress), status
    return found


def in_order(
    stresses: Mapping[str, tuple[FloatArray, int]], names: Iterable[str]
) -> tuple[FloatArray, StatusArray]:
    """Stresses of the named clusters as arrays; an absent one is NaN and missing.

    Args:
        stresses: By cluster the normal stress (positive in compression) and shears along x and y of
            its own frame, shape (3,) [Pa], and the `Status`, as a `Reader` gives them.
        names: Names of the c clusters, which give the rows.

    Returns:
        The stresses, shape (c, 3) [Pa], and the statuses, shape (c,).
    """
    missing = np.full(3, np.nan), Status.MISSING
    found = [stresses.get(name, missing) for name in names]
    stress = np.array([stress for stress, _ in found]).reshape(-1, 3)
    return stress, np.array([status for _, status in found], dtype=np.uint8)


def stress_packer(names: Sequence[str]) -> Callable[[int, FloatArray, StatusArray], bytes]:
    """Packs a ClusterStressArray of c clusters, given by name.

    From its stamp [ns], the normal stress (positive in compression) and shears along x and y of the
    cluster's own frame, shape (c, 3) [Pa], and the `Status` of each cluster, shape (c,).
    """
    template = Template(topics.STRESS.type, clusters=[{"name": name} for name in names])
    clusters = cdr.elements(template.numbers, "clusters")

    def pack(stamp: int, stress: FloatArray, status: StatusArray) -> bytes:
        for own, values, state in zip(clusters, stress.tolist(), status.tolist(), strict=True):
            own[()] = (*values, state)
        return template.serialised(stamp)

    return pack


def _markers(records: cdr.Record, sample: Any) -> list[tuple[str, FloatArray]]:
    """Name of each body, and its m markers in the world, shape (..., m, 3) [m]."""
    found = []
    for number, body in enumerate(sample.bodies):
        markers = np.empty((*records.shape, len(body.markers), 3))
        if body.markers:
            markers[:] = records["bodies"][str(number)]["markers"]
        found.append((body.name, markers))
    return found


def markers_packer(counts: Mapping[str, int]) -> Callable[[int, Sequence[FloatArray]], bytes]:
    """Packs a RigidBodyMarkersArray, given each body's marker count.

    From its stamp [ns] and the markers of each body, shape (m, 3) [m] in the world.
    """
    bodies = [{"name": name, "markers": [None] * count} for name, count in counts.items()]
    template = Template(topics.MARKERS.type, WORLD_FRAME, bodies=bodies)
    # A body without markers has no numbers.
    numbers = {
        place: template.numbers["bodies"][str(place)]
        for place, count in enumerate(counts.values())
        if count
    }

    def pack(stamp: int, markers: Sequence[FloatArray]) -> bytes:
        for place, own in numbers.items():
            own["markers"] = markers[place]
        return template.serialised(stamp)

    return pack


def _per_name(
    topic: topics.Topic, names: Sequence[str], fields: Sequence[str], **more: Any
) -> Template:
    """A template whose fields have one element per name."""
    blanks: dict[str, Any] = dict.fromkeys(fields, [None] * len(names))
    return Template(topic.type, names=names, **blanks, **more)


def local_forces_packer(names: Sequence[str]) -> VectorPacker:
    """Packs a LocalForceArray: stamp [ns]; forces on the socket in {S}, shape (n, 3) [N]."""
    template = _per_name(topics.LOCAL_FORCES, names, ["forces"])
    return lambda stamp, values: template.serialised(stamp, forces=values)


_MAP_FIELDS = (
    *("forces", "standard_deviations", "normal_pressure", "normal_pressure_standard_deviation"),
    *("shear", "shear_standard_deviation"),
)


def _array(records: cdr.Record, field: str) -> FloatArray:
    """Numbers (..., n) or vectors (..., n, 3) of a field; an empty sequence of vectors has none."""
    if field not in (records.dtype.names or ()):
        return np.empty((*records.shape, 0, 3))
    return np.asarray(records[field].astype(np.float64))


def _force_map(records: cdr.Record, sample: Any) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Names of the n tiles, and the fields of N maps for a `MapEstimate`."""
    records = np.atleast_1d(records)
    fields: dict[str, Any] = {name: _array(records, name) for name in _MAP_FIELDS}
    return tuple(sample.names), {**fields, "source": sample.source}


def force_map_packer(names: Sequence[str]) -> Callable[[int, MapEstimate], bytes]:
    """Packs a ForceMap of n tiles from its stamp [ns] and an estimate with N = 1."""
    # One for each combination of available channels; there are few.
    template_of = cache(
        lambda source: _per_name(topics.FORCE_MAP, names, _MAP_FIELDS, source=source)
    )

    def pack(stamp: int, estimate: MapEstimate) -> bytes:
        numbers = {field: getattr(estimate, field)[0] for field in _MAP_FIELDS}
        return template_of(estimate.source).serialised(stamp, **numbers)

    return pack


# Region outputs and their fields in a RegionPressures.
_REGION_FIELDS = {"mean": "mean", "peak": "peak", "shear": "shear", "share": "load_share"}
_REGION_COLUMNS = [
    f"{name}{end}" for name in _REGION_FIELDS.values() for end in ("", "_low", "_high")
]


def _regions(records: cdr.Record, sample: Any) -> tuple[tuple[str, ...], RegionOutputs]:
    """Names of the R regions, and their outputs; quantities not in the message are NaN."""
    from socket_testbed.identification.pressure import Quantity, RegionOutputs  # few nodes need it

    unknown = np.full(records["mean"].shape, np.nan)
    nothing = Quantity(unknown, unknown, unknown, unknown)
    found = {field.name: nothing for field in fields(RegionOutputs)}
    found["centre"] = Quantity(*[np.full((*unknown.shape, 3), np.nan)] * 4)
    for name, field in _REGION_FIELDS.items():
        ends = (records[field + end].astype(np.float64) for end in ("", "_low", "_high", ""))
        found[name] = Quantity(*ends)
    return tuple(sample.names), RegionOutputs(**found)


def regions_packer(names: Sequence[str]) -> Callable[[int, RegionOutputs], bytes]:
    """Packs a RegionPressures of R regions from its stamp [ns] and outputs with N = 1."""
    template = _per_name(topics.REGIONS, names, _REGION_COLUMNS)

    def pack(stamp: int, outputs: RegionOutputs) -> bytes:
        quantities = [getattr(outputs, output) for output in _REGION_FIELDS]
        values = [own for each in quantities for own in (each.value, each.low, each.high)]
        return template.serialised(stamp, **dict(zip(_REGION_COLUMNS, values, strict=True)))

    return pack


def model_message(fitted: FittedModel) -> bytes:
    """A serialised ContactModel of a fitted model, stamped with its newest sample."""
    model = fitted.model
    seconds, nanoseconds = divmod(fitted.last_stamp, 1_000_000_000)
    stamp = {"sec": seconds, "nanosec": nanoseconds}
    message = cdr.make_message(
        topics.PARAMETERS.type,
        header={"stamp": stamp, "frame_id": LOAD_CELL_FRAME},
        variant=model.variant,
        names=list(model.names),
        stiffness=[named(row) for row in model.stiffness],
        rest_positions=[named(row) for row in model.rest_positions],
        wrench_bias=_named_wrench(model.wrench_bias),
        bias_names=list(model.force_bias),
        force_bias=[named(row) for row in model.force_bias.values()],
        wrench_rmse=_named_wrench(fitted.wrench_rmse),
        samples=fitted.samples,
        solver_status=fitted.status,
    )
    return cdr.encode(message, topics.PARAMETERS.type)


def _named_wrench(values: FloatArray) -> dict[str, Any]:
    return {"torque": named(values[:3]), "force": named(values[3:])}


def named(values: FloatArray) -> dict[str, float]:
    """Components by name, x, y, z and w, of a vector or point, (3,), or quaternion, (4,)."""
    return dict(zip("xyzw", values.tolist(), strict=False))


_PARALLEL: dict[str, dict[str, Sequence[str]]] = {
    topics.LOCAL_FORCES.type: {"names": ["forces"]},
    topics.FORCE_MAP.type: {"names": _MAP_FIELDS},
    topics.REGIONS.type: {"names": _REGION_COLUMNS},
    topics.PARAMETERS.type: {
        "names": ["stiffness", "rest_positions"],
        "bias_names": ["force_bias"],
    },
}
"""Fields of a message type with an element for each name, by the field that holds the names."""


def check_lengths(message: Any, message_type: str) -> None:
    """Refuse a message in which an array does not have an element for each name.

    The definition of the message does not tie them together, so every reader checks.

    Args:
        message: The message, from rosbags or ROS.
        message_type: Its type, as `package/msg/Type`.

    Raises:
        ValueError: If an array is longer or shorter than its names.
    """
    for names, parallel in _PARALLEL.get(message_type, {}).items():
        expected = len(getattr(message, names))
        for field in parallel:
            if (count := len(getattr(message, field))) != expected:
                raise ValueError(f"{count} {field} for {expected} {names}")


VALUES: dict[str, Values] = {
    topics.TRIGGER.type: lambda records, sample: records["sequence"],
    # [M; F], shape (..., 6) [N m, N]
    topics.WRENCH.type: lambda records, sample: _joined(records["wrench"], "torque", "force"),
    topics.LOAD_CELL_RAW.type: _raw,
    # Position [m] and quaternion (x, y, z, w), shape (..., 7)
    topics.SOCKET_POSE.type: lambda records, sample: _joined(
        records["pose"], "position", "orientation"
    ),
    topics.CAPACITANCE.type: _capacitances,
    topics.STRESS.type: _stress,
    topics.MARKERS.type: _markers,
    # Forces in {S}, shape (..., n, 3) [N]
    topics.LOCAL_FORCES.type: lambda records, sample: _array(records, "forces"),
    topics.FORCE_MAP.type: _force_map,
    topics.REGIONS.type: _regions,
    topics.EVENT.type: lambda records, sample: str(sample.label),
}
"""Reads the values of a message type; `Reader` lists them with shapes, units and frames."""
