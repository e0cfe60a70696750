"""The inner wall of a cavity, without its rims, cut faces and the outer wall."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.scans.sight import Samples, Sight
from socket_testbed.scans.surface import Surface, dots
from socket_testbed.scans.topology import label_pieces

_FACE_ON = 0.4  # [-]; cosine from which on a seen face needs no other witness
_OPPOSITE = -0.75  # [-]; cosine between the normals of the two sides of a wall
_NEAR = 1.5  # [-]; of the thickness: here the outer wall bears witness
_BAND = 3.0  # [-]; of the thickness: farther from the border nothing is rim
_POCKET = 0.2  # [-]; of the seen area, for a piece in the shadow of the wall itself
_REAL_OUTSIDE = 0.01  # [-]; of the seen area, for an outer wall that is worth the name
_PROBES = 2000  # of the thickness


def inner_wall(surface: Surface, samples: Samples, sight: Sight) -> BoolArray:
    """Faces of the inner wall, in one piece without holes of shadow, shape (F,).

    Args:
        surface: The surface.
        samples: Points on all of its faces.
        sight: What the spine sees of it.
    """
    if not sight.seen.any():
        return sight.seen
    face_on = sight.seen & (sight.facing > _FACE_ON)
    seen_area = float(surface.areas @ sight.seen)
    pockets = _pockets(surface, face_on, _POCKET * seen_area)
    outside = sight.hidden & ~pockets
    if surface.areas @ outside < _REAL_OUTSIDE * seen_area:
        return main_piece(surface, np.ones(len(surface.faces), bool))
    kept = _without_rims(surface, samples, sight.seen, face_on | pockets, outside)
    return _fill(surface, main_piece(surface, kept), outside)


def main_piece(surface: Surface, chosen: BoolArray) -> BoolArray:
    """The largest connected piece of the chosen faces, shape (F,)."""
    labels = _pieces(surface, chosen)
    areas = np.bincount(labels, surface.areas * chosen)
    return chosen & (labels == np.argmax(areas))


def _pockets(surface: Surface, face_on: BoolArray, largest: float) -> BoolArray:
    """Faces that those seen face-on surround, in pieces up to an area [m^2], shape (F,)."""
    labels = _pieces(surface, ~face_on)
    small = np.bincount(labels, surface.areas) < largest
    return ~face_on & (small & ~_reach_edge(surface, labels))[labels]


def _fill(surface: Surface, wall: BoolArray, outside: BoolArray) -> BoolArray:
    """The wall with the pieces that it surrounds and that hold nothing of the outside, (F,)."""
    labels = _pieces(surface, ~wall)
    within = (np.bincount(labels, outside) == 0) & ~_reach_edge(surface, labels)
    return wall | within[labels]


def _reach_edge(surface: Surface, labels: IntArray) -> BoolArray:
    """Whether each numbered piece has an edge of the surface, shape (pieces,)."""
    reach = np.zeros(int(labels.max()) + 1, bool)
    reach[labels[surface.edges.boundary // 3]] = True
    return reach


def _pieces(surface: Surface, chosen: BoolArray) -> IntArray:
    """Numbers of the pieces; every face that is not chosen is a piece of its own."""
    pairs = surface.edges.neighbours
    return label_pieces(len(chosen), pairs[chosen[pairs].all(axis=1)])


def _without_rims(
    surface: Surface, samples: Samples, seen: BoolArray, sure: BoolArray, outside: BoolArray
) -> BoolArray:
    """The faces that belong to a wall, not to the rim of its brim or to a cut, shape (F,).

    A face of a rim has the outer wall beside it; a face of the inner wall has it behind, turned
    the other way, or far off. What is seen at a slant needs it behind. Only what lies near the
    way from what is sure to the outside can be rim.
    """
    back = np.flatnonzero(outside[samples.owners])
    some = samples.points[back[:: max(1, len(back) // _PROBES)]]
    front = cKDTree(samples.points[sure[samples.owners]])
    thickness = float(np.median(front.query(some)[0]))

    near_border = _within(_BAND * thickness, _border(surface, sure, outside), surface.centres)
    band = np.flatnonzero((seen | sure) & near_border)
    near = _within(_NEAR * thickness, samples.points[back], surface.centres[band])
    opposite = _opposite(surface, samples, band, back, thickness)
    kept = sure.copy()
    kept[band] = np.where(sure[band], ~near | opposite, near & opposite)
    return kept


def _border(surface: Surface, sure: BoolArray, outside: BoolArray) -> FloatArray:
    """Centres of the faces where what is sure meets what leads outside, shape (B, 3) [m]."""
    labels = _pieces(surface, ~sure)
    leads_out = ~sure & (np.bincount(labels, outside) > 0)[labels]
    one, other = surface.edges.neighbours.T
    meet = (sure[one] & leads_out[other]) | (sure[other] & leads_out[one])
    return surface.centres[np.unique(surface.edges.neighbours[meet])]


def _within(reach: float, places: FloatArray, points: FloatArray) -> BoolArray:
    """Whether some place is within reach of each point, shape (N,)."""
    return cKDTree(places).query(points, distance_upper_bound=reach)[0] < np.inf


def _opposite(
    surface: Surface, samples: Samples, faces: IntArray, back: IntArray, thickness: float
) -> BoolArray:
    """Whether the part of the outer wall that suits a face best is turned the other way, (M,)."""
    normals = surface.normals[samples.owners[back]]
    turn = 2.0 * thickness  # a normal that is off counts as much as this distance
    own = surface.normals[faces]
    _, partner = cKDTree(np.hstack([samples.points[back], turn * normals])).query(
        np.hstack([surface.centres[faces], -turn * own])
    )
    return dots(normals[partner], own) < _OPPOSITE
