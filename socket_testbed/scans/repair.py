"""Repairs of triangle meshes: welding, unsound faces, winding, small holes, slivers."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.scans.topology import (
    boundary_loops,
    label_pieces,
    match_edges,
    winding_flips,
)

_SAME_PLACE = 1e-6  # [-]; of the size of the mesh
_ROUNDS = 10  # of flips; a flip can leave a sliver to its neighbour


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
    label = label_pieces(len(first), close)
    _, welded = np.unique(label, return_index=True)
    return places[first[welded]], label[cubes[corners]].reshape(-1, 3)


def are_finite(vertices: FloatArray, faces: IntArray) -> BoolArray:
    """Whether all corners of a face are finite, shape (F,)."""
    return np.asarray(np.isfinite(vertices[faces]).all(axis=(1, 2)))


def are_triangles(faces: IntArray) -> BoolArray:
    """Whether the corners of a face are three different vertices, shape (F,)."""
    return (faces != np.roll(faces, 1, axis=1)).all(axis=1)


def are_first(faces: IntArray) -> BoolArray:
    """Whether no earlier face has the same corners, whatever its winding, shape (F,)."""
    low, middle, high = np.sort(faces, axis=1).T
    order = np.lexsort((high, middle, low))  # stable: the first stays the first
    ordered = faces[order]
    same = (np.diff(np.sort(ordered, axis=1), axis=0) == 0).all(axis=1)
    first = np.ones(len(faces), bool)
    first[order[1:][same]] = False
    return first


def wind_alike(faces: IntArray) -> tuple[IntArray, int, BoolArray]:
    """Turn faces so that neighbours wind the same way.

    Args:
        faces: Shape (F, 3).

    Returns:
        The faces; how many were turned; which of them no winding fits, shape (F,).
    """
    turn, one_sided = winding_flips(faces, match_edges(faces).twins)
    return np.where(turn[:, None], faces[:, ::-1], faces), int(turn.sum()), one_sided


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
    for loop in boundary_loops(faces, match_edges(faces).boundary):
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


def loop_length(vertices: FloatArray, loop: IntArray) -> float:
    """How long a loop of vertices is around [m]."""
    steps = vertices[np.roll(loop, -1)] - vertices[loop]
    return float(np.linalg.norm(steps, axis=1).sum())


def flip_slivers(vertices: FloatArray, faces: IntArray) -> tuple[IntArray, int]:
    """Remove faces whose corners lie on one line, without opening a crack.

    Such a face is joined to the neighbour across its longest edge, and both are cut along the
    other diagonal; where there is none it is left out.

    Args:
        vertices: Shape (V, 3).
        faces: Shape (F, 3), wound alike.

    Returns:
        The faces, and how many had no area.
    """
    slivers = are_slivers(vertices, faces)
    found = int(slivers.sum())
    for _ in range(_ROUNDS):
        if not slivers.any():
            break
        faces = _flip(vertices, faces, slivers)
        slivers = are_slivers(vertices, faces)
    return faces[~slivers], found


def are_slivers(vertices: FloatArray, faces: IntArray) -> BoolArray:
    """Whether the height of a face over its longest edge is next to nothing, shape (F,)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    longest = np.linalg.norm([b - a, c - b, a - c], axis=2).max(axis=0)
    double_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    size = np.ptp(vertices, axis=0).max()
    return double_area <= _SAME_PLACE * size * longest


def _flip(vertices: FloatArray, faces: IntArray, slivers: BoolArray) -> IntArray:
    """Flip the longest edge of each sliver that has a neighbour there, no face twice."""
    twin = np.full(3 * len(faces), -1)
    twins = match_edges(faces).twins
    twin[twins] = twins[:, ::-1]
    corners = vertices[faces]
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    flipped = faces.copy()
    touched: set[int] = set()
    for face in np.flatnonzero(slivers).tolist():
        edge = 3 * face + int(lengths[face].argmax())
        across = int(twin[edge])
        if across >= 0 and touched.isdisjoint((face, across // 3)):
            touched |= {face, across // 3}
            start, stop, near = _corners_from(faces, edge)
            far = _corners_from(faces, across)[2]
            flipped[face], flipped[across // 3] = (start, far, near), (far, stop, near)
    return flipped


def _corners_from(faces: IntArray, half_edge: int) -> tuple[int, int, int]:
    """The corners of a face, beginning at a half-edge's start."""
    a, b, c = np.roll(faces[half_edge // 3], -(half_edge % 3)).tolist()
    return a, b, c
