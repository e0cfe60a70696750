"""Conversions between arrays and ROS messages, in pairs where both are needed.

They need no more than numpy: the nodes that measure start quickly.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3, Wrench
from rclpy.serialization import serialize_message
from socket_testbed_msgs.msg import (
    ClusterCapacitance,
    ClusterCapacitanceArray,
    ClusterStress,
    ClusterStressArray,
    RigidBodyMarkers,
    RigidBodyMarkersArray,
)
from std_msgs.msg import Header

from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.trials.layout import Field, Layout

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
    kind = type(message)
    message_type = f"{kind.__module__.partition('.')[0]}/{kind.__name__}"
    return Layout(serialize_message(message), message_type, fields_of)


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


def wrench_from_ros(wrench: Wrench) -> FloatArray:
    """[M; F], shape (6,) [N m, N]."""
    t, f = wrench.torque, wrench.force
    return np.array([t.x, t.y, t.z, f.x, f.y, f.z])


def wrench_to_ros(wrench: FloatArray) -> Wrench:
    """Wrench from [M; F], shape (6,) [N m, N]."""
    return Wrench(torque=vector_to_ros(wrench[:3]), force=vector_to_ros(wrench[3:]))


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


def pose_to_ros(position: FloatArray, quaternion: FloatArray) -> Pose:
    """Pose from a position, shape (3,) [m], and a quaternion (x, y, z, w), shape (4,)."""
    return Pose(position=point_to_ros(position), orientation=quaternion_to_ros(quaternion))


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


def stress_to_ros(
    stamp: int, names: list[str], stress: FloatArray, status: StatusArray
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
