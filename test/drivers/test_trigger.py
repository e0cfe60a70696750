"""The trigger's driver against simulated lines, and where a stamp is on the steady clock."""

import builtins
import math
from pathlib import Path

import pytest
from support.clocks import FakeClock

from socket_testbed.clocks import SteadyClock, TriggerTime
from socket_testbed.drivers.trigger import GpiodLines, GpioTrigger, TimerTrigger
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


def test_without_the_chip_its_label_and_the_mend_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "glob", lambda *_: iter(()))
    with pytest.raises(DeviceError, match=r"'pinctrl-rp1' \(there is none\): set trigger_node's"):
        GpiodLines(SETTINGS)


def test_a_chip_that_may_not_be_used_names_the_group(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    import gpiod

    def refuse(path: str) -> None:
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr(Path, "glob", lambda *_: iter([tmp_path / "gpiochip0"]))
    monkeypatch.setattr(gpiod, "Chip", refuse)
    with pytest.raises(DeviceError, match=r"gpiochip0: permission denied: .*gpio"):
        GpiodLines(SETTINGS)


def test_without_gpiod_the_mend_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    original = builtins.__import__

    def refuse(name: str, *rest: object, **more: object) -> object:
        if name.startswith("gpiod"):
            raise ImportError(name)
        return original(name, *rest, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(DeviceError, match=r"hardware\.txt"):
        GpiodLines(SETTINGS)


def clock_of(wall: list[int], steady: list[int]) -> SteadyClock:
    return SteadyClock(lambda: wall[0], lambda: steady[0])


def test_a_stamp_finds_its_time_whatever_the_travel() -> None:
    wall, steady = [1_700_000_000_000_000_000], [50_000_000_000]
    time = TriggerTime(clock_of(wall, steady))
    stamp = wall[0] + 3_000_000_000
    for travel in (0.0002, 0.02, 0.3):
        assert time.steady(stamp, 53.0 + travel) == pytest.approx(53.0, abs=1e-6)
    assert time.shift == 0.0


@pytest.mark.parametrize("step", [-3600.0, -2.0, 2.0, 86400.0])
def test_a_clock_set_between_two_starts_is_found_by_the_arrival(step: float) -> None:
    wall, steady = [1_700_000_000_000_000_000], [50_000_000_000]
    time = TriggerTime(clock_of(wall, steady))
    told = []
    for k in range(10):
        sent = 60.0 + k
        stamp = wall[0] + round((sent - 50.0 + step) * 1e9)
        told.append(time.steady(stamp, sent + 0.0004 + 0.0003 * (k % 3)) - sent)
    assert told[:4] == [-math.inf] * 4
    assert told[4:] == pytest.approx([0.0] * 6, abs=1e-3)
    assert time.shift == pytest.approx(-step, abs=1e-3)
    # The trigger's node starts again, too: the clocks agree once more.
    assert time.steady(wall[0] + 30_000_000_000, 80.0004) == pytest.approx(80.0, abs=1e-6)
    assert time.shift == 0.0


def test_triggers_that_were_held_up_are_not_taken_for_another_clock() -> None:
    wall, steady = [1_700_000_000_000_000_000], [50_000_000_000]
    time = TriggerTime(clock_of(wall, steady))
    stamps = [wall[0] + round((3.0 + 0.05 * k) * 1e9) for k in range(40)]
    for k, stamp in enumerate(stamps):  # all at once, when the node begins to listen
        told = time.steady(stamp, 55.0 + 1e-5 * k)
        assert told in (-math.inf, pytest.approx(53.0 + 0.05 * k, abs=1e-6))
    assert time.shift == 0.0
