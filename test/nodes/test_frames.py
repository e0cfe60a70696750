"""The transforms of a testbed, composed as RViz does it, against the geometry's own formula."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from types import SimpleNamespace
from typing import Any

import numpy as np
from rclpy.clock import Clock
from scipy.spatial.transform import Rotation

from socket_testbed.files import packaged
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import read_socket
from socket_testbed.nodes.mocap_node import FrameBroadcaster, fixed_frames
from socket_testbed.trials.layout import stamp_of
from socket_testbed.trials.topics import PYLON_POSE, SOCKET_POSE

GEOMETRY = read_socket(packaged("config", "socket.yaml"))


def pose_of(transform: Any) -> Pose:
    """A transform's pose, from the message's own fields."""
    t, q = transform.transform.translation, transform.transform.rotation
    turn = Rotation.from_quat([q.x, q.y, q.z, q.w])
    return Pose(turn.as_matrix(), np.array([t.x, t.y, t.z]))


def test_a_cluster_s_frame_is_its_tile_s_turned_as_it_is_glued() -> None:
    geometry = dataclasses.replace(GEOMETRY, turned={"distal": 0.6})
    found = {name: (parent, pose) for parent, name, pose in fixed_frames(geometry)}
    assert set(found) == {"load_cell", *GEOMETRY.clusters}
    for name, tile in GEOMETRY.clusters.items():
        parent, pose = found[name]
        assert parent == "load_cell"
        # {L}: z is the inward normal, the origin the tile's centre.
        np.testing.assert_allclose(pose.apply(np.zeros(3)), GEOMETRY.anchors[tile])
        inward = pose.apply(np.array([0.0, 0.0, 1.0])) - GEOMETRY.anchors[tile]
        np.testing.assert_allclose(inward, GEOMETRY.rotations[tile][:, 2])
        # A stress along the axes of the cluster's frame is the force that the fit reckons with.
        normal, shear_x, shear_y = stress = np.array([2e4, 3e3, -1e3])
        force = geometry.areas[tile] * pose.rotation @ (shear_x, shear_y, -normal)
        expected = geometry.rotations[tile] @ geometry.cluster_force(name, stress)
        np.testing.assert_allclose(force, expected)
    parent, load_cell = found["load_cell"]
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


def test_the_transforms_compose_to_the_limb_in_the_socket() -> None:
    rng, node = np.random.default_rng(0), Listened()
    turns = Rotation.from_rotvec(rng.normal(size=(2, 3)))
    vectors = np.hstack([rng.normal(size=(2, 3)), turns.as_quat()])
    broadcaster = FrameBroadcaster(node, GEOMETRY, "/lab")
    broadcaster.move(7, {SOCKET_POSE: vectors[0], PYLON_POSE: vectors[1]})
    broadcaster.move(8, {SOCKET_POSE: vectors[0], PYLON_POSE: np.nan * vectors[1]})
    seen, hidden = (message.transforms for message in node.sent["/lab/tf"])
    assert [t.child_frame_id for t in seen] == ["socket", "limb"]
    assert [t.child_frame_id for t in hidden] == ["socket"]
    assert all(t.header.frame_id == "world" and stamp_of(t) == 7 for t in seen)
    (fixed,) = node.sent["/lab/tf_static"]
    (load_cell,) = (t for t in fixed.transforms if t.header.frame_id == "socket")
    limb = (pose_of(seen[0]) @ pose_of(load_cell)).inverse() @ pose_of(seen[1])
    bodies = (Pose.from_quaternion(vector[:3], vector[3:]) for vector in vectors)
    expected = GEOMETRY.limb_pose(*bodies)
    np.testing.assert_allclose(limb.translation, expected.translation, atol=1e-9)
    np.testing.assert_allclose(limb.rotation, expected.rotation, atol=1e-9)
