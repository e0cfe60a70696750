"""Poses of rigid bodies from their markers, and how sure they are."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.geometry.pose import Pose


@dataclass(frozen=True)
class PoseUncertainty:
    """First-order uncertainty of a pose that was fitted to points of a body.

    The fitted pose puts a point p of the body off by ``d + w x (p - c)``, where the shift d and
    the small rotation w are independent of each other. All of it is in the axes of the body.

    Attributes:
        centroid: Centroid c of the points, shape (3,) [m].
        shift: Covariance of d, shape (3, 3) [m^2].
        rotation: Covariance of w, shape (3, 3) [rad^2].
    """

    centroid: FloatArray
    shift: FloatArray
    rotation: FloatArray

    def at(self, point: FloatArray) -> FloatArray:
        """Covariance of a point that moves with the body, shape (3, 3) [m^2].

        Args:
            point: The point in the body's frame, shape (3,) [m].
        """
        x, y, z = point - self.centroid
        lever = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # lever @ w = w x r
        return self.shift + lever @ self.rotation @ lever.T


def pose_uncertainty(points: FloatArray, noise: float) -> PoseUncertainty:
    """Uncertainty of a least-squares pose from equal, independent noise of the coordinates.

    With r the points from their centroid, the covariances are ``sigma^2 / k I`` of the shift
    and ``sigma^2 (sum(|r|^2 I - r r^T))^-1`` of the rotation. Their sum at a point is the
    target registration error of Fitzpatrick, West and Maurer 1998, doi:10.1109/42.736021,
    whose squared localisation error is ``3 sigma^2``.

    Args:
        points: The k points in the body's frame, not on one line, shape (k, 3) [m].
        noise: 1-sigma noise of a coordinate of the observed points [m]; for the mean of N
            independent frames that of a frame over sqrt(N).
    """
    centroid = points.mean(axis=0)
    arms = points - centroid
    inertia = (arms**2).sum() * np.eye(3) - arms.T @ arms
    shift = noise**2 / len(points) * np.eye(3)
    return PoseUncertainty(centroid, shift, noise**2 * np.linalg.inv(inertia))


def fit_rigid(points: FloatArray, observed: FloatArray) -> Pose:
    """Least-squares poses of a body from its points (Kabsch 1976, doi:10.1107/S0567739476001873).

    Args:
        points: Points in the body's frame, shape (k, 3) [m].
        observed: The same points in another frame, M times, shape (M, k, 3) [m].

    Returns:
        M poses of the body in the frame of the observations.
    """
    centre_points = points.mean(axis=0)
    centre_observed = observed.mean(axis=1)
    covariance = np.swapaxes(observed - centre_observed[:, None], 1, 2) @ (points - centre_points)
    left, _, right = np.linalg.svd(covariance)
    # Points in a plane leave the sign of its normal open: take the proper rotation.
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    rotation = left @ right
    return Pose(rotation, centre_observed - rotation @ centre_points)


def misfit(points: FloatArray, observed: FloatArray, pose: Pose) -> FloatArray:
    """Distances of observed points from where poses put them, shape (M, k) [m].

    Args:
        points: Points in the body's frame, shape (k, 3) [m].
        observed: The same points in another frame, shape (M, k, 3) [m].
        pose: M poses of the body in that frame.
    """
    fitted = points @ np.swapaxes(pose.rotation, 1, 2) + pose.translation[:, None]
    return np.linalg.norm(observed - fitted, axis=2)


def root_mean_square(values: FloatArray, axis: int = -1) -> FloatArray:
    """Root of the mean of the squares along an axis."""
    return np.sqrt((values**2).mean(axis=axis))


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
    """What makes a triad useless, and the hint; None for a good one.

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
