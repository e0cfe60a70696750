"""The axes about which a surface is most nearly one of revolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.scans.surface import Surface

_EXACT = 1e-6  # [-]; misfit of an axis that is as good as exact
_IN_QUESTION = 5.0  # [-]; misfit of an axis that cannot be ruled out, of the best misfit
_ALIKE = 1.3  # [-]; between misfits so close that all axes between theirs fit as well


@dataclass(frozen=True)
class Axis:
    """A line.

    Attributes:
        origin: A point of it, shape (3,) [m].
        direction: Unit vector along it, shape (3,).
    """

    origin: FloatArray
    direction: FloatArray

    def turned(self) -> Axis:
        """The same line in the other direction."""
        return Axis(self.origin, -self.direction)


@dataclass(frozen=True)
class AxisFit:
    """How well a surface is one of revolution about axes of any direction.

    Attributes:
        middle: Middle of the surface, shape (3,) [m].
        moment: Best moment about the middle of an axis a unit direction, shape (3, 3) [m].
        misfits: Mean square misfit of the principal directions, rising, shape (3,) [-].
        directions: The principal directions, one a row, shape (3, 3).
    """

    middle: FloatArray
    moment: FloatArray
    misfits: FloatArray
    directions: FloatArray

    def likely(self) -> list[Axis]:
        """The best axis, and those at right angles to it that cannot be ruled out."""
        limit = _IN_QUESTION * max(float(self.misfits[0]), _EXACT)
        return [self._along(direction) for direction in self.directions[self.misfits <= limit]]

    def near(self, direction: FloatArray) -> Axis:
        """The principal axis near a direction, or that direction where many fit alike.

        Args:
            direction: Unit vector, shape (3,).
        """
        best = int(np.abs(self.directions @ direction).argmax())
        ratio = np.fmax(self.misfits, _EXACT) / max(float(self.misfits[best]), _EXACT)
        alike = self.directions[np.abs(np.log(ratio)) < np.log(_ALIKE)]
        towards = alike.T @ (alike @ direction)
        return self._along(towards / np.linalg.norm(towards))

    @property
    def is_sharp(self) -> bool:
        """Whether the best axis stands out."""
        return float(self.misfits[1]) > _ALIKE * max(float(self.misfits[0]), _EXACT)

    def _along(self, direction: FloatArray) -> Axis:
        return Axis(self.middle + np.cross(direction, self.moment @ direction), direction)


def fit_axis(surface: Surface) -> AxisFit:
    """Fit an axis of revolution to a surface.

    A rotation about the direction c with the moment m moves the point p by c x p + m. It leaves
    a surface of revolution in itself, so ``n . (c x p + m) = 0`` there; that is solved in least
    squares for |c| = 1 (Pottmann and Randrup 1998, Computing 60, 307-322). Neither the sign of
    the normals nor a part of the circumference that is missing matters.
    """
    weights = surface.areas / surface.areas.sum()
    middle = weights @ surface.centres
    points = surface.centres - middle
    scale = max(float(np.sqrt(weights @ (points**2).sum(axis=1))), np.finfo(float).tiny)
    columns = np.hstack([np.cross(points / scale, surface.normals), surface.normals])
    gram = columns.T @ (weights[:, None] * columns)
    moment = -np.linalg.pinv(gram[3:, 3:], rcond=1e-9, hermitian=True) @ gram[3:, :3]
    misfits, directions = np.linalg.eigh(gram[:3, :3] + gram[:3, 3:] @ moment)
    return AxisFit(middle, scale * moment, misfits, directions.T)
