"""Lines of a GPIO chip, through gpiod 2."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

from socket_testbed import clocks
from socket_testbed.errors import DeviceError

Use: TypeAlias = Literal["output", "rising", "falling"]  # of a line: it is set, or its edges come

_CONSUMER = "socket_testbed"


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
    """Lines of a chip, held until they are closed.

    Args:
        label: Label of the chip.
        uses: Use of each line, by its number.
        node: Node whose settings name the lines, for the hints.
        setting: Its setting of the chip's label.
        without: Setting to do without the lines.
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
        names = " and ".join(map(str, uses))
        try:
            self._request = gpiod.request_lines(path, consumer=_CONSUMER, config=lines)
        except PermissionError:
            raise _not_permitted(path) from None
        except (OSError, ValueError) as error:
            raise DeviceError(
                f"{path}: {'lines' if len(uses) > 1 else 'line'} {names} cannot be used ({error})",
                "check that no other program or overlay uses them",
            ) from None

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
    labels = []
    refused = ""
    for path in sorted(Path("/dev").glob("gpiochip*")):
        try:
            with gpiod.Chip(str(path)) as chip:
                labels.append(chip.get_info().label)
        except PermissionError:
            refused = str(path)
            continue
        except OSError:
            continue
        if labels[-1] == label:
            return str(path)
    if refused:
        raise _not_permitted(refused)
    raise DeviceError(
        f"there is no GPIO chip '{label}' (there is {', '.join(labels) or 'none'})", hint
    )


def _not_permitted(path: str) -> DeviceError:
    return DeviceError(
        f"{path}: permission denied",
        "add the user to the group of that file (gpio or dialout), then log in again",
    )
