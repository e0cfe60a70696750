"""Rigid fits of corresponding points, and how sure they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray
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
