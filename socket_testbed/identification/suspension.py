r"""How the limb sits in the socket: its 6 x 6 stiffness, pistoning and range of rotation.

About the centre of the tiles, with the limb's displacement u = [translation; rotation] and the load
w = [F; M] that it puts on the socket, both from their means,

.. math:: u = C w, \qquad K = C^{-1}

C is a linear regression of the pose on the load, less the noise of the load: the load is measured
far better than the pose. It is a secant over the motion of the samples. Where these do not move in
a direction, K is not known there and its interval is wide. Intervals come from a bootstrap of
blocks in time (Kuensch, Annals of Statistics 17, 1989), as neighbouring samples err alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.geometry.axis import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.noise import channel_noise
from socket_testbed.identification.pressure import Quantity
from socket_testbed.samples import Samples

AXES = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
"""Rows and columns of the stiffness: along, then about x, y and z of {S}."""
_BLOCKS = 16
_DRAWS = 400
_LEAST = 64  # samples
_WIDENING = 1.5  # [-]; so few blocks are too much alike
_ENDS = (2.5, 97.5)  # [%]; of a range, and of an interval
_SINGULAR = 1e-9  # [-]; of the standardised load's covariance


@dataclass(frozen=True)
class Suspension:
    """Stiffness between limb and socket, and how far the limb moved, with 95 % intervals."""

    # by AXES, shape (6, 6) [N/m, N/rad; N m/m, N m/rad]: load by displacement
    stiffness: Quantity
    pistoning: Quantity  # range of the motion along the socket, shape () [m]
    rotation: Quantity  # range of the rotation about x, y, z of {S}, shape (3,) [rad]

    def outputs(self) -> dict[str, Quantity]:
        """What a lab reads, in the unit of its title, such as `stiffness Fz [N/mm]`; shapes ()."""
        found = {"pistoning [mm]": _scaled(self.pistoning, (), 1e3)}
        degrees = 180.0 / np.pi
        for axis, name in enumerate("xyz"):
            title = f"range of rotation about {name} [deg]"
            found[title] = _scaled(self.rotation, (axis,), degrees)
        for axis, name in enumerate(AXES):
            unit, factor = ("N/mm", 1e-3) if axis < 3 else ("N m/deg", 1.0 / degrees)
            found[f"stiffness {name} [{unit}]"] = _scaled(self.stiffness, (axis, axis), factor)
        return found


def _scaled(quantity: Quantity, at: tuple[int, ...], factor: float) -> Quantity:
    return Quantity(*(np.asarray(factor * part[at]) for part in vars(quantity).values()))


def find_suspension(samples: Samples, geometry: SocketGeometry) -> Suspension | None:
    """The suspension over some samples; None if too few have a pose and a wrench."""
    noise = channel_noise(samples).wrench
    known = np.isfinite(samples.pose).all(axis=1) & np.isfinite(samples.wrench).all(axis=1)
    if known.sum() < _LEAST:
        return None
    centre, pose, wrench = geometry.anchors.mean(axis=0), samples.pose[known], samples.wrench[known]
    force = wrench[:, 3:]
    load = np.hstack([force, wrench[:, :3] - np.cross(centre, force)])
    turned = pose[:, 3:] - pose[:, 3:].mean(axis=0)
    arm = centre - pose[:, :3].mean(axis=0)
    moved = np.hstack([pose[:, :3] - pose[:, :3].mean(axis=0) + np.cross(turned, arm), turned])
    variance = np.nan_to_num(np.concatenate([noise[3:], noise[:3]])) ** 2
    along = moved[:, :3] @ proximal_direction(geometry)

    def found(rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        low, high = np.percentile(moved[rows], _ENDS, axis=0)
        ends = np.percentile(along[rows], _ENDS)
        return _stiffness(moved[rows], load[rows], variance), np.diff(ends)[0], (high - low)[3:]

    rng, count = np.random.default_rng(0), len(moved)
    blocks = np.array_split(np.arange(count), _BLOCKS)
    chosen = rng.integers(0, _BLOCKS, (_DRAWS, _BLOCKS))
    drawn = [found(np.concatenate([blocks[block] for block in row])) for row in chosen]
    value = found(np.arange(count))
    stiffness, pistoning, rotation = (
        _quantity(each, np.array(draws))
        for each, draws in zip(value, zip(*drawn, strict=True), strict=True)
    )
    own = np.sqrt(np.abs(np.diag(stiffness.value)))
    scale = np.outer(own, own)  # of what couples two axes
    stiffness = Quantity(stiffness.value, stiffness.low, stiffness.high, scale)
    return Suspension(stiffness, pistoning, rotation)


def _stiffness(moved: FloatArray, load: FloatArray, variance: FloatArray) -> FloatArray:
    """K of displacements and loads, shape (N, 6) each; NaN where the load lacks a direction."""
    load = load - load.mean(axis=0)
    size = load.std(axis=0)
    gram = load.T @ load / len(load) - np.diag(variance)
    standard = gram / np.outer(size, size) if size.all() else np.zeros((6, 6))
    if np.linalg.eigvalsh(standard)[0] <= _SINGULAR:
        return np.full((6, 6), np.nan)
    compliance = np.linalg.solve(gram, load.T @ (moved - moved.mean(axis=0)) / len(load)).T
    return np.asarray(np.linalg.pinv(compliance))


def _quantity(value: FloatArray, drawn: FloatArray) -> Quantity:
    """A value with its interval; a draw that is not known reaches to either side."""
    below = np.where(np.isnan(drawn), -np.inf, drawn)
    above = np.where(np.isnan(drawn), np.inf, drawn)
    low = np.percentile(below, _ENDS[0], axis=0, method="lower")
    high = np.percentile(above, _ENDS[1], axis=0, method="higher")
    value = np.asarray(value)
    low = value - _WIDENING * np.maximum(value - low, 0.0)
    high = value + _WIDENING * np.maximum(high - value, 0.0)
    return Quantity(value, low, high, np.abs(value))
