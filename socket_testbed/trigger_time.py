"""The time of a trigger, told by its stamp, on the steady clock of this process."""

from __future__ import annotations

from socket_testbed.steady_clock import SteadyClock

_EARLY = 0.002  # [s]; how much two processes may differ about the time
_LATE = 0.5  # [s]; how late a trigger may arrive
_TRAVEL = 0.0005  # [s]; how long it usually takes


class TriggerTime:
    """Puts triggers on the steady clock.

    Every process takes the system clock once, at its start. If that clock was set between the
    starts of two of them, a stamp seems to come from the future or from long ago: then the time
    of its arrival tells how far they differ.

    Attributes:
        shift: How far the trigger's clock is from this process's [s]; 0 as a rule.
    """

    def __init__(self, clock: SteadyClock) -> None:
        self._clock = clock
        self.shift = 0.0

    def steady(self, stamp: int, arrival: float) -> float:
        """Time of a trigger on the steady clock [s].

        Args:
            stamp: Its stamp since the epoch [ns].
            arrival: When it arrived, on the steady clock [s].
        """
        plain = self._clock.to_steady(stamp)
        for shift in (self.shift, 0.0):
            if -_EARLY <= arrival - (plain + shift) <= _LATE:
                self.shift = shift
                return plain + shift
        self.shift = arrival - _TRAVEL - plain
        return plain + self.shift
