"""Rigid poses, singly or in batches, and their form in YAML documents."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from socket_testbed.arrays import FloatArray
from socket_testbed.documents import Document, FieldError

_UNIT = np.eye(3)
_CROSS = np.cross(_UNIT[:, None], _UNIT).transpose(0, 2, 1).reshape(3, 9)  # [v]_x = v @ _CROSS


@dataclass(frozen=True)
class Pose:
    """Pose of a body in a frame, or of N bodies at once: ``p_frame = R p_body + t``.

    Attributes:
        rotation: Rotation matrices, shape (3, 3) or (N, 3, 3) [-].
        translation: Positions of the body's origin, shape (3,) or (N, 3) [m].
    """

    rotation: FloatArray
    translation: FloatArray

    @classmethod
    def from_quaternion(cls, translation: FloatArray, quaternion: FloatArray) -> Pose:
        """Poses from quaternions (x, y, z, w) of any length; NaN or zero gives NaN.

        Args:
            translation: Positions, shape (N, 3) [m].
            quaternion: Quaternions, shape (N, 4) [-].
        """
        norm = np.sqrt((quaternion * quaternion).sum(axis=-1, keepdims=True))
        norm = np.where(np.isfinite(norm) & (norm > 0.0), norm, np.nan)
        unit = quaternion / norm
        v, w = unit[..., :3], unit[..., 3:, None]
        crossed = (v @ _CROSS).reshape(*v.shape, 3)  # [v]_x
        rotation = 2.0 * (v[..., None] * v[..., None, :] + w * crossed)
        rotation += (1.0 - 2.0 * (v * v).sum(axis=-1))[..., None, None] * _UNIT
        return cls(rotation, translation)

    def quaternion(self) -> FloatArray:
        """Quaternions (x, y, z, w), shape (4,) or (N, 4) [-]; NaN where the pose is NaN."""
        usable = np.isfinite(self.rotation).all(axis=(-2, -1))
        quaternion = np.full((*self.rotation.shape[:-2], 4), np.nan)
        if usable.any():
            quaternion[usable] = Rotation.from_matrix(self.rotation[usable]).as_quat()
        return quaternion

    def rotation_vector(self) -> FloatArray:
        """Rotation vectors, shape (3,) or (N, 3) [rad]; NaN where the pose is NaN."""
        usable = np.isfinite(self.rotation).all(axis=(-2, -1))
        vector = np.full(self.rotation.shape[:-1], np.nan)
        if usable.any():
            vector[usable] = Rotation.from_matrix(self.rotation[usable]).as_rotvec()
        return vector

    def inverse(self) -> Pose:
        """Pose of the frame in the body."""
        rotation = np.swapaxes(self.rotation, -1, -2)
        return Pose(rotation, -_rotate(rotation, self.translation))

    def __matmul__(self, other: Pose) -> Pose:
        """Pose of `other`'s body in this pose's frame."""
        return Pose(self.rotation @ other.rotation, self.apply(other.translation))

    def apply(self, points: FloatArray) -> FloatArray:
        """Points of the body in the frame, shape (3,) or (N, 3) [m]."""
        return _rotate(self.rotation, points) + self.translation


def _rotate(rotation: FloatArray, vectors: FloatArray) -> FloatArray:
    return np.einsum("...ij,...j->...i", rotation, vectors)


def rotation_vectors(rotations: FloatArray) -> FloatArray:
    """Rotation vectors, shape (N, 3) [rad], of rotation matrices, shape (N, 3, 3), below pi.

    A few times as fast as `scipy.spatial.transform.Rotation` on few matrices, which it checks.
    """
    twice = rotations - np.swapaxes(rotations, 1, 2)
    axis = 0.5 * np.stack([twice[:, 2, 1], twice[:, 0, 2], twice[:, 1, 0]], axis=1)
    sine = np.sqrt(np.einsum("ni,ni->n", axis, axis))
    angle = np.arctan2(sine, 0.5 * (np.einsum("nii->n", rotations) - 1.0))
    return axis * np.where(sine > 0.0, angle / np.where(sine > 0.0, sine, 1.0), 1.0)[:, None]


def rotation_vector(rotation: FloatArray) -> FloatArray:
    """Rotation vector, shape (3,) [rad], of one rotation matrix, shape (3, 3); NaN for NaN.

    The same as `Pose.rotation_vector` in a fraction of the time. One step of Newton and Schulz
    makes a matrix that a file rounded to nine digits orthonormal.
    """
    *vector, w = _quaternion(rotation @ (1.5 * _UNIT - 0.5 * (rotation.T @ rotation)))
    size = math.hypot(*vector)
    angle = 2.0 * math.atan2(size, abs(w))
    share = math.copysign(angle, w) / size if size > 0.0 else 0.0 * size
    return np.array([share * part for part in vector])


def _quaternion(rotation: FloatArray) -> tuple[float, float, float, float]:
    """Quaternion (x, y, z, w) of any length of a rotation matrix, shape (3, 3)."""
    m = rotation.tolist()
    diagonal = [m[0][0], m[1][1], m[2][2]]
    trace = sum(diagonal)
    # Shepperd 1978, doi:10.2514/3.55767b: by the largest of the four components.
    i = max(range(3), key=diagonal.__getitem__)
    if trace >= diagonal[i]:
        return m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1], 1.0 + trace
    j, k = (i + 1) % 3, (i + 2) % 3
    vector = [0.0, 0.0, 0.0]
    vector[i] = 1.0 - trace + 2.0 * diagonal[i]
    vector[j], vector[k] = m[j][i] + m[i][j], m[k][i] + m[i][k]
    x, y, z = vector
    return x, y, z, m[k][j] - m[j][k]


def turned_quaternion(rotation: FloatArray, turn: FloatArray) -> FloatArray:
    """Quaternion (x, y, z, w) of a rotation matrix, shape (3, 3), times a rotation vector [rad]."""
    x, y, z, w = _quaternion(rotation)
    angle = math.sqrt(float(turn @ turn))
    share = math.sin(0.5 * angle) / angle if angle > 0.0 else 0.5
    a, b, c = (share * turn).tolist()
    d = math.cos(0.5 * angle)
    product = np.array(
        [
            w * a + x * d + y * c - z * b,
            w * b + y * d + z * a - x * c,
            w * c + z * d + x * b - y * a,
            w * d - x * a - y * b - z * c,
        ]
    )
    return np.asarray(product / math.sqrt(product @ product))


def rotation_of(quaternion: FloatArray) -> FloatArray:
    """Rotation matrix, shape (3, 3), of a quaternion (x, y, z, w) of length 1."""
    x, y, z, w = quaternion.tolist()
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def about_z(angle: float) -> FloatArray:
    """Rotation about z by an angle [rad], shape (3, 3) [-]."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


_ORTHONORMAL = 1e-6  # [-]; a file holds at least seven digits
_Cosine = Annotated[float, Meta(ge=-2.0, le=2.0)]
_Row = tuple[_Cosine, _Cosine, _Cosine]
RotationRows = tuple[_Row, _Row, _Row]
_Metres = Annotated[float, Meta(ge=-2.0, le=2.0, description="coordinates [m]")]
Point = tuple[_Metres, _Metres, _Metres]


class PoseDocument(Document):
    """A pose in a document: rows of R = [x y z], and the translation [m]."""

    rotation: RotationRows
    translation: Point

    def __post_init__(self) -> None:
        check_rotation(self.rotation, "rotation")

    def pose(self) -> Pose:
        """The pose."""
        return Pose(np.array(self.rotation), np.array(self.translation))


def check_rotation(rows: RotationRows, field: str) -> None:
    """Refuse rows of R = [x y z] that are not a right-handed orthonormal frame.

    Raises:
        FieldError: If they are not.
    """
    rotation = np.array(rows)
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > _ORTHONORMAL or np.linalg.det(rotation) < 0.0:
        raise FieldError(
            f"{field} is not a right-handed orthonormal frame (off by {error:.1g})",
            "give columns x, y, z of unit length with y = z x x",
        )


def pose_document(pose: Pose) -> dict[str, Any]:
    """The document of a pose."""
    return {"rotation": plain(pose.rotation), "translation": plain(pose.translation)}


def plain(array: FloatArray) -> Any:
    """Nested lists, with digits enough for 10 nm and 1e-9 rad."""
    return (np.round(array, 9) + 0.0).tolist()
