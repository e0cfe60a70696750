"""Where socket, load cell, clusters and limb are, as transforms for RViz and others.

    world -> socket -> load_cell -> each cluster      world -> limb

What moves follows the poses of the motion capture, on /tf; the rest is the socket's geometry, on
/tf_static. mocap_node publishes them at the testbed, replay_node when a trial is replayed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.nodes.base import TestbedNode, header_to_ros, message_type, publisher_qos
from socket_testbed.trials.messages import LOAD_CELL_FRAME, WORLD_FRAME
from socket_testbed.trials.topics import PYLON_POSE, SOCKET_POSE, TF, TF_STATIC, Topic

SOCKET_FRAME = "socket"  # the socket's marker body
LIMB_FRAME = "limb"  # its origin is the lumped mass

Send = Callable[[list[TransformStamped]], None]


class FrameBroadcaster:
    """Publishes the transforms of a testbed; nothing where tf2_msgs is missing.

    Without a namespace of their own, the topics are as the node's are remapped.
    """

    def __init__(
        self, node: TestbedNode[Any], geometry: SocketGeometry, namespace: str = ""
    ) -> None:
        self._bodies = {
            SOCKET_POSE: (SOCKET_FRAME, Pose(np.eye(3), np.zeros(3))),
            PYLON_POSE: (LIMB_FRAME, geometry.limb),
        }
        self._send: Send | None = None
        self._node, self._topic = node, node.resolve_topic_name(namespace + TF.name)
        try:
            send_static = _sender(node, TF_STATIC, namespace)
            self._send = _sender(node, TF, namespace)
        except ImportError:
            node.get_logger().warning(
                "tf2_msgs cannot be imported: transforms are left out: install ros-jazzy-tf2-msgs"
            )
            return
        now = node.get_clock().now().nanoseconds
        send_static([_transform(now, *entry) for entry in fixed_frames(geometry)])

    @property
    def wanted(self) -> bool:
        """Whether anybody subscribes."""
        return self._send is not None and self._node.count_subscribers(self._topic) > 0

    def move(self, stamp: int, poses: Mapping[Topic, FloatArray]) -> None:
        """Publish where socket and limb are; what the motion capture did not see is left out.

        The poses of a stamp [ns], of SOCKET_POSE, PYLON_POSE or both, are position [m] and
        quaternion (x, y, z, w), shape (7,).
        """
        if self._send is None or not self.wanted:
            return
        transforms = []
        for topic, vector in poses.items():
            if np.isfinite(vector).all():
                pose = Pose.from_quaternion(vector[:3], vector[3:])
                name, in_body = self._bodies[topic]
                transforms.append(_transform(stamp, WORLD_FRAME, name, pose @ in_body))
        if transforms:
            self._send(transforms)


def fixed_frames(geometry: SocketGeometry) -> list[tuple[str, str, Pose]]:
    """The frames that do not move: parent, name, and pose in the parent."""
    rotations = geometry.square_frames()
    clusters = [
        (LOAD_CELL_FRAME, name, Pose(rotations[tile], geometry.anchors[tile]))
        for name, tile in geometry.clusters.items()
    ]
    return [(SOCKET_FRAME, LOAD_CELL_FRAME, geometry.socket_body.inverse()), *clusters]


def _transform(stamp: int, parent: str, name: str, pose: Pose) -> TransformStamped:
    return TransformStamped(
        header=header_to_ros(stamp, parent),
        child_frame_id=name,
        transform=Transform(
            translation=Vector3(**dict(zip("xyz", pose.translation.tolist(), strict=True))),
            rotation=Quaternion(**dict(zip("xyzw", pose.quaternion().tolist(), strict=True))),
        ),
    )


def _sender(node: TestbedNode[Any], topic: Topic, namespace: str) -> Send:
    """What sends transforms; an ImportError without tf2_msgs."""
    kind = message_type(topic)
    publisher = node.create_publisher(kind, namespace + topic.name, publisher_qos(topic))
    return lambda transforms: publisher.publish(kind(transforms=transforms))
