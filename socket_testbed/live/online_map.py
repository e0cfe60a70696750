"""The force map while a testbed runs, of every sample from the first one on.

It needs neither a fitted model nor the motion capture.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.regions import all_regions
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import ForceMap, MapEstimate
from socket_testbed.identification.plausibility import channel_limits
from socket_testbed.identification.pressure import (
    THRESHOLD,
    RegionOutputs,
    measured_rows,
    pressure_outputs,
)
from socket_testbed.live.estimator import StampSynchroniser, cluster_forces
from socket_testbed.samples import Samples, channel_names
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.topics import STRESS, WRENCH, Topic


class OnlineMap:
    """Maps the forces on all tiles from the clusters and the wrench of a trigger.

    Channels that are left out of the objective do not count, and neither do values that no limb in
    a socket gives. Stresses are normal stress, shear x and y, shape (3,) [Pa], and status by
    cluster; wrenches [M; F] in {S}, shape (6,) [N m, N].

    Args:
        geometry: Geometry of the socket.
        settings: Called for the estimator's settings as they are now.

    Attributes:
        count: Number of maps.
        places: The regions of the outputs; the last one is the socket.
    """

    def __init__(self, geometry: SocketGeometry, settings: Callable[[], EstimatorSettings]) -> None:
        self._geometry = geometry
        self._settings = settings
        self._clusters = tuple(geometry.clusters)
        self._limits = channel_limits(geometry, self._clusters)
        self._names = channel_names(self._clusters)
        kinds = [STRESS.name, WRENCH.name]
        self._synchroniser = StampSynchroniser(kinds, settings().window.pending)
        self._prior = settings().force_map
        self._map = ForceMap(geometry, self._clusters, self._prior)
        self.count = 0
        self.places = all_regions(geometry)

    def clear(self) -> None:
        """Forget pending measurements, as after a jump back in time."""
        self._synchroniser.clear()

    def add(self, topic: Topic, stamp: int, value: Any) -> MapEstimate | None:
        """Add a measurement, as to `OnlineEstimator.add`; topics that the map ignores may come too.

        Returns:
            The map, with N = 1, if this completes the clusters and the wrench of the stamp.
        """
        if topic not in (STRESS, WRENCH):
            return None
        measured = self._synchroniser.add(topic.name, stamp, value)
        if measured is None:
            return None
        sample = self._sample(measured[WRENCH.name], measured[STRESS.name])
        self.count += 1
        return self._map.update(sample.wrench[0], sample.local_forces[0], sample.status[0])

    def outputs(
        self, wrench: FloatArray, stresses: Mapping[str, tuple[FloatArray, int]]
    ) -> RegionOutputs | None:
        """The outputs of one sample by region, from joint draws; None if no channel counts."""
        sample = self._sample(wrench, stresses)
        if not measured_rows(sample)[0]:
            return None
        found = pressure_outputs(self._map, sample, self._geometry, self.places, THRESHOLD)
        return found.regions

    def _sample(
        self, wrench: FloatArray, stresses: Mapping[str, tuple[FloatArray, int]]
    ) -> Samples:
        """The channels of one sample that count; from now on the map has the present prior."""
        settings = self._settings()
        if settings.force_map != self._prior:
            self._prior = settings.force_map
            self._map = ForceMap(self._geometry, self._clusters, self._prior)
        forces, status = cluster_forces(self._geometry, stresses)
        values = np.concatenate([wrench, forces.reshape(-1)])
        values[~(np.abs(values) <= self._limits)] = np.nan
        unknown = np.full((1, 3), np.nan)
        values[np.isin(self._names, settings.identification.leave_out)] = np.nan
        return Samples(
            np.zeros(1, dtype=np.int64),
            unknown,
            unknown,
            values[None, :6],
            self._clusters,
            values[None, 6:].reshape(1, -1, 3),
            status[None],
        )
