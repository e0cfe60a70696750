"""The testbed's clock: its scale, its relation to the epoch, and retry intervals.

A simulated testbed may run slower than real time, so that a busy machine keeps up. All code that
waits or reads the time (trigger, chips, bus transfers, NatNet, physics, nodes) therefore uses
`monotonic`, `sleep` and `real` of this module. On hardware the scale is 1.

The processes of one graph share the origin of the clock in an environment variable. A process that
is restarted after the system clock was set still agrees with the others.
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
    """The scale from the environment; exits with an error if it is invalid."""
    text = os.environ.get(TIME_SCALE, "1")
    try:
        if 0.0 < float(text) <= 1.0:
            return float(text)
    except ValueError:
        pass
    raise SystemExit(f"error: {TIME_SCALE}={text}: set a number above 0, 1 at most, or unset it")


_scale = _inherited_scale()


def time_scale() -> float:
    """Testbed seconds per real second [-]; 1 on hardware."""
    return _scale


def shared_environment(scale: float = 1.0) -> dict[str, str]:
    """Environment variables that give the processes of one testbed the same clock.

    They hold the clock's origin and its scale, in testbed seconds per real second, 0 to 1 [-].
    """
    beginning = time.time_ns() - round(time.monotonic_ns() * scale)
    return {TIME_SCALE: str(scale), BEGINNING: str(beginning)}


def monotonic() -> float:
    """Time of the testbed's steady clock [s]; all processes of a testbed read the same time."""
    return time.monotonic() * _scale


def monotonic_ns() -> int:
    """Time of the testbed's steady clock [ns]."""
    return time.monotonic_ns() if _scale == 1.0 else round(time.monotonic_ns() * _scale)


def sleep(seconds: float) -> None:
    """Sleep for some testbed seconds [s]."""
    time.sleep(seconds / _scale)


def real(seconds: float) -> float:
    """Convert testbed seconds to real seconds [s], as for the timeout of an event or a socket."""
    return seconds / _scale


class SteadyClock:
    """The system clock at startup, advanced by the steady clock; both in ns.

    Attributes:
        beginning: Time since the epoch at zero of the steady clock [ns].
    """

    def __init__(
        self, wall: Callable[[], int] = time.time_ns, steady: Callable[[], int] = monotonic_ns
    ) -> None:
        self._wall = wall
        self._steady = steady
        shared = os.environ.get(BEGINNING)
        self.beginning = int(shared) if shared else wall() - steady()

    def now(self) -> int:
        """Time since the epoch [ns]; monotonic."""
        return self._steady() + self.beginning

    def to_epoch(self, steady_seconds: float) -> int:
        """Time since the epoch [ns] of a time of the steady clock [s]."""
        return round(steady_seconds * 1e9) + self.beginning

    def to_steady(self, stamp: int) -> float:
        """Time of the steady clock [s] of a time since the epoch [ns]."""
        return (stamp - self.beginning) * 1e-9

    def step(self) -> float:
        """Step of the system clock since creation [s]; positive if it was set forward."""
        return (self._wall() - self.now()) * 1e-9


_MIN_STEP_BACK = 0.001  # [s]; the slewing of NTP is slower


class StepsBack:
    """Notices that the system clock was set back.

    Args:
        wall: The system clock [s].
        steady: The steady clock of the machine [s].
    """

    def __init__(
        self,
        wall: Callable[[], float] = time.time,
        steady: Callable[[], float] = time.monotonic,
    ) -> None:
        self._wall = wall
        self._steady = steady
        self._difference = wall() - steady()

    def noticed(self) -> bool:
        """Whether the system clock was set back since the last call, by more than 1 ms."""
        before, self._difference = self._difference, self._wall() - self._steady()
        return self._difference < before - _MIN_STEP_BACK


_MAX_SKEW = 0.002  # [s]; clock difference between two processes
_MAX_DELAY = 0.5  # [s]; of a trigger's arrival
_MAX_SPREAD = 0.005  # [s]; of the differences of triggers that are not delayed
_MIN_TRIGGERS = 5
_LATENCY = 0.0005  # [s]; typical, of a trigger


class TriggerTime:
    """Converts trigger stamps to the steady clock.

    Processes that were not started together read the system clock at different times. If it was set
    in between, all stamps are off by the same amount, which shows when triggers arrive. Delayed
    triggers are off by varying amounts.

    Attributes:
        shift: Time of the steady clock at a trigger, less the time that this process's
            `SteadyClock` gives its stamp [s]; normally 0.
    """

    def __init__(self, clock: SteadyClock) -> None:
        self._clock = clock
        self._differences: deque[float] = deque(maxlen=_MIN_TRIGGERS)
        self.shift = 0.0

    def steady(self, stamp: int, arrival: float) -> float:
        """Time of a trigger on the steady clock [s]; minus infinity while unknown.

        Args:
            stamp: The trigger's stamp, since the epoch [ns].
            arrival: Time at which this process received the trigger, on the steady clock [s].
        """
        plain = self._clock.to_steady(stamp)
        for shift in (self.shift, 0.0):
            if -_MAX_SKEW <= arrival - (plain + shift) <= _MAX_DELAY:
                self.shift = shift
                self._differences.clear()
                return plain + shift
        self._differences.append(arrival - plain)
        spread = max(self._differences) - min(self._differences)
        if len(self._differences) < _MIN_TRIGGERS or spread > _MAX_SPREAD:
            return -math.inf
        self.shift = min(self._differences) - _LATENCY
        return plain + self.shift

    def stamp(self, moment: float) -> int:
        """Stamp [ns] that the trigger would give a time of the steady clock [s]."""
        return self._clock.to_epoch(moment - self.shift)


_MAX_INTERVALS = 5
_MIN_INTERVALS = 3  # a late trigger makes one of them too long


class TriggerPeriod:
    """Time between triggers: the median of the last three or more intervals.

    Gaps in the sequence account for missed pulses; the median ignores pauses, late triggers and
    the short intervals after them.

    Args:
        most: Largest number of intervals that count [1].
    """

    def __init__(self, most: int = _MAX_INTERVALS) -> None:
        self._last: tuple[int, int] | None = None
        self._intervals: deque[float] = deque(maxlen=most)

    def add(self, stamp: int, sequence: int) -> float:
        """Add a trigger; returns the period [s], 0 until three intervals are known.

        Args:
            stamp: The trigger's stamp, since the epoch [ns].
            sequence: The trigger's number. Numbers that do not increase belong to another trigger
                node, so that the period is unknown again.
        """
        if self._last is not None:
            duration, pulses = stamp - self._last[0], sequence - self._last[1]
            if duration > 0 and pulses > 0:
                self._intervals.append(1e-9 * duration / pulses)
            else:
                self._intervals.clear()
        self._last = stamp, sequence
        return median_low(self._intervals) if len(self._intervals) >= _MIN_INTERVALS else 0.0


_MIN_WAIT = 0.05  # [s]
_MAX_WAIT = 0.4  # [s]; a recovery is noticed within a second


class Backoff:
    """Retry intervals: a failure doubles the wait up to the longest [s], a success resets it.

    Waits are in testbed seconds; the first is 0.05 s.
    """

    def __init__(self, longest: float = _MAX_WAIT) -> None:
        self._longest = longest
        self._wait = 0.0
        self._next = 0.0

    def due(self, now: float) -> bool:
        """Whether an attempt is due at a time of the steady clock [s]."""
        return now >= self._next

    def failed(self, now: float) -> float:
        """Note a failed attempt at a time of the steady clock [s]; returns the next wait [s]."""
        self._wait = min(2.0 * self._wait, self._longest) if self._wait else _MIN_WAIT
        self._next = now + self._wait
        return self._wait

    def succeeded(self) -> None:
        """Note a successful attempt."""
        self._wait = self._next = 0.0
