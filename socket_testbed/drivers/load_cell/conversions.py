"""Conversions and their times: when each was measured, and the last of them."""

from __future__ import annotations

import math

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray

_SINC3_LONGEST = 1024  # a higher oversampling is reached by a sinc1 behind it
_PAUSE = 1.95  # periods; two conversions wait, a third would be lost
_BRIDGES = 6
_ROWS = 200_000  # 11 MB


def conversion_period(clock_in: float, oversampling: int) -> float:
    """Time from one conversion to the next [s], for a clock [Hz]."""
    return 2.0 * oversampling / clock_in


def group_delay(clock_in: float, oversampling: int) -> float:
    """Time from what a conversion measures to its end [s], for a clock [Hz].

    A sinc3 filter spans three of its periods, so its middle is 1.5 of them back. Above 1024
    its oversampling stays 1024 and a mean of oversampling / 1024 of its outputs follows, whose
    middle is further back by half its span (datasheet SBAS950B, table 8-3).
    """
    inner = min(oversampling, _SINC3_LONGEST)
    return (1.5 * inner + 0.5 * (oversampling - inner)) * 2.0 / clock_in


class ConversionClock:
    """Tells when conversions ended, from when frames were read.

    A frame without new data says that no conversion waits; the next conversion ends within a
    period of it, and ahead of the frame that brings it. Conversions follow each other in equal
    steps, so the bounds of all of them together are much closer than a reader's pace.

    Args:
        period: Time from one conversion to the next [s].
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._empty: float | None = None
        self._last: float | None = None
        self._waiting = 0  # conversions read since none waited
        self._continuous = False

    def lose(self) -> None:
        """A frame was lost, or what waits is of unknown age: wait until nothing waits."""
        self._empty = None
        self._continuous = False

    def nothing_waits(self, begin: float) -> None:
        """A frame that was begun at this time [s] brought nothing new."""
        self._empty = begin
        self._waiting = 0

    def conversion_end(self, read: float) -> float | None:
        """When a conversion ended [s].

        Args:
            read: Time at which the frame that brought it was over [s].

        Returns:
            The time, or None if it is not known which conversion this is.
        """
        if self._empty is None:
            return None
        if read - self._empty > (self._waiting + _PAUSE) * self._period:
            self.lose()
            return None
        low = self._empty + self._waiting * self._period
        high = min(read, low + self._period)
        middle = 0.5 * (low + high)
        end = middle if self._last is None else self._next_end(self._last, middle)
        if abs(end - middle) > self._period:  # conversions paused, and begin anew
            end = middle
        self._last = min(max(end, low), high)
        self._waiting += 1
        self._continuous = True
        return self._last

    def _next_end(self, last: float, middle: float) -> float:
        """The step from the last conversion that was told, nearest to a time if some are lost."""
        steps = 1 if self._continuous else round((middle - last) / self._period)
        return last + self._period * steps


class ConversionRing:
    """The last conversions, in the order of their times.

    Args:
        period: Time from one conversion to the next [s].
        span: Time that is kept, as far as there is room [s].

    Attributes:
        span: Time that is kept [s].
    """

    def __init__(self, period: float, span: float) -> None:
        self._size = min(math.ceil(span / period), _ROWS)
        self.span = self._size * period
        # Every row stands twice, so that the rows kept are always in one piece.
        self._times = np.full(2 * self._size, -np.inf)
        self._ratios = np.zeros((2 * self._size, _BRIDGES))
        self._rails = np.zeros((2 * self._size, _BRIDGES), dtype=bool)
        self._next = 0

    def add(self, time: float, ratios: FloatArray, rails: BoolArray) -> None:
        """Add a conversion, later than all before.

        Args:
            time: When it was measured [s].
            ratios: Ratios of the bridges, shape (6,) [mV/V].
            rails: Whether each is clipped, shape (6,).
        """
        for row in (self._next, self._next + self._size):
            self._times[row] = time
            self._ratios[row] = ratios
            self._rails[row] = rails
        self._next = (self._next + 1) % self._size

    def between(self, start: float, end: float) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Conversions measured after `start` and until `end` [s].

        Returns:
            Their times, shape (n,) [s], ratios, shape (n, 6) [mV/V], and whether these are
            clipped, shape (n, 6).
        """
        kept = slice(self._next, self._next + self._size)
        first, last = self._next + np.searchsorted(self._times[kept], (start, end), side="right")
        rows = slice(first, max(first, last))
        return self._times[rows].copy(), self._ratios[rows].copy(), self._rails[rows].copy()
