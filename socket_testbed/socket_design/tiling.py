"""Tiling: cover the interior of a socket with as many tiles as the search finds.

The squares are the nodes of a graph, overlaps its edges: the goal is a maximum independent set.
A greedy search places the free square that blocks the fewest other free ones (least waste), so
that tiles grow from corners, edges and other tiles. Then parts of the set are removed and refilled
in a partly random order; the result is kept if no tile is lost (ruin and recreate: Schrimpf et
al. 2000, doi:10.1006/jcph.1999.6413).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.errors import ScanError
from socket_testbed.socket_design.clusters import ClusterPlace, LaidCluster, lay_clusters
from socket_testbed.socket_design.scan_file import number_cells
from socket_testbed.socket_design.squares import (
    OTHER_WALL,
    REACH,
    Footprints,
    Squares,
    SurfacePoints,
    Surroundings,
    gaps,
    overlapping,
    points_over,
    rim_points,
    roughly_fit,
    spread_points,
    squares_at,
)

_PROJECTION_STEPS = 2  # towards the surface, taken as plane around each of its points
_MIN_COSINE = 0.3  # [-]; between a square's and the surface's normal, to project on the surface

# Corners and thirds of the edges, in halves of an edge.
_BORDER = np.array(
    [[x, y] for x in (-3, -1, 1, 3) for y in (-3, -1, 1, 3) if 3 in (abs(x), abs(y))]
) / (3.0)


def _border_points(squares: Squares, points: SurfacePoints) -> FloatArray:
    """Points of the surface along the borders of squares, shape (m, 12, 3) [m]."""
    half, tree = 0.5 * squares.edge, KDTree(points.positions)
    along = np.einsum("mij,bj->mbi", squares.rotations[:, :, :2], half * _BORDER)
    border = squares.anchors[:, None] + along
    normal = squares.rotations[:, None, :, 2]
    for _ in range(_PROJECTION_STEPS):
        nearest = tree.query(border, workers=-1)[1]
        there = points.normals[nearest]
        steepness = (there * normal).sum(axis=2)
        step = ((points.positions[nearest] - border) * there).sum(axis=2)
        step = np.where(steepness > _MIN_COSINE, step / np.maximum(steepness, _MIN_COSINE), 0.0)
        border = border + step[:, :, None] * normal
    return border


def _border_gaps(
    squares: Squares, borders: NDArray[np.floating[Any]], index: int, others: IntArray
) -> FloatArray:
    """Gaps between a square and p others close to it, from points on their borders, (p,) [m].

    A gap is negative if a border point of one is in the column over the other.
    """
    own = (borders[others] - squares.anchors[index]) @ squares.rotations[index][:, :2]
    offset = borders[index] - squares.anchors[others][:, None]
    theirs = offset @ squares.rotations[others][:, :, :2]
    outside = (np.abs(seen).max(axis=2).min(axis=1) for seen in (own, theirs))
    return np.minimum(*outside) - 0.5 * squares.edge


_WASTE_SPACING = 0.15  # [edges]; of the squares that measure waste
_CHANCE = (0.0, 0.02, 0.1, 0.3)  # [-]; relative random change of the waste when recreating
_MIN_RUINED, _MAX_RUINED = 3, 14
_MAX_LISTS = 256
_PLANE_TOLERANCE = 0.002  # [m]; smaller gaps are measured on the surface itself
_CLEARANCE = 0.0001  # [m]; between tiles, as the plane geometry of the search is approximate


class Search:
    """Greedy placement and its improvement.

    The search treats squares as plane, but checks each set of tiles that it keeps on the surface
    itself and never tries squares that fail there again. The first `fixed` squares, which do not
    overlap, are always tiles. A set of tiles is given by the indices of its squares.
    """

    def __init__(
        self, squares: Squares, points: SurfacePoints, footprints: Footprints, fixed: int = 0
    ) -> None:
        self._fixed = fixed
        self._borders = _border_points(squares, points).astype(np.float32)
        # Rounding to 30 nm, far below the clearance, halves the time.
        squares = Squares(
            squares.anchors.astype(np.float32), squares.rotations.astype(np.float32), squares.edge
        )
        self._squares = squares
        self._normals = np.ascontiguousarray(squares.rotations[:, :, 2])
        self._footprints = footprints
        self._alive = np.ones(len(squares), dtype=bool)
        self._tree = KDTree(squares.anchors)
        self._overlapping = lru_cache(_MAX_LISTS)(self._find_overlapping)
        cell = number_cells(squares.anchors, _WASTE_SPACING * squares.edge)
        witnesses = np.unique(cell, return_index=True)[1]
        self._witness = np.full(len(squares), -1)
        self._witness[witnesses] = np.arange(len(witnesses))
        self._overlapping_witness = overlapping(squares, witnesses, _CLEARANCE)

    def fill(self) -> IntArray:
        """An initial set of tiles, the fixed ones first, with no space for another, shape (t,)."""
        tiles = np.arange(self._fixed)
        while True:
            free = self._alive.copy()
            for tile in tiles:
                free[self._overlapping(int(tile))] = False
            tiles = self._place(tiles, np.flatnonzero(free), np.zeros(free.sum()))
            wrong = self._find_invalid(tiles)
            if not wrong:
                return tiles
            tiles = np.array([tile for tile in tiles if tile not in wrong], dtype=np.int64)

    def improve(
        self,
        tiles: IntArray,
        rounds: int,
        rng: np.random.Generator,
        progress: Callable[[int, int], None],
    ) -> IntArray:
        """Remove and refill round by round, without ever losing a tile.

        The fixed tiles remain the first.

        Args:
            tiles: Indices of the tiles to begin with, the fixed ones first, shape (t,).
            rounds: Number of rounds.
            rng: Source of the random numbers.
            progress: Called after each round with the rounds done and their number.

        Returns:
            Indices of as many tiles or more.
        """
        anchors = self._squares.anchors
        for done in range(rounds):
            centre = anchors[rng.integers(len(anchors))]
            fixed, loose = tiles[: self._fixed], tiles[self._fixed :]
            order = np.argsort(np.linalg.norm(anchors[loose] - centre, axis=1))
            ruined = int(rng.integers(_MIN_RUINED, _MAX_RUINED))
            kept, out = np.concatenate([fixed, loose[order[ruined:]]]), loose[order[:ruined]]
            free = np.zeros(len(anchors), dtype=bool)
            for tile in out:
                free[self._overlapping(int(tile))] = True
            free &= self._alive
            apart = cdist(anchors[kept], anchors[out]).min(axis=1, initial=np.inf)
            for tile in kept[apart < 2.0 * REACH * self._squares.edge]:
                free[self._overlapping(int(tile))] = False
            chance = rng.choice(_CHANCE) * rng.random(len(free))
            found = self._place(kept, np.flatnonzero(free), chance[free])
            if len(found) >= len(tiles) and not self._find_invalid(found, len(kept)):
                tiles = found
            progress(done + 1, rounds)
        return tiles

    def _place(self, tiles: IntArray, free: IntArray, chance: FloatArray) -> IntArray:
        """Place free squares by least waste until none is left."""
        placed = list(tiles)
        waste = self._overlaps(free)
        while len(free):
            best = int(free[np.argmin(waste[free] * (1.0 + chance))])
            placed.append(best)
            taken = self._overlap(best, free)
            if taken.all():
                break
            waste -= self._overlaps(free[taken])
            free, chance = free[~taken], chance[~taken]
        return np.array(placed, dtype=np.int64)

    def _overlaps(self, some: IntArray) -> IntArray:
        """Number of witnesses among some squares that each square overlaps, shape (m,)."""
        witnesses = self._witness[some]
        squares = [self._overlapping_witness[i] for i in witnesses[witnesses >= 0]]
        none = np.zeros(0, dtype=np.int32)
        return np.bincount(np.concatenate([none, *squares]), minlength=len(self._squares))

    def _find_invalid(self, tiles: IntArray, known: int = 0) -> set[int]:
        """Tiles that are incomplete or overlap; the first `known` are known to be valid."""
        wrong = set(self._footprints.unfit(tiles[known:]))
        for pair in self._footprints.overlapping(tiles, known):
            if not wrong.intersection(pair):
                wrong.add(pair[1])
        self._alive[list(wrong)] = False
        return wrong

    def _find_overlapping(self, tile: int) -> IntArray:
        """Squares that overlap a tile, including itself."""
        anchor, reach = self._squares.anchors[tile], REACH * self._squares.edge
        near = np.array(self._tree.query_ball_point(anchor, reach))
        return near[self._overlap(tile, near)]

    def _overlap(self, index: int, others: IntArray) -> BoolArray:
        squares, normals = self._squares, self._normals
        x, y, z = (squares.anchors[others] - squares.anchors[index]).T
        apart2 = x**2 + y**2 + z**2
        # With centres less than an edge apart, squares overlap in any orientation.
        overlap = apart2 < (squares.edge - _PLANE_TOLERANCE) ** 2
        overlap &= normals[others] @ normals[index] > OTHER_WALL
        unsure = np.flatnonzero(~overlap & (apart2 <= (REACH * squares.edge) ** 2))
        some = others[unsure]
        gap = gaps(squares, np.array([index]), some)[0]
        close = np.abs(gap) < _PLANE_TOLERANCE
        gap[close] = _border_gaps(squares, self._borders, index, some[close])
        overlap[unsure] = gap < _CLEARANCE
        return overlap


_MAX_GAP = 0.5  # [edges]; largest gap between neighbours
_MAX_DISTANCE = 2.2  # [edges]; between centres of neighbours
_MIN_FACING = 0.0  # [-]; cosine between normals of neighbours


def _nearby_pairs(squares: Squares) -> IntArray:
    """Pairs of tiles less than half a tile apart, including diagonal ones."""
    every, normals = np.arange(len(squares)), squares.rotations[:, :, 2]
    near = gaps(squares, every, every) < _MAX_GAP * squares.edge
    near &= normals @ normals.T > _MIN_FACING
    near &= cdist(squares.anchors, squares.anchors) < _MAX_DISTANCE * squares.edge
    return np.argwhere(np.triu(near, 1))


_PLACE_SPACING = 1 / 30  # [edges]; of candidate centres
_POINT_SPACING = 1 / 12  # [edges]; of points that represent the surface
_RIM = 1 / 60  # [edges]


@dataclass(frozen=True)
class TilingSettings:
    """How a surface is tiled.

    Attributes:
        edge: Length of a tile's edges [m].
        flatness: Largest distance of the surface from a tile's plane [m].
        rounds: Rounds of improvement; more may find another tile.
        seed: Seed of the random numbers for candidate places and improvement.
    """

    edge: float = 0.030
    flatness: float = 0.008
    rounds: int = 300
    seed: int = 0


@dataclass(frozen=True)
class Tiling:
    """Tiles on the interior of a socket and how well they cover it.

    Attributes:
        squares: The n tiles in the frame of the interior, those under clusters first; the frames of
            these are turned with their clusters.
        footprint_areas: Area of the surface under each tile, shape (n,) [m^2].
        flatness: Largest distance of the surface from each tile's plane, shape (n,) [m].
        neighbours: Indices of neighbouring tiles, a pair per row, shape (e, 2), the smaller first.
        interior_area: Area of the interior [m^2].
        cover_inside: Covered share of the interior farther than half a tile from the rim (brim,
            holes, cuts) [-]; NaN if nothing is.
        largest_gap: Largest distance of a point of the interior from the nearest tile [m].
        clusters: The clusters under the first tiles, in their order.
    """

    squares: Squares
    footprint_areas: FloatArray
    flatness: FloatArray
    neighbours: IntArray
    interior_area: float
    cover_inside: float
    largest_gap: float
    clusters: tuple[LaidCluster, ...] = ()

    @property
    def cover(self) -> float:
        """Share of the interior's area that the tiles cover, at most 1 [-]."""
        return min(float(self.footprint_areas.sum()) / self.interior_area, 1.0)

    @property
    def upper_bound(self) -> float:
        """Interior area over tile area [-]: no tiling has more tiles."""
        return self.interior_area / self.squares.edge**2


def tile_interior(
    mesh: trimesh.Trimesh,
    proximal: FloatArray,
    anterior: FloatArray,
    settings: TilingSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
    clusters: Sequence[ClusterPlace] = (),
) -> Tiling:
    """Tile the interior of a socket around clusters glued in at places in {S}.

    Tiles have x towards proximal, or towards anterior where the normal is nearly proximal.

    Args:
        mesh: The interior in {S} [m], with normals towards the limb.
        proximal: Unit vector towards the proximal end in {S}, shape (3,) [-].
        anterior: Unit vector towards anterior in {S}, shape (3,) [-].
        settings: Size and flatness of the tiles, and the effort of the search.
        progress: Called after each round with the rounds done and their number.
        clusters: Places of the glued clusters in {S}; their tiles are the first.

    Raises:
        ScanError: If no tile fits the interior.
    """
    rng = np.random.default_rng(settings.seed)
    points = spread_points(mesh, _POINT_SPACING * settings.edge, rng)
    surroundings = Surroundings(points, rim_points(mesh, _RIM * settings.edge), proximal, anterior)
    places = spread_points(mesh, _PLACE_SPACING * settings.edge, rng)
    every = squares_at(places, surroundings, settings.edge)
    fitting = every.take(roughly_fit(every, surroundings, settings.flatness))
    glued, laid = lay_clusters(mesh, clusters, every, surroundings, settings.flatness)
    fitting = glued.join(fitting)
    footprints = Footprints(mesh, fitting, settings.flatness)
    search = Search(fitting, points, footprints, len(laid)) if len(fitting) else None
    tiles = search.fill() if search else np.zeros(0, dtype=np.int64)
    if not search or not len(tiles):
        raise ScanError(
            f"no {1e3 * settings.edge:g} mm tile fits the interior"
            f" ({1e4 * mesh.area:.1f} cm^2) within {1e3 * settings.flatness:g} mm of flat",
            "check the unit of the scan, or give a smaller --size or a larger --flatness",
        )
    tiles = search.improve(tiles, settings.rounds, rng, progress)
    kept = [footprints.footprint(int(tile)) for tile in tiles]
    squares = fitting.take(tiles)
    under, _ = points_over(squares, points.positions, settings.edge)
    facing = squares.rotations[:, :, 2] @ points.normals.T > 0.0
    covered = np.asarray((under & facing).any(axis=0))
    from_rim, from_tiles = (
        KDTree(others).query(points.positions)[0]  # infinite without a rim
        for others in (surroundings.rim, points.positions[covered])
    )
    inside = from_rim > 0.5 * settings.edge
    return Tiling(
        squares=squares,
        footprint_areas=np.array([footprint.area for footprint in kept]),
        flatness=np.array([footprint.flatness for footprint in kept]),
        neighbours=_nearby_pairs(squares),
        interior_area=float(mesh.area),
        cover_inside=_cover(points.areas[inside], covered[inside]),
        largest_gap=float(from_tiles.max()),
        clusters=tuple(laid),
    )


def _cover(areas: FloatArray, covered: BoolArray) -> float:
    """Covered share of the areas of some points [-]; NaN if there are none."""
    whole = float(areas.sum())
    return float(areas[covered].sum()) / whole if whole > 0.0 else float("nan")
