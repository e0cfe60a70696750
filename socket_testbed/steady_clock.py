"""Time since the epoch that no step of the system clock disturbs."""

from __future__ import annotations

import time
from collections.abc import Callable


class SteadyClock:
    """The system clock as it was once, advanced by the steady clock.

    Args:
        wall: The system clock, since the epoch [ns].
        steady: The steady clock, since some moment [ns].
    """

    def __init__(
        self,
        wall: Callable[[], int] = time.time_ns,
        steady: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._wall = wall
        self._steady = steady
        self._offset = wall() - steady()

    def now(self) -> int:
        """Time since the epoch [ns]; it never goes back."""
        return self._steady() + self._offset

    def to_epoch(self, steady_seconds: float) -> int:
        """Time since the epoch [ns] of a time of the steady clock [s]."""
        return round(steady_seconds * 1e9) + self._offset

    def to_steady(self, stamp: int) -> float:
        """Time of the steady clock [s] of a time since the epoch [ns]."""
        return (stamp - self._offset) * 1e-9

    def step(self) -> float:
        """How far the system clock was set forward (negative: back) since this was made [s]."""
        return (self._wall() - self.now()) * 1e-9
