"""Nodes of a testbed as they are described, without starting any."""

from dataclasses import replace
from pathlib import Path

import pytest

from socket_testbed.errors import ConfigurationError
from socket_testbed.live.bringup import simulated_testbed
from socket_testbed.settings.testbed import RecorderSettings
from socket_testbed.trials.metadata import TrialMetadata, read_metadata, write_metadata


def test_what_the_call_states_goes_over_what_the_settings_name(tmp_path: Path) -> None:
    study, folder = tmp_path / "study.yaml", tmp_path / "graph"
    folder.mkdir()
    write_metadata(TrialMetadata(protocol="walk", side="left"), study)
    testbed = simulated_testbed(record=tmp_path / "trial")

    def stored(named: Path, stated: TrialMetadata) -> TrialMetadata:
        """What the recorder is given to store."""
        settings = replace(testbed.settings, recorder_node=RecorderSettings(metadata=str(named)))
        nodes = replace(testbed, settings=settings, metadata=stated).nodes(folder)
        (recorder,) = (node.settings for node in nodes if node.name == "recorder_node")
        return read_metadata(Path(recorder.metadata))  # type: ignore[attr-defined]

    assert stored(study, TrialMetadata()) == read_metadata(study)
    both = stored(study, TrialMetadata("S01", "right"))
    assert both == TrialMetadata("S01", "right", protocol="walk")
    assert read_metadata(study).side == "left"  # it is another trial's as well
    with pytest.raises(ConfigurationError, match=r"none\.yaml: no such file"):
        stored(tmp_path / "none.yaml", TrialMetadata())
