"""Landmarks: the file that names them, the frame they place, and names that are swapped.

A residual shows a mix-up only as far as the landmarks' places differ. What it would not show is
reported, so that a person looks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from pathlib import Path
from typing import TypeAlias

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import ConfigurationError, RegistrationError
from socket_testbed.files import Section, read_document
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
Of three, or of more in one plane, a wrong sign may go unseen: better give a fourth off their plane.
"""


_MIRROR = np.array([1.0, 1.0, -1.0])
_SUSPECT = 0.001  # [m]; a smaller residual raises no question
_BETTER = 1.5  # [-]; how many times better another explanation fits than errors would let it
_AS_GOOD = 2.0  # [-]; two explanations that fit alike
_POOR = 0.002  # [m]; an explanation that fits worse is none to follow
_UNSEEN = 0.002  # [m]; a mix-up with a smaller residual goes unnoticed
_SIGNS = "the signs of their coordinates, and that the take was exported with right-handed axes"
_MOST_ORDERED = 6  # landmarks of which every order is tried


def refuse_mix_ups(known: FloatArray, measured: FloatArray, names: Sequence[str]) -> None:
    """Refuse landmarks that fit better under other names, mirrored, or both.

    Args:
        known: Landmarks in the frame to register, shape (k, 3) [m].
        measured: The same landmarks in another frame, shape (k, 3) [m].
        names: Names of the k landmarks.

    Raises:
        RegistrationError: Naming what explains the landmarks better, each with its residual. It
            advises an exchange of names only if nothing else fits about as well.
    """
    orders = _orders(len(names))
    exchanged = _misfits(known, measured[orders])
    mirrored = np.full(len(orders), np.inf)
    if not in_one_plane(known):  # their mirror image is what another rotation shows, too
        mirrored = _misfits(known * _MIRROR, measured[orders])
    named, best = exchanged[0], min(exchanged.min(), mirrored.min())
    if named <= _SUSPECT or named <= _BETTER * best:
        return
    swap = _plainest(orders, exchanged, _AS_GOOD * best)
    mirror = _plainest(orders, mirrored, _AS_GOOD * best)
    hint = "check which landmark is which"
    who, words = ", ".join(names), []
    if mirror is not None:
        hint = f"check {_SIGNS}" if swap is None else f"{hint}, and {_SIGNS}"
        here, how = _exchange(names, orders[mirror])
        also = f", with {here} {how}" if here else ""
        words = [f"with {1e3 * mirrored[mirror]:.1f} mm mirrored{also}"]
    if swap is not None:
        here, how = _exchange(names, orders[swap])
        who, here = (who, here) if words else (here, "they")
        words += [f"with {1e3 * exchanged[swap]:.1f} mm if {here} are {how}"]
    if best > _POOR:
        hint += ": nothing fits well, so measure their coordinates again"
    elif mirror is None:
        hint = "exchange their names or their coordinates"
    raise RegistrationError(
        f"landmarks {who} fit with {1e3 * named:.1f} mm as they are named, {', '.join(words)}", hint
    )


def in_one_plane(points: FloatArray) -> bool:
    """Whether landmarks are so close to one plane that their mirror image fits as well.

    Args:
        points: The landmarks, shape (k, 3) [m].
    """
    return float(_misfits(points * _MIRROR, points[None])[0]) < _UNSEEN


def _plainest(orders: IntArray, misfits: FloatArray, most: float) -> int | None:
    """The order that moves the fewest landmarks, of those that fit this well; None if none does."""
    alike = np.flatnonzero(misfits <= most)
    moved = (orders[alike] != orders[0]).sum(axis=1)
    return int(alike[moved.argmin()]) if len(alike) else None


def _exchange(names: Sequence[str], order: IntArray) -> tuple[str, str]:
    """Which landmarks an order exchanges, and how."""
    moved = [(name, names[i]) for name, i in zip(names, order, strict=True) if name != names[i]]
    here, there = (" and ".join(pair[side] for pair in moved) for side in (0, 1))
    return here, "swapped" if len(moved) == 2 else f"taken for {there}"


def unseen_mix_ups(known: FloatArray, names: Sequence[str]) -> tuple[str, ...]:
    """What mix-ups of the landmarks would leave too small a residual to be seen.

    Args:
        known: Landmarks in the frame to register, shape (k, 3) [m].
        names: Names of the k landmarks.
    """
    misfits = _misfits(known, known[_swaps(len(names))])
    unseen = [
        f"{a} and {b} could be swapped unseen ({1e3 * rms:.1f} mm): check which is which"
        for (a, b), rms in zip(combinations(names, 2), misfits, strict=True)
        if rms < _UNSEEN
    ]
    if in_one_plane(known):
        unseen.append(
            f"{', '.join(names)} lie in one plane: a wrong sign of a coordinate would not be seen"
        )
    return tuple(unseen)


def _misfits(known: FloatArray, measured: FloatArray) -> FloatArray:
    """Root-mean-square residuals of M sets of measured points, shape (M,) [m]."""
    return root_mean_square(misfit(known, measured, fit_rigid(known, measured)))


def _swaps(count: int) -> IntArray:
    swaps = np.tile(np.arange(count), (count * (count - 1) // 2, 1))
    for order, (a, b) in zip(swaps, combinations(range(count), 2), strict=True):
        order[[a, b]] = b, a
    return swaps


def _orders(count: int) -> IntArray:
    """Orders of the landmarks, the first being the one that is named."""
    if count <= _MOST_ORDERED:
        return np.array(list(permutations(range(count))))
    return np.concatenate([np.arange(count)[None], _swaps(count)])


_FEWEST = 3
_SMALLEST = 0.005  # [m]; landmarks closer to each other or to one line hold no rotation


@dataclass(frozen=True)
class LandmarkFit:
    """A frame registered by k landmarks.

    Attributes:
        names: Names of the landmarks.
        pose: Pose of the frame in which they are known, in the frame in which they are measured.
        residual: Distances of the landmarks from where the fit puts them, shape (k,) [m].
        noise: 1-sigma error of a coordinate of a landmark [m].
        degrees: Degrees of freedom of the residual, 3k - 6.
        uncertainty: 1-sigma uncertainty of the pose, in the axes of the known frame.
        blind: What mix-ups of the landmarks no residual would show.
    """

    names: tuple[str, ...]
    pose: Pose
    residual: FloatArray
    noise: float
    degrees: int
    uncertainty: PoseUncertainty
    blind: tuple[str, ...]

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

    Raises:
        RegistrationError: If there are fewer than three landmarks, if they lie together or on
            one line, or if they fit better under other names or mirrored.
    """
    if len(names) < _FEWEST:
        raise RegistrationError(
            f"{len(names)} landmarks ({', '.join(names) or 'none'}) hold no frame",
            f"give {_FEWEST} or more that are not on one line",
        )
    _require_spread(known, names, "are given")
    _require_spread(measured, names, "were measured")
    refuse_mix_ups(known, measured, names)

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
        blind=unseen_mix_ups(known, names),
    )


def _require_spread(points: FloatArray, names: Sequence[str], how: str) -> None:
    for a, b in combinations(range(len(names)), 2):
        apart = float(np.linalg.norm(points[a] - points[b]))
        if apart < _SMALLEST:
            raise RegistrationError(
                f"landmarks {names[a]} and {names[b]} {how} {1e3 * apart:.1f} mm apart",
                "give landmarks far from each other",
            )
    stretch = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    off_line = float(np.hypot(stretch[1], stretch[2]) / np.sqrt(len(names)))
    if off_line < _SMALLEST:
        raise RegistrationError(
            f"landmarks {', '.join(names)} {how} on one line (within {1e3 * off_line:.1f} mm)",
            "move one of them away from the line of the others",
        )


_FARTHEST = 2.0  # [m]; what is farther is in another unit

TriadLabels: TypeAlias = str | tuple[str, ...]


@dataclass(frozen=True)
class Side:
    """A marker body and the landmarks that are rigid to it.

    Attributes:
        body: The body, `socket` or `pylon`.
        triad: The names of its own three to eight markers, or that of a rigid body.
        frame: The frame in which the landmarks are known: `load_cell` or `limb`.
        where: What names the landmarks in an error: the file and the frame.
        landmarks: Their coordinates by name, shape (3,) [m].
    """

    body: str
    triad: TriadLabels
    frame: str
    where: str
    landmarks: dict[str, FloatArray]

    def points(self) -> FloatArray:
        """The landmarks' coordinates, shape (k, 3) [m]."""
        return np.array(list(self.landmarks.values()))

    def names(self) -> set[str]:
        """All names in the take that this side uses."""
        triad = {self.triad} if isinstance(self.triad, str) else set(self.triad)
        return triad | set(self.landmarks)


@dataclass(frozen=True)
class LandmarkFile:
    """Which marker of a static take is what.

    Attributes:
        socket: The socket's markers, and landmarks known in {S}.
        pylon: The pylon's markers, and landmarks known in the limb's frame.
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
    if len(set(names)) != len(names) or not FEWEST_MARKERS <= len(names) <= MOST_MARKERS:
        raise ConfigurationError(
            f"{bodies.where}: {body} names no three to eight markers",
            "give the names of three to eight different markers, or 'rigid_body: NAME'",
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
