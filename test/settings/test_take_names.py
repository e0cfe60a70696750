"""Names of trials that go to Motive as names of takes."""

from pathlib import Path

import pytest

from socket_testbed.drivers.natnet.connection import TakeKeeper
from socket_testbed.drivers.natnet.messages import encode_command
from socket_testbed.errors import ConfigurationError
from socket_testbed.settings.testbed import RecorderSettings, check_take_name

GOOD = ["trial_20261122_101500", "S01 left 2", "Übung-3.b", "歩行"]
BAD = [
    "", "a,b", "StopRecording\nx", "a\0b", "..", ".hidden", "../../x", "a/b", "a\\b", "C:x", "a ",
    "a.", "what?", "\udcff", "x" * 201, "x" * 70_000, "ü" * 101, "a\u2028b",
]  # fmt: skip


@pytest.mark.parametrize("name", GOOD)
def test_a_name_goes_to_motive_as_it_is(name: str) -> None:
    assert check_take_name(name) == name
    assert encode_command(f"SetRecordTakeName,{name}").count(b",") == 1


@pytest.mark.parametrize("name", BAD)
def test_a_name_that_no_take_can_have_is_refused_when_it_is_given(name: str) -> None:
    with pytest.raises(ConfigurationError, match=r"the trial's name .*: give letters") as caught:
        check_take_name(name)
    assert len(str(caught.value)) < 450
    assert "\n" not in str(caught.value)
    str(caught.value).encode()


def test_a_refused_take_is_not_pursued_and_the_one_before_it_ends() -> None:
    sent: list[str] = []
    keeper = TakeKeeper(lambda command, done: sent.append(command))
    keeper.want("first")
    with pytest.raises(ConfigurationError):
        keeper.want("a,b")
    assert keeper.settled  # nothing was started, nothing is wanted
    keeper.step(1.0, connected=True)
    assert sent == [] and keeper.fault == ""


@pytest.mark.parametrize("name", ["a,b", "line\nbreak", "x" * 230])
def test_a_recording_s_folder_is_checked_by_the_settings(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigurationError, match="the trial's name"):
        RecorderSettings(directory=str(tmp_path / name), record=True)
    RecorderSettings(directory=str(tmp_path / name))  # it is no trial itself
