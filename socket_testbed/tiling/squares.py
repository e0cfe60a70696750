"""Squares in space: where two of them overlap, and how far they are apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray

_OTHER_WALL = -0.2  # [-]; cosine between the normals of squares that are on different walls
_SMALL = 1e-12  # in place of a zero that is divided by


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

    def corners(self) -> FloatArray:
        """Corners, counterclockwise about the inward normal, shape (m, 4, 3) [m]."""
        unit = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        around = np.einsum("mij,cj->mci", self.rotations, 0.5 * self.edge * unit)
        return self.anchors[:, None] + around


def gaps(squares: Squares, index: int, others: IntArray) -> FloatArray:
    """Gaps between a square and others on a smooth surface, negative where they overlap.

    Both of a pair are turned into the plane halfway between their own, where the separating-axis
    test of two squares is exact: on a circular wall two squares touch when the chord between
    their centres is one edge, as their footprints on the wall do. The gap is the largest
    distance along any of the four axes; it is infinite between different walls.

    Args:
        squares: The squares.
        index: The square.
        others: Indices of the others, shape (p,).

    Returns:
        Gaps, shape (p,) [m].
    """
    x, _, z = squares.rotations[index].T
    x_other, z_other = squares.rotations[others, :, 0], squares.rotations[others, :, 2]
    offset = squares.anchors[others] - squares.anchors[index]

    # The normal of the plane halfway is along z + z_other, of this length squared:
    cosine = z_other @ z
    length2 = np.maximum(2.0 + 2.0 * cosine, _SMALL)
    out_of_plane = (offset @ z + _dot(offset, z_other)) / length2
    in_plane2 = _dot(offset, offset) - out_of_plane**2 * length2
    x_out, x_other_out = z_other @ x, x_other @ z
    scale, scale_other = (
        1.0 / np.sqrt(np.maximum(1.0 - out**2 / length2, _SMALL)) for out in (x_out, x_other_out)
    )
    along = (offset @ x - x_out * out_of_plane) * scale
    along_other = (_dot(offset, x_other) - x_other_out * out_of_plane) * scale_other
    cosine_x = (x_other @ x - x_out * x_other_out / length2) * scale * scale_other

    apart = np.abs([along, along_other])
    across = np.sqrt(np.maximum(in_plane2 - apart**2, 0.0))
    sine_x = np.sqrt(np.maximum(1.0 - cosine_x**2, 0.0))
    reach = 0.5 * squares.edge * (1.0 + np.abs(cosine_x) + sine_x)
    return np.where(cosine > _OTHER_WALL, np.maximum(apart, across).max(axis=0) - reach, np.inf)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.einsum("pi,pi->p", a, b)
