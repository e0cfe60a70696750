"""How well the server's clock is known over networks of all kinds, against the truth."""

import numpy as np
import pytest
from support.links import NatNetLink, jitter, power_save, queue, queue_at_first
from support.natnet import Link, until
from support.wording import check_line

from socket_testbed.drivers.natnet.clock import EchoClock
from socket_testbed.settings.acquisition import MocapSettings

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


def test_a_drifting_clock_is_followed():
    for drift, frequency in ((3e-5, 2_441_406), (-8e-5, FREQUENCY), (2e-4, 10**9)):
        server, clock = Server(1, 3.2e6, drift, frequency), EchoClock(frequency)
        server.echoes(clock, times_of_a_session(300.0), 4e-4, 2e-4)
        for ago in (0.0, 0.01, 0.4):
            moment = 300.0 - ago
            assert clock.to_steady(server.ticks(moment))[0] == pytest.approx(moment, abs=2e-4)


def test_a_restarted_server_is_noticed_by_its_first_echo():
    for jump in (-1e6, -1.0, -0.05, 0.05, 3.0, 1e6):
        server, clock = Server(2, 1e3, 5e-5), EchoClock(FREQUENCY)
        server.echoes(clock, times_of_a_session(60.0), 1e-3, 1e-3)
        assert server.echo(clock, 120.0, 5e-4, 5e-4)  # a long silence is no restart
        server.offset += jump
        assert not server.echo(clock, 121.0, 5e-4, 5e-4)
        assert len(clock) == 1
        assert clock.to_steady(server.ticks(121.0)) is None
        server.echoes(clock, 121.0 + times_of_a_session(1.0), 1e-3, 1e-3)
        assert clock.to_steady(server.ticks(122.0))[0] == pytest.approx(122.0, abs=1e-3)


LIMIT = MocapSettings().clock_uncertainty  # [s]
GOOD = jitter(0.5e-3, 0.3e-3)
LINKS = {
    "cable": (jitter(1e-4, 2e-5), jitter(1e-4, 3e-5)),
    "busy Wi-Fi": (jitter(0.8e-3, 0.4e-3), jitter(0.8e-3, 1.5e-3)),
    "a queue that fills and empties": (GOOD, queue(0.5e-3, 0.02, 7.0)),
    "a queue of 30 ms at first, back": (GOOD, queue_at_first(0.03, 2.0, GOOD)),
    "a queue of 30 ms at first, forth": (queue_at_first(0.03, 2.0, GOOD), GOOD),
    "power saving, mostly awake": (GOOD, power_save(0.8)),
    "power saving, mostly asleep": (GOOD, power_save(0.1)),
    "back always 3 ms slower": (jitter(3e-4, 1e-4), jitter(3.3e-3, 1e-4)),
}


def crystal(at: float) -> float:
    """A clock that runs 60 ppm fast, 2 ppm more or less as it warms and cools [s]."""
    return 6e-5 * at + 2e-6 * 40.0 / 6.28 * np.sin(6.28 * at / 40.0)


def test_no_frame_is_stamped_worse_than_is_stated():
    for name, ways in LINKS.items():
        links = [NatNetLink(*ways, crystal, seed).run(25.0) for seed in range(2)]
        _, errors, stated = np.concatenate([np.array(link.frames) for link in links]).T
        assert len(errors) > (130 if "asleep" in name else 1300), name
        assert (np.abs(errors) <= stated + 0.02e-3).all(), name
        assert stated.max() <= LIMIT
        assert all(link.session.sessions == 1 for link in links)
        if "queue of 30 ms at first, back" in name:  # none while it is full, then all
            times = np.array(links[0].frames)[:, 0]
            assert 2.0 < times[0] < 2.5 and times[-1] > 24.9


def test_a_way_back_that_is_always_slower_gives_no_frames_and_more_echoes():
    bad = NatNetLink(jitter(3e-4, 1e-4), jitter(8.3e-3, 0.1e-3), crystal).run(10.0)
    assert not bad.frames
    assert 4e-3 < bad.session.clock_error < 5e-3
    good = NatNetLink(GOOD, GOOD, crystal).run(10.0)
    assert len(bad.session.echoes) > 2 * len(good.session.echoes)


def test_a_clock_that_is_known_badly_is_reported_with_what_helps():
    with Link(settings={"clock_uncertainty": 1e-5}) as link:  # no round trip is that short
        link.until_level(1, "Motive's clock is known within 0.")
        check_line(link.client.clock_fault, "clock_uncertainty", "poses are missing", "power_save")
        assert not link.frames
        link.faults["mocap.unplugged"] = 1.0
        link.until_level(2, "no answer from")
        until(lambda: link.client.clock_fault == "", "the end of the session")
