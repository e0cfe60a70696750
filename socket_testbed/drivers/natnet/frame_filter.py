"""Which frames are used, and what went right and wrong on the link, now and in all."""

from __future__ import annotations

import threading
from collections import deque

_RECENT = 0.8  # [s]; a fault that ended is no longer reported within a second
_SPAN = 1.0  # [s]; over which the rate is measured
_MOST = 2000  # events
_EARLIEST, _LATEST = 1.0, 0.005  # [s]; before and after its arrival that a frame can be from
_ODD = 10  # frames in a row; of another server, not of the network
_SUSPICION = 2.0  # [s]; between two guesses that it is another server
_MOST_LOST = 1000  # frames

KINDS = {
    "bad": "bad datagrams",
    "lost": "lost frames",
    "late": "duplicate or late frames",
    "implausible": "frames of implausible time",
    "failed": "frames that could not be used",
}


class LinkStatistics:
    """Counts frames and faults; any thread may ask, one counts."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._recent: dict[str, deque[tuple[float, int]]] = {
            kind: deque(maxlen=_MOST) for kind in KINDS
        }
        self._totals = dict.fromkeys(KINDS, 0)
        self._frames: deque[float] = deque(maxlen=_MOST)
        self._delivered = 0
        self._warning = ("", 0.0, frozenset[str]())
        self.last_error = ""

    def count(self, kind: str, now: float, number: int = 1, error: str = "") -> None:
        """Count a fault."""
        with self._lock:
            self._totals[kind] += number
            self._recent[kind].append((now, number))
            if error:
                self.last_error = error

    def delivered(self, now: float) -> None:
        """Count a frame that was delivered."""
        with self._lock:
            self._delivered += 1
            self._frames.append(now)

    def quiet(self, now: float) -> float:
        """Time since the last frame that was delivered, of two at least [s]."""
        with self._lock:
            return now - self._frames[-1] if len(self._frames) > 1 else float("inf")

    def rate(self, now: float) -> float:
        """Frames delivered a second, over the last one [Hz]."""
        with self._lock:
            while self._frames and self._frames[0] < now - _SPAN:
                self._frames.popleft()
            if len(self._frames) < 2:
                return 0.0
            return (len(self._frames) - 1) / max(self._frames[-1] - self._frames[0], 1e-6)

    def warning(self, now: float) -> str:
        """The faults of the last second in one line; empty for none.

        It is the same for half a second unless other kinds of faults come.
        """
        with self._lock:
            counts = {
                kind: sum(number for moment, number in events if moment > now - _RECENT)
                for kind, events in self._recent.items()
            }
        kinds = frozenset(kind for kind, number in counts.items() if number)
        text, since, shown = self._warning
        if kinds != shown or now - since > 0.5:
            text = ", ".join(f"{counts[kind]} {KINDS[kind]}" for kind in KINDS if kind in kinds)
            if kinds & {"bad", "failed"}:
                text += f" (the last: {self.last_error})"
            self._warning = (text, now, kinds)
        return text if kinds else ""

    def figures(self) -> dict[str, object]:
        """All counts since the begin, by name."""
        with self._lock:
            return {
                "frames": self._delivered,
                **{KINDS[kind].replace(" ", "_"): n for kind, n in self._totals.items()},
            }


class FrameFilter:
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

    def is_plausible(self, moment: float, now: float, error: float) -> bool:
        """Whether a frame that comes now can be from a time, known within an error [s]."""
        if now - _EARLIEST - error <= moment <= now + _LATEST + error:
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
