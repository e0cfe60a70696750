"""Rotations and poses in YAML documents."""

from __future__ import annotations

from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.documents import Section
from socket_testbed.errors import ConfigurationError
from socket_testbed.geometry.pose import Pose

_ORTHONORMAL = 1e-6  # [-]; a file holds at least seven digits


def read_rotation(section: Section, key: str) -> FloatArray:
    """A right-handed orthonormal frame, rows of R = [x y z], shape (3, 3) [-].

    Raises:
        ConfigurationError: If it is none.
    """
    rotation = section.array(key, (3, 3))
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > _ORTHONORMAL or np.linalg.det(rotation) < 0.0:
        raise ConfigurationError(
            f"{section.where}: {key} is no right-handed orthonormal frame (off by {error:.1g})",
            "give columns x, y, z of unit length with y = z x x",
        )
    return rotation


def read_pose(section: Section, farthest: float) -> Pose:
    """A pose, its translation at most so far along any axis [m].

    Raises:
        ConfigurationError: If it is none, or has other keys.
    """
    section.expect(("rotation", "translation"))
    translation = section.array("translation", (3,), limit=farthest)
    return Pose(read_rotation(section, "rotation"), translation)


def pose_document(pose: Pose) -> dict[str, Any]:
    """The document of a pose."""
    return {"rotation": plain(pose.rotation), "translation": plain(pose.translation)}


def plain(array: FloatArray) -> Any:
    """Nested lists, with digits enough for 10 nm and 1e-9 rad."""
    return (np.round(array, 9) + 0.0).tolist()
