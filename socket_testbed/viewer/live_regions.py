"""The standard outputs by region while a testbed runs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.regions import all_regions
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.plausibility import channel_limits
from socket_testbed.identification.pressure import THRESHOLD, measured_rows, pressure_outputs
from socket_testbed.live.estimator import cluster_forces
from socket_testbed.samples import Samples, channel_names
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.viewer.source import RegionsNow


class LiveRegions:
    """Computes the outputs of single samples from joint draws, as `pressure` does over a span.

    Args:
        geometry: Geometry of the socket.

    Attributes:
        settings: Those of the estimator that runs: its prior, and the channels that it leaves out.
    """

    def __init__(self, geometry: SocketGeometry) -> None:
        self.settings = EstimatorSettings()
        self._geometry = geometry
        self._clusters = tuple(geometry.clusters)
        self._limits = channel_limits(geometry, self._clusters)
        self._names = channel_names(self._clusters)
        self._places = all_regions(geometry)
        self._map: ForceMap | None = None  # with the prior in use
        self._prior = self.settings.force_map

    def outputs(
        self, time: float, wrench: FloatArray, stresses: Mapping[str, tuple[FloatArray, int]]
    ) -> RegionsNow | None:
        """The outputs of one sample; None if no channel of it counts.

        Args:
            time: Its time [s].
            wrench: Its wrench [M; F] in {S}, shape (6,) [N m, N]; NaN where it is missing.
            stresses: Normal stress, shear x and y [Pa], and status by cluster.
        """
        if self._map is None or self._prior != self.settings.force_map:
            self._prior = self.settings.force_map
            self._map = ForceMap(self._geometry, self._clusters, self._prior)
        forces, status = cluster_forces(self._geometry, stresses)
        values = np.concatenate([wrench, forces.reshape(-1)])
        values[~(np.abs(values) <= self._limits)] = np.nan
        values[np.isin(self._names, self.settings.identification.leave_out)] = np.nan
        unknown = np.full((1, 3), np.nan)
        sample = Samples(
            np.zeros(1, dtype=np.int64),
            unknown,
            unknown,
            values[None, :6],
            self._clusters,
            values[None, 6:].reshape(1, -1, 3),
            status[None],
        )
        if not measured_rows(sample)[0]:
            return None
        found = pressure_outputs(self._map, sample, self._geometry, self._places, THRESHOLD)
        return RegionsNow(time, self._places, found.regions)
