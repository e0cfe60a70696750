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


def test_a_trigger_s_time_is_that_of_its_edge_never_of_another_pulse_s(monkeypatch) -> None:
    clock, faults = FakeClock(look=1e-6).install(monkeypatch), dict.fromkeys(FAULTS, 0.0)
    lines = SimulatedLines(faults)
    trigger = GpioTrigger(lines, SETTINGS)

    def fire(times: int) -> None:
        for _ in range(times):
            before = clock.now
            assert before < trigger.fire() < before + 1e-4
            trigger.end_pulse()
            assert clock.now - before >= SETTINGS.pulse
            clock.sleep(0.05)

    fire(100)
    assert trigger.stray == 0
    faults["trigger.missing"] = 1.0
    with refused(DeviceError, "no edge on line 27", "line 17", "check the wire"):
        trigger.fire()
    trigger.end_pulse()
    faults["trigger.missing"] = 0.0
    for late in (0.0011, 0.01, 0.2):
        stray, faults["trigger.late"] = trigger.stray, late
        for _ in range(20):
            with pytest.raises(DeviceError):
                trigger.fire()
            trigger.end_pulse()
            clock.sleep(0.05)
        faults["trigger.late"] = 0.0
        fire(20)
        assert trigger.stray > stray + 10


def test_drdy_is_asked_for_falling_edges_on_the_steady_clock(monkeypatch) -> None:
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
