"""GPIO: the trigger against simulated lines, and what is asked of the kernel."""

import errno
import os
from types import SimpleNamespace
from typing import Any, ClassVar
from unittest.mock import Mock

import gpiod
import pytest
from gpiod.line import Clock, Direction, Edge
from support.clocks import FakeClock
from support.wording import refused

from socket_testbed.drivers import DeviceBusyError, gpio
from socket_testbed.drivers.gpio import GpiodLines, GpioTrigger, LinesError
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.settings.acquisition import TriggerSettings
from socket_testbed.simulation.devices.gpio import SimulatedLines
from socket_testbed.simulation.world import FAULTS

SETTINGS = TriggerSettings()


class Wired:
    """A trigger whose output and input are one wire, with its faults."""

    def __init__(self, clock: FakeClock) -> None:
        self.clock = clock
        self.faults = dict.fromkeys(FAULTS, 0.0)
        self.trigger = GpioTrigger(SimulatedLines(self.faults), SETTINGS)

    def fire(self, times: int) -> None:
        """Fire, and check that each time is that of its own edge."""
        for _ in range(times):
            before = self.clock.now
            assert before < self.trigger.fire() < before + 1e-4
            self.trigger.end_pulse()
            assert self.clock.now - before >= SETTINGS.pulse
            self.clock.sleep(0.05)


@pytest.fixture
def wired(monkeypatch: pytest.MonkeyPatch) -> Wired:
    return Wired(FakeClock(look=1e-6).install(monkeypatch))


def test_a_trigger_has_the_time_of_its_edge(wired: Wired) -> None:
    wired.fire(100)
    assert wired.trigger.stray == 0


def test_a_trigger_without_an_edge_is_refused(wired: Wired) -> None:
    wired.faults["trigger.missing"] = 1.0
    with refused(DeviceError, "no edge on line 27", "line 17", "check the wire"):
        wired.trigger.fire()
    wired.trigger.end_pulse()
    wired.faults["trigger.missing"] = 0.0
    wired.fire(20)


@pytest.mark.parametrize("late", [0.0011, 0.01, 0.2], ids=["1.1-ms", "10-ms", "200-ms"])
def test_an_edge_that_comes_late_counts_for_none(wired: Wired, late: float) -> None:
    """Neither for its own pulse nor for the next one."""
    wired.faults["trigger.late"] = late
    for _ in range(20):
        with pytest.raises(DeviceError):
            wired.trigger.fire()
        wired.trigger.end_pulse()
        wired.clock.sleep(0.05)
    wired.faults["trigger.late"] = 0.0
    wired.fire(20)
    assert wired.trigger.stray > 10


def test_drdy_edges_are_falling_on_the_steady_clock(monkeypatch) -> None:
    request = Mock()
    request.read_edge_events.return_value = [Mock(timestamp_ns=5_002_000_000)]
    monkeypatch.setattr(gpio, "_chip", lambda *_: "/dev/gpiochip4")
    monkeypatch.setattr(gpiod, "request_lines", asked := Mock(return_value=request))
    line = GpiodLines("a chip", {22: "falling"}, "load_cell_node", "data_ready_chip", "")
    wanted = asked.call_args.kwargs["config"][22]
    assert (wanted.direction, wanted.edge_detection) == (Direction.INPUT, Edge.FALLING)
    assert wanted.event_clock == Clock.MONOTONIC
    assert line.edges(0.0) == pytest.approx([5.002])
    line.close()
    request.release.assert_called_once()


# --- a chip that goes and comes


def test_lines_of_a_lost_chip_are_named(wired: Wired) -> None:
    """They stay lost when it is back, until they are opened again."""
    wired.fire(1)
    wired.faults["trigger.unplugged"] = 1.0
    with refused(LinesError, "pinctrl-rp1 are gone", "overlay or adapter; it is opened again"):
        wired.trigger.fire()
    wired.trigger.end_pulse()
    with refused(DeviceError, "there is no GPIO chip"):
        SimulatedLines(wired.faults)
    wired.faults["trigger.unplugged"] = 0.0
    with pytest.raises(LinesError):
        wired.trigger.fire()
    wired.trigger.close()
    wired.trigger = GpioTrigger(SimulatedLines(wired.faults), SETTINGS)
    wired.fire(3)


@pytest.mark.parametrize("number", [errno.ENODEV, errno.ENXIO, errno.EIO], ids=errno.errorcode.get)
@pytest.mark.parametrize("call", ["set_value", "wait_edge_events", "read_edge_events", "release"])
def test_a_failing_line_never_raises_its_errno(call: str, number: int) -> None:
    lines = GpiodLines.__new__(GpiodLines)
    lines._values = (0, 1)  # type: ignore[assignment]
    lines._request = Mock(**{"read_edge_events.return_value": []})
    getattr(lines._request, call).side_effect = OSError(number, "x")
    trigger = GpioTrigger(lines, SETTINGS)
    if call == "release":
        trigger.close()
    else:
        with refused(LinesError, "the GPIO lines of pinctrl-rp1", "opened again automatically"):
            trigger.fire()
    trigger.end_pulse()


# --- lines that the kernel refuses


class StrictChip:
    """A `gpiod.Chip` of 54 lines as far as it checks; lines in `held` have a consumer."""

    held: ClassVar[dict[int, str]] = {}

    def __init__(self, path: str) -> None:
        if not isinstance(path, str):
            raise TypeError("a path is needed")

    def __enter__(self) -> "StrictChip":
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def get_info(self) -> SimpleNamespace:
        return SimpleNamespace(label="a chip", num_lines=54)

    def get_line_info(self, line: int) -> SimpleNamespace:
        if not isinstance(line, int):
            raise TypeError("the number of a line is needed")
        if line >= 54:
            raise OSError(errno.EINVAL, "Invalid argument")
        return SimpleNamespace(used=line in self.held, consumer=self.held.get(line, ""))


@pytest.fixture
def request_lines(monkeypatch: pytest.MonkeyPatch) -> Mock:
    monkeypatch.setattr(gpio, "_chip", lambda *_: "/dev/gpiochip4")
    monkeypatch.setattr(gpiod, "Chip", StrictChip)
    monkeypatch.setattr(gpiod, "request_lines", asked := Mock())
    return asked


def opened(*lines: int) -> GpiodLines:
    return GpiodLines("a chip", dict.fromkeys(lines, "output"), "trigger_node", "chip", "source")


def test_a_line_that_is_not_there_is_named(request_lines: Mock) -> None:
    request_lines.side_effect = OSError(errno.EINVAL, "Invalid argument")
    with refused(DeviceError, "no line 99 on /dev/gpiochip4, which has 54", "give 0 to 53"):
        opened(17, 99)


@pytest.mark.parametrize(
    ("consumer", "words"),
    [
        ("spi0 CS0", "another program uses line 27 of /dev/gpiochip4 ('spi0 CS0')"),
        (f"socket_testbed {os.getpid()}", f"(process {os.getpid()}, "),
        ("", "another program uses line 27 of /dev/gpiochip4: "),
    ],
    ids=["kernel", "ours", "nobody"],
)
def test_a_line_s_user_is_named(
    consumer: str, words: str, request_lines: Mock, monkeypatch: pytest.MonkeyPatch
) -> None:
    request_lines.side_effect = OSError(errno.EBUSY, "Device or resource busy")
    monkeypatch.setattr(StrictChip, "held", {27: consumer})
    with refused(DeviceBusyError, words):
        opened(17, 27)


def test_a_line_that_is_free_is_refused_otherwise(request_lines: Mock) -> None:
    request_lines.side_effect = OSError(errno.ENXIO, "No such device or address")
    with refused(DeviceError, "line 17 and line 27 cannot be used", "knows edges"):
        opened(17, 27)


def test_our_lines_carry_our_process(request_lines: Mock) -> None:
    opened(17)
    consumer = request_lines.call_args.kwargs["consumer"]
    assert consumer == f"socket_testbed {os.getpid()}" and len(consumer) < 32


def test_a_trigger_needs_two_lines() -> None:
    with refused(ConfigurationError, "output_line and input_line are both 17"):
        TriggerSettings(input_line=17)
    same: Any = TriggerSettings(source="timer", input_line=17)
    assert same.input_line == same.output_line
