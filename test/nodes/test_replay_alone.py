"""A replay without a graph: what it publishes of the hold, where, and with which numbers."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import HANGS
from support.nodes import Maker, running_ros
from support.wording import refused

from socket_testbed.errors import ConfigurationError
from socket_testbed.nodes import replay_node
from socket_testbed.nodes.replay_node import ReplayNode
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.trial import Trial


@pytest.fixture(scope="module", autouse=True)
def ros() -> Iterator[None]:
    with running_ros():
        yield


@pytest.fixture
def make(make: Maker, monkeypatch: pytest.MonkeyPatch) -> Maker:
    monkeypatch.setattr(replay_node, "_DISCOVERY_TIME", 0.0)
    return make


@pytest.fixture
def replay(make: Maker, hold: Path) -> Callable[..., ReplayNode]:
    """Replays the hold as fast as it goes, to its end."""

    def run(**parameters: Any) -> ReplayNode:
        node = make(ReplayNode, trial=hold, rate=10_000.0, **parameters)
        node._thread.join(HANGS)
        return node

    return run


def test_every_message_is_replayed_once(
    replay: Callable[..., ReplayNode], make: Maker, hold: Path
) -> None:
    node = replay()
    with BagReader(hold) as bag:
        counts, duration = bag.counts, bag.duration
    sent = {name: len(make.sent[name]) for name, count in counts.items() if count}
    assert sent == {name: count for name, count in counts.items() if count}
    figures = node.figures()
    assert figures["published"] == sum(counts.values())
    assert figures["position"] == figures["duration"] == f"{duration:.1f}"
    assert 59.0 < duration < 61.0 and node.finished.done()
    assert node.get_name() == "replay_node"
    assert make.state() == (0, f"replaying {hold}")


def test_messages_keep_their_numbers_and_stamps(
    replay: Callable[..., ReplayNode], make: Maker, hold: Path
) -> None:
    replay()
    samples = Trial(hold).samples()
    message = make.sent["/load_cell/wrench"][100]
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == samples.stamps[100]
    force = message.wrench.force
    assert (force.x, force.y, force.z) == tuple(samples.wrench[100, 3:])


def test_the_clock_is_that_of_the_recording(
    replay: Callable[..., ReplayNode], make: Maker, hold: Path
) -> None:
    replay()
    times = [m.clock.sec * 10**9 + m.clock.nanosec for m in make.sent["/clock"]]
    with BagReader(hold) as bag:
        recorded = [raw.time for raw in bag.messages()]
    assert times == sorted(times) and times[-1] == recorded[-1]
    assert times[0] == pytest.approx(recorded[0], abs=1e9)


def test_a_namespace_renames_the_topics(replay: Callable[..., ReplayNode], make: Maker) -> None:
    replay(namespace="left")
    assert len(make.sent["/left/trigger"]) == 240 and not make.sent["/trigger"]
    assert make.sent["/left/tf"] and not make.sent["/tf"]


def test_recomputed_wrenches_replace_the_recorded_ones(
    replay: Callable[..., ReplayNode], make: Maker, hold: Path
) -> None:
    """The first 5 s count as without load, so that their mean is zero."""
    replay(tare="0:5")
    force = [m.wrench.force.z for m in make.sent["/load_cell/wrench"]]
    assert np.mean(force[:21]) == pytest.approx(0.0, abs=1e-9)
    recorded = Trial(hold).samples().wrench[:, 5]
    assert force[100] == pytest.approx(recorded[100] - recorded[:21].mean())


def test_a_replay_needs_a_trial(make: Maker) -> None:
    with refused(ConfigurationError, "replay_node: trial is empty: give the path of a trial"):
        make(ReplayNode)


def test_a_pause_says_so(replay: Callable[..., ReplayNode]) -> None:
    node = replay()
    assert (node._on_pause(True), node._on_pause(False)) == ("paused", "resumed")
    assert node._pacer._going.is_set()


def test_a_looping_replay_starts_over(make: Maker, hold: Path) -> None:
    """The clock jumps back."""
    node = make(ReplayNode, trial=hold, rate=10_000.0, loop="true")
    deadline = time.monotonic() + HANGS
    while len(make.sent["/trigger"]) < 250 and time.monotonic() < deadline:
        time.sleep(1e-2)
    node._pacer.stop()
    node._thread.join(HANGS)
    numbers = [message.sequence for message in make.sent["/trigger"]]
    assert numbers[240:250] == numbers[:10]
