"""How well the server's clock is known over networks of all kinds, against the truth."""

import numpy as np
from support.links import NatNetLink, jitter, power_save, queue, queue_at_first
from support.wording import check_line

from socket_testbed.drivers.natnet.client import NatNetClient
from socket_testbed.settings.acquisition import MocapSettings

LIMIT = MocapSettings().clock_uncertainty  # [s]
GOOD = jitter(0.5e-3, 0.3e-3)
LINKS = {
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


def test_a_restarted_server_is_noticed_by_its_first_echo():
    for jump in (-0.05, 0.05, 1e6):

        def restarted(at: float, jump: float = jump) -> float:
            return crystal(at) + (jump if at > 12.0 else 0.0)

        link = NatNetLink(GOOD, GOOD, restarted).run(25.0)
        times, errors, stated = np.array(link.frames).T
        assert link.session.sessions == 2
        right = np.abs(errors) <= stated + 0.02e-3
        assert right[(times < 12.0) | (times > 12.6)].all()
        assert (times > 13.5).sum() > 1000


def test_a_way_back_that_is_always_slower_gives_no_frames_more_echoes_and_a_line_with_what_helps():
    bad = NatNetLink(jitter(3e-4, 1e-4), jitter(8.3e-3, 0.1e-3), crystal).run(10.0)
    assert not bad.frames
    assert 4e-3 < bad.session.clock_error < 5e-3
    client = NatNetClient(bad.settings, lambda *_: None)
    client._session = bad.session
    check_line(client.clock_fault, "clock_uncertainty is 2 ms", "poses are missing", "power_save")
    good = NatNetLink(GOOD, GOOD, crystal).run(10.0)
    assert len(bad.session.echoes) > 2 * len(good.session.echoes)
