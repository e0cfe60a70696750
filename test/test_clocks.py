import math

import pytest

from socket_testbed.clocks import BEGINNING, SteadyClock, TriggerPeriod, TriggerTime

START = 1_760_000_000_123_456_789  # [ns]


class Clocks:
    """A system clock that is stepped and a steady clock that is not."""

    def __init__(self) -> None:
        self.wall, self.steady = START, 5_000_000_000

    def pass_time(self, nanoseconds: int) -> None:
        self.wall += nanoseconds
        self.steady += nanoseconds

    def clock(self) -> SteadyClock:
        return SteadyClock(lambda: self.wall, lambda: self.steady)


def test_it_keeps_its_pace_in_all_processes_and_measures_a_step(monkeypatch) -> None:
    clocks = Clocks()
    clock = clocks.clock()
    assert clock.now() == START and clock.step() == 0.0
    assert clock.to_epoch(clocks.steady * 1e-9) == START
    assert clock.to_steady(START) == clocks.steady * 1e-9
    for step in (3600.0, 0.25, -0.25, -3600.0, 3600.0):
        before, stepped = clock.now(), clock.step()
        clocks.wall += round(step * 1e9)
        assert clock.now() == before
        assert clock.step() - stepped == pytest.approx(step, abs=1e-6)
        clocks.pass_time(7)
        assert clock.now() == before + 7
    monkeypatch.setenv(BEGINNING, str(clock.beginning))
    later = clocks.clock()  # of a process that is started after the clock was set
    assert later.now() == clock.now() and later.step() == clock.step() == 3600.0
    for seconds in (0.0, 5.25, 86400.125, 1e6):
        assert later.to_steady(clock.to_epoch(seconds)) == pytest.approx(seconds, abs=1e-9)


def test_a_stamp_finds_its_time_though_triggers_were_held_up_or_a_clock_was_set() -> None:
    clock = Clocks().clock()
    trigger = TriggerTime(clock)
    for travel in (0.0002, 0.02, 0.3):
        assert trigger.steady(START + 3 * 10**9, 8.0 + travel) == pytest.approx(8.0, abs=1e-6)
    for step in (-2.0, 86400.0):  # between two starts
        trigger, found = TriggerTime(clock), []
        for k in range(10):
            stamp = START + round((10.0 + k + step) * 1e9)
            arrival = 15.0 + k + 0.0004 + 0.0003 * (k % 3)
            found.append(trigger.steady(stamp, arrival) - (15.0 + k))
        assert found[:4] == [-math.inf] * 4
        assert found[4:] == pytest.approx([0.0] * 6, abs=1e-3)
        assert trigger.shift == pytest.approx(-step, abs=1e-3)
        # What happens between two triggers, such as a tare, gets a stamp between theirs.
        assert trigger.stamp(24.5) == pytest.approx(stamp + 5e8, abs=1e6)
        # The trigger's node starts again, too: the clocks agree once more.
        assert trigger.steady(START + 30 * 10**9, 35.0004) == pytest.approx(35.0, abs=1e-6)
        assert trigger.shift == 0.0


def periods_of(triggers: list[tuple[float, int]]) -> list[float]:
    """The periods after triggers with these times [s] and numbers."""
    period = TriggerPeriod()
    return [period.add(1_700_000_000_000_000_000 + round(t * 1e9), n) for t, n in triggers]


def test_jitter_missed_pulses_and_pauses_leave_the_period_and_another_rate_is_followed(rng) -> None:
    assert periods_of([(0.25 * k, k) for k in range(5)]) == pytest.approx([0.0] * 3 + [0.25] * 2)
    seen = [k for k in range(200) if rng.random() > 0.4]
    jittery = [(0.05 * k + rng.uniform(0.0, 2e-3), k) for k in seen]
    assert periods_of(jittery)[6:] == pytest.approx([0.05] * (len(seen) - 6), abs=2.5e-3)
    faster = [(0.25 * k, k) for k in range(9)] + [(2.0 + 0.01 * k, 8 + k) for k in range(1, 9)]
    assert periods_of(faster)[-5:] == pytest.approx([0.01] * 5)
    restarted = [(0.05 * k, 100 + k) for k in range(9)] + [(3.0 + 0.1 * k, k) for k in range(5)]
    assert periods_of(restarted)[-5:] == pytest.approx([0.0] * 3 + [0.1] * 2)
