"""A tiling: the interior of a socket covered with the most tiles that the search finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import KDTree

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.errors import ScanError
from socket_testbed.tiling.candidates import Surroundings, fitting_squares, rim_points
from socket_testbed.tiling.neighbours import nearby_pairs
from socket_testbed.tiling.search import Search
from socket_testbed.tiling.squares import Squares
from socket_testbed.tiling.surface_points import SurfacePoints, spread_points
from socket_testbed.tiling.verification import Verification

_PLACES = 1 / 30  # [edges]; spacing of the centres that are tried
_POINTS = 1 / 12  # [edges]; spacing of the points that stand for the surface
_RIM = 1 / 60  # [edges]


@dataclass(frozen=True)
class TilingSettings:
    """How a surface is tiled.

    Attributes:
        edge: Length of a tile's edges [m].
        flatness: Largest distance of the surface from a tile's plane [m].
        rounds: Rounds of improvement; more may find another tile.
        seed: Seed of the places that are tried and of the improvement.
    """

    edge: float = 0.030
    flatness: float = 0.008
    rounds: int = 300
    seed: int = 0


@dataclass(frozen=True)
class Tiling:
    """Tiles on the interior of a socket and how well they cover it.

    Attributes:
        squares: The tiles.
        footprint_areas: Areas of the surface under the tiles, shape (n,) [m^2].
        flatness: Largest distances of the surface from the tiles' planes, shape (n,) [m].
        neighbours: Pairs of neighbouring tiles, shape (e, 2).
        interior_area: Area of the interior [m^2].
        cover_inside: Part of the interior under tiles, of what is farther than half a tile from
            the rim (brim, holes, cuts) [-].
        largest_gap: Largest distance of a point of the interior from the nearest tile [m].
    """

    squares: Squares
    footprint_areas: FloatArray
    flatness: FloatArray
    neighbours: IntArray
    interior_area: float
    cover_inside: float
    largest_gap: float

    @property
    def upper_bound(self) -> float:
        """Interior area in tile areas: no tiling has more tiles."""
        return self.interior_area / self.squares.edge**2


def tile_interior(
    mesh: trimesh.Trimesh,
    proximal: FloatArray,
    anterior: FloatArray,
    settings: TilingSettings,
    progress: Callable[[int, int], None] | None = None,
) -> Tiling:
    """Tile the interior of a socket.

    Args:
        mesh: The interior, its normals towards the limb [m].
        proximal: Direction towards the proximal end, shape (3,) [-].
        anterior: Direction of x where no tangent is proximal, shape (3,) [-].
        settings: The settings.
        progress: Called with the rounds done and their number.

    Raises:
        ScanError: If not a single tile fits.
    """
    rng = np.random.default_rng(settings.seed)
    points = spread_points(mesh, _POINTS * settings.edge, rng)
    surroundings = Surroundings(points, rim_points(mesh, _RIM * settings.edge), proximal, anterior)
    places = spread_points(mesh, _PLACES * settings.edge, rng)
    fitting = fitting_squares(places, surroundings, settings.edge, settings.flatness)
    if not len(fitting):
        raise ScanError(
            f"no {1e3 * settings.edge:g} mm tile fits the interior"
            f" ({1e4 * mesh.area:.1f} cm^2) within {1e3 * settings.flatness:g} mm of flat",
            "check the unit of the scan, or give a smaller --size or a larger --flatness",
        )
    verification = Verification(mesh, fitting, settings.flatness)
    search = Search(fitting, points, verification)
    tiles = search.improve(search.fill(), settings.rounds, rng, progress)
    footprints = [verification.footprint(int(tile)) for tile in tiles]
    squares = fitting.take(tiles)
    covered = _covered(points, squares)
    inside = _distance(points.positions, surroundings.rim) > 0.5 * settings.edge
    return Tiling(
        squares=squares,
        footprint_areas=np.array([footprint.area for footprint in footprints]),
        flatness=np.array([footprint.flatness for footprint in footprints]),
        neighbours=nearby_pairs(squares),
        interior_area=float(mesh.area),
        cover_inside=float(points.areas[covered & inside].sum() / points.areas[inside].sum()),
        largest_gap=float(_distance(points.positions, points.positions[covered]).max()),
    )


def _distance(points: FloatArray, others: FloatArray) -> FloatArray:
    """Distance of each point from the nearest of the others; infinite without others [m]."""
    if not len(others):
        return np.full(len(points), np.inf)
    return KDTree(others).query(points)[0]


def _covered(points: SurfacePoints, squares: Squares) -> BoolArray:
    """Which points lie under a square."""
    tree, half = KDTree(points.positions), 0.5 * squares.edge
    covered = np.zeros(len(points.areas), dtype=bool)
    for anchor, frame in zip(squares.anchors, squares.rotations, strict=True):
        near = np.array(tree.query_ball_point(anchor, 2.0 * half))
        x, y, _ = ((points.positions[near] - anchor) @ frame).T
        facing = points.normals[near] @ frame[:, 2] > 0.0
        covered[near[(np.abs(x) < half) & (np.abs(y) < half) & facing]] = True
    return covered
