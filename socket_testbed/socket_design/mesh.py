"""Triangle meshes: how triangles hang together, and repairs that trimesh does not make.

A half-edge ``h = 3 f + i`` of face f runs from its corner i to its corner i + 1; corner ``h`` is
where it starts. It is row h of `trimesh.Trimesh.edges`.
"""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from trimesh.geometry import faces_to_edges
from trimesh.graph import connected_component_labels
from trimesh.grouping import group_rows

from socket_testbed.arrays import BoolArray, FloatArray, IntArray


def plain_mesh(vertices: FloatArray, faces: IntArray) -> trimesh.Trimesh:
    """A mesh of exactly these vertices, shape (V, 3), and faces, shape (F, 3)."""
    return trimesh.Trimesh(vertices, faces, process=False)


def twin_half_edges(faces: IntArray) -> IntArray:
    """Pairs of half-edges whose edge exactly two faces share, shape (A, 2).

    Args:
        faces: Vertices of the triangles, shape (F, 3).
    """
    return group_rows(np.sort(faces_to_edges(faces), axis=1), require_count=2)


def boundary_half_edges(faces: IntArray) -> IntArray:
    """Half-edges whose edge is in one face only, shape (B,).

    Args:
        faces: Vertices of the triangles, shape (F, 3).
    """
    return np.sort(group_rows(np.sort(faces_to_edges(faces), axis=1), require_count=1))


def separate(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Cut a mesh wherever it is not a plain surface, and drop the vertices that no face uses.

    Faces stay joined across edges that exactly two of them share. Where more meet in an edge,
    or where two fans of faces meet in a vertex alone, each gets vertices of its own; so every
    boundary vertex is on one boundary loop, once.

    Args:
        vertices: Shape (V, 3).
        faces: Shape (F, 3).

    Returns:
        The new vertices and faces; the order of the faces stays.
    """
    start = faces.ravel()
    one, other = twin_half_edges(faces).T
    same_way = start[one] == start[other]
    one_stop, other_stop = next_half_edge(one), next_half_edge(other)
    joined = np.vstack(
        [
            np.column_stack([one, np.where(same_way, other, other_stop)]),
            np.column_stack([one_stop, np.where(same_way, other_stop, other)]),
        ]
    )
    label = connected_component_labels(joined, node_count=len(start))
    _, first = np.unique(label, return_index=True)
    return vertices[start[first]], label.reshape(-1, 3).astype(np.int64)


def wind_alike(faces: IntArray) -> tuple[IntArray, int, BoolArray]:
    """Reverse faces so that neighbours wind the same way, as few as possible per piece.

    The faces are nodes twice, as they are and reversed; pairs that fit are joined. In an
    orientable piece the two sets stay apart.

    Args:
        faces: Shape (F, 3).

    Returns:
        The faces; how many were reversed; which of them no winding fits, as their piece is
        one-sided, shape (F,).
    """
    count = len(faces)
    one, other = twin_half_edges(faces).T
    differ = (faces.ravel()[one] == faces.ravel()[other]) * count
    a, b = one // 3, other // 3
    pairs = np.vstack(
        [np.column_stack([a, b + differ]), np.column_stack([a + count, b + count - differ])]
    )
    label = connected_component_labels(pairs, node_count=2 * count)
    as_is, reverse = label[:count], label[count:]
    # The side that holds more faces as they are is kept.
    votes = np.bincount(as_is, minlength=label.max(initial=-1) + 1)
    flip = votes[as_is] < votes[reverse]
    flip |= (votes[as_is] == votes[reverse]) & (as_is > reverse)
    return np.where(flip[:, None], faces[:, ::-1], faces), int(flip.sum()), as_is == reverse


def boundary_loops(faces: IntArray) -> list[IntArray]:
    """Boundary loops of a mesh that `separate` has left, each in the order of its half-edges.

    Args:
        faces: Shape (F, 3), wound consistently.

    Returns:
        The vertices of each loop, each vertex once.
    """
    boundary = boundary_half_edges(faces)
    start, stop = faces.ravel()[boundary], faces.ravel()[next_half_edge(boundary)]
    follows = dict(zip(start.tolist(), stop.tolist(), strict=True))
    loops = []
    while follows:
        vertex, after = follows.popitem()
        loop = [vertex]
        while after != loop[0]:
            loop.append(after)
            after = follows.pop(after)
        loops.append(np.array(loop))
    return loops


def loop_length(vertices: FloatArray, loop: IntArray) -> float:
    """How long a loop of vertices is around [m]."""
    steps = vertices[np.roll(loop, -1)] - vertices[loop]
    return float(np.linalg.norm(steps, axis=1).sum())


def next_half_edge(half_edges: IntArray) -> IntArray:
    """The half-edges that follow in the same faces."""
    return half_edges - half_edges % 3 + (half_edges + 1) % 3


def number_cells(points: FloatArray, size: float) -> IntArray:
    """Number the cells of a cubic grid that hold points, by x, then y, then z.

    Args:
        points: Shape (P, 3) [m].
        size: Edge of a cell [m].

    Returns:
        The number of the cell of each point, shape (P,).
    """
    return np.unique(cell_keys(points, size), return_inverse=True)[1]


def cell_keys(points: FloatArray, size: float) -> IntArray:
    """A number of its own for each cell of a cubic grid, rising by x, then y, then z.

    Args:
        points: Shape (P, 3) [m].
        size: Edge of a cell [m].

    Returns:
        The number of the cell of each point, shape (P,).
    """
    cell = np.floor(points / size).astype(np.int64)
    x, y, z = (cell - cell.min(axis=0)).T
    return (x * (y.max() + 1) + y) * (z.max() + 1) + z


_SAME_PLACE = 1e-6  # [-]; of the size of the mesh


def weld(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Make one vertex of all in the same place, to a millionth of the size of the mesh.

    Args:
        vertices: Shape (V, 3), finite where a face uses them.
        faces: Shape (F, 3).

    Returns:
        The vertices that the faces use, and the faces.
    """
    used, corners = np.unique(faces, return_inverse=True)
    places = vertices[used]
    low = places.min(axis=0)
    cell = max(_SAME_PLACE * float((places.max(axis=0) - low).max()), np.finfo(float).tiny)
    x, y, z = np.round((places - low) / cell).astype(np.int64).T  # 21 bits each at most
    _, first, cubes = np.unique((x << 42) | (y << 21) | z, return_index=True, return_inverse=True)
    # Neighbours on the two sides of a cell's face are left.
    close = cKDTree(places[first]).query_pairs(cell, output_type="ndarray")
    label = connected_component_labels(close, node_count=len(first))
    _, welded = np.unique(label, return_index=True)
    return places[first[welded]], label[cubes[corners]].reshape(-1, 3).astype(np.int64)


def fill_holes(
    vertices: FloatArray, faces: IntArray, longest: float
) -> tuple[FloatArray, IntArray, list[float], list[float]]:
    """Close small holes by a fan around their middle.

    Args:
        vertices: Shape (V, 3) [m].
        faces: Shape (F, 3), as `separate` leaves them, wound alike.
        longest: Holes at least this long around stay open [m].

    Returns:
        The vertices; the faces; how long the closed holes were around; how long the open
        ones are [m].
    """
    new_vertices, new_faces = [vertices], [faces]
    closed, left = [], []
    count = len(vertices)
    for loop in boundary_loops(faces):
        around = loop_length(vertices, loop)
        if around >= longest:
            left.append(around)
            continue
        closed.append(around)
        if len(loop) == 3:
            new_faces.append(loop[None, ::-1])
            continue
        new_vertices.append(vertices[loop].mean(axis=0, keepdims=True))
        new_faces.append(np.column_stack([np.roll(loop, -1), loop, np.full(len(loop), count)]))
        count += 1
    return np.vstack(new_vertices), np.vstack(new_faces), closed, left
