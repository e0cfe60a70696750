"""The socket's wall as a continuous surface: its points on a grid, and what the tiles say there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.axis import socket_axis, wall_tiles
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import matern
from socket_testbed.settings.identification import ForceMapSettings

STEP = 0.35  # [-]; of the grid, by the tiles' edge
_NEAR = 1.3  # [-]; of the tiles' edge: beyond it from the nearest tile, there is no wall
_KERNEL = 0.7  # [-]; width over which the wall's shape is smoothed, likewise
_NUGGET = 3e-3  # [-]; keeps weights small beyond the outermost tiles


@dataclass(frozen=True, eq=False)
class Patch:
    """A part of the surface on a grid of w by h points."""

    name: str  # `wall`, unrolled, or `end`, seen from inside with anterior up
    x: FloatArray  # (w,); angle from anterior towards left [deg], or towards right [mm]
    y: FloatArray  # (h,); height above the distal end, or towards anterior [mm]
    points: FloatArray  # (h, w, 3) in {S} [m]; NaN where no wall is
    weights: FloatArray  # (h, w, n) [-]; of the tiles' values in the value of a point


def patches(geometry: SocketGeometry, step: float = STEP) -> list[Patch]:
    """The wall, then the distal end, less what has no tile, on grids of a step by the tiles' edge.

    The value of a point is its expected value, given those of the tiles, of a Gaussian process
    with the correlation of the force map (Matern 3/2 by distance): where the field is one, this is
    the force map at the point.
    """
    around, edge = socket_axis(geometry), float(np.median(np.sqrt(geometry.areas)))
    on_wall = wall_tiles(geometry, around)
    found = []
    radius = float(around.radii(geometry.anchors).max())
    if on_wall.any():
        wall = geometry.anchors[on_wall]
        heights, angles = around.heights(wall), around.angles(wall)
        radii = around.radii(wall)
        low, high = max(heights.min() - 0.5 * edge, 0.0), heights.max() + 0.5 * edge
        x = np.linspace(-np.pi, np.pi, 2 * max(8, round(np.pi * np.median(radii) / edge / step)))
        y = np.linspace(low, high, max(4, round((high - low) / edge / step)))
        size = np.median(radii)
        at = np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1).reshape(-1, 2)
        apart = np.angle(np.exp(1j * np.subtract.outer(at[:, 0], angles))) * size
        r = _smooth(np.hypot(apart, np.subtract.outer(at[:, 1], heights)) / edge, radii)
        across = np.cos(at[:, :1]) * around.anterior + np.sin(at[:, :1]) * around.left
        points = around.end + at[:, 1:] * around.proximal + r[:, None] * across
        found.append(_patch("wall", geometry, np.degrees(x), 1e3 * y, points, edge))
        radius = float(r[: len(x)].mean())
    if not on_wall.all():
        line = np.linspace(-radius, radius, 2 * max(12, round(radius / edge / step)) + 1)
        at = np.stack(np.broadcast_arrays(line, line[:, None]), axis=-1).reshape(-1, 2)
        low_tiles = around.heights(geometry.anchors) < edge
        offset = geometry.anchors[low_tiles | ~on_wall] - around.end
        flat = np.column_stack([-offset @ around.left, offset @ around.anterior])
        height = _smooth(cdist(at, flat) / edge, offset @ around.proximal)
        points = around.end - at[:, :1] * around.left + at[:, 1:] * around.anterior
        points = points + height[:, None] * around.proximal
        points[np.hypot(*at.T) > radius * (1.0 + 1e-9)] = np.nan
        found.append(_patch("end", geometry, 1e3 * line, 1e3 * line, points, edge))
    return found


def _smooth(apart: FloatArray, values: FloatArray) -> FloatArray:
    """Values of the tiles smoothed over points, by the distances to them in tiles' edges."""
    closeness = np.exp(-0.5 * (apart / _KERNEL) ** 2) + 1e-9 / (1.0 + apart**2)
    return np.asarray((closeness @ values) / closeness.sum(axis=1))


def _patch(
    name: str,
    geometry: SocketGeometry,
    x: FloatArray,
    y: FloatArray,
    points: FloatArray,
    edge: float,
) -> Patch:
    apart = cdist(points, geometry.anchors)
    points[~(apart.min(axis=1) <= _NEAR * edge)] = np.nan
    length = ForceMapSettings().length
    among = matern(cdist(geometry.anchors, geometry.anchors), length)
    among += _NUGGET * np.eye(len(geometry))
    weights = np.linalg.solve(among, matern(np.nan_to_num(apart), length).T).T
    weights /= weights.sum(axis=1, keepdims=True)  # what is the same on all tiles stays so
    grid = (len(y), len(x))
    shown = np.asarray(points.reshape(*grid, 3))
    return Patch(name, x, y, shown, np.asarray(weights.reshape(*grid, -1)))
