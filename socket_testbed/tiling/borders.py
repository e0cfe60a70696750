"""The borders of tiles on the surface: where two squares meet that are close to each other."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.tiling.squares import Squares
from socket_testbed.tiling.surface_points import SurfacePoints

_STEPS = 2  # towards the surface; it is a plane around each of its points
_STEEP = 0.3  # [-]; cosine below which a plane is not followed

# Corners and thirds of the edges, in halves of an edge.
_AROUND = np.array(
    [[x, y] for x in (-3, -1, 1, 3) for y in (-3, -1, 1, 3) if 3 in (abs(x), abs(y))]
) / (3.0)


def border_points(squares: Squares, points: SurfacePoints) -> FloatArray:
    """Points of the surface along the borders of squares, shape (m, 12, 3) [m].

    Args:
        squares: Squares that fit the surface.
        points: The surface.
    """
    half, tree = 0.5 * squares.edge, KDTree(points.positions)
    along = np.einsum("mij,bj->mbi", squares.rotations[:, :, :2], half * _AROUND)
    border = squares.anchors[:, None] + along
    normal = squares.rotations[:, None, :, 2]
    for _ in range(_STEPS):
        nearest = tree.query(border, workers=-1)[1]
        there = points.normals[nearest]
        steepness = (there * normal).sum(axis=2)
        step = ((points.positions[nearest] - border) * there).sum(axis=2)
        step = np.where(steepness > _STEEP, step / np.maximum(steepness, _STEEP), 0.0)
        border = border + step[:, :, None] * normal
    return border


def border_gaps(squares: Squares, borders: FloatArray, index: int, others: IntArray) -> FloatArray:
    """Gaps between a square and others close to it, by the points of their borders.

    Negative where a point of one's border lies in the column over the other.

    Args:
        squares: The squares.
        borders: Their borders, shape (m, 12, 3) [m].
        index: The square.
        others: Indices of the others, shape (p,).

    Returns:
        Gaps, shape (p,) [m].
    """
    own = (borders[others] - squares.anchors[index]) @ squares.rotations[index][:, :2]
    offset = borders[index] - squares.anchors[others][:, None]
    theirs = offset @ squares.rotations[others][:, :, :2]
    outside = [np.abs(seen).max(axis=2).min(axis=1) for seen in (own, theirs)]
    return np.minimum(*outside) - 0.5 * squares.edge
