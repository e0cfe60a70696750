"""A take of the motion capture: rigid bodies and markers over its frames."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.documents import closest
from socket_testbed.errors import RegistrationError
from socket_testbed.geometry.pose import Pose

_UNNAMED = ("Unlabeled", "Unlabelled")


@dataclass(frozen=True)
class TrackedBody:
    """A rigid body as Motive tracked it over N frames.

    Attributes:
        pose: Poses of Motive's body frame in `world`; NaN where the body was not tracked.
        error: Motive's mean error of a marker, shape (N,), taken to metres with the unit of
            the positions; NaN where it was not exported.
    """

    pose: Pose
    error: FloatArray


@dataclass(frozen=True)
class MotiveTake:
    """A take that Motive exported, N frames of it.

    Attributes:
        path: File of the take.
        version: Version of the format.
        frame_rate: Frame rate of the export [Hz].
        units: Unit of length in the file, as written there; all below is in metres.
        frames: Frame numbers, shape (N,).
        times: Times since the start of the take, shape (N,) [s].
        bodies: Rigid bodies by name.
        markers: Measured markers by name, in `world`, shape (N, 3) [m]; NaN where occluded.
        solved: Markers where Motive's rigid bodies expect them, likewise.
        doubled: Names that stand twice among the bodies, markers or solved markers; what has
            such a name is not read.
        notes: What a person should know of the file.
    """

    path: Path
    version: str
    frame_rate: float
    units: str
    frames: IntArray
    times: FloatArray
    bodies: dict[str, TrackedBody]
    markers: dict[str, FloatArray]
    solved: dict[str, FloatArray]
    doubled: frozenset[str]
    notes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.frames)

    def body(self, name: str) -> TrackedBody:
        """A rigid body.

        Raises:
            RegistrationError: If the take does not have it.
        """
        if name not in self.bodies:
            raise self._missing("rigid body", name, self.bodies)
        return self.bodies[name]

    def stack(self, names: Iterable[str]) -> FloatArray:
        """Measured markers in `world`, shape (N, k, 3) [m]; NaN where occluded.

        Raises:
            RegistrationError: If the take does not have one of them, or only as a solved
                marker: that is where a rigid body expects it, not where it was seen.
        """
        return np.stack([self._marker(name) for name in names], axis=1)

    def markers_of(self, body: str) -> tuple[str, ...]:
        """Names of the measured markers of a rigid body.

        Raises:
            RegistrationError: If the take does not have the body.
        """
        self.body(body)
        return tuple(name for name in self.markers if name.startswith(f"{body}:"))

    def _marker(self, name: str) -> FloatArray:
        if name in self.markers:
            return self.markers[name]
        if name in self.solved:
            raise RegistrationError(
                f"{self.path}: '{name}' is where a rigid body expects a marker, not a measured one",
                "export the take with its markers ('Markers' in Motive's export)",
            )
        raise self._missing("marker", name, self.markers)

    def _missing(self, what: str, name: str, known: Collection[str]) -> RegistrationError:
        if name in self.doubled:
            return RegistrationError(
                f"{self.path}: the name '{name}' stands twice", "rename one in Motive"
            )
        labelled = [word for word in known if not word.startswith(_UNNAMED)]
        return RegistrationError(f"{self.path}: has no {what} '{name}'", closest(name, labelled))
