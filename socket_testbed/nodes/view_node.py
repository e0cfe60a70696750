"""View node: serves the page on which the running testbed is seen in a browser.

Subscribes, while a browser is open: estimate/force_map, load_cell/wrench, estimate/wrench,
mocap/socket/pose, mocap/pylon/pose, clusters/stress. Always: /diagnostics, recorder/trial.
Publishes: /diagnostics.

No executor serves the subscriptions of the page: the thread that draws takes the newest messages
when it needs them. At 100 Hz most of them are never decoded.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_msgs.msg import String

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray
from socket_testbed.files import packaged
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.live.estimator import OnlineMap
from socket_testbed.nodes.base import ELAPSED, FREE, OK, PolledSubscription, TestbedNode
from socket_testbed.nodes.controls import ServiceControls
from socket_testbed.nodes.frames import known_pose
from socket_testbed.settings.testbed import EstimatorSettings, ViewSettings
from socket_testbed.trials.messages import Reader
from socket_testbed.trials.topics import (
    DIAGNOSTICS,
    ESTIMATED_WRENCH,
    FORCE_MAP,
    PYLON_POSE,
    RECORDED_TRIAL,
    SOCKET_POSE,
    STRESS,
    WRENCH,
    Topic,
)
from socket_testbed.viewer.page import Page, PageServer
from socket_testbed.viewer.source import HISTORY, Controls, Instant, RegionsNow, SensorState
from socket_testbed.viewer.source import Recording as RecordingNow

_OLD = 2.0  # [s]; what came longer ago is not shown as if it were now
_DEPTHS = {FORCE_MAP: 1, SOCKET_POSE: 1, PYLON_POSE: 1, WRENCH: 50, ESTIMATED_WRENCH: 50}
_REGIONS_EVERY = 1.0  # [s] at least between joint draws
_ESTIMATOR = "estimator_node/get_parameters"
_FOREIGN = SensorState(
    "force map", 2, "is of another socket than the page's: give its --geometry", math.nan, 0.0
)
_COUNTS = ("samples", "triggers", "messages", "maps")  # among the figures of a node


class ViewNode(TestbedNode[ViewSettings]):
    """Shows the running testbed in browsers."""

    def __init__(self) -> None:
        super().__init__("view_node", ViewSettings)
        settings = self.settings
        path = Path(settings.geometry) if settings.geometry else packaged("config", "socket.yaml")
        server = PageServer(settings.host, settings.port, settings.names)
        allowed = settings.buttons or server.is_local
        controls = ServiceControls(self) if allowed else None
        self._live = LiveSource(self, read_socket(path), controls)
        self._page = Page(self._live, server)
        self.report(OK, f"the testbed is seen at {server.url}")

    def check(self) -> None:
        """End where the page has failed: `run` starts the node again."""
        if not self._page.works:
            raise RuntimeError("the page draws no more, see above")

    def close(self) -> None:
        """End the page."""
        self._page.close()
        super().close()


class LiveSource:
    """The running testbed as the page shows it.

    Args:
        node: The node that listens to diagnostics.
        geometry: Geometry of the socket.
        controls: What the buttons do; None where nobody may press them.
    """

    playback = None

    def __init__(
        self, node: TestbedNode[Any], geometry: SocketGeometry, controls: Controls | None
    ) -> None:
        self.geometry = geometry
        self.controls = controls
        self._node = node
        self._own = node.get_fully_qualified_name()
        self._prefix = self._own.removesuffix(node.get_name())
        self._inbox: _Inbox | None = None
        self._newest: dict[Topic, tuple[int, Any, float]] = {}  # stamp [ns], values, arrival [s]
        self._rows: dict[int, FloatArray] = {}  # measured and predicted wrench by stamp [ns]
        self._first = 0  # [ns]
        self._shown: Instant | None = None
        self._sensors: dict[str, tuple[DiagnosticArray, float]] = {}
        self._rates: dict[str, tuple[float, float, float]] = {}  # count, time [s], rate [Hz]
        self._trial = ("", 0.0)
        self._settings = EstimatorSettings()  # those of the estimator that runs
        self._regions = OnlineMap(geometry, lambda: self._settings)
        self._outputs: RegionsNow | None = None
        self._next_outputs = -math.inf  # [s]
        self._asked = False
        self._estimator = node.create_client(GetParameters, _ESTIMATOR)
        node.listen(DIAGNOSTICS, self._on_diagnostics, needed=False)
        node.listen(RECORDED_TRIAL, self._on_trial, needed=False)

    def watched(self, on: bool) -> None:
        """Subscribe while a browser is open."""
        if on:
            self._inbox = _Inbox(self._node)
            self._asked = False
        elif self._inbox is not None:
            self._inbox.close()
            self._inbox = None
            self._newest.clear()

    def instant(self) -> Instant | None:
        """The newest sample."""
        if self._inbox is None or not self._take(self._inbox):
            return self._shown_or_old()
        stamp = max(stamp for stamp, _, _ in self._newest.values())
        wrench, predicted = self._wrench(WRENCH), self._wrench(ESTIMATED_WRENCH)
        socket, limb = self._poses()
        self._shown = Instant(
            stamp, (stamp - self._first) * 1e-9, self._map(), wrench, predicted, socket, limb
        )
        return self._shown

    def wrenches(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The last wrenches."""
        stamps = sorted(self._rows)
        rows = np.array([self._rows[stamp] for stamp in stamps]).reshape(-1, 12)
        time = 1e-9 * (np.array(stamps, dtype=np.float64) - self._first)
        return time, rows[:, :6], rows[:, 6:]

    def sensors(self) -> list[SensorState]:
        """What the nodes report of themselves."""
        now = clocks.monotonic()
        return [_FOREIGN] * self._has_foreign_map() + [
            SensorState(
                name,
                int.from_bytes(status.level, "little"),
                status.message,
                self._rates.get(name, (0.0, 0.0, math.nan))[2],
                now - arrival,
            )
            for name, (status, arrival) in sorted(self._sensors.items())
        ]

    def recording(self) -> RecordingNow | None:
        """The trial that is being recorded."""
        trial, since = self._trial
        now = clocks.monotonic()
        recorder, arrival = self._sensors.get(f"{self._prefix}recorder_node", (None, now))
        if recorder is None:
            return RecordingNow(trial, now - since if trial else 0.0, math.nan)
        figures = {entry.key: entry.value for entry in recorder.values}
        elapsed = float(figures[ELAPSED]) + now - max(arrival, since) if trial else 0.0
        return RecordingNow(trial, elapsed, float(figures[FREE]))

    def regions(self) -> RegionsNow | None:
        """The standard outputs of the newest sample."""
        now = clocks.monotonic()
        if now < self._next_outputs or self._inbox is None:
            return self._outputs
        self._next_outputs = now + _REGIONS_EVERY
        self._ask_settings()
        self._outputs = None
        for stamp, stresses in self._inbox.take(STRESS):
            row = self._rows.get(stamp)
            wrench = np.full(6, np.nan) if row is None else row[:6]
            outputs = self._regions.outputs(wrench, stresses)
            if outputs is not None:
                at = 1e-9 * (stamp - self._first)
                self._outputs = RegionsNow(at, self._regions.places, outputs)
        return self._outputs

    def _ask_settings(self) -> None:
        """Ask for the prior of the estimator, and for what it leaves out, once per browser."""
        if self._asked or not self._estimator.service_is_ready():
            return
        self._asked = True
        names = [n for n in EstimatorSettings.flat() if n.startswith("force_map.")]
        names.append("identification.leave_out")

        def take(answer: Future) -> None:
            values = [parameter_value_to_python(value) for value in answer.result().values]
            given = dict(zip(names, values, strict=True))
            given["identification.leave_out"] = [n for n in given[names[-1]] or () if n]
            self._settings = EstimatorSettings.from_flat(given, _ESTIMATOR)

        request = GetParameters.Request(names=names)
        self._estimator.call_async(request).add_done_callback(take)

    def _take(self, inbox: _Inbox) -> bool:
        """Take what has come; returns whether it is anything."""
        now, news = clocks.monotonic(), False
        for topic in _DEPTHS:
            for stamp, values in inbox.take(topic):
                news = True
                self._newest[topic] = stamp, values, now
                if topic in (WRENCH, ESTIMATED_WRENCH):
                    self._add_row(topic, stamp, values)
        return news

    def _add_row(self, topic: Topic, stamp: int, wrench: FloatArray) -> None:
        if not self._rows or stamp < next(iter(self._rows)):  # a graph that was started again
            self._rows.clear()
            self._first = self._first if 0 < self._first <= stamp else stamp
        row = self._rows.setdefault(stamp, np.full(12, np.nan))
        row[0 if topic is WRENCH else 6 :][:6] = wrench
        while stamp - next(iter(self._rows)) > HISTORY * 1e9:
            del self._rows[next(iter(self._rows))]

    def _shown_or_old(self) -> Instant | None:
        """What was shown, without what has become old."""
        shown = self._shown
        if shown is not None and shown.map is not None and self._recent(FORCE_MAP) is None:
            nothing = np.full(6, np.nan)
            self._shown = Instant(shown.stamp, shown.time, None, nothing, nothing, None, None)
        return self._shown

    def _recent(self, topic: Topic) -> Any:
        """The newest values; None where they came long ago."""
        _, values, arrival = self._newest.get(topic, (0, None, -math.inf))
        return values if clocks.monotonic() - arrival < _OLD else None

    def _wrench(self, topic: Topic) -> FloatArray:
        wrench: FloatArray | None = self._recent(topic)
        return np.full(6, np.nan) if wrench is None else wrench

    def _map(self) -> MapEstimate | None:
        found = self._recent(FORCE_MAP)
        return None if found is None or self._has_foreign_map() else MapEstimate(**found[1])

    def _has_foreign_map(self) -> bool:
        """Whether the newest map is of another socket than the one that is shown."""
        found = self._recent(FORCE_MAP)
        return found is not None and found[0] != self.geometry.names

    def _poses(self) -> tuple[Pose | None, Pose | None]:
        """Pose of {S} and of the limb in the world."""
        socket, pylon = (self._pose(topic) for topic in (SOCKET_POSE, PYLON_POSE))
        return (
            socket @ self.geometry.socket_body.inverse() if socket else None,
            pylon @ self.geometry.limb if pylon else None,
        )

    def _pose(self, topic: Topic) -> Pose | None:
        pose = self._recent(topic)
        return None if pose is None else known_pose(pose)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now = clocks.monotonic()
        for status in message.status:
            # Another testbed may run in another namespace.
            if status.name.rpartition("/")[0] + "/" != self._prefix or status.name == self._own:
                continue
            self._sensors[status.name] = status, now
            values = {entry.key: entry.value for entry in status.values}
            counts = [float(values[key]) for key in _COUNTS if key in values]
            if not counts:
                continue
            count, since, rate = self._rates.get(status.name, (counts[0], now, math.nan))
            if now - since > 0.5:
                rate = (counts[0] - count) / (now - since)
                count, since = counts[0], now
            self._rates[status.name] = count, since, rate

    def _on_trial(self, message: String) -> None:
        self._trial = message.data, clocks.monotonic()


class _Inbox:
    """Takes the messages that the page draws, and reads them."""

    def __init__(self, node: TestbedNode[Any]) -> None:
        self._node = Node(
            f"_{node.get_name()}_inbox",
            namespace=node.get_namespace(),
            context=node.context,
            start_parameter_services=False,
            use_global_arguments=False,
        )
        topics = (*_DEPTHS, STRESS)
        self._subscriptions = {topic: self._subscribe(topic) for topic in topics}
        self._readers = {topic: Reader(topic) for topic in topics}

    def close(self) -> None:
        """Unsubscribe."""
        self._node.destroy_node()

    def take(self, topic: Topic) -> list[tuple[int, Any]]:
        """Stamps and values of what has come, in its order; at most as many as are kept."""
        return [self._readers[topic].read(data) for data in self._subscriptions[topic].take()]

    def _subscribe(self, topic: Topic) -> PolledSubscription:
        # Whoever publishes waits for no page: a message that is lost is not sent again.
        qos = QoSProfile(depth=_DEPTHS.get(topic, 1), reliability=ReliabilityPolicy.BEST_EFFORT)
        return PolledSubscription(self._node, topic, qos)
