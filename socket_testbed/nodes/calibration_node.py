"""Calibration node: capacitances of the clusters to stresses.

Subscribes: clusters/capacitance. Publishes: clusters/stress, /diagnostics.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rclpy.node import Node
from rclpy.task import Future
from socket_testbed_msgs.msg import ClusterCapacitanceArray, ClusterStressArray

from socket_testbed.calibration.model import read_calibration
from socket_testbed.files import packaged
from socket_testbed.nodes.conversions import stamp_from_ros, stress_to_ros
from socket_testbed.nodes.diagnostics import ERROR, NEWEST_STAMP, OK, WARN, Diagnostics
from socket_testbed.nodes.parameters import Parameters
from socket_testbed.nodes.runtime import publisher_qos, run_node, subscriber_qos
from socket_testbed.samples import Status
from socket_testbed.settings.testbed import CalibrationNodeSettings
from socket_testbed.trials.topics import CAPACITANCE, STRESS


class CalibrationNode(Node):
    """Applies the calibration to every message of capacitances."""

    def __init__(self) -> None:
        super().__init__("calibration_node")
        self.finished = Future()
        parameters = Parameters(self, CalibrationNodeSettings)
        path = parameters.settings.calibration
        self._calibration = read_calibration(
            Path(path) if path else packaged("config", "calibration.yaml")
        )
        self._messages = 0
        self._newest = 0
        self._publisher = self.create_publisher(
            ClusterStressArray, STRESS.name, publisher_qos(STRESS)
        )
        self._subscription = self.create_subscription(
            ClusterCapacitanceArray,
            CAPACITANCE.name,
            self._on_capacitance,
            subscriber_qos(CAPACITANCE),
        )
        self._diagnostics = Diagnostics(
            self,
            lambda: {"messages": self._messages, NEWEST_STAMP: self._newest},
            inputs=(self._subscription,),
            outputs=(self._publisher,),
        )

    def close(self) -> None:
        """Nothing is left open."""

    def _on_capacitance(self, message: ClusterCapacitanceArray) -> None:
        stress = np.full((len(message.clusters), 3), np.nan)
        status = np.full(len(message.clusters), Status.MISSING, dtype=np.uint8)
        for i, cluster in enumerate(message.clusters):
            calibration = self._calibration.clusters.get(cluster.name)
            if calibration is not None:
                stress[i], status[i] = calibration.apply(
                    np.asarray(cluster.capacitance), np.asarray(cluster.status)
                )
        names = [cluster.name for cluster in message.clusters]
        self._newest = stamp_from_ros(message.header.stamp)
        self._messages += 1
        self._publisher.publish(stress_to_ros(self._newest, names, stress, status))
        self._report(names, status.tolist())

    def _report(self, names: list[str], status: list[int]) -> None:
        unknown = [name for name in names if name not in self._calibration.clusters]
        if unknown:
            self._diagnostics.report(
                ERROR,
                f"no calibration for {', '.join(unknown)}: give these clusters' calibration.yaml",
            )
            return
        faults = [
            f"{name} {Status(state).name.lower().replace('_', ' ')}"
            for name, state in zip(names, status, strict=True)
            if state != Status.OK
        ]
        if faults:
            self._diagnostics.report(WARN, ", ".join(faults))
        else:
            self._diagnostics.report(OK, f"{len(names)} clusters calibrated")


def main() -> None:
    """Run the node."""
    run_node(CalibrationNode)


if __name__ == "__main__":
    main()
