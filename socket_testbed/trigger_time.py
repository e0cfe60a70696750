"""The time of a trigger, told by its stamp, on the steady clock of this process."""

from __future__ import annotations

import math
from collections import deque

from socket_testbed.steady_clock import SteadyClock

_EARLY = 0.002  # [s]; how much two processes may differ about the time
_LATE = 0.5  # [s]; how late a trigger may arrive
_ALIKE = 0.005  # [s]; spread of the differences of triggers that arrive as they are sent
_ENOUGH = 5  # triggers
_TRAVEL = 0.0005  # [s]; how long a trigger usually takes


class TriggerTime:
    """Puts triggers on the steady clock.

    Processes that were not started together take the system clock each at its own start. If that
    clock was set in between, stamps seem to come from the future or from long ago, all by the same
    difference: then their arrival tells it. Triggers that were held up come from long ago, too,
    but each by another difference.

    Attributes:
        shift: How far the trigger's clock is from this process's [s]; 0 as a rule.
    """

    def __init__(self, clock: SteadyClock) -> None:
        self._clock = clock
        self._differences: deque[float] = deque(maxlen=_ENOUGH)
        self.shift = 0.0

    def steady(self, stamp: int, arrival: float) -> float:
        """Time of a trigger on the steady clock [s]; minus infinity while it cannot be told.

        Args:
            stamp: Its stamp since the epoch [ns].
            arrival: When it arrived, on the steady clock [s].
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
