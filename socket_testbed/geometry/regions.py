"""The socket's axis, heights and angles about it, and the regions they define.

Heights are measured from the distal end, angles from anterior towards left.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.errors import ConfigurationError, closest
from socket_testbed.geometry.socket import (
    HEIGHTS,
    SECTOR_PARTS,
    SECTOR_TURNS,
    SOCKET,
    UNMEASURED,
    SocketGeometry,
)
from socket_testbed.settings.options import Side

_MIN_ALIGNMENT = 0.5  # [-]; cosine between a tile's x axis and the proximal direction
_FACES_UP = np.sqrt(0.5)  # [-]; z of normals that point up at 45 degrees or more
_NO_DIRECTION = 0.1  # [-]; a shorter mean of unit vectors has no direction
_X, _Z = np.eye(3)[[0, 2]]
DISTAL_END = "the distal end"


@dataclass(frozen=True)
class SocketAxis:
    """The axis of a socket, with the zero direction of angles about it.

    Its vectors are in the frame of the points it was laid through: {S} for a `SocketGeometry`.

    Attributes:
        end: Intersection of the axis with the distal end, where heights are zero, shape (3,) [m].
        proximal: Unit vector along the axis towards the proximal end, shape (3,) [-].
        anterior: Unit vector across the axis, where angles are zero, shape (3,) [-].
    """

    end: FloatArray
    proximal: FloatArray
    anterior: FloatArray

    @property
    def left(self) -> FloatArray:
        """Unit vector towards left, at +90 degrees, shape (3,) [-]."""
        return np.cross(self.proximal, self.anterior)

    @property
    def frame(self) -> FloatArray:
        """Rotation from the points' frame to anterior, left and proximal, shape (3, 3) [-].

        Its rows are the three unit vectors.
        """
        return np.stack([self.anterior, self.left, self.proximal])

    def heights(self, points: FloatArray) -> FloatArray:
        """Heights of points above the distal end, shape (...) of (..., 3) [m].

        The points are in the frame of the axis.
        """
        return np.asarray((points - self.end) @ self.proximal)

    def angles(self, points: FloatArray) -> FloatArray:
        """Angles of points from anterior towards left, in +-pi, shape (...) [rad].

        The points are in the frame of the axis, shape (..., 3) [m].
        """
        offset = points - self.end
        return np.asarray(np.arctan2(offset @ self.left, offset @ self.anterior))

    def radii(self, points: FloatArray) -> FloatArray:
        """Distances of points from the axis, shape (...) of (..., 3) [m].

        The points are in the frame of the axis.
        """
        offset = points - self.end
        return np.hypot(offset @ self.left, offset @ self.anterior)


def axis_between(points: FloatArray, proximal: FloatArray, anterior: FloatArray = _X) -> SocketAxis:
    """The axis in a proximal direction, centred between points, from the lowest one up.

    Args:
        points: Points of the wall, or the tiles' anchors, shape (N, 3) [m], in {S} or another frame
            such as a scan's; the axis and both directions are in this frame.
        proximal: Direction of the axis towards the proximal end, of any length, shape (3,) [-].
        anterior: Direction towards anterior, shape (3,) [-], by default x (REP 103). It is
            projected across the axis; if it is parallel to the axis, -z is anterior.
    """
    along = proximal / np.linalg.norm(proximal)
    across = anterior - (anterior @ along) * along
    if np.linalg.norm(across) < _NO_DIRECTION:
        across = -_Z + (_Z @ along) * along
    axis = SocketAxis(np.zeros(3), along, across / np.linalg.norm(across))
    inside = points @ axis.frame.T
    low, high = inside.min(axis=0), inside.max(axis=0)
    return replace(axis, end=np.array([*0.5 * (low + high)[:2], low[2]]) @ axis.frame)


def proximal_direction(geometry: SocketGeometry) -> FloatArray:
    """Unit vector (3,) in {S} towards the proximal end, the mean x axis of the tiles on the wall.

    On the distal end no tangent is proximal, so tiles whose x axis deviates from the mean of all
    are left out. If the x axes cancel or all tiles face up, it is z of {S}.
    """
    x_axes = geometry.rotations[:, :, 0]
    mean = x_axes.mean(axis=0)
    length = np.linalg.norm(mean)
    if length < _NO_DIRECTION or (geometry.rotations[:, 2, 2] > _FACES_UP).all():
        return _Z.copy()
    along = x_axes @ (mean / length) >= _MIN_ALIGNMENT
    if along.any():
        mean = x_axes[along].mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def axial_force(geometry: SocketGeometry, wrench: FloatArray) -> FloatArray:
    """Force of wrenches along the socket, positive under load, shape (...) [N].

    Args:
        geometry: The socket, whose `proximal_direction` is that of the force.
        wrench: Wrenches [M; F] on the socket in {S}, shape (..., 6) [N m, N]; the force of a limb
            that presses towards the distal end is positive.
    """
    return np.asarray(-wrench[..., 3:] @ proximal_direction(geometry))


def socket_axis(geometry: SocketGeometry) -> SocketAxis:
    """The axis of a socket, centred between the anchors of its tiles, from the lowest one up.

    Its `heights(geometry.anchors)` and `angles(geometry.anchors)` locate each tile.
    """
    return axis_between(geometry.anchors, proximal_direction(geometry))


def wall_tiles(geometry: SocketGeometry, around: SocketAxis) -> BoolArray:
    """Which tiles are on the wall, not on the distal end or at the axis, shape (n,).

    Args:
        geometry: The socket with its n tiles.
        around: Its axis in {S}, as `socket_axis` returns it.
    """
    steep = geometry.rotations[:, :, 2] @ around.proximal < _FACES_UP
    return np.asarray(steep & (around.radii(geometry.anchors) >= np.sqrt(geometry.areas)))


@dataclass(frozen=True, eq=False)
class Region:
    """A part of a socket.

    Attributes:
        name: Such as `anterior`, `anterior proximal`, or the user's own name.
        tiles: Indices of its tiles in the geometry, ascending, shape (k,).
    """

    name: str
    tiles: IntArray


# Borders of the sectors, quarter turns in `anatomical_regions`, from anterior towards left [deg]
SECTOR_EDGES = (-135, -45, 45, 135)


def main_regions(places: Iterable[Region]) -> list[Region]:
    """Sectors, heights and the user's regions: neither parts of sectors nor what covers them."""
    return [place for place in places if place.name not in {SOCKET, UNMEASURED, *SECTOR_PARTS}]


def part_of(places: Iterable[Region], tile: int) -> str:
    """Name of the smallest region that holds a tile, such as `anterior proximal`.

    Args:
        places: Regions of the socket; the whole socket and its unmeasured wall do not count.
        tile: Index of the tile.

    Returns:
        The region's name; `socket` if the tile is in none.
    """
    inside = [p for p in places if tile in p.tiles and p.name not in (SOCKET, UNMEASURED)]
    return min(inside, key=lambda place: len(place.tiles)).name if inside else SOCKET


def place_of(geometry: SocketGeometry, places: Iterable[Region], tile: int) -> str:
    """Where a tile is, in words: a part of the wall, such as `anterior proximal`, or the end.

    A sector of the distal end is not named, because it reads like a part of the wall.

    Args:
        geometry: The socket.
        places: Regions of the socket, as for `part_of`.
        tile: Index of the tile.
    """
    on_wall = wall_tiles(geometry, socket_axis(geometry))
    return part_of(places, tile) if on_wall[tile] or not on_wall.any() else DISTAL_END


def third_edges(geometry: SocketGeometry) -> FloatArray:
    """Heights of the edges of the thirds above the distal end, from distal to proximal, (4,) [m].

    The thirds divide the span of the tiles' anchors along the socket's axis.
    """
    heights = socket_axis(geometry).heights(geometry.anchors)
    return np.linspace(heights.min(), heights.max(), 4)


def anatomical_regions(geometry: SocketGeometry, side: Side | None = None) -> tuple[Region, ...]:
    """Four sectors, three heights, and their intersections.

    The sectors are quarter turns about the socket's axis (`socket_axis`), centred on anterior,
    left, posterior and right. The heights are thirds of the span of the tiles' centres along the
    axis. Every tile is in exactly one sector, one height and one intersection, such as `anterior
    proximal`; empty regions are left out. Medial is left of the axis on a right leg, right of it on
    a left leg.

    Args:
        geometry: The socket.
        side: The leg, `left` or `right`; None if unknown: the sectors are then called `left` and
            `right`, not `medial` and `lateral`.
    """
    axis = socket_axis(geometry)
    turns = np.round(axis.angles(geometry.anchors) / (0.5 * np.pi)) % 4
    heights, edges = axis.heights(geometry.anchors), third_edges(geometry)
    thirds = 2 - np.searchsorted(edges[1:3], heights)  # HEIGHTS begin with the proximal one
    sectors = {name: turns == turn for name, turn in SECTOR_TURNS[side].items()}
    levels = {name: thirds == third for third, name in enumerate(HEIGHTS)}
    fields = {
        f"{sector} {height}": inside & level
        for sector, inside in sectors.items()
        for height, level in levels.items()
    }
    masks = {**sectors, **levels, **fields}
    return tuple(Region(name, np.flatnonzero(m)) for name, m in masks.items() if m.any())


def all_regions(geometry: SocketGeometry, side: Side | None = None) -> tuple[Region, ...]:
    """Anatomical regions, those of `socket.yaml`, tiles without a cluster, and the whole socket.

    In this order; the unmeasured region is left out if every tile has a cluster.

    Args:
        geometry: The socket.
        side: The leg, `left` or `right`; None if unknown, see `anatomical_regions`.
    """
    own = [Region(name, np.array(tiles)) for name, tiles in geometry.regions.items()]
    bare = np.flatnonzero(~geometry.covered)
    if len(bare):
        own.append(Region(UNMEASURED, bare))
    every = Region(SOCKET, np.arange(len(geometry)))
    return (*anatomical_regions(geometry, side), *own, every)


def tiles_named(name: str, tiles: Mapping[str, IntArray]) -> IntArray:
    """Indices of the tiles of a region, or of the tile of that name, shape (k,).

    Args:
        name: Name of the region or tile.
        tiles: Indices of the tiles keyed by the names of regions and tiles.

    Raises:
        ConfigurationError: If there is no region or tile of this name.
    """
    if name not in tiles:
        fact = f"--keep-out: there is no region or tile '{name}'"
        raise ConfigurationError(fact, closest(name, tiles))
    return tiles[name]
