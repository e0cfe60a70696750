import threading
import time
from types import SimpleNamespace

import pytest
from support.clocks import FakeClock

from socket_testbed.nodes import replay_node
from socket_testbed.nodes.replay_node import Pacer


def test_the_clock_never_runs_back_and_ends_at_the_message(monkeypatch: pytest.MonkeyPatch) -> None:
    # 10 ms pass with each look at the clock, however fast the machine is.
    clock = FakeClock(look=0.01)
    monkeypatch.setattr(replay_node, "time", SimpleNamespace(monotonic=clock))
    ticks: list[int] = []
    pacer = Pacer(2.0, ticks.append)
    pacer.begin(0)
    start = clock.now
    for stamp in (0, 90_000_000, 90_000_000, 300_000_000):
        assert pacer.wait_for(stamp)
        assert ticks[-1] == stamp
        assert clock.now - start >= 1e-9 * stamp / 2.0  # never early, in the recording's time
    assert ticks == sorted(ticks) and len(ticks) > 8


def test_a_pause_moves_what_follows_and_a_stop_ends_every_wait() -> None:
    pacer = Pacer(1.0, tick=lambda stamp: None, paused=True)
    pacer.begin(0)
    start = time.monotonic()
    threading.Timer(0.2, pacer.pause, [False]).start()
    assert pacer.wait_for(0)
    assert pacer.wait_for(100_000_000)
    assert time.monotonic() - start > 0.25  # 0.3; 0.2 if what follows did not move
    for paused in (False, True):
        pacer = Pacer(1.0, tick=lambda stamp: None, paused=paused)
        pacer.begin(0)
        threading.Timer(0.05, pacer.stop).start()
        assert not pacer.wait_for(3_600_000_000_000) and pacer.stopped()
        pacer.rest(3600.0)  # returns at once
