"""The limb's suspension in the socket: its motion and stiffness, measured without a model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray, evenly, gaps
from socket_testbed.geometry.regions import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.noise import deviations
from socket_testbed.identification.pressure import Quantity
from socket_testbed.samples import Samples, moments_about

AXES = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
"""Rows and columns of the stiffness: along, then about x, y and z of {S}."""
_BLOCKS = 16
_RESAMPLES = 400
_MAX_RESAMPLED = 4000  # samples
_MIN_SAMPLES = 64  # samples
_WIDENING = 1.5  # [-]; so few blocks underestimate the spread
_PERCENTILES = (2.5, 97.5)  # [%]; of a range, and of an interval
_MIN_EIGENVALUE = 1e-9  # [-]; of the standardised load's covariance


@dataclass(frozen=True)
class Suspension:
    r"""Stiffness between limb and socket, and how far the limb moved, with 95 % intervals.

    About the centre of the tiles, with the limb's displacement u = [translation; rotation] and its
    load w = [F; M] on the socket, both less their means,

    .. math:: u = C w, \qquad K = C^{-1}

    C is a linear regression of the pose on the load, corrected for the noise of the load, which is
    measured far better than the pose. K is a secant stiffness over the motion of the samples. In a
    direction without motion it is unknown and its interval wide. Intervals come from a bootstrap of
    blocks in time (Kuensch, Annals of Statistics 17, 1989), as errors of neighbouring samples are
    correlated.

    Attributes:
        stiffness: K along and about the axes of {S}, shape (6, 6) [N/m, N/rad; N m/m, N m/rad].
            Rows are loads, columns displacements, both in the order of `AXES`; NaN if the load
            lacks a direction.
        pistoning: Range of the motion of the tiles' centre along the socket, between the 2.5th and
            the 97.5th percentile, shape () [m].
        rotation: Range of the rotation about x, y, z of {S}, between these percentiles, shape (3,)
            [rad].
    """

    stiffness: Quantity
    pistoning: Quantity
    rotation: Quantity

    def outputs(self) -> dict[str, Quantity]:
        """Scalar results, shape () each, in the unit of their title: `stiffness Fz [N/mm]`."""
        found = {"pistoning [mm]": self.pistoning.part((), 1e3)}
        degree = np.pi / 180.0
        for axis, name in enumerate("xyz"):
            found[f"range of rotation about {name} [deg]"] = self.rotation.part(axis, 1.0 / degree)
        for axis, name in enumerate(AXES):
            unit, factor = ("N/mm", 1e-3) if axis < 3 else ("N m/deg", degree)
            found[f"stiffness {name} [{unit}]"] = self.stiffness.part((axis, axis), factor)
        return found


def find_suspension(samples: Samples, geometry: SocketGeometry) -> Suspension | None:
    """The suspension over some samples; None if fewer than 64 have a pose and a whole wrench.

    Args:
        samples: N samples under changing load, in ascending time.
        geometry: The socket, whose tiles give the centre and the direction along the socket.
    """
    noise = deviations(samples.wrench, ~gaps(samples.stamps))
    known = samples.has_pose & np.isfinite(samples.wrench).all(axis=1)
    if known.sum() < _MIN_SAMPLES:
        return None
    centre, pose = geometry.anchors.mean(axis=0), samples.centred().pose[known]
    load = np.roll(moments_about(samples.wrench[known], centre), 3, axis=1)
    turned = pose[:, 3:] - pose[:, 3:].mean(axis=0)
    arm = centre - pose[:, :3].mean(axis=0)
    moved = np.hstack([pose[:, :3] - pose[:, :3].mean(axis=0) + np.cross(turned, arm), turned])
    variance = np.nan_to_num(np.roll(noise, 3)) ** 2
    along = moved[:, :3] @ proximal_direction(geometry)
    motions = np.column_stack([along, moved[:, 3:]])

    def found(rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        low, high = np.percentile(motions[rows], _PERCENTILES, axis=0)
        sunk, *rotated = high - low
        return _stiffness(moved[rows], load[rows], variance), sunk, np.array(rotated)

    blocks = np.array_split(evenly(len(moved), _MAX_RESAMPLED), _BLOCKS)
    chosen = np.random.default_rng(0).integers(0, _BLOCKS, (_RESAMPLES, _BLOCKS))
    drawn = [found(np.concatenate([blocks[block] for block in row])) for row in chosen]
    value = found(np.arange(len(moved)))
    stiffness, *motion = (
        _quantity(each, np.array(draws))
        for each, draws in zip(value, zip(*drawn, strict=True), strict=True)
    )
    own = np.sqrt(np.abs(np.diag(stiffness.value)))
    coupling = np.outer(own, own)  # of two axes
    return Suspension(replace(stiffness, scale=coupling), *motion)


def _stiffness(moved: FloatArray, load: FloatArray, variance: FloatArray) -> FloatArray:
    """K, shape (6, 6), from displacements [m, rad] and loads [N, N m], shape (N, 6) each.

    It is NaN if the load lacks a direction. `variance` is that of the loads' noise, shape (6,).
    """
    load = load - load.mean(axis=0)
    size = load.std(axis=0)
    gram = load.T @ load / len(load) - np.diag(variance)
    standard = gram / np.outer(size, size) if size.all() else np.zeros((6, 6))
    if np.linalg.eigvalsh(standard)[0] <= _MIN_EIGENVALUE:
        return np.full((6, 6), np.nan)
    compliance = np.linalg.solve(gram, load.T @ (moved - moved.mean(axis=0)) / len(load)).T
    return np.asarray(np.linalg.pinv(compliance))


def _quantity(value: FloatArray, drawn: FloatArray) -> Quantity:
    """A value of any shape with its interval, from draws with one more leading axis.

    An unknown draw counts as infinite on either side.
    """
    below = np.where(np.isnan(drawn), -np.inf, drawn)
    above = np.where(np.isnan(drawn), np.inf, drawn)
    low = np.percentile(below, _PERCENTILES[0], axis=0, method="lower")
    high = np.percentile(above, _PERCENTILES[1], axis=0, method="higher")
    value = np.asarray(value)
    low = value - _WIDENING * np.maximum(value - low, 0.0)
    high = value + _WIDENING * np.maximum(high - value, 0.0)
    return Quantity(value, low, high, np.abs(value))
