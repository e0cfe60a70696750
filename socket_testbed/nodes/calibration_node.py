"""Calibration node: converts the clusters' capacitances to stresses.

Subscribes: clusters/capacitance. Publishes: clusters/stress, /diagnostics.
"""

from __future__ import annotations

import numpy as np

from socket_testbed.calibration.model import read_calibration
from socket_testbed.files import CALIBRATION_FILE, file_or_packaged
from socket_testbed.nodes.base import ERROR, MESSAGES, NEWEST_STAMP, OK, WARN, TestbedNode
from socket_testbed.samples import Status
from socket_testbed.settings.testbed import CalibrationNodeSettings
from socket_testbed.wire.messages import Capacitances, stress_packer
from socket_testbed.wire.topics import CAPACITANCE, STRESS


class CalibrationNode(TestbedNode[CalibrationNodeSettings]):
    """Applies the calibration to every capacitance message.

    Subscribes: clusters/capacitance, by cluster the capacitances by converter input [pF] and their
    statuses. Publishes: clusters/stress, with the same stamp and clusters, frame load_cell: normal
    stress (positive in compression) and shears along x and y of the cluster's own frame [Pa].
    """

    def __init__(self) -> None:
        super().__init__("calibration_node", CalibrationNodeSettings)
        path = file_or_packaged(self.settings.calibration, CALIBRATION_FILE)
        self._calibration = read_calibration(path)
        self._messages = 0
        self._newest = 0
        self._names: tuple[str, ...] | None = None
        self._states: list[int] = []
        self._stress = self.advertise(STRESS, needed=True)
        self.follow(CAPACITANCE, self._on_capacitance)

    def figures(self) -> dict[str, object]:
        """Number of messages, and the newest stamp since the epoch [ns]."""
        return {MESSAGES: self._messages, NEWEST_STAMP: self._newest}

    def _on_capacitance(self, stamp: int, read: Capacitances) -> None:
        """Publish the stresses [Pa] of the capacitances [pF] at a stamp [ns]; c clusters each."""
        news = read.names != self._names
        if news:
            self._prepare(read.names)
        stress, status = self._nothing.copy(), self._missing.copy()
        if known := self._known:
            stress[known], status[known] = self._coefficients.apply(
                read.capacitance[known], read.status[known]
            )
        states = status.tolist()
        self._newest = stamp
        self._messages += 1
        self._stress.publish(self._pack(stamp, stress, status))
        if news or states != self._states:
            self._states = states
            self.report(*self._health(read.names, states))

    def _prepare(self, names: tuple[str, ...]) -> None:
        """Switch to other clusters; those without a calibration stay missing."""
        self._names = names
        self._known = [i for i, name in enumerate(names) if name in self._calibration.clusters]
        if self._known:
            self._coefficients = self._calibration.stacked([names[i] for i in self._known])
        self._nothing = np.full((len(names), 3), np.nan)
        self._missing = np.full(len(names), Status.MISSING, dtype=np.uint8)
        self._pack = stress_packer(names)

    def _health(self, names: tuple[str, ...], status: list[int]) -> tuple[int, str]:
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
