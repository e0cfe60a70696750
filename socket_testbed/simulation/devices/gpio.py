"""The trigger's two GPIO lines, with a wire between them."""

from __future__ import annotations

import errno
from collections.abc import Mapping

from socket_testbed import clocks
from socket_testbed.errors import DeviceError

_DELAY = 2e-6  # [s]; from the trigger's output to the timestamped edge


class SimulatedLines:
    """The `Lines` of `drivers.gpio.GpioTrigger`, with a wire that carries the edge.

    The constructor takes the faults of `simulation.world`, read at each access, and raises a
    `DeviceError` while the chip is unplugged. Lines of a chip that was unplugged fail with ENODEV
    even when it is back: they must be opened again.
    """

    def __init__(self, faults: Mapping[str, float]) -> None:
        if faults["trigger.unplugged"]:
            raise DeviceError(
                "there is no GPIO chip (simulated)",
                "set trigger_node's chip, or its source to timer",
            )
        self._faults = faults
        self._is_gone = False
        self._active = False
        self._edges: list[float] = []

    def set(self, line: int, active: bool) -> None:
        """Set the output line; an edge follows when it becomes active.

        Args:
            line: Number of the line; any, as there is one output.
            active: Whether to drive it active (high), otherwise inactive (low).

        Raises:
            TypeError: The number is no int, as in gpiod.
            OSError: The chip was unplugged.
        """
        self._check()
        if not isinstance(line, int):
            raise TypeError(f"line {line!r} is no number of a line")
        rising, self._active = active and not self._active, active
        if rising and not self._faults["trigger.missing"]:
            self._edges.append(clocks.monotonic() + _DELAY + self._faults["trigger.late"])

    def edges(self, within: float) -> list[float]:
        """Times of rising edges since the last call, on the steady clock [s].

        Without an edge it waits up to `within` [s] for the first, and may return an empty list.

        Raises:
            OSError: The chip was unplugged.
        """
        self._check()
        deadline = clocks.monotonic() + within
        if self._edges and (due := min(self._edges)) <= deadline:
            clocks.sleep(max(0.0, due - clocks.monotonic()))
        elif within > 0.0:
            clocks.sleep(within)
        now = clocks.monotonic()
        past = [edge for edge in self._edges if edge <= now]
        self._edges = [edge for edge in self._edges if edge > now]
        return past

    def _check(self) -> None:
        self._is_gone = self._is_gone or bool(self._faults["trigger.unplugged"])
        if self._is_gone:
            raise OSError(errno.ENODEV, "the GPIO chip is gone (simulated)")

    def close(self) -> None:
        """Do nothing: no lines are held."""
