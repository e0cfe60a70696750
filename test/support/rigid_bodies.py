"""Messages of rigid bodies, as the drivers of mocap4r2 send them, by either of two definitions."""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from socket_testbed.trials.bag import RawMessage

KIND = "mocap4r2_msgs/msg/RigidBodies"
_BODIES = "std_msgs/Header header\nuint32 frame_number\nmocap4r2_msgs/RigidBody[] rigidbodies\n"
_RULE = "=" * 80 + "\n"
DEFINITIONS = {
    "first": _BODIES + _RULE + "MSG: mocap4r2_msgs/RigidBody\n"
    "std_msgs/Header header\nuint32 frame_number\nstring rigid_body_name\n"
    "mocap4r2_msgs/Marker[] markers\ngeometry_msgs/Pose pose\n" + _RULE
    + "MSG: mocap4r2_msgs/Marker\nint64 index\ngeometry_msgs/Point translation\n",
    "present": _BODIES + _RULE + "MSG: mocap4r2_msgs/RigidBody\n"
    "string rigid_body_name\nmocap4r2_msgs/Marker[] markers\ngeometry_msgs/Pose pose\n" + _RULE
    + "MSG: mocap4r2_msgs/Marker\nint8 USE_NAME=0\nint8 USE_INDEX=1\nint8 USE_BOTH=2\n"
    "int8 id_type\nint32 marker_index\nstring marker_name\ngeometry_msgs/Point translation\n",
}  # fmt: skip


class Body(NamedTuple):
    """A body in a message: its pose, the number of its markers, and a stamp [ns] of its own."""

    name: str
    pose: Sequence[float]
    markers: int = 0
    stamp: int = 0


@cache
def types_of(definition: str) -> Typestore:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(DEFINITIONS[definition], KIND))
    return store


def message(
    definition: str,
    stamp: int,
    bodies: Sequence[Body],
    arrival: int | None = None,
    told: bool = True,
) -> RawMessage:
    """A message on /rigid_bodies in the frame `map`, which tells its definition or does not."""
    store = types_of(definition)
    kinds = {name.rpartition("/")[2]: kind for name, kind in store.types.items()}
    point = kinds["Point"](0.1, 0.2, 0.3)

    def head(time: int, frame: str) -> Any:
        return kinds["Header"](kinds["Time"](*divmod(time, 1_000_000_000)), frame)

    sent = []
    for body in bodies:
        numbers = range(body.markers)
        if definition == "first":
            first: list[Any] = [head(body.stamp, ""), 7]
            markers = [kinds["Marker"](number, point) for number in numbers]
        else:
            first = []
            markers = [kinds["Marker"](2, number, f"marker_{number}", point) for number in numbers]
        pose = kinds["Pose"](kinds["Point"](*body.pose[:3]), kinds["Quaternion"](*body.pose[3:]))
        sent.append(kinds["RigidBody"](*first, body.name, markers, pose))
    data = bytes(store.serialize_cdr(kinds["RigidBodies"](head(stamp, "map"), 7, sent), KIND))
    received = stamp if arrival is None else arrival
    return RawMessage("/rigid_bodies", KIND, received, data, DEFINITIONS[definition] * told)
