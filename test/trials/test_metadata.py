"""The metadata of a trial: what is stated comes back, what is wrong is refused in one line."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from support.verbs import call
from support.wording import check_line, refused

import socket_testbed as st
from socket_testbed.errors import ConfigurationError
from socket_testbed.live.bringup import simulated_testbed
from socket_testbed.settings.testbed import NextTrialSettings, RecorderSettings
from socket_testbed.trials import metadata
from socket_testbed.trials.trial import Trial


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """What passes for a trial: its metadata are all that is read."""
    path = tmp_path / "hold"
    path.mkdir()
    (path / "metadata.yaml").write_text("rosbag2")
    (path / "hold.mcap").write_bytes(bytes(range(256)))
    return path


VALUES = ("S01", "right", "PTB 3", "sock", 82.5, "KL", "hold", "new foot")
STATED = metadata.TrialMetadata(*VALUES)
TEXTS = ("007", "1e3", "yes", "null", "2026-01-01", "a: b # c", "\"'\\", "ü 日本 🦿", "-")


def test_columns_hold_all_fields() -> None:
    assert (*STATED.columns().values(),) == VALUES and len(metadata.FIELDS) == len(VALUES)


def test_the_recorder_s_settings_hold_all_fields() -> None:
    """A button of the page sets them."""
    assert {"name", *metadata.FIELDS} == NextTrialSettings().to_flat().keys()


@pytest.mark.parametrize(
    "given",
    [STATED, *(metadata.TrialMetadata(socket=text, notes=text) for text in TEXTS)],
    ids=[
        *("all", "zeros", "exponent", "boolean", "null", "date", "comment"),
        *("quotes", "unicode", "dash"),
    ],
)
def test_metadata_come_back_as_written(given: metadata.TrialMetadata, tmp_path: Path) -> None:
    metadata.write_metadata(given, tmp_path / metadata.METADATA_FILE)
    assert metadata.read_metadata(tmp_path / metadata.METADATA_FILE) == given


def test_white_space_becomes_single_blanks() -> None:
    assert metadata.TrialMetadata(notes=" on\ntwo\u00a0 lines ").notes == "on two lines"


def assert_untouched(folder: Path) -> None:
    assert sorted(path.name for path in folder.iterdir()) == ["hold.mcap", "metadata.yaml"]
    assert [*folder.parent.iterdir()] == [folder]


MASS = "from 5 to 400: the body mass [kg]"


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("side", "lft", "side is 'lft': did you mean 'left'?"),
        ("mass", 82500.0, MASS),
        ("mass", 4.9, MASS),
        ("subject", "Some Body", "never a name"),
        ("notes", "bell\a", "control character"),
    ],
    ids=["side", "mass in grams", "mass too low", "name of a person", "control character"],
)
def test_a_wrong_value_is_refused(field: str, value: Any, says: str, folder: Path) -> None:
    with refused(ConfigurationError, field, says):
        st.annotate(Trial(folder), **{field: value})
    assert_untouched(folder)


@pytest.mark.parametrize("place", ["..", "hold.mcap"], ids=["parent", "file"])
def test_only_a_trial_folder_takes_metadata(place: str, folder: Path) -> None:
    with refused(st.TestbedError, "is not a trial folder"):
        st.annotate(Trial((folder / place).resolve()), subject="S01")
    assert_untouched(folder)


@pytest.mark.parametrize(
    ("text", "says"),
    [("sidee: left", "did you mean 'side'?"), ("]", "correct the YAML")],
    ids=["field", "syntax"],
)
def test_a_broken_file_is_never_overwritten(text: str, says: str, folder: Path) -> None:
    """It is a note, and the trial has no metadata."""
    (folder / metadata.METADATA_FILE).write_text(text, encoding="latin-1")
    notes: list[str] = []
    assert Trial(folder, notify=notes.append).metadata == metadata.TrialMetadata()
    (note,) = notes
    check_line(note, says, metadata.METADATA_FILE)
    with refused(ConfigurationError, metadata.METADATA_FILE):
        st.annotate(Trial(folder), subject="S02")
    assert (folder / metadata.METADATA_FILE).read_text(encoding="latin-1") == text


def test_empty_fields_are_unset(folder: Path) -> None:
    (folder / metadata.METADATA_FILE).write_text("# to be filled in\nsubject:\nmass: 70\n")
    assert Trial(folder).metadata == metadata.TrialMetadata(mass=70.0)


def mtimes(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}


def test_annotate_adds_one_file_alone(folder: Path, capsys: Any) -> None:
    before = mtimes(folder)
    call(capsys, "annotate", folder, "--subject", "S07", "--mass", "81.5")
    call(capsys, "annotate", folder, "--remove", "mass")
    st.annotate(Trial(folder), remove=["subject"], side="right")
    after = mtimes(folder)
    assert after.keys() - before.keys() == {metadata.METADATA_FILE}
    assert {name: after[name] for name in before} == before


def test_the_verb_states_what_it_stored(folder: Path, capsys: Any) -> None:
    words = ["--subject", "S07", "--side", "left", "--mass", "81.5", "--notes", "new foot"]
    code, shown, _ = call(capsys, "annotate", folder, *words)
    assert code == 0 and "S07" in shown and "81.5 kg" in shown
    shown = call(capsys, "annotate", folder, "--remove", "mass", "--remove", "notes")[1]
    assert "S07" in shown and "kg" not in shown
    found = st.annotate(Trial(folder), side="right", mass=70.0)
    assert found == metadata.TrialMetadata("S07", "right", mass=70.0)


def test_a_field_can_be_removed(folder: Path) -> None:
    trial = Trial(folder)
    st.annotate(trial, subject="S07", side="right", mass=70.0)
    assert st.annotate(trial, remove=["subject", "mass"]) == metadata.TrialMetadata(side="right")
    assert trial.metadata == metadata.TrialMetadata(side="right")


def test_metadata_of_a_call_replace_the_settings(tmp_path: Path) -> None:
    study = tmp_path / "study.yaml"
    metadata.write_metadata(metadata.TrialMetadata(protocol="walk", side="left"), study)
    testbed = simulated_testbed(record=tmp_path / "trial")
    recorder_node = RecorderSettings(metadata=str(study), everything=True)
    settings = dataclasses.replace(testbed.settings, recorder_node=recorder_node)
    stated = metadata.TrialMetadata("S01", "right")
    testbed = dataclasses.replace(testbed, settings=settings, metadata=stated)
    recorder, *_ = testbed.nodes(tmp_path)
    assert recorder.settings.everything and recorder.settings.record
    stored = metadata.read_metadata(Path(recorder.settings.metadata))
    assert stored == metadata.TrialMetadata("S01", "right", protocol="walk")
    assert metadata.read_metadata(study).side == "left"  # it is another trial's as well
