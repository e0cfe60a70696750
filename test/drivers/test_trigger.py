"""The trigger's driver against simulated lines."""

import builtins
from pathlib import Path

import pytest
from support.clocks import FakeClock

from socket_testbed.drivers.trigger import GpioTrigger, TimerTrigger, TriggerLines
from socket_testbed.errors import DeviceError
from socket_testbed.settings.acquisition import TriggerSettings
from socket_testbed.simulation.devices.gpio_lines import SimulatedLines
from socket_testbed.simulation.world import FAULTS

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


def test_a_trigger_s_time_is_that_of_its_edge() -> None:
    bench = Bench()
    for _ in range(100):
        before = bench.clock.now
        stamp = bench.fire()
        assert before < stamp < before + 1e-4 < bench.clock.now
    assert bench.trigger.stray == 0


def test_the_pulse_lasts_as_long_as_it_should() -> None:
    bench = Bench()
    before = bench.clock.now
    bench.fire()
    assert bench.clock.now - before >= SETTINGS.pulse


def test_a_missing_edge_names_both_lines() -> None:
    bench = Bench()
    bench.faults["trigger.missing"] = 1.0
    with pytest.raises(DeviceError, match=r"no edge on line 27 .* line 17: check the wire"):
        bench.fire()
    bench.faults["trigger.missing"] = 0.0
    assert bench.fire() > 100.0


@pytest.mark.parametrize("late", [0.0011, 0.01, 0.2])
def test_a_late_edge_is_never_another_pulse_s(late: float) -> None:
    bench = Bench()
    bench.faults["trigger.late"] = late
    for _ in range(20):
        with pytest.raises(DeviceError, match="no edge"):
            bench.fire()
        bench.clock.sleep(0.05)
    bench.faults["trigger.late"] = 0.0
    for _ in range(20):
        before = bench.clock.now
        assert before < bench.fire() < before + SETTINGS.edge_within
        bench.clock.sleep(0.05)
    assert bench.trigger.stray > 10


def test_a_timer_needs_no_wire() -> None:
    clock = FakeClock(look=1e-6)
    trigger = TimerTrigger(clock)
    first = trigger.fire()
    clock.sleep(0.25)
    assert 0.25 <= trigger.fire() - first < 0.2501


def test_without_the_chip_its_label_and_the_hint_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "glob", lambda *_: iter(()))
    with pytest.raises(DeviceError, match=r"'pinctrl-rp1' \(there is none\): set trigger_node's"):
        TriggerLines(SETTINGS)


def test_a_chip_that_may_not_be_used_names_the_group(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    import gpiod

    def refuse(path: str) -> None:
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr(Path, "glob", lambda *_: iter([tmp_path / "gpiochip0"]))
    monkeypatch.setattr(gpiod, "Chip", refuse)
    with pytest.raises(DeviceError, match=r"gpiochip0: permission denied: .*gpio"):
        TriggerLines(SETTINGS)


def test_without_gpiod_the_hint_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    original = builtins.__import__

    def refuse(name: str, *rest: object, **more: object) -> object:
        if name.startswith("gpiod"):
            raise ImportError(name)
        return original(name, *rest, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(DeviceError, match=r"hardware\.txt"):
        TriggerLines(SETTINGS)
