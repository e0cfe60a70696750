"""Settings, the file of the node parameters, and names of trials, which are names of takes."""

import dataclasses
import inspect
from pathlib import Path

import numpy as np
from support.wording import refused

from socket_testbed.drivers.natnet.connection import TakeKeeper
from socket_testbed.errors import ConfigurationError
from socket_testbed.settings import testbed
from socket_testbed.settings.acquisition import TriggerSettings
from socket_testbed.settings.identification import IdentificationSettings

NODES = {name: type(settings) for name, settings in testbed.TestbedSettings().nodes().items()}


def test_every_setting_has_a_unit_and_its_default_comes_back_from_its_flat_form():
    for kind in {*NODES.values(), IdentificationSettings, testbed.TestbedSettings}:
        settings = kind()
        assert kind.from_flat(settings.to_flat(), "here") == kind.from_flat({}, "here") == settings
        assert set(settings.to_flat()) == set(kind.flat())
        for field in kind.flat().values():
            assert field.metadata["description"].rstrip().endswith("]"), field.name


def test_help_shows_each_field_with_its_unit_default_and_range_or_choices():
    shown = " ".join(inspect.getdoc(IdentificationSettings).split())
    assert "theta: weight of the wrench against the clusters, on normalised errors [-];" in shown
    assert "[-]; default 0.5; from 0 to 1. weights:" in shown
    assert "default 'size'; one of 'size', 'noise', 'raw'." in shown
    assert "default (100.0, 20.0); each from 1 to 1e+06." in shown
    assert "default 'osqp'. solver_tolerance:" in shown
    nested = inspect.getdoc(testbed.EstimatorSettings)
    assert "\n    identification: nested settings, a `IdentificationSettings`.\n" in nested
    assert "\n    force_map: nested settings, a `ForceMapSettings`." in nested


def test_whatever_means_a_number_is_one_and_a_wrong_value_is_refused_by_its_name():
    for value in (1, 1.0, "1e0", "1.0", np.float32(1.0), np.array(1.0)):
        theta = IdentificationSettings(theta=value).theta
        assert type(theta) is float and theta == 1.0
    least = testbed.WindowSettings(least_samples=50.0).least_samples
    assert type(least) is int and least == 50
    assert IdentificationSettings(initial_stiffness="auto").initial_stiffness == 0.0
    assert IdentificationSettings(reference_position=np.ones(3)).reference_position == (1.0,) * 3
    for name, value, error in (
        ("variant", "stifness", "did you mean 'stiffness'"),
        ("leave_out", "Mz", "leave_out is 'Mz': give a list"),
        ("reference_position", [1.0], "give x, y and z in m"),
    ):
        with refused(ConfigurationError, error):
            IdentificationSettings(**{name: value})
    with refused(ConfigurationError, "a pulse of 0.1 s is too long for 20 Hz", "0.025 s or less"):
        TriggerSettings(rate=20.0, pulse=0.1)


# --- testbed.yaml


def test_a_file_of_parameters_gives_the_settings_of_its_nodes_over_those_of_another(tmp_path):
    path = tmp_path / "testbed.yaml"

    def read(content, *base):
        path.write_text(content)
        return testbed.read_testbed(path, *base)

    assert read("") == testbed.TestbedSettings()
    found = read(
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
    first = read("trigger_node: {ros__parameters: {rate: 9, pulse: 1e-3}}")
    second = read("trigger_node: {ros__parameters: {rate: 7}}", first)
    assert second.trigger_node == TriggerSettings(rate=7.0)
    known = "estimator_node: {ros__parameters: {identification: "
    for content, error in (
        ("estimater_node: {ros__parameters: {}}", "did you mean 'estimator_node'"),
        (f"{known}{{tetha: 1}}}}}}", "'identification.tetha': did you mean 'identification.theta'"),
    ):
        with refused(ConfigurationError, str(path), error):
            read(content)


def test_what_is_written_comes_back_but_for_what_belongs_to_one_run(tmp_path):
    path = tmp_path / "testbed.yaml"
    estimator = testbed.EstimatorSettings(
        geometry="socket.yaml",
        identification=IdentificationSettings(leave_out=("Mz",), theta=0.3, wrench_sharpness=()),
    )
    trigger = TriggerSettings(rate=20.0, wait_for=("mocap_node",), simulation="world")
    testbed.write_testbed({"estimator_node": estimator, "trigger_node": trigger}, path)
    found = testbed.read_testbed(path)
    assert found.estimator_node == dataclasses.replace(estimator, geometry="")
    assert found.trigger_node == TriggerSettings(rate=20.0)


# --- names of trials, which go to Motive as names of takes


def test_a_name_goes_to_motive_as_it_is_or_is_refused_when_it_is_given(tmp_path: Path):
    for name in ("trial_20261122_101500", "S01 left 2", "Übung-3.b", "歩行"):
        assert testbed.check_take_name(name) == name
    wrong = ("", "a,b", "StopRecording\nx", "a\0b", "..", "a/b", "a\\b", "C:x", "a ", "a\u2028b")
    for name in (*wrong, "\udcff", "x" * 70_000, "ü" * 101):
        with refused(ConfigurationError, "the trial's name ", ": give letters") as caught:
            testbed.check_take_name(name)
        assert len(str(caught.value).encode()) < 450
    with refused(ConfigurationError, "the trial's name"):
        testbed.RecorderSettings(directory=str(tmp_path / "a,b"), record=True)
    # A refused take is not pursued, and the one before it ends.
    sent: list[str] = []
    keeper = TakeKeeper(lambda command, done: sent.append(command))
    keeper.request("first")
    with refused(ConfigurationError, "the trial's name"):
        keeper.request("a,b")
    assert keeper.settled  # nothing was started, nothing is wanted
    keeper.step(1.0, connected=True)
    assert sent == [] and keeper.fault == ""
