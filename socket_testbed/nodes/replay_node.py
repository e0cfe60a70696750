"""Replay node: a trial published again as raw bytes, in its order and timing, with /clock.

Publishes: the topics of the trial under their recorded names, /clock, /diagnostics. Service:
replay/pause.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from socket_testbed.errors import ConfigurationError, TestbedError, TrialError
from socket_testbed.nodes.conversions import stamp_to_ros
from socket_testbed.nodes.diagnostics import (
    ERROR,
    NEWEST_STAMP,
    OK,
    WAITING_FOR,
    WARN,
    Diagnostics,
)
from socket_testbed.nodes.parameters import Parameters
from socket_testbed.nodes.runtime import message_type, publisher_qos, run_node, subscriber_qos
from socket_testbed.settings import ReplaySettings
from socket_testbed.trials.bag import BagReader, RawMessage
from socket_testbed.trials.messages import decode, stamp_of
from socket_testbed.trials.topics import DIAGNOSTICS, TRIGGER, Topic, match_topics

_CLOCK_PERIOD = 0.02  # [s]; of /clock between messages
_READY_WITHIN = 15.0  # [s]; for the nodes waited for to find each other
_DISCOVERY = 3.0  # [s]; DDS takes 5 ms or more than 2 s, at random
_DONE_WITHIN = 10.0  # [s]; for them to work off the last message
_IN_FLIGHT = 500  # triggers ahead of the nodes waited for, well below their queues
_BURST = 50  # messages sent at once, half of what a writer keeps to send again
_PROGRESS_PERIOD = 10.0  # [s]
_BREATH = 0.002  # [s]; after a burst


class ReplayNode(Node):
    """Publishes a trial from a thread of its own, so that services answer meanwhile."""

    def __init__(self) -> None:
        super().__init__("replay_node")
        self.finished = Future()
        self.failure: TestbedError | None = None
        settings = Parameters(self, ReplaySettings).settings
        if not settings.trial:
            raise ConfigurationError("replay_node: trial is empty", "give the path of a trial")
        self._settings = settings
        self._stop = threading.Event()
        self._going = threading.Event()
        if not settings.paused:
            self._going.set()
        self._waiting = dict.fromkeys(settings.wait_for, "not seen")
        self._newest: dict[str, int] = {}
        self._heard = threading.Condition()
        self._published = 0
        self._last_trigger = 0
        self._said = time.monotonic()
        self._ahead: deque[int] = deque()

        self._bag = BagReader(Path(settings.trial))
        self._bag.__enter__()
        self._topics = self._replayed_topics()
        self._outputs = {
            name: self.create_publisher(message_type(topic), name, publisher_qos(topic))
            for name, topic in self._topics.items()
        }
        self._clock_publisher = self.create_publisher(Clock, "/clock", 10)
        self._listener = self.create_subscription(
            DiagnosticArray, DIAGNOSTICS.name, self._on_diagnostics, subscriber_qos(DIAGNOSTICS)
        )
        self._service = self.create_service(SetBool, "replay/pause", self._on_pause)
        self._diagnostics = Diagnostics(self, lambda: {"published": self._published})
        self._thread = threading.Thread(target=self._replay, name="replay")
        self._thread.start()

    def close(self) -> None:
        """Stop publishing and close the trial."""
        self._stop.set()
        self._going.set()
        self._thread.join()
        self._bag.__exit__(None, None, None)
        if self.failure is not None:
            raise self.failure

    def _replayed_topics(self) -> dict[str, Topic]:
        """The testbed's topics of the trial by their recorded names."""
        names = match_topics(self._bag.counts, self._settings.trial)
        topics = {
            name: topic
            for topic, name in names.items()
            if self._bag.counts[name] > 0
            and topic is not DIAGNOSTICS  # this graph's own nodes say how they are
            and not (topic.computed and self._settings.measured_only)
        }
        if not topics:
            raise TrialError(
                f"{self._settings.trial}: holds no message on any topic of the testbed",
                "give a trial that 'record' or 'simulate' made",
            )
        return topics

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data:
            self._going.clear()
        else:
            self._going.set()
        response.success = True
        response.message = "paused" if request.data else "going on"
        return response

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name in self._waiting:
                values = {entry.key: entry.value for entry in status.values}
                with self._heard:
                    self._waiting[status.name] = values.get(WAITING_FOR, "")
                    if NEWEST_STAMP in values:
                        self._newest[status.name] = int(values[NEWEST_STAMP])
                    self._heard.notify_all()

    def _replay(self) -> None:
        try:
            self._await_ready()
            self._diagnostics.report(OK, f"replaying {self._settings.trial}")
            self._publish_once()
            while self._settings.loop and not self._stop.is_set():
                self._await_done()
                with self._heard:
                    self._newest = dict.fromkeys(self._newest, 0)
                self._publish_once()
            self._await_done()
        except TestbedError as error:
            self.failure = error
            self._diagnostics.report(ERROR, str(error))
        finally:
            self.finished.set_result(None)

    def _publish_once(self) -> None:
        """Publish every message of the trial in its order, each at its time."""
        rate = self._settings.rate
        first: int | None = None
        start = 0.0
        for raw in self._bag.messages(self._topics):
            if first is None:
                first, start = raw.time, time.monotonic()
            start += self._pause()
            start += self._wait_until(raw.time, start + (raw.time - first) * 1e-9 / rate)
            if self._stop.is_set():
                return
            self._publish(raw)
            self._say_how_far((raw.time - first) * 1e-9)

    def _say_how_far(self, position: float) -> None:
        """Log how far the replay is [s] now and then."""
        if time.monotonic() - self._said > _PROGRESS_PERIOD:
            self._said = time.monotonic()
            self.get_logger().info(f"{position:.1f} of {self._bag.duration:.1f} s")

    def _pause(self) -> float:
        """Wait while paused; returns for how long [s]."""
        if self._going.is_set():
            return 0.0
        before = time.monotonic()
        self._going.wait()
        return time.monotonic() - before

    def _wait_until(self, stamp: int, due: float) -> float:
        """Wait for a message's turn, with the clock ticking; returns the time paused [s]."""
        paused = 0.0
        while (left := due + paused - time.monotonic()) > 0.0:
            self._tick(stamp - round(left * self._settings.rate * 1e9))
            if self._stop.wait(min(left, _CLOCK_PERIOD)):
                break
            paused += self._pause()
        self._tick(stamp)
        return paused

    def _tick(self, stamp: int) -> None:
        self._clock_publisher.publish(Clock(clock=stamp_to_ros(max(stamp, 0))))

    def _publish(self, raw: RawMessage) -> None:
        self._outputs[raw.topic].publish(raw.data)
        self._published += 1
        if self._topics[raw.topic] is TRIGGER:
            self._last_trigger = stamp_of(decode(raw.data, raw.type))
            self._ahead.append(self._last_trigger)
            self._await_progress(_IN_FLIGHT)
        if self._published % _BURST == 0:
            self._stop.wait(_BREATH)

    def _await_ready(self) -> None:
        """Wait until the subscribers are linked, so that they miss no message."""
        deadline = time.monotonic() + _READY_WITHIN

        # Without nodes to wait for, whoever listens is found within the time of a discovery.
        settled = time.monotonic() + (0.0 if self._waiting else _DISCOVERY)

        def linked(name: str) -> bool:
            needed = bool(self._waiting) and self._topics[name].required
            wanted = max(self.count_subscribers(name), int(needed))
            return self._outputs[name].get_subscription_count() >= wanted

        def ready() -> bool:
            everyone = all(map(linked, self._topics)) and not any(self._waiting.values())
            return everyone and time.monotonic() >= settled

        with self._heard:
            while not ready():
                left = deadline - time.monotonic()
                if left <= 0.0 or self._stop.is_set():
                    lacking = ", ".join(f"{n} ({w})" for n, w in self._waiting.items() if w)
                    raise TrialError(
                        f"after {_READY_WITHIN:g} s not ready: {lacking or 'subscribers'}",
                        "see what these nodes print; is another graph on this ROS_DOMAIN_ID?",
                    )
                self._heard.wait(min(left, _CLOCK_PERIOD))

    def _await_done(self) -> None:
        """Wait until the last message is received and worked off."""
        if self._newest:
            self._await_progress(0)
            return
        for publisher in self._outputs.values():
            if publisher.get_subscription_count() > 0:
                publisher.wait_for_all_acked(Duration(seconds=_DONE_WITHIN))

    def _await_progress(self, ahead: int) -> None:
        """Wait until the nodes waited for are at most so many triggers behind."""
        deadline = time.monotonic() + _DONE_WITHIN
        with self._heard:
            while self._newest and not self._stop.is_set():
                slowest = min(self._newest.values())
                while self._ahead and self._ahead[0] <= slowest:
                    self._ahead.popleft()
                    deadline = time.monotonic() + _DONE_WITHIN
                left = deadline - time.monotonic()
                if len(self._ahead) <= ahead:
                    return
                if left <= 0.0:
                    self._diagnostics.report(
                        WARN, f"{len(self._ahead)} triggers were not worked off in time"
                    )
                    self._ahead.clear()
                    return
                self._heard.wait(left)


def main() -> None:
    """Run the node."""
    run_node(ReplayNode)


if __name__ == "__main__":
    main()
