"""GPIO: the trigger against simulated lines, and what is asked of the kernel."""

from unittest.mock import Mock

import gpiod
import pytest
from gpiod.line import Clock, Direction, Edge
from support.clocks import FakeClock
from support.wording import refused

from socket_testbed.drivers import gpio
from socket_testbed.drivers.gpio import GpiodLines, GpioTrigger
from socket_testbed.errors import DeviceError
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
