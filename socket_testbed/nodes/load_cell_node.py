"""Load-cell node: measures the wrench, averaged around each trigger.

Subscribes: trigger, clusters/stress, recorder/trial. Publishes: load_cell/wrench, load_cell/raw,
event, /diagnostics. Services: load_cell/tare, load_cell/force_tare.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from socket_testbed import clocks
from socket_testbed.drivers.load_cell.load_cell import check_settings
from socket_testbed.live.hardware import make_load_cell
from socket_testbed.nodes.base import OK, WARN
from socket_testbed.nodes.sensor_node import SensorNode
from socket_testbed.nodes.taring import TareServices
from socket_testbed.settings.acquisition import LoadCellSettings, averaging_span
from socket_testbed.wire.messages import load_cell_raw_packer, wrench_packer
from socket_testbed.wire.topics import LOAD_CELL_RAW, WRENCH

_CONVERSION_TIMEOUT = 0.05  # [s]; for the conversions after a trigger


class LoadCellNode(SensorNode[LoadCellSettings]):
    """Reads the converter continuously and averages around each trigger.

    Publishes, with the stamp of the trigger and in the frame load_cell, {S}: load_cell/wrench, the
    wrench of the limb on the socket, tared [N, N m]; load_cell/raw, the ratios of the bridges
    [V/V], the tare that was subtracted [N, N m] and when it was taken [ns], and a status. Both are
    NaN where nothing was measured. Publishes on event that the load cell was tared.

    Services: load_cell/tare tares at rest, unless the load exceeds the setting `tare_load` [N], a
    cluster is pressed by more than `tare_pressure` [Pa] or a trial is being recorded;
    load_cell/force_tare tares at rest even then. Subscribes to clusters/stress, the clusters'
    normal stresses [Pa], to know.
    """

    def __init__(self) -> None:
        super().__init__("load_cell_node", LoadCellSettings)
        self.device = f"spidev{self.settings.device}"
        self._cell = make_load_cell(self.settings)
        self._send_wrench = self.sender(WRENCH, wrench_packer())
        self._send_raw = self.sender(LOAD_CELL_RAW, load_cell_raw_packer())
        self._averaged = 0  # conversions around the last trigger
        self._polled = threading.Condition()
        self._stopping = threading.Event()
        polling = (self._stopping.is_set, self._wake)
        self._polling = threading.Thread(
            target=self._cell.converter.poll_until, args=polling, name="load_cell"
        )
        self._polling.start()
        self.follow_triggers()
        self._taring = TareServices(self, self._cell.tare, self.trigger_time, lambda: self.period)

    def _read_settings(self, changes: dict[str, Any]) -> LoadCellSettings:
        settings = super()._read_settings(changes)
        check_settings(settings)
        return settings

    def close(self) -> None:
        """Stop reading and close the converter."""
        super().close()
        self._stopping.set()
        self._polling.join()
        self._cell.converter.close()

    def figures(self) -> dict[str, object]:
        """Counts of the measurements and the converter, and conversions in the last wrench [1]."""
        own = {"averaged_conversions": self._averaged}
        return {**super().figures(), **own, **self._cell.figures()}

    def _wake(self) -> None:
        """Wake the thread that waits for conversions."""
        with self._polled:
            self._polled.notify_all()

    def measure(self, stamp: int, moment: float) -> None:
        """Average the conversions around the trigger; publish load_cell/wrench and load_cell/raw.

        Args:
            stamp: Stamp of the trigger since the epoch [ns].
            moment: The trigger on the testbed's steady clock [s].
        """
        span = averaging_span(self.settings.average_over, self.period)
        over = self._cell.end_time(moment, span)
        clocks.sleep(max(0.0, over - clocks.monotonic()))
        left = over + _CONVERSION_TIMEOUT - clocks.monotonic()
        with self._polled:
            self._polled.wait_for(lambda: self._cell.ready(moment, span), clocks.real(left))
        reading = self._cell.wrench_at(moment, span)
        self._averaged = reading.conversions
        if reading.fault:
            self.missing += bool(np.isnan(reading.wrench).any())
            self.fault.note(reading.fault)
        self._send_wrench(stamp, reading.wrench)
        self._send_raw(stamp, reading.ratios, reading.tare, reading.tared, reading.status)

    def health(self) -> tuple[int, str]:
        """The converter's health, or the latest fault."""
        self._cell.settings = self.settings
        level, message = self._cell.health(clocks.monotonic())
        if level == OK and (fault := self.fault.text()):
            return WARN, fault
        return level, message
