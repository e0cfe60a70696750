"""A fault that lasted a moment, told for long enough to be seen."""

from __future__ import annotations

import time

_TOLD = 0.5  # [s]


class RecentFault:
    """The last fault that a node's thread saw."""

    def __init__(self) -> None:
        self._seen = ("", 0.0)  # one value: it is written in one thread and read in another

    def saw(self, text: str) -> None:
        """A fault was seen now."""
        self._seen = (text, time.monotonic())

    def text(self, told: float = _TOLD) -> str:
        """The fault, empty when it was seen longer ago than it is told [s]."""
        text, when = self._seen
        return text if time.monotonic() - when < told else ""
