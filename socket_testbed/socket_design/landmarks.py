"""Landmarks: the file that names them, and the frame that they place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, TypeAlias

import numpy as np
from msgspec import Meta

from socket_testbed.arrays import FloatArray
from socket_testbed.documents import Document, FieldError, Text, read_document
from socket_testbed.errors import ConfigurationError, RegistrationError
from socket_testbed.geometry.marker_bodies import (
    FEWEST_MARKERS,
    MOST_MARKERS,
    PoseUncertainty,
    fit_rigid,
    misfit,
    pose_uncertainty,
    root_mean_square,
)
from socket_testbed.geometry.pose import Pose

LANDMARK_FILE_HELP = """LANDMARKS.yaml names the markers and gives the landmarks' coordinates.

    bodies:                # the markers that stay on the bodies (3 to 8), as the take names them
      socket: [Socket:Marker1, Socket:Marker2, Socket:Marker3]
      pylon:               # or a rigid body of Motive, 3 to 8 markers; its frame is kept
        rigid_body: Pylon
    load_cell:             # landmarks on the load cell or the socket: coordinates in {S} [m]
      Cell:Marker1: [0.030, 0.0, 0.012]
      Cell:Marker2: [-0.030, 0.0, 0.012]
      Cell:Marker3: [0.0, 0.055, 0.040]
    limb:                  # landmarks on the limb: coordinates in its frame [m], whose origin
      Limb:Marker1: [0.0, 0.070, 0.10]    # is the lumped mass
      Limb:Marker2: [0.05, -0.030, 0.12]
      Limb:Marker3: [-0.06, -0.020, 0.09]

All keys are required; load_cell and limb name three landmarks or more, as the take names them.
Of three, or of more in one plane, a wrong sign has no residual: better give a fourth off the plane.
"""


_FEWEST = 3
_FLAT = 0.001  # [m]; mirrored landmarks leave twice this residual
_SMALLEST = 0.005  # [m]; landmarks closer to each other or to one line hold no rotation


@dataclass(frozen=True)
class LandmarkFit:
    """A frame registered by k landmarks."""

    names: tuple[str, ...]
    pose: Pose  # pose of the frame in which they are known, in the frame in which they are measured
    residual: FloatArray  # distances of the landmarks from where the fit puts them; (k,) [m]
    noise: float  # 1-sigma error of a coordinate of a landmark [m]
    degrees: int  # degrees of freedom of the residual, 3k - 6
    uncertainty: PoseUncertainty  # 1-sigma uncertainty of the pose, in the axes of the known frame
    flat: bool  # whether the landmarks lie in one plane: a coordinate's wrong sign has no residual

    @property
    def rms(self) -> float:
        """Root-mean-square residual [m]."""
        return float(root_mean_square(self.residual))


def register_landmarks(
    known: FloatArray, measured: FloatArray, names: Sequence[str], noise: float | None = None
) -> LandmarkFit:
    """Least-squares pose of a frame from landmarks.

    The uncertainty is the first-order one (`pose_uncertainty`). Without a given noise, sigma
    comes from the residuals, ``sigma^2 = sum(residual^2) / (3k - 6)``; with few landmarks it is
    itself known roughly only (three of them leave 3 degrees of freedom). An error that all
    landmarks share, such as a wrong origin of the known frame, is in no residual.

    Args:
        known: Landmarks in the frame to register, shape (k, 3) [m].
        measured: The same landmarks in another frame, shape (k, 3) [m].
        names: Names of the k landmarks.
        noise: 1-sigma error of a coordinate of a landmark [m], if it is known.
    """
    if len(names) < _FEWEST:
        raise RegistrationError(
            f"{len(names)} landmarks ({', '.join(names) or 'none'}) hold no frame",
            f"give {_FEWEST} or more that are not on one line",
        )
    _require_spread(known, names, "are given")
    _require_spread(measured, names, "were measured")

    batch = fit_rigid(known, measured[None])
    residual = misfit(known, measured[None], batch)[0]
    degrees = 3 * len(names) - 6
    sigma = float(np.sqrt((residual**2).sum() / degrees)) if noise is None else noise
    return LandmarkFit(
        names=tuple(names),
        pose=Pose(batch.rotation[0], batch.translation[0]),
        residual=residual,
        noise=sigma,
        degrees=degrees,
        uncertainty=pose_uncertainty(known, sigma),
        flat=float(_stretch(known)[2]) < _FLAT,
    )


def _require_spread(points: FloatArray, names: Sequence[str], how: str) -> None:
    for a, b in combinations(range(len(names)), 2):
        apart = float(np.linalg.norm(points[a] - points[b]))
        if apart < _SMALLEST:
            raise RegistrationError(
                f"landmarks {names[a]} and {names[b]} {how} {1e3 * apart:.1f} mm apart",
                "give landmarks far from each other",
            )
    off_line = float(np.hypot(*_stretch(points)[1:]))
    if off_line < _SMALLEST:
        raise RegistrationError(
            f"landmarks {', '.join(names)} {how} on one line (within {1e3 * off_line:.1f} mm)",
            "move one of them away from the line of the others",
        )


def _stretch(points: FloatArray) -> FloatArray:
    """Root-mean-square extents along the principal axes, the longest first, shape (3,) [m]."""
    stretch = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return np.asarray(stretch / np.sqrt(len(points)))


_FARTHEST = 2.0  # [m]; what is farther is in another unit

TriadLabels: TypeAlias = str | tuple[str, ...]


@dataclass(frozen=True)
class Side:
    """A marker body and the landmarks that are rigid to it."""

    body: str  # the body, `socket` or `pylon`
    triad: TriadLabels  # the names of its own three to eight markers, or that of a rigid body
    frame: str  # the frame in which the landmarks are known: `load_cell` or `limb`
    where: str  # what names the landmarks in an error: the file and the frame
    landmarks: dict[str, FloatArray]  # their coordinates by name; (3,) [m]

    def points(self) -> FloatArray:
        """The landmarks' coordinates, shape (k, 3) [m]."""
        return np.array(list(self.landmarks.values()))

    def names(self) -> set[str]:
        """All names in the take that this side uses."""
        triad = {self.triad} if isinstance(self.triad, str) else set(self.triad)
        return triad | set(self.landmarks)


@dataclass(frozen=True)
class LandmarkFile:
    """Which marker of a static take is what."""

    socket: Side  # the socket's markers, and landmarks known in {S}
    pylon: Side  # the pylon's markers, and landmarks known in the limb's frame


_Metres = Annotated[float, Meta(ge=-_FARTHEST, le=_FARTHEST)]
_Coordinates = dict[str, tuple[_Metres, _Metres, _Metres]]


class _RigidBody(Document):
    rigid_body: Text


_Names = Annotated[list[Text], Meta(min_length=FEWEST_MARKERS, max_length=MOST_MARKERS)]


class _Bodies(Document):
    socket: _RigidBody | _Names
    pylon: _RigidBody | _Names

    def __post_init__(self) -> None:
        for body, names in (("socket", self.socket), ("pylon", self.pylon)):
            if isinstance(names, list) and len({*map(str, names)}) < len(names):
                raise FieldError(f"{body} names a marker twice", "name each marker once")


class _Landmarks(Document):
    bodies: _Bodies
    load_cell: _Coordinates
    limb: _Coordinates


def read_landmarks(path: Path) -> LandmarkFile:
    """Read LANDMARKS.yaml."""
    document = read_document(path, _Landmarks)
    bodies = document.bodies
    socket = _side("socket", bodies.socket, "load_cell", document.load_cell, path)
    pylon = _side("pylon", bodies.pylon, "limb", document.limb, path)
    # The socket and the limb move against each other: no marker is on both.
    for name in sorted(socket.names() & pylon.names()):
        raise ConfigurationError(
            f"{path}: '{name}' is on the socket's side and on the limb's",
            "name each marker on one side",
        )
    return LandmarkFile(socket, pylon)


def _side(
    body: str, markers: _RigidBody | list[Text], frame: str, known: _Coordinates, path: Path
) -> Side:
    where = f"{path}: {frame}"
    if len(known) < _FEWEST:
        raise ConfigurationError(
            f"{where}: {len(known)} landmarks hold no frame",
            f"give {_FEWEST} or more that are not on one line",
        )
    labels = tuple(map(str, markers)) if isinstance(markers, list) else str(markers.rigid_body)
    return Side(body, labels, frame, where, {name: np.array(at) for name, at in known.items()})
