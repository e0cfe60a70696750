"""Pose of a rigid body from its three markers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.rigid import fit_rigid, misfit, root_mean_square

EDGE_TOLERANCE = 0.002  # [m]; well above the noise of a marker
_SMALLEST = 0.01  # [m]

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

    @property
    def noise(self) -> float:
        """1-sigma noise of a marker's coordinate, pooled over the frames [m]; NaN without any.

        Nine coordinates less the six of a pose leave 3 degrees of freedom a frame, so that the
        squared residual, a third of the sum of squares, is sigma^2 on average. With it,
        `pose_uncertainty(reference, noise)` is the uncertainty of the pose of one frame. An
        error of the reference itself is in the residual and thus counts as noise.
        """
        seen = self.residual[np.isfinite(self.residual)]
        return float(root_mean_square(seen)) if len(seen) else math.nan


def edge_lengths(markers: FloatArray) -> FloatArray:
    """Lengths of the edges 0-1, 1-2 and 2-0 of triads, shape (..., 3) [m].

    Args:
        markers: Marker positions, shape (..., 3, 3) [m].
    """
    return np.stack(
        [np.linalg.norm(markers[..., a, :] - markers[..., b, :], axis=-1) for a, b in _EDGES],
        axis=-1,
    )


def triad_fault(edges: FloatArray) -> tuple[str, str] | None:
    """What makes a triad useless, and the mend; None for a good one.

    Args:
        edges: Lengths of its edges, shape (3,) [m].
    """
    lengths = ", ".join(f"{1e3 * edge:.1f}" for edge in edges)
    shortest, middle, longest = np.sort(edges)
    half = 0.5 * edges.sum()
    area = np.sqrt(max(half * (half - edges).prod(), 0.0))  # Heron
    if shortest < _SMALLEST or area < 0.1 * _SMALLEST * longest:
        return (
            f"the markers are on one line or too close (edges {lengths} mm)",
            f"make a triangle of them, with edges of {1e3 * _SMALLEST:g} mm or more",
        )
    closest = min(middle - shortest, longest - middle)
    if closest < 2.0 * EDGE_TOLERANCE:
        return (
            f"two edges of the triad differ by {1e3 * closest:.1f} mm only (edges {lengths} mm),"
            " so swapped labels cannot be found",
            f"move a marker until all edges differ by {2e3 * EDGE_TOLERANCE:g} mm or more",
        )
    return None


def fit_triad(
    reference: FloatArray, observed: FloatArray, tolerance: float = EDGE_TOLERANCE
) -> TriadFit:
    """Fit a body's triad to observed ones, whatever the order of their labels.

    The labels stand if the edge lengths agree with the body's; otherwise the order whose
    edges agree best is taken, which finds a swap of labels that lasts a single frame. The
    rotation is the least-squares one (`fit_rigid`). A frame has no pose if a marker is occluded
    (NaN) or if no order agrees within the tolerance.

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
        pose = fit_rigid(reference, markers)
        rotation[usable], translation[usable] = pose.rotation, pose.translation
        residual[usable] = root_mean_square(misfit(reference, markers, pose))
    return TriadFit(Pose(rotation, translation), residual, order)
