"""Subscribers to a running graph: one collects its estimates, one watches it for a status line."""

from __future__ import annotations

import threading
from functools import partial
from typing import Any, Self

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from socket_testbed_msgs.msg import ContactModel
from std_msgs.msg import String
from std_srvs.srv import SetBool

from socket_testbed.arrays import FloatArray
from socket_testbed.live.graph_status import MEASURED, GraphStatus
from socket_testbed.nodes.base import NEWEST_STAMP, Inbox, TestbedNode, spin, subscriber_qos
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


class EstimateListener(TestbedNode[Settings]):
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
        rclpy.init()
        self.estimates: dict[Topic, dict[int, FloatArray]] = {topic: {} for topic in _ESTIMATES}
        self.models = 0
        super().__init__(self.NAME, Settings)
        for topic in _ESTIMATES:
            self.listen(topic, partial(self._on_estimate, topic, Reader(topic)), raw=True)
        self.listen(PARAMETERS, self._on_model, raw=True)
        self._spinning = threading.Thread(target=spin, args=([self],), name="listener")

    def __enter__(self) -> Self:
        self._spinning.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.finished.set_result(None)
        self._spinning.join()
        self.destroy_node()
        rclpy.try_shutdown()

    def series(self, topic: Topic, stamps: list[int]) -> FloatArray:
        """The estimates of a topic at N stamps [ns], shape (N, ...); NaN where there is none."""
        found = self.estimates[topic]
        none = np.full_like(next(iter(found.values())), np.nan)
        return np.array([found.get(stamp, none) for stamp in stamps])

    def figures(self) -> dict[str, object]:
        """The newest stamp of which every kind of estimate has come: a replay waits for it."""
        # 0 before any: a replay that ends meanwhile waits for this node, too.
        newest = (max(kind) for kind in self.estimates.values() if kind)
        return {NEWEST_STAMP: min(newest, default=0)}

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

    The program that draws the status line takes what has come, twenty times a second.
    """

    def __init__(self, status: GraphStatus, namespace: str = "/", pause: str = "") -> None:
        self._status = status
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C is the verb's
        node = Node(
            "_status_listener",
            namespace=namespace,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self._readers = {topic: Reader(topic) for topic in _WATCHED}
        self._topics = (*_WATCHED, PARAMETERS, RECORDED_TRIAL)
        self._inbox = Inbox(node, {topic: subscriber_qos(topic) for topic in self._topics})
        self._pause = node.create_client(SetBool, pause) if pause else None

    def take(self) -> None:
        """Take what has come since the last call."""
        for topic in self._topics:
            for data in self._inbox.take(topic):
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
        self._inbox.close()
        rclpy.try_shutdown()
