"""Recorder and replay without a graph: each line that they say, whole."""

import errno
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support import HANGS
from support.clocks import FakeClock
from support.nodes import Maker, running_ros

from socket_testbed.errors import ConfigurationError, TestbedError, TrialError
from socket_testbed.nodes import recorder_node, replay_node
from socket_testbed.nodes.base import TestbedNode
from socket_testbed.nodes.controls import Marked, _refusal
from socket_testbed.nodes.recorder_node import RecorderNode
from socket_testbed.nodes.replay_node import ReplayNode
from socket_testbed.trials.bag import BagWriter
from socket_testbed.wire import messages
from socket_testbed.wire.topics import EVENT

OK, WARN, ERROR = 0, 1, 2
REQUIRED = {
    "/clusters/capacitance",
    "/load_cell/wrench",
    "/mocap/pylon/pose",
    "/mocap/socket/pose",
    "/trigger",
}


@pytest.fixture(scope="module", autouse=True)
def ros() -> Iterator[None]:
    mask = os.umask(0)  # a recorder changes it
    with running_ros():
        yield
    os.umask(mask)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "trials"


# --- the recorder


def test_a_silent_recording_says_what_to_check(
    make: Maker, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = FakeClock().install(monkeypatch)
    node = make(RecorderNode, directory=folder, record="true")
    clock.sleep(10.1)
    node.check()
    assert make.state() == (
        WARN,
        f"recording {folder}, but nothing arrives: check that the testbed runs, with the same"
        " ROS_DOMAIN_ID (on another computer: docs/hardware.md, Network)",
    )


def test_silent_topics_are_those_without_any_message(make: Maker, folder: Path) -> None:
    node = make(RecorderNode, directory=folder, record="true")
    assert set(node._silent_topics()) == REQUIRED
    node._on_message("/trigger", messages.trigger_packer()(1, 1))
    node._on_message("/event", b"")
    assert set(node._silent_topics()) == REQUIRED - {"/trigger"}


def test_a_stopped_recorder_says_how_much_it_has(make: Maker, folder: Path) -> None:
    node = make(RecorderNode, directory=folder)
    assert node.figures()["trial"] == "" and node.figures()["elapsed"] == 0.0
    assert node._on_record(False) == "nothing was being recorded"
    assert make.state() == (OK, "started")
    node.close()
    assert make.state() == (OK, "started")


def test_a_folder_has_one_recorder(
    make: Maker, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(RecorderNode, directory=folder, record="true").close()
    monkeypatch.setattr(recorder_node, "is_held", lambda path: path == folder)
    with pytest.raises(ConfigurationError) as found:
        make(RecorderNode, directory=folder, record="true")
    assert str(found.value) == (
        f"{folder} is being written by another recorder: end it, or name a new folder"
    )


@pytest.mark.parametrize(
    ("number", "hint"),
    [
        (errno.ENOSPC, "make space"),
        (errno.EACCES, "check the permissions"),
        (errno.EEXIST, "name another folder"),
        (errno.ENOTDIR, "name another folder, a part of its path is a file"),
        (errno.ENAMETOOLONG, "give a shorter name"),
        (errno.EROFS, "check its file system for errors, and mount it again for writing"),
    ],
    ids=["full", "no-permission", "exists", "file-in-path", "long-name", "read-only"],
)
def test_a_trial_that_cannot_begin_leaves_nothing(
    number: int, hint: str, make: Maker, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*given: Any) -> None:
        raise OSError(number, os.strerror(number))

    node = make(RecorderNode, directory=folder)
    node._on_record(True)
    node._on_record(False)
    monkeypatch.setattr(recorder_node, "store_configuration", refuse)
    node._next_path = lambda name: folder / "b"  # type: ignore[method-assign]
    with pytest.raises(ConfigurationError) as found:
        node._on_record(True)
    assert str(found.value) == (
        f"{folder / 'b'}: cannot be written ({os.strerror(number)}): {hint}"
    )
    assert not (folder / "b").exists() and node._bag is None


def test_a_disk_that_fills_at_the_end_fails_the_request(make: Maker, folder: Path) -> None:
    node = make(RecorderNode, directory=folder)
    node._on_record(True)
    path, bag = node._path, node._bag
    assert bag is not None
    end = bag.__exit__

    def fail(*given: Any) -> None:
        raise OSError(28, "No space left on device")

    node._bag = SimpleNamespace(__exit__=fail, path=path, abandon=lambda: end(None, None, None))  # type: ignore[assignment]
    with pytest.raises(TestbedError) as found:
        node._on_record(False)
    words = f"recording stopped, {path} keeps its data (No space left on device): make space"
    assert str(found.value) == words
    assert make.state() == (ERROR, words)
    assert make.sent["recorder/trial"][-1].data == ""


@pytest.mark.parametrize(
    ("before", "after"), [(0o000, 0o007), (0o022, 0o027), (0o077, 0o077)], ids=oct
)
def test_a_trial_is_closed_to_others(before: int, after: int, make: Maker, folder: Path) -> None:
    """It holds personal data; its group's rights stay as the user set them."""
    os.umask(before)
    make(RecorderNode, directory=folder)
    assert os.umask(0) == after


def test_the_bag_is_flushed_while_recording(make: Maker, folder: Path) -> None:
    node = make(RecorderNode, directory=folder)
    node._flush()  # nothing to flush
    node._on_record(True)
    flushed: list[str] = []
    assert node._bag is not None
    node._bag.flush = lambda: flushed.append("once")  # type: ignore[method-assign]
    node._flush()
    assert flushed == ["once"]


def test_a_recording_of_a_replay_has_its_clock(make: Maker, folder: Path) -> None:
    node = make(RecorderNode, directory=folder, use_sim_time="true", record="true")
    assert node._now() == 0  # before the first time on /clock


# --- the replay


@pytest.fixture
def replaying(make: Maker, hold: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """A replay of the hold, to its end or its fault, with patience of 0 s for others."""
    monkeypatch.setattr(replay_node, "_DISCOVERY_TIME", 0.0)
    monkeypatch.setattr(replay_node, "_READY_TIMEOUT", 0.0)

    def run(**parameters: Any) -> ReplayNode:
        node = make(ReplayNode, **{"trial": hold, "rate": 10_000.0, **parameters})
        node._thread.join(HANGS)
        assert node.finished.done()
        return node

    return run


def failure(node: ReplayNode) -> str:
    """The line of a replay's end."""
    with pytest.raises(TrialError) as found:
        node.close()
    node._failure = None
    return str(found.value)


def test_two_trials_must_not_mix(
    replaying: Callable[..., ReplayNode], make: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        TestbedNode, "count_publishers", lambda self, name: 2 if name == "/trigger" else 1
    )
    line = (
        "another program publishes /trigger on this ROS_DOMAIN_ID: end it, or set another"
        " ROS_DOMAIN_ID: two trials must not mix"
    )
    node = replaying()
    assert make.state() == (ERROR, line)
    assert failure(node) == line and not make.sent["/trigger"]


def test_followers_that_do_not_start_are_named(
    replaying: Callable[..., ReplayNode], make: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TestbedNode, "count_publishers", lambda self, name: 1)
    node = replaying(wait_for="[estimator_node]")
    assert failure(node) == (
        "after 0 s not ready: /estimator_node (not seen): see what these nodes print; is another"
        " graph on this ROS_DOMAIN_ID?"
    )


def test_slow_followers_are_a_warning(replaying: Callable[..., ReplayNode], make: Maker) -> None:
    node = replaying()
    node._followers.catch_up = lambda behind, patience: behind  # type: ignore[method-assign]
    node._catch_up(7)
    assert make.state() == (WARN, "7 triggers were not processed in time")
    node.report(OK, "goes on")
    node._catch_up(0)
    assert make.state() == (OK, "goes on")


def test_lacking_transforms_are_told(
    replaying: Callable[..., ReplayNode], monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    logger = SimpleNamespace(warning=told.append, info=lambda words: None)
    node = replaying()

    class Lacking:
        @property
        def geometry(self) -> None:
            raise ConfigurationError("no socket.yaml", "give --geometry")

    monkeypatch.setattr(node, "_trial", Lacking())
    monkeypatch.setattr(node, "get_logger", lambda: logger)
    assert node._broadcaster() is None
    assert told == ["transforms are left out: no socket.yaml: give --geometry"]


def test_a_trial_of_other_topics_is_refused(
    replaying: Callable[..., ReplayNode], make: Maker, tmp_path: Path
) -> None:
    path = tmp_path / "other"
    with BagWriter(path) as bag:
        bag.add_topic("/event", EVENT)
    with pytest.raises(TestbedError) as found:
        replaying(trial=path)
    assert str(found.value) == (
        f"{path}: holds no message on any topic of the testbed: give a trial that 'record' or"
        " 'simulate' made"
    )


@pytest.mark.parametrize("measured", ["true", "false"])
def test_estimates_are_replayed_unless_computed_again(
    measured: str, replaying: Callable[..., ReplayNode]
) -> None:
    names = replaying(measured_only=measured)._topics
    assert set(names) >= REQUIRED
    assert not any(topic.computed for topic in names.values()) or measured == "false"
    assert "/diagnostics" not in names


# --- events and refusals

MARKS = {
    ("s01", True): [],
    ("", True): ["no trial is being recorded: call recorder/record"],
    ("s01", False): ["no trigger received: the stamp is the system clock's"],
}


@pytest.mark.parametrize(("trial", "triggered"), MARKS)
def test_a_mark_s_remarks_are_what_lacks(trial: str, triggered: bool) -> None:
    assert Marked(1, trial, triggered).notes() == MARKS[trial, triggered]


@pytest.mark.parametrize(
    ("words", "fact", "hint"),
    [
        ("cannot tare: it moves: hold it", "cannot tare: it moves", "hold it"),
        ("no", "refused", "no"),
    ],
    ids=["with a hint", "one word"],
)
def test_a_refusal_has_fact_and_hint(words: str, fact: str, hint: str) -> None:
    found = _refusal(words)
    assert (found.fact, found.hint) == (fact, hint)
