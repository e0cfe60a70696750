"""What the cameras of a simulated Motive see: bodies, their markers, and which are hidden."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed.arrays import FloatArray
from socket_testbed.simulation.devices.natnet_encoding import (
    HAS_MODEL,
    OCCLUDED,
    SOLVED,
    Body,
    Content,
    Definition,
    Marker,
)

# Name, markers in the world (m, 3) [m], position (3,) [m], quaternion (4,), each body's.
Bodies: TypeAlias = Callable[[float], Sequence[tuple[str, FloatArray, FloatArray, FloatArray]]]

_CHANGED = 24  # frames that say that the rigid bodies have changed


class Scene:
    """Makes frames of bodies.

    Args:
        bodies: The bodies at a time of the steady clock [s].
        faults: The faults `mocap.occlude` and `mocap.swap`, looked up live.
        noise: Standard deviation of a marker's coordinate [m].
        rng: Source of what is random.
    """

    def __init__(
        self, bodies: Bodies, faults: Mapping[str, float], noise: float, rng: np.random.Generator
    ) -> None:
        self._bodies = bodies
        self._faults = faults
        self._noise = noise
        self._rng = rng
        self._ids: dict[str, int] = {}
        self._names: tuple[str, ...] = ()
        self._seen: dict[tuple[str, int], FloatArray] = {}
        self._changed = 0

    def start_anew(self) -> None:
        """Forget what was seen."""
        self._seen.clear()
        self._names = ()

    def definitions(self, moment: float) -> list[Definition]:
        """The rigid bodies as they are defined at a time of the steady clock [s]."""
        found = []
        for name, markers, position, quaternion in self._bodies(moment):
            in_body = Rotation.from_quat(quaternion).inv().apply(markers - position)
            found.append(Definition(name, self._identify(name), in_body))
        return found

    def content(
        self, moment: float, number: int, ticks: tuple[int, int, int], recording: bool
    ) -> Content:
        """The frame that is exposed at a time of the steady clock [s]."""
        bodies: list[Body] = []
        labelled: list[Marker] = []
        sets: dict[str, FloatArray] = {}
        scene = self._bodies(moment)
        names = tuple(name for name, *_ in scene)
        if names != self._names:
            self._changed = _CHANGED if self._names else 0
            self._names = names
        self._changed = max(0, self._changed - 1)
        for name, true, position, quaternion in scene:
            identity = self._identify(name)
            markers, hidden = self._observe(name, np.asarray(true, dtype=float))
            bodies.append(Body(identity, position, quaternion, markers, not hidden.any()))
            sets[name] = markers
            for k in range(len(markers)):
                flags = HAS_MODEL | (OCCLUDED if hidden[k] else SOLVED)
                labelled.append(Marker(identity, k + 1, markers[k], flags))
        return Content(
            number=number,
            ticks=ticks,
            timestamp=(ticks[0] % 10**14) * 1e-7,
            bodies=bodies,
            markers=labelled,
            marker_sets=sets,
            others=np.array([[1.0, 2.0, 0.5]]),  # a reflection on the floor
            recording=recording,
            models_changed=self._changed > 0,
        )

    def _identify(self, name: str) -> int:
        return self._ids.setdefault(name, len(self._ids) + 1)

    def _observe(self, name: str, true: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Markers by their labels, and which of them are hidden."""
        markers = true + self._rng.normal(0.0, self._noise, true.shape) if self._noise else true
        markers = markers.copy()
        hidden = np.zeros(len(markers), dtype=bool)
        occluded = round(self._faults.get("mocap.occlude", 0.0)) - 1
        for k in range(len(markers)):
            if k == occluded:  # its last position is told on, as Motive does
                hidden[k] = True
                markers[k] = self._seen.get((name, k), markers[k])
            else:
                self._seen[name, k] = markers[k].copy()
        if self._rng.random() < self._faults.get("mocap.swap", 0.0):
            a, b = self._rng.choice(len(markers), 2, replace=False)
            markers[[a, b]] = markers[[b, a]]
            hidden[[a, b]] = hidden[[b, a]]
        return markers, hidden
