"""A triangle mesh with what its classification needs: normals, areas, points on every face."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.scans.topology import Edges, match_edges


@dataclass(frozen=True)
class Surface:
    """Triangles in the scan's axes.

    Attributes:
        vertices: Shape (V, 3) [m].
        faces: Shape (F, 3), wound consistently.
    """

    vertices: FloatArray
    faces: IntArray

    @cached_property
    def edges(self) -> Edges:
        """Which faces share an edge."""
        return match_edges(self.faces)

    @cached_property
    def centres(self) -> FloatArray:
        """Centres of the faces, shape (F, 3) [m]."""
        return self.vertices[self.faces].mean(axis=1)

    @cached_property
    def area_vectors(self) -> FloatArray:
        """Normals times areas, shape (F, 3) [m^2]."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return 0.5 * np.cross(b - a, c - a)

    @cached_property
    def areas(self) -> FloatArray:
        """Areas of the faces, shape (F,) [m^2]."""
        return lengths(self.area_vectors)

    @cached_property
    def normals(self) -> FloatArray:
        """Unit normals, shape (F, 3); zero for a face without area."""
        return self.area_vectors / np.fmax(self.areas, np.finfo(float).tiny)[:, None]

    @property
    def is_watertight(self) -> bool:
        """Whether every edge is shared by exactly two faces."""
        return not len(self.edges.boundary) and not len(self.edges.crowded)

    @cached_property
    def volume(self) -> float:
        """Volume within, positive if the normals point out; of a watertight mesh only [m^3]."""
        return float(np.einsum("ij,ij->", self.centres - self.centres[0], self.area_vectors)) / 3.0

    def flipped(self) -> Surface:
        """The same surface with its normals turned round."""
        return Surface(self.vertices, self.faces[:, ::-1])

    def subset(self, keep: BoolArray) -> Surface:
        """The faces of a mask, on the same vertices."""
        return Surface(self.vertices, self.faces[keep])


def dots(a: FloatArray, b: FloatArray) -> FloatArray:
    """Inner products of N pairs of vectors, shape (N,)."""
    return np.einsum("ij,ij->i", a, b)


def lengths(vectors: FloatArray) -> FloatArray:
    """Lengths of N vectors, shape (N,)."""
    return np.sqrt(dots(vectors, vectors))


def sample_surface(surface: Surface, spacing: float) -> tuple[IntArray, FloatArray]:
    """Points spread over every face, no farther apart than about the spacing.

    A face is cut into k^2 equal triangles, of which the centres are taken.

    Args:
        surface: The surface.
        spacing: Longest edge of a small triangle [m].

    Returns:
        The face of each point, shape (P,), and the points, shape (P, 3) [m].
    """
    corners = surface.vertices[surface.faces]
    longest = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    cuts = np.fmax(np.ceil(longest / spacing), 1).astype(np.int64)
    owners, points = [], []
    for count in np.unique(cuts):
        faces = np.flatnonzero(cuts == count)
        weights = _centres_of_parts(int(count))
        owners.append(np.repeat(faces, len(weights)))
        points.append((weights @ corners[faces]).reshape(-1, 3))
    return np.concatenate(owners), np.concatenate(points)


def _centres_of_parts(count: int) -> FloatArray:
    """Barycentric coordinates of the centres of count^2 equal parts, shape (count^2, 3)."""
    i, j = np.mgrid[:count, :count].reshape(2, -1)
    upright, turned = i + j < count, i + j < count - 1
    two = np.vstack(
        [
            np.column_stack([i[upright], j[upright]]) + 1.0 / 3.0,
            np.column_stack([i[turned], j[turned]]) + 2.0 / 3.0,
        ]
    )
    return np.column_stack([count - two.sum(axis=1), two]) / count
