"""Squares in space and on the surface: overlaps, footprints, and points spread over it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import KDTree

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.socket_design.mesh import cell_keys, number_cells

_SMALL = 1e-12  # in place of a zero that is divided by
REACH = 1.45  # [edges]; squares that overlap have their centres within it
_BLOCK = 0.4  # [-]; size of a block of centres, of the radius around them
OTHER_WALL = -0.2  # [-]; cosine between the normals of squares that are on different walls


@dataclass(frozen=True)
class Squares:
    """Squares of one size on a surface, each with the frame of the tile contract.

    Attributes:
        anchors: Centres, shape (m, 3) [m].
        rotations: Frames, columns x, y along the edges and z the inward normal, (m, 3, 3) [-].
        edge: Length of the edges [m].
    """

    anchors: FloatArray
    rotations: FloatArray
    edge: float

    def __len__(self) -> int:
        return len(self.anchors)

    def take(self, index: IntArray | BoolArray) -> Squares:
        """Some of the squares."""
        return Squares(self.anchors[index], self.rotations[index], self.edge)

    def join(self, other: Squares) -> Squares:
        """These squares, then others of the same size."""
        anchors = np.concatenate([self.anchors, other.anchors])
        return Squares(anchors, np.concatenate([self.rotations, other.rotations]), self.edge)

    def corners(self) -> FloatArray:
        """Corners, counterclockwise about the inward normal, shape (m, 4, 3) [m]."""
        unit = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        around = np.einsum("mij,cj->mci", self.rotations, 0.5 * self.edge * unit)
        return self.anchors[:, None] + around


def gaps(squares: Squares, some: IntArray, others: IntArray) -> FloatArray:
    """Gaps between squares and others on a smooth surface, negative where they overlap.

    Both of a pair are turned into the plane halfway between their own, where the separating-axis
    test of two squares is exact: on a circular wall two squares touch when the chord between
    their centres is one edge, as their footprints on the wall do. The gap is the largest
    distance along any of the four axes; it is infinite between different walls.

    Args:
        squares: The squares.
        some: Indices of the squares, shape (m,).
        others: Indices of the others, shape (p,).

    Returns:
        Gaps, shape (m, p) [m].
    """
    one, other = squares.take(some), squares.take(others)
    x, z = one.rotations[:, :, 0], one.rotations[:, :, 2]
    x_other, z_other = other.rotations[:, :, 0], other.rotations[:, :, 2]
    offset_x, offset_y, offset_z = seen_from(one, other.anchors)
    offset_x_other = (x_other * other.anchors).sum(axis=1) - one.anchors @ x_other.T
    offset_z_other = (z_other * other.anchors).sum(axis=1) - one.anchors @ z_other.T

    # The normal of the plane halfway is along z + z_other, of this length squared:
    cosine = z @ z_other.T
    length2 = np.maximum(2.0 + 2.0 * cosine, _SMALL)
    out_of_plane = (offset_z + offset_z_other) / length2
    in_plane2 = offset_x**2 + offset_y**2 + offset_z**2 - out_of_plane**2 * length2
    x_out, x_other_out = x @ z_other.T, z @ x_other.T
    scale, scale_other = (
        1.0 / np.sqrt(np.maximum(1.0 - out**2 / length2, _SMALL)) for out in (x_out, x_other_out)
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
    """For each of some squares, all that it overlaps, itself included.

    Args:
        squares: The squares.
        some: Indices of some of them.
        clearance: Gap below which two count as overlapping [m].
    """
    found = [np.zeros(0, dtype=np.int64)] * len(some)
    for rows, near in blocks_of(squares.anchors[some], squares.anchors, REACH * squares.edge):
        for row, overlap in zip(rows, gaps(squares, some[rows], near) < clearance, strict=True):
            found[row] = near[overlap]
    return found


def seen_from(squares: Squares, points: FloatArray) -> FloatArray:
    """Coordinates of p points in the frames of m squares, shape (3, m, p) [m]."""
    axes = np.moveaxis(squares.rotations, 2, 0)
    return axes @ points.T - (axes * squares.anchors).sum(axis=2)[:, :, None]


def blocks_of(
    centres: FloatArray, points: FloatArray, radius: float
) -> Iterator[tuple[IntArray, IntArray]]:
    """Blocks of centres that are close to each other, each with the points near any of them.

    Args:
        centres: Shape (m, 3) [m].
        points: Shape (p, 3) [m].
        radius: How far from a centre points are near [m].

    Yields:
        The indices of the centres, and those of all points within the radius, and of some others.
    """
    if not len(points) or not len(centres):
        return
    tree = KDTree(points)
    block = number_cells(centres, _BLOCK * radius)
    order = np.argsort(block, kind="stable")
    first = np.flatnonzero(np.diff(block[order], prepend=-1))
    sorted_centres = centres[order]
    middles = np.add.reduceat(sorted_centres, first) / np.diff(first, append=len(order))[:, None]
    off = np.linalg.norm(sorted_centres - middles[block[order]], axis=1)
    reach = radius + np.maximum.reduceat(off, first)
    for rows, *ball in zip(np.split(order, first[1:]), middles, reach, strict=True):
        near = tree.query_ball_point(*ball)
        if near:
            yield rows, np.array(near)


_DRAWN = 4.0  # random points for each that is kept
_CLOSEST = 0.6  # [-]; smallest distance of two points, in spacings


@dataclass(frozen=True)
class SurfacePoints:
    """Points of a surface that stand for the area around them.

    Attributes:
        positions: Positions, shape (p, 3) [m].
        normals: Normals of the faces that they are on, shape (p, 3) [-].
        areas: Area that each stands for, shape (p,) [m^2].
    """

    positions: FloatArray
    normals: FloatArray
    areas: FloatArray


def spread_points(
    mesh: trimesh.Trimesh, spacing: float, rng: np.random.Generator, weighed: bool = True
) -> SurfacePoints:
    """Spread points over a surface: about one in each square of the spacing.

    Args:
        mesh: The surface [m].
        spacing: About the distance of neighbouring points [m].
        rng: Source of the positions.
        weighed: Whether the areas are needed; else they are 0.
    """
    count = int(np.ceil(_DRAWN * mesh.area / spacing**2))
    drawn, face = trimesh.sample.sample_surface(mesh, count, seed=rng)
    kept = _one_a_cell(drawn, spacing)
    kept = kept[trimesh.points.remove_close(drawn[kept], _CLOSEST * spacing)[1]]
    nearest = KDTree(drawn[kept]).query(drawn)[1] if weighed else np.zeros(0, dtype=np.int64)
    return SurfacePoints(
        positions=drawn[kept],
        normals=np.asarray(mesh.face_normals)[face[kept]],
        areas=np.bincount(nearest, minlength=len(kept)) * (mesh.area / count),
    )


def _one_a_cell(points: FloatArray, spacing: float) -> IntArray:
    """Of the points in each cell of a cubic grid, the one closest to the cell's centre."""
    cell = np.floor(points / spacing)
    off = ((points - (cell + 0.5) * spacing) ** 2).sum(axis=1)
    key = cell_keys(points, spacing)
    order = np.lexsort((off, key))
    first = np.concatenate([[True], np.diff(key[order]) > 0])
    return order[first]
