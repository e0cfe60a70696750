"""Motion-capture node: the bodies' markers and poses at each trigger, from NatNet.

Subscribes: trigger, recorder/trial. Publishes: mocap/socket/pose, mocap/pylon/pose,
mocap/markers, /diagnostics.
"""

from __future__ import annotations

from pathlib import Path

from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.task import Future
from socket_testbed_msgs.msg import RigidBodyMarkersArray
from std_msgs.msg import String

from socket_testbed import clocks
from socket_testbed.drivers.natnet.client import NatNetClient
from socket_testbed.drivers.natnet.tracker import BodyTracker, MocapSample
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.nodes.conversions import header_to_ros, markers_to_ros, pose_to_ros
from socket_testbed.nodes.diagnostics import LEVELS, SETTLE, Diagnostics, RecentFault
from socket_testbed.nodes.parameters import Parameters
from socket_testbed.nodes.runtime import latched_qos, publisher_qos, run_node
from socket_testbed.nodes.trigger_follower import TriggerFollower
from socket_testbed.settings.acquisition import MocapSettings
from socket_testbed.trials.topics import MARKERS, PYLON_POSE, RECORDED_TRIAL, SOCKET_POSE

_WORLD = "world"


class MocapNode(Node):
    """Interpolates the bodies to each trigger's time; what is not seen is missing."""

    def __init__(self) -> None:
        super().__init__("mocap_node")
        self.finished = Future()
        self._adjustable = Parameters(self, MocapSettings)
        settings = self._adjustable.settings
        path = settings.geometry
        geometry = read_socket(Path(path) if path else packaged("config", "socket.yaml"))
        self._stale = settings.stale
        self._tracker = BodyTracker(settings, geometry.socket_markers, geometry.pylon_markers)
        self._client = NatNetClient(settings, self._tracker.add)
        self._samples = 0
        self._missing = 0
        self._fault = RecentFault()
        self._poses = [
            self.create_publisher(PoseStamped, topic.name, publisher_qos(topic))
            for topic in (SOCKET_POSE, PYLON_POSE)
        ]
        self._markers = self.create_publisher(
            RigidBodyMarkersArray, MARKERS.name, publisher_qos(MARKERS)
        )
        self._client.start()
        self._follower = TriggerFollower(self, self._on_trigger, self._watch)
        self._recorded = self.create_subscription(
            String, RECORDED_TRIAL, self._on_recorded, latched_qos()
        )
        self._diagnostics = Diagnostics(
            self,
            lambda: {"samples": self._samples, "missing": self._missing, **self._client.figures()},
            inputs=(self._follower.subscription,),
            offered=(*self._poses, self._markers),
            look=self._look,
            settle=SETTLE,
        )

    def close(self) -> None:
        """Stop following and leave the server."""
        self._follower.close()
        self._client.close()

    def _on_trigger(self, stamp: int, moment: float) -> None:
        self._tracker.wait(moment, moment + self._stale)
        sample = self._sample(moment)
        self._samples += 1
        header = header_to_ros(stamp, _WORLD)
        for publisher, position, quaternion in zip(
            self._poses, sample.positions, sample.quaternions, strict=True
        ):
            publisher.publish(PoseStamped(header=header, pose=pose_to_ros(position, quaternion)))
        self._markers.publish(markers_to_ros(stamp, _WORLD, ("socket", "pylon"), sample.markers))
        self._missing += any(sample.faults)

    def _watch(self) -> None:
        """While no trigger comes, see how the bodies are."""
        self._sample(clocks.monotonic() - self._stale)

    def _sample(self, moment: float) -> MocapSample:
        sample = self._tracker.sample(moment)
        faults = dict.fromkeys(fault for fault in sample.faults if fault)
        if faults:
            self._fault.saw("; ".join(faults))
        return sample

    def _on_recorded(self, message: String) -> None:
        if self._adjustable.settings.record_takes:
            self._client.set_recording(message.data or None)

    def _look(self) -> None:
        level, message = self._client.health(clocks.monotonic())
        if level < 2 and (fault := self._fault.text()):
            level, message = 1, fault
        elif level == 0 and (note := self._client.recording_fault or self._follower.note):
            level, message = 1, note
        self._diagnostics.report(LEVELS[level], message)


def main() -> None:
    """Run the node."""
    run_node(MocapNode)


if __name__ == "__main__":
    main()
