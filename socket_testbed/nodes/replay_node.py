"""Replay node: republishes a trial as raw bytes, in its order and timing, with /clock.

Wrenches and poses affected by another load cell, tare or geometry are recomputed.

Subscribes: /diagnostics. Publishes: the topics of the trial under their recorded names or in
another namespace, /clock, tf, tf_static, /diagnostics. Service: replay/pause.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from socket_testbed.arrays import FloatArray
from socket_testbed.errors import ConfigurationError, TestbedError, TrialError
from socket_testbed.nodes import base
from socket_testbed.nodes.followers import Followers
from socket_testbed.nodes.frames import FrameBroadcaster
from socket_testbed.settings.testbed import ReplaySettings
from socket_testbed.trials.bag import BagReader, RawMessage
from socket_testbed.trials.trial import Trial
from socket_testbed.wire import topics
from socket_testbed.wire.messages import Reader, VectorPacker

_READY_TIMEOUT = 180.0  # [s]; for the followers to start and discover each other
_DISCOVERY_TIME = 3.0  # [s]; DDS takes 5 ms or more than 2 s, at random
_PROGRESS_TIMEOUT = 60.0  # [s]; without any progress of the followers
_MAX_IN_FLIGHT = topics.PUBLISHER_DEPTH // 2  # triggers ahead of the followers
_BURST_SIZE = topics.PUBLISHER_DEPTH // 2  # messages sent at once; writers keep twice as many
_BURST_PAUSE = 0.002  # [s]; after a burst

_TICK_PERIOD = 0.02  # [s]; of /clock between messages


class Pacer:
    """Waits until each message of a recording is due.

    Args:
        rate: Speed relative to the recording [-].
        tick: Called with the time of the recording since the epoch [ns] as it passes.
        paused: Whether to begin paused.

    Attributes:
        stopped: Returns whether the pacer is stopped.
        sleep: Waits for a duration in real time [s], or until the pacer is stopped.
    """

    def __init__(self, rate: float, tick: Callable[[int], None], paused: bool = False) -> None:
        self._rate = rate
        self._tick = tick
        self._stopping = threading.Event()
        self._going = threading.Event()
        self.stopped, self.sleep = self._stopping.is_set, self._stopping.wait
        self.pause(paused)
        self._first = 0
        self._start = 0.0

    def pause(self, paused: bool) -> None:
        """Pause before the next message, or resume."""
        if paused:
            self._going.clear()
        else:
            self._going.set()

    def stop(self) -> None:
        """End all waiting."""
        self._stopping.set()
        self._going.set()

    def begin(self, first: int) -> None:
        """Begin a pass over the recording, given its first message's time since the epoch [ns]."""
        self._first, self._start = first, time.monotonic()

    def wait_for(self, stamp: int) -> bool:
        """Wait until the message recorded at a time [ns] is due; false if stopped.

        Meanwhile `tick` is called every 20 ms.
        """
        while True:
            if not self._going.is_set():  # a pause shifts all later messages
                before = time.monotonic()
                self._going.wait()
                self._start += time.monotonic() - before
            if self.stopped():
                return False
            due = self._start + (stamp - self._first) * 1e-9 / self._rate
            if (left := due - time.monotonic()) <= 0.0:
                self._tick(stamp)
                return True
            self._tick(stamp - round(left * self._rate * 1e9))
            self._stopping.wait(min(left, _TICK_PERIOD))


class ReplayNode(base.TestbedNode[ReplaySettings]):
    """Publishes a trial from a separate thread, so that services stay responsive.

    Messages keep the units, frames and stamps of the recording. Recomputed wrenches are in the
    frame load_cell [N, N m], recomputed poses in the world [m]. /clock carries the recording time.
    Service: replay/pause.
    """

    def __init__(self) -> None:
        super().__init__("replay_node", ReplaySettings)
        settings = self.settings
        self._failure: TestbedError | None = None
        if not settings.trial:
            raise ConfigurationError("replay_node: trial is empty", "give the path of a trial")
        self._sample_topics: set[topics.Topic] = set()  # published since the last trigger
        self._published = 0
        self._position = 0.0  # [s]

        self._trial = Trial(
            Path(settings.trial),
            Path(settings.geometry) if settings.geometry else None,
            notify=self.get_logger().info,
            load_cell_file=Path(settings.load_cell) if settings.load_cell else None,
            tare=settings.tare,
        )
        self._remade = self._remake()
        self._bag = BagReader(self._trial.path)
        self._bag.__enter__()
        self._topics = self._replayed_topics()
        waits = bool(settings.wait_for)  # then required topics must have a subscriber
        wanted = topics.full_namespace(settings.namespace)
        self._by_topic = {
            name: self.advertise(
                topic,
                topics.full_name(topic.name, wanted) if settings.namespace else name,
                topic.required and waits,
            )
            for name, topic in self._topics.items()
        }
        decoded = (topics.TRIGGER, topics.WRENCH, *topics.POSES.values())
        self._readers = {topic: Reader(topic, self._trial.path) for topic in decoded}
        self._frames = self._broadcaster()
        self._clock_publisher = self.create_publisher(Clock, topics.CLOCK.name, 10)
        self._pacer = Pacer(settings.rate, self._tick, settings.paused)
        self._followers = Followers(self, settings.wait_for, self._pacer.stopped)
        self.serve(SetBool, topics.Service.PAUSE_REPLAY, self._on_pause)
        self._thread = threading.Thread(target=self._replay, name="replay")
        self._thread.start()

    def figures(self) -> dict[str, object]:
        """Number of published messages [1], position in the trial and its duration [s]."""
        return {
            "published": self._published,
            "position": f"{self._position:.1f}",
            "duration": f"{self._bag.duration:.1f}",
        }

    def close(self) -> None:
        """Stop publishing and close the trial."""
        self._pacer.stop()
        self._thread.join()
        self._bag.__exit__(None, None, None)
        if self._failure is not None:
            raise self._failure

    def _replayed_topics(self) -> dict[str, topics.Topic]:
        """The testbed's topics in the trial, by recorded name."""
        counts = self._bag.counts
        found = {
            name: topic
            for topic, name in topics.match_topics(self._bag.types, self.settings.trial).items()
            if counts[name] > 0
            and topic is not topics.DIAGNOSTICS  # this graph's nodes report their own state
            and not (topic.computed and self.settings.measured_only)
        }
        if not found:
            raise TrialError(
                f"{self.settings.trial}: holds no message on any topic of the testbed",
                "give a trial that 'record' or 'simulate' made",
            )
        return found

    def _remake(self) -> dict[topics.Topic, tuple[VectorPacker, dict[int, FloatArray]]]:
        """Packers, and rows by stamp [ns], that replace recorded measurements, by topic.

        Wrenches [M; F] in {S}, shape (6,) [N m, N], and poses in the world, shape (7,) [m, -];
        empty if nothing is recomputed.
        """
        if not self._trial.remade:
            return {}
        found = self._trial.measurements()
        return {
            topic: (pack, dict(zip(found.stamps.tolist(), rows, strict=True)))
            for topic, pack, rows in found.packed()
        }

    def _broadcaster(self) -> FrameBroadcaster | None:
        """The publisher of the transforms; None, with a warning, without the socket's geometry."""
        try:
            geometry = self._trial.geometry
        except TestbedError as error:
            self.get_logger().warning(f"transforms are left out: {error}")
            return None
        recorded = topics.namespace_of(*next(iter(self._topics.items())))
        wanted = self.settings.namespace
        return FrameBroadcaster(
            self, geometry, topics.full_namespace(wanted) if wanted else recorded or "/"
        )

    def _on_pause(self, paused: bool) -> str:
        """Pause or resume."""
        self._pacer.pause(paused)
        return "paused" if paused else "resumed"

    def _replay(self) -> None:
        try:
            with self.until_ros_ends():
                self._await_ready()
                self.report(base.OK, f"replaying {self.settings.trial}")
                self._publish_once()
                while self.settings.loop and not self._pacer.stopped():
                    self._catch_up(0)
                    self._followers.start_over()
                    self._publish_once()
                self._await_done()
        except TestbedError as error:
            self._failure = error
            self.report(base.ERROR, str(error))
        finally:
            self.finished.set_result(None)

    def _publish_once(self) -> None:
        """Publish every message of the trial in order, each at its time."""
        first: int | None = None
        for raw in self._bag.messages(self._topics):
            if first is None:
                first = raw.time
                self._pacer.begin(first)
            if not self._pacer.wait_for(raw.time):
                return
            self._publish(raw)
            self._position = (raw.time - first) * 1e-9

    def _publish(self, raw: RawMessage) -> None:
        """Publish a message, recomputed if its measurement is, and the transforms of a pose."""
        topic, data = self._topics[raw.topic], raw.data
        if topic in self._remade:
            pack, rows = self._remade[topic]
            stamp, _ = self._readers[topic].read(data)
            if stamp not in rows:
                return  # its trigger is missing in the trial
            data = pack(stamp, rows[stamp])
        self._by_topic[raw.topic].publish(data)
        self._published += 1
        if topic in topics.POSES.values() and self._frames is not None and self._frames.wanted:
            stamp, pose = self._readers[topic].read(data)
            self._frames.move(stamp, {topic: pose})
        self._sample_topics.add(topic)
        if topic is topics.TRIGGER:
            self._sample_topics = {topic}
            self._followers.sent(self._readers[topic].read(data)[0])
            self._catch_up(_MAX_IN_FLIGHT)
        if self._published % _BURST_SIZE == 0:
            self._pacer.sleep(_BURST_PAUSE)

    def _tick(self, stamp: int) -> None:
        """Publish a time since the epoch [ns] on /clock."""
        self._clock_publisher.publish(Clock(clock=base.stamp_to_ros(max(stamp, 0))))

    def _await_ready(self) -> None:
        """Wait until the subscribers are linked, so that they miss no message."""
        if not self._followers:
            self._pacer.sleep(_DISCOVERY_TIME)
        lacking = self._followers.await_links(_READY_TIMEOUT)
        for name, publisher in self._by_topic.items():
            topic = publisher.topic_name
            if self._topics[name].required and self.count_publishers(topic) > 1:
                raise TrialError(
                    f"another program publishes {topic} on this ROS_DOMAIN_ID",
                    "end it, or set another ROS_DOMAIN_ID: two trials must not mix",
                )
        if lacking:
            raise TrialError(
                f"after {_READY_TIMEOUT:g} s not ready: {lacking}",
                "see what these nodes print; is another graph on this ROS_DOMAIN_ID?",
            )

    def _await_done(self) -> None:
        """Wait until the last message is received and processed.

        Not every follower reports its progress, and messages without acknowledgement are lost when
        the publishers end. A trial may end between a trigger and its measurements.
        """
        if self._followers:
            self._catch_up(int(not self._sample_topics.issuperset(topics.REQUIRED)))
        for publisher in self._by_topic.values():
            self._followers.wait(partial(base.is_acknowledged, publisher), _PROGRESS_TIMEOUT)

    def _catch_up(self, behind: int) -> None:
        left = self._followers.catch_up(behind, _PROGRESS_TIMEOUT)
        if left:
            self.report(base.WARN, f"{left} triggers were not processed in time")
