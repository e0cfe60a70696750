"""Stresses on the tiles of a socket at moments of a trial, and their course over it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.regions import axial_force
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.pressure import PressureOutputs, Quantity
from socket_testbed.samples import Samples


@dataclass(frozen=True, eq=False)
class Stresses:
    """Stresses on the n tiles, and what the c clusters of the socket measured, at K moments.

    Attributes:
        time: Times since the first sample of the trial, shape (K,) [s]; NaN for a mean over time.
        pressure: Normal pressures on the tiles, positive in compression, shape (K, n) [Pa].
        reach: Distances of the farther ends of their 95 % intervals, shape (K, n) [Pa].
        shear: Magnitudes of the shear on the tiles, shape (K, n) [Pa].
        forces: Forces of the limb on the tiles in {S}, shape (K, n, 3) [N].
        measured: Measured normal pressures, in the order of the socket's clusters, shape (K, c)
            [Pa]; NaN where missing.
    """

    time: FloatArray
    pressure: FloatArray
    reach: FloatArray
    shear: FloatArray
    forces: FloatArray
    measured: FloatArray


@dataclass(frozen=True, eq=False)
class TrialCourse:
    """Pressures at K samples of a trial, in the order of time.

    Attributes:
        stresses: Stresses on the tiles at these samples.
        force: Force of the limb along the socket, positive under load, shape (K,) [N].
        peak: Highest pressure of a tile at each of the samples, shape (K,) [Pa].
        highest: The highest pressure of them all [Pa].
        highest_time: Its time since the first sample of the trial [s].
    """

    stresses: Stresses
    force: FloatArray
    peak: Quantity
    highest: float
    highest_time: float


def stresses_of(
    found: MapEstimate, samples: Samples, geometry: SocketGeometry, start: int
) -> Stresses:
    """Stresses of a force map at its samples.

    Args:
        found: The map of K samples.
        samples: These samples.
        geometry: The socket.
        start: Stamp of the first sample of the trial since the epoch [ns].
    """
    return Stresses(
        time=(samples.stamps - start).astype(np.float64) * 1e-9,
        pressure=found.normal_pressure,
        reach=found.pressure_reach,
        shear=found.shear,
        forces=found.forces,
        measured=measured_pressure(samples, geometry),
    )


def mean_stresses(outputs: PressureOutputs, geometry: SocketGeometry) -> Stresses:
    """Mean stresses over a span, K = 1: those of its outputs by tile; the mean of what was read.

    Args:
        outputs: Pressure outputs over the span.
        geometry: The socket.
    """
    tiles, measured = outputs.tiles, measured_pressure(outputs.samples, geometry)
    known = np.isfinite(measured)
    with np.errstate(invalid="ignore"):  # a cluster that was never read
        read = np.where(known, measured, 0.0).sum(axis=0) / known.sum(axis=0)
    return Stresses(
        time=np.full(1, np.nan),
        pressure=tiles.mean.value[None],
        reach=tiles.mean.reach[None],
        shear=tiles.shear.value[None],
        forces=outputs.mean_map.forces,
        measured=read[None],
    )


def course_of(outputs: PressureOutputs, geometry: SocketGeometry, start: int) -> TrialCourse:
    """The course of the pressure over some samples of a trial.

    Args:
        outputs: Pressure outputs of these samples, whose last region is the socket.
        geometry: The socket.
        start: Stamp of the first sample of the trial since the epoch [ns].
    """
    stresses = stresses_of(outputs.estimate, outputs.samples, geometry, start)
    return TrialCourse(
        stresses=stresses,
        force=axial_force(geometry, outputs.samples.wrench),
        peak=outputs.series.peak.part((..., -1)),
        highest=float(outputs.regions.peak.value[-1]),
        highest_time=float(stresses.time[outputs.peak_row]),
    )


def measured_pressure(samples: Samples, geometry: SocketGeometry) -> FloatArray:
    """Measured normal pressure of every cluster of the socket.

    Args:
        samples: The N samples; values whose status is not OK count as missing.
        geometry: The socket with its c clusters, which may be more than those of the samples.

    Returns:
        Pressures, positive in compression, shape (N, c) [Pa], in the order of `geometry.clusters`;
        NaN where missing.
    """
    found = np.full((len(samples), len(geometry.clusters)), np.nan)
    for column, name in enumerate(geometry.clusters):
        if name in samples.clusters:
            forces = samples.trusted_forces[:, samples.clusters.index(name)]
            found[:, column] = geometry.cluster_stress(name, forces)[:, 0]
    return found
