"""The piece of the surface under a square, cut out exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import KDTree
from trimesh.intersections import slice_faces_plane

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.tiling.candidates import FACING_WALL, LEAST_FACING
from socket_testbed.tiling.squares import Squares

_SMALL = 0.1  # [edges]; triangles larger than it are looked at for every square


@dataclass(frozen=True)
class Footprint:
    """A piece of the surface: what projects onto a square along its normal.

    Attributes:
        vertices: Vertices, shape (v, 3) [m].
        faces: Triangles, shape (f, 3).
        area: Area of the surface [m^2].
        cover: Part of the square that it covers; 1 for a whole one, more where it is double [-].
        fold: Area that is folded away from the square, in areas of the square [-].
        flatness: Largest distance from the square's plane [m].
    """

    vertices: FloatArray
    faces: IntArray
    area: float
    cover: float
    fold: float
    flatness: float


class FootprintCutter:
    """Cuts footprints out of a surface.

    Args:
        mesh: The surface, its normals inwards [m].
        squares: The squares.
        flatness: How far from a square's plane the surface under it is looked for [m].
    """

    def __init__(self, mesh: trimesh.Trimesh, squares: Squares, flatness: float) -> None:
        self._vertices = np.asarray(mesh.vertices)
        self._faces = np.asarray(mesh.faces)
        self._normals = np.asarray(mesh.face_normals)
        centres = np.asarray(mesh.triangles_center)
        spread = np.asarray(mesh.triangles) - centres[:, None]
        radii = np.linalg.norm(spread, axis=2).max(axis=1)
        self._large = np.flatnonzero(radii > _SMALL * squares.edge)
        self._tree = KDTree(centres)
        self._squares = squares
        self._flatness = flatness

    def footprint(self, index: int) -> Footprint:
        """The footprint of a square."""
        squares = self._squares
        frame, anchor = squares.rotations[index], squares.anchors[index]
        reach = np.hypot(squares.edge / np.sqrt(2.0), self._flatness)
        reach += _SMALL * squares.edge
        near = np.union1d(self._tree.query_ball_point(anchor, reach), self._large).astype(np.int64)
        faces = self._faces[near[self._normals[near] @ frame[:, 2] > FACING_WALL]]
        height = (self._vertices[faces] - anchor) @ frame[:, 2]
        in_band = (height.min(axis=1) < self._flatness) & (height.max(axis=1) > -self._flatness)
        vertices, faces = self._cut(self._vertices, faces[in_band], index)
        height = (vertices - anchor) @ frame[:, 2]
        doubled = _doubled_areas(vertices, faces)
        areas, projected = 0.5 * np.linalg.norm(doubled, axis=1), 0.5 * doubled @ frame[:, 2]
        steep = projected < LEAST_FACING * areas
        return Footprint(
            vertices,
            faces,
            area=float(areas.sum()),
            cover=float(projected[~steep].sum()) / squares.edge**2,
            fold=float(areas[steep].sum()) / squares.edge**2,
            flatness=float(np.abs(height[faces]).max(initial=0.0)),
        )

    def shared_area(self, footprint: Footprint, other: int) -> float:
        """Area of a footprint that lies under another square, too [m^2]."""
        frame, anchor = self._squares.rotations[other], self._squares.anchors[other]
        faces = footprint.faces
        facing = _doubled_areas(footprint.vertices, faces) @ frame[:, 2] > 0.0
        height = np.abs((footprint.vertices[faces] - anchor) @ frame[:, 2]).min(axis=1)
        reached = faces[facing & (height < 2.0 * self._flatness)]
        vertices, faces = self._cut(footprint.vertices, reached, other)
        return 0.5 * float(np.linalg.norm(_doubled_areas(vertices, faces), axis=1).sum())

    def _cut(
        self, vertices: FloatArray, faces: IntArray, index: int
    ) -> tuple[FloatArray, IntArray]:
        """Triangles cut to the column over a square."""
        anchor, half = self._squares.anchors[index], 0.5 * self._squares.edge
        for axis in self._squares.rotations[index].T[:2]:
            for outward in (axis, -axis):
                if not len(faces):
                    return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
                used, faces = np.unique(faces, return_inverse=True)
                vertices, faces = vertices[used], faces.reshape(-1, 3)
                vertices, faces, _ = slice_faces_plane(
                    vertices, faces, -outward, anchor + half * outward
                )
        return vertices, faces


def _doubled_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Normals of triangles, twice their area long, shape (f, 3) [m^2]."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    return np.cross(b - a, c - a)
