"""Which frames are taken: each once, in order, and of a time that can be."""

from __future__ import annotations

from socket_testbed.drivers.natnet.statistics import LinkStatistics

_EARLIEST, _LATEST = 1.0, 0.005  # [s]; before and after its arrival that a frame can be from
_ODD = 10  # frames in a row; of another server, not of the network
_SUSPICION = 2.0  # [s]; between two guesses that it is another server
_MOST_LOST = 1000  # frames


class FrameGate:
    """Drops and counts frames that come again, late, or from an implausible time.

    Args:
        statistics: Where they are counted.
    """

    def __init__(self, statistics: LinkStatistics) -> None:
        self._statistics = statistics
        self._number = -1
        self._behind = self._odd = 0
        self._suspected = float("-inf")

    def reset(self) -> None:
        """Another session begins: its frames may have any number."""
        self._number, self._behind, self._odd = -1, 0, 0

    def is_next(self, number: int, now: float) -> bool:
        """Whether a frame is newer than all before it."""
        if number <= self._number:
            self._statistics.count("late", now)
            self._behind += 1
            return False
        if self._number >= 0 and number > self._number + 1:
            self._statistics.count("lost", now, min(number - self._number - 1, _MOST_LOST))
        self._number, self._behind = number, 0
        return True

    def is_plausible(self, moment: float, now: float) -> bool:
        """Whether a frame that comes now can be from a time of the steady clock [s]."""
        if now - _EARLIEST <= moment <= now + _LATEST:
            self._odd = 0
            return True
        self._statistics.count("implausible", now)
        self._odd += 1
        return False

    def suspects(self, now: float) -> bool:
        """Whether so many frames in a row do not fit that the server must be another one."""
        if self._behind < _ODD and self._odd < _ODD:
            return False
        if now < self._suspected + _SUSPICION:
            return False
        self._suspected = now
        return True
