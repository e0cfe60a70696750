"""Calibration node: capacitances of the clusters to stresses.

Subscribes: clusters/capacitance. Publishes: clusters/stress, /diagnostics.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from socket_testbed_msgs.msg import ClusterCapacitanceArray

from socket_testbed.calibration.model import read_calibration
from socket_testbed.files import packaged
from socket_testbed.nodes.base import ERROR, NEWEST_STAMP, OK, WARN, TestbedNode
from socket_testbed.nodes.conversions import stamp_from_ros, stress_to_ros
from socket_testbed.samples import Status
from socket_testbed.settings.testbed import CalibrationNodeSettings
from socket_testbed.trials.topics import CAPACITANCE, STRESS


class CalibrationNode(TestbedNode[CalibrationNodeSettings]):
    """Applies the calibration to every message of capacitances."""

    def __init__(self) -> None:
        super().__init__("calibration_node", CalibrationNodeSettings)
        path = self.settings.calibration
        self._calibration = read_calibration(
            Path(path) if path else packaged("config", "calibration.yaml")
        )
        self._messages = 0
        self._newest = 0
        self._stress = self.advertise(STRESS, needed=True)
        self.listen(CAPACITANCE, self._on_capacitance)

    def figures(self) -> dict[str, object]:
        """Number of messages, and the newest stamp."""
        return {"messages": self._messages, NEWEST_STAMP: self._newest}

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
        self._stress.publish(stress_to_ros(self._newest, names, stress, status))
        self.report(*self._health(names, status.tolist()))

    def _health(self, names: list[str], status: list[int]) -> tuple[int, str]:
        unknown = [name for name in names if name not in self._calibration.clusters]
        if unknown:
            listed = ", ".join(unknown)
            return ERROR, f"no calibration for {listed}: give these clusters' calibration.yaml"
        faults = [
            f"{name} {Status(state).name.lower().replace('_', ' ')}"
            for name, state in zip(names, status, strict=True)
            if state != Status.OK
        ]
        if faults:
            return WARN, ", ".join(faults)
        return OK, f"{len(names)} clusters calibrated"
