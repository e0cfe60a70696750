"""The force map while a trial runs: clusters and wrench in, the force on every tile out.

It needs neither a fitted model nor the motion capture, so that there is a map of every sample from
the first one on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import ForceMap, MapEstimate
from socket_testbed.identification.plausibility import channel_limits
from socket_testbed.live.estimator import StampSynchroniser, cluster_forces
from socket_testbed.samples import channel_names
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.topics import STRESS, WRENCH, Topic


class OnlineMap:
    """Maps the forces on all tiles as soon as the clusters and the wrench of a stamp are in.

    Channels that are left out of the objective do not count, and neither do values that no limb in
    a socket gives.

    Args:
        geometry: Geometry of the socket.
        settings: Called for the settings as they are now.

    Attributes:
        count: Number of maps.
    """

    def __init__(self, geometry: SocketGeometry, settings: Callable[[], EstimatorSettings]) -> None:
        self._geometry = geometry
        self._settings = settings
        self._clusters = tuple(geometry.clusters)
        self._limits = channel_limits(geometry, self._clusters)
        kinds = [STRESS.name, WRENCH.name]
        self._synchroniser = StampSynchroniser(kinds, settings().window.pending)
        self._prior = settings().force_map
        self._map = ForceMap(geometry, self._clusters, self._prior)
        self.count = 0

    def clear(self) -> None:
        """Forget what is pending, as after a jump back in time."""
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
        forces, status = cluster_forces(self._geometry, measured[STRESS.name])
        settings = self._settings()
        if settings.force_map != self._prior:
            self._prior = settings.force_map
            self._map = ForceMap(self._geometry, self._clusters, self._prior)
        values = np.concatenate([measured[WRENCH.name], forces.reshape(-1)])
        values[~(np.abs(values) <= self._limits)] = np.nan
        names = channel_names(self._clusters)
        for name in settings.identification.leave_out:
            if name in names:
                values[names.index(name)] = np.nan
        self.count += 1
        return self._map.update(values[:6], values[6:].reshape(-1, 3), status)
