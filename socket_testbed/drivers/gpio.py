"""GPIO lines through gpiod 2, and the trigger: a pulse on one, or the steady clock alone."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

from socket_testbed import clocks
from socket_testbed.errors import DeviceError
from socket_testbed.settings.acquisition import TriggerSettings

Use: TypeAlias = Literal["output", "rising", "falling"]  # of a line: it is set, or its edges come


class EdgeLine(Protocol):
    """A line whose edges the kernel stamps."""

    def edges(self, within: float) -> list[float]:
        """Edges by their times on the steady clock [s]; waits so long for the first [s]."""
        ...

    def close(self) -> None:
        """Give the line back."""


class Lines(EdgeLine, Protocol):
    """Lines whose edges the kernel stamps, and others that are set."""

    def set(self, line: int, active: bool) -> None:
        """Set an output line."""


class GpiodLines:
    """Lines of the chip with a label, by their numbers and uses, held until they are closed.

    Hints name the node whose `setting` is the chip, and that does without it with `without`.
    """

    def __init__(
        self, label: str, uses: Mapping[int, Use], node: str, setting: str, without: str
    ) -> None:
        try:
            import gpiod
            from gpiod.line import Clock, Direction, Edge, Value
        except ImportError:
            raise DeviceError(
                "gpiod cannot be imported",
                f"pip install -r requirements/hardware.txt, or set {node}'s {without}",
            ) from None
        self._values = (Value.INACTIVE, Value.ACTIVE)
        edges = {"rising": Edge.RISING, "falling": Edge.FALLING}
        lines: dict[Any, Any] = {
            line: gpiod.LineSettings(direction=Direction.OUTPUT)
            if use == "output"
            # Not the system's clock: that one may be set while a trial runs.
            else gpiod.LineSettings(
                direction=Direction.INPUT, edge_detection=edges[use], event_clock=Clock.MONOTONIC
            )
            for line, use in uses.items()
        }
        path = _chip(gpiod, label, f"set {node}'s {setting}, or its {without}")
        names = " and ".join(f"line {line}" for line in uses)
        try:
            self._request = gpiod.request_lines(path, consumer="socket_testbed", config=lines)
        except PermissionError:
            raise _not_permitted(path) from None
        except (OSError, ValueError) as error:
            fact = f"{path}: {names} cannot be used ({error})"
            raise DeviceError(fact, "check that no other program or overlay does") from None

    def set(self, line: int, active: bool) -> None:
        """Set an output line."""
        self._request.set_value(line, self._values[active])

    def edges(self, within: float) -> list[float]:
        """Edges of all lines by their times on the steady clock [s]; waits for the first."""
        if not self._request.wait_edge_events(timedelta(seconds=clocks.real(max(within, 0.0)))):
            return []
        # CLOCK_MONOTONIC is the testbed's steady clock: on hardware its scale is 1.
        return [event.timestamp_ns * 1e-9 for event in self._request.read_edge_events()]

    def close(self) -> None:
        """Give the lines back."""
        self._request.release()


def _chip(gpiod: Any, label: str, hint: str) -> str:
    """Path of the chip with a label; its number differs from kernel to kernel."""
    found: dict[str, str] = {}
    refused = ""
    for path in sorted(map(str, Path("/dev").glob("gpiochip*"))):
        try:
            with gpiod.Chip(path) as chip:
                found.setdefault(chip.get_info().label, path)
        except PermissionError:
            refused = path
        except OSError:
            continue
    if label in found:
        return found[label]
    if refused:
        raise _not_permitted(refused)
    there = ", ".join(found) or "none"
    raise DeviceError(f"there is no GPIO chip '{label}' (there is {there})", hint)


def _not_permitted(path: str) -> DeviceError:
    return DeviceError(
        f"{path}: permission denied",
        "add the user to the group of that file (gpio or dialout), then log in again",
    )


class TimerTrigger:
    """A trigger without a wire: it has no pulse, and its time is that of the call."""

    def __init__(self) -> None:
        self.fire = clocks.monotonic
        self.stray = 0

    def rest(self) -> None:
        """There is no pulse."""

    def close(self) -> None:
        """Nothing is held."""


class GpioTrigger:
    """A pulse on a line, stamped by the kernel at its edge on another line wired to it."""

    def __init__(self, lines: Lines, settings: TriggerSettings) -> None:
        self._lines = lines
        self._settings = settings
        self._begun = 0.0
        self.stray = 0  # number of edges that belonged to no pulse

    def fire(self) -> float:
        """Begin a pulse; returns the time of its edge on the steady clock [s]."""
        settings = self._settings
        try:
            self.stray += len(self._lines.edges(0.0))
            self._begun = clocks.monotonic()
            self._lines.set(settings.output_line, True)
            # The line rises while this process sets it, which a busy machine may hold up.
            deadline = clocks.monotonic() + settings.edge_within
            left = settings.edge_within
            while True:
                for edge in self._lines.edges(left):
                    if self._begun <= edge <= deadline:
                        return edge
                    self.stray += 1
                if left == 0.0:
                    break
                # Once more after the deadline: the kernel's stamp counts.
                left = max(0.0, deadline - clocks.monotonic())
        except OSError as error:
            raise DeviceError(
                f"the GPIO lines cannot be used ({error.strerror or error})",
                "check that no other program holds them",
            ) from None
        raise DeviceError(
            f"no edge on line {settings.input_line} within {settings.edge_within * 1e3:g} ms of"
            f" the pulse on line {settings.output_line}",
            "check the wire between the two lines",
        )

    def rest(self) -> None:
        """End the pulse when it has lasted long enough."""
        clocks.sleep(max(0.0, self._begun + self._settings.pulse - clocks.monotonic()))
        try:
            self._lines.set(self._settings.output_line, False)
        except OSError:
            return  # the next pulse reports it

    def close(self) -> None:
        """Give the lines back."""
        self._lines.close()


Trigger: TypeAlias = TimerTrigger | GpioTrigger
