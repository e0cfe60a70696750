"""The unrolled surface of the socket: positions of tiles, and interpolation between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.regions import SocketAxis, socket_axis, wall_tiles
from socket_testbed.geometry.socket import SECTOR_TURNS, SocketGeometry
from socket_testbed.identification.map_prior import matern
from socket_testbed.settings.identification import ForceMapSettings
from socket_testbed.settings.options import Side

STEP = 0.35  # [-]; of the grid, relative to the edge of a tile
_MAX_DISTANCE = 1.3  # [tile edges]; farther from the nearest tile there is no wall
_KERNEL_WIDTH = 0.7  # [tile edges]; for smoothing the wall's shape
_NUGGET = 3e-3  # [-]; keeps weights small beyond the outermost tiles
# Corners of a square of edge 1 in {L}, counter-clockwise about the inward normal.
_SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) / 2.0


def side_names(side: Side | None) -> list[str]:
    """Directions at -180, -90, 0, 90 and 180 degrees on the unrolled wall, by side of the leg.

    For a right leg posterior, lateral, anterior, medial, posterior; without a side right and left.
    """
    names = {turn: name for name, turn in SECTOR_TURNS[side].items()}
    return [names[turn] for turn in (2, 3, 0, 1, 2)]


@dataclass(frozen=True, eq=False)
class UnrolledTiles:
    """The n tiles as squares of their areas, on the unrolled wall or on the distal end.

    A position on the wall is the angle from anterior towards left [deg] and the height above the
    distal end [mm]; one on the end, seen from inside, points towards right and anterior [mm].

    Attributes:
        around: The socket's axis in {S}.
        on_wall: Which tiles are on the wall, shape (n,); the others are on the end.
        squares: Corners in {S} at (-x, -y), (+x, -y), (+x, +y) and (-x, +y) of the tile's frame,
            turned with its cluster, shape (n, 4, 3) [m].
        places: Positions of the centres on the wall or end, shape (n, 2) [deg, mm] or [mm, mm].
        corners: Positions of the corners on the wall or end, in the order of `squares`, shape
            (n, 4, 2) [deg, mm] or [mm, mm]. Angles are within half a turn of the centre's, so
            that they may lie beyond +-180.
        directions: Unit vectors along each tile in {S} that point towards right and up on the wall
            or end, shape (n, 2, 3) [-].
    """

    around: SocketAxis
    on_wall: BoolArray
    squares: FloatArray
    places: FloatArray
    corners: FloatArray
    directions: FloatArray


def unrolled_tiles(geometry: SocketGeometry) -> UnrolledTiles:
    """Positions of the tiles on the unrolled wall and on the distal end."""
    around = socket_axis(geometry)
    on_wall = wall_tiles(geometry, around)
    tiles_in_socket = Pose(geometry.square_frames()[:, None], geometry.anchors[:, None])
    squares = tiles_in_socket.apply(np.sqrt(geometry.areas)[:, None, None] * _SQUARE)
    points = np.concatenate([geometry.anchors[:, None], squares], axis=1)
    angles = np.degrees(around.angles(points))
    turned = angles[:, :1] + (angles - angles[:, :1] + 180.0) % 360.0 - 180.0
    wall = np.stack([turned, 1e3 * around.heights(points)], axis=-1)
    end = 1e3 * (points - around.end) @ np.column_stack([-around.left, around.anterior])
    places = np.where(on_wall[:, None, None], wall, end)
    directions = _directions(geometry, around, on_wall)
    return UnrolledTiles(around, on_wall, squares, places[:, 0], places[:, 1:], directions)


def _directions(geometry: SocketGeometry, around: SocketAxis, on_wall: BoolArray) -> FloatArray:
    """Unit vectors in {S} towards right and up on the page, along each tile, (n, 2, 3) [-].

    Up is proximal on the wall, and anterior on the end. Right on the wall is towards left about the
    axis, as seen from outside; the end is seen from inside.
    """
    normals = geometry.rotations[:, :, 2]
    up = np.where(on_wall[:, None], around.proximal, around.anterior)
    up = up - (up * normals).sum(axis=1, keepdims=True) * normals
    up = up / np.linalg.norm(up, axis=1, keepdims=True)
    right = np.cross(normals, up) * np.where(on_wall, 1.0, -1.0)[:, None]
    return np.stack([right, up], axis=1)


@dataclass(frozen=True, eq=False)
class Patch:
    """A part of the surface on a grid of w x h points.

    Attributes:
        name: `wall`, unrolled, or `end`, seen from inside with anterior up.
        x: Columns of the grid, shape (w,): on the wall angles from anterior towards left, from -180
            to 180 [deg], on the end distances from the axis towards right [mm].
        y: Rows of the grid, shape (h,): on the wall heights above the distal end, on the end
            distances from the axis towards anterior [mm].
        points: The points in {S}, shape (h, w, 3) [m]; NaN where there is no wall.
        weights: Weights of the n tiles' values in the value at each point, shape (h, w, n) [-];
            they add up to 1 and may be negative.
    """

    name: str
    x: FloatArray
    y: FloatArray
    points: FloatArray
    weights: FloatArray


def patches(geometry: SocketGeometry, step: float = STEP) -> Iterator[Patch]:
    """Grids of the wall and the distal end, where they have tiles.

    The value at a point is its expected value given those of the tiles, under a Gaussian process
    with the correlation of the force map (Matern 3/2 by distance, of the default length).

    Args:
        geometry: The socket.
        step: Usual distance of neighbouring points, relative to the edge of the median tile [-].

    Yields:
        The wall, then the distal end.
    """
    around = socket_axis(geometry)
    on_wall = wall_tiles(geometry, around)
    edge = float(np.median(np.sqrt(geometry.areas)))
    radius = float(around.radii(geometry.anchors).max())
    if on_wall.any():
        wall = _wall_patch(geometry, around, on_wall, edge, step)
        yield wall.patch
        radius = wall.lower_radius
    if not on_wall.all():
        yield _end_patch(geometry, around, on_wall, edge, radius, step)


class _Wall(NamedTuple):
    """The wall's grid, and the mean radius of its lowest row, where the distal end begins [m]."""

    patch: Patch
    lower_radius: float


def _wall_patch(
    geometry: SocketGeometry, around: SocketAxis, on_wall: BoolArray, edge: float, step: float
) -> _Wall:
    """The unrolled wall: a full turn by the heights of its tiles and half an edge [m] beyond them.

    Its radius at a point is that of the nearby tiles, smoothed by their distance along the wall.
    """
    anchors = geometry.anchors[on_wall]
    heights, radii = around.heights(anchors), around.radii(anchors)
    low = max(heights.min() - 0.5 * edge, 0.0)
    high = heights.max() + 0.5 * edge
    size = np.median(radii)
    columns = 2 * max(8, round(np.pi * size / edge / step))
    rows = max(4, round((high - low) / edge / step))
    x = np.linspace(-np.pi, np.pi, columns)
    y = np.linspace(low, high, rows)
    angle, height = np.reshape(np.meshgrid(x, y), (2, -1))  # row by row
    apart = np.subtract.outer(angle, around.angles(anchors))
    across = np.angle(np.exp(1j * apart)) * size
    along = np.subtract.outer(height, heights)
    radius = _smooth(np.hypot(across, along) / edge, radii)
    outwards = np.cos(angle)[:, None] * around.anterior + np.sin(angle)[:, None] * around.left
    points = around.end + height[:, None] * around.proximal + radius[:, None] * outwards
    patch = _patch("wall", geometry, np.degrees(x), 1e3 * y, points, edge)
    return _Wall(patch, lower_radius=float(radius[:columns].mean()))


def _end_patch(
    geometry: SocketGeometry,
    around: SocketAxis,
    on_wall: BoolArray,
    edge: float,
    radius: float,
    step: float,
) -> Patch:
    """The distal end: a disc of a radius [m], seen from inside with anterior up.

    Its height at a point is that of the nearby tiles, smoothed by their distance across the axis.
    """
    count = 2 * max(12, round(radius / edge / step)) + 1
    line = np.linspace(-radius, radius, count)
    right, up = np.reshape(np.meshgrid(line, line), (2, -1))
    nearby = (around.heights(geometry.anchors) < edge) | ~on_wall
    offset = geometry.anchors[nearby] - around.end
    flat = np.column_stack([-offset @ around.left, offset @ around.anterior])
    apart = cdist(np.column_stack([right, up]), flat)
    height = _smooth(apart / edge, offset @ around.proximal)
    directions = np.stack([-around.left, around.anterior, around.proximal])
    points = around.end + np.column_stack([right, up, height]) @ directions
    points[np.hypot(right, up) > radius * (1.0 + 1e-9)] = np.nan
    return _patch("end", geometry, 1e3 * line, 1e3 * line, points, edge)


def _smooth(apart: FloatArray, values: FloatArray) -> FloatArray:
    """Smooth k tile values (k,) over p points, by the distances between them in tile edges (p, k).

    The result has the unit of the values and the shape (p,).
    """
    weights = np.exp(-0.5 * (apart / _KERNEL_WIDTH) ** 2) + 1e-9 / (1.0 + apart**2)
    return np.asarray((weights @ values) / weights.sum(axis=1))


def _patch(
    name: str,
    geometry: SocketGeometry,
    x: FloatArray,
    y: FloatArray,
    points: FloatArray,
    edge: float,
) -> Patch:
    apart = cdist(points, geometry.anchors)
    points[~(apart.min(axis=1) <= _MAX_DISTANCE * edge)] = np.nan
    length = ForceMapSettings().length
    among = matern(cdist(geometry.anchors, geometry.anchors), length)
    among += _NUGGET * np.eye(len(geometry))
    weights = np.linalg.solve(among, matern(np.nan_to_num(apart), length).T).T
    weights /= weights.sum(axis=1, keepdims=True)  # preserves uniform fields
    grid = (len(y), len(x))
    shown = np.asarray(points.reshape(*grid, 3))
    return Patch(name, x, y, shown, np.asarray(weights.reshape(*grid, -1)))
