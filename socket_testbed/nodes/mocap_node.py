"""Motion-capture node: measures the bodies' markers and poses at each trigger, from NatNet.

Subscribes: trigger, recorder/trial. Publishes: mocap/socket/pose, mocap/pylon/pose,
mocap/markers, tf, tf_static, /diagnostics.

A pose is the mean over the frames in a window centred on the trigger, and is published half a
window later; the markers are interpolated at the trigger.
"""

from __future__ import annotations

from std_msgs.msg import String

from socket_testbed import clocks
from socket_testbed.drivers.natnet.client import NatNetClient
from socket_testbed.drivers.natnet.tracker import BodyTracker, SeenBody
from socket_testbed.errors import ConfigurationError, joined
from socket_testbed.files import SOCKET_FILE, file_or_packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.nodes import base
from socket_testbed.nodes.frames import FrameBroadcaster
from socket_testbed.nodes.sensor_node import SensorNode
from socket_testbed.settings.acquisition import MocapSettings, averaging_span
from socket_testbed.wire import messages, topics

_GONE_AFTER = 5  # checks in a row without a recorder; discovery may pause


class MocapNode(SensorNode[MocapSettings]):
    """Averages the bodies' poses around each trigger; an unseen body is missing (NaN).

    Publishes, with the stamp of the trigger and in the frame world of the motion capture:
    mocap/socket/pose and mocap/pylon/pose, positions [m] and quaternions of the marker bodies;
    mocap/markers, their markers [m]; on tf the socket and the limb, see `frames`. Subscribes to
    recorder/trial, whose trials Motive can record as takes.
    """

    def __init__(self) -> None:
        super().__init__("mocap_node", MocapSettings)
        settings = self.settings
        self.device = f"NatNet {settings.server}"
        geometry = read_socket(file_or_packaged(settings.geometry, SOCKET_FILE))
        self._stale = settings.stale
        self._tracker = BodyTracker(settings, *geometry.markers.values())
        self._client = NatNetClient(settings, self._tracker.add)
        self._send_pose = {
            topic: self.sender(topic, messages.pose_packer()) for topic in topics.POSES.values()
        }
        counts = {name: len(markers) for name, markers in geometry.markers.items()}
        self._send_markers = self.sender(topics.MARKERS, messages.markers_packer(counts))
        self._frames = FrameBroadcaster(self, geometry)
        self._averaged, self._delay = 0, 0.0
        self._refused = ""  # why a take's name was refused
        self._client.start()
        self.follow_triggers()
        self._trial, self._gone = "", 0  # being recorded; checks without its recorder
        self.listen(topics.RECORDED_TRIAL, self._on_recorded, needed=False)

    def close(self) -> None:
        """Stop measuring and disconnect from the server."""
        super().close()
        self._client.close()

    def figures(self) -> dict[str, object]:
        """Figures of the measurements, the stream and the last poses.

        `averaged_frames` is the number of averaged frames, of the body with fewer; `delay` is the
        time from the trigger to the last pose's publication [s].
        """
        last = {"averaged_frames": self._averaged, "delay": round(self._delay, 4)}
        return {**super().figures(), **last, **self._client.figures()}

    def measure(self, stamp: int, moment: float) -> None:
        """Average the frames around the trigger; publish poses and markers in the world [m].

        Args:
            stamp: Stamp of the trigger since the epoch [ns].
            moment: The trigger on the testbed's steady clock [s].
        """
        window = averaging_span(self.settings.window, self.period)
        self._tracker.wait(moment, moment + 0.5 * window + self._stale, window)
        sample = self._sample(moment, window)
        self._averaged = min(body.frames for body in sample)
        poses = {topic: body.pose for topic, body in zip(self._send_pose, sample, strict=True)}
        for topic, pose in poses.items():
            self._send_pose[topic](stamp, pose)
        self._send_markers(stamp, [body.markers for body in sample])
        self._delay = clocks.monotonic() - moment
        self._frames.move(stamp, poses)
        self.missing += any(body.fault for body in sample)

    def idle(self) -> None:
        """Check the bodies."""
        self._sample(clocks.monotonic() - self._stale)

    def _sample(self, moment: float, window: float = 0.0) -> tuple[SeenBody, ...]:
        """The bodies at a steady time [s], averaged over a window [s]; notes why one is missing."""
        sample = self._tracker.sample(moment, window)
        faults = dict.fromkeys(body.fault for body in sample if body.fault)
        if faults:
            self.fault.note(self._client.clock_fault or joined(faults))
        return sample

    def _on_recorded(self, message: String) -> None:
        """Have Motive record a take with the name of the trial; empty: end the take."""
        if not self.settings.record_takes:
            return
        self._trial, self._refused = message.data, ""
        try:
            self._client.set_recording(self._trial or None)
        except ConfigurationError as error:
            self._refused = f"no take is recorded: {error}"

    def health(self) -> tuple[int, str]:
        """Health of the stream and the latest fault, or health of Motive's recording."""
        gone = self._trial and not base.recorded_trial(self, self._trial)
        self._gone = self._gone + 1 if gone else 0
        if self._gone == _GONE_AFTER:
            self._on_recorded(String())  # the recorder ended without a word
        level, message = self._client.health(clocks.monotonic())
        if level < base.ERROR and (faults := [f for f in (self.fault.text(), self._refused) if f]):
            # What the stream lacks comes first: it explains why a body has no pose.
            cause = [message] if level == base.WARN and not self._client.clock_fault else []
            return base.WARN, joined([*cause, *faults])
        if level == base.OK and (fault := self._client.recording_fault):
            return base.WARN, fault
        return level, message
