"""The trigger: a pulse whose edge the kernel stamps, or the steady clock alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from socket_testbed import clocks
from socket_testbed.drivers.gpio import GpiodLines, Lines, Use
from socket_testbed.errors import DeviceError
from socket_testbed.settings.acquisition import TriggerSettings


class TimerTrigger:
    """A trigger without a wire: it has no pulse, and its time is that of the call."""

    def __init__(self, clock: Callable[[], float] = clocks.monotonic) -> None:
        self.fire = clock
        self.stray = 0

    def rest(self) -> None:
        """There is no pulse."""

    def close(self) -> None:
        """Nothing is held."""


class GpioTrigger:
    """A pulse on a line, stamped by the kernel at its edge on another line wired to it."""

    def __init__(
        self,
        lines: Lines,
        settings: TriggerSettings,
        clock: Callable[[], float] = clocks.monotonic,
        sleep: Callable[[float], None] = clocks.sleep,
    ) -> None:
        self._lines = lines
        self._settings = settings
        self._clock = clock
        self._sleep = sleep
        self._begun = 0.0
        self.stray = 0  # number of edges that belonged to no pulse

    def fire(self) -> float:
        """Begin a pulse; returns the time of its edge on the steady clock [s]."""
        try:
            self.stray += len(self._lines.edges(0.0))
            self._begun = self._clock()
            self._lines.set(self._settings.output_line, True)
            # The line rises while this process sets it, which a busy machine may hold up.
            deadline = self._clock() + self._settings.edge_within
            left = self._settings.edge_within
            while True:
                for edge in self._lines.edges(left):
                    if self._begun <= edge <= deadline:
                        return edge
                    self.stray += 1
                if left == 0.0:
                    break
                # Once more after the deadline: the kernel's stamp counts.
                left = max(0.0, deadline - self._clock())
        except OSError as error:
            raise DeviceError(
                f"the GPIO lines cannot be used ({error.strerror or error})",
                "check that no other program holds them",
            ) from None
        settings = self._settings
        raise DeviceError(
            f"no edge on line {settings.input_line} within {settings.edge_within * 1e3:g} ms of"
            f" the pulse on line {settings.output_line}",
            "check the wire between the two lines",
        )

    def rest(self) -> None:
        """End the pulse when it has lasted long enough."""
        self._sleep(max(0.0, self._begun + self._settings.pulse - self._clock()))
        try:
            self._lines.set(self._settings.output_line, False)
        except OSError:
            return  # the next pulse reports it

    def close(self) -> None:
        """Give the lines back."""
        self._lines.close()


Trigger: TypeAlias = TimerTrigger | GpioTrigger


def trigger_lines(settings: TriggerSettings) -> GpiodLines:
    """The lines of the GPIO chip that the settings name, through gpiod."""
    uses: dict[int, Use] = {settings.output_line: "output", settings.input_line: "rising"}
    return GpiodLines(settings.chip, uses, "trigger_node", "chip", "source to timer")
