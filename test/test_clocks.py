from collections.abc import Iterator

import numpy as np
import pytest

from socket_testbed.clocks import BEGINNING, SteadyClock

START = 1_760_000_000_123_456_789  # [ns]


class Clocks:
    """A system clock that is stepped and a steady clock that is not."""

    def __init__(self) -> None:
        self.wall = START
        self.steady = 5_000_000_000

    def pass_time(self, nanoseconds: int) -> None:
        self.wall += nanoseconds
        self.steady += nanoseconds


@pytest.fixture
def clocks() -> Clocks:
    return Clocks()


@pytest.fixture
def clock(clocks: Clocks) -> Iterator[SteadyClock]:
    yield SteadyClock(lambda: clocks.wall, lambda: clocks.steady)


def test_it_starts_as_the_system_clock_and_keeps_its_pace(clocks, clock) -> None:
    assert clock.now() == START and clock.step() == 0.0
    clocks.pass_time(1_234_567_891)
    assert clock.now() == clocks.wall == START + 1_234_567_891


@pytest.mark.parametrize("step", [3600.0, 0.25, -0.25, -3600.0])
def test_a_step_of_the_system_clock_is_measured_and_not_followed(clocks, clock, step) -> None:
    clocks.pass_time(10**9)
    before = clock.now()
    clocks.wall += round(step * 1e9)
    assert clock.now() == before
    assert clock.step() == pytest.approx(step, abs=1e-9)
    clocks.pass_time(7)
    assert clock.now() == before + 7


def test_times_never_go_back_whatever_the_system_clock_does(clocks, clock) -> None:
    rng = np.random.default_rng(0)
    times = []
    for _ in range(200):
        clocks.pass_time(int(rng.integers(0, 10**8)))
        clocks.wall += int(rng.integers(-(10**10), 10**10))
        times.append(clock.now())
    assert times == sorted(times)


def test_steady_times_and_stamps_are_each_other_s_inverse(clocks, clock) -> None:
    assert clock.to_epoch(clocks.steady * 1e-9) == START
    assert clock.to_steady(START) == clocks.steady * 1e-9
    clocks.wall += 10**12  # a step changes neither
    for seconds in (0.0, 5.25, 86400.125, 1e6):
        assert clock.to_steady(clock.to_epoch(seconds)) == pytest.approx(seconds, abs=1e-9)


def test_by_default_it_reads_this_machine_s_clocks() -> None:
    clock = SteadyClock()
    first = clock.now()
    assert clock.now() >= first
    assert abs(clock.step()) < 1.0


def test_processes_of_one_graph_tell_the_same_time(
    clocks: Clocks, clock: SteadyClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(BEGINNING, str(clock.beginning))
    clocks.pass_time(7_000_000_000)
    clocks.wall += 3_600_000_000_000  # set before another process starts
    later = SteadyClock(lambda: clocks.wall, lambda: clocks.steady)
    assert later.now() == clock.now()
    assert later.step() == clock.step() == 3600.0
