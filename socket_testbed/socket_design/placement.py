"""Where {S} is in a scan: by directions, by landmarks, or by three picked points."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from socket_testbed.arrays import FloatArray
from socket_testbed.documents import Document, read_document
from socket_testbed.errors import ConfigurationError, RegistrationError
from socket_testbed.geometry.pose import Pose
from socket_testbed.socket_design.landmarks import register_landmarks

_AXES = {"x": 0, "y": 1, "z": 2}
_SMALLEST_SINE = 0.1  # [-]; directions closer to each other than some 6 degrees span no plane
_LARGEST_RESIDUAL = 0.01  # [m]


@dataclass(frozen=True)
class Placement:
    """Pose of the scan in {S}."""

    scan_in_load_cell: Pose  # pose of the scan's frame (in metres) in {S}
    source: str  # how it was found


def parse_direction(text: str, where: str) -> FloatArray:
    """A direction in the scan's axes, shape (3,) [-].

    Args:
        text: An axis with its sign, such as +z, or three numbers, such as "0 0.1 1".
        where: What names it in an error.
    """
    axis = re.fullmatch(r"([+-]?)([xyz])", text.strip().lower())
    if axis:
        direction = np.zeros(3)
        direction[_AXES[axis[2]]] = -1.0 if axis[1] == "-" else 1.0
        return direction
    try:
        vector = parse_point(text, where)
    except ConfigurationError as error:
        raise ConfigurationError(error.fact, "give an axis, such as +z, or three numbers") from None
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        raise ConfigurationError(f"{where} is '{text}', no direction", "give +z or three numbers")
    return vector / length


def parse_point(text: str, where: str) -> FloatArray:
    """Three numbers, with spaces or commas between them, shape (3,)."""
    try:
        point = np.array([float(word) for word in re.split(r"[\s,]+", text.strip())])
    except ValueError:
        point = np.zeros(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ConfigurationError(f"{where} is '{text}'", "give three numbers, such as '0 0 1'")
    return point


def place_by_directions(
    vertices: FloatArray, proximal: FloatArray, anterior: FloatArray | None, height: float
) -> Placement:
    """{S} below the distal end, z proximal and x anterior.

    Args:
        vertices: Vertices of the interior in the scan's frame, shape (v, 3) [m].
        proximal: Direction towards the proximal end, shape (3,) [-].
        anterior: Direction towards anterior, shape (3,) [-]; None for the scan's axis that is
            most across: +x, or +y where that is along the socket.
        height: Height of the distal end above the origin of {S} [m].
    """
    assumed = anterior is None
    if anterior is None:
        anterior = np.eye(3)[0 if abs(proximal[0]) < 0.7 else 1]
    z = proximal / np.linalg.norm(proximal)
    x = anterior - (anterior @ z) * z
    if np.linalg.norm(x) < _SMALLEST_SINE:
        raise ConfigurationError(
            "--anterior is along the proximal direction", "give the direction of the shin's front"
        )
    x /= np.linalg.norm(x)
    rotation = np.array([x, np.cross(z, x), z])
    inside = vertices @ rotation.T
    low, high = inside.min(axis=0), inside.max(axis=0)
    origin = np.array([*(0.5 * (low + high))[:2], low[2] - height])
    how = f"z proximal, x {'assumed' if assumed else 'given as'} anterior, the distal end's"
    return Placement(
        Pose(rotation, -origin),
        f"{how} lowest point {1e3 * height:g} mm above the load cell: nominal",
    )


def place_by_points(points: FloatArray) -> Placement:
    """{S} by three points picked in the scan: its origin, one on +x, one on the side of +y.

    Args:
        points: The points in the scan's frame, shape (3, 3) [m].
    """
    along, aside = points[1] - points[0], points[2] - points[0]
    normal = np.cross(along, aside)
    size = float(np.linalg.norm(along) * np.linalg.norm(aside))
    if size == 0.0 or np.linalg.norm(normal) < _SMALLEST_SINE * size:
        raise RegistrationError(
            "the three --points are on one line or at one place",
            "pick the origin of {S}, a point on its +x axis, and one beside it towards +y",
        )
    x, z = along / np.linalg.norm(along), normal / np.linalg.norm(normal)
    rotation = np.array([x, np.cross(z, x), z])
    return Placement(Pose(rotation, -rotation @ points[0]), "three picked points")


_Scanned = Annotated[float, Meta(ge=-1e6, le=1e6)]  # in the scan's unit
_Metres = Annotated[float, Meta(ge=-10.0, le=10.0)]


class _Landmark(Document):
    scan: tuple[_Scanned, _Scanned, _Scanned]
    load_cell: tuple[_Metres, _Metres, _Metres]


class _Landmarks(Document):
    landmarks: dict[str, _Landmark]


def place_by_landmarks(path: Path, scale: float) -> Placement:
    """{S} by landmarks that are known in it and were picked in the scan.

    The file holds, below the key `landmarks`, for each by name: `scan` (in the scan's unit) and
    `load_cell` [m].

    Args:
        path: The file.
        scale: The scan's unit [m].
    """
    landmarks = read_document(path, _Landmarks).landmarks
    scan = np.array([each.scan for each in landmarks.values()]).reshape(-1, 3) * scale
    load_cell = np.array([each.load_cell for each in landmarks.values()]).reshape(-1, 3)
    try:
        fit = register_landmarks(scan, load_cell, tuple(landmarks))
    except RegistrationError as error:
        raise RegistrationError(f"{path}: {error.fact}", error.hint) from None
    if fit.rms > _LARGEST_RESIDUAL:
        worst = fit.names[int(fit.residual.argmax())]
        raise RegistrationError(
            f"{path}: the landmarks fit by {1e3 * fit.rms:.1f} mm only",
            f"check the scan's unit and the coordinates, first of '{worst}'",
        )
    return Placement(fit.pose, f"{len(landmarks)} landmarks, rms {1e3 * fit.rms:.2f} mm")
