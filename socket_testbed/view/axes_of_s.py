"""Where the axes of {S} are drawn, and how long."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.view.squares import tile_squares
from socket_testbed.view.surface import Surface

AXIS_NAMES = ("x", "y", "z")
_LONGEST = 0.25  # [-]; of the socket's diagonal
_FARTHEST = 0.6  # [-]; likewise, of the origin from the socket
_BELOW = 1.3  # [-]; of the axes' length


@dataclass(frozen=True)
class AxesOfS:
    """The axes of {S} as three arrows.

    Attributes:
        start: Where they start in {S}, shape (3,) [m].
        length: Their length, a round number [m].
        moved: Whether they start elsewhere than in the origin, which is far off.
    """

    start: FloatArray
    length: float
    moved: bool

    def describe(self) -> str:
        """What they are, for a legend."""
        where = ", moved here from the far origin" if self.moved else ""
        return f"axes of {{S}}, {1e3 * self.length:g} mm{where}"


def drawn_bounds(surface: Surface, geometry: SocketGeometry) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest coordinates in {S} of the surface and the tiles, shape (3,) each [m]."""
    corners = np.vstack([*surface.bounds(), tile_squares(geometry).reshape(-1, 3)])
    return corners.min(axis=0), corners.max(axis=0)


def place_axes(low: FloatArray, high: FloatArray) -> AxesOfS:
    """The axes at the origin; right below the socket where the origin is far from it.

    Args:
        low: Lowest coordinates of the socket in {S}, shape (3,) [m].
        high: Highest coordinates, shape (3,) [m].
    """
    diagonal = float(np.linalg.norm(high - low))
    length = _round_length(_LONGEST * diagonal)
    gap = float(np.linalg.norm(np.clip(0.0, low, high)))
    if gap <= _FARTHEST * diagonal:
        return AxesOfS(np.zeros(3), length, moved=False)
    middle = 0.5 * (low + high)
    return AxesOfS(np.array([middle[0], middle[1], low[2] - _BELOW * length]), length, moved=True)


def _round_length(longest: float) -> float:
    """The longest of 1, 2 or 5 times a power of ten."""
    decade = 10.0 ** np.floor(np.log10(longest))
    return float(decade * max(step for step in (1.0, 2.0, 5.0) if step * decade <= longest))
