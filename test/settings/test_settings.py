"""Settings, the file of the node parameters, and names of trials, which are names of takes."""

import dataclasses
import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.wording import refused

from socket_testbed.drivers.natnet.connection import TakeKeeper
from socket_testbed.errors import ConfigurationError
from socket_testbed.settings import testbed
from socket_testbed.settings.acquisition import TriggerSettings
from socket_testbed.settings.fields import Settings
from socket_testbed.settings.identification import IdentificationSettings

NODES = {name: type(settings) for name, settings in testbed.TestbedSettings().nodes().items()}


EVERY_KIND = pytest.mark.parametrize(
    "kind", sorted({*NODES.values(), IdentificationSettings, testbed.TestbedSettings}, key=str)
)


def test_help_shows_unit_default_and_range():
    shown = " ".join(inspect.getdoc(IdentificationSettings).split())
    assert "theta: weight of the wrench against the clusters, on normalised errors [-];" in shown
    assert "[-]; default 0.5; from 0 to 1. weights:" in shown
    assert "default 'size'; one of 'size', 'noise', 'raw'." in shown
    assert "default (); each from -10 to 10." in shown
    assert "default 'osqp'. solver_tolerance:" in shown
    nested = inspect.getdoc(testbed.EstimatorSettings)
    assert "\n    identification: nested settings, a `IdentificationSettings`.\n" in nested
    assert "\n    force_map: nested settings, a `ForceMapSettings`." in nested


@EVERY_KIND
def test_defaults_come_back_from_their_flat_form(kind: type[Settings]):
    settings = kind()
    assert kind.from_flat(settings.to_flat(), "here") == kind.from_flat({}, "here") == settings
    assert set(settings.to_flat()) == set(kind.flat())


@EVERY_KIND
def test_every_setting_has_a_unit(kind: type[Settings]):
    for field in kind.flat().values():
        assert field.metadata["description"].rstrip().endswith("]"), field.name


@pytest.mark.parametrize(
    "value",
    [
        pytest.param(1, id="int"),
        pytest.param(1.0, id="float"),
        pytest.param("1e0", id="exponent"),
        pytest.param("1.0", id="decimal"),
        pytest.param(np.float32(1.0), id="numpy-scalar"),
        pytest.param(np.array(1.0), id="numpy-array"),
    ],
)
def test_whatever_means_a_number_is_one(value: Any):
    theta = IdentificationSettings(theta=value).theta
    assert type(theta) is float and theta == 1.0


def test_a_float_that_is_whole_is_an_integer():
    least = testbed.WindowSettings(least_samples=50.0).least_samples
    assert type(least) is int and least == 50


def test_auto_is_the_stiffness_zero():
    assert IdentificationSettings(initial_stiffness="auto").initial_stiffness == 0.0


def test_an_array_is_a_tuple():
    assert IdentificationSettings(reference_position=np.ones(3)).reference_position == (1.0,) * 3


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        pytest.param("variant", "stifness", "did you mean 'stiffness'", id="misspelt"),
        pytest.param("leave_out", "Mz", "leave_out is 'Mz': give a list", id="no-list"),
        pytest.param("reference_position", [1.0], "give x, y and z in m", id="too-short"),
        pytest.param("reference_position", [1.0] * 4, "give x, y and z in m", id="too-long"),
    ],
)
def test_a_wrong_value_is_refused_by_its_name(name: str, value: Any, error: str):
    with refused(ConfigurationError, error):
        IdentificationSettings(**{name: value})


def test_a_pulse_longer_than_the_period_is_refused():
    assert TriggerSettings(rate=20.0, pulse=0.025).pulse == 0.025
    with refused(ConfigurationError, "a pulse of 0.1 s is too long for 20 Hz", "0.025 s or less"):
        TriggerSettings(rate=20.0, pulse=0.1)


# --- testbed.yaml


class Parameters:
    """A file of parameters."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "testbed.yaml"

    def read(
        self, content: str, *base: testbed.TestbedSettings, namespace: str = "/"
    ) -> testbed.TestbedSettings:
        self.path.write_text(content)
        return testbed.read_testbed(self.path, *base, namespace=namespace)


@pytest.fixture
def parameters(tmp_path: Path) -> Parameters:
    return Parameters(tmp_path)


def test_an_empty_file_gives_the_defaults(parameters: Parameters):
    assert parameters.read("") == testbed.TestbedSettings()


def test_a_file_of_parameters_gives_its_nodes_settings(parameters: Parameters):
    found = parameters.read(
        """
        estimator_node:
          ros__parameters:
            use_sim_time: true
            identification:
              theta: 1
              leave_out: [Mz]
            plateau.smoothing: 4
        """
    )
    estimator = found.estimator_node
    assert (estimator.identification.theta, estimator.plateau.smoothing) == (1.0, 4.0)
    assert estimator.identification.leave_out == ("Mz",)
    assert estimator.window == testbed.WindowSettings()


def test_a_node_in_a_later_file_is_replaced(parameters: Parameters):
    first = parameters.read("trigger_node: {ros__parameters: {rate: 9, pulse: 1e-3}}")
    second = parameters.read("trigger_node: {ros__parameters: {rate: 7}}", first)
    assert second.trigger_node == TriggerSettings(rate=7.0)


RATE_9 = "ros__parameters: {rate: 9}"


@pytest.mark.parametrize(
    ("content", "namespace"),
    [
        pytest.param(f"/**: {{{RATE_9}}}", "/", id="any-node"),
        pytest.param(f"/**: {{{RATE_9}}}", "/left", id="any-node-in-left"),
        pytest.param(f"/*: {{{RATE_9}}}", "/", id="one-level"),
        pytest.param(f"/**/trigger_node: {{{RATE_9}}}", "/left", id="any-namespace"),
        pytest.param(f"/*/trigger_node: {{{RATE_9}}}", "/left", id="one-namespace"),
        pytest.param(f"trigger_node: {{{RATE_9}}}", "/left", id="bare"),
        pytest.param(f"/trigger_node: {{{RATE_9}}}", "/", id="dumped"),
        pytest.param(f"/trigger_node: {{{RATE_9}}}", "/left", id="dumped-for-left"),
        pytest.param(f"/left/trigger_node: {{{RATE_9}}}", "/left", id="in-left"),
        pytest.param(f"/left/trigger_node: {{{RATE_9}}}", "/", id="left-for-none"),
        pytest.param(f"left/trigger_node: {{{RATE_9}}}", "/left", id="without-slash"),
        pytest.param(f"/lab: {{left: {{trigger_node: {{{RATE_9}}}}}}}", "/lab/left", id="nested"),
        pytest.param(f"/left/**: {{{RATE_9}}}", "/left", id="all-in-left"),
        pytest.param(
            f"/left/trigger_node: {{{RATE_9}}}\n"
            "/right/trigger_node: {ros__parameters: {rate: 5}}",
            "/left",
            id="two-testbeds",
        ),
        pytest.param(
            f"/**: {{ros__parameters: {{rate: 5}}}}\ntrigger_node: {{{RATE_9}}}", "/", id="last"
        ),
    ],
)
def test_a_file_of_ros_is_read(parameters: Parameters, content: str, namespace: str):
    found = parameters.read(content, namespace=namespace)
    assert found.trigger_node.rate == 9.0
    assert found.cluster_node == testbed.TestbedSettings().cluster_node


def test_what_ros_dumps_comes_back(parameters: Parameters):
    """As `ros2 param dump /left/replay_node` writes it."""
    found = parameters.read(
        """
        /left/replay_node:
          ros__parameters:
            geometry: ''
            rate: 2.5
            loop: true
            qos_overrides:
              /clock:
                subscription: {depth: 1, history: keep_last, reliability: best_effort}
            start_type_description_service: true
            use_sim_time: false
            wait_for:
            - ''
        """
    )
    assert found.replay_node == testbed.ReplaySettings(rate=2.5, loop=True)


def test_a_section_for_all_nodes_changes_what_it_names(parameters: Parameters):
    """The other parameters of a node stay as they were."""
    base = testbed.TestbedSettings(trigger_node=TriggerSettings(rate=9.0, pulse=1e-3))
    found = parameters.read("/**: {ros__parameters: {use_sim_time: true, rate: 7.0}}", base)
    assert found.trigger_node == TriggerSettings(rate=7.0, pulse=1e-3)
    assert found.replay_node.rate == 7.0 and found.view_node == base.view_node


@pytest.mark.parametrize(
    ("content", "error"),
    [
        pytest.param(
            "/**: {ros__parameters: {rat: 1}}", "/**: unknown key 'rat': did you mean", id="name"
        ),
        pytest.param("/left/trigger_nod: {ros__parameters: {}}", "'trigger_node'", id="node"),
        pytest.param("/left: 3", "/left is not a mapping: write 'ros__parameters:'", id="number"),
        pytest.param("/left: {trigger_node: {}}", "/left/trigger_node: 'ros__pa", id="empty"),
        pytest.param("a: {ros__parameters: [1]}", "a: ros__parameters is not a ma", id="list"),
        pytest.param(
            "/b/trigger_node: {ros__parameters: {}}\n/c/trigger_node: {ros__parameters: {}}",
            "holds nodes in /b, /c, not /left: give that namespace",
            id="places",
        ),
    ],
)
def test_a_wrong_file_of_ros_is_refused(parameters: Parameters, content: str, error: str):
    with refused(ConfigurationError, f"{parameters.path}: ", error):
        parameters.read(content, namespace="/left")


@pytest.mark.parametrize(
    ("content", "error"),
    [
        pytest.param(
            "estimater_node: {ros__parameters: {}}", "did you mean 'estimator_node'", id="node"
        ),
        pytest.param(
            "estimator_node: {ros__parameters: {identification: {tetha: 1}}}",
            "'identification.tetha': did you mean 'identification.theta'",
            id="parameter",
        ),
    ],
)
def test_an_unknown_name_is_refused_with_the_nearest(parameters: Parameters, content, error):
    with refused(ConfigurationError, str(parameters.path), error):
        parameters.read(content)


def test_what_is_written_comes_back(tmp_path):
    """But for what belongs to one run."""
    path = tmp_path / "testbed.yaml"
    estimator = testbed.EstimatorSettings(
        geometry="socket.yaml",
        identification=IdentificationSettings(leave_out=("Mz",), theta=0.3),
    )
    trigger = TriggerSettings(rate=20.0, wait_for=("mocap_node",), simulation="world")
    testbed.write_testbed({"estimator_node": estimator, "trigger_node": trigger}, path)
    found = testbed.read_testbed(path)
    assert found.estimator_node == dataclasses.replace(estimator, geometry="")
    assert found.trigger_node == TriggerSettings(rate=20.0)


# --- names of trials, which go to Motive as names of takes


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("trial_20261122_101500", id="usual"),
        pytest.param("S01 left 2", id="with-spaces"),
        pytest.param("Übung-3.b", id="umlaut"),
        pytest.param("歩行", id="japanese"),
        pytest.param("ü" * 100, id="200-bytes"),
    ],
)
def test_a_good_name_goes_to_motive_unchanged(name: str):
    assert testbed.check_take_name(name) == name


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("", id="empty"),
        pytest.param("a,b", id="comma"),
        pytest.param("StopRecording\nx", id="second-command"),
        pytest.param("a\0b", id="null"),
        pytest.param("..", id="parent"),
        pytest.param("a/b", id="slash"),
        pytest.param("a\\b", id="backslash"),
        pytest.param("C:x", id="drive"),
        pytest.param("a ", id="space-at-the-end"),
        pytest.param("a\u2028b", id="line-separator"),
        pytest.param("\udcff", id="surrogate"),
        pytest.param("x" * 70_000, id="70000-bytes"),
        pytest.param("ü" * 101, id="202-bytes"),
    ],
)
def test_a_wrong_name_is_refused_in_one_line(name: str):
    with refused(ConfigurationError, "the trial's name ", ": give letters") as caught:
        testbed.check_take_name(name)
    assert len(str(caught.value).encode()) < 450


def test_a_recorder_refuses_a_wrong_name(tmp_path: Path):
    with refused(ConfigurationError, "the trial's name"):
        testbed.RecorderSettings(directory=str(tmp_path / "a,b"), record=True)


def test_a_refused_take_is_not_pursued():
    """And the one before it ends."""
    sent: list[str] = []
    keeper = TakeKeeper(lambda command, done: sent.append(command))
    keeper.request("first")
    with refused(ConfigurationError, "the trial's name"):
        keeper.request("a,b")
    assert keeper.settled  # nothing was started, nothing is wanted
    keeper.step(1.0, connected=True)
    assert sent == [] and keeper.fault == ""
