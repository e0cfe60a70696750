"""Motion-capture node: the bodies' markers and poses at each trigger, from NatNet.

Subscribes: trigger, recorder/trial. Publishes: mocap/socket/pose, mocap/pylon/pose,
mocap/markers, /tf, /tf_static, /diagnostics.

A pose is the mean of the frames in a window centred on the trigger, and published half a window
after it; the markers are interpolated at the trigger.
"""

from __future__ import annotations

import numpy as np
from std_msgs.msg import String

from socket_testbed import clocks
from socket_testbed.drivers.natnet.client import NatNetClient
from socket_testbed.drivers.natnet.tracker import BodyTracker, SeenBody
from socket_testbed.errors import ConfigurationError
from socket_testbed.geometry.socket import read_socket
from socket_testbed.nodes.base import ERROR, OK, WARN, file_or_packaged
from socket_testbed.nodes.frames import FrameBroadcaster
from socket_testbed.nodes.sensor_node import SensorNode, averaging_span
from socket_testbed.settings.acquisition import MocapSettings
from socket_testbed.trials.messages import markers_packer, pose_packer
from socket_testbed.trials.topics import MARKERS, PYLON_POSE, RECORDED_TRIAL, SOCKET_POSE


class MocapNode(SensorNode[MocapSettings]):
    """Averages the bodies' poses around each trigger; what is not seen is missing."""

    def __init__(self) -> None:
        super().__init__("mocap_node", MocapSettings)
        settings = self.settings
        geometry = read_socket(file_or_packaged(settings.geometry, "socket.yaml"))
        self._stale = settings.stale
        bodies = (geometry.socket_markers, geometry.pylon_markers)
        self._tracker = BodyTracker(settings, *bodies)
        self._client = NatNetClient(settings, self._tracker.add)
        self._poses = {topic: self.advertise(topic) for topic in (SOCKET_POSE, PYLON_POSE)}
        self._pack_pose = pose_packer()
        self._markers = self.advertise(MARKERS)
        self._pack_markers = markers_packer({"socket": len(bodies[0]), "pylon": len(bodies[1])})
        self._frames = FrameBroadcaster(self, geometry)
        self._averaged, self._delay = 0, 0.0
        self._refused = ""  # why a take's name was not taken
        self._client.start()
        self.follow_triggers()
        self.listen(RECORDED_TRIAL, self._on_recorded, needed=False)

    def close(self) -> None:
        """Stop following and leave the server."""
        super().close()
        self._client.close()

    def figures(self) -> dict[str, object]:
        """Those of the measurements, of the stream and of the last poses.

        `averaged_frames` is the number of frames that made them, the smaller one of the bodies;
        `delay` is how long after its trigger the last pose was published [s].
        """
        last = {"averaged_frames": self._averaged, "delay": round(self._delay, 4)}
        return {**super().figures(), **last, **self._client.figures()}

    def device(self) -> str:
        """The motion capture's server."""
        return f"NatNet {self.settings.server}"

    def measure(self, stamp: int, moment: float) -> None:
        """Wait for the frames around the trigger and average them."""
        window = averaging_span(self.settings.window, self.period)
        self._tracker.wait(moment, moment + 0.5 * window + self._stale, window)
        sample = self._sample(moment, window)
        self._averaged = min(body.frames for body in sample)
        vectors = [np.hstack([body.position, body.quaternion]) for body in sample]
        poses = dict(zip(self._poses, vectors, strict=True))
        for topic, pose in poses.items():
            self._poses[topic].publish(self._pack_pose(stamp, pose))
        self._markers.publish(self._pack_markers(stamp, [body.markers for body in sample]))
        self._delay = clocks.monotonic() - moment
        self._frames.move(stamp, poses)
        self.missing += any(body.fault for body in sample)

    def idle(self) -> None:
        """See how the bodies are."""
        self._sample(clocks.monotonic() - self._stale)

    def _sample(self, moment: float, window: float = 0.0) -> tuple[SeenBody, ...]:
        sample = self._tracker.sample(moment, window)
        faults = dict.fromkeys(body.fault for body in sample if body.fault)
        if faults:
            self.fault.note(self._client.clock_fault or "; ".join(faults))
        return sample

    def _on_recorded(self, message: String) -> None:
        if not self.settings.record_takes:
            return
        self._refused = ""
        try:
            self._client.set_recording(message.data or None)
        except ConfigurationError as error:
            self._refused = f"no take is recorded: {error}"

    def health(self) -> tuple[int, str]:
        """That of the stream, what the last samples lack, or of Motive's recording."""
        level, message = self._client.health(clocks.monotonic())
        if level < ERROR and (faults := [f for f in (self.fault.text(), self._refused) if f]):
            return WARN, "; ".join(faults)
        if level == OK and (fault := self._client.recording_fault):
            return WARN, fault
        return level, message
