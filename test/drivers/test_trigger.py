"""The trigger's driver against simulated lines."""

import sys
from pathlib import Path
from unittest.mock import Mock

import gpiod
import pytest
from support.clocks import FakeClock
from support.wording import refused

from socket_testbed.drivers.gpio import GpioTrigger, TimerTrigger, trigger_lines
from socket_testbed.errors import DeviceError
from socket_testbed.settings.acquisition import TriggerSettings
from socket_testbed.simulation.world import FAULTS, SimulatedLines

SETTINGS = TriggerSettings()


class Bench:
    def __init__(self) -> None:
        self.clock = FakeClock(look=1e-6)
        self.faults = dict.fromkeys(FAULTS, 0.0)
        lines = SimulatedLines(self.faults, self.clock, self.clock.sleep)
        self.trigger = GpioTrigger(lines, SETTINGS, self.clock, self.clock.sleep)

    def fire(self) -> float:
        try:
            return self.trigger.fire()
        finally:
            self.trigger.rest()


def test_a_trigger_s_time_is_that_of_its_edge_and_its_pulse_lasts() -> None:
    bench = Bench()
    for _ in range(100):
        before = bench.clock.now
        stamp = bench.fire()
        assert before < stamp < before + 1e-4
        assert bench.clock.now - before >= SETTINGS.pulse
    assert bench.trigger.stray == 0
    timer = TimerTrigger(bench.clock)  # which needs no wire
    first = timer.fire()
    bench.clock.sleep(0.25)
    assert 0.25 <= timer.fire() - first < 0.2501


def test_a_missing_edge_names_both_lines_and_a_late_one_is_never_another_pulse_s() -> None:
    bench = Bench()
    bench.faults["trigger.missing"] = 1.0
    with refused(DeviceError, "no edge on line 27", "line 17", "check the wire"):
        bench.fire()
    bench.faults["trigger.missing"] = 0.0
    for late in (0.0011, 0.01, 0.2):
        bench.faults["trigger.late"] = late
        stray = bench.trigger.stray
        for _ in range(20):
            with pytest.raises(DeviceError):
                bench.fire()
            bench.clock.sleep(0.05)
        bench.faults["trigger.late"] = 0.0
        for _ in range(20):
            before = bench.clock.now
            assert before < bench.fire() < before + SETTINGS.edge_within
            bench.clock.sleep(0.05)
        assert bench.trigger.stray > stray + 10


def test_lines_that_cannot_be_had_say_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "glob", lambda *_: iter(()))
    with refused(DeviceError, "'pinctrl-rp1' (there is none)", "set trigger_node's"):
        trigger_lines(SETTINGS)
    monkeypatch.setattr(Path, "glob", lambda *_: iter([Path("/dev/gpiochip0")]))
    denied = PermissionError(13, "Permission denied", "/dev/gpiochip0")
    monkeypatch.setattr(gpiod, "Chip", Mock(side_effect=denied))
    with refused(DeviceError, "gpiochip0: permission denied", "gpio"):
        trigger_lines(SETTINGS)
    monkeypatch.setitem(sys.modules, "gpiod", None)  # as if it were not installed
    with refused(DeviceError, "hardware.txt"):
        trigger_lines(SETTINGS)
