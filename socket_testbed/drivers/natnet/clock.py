"""Maps the clock of a NatNet server to the testbed's clock by echoes."""

from __future__ import annotations

from collections import deque
from typing import TypeAlias

_MAX_ECHOES = 200
_MAX_AGE = 40.0  # [s]; of an echo
_MIN_ECHOES = 3  # before times are mapped
_MAX_DRIFT = 6e-4  # [-]; two crystals and the steering of a computer's clock
_MAX_WANDER = 1e-5  # [-]; change of the drift within the maximum age
_TOLERANCE = 0.005  # [s]; between an echo and the map

_Region: TypeAlias = list[tuple[float, float]]  # corners: offset [s], drift [-]


class EchoClock:
    """Maps ticks of a server's clock to the testbed's steady clock.

    The server reads its clock between an echo's request and its arrival, so each echo bounds the
    offset from both sides, whatever the delay in each direction (Marzullo and Owicki 1983,
    doi:10.1145/800221.806730). Offset and drift lie in the convex region allowed by all echoes,
    each relaxed by the possible change of the drift since then. The middle of the region maps the
    times. Half its width bounds the error for any network asymmetry, as long as the drift changes
    by at most 1e-5 in 40 s.

    The constructor takes the frequency of the server's clock [Hz]; 0 for a server without a clock,
    whose times are never mapped. `len` is the number of echoes in use.

    Attributes:
        uncertainty: Error bound of mapped times at the newest echo [s]; 0 before the first.
    """

    def __init__(self, frequency: int) -> None:
        self.uncertainty = 0.0
        self._frequency = frequency  # of the server's clock [Hz]; 0: none
        # Both clocks at the first echo: the server's, and its request.
        self._origin = 0, 0.0  # [ticks], [s]
        # Server time, and bounds of the offset: request and arrival minus that time [s].
        self._echoes: deque[tuple[float, float, float]] = deque(maxlen=_MAX_ECHOES)
        # Possible offsets at the newest echo, and drifts.
        self._region: _Region = []

    def __len__(self) -> int:
        return len(self._echoes)

    def add(self, request: float, ticks: int, arrival: float) -> bool:
        """Add an echo: the server read its clock between the request and the arrival of the reply.

        False if it contradicts the map: the clock has changed, and the map is restarted.

        Args:
            request: When the request was sent, on the steady clock [s].
            ticks: The server's clock in its reply [ticks].
            arrival: When the reply arrived, on the steady clock [s].
        """
        if self._frequency <= 0 or arrival < request:
            return True
        consistent = True
        if self._echoes:
            low, high = self._bounds(ticks)
            ahead = self._elapsed(ticks) - self._echoes[-1][0]
            slack = _TOLERANCE + 2.0 * _MAX_DRIFT * abs(ahead)
            consistent = request - slack <= high and low <= arrival + slack
        if not consistent or not self._echoes:
            self._echoes.clear()
            self._origin = ticks, request
        elapsed = self._elapsed(ticks)
        begun = self._origin[1] + elapsed
        self._echoes.append((elapsed, request - begun, arrival - begun))
        while elapsed - self._echoes[0][0] > _MAX_AGE:
            self._echoes.popleft()
        self._fit()
        return consistent

    def to_steady(self, ticks: int) -> tuple[float, float] | None:
        """Time on the steady clock at the server's ticks, and its error bound, both [s].

        None with fewer than three echoes.
        """
        if len(self._echoes) < _MIN_ECHOES:
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
        slack = _MAX_WANDER * abs(ahead)
        return begun + min(offsets) - slack, begun + max(offsets) + slack

    def _fit(self) -> None:
        """Intersect the bounds of the echoes, newest first."""
        at, low, high = self._echoes[-1]
        region = [(low, -_MAX_DRIFT), (high, -_MAX_DRIFT), (high, _MAX_DRIFT), (low, _MAX_DRIFT)]
        for number, (elapsed, low, high) in enumerate(reversed(self._echoes)):
            ahead = elapsed - at
            slack = _MAX_WANDER * abs(ahead)
            region = _below(_below(region, ahead, high + slack), ahead, low - slack, sign=-1.0)
            if not region:  # the drift has changed since
                while len(self._echoes) > number:
                    self._echoes.popleft()
                break
            self._region = region
        offsets = [offset for offset, _ in self._region]
        self.uncertainty = 0.5 * (max(offsets) - min(offsets))


def _below(region: _Region, ahead: float, limit: float, sign: float = 1.0) -> _Region:
    """Clip a convex region to offsets below a limit [s], some time ahead [s].

    With sign -1, to offsets above it (Sutherland and Hodgman 1974).
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
