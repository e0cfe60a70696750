"""The timing of a replay: each message at its time, paused and stopped from elsewhere."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

_TICK_PERIOD = 0.02  # [s]; of the clock between messages


class Pacer:
    """Waits until each message of a recording is due.

    Args:
        rate: Speed against the recording [-].
        tick: Called with the time of the recording [ns] as it passes.
        paused: Whether it starts paused.
    """

    def __init__(self, rate: float, tick: Callable[[int], None], paused: bool = False) -> None:
        self._rate = rate
        self._tick = tick
        self._stopping = threading.Event()
        self._going = threading.Event()
        if not paused:
            self._going.set()
        self._first = 0
        self._start = 0.0

    @property
    def stopped(self) -> bool:
        """Whether it is stopped."""
        return self._stopping.is_set()

    def pause(self) -> None:
        """Let no further message become due."""
        self._going.clear()

    def resume(self) -> None:
        """Go on where it was paused."""
        self._going.set()

    def stop(self) -> None:
        """Wait for nothing any more."""
        self._stopping.set()
        self._going.set()

    def rest(self, duration: float) -> None:
        """Do nothing for a while [s], or until it is stopped."""
        self._stopping.wait(duration)

    def begin(self, first: int) -> None:
        """Begin a pass over the recording, whose first message is from `first` [ns]."""
        self._first, self._start = first, time.monotonic()

    def wait_for(self, stamp: int) -> bool:
        """Wait until the message of a time [ns] is due, the clock ticking; False if stopped."""
        while True:
            if not self._going.is_set():  # a pause moves everything that follows
                before = time.monotonic()
                self._going.wait()
                self._start += time.monotonic() - before
            if self.stopped:
                return False
            due = self._start + (stamp - self._first) * 1e-9 / self._rate
            if (left := due - time.monotonic()) <= 0.0:
                self._tick(stamp)
                return True
            self._tick(stamp - round(left * self._rate * 1e9))
            self._stopping.wait(min(left, _TICK_PERIOD))
