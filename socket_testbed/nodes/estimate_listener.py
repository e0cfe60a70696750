"""A subscriber to the estimates, as a user of the testbed would write one."""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import Self

import numpy as np
import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.task import Future
from socket_testbed_msgs.msg import ContactModel, LocalForceArray

from socket_testbed.arrays import FloatArray
from socket_testbed.nodes.conversions import stamp_from_ros, vectors_from_ros, wrench_from_ros
from socket_testbed.nodes.diagnostics import Diagnostics
from socket_testbed.nodes.runtime import message_type, subscriber_qos
from socket_testbed.trials.topics import ESTIMATED_WRENCH, LOCAL_FORCES, PARAMETERS


class EstimateListener:
    """Collects the estimates of a graph while it runs; a context manager.

    Attributes:
        wrench: Predicted wrench [M; F] by stamp [ns], shape (6,) each [N m, N].
        forces: Predicted forces in {S} by stamp [ns], shape (n, 3) each [N].
        models: Number of models published.
    """

    NAME = "estimate_listener"

    def __init__(self) -> None:
        self.wrench: dict[int, FloatArray] = {}
        self.forces: dict[int, FloatArray] = {}
        self.models = 0

    def __enter__(self) -> Self:
        rclpy.init()
        self._node = rclpy.create_node(self.NAME)
        subscriptions = []
        for topic, callback in (
            (ESTIMATED_WRENCH, self._on_wrench),
            (LOCAL_FORCES, self._on_forces),
            (PARAMETERS, self._on_model),
        ):
            subscriptions.append(
                self._node.create_subscription(
                    message_type(topic), topic.name, callback, subscriber_qos(topic)
                )
            )
        # Its diagnostics tell a replay that waits for it that it is linked.
        self._diagnostics = Diagnostics(
            self._node, lambda: {"received": len(self.wrench)}, inputs=tuple(subscriptions)
        )
        self._executor = EventsExecutor()
        self._executor.add_node(self._node)
        self._done = Future()
        self._thread = threading.Thread(target=self._spin, name="listener")
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._done.set_result(None)
        self._thread.join()
        self._executor.remove_node(self._node)  # it holds on to the node's entities
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            while rclpy.ok() and not self._done.done():
                self._executor.spin_until_future_complete(self._done, timeout_sec=0.2)

    def _on_wrench(self, message: WrenchStamped) -> None:
        self.wrench[stamp_from_ros(message.header.stamp)] = wrench_from_ros(message.wrench)

    def _on_forces(self, message: LocalForceArray) -> None:
        self.forces[stamp_from_ros(message.header.stamp)] = vectors_from_ros(message.forces)

    def _on_model(self, message: ContactModel) -> None:
        self.models += 1

    def series(self, stamps: list[int], points: int) -> tuple[FloatArray, FloatArray]:
        """The estimates at some stamps, NaN where there is none.

        Args:
            stamps: Stamps [ns], N of them.
            points: Number n of points of interest.

        Returns:
            Wrenches, shape (N, 6) [N m, N], and forces in {S}, shape (N, n, 3) [N].
        """
        no_wrench, no_forces = np.full(6, np.nan), np.full((points, 3), np.nan)
        wrench = np.array([self.wrench.get(stamp, no_wrench) for stamp in stamps])
        forces = np.array([self.forces.get(stamp, no_forces) for stamp in stamps])
        return wrench, forces
