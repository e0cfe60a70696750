"""Subscribers to a running graph: one collects its estimates, one watches it for a status line."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any, Self

import numpy as np
import rclpy
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from socket_testbed_msgs.msg import ContactModel
from std_msgs.msg import String
from std_srvs.srv import SetBool

from socket_testbed.arrays import FloatArray
from socket_testbed.live.graph_status import MEASURED, GraphStatus
from socket_testbed.nodes.base import (
    NEWEST_STAMP,
    PolledSubscription,
    TestbedNode,
    spin,
    subscriber_qos,
)
from socket_testbed.settings.fields import Settings
from socket_testbed.trials.messages import Reader
from socket_testbed.trials.topics import (
    ESTIMATED_WRENCH,
    FORCE_MAP,
    LOCAL_FORCES,
    PARAMETERS,
    RECORDED_TRIAL,
    TRIGGER,
    Topic,
)

_ESTIMATES = (ESTIMATED_WRENCH, LOCAL_FORCES, FORCE_MAP)
_WATCHED = (TRIGGER, ESTIMATED_WRENCH, *MEASURED)


class ListenerNode(TestbedNode[Settings]):
    """Reports the newest stamp that has come [ns], until which a replay waits; None for no wait."""

    def __init__(self, name: str, newest: Callable[[], int | None]) -> None:
        self._newest = newest
        super().__init__(name, Settings)

    def figures(self) -> dict[str, object]:
        """The newest stamp, as nodes that follow a replay report it."""
        newest = self._newest()
        return {} if newest is None else {NEWEST_STAMP: newest}


class EstimateListener:
    """Collects the estimates of a graph while it runs; a context manager.

    Attributes:
        estimates: By topic and stamp [ns]: of ESTIMATED_WRENCH [M; F], shape (6,) [N m, N]; of
            LOCAL_FORCES the forces in {S}, shape (n, 3) [N]; of FORCE_MAP the values and their
            standard deviations, shape (2, n, 4): the force in {S} [N], and the normal pressure
            [Pa].
        models: Number of models published.
    """

    NAME = "estimate_listener"

    def __init__(self) -> None:
        self.estimates: dict[Topic, dict[int, FloatArray]] = {topic: {} for topic in _ESTIMATES}
        self.models = 0

    def __enter__(self) -> Self:
        rclpy.init()
        self._node = ListenerNode(self.NAME, self._newest_stamp)
        for topic in _ESTIMATES:
            self._node.listen(topic, partial(self._on_estimate, topic, Reader(topic)), raw=True)
        self._node.listen(PARAMETERS, self._on_model, raw=True)
        self._executor = EventsExecutor()
        self._executor.add_node(self._node)
        self._done = Future()
        self._thread = threading.Thread(
            target=spin, args=(self._executor, [self._done]), name="listener"
        )
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._done.set_result(None)
        self._thread.join()
        self._executor.remove_node(self._node)  # it holds on to the node's entities
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown()

    def series(self, topic: Topic, stamps: list[int]) -> FloatArray:
        """The estimates of a topic at N stamps [ns], shape (N, ...); NaN where there is none."""
        found = self.estimates[topic]
        none = np.full_like(next(iter(found.values())), np.nan)
        return np.array([found.get(stamp, none) for stamp in stamps])

    def _newest_stamp(self) -> int:
        # 0 before any: a replay that ends meanwhile waits for this node, too.
        return min((max(kind) for kind in self.estimates.values() if kind), default=0)

    def _on_estimate(self, topic: Topic, reader: Reader, data: bytes) -> None:
        stamp, values = reader.read(data)
        self.estimates[topic][stamp] = _map_values(values[1]) if topic is FORCE_MAP else values

    def _on_model(self, data: bytes) -> None:
        self.models += 1


def _map_values(fields: dict[str, Any]) -> FloatArray:
    vectors = [*fields["forces"], *fields["standard_deviations"]]
    pressures = [*fields["normal_pressure"], *fields["normal_pressure_standard_deviation"]]
    return np.dstack([vectors, pressures])


class StatusListener:
    """Feeds a graph's status with serialised messages; `pause` names a replay's service, if any.

    No executor and no thread serve it: the program that draws the status line takes what has come,
    twenty times a second. At 100 Hz that takes 2 % of a core, where an executor takes 4 %.
    """

    def __init__(self, status: GraphStatus, namespace: str = "/", pause: str = "") -> None:
        self._status = status
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C is the verb's
        self._node = Node(
            "_status_listener",
            namespace=namespace,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self._readers = {topic: Reader(topic) for topic in _WATCHED}
        self._subscriptions = {
            topic: PolledSubscription(self._node, topic, subscriber_qos(topic))
            for topic in (*_WATCHED, PARAMETERS, RECORDED_TRIAL)
        }
        self._pause = self._node.create_client(SetBool, pause) if pause else None

    def take(self) -> None:
        """Take what has come since the last call."""
        for topic, subscription in self._subscriptions.items():
            for data in subscription.take():
                self.add(topic, data)

    def add(self, topic: Topic, data: bytes) -> None:
        """Feed a serialised message of a topic."""
        if topic is PARAMETERS:
            self._status.variant = deserialize_message(data, ContactModel).variant
        elif topic is RECORDED_TRIAL:
            self._status.trial = deserialize_message(data, String).data
        else:
            self._status.add(topic, *self._readers[topic].read(data))

    def set_paused(self, paused: bool) -> bool:
        """Pause the replay or let it go on; returns whether it was there to be asked."""
        if self._pause is None or not self._pause.service_is_ready():
            return False
        self._pause.call_async(SetBool.Request(data=paused))
        return True

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()
        rclpy.try_shutdown()
