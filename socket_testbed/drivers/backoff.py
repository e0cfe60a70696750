"""When to try again what has failed."""

from __future__ import annotations

_FIRST = 0.05  # [s]
_LONGEST = 0.4  # [s]; a recovery is seen within a second


class Backoff:
    """Spaces out attempts: each failure doubles the wait, a success ends it.

    Args:
        longest: Longest wait [s].
    """

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
