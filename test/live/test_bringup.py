"""Nodes of a testbed as they are described, without starting any."""

from dataclasses import replace
from pathlib import Path

import pytest

from socket_testbed.errors import ConfigurationError
from socket_testbed.live.bringup import Testbed, simulated_testbed
from socket_testbed.settings.testbed import RecorderSettings
from socket_testbed.trials.metadata import TrialMetadata, read_metadata, write_metadata


def with_recorder_metadata(testbed: Testbed, path: Path) -> Testbed:
    """The testbed whose testbed.yaml names a file of metadata."""
    recorder = RecorderSettings(metadata=str(path))
    return replace(testbed, settings=replace(testbed.settings, recorder_node=recorder))


def stored(testbed: Testbed, folder: Path) -> str:
    """What the recorder of a testbed is given to store."""
    (recorder,) = (n.settings for n in testbed.nodes(folder) if n.name == "recorder_node")
    assert isinstance(recorder, RecorderSettings)
    return recorder.metadata


def test_what_the_call_states_goes_over_what_the_settings_name(tmp_path: Path) -> None:
    study, folder = tmp_path / "study.yaml", tmp_path / "graph"
    folder.mkdir()
    write_metadata(TrialMetadata(protocol="walk", side="left"), study)
    testbed = simulated_testbed(record=tmp_path / "trial")
    assert stored(testbed, folder) == ""
    testbed = with_recorder_metadata(testbed, study)
    assert read_metadata(Path(stored(testbed, folder))) == read_metadata(study)
    testbed = replace(testbed, metadata=TrialMetadata("S01", "right"))
    expected = TrialMetadata("S01", "right", protocol="walk")
    assert read_metadata(Path(stored(testbed, folder))) == expected
    assert read_metadata(study).side == "left"  # it is another trial's as well
    with pytest.raises(ConfigurationError, match=r"none\.yaml: no such file"):
        stored(with_recorder_metadata(testbed, tmp_path / "none.yaml"), folder)
