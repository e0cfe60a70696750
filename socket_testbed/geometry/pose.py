"""Rigid poses, single or in batches, and their form in YAML documents."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from socket_testbed.arrays import FloatArray
from socket_testbed.documents import Document, FieldError
from socket_testbed.rotations import (
    compose,
    inverted,
    matrices_to_quaternions,
    quaternions_to_matrices,
    quaternions_to_vectors,
    vectors_to_quaternions,
)


@dataclass(frozen=True)
class Pose:
    """Pose of a body in a frame, or of N bodies at once: ``p_frame = R p_body + t``.

    Attributes:
        rotation: Rotation matrix R, which maps vectors from the body to the frame, shape (3, 3) or
            (N, 3, 3) [-]; its columns are the body's axes in the frame. NaN if unknown.
        translation: Position t of the body's origin in the frame, shape (3,) or (N, 3) [m]; NaN if
            unknown.
    """

    rotation: FloatArray
    translation: FloatArray

    @classmethod
    def from_quaternion(cls, translation: FloatArray, quaternion: FloatArray) -> Pose:
        """One pose or N poses from positions and quaternions.

        Args:
            translation: Positions of the body's origin in the frame, shape (3,) or (N, 3) [m].
            quaternion: Quaternions (x, y, z, w) from the body to the frame, of any length, shape
                (4,) or (N, 4) [-]; one that is not finite or is zero gives a NaN rotation.
        """
        # Scaled by their largest component, so that no square under- or overflows.
        largest = np.abs(quaternion).max(axis=-1, keepdims=True)
        usable = np.isfinite(largest) & (largest > 0.0)
        scaled = np.full(quaternion.shape, np.nan)
        np.divide(quaternion, largest, out=scaled, where=usable)
        return cls(quaternions_to_matrices(scaled), translation)

    @classmethod
    def from_vector(cls, vector: FloatArray) -> Pose:
        """Poses from their vectors, shape (7,) or (N, 7) [m, -], as `vector` returns them.

        The quaternions may have any length.
        """
        return cls.from_quaternion(vector[..., :3], vector[..., 3:])

    @property
    def vector(self) -> FloatArray:
        """Positions [m], then quaternions (x, y, z, w) [-], shape (7,) or (N, 7)."""
        return np.concatenate([self.translation, self.quaternion()], axis=-1)

    def quaternion(self) -> FloatArray:
        """Quaternions (x, y, z, w), shape (4,) or (N, 4) [-]; NaN if the pose is NaN."""
        return matrices_to_quaternions(_orthogonal(self.rotation))

    def rotation_vector(self) -> FloatArray:
        """Rotation vectors, shape (3,) or (N, 3) [rad]; NaN if the pose is NaN."""
        return quaternions_to_vectors(self.quaternion())

    def inverse(self) -> Pose:
        """Pose of the frame in the body."""
        rotation = np.swapaxes(self.rotation, -1, -2)
        return Pose(rotation, -_rotate(rotation, self.translation))

    def __matmul__(self, other: Pose) -> Pose:
        """Pose of `other`'s body in this pose's frame."""
        return Pose(self.rotation @ other.rotation, self.apply(other.translation))

    def apply(self, points: FloatArray) -> FloatArray:
        """Coordinates in the frame of points given in the body, shape (3,) or (N, 3) each [m].

        N poses place one point each, or all of them the same point.
        """
        return _rotate(self.rotation, points) + self.translation

    def place(self, points: FloatArray) -> FloatArray:
        """Coordinates in the frame of k points of each body, shape ([N,] k, 3) [m].

        The points are in the body, shape (k, 3) [m], and each of N poses places them all.
        """
        return points @ np.swapaxes(self.rotation, -1, -2) + self.translation[..., None, :]


def _orthogonal(rotation: FloatArray) -> FloatArray:
    """The rotations nearest to matrices that are rounded, shape (..., 3, 3) [-].

    A step of the Newton-Schulz iteration, which squares the error (Higham, Functions of Matrices,
    2008, section 8.3).
    """
    gram = np.swapaxes(rotation, -1, -2) @ rotation
    return np.asarray(rotation @ (1.5 * np.eye(3) - 0.5 * gram))


def _rotate(rotation: FloatArray, vectors: FloatArray) -> FloatArray:
    return np.einsum("...ij,...j->...i", rotation, vectors)


def weighted_pose(vectors: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted means on SE(3) of m nearby poses each, as `Pose.vector`, shape (..., 7) [m, -].

    The mean of the positions, and that of the rotations in the tangent space of their chordal mean
    (Hartley 2013, doi:10.1007/s11263-012-0601-0). With the weights of `arrays.line_weights` it is
    the pose on a line through the poses.

    Args:
        vectors: The poses as `Pose.vector`, shape (..., m, 7) [m, -]. Their rotations are less than
            half a turn apart.
        weights: Their weights, shape (..., m) [-], with the sum 1; the pose of a weight 0 does not
            count, and may be NaN.
    """
    counts = weights != 0.0
    vectors = np.where(counts[..., None], vectors, 0.0)
    position = np.einsum("...m,...mi->...i", weights, vectors[..., :3])
    quaternions = vectors[..., 3:]
    # The chordal mean: the quaternion nearest to all, whatever their signs.
    products = np.einsum("...mi,...mj->...ij", quaternions, quaternions)
    mean = np.linalg.eigh(products)[1][..., -1]
    quaternions[~counts] = [0.0, 0.0, 0.0, 1.0]
    turns = quaternions_to_vectors(compose(inverted(mean)[..., None, :], quaternions))
    turn = np.einsum("...m,...mi->...i", weights, turns)
    rotation = compose(mean, vectors_to_quaternions(turn))
    return np.concatenate([position, rotation], axis=-1)


def about_z(angle: float) -> FloatArray:
    """Rotation about z by an angle [rad], shape (3, 3) [-]."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


_TOLERANCE = 1e-6  # [-]; files have at least seven digits
_Cosine = Annotated[float, Meta(ge=-2.0, le=2.0)]
_Row = tuple[_Cosine, _Cosine, _Cosine]
RotationRows = tuple[_Row, _Row, _Row]
# Larger coordinates are in another unit.
_Metres = Annotated[float, Meta(ge=-2.0, le=2.0, description="coordinates [m]")]
Point = tuple[_Metres, _Metres, _Metres]
_Scanned = Annotated[float, Meta(ge=-1e6, le=1e6)]  # in the scan's unit
ScanPoint = tuple[_Scanned, _Scanned, _Scanned]


class PoseDocument(Document):
    """A pose in a document.

    Attributes:
        rotation: The three rows of R = [x y z], which maps vectors from the body to the frame [-].
        translation: Position of the body's origin in the frame, three numbers in +-2 m [m].
    """

    rotation: RotationRows
    translation: Point

    def __post_init__(self) -> None:
        check_rotation(self.rotation, "rotation")

    def pose(self) -> Pose:
        """The pose as arrays: rotation (3, 3) [-] and translation (3,) [m]."""
        return Pose(np.array(self.rotation), np.array(self.translation))


def check_rotation(rows: RotationRows, field: str) -> None:
    """Refuse rows of R = [x y z] that are not a right-handed orthonormal frame.

    Args:
        rows: Three rows of three numbers [-]; the columns are the axes x, y, z.
        field: The field's name in the error.

    Raises:
        FieldError: If an entry of R^T R is more than 1e-6 off the identity, or R is left-handed.
    """
    rotation = np.array(rows)
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > _TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise FieldError(
            f"{field} is not a right-handed orthonormal frame (off by {error:.1g})",
            "give columns x, y, z of unit length with y = z x x",
        )


def pose_document(pose: Pose) -> dict[str, Any]:
    """The document of a single pose: `rotation`, rows of R [-], and `translation` [m]."""
    return {"rotation": rounded(pose.rotation), "translation": rounded(pose.translation)}


def rounded(array: FloatArray) -> Any:
    """An array of any shape as nested lists, rounded to nine decimals: nm for m, nrad for rad."""
    return (np.round(array, 9) + 0.0).tolist()
