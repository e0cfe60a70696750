"""The recorder without a graph: where trials go, what they hold, and what is said of them."""

import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from support import scene
from support.clocks import FakeClock
from support.nodes import Maker, running_ros
from support.wording import refused

from socket_testbed.errors import ConfigurationError
from socket_testbed.nodes import recorder_node
from socket_testbed.nodes.recorder_node import RecorderNode
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.metadata import TrialMetadata, read_metadata
from socket_testbed.wire import messages

OK, WARN, ERROR = 0, 1, 2
MEASURED = (
    *("/trigger", "/clusters/capacitance", "/load_cell/wrench"),
    *("/mocap/socket/pose", "/mocap/pylon/pose"),
)


@pytest.fixture(scope="module", autouse=True)
def ros() -> Iterator[None]:
    mask = os.umask(0)  # a recorder changes it
    with running_ros():
        yield
    os.umask(mask)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "trials"


def send_all(node: RecorderNode, stamp: int = scene.START) -> None:
    """One message on each topic that an analysis needs."""
    pose, still = messages.pose_packer(), np.eye(7)[6]
    packed = (
        messages.trigger_packer()(stamp, 1),
        messages.capacitance_packer(["a"])(stamp, np.ones((1, 4)), np.zeros((1, 4), np.uint8)),
        messages.wrench_packer()(stamp, np.arange(6.0)),
        pose(stamp, still),
        pose(stamp, still),
    )
    for name, data in zip(MEASURED, packed, strict=True):
        node._on_message(name, data)


def announced(make: Maker) -> list[str]:
    return [message.data for message in make.sent["recorder/trial"]]


def test_a_requested_trial_holds_what_arrived(make: Maker, folder: Path) -> None:
    node = make(RecorderNode, directory=folder)
    node.set_parameters([Parameter("next.name", value="walk 1")])
    path = folder / "walk 1"
    assert node.get_name() == "recorder_node"
    send_all(node)  # before: not recorded
    assert node._on_record(True) == f"recording {path}"
    assert make.state() == (OK, f"recording {path}")
    send_all(node)
    send_all(node, scene.START + 10**9)
    figures = node.figures()
    assert figures["trial"] == path and figures["/trigger"] == 2 and figures["/event"] == 0
    assert figures["elapsed"] < 60.0 and figures["free"] > 1e6
    assert node._on_record(False) == f"recorded {path}"
    assert make.state() == (OK, f"recorded 10 messages in {path}")
    assert announced(make) == ["", "walk 1", ""]
    with BagReader(path) as bag:
        assert {name: n for name, n in bag.counts.items() if n} == dict.fromkeys(MEASURED, 2)
    assert node._on_record(False) == "nothing was being recorded"


def test_lacking_topics_are_named_at_the_end(make: Maker, folder: Path) -> None:
    node = make(RecorderNode, directory=folder, record="true")
    node._on_message("/trigger", messages.trigger_packer()(scene.START, 1))
    node._on_record(False)
    lacking = ", ".join(MEASURED[1:])
    expected = f"recorded 1 messages in {folder}, none on {lacking}: a fit needs these"
    level, text = make.state()
    assert level == WARN and sorted(text) == sorted(expected)
    assert text.startswith(f"recorded 1 messages in {folder}, none on /")


def test_silence_is_reported_after_ten_seconds(
    make: Maker, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = FakeClock().install(monkeypatch)
    node = make(RecorderNode, directory=folder, record="true")
    clock.sleep(9.9)
    node.check()
    assert make.state() == (OK, f"recording {folder}")
    clock.sleep(0.2)
    node.check()
    level, text = make.state()
    assert level == WARN
    assert text.startswith(f"recording {folder}, but nothing arrives: check that the testbed runs,")
    send_all(node)
    node.check()
    assert make.state() == (OK, f"recording {folder}")
    assert node.figures()["elapsed"] == 10.1


def test_silent_topics_are_named(
    make: Maker, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = FakeClock().install(monkeypatch)
    node = make(RecorderNode, directory=folder, record="true")
    send_all(node)
    node._counts["/trigger"] = 0
    clock.sleep(10.1)
    node.check()
    assert ", but nothing arrives on /trigger: check" in make.state()[1]


# --- names and metadata


def test_the_next_trial_s_metadata_count_once(make: Maker, folder: Path) -> None:
    node = make(RecorderNode, directory=folder)
    stated = {"name": "a", "subject": "S07", "side": "left", "mass": 70.5}
    node.set_parameters([Parameter(f"next.{n}", value=v) for n, v in stated.items()])
    node._on_record(True)
    with refused(ConfigurationError, "a is being recorded: stop it first"):
        node.set_parameters([Parameter("next.name", value="b")])
        node._on_record(True)
    assert node._on_record(True) == f"recording {folder / 'a'}"
    node._on_record(False)
    found = read_metadata(folder / "a" / "trial.yaml")
    assert found == TrialMetadata(subject="S07", side="left", mass=70.5)
    node.set_parameters([Parameter("next.name", value="c")])
    node._on_record(True)
    assert not (folder / "c" / "trial.yaml").exists()


def test_wrong_metadata_are_refused(make: Maker, folder: Path) -> None:
    node = make(RecorderNode, directory=folder)
    (answer,) = node.set_parameters([Parameter("next.side", value="middle")])
    assert not answer.successful and "side is 'middle'" in answer.reason


@pytest.mark.parametrize(
    ("taken", "name", "expected"),
    [
        ((), "a", "trials/a"),
        (("trials/a",), "a", "trials/a_2"),
        (("trials/a", "trials/a_2"), "a", "trials/a_3"),
        (("trials/metadata.yaml",), "a", "trials_a"),
        (("trials/metadata.yaml",), "", "trials_2"),
    ],
    ids=["free", "taken", "taken twice", "in a trial", "in a trial, no name"],
)
def test_a_trial_never_overwrites_another(
    taken: tuple[str, ...], name: str, expected: str, make: Maker, tmp_path: Path
) -> None:
    for path in taken:
        (tmp_path / path).mkdir(parents=True)
    node = make(RecorderNode, directory=tmp_path / "trials")
    assert node._next_path(name) == tmp_path / expected


@pytest.mark.parametrize("place", ["check_take_name", "refuse_existing", "BagWriter.__enter__"])
def test_a_folder_that_another_makes_first_stays(
    place: str, make: Maker, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process makes it just after each of the recorder's steps."""
    node = make(RecorderNode, directory=folder)
    real = resolve_name(f"{recorder_node.__name__}:{place}")
    theirs = folder / "walk" / "walk.mcap"

    def followed(*given: Any) -> Any:
        if place != "BagWriter.__enter__":
            real(*given)
        theirs.parent.mkdir(parents=True)
        theirs.write_text("theirs")
        return real(*given) if place == "BagWriter.__enter__" else None

    monkeypatch.setattr(f"{recorder_node.__name__}.{place}", followed)
    node.set_parameters([Parameter("next.name", value="walk")])
    with pytest.raises(ConfigurationError) as found:
        node._on_record(True)
    assert str(found.value).startswith(f"{theirs.parent} exists already: ")
    assert theirs.read_text() == "theirs" and node.figures()["trial"] == ""


def test_a_nameless_trial_has_its_date_and_time(make: Maker, folder: Path) -> None:
    node = make(RecorderNode, directory=folder)
    assert node._next_path("").match("trial_2[0-9]*_[0-9]*")
    assert len(node._next_path("").name) == len("trial_20260101_120000")


def test_a_restarted_recorder_leaves_the_first_trial(make: Maker, folder: Path) -> None:
    make(RecorderNode, directory=folder, record="true").close()
    make(RecorderNode, directory=folder, record="true")
    second = folder.with_name("trials_2")
    words = f"recording {second}: {folder} holds a trial and stays as it is"
    assert make.state() == (WARN, words) and announced(make)[-1] == "trials_2"


GONE = "check that its disk is connected, and what dmesg says of it"


@pytest.mark.parametrize(
    ("number", "hint"),
    [
        (errno.ENOSPC, "make space"),
        (errno.EFBIG, "use a disk with ext4 or exFAT, as its file system takes no larger file"),
        (errno.EROFS, "check its file system for errors, and mount it again for writing"),
        (errno.EIO, GONE),
        (errno.ENODEV, GONE),
    ],
    ids=["full", "file-too-large", "read-only", "input-output", "no-device"],
)
def test_a_failing_disk_ends_the_recording(
    number: int, hint: str, make: Maker, folder: Path
) -> None:
    node = make(RecorderNode, directory=folder, record="true")

    def fail(*given: Any) -> None:
        raise OSError(number, os.strerror(number))

    node._bag.write = fail
    node._on_message("/trigger", b"")
    level, words = make.state()
    said = f"recording stopped, {folder} keeps its data ({os.strerror(number)}): {hint}"
    assert level == ERROR and words.startswith(said) and announced(make)[-1] == ""


@pytest.mark.parametrize("by", ["flush", "end"])
def test_a_removed_trial_ends_the_recording(by: str, make: Maker, folder: Path) -> None:
    node = make(RecorderNode, directory=folder, record="true")
    send_all(node)
    shutil.rmtree(folder)
    if by == "flush":
        node._flush()
    else:
        node.close()
    words = f"recording stopped, {folder} is gone (No such file or directory): {GONE}"
    assert make.state() == (ERROR, words) and announced(make)[-1] == ""


def test_a_renamed_trial_is_recorded_on(make: Maker, folder: Path) -> None:
    node = make(RecorderNode, directory=folder, record="true")
    folder.rename(folder.with_name("moved"))
    send_all(node)
    node._flush()
    assert make.state() == (OK, f"recording {folder}")
    with BagReader(folder.with_name("moved")) as bag:
        assert sum(bag.counts.values()) == len(MEASURED)


def test_diagnostics_survive_an_unplugged_disk(
    make: Maker, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = make(RecorderNode, directory=folder, record="true")

    def fail(*given: Any, **more: Any) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "stat", fail)
    assert np.isnan(node.figures()["free"])


@pytest.mark.parametrize(("everything", "maps"), [("false", 0), ("true", 1)])
def test_maps_are_recorded_on_request(
    everything: str, maps: int, make: Maker, folder: Path
) -> None:
    node = make(RecorderNode, directory=folder, record="true", everything=everything)
    for name in ("/estimate/force_map", "/estimate/regions", "/estimate/pressure_map"):
        assert (name in node.figures()) is bool(maps)
    assert "/estimate/parameters" in node.figures() and "/diagnostics" in node.figures()
