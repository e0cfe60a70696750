"""Rigid poses, single or in batches, and their form in YAML documents."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from socket_testbed.arrays import FloatArray
from socket_testbed.documents import Document, FieldError


@dataclass(frozen=True)
class Pose:
    """Pose of a body in a frame, or of N bodies at once: ``p_frame = R p_body + t``."""

    rotation: FloatArray  # rotation matrices, shape (3, 3) or (N, 3, 3) [-]
    translation: FloatArray  # positions of the body's origin, shape (3,) or (N, 3) [m]

    @classmethod
    def from_quaternion(cls, translation: FloatArray, quaternion: FloatArray) -> Pose:
        """Poses from positions (N, 3) [m] and quaternions (x, y, z, w) of any length, (N, 4) [-].

        A NaN or zero quaternion gives NaN.
        """
        usable = np.isfinite(quaternion).all(axis=-1) & (quaternion != 0.0).any(axis=-1)
        rotation = np.full((*quaternion.shape[:-1], 3, 3), np.nan)
        if usable.any():
            rotation[usable] = Rotation.from_quat(quaternion[usable]).as_matrix()
        return cls(rotation, translation)

    @classmethod
    def from_vector(cls, vector: FloatArray) -> Pose:
        """Poses from their vectors, see `vector`; the quaternions may have any length."""
        return cls.from_quaternion(vector[..., :3], vector[..., 3:])

    @property
    def vector(self) -> FloatArray:
        """Positions [m] and quaternions (x, y, z, w), shape (7,) or (N, 7)."""
        return np.concatenate([self.translation, self.quaternion()], axis=-1)

    def quaternion(self) -> FloatArray:
        """Quaternions (x, y, z, w), shape (4,) or (N, 4) [-]; NaN if the pose is NaN."""
        return self._converted(Rotation.as_quat, 4)

    def rotation_vector(self) -> FloatArray:
        """Rotation vectors, shape (3,) or (N, 3) [rad]; NaN if the pose is NaN."""
        return self._converted(Rotation.as_rotvec, 3)

    def _converted(self, convert: Callable[[Rotation], FloatArray], size: int) -> FloatArray:
        """Convert the rotations to a form of some size; NaN if the pose is NaN."""
        usable = np.isfinite(self.rotation).all(axis=(-2, -1))
        found = np.full((*self.rotation.shape[:-2], size), np.nan)
        if usable.any():
            found[usable] = convert(Rotation.from_matrix(self.rotation[usable]))
        return found

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

    def place(self, points: FloatArray) -> FloatArray:
        """The same k points of N bodies, (k, 3) [m], in the frame, shape ([N,] k, 3) [m]."""
        return points @ np.swapaxes(self.rotation, -1, -2) + self.translation[..., None, :]


def _rotate(rotation: FloatArray, vectors: FloatArray) -> FloatArray:
    return np.einsum("...ij,...j->...i", rotation, vectors)


def about_z(angle: float) -> FloatArray:
    """Rotation about z by an angle [rad], shape (3, 3) [-]."""
    return np.asarray(Rotation.from_euler("z", angle).as_matrix())


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
    """A pose in a document: rows of R = [x y z], and the translation [m]."""

    rotation: RotationRows
    translation: Point

    def __post_init__(self) -> None:
        check_rotation(self.rotation, "rotation")

    def pose(self) -> Pose:
        """The pose."""
        return Pose(np.array(self.rotation), np.array(self.translation))


def check_rotation(rows: RotationRows, field: str) -> None:
    """Refuse rows of R = [x y z] that are not a right-handed orthonormal frame."""
    rotation = np.array(rows)
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > _TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise FieldError(
            f"{field} is not a right-handed orthonormal frame (off by {error:.1g})",
            "give columns x, y, z of unit length with y = z x x",
        )


def pose_document(pose: Pose) -> dict[str, Any]:
    """The document of a pose."""
    return {"rotation": rounded(pose.rotation), "translation": rounded(pose.translation)}


def rounded(array: FloatArray) -> Any:
    """Nested lists, rounded to nine digits: nm and nrad."""
    return (np.round(array, 9) + 0.0).tolist()
