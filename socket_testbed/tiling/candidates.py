"""Where a tile could be: its frame at every place of the surface, and whether it fits there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy import sparse
from scipy.spatial import KDTree

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.tiling.squares import Squares
from socket_testbed.tiling.surface_points import SurfacePoints

FACING_WALL = -0.5  # [-]; cosine below which a surface is the wall on the other side
LEAST_FACING = 0.5  # [-]; cosine to a tile's normal below which a surface is folded away
_END = 10.0  # [deg]; a normal this close to the proximal direction has no proximal tangent
_SAME_SHEET = 0.3  # [-]; cosine between normals that are averaged
_LEAST_COVER = 0.85  # [-]; coverage of a square, as far as the points' areas can tell
_SAFE = 0.95  # [-]; the points miss the farthest corners
_BATCH = 2000


@dataclass(frozen=True)
class Surroundings:
    """What the tiles of a surface are fitted to.

    Attributes:
        points: Points spread over the surface.
        rim: Points along the edges of the surface (brim, holes, cuts), shape (b, 3) [m].
        proximal: Direction towards the proximal end, shape (3,) [-].
        anterior: Direction of x where no tangent is proximal, shape (3,) [-].
    """

    points: SurfacePoints
    rim: FloatArray
    proximal: FloatArray
    anterior: FloatArray


def rim_points(mesh: trimesh.Trimesh, spacing: float) -> FloatArray:
    """Points along every edge that has one face only or more than two, shape (b, 3) [m]."""
    faces_of_edge = np.bincount(mesh.edges_unique_inverse, minlength=len(mesh.edges_unique))
    start, end = np.asarray(mesh.vertices)[mesh.edges_unique[faces_of_edge != 2]].swapaxes(0, 1)
    count = np.ceil(np.linalg.norm(end - start, axis=1) / spacing).astype(int).clip(min=1)
    edge = np.repeat(np.arange(len(count)), count)
    step = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    return start[edge] + (step / count[edge])[:, None] * (end - start)[edge]


def fitting_squares(
    places: SurfacePoints, surroundings: Surroundings, edge: float, flatness: float
) -> Squares:
    """The squares that fit the surface, of all that are centred on the given places.

    A square fits if the whole of it lies on the surface: no rim inside, the surface nowhere
    farther from its plane than the flatness, nor folded away from it.

    Args:
        places: Centres to try.
        surroundings: The surface.
        edge: Length of the squares' edges [m].
        flatness: Largest distance of the surface from a tile's plane [m].
    """
    normals = _mean_normals(places, surroundings.points, edge / np.sqrt(np.pi))
    squares = Squares(places.positions, tile_frames(normals, surroundings), edge)
    if not len(squares):
        return squares
    return squares.take(_fits(squares, surroundings, flatness))


def tile_frames(normals: FloatArray, surroundings: Surroundings) -> FloatArray:
    """Frames of tiles: z the normal, x the tangent towards the proximal end, y = z x x.

    Where the normal is within 10 degrees of the proximal direction, as on the distal end, no
    tangent is proximal: there x is the tangent towards anterior.

    Args:
        normals: Inward normals, shape (m, 3) [-].
        surroundings: The directions.

    Returns:
        Frames, columns x, y, z, shape (m, 3, 3) [-].
    """
    on_end = np.abs(normals @ surroundings.proximal) > np.cos(np.radians(_END))
    towards = np.where(on_end[:, None], surroundings.anterior, surroundings.proximal)
    x = towards - np.einsum("mi,mi->m", towards, normals)[:, None] * normals
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(normals, x), normals], axis=2)


def _mean_normals(places: SurfacePoints, points: SurfacePoints, radius: float) -> FloatArray:
    """Mean normal of the sheet around each place, shape (m, 3) [-]."""
    mean = np.empty_like(places.normals)
    for rows, owner, near in _around(places.positions, points.positions, radius):
        same = np.einsum("pi,pi->p", points.normals[near], places.normals[rows][owner])
        weight = points.areas[near] * (same > _SAME_SHEET)
        shape = (rows.stop - rows.start, len(points.positions))
        mean[rows] = sparse.csr_matrix((weight, (owner, near)), shape=shape) @ points.normals
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    return np.where(length > 0.0, mean / np.where(length > 0.0, length, 1.0), places.normals)


def _fits(squares: Squares, surroundings: Surroundings, flatness: float) -> BoolArray:
    points, half = surroundings.points, 0.5 * squares.edge
    reach = float(np.hypot(np.sqrt(2.0) * half, flatness))
    fits = np.zeros(len(squares), dtype=bool)
    for rows, owner, near in _around(squares.anchors, points.positions, 1.1 * reach):
        frames = squares.rotations[rows][owner]
        offset = points.positions[near] - squares.anchors[rows][owner]
        x, y, height = np.einsum("pi,pij->jp", offset, frames)
        facing = np.einsum("pi,pi->p", points.normals[near], frames[:, :, 2])
        inside = (np.abs(x) < half) & (np.abs(y) < half) & (facing > FACING_WALL)
        unfit = inside & ((np.abs(height) > _SAFE * flatness) | (facing < LEAST_FACING))
        count = rows.stop - rows.start
        cover = np.bincount(owner, points.areas[near] * facing * inside, minlength=count)
        fits[rows] = cover > _LEAST_COVER * squares.edge**2
        fits[np.arange(rows.start, rows.stop)[np.unique(owner[unfit])]] = False
    for rows, owner, near in _around(squares.anchors, surroundings.rim, reach):
        offset = surroundings.rim[near] - squares.anchors[rows][owner]
        x, y, _ = np.einsum("pi,pij->jp", offset, squares.rotations[rows][owner])
        cut = (np.abs(x) < half) & (np.abs(y) < half)
        fits[np.arange(rows.start, rows.stop)[np.unique(owner[cut])]] = False
    return fits


def _around(
    centres: FloatArray, points: FloatArray, radius: float
) -> Iterator[tuple[slice, IntArray, IntArray]]:
    """Points within a radius of each centre, batch by batch.

    Yields:
        The centres of the batch, and for each pair of a centre and a point near it the
        centre's index in the batch and the point's index.
    """
    if not len(points):
        return
    tree = KDTree(points)
    for start in range(0, len(centres), _BATCH):
        rows = slice(start, min(start + _BATCH, len(centres)))
        near = tree.query_ball_point(centres[rows], radius)
        count = np.fromiter(map(len, near), dtype=np.int64, count=len(near))
        yield rows, np.repeat(np.arange(len(near)), count), np.concatenate(near).astype(np.int64)
