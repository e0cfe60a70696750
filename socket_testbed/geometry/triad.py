"""Pose of a rigid body from its three markers."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.geometry.pose import Pose

EDGE_TOLERANCE = 0.002  # [m]; well above the noise of a marker

_ORDERS = np.array(list(permutations(range(3))))
_EDGES = ((0, 1), (1, 2), (2, 0))
_EDGE_OF = {frozenset(edge): i for i, edge in enumerate(_EDGES)}
# Another order of the markers is another order of the same three edges.
_EDGES_OF_ORDERS = np.array(
    [[_EDGE_OF[frozenset((o[a], o[b]))] for a, b in _EDGES] for o in permutations(range(3))]
)


@dataclass(frozen=True)
class TriadFit:
    """Rigid fits of a triad to N frames.

    Attributes:
        pose: Pose of the body in the frame of the observations; NaN where there is none.
        residual: Root-mean-square distance of the markers from the fit, shape (N,) [m].
        order: Which observed marker is the body's first, second and third, shape (N, 3);
            -1 where there is no pose.
    """

    pose: Pose
    residual: FloatArray
    order: IntArray


def edge_lengths(markers: FloatArray) -> FloatArray:
    """Lengths of the edges 0-1, 1-2 and 2-0 of triads, shape (..., 3) [m].

    Args:
        markers: Marker positions, shape (..., 3, 3) [m].
    """
    return np.stack(
        [np.linalg.norm(markers[..., a, :] - markers[..., b, :], axis=-1) for a, b in _EDGES],
        axis=-1,
    )


def fit_triad(
    reference: FloatArray, observed: FloatArray, tolerance: float = EDGE_TOLERANCE
) -> TriadFit:
    """Fit a body's triad to observed ones, whatever the order of their labels.

    The labels stand if the edge lengths agree with the body's; otherwise the order whose
    edges agree best is taken, which finds a swap of labels that lasts a single frame. The
    rotation is the least-squares one (Kabsch 1976, doi:10.1107/S0567739476001873). A frame
    has no pose if a marker is occluded (NaN) or if no order agrees within the tolerance.

    Args:
        reference: Markers in the body's frame, shape (3, 3) [m].
        observed: Markers in another frame, shape (N, 3, 3) [m].
        tolerance: Largest difference of an edge length from the body's [m].
    """
    lengths = edge_lengths(observed)[:, _EDGES_OF_ORDERS]
    mismatch = np.abs(lengths - edge_lengths(reference)).max(axis=-1)
    mismatch = np.where(np.isfinite(mismatch), mismatch, np.inf)
    # The first order is the labels' own. Where it fits, noise must not flip a triad that is
    # nearly symmetric.
    best = np.where(mismatch[:, 0] <= tolerance, 0, mismatch.argmin(axis=-1))
    usable = mismatch.min(axis=-1) <= tolerance

    count = len(observed)
    rotation = np.full((count, 3, 3), np.nan)
    translation = np.full((count, 3), np.nan)
    residual = np.full(count, np.nan)
    order = np.full((count, 3), -1)
    if usable.any():
        order[usable] = _ORDERS[best[usable]]
        markers = np.take_along_axis(observed[usable], order[usable][:, :, None], axis=1)
        rotation[usable], translation[usable] = _kabsch(reference, markers)
        fitted = reference @ np.swapaxes(rotation[usable], 1, 2) + translation[usable][:, None]
        residual[usable] = np.sqrt(((markers - fitted) ** 2).sum(axis=2).mean(axis=1))
    return TriadFit(Pose(rotation, translation), residual, order)


def _kabsch(reference: FloatArray, markers: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations (M, 3, 3) and translations (M, 3) of the reference onto the markers."""
    centre_reference = reference.mean(axis=0)
    centre_markers = markers.mean(axis=1)
    covariance = np.swapaxes(markers - centre_markers[:, None], 1, 2) @ (
        reference - centre_reference
    )
    left, _, right = np.linalg.svd(covariance)
    # Three points leave the sign of the normal open: take the proper rotation.
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    rotation = left @ right
    return rotation, centre_markers - rotation @ centre_reference
