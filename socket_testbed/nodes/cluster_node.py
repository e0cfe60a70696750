"""Cluster node: measures the capacitances of all clusters at each trigger.

Subscribes: trigger. Publishes: clusters/capacitance, /diagnostics.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from socket_testbed import clocks
from socket_testbed.drivers.clusters.reader import ClusterReading
from socket_testbed.errors import joined
from socket_testbed.live.hardware import make_clusters
from socket_testbed.nodes.base import ERROR, OK, SAMPLES
from socket_testbed.nodes.sensor_node import SensorNode
from socket_testbed.samples import Status
from socket_testbed.settings.acquisition import ClusterSettings
from socket_testbed.wire.messages import capacitance_packer
from socket_testbed.wire.topics import CAPACITANCE

_READ_TIMEOUT = 0.5  # [s]; a longer reading means a hanging bus


class ClusterNode(SensorNode[ClusterSettings]):
    """Reads the clusters at each trigger; a failed cluster is missing, the others continue.

    Publishes: clusters/capacitance, with the stamp of the trigger, frame load_cell: by cluster the
    capacitances by converter input [pF], NaN where missing or saturated, and their statuses.
    """

    def __init__(self) -> None:
        super().__init__("cluster_node", ClusterSettings)
        self.device = ", ".join(f"i2c-{number}" for number in dict.fromkeys(self.settings.buses))
        self._reader = make_clusters(self.settings)
        self._answering = False
        self._send = self.sender(CAPACITANCE, capacitance_packer(self.settings.names))
        self.follow_triggers()

    def close(self) -> None:
        """Stop reading and close the buses."""
        super().close()
        self._reader.close()

    def figures(self) -> dict[str, object]:
        """Numbers of measurements, and of channels without a value: missing or saturated."""
        return {SAMPLES: self.samples, "missing_channels": self.missing}

    def measure(self, stamp: int, moment: float) -> None:
        """Read all clusters and publish clusters/capacitance [pF].

        `missing` counts channels without a value.

        Args:
            stamp: Stamp of the trigger since the epoch [ns].
            moment: The trigger on the testbed's steady clock [s].
        """
        reading = self._read(moment)
        self.missing += int((reading.status != Status.OK).sum())
        self._send(stamp, reading.capacitance, reading.status)

    def idle(self) -> None:
        """Check the clusters."""
        self._read(clocks.monotonic())

    def _read(self, moment: float) -> ClusterReading:
        reading = self._reader.read(moment)
        self._answering = True
        if reading.faults:
            self.fault.note(named_faults(reading.faults, len(self.settings.names)))
        return reading

    def health(self) -> tuple[int, str] | None:
        """A hanging bus, the latest fault, or OK once the clusters have answered."""
        since = self.busy_since
        if since is not None and clocks.monotonic() - since > _READ_TIMEOUT:
            return ERROR, "a bus hangs: check the clusters' wires and supply"
        if fault := self.fault.text():
            return ERROR, fault
        return (OK, f"{len(self.settings.names)} clusters answer") if self._answering else None


def named_faults(faults: Mapping[str, Sequence[str]], count: int) -> str:
    """Faults with the clusters that have them, such as `posterior_distal: no answer`, in one line.

    A fault of all clusters, such as that of their bus, is not of one cluster and is not named.

    Args:
        faults: Faults by the cluster's name, as in `ClusterReading`.
        count: Number of all clusters.
    """
    names: dict[str, list[str]] = {}
    for name, own in faults.items():
        for fault in own:
            names.setdefault(fault, []).append(name)
    return joined(
        fault if len(having) == count > 1 else f"{', '.join(having)}: {fault}"
        for fault, having in names.items()
    )
