"""A source of the page that shows nothing; tests override what they show."""

from typing import Any

import numpy as np

from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.viewer.source import Instant, Recording, SensorState
from support.ring_socket import ring_socket

NOTHING = np.full(6, np.nan)


class StillSource:
    geometry = ring_socket()
    controls: Any = None
    playback = None

    def instant(self) -> Instant | None:
        return None

    def wrenches(self) -> tuple[Any, Any, Any]:
        return np.zeros(0), np.zeros((0, 6)), np.zeros((0, 6))

    def sensors(self) -> list[SensorState]:
        return []

    def recording(self) -> Recording | None:
        return None

    def regions(self) -> None:
        return None

    def watched(self, on: bool) -> None:
        pass


def estimate_of(pressure: np.ndarray, words: str) -> MapEstimate:
    """A map of pressures, shape (n,) [Pa], each known within a few percent."""
    p, none = pressure[None], np.zeros((1, len(pressure)))
    forces = np.zeros((1, len(pressure), 3))
    return MapEstimate(forces, forces, p, 0.02 * p, none, none, words)
