"""A subscriber to the estimates, as a user of the testbed would write one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any, Self

import numpy as np
import rclpy
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.task import Future
from socket_testbed_msgs.msg import ContactModel, ForceMap

from socket_testbed.arrays import FloatArray
from socket_testbed.nodes.base import NEWEST_STAMP, TestbedNode, spin
from socket_testbed.nodes.conversions import stamp_from_ros, vectors_from_ros, wrench_from_ros
from socket_testbed.nodes.estimate_messages import map_from_ros
from socket_testbed.settings.fields import Settings
from socket_testbed.trials.topics import (
    ESTIMATED_WRENCH,
    FORCE_MAP,
    LOCAL_FORCES,
    PARAMETERS,
    Topic,
)


class ListenerNode(TestbedNode[Settings]):
    """Its diagnostics let a replay wait until the estimates have arrived.

    Args:
        name: Name of the node.
        newest: The newest stamp of which every kind of estimate has come [ns]; None before any.
    """

    def __init__(self, name: str, newest: Callable[[], int | None]) -> None:
        self._newest = newest
        super().__init__(name, Settings)

    def figures(self) -> dict[str, object]:
        """The newest stamp, as nodes that follow a replay report it."""
        newest = self._newest()
        return {} if newest is None else {NEWEST_STAMP: newest}


def _map_values(message: ForceMap) -> FloatArray:
    found = map_from_ros(message)
    values = [*found.forces, *found.standard_deviations]
    pressures = [*found.normal_pressure, *found.normal_pressure_standard_deviation]
    return np.dstack([values, pressures])


# What is kept of a message.
_VALUES: dict[Topic, Callable[[Any], FloatArray]] = {
    ESTIMATED_WRENCH: lambda message: wrench_from_ros(message.wrench),
    LOCAL_FORCES: lambda message: vectors_from_ros(message.forces),
    FORCE_MAP: _map_values,
}


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
        self.estimates: dict[Topic, dict[int, FloatArray]] = {topic: {} for topic in _VALUES}
        self.models = 0

    def __enter__(self) -> Self:
        rclpy.init()
        self._node = ListenerNode(self.NAME, self._newest_stamp)
        for topic in _VALUES:
            self._node.listen(topic, partial(self._on_estimate, topic))
        self._node.listen(PARAMETERS, self._on_model)
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
        """The estimates of a topic at N stamps [ns], shape (N, ...); NaN where there is none.

        Raises:
            StopIteration: If none has come at all.
        """
        found = self.estimates[topic]
        none = np.full_like(next(iter(found.values())), np.nan)
        return np.array([found.get(stamp, none) for stamp in stamps])

    def _newest_stamp(self) -> int | None:
        return min((max(kind) for kind in self.estimates.values() if kind), default=None)

    def _on_estimate(self, topic: Topic, message: Any) -> None:
        stamp = stamp_from_ros(message.header.stamp)
        self.estimates[topic][stamp] = _VALUES[topic](message)

    def _on_model(self, message: ContactModel) -> None:
        self.models += 1
