"""The file that says which marker is what: LANDMARKS.yaml.

    bodies:                # the triads that stay on the bodies, as the take names their markers
      socket: [Socket:Marker1, Socket:Marker2, Socket:Marker3]
      pylon:               # or a rigid body of Motive with three markers; its frame is kept
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
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from socket_testbed.arrays import FloatArray
from socket_testbed.documents import Section, read_document
from socket_testbed.errors import ConfigurationError

_FARTHEST = 2.0  # [m]; what is farther is in another unit
_FEWEST = 3

TriadLabels: TypeAlias = str | tuple[str, ...]


@dataclass(frozen=True)
class Side:
    """A marker body and the landmarks that are rigid to it.

    Attributes:
        body: The body, `socket` or `pylon`.
        triad: Its triad: the names of three markers, or that of a rigid body.
        frame: The frame in which the landmarks are known: `load_cell` or `limb`.
        where: What names the landmarks in an error: the file and the frame.
        landmarks: Their coordinates by name, shape (3,) [m].
    """

    body: str
    triad: TriadLabels
    frame: str
    where: str
    landmarks: dict[str, FloatArray]

    def names(self) -> set[str]:
        """All names in the take that this side uses."""
        triad = {self.triad} if isinstance(self.triad, str) else set(self.triad)
        return triad | set(self.landmarks)


@dataclass(frozen=True)
class LandmarkFile:
    """Which marker of a static take is what.

    Attributes:
        socket: The socket's triad, and landmarks known in {S}.
        pylon: The pylon's triad, and landmarks known in the limb's frame.
    """

    socket: Side
    pylon: Side


def read_landmarks(path: Path) -> LandmarkFile:
    """Read LANDMARKS.yaml.

    Raises:
        ConfigurationError: If the file is missing or anything in it is not as it must be.
    """
    document = read_document(path).expect(("bodies", "load_cell", "limb"))
    document.section("bodies").expect(("socket", "pylon"))
    socket, pylon = _side(document, "socket", "load_cell"), _side(document, "pylon", "limb")
    # The socket and the limb move against each other: no marker is on both.
    for name in sorted(socket.names() & pylon.names()):
        raise ConfigurationError(
            f"{path}: '{name}' is on the socket's side and on the limb's",
            "name each marker on one side",
        )
    return LandmarkFile(socket, pylon)


def _side(document: Section, body: str, frame: str) -> Side:
    section = document.section(frame)
    triad = _labels(document.section("bodies"), body)
    return Side(body, triad, frame, section.where, _coordinates(section))


def _labels(bodies: Section, body: str) -> TriadLabels:
    value = bodies.take(body)
    if isinstance(value, dict):
        return bodies.section(body).expect(("rigid_body",)).text("rigid_body")
    names = tuple(map(str, value)) if isinstance(value, list) else ()
    if len(set(names)) != 3 or len(names) != 3:
        raise ConfigurationError(
            f"{bodies.where}: {body} names no three markers",
            "give the names of three different markers, or 'rigid_body: NAME'",
        )
    return names


def _coordinates(section: Section) -> dict[str, FloatArray]:
    names = section.names()
    if len(names) < _FEWEST:
        raise ConfigurationError(
            f"{section.where}: {len(names)} landmarks hold no frame",
            f"give {_FEWEST} or more that are not on one line",
        )
    return {name: section.array(name, (3,), limit=_FARTHEST) for name in names}
