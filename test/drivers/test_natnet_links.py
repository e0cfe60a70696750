"""How well the server's clock is known over networks of all kinds, against the truth."""

import numpy as np
import pytest
from support.links import NatNetLink, jitter, power_save, queue, queue_at_first
from support.natnet import Link, until

from socket_testbed.settings.acquisition import MocapSettings

LIMIT = MocapSettings().clock_uncertainty  # [s]
GOOD = jitter(0.5e-3, 0.3e-3)
SLOWER = jitter(8.3e-3, 0.1e-3)
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


@pytest.mark.parametrize("name", LINKS)
def test_no_frame_is_stamped_worse_than_is_stated(name):
    links = [NatNetLink(*LINKS[name], crystal, seed).run(25.0) for seed in range(3)]
    _, errors, stated = np.concatenate([np.array(link.frames) for link in links]).T
    assert len(errors) > 2000 if "asleep" not in name else len(errors) > 200
    assert (np.abs(errors) <= stated + 0.5e-3).mean() > 0.995
    assert (np.abs(errors) <= stated + 0.02e-3).all()
    assert stated.max() <= LIMIT
    assert all(link.session.sessions == 1 for link in links)


def test_frames_stamped_while_a_queue_is_full_are_not_used_and_those_after_it_are():
    link = NatNetLink(GOOD, queue_at_first(0.03, 2.0, GOOD), crystal).run(6.0)
    times = np.array(link.frames)[:, 0]
    assert 2.0 < times[0] < 2.5 and times[-1] > 5.9
    assert link.session.clock_error < LIMIT


def test_a_way_back_that_is_always_slower_hides_from_echoes_and_gives_no_frames():
    link = NatNetLink(jitter(3e-4, 1e-4), SLOWER, crystal).run(10.0)
    assert not link.frames
    assert 4e-3 < link.session.clock_error < 5e-3


def test_echoes_are_sent_more_often_while_the_clock_is_known_badly():
    bad = NatNetLink(GOOD, SLOWER, crystal).run(10.0)
    good = NatNetLink(GOOD, GOOD, crystal).run(10.0)
    assert len(bad.session.echoes) > 2 * len(good.session.echoes)


def test_a_clock_that_is_known_badly_is_reported_with_what_helps():
    with Link(settings={"clock_uncertainty": 1e-5}) as link:  # no round trip is that short
        link.until_level(1, "Motive's clock is known within 0.")
        level, text = link.health()
        assert (level, text) == (1, link.client.clock_fault)
        assert "(clock_uncertainty is 0.01 ms), so poses are missing: switch the Wi-Fi's" in text
        assert "power_save off" in text
        assert not link.frames
        link.faults["mocap.unplugged"] = 1.0
        link.until_level(2, "no answer from")
        until(lambda: link.client.clock_fault == "", "the end of the session")
