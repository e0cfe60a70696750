"""The contract's messages: as ROS has them, and as the testbed reads, packs and draws them."""

import dataclasses
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Vector3, Wrench, WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from socket_testbed_msgs import msg
from support import CHECKOUT
from visualization_msgs.msg import Marker, MarkerArray

from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.model_file import read_model
from socket_testbed.nodes.base import header_to_ros, stamp_to_ros
from socket_testbed.nodes.estimator_node import PressureMap, model_message
from socket_testbed.trials.layout import typestore
from socket_testbed.trials.messages import (
    Reader,
    capacitance_packer,
    force_map_packer,
    load_cell_raw_packer,
    local_forces_packer,
    markers_packer,
    pose_packer,
    stress_packer,
    trigger_packer,
    wrench_packer,
)
from socket_testbed.trials.topics import (
    CAPACITANCE,
    FORCE_MAP,
    LOAD_CELL_RAW,
    LOCAL_FORCES,
    MARKERS,
    SOCKET_POSE,
    STRESS,
    TRIGGER,
    WRENCH,
    Topic,
)

FOLDER = CHECKOUT / "msg_defs" / "msg"
GEOMETRY = read_socket(packaged("config", "socket.yaml"))
STAMP = 1_700_000_000_250_000_000
CONTRACT = {
    "Trigger": "std_msgs/Header header; uint64 sequence",
    "ClusterCapacitance": "string name; float64[4] capacitance; uint8[4] status",
    "ClusterCapacitanceArray": "std_msgs/Header header; ClusterCapacitance[] clusters",
    "LoadCellRaw": (
        "std_msgs/Header header; float64[6] ratios; geometry_msgs/Wrench tare;"
        " builtin_interfaces/Time tared; uint8 status"
    ),
    "RigidBodyMarkers": "string name; geometry_msgs/Point[] markers",
    "RigidBodyMarkersArray": "std_msgs/Header header; RigidBodyMarkers[] bodies",
    "ClusterStress": (
        "string name; float64 normal; float64 shear_x; float64 shear_y; uint8 status"
    ),
    "ClusterStressArray": "std_msgs/Header header; ClusterStress[] clusters",
    "LocalForceArray": ("std_msgs/Header header; string[] names; geometry_msgs/Vector3[] forces"),
    "ForceMap": (
        "std_msgs/Header header; string[] names; geometry_msgs/Vector3[] forces;"
        " geometry_msgs/Vector3[] standard_deviations; float64[] normal_pressure;"
        " float64[] normal_pressure_standard_deviation; float64[] shear;"
        " float64[] shear_standard_deviation; string source"
    ),
    "ContactModel": (
        "std_msgs/Header header; string variant; string[] names;"
        " geometry_msgs/Vector3[] stiffness; geometry_msgs/Vector3[] rest_positions;"
        " geometry_msgs/Wrench wrench_bias; string[] bias_names;"
        " geometry_msgs/Vector3[] force_bias; geometry_msgs/Wrench wrench_rmse;"
        " uint32 samples; string solver_status"
    ),
    "Event": "std_msgs/Header header; string label",
}


def test_the_messages_are_the_contract_s_with_a_unit_a_field() -> None:
    assert {path.stem for path in FOLDER.glob("*.msg")} == set(CONTRACT)
    for name, content in CONTRACT.items():
        text = (FOLDER / f"{name}.msg").read_text().splitlines()
        lines = [line.partition("#")[0].split() for line in text]
        fields = [tuple(words) for words in lines if len(words) == 2 and "=" not in words[1]]
        assert fields == [tuple(field.split()) for field in content.split(";")]
        names = [field for _, field in fields]
        assert list(getattr(msg, name).get_fields_and_field_types()) == names
        offline = typestore().types[f"socket_testbed_msgs/msg/{name}"].__dataclass_fields__
        assert [f for f in offline if f.islower() and f != "__msgtype__"] == names
        for line in text:
            assert not line or line.startswith("#") or re.search(r"#.*\[[^\]]+\]", line), line


# A message of each type as ROS has it, and its numbers. The second number is missing.


@dataclasses.dataclass
class Case:
    """A message, set field by field; what its packer takes, and what its reader gives."""

    message: Any
    given: tuple[Any, ...]
    read: Any


Numbers = Callable[..., np.ndarray]


def vector(values: np.ndarray) -> Vector3:
    return Vector3(**dict(zip("xyz", values.tolist(), strict=True)))


def ros_wrench(values: np.ndarray) -> Wrench:
    return Wrench(torque=vector(values[:3]), force=vector(values[3:]))


def trigger(stamp: int, names: tuple[str, ...], numbers: Numbers) -> Case:
    sequence = 2**40 + stamp % 7
    message = msg.Trigger(header=header_to_ros(stamp), sequence=sequence)
    return Case(message, (sequence,), sequence)


def wrench(stamp: int, names: tuple[str, ...], numbers: Numbers) -> Case:
    values = numbers(6)
    message = WrenchStamped(header=header_to_ros(stamp), wrench=ros_wrench(values))
    return Case(message, (values,), values)


def pose(stamp: int, names: tuple[str, ...], numbers: Numbers) -> Case:
    values = numbers(7)
    x, y, z, *turn = values.tolist()
    where = Pose(
        position=Point(x=x, y=y, z=z),
        orientation=Quaternion(**dict(zip("xyzw", turn, strict=True))),
    )
    message = PoseStamped(header=header_to_ros(stamp, "world"), pose=where)
    return Case(message, (values,), values)


def raw(stamp: int, names: tuple[str, ...], numbers: Numbers) -> Case:
    ratios, tare = numbers(6), numbers(6)
    message = msg.LoadCellRaw(
        header=header_to_ros(stamp),
        ratios=1e-3 * ratios,
        tare=ros_wrench(tare),
        tared=stamp_to_ros(STAMP + 7),
        status=2,
    )
    return Case(message, (ratios, tare, STAMP + 7, 2), np.concatenate([1e-3 * ratios, tare]))


def capacitance(stamp: int, names: tuple[str, ...], numbers: Numbers) -> Case:
    values = numbers(len(names), 4)
    status = (np.arange(4 * len(names)).reshape(-1, 4) % 3).astype(np.uint8)
    clusters = [
        msg.ClusterCapacitance(name=name, capacitance=values[i], status=status[i])
        for i, name in enumerate(names)
    ]
    message = msg.ClusterCapacitanceArray(header=header_to_ros(stamp), clusters=clusters)
    return Case(message, (values, status), (names, values, status))


def stress(stamp: int, names: tuple[str, ...], numbers: Numbers) -> Case:
    values, status = numbers(len(names), 3), np.arange(len(names), dtype=np.uint8)
    clusters = [
        msg.ClusterStress(name=name, normal=n, shear_x=x, shear_y=y, status=i)
        for i, (name, (n, x, y)) in enumerate(zip(names, values.tolist(), strict=True))
    ]
    message = msg.ClusterStressArray(header=header_to_ros(stamp), clusters=clusters)
    read = {name: (values[i], i) for i, name in enumerate(names)}
    return Case(message, (values, status), read)


def markers(stamp: int, names: tuple[str, ...], numbers: Numbers) -> Case:
    values = [numbers(len(name), 3) for name in names]
    bodies = [
        msg.RigidBodyMarkers(name=name, markers=[Point(x=x, y=y, z=z) for x, y, z in own.tolist()])
        for name, own in zip(names, values, strict=True)
    ]
    message = msg.RigidBodyMarkersArray(header=header_to_ros(stamp, "world"), bodies=bodies)
    return Case(message, (values,), list(zip(names, values, strict=True)))


def local_forces(stamp: int, names: tuple[str, ...], numbers: Numbers) -> Case:
    values = numbers(len(names), 3)
    message = msg.LocalForceArray(
        header=header_to_ros(stamp), names=list(names), forces=[vector(v) for v in values]
    )
    return Case(message, (values,), values)


def force_map(stamp: int, names: tuple[str, ...], numbers: Numbers) -> Case:
    vectors, scalars = numbers(2, 1, len(names), 3), numbers(4, 1, len(names))
    estimate = MapEstimate(*vectors, *scalars, source=f"made up {stamp % 2}")
    message = msg.ForceMap(
        header=header_to_ros(stamp), names=list(names), source=estimate.source,
        forces=[vector(v) for v in vectors[0, 0]],
        standard_deviations=[vector(v) for v in vectors[1, 0]],
        normal_pressure=scalars[0, 0], normal_pressure_standard_deviation=scalars[1, 0],
        shear=scalars[2, 0], shear_standard_deviation=scalars[3, 0],
    )  # fmt: skip
    return Case(message, (estimate,), (names, vars(estimate)))


CASES: dict[Topic, tuple[Any, Any]] = {
    TRIGGER: (trigger, lambda names: trigger_packer()),
    WRENCH: (wrench, lambda names: wrench_packer()),
    SOCKET_POSE: (pose, lambda names: pose_packer()),
    LOAD_CELL_RAW: (raw, lambda names: load_cell_raw_packer()),
    CAPACITANCE: (capacitance, capacitance_packer),
    STRESS: (stress, stress_packer),
    MARKERS: (markers, lambda names: markers_packer({name: len(name) for name in names})),
    LOCAL_FORCES: (local_forces, local_forces_packer),
    FORCE_MAP: (force_map, force_map_packer),
}


@pytest.mark.parametrize("topic", CASES, ids=lambda topic: topic.name)
def test_what_ros_sends_is_read_and_what_is_packed_is_what_ros_sends(topic: Topic) -> None:
    """Also after a message with other names, fewer elements, none, or in another frame."""
    make, packer_of = CASES[topic]
    rng, reader, packers = np.random.default_rng(5), Reader(topic), cache(packer_of)

    def numbers(*shape: int) -> np.ndarray:
        values = rng.normal(size=shape)
        values.reshape(-1)[1:2] = np.nan
        return values

    clusters = topic in (CAPACITANCE, STRESS, MARKERS)
    fewer: tuple[str, ...] = () if clusters else ("a",)
    several = (("a", "bcd"), ("a", "bcd"), ("bcd", "a"), ("bc",), fewer, ("a", "bce"))
    for number, names in enumerate(several):
        case = make(STAMP + number, names, numbers)
        stamp, read = reader.read(serialize_message(case.message))
        assert stamp == STAMP + number and type(stamp) is int
        np.testing.assert_equal(read, case.read)
        packed = packers(names)(STAMP + number, *case.given)
        assert len(packed) == len(serialize_message(case.message))
        assert repr(deserialize_message(packed, type(case.message))) == repr(case.message)
        case.message.header.frame_id = "elsewhere"
        np.testing.assert_equal(reader.read(serialize_message(case.message))[1], case.read)


def test_a_model_is_sent_as_it_is_stored(hold_model: Path) -> None:
    stored = read_model(hold_model)
    model, sent = stored.model, deserialize_message(model_message(stored), msg.ContactModel)
    assert sent.header == header_to_ros(stored.last_stamp) and sent.variant == model.variant
    assert (tuple(sent.names), list(sent.bias_names)) == (model.names, list(model.force_bias))
    assert sent.stiffness == [vector(row) for row in model.stiffness]
    assert sent.rest_positions == [vector(row) for row in model.rest_positions]
    assert sent.force_bias == [vector(row) for row in model.force_bias.values()]
    assert sent.wrench_bias == ros_wrench(model.wrench_bias)
    assert sent.wrench_rmse == ros_wrench(stored.wrench_rmse)
    assert (sent.samples, sent.solver_status) == (stored.samples, stored.status)


def made_up_map(seed: int = 0, **fixed: float) -> MapEstimate:
    rng, count = np.random.default_rng(seed), len(GEOMETRY)
    scalars = (rng.uniform(0.0, 4e4, (1, count)) for _ in range(4))
    estimate = MapEstimate(
        rng.normal(size=(1, count, 3)), rng.uniform(size=(1, count, 3)), *scalars, "made up"
    )
    return dataclasses.replace(
        estimate, **{name: np.full((1, count), value) for name, value in fixed.items()}
    )


def drawn(estimate: MapEstimate, picture: PressureMap | None = None) -> list[Marker]:
    """The markers of a message that is as long as one that ROS sends."""
    sent = (picture or PressureMap(GEOMETRY)).serialised(STAMP, estimate)
    message = deserialize_message(sent, MarkerArray)
    assert len(sent) == len(serialize_message(message))
    return list(message.markers)


def test_a_picture_holds_nothing_of_the_one_before() -> None:
    picture = PressureMap(GEOMETRY)
    picture.serialised(1, made_up_map(1))
    found = drawn(made_up_map(2), picture)
    assert found == drawn(made_up_map(2))
    assert all(marker.header == header_to_ros(STAMP) for marker in found)
    names = [(marker.ns, marker.id) for marker in found[:3]]
    assert names == [("tiles", 0), ("forces", 0), ("tiles", 1)]


def test_the_colour_is_the_normal_pressure_and_what_is_uncertain_is_faint() -> None:
    def colour(pressure: float, deviation: float = 1e3) -> Any:
        given = {"normal_pressure": pressure, "normal_pressure_standard_deviation": deviation}
        return drawn(made_up_map(**given))[0].color

    green = [colour(pressure).g for pressure in (-1e4, 0.0, 1e4, 2e4, 3e4, 9e4)]
    assert green == sorted(green, reverse=True)
    assert green[0] == green[1] and green[-1] == green[-2] == 0.0
    opacity = [colour(1e4, deviation).a for deviation in (0.0, 2e3, 5e3, 9e3, 5e4)]
    assert opacity == sorted(opacity, reverse=True)
    assert opacity[0] == 1.0 and opacity[-1] == pytest.approx(0.1)


def test_tiles_cover_their_areas_and_face_outwards_and_arrows_start_at_them() -> None:
    estimate = made_up_map()
    found = drawn(estimate)
    assert len(found) == 2 * len(GEOMETRY)
    for marker in found:  # it ends by itself
        assert 0 < marker.lifetime.sec < 10 and marker.header.frame_id == "load_cell"
    for i, (tile, arrow) in enumerate(zip(found[::2], found[1::2], strict=True)):
        assert tile.type == Marker.TRIANGLE_LIST and (tile.scale.x, tile.color.a > 0.0) == (1, True)
        q, p = tile.pose.orientation, tile.pose.position
        turn = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        corners = np.array([(c.x, c.y, c.z) for c in tile.points]) @ turn.T + (p.x, p.y, p.z)
        sides = corners.reshape(2, 3, 3)
        normals = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
        assert 0.5 * np.linalg.norm(normals, axis=1).sum() == pytest.approx(GEOMETRY.areas[i])
        outwards = -GEOMETRY.rotations[i][:, 2]
        np.testing.assert_allclose(normals / np.linalg.norm(normals[0]), [outwards] * 2, atol=1e-9)
        np.testing.assert_allclose(sides.mean(axis=(0, 1)), GEOMETRY.anchors[i], atol=0.02)
        (start, tip) = ([p.x, p.y, p.z] for p in arrow.points)
        np.testing.assert_allclose(start, GEOMETRY.anchors[i])
        np.testing.assert_allclose(np.subtract(tip, start), 0.002 * estimate.forces[0, i])
