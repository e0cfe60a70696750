"""Trigger node: one trigger for all sensors, with the timestamp of all measurements.

Subscribes: trigger, /diagnostics, and with source `topic` the topic of another program, each
message of which is a trigger. Publishes: trigger, /diagnostics; /clock while a simulated
testbed runs slower than real time. Service: trigger/enable.

The stamp is the system clock at the start of the testbed, advanced by the steady clock, because the
system clock may be set during a trial. The sequence counts pulses: an unseen pulse leaves a gap.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from typing import TYPE_CHECKING

from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from socket_testbed import clocks
from socket_testbed.clocks import SteadyClock
from socket_testbed.drivers.gpio import LinesError, Trigger
from socket_testbed.errors import DeviceError
from socket_testbed.live.hardware import make_trigger, wall_clock
from socket_testbed.nodes.base import (
    ERROR,
    OK,
    TRIGGERS,
    WARN,
    Inbox,
    RecentFault,
    TestbedNode,
    stamp_to_ros,
)
from socket_testbed.nodes.followers import Followers
from socket_testbed.settings.acquisition import READY_TIMEOUT, TriggerSettings
from socket_testbed.wire.messages import trigger_packer
from socket_testbed.wire.topics import CLOCK, TRIGGER, Service

if TYPE_CHECKING:
    from socket_testbed.live.sources import TriggerStream

_FOREIGN_DURATION = 5.0  # [s]; how long another testbed is reported
_LINGER = 0.05  # [s]; a busy node may not have received the last trigger when its publisher ends
_MAX_REMEMBERED = 200  # own triggers, to recognise foreign ones
_TICK_PERIOD = 0.02  # [s]; of /clock, in real time
_TAKE_PERIOD = 0.002  # [s]; of looks at the messages of another program
_LOOK_PERIOD = 0.5  # [s]; of looks for its publisher
_LISTEN_TIME = 2.0  # [s]; to a topic before its state is reported
_STEP_THRESHOLD = 0.01  # [s]; smallest reported step of the system clock


class TriggerNode(TestbedNode[TriggerSettings]):
    """Triggers from a thread of its own, at a constant rate [Hz] on the steady clock.

    Publishes: trigger, with the time of the edge (or timer) as its stamp since the epoch [ns], and
    a sequence number that counts pulses. Subscribes: trigger, to detect another testbed. Service:
    trigger/enable starts and stops the pulses. Publishes /clock, with the time of the stamps since
    the epoch, 50 times per real second while the testbed runs slower than real time.
    """

    def __init__(self) -> None:
        super().__init__("trigger_node", TriggerSettings)
        settings = self.settings
        if settings.source == "gpio":
            self.device = f"{settings.chip} line {settings.output_line}"
        self._epoch = SteadyClock(wall_clock(settings))
        self._trigger: Trigger | None = None
        self._sequence = 0
        self._unseen = 0
        self._skipped = 0
        self._stray = 0  # edges of lines that were closed
        self._listening = math.inf  # since this time of the steady clock [s]
        self._wrong = ""  # with the topic of another program
        self._lost = ""  # the fault that closed them, until the next trigger
        self._fault = RecentFault()
        self._reopening = clocks.Backoff()
        self._enabled = threading.Event()
        if settings.enabled:
            self._enabled.set()
        self._stopping = threading.Event()
        self._own: deque[int] = deque(maxlen=_MAX_REMEMBERED)
        self._foreign = 0.0
        self._stream = self._foreign_stream()
        self._send = self.sender(TRIGGER, trigger_packer())
        self.follow(TRIGGER, self._on_trigger, needed=False)
        self._followers = Followers(self, settings.wait_for, self._stopping.is_set)
        self.serve(SetBool, Service.ENABLE_TRIGGER, self._on_enable)
        if clocks.time_scale() != 1.0:
            self._clock_publisher = self.create_publisher(Clock, CLOCK.name, 10)
            self.repeat(_TICK_PERIOD, self._tick)
        self._thread = threading.Thread(target=self._run, name="trigger")
        self._thread.start()

    def close(self) -> None:
        """Stop triggering."""
        self._stopping.set()
        self._enabled.set()
        self._thread.join()
        clocks.sleep(_LINGER)

    def figures(self) -> dict[str, object]:
        """Numbers of pulses, and of those unseen or skipped, and of stray edges [1]."""
        trigger = self._trigger  # the thread may close it meanwhile
        return {
            TRIGGERS: self._sequence,
            "unseen": self._unseen,
            "skipped": self._skipped,
            "stray_edges": self._stray + (trigger.stray if trigger is not None else 0),
        }

    def _tick(self) -> None:
        """Publish the time of the testbed."""
        with self.until_ros_ends():
            self._clock_publisher.publish(Clock(clock=stamp_to_ros(self._epoch.now())))

    def _on_trigger(self, stamp: int, sequence: int) -> None:
        """Detect another testbed that triggers the same nodes, by a stamp [ns] not our own."""
        if stamp not in self._own:
            self._foreign = clocks.monotonic()

    def _on_enable(self, enabled: bool) -> str:
        """Start or stop the pulses."""
        if enabled:
            self._enabled.set()
            return "triggering"
        self._enabled.clear()
        return "not triggering"

    def _run(self) -> None:
        """Wait for the followers, then fire at the rate of the settings until the node closes."""
        with self.until_ros_ends():
            # The first trigger must reach all nodes that measure.
            if lacking := self._followers.await_links(READY_TIMEOUT):
                self.get_logger().warning(f"triggering without waiting any longer for {lacking}")
            if self._stream is not None:
                self._follow_topic(self._stream)
                return
            due = clocks.monotonic()
            while not self._stopping.is_set():
                if not self._enabled.is_set():
                    self._enabled.wait()
                    due = clocks.monotonic()
                    continue
                period = 1.0 / self.settings.rate
                due += period
                if (behind := clocks.monotonic() - due) > period:
                    self._skipped += int(behind / period)
                    due = clocks.monotonic()
                if self._stopping.wait(clocks.real(max(0.0, due - clocks.monotonic()))):
                    break
                if self._enabled.is_set():
                    self._fire()
            if self._trigger is not None:
                self._trigger.close()

    def _foreign_stream(self) -> TriggerStream | None:
        """The triggers of another program; None if this node makes its own.

        Raises:
            ConfigurationError: If their topic is one that the testbed publishes.
        """
        if self.settings.source != "topic":
            return None
        # Memory that others need not:
        from socket_testbed.live.sources import TriggerStream, refuse_own_topic

        topic = self.settings.topic
        refuse_own_topic(topic, "trigger_node: topic", self.get_namespace())
        return TriggerStream(topic)

    def _follow_topic(self, stream: TriggerStream) -> None:
        """Publish a trigger with each message of another program, until the node closes."""
        from socket_testbed.nodes.foreign_topics import trigger_topic

        inbox = Inbox(self.get_name(), self.get_namespace(), {})
        topic = trigger_topic(inbox.node, self.settings.topic, self.get_namespace())
        look = 0.0
        self._listening = clocks.monotonic()
        while not self._stopping.wait(clocks.real(_TAKE_PERIOD)):
            if (now := clocks.monotonic()) >= look:
                look, self._wrong = now + _LOOK_PERIOD, topic.look()
            for stamp in stream.receive(topic.take(self._epoch.now)):
                if self._enabled.is_set():
                    self._sequence += 1
                    self._own.append(stamp)
                    self._send(stamp, self._sequence)
        inbox.close()

    def _fire(self) -> None:
        """Fire one pulse and publish its trigger; a fault is noted instead."""
        begun = self._sequence
        try:
            trigger = self._opened()
            self._sequence += 1
            try:
                moment = trigger.fire()
            except LinesError as error:
                self._lost = str(error)
                # The chip may have returned since the last pulse.
                self._close_trigger()
                moment = self._opened().fire()
        except DeviceError as error:
            self._unseen += self._sequence - begun
            self._fault.note(self._lost or str(error))
            if isinstance(error, LinesError):
                self._close_trigger()
            if self._trigger is None:
                wait = self._reopening.failed(clocks.monotonic())
                self._stopping.wait(clocks.real(wait))
        else:
            self._lost = ""
            self._reopening.succeeded()
            stamp = self._epoch.to_epoch(moment)
            self._own.append(stamp)
            self._send(stamp, self._sequence)
        if self._trigger is not None:
            self._trigger.end_pulse()

    def _opened(self) -> Trigger:
        """The trigger, whose lines are opened if they are not open."""
        if self._trigger is None:
            self._trigger = make_trigger(self.settings)
        return self._trigger

    def _close_trigger(self) -> None:
        """Release the lines, so that the kernel can give a chip back; they are opened again."""
        if self._trigger is not None:
            self._stray += self._trigger.stray
            self._trigger.close()
            self._trigger = None

    def check(self) -> None:
        """Report a fault of recent pulses, a foreign trigger, or a step of the system clock."""
        step = self._epoch.step()
        rate = self.settings.rate
        if fault := self._fault.text(1.5 / rate):
            self.report(ERROR, fault)
        elif self._foreign and clocks.monotonic() - self._foreign < _FOREIGN_DURATION:
            self.report(
                ERROR,
                "another trigger is active on this ROS_DOMAIN_ID: end the other testbed, or set"
                " another ROS_DOMAIN_ID; two testbeds must not mix",
            )
        elif not self._enabled.is_set():
            self.report(WARN, "not enabled: call trigger/enable")
        elif abs(step) > _STEP_THRESHOLD:
            self.report(
                WARN,
                f"the system clock was set by {step:+.3f} s: stamps continue steadily;"
                " restart after the trial to adopt the new time",
            )
        elif self._wrong:
            self.report(ERROR, self._wrong)
        elif self._stream is not None and clocks.monotonic() > self._listening + _LISTEN_TIME:
            self.report(*self._stream.health(self._epoch.now()))
        elif self._sequence:
            self.report(OK, f"triggering at {rate:g} Hz")
