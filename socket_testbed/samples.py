"""Synchronised samples: what every consumer of a trial works on."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray, StatusArray

WRENCH_CHANNELS = ("Mx", "My", "Mz", "Fx", "Fy", "Fz")
LOCAL_CHANNELS = ("Fx", "Fy", "Fz")


class Status(IntEnum):
    """Status of a cluster's stress; the first three are also those of a channel."""

    OK = 0
    SATURATED = 1
    MISSING = 2
    OUT_OF_RANGE = 3


def channel_names(clusters: tuple[str, ...]) -> tuple[str, ...]:
    """Names of all channels: the wrench's, then three a cluster."""
    return WRENCH_CHANNELS + tuple(f"{c}.{channel}" for c in clusters for channel in LOCAL_CHANNELS)


@dataclass(frozen=True)
class Samples:
    """Measurements that belong to the same triggers, one row a trigger.

    What was not measured is NaN, never an older value.

    Attributes:
        stamps: Times of the triggers since the epoch, shape (N,) [ns].
        position: Limb position q in {S}, shape (N, 3) [m].
        wrench: Measured wrench [M; F] in {S}, shape (N, 6) [N m, N].
        clusters: Names of the c clusters.
        local_forces: Measured force on each cluster in the cluster's frame, shape
            (N, c, 3) [N].
        status: Status of each cluster (`Status`), shape (N, c).
    """

    stamps: IntArray
    position: FloatArray
    wrench: FloatArray
    clusters: tuple[str, ...]
    local_forces: FloatArray
    status: StatusArray

    def __len__(self) -> int:
        return len(self.stamps)

    def __getitem__(self, rows: slice | BoolArray | IntArray) -> Samples:
        """The samples of some rows."""
        return Samples(
            self.stamps[rows],
            self.position[rows],
            self.wrench[rows],
            self.clusters,
            self.local_forces[rows],
            self.status[rows],
        )

    @property
    def time(self) -> FloatArray:
        """Time since the first sample, shape (N,) [s]."""
        if len(self) == 0:
            return np.zeros(0)
        return (self.stamps - self.stamps[0]) * 1e-9

    @property
    def complete(self) -> BoolArray:
        """Rows with a wrench and a limb position, which is what a fit needs, shape (N,)."""
        return np.asarray(
            np.isfinite(self.position).all(axis=1) & np.isfinite(self.wrench).all(axis=1)
        )

    @property
    def trusted_forces(self) -> FloatArray:
        """Local forces whose status is OK, shape (N, c, 3) [N]; the others are NaN.

        A force out of the calibrated range is an extrapolation: nothing is fitted to it or
        judged by it.
        """
        return np.where((self.status == 0)[:, :, None], self.local_forces, np.nan)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of all channels: the wrench's, then three a cluster."""
        return channel_names(self.clusters)

    @property
    def values(self) -> FloatArray:
        """All channels in the order of `channels`, shape (N, 6 + 3c) [N m, N]."""
        return np.hstack([self.wrench, self.local_forces.reshape(len(self), -1)])
