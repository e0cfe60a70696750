"""The map of the server's clock, from echoes over networks of all kinds."""

import numpy as np
import pytest

from socket_testbed.drivers.natnet.clock import EchoClock

FREQUENCY = 10_000_000  # [Hz]


class Server:
    """A clock that runs a little fast or slow, behind a network that takes its time."""

    def __init__(self, seed: int, offset: float, drift: float = 0.0, frequency: int = FREQUENCY):
        self.rng = np.random.default_rng(seed)
        self.offset, self.drift, self.frequency = offset, drift, frequency

    def ticks(self, steady: float) -> int:
        return round((steady * (1.0 + self.drift) + self.offset) * self.frequency)

    def echo(self, clock: EchoClock, at: float, way: float, back: float) -> bool:
        return clock.add(at, self.ticks(at + way), at + way + back)

    def echoes(self, clock: EchoClock, times, shortest: float, jitter: float) -> None:
        """Jitter mostly on the way back, in heaps: a Wi-Fi that is busy now and then."""
        for at in times:
            busy = self.rng.random() < 0.3
            way = shortest / 2 + self.rng.exponential(0.1 * jitter)
            back = shortest / 2 + self.rng.exponential(jitter * (5.0 if busy else 0.5))
            assert self.echo(clock, at, way, back)


def times_of_a_session(duration: float) -> np.ndarray:
    return np.concatenate([np.arange(10) * 0.01, np.arange(0.5, duration, 0.5)])


def test_without_echoes_there_is_no_map():
    server, clock = Server(0, 1e4), EchoClock(FREQUENCY)
    for number in range(3):
        assert clock.to_steady(server.ticks(1.0)) is None
        server.echo(clock, 0.1 * number, 1e-4, 1e-4)
    assert clock.to_steady(server.ticks(1.0)) == pytest.approx(1.0, abs=1e-4)


def test_a_drifting_clock_is_followed():
    for drift, frequency in (
        (0.0, FREQUENCY),
        (3e-5, 2_441_406),
        (-8e-5, FREQUENCY),
        (2e-4, 10**9),
    ):
        server, clock = Server(1, 3.2e6, drift, frequency), EchoClock(frequency)
        server.echoes(clock, times_of_a_session(300.0), 4e-4, 2e-4)
        for ago in (0.0, 0.01, 0.4):
            moment = 300.0 - ago
            assert clock.to_steady(server.ticks(moment)) == pytest.approx(moment, abs=2e-4)


def test_the_error_of_an_echo_is_weighed_by_its_round_trip():
    server, clock = Server(0, 0.0), EchoClock(FREQUENCY)
    for number in range(20):
        server.echo(clock, 0.1 * number, 1e-4, 1e-4 if number == 7 else 8e-3)
    assert clock.to_steady(server.ticks(2.0)) == pytest.approx(2.0, abs=5e-4)
    # Half of the shortest round trip, and what the clocks may have drifted apart since then.
    assert 1e-4 < clock.uncertainty < 1e-4 + 1.2 * 6.2e-4


def test_a_restarted_server_is_noticed_by_its_first_echo():
    for jump in (-1e6, -1.0, -0.05, 0.05, 3.0, 1e6):
        server, clock = Server(2, 1e3, 5e-5), EchoClock(FREQUENCY)
        server.echoes(clock, times_of_a_session(60.0), 1e-3, 1e-3)
        server.offset += jump
        assert not server.echo(clock, 60.0, 5e-4, 5e-4)
        assert len(clock) == 1
        assert clock.to_steady(server.ticks(60.0)) is None
        server.echoes(clock, 60.0 + times_of_a_session(1.0), 1e-3, 1e-3)
        assert clock.to_steady(server.ticks(61.0)) == pytest.approx(61.0, abs=1e-3)


def test_a_long_silence_is_no_restart():
    server, clock = Server(3, 1e3, 1e-4), EchoClock(FREQUENCY)
    server.echoes(clock, times_of_a_session(20.0), 1e-3, 1e-3)
    assert server.echo(clock, 120.0, 5e-4, 5e-4)
