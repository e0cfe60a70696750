"""Takes of motion capture, exported to tables, as poses with their own times."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from socket_testbed.alignment.series import PoseSeries
from socket_testbed.arrays import FloatArray
from socket_testbed.errors import ConfigurationError, closest, listed
from socket_testbed.geometry.marker_bodies import fit_body
from socket_testbed.geometry.pose import Pose
from socket_testbed.socket_design.motive import read_motive_csv

_SECOND = 1_000_000_000  # [ns]
_MAX_LISTED = 6
_MIN_FITTED = 0.5  # share of the frames with all markers that must fit the body


@dataclass(frozen=True)
class Take:
    """What an export of motion capture holds, N frames.

    Attributes:
        path: The file.
        program: The program that wrote it.
        times: Time of each frame since the start of the take, shape (N,) [s].
        bodies: N poses of each rigid body in `world` by its name; NaN where it is not tracked.
        markers: Positions of each marker in `world` by its name, shape (N, 3) [m]; NaN where
            occluded.
        notes: Remarks for the user.
    """

    path: Path
    program: str
    times: FloatArray
    bodies: dict[str, Pose]
    markers: dict[str, FloatArray]
    notes: tuple[str, ...]

    def markers_of(self, body: str) -> tuple[str, ...]:
        """Names of the markers of a body, those that begin with `BODY:`."""
        return tuple(name for name in self.markers if name.startswith(f"{body}:"))

    @property
    def names(self) -> list[str]:
        """Names of the bodies, of rigid bodies and of markers called `BODY:...`."""
        labelled = [name.partition(":")[0] for name in self.markers if ":" in name]
        return list(dict.fromkeys([*self.bodies, *labelled]))


def is_take(text: str) -> bool:
    """Whether a file's text begins like an export of motion capture that `read_take` knows.

    Args:
        text: The first lines.
    """
    return text.lstrip('\ufeff" \t\r\n').startswith("Format Version")


def read_take(path: Path) -> Take:
    """Read an export of motion capture, here of Motive.

    Raises:
        RegistrationError: If it is not complete.
    """
    take = read_motive_csv(path)
    return Take(path, "Motive", take.times, take.bodies, take.markers, take.notes)


def take_poses(take: Take, body: str, reference: FloatArray) -> tuple[PoseSeries, tuple[str, ...]]:
    """Poses of a body of a take, and notes.

    The poses of a rigid body are those of the program that wrote the take. Without one, the markers
    called `BODY:...`, or those that are named one by one, are fitted to the markers of socket.yaml.

    Args:
        take: The take.
        body: The rigid body's name, or the names of markers with commas between them.
        reference: Markers of the body in its own frame, shape (k, 3) [m].

    Raises:
        ConfigurationError: If the take has no such body or markers, or they do not fit the body.
    """
    if body in take.bodies:
        pose = take.bodies[body]
        notes = (f"{take.path.name}: the pose of '{body}' is that of {take.program}'s rigid body:"
                 " socket.yaml must state its place",)  # fmt: skip
    else:
        pose = _fitted(take, body, reference)
        notes = (f"{take.path.name}: '{body}' is fitted to the markers of socket.yaml",)
    seen = np.isfinite(pose.translation).all(axis=1)
    if not seen.any():
        raise ConfigurationError(
            f"{take.path.name}: '{body}' is never tracked", "choose another body"
        )
    times = np.round(take.times * _SECOND).astype(np.int64)[seen]
    vectors = pose.vector[seen]
    return PoseSeries(times, vectors[:, :3], vectors[:, 3:], "world"), notes


def _fitted(take: Take, body: str, reference: FloatArray) -> Pose:
    """Poses fitted to markers."""
    names = take.markers_of(body) or tuple(name.strip() for name in body.split(","))
    unknown = [name for name in names if name not in take.markers]
    if unknown:
        known = [*take.names, *take.markers]
        raise ConfigurationError(
            f"{take.path.name}: has no body or marker '{unknown[0]}'", closest(unknown[0], known)
        )
    if len(names) != len(reference):
        raise ConfigurationError(
            f"{take.path.name}: '{body}' has {len(names)} markers"
            f" ({listed(list(names), _MAX_LISTED)}), socket.yaml {len(reference)}",
            "name the markers with commas between them, or give the socket.yaml of this socket",
        )
    observed = np.stack([take.markers[name] for name in names], axis=1)
    pose = fit_body(reference, observed).pose
    complete = np.isfinite(observed).all(axis=(1, 2))
    fits = np.isfinite(pose.translation).all(axis=1)
    if complete.any() and fits[complete].mean() < _MIN_FITTED:
        raise ConfigurationError(
            f"{take.path.name}: the markers of '{body}' do not have the distances of socket.yaml",
            "give the socket.yaml that these markers were registered for",
        )
    return pose
