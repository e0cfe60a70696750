"""Samples and prediction errors of a running graph, for the status line of a terminal."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.samples import WITHOUT_VALUE
from socket_testbed.wire import topics

_MAX_PENDING = 1000  # stamps whose measurements are incomplete
_ERROR_WINDOW = 10.0  # [s]; averaging window of the prediction errors


class GraphStatus:
    """Counts the samples of a graph, and compares predictions with measurements.

    Attributes:
        absent: Topics that nobody measures in this graph, without which a sample is complete.
        triggers: Number of triggers.
        complete: Number of triggers with all its measurements present and valid.
        wrench: The newest measured wrench [M; F] in {S}, shape (6,) [N m, N]; None before any.
        variant: Variant of the predicting model; empty before the first.
        trial: Name of the trial being recorded; empty if none.
        trials: Names of all trials whose recording was announced.
        heard: Arrival of the newest trigger on the monotonic clock [s]; None before any.
    """

    def __init__(self) -> None:
        self.absent: frozenset[topics.Topic] = frozenset()
        self.triggers = 0
        self.complete = 0
        self.wrench: FloatArray | None = None
        self.variant = ""
        self.trial = ""
        self.trials: set[str] = set()
        self.heard: float | None = None
        self._first = self._last = 0  # stamps of triggers [ns]
        self._pending: dict[int, set[topics.Topic]] = {}
        self._measured: dict[int, FloatArray] = {}
        self._errors: deque[tuple[int, FloatArray]] = deque()

    @property
    def elapsed(self) -> float:
        """Time from the first trigger (or the last jump back) to the newest [s]."""
        return 1e-9 * (self._last - self._first)

    def errors(self) -> tuple[float, float] | None:
        """RMSE of the predicted forces [N] and moments [N m] over the last 10 s; None: unknown.

        Each is the root of the mean square over the samples and over x, y and z. The model has not
        seen these samples, unless a replay repeats them: each is predicted before it is used in a
        fit.
        """
        if not self._errors:
            return None
        squares = np.square([error for _, error in self._errors]).reshape(-1, 2, 3)
        moment, force = np.sqrt(squares.mean(axis=(0, 2)))
        return float(force), float(moment)

    def add(self, topic: topics.Topic, stamp: int, values: Any) -> None:
        """Process a message.

        Args:
            topic: A topic that samples require, or ESTIMATED_WRENCH.
            stamp: Stamp of the message since the epoch [ns].
            values: Its values, as a `Reader` gives them.
        """
        if topic is topics.ESTIMATED_WRENCH:
            error = values - self._measured.get(stamp, np.nan)
            if np.isfinite(error).all():
                self._errors.append((stamp, error))
            # A replay that starts again may bring older predictions after the first new trigger.
            while self._errors and not 0 <= stamp - self._errors[0][0] <= _ERROR_WINDOW * 1e9:
                self._errors.popleft()
            return
        if topic is topics.TRIGGER:
            self._add_trigger(stamp)
        elif topic is topics.WRENCH:
            self.wrench = self._measured[stamp] = values
            _keep_newest(self._measured)
        is_clusters = topic is topics.CAPACITANCE
        missing = np.isin(values.status, WITHOUT_VALUE) if is_clusters else np.isnan(values)
        if not missing.any() and topic not in self.absent:
            self._pending.setdefault(stamp, set()).add(topic)
            if len(self._pending[stamp]) == len({*topics.REQUIRED} - self.absent):
                del self._pending[stamp]
                self.complete += 1
            _keep_newest(self._pending)

    def _add_trigger(self, stamp: int) -> None:
        if not self.triggers or stamp < self._last:  # a replay restarts
            self._first = stamp
            self._pending.clear()
            self._measured.clear()
            self._errors.clear()
        self._last = stamp
        self.triggers += 1
        self.heard = time.monotonic()


def _keep_newest(entries: dict[int, Any]) -> None:
    while len(entries) > _MAX_PENDING:
        del entries[next(iter(entries))]
