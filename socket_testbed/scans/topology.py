"""How triangles hang together: shared edges, pieces, boundary loops, one winding.

A half-edge ``h = 3 f + i`` of face f runs from its corner i to its corner i + 1; corner ``h`` is
where it starts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from socket_testbed.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Edges:
    """The edges of a mesh by how many faces share them.

    Attributes:
        twins: Pairs of half-edges whose edge exactly two faces share, shape (A, 2).
        boundary: Half-edges whose edge is in one face only, shape (B,).
        crowded: Half-edges whose edge more than two faces share, shape (C,).
    """

    twins: IntArray
    boundary: IntArray
    crowded: IntArray

    @property
    def neighbours(self) -> IntArray:
        """Pairs of faces with a common edge that no third face shares, shape (A, 2)."""
        return self.twins // 3


def match_edges(faces: IntArray) -> Edges:
    """Find which half-edges lie on the same edge.

    Args:
        faces: Vertices of the triangles, shape (F, 3).
    """
    start, stop = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(start, stop), np.maximum(start, stop)
    key = low * (int(faces.max(initial=0)) + 1) + high
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(np.append(first, len(key)))
    twins = first[count == 2]
    crowded = np.repeat(count > 2, count)
    return Edges(
        twins=np.column_stack([order[twins], order[twins + 1]]),
        boundary=np.sort(order[first[count == 1]]),
        crowded=np.sort(order[crowded]),
    )


def label_pieces(count: int, pairs: IntArray) -> IntArray:
    """Number the pieces of a graph in the order of their first nodes, shape (count,).

    Args:
        count: How many nodes there are.
        pairs: Pairs of joined nodes, shape (A, 2).
    """
    graph = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), (count, count))
    labels = connected_components(graph, directed=False)[1]
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]


def separate(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Cut a mesh wherever it is no plain surface, and drop the vertices that no face uses.

    Faces stay joined across edges that exactly two of them share. Where more meet in an edge,
    or where two fans of faces meet in a vertex alone, each gets vertices of its own; so every
    boundary vertex is on one boundary loop, once.

    Args:
        vertices: Shape (V, 3).
        faces: Shape (F, 3).

    Returns:
        The new vertices and faces; the order of the faces stays.
    """
    twins = match_edges(faces).twins
    start = faces.ravel()
    one, other = twins.T
    same_way = start[one] == start[other]
    one_stop, other_stop = next_half_edge(one), next_half_edge(other)
    joined = np.vstack(
        [
            np.column_stack([one, np.where(same_way, other, other_stop)]),
            np.column_stack([one_stop, np.where(same_way, other_stop, other)]),
        ]
    )
    label = label_pieces(len(start), joined)
    _, first = np.unique(label, return_index=True)
    return vertices[start[first]], label.reshape(-1, 3)


def winding_flips(faces: IntArray, twins: IntArray) -> tuple[BoolArray, BoolArray]:
    """Which faces to turn so that neighbours wind the same way, as few as possible a piece.

    The faces are nodes twice, as they are and turned; pairs that fit are joined. In an
    orientable piece the two sets stay apart.

    Args:
        faces: Shape (F, 3).
        twins: Pairs of half-edges on a common edge, shape (A, 2).

    Returns:
        Whether to turn each face, and whether its piece is one-sided (no winding fits),
        each of shape (F,).
    """
    count = len(faces)
    one, other = twins.T
    differ = (faces.ravel()[one] == faces.ravel()[other]) * count
    a, b = one // 3, other // 3
    pairs = np.vstack(
        [np.column_stack([a, b + differ]), np.column_stack([a + count, b + count - differ])]
    )
    label = label_pieces(2 * count, pairs)
    as_is, turned = label[:count], label[count:]
    # The side that holds more faces as they are is kept.
    votes = np.bincount(as_is, minlength=label.max(initial=-1) + 1)
    better = votes[as_is] < votes[turned]
    tie = (votes[as_is] == votes[turned]) & (as_is > turned)
    return better | tie, as_is == turned


def boundary_loops(faces: IntArray, boundary: IntArray) -> list[IntArray]:
    """Boundary loops of a mesh that `separate` has left, each in the order of its half-edges.

    Args:
        faces: Shape (F, 3), wound consistently.
        boundary: Half-edges in one face only.

    Returns:
        The vertices of each loop, each vertex once.
    """
    corners = faces.ravel()
    start, stop = corners[boundary], corners[next_half_edge(boundary)]
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


def next_half_edge(half_edges: IntArray) -> IntArray:
    """The half-edges that follow in the same faces."""
    return half_edges - half_edges % 3 + (half_edges + 1) % 3
