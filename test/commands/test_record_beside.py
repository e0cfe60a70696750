"""What `record` hands to the recorder of a testbed with other drivers."""

from pathlib import Path
from typing import Any

import pytest

from socket_testbed.__main__ import run
from socket_testbed.commands import live
from socket_testbed.settings.testbed import RecorderSettings

PARAMETERS = """
trigger_node: {ros__parameters: {source: topic, topic: /sync}}
align_node:
  ros__parameters:
    wrench: {topic: /ft}
    socket_pose: {topic: "tf:world/rig"}
    pylon_pose: {topic: none}
"""


class Stage:
    """A graph, and its status, of which nothing starts."""

    output = None
    started: list[RecorderSettings]

    def __init__(self, *given: Any) -> None: ...

    def __enter__(self) -> "Stage":
        return self

    def __exit__(self, *error: object) -> None: ...

    def start(self, name: str, settings: RecorderSettings) -> None:
        self.started.append(settings)

    def renew(self) -> None: ...

    def say(self, line: str) -> None: ...

    def follow(self) -> None: ...

    def wait(self, name: str) -> None: ...


def test_record_keeps_the_topics_of_other_drivers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Stage, "started", [], raising=False)
    for name in ("Graph", "StatusLine"):
        monkeypatch.setattr(live, name, Stage)
    params = tmp_path / "testbed.yaml"
    params.write_text(PARAMETERS)
    assert run(["record", str(tmp_path / "new"), "--params", str(params)]) == 1, "no trial is there"
    (settings,) = Stage.started
    assert settings.beside == ("/ft", "/tf", "/sync")
    assert settings.absent == ("mocap/pylon/pose",)
