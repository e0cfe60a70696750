"""Two simulated GPIO lines with a wire between them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from socket_testbed import clocks

_DELAY = 2e-6  # [s]; from the output to the stamped edge


class SimulatedLines:
    """The `Lines` of `drivers.gpio.GpioTrigger`; the edge comes by the wire."""

    def __init__(
        self,
        faults: Mapping[str, float],
        clock: Callable[[], float] = clocks.monotonic,
        sleep: Callable[[float], None] = clocks.sleep,
    ) -> None:
        self._faults = faults
        self._clock = clock
        self._sleep = sleep
        self._active = False
        self._edges: list[float] = []

    def set(self, line: int, active: bool) -> None:
        """Set the output line."""
        rising, self._active = active and not self._active, active
        if rising and not self._faults["trigger.missing"]:
            self._edges.append(self._clock() + _DELAY + self._faults["trigger.late"])

    def edges(self, within: float) -> list[float]:
        """Rising edges that have come, or come within a time [s]."""
        deadline = self._clock() + within
        if self._edges and (due := min(self._edges)) <= deadline:
            self._sleep(max(0.0, due - self._clock()))
        elif within > 0.0:
            self._sleep(within)
        now = self._clock()
        come = [edge for edge in self._edges if edge <= now]
        self._edges = [edge for edge in self._edges if edge > now]
        return come

    def close(self) -> None:
        """Nothing is held."""
