"""Align node: measurements of other drivers, brought to each trigger.

Subscribes: trigger, clusters/stress, recorder/trial, and the topics that its settings name.
Publishes, of what comes from other drivers: load_cell/wrench, load_cell/raw (the tare alone),
mocap/socket/pose, mocap/pylon/pose, clusters/capacitance, tf, tf_static, event; /diagnostics.
Services, for a wrench of another driver: load_cell/tare, load_cell/force_tare.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from socket_testbed import clocks
from socket_testbed.alignment.align import Aligned
from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.model import read_calibration
from socket_testbed.clocks import SteadyClock, TriggerPeriod, TriggerTime
from socket_testbed.files import CALIBRATION_FILE, SOCKET_FILE, file_or_packaged
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.live.sources import StreamedSource, WrenchTare, as_capacitances, wrench_mapping
from socket_testbed.nodes.base import ERROR, OK, SAMPLES, WARN, Inbox, TestbedNode
from socket_testbed.nodes.foreign_topics import ForeignTopic, foreign_topic
from socket_testbed.nodes.frames import FrameBroadcaster
from socket_testbed.nodes.taring import TareServices
from socket_testbed.samples import Status
from socket_testbed.settings.alignment import NONE, OWN, AlignSettings
from socket_testbed.trials import foreign
from socket_testbed.trials.foreign import TRANSFORM
from socket_testbed.trials.imported import in_load_cell
from socket_testbed.wire.messages import (
    capacitance_packer,
    load_cell_raw_packer,
    pose_packer,
    wrench_packer,
)
from socket_testbed.wire.topics import CAPACITANCE, LOAD_CELL_RAW, POSES, TRIGGER, WRENCH, Topic

_POLL_PERIOD = 0.02  # [s]; of looks at what has arrived, each of which costs a millisecond
_LOOK_PERIOD = 0.5  # [s]; of looks for publishers
_INTERVALS = 25  # of the trigger, whose median is its period
_SETTLING_TIME = 5.0  # [s]; for the drivers to answer; then the testbed starts without them
_MISSING_WRENCH, _MISSING_POSE = np.full(6, np.nan), np.full(7, np.nan)


class AlignNode(TestbedNode[AlignSettings]):
    """Brings sources of other drivers to each trigger; a source without a value is missing (NaN).

    Publishes, with the stamp of the trigger, what the testbed's own drivers would.
    """

    def __init__(self) -> None:
        super().__init__("align_node", AlignSettings, settle=_SETTLING_TIME)
        settings = self.settings
        self.samples = 0  # triggers so far
        self._trigger_time = TriggerTime(SteadyClock())
        self._trigger_period = TriggerPeriod(_INTERVALS)
        self._period = 0.0  # of the triggers [s]; 0 while unknown
        self._inbox = Inbox(self.get_name(), self.get_namespace(), {})
        self._mapping = wrench_mapping(settings.wrench)
        self._tare_taken = WrenchTare(settings.tare_file)
        geometry = read_socket(file_or_packaged(settings.geometry, SOCKET_FILE))
        self._calibration = read_calibration(
            file_or_packaged(settings.calibration, CALIBRATION_FILE)
        )
        self._clusters = settings.clusters.names or tuple(geometry.clusters)
        if settings.clusters.is_foreign:
            self._calibration.require(self._clusters, "align_node: clusters")
        self._sources: dict[str, StreamedSource] = {}
        self._topics: dict[str, ForeignTopic] = {}
        self._wrong: dict[str, str] = {}  # what is wrong with a topic, by source
        for source in foreign.SOURCES:
            own = settings.sources[source]
            if own.is_foreign:
                clusters = self._clusters if source == "clusters" else ()
                keep = settings.tare_duration if source == "wrench" else 0.0
                self._sources[source] = StreamedSource(source, own, clusters, keep)
                self._topics[source] = foreign_topic(
                    self._inbox.node, source, own.topic, self.get_namespace()
                )
        self._publish: dict[str, Callable[[int, Aligned | None], None]] = {}
        self._frames: FrameBroadcaster | None = None
        self._publish_all(geometry)
        self._due: list[int] = []
        self._stopping = threading.Event()
        self._aligning = threading.Thread(target=self._run, name="align")
        self.follow(TRIGGER, self._on_trigger)
        self._aligning.start()

    def _publish_all(self, geometry: SocketGeometry) -> None:
        """Advertise the topics of all sources that the testbed's own drivers do not measure."""
        sources = self.settings.sources
        if sources["wrench"].topic != OWN:
            self._send_wrench = self.sender(WRENCH, wrench_packer())
            self._publish["wrench"] = self._publish_wrench
        if "wrench" in self._sources:
            self._send_raw = self.sender(LOAD_CELL_RAW, load_cell_raw_packer())
            self._taring = TareServices(self, self._tare, self._trigger_time, lambda: self._period)
        if sources["clusters"].topic != OWN:
            self._names = self._clusters if sources["clusters"].is_foreign else ()
            self._send_capacitance = self.sender(CAPACITANCE, capacitance_packer(self._names))
            self._publish["clusters"] = self._publish_clusters
        poses = {f"{body}_pose": topic for body, topic in POSES.items()}
        for name, topic in poses.items():
            if sources[name].topic == NONE:
                self.advertise(topic)  # nodes wait for a publisher, which stays silent
        foreign_poses = {name: topic for name, topic in poses.items() if name in self._sources}
        for name, topic in foreign_poses.items():
            send = self.sender(topic, pose_packer())
            self._publish[name] = partial(self._publish_pose, topic, send)
        on_tf = [name for name in foreign_poses if sources[name].topic.startswith(TRANSFORM)]
        if foreign_poses and not on_tf:  # those on /tf are there already, under any names
            self._frames = FrameBroadcaster(self, geometry)

    def close(self) -> None:
        """Stop aligning."""
        self._stopping.set()
        self._aligning.join()
        self._inbox.close()
        super().close()

    def figures(self) -> dict[str, object]:
        """The number of triggers, and the figures of each source, see `StreamedSource.figures`."""
        own = [source.figures() for source in self._sources.values()]
        return {
            SAMPLES: self.samples,
            **{key: value for part in own for key, value in part.items()},
        }

    def check(self) -> None:
        """Report the worst state of a source."""
        if not self._aligning.is_alive():
            self.report(ERROR, "it stopped aligning: see what it printed, and start it again")
            return
        now = self._now()
        states = [
            (ERROR, f"{source.name}: {wrong}")
            if (wrong := self._wrong.get(name))
            else source.health(now)
            for name, source in self._sources.items()
        ]
        worst = max((level for level, _ in states), default=OK)
        texts = [text for level, text in states if level >= min(worst, WARN)]
        self.report(worst, "; ".join(texts) or "no source of another driver")

    def _now(self) -> int:
        """The present time on the clock of the triggers' stamps [ns]."""
        return self._trigger_time.stamp(clocks.monotonic())

    def _on_trigger(self, stamp: int, sequence: Any) -> None:
        """Queue a trigger, given its stamp since the epoch [ns] and number."""
        self._trigger_time.steady(stamp, clocks.monotonic())
        self._period = self._trigger_period.add(stamp, int(sequence))
        self._due.append(stamp)

    def _run(self) -> None:
        """Take what has arrived, and publish what is complete, until the node closes."""
        with self.until_ros_ends():
            look = 0.0
            while not self._stopping.wait(clocks.real(_POLL_PERIOD)):
                if (now := clocks.monotonic()) >= look:
                    look = now + _LOOK_PERIOD
                    self._wrong = {name: own.look() for name, own in self._topics.items()}
                self._take()
                self._send_due()

    def _take(self) -> None:
        """Hand what has arrived to the sources."""
        for name, topic in self._topics.items():
            self._sources[name].receive(topic.take(self._now))

    def _send_due(self) -> None:
        """Publish the values at the triggers that need not wait any longer."""
        due, self._due = self._due, []
        self.samples += len(due)
        settings = self.settings
        for name, publish in self._publish.items():
            if settings.sources[name].topic == NONE:
                for stamp in due:
                    publish(stamp, None)
                continue
            source = self._sources[name]
            source.settings = settings.sources[name]
            for stamp in due:
                source.trigger(stamp)
            for stamp, value in source.due(self._now(), self._period, settings.wait):
                publish(stamp, value)

    def _publish_wrench(self, stamp: int, value: Aligned | None) -> None:
        """Publish load_cell/wrench, [M; F] in {S}, tared [N m, N], and its tare."""
        tare, wrench = self._tare_taken, _MISSING_WRENCH
        if value is not None:
            wrench = in_load_cell(value.values, self._mapping)[0] - tare.wrench
        self._send_wrench(stamp, wrench)
        if "wrench" in self._sources:
            self._send_raw(stamp, _MISSING_WRENCH, tare.wrench, tare.time, Status.MISSING)

    def _tare(self, stamp: int, forced: bool) -> FloatArray:
        """Tare at the present time since the epoch [ns]; returns the removed load [N m, N]."""
        source, settings = self._sources["wrench"], self.settings
        start = stamp - round(1e9 * settings.tare_duration)
        wrenches = in_load_cell(source.between(start, stamp), self._mapping)
        return self._tare_taken.take(wrenches, source.rate, settings, stamp, forced)

    def _publish_clusters(self, stamp: int, value: Aligned | None) -> None:
        """Publish clusters/capacitance [pF]."""
        capacitance = np.full((len(self._names), 4), np.nan)
        if value is not None:
            capacitance = as_capacitances(value.values, self._names, self._calibration)[0]
        status = np.where(np.isfinite(capacitance), Status.OK, Status.MISSING).astype(np.uint8)
        self._send_capacitance(stamp, capacitance, status)

    def _publish_pose(
        self, topic: Topic, send: Callable[[int, FloatArray], None], stamp: int,
        value: Aligned | None,
    ) -> None:  # fmt: skip
        """Publish a body's pose: position [m] and quaternion x, y, z, w in the world."""
        pose = _MISSING_POSE if value is None else value.values[0]
        send(stamp, pose)
        if self._frames is not None:
            self._frames.move(stamp, {topic: pose})
