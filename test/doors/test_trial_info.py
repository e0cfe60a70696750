"""What `info` says of the scene: 96 triggers over 23.75 s, and its events."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.bags import rewrite
from support.verbs import call

from socket_testbed.commands import trials
from socket_testbed.trials.events import Event


@pytest.fixture(scope="module")
def lines(scene_folder: Path) -> list[str]:
    """The output of `info`, with runs of blanks as one."""
    with pytest.MonkeyPatch.context() as patch:
        said: list[str] = []
        patch.setattr("builtins.print", lambda *words, **_: said.extend(map(str, words)))
        trials.info(scene_folder, geometry=None, calibration=None, load_cell=None, tare="recorded")
    return [" ".join(line.split()) for line in "\n".join(said).splitlines()]


@pytest.mark.parametrize(
    ("topic", "kind"),
    [
        ("/trigger", "socket_testbed_msgs/msg/Trigger"),
        ("/clusters/capacitance", "socket_testbed_msgs/msg/ClusterCapacitanceArray"),
        ("/load_cell/wrench", "geometry_msgs/msg/WrenchStamped"),
        ("/mocap/pylon/pose", "geometry_msgs/msg/PoseStamped"),
    ],
    ids=["trigger", "clusters", "wrench", "pose"],
)
def test_a_topic_has_its_count_and_rate(topic: str, kind: str, lines: list[str]) -> None:
    """95 periods in 23.75 s are 4 Hz."""
    assert f"{topic} {kind} 96 4.00" in lines


def test_the_heading_counts_messages_and_seconds(lines: list[str], scene_folder: Path) -> None:
    """Seven topics; a source answers some hundredths of a second after its trigger."""
    (heading,) = [line for line in lines if line.startswith(f"{scene_folder}: ")]
    count, seconds = heading.removeprefix(f"{scene_folder}: ").split(" messages in ")
    assert int(count) == 7 * 96
    assert float(seconds.removesuffix(" s")) == pytest.approx(23.75, abs=0.05)


def test_the_configuration_is_told(lines: list[str]) -> None:
    assert "socket: a scene made by hand; 12 tiles" in lines
    assert "registration: made by hand" in lines
    assert "calibration: made by hand (2026-01-01)" in lines


def test_events_of_one_label_are_told_by_source() -> None:
    events = [Event("placed", 1.0, "recorded"), Event("placed", 2.0, "found")]
    found = trials._events(SimpleNamespace(events=lambda: events))  # type: ignore[arg-type]
    assert found.splitlines() == ["event placed (recorded): 1.00 s", "event placed (found): 2.00 s"]


def test_a_bag_without_duration_has_no_rate(
    scene_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    place = "socket_testbed.trials.bag.BagReader.duration"
    monkeypatch.setattr(place, property(lambda bag: 0.0))
    code, out, _ = call(capsys, "info", scene_folder)
    (line,) = [line for line in out.splitlines() if line.startswith("/trigger ")]
    assert code == 0 and line.split()[-1] == "0.00"


def test_an_outlier_is_no_drop_out(
    scene_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """9 kN at a single sample: the sensor did answer; its noise is that of the others, none."""
    count = 0

    def spoil(topic: str, message: Any) -> Any:
        nonlocal count
        if topic == "/load_cell/wrench":
            count += 1
            message.wrench.force.z = 9e3 if count == 50 else message.wrench.force.z
        return message

    code, out, _ = call(capsys, "info", rewrite(scene_folder, tmp_path / "spoilt", spoil))
    lines = [line.split() for line in out.splitlines()]
    assert code == 0 and ["Fz", "0", "0.00", "0.00", "-", "-"] in lines
    (force,) = [line for line in lines if line[:2] == ["force", "[N]"]]
    assert float(force[4]) < 1.0
