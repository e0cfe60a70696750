"""GPIO lines through gpiod 2, and the trigger: a pulse on a line, or the steady clock alone."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

from socket_testbed import clocks
from socket_testbed.drivers import GONE, DeviceBusyError, described, not_permitted
from socket_testbed.errors import DeviceError
from socket_testbed.settings.acquisition import TriggerSettings

Use: TypeAlias = Literal["output", "rising", "falling"]  # of a line

_CONSUMER = "socket_testbed"  # of the lines, for the kernel
_GROUP = "gpio"


class LinesError(DeviceError):
    """Open lines cannot be used any more: close and open them again."""


def lines_failed(what: str, error: OSError) -> LinesError:
    """The error for lines that were open and fail now.

    Args:
        what: The lines, such as "the GPIO lines of pinctrl-rp1".
        error: What using them raised; its `errno` tells the cause.
    """
    said = error.strerror or error
    if error.errno in GONE | {errno.ENXIO}:
        hint = "check the chip's overlay or adapter; it is opened again automatically"
        return LinesError(f"{what} are gone ({said})", hint)
    hint = "check the chip and its adapter; they are opened again automatically"
    return LinesError(f"{what} cannot be used ({said})", hint)


class EdgeLine(Protocol):
    """A line whose edges are timestamped by the kernel."""

    def edges(self, within: float) -> list[float]:
        """Times of edges since the last call, on the steady clock [s].

        Without an edge it waits up to `within` [s] for the first, and may return an empty list.
        """

    def close(self) -> None:
        """Release the line."""


class Lines(EdgeLine, Protocol):
    """Input lines with timestamped edges, and output lines."""

    def set(self, line: int, active: bool) -> None:
        """Set an output line.

        Args:
            line: Number of the line on its chip.
            active: Whether to drive it active (high), otherwise inactive (low).
        """


class GpiodLines:
    """Lines of a GPIO chip, held until `close`.

    The constructor raises a `DeviceError` if gpiod, the chip or a line cannot be used.

    Args:
        label: Label of the chip, such as pinctrl-rp1; unlike its number it does not depend on the
            kernel.
        uses: Use of each line by its number: `output`, or an input with timestamped `rising` or
            `falling` edges.
        node: Name of the node, for hints.
        setting: The node's setting for the chip's label, for hints.
        without: The node's setting, with its value, to work without the chip, for hints.
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
            # Not the system clock, which may be set during a trial.
            else gpiod.LineSettings(
                direction=Direction.INPUT, edge_detection=edges[use], event_clock=Clock.MONOTONIC
            )
            for line, use in uses.items()
        }
        path = _chip(gpiod, label, f"set {node}'s {setting}, or its {without}")
        # At most 31 characters; another program that wants a line reads who has it.
        consumer = f"{_CONSUMER} {os.getpid()}"
        try:
            self._request = gpiod.request_lines(path, consumer=consumer, config=lines)
        except PermissionError:
            raise not_permitted(path, _GROUP) from None
        except (OSError, ValueError) as error:
            raise _lines_refused(gpiod, path, sorted(uses), node, error) from None

    def set(self, line: int, active: bool) -> None:
        """Set an output line.

        Args:
            line: Number of the line, one of those with the use `output`.
            active: Whether to drive it active (high), otherwise inactive (low).
        """
        self._request.set_value(line, self._values[active])

    def edges(self, within: float) -> list[float]:
        """Times of edges on all input lines since the last call, on the steady clock [s].

        The kernel stamps them. Without an edge it waits up to `within` [s] for the first.
        """
        if not self._request.wait_edge_events(timedelta(seconds=clocks.real(max(within, 0.0)))):
            return []
        # CLOCK_MONOTONIC is the testbed's steady clock: on hardware its scale is 1.
        return [event.timestamp_ns * 1e-9 for event in self._request.read_edge_events()]

    def close(self) -> None:
        """Release the lines."""
        with suppress(OSError):  # the chip is gone
            self._request.release()


def _chip(gpiod: Any, label: str, hint: str) -> str:
    """Path of the chip with a label; the chip's number depends on the kernel."""
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
        raise not_permitted(refused, _GROUP)
    there = ", ".join(found) or "none"
    raise DeviceError(f"there is no GPIO chip '{label}' (there is {there})", hint)


def _lines_refused(
    gpiod: Any, path: str, lines: list[int], node: str, error: OSError | ValueError
) -> DeviceError:
    """Why a chip refused its lines: a line that it does not have, or that somebody else uses."""
    names = " and ".join(f"line {line}" for line in lines)
    with suppress(OSError), gpiod.Chip(path) as chip:
        count = chip.get_info().num_lines
        for line in lines:
            if line >= count:
                return DeviceError(
                    f"there is no line {line} on {path}, which has {count}",
                    f"give 0 to {count - 1} in {node}'s settings",
                )
            held = chip.get_line_info(line)
            if held.used:
                return DeviceBusyError(f"line {line} of {path}", _user(held.consumer))
    fact = f"{path}: {names} cannot be used ({getattr(error, 'strerror', None) or error})"
    return DeviceError(fact, "check that no overlay uses them and that the chip knows edges")


def _user(consumer: str) -> str:
    """Who uses a line, from the name that it gave the kernel; our own name holds its process."""
    name, _, process = consumer.partition(" ")
    if name == _CONSUMER and process.isdigit():
        return described(int(process))
    return f"'{consumer}'" if consumer else ""


class TimerTrigger:
    """A trigger without a pulse; its time is that of the call.

    Attributes:
        fire: Function without arguments that returns the trigger's time, that of the call, on the
            steady clock [s].
        stray: Number of edges without a pulse; always 0.
    """

    def __init__(self) -> None:
        self.fire = clocks.monotonic
        self.stray = 0

    def end_pulse(self) -> None:
        """Do nothing: there is no pulse."""

    def close(self) -> None:
        """Do nothing: no lines are held."""


class GpioTrigger:
    """A pulse on one line; the kernel timestamps its edge on another line wired to it.

    Args:
        lines: The lines, with the settings' `output_line` as an output and their `input_line` as an
            input with rising edges.
        settings: Numbers of the lines, length of the pulse and longest delay of its edge.

    Attributes:
        stray: Number of edges without a pulse since the start.
    """

    def __init__(self, lines: Lines, settings: TriggerSettings) -> None:
        self._lines = lines
        self._settings = settings
        self._started = 0.0
        self.stray = 0

    def fire(self) -> float:
        """Start a pulse; returns the time of its edge on the steady clock [s].

        Raises:
            DeviceError: No edge followed within the settings' `edge_within`: check the wire between
                the lines. A `LinesError` if the lines cannot be used any more.
        """
        settings = self._settings
        try:
            self.stray += len(self._lines.edges(0.0))
            self._started = clocks.monotonic()
            self._lines.set(settings.output_line, True)
            # A busy machine may delay this process while it sets the line.
            deadline = clocks.monotonic() + settings.edge_within
            remaining = settings.edge_within
            while True:
                for edge in self._lines.edges(remaining):
                    if self._started <= edge <= deadline:
                        return edge
                    self.stray += 1
                if remaining == 0.0:
                    break
                # Check once more after the deadline: only the kernel's timestamp matters.
                remaining = max(0.0, deadline - clocks.monotonic())
        except OSError as error:
            raise lines_failed(f"the GPIO lines of {settings.chip}", error) from None
        raise DeviceError(
            f"no edge on line {settings.input_line} within {settings.edge_within * 1e3:g} ms of"
            f" the pulse on line {settings.output_line}",
            "check the wire between the two lines",
        )

    def end_pulse(self) -> None:
        """End the pulse once it has lasted as long as the settings' `pulse` [s]."""
        clocks.sleep(max(0.0, self._started + self._settings.pulse - clocks.monotonic()))
        try:
            self._lines.set(self._settings.output_line, False)
        except OSError:
            return  # the next pulse reports it

    def close(self) -> None:
        """Release the lines."""
        self._lines.close()


Trigger: TypeAlias = TimerTrigger | GpioTrigger
