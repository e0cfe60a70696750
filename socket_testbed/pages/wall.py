"""The unrolled surface of the socket: positions of tiles, and interpolation between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.regions import SocketAxis, socket_axis, wall_tiles
from socket_testbed.geometry.socket import SECTOR_TURNS, Side, SocketGeometry
from socket_testbed.identification.force_map import matern
from socket_testbed.settings.identification import ForceMapSettings

STEP = 0.35  # [-]; of the grid, relative to the edge of a tile
_MAX_DISTANCE = 1.3  # [-]; likewise; farther from the nearest tile there is no wall
_KERNEL_WIDTH = 0.7  # [-]; likewise; for smoothing the wall's shape
_NUGGET = 3e-3  # [-]; keeps weights small beyond the outermost tiles
# Corners of a square of edge 1 in {L}, counter-clockwise about the inward normal.
_SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) / 2.0


def side_names(side: Side | None) -> list[str]:
    """Directions at -180, -90, 0, 90 and 180 degrees on the unrolled wall, by side of the leg."""
    names = {turn: name for name, turn in SECTOR_TURNS[side].items()}
    return [names[turn] for turn in (2, 3, 0, 1, 2)]


@dataclass(frozen=True, eq=False)
class UnrolledTiles:
    """The n tiles as squares of the same areas, on the unrolled wall or on the distal end.

    Positions on the wall are the angle from anterior towards left [deg], unwrapped around the
    tile's centre, and the height above the distal end; those on the end, seen from inside, are
    towards right and towards anterior [mm].
    """

    around: SocketAxis
    on_wall: BoolArray  # (n,); the others are on the end
    squares: FloatArray  # (n, 4, 3) in {S} [m]; corners (-x, -y), (+x, -y), (+x, +y), (-x, +y)
    places: FloatArray  # (n, 2), of the centres
    corners: FloatArray  # (n, 4, 2)


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
    return UnrolledTiles(around, on_wall, squares, places[:, 0], places[:, 1:])


@dataclass(frozen=True, eq=False)
class Patch:
    """A part of the surface on a grid of w x h points."""

    name: str  # `wall`, unrolled, or `end`, seen from inside with anterior up
    x: FloatArray  # (w,); as in `UnrolledTiles`
    y: FloatArray  # (h,)
    points: FloatArray  # (h, w, 3) in {S} [m]; NaN without wall
    weights: FloatArray  # (h, w, n) [-]; of the tiles' values at a point


def patches(geometry: SocketGeometry, step: float = STEP) -> Iterator[Patch]:
    """Grids of the wall and the distal end, where they have tiles; `step` is relative to the edge.

    The value at a point is its expected value given those of the tiles, under a Gaussian process
    with the correlation of the force map (Matern 3/2 by distance, of the default length).
    """
    around, edge = socket_axis(geometry), float(np.median(np.sqrt(geometry.areas)))
    on_wall, heights = wall_tiles(geometry, around), around.heights(geometry.anchors)
    radii = around.radii(geometry.anchors)
    radius = float(radii.max())
    if on_wall.any():
        wall, radii = heights[on_wall], radii[on_wall]
        low, high = max(wall.min() - 0.5 * edge, 0.0), wall.max() + 0.5 * edge
        size = np.median(radii)
        x = np.linspace(-np.pi, np.pi, 2 * max(8, round(np.pi * size / edge / step)))
        y = np.linspace(low, high, max(4, round((high - low) / edge / step)))
        angle, height = np.reshape(np.meshgrid(x, y), (2, -1))  # row by row
        apart = np.subtract.outer(angle, around.angles(geometry.anchors[on_wall]))
        across = np.angle(np.exp(1j * apart)) * size
        r = _smooth(np.hypot(across, np.subtract.outer(height, wall)) / edge, radii)
        outwards = np.cos(angle)[:, None] * around.anterior + np.sin(angle)[:, None] * around.left
        points = around.end + height[:, None] * around.proximal + r[:, None] * outwards
        yield _patch("wall", geometry, np.degrees(x), 1e3 * y, points, edge)
        radius = float(r[: len(x)].mean())
    if not on_wall.all():
        line = np.linspace(-radius, radius, 2 * max(12, round(radius / edge / step)) + 1)
        right, up = np.reshape(np.meshgrid(line, line), (2, -1))
        offset = geometry.anchors[(heights < edge) | ~on_wall] - around.end
        flat = np.column_stack([-offset @ around.left, offset @ around.anterior])
        z = _smooth(cdist(np.column_stack([right, up]), flat) / edge, offset @ around.proximal)
        directions = np.stack([-around.left, around.anterior, around.proximal])
        points = around.end + np.column_stack([right, up, z]) @ directions
        points[np.hypot(right, up) > radius * (1.0 + 1e-9)] = np.nan
        yield _patch("end", geometry, 1e3 * line, 1e3 * line, points, edge)


def _smooth(apart: FloatArray, values: FloatArray) -> FloatArray:
    """Smooth tile values over points, by the distances between them in tile edges."""
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
