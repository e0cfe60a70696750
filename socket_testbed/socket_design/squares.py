"""Squares on a surface: candidates, overlaps and footprints."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from trimesh.intersections import slice_faces_plane

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.socket_design.scan_file import number_cells

_TINY = 1e-12  # avoids division by zero
REACH = 1.45  # [edges]; largest distance between centres of overlapping squares
_BLOCK = 0.4  # [-]; size of a block of centres over the radius around them
OTHER_WALL = -0.2  # [-]; cosine between normals below which squares are on different walls


@dataclass(frozen=True)
class Squares:
    """Squares of one size on a surface, each with the frame of its tile.

    Attributes:
        anchors: Centres of the m squares in the frame of the surface, shape (m, 3) [m].
        rotations: Frames of the squares, which map to the frame of the surface, shape (m, 3, 3)
            [-]; columns x and y along the edges, z the inward normal.
        edge: Length of their edges [m].
    """

    anchors: FloatArray
    rotations: FloatArray
    edge: float

    def __len__(self) -> int:
        return len(self.anchors)

    def take(self, index: IntArray | BoolArray) -> Squares:
        """Some of the squares, by their indices, shape (k,), or a mask, shape (m,)."""
        return Squares(self.anchors[index], self.rotations[index], self.edge)

    def join(self, other: Squares) -> Squares:
        """These squares, then others with equal edges."""
        anchors = np.concatenate([self.anchors, other.anchors])
        return Squares(anchors, np.concatenate([self.rotations, other.rotations]), self.edge)


def gaps(squares: Squares, some: IntArray, others: IntArray) -> FloatArray:
    """Gaps between squares and others on a smooth surface, negative for overlaps.

    Each pair is rotated into the plane halfway between the two, where the separating-axis test of
    two squares is exact: on a circular wall two squares touch when the chord between their centres
    is one edge, like their footprints on the wall. The gap is the largest distance along any of
    the four axes; it is infinite between different walls.

    Args:
        squares: All squares.
        some: Indices of p squares, shape (p,).
        others: Indices of q squares, shape (q,).

    Returns:
        The gap of each of `some` (rows) from each of `others` (columns), shape (p, q) [m].
    """
    one, other = squares.take(some), squares.take(others)
    x, z = one.rotations[:, :, 0], one.rotations[:, :, 2]
    x_other, z_other = other.rotations[:, :, 0], other.rotations[:, :, 2]
    offset_x, offset_y, offset_z = seen_from(one, other.anchors)
    offset_x_other = (x_other * other.anchors).sum(axis=1) - one.anchors @ x_other.T
    offset_z_other = (z_other * other.anchors).sum(axis=1) - one.anchors @ z_other.T

    # The normal of the plane halfway is along z + z_other, whose squared length is:
    cosine = z @ z_other.T
    length2 = np.maximum(2.0 + 2.0 * cosine, _TINY)
    out_of_plane = (offset_z + offset_z_other) / length2
    in_plane2 = offset_x**2 + offset_y**2 + offset_z**2 - out_of_plane**2 * length2
    x_out, x_other_out = x @ z_other.T, z @ x_other.T
    scale, scale_other = (
        1.0 / np.sqrt(np.maximum(1.0 - out**2 / length2, _TINY)) for out in (x_out, x_other_out)
    )
    along = (offset_x - x_out * out_of_plane) * scale
    along_other = (offset_x_other - x_other_out * out_of_plane) * scale_other
    cosine_x = (x @ x_other.T - x_out * x_other_out / length2) * scale * scale_other

    apart = np.maximum(along**2, along_other**2)
    across = in_plane2 - np.minimum(along**2, along_other**2)
    sine_x = np.sqrt(np.maximum(1.0 - cosine_x**2, 0.0))
    reach = 0.5 * squares.edge * (1.0 + np.abs(cosine_x) + sine_x)
    return np.where(cosine > OTHER_WALL, np.sqrt(np.maximum(apart, across)) - reach, np.inf)


def overlapping(squares: Squares, some: IntArray, clearance: float) -> list[IntArray]:
    """For each of some squares, those closer to it than a clearance, including itself.

    Args:
        squares: All squares.
        some: Indices of p squares, shape (p,).
        clearance: Smallest gap of squares that do not overlap [m].

    Returns:
        For each of the p squares an array of indices of squares.
    """
    found = [np.zeros(0, dtype=np.int64)] * len(some)
    for rows, near in _blocks_of(squares.anchors[some], squares.anchors, REACH * squares.edge):
        for row, overlap in zip(rows, gaps(squares, some[rows], near) < clearance, strict=True):
            found[row] = near[overlap]
    return found


def seen_from(squares: Squares, points: FloatArray) -> FloatArray:
    """Coordinates of p points in the frames of m squares, shape (3, m, p) [m].

    Args:
        squares: The m squares.
        points: The points in the frame of the surface, shape (p, 3) [m].

    Returns:
        The coordinates x, y and z (height over the square's plane, positive inwards), with a row
        per square and a column per point each.
    """
    axes = np.moveaxis(squares.rotations, 2, 0)
    return axes @ points.T - (axes * squares.anchors).sum(axis=2)[:, :, None]


def points_over(squares: Squares, points: FloatArray, reach: float) -> tuple[BoolArray, FloatArray]:
    """Which points are over which squares, and how high.

    Args:
        squares: The m squares.
        points: The p points in the frame of the surface, shape (p, 3) [m].
        reach: Largest distance of a point from a square's centre [m].

    Returns:
        Whether each point (column) is within the reach in the column over or under each square
        (row), shape (m, p), and its height over the square's plane, positive inwards, shape (m, p)
        [m].
    """
    x, y, height = seen_from(squares, points)
    over = np.maximum(np.abs(x), np.abs(y)) < 0.5 * squares.edge
    return over & (cdist(squares.anchors, points) <= reach), height


def _blocks_of(
    centres: FloatArray, points: FloatArray, radius: float
) -> Iterator[tuple[IntArray, IntArray]]:
    """Blocks of neighbouring centres, each with the points near any of them."""
    if not len(points) or not len(centres):
        return
    tree = KDTree(points)
    block = number_cells(centres, _BLOCK * radius)
    order = np.argsort(block, kind="stable")
    first = np.flatnonzero(np.diff(block[order], prepend=-1))
    for rows in np.split(order, first[1:]):
        middle = centres[rows].mean(axis=0)
        off = np.linalg.norm(centres[rows] - middle, axis=1).max()
        near = tree.query_ball_point(middle, radius + off)
        if near:
            yield rows, np.array(near)


_DRAWS_PER_POINT = 4.0  # random points per kept point
_MIN_DISTANCE = 0.6  # [-]; smallest distance of two points, in spacings


@dataclass(frozen=True)
class SurfacePoints:
    """Points of a surface that represent the area around them.

    Attributes:
        positions: The p points in the frame of the surface, shape (p, 3) [m].
        normals: Unit normals of their faces, shape (p, 3) [-].
        areas: Area that each point represents, shape (p,) [m^2].
    """

    positions: FloatArray
    normals: FloatArray
    areas: FloatArray


def spread_points(mesh: trimesh.Trimesh, spacing: float, rng: np.random.Generator) -> SurfacePoints:
    """Spread points over a surface at random: about one per square of a spacing.

    Args:
        mesh: The surface [m].
        spacing: Approximate distance between neighbouring points [m].
        rng: Source of the random numbers.
    """
    count = int(np.ceil(_DRAWS_PER_POINT * mesh.area / spacing**2))
    drawn, face = trimesh.sample.sample_surface(mesh, count, seed=rng)
    # In each cell of a cubic grid, keep the point closest to the cell's centre.
    off = ((drawn / spacing) % 1.0 - 0.5) ** 2
    cell = number_cells(drawn, spacing)
    order = np.lexsort((off.sum(axis=1), cell))
    kept = order[np.flatnonzero(np.diff(cell[order], prepend=-1))]
    kept = kept[trimesh.points.remove_close(drawn[kept], _MIN_DISTANCE * spacing)[1]]
    nearest = KDTree(drawn[kept]).query(drawn)[1]
    return SurfacePoints(
        positions=drawn[kept],
        normals=np.asarray(mesh.face_normals)[face[kept]],
        areas=np.bincount(nearest, minlength=len(kept)) * (mesh.area / count),
    )


FACING_WALL = -0.5  # [-]; cosine below which a surface is the opposite wall
MIN_FACING = 0.5  # [-]; cosine to a tile's normal below which a surface is folded away
_SMALL_TRIANGLE = 0.1  # [edges]; larger triangles are checked for every square
_TOLERANCE = 0.003  # [-]; of cover and fold: beyond it a footprint is cut, folded or double
_MAX_GAP = 0.1  # [edges]; with larger gaps footprints cannot overlap
_MAX_FOOTPRINTS = 256
_MAX_SHARED_AREA = 1e-8  # [m^2]; rounding for two adjacent footprints


@dataclass(frozen=True)
class Footprint:
    """The piece of the surface that projects onto a square along its normal.

    Attributes:
        triangles: Corners of its f triangles in the frame of the surface, shape (f, 3, 3) [m]; a
            corner per row of each.
        area: Area of the piece of the surface [m^2].
        cover: Share of the square that it covers [-]; more than 1 if the surface is double.
        fold: Area folded away from the square, in areas of the square [-].
        flatness: Largest distance of the piece from the square's plane [m].
    """

    triangles: FloatArray
    area: float
    cover: float
    fold: float
    flatness: float


class Footprints:
    """The footprints of squares on a surface, each cut out of its triangles once.

    The mesh [m], with normals inwards, and the squares are in one frame; the flatness is the
    largest distance of the surface from a tile's plane [m]. `footprint(i)` is the `Footprint` of
    square i.
    """

    def __init__(self, mesh: trimesh.Trimesh, squares: Squares, flatness: float) -> None:
        self._triangles = np.asarray(mesh.triangles)
        self._normals = np.asarray(mesh.face_normals)
        centres = np.asarray(mesh.triangles_center)
        radii = np.linalg.norm(self._triangles - centres[:, None], axis=2).max(axis=1)
        small = radii <= _SMALL_TRIANGLE * squares.edge
        self._large, self._small = np.flatnonzero(~small), np.flatnonzero(small)
        self._tree = KDTree(centres[small])
        self._squares = squares
        self._flatness = flatness
        # Footprints on a fine scan take much memory: cache only those in use.
        self.footprint = lru_cache(_MAX_FOOTPRINTS)(self._find_footprint)

    def unfit(self, tiles: IntArray | Sequence[int]) -> list[int]:
        """Those of some tiles, indices of squares, that are cut, folded, double or too curved."""
        unfit = []
        for tile in map(int, tiles):
            footprint = self.footprint(tile)
            complete = abs(footprint.cover - 1.0) < _TOLERANCE and footprint.fold < _TOLERANCE
            if not complete or footprint.flatness > self._flatness:
                unfit.append(tile)
        return unfit

    def overlapping(self, tiles: IntArray, known: int = 0) -> list[tuple[int, int]]:
        """Pairs of tiles with overlapping footprints.

        Args:
            tiles: Indices of the squares that are tiles, shape (t,).
            known: Number of first tiles that are known not to overlap each other.

        Returns:
            Pairs of indices of squares, the tile that is earlier in `tiles` first.
        """
        gap = gaps(self._squares, tiles[known:], tiles)
        earlier = np.arange(len(tiles)) < np.arange(known, len(tiles))[:, None]
        later, other = np.nonzero(earlier & (gap < _MAX_GAP * self._squares.edge))
        pairs = zip(tiles[other].tolist(), tiles[known + later].tolist(), strict=True)
        return [pair for pair in pairs if self.shared_area(*pair) > _MAX_SHARED_AREA]

    def _find_footprint(self, tile: int) -> Footprint:
        frame, anchor = self._squares.rotations[tile], self._squares.anchors[tile]
        seen = _cut_to_square(self._seen_around(tile), self._squares.edge)
        crosses = trimesh.triangles.cross(seen)
        areas, projected = 0.5 * np.linalg.norm(crosses, axis=1), 0.5 * crosses[:, 2]
        steep = projected < MIN_FACING * areas
        return Footprint(
            seen @ frame.T + anchor,
            area=float(areas.sum()),
            cover=float(projected[~steep].sum()) / self._squares.edge**2,
            fold=float(areas[steep].sum()) / self._squares.edge**2,
            flatness=float(np.abs(seen[:, :, 2]).max(initial=0.0)),
        )

    def _seen_around(self, tile: int) -> FloatArray:
        """Triangles possibly under a square, in its frame, shape (f, 3, 3) [m]."""
        edge, flatness = self._squares.edge, self._flatness
        frame, anchor = self._squares.rotations[tile], self._squares.anchors[tile]
        reach = np.hypot(edge / np.sqrt(2.0), flatness) + _SMALL_TRIANGLE * edge
        small = self._small[np.array(self._tree.query_ball_point(anchor, reach), dtype=int)]
        near = np.append(small, self._large)
        near = near[self._normals[near] @ frame[:, 2] > FACING_WALL]
        seen = (self._triangles[near] - anchor) @ frame
        height = seen[:, :, 2]
        return seen[(height.min(axis=1) < flatness) & (height.max(axis=1) > -flatness)]

    def shared_area(self, tile: int, other: int) -> float:
        """Area of the surface under both of two squares [m^2].

        Args:
            tile: Index of the square whose footprint is cut.
            other: Index of the square that cuts it.
        """
        squares = self._squares
        frame, anchor = squares.rotations[other], squares.anchors[other]
        seen = self.footprint(tile).triangles @ frame - anchor @ frame
        facing = trimesh.triangles.cross(seen)[:, 2] > 0.0
        close = np.abs(seen[:, :, 2]).min(axis=1) < 2.0 * self._flatness
        seen = _cut_to_square(seen[facing & close], squares.edge)
        return 0.5 * float(np.linalg.norm(trimesh.triangles.cross(seen), axis=1).sum())


def _cut_to_square(triangles: FloatArray, edge: float) -> FloatArray:
    """Triangles clipped to the column over a square, triangulated again."""
    low, high = triangles[:, :, :2].min(axis=1), triangles[:, :, :2].max(axis=1)
    triangles = triangles[((low < 0.5 * edge) & (high > -0.5 * edge)).all(axis=1)]
    inside = (np.abs(triangles[:, :, :2]) <= 0.5 * edge).all(axis=(1, 2))
    vertices = triangles[~inside].reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    for inwards in (*np.eye(3)[:2], *-np.eye(3)[:2]):
        on_side = -0.5 * edge * inwards
        vertices, faces = slice_faces_plane(vertices, faces, inwards, on_side)[:2]
    return np.concatenate([triangles[inside], vertices[faces]])


_END_ANGLE = 10.0  # [deg]; between normal and proximal direction, for a proximal tangent
_SAME_SHEET = 0.3  # [-]; cosine between normals that are averaged
_MIN_COVER = 0.85  # [-]; of a square, within the accuracy of the points' areas
_FLATNESS_MARGIN = 0.95  # [-]; as points miss the farthest corners


@dataclass(frozen=True)
class Surroundings:
    """The surface around tiles, as points, with reference directions in the surface's frame.

    Attributes:
        points: Points spread over the surface.
        rim: Points along the edges of the surface (brim, holes, cuts), shape (b, 3) [m].
        proximal: Unit vector towards the proximal end, shape (3,) [-].
        anterior: Direction of a tile's x axis where no tangent is proximal, shape (3,) [-].
    """

    points: SurfacePoints
    rim: FloatArray
    proximal: FloatArray
    anterior: FloatArray


def rim_points(mesh: trimesh.Trimesh, spacing: float) -> FloatArray:
    """Points along every edge that does not have exactly two faces, shape (b, 3) [m].

    Args:
        mesh: The surface [m].
        spacing: Largest distance between neighbouring points of an edge [m].
    """
    faces_of_edge = np.bincount(mesh.edges_unique_inverse)
    start, end = np.asarray(mesh.vertices)[mesh.edges_unique[faces_of_edge != 2]].swapaxes(0, 1)
    count = np.ceil(np.linalg.norm(end - start, axis=1) / spacing).astype(int).clip(min=1)
    edge = np.repeat(np.arange(len(count)), count)
    step = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    return start[edge] + (step / count[edge])[:, None] * (end - start)[edge]


def squares_at(places: SurfacePoints, surroundings: Surroundings, edge: float) -> Squares:
    """Squares centred on the given places, whether they fit or not.

    In their frames z is the normal, x the tangent towards the proximal end, y = z x x. Where the
    normal is within 10 degrees of the proximal direction, as on the distal end, x is the tangent
    towards anterior instead.

    Args:
        places: Centres of the m squares, with normals of the surface there.
        surroundings: The surface, whose mean normal around a centre is that of its square, and the
            directions towards proximal and anterior.
        edge: Length of the squares' edges [m].
    """
    normals = _mean_normals(places, surroundings.points, edge / np.sqrt(np.pi))
    on_end = np.abs(normals @ surroundings.proximal) > np.cos(np.radians(_END_ANGLE))
    towards = np.where(on_end[:, None], surroundings.anterior, surroundings.proximal)
    x = towards - (towards * normals).sum(axis=1, keepdims=True) * normals
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    rotations = np.stack([x, np.cross(normals, x), normals], axis=2)
    return Squares(places.positions, rotations, edge)


def _mean_normals(places: SurfacePoints, points: SurfacePoints, radius: float) -> FloatArray:
    """Mean normal of the sheet around each place, shape (m, 3) [-]."""
    mean = np.empty_like(places.normals)
    for rows, near in _blocks_of(places.positions, points.positions, radius):
        close = cdist(places.positions[rows], points.positions[near]) <= radius
        same = places.normals[rows] @ points.normals[near].T > _SAME_SHEET
        mean[rows] = np.where(close & same, points.areas[near], 0.0) @ points.normals[near]
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    return np.where(length > 0.0, mean / np.where(length > 0.0, length, 1.0), places.normals)


def roughly_fit(squares: Squares, surroundings: Surroundings, flatness: float) -> BoolArray:
    """Which squares fit the surface, judged by its points, shape (m,).

    A square fits if all of it lies on the surface, without a rim inside, and the surface is close
    to its plane and not folded away from it.

    Args:
        squares: The m squares.
        surroundings: The surface around them.
        flatness: Largest distance of the surface from a square's plane [m].
    """
    points = surroundings.points
    reach = float(np.hypot(squares.edge / np.sqrt(2.0), flatness))
    fits = np.zeros(len(squares), dtype=bool)
    for rows, near in _blocks_of(squares.anchors, points.positions, 1.1 * reach):
        block = squares.take(rows)
        inside, height = points_over(block, points.positions[near], 1.1 * reach)
        facing = block.rotations[:, :, 2] @ points.normals[near].T
        inside &= facing > FACING_WALL
        unfit = inside & ((np.abs(height) > _FLATNESS_MARGIN * flatness) | (facing < MIN_FACING))
        cover = np.where(inside, facing, 0.0) @ points.areas[near]
        fits[rows] = (cover > _MIN_COVER * squares.edge**2) & ~unfit.any(axis=1)
    for rows, near in _blocks_of(squares.anchors, surroundings.rim, reach):
        cut, _ = points_over(squares.take(rows), surroundings.rim[near], reach)
        fits[rows] &= ~cut.any(axis=1)
    return fits
