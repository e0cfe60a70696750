"""Nodes of a testbed as they are described, without starting any."""

from dataclasses import replace
from pathlib import Path

from support.wording import refused

from socket_testbed.errors import TestbedError
from socket_testbed.live.bringup import simulated_testbed
from socket_testbed.settings.testbed import RecorderSettings
from socket_testbed.trials.metadata import TrialMetadata, read_metadata, write_metadata


def test_metadata_of_the_call_goes_over_the_settings_and_a_wrong_name_is_refused(
    tmp_path: Path,
) -> None:
    study = tmp_path / "study.yaml"
    write_metadata(TrialMetadata(protocol="walk", side="left"), study)
    testbed = simulated_testbed(record=tmp_path / "trial")
    recorder_node = RecorderSettings(metadata=str(study), everything=True)
    settings = replace(testbed.settings, recorder_node=recorder_node)
    stated = TrialMetadata("S01", "right")
    recorder, *_ = replace(testbed, settings=settings, metadata=stated).nodes(tmp_path)
    assert recorder.settings.everything and recorder.settings.record
    stored = read_metadata(Path(recorder.settings.metadata))
    assert stored == TrialMetadata("S01", "right", protocol="walk")
    assert read_metadata(study).side == "left"  # it is another trial's as well
    names = ("distale", *settings.cluster_node.names[1:])
    wrong = replace(settings, cluster_node=replace(settings.cluster_node, names=names))
    with refused(TestbedError, "distale"):
        replace(testbed, settings=wrong)
