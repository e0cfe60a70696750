"""A subscriber to the estimates, as a user of the testbed would write one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Self

import numpy as np
import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.task import Future
from socket_testbed_msgs.msg import ContactModel, ForceMap, LocalForceArray

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


class EstimateListener:
    """Collects the estimates of a graph while it runs; a context manager.

    Attributes:
        wrench: Predicted wrench [M; F] by stamp [ns], shape (6,) each [N m, N].
        forces: Predicted forces in {S} by stamp [ns], shape (n, 3) each [N].
        maps: Forces of the force map in {S} and their standard deviations by axis of {S}, by stamp
            [ns], shape (2, n, 3) each [N].
        pressure: The force map's normal pressure and its standard deviation by stamp [ns], shape
            (2, n) each [Pa].
        models: Number of models published.
    """

    NAME = "estimate_listener"

    def __init__(self) -> None:
        self.wrench: dict[int, FloatArray] = {}
        self.forces: dict[int, FloatArray] = {}
        self.maps: dict[int, FloatArray] = {}
        self.pressure: dict[int, FloatArray] = {}
        self.models = 0

    def __enter__(self) -> Self:
        rclpy.init()
        self._node = ListenerNode(self.NAME, self._newest_stamp)
        self._node.listen(ESTIMATED_WRENCH, self._on_wrench)
        self._node.listen(LOCAL_FORCES, self._on_forces)
        self._node.listen(FORCE_MAP, self._on_map)
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

    def _newest_stamp(self) -> int | None:
        found = [max(kind) for kind in (self.wrench, self.forces, self.maps) if kind]
        return min(found, default=None)

    def _on_wrench(self, message: WrenchStamped) -> None:
        self.wrench[stamp_from_ros(message.header.stamp)] = wrench_from_ros(message.wrench)

    def _on_forces(self, message: LocalForceArray) -> None:
        self.forces[stamp_from_ros(message.header.stamp)] = vectors_from_ros(message.forces)

    def _on_map(self, message: ForceMap) -> None:
        stamp, found = stamp_from_ros(message.header.stamp), map_from_ros(message)
        self.maps[stamp] = np.concatenate([found.forces, found.standard_deviations])
        self.pressure[stamp] = np.concatenate(
            [found.normal_pressure, found.normal_pressure_standard_deviation]
        )

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

    def map_series(self, stamps: list[int], points: int) -> tuple[FloatArray, FloatArray]:
        """The force maps at some stamps, NaN where there is none.

        Args:
            stamps: Stamps [ns], N of them.
            points: Number n of tiles.

        Returns:
            Forces in {S} and their standard deviations by axis of {S}, shape (2, N, n, 3) [N];
            normal pressures and their standard deviations, shape (2, N, n) [Pa].
        """
        no_forces, no_pressure = np.full((2, points, 3), np.nan), np.full((2, points), np.nan)
        forces = np.stack([self.maps.get(stamp, no_forces) for stamp in stamps], axis=1)
        pressure = np.stack([self.pressure.get(stamp, no_pressure) for stamp in stamps], axis=1)
        return forces, pressure
