"""How well the server's clock is known over networks of all kinds, against the truth."""

from collections.abc import Callable

import numpy as np
import pytest

from socket_testbed.drivers.natnet.clock import EchoClock
from socket_testbed.settings.acquisition import MocapSettings

LIMIT = MocapSettings().clock_uncertainty  # [s]
FREQUENCY = 10_000_000  # [Hz]
FRAMES = 0.01  # [s]

# How long a datagram takes that is sent at a time [s].
Delay = Callable[[float, np.random.Generator], float]


def jitter(shortest: float, mean: float) -> Delay:
    return lambda at, rng: shortest + rng.exponential(mean)


def power_save(awake: float, beacon: float = 0.1024) -> Delay:
    """A radio that is awake for a share of the time; datagrams wait for the next beacon [s]."""

    def delay(at: float, rng: np.random.Generator) -> float:
        phase = at % beacon
        sleeps_from = awake * beacon * 2.0 * np.random.default_rng(int(at / beacon)).random()
        return (0.0 if phase < sleeps_from else beacon - phase) + 0.6e-3 + rng.exponential(0.3e-3)

    return delay


GOOD = jitter(0.5e-3, 0.3e-3)


def crystal(at: float) -> float:
    """A clock that runs 60 ppm fast, 2 ppm more or less as it warms and cools [s]."""
    return 6e-5 * at + 2e-6 * 40.0 / 6.28 * np.sin(6.28 * at / 40.0)


def follow(way: Delay, back: Delay, jump: float = 0.0) -> np.ndarray:
    """Time, error and stated uncertainty of each frame [s]; the clock jumps [s] after 12 s."""
    rng = np.random.default_rng(0)
    clock, begin, found = EchoClock(FREQUENCY), 5000.0, []

    def ticks(at: float) -> int:
        return round((1e4 + at + crystal(at) + (jump if at > 12.0 else 0.0)) * FREQUENCY)

    asked, frame, restarts = 0.0, 0.0, 0
    while asked < 25.0:
        read = asked + way(asked, rng)
        arrival = read + back(read, rng)
        restarts += not clock.add(begin + asked, ticks(read), begin + arrival)
        unsure = clock.uncertainty > 0.5 * LIMIT
        asked += 0.01 if len(clock) < 10 else 0.13 if unsure else 0.5
        while frame < asked:
            frame += FRAMES
            if frame > arrival and (known := clock.to_steady(ticks(frame))):
                found.append((frame, known[0] - begin - frame, known[1]))
    assert restarts == bool(jump)
    return np.array(found).T


@pytest.mark.parametrize(
    ("way", "back", "share"),
    [
        pytest.param(GOOD, power_save(0.1), 0.9, id="mostly-asleep-to-save-power"),
        pytest.param(jitter(3e-4, 1e-4), jitter(8.3e-3, 1e-4), 0.0, id="back-8-ms-slower"),
    ],
)
def test_no_frame_is_stamped_worse_than_is_stated(way: Delay, back: Delay, share: float) -> None:
    _, errors, stated = follow(way, back)
    assert (np.abs(errors) <= stated + 0.02e-3).all()
    used = stated <= LIMIT
    assert used.mean() >= share and used.any() == (share > 0.0)


@pytest.mark.parametrize("jump", [-0.05, 0.05, 1e6], ids=["50-ms-back", "50-ms-on", "days-on"])
def test_another_clock_is_noticed_by_its_first_echo(jump: float) -> None:
    times, errors, stated = follow(GOOD, GOOD, jump)
    right = np.abs(errors) <= stated + 0.02e-3
    assert right[(times < 12.0) | (times > 12.6)].all()
    assert (times > 13.0).sum() > 1150
