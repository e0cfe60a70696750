"""Transforms of the socket, its load cell and clusters, and the limb, for RViz and others.

    world -> socket -> load_cell -> each cluster      world -> limb

Moving frames follow the motion capture, on tf; fixed frames come from the socket's geometry, on
tf_static, both in the namespace of the testbed. mocap_node publishes them live, replay_node in a
replay.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from tf2_msgs.msg import TFMessage

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.nodes import base
from socket_testbed.wire import messages, topics

SOCKET_FRAME = "socket"  # the socket's marker body
LIMB_FRAME = "limb"  # origin at the lumped mass


class FrameBroadcaster:
    """Publishes the transforms, on tf and once on tf_static.

    Args:
        node: The node that publishes.
        geometry: The socket: poses of its marker body and clusters in {S}, and of the limb in the
            pylon's marker body.
        namespace: Absolute namespace of both topics; empty for the node's own.
    """

    def __init__(
        self, node: base.TestbedNode[Any], geometry: SocketGeometry, namespace: str = ""
    ) -> None:
        self._bodies = {
            topics.SOCKET_POSE: (SOCKET_FRAME, Pose(np.eye(3), np.zeros(3))),
            topics.PYLON_POSE: (LIMB_FRAME, geometry.limb),
        }
        self._publisher, static = (
            node.create_publisher(
                TFMessage,
                topics.full_name(topic.name, namespace) if namespace else topic.name,
                base.publisher_qos(topic),
            )
            for topic in (topics.TF, topics.TF_STATIC)
        )
        now = node.get_clock().now().nanoseconds
        fixed = [_transform(now, *entry) for entry in fixed_frames(geometry)]
        static.publish(TFMessage(transforms=fixed))

    @property
    def wanted(self) -> bool:
        """Whether anybody subscribes."""
        return bool(self._publisher.get_subscription_count())

    def move(self, stamp: int, poses: Mapping[topics.Topic, FloatArray]) -> None:
        """Publish the frames `socket` and `limb` in the world; unseen bodies are left out.

        Args:
            stamp: Stamp of the poses since the epoch [ns].
            poses: Of SOCKET_POSE, PYLON_POSE or both: position [m] and quaternion (x, y, z, w) of
                the marker body in the world, shape (7,).
        """
        if not self.wanted:
            return
        transforms = []
        for topic, vector in poses.items():
            pose = Pose.from_vector(vector)
            if np.isfinite(pose.rotation).all() and np.isfinite(pose.translation).all():
                name, in_body = self._bodies[topic]
                transforms.append(_transform(stamp, messages.WORLD_FRAME, name, pose @ in_body))
        if transforms:
            self._publisher.publish(TFMessage(transforms=transforms))


def fixed_frames(geometry: SocketGeometry) -> list[tuple[str, str, Pose]]:
    """The fixed frames of a socket: parent, name, and pose in the parent [m].

    `load_cell`, which is {S}, in `socket`, and each cluster's own frame in `load_cell`.
    """
    rotations = geometry.square_frames()
    clusters = [
        (messages.LOAD_CELL_FRAME, name, Pose(rotations[tile], geometry.anchors[tile]))
        for name, tile in geometry.clusters.items()
    ]
    return [(SOCKET_FRAME, messages.LOAD_CELL_FRAME, geometry.socket_body.inverse()), *clusters]


def _transform(stamp: int, parent: str, name: str, pose: Pose) -> TransformStamped:
    return TransformStamped(
        header=base.header_to_ros(stamp, parent),
        child_frame_id=name,
        transform=Transform(
            translation=Vector3(**messages.named(pose.translation)),
            rotation=Quaternion(**messages.named(pose.quaternion())),
        ),
    )
