"""The testbed's clock: its scale, its relation to the epoch, and when to try again.

A simulated testbed may run slower than real time, so that a busy machine keeps up: everything
that waits or reads the time in it (trigger, chips, bus transfers, NatNet, physics, nodes) uses
`monotonic`, `sleep` and `real` of this module. On hardware the scale is 1.

The processes of one graph share where it begins, in an environment variable: one that is started
again later, when the system clock has been set, still reads the same time as the others.
"""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Callable
from statistics import median_low

BEGINNING = "SOCKET_TESTBED_BEGINNING"  # of the steady clock, since the epoch [ns]
TIME_SCALE = "SOCKET_TESTBED_TIME_SCALE"  # testbed seconds per real second, in (0, 1] [-]


def _inherited_scale() -> float:
    """The scale that this process was started with; a wrong one ends it with an error."""
    text = os.environ.get(TIME_SCALE, "1")
    try:
        if 0.0 < float(text) <= 1.0:
            return float(text)
    except ValueError:
        pass
    raise SystemExit(f"error: {TIME_SCALE}={text}: set a number above 0, 1 at most, or unset it")


_scale = _inherited_scale()


def time_scale() -> float:
    """Testbed seconds per real second of this process [-]; 1 on hardware."""
    return _scale


def shared_environment(scale: float = 1.0) -> dict[str, str]:
    """Environment of the processes of one testbed: its time scale [-] and where its time begins."""
    beginning = time.time_ns() - round(time.monotonic_ns() * scale)
    return {TIME_SCALE: str(scale), BEGINNING: str(beginning)}


def monotonic() -> float:
    """Time of the testbed's steady clock [s]; the same in all processes of a testbed."""
    return time.monotonic() * _scale


def monotonic_ns() -> int:
    """Time of the testbed's steady clock [ns]."""
    return time.monotonic_ns() if _scale == 1.0 else round(time.monotonic_ns() * _scale)


def sleep(seconds: float) -> None:
    """Sleep for testbed seconds [s]."""
    time.sleep(seconds / _scale)


def real(seconds: float) -> float:
    """Real seconds [s] that testbed seconds take, as the timeout of an event or a socket."""
    return seconds / _scale


class SteadyClock:
    """The system clock as it was once, advanced by the steady clock; both in ns."""

    def __init__(
        self, wall: Callable[[], int] = time.time_ns, steady: Callable[[], int] = monotonic_ns
    ) -> None:
        self._wall = wall
        self._steady = steady
        shared = os.environ.get(BEGINNING)
        # Time since the epoch at which the steady clock was zero [ns].
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


_EARLY = 0.002  # [s]; how much two processes may differ about the time
_LATE = 0.5  # [s]; how late a trigger may arrive
_ALIKE = 0.005  # [s]; spread of the differences of triggers that arrive as they are sent
_ENOUGH = 5  # triggers
_TRAVEL = 0.0005  # [s]; how long a trigger usually takes


class TriggerTime:
    """Puts triggers on the steady clock.

    Processes that were not started together take the system clock each at its own start. If that
    clock was set in between, stamps seem to come from the future or from long ago, all by the same
    difference: then their arrival shows it. Triggers that were held up come from long ago, too,
    but each by another difference.
    """

    def __init__(self, clock: SteadyClock) -> None:
        self._clock = clock
        self._differences: deque[float] = deque(maxlen=_ENOUGH)
        self.shift = 0.0  # [s]; how far the trigger's clock is from this process's; 0 as a rule

    def steady(self, stamp: int, arrival: float) -> float:
        """Time of a trigger on the steady clock [s]; minus infinity while it is unknown.

        Its stamp is since the epoch [ns], its arrival on the steady clock [s].
        """
        plain = self._clock.to_steady(stamp)
        for shift in (self.shift, 0.0):
            if -_EARLY <= arrival - (plain + shift) <= _LATE:
                self.shift = shift
                self._differences.clear()
                return plain + shift
        self._differences.append(arrival - plain)
        spread = max(self._differences) - min(self._differences)
        if len(self._differences) < _ENOUGH or spread > _ALIKE:
            return -math.inf
        self.shift = min(self._differences) - _TRAVEL
        return plain + self.shift


_INTERVALS = 5
_FEWEST = 3  # intervals; a late trigger makes one of them too long


class TriggerPeriod:
    """Time between triggers: the median of the last intervals, of three at least.

    A pulse that was not seen leaves a gap in the sequence and is allowed for; a pause, a late
    trigger and a short interval after it do not count.
    """

    def __init__(self) -> None:
        self._last: tuple[int, int] | None = None
        self._intervals: deque[float] = deque(maxlen=_INTERVALS)

    def add(self, stamp: int, sequence: int) -> float:
        """Add a trigger with its stamp [ns] and number; returns the period [s], 0 until known.

        Numbers that do not rise are those of another trigger node.
        """
        if self._last is not None:
            duration, pulses = stamp - self._last[0], sequence - self._last[1]
            if duration > 0 and pulses > 0:
                self._intervals.append(1e-9 * duration / pulses)
            else:
                self._intervals.clear()
        self._last = stamp, sequence
        return median_low(self._intervals) if len(self._intervals) >= _FEWEST else 0.0


_FIRST = 0.05  # [s]
_LONGEST = 0.4  # [s]; a recovery is seen within a second


class Backoff:
    """Spaces out attempts: a failure doubles the wait up to the longest [s], a success ends it."""

    def __init__(self, longest: float = _LONGEST) -> None:
        self._longest = longest
        self._wait = 0.0
        self._next = 0.0

    def due(self, now: float) -> bool:
        """Whether an attempt is due at a time of the steady clock [s]."""
        return now >= self._next

    def failed(self, now: float) -> None:
        """An attempt failed."""
        self._wait = min(2.0 * self._wait, self._longest) if self._wait else _FIRST
        self._next = now + self._wait

    def succeeded(self) -> None:
        """An attempt succeeded."""
        self._wait = self._next = 0.0
