"""Cluster node: the capacitances of all clusters at each trigger.

Subscribes: trigger. Publishes: clusters/capacitance, /diagnostics.
"""

from __future__ import annotations

from rclpy.node import Node
from rclpy.task import Future
from socket_testbed_msgs.msg import ClusterCapacitanceArray

from socket_testbed import clocks
from socket_testbed.drivers.clusters.reader import ClusterReader, ClusterReading
from socket_testbed.live.hardware import i2c_opener
from socket_testbed.nodes.conversions import capacitance_to_ros
from socket_testbed.nodes.diagnostics import ERROR, OK, SETTLE, WARN, Diagnostics, RecentFault
from socket_testbed.nodes.parameters import Parameters
from socket_testbed.nodes.runtime import publisher_qos, run_node
from socket_testbed.nodes.trigger_follower import TriggerFollower
from socket_testbed.settings.acquisition import ClusterSettings
from socket_testbed.trials.topics import CAPACITANCE

_STUCK = 0.5  # [s]; a reading that takes longer hangs


class ClusterNode(Node):
    """Reads the clusters at each trigger; what fails is missing, the others go on."""

    def __init__(self) -> None:
        super().__init__("cluster_node")
        self.finished = Future()
        self._adjustable = Parameters(self, ClusterSettings)
        settings = self._adjustable.settings
        self._reader = ClusterReader(settings, i2c_opener(settings))
        self._answering = False
        self._fault = RecentFault()
        self._samples = 0
        self._missing = 0
        self._publisher = self.create_publisher(
            ClusterCapacitanceArray, CAPACITANCE.name, publisher_qos(CAPACITANCE)
        )
        self._follower = TriggerFollower(self, self._on_trigger, self._watch)
        self._diagnostics = Diagnostics(
            self,
            lambda: {"samples": self._samples, "missing_channels": self._missing},
            inputs=(self._follower.subscription,),
            offered=(self._publisher,),
            look=self._look,
            settle=SETTLE,
        )

    def close(self) -> None:
        """Stop reading and close the buses."""
        self._follower.close()
        self._reader.close()

    def _on_trigger(self, stamp: int, moment: float) -> None:
        reading = self._read(moment)
        self._samples += 1
        self._missing += int((reading.status != 0).sum())
        self._publisher.publish(
            capacitance_to_ros(stamp, reading.names, reading.capacitance, reading.status)
        )

    def _watch(self) -> None:
        """While no trigger comes, see how the clusters are."""
        self._read(clocks.monotonic())

    def _read(self, moment: float) -> ClusterReading:
        reading = self._reader.read(moment)
        self._answering = True
        if reading.faults:
            self._fault.saw("; ".join(dict.fromkeys(reading.faults.values())))
        return reading

    def _look(self) -> None:
        since = self._follower.busy_since
        if since is not None and clocks.monotonic() - since > _STUCK:
            self._diagnostics.report(ERROR, "a bus hangs: check the clusters' wires and supply")
        elif fault := self._fault.text():
            self._diagnostics.report(ERROR, fault)
        elif self._follower.note:
            self._diagnostics.report(WARN, self._follower.note)
        elif self._answering:
            names = self._adjustable.settings.names
            self._diagnostics.report(OK, f"{len(names)} clusters answer")


def main() -> None:
    """Run the node."""
    run_node(ClusterNode)


if __name__ == "__main__":
    main()
