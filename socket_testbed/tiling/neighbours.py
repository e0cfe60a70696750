"""Which tiles are neighbours: the graph of the smoothness operator D."""

from __future__ import annotations

import numpy as np

from socket_testbed.arrays import IntArray
from socket_testbed.tiling.squares import Squares, gaps

_NEAR = 0.5  # [edges]; largest gap between neighbours
_FARTHEST = 2.2  # [edges]; no centres of neighbours are farther apart
_FOLD = 0.0  # [-]; cosine between the normals of tiles on different sides of an edge


def nearby_pairs(squares: Squares) -> IntArray:
    """Pairs of tiles with less than half a tile between them, diagonal ones included.

    Returns:
        Pairs (a, b) with a < b, sorted, shape (e, 2).
    """
    normals = squares.rotations[:, :, 2]
    pairs = []
    for tile in range(len(squares)):
        later = np.arange(tile + 1, len(squares))
        later = later[normals[later] @ normals[tile] > _FOLD]
        offset = squares.anchors[later] - squares.anchors[tile]
        later = later[np.linalg.norm(offset, axis=1) < _FARTHEST * squares.edge]
        near = later[gaps(squares, tile, later) < _NEAR * squares.edge]
        pairs += [(tile, int(other)) for other in near]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)
