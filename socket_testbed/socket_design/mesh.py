"""Triangle meshes: how triangles hang together, and repairs that trimesh does not make.

A half-edge ``h = 3 f + i`` of face f runs from its corner i to its corner i + 1; corner ``h`` is
where it starts. It is row h of `trimesh.Trimesh.edges`.

Throughout, vertices have the shape (V, 3) [m], faces (F, 3).
"""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from trimesh.geometry import faces_to_edges
from trimesh.graph import connected_component_labels
from trimesh.grouping import group_rows, unique_rows

from socket_testbed.arrays import FloatArray, IntArray


def plain_mesh(vertices: FloatArray, faces: IntArray) -> trimesh.Trimesh:
    """A mesh of exactly these vertices, shape (V, 3), and faces, shape (F, 3)."""
    return trimesh.Trimesh(vertices, faces, process=False)


def twin_half_edges(faces: IntArray) -> IntArray:
    """Pairs of half-edges whose edge exactly two faces share, shape (A, 2)."""
    return group_rows(np.sort(faces_to_edges(faces), axis=1), require_count=2)


def boundary_half_edges(faces: IntArray) -> IntArray:
    """Half-edges whose edge is in one face only, shape (B,)."""
    return np.sort(group_rows(np.sort(faces_to_edges(faces), axis=1), require_count=1))


def separate(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Cut a mesh wherever it is not a plain surface, and drop the vertices that no face uses.

    Faces stay joined across edges that exactly two of them share. Where more meet in an edge,
    or where two fans of faces meet in a vertex alone, each gets vertices of its own; so every
    boundary vertex is on one boundary loop, once.

    Returns:
        The new vertices and faces; the order of the faces stays.
    """
    start = faces.ravel()
    one, other = twin_half_edges(faces).T
    same_way = start[one] == start[other]
    one_stop, other_stop = _next_half_edge(one), _next_half_edge(other)
    joined = np.vstack(
        [
            np.column_stack([one, np.where(same_way, other, other_stop)]),
            np.column_stack([one_stop, np.where(same_way, other_stop, other)]),
        ]
    )
    label = connected_component_labels(joined, node_count=len(start))
    _, first = np.unique(label, return_index=True)
    return vertices[start[first]], label.reshape(-1, 3).astype(np.int64)


def wind_alike(faces: IntArray) -> tuple[IntArray, int]:
    """Reverse faces so that neighbours wind the same way, as few as possible per piece.

    The faces are nodes twice, as they are and reversed; pairs that fit are joined. In an
    orientable piece the two sets stay apart.

    Returns:
        The faces, and how many were reversed.
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
    return np.where(flip[:, None], faces[:, ::-1], faces), int(flip.sum())


def boundary_loops(faces: IntArray) -> list[IntArray]:
    """Boundary loops of a mesh that `separate` has left, each in the order of its half-edges.

    Returns:
        The vertices of each loop, each vertex once.
    """
    boundary = boundary_half_edges(faces)
    start, stop = faces.ravel()[boundary], faces.ravel()[_next_half_edge(boundary)]
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


def _next_half_edge(half_edges: IntArray) -> IntArray:
    """The half-edges that follow in the same faces."""
    return half_edges - half_edges % 3 + (half_edges + 1) % 3


def number_cells(points: FloatArray, size: float) -> IntArray:
    """Number the cells of a cubic grid that hold points, by x, then y, then z, shape (P,)."""
    cell = np.floor(points / size).astype(np.int64)
    x, y, z = (cell - cell.min(axis=0)).T
    return np.unique((x * (y.max() + 1) + y) * (z.max() + 1) + z, return_inverse=True)[1]


_SAME_PLACE = 1e-6  # [-]; of the size of the mesh


def weld(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Make one vertex of all in the same place, to a millionth of the size of the mesh."""
    used, corners = np.unique(faces, return_inverse=True)
    places = vertices[used] - vertices[used].min(axis=0)
    cell = max(_SAME_PLACE * float(places.max()), np.finfo(float).tiny)
    first, cubes = unique_rows(np.round(places / cell).astype(np.int64))
    # Neighbours on the two sides of a cell's face are left.
    close = cKDTree(places[first]).query_pairs(cell, output_type="ndarray")
    label = connected_component_labels(close, node_count=len(first))
    _, welded = np.unique(label, return_index=True)
    kept = vertices[used][first[welded]]
    return kept, label[cubes[corners]].reshape(-1, 3).astype(np.int64)


def fill_holes(
    vertices: FloatArray, faces: IntArray, longest: float
) -> tuple[FloatArray, IntArray, list[float], list[float]]:
    """Close small holes by a fan around their middle.

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
