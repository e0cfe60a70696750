"""Load-cell node: the wrench at each trigger, averaged over a window around it.

Subscribes: trigger. Publishes: load_cell/wrench, /diagnostics. Service: load_cell/tare.
"""

from __future__ import annotations

import threading

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger as TriggerService

from socket_testbed import clocks
from socket_testbed.drivers.load_cell.load_cell import LoadCell
from socket_testbed.errors import TestbedError
from socket_testbed.live.hardware import spi_opener
from socket_testbed.nodes.conversions import LOAD_CELL_FRAME, header_to_ros, wrench_to_ros
from socket_testbed.nodes.diagnostics import LEVELS, SETTLE, Diagnostics, RecentFault
from socket_testbed.nodes.parameters import Parameters
from socket_testbed.nodes.runtime import BlockingService, publisher_qos, run_node
from socket_testbed.nodes.trigger_follower import TriggerFollower
from socket_testbed.settings.acquisition import LoadCellSettings
from socket_testbed.trials.topics import WRENCH

_PATIENCE = 0.05  # [s]; for the conversions after a trigger
_LOOK = 1e-3  # [s]


class LoadCellNode(Node):
    """Reads the converter all the time and averages around each trigger."""

    def __init__(self) -> None:
        super().__init__("load_cell_node")
        self.finished = Future()
        self._adjustable = Parameters(self, LoadCellSettings)
        settings = self._adjustable.settings
        self._cell = LoadCell(settings, spi_opener(settings))
        self._samples = 0
        self._missing = 0
        self._fault = RecentFault()
        self._publisher = self.create_publisher(WrenchStamped, WRENCH.name, publisher_qos(WRENCH))
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._poll, name="load_cell")
        self._thread.start()
        self._follower = TriggerFollower(self, self._on_trigger)
        self._service = BlockingService(self, TriggerService, "load_cell/tare", self._on_tare)
        self._diagnostics = Diagnostics(
            self,
            lambda: {"samples": self._samples, "missing": self._missing, **self._cell.figures()},
            inputs=(self._follower.subscription,),
            offered=(self._publisher,),
            look=self._look,
            settle=SETTLE,
        )

    def close(self) -> None:
        """Stop reading and close the converter."""
        self._follower.close()
        self._stopping.set()
        self._thread.join()
        self._service.close()
        self._cell.close()

    def _poll(self) -> None:
        """Read the converter at its pace; a pause costs nothing but conversions."""
        due = clocks.monotonic()
        while not self._stopping.is_set():
            self._cell.poll()
            due = max(due + self._cell.period, clocks.monotonic() - self._cell.period)
            clocks.sleep(max(0.0, due - clocks.monotonic()))

    def _on_trigger(self, stamp: int, moment: float) -> None:
        over = self._cell.over(moment)
        clocks.sleep(max(0.0, over - clocks.monotonic()))
        while not self._cell.ready(moment) and clocks.monotonic() < over + _PATIENCE:
            clocks.sleep(_LOOK)
        reading = self._cell.wrench_at(moment)
        self._samples += 1
        if reading.fault:
            self._missing += bool(np.isnan(reading.wrench).any())
            self._fault.saw(reading.fault)
        header = header_to_ros(stamp, LOAD_CELL_FRAME)
        self._publisher.publish(WrenchStamped(header=header, wrench=wrench_to_ros(reading.wrench)))

    def _on_tare(
        self, request: TriggerService.Request, response: TriggerService.Response
    ) -> TriggerService.Response:
        del request
        try:
            response.message = self._cell.tare()
            response.success = True
        except TestbedError as error:
            response.message = str(error)
        return response

    def _look(self) -> None:
        self._cell.settings = self._adjustable.settings
        level, message = self._cell.health(clocks.monotonic())
        if level == 0 and (fault := self._fault.text()):
            level, message = 1, f"{fault}: missing; relieve the computer if this comes often"
        elif level == 0 and self._follower.note:
            level, message = 1, self._follower.note
        self._diagnostics.report(LEVELS[level], message)


def main() -> None:
    """Run the node."""
    run_node(LoadCellNode)


if __name__ == "__main__":
    main()
