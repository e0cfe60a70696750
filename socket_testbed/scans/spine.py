"""The spine of a cavity: the line from whose points its walls are looked at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.scans.axis import Axis
from socket_testbed.scans.surface import Surface, lengths

_LONGEST_ROUND = 0.45  # [-]; of the length, for the radius of a rounded end
_NARROW = 0.5  # [-]; of the radius, for what is no wall of the cavity but of a bore


@dataclass(frozen=True)
class Spine:
    """A segment; its points look at the walls beside them, its ends at what lies beyond.

    Attributes:
        axis: The line it is on.
        low: Where the segment begins, from the origin along the direction [m].
        high: Where it ends [m].
        radius: Typical distance of the walls [m].
    """

    axis: Axis
    low: float
    high: float
    radius: float

    def feet(self, points: FloatArray) -> FloatArray:
        """The points of the segment that look at the given points, shape (N, 3) [m]."""
        along = np.clip((points - self.axis.origin) @ self.axis.direction, self.low, self.high)
        return self.axis.origin + along[:, None] * self.axis.direction


def lay_spine(axis: Axis, wall: Surface, open_above: bool = False) -> Spine:
    """Lay the segment so that it ends a radius before the ends of a wall.

    What is much closer to the axis than the wall does not count: a bore in the distal end would
    draw the segment too far down to see the floor around it.

    Args:
        axis: The line.
        wall: The wall, or all of the mesh while the wall is not known.
        open_above: Whether the wall's far end is an opening: there it is looked at from
            beside, up to its edge.
    """
    along = (wall.centres - axis.origin) @ axis.direction
    distance = lengths(wall.centres - axis.origin - along[:, None] * axis.direction)
    radius = _weighted_median(distance, wall.areas)
    wide = along[distance >= _NARROW * radius]
    low, high = float(wide.min()), float(wide.max())
    radius = min(radius, _LONGEST_ROUND * (high - low))
    return Spine(axis, low + radius, np.inf if open_above else high - radius, radius)


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
