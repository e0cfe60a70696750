"""Nodes that a trigger or a replay waits for, by their diagnostics; and a replay's pace."""

from types import SimpleNamespace
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from socket_testbed.nodes import replay_node
from socket_testbed.nodes.followers import Followers


class Waiting:
    """Stands for the waiting node in /lab; one publisher of it has one of two subscribers."""

    def __init__(self) -> None:
        self.own: dict[str, tuple[int, int]] = {}
        self.there: dict[str, int] = {}

    def get_namespace(self) -> str:
        return "/lab"

    def listen(self, topic: Any, callback: Any, needed: bool) -> None:
        self.hear = callback

    def links(self) -> dict[str, tuple[int, int]]:
        return self.own

    def count_subscribers(self, name: str) -> int:
        return self.there.get(name, 0)


@pytest.fixture
def node() -> Waiting:
    return Waiting()


@pytest.fixture
def pair(node: Waiting) -> Followers:
    return Followers(node, ("cluster_node", "/other/mocap_node"), lambda: False)


def say(node: Waiting, name: str, **values: object) -> None:
    keys = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    node.hear(DiagnosticArray(status=[DiagnosticStatus(name=name, values=keys)]))


def test_unseen_followers_are_named(pair: Followers) -> None:
    assert len(pair) == 2
    expected = "/lab/cluster_node (not seen), /other/mocap_node (not seen)"
    assert pair.await_links(0.0) == expected


def test_a_waiting_follower_is_named_with_its_need(node: Waiting, pair: Followers) -> None:
    say(node, "/lab/cluster_node", waiting_for="trigger")
    say(node, "/other/mocap_node", waiting_for="")
    assert pair.await_links(0.0) == "/lab/cluster_node (trigger)"


@pytest.mark.parametrize(
    ("own", "there", "said", "lacking"),
    [
        ({"/lab/trigger": (2, 2)}, {}, {}, ""),
        ({"/lab/trigger": (1, 2)}, {}, {}, "subscribers"),
        # Two followers hear the topic, and one is known.
        ({"/lab/trigger": (1, 1)}, {}, {"hears": "/lab/trigger /lab/x"}, "subscribers"),
        ({"/lab/trigger": (2, 1)}, {}, {"hears": "/lab/trigger /lab/x"}, ""),
        # A follower's own publisher has one subscriber, the graph two.
        ({}, {"/lab/pose": 2}, {"links": "/lab/pose=1"}, "subscribers"),
        ({}, {"/lab/pose": 1}, {"links": "/lab/pose=1"}, ""),
    ],
    ids=["linked", "one lacks", "heard", "all heard", "theirs lacks", "theirs"],
)
def test_links_are_awaited(
    own: dict[str, tuple[int, int]],
    there: dict[str, int],
    said: dict[str, str],
    lacking: str,
    node: Waiting,
    pair: Followers,
) -> None:
    node.own, node.there = own, there
    for name in ("/lab/cluster_node", "/other/mocap_node"):
        say(node, name, waiting_for="", **said)
    assert pair.await_links(0.0) == lacking


def test_the_slowest_follower_counts(node: Waiting, pair: Followers) -> None:
    """Of five samples, one follower has four and the other two: three are left."""
    for stamp in range(1, 6):
        pair.sent(stamp)
    assert pair.catch_up(0, 0.0) == 0  # none has reported any progress
    say(node, "/lab/cluster_node", newest_stamp=4)
    say(node, "/other/mocap_node", newest_stamp=2)
    assert pair.catch_up(3, 0.0) == 0
    for stamp in range(6, 9):
        pair.sent(stamp)
    assert pair.catch_up(3, 0.0) == 6


def test_progress_is_forgotten_at_a_jump_back(node: Waiting, pair: Followers) -> None:
    say(node, "/lab/cluster_node", newest_stamp=9)
    pair.sent(9)
    pair.start_over()
    pair.sent(3)
    assert pair.catch_up(0, 0.0) == 1


def test_a_stopped_wait_is_over(node: Waiting) -> None:
    own = Followers(node, ("cluster_node",), lambda: True)
    assert own.await_links(9.0) == ""
    say(node, "/lab/cluster_node", newest_stamp=1)
    own.sent(2)
    assert own.catch_up(0, 9.0) == 0


def test_other_programs_are_not_followed(node: Waiting, pair: Followers) -> None:
    say(node, "/lab/another", newest_stamp=5)
    pair.sent(6)
    assert pair.catch_up(0, 0.0) == 0


@pytest.mark.parametrize(
    "said",
    [
        {"newest_stamp": "never"},
        {"newest_stamp": "1.5e9"},
        {"newest_stamp": "-4"},
        {"newest_stamp": "9" * 40},
        {"links": "trigger"},
        {"links": "/lab/trigger=many"},
        {"links": "/lab/tr-igger=1 =2 /=3"},
    ],
    ids=["word", "fraction", "negative", "huge", "no number", "text", "no names"],
)
def test_another_program_s_values_are_ignored(
    said: dict[str, str], node: Waiting, pair: Followers
) -> None:
    """A node of theirs has the name of ours: its values may be anything."""
    node.there = {"/lab/trigger": 1}
    for name in ("/lab/cluster_node", "/other/mocap_node"):
        say(node, name, waiting_for="", **said)
    assert pair.await_links(0.0) == ""
    pair.sent(1)
    assert pair.catch_up(0, 0.0) == 0


def test_a_wait_says_whether_its_condition_holds(pair: Followers) -> None:
    assert not pair.wait(lambda: False, 1e-3)
    assert pair.wait(lambda: True, 0.0)


# --- the pace of a replay


class Clock:
    """A monotonic clock [s] that each look moves on by 5 ms."""

    def __init__(self) -> None:
        self.now = 50.0

    def monotonic(self) -> float:
        self.now += 0.005
        return self.now


@pytest.mark.parametrize(("rate", "real"), [(1.0, 2.0), (4.0, 0.5)], ids=["real time", "fast"])
def test_the_rate_divides_a_message_s_time(
    rate: float, real: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """2 s after the first message; /clock ticks every 20 ms meanwhile."""
    clock, ticks = Clock(), list[int]()
    monkeypatch.setattr(replay_node, "time", clock)
    pacer = replay_node.Pacer(rate, ticks.append)
    pauses: list[float] = []

    def wait(seconds: float) -> bool:
        pauses.append(seconds)
        clock.now += seconds
        return False

    monkeypatch.setattr(pacer, "sleep", wait)
    monkeypatch.setattr(pacer, "_stopping", SimpleNamespace(wait=wait))
    pacer.begin(10**9)
    begun = clock.now
    assert pacer.wait_for(3 * 10**9)
    assert clock.now - begun == pytest.approx(real, abs=0.02)
    assert ticks[-1] == 3 * 10**9 and ticks == sorted(ticks)
    assert ticks[0] == pytest.approx(10**9, abs=0.05 * 10**9)
    assert max(pauses) == pytest.approx(0.02) and pacer.wait_for(10**9)


def test_a_stopped_pacer_waits_no_longer() -> None:
    pacer = replay_node.Pacer(1.0, lambda stamp: None, paused=True)
    assert not pacer._going.is_set()
    pacer.pause(False)
    assert pacer._going.is_set()
    pacer.stop()
    pacer.begin(0)
    assert not pacer.wait_for(10**12)
