"""Time since the epoch that no step of the system clock disturbs.

The processes of one graph share where it begins, in an environment variable: one that is started
again later, when the system clock has been set, still tells the same time as the others.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

BEGINNING = "SOCKET_TESTBED_BEGINNING"  # of the steady clock, since the epoch [ns]


class SteadyClock:
    """The system clock as it was once, advanced by the steady clock.

    Args:
        wall: The system clock, since the epoch [ns].
        steady: The steady clock, since some moment [ns].

    Attributes:
        beginning: Time since the epoch at which the steady clock was zero [ns].
    """

    def __init__(
        self,
        wall: Callable[[], int] = time.time_ns,
        steady: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._wall = wall
        self._steady = steady
        shared = os.environ.get(BEGINNING)
        self.beginning = int(shared) if shared else wall() - steady()

    def now(self) -> int:
        """Time since the epoch [ns]; it never goes back."""
        return self._steady() + self.beginning

    def to_epoch(self, steady_seconds: float) -> int:
        """Time since the epoch [ns] of a time of the steady clock [s]."""
        return round(steady_seconds * 1e9) + self.beginning

    def to_steady(self, stamp: int) -> float:
        """Time of the steady clock [s] of a time since the epoch [ns]."""
        return (stamp - self.beginning) * 1e-9

    def step(self) -> float:
        """How far the system clock was set forward (negative: back) since this was made [s]."""
        return (self._wall() - self.now()) * 1e-9
