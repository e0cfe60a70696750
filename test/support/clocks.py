"""A clock for tests that never wait, and how fast others let a simulated testbed run."""

from typing import Self

import pytest

from socket_testbed import clocks
from socket_testbed.live.scheduling import SLOWEST, measure_speed


def careful_time_scale() -> float:
    """What this machine manages, on a busy one with a reserve for what starts meanwhile [-]."""
    scale = measure_speed().time_scale()
    return scale if scale == 1.0 else max(0.5 * scale, SLOWEST)


class FakeClock:
    """A steady clock [s] that only sleeping moves on, and looking at it if that takes time."""

    def __init__(self, now: float = 100.0, look: float = 0.0) -> None:
        self.now = now
        self._look = look

    def __call__(self) -> float:
        self.now += self._look
        return self.now

    def sleep(self, duration: float) -> None:
        assert duration >= 0.0
        self.now += duration

    def install(self, monkeypatch: pytest.MonkeyPatch) -> Self:
        """Let all of this process go by it."""
        monkeypatch.setattr(clocks, "monotonic", self)
        monkeypatch.setattr(clocks, "sleep", self.sleep)
        return self
