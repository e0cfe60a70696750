"""The contract's messages and transforms: as ROS has them, read, packed and drawn."""

import dataclasses
import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rclpy.clock import Clock
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from socket_testbed_msgs import msg
from support import CHECKOUT
from support.bags import wrench_vector
from support.messages import Maker, numbers_of
from support.problems import GEOMETRY

from socket_testbed.geometry.pose import Pose
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.model_file import read_model
from socket_testbed.nodes.base import header_to_ros, message_type
from socket_testbed.nodes.frames import FrameBroadcaster, fixed_frames
from socket_testbed.samples import Status
from socket_testbed.wire import cdr, messages, topics

FOLDER = CHECKOUT / "msg_defs" / "msg"
CONTRACT = """
Trigger: std_msgs/Header header; uint64 sequence
ClusterCapacitance: string name; float64[4] capacitance; uint8[4] status
ClusterCapacitanceArray: std_msgs/Header header; ClusterCapacitance[] clusters
LoadCellRaw: std_msgs/Header header; float64[6] ratios; geometry_msgs/Wrench tare; \
builtin_interfaces/Time tared; uint8 status
RigidBodyMarkers: string name; geometry_msgs/Point[] markers
RigidBodyMarkersArray: std_msgs/Header header; RigidBodyMarkers[] bodies
ClusterStress: string name; float64 normal; float64 shear_x; float64 shear_y; uint8 status
ClusterStressArray: std_msgs/Header header; ClusterStress[] clusters
LocalForceArray: std_msgs/Header header; string[] names; geometry_msgs/Vector3[] forces
ForceMap: std_msgs/Header header; string[] names; geometry_msgs/Vector3[] forces; \
geometry_msgs/Vector3[] standard_deviations; float64[] normal_pressure; \
float64[] normal_pressure_standard_deviation; float64[] shear; \
float64[] shear_standard_deviation; string source
ContactModel: std_msgs/Header header; string variant; string[] names; \
geometry_msgs/Vector3[] stiffness; geometry_msgs/Vector3[] rest_positions; \
geometry_msgs/Wrench wrench_bias; string[] bias_names; geometry_msgs/Vector3[] force_bias; \
geometry_msgs/Wrench wrench_rmse; uint32 samples; string solver_status
RegionPressures: std_msgs/Header header; string[] names; \
float64[] mean; float64[] mean_low; float64[] mean_high; \
float64[] peak; float64[] peak_low; float64[] peak_high; \
float64[] shear; float64[] shear_low; float64[] shear_high; \
float64[] load_share; float64[] load_share_low; float64[] load_share_high
Event: std_msgs/Header header; string label
"""


FIELDS = dict(line.split(": ") for line in CONTRACT.strip().splitlines())


def test_the_messages_are_those_of_the_contract() -> None:
    assert {path.stem for path in FOLDER.glob("*.msg")} == set(FIELDS)


@pytest.mark.parametrize("name", FIELDS)
def test_a_message_has_the_contract_s_fields(name: str) -> None:
    """In its file, in ROS and offline."""
    text = (FOLDER / f"{name}.msg").read_text().splitlines()
    lines = [line.partition("#")[0].split() for line in text]
    fields = [tuple(words) for words in lines if len(words) == 2 and "=" not in words[1]]
    assert fields == [tuple(field.split()) for field in FIELDS[name].split(";")]
    constants = [words[1].split("=") for words in lines if len(words) == 2 and "=" in words[1]]
    assert all(Status[state] == int(number) for state, number in constants)
    names = [field for _, field in fields]
    assert list(getattr(msg, name).get_fields_and_field_types()) == names
    offline = cdr.typestore().types[f"socket_testbed_msgs/msg/{name}"].__dataclass_fields__
    assert [f for f in offline if f.islower() and f != "__msgtype__"] == names


@pytest.mark.parametrize("name", FIELDS)
def test_every_field_has_a_unit(name: str) -> None:
    for line in (FOLDER / f"{name}.msg").read_text().splitlines():
        assert not line or line.startswith("#") or re.search(r"#.*\[[^\]]+\]", line), line


# By topic: what packs the values that are read of a message m, with a stamp.
PACK: dict[topics.Topic, Callable[[int, Any, Any], bytes]] = {
    topics.TRIGGER: lambda t, v, m: messages.trigger_packer()(t, v),
    topics.WRENCH: lambda t, v, m: messages.wrench_packer()(t, v),
    topics.SOCKET_POSE: lambda t, v, m: messages.pose_packer()(t, v),
    topics.LOAD_CELL_RAW: lambda t, v, m: messages.load_cell_raw_packer()(
        t, v.ratios, v.tare, int(v.tared), m.status
    ),
    topics.CAPACITANCE: lambda t, v, m: messages.capacitance_packer(v.names)(
        t, v.capacitance, v.status
    ),
    topics.STRESS: lambda t, v, m: messages.stress_packer(list(v))(
        t, np.array([s for s, _ in v.values()]), np.array([s for _, s in v.values()], np.uint8)
    ),
    topics.MARKERS: lambda t, v, m: messages.markers_packer({name: len(seen) for name, seen in v})(
        t, [seen for _, seen in v]
    ),
    topics.LOCAL_FORCES: lambda t, v, m: messages.local_forces_packer(m.names)(t, v),
    topics.FORCE_MAP: lambda t, v, m: messages.force_map_packer(v[0])(t, MapEstimate(**v[1])),
}


def ros_message(topic: topics.Topic, seed: int) -> Any:
    """A message as ROS has it, with random content: tiles in all lists, bodies with markers."""
    maker = Maker(seed, seed)
    content = maker.message(topic.type)
    if topic in (topics.LOCAL_FORCES, topics.FORCE_MAP):
        for field in (field for field in cdr.fields_of(topic.type) if field.number == 0):
            own = [maker.one(field.type) for _ in range(1 + seed % 3)]
            setattr(content, field.name, np.array(own) if field.type == "float64" else own)
    data = cdr.typestore().serialize_cdr(content, topic.type)
    message = deserialize_message(bytes(data), message_type(topic))
    if topic is topics.MARKERS:
        message.bodies = [body for body in message.bodies if body.markers]
    for number, part in enumerate(getattr(message, "clusters", getattr(message, "bodies", ()))):
        part.name += f"{number}"
    return message


def flat(values: Any) -> Iterator[float]:
    if isinstance(values, dict | list | tuple):
        for own in values.values() if isinstance(values, dict) else values:
            yield from flat(own)
    elif not isinstance(values, str):
        yield from np.ravel(values).tolist()


@pytest.mark.parametrize("topic", PACK, ids=lambda topic: topic.name)
def test_packed_messages_are_those_of_ros(topic: topics.Topic) -> None:
    """And read as such, even after one with other names, other counts, or in another frame."""
    reader = messages.Reader(topic)
    for seed in range(24):
        message = ros_message(topic, seed)
        data = serialize_message(message)
        stamp, values = reader.read(data)
        assert stamp == cdr.stamp_of(message) and type(stamp) is int
        if topic is topics.WRENCH:
            expected = [*wrench_vector(message.wrench)]
        elif topic is topics.LOAD_CELL_RAW:
            taken = 10**9 * message.tared.sec + message.tared.nanosec
            expected = [*(1e3 * message.ratios), *wrench_vector(message.tare), taken]
        elif topic is topics.CAPACITANCE:
            expected = [x for c in message.clusters for x in c.capacitance]
            expected += [x for c in message.clusters for x in c.status]
        else:
            expected = numbers_of(cdr.decode(data, topic.type), topic.type)[2:]
        np.testing.assert_equal(list(flat(values)), expected)
        in_world = topic in (topics.SOCKET_POSE, topics.MARKERS)
        message.header.frame_id = "world" if in_world else "load_cell"
        packed = PACK[topic](stamp, values, message)
        assert len(packed) == len(serialize_message(message))
        if topic is topics.LOAD_CELL_RAW:
            message.ratios = 1e-3 * (1e3 * message.ratios)
        assert repr(deserialize_message(packed, type(message))) == repr(message)


def xyz(vectors: Any) -> np.ndarray:
    return np.array([(v.x, v.y, v.z) for v in vectors]).reshape(-1, 3)


def test_a_model_is_sent_as_it_is_stored(hold_model: Path) -> None:
    stored = read_model(hold_model)
    model, sent = (
        stored.model,
        deserialize_message(messages.model_message(stored), msg.ContactModel),
    )
    assert sent.header == header_to_ros(stored.last_stamp) and sent.variant == model.variant
    assert (tuple(sent.names), list(sent.bias_names)) == (model.names, list(model.force_bias))
    np.testing.assert_array_equal(xyz(sent.stiffness), model.stiffness)
    np.testing.assert_array_equal(xyz(sent.rest_positions), model.rest_positions)
    np.testing.assert_array_equal(xyz(sent.force_bias), [*model.force_bias.values()])
    assert wrench_vector(sent.wrench_bias) == tuple(model.wrench_bias)
    assert wrench_vector(sent.wrench_rmse) == tuple(stored.wrench_rmse)
    assert (sent.samples, sent.solver_status) == (stored.samples, stored.status)


# --- transforms, composed as RViz does it, against the geometry's own formula


def pose_of(transform: Any) -> Pose:
    t, q = transform.transform.translation, transform.transform.rotation
    turn = Rotation.from_quat([q.x, q.y, q.z, q.w])
    return Pose(turn.as_matrix(), np.array([t.x, t.y, t.z]))


TURNED = dataclasses.replace(GEOMETRY, turned={"distal": 0.6})
FRAMES = {name: (parent, pose) for parent, name, pose in fixed_frames(TURNED)}


def test_each_cluster_has_a_frame() -> None:
    assert set(FRAMES) == {"load_cell", *GEOMETRY.clusters}


@pytest.mark.parametrize("name", GEOMETRY.clusters)
def test_a_cluster_s_frame_is_its_tile_s(name: str) -> None:
    """{L}: z is the inward normal, the origin the tile's centre."""
    parent, pose = FRAMES[name]
    tile = GEOMETRY.clusters[name]
    assert parent == "load_cell"
    np.testing.assert_allclose(pose.apply(np.zeros(3)), GEOMETRY.anchors[tile])
    inward = pose.apply(np.array([0.0, 0.0, 1.0])) - GEOMETRY.anchors[tile]
    np.testing.assert_allclose(inward, GEOMETRY.rotations[tile][:, 2])


@pytest.mark.parametrize("name", GEOMETRY.clusters)
def test_a_cluster_s_stress_is_its_force(name: str) -> None:
    """The force that the fit reckons with; the distal cluster is glued on turned."""
    pose, tile = FRAMES[name][1], GEOMETRY.clusters[name]
    normal, shear_x, shear_y = stress = np.array([2e4, 3e3, -1e3])
    force = TURNED.areas[tile] * pose.rotation @ (shear_x, shear_y, -normal)
    expected = TURNED.rotations[tile] @ TURNED.cluster_force(name, stress)
    np.testing.assert_allclose(force, expected)


def test_the_load_cell_is_in_the_socket() -> None:
    parent, load_cell = FRAMES["load_cell"]
    assert parent == "socket"
    both: Pose = GEOMETRY.socket_body @ load_cell
    np.testing.assert_allclose(both.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(both.translation, 0.0, atol=1e-9)


class Listened:
    """Stands for a node that publishes: the messages by topic."""

    def __init__(self) -> None:
        self.sent: dict[str, list[Any]] = defaultdict(list)

    def get_clock(self) -> Clock:
        return Clock()

    def create_publisher(self, kind: Any, name: str, qos: Any) -> SimpleNamespace:
        return SimpleNamespace(publish=self.sent[name].append, get_subscription_count=lambda: 1)


def test_the_transforms_compose_to_the_limb_s_pose() -> None:
    rng, node = np.random.default_rng(0), Listened()
    turns = Rotation.from_rotvec(rng.normal(size=(2, 3)))
    vectors = np.hstack([rng.normal(size=(2, 3)), turns.as_quat()])
    broadcaster = FrameBroadcaster(node, GEOMETRY, "/lab")
    broadcaster.move(7, {topics.SOCKET_POSE: vectors[0], topics.PYLON_POSE: vectors[1]})
    broadcaster.move(8, {topics.SOCKET_POSE: vectors[0], topics.PYLON_POSE: np.nan * vectors[1]})
    broadcaster.move(9, {topics.SOCKET_POSE: np.zeros(7)})  # no rotation has this quaternion
    seen, hidden = (message.transforms for message in node.sent["/lab/tf"])
    assert [t.child_frame_id for t in seen] == ["socket", "limb"]
    assert [t.child_frame_id for t in hidden] == ["socket"]
    assert all(t.header.frame_id == "world" and cdr.stamp_of(t) == 7 for t in seen)
    (fixed,) = node.sent["/lab/tf_static"]
    (load_cell,) = (t for t in fixed.transforms if t.header.frame_id == "socket")
    limb = (pose_of(seen[0]) @ pose_of(load_cell)).inverse() @ pose_of(seen[1])
    expected = GEOMETRY.limb_of(*vectors)
    np.testing.assert_allclose(limb.translation, expected.translation, atol=1e-9)
    np.testing.assert_allclose(limb.rotation, expected.rotation, atol=1e-9)
