"""Conversions between arrays and ROS messages, in pairs where both are needed.

They need no more than numpy: the nodes that measure start quickly.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Vector3, Wrench, WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from socket_testbed_msgs.msg import (
    ClusterCapacitance,
    ClusterCapacitanceArray,
    ClusterStress,
    ClusterStressArray,
    LoadCellRaw,
    RigidBodyMarkers,
    RigidBodyMarkersArray,
    Trigger,
)
from std_msgs.msg import Header

from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.trials.layout import Field, Layout, Record

WORLD_FRAME = "world"  # the motion capture's
SOCKET_FRAME = "socket"  # the socket's marker body
LOAD_CELL_FRAME = "load_cell"  # the paper's {S}
LIMB_FRAME = "limb"  # its origin is the lumped mass


_TYPE = re.compile(r"(sequence<)?([\w/]+)(?:<\d+>)?(?:, \d+)?>?(?:\[(\d+)\])?")
_IDL_NAMES = {"double": "float64", "float": "float32", "boolean": "bool", "octet": "byte"}


@cache
def fields_of(message_type: str) -> tuple[Field, ...]:
    """The fields of a message type, given as `package/Type`, for its layout."""
    package, _, name = message_type.partition("/")
    kind = getattr(import_module(f"{package}.msg"), name)
    fields = []
    for field, written in kind.get_fields_and_field_types().items():
        for sequence, element, length in _TYPE.findall(written):
            number = 0 if sequence else int(length) if length else None
            fields.append(Field(field, _IDL_NAMES.get(element, element), number))
    return tuple(fields)


def layout_of(message: Any) -> Layout:
    """The layout of a message, and of all whose strings and sequences are as long."""
    return Layout(serialize_message(message), _type_name(type(message)), fields_of)


def _type_name(kind: type) -> str:
    return f"{kind.__module__.partition('.')[0]}/{kind.__name__}"


T = TypeVar("T")


class MessageReader(Generic[T]):
    """Reads serialised messages of one type, with numpy where they have the last one's layout.

    Args:
        kind: Class of the messages.
        from_message: What a message says.
        from_record: What the numbers of a message say, given what the one says that the layout
            was found from: strings and lengths are the same.
    """

    def __init__(
        self,
        kind: Any,
        from_message: Callable[[Any], T],
        from_record: Callable[[Record, T], T],
    ) -> None:
        self._kind = kind
        self._from_message = from_message
        self._from_record = from_record
        self._known: tuple[Layout, T] | None = None

    def read(self, data: bytes) -> T:
        """What a serialised message says."""
        if self._known is not None:
            layout, like = self._known
            if (record := layout.record(data)) is not None:
                return self._from_record(record, like)
        found = self._from_message(deserialize_message(data, self._kind))
        with suppress(ValueError):  # it has no layout: the next is decoded as this one
            self._known = Layout(data, _type_name(self._kind), fields_of), found
        return found


class MessageTemplate:
    """A message with a header, of which all but the numbers stays: filled and sent as bytes.

    Args:
        message: The message; its strings and the lengths of its sequences stay.

    Attributes:
        numbers: Its numbers, to be filled: as `Layout.blank`.
    """

    def __init__(self, message: Any) -> None:
        self._content, self.numbers = layout_of(message).blank()
        stamp = self.numbers["header"]["stamp"]
        self._seconds, self._nanoseconds = stamp["sec"], stamp["nanosec"]

    def serialised(self, stamp: int) -> bytes:
        """The message as it is filled, with a stamp [ns]."""
        self._seconds[()], self._nanoseconds[()] = divmod(stamp, 1_000_000_000)
        return bytes(self._content)


Stamped: TypeAlias = tuple[int, FloatArray]
"""A stamp since the epoch [ns], and what was measured."""

VectorPacker: TypeAlias = Callable[[int, FloatArray], bytes]
"""Makes a serialised message of a stamp since the epoch [ns] and its numbers in a row."""


def elements(record: Record, field: str) -> list[Record]:
    """The numbers of the messages in a sequence, none where it is empty."""
    if field not in (record.dtype.names or ()):
        return []
    sequence = record[field]
    return [sequence[number] for number in sequence.dtype.names or ()]


def stamp_from_record(record: Record) -> int:
    """Stamp of a message's header, in nanoseconds since the epoch."""
    stamp = record["header"]["stamp"]
    return int(stamp["sec"]) * 1_000_000_000 + int(stamp["nanosec"])


def stamp_from_ros(stamp: Time) -> int:
    """Nanoseconds since the epoch."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stamp_to_ros(stamp: int) -> Time:
    """Stamp from nanoseconds since the epoch."""
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    return Time(sec=seconds, nanosec=nanoseconds)


def header_to_ros(stamp: int, frame: str = LOAD_CELL_FRAME) -> Header:
    """Header from nanoseconds since the epoch and a frame."""
    return Header(stamp=stamp_to_ros(stamp), frame_id=frame)


def trigger_reader() -> MessageReader[tuple[int, int]]:
    """Reads triggers: the stamp [ns] and the sequence."""
    return MessageReader(
        Trigger,
        lambda message: (stamp_from_ros(message.header.stamp), int(message.sequence)),
        lambda record, like: (stamp_from_record(record), int(record["sequence"])),
    )


def wrench_from_ros(wrench: Wrench) -> FloatArray:
    """[M; F], shape (6,) [N m, N]."""
    t, f = wrench.torque, wrench.force
    return np.array([t.x, t.y, t.z, f.x, f.y, f.z])


def wrench_reader() -> MessageReader[Stamped]:
    """Reads WrenchStamped: the stamp [ns] and [M; F], shape (6,) [N m, N]."""
    return _vector_reader(WrenchStamped, "wrench", ("torque", "force"), wrench_from_ros)


def wrench_to_ros(wrench: FloatArray) -> Wrench:
    """Wrench from [M; F], shape (6,) [N m, N]."""
    return Wrench(torque=vector_to_ros(wrench[:3]), force=vector_to_ros(wrench[3:]))


def wrench_packer() -> VectorPacker:
    """Packs a WrenchStamped from its stamp [ns] and [M; F], shape (6,) [N m, N]."""
    return _vector_packer(WrenchStamped(header=header_to_ros(0)), "wrench", ("torque", "force"))


def load_cell_raw_packer() -> Callable[[int, FloatArray, FloatArray, int, int], bytes]:
    """Packs a LoadCellRaw.

    From its stamp [ns], the ratios, shape (6,) [mV/V], the tare [M; F], shape (6,) [N m, N], when
    that was taken [ns], and a `Status`.
    """
    template = MessageTemplate(LoadCellRaw(header=header_to_ros(0)))
    numbers = template.numbers

    def pack(stamp: int, ratios: FloatArray, tare: FloatArray, tared: int, status: int) -> bytes:
        numbers["ratios"] = 1e-3 * ratios
        numbers["tare"]["torque"], numbers["tare"]["force"] = tare[:3], tare[3:]
        numbers["tared"]["sec"], numbers["tared"]["nanosec"] = divmod(tared, 1_000_000_000)
        numbers["status"] = status
        return template.serialised(stamp)

    return pack


def vector_to_ros(vector: FloatArray) -> Vector3:
    """Vector3 from an array of shape (3,)."""
    x, y, z = vector.tolist()
    return Vector3(x=x, y=y, z=z)


def vectors_from_ros(vectors: list[Vector3]) -> FloatArray:
    """Array of shape (n, 3) from n Vector3."""
    return np.array([(v.x, v.y, v.z) for v in vectors]).reshape(-1, 3)


def pose_from_ros(pose: Pose) -> FloatArray:
    """Position [m] and quaternion (x, y, z, w), shape (7,)."""
    p, q = pose.position, pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])


def pose_reader() -> MessageReader[Stamped]:
    """Reads PoseStamped: the stamp [ns] and `pose_from_ros`, shape (7,)."""
    return _vector_reader(PoseStamped, "pose", ("position", "orientation"), pose_from_ros)


def pose_packer() -> VectorPacker:
    """Packs a PoseStamped in the world from its stamp [ns] and `pose_from_ros`, shape (7,)."""
    blank = PoseStamped(header=header_to_ros(0, WORLD_FRAME))
    return _vector_packer(blank, "pose", ("position", "orientation"))


def _vector_reader(
    kind: Any, field: str, halves: tuple[str, str], from_ros: Callable[[Any], FloatArray]
) -> MessageReader[Stamped]:
    """Reads a stamped message: the stamp [ns] and the numbers of a field's two halves in a row."""

    def from_record(record: Record, like: Stamped) -> Stamped:
        whole = record[field]
        return stamp_from_record(record), np.concatenate([whole[half] for half in halves])

    return MessageReader(
        kind,
        lambda message: (stamp_from_ros(message.header.stamp), from_ros(getattr(message, field))),
        from_record,
    )


def _vector_packer(message: Any, field: str, halves: tuple[str, str]) -> VectorPacker:
    """Packs a message from its stamp [ns] and the numbers of a field's two halves in a row."""
    template = MessageTemplate(message)
    first, second = (template.numbers[field][half] for half in halves)

    def pack(stamp: int, values: FloatArray) -> bytes:
        first[:], second[:] = values[: len(first)], values[len(first) :]
        return template.serialised(stamp)

    return pack


def quaternion_to_ros(quaternion: FloatArray) -> Quaternion:
    """Quaternion from an array (x, y, z, w), shape (4,)."""
    x, y, z, w = quaternion.tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def point_to_ros(position: FloatArray) -> Point:
    """Point from a position, shape (3,) [m]."""
    x, y, z = position.tolist()
    return Point(x=x, y=y, z=z)


def markers_to_ros(
    stamp: int, bodies: Sequence[str], markers: Sequence[FloatArray]
) -> RigidBodyMarkersArray:
    """Message from the markers of each body, shape (m, 3) [m] in the world; NaN where occluded."""
    found = [
        RigidBodyMarkers(name=name, markers=[point_to_ros(marker) for marker in own])
        for name, own in zip(bodies, markers, strict=True)
    ]
    return RigidBodyMarkersArray(header=header_to_ros(stamp, WORLD_FRAME), bodies=found)


class Capacitances(NamedTuple):
    """What a message of capacitances says.

    Attributes:
        stamp: Stamp of its trigger since the epoch [ns].
        names: Names of the c clusters.
        capacitance: Capacitances by input, shape (c, 4) [pF].
        status: `Status` of each, shape (c, 4).
    """

    stamp: int
    names: tuple[str, ...]
    capacitance: FloatArray
    status: StatusArray


def capacitance_reader() -> MessageReader[Capacitances]:
    """Reads messages of capacitances."""

    def from_message(message: ClusterCapacitanceArray) -> Capacitances:
        clusters = message.clusters
        return Capacitances(
            stamp_from_ros(message.header.stamp),
            tuple(cluster.name for cluster in clusters),
            np.array([cluster.capacitance for cluster in clusters]).reshape(-1, 4),
            np.array([cluster.status for cluster in clusters], dtype=np.uint8).reshape(-1, 4),
        )

    def from_record(record: Record, like: Capacitances) -> Capacitances:
        clusters = elements(record, "clusters")
        capacitance, status = np.empty_like(like.capacitance), np.empty_like(like.status)
        for i, cluster in enumerate(clusters):
            capacitance[i], status[i] = cluster["capacitance"], cluster["status"]
        return Capacitances(stamp_from_record(record), like.names, capacitance, status)

    return MessageReader(ClusterCapacitanceArray, from_message, from_record)


def capacitance_to_ros(
    stamp: int, names: tuple[str, ...], capacitance: FloatArray, status: StatusArray
) -> ClusterCapacitanceArray:
    """Message from capacitances, shape (c, 4) [pF], and statuses, shape (c, 4)."""
    clusters = [
        ClusterCapacitance(name=name, capacitance=capacitance[i], status=status[i])
        for i, name in enumerate(names)
    ]
    return ClusterCapacitanceArray(header=header_to_ros(stamp), clusters=clusters)


def stress_from_ros(message: ClusterStressArray) -> dict[str, tuple[FloatArray, int]]:
    """Normal stress, shear x, shear y [Pa] and status by cluster."""
    return {
        c.name: (np.array([c.normal, c.shear_x, c.shear_y]), int(c.status))
        for c in message.clusters
    }


def stress_reader() -> MessageReader[tuple[int, dict[str, tuple[FloatArray, int]]]]:
    """Reads messages of stresses: the stamp [ns] and `stress_from_ros`."""

    def from_record(
        record: Record, like: tuple[int, dict[str, tuple[FloatArray, int]]]
    ) -> tuple[int, dict[str, tuple[FloatArray, int]]]:
        numbers = (cluster.tolist() for cluster in elements(record, "clusters"))
        found = {
            name: (np.array([normal, shear_x, shear_y]), status)
            for name, (normal, shear_x, shear_y, status) in zip(like[1], numbers, strict=True)
        }
        return stamp_from_record(record), found

    return MessageReader(
        ClusterStressArray,
        lambda message: (stamp_from_ros(message.header.stamp), stress_from_ros(message)),
        from_record,
    )


def stress_to_ros(
    stamp: int, names: Sequence[str], stress: FloatArray, status: StatusArray
) -> ClusterStressArray:
    """Message from stresses, shape (c, 3) [Pa], and statuses, shape (c,)."""
    clusters = [
        ClusterStress(
            name=name,
            normal=float(values[0]),
            shear_x=float(values[1]),
            shear_y=float(values[2]),
            status=int(state),
        )
        for name, values, state in zip(names, stress, status, strict=True)
    ]
    return ClusterStressArray(header=header_to_ros(stamp), clusters=clusters)
