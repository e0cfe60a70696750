"""The server's clock on the steady clock, from echoes."""

from __future__ import annotations

from collections import deque
from math import sqrt

_WINDOW = 64  # echoes
_OLDEST = 40.0  # [s]
_NEEDED = 3  # echoes, before times are mapped
_FLOOR = 5e-5  # [s]; error of an echo with the shortest round trip
_DRIFT = 1e-4  # [-]; standard deviation between two crystals
_TOLERANCE = 0.005  # [s]; of an echo against the map


class EchoClock:
    """Maps ticks of a server to the steady clock.

    The server read its clock between an echo's request and its arrival; taking the middle errs
    by half of what the round trip is longer than the shortest, at most. The map is the line
    through these middles, weighted so, with a prior on the drift (Bayesian linear regression).
    What the shortest round trip is asymmetric by stays unknown: that is the uncertainty.

    Args:
        frequency: Frequency of the server's clock [Hz]; 0: it has none.
    """

    def __init__(self, frequency: int) -> None:
        self._frequency = frequency
        self._echoes: deque[tuple[float, float, float]] = deque(maxlen=_WINDOW)
        self._origin = 0  # [ticks]
        self._at = self._offset = self._drift = 0.0
        self.jitter = 0.0
        self.uncertainty = 0.0

    def __len__(self) -> int:
        return len(self._echoes)

    def add(self, request: float, ticks: int, arrival: float) -> bool:
        """Take an echo.

        Args:
            request: When it was asked for, on the steady clock [s].
            ticks: The server's clock in the reply [ticks].
            arrival: When the reply came [s].

        Returns:
            False if it contradicts the map: this is another clock, and the map starts anew.
        """
        if self._frequency <= 0 or arrival < request:
            return True
        consistent = True
        if self._echoes:
            elapsed = (ticks - self._origin) / self._frequency
            mapped = self._map(elapsed)
            slack = _TOLERANCE + self.uncertainty + 5.0 * _DRIFT * abs(elapsed - self._at)
            consistent = request - slack <= mapped <= arrival + slack
        if not consistent or not self._echoes:
            self._echoes.clear()
            self._origin = ticks
        elapsed = (ticks - self._origin) / self._frequency
        self._echoes.append((elapsed, 0.5 * (request + arrival) - elapsed, arrival - request))
        while elapsed - self._echoes[0][0] > _OLDEST:
            self._echoes.popleft()
        self._fit()
        return consistent

    def to_steady(self, ticks: int) -> float | None:
        """Time of the steady clock [s] at the server's ticks; None before there is a map."""
        if len(self._echoes) < _NEEDED:
            return None
        return self._map((ticks - self._origin) / self._frequency)

    def _map(self, elapsed: float) -> float:
        return elapsed + self._offset + self._drift * (elapsed - self._at)

    def _fit(self) -> None:
        """Line through the offsets: its value at the newest echo, and its slope.

        `uncertainty` becomes half of the shortest round trip, `jitter` the weighted
        root-mean-square distance of the echoes from the line, both [s].
        """
        shortest = min(trip for _, _, trip in self._echoes)
        self._at = self._echoes[-1][0]
        base = self._echoes[-1][1]  # keeps the sums small
        s = st = stt = sy = sty = 0.0
        rows = []
        for elapsed, offset, trip in self._echoes:
            weight = 1.0 / (_FLOOR + 0.5 * (trip - shortest)) ** 2
            t, y = elapsed - self._at, offset - base
            rows.append((weight, t, y))
            s += weight
            st += weight * t
            stt += weight * t * t
            sy += weight * y
            sty += weight * t * y
        stt += 1.0 / _DRIFT**2
        determinant = s * stt - st * st
        self._drift = (s * sty - st * sy) / determinant
        value = (stt * sy - st * sty) / determinant
        self._offset = base + value
        square = sum(w * (y - value - self._drift * t) ** 2 for w, t, y in rows)
        self.jitter = sqrt(square / s)
        self.uncertainty = 0.5 * shortest
