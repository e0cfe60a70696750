"""The messages of the force map and its picture."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Vector3, WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo
from shape_msgs.msg import SolidPrimitive
from socket_testbed_msgs.msg import (
    ClusterCapacitanceArray,
    ForceMap,
    LoadCellRaw,
    LocalForceArray,
    Trigger,
)
from visualization_msgs.msg import Marker, MarkerArray

from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.nodes import conversions
from socket_testbed.nodes.conversions import (
    MessageTemplate,
    capacitance_reader,
    capacitance_to_ros,
    elements,
    header_to_ros,
    layout_of,
    load_cell_raw_packer,
    markers_to_ros,
    pose_from_ros,
    pose_packer,
    pose_reader,
    stamp_from_ros,
    stress_reader,
    stress_to_ros,
    trigger_reader,
    wrench_from_ros,
    wrench_packer,
    wrench_reader,
    wrench_to_ros,
)
from socket_testbed.nodes.estimate_messages import (
    ForceMapPacker,
    PressureMap,
    local_forces_packer,
)
from socket_testbed.trials import bag
from socket_testbed.trials.layout import stamps_of

GEOMETRY = read_socket(packaged("config", "socket.yaml"))
STAMP = 1_700_000_000_250_000_000


def made_up_map(seed: int = 0) -> MapEstimate:
    rng = np.random.default_rng(seed)
    count = len(GEOMETRY)
    scalars = (rng.uniform(0.0, 4e4, (1, count)) for _ in range(4))
    return MapEstimate(
        rng.normal(size=(1, count, 3)), rng.uniform(size=(1, count, 3)), *scalars, "made up"
    )


def force_map_to_ros(stamp: int, estimate: MapEstimate) -> ForceMap:
    """The message set field by field, which is what the node has to send."""
    message = ForceMap(
        header=header_to_ros(stamp), names=list(GEOMETRY.names), source=estimate.source
    )
    for field in ("forces", "standard_deviations"):
        values = getattr(estimate, field)[0].tolist()
        setattr(message, field, [Vector3(x=x, y=y, z=z) for x, y, z in values])
    for field in dataclasses.fields(MapEstimate)[2:-1]:
        setattr(message, field.name, getattr(estimate, field.name)[0].tolist())
    return message


def check_sent(sent: bytes, message: Any) -> None:
    """That bytes are what ROS would send, but for what it leaves in the gaps of alignment."""
    assert len(sent) == len(serialize_message(message))
    assert deserialize_message(sent, type(message)) == message


def test_a_map_is_sent_as_ros_would_send_it_and_holds_nothing_of_the_one_before() -> None:
    packer = ForceMapPacker(GEOMETRY.names)
    other = dataclasses.replace(made_up_map(3), source="without a cluster")
    for number, estimate in enumerate((made_up_map(1), made_up_map(2), other, made_up_map(4))):
        sent = packer.packed(STAMP + number, estimate)
        check_sent(sent, force_map_to_ros(STAMP + number, estimate))


def test_local_forces_are_sent_as_ros_would_send_them() -> None:
    pack = local_forces_packer(GEOMETRY.names)
    for number in range(3):
        forces = made_up_map(number).forces[0]
        vectors = [Vector3(x=x, y=y, z=z) for x, y, z in forces.tolist()]
        message = LocalForceArray(
            header=header_to_ros(STAMP + number), names=list(GEOMETRY.names), forces=vectors
        )
        check_sent(pack(STAMP + number, forces), message)


def test_stresses_wrenches_and_poses_are_read_as_ros_reads_them() -> None:
    """Also after a message of another layout: with fewer clusters, or another frame."""
    rng = np.random.default_rng(5)
    stresses, wrenches, poses = stress_reader(), wrench_reader(), pose_reader()
    for number, names in enumerate([("a", "bc"), ("a", "bc"), ("bc",), ("a", "d")]):
        stamp, stress = STAMP + number, rng.normal(size=(len(names), 3))
        status = rng.integers(4, size=len(names)).astype(np.uint8)
        found = stresses.read(serialize_message(stress_to_ros(stamp, names, stress, status)))
        assert found[0] == stamp and tuple(found[1]) == names
        for row, (values, state) in enumerate(found[1].values()):
            np.testing.assert_array_equal(values, stress[row])
            assert state == status[row] and type(state) is int
        header = header_to_ros(stamp, names[0])
        wrench, pose = rng.normal(size=6), rng.normal(size=7)
        message = WrenchStamped(header=header, wrench=wrench_to_ros(wrench))
        read = wrenches.read(serialize_message(message))
        assert read[0] == stamp
        np.testing.assert_array_equal(read[1], wrench)
        read = poses.read(pose_packer()(stamp, pose))
        assert read[0] == stamp
        np.testing.assert_array_equal(read[1], pose)


def markers(pressure: float, deviation: float) -> list[Marker]:
    count = len(GEOMETRY)
    estimate = dataclasses.replace(
        made_up_map(),
        normal_pressure=np.full((1, count), pressure),
        normal_pressure_standard_deviation=np.full((1, count), deviation),
    )
    return sent_markers(PressureMap(GEOMETRY).serialised(STAMP, estimate))


def sent_markers(sent: bytes) -> list[Marker]:
    """Those of a message that is as long as one that ROS sends."""
    message = deserialize_message(sent, MarkerArray)
    assert len(sent) == len(serialize_message(message))
    return list(message.markers)


def test_a_picture_holds_nothing_of_the_one_before() -> None:
    picture = PressureMap(GEOMETRY)
    picture.serialised(1, made_up_map(1))
    found = sent_markers(picture.serialised(STAMP, made_up_map(2)))
    assert found == sent_markers(PressureMap(GEOMETRY).serialised(STAMP, made_up_map(2)))
    assert all(marker.header == header_to_ros(STAMP) for marker in found)
    assert [(marker.ns, marker.id) for marker in found[:3]] == [
        ("tiles", 0), ("forces", 0), ("tiles", 1)
    ]  # fmt: skip


def test_uncertain_tiles_look_uncertain() -> None:
    opacity = [markers(1e4, deviation)[0].color.a for deviation in (0.0, 2e3, 5e3, 9e3, 5e4)]
    assert opacity == sorted(opacity, reverse=True)
    assert opacity[0] == 1.0 and opacity[-1] == pytest.approx(0.1)


def test_the_colour_is_the_normal_pressure() -> None:
    green = [markers(pressure, 1e3)[0].color.g for pressure in (-1e4, 0.0, 1e4, 2e4, 3e4, 9e4)]
    assert green == sorted(green, reverse=True)
    assert green[0] == green[1] and green[-1] == green[-2] == 0.0


def test_the_mesh_of_a_tile_covers_its_area_and_faces_outwards() -> None:
    for i, tile in enumerate(markers(1e4, 1e3)[::2]):
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


def test_a_picture_ends_by_itself_and_its_arrows_start_at_the_tiles() -> None:
    drawn = markers(1e4, 1e3)
    assert len(drawn) == 2 * len(GEOMETRY)
    for marker in drawn:
        assert 0 < marker.lifetime.sec < 10 and marker.header.frame_id == "load_cell"
    forces = made_up_map().forces[0]
    for arrow, anchor, force in zip(drawn[1::2], GEOMETRY.anchors, forces, strict=True):
        (start, tip) = ([p.x, p.y, p.z] for p in arrow.points)
        np.testing.assert_allclose(start, anchor)
        np.testing.assert_allclose(np.subtract(tip, start), 0.002 * force)


def test_markers_of_bodies_of_different_sizes_go_out_as_they_are() -> None:
    socket, pylon = np.arange(15.0).reshape(5, 3), np.full((3, 3), np.nan)
    message = markers_to_ros(STAMP, ("socket", "pylon"), [socket, pylon])
    assert [(body.name, len(body.markers)) for body in message.bodies] == [
        ("socket", 5), ("pylon", 3)
    ]  # fmt: skip
    seen = [(point.x, point.y, point.z) for point in message.bodies[0].markers]
    np.testing.assert_array_equal(seen, socket)
    assert all(np.isnan(point.x) for point in message.bodies[1].markers)


def test_a_layout_fills_and_reads_messages_of_ros() -> None:
    clusters = ("brim_lateral", "mid", "distal")
    rng = np.random.default_rng(0)
    capacitance = rng.normal(size=(2, 3, 4))
    status = rng.integers(3, size=(2, 3, 4), dtype=np.uint8)
    first, second = (
        capacitance_to_ros(STAMP + i, clusters, capacitance[i], status[i]) for i in range(2)
    )
    layout = layout_of(first)
    content, blank = layout.blank()
    record = layout.record(serialize_message(second))
    assert record is not None
    for number in range(len(clusters)):
        np.testing.assert_array_equal(
            record["clusters"][str(number)]["capacitance"], capacitance[1, number]
        )
    assert stamps_of(record) == STAMP + 1
    blank[()] = record
    assert deserialize_message(bytes(content), ClusterCapacitanceArray) == second


@pytest.mark.parametrize("kind", [ForceMap, Marker, DiagnosticArray, CameraInfo, SolidPrimitive])
def test_a_layout_knows_the_types_of_ros(kind: type) -> None:
    """The fields are those that the offline side reads from the same definitions."""
    package, name = kind.__module__.partition(".")[0], kind.__name__
    named = [
        field._replace(type=field.type.replace("/msg/", "/"))
        for field in bag.fields_of(f"{package}/msg/{name}")
    ]
    assert list(conversions.fields_of(f"{package}/{name}")) == named


CLUSTERS = ("brim_lateral", "mid", "distal")
NUMBERS = np.random.default_rng(1).normal(size=(3, 4))
NUMBERS[1, 2] = np.nan
STATES = np.array([[0, 1, 2, 0], [0, 0, 2, 0], [0, 0, 0, 3]], dtype=np.uint8)


def test_packed_wrenches_and_poses_are_what_ros_decodes() -> None:
    pack_wrench, pack_pose, pack_raw = wrench_packer(), pose_packer(), load_cell_raw_packer()
    for number in range(3):
        values = np.append(NUMBERS[number], NUMBERS[1, :3])
        wrench = deserialize_message(pack_wrench(STAMP + number, values[:6]), WrenchStamped)
        assert wrench.header == header_to_ros(STAMP + number)
        np.testing.assert_array_equal(wrench_from_ros(wrench.wrench), values[:6])
        pose = deserialize_message(pack_pose(STAMP + number, values), PoseStamped)
        assert pose.header == header_to_ros(STAMP + number, "world")
        np.testing.assert_array_equal(pose_from_ros(pose.pose), values)
        taken = pack_raw(STAMP + number, values[:6], values[1:], STAMP + 7, number)
        raw = deserialize_message(taken, LoadCellRaw)
        assert (raw.header, raw.status) == (header_to_ros(STAMP + number), number)
        assert stamp_from_ros(raw.tared) == STAMP + 7
        np.testing.assert_array_equal(raw.ratios, 1e-3 * values[:6])
        np.testing.assert_array_equal(wrench_from_ros(raw.tare), values[1:])


@pytest.mark.parametrize("names", [CLUSTERS, CLUSTERS[:1], ()])
def test_messages_of_clusters_are_packed_and_read_as_ros_does(names: tuple[str, ...]) -> None:
    count = len(names)
    reader = capacitance_reader()
    plain = MessageTemplate(capacitance_to_ros(0, names, np.zeros((count, 4)), STATES[:count] * 0))
    stress = MessageTemplate(stress_to_ros(0, names, np.zeros((count, 3)), STATES[:count, 0]))
    for stamp in (STAMP, STAMP + 1):
        message = capacitance_to_ros(stamp, names, NUMBERS[:count], STATES[:count])
        for i, cluster in enumerate(elements(plain.numbers, "clusters")):
            cluster["capacitance"], cluster["status"] = NUMBERS[i], STATES[i]
        for i, cluster in enumerate(elements(stress.numbers, "clusters")):
            cluster[()] = (*NUMBERS[i, :3], STATES[i, 1])
        found = deserialize_message(plain.serialised(stamp), ClusterCapacitanceArray)
        assert repr(found) == repr(message)  # NaN equals NaN
        expected = stress_to_ros(stamp, names, NUMBERS[:count, :3], STATES[:count, 1])
        packed = deserialize_message(stress.serialised(stamp), type(expected))
        assert repr(packed) == repr(expected)
        read = reader.read(serialize_message(message))
        assert (read.stamp, read.names) == (stamp, names)
        np.testing.assert_array_equal(read.capacitance, NUMBERS[:count])
        np.testing.assert_array_equal(read.status, STATES[:count])


def test_a_reader_follows_what_changes_between_messages() -> None:
    reader, rng = capacitance_reader(), np.random.default_rng(2)
    for names in (CLUSTERS, CLUSTERS[::-1], CLUSTERS, CLUSTERS[:2], CLUSTERS[:2], ("x", "y")):
        values = rng.normal(size=(len(names), 4))
        status = rng.integers(3, size=values.shape, dtype=np.uint8)
        read = reader.read(serialize_message(capacitance_to_ros(STAMP, names, values, status)))
        assert read.names == names
        np.testing.assert_array_equal(read.capacitance, values)
        np.testing.assert_array_equal(read.status, status)


def test_triggers_are_read_whatever_their_frame() -> None:
    reader = trigger_reader()
    for sequence, frame in enumerate(("", "", "load_cell", "load_cell")):
        message = Trigger(header=header_to_ros(STAMP + sequence, frame), sequence=2**40 + sequence)
        assert reader.read(serialize_message(message)) == (STAMP + sequence, 2**40 + sequence)
