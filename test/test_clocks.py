import math

import pytest

from socket_testbed.clocks import BEGINNING, SteadyClock, StepsBack, TriggerPeriod, TriggerTime

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


@pytest.mark.parametrize(
    "step",
    [3600.0, 0.25, -0.25, -3600.0],
    ids=["an-hour-on", "250-ms-on", "250-ms-back", "an-hour-back"],
)
def test_a_clock_keeps_its_pace_through_steps(step: float) -> None:
    """It measures them."""
    clocks = Clocks()
    clock = clocks.clock()
    assert clock.now() == START and clock.step() == 0.0
    for _ in range(2):
        before, stepped = clock.now(), clock.step()
        clocks.wall += round(step * 1e9)
        assert clock.now() == before
        assert clock.step() - stepped == pytest.approx(step, abs=1e-6)
        clocks.pass_time(7)
        assert clock.now() == before + 7


def test_a_clock_starts_at_the_system_s_time() -> None:
    clocks = Clocks()
    clock = clocks.clock()
    assert clock.to_epoch(clocks.steady * 1e-9) == START
    assert clock.to_steady(START) == clocks.steady * 1e-9


@pytest.mark.parametrize(
    ("step", "back"),
    [(-7200.0, True), (-0.002, True), (-0.0005, False), (3600.0, False)],
    ids=["two-hours-back", "2-ms-back", "slewed", "an-hour-on"],
)
def test_a_step_back_is_noticed_once(step: float, back: bool) -> None:
    clocks = Clocks()
    steps = StepsBack(lambda: 1e-9 * clocks.wall, lambda: 1e-9 * clocks.steady)
    clocks.pass_time(10**9)
    assert not steps.noticed()
    clocks.wall += round(step * 1e9)
    assert steps.noticed() == back
    clocks.pass_time(10**9)
    assert not steps.noticed()


@pytest.fixture
def two_clocks(monkeypatch: pytest.MonkeyPatch) -> tuple[SteadyClock, SteadyClock]:
    """Those of two processes; the second is started after the system's clock was set."""
    clocks = Clocks()
    clock = clocks.clock()
    clocks.wall += 3600 * 10**9
    clocks.pass_time(7)
    monkeypatch.setenv(BEGINNING, str(clock.beginning))
    return clock, clocks.clock()


def test_all_processes_have_the_same_time(two_clocks) -> None:
    clock, later = two_clocks
    assert later.now() == clock.now() and later.step() == clock.step() == 3600.0


@pytest.mark.parametrize("seconds", [0.0, 5.25, 86400.125, 1e6])
def test_all_processes_have_the_same_stamps(two_clocks, seconds: float) -> None:
    clock, later = two_clocks
    assert later.to_steady(clock.to_epoch(seconds)) == pytest.approx(seconds, abs=1e-9)


def test_a_stamp_finds_its_time_though_held_up() -> None:
    trigger = TriggerTime(Clocks().clock())
    found = [trigger.steady(START + 3 * 10**9, 8.0 + travel) for travel in (0.0002, 0.02, 0.3)]
    assert found == pytest.approx([8.0] * 3, abs=1e-6)


@pytest.mark.parametrize("step", [-2.0, 86400.0], ids=["2-s-back", "a-day-on"])
def test_a_stamp_finds_its_time_after_steps(step: float) -> None:
    """Of the clock, between two starts."""
    trigger, found = TriggerTime(Clocks().clock()), []
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


def test_a_period_is_known_after_three_triggers() -> None:
    assert periods_of([(0.25 * k, k) for k in range(5)]) == pytest.approx([0.0] * 3 + [0.25] * 2)


def test_jitter_of_few_pulses_leaves_the_period(rng) -> None:
    seen = [k for k in range(200) if rng.random() > 0.4]
    jittery = [(0.05 * k + rng.uniform(0.0, 2e-3), k) for k in seen]
    assert periods_of(jittery)[6:] == pytest.approx([0.05] * (len(seen) - 6), abs=2.5e-3)


@pytest.mark.parametrize("period", [0.01, 1.0], ids=["faster", "slower"])
def test_another_rate_is_followed(period: float) -> None:
    changed = [(0.25 * k, k) for k in range(9)] + [(2.0 + period * k, 8 + k) for k in range(1, 9)]
    assert periods_of(changed)[-5:] == pytest.approx([period] * 5)


def test_a_restarted_trigger_has_a_new_period() -> None:
    restarted = [(0.05 * k, 100 + k) for k in range(9)] + [(3.0 + 0.1 * k, k) for k in range(5)]
    assert periods_of(restarted)[-5:] == pytest.approx([0.0] * 3 + [0.1] * 2)
