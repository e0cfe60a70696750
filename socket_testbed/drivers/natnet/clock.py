"""The clock of a NatNet server, mapped to the testbed's by echoes."""

from __future__ import annotations

from collections import deque
from typing import TypeAlias

_WINDOW = 200  # echoes
_OLDEST = 40.0  # [s]
_NEEDED = 3  # echoes, before times are mapped
_DRIFT = 6e-4  # [-]; of two crystals and what steers a computer's clock, at most
_WANDER = 1e-5  # [-]; change of the drift within the oldest echo's age, at most
_TOLERANCE = 0.005  # [s]; of an echo against the map

_Region: TypeAlias = list[tuple[float, float]]  # corners: offset [s], drift [-]


class EchoClock:
    """Maps ticks of a server to the steady clock.

    The server reads its clock between an echo's request and its arrival, however the round trip
    is split, so each echo bounds the offset from both sides (Marzullo and Owicki 1983,
    doi:10.1145/800221.806730). Clocks drift steadily: offset and drift lie in the convex region
    that all echoes allow, each loosened by the possible change of the drift since. Times are
    mapped by the middle of the region. Half of its width is the largest error, whatever the
    asymmetry of the network, as long as the drift changes by no more than 1e-5 in 40 s.
    """

    def __init__(self, frequency: int) -> None:
        self.uncertainty = 0.0  # largest error at the newest echo [s]
        self._frequency = frequency  # of the server's clock [Hz]; 0: it has none
        # Both clocks are counted from the first echo on: the server's, and the request.
        self._origin = 0, 0.0  # [ticks], [s]
        # Time of the server, and the offset's bounds: request and arrival less that time [s].
        self._echoes: deque[tuple[float, float, float]] = deque(maxlen=_WINDOW)
        # The possible offsets at the newest echo's time, and drifts from it.
        self._region: _Region = []

    def __len__(self) -> int:
        return len(self._echoes)

    def add(self, request: float, ticks: int, arrival: float) -> bool:
        """Take an echo: the server's clock [ticks], read between request and arrival [s].

        False if it contradicts the map: this is another clock, and the map starts anew.
        """
        if self._frequency <= 0 or arrival < request:
            return True
        consistent = True
        if self._echoes:
            low, high = self._bounds(ticks)
            ahead = self._elapsed(ticks) - self._echoes[-1][0]
            slack = _TOLERANCE + 2.0 * _DRIFT * abs(ahead)
            consistent = request - slack <= high and low <= arrival + slack
        if not consistent or not self._echoes:
            self._echoes.clear()
            self._origin = ticks, request
        elapsed = self._elapsed(ticks)
        begun = self._origin[1] + elapsed
        self._echoes.append((elapsed, request - begun, arrival - begun))
        while elapsed - self._echoes[0][0] > _OLDEST:
            self._echoes.popleft()
        self._fit()
        return consistent

    def to_steady(self, ticks: int) -> tuple[float, float] | None:
        """Steady time at the server's ticks, and its largest error [s]; None without a map."""
        if len(self._echoes) < _NEEDED:
            return None
        low, high = self._bounds(ticks)
        return 0.5 * (low + high), 0.5 * (high - low)

    def _elapsed(self, ticks: int) -> float:
        return (ticks - self._origin[0]) / self._frequency

    def _bounds(self, ticks: int) -> tuple[float, float]:
        """Earliest and latest steady time of the server's ticks [s]."""
        elapsed = self._elapsed(ticks)
        ahead, begun = elapsed - self._echoes[-1][0], self._origin[1] + elapsed
        offsets = [offset + drift * ahead for offset, drift in self._region]
        slack = _WANDER * abs(ahead)
        return begun + min(offsets) - slack, begun + max(offsets) + slack

    def _fit(self) -> None:
        """Narrow the region by the echoes, from the newest on."""
        at, least, most = self._echoes[-1]
        region = [(least, -_DRIFT), (most, -_DRIFT), (most, _DRIFT), (least, _DRIFT)]
        for number, (elapsed, low, high) in enumerate(reversed(self._echoes)):
            ahead = elapsed - at
            slack = _WANDER * abs(ahead)
            region = _below(_below(region, ahead, high + slack), ahead, low - slack, sign=-1.0)
            if not region:  # the drift was another one then
                while len(self._echoes) > number:
                    self._echoes.popleft()
                break
            self._region = region
        offsets = [offset for offset, _ in self._region]
        self.uncertainty = 0.5 * (max(offsets) - min(offsets))


def _below(region: _Region, ahead: float, limit: float, sign: float = 1.0) -> _Region:
    """The part of a convex region whose offset some time ahead is below a limit [s].

    With the sign -1, the part above it (Sutherland and Hodgman 1974).
    """
    excess = [sign * (offset + drift * ahead - limit) for offset, drift in region]
    if max(excess, default=0.0) <= 0.0:
        return region
    kept: _Region = []
    for k, (corner, over) in enumerate(zip(region, excess, strict=True)):
        (x, y), over_before = region[k - 1], excess[k - 1]
        if (over > 0.0) != (over_before > 0.0):
            share = over_before / (over_before - over)
            kept.append((x + share * (corner[0] - x), y + share * (corner[1] - y)))
        if over <= 0.0:
            kept.append(corner)
    return kept
