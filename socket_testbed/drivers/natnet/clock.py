"""The server's clock on the steady clock, from echoes, and how well it is known."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple, TypeAlias

_WINDOW = 200  # echoes
_OLDEST = 40.0  # [s]
_NEEDED = 3  # echoes, before times are mapped
_DRIFT = 6e-4  # [-]; of two crystals and what steers a computer's clock, at most
_WANDER = 1e-5  # [-]; change of the drift within the oldest echo's age, at most
_TOLERANCE = 0.005  # [s]; of an echo against the map

_Region: TypeAlias = list[tuple[float, float]]  # corners: offset [s], drift [-]


class _Map(NamedTuple):
    """The possible offsets at a time of the server, and drifts from it."""

    at: float
    base: float
    region: _Region

    def offsets(self, elapsed: float) -> tuple[float, float]:
        """Least and largest offset at a time of the server [s]."""
        ahead = elapsed - self.at
        offsets = [offset + drift * ahead for offset, drift in self.region]
        slack = _WANDER * abs(ahead)
        return self.base + min(offsets) - slack, self.base + max(offsets) + slack


class EchoClock:
    """Maps ticks of a server to the steady clock.

    The server reads its clock between an echo's request and its arrival, however the round trip
    is split, so each echo bounds the offset from both sides (Marzullo and Owicki 1983,
    doi:10.1145/800221.806730). Clocks drift steadily: offset and drift lie in the convex region
    that all echoes allow, each loosened by the possible change of the drift since. Times are
    mapped by the middle of the region. Half of its width is the largest error, whatever the
    asymmetry of the network, as long as the drift changes by no more than 1e-5 in 40 s.

    Args:
        frequency: Frequency of the server's clock [Hz]; 0: it has none.
    """

    def __init__(self, frequency: int) -> None:
        self._frequency = frequency
        # Time of the server, and the offset's bounds: request and arrival less that time [s].
        self._echoes: deque[tuple[float, float, float]] = deque(maxlen=_WINDOW)
        self._origin = 0  # [ticks]
        self._map = _Map(0.0, 0.0, [])
        self.uncertainty = 0.0  # largest error at the newest echo [s]

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
            elapsed = self._elapsed(ticks)
            low, high = (offset + elapsed for offset in self._map.offsets(elapsed))
            slack = _TOLERANCE + 2.0 * _DRIFT * abs(elapsed - self._map.at)
            consistent = request - slack <= high and low <= arrival + slack
        if not consistent or not self._echoes:
            self._echoes.clear()
            self._origin = ticks
        elapsed = self._elapsed(ticks)
        self._echoes.append((elapsed, float(request - elapsed), float(arrival - elapsed)))
        while elapsed - self._echoes[0][0] > _OLDEST:
            self._echoes.popleft()
        self._fit()
        return consistent

    def to_steady(self, ticks: int) -> tuple[float, float] | None:
        """Steady time at the server's ticks, and its largest error [s]; None without a map."""
        if len(self._echoes) < _NEEDED:
            return None
        elapsed = self._elapsed(ticks)
        low, high = self._map.offsets(elapsed)
        return elapsed + 0.5 * (low + high), 0.5 * (high - low)

    def _elapsed(self, ticks: int) -> float:
        return (ticks - self._origin) / self._frequency

    def _fit(self) -> None:
        """Narrow the region by the echoes, from the newest on."""
        at, low, high = self._echoes[-1]
        base = 0.5 * (low + high)  # keeps the numbers small
        half = 0.5 * (high - low)
        region: _Region = [(-half, -_DRIFT), (half, -_DRIFT), (half, _DRIFT), (-half, _DRIFT)]
        for number, (elapsed, low, high) in enumerate(reversed(self._echoes)):
            age = at - elapsed
            slack = _WANDER * abs(age)
            region = _between(region, -age, low - slack - base, high + slack - base)
            if not region:  # the drift was another one then
                while len(self._echoes) > number:
                    self._echoes.popleft()
                break
            self._map = _Map(at, base, region)
        low, high = self._map.offsets(at)
        self.uncertainty = 0.5 * (high - low)


def _between(region: _Region, ahead: float, low: float, high: float) -> _Region:
    """The part of a convex region whose offset some time ahead is between two bounds [s]."""
    offsets = [offset + drift * ahead for offset, drift in region]
    if max(offsets) > high:
        region = _cut(region, [offset - high for offset in offsets])
        offsets = [offset + drift * ahead for offset, drift in region]
    if offsets and min(offsets) < low:
        region = _cut(region, [low - offset for offset in offsets])
    return region


def _cut(region: _Region, excess: list[float]) -> _Region:
    """The part of a convex region on one side of a line (Sutherland and Hodgman 1974)."""
    kept: _Region = []
    for k, (corner, over) in enumerate(zip(region, excess, strict=True)):
        (x, y), over_before = region[k - 1], excess[k - 1]
        if (over > 0.0) != (over_before > 0.0):
            share = over_before / (over_before - over)
            kept.append((x + share * (corner[0] - x), y + share * (corner[1] - y)))
        if over <= 0.0:
            kept.append(corner)
    return kept
