"""Points spread evenly over a triangulated surface, whatever its triangles are like."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import KDTree

from socket_testbed.arrays import FloatArray, IntArray

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


def spread_points(mesh: trimesh.Trimesh, spacing: float, rng: np.random.Generator) -> SurfacePoints:
    """Spread points over a surface: about one in each square of the spacing.

    Args:
        mesh: The surface [m].
        spacing: About the distance of neighbouring points [m].
        rng: Source of the positions.
    """
    count = int(np.ceil(_DRAWN * mesh.area / spacing**2))
    drawn, face = _draw(mesh, count, rng)
    kept = _one_a_cell(drawn, spacing)
    kept = kept[_apart(drawn[kept], _CLOSEST * spacing)]
    nearest = KDTree(drawn[kept]).query(drawn)[1]
    return SurfacePoints(
        positions=drawn[kept],
        normals=np.asarray(mesh.face_normals)[face[kept]],
        areas=np.bincount(nearest, minlength=len(kept)) * (mesh.area / count),
    )


def _draw(
    mesh: trimesh.Trimesh, count: int, rng: np.random.Generator
) -> tuple[FloatArray, IntArray]:
    """Random points, uniform in the area, and the faces that they are on."""
    until = np.cumsum(mesh.area_faces)
    face = np.searchsorted(until, rng.uniform(0.0, until[-1], count)).clip(max=len(until) - 1)
    a, b = rng.random((2, count, 1))
    outside = a + b > 1.0  # in the other half of the parallelogram: mirrored back
    a, b = np.where(outside, 1.0 - a, a), np.where(outside, 1.0 - b, b)
    corner = np.asarray(mesh.triangles)[face]
    points = corner[:, 0] + a * (corner[:, 1] - corner[:, 0]) + b * (corner[:, 2] - corner[:, 0])
    return points, face


def _one_a_cell(points: FloatArray, spacing: float) -> IntArray:
    """Of the points in each cell of a cubic grid, the one closest to the cell's centre."""
    cell = np.floor(points / spacing)
    off = ((points - (cell + 0.5) * spacing) ** 2).sum(axis=1)
    index = np.unique(cell, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.lexsort((off, index))
    first = np.concatenate([[True], np.diff(index[order]) > 0])
    return order[first]


def _apart(points: FloatArray, distance: float) -> IntArray:
    """Indices of points of which no two are closer than a distance."""
    dropped = np.zeros(len(points), dtype=bool)
    for a, b in KDTree(points).query_pairs(distance, output_type="ndarray"):
        if not dropped[a]:
            dropped[b] = True
    return np.flatnonzero(~dropped)
