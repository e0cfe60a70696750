"""What a testbed refuses before anything starts, which files it takes, and what it stores."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import scene

from socket_testbed.errors import ConfigurationError, TestbedError, TrialError
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import write_socket
from socket_testbed.live import bringup, fit_worker
from socket_testbed.live.bringup import Testbed
from socket_testbed.settings.acquisition import ClusterSettings
from socket_testbed.settings.alignment import (
    AlignSettings,
    LiveClusterSettings,
    LiveSourceSettings,
    LiveWrenchSettings,
)
from socket_testbed.settings.identification import IdentificationSettings
from socket_testbed.settings.testbed import (
    CalibrationNodeSettings,
    EstimatorSettings,
    RecorderSettings,
    ReplaySettings,
    TestbedSettings,
    read_testbed,
)
from socket_testbed.simulation import limb as limb_module
from socket_testbed.simulation.limb import LoadedLimb
from socket_testbed.simulation.testbed import Simulation
from socket_testbed.simulation.trial import check_trial_folder
from socket_testbed.simulation.world import World
from socket_testbed.trials.metadata import TrialMetadata, read_metadata, write_metadata
from socket_testbed.trials.trial import Trial
from socket_testbed.trials.truth import read_truth


def line_of(call: Any, kind: type[Exception] = TestbedError) -> str:
    """The line of the error that a call raises."""
    with pytest.raises(kind) as found:
        call()
    return str(found.value)


def clusters(*names: str) -> TestbedSettings:
    return TestbedSettings(cluster_node=ClusterSettings(names=names))


# --- refused testbeds


def test_seventeen_clusters_are_too_many() -> None:
    names = tuple(f"c{k}" for k in range(17))
    found = line_of(lambda: Testbed(clusters(*names), simulation=Simulation()))
    expected = "cluster_node: names 17 clusters, and 16 can be simulated: leave the others out"
    assert found == expected
    for few, simulation in ((names[:16], Simulation()), (names, None)):
        found = line_of(lambda: Testbed(clusters(*few), simulation=simulation))  # noqa: B023
        assert "can be simulated" not in found and "cluster_node" in found


def test_a_channel_that_is_left_out_must_exist() -> None:
    own = EstimatorSettings(identification=IdentificationSettings(leave_out=("heel.Fz",)))
    assert "heel.Fz" in line_of(lambda: Testbed(TestbedSettings(estimator_node=own)))


def test_a_replayed_channel_that_is_left_out_must_exist(hold: Path) -> None:
    own = EstimatorSettings(identification=IdentificationSettings(leave_out=("heel.Fz",)))
    found = line_of(lambda: bringup.replay_nodes(Trial(hold), ReplaySettings(), own))
    assert "heel.Fz" in found


def test_a_model_must_be_of_this_socket(tmp_path: Path) -> None:
    model = scene.model(tmp_path / "model.json")
    package = packaged("config", "socket.yaml")
    found = line_of(lambda: bringup.predict_with(model, EstimatorSettings(), package))
    assert found == (
        "the model of another was fitted on another socket (12 tiles) than the one that it is used"
        " on (79 tiles): fit a model on this socket, or give the socket.yaml of the model's trial"
    )


@pytest.mark.parametrize("scale", [0.009, 1.01], ids=["slower", "faster"])
def test_a_time_scale_has_two_ends(scale: float) -> None:
    assert "the time scale" in line_of(lambda: Simulation(time_scale=scale))
    assert Simulation(time_scale=0.01).time_scale == 0.01
    assert Simulation(time_scale=1.0).time_scale == 1.0


def test_a_new_trial_has_a_name_that_motive_takes(tmp_path: Path) -> None:
    found = line_of(lambda: bringup.check_new_trial(tmp_path / "a" / "s01?"))
    assert found.startswith("the trial's name 's01?' cannot be that of a take: give letters,")
    assert not (tmp_path / "a").exists()
    (tmp_path / "file").write_text("")
    assert "file" in line_of(lambda: bringup.check_new_trial(tmp_path / "file"))


# --- files


def test_a_calibration_is_that_given_or_named() -> None:
    named = TestbedSettings(calibration_node=CalibrationNodeSettings(calibration="/n.yaml"))
    assert bringup.testbed_files(named, None, None)[1] == Path("/n.yaml")
    assert bringup.testbed_files(named, None, "/c.yaml")[1] == Path("/c.yaml")
    package = packaged("config", "socket.yaml"), packaged("config", "calibration.yaml")
    found = bringup.testbed_files(TestbedSettings(), None, None)
    assert found == tuple(path.resolve() for path in package)


def test_stated_metadata_outweigh_the_recorder_s(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    write_metadata(TrialMetadata(subject="S01", mass=60.0, side="left"), file)
    recorder = RecorderSettings(metadata=str(file))
    testbed = Testbed(
        TestbedSettings(recorder_node=recorder),
        record=tmp_path / "s01",
        metadata=TrialMetadata(subject="S02", notes="wet"),
    )
    stored = Path(testbed.nodes(tmp_path)[0].settings.metadata)  # type: ignore[attr-defined]
    expected = TrialMetadata(subject="S02", mass=60.0, side="left", notes="wet")
    assert read_metadata(stored) == expected


def test_only_a_trial_from_the_start_has_its_truth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trials on request are many, and their names are not known."""
    arguments: list[list[str]] = []

    class Graph:
        folder = tmp_path

        def start_program(self, name: str, module: str, given: list[str]) -> None:
            arguments.append(given)
            World(tmp_path).port = 4711

    testbed = bringup.simulated_testbed(tmp_path / "s01")
    for at_once in (True, False):
        own = replace(testbed, at_once=at_once)
        bringup.simulate_hardware(Graph(), own, own.simulation)  # type: ignore[arg-type]
    truth = str(tmp_path / "s01" / "ground_truth.npz")
    assert [given[5] for given in arguments] == [truth, ""]


# --- the simulation


def test_a_world_must_have_been_started(tmp_path: Path) -> None:
    found = line_of(lambda: World(tmp_path), ConfigurationError)
    assert found == f"{tmp_path}: there is no simulated world: start one with 'run --simulated'"


def test_only_a_simulated_trial_is_replaced(tmp_path: Path) -> None:
    check_trial_folder(tmp_path / "new", replace=True)
    found = line_of(lambda: check_trial_folder(tmp_path, replace=True), ConfigurationError)
    assert found == (
        f"{tmp_path} is not a simulated trial, and only such a one is replaced: name another folder"
    )
    (tmp_path / "ground_truth.npz").write_text("")
    check_trial_folder(tmp_path, replace=True)
    found = line_of(lambda: check_trial_folder(tmp_path, replace=False), ConfigurationError)
    assert found == (
        f"{tmp_path} exists already: name another output, or replace it with --replace (in Python,"
        " replace=True)"
    )


def test_a_damaged_truth_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "ground_truth.npz").write_text("no truth")
    found = line_of(lambda: read_truth(tmp_path), TrialError)
    assert found.startswith(f"{tmp_path / 'ground_truth.npz'}: is damaged (")
    assert found.endswith("): simulate the trial again, or remove the file")


def test_a_load_without_equilibrium_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    limb = LoadedLimb.__new__(LoadedLimb)
    far = SimpleNamespace(fun=np.full(6, 1.0), x=np.zeros(6))
    monkeypatch.setattr(limb_module, "root", lambda *given, **more: far)
    monkeypatch.setattr(limb, "_solve", lambda *given: far, raising=False)
    limb._centre, limb._displacement = np.zeros(3), np.zeros(6)
    load = np.array([0.125, -2.0, 0.0, 1.0, 2.0, -1234.567])
    assert line_of(lambda: limb.step(load, 1.0)) == (
        "no equilibrium under the load [0.12, -2.0, 0.0, 1.0, 2.0, -1234.57] [N m, N]: give a"
        " smaller load or a socket that holds the limb"
    )


# --- checks of the data


@pytest.mark.parametrize(("count", "found"), [(29, ()), (30, ("finding",))], ids=["few", "enough"])
def test_thirty_samples_are_checked(
    count: int, found: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[dict[str, Any]] = []

    def judged(own: Any, geometry: Any, leave_out: tuple[str, ...], whole: bool) -> Any:
        asked.append({"leave_out": leave_out, "whole": whole})
        return SimpleNamespace(findings=["finding"])

    monkeypatch.setattr(fit_worker, "CheckedSamples", judged)
    samples: Any = range(count)
    assert fit_worker.check_samples(samples, scene.geometry(), ("distal.Fz",)) == found
    assert asked == [{"leave_out": ("distal.Fz",), "whole": False}] * len(found)


def test_a_socket_must_have_the_clusters(tmp_path: Path) -> None:
    write_socket(scene.geometry(), tmp_path / "socket.yaml")
    found = line_of(lambda: Testbed(clusters("heel"), geometry=tmp_path / "socket.yaml"))
    assert found == (
        "the calibration has no cluster heel of cluster_node (it has brim_lateral, mid_anterior,"
        " posterior_distal, distal): give the calibration.yaml of these clusters"
    )
    lacking = replace(scene.geometry(), clusters={"distal": 11}, turned={})
    write_socket(lacking, tmp_path / "other.yaml")
    found = line_of(lambda: Testbed(clusters("brim_lateral"), geometry=tmp_path / "other.yaml"))
    assert found == (
        f"the cluster 'brim_lateral' of cluster_node (socket {tmp_path / 'other.yaml'}) is on no"
        " tile of the socket (which has distal): give the socket.yaml of these clusters, or correct"
        " the name"
    )


# --- sources of other drivers

FT = {"wrench": LiveWrenchSettings(topic="/ft")}
BODIES = {
    "socket_pose": LiveSourceSettings(topic="/rig/socket"),
    "pylon_pose": LiveSourceSettings(topic="none"),
}
CHIPS = {"clusters": LiveClusterSettings(topic="/uc", names=("distal",))}
OWN = ["cluster_node", "load_cell_node", "mocap_node"]
RUNNING: dict[str, tuple[dict[str, Any], list[str]]] = {
    "own": ({}, OWN),
    "wrench": (FT, ["cluster_node", "mocap_node", "align_node"]),
    "poses": (BODIES, ["cluster_node", "load_cell_node", "align_node"]),
    "clusters": (CHIPS, ["load_cell_node", "mocap_node", "align_node"]),
    "all": (FT | BODIES | CHIPS, ["align_node"]),
}


def foreign(given: dict[str, Any], **more: Any) -> Testbed:
    return Testbed(replace(TestbedSettings(), align_node=AlignSettings(**given)), **more)


@pytest.mark.parametrize("case", RUNNING)
def test_only_the_drivers_that_are_needed_start(case: str, tmp_path: Path) -> None:
    given, expected = RUNNING[case]
    nodes = foreign(given).nodes(tmp_path)
    names = [node.name for node in nodes]
    computing = ["calibration_node", "estimator_node"]
    assert names == ["trigger_node", *expected, *computing]
    assert nodes[0].settings.to_flat()["wait_for"] == [*expected, *computing]


def test_the_recorder_knows_other_drivers_topics(tmp_path: Path) -> None:
    testbed = foreign(FT | BODIES | CHIPS, record=tmp_path / "trial")
    recorder, _, align, *_ = testbed.nodes(tmp_path)
    found = recorder.settings.to_flat()
    assert found["beside"] == ["/ft", "/rig/socket", "/uc"]
    assert found["absent"] == ["mocap/pylon/pose"]
    aligned = align.settings.to_flat()
    assert aligned["clusters.names"] == ["distal"]
    assert aligned["tare_file"] == str(tmp_path / "tare.json")
    assert aligned["geometry"] == str(testbed.geometry)
    stored = read_testbed(tmp_path / "stored.yaml")
    assert stored.align_node.wrench.topic == "/ft" and stored.own_nodes == ()


def test_other_drivers_need_no_device_of_ours() -> None:
    """No matrix of the load cell, no server of the motion capture."""
    foreign(FT | BODIES | CHIPS).check_devices()
    words = "load_cell_node: amplifier_gain|load_cell_node: full_scale is empty"
    with pytest.raises(ConfigurationError, match=words):
        foreign(BODIES | CHIPS).check_devices()


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, TestbedSettings().cluster_node.names),
        (CHIPS, ("distal",)),
        ({"clusters": LiveClusterSettings(topic="/uc")}, TestbedSettings().cluster_node.names),
        ({"clusters": LiveClusterSettings(topic="none")}, ()),
    ],
    ids=["own", "named", "not named", "none"],
)
def test_the_clusters_have_their_names(given: dict[str, Any], expected: tuple[str, ...]) -> None:
    assert foreign(given).settings.cluster_names == expected


def test_an_unknown_cluster_of_another_driver_is_refused() -> None:
    given = {"clusters": LiveClusterSettings(topic="/uc", names=("heel",))}
    found = line_of(lambda: foreign(given))
    assert found.startswith("the calibration has no cluster heel of align_node (it has brim")
