"""The interior surface as it is drawn: checked, and simplified where it has too many faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.errors import ScanError

_LARGEST_SURFACE = 2.0  # [m]; what is larger is in another unit
_GROWTH = 1.1  # [-]; of the cells, from one attempt to the next
_SMALLEST_CELL = 1e-5  # [-]; of the surface's size, so that a cell's number is an int64
_FACES_A_CELL = 2.0  # [-]; of a triangulation


@dataclass(frozen=True)
class Surface:
    """A triangulated surface.

    Attributes:
        vertices: Vertices in {S}, shape (v, 3) [m].
        faces: Indices of each face's vertices, shape (f, 3).
    """

    vertices: FloatArray
    faces: IntArray

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest coordinates of the faces, shape (3,) each [m]."""
        used = self.vertices[self.faces.ravel()]
        return used.min(axis=0), used.max(axis=0)

    def normals(self) -> FloatArray:
        """Unit normals of the faces by their winding, shape (f, 3) [-]; 0 without an area."""
        normals = _doubled_area_vectors(self)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)

    def area(self) -> float:
        """Area of all faces [m^2]."""
        return 0.5 * float(np.linalg.norm(_doubled_area_vectors(self), axis=1).sum())


def drawable_surface(vertices: FloatArray, faces: IntArray, most_faces: int) -> Surface:
    """A surface that can be drawn: checked, and of no more faces than a drawing can hold.

    Args:
        vertices: Vertices in {S}, shape (v, 3) [m].
        faces: Indices of each face's vertices, shape (f, 3).
        most_faces: Largest number of faces of the result.

    Raises:
        ScanError: If this is no surface, or not in metres.
    """
    surface = Surface(np.asarray(vertices, dtype=float), np.asarray(faces))
    _check(surface)
    return simplify(surface, most_faces)


def simplify(surface: Surface, most_faces: int) -> Surface:
    """Merge the vertices in each cell of a cubic grid, in cells that grow until it suffices.

    Vertex clustering (Rossignac and Borrel 1993, doi:10.1007/978-3-642-78114-8_29), with the
    mean of a cell's vertices, or of those on the rim, for all of them. It needs no manifold,
    so it takes any scan.

    Args:
        surface: Any surface.
        most_faces: Largest number of faces of the result.

    Raises:
        ScanError: If its faces have so little in common that none is left.
    """
    cell = max(
        np.sqrt(_FACES_A_CELL * surface.area() / most_faces),
        _SMALLEST_CELL * float(np.ptp(surface.vertices, axis=0).max()),
    )
    rim = _rim(surface)
    simplified = surface
    while len(simplified.faces) > most_faces:
        simplified = _merge_within_cells(surface, rim, cell)
        cell *= _GROWTH
    if not len(simplified.faces):
        raise ScanError("the surface's faces do not hang together", "repair the scan")
    return simplified


def _merge_within_cells(surface: Surface, rim: BoolArray, cell: float) -> Surface:
    place = ((surface.vertices - surface.vertices.min(axis=0)) / cell).astype(np.int64)
    key = np.ravel_multi_index(tuple(place.T), tuple(place.max(axis=0) + 1))
    _, cell_of_vertex = np.unique(key, return_inverse=True)
    # The rest of a cell at the rim would draw the rim inwards, here more and there less.
    weight = np.where(np.bincount(cell_of_vertex, rim)[cell_of_vertex] > 0, rim, 1.0)
    sums = [np.bincount(cell_of_vertex, weight * axis) for axis in surface.vertices.T]
    faces = cell_of_vertex[surface.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    mean = np.column_stack(sums) / np.bincount(cell_of_vertex, weight)[:, None]
    return Surface(mean, faces[np.sort(first)])


def _rim(surface: Surface) -> BoolArray:
    """Which vertices are on an edge of a single face, shape (v,)."""
    edges = np.sort(surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    count = len(surface.vertices)
    edge, faces_at_edge = np.unique(edges @ [count, 1], return_counts=True)
    rim = np.zeros(count, dtype=bool)
    rim[np.concatenate(np.divmod(edge[faces_at_edge == 1], count))] = True
    return rim


def _doubled_area_vectors(surface: Surface) -> FloatArray:
    a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
    return np.cross(b - a, c - a)


def _check(surface: Surface) -> None:
    vertices, faces = surface.vertices, surface.faces
    for what, array in (("vertices", vertices), ("faces", faces)):
        if array.ndim != 2 or array.shape[1] != 3 or not len(array):
            raise ScanError(
                f"the surface's {what} have the shape {array.shape}", "give one row of three each"
            )
    if not np.issubdtype(faces.dtype, np.integer):
        raise ScanError("the surface's faces are no whole numbers", "give indices of vertices")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ScanError(
            f"a face of the surface has a vertex that is none of the {len(vertices)}",
            "give indices of vertices, from 0",
        )
    if not np.isfinite(vertices).all():
        raise ScanError("a vertex of the surface is not finite", "repair the scan")
    size = float(np.ptp(vertices, axis=0).max())
    if not 0.0 < size <= _LARGEST_SURFACE:
        raise ScanError(f"the surface is {size:g} m long", "give its vertices in m")
