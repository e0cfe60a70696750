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


def test_all_fields_and_any_text_come_back_as_they_were(tmp_path: Path) -> None:
    values = ("S01", "right", "PTB 3", "sock", 82.5, "KL", "hold", "new foot")
    stated = metadata.TrialMetadata(*values)
    assert (*stated.columns().values(),) == values and len(metadata.FIELDS) == len(values)
    assert {"name", *metadata.FIELDS} == NextTrialSettings().to_flat().keys()  # of a button
    texts = ("007", "1e3", "yes", "null", "2026-01-01", "a: b # c", "\"'\\", "ü 日本 🦿", "-")
    for given in (stated, *(metadata.TrialMetadata(socket=text, notes=text) for text in texts)):
        metadata.write_metadata(given, tmp_path / metadata.METADATA_FILE)
        assert metadata.read_metadata(tmp_path / metadata.METADATA_FILE) == given
    assert metadata.TrialMetadata(notes=" on\ntwo\u00a0 lines ").notes == "on two lines"


WRONG = [
    ({"side": "lft"}, "side is 'lft': did you mean 'left'?"),
    ({"mass": 82500.0}, "from 5 to 400: the body mass [kg]"),
    ({"subject": "Some Body"}, "never a name"),
    ({"notes": "bell\a"}, "control character"),
]


def test_a_wrong_value_is_refused_by_its_field(folder: Path) -> None:
    for given, says in WRONG:
        with refused(ConfigurationError, next(iter(given)), says):
            st.annotate(Trial(folder), **given)
    for path in (folder.parent, folder / "hold.mcap"):
        with refused(st.TestbedError, "is not a trial folder"):
            st.annotate(Trial(path), subject="S01")
    assert sorted(path.name for path in folder.iterdir()) == ["hold.mcap", "metadata.yaml"]
    assert [*folder.parent.iterdir()] == [folder]


def test_a_broken_file_is_a_note_and_nothing_is_written_over_it(folder: Path) -> None:
    for text, says in (("sidee: left", "did you mean 'side'?"), ("]", "correct the YAML")):
        (folder / metadata.METADATA_FILE).write_text(text, encoding="latin-1")
        notes: list[str] = []
        assert Trial(folder, notify=notes.append).metadata == metadata.TrialMetadata()
        (note,) = notes
        check_line(note, says, metadata.METADATA_FILE)
        with refused(ConfigurationError, metadata.METADATA_FILE):
            st.annotate(Trial(folder), subject="S02")
        assert (folder / metadata.METADATA_FILE).read_text(encoding="latin-1") == text
    (folder / metadata.METADATA_FILE).write_text("# to be filled in\nsubject:\nmass: 70\n")
    assert Trial(folder).metadata == metadata.TrialMetadata(mass=70.0)


def test_annotate_adds_changes_removes_and_leaves_the_bag_alone(folder: Path, capsys: Any) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    words = ["--subject", "S07", "--side", "left", "--mass", "81.5", "--notes", "new foot"]
    code, shown, _ = call(capsys, "annotate", folder, *words)
    assert code == 0 and "S07" in shown and "81.5 kg" in shown
    shown = call(capsys, "annotate", folder, "--remove", "mass", "--remove", "notes")[1]
    assert "S07" in shown and "kg" not in shown
    trial = Trial(folder)
    found = st.annotate(trial, side="right", mass=70.0)
    assert found == metadata.TrialMetadata("S07", "right", mass=70.0)
    assert st.annotate(trial, remove=["subject", "mass"]) == metadata.TrialMetadata(side="right")
    assert trial.metadata == metadata.TrialMetadata(side="right")
    after = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert after.keys() - before.keys() == {metadata.METADATA_FILE}
    assert {name: after[name] for name in before} == before


def test_metadata_of_a_call_goes_over_those_of_the_settings(tmp_path: Path) -> None:
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
