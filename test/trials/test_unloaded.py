"""Drift of the clusters, taken off a trial by its spans without load."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.verbs import call
from support.wording import refused

import socket_testbed as st
from socket_testbed.errors import CalibrationError, ConfigurationError, TrialError
from socket_testbed.trials.synchronise import (
    Measurements,
    correct_measurements,
    make_samples,
    parse_unloaded,
)
from socket_testbed.trials.trial import Trial


@pytest.fixture
def measured(hold: Path) -> Measurements:
    """The trial's measurements; its first and last 10 s made to be without load."""
    found = Trial(hold).measurements()
    rest = (found.time < 10.0) | (found.time > found.time[-1] - 10.0)
    capacitance = found.capacitance.copy()
    capacitance[rest] = np.array([5.1, 5.2, 5.0, 5.3])
    return dataclasses.replace(found, capacitance=capacitance)


def correct(trial: Trial, measured: Measurements) -> Measurements:
    """The correction of `Trial.measurements`, of any measurements."""
    least_force = trial.estimator.plateau.least_force
    notify = trial.notify or (lambda note: None)
    return correct_measurements(
        measured, trial.unloaded, trial.calibration, least_force, str(trial.path), notify
    )


def test_drift_between_two_spans_is_taken_off(hold: Path, measured: Measurements) -> None:
    time, notes = measured.time, []
    end = time[-1]
    trial = Trial(hold, notify=notes.append, unloaded=((0.0, 8.0), (end - 8.0, end)))
    drift = 0.2 * (time - 4.0) / (end - 8.0)
    drifted = dataclasses.replace(measured, capacitance=measured.capacitance + drift[:, None, None])
    corrected = correct(trial, drifted)
    inner = (time > 8.0) & (time < end - 8.0)
    np.testing.assert_allclose(  # what was not measured stays so
        corrected.capacitance[inner], measured.capacitance[inner], atol=0.003
    )
    assert len(notes) == 4 and all("more than 1 kPa" in note for note in notes)
    plain, found = (
        make_samples(each, trial.calibration, trial.geometry) for each in (measured, corrected)
    )
    np.testing.assert_allclose(
        found.local_forces[inner], plain.local_forces[inner], atol=0.15, rtol=0.01
    )


def with_baselines(trial: Trial) -> Trial:
    """The trial with a baseline of 5 pF in the calibration of every cluster."""
    clusters = {
        name: dataclasses.replace(cluster, baseline=np.full(4, 5.0))
        for name, cluster in trial.calibration.clusters.items()
    }
    trial.__dict__["calibration"] = dataclasses.replace(trial.calibration, clusters=clusters)
    return trial


def test_a_baseline_takes_off_earlier_drift_but_not_what_a_weight_presses(
    hold: Path, measured: Measurements
) -> None:
    """A baseline is of a cluster that bears nothing: not even the pylon's weight."""
    trial = with_baselines(Trial(hold, unloaded=((0.0, 8.0),)))
    wrench = np.where(measured.time[:, None] <= 8.0, 0.0, measured.wrench)
    corrected = correct(trial, dataclasses.replace(measured, wrench=wrench))
    np.testing.assert_allclose(corrected.capacitance[3], np.full((4, 4), 5.0))
    end, notes = measured.time[-1], []
    spans = ((0.0, 8.0), (end - 8.0, end))
    trial = with_baselines(Trial(hold, notify=notes.append, unloaded=spans))
    corrected = correct(trial, measured)
    assert "load cell measured 92 N in 0:8" in notes[0] and "baseline" in notes[0]
    expected = correct(Trial(hold, unloaded=spans), measured)
    np.testing.assert_array_equal(corrected.capacitance, expected.capacitance)


def test_spans_that_cannot_correct_are_refused_or_reported(
    hold: Path, measured: Measurements
) -> None:
    for spans in (((25.0, 30.0),), ((0.0, 5.0), (25.0, 30.0))):
        with refused(TrialError, "25:30 is not without load", "279 N there: ", " 92 N"):
            Trial(hold, unloaded=spans).samples()
    with refused(CalibrationError, "from 900 s to 901 s", "too few"):
        correct(Trial(hold, unloaded=((900.0, 901.0),)), measured)
    notes: list[str] = []
    Trial(hold, notify=notes.append, unloaded=((0.0, 3.0),)).samples()
    assert len(notes) == 1 and "distal is not corrected: give a second span" in notes[0]
    for wrong in (["5"], ["8:2"], ["nan:1"], ["0:1", "2:3", "4:5"], ["9:10", "0:1"]):
        with refused(ConfigurationError, "--unloaded"):
            parse_unloaded(wrong)
    with refused(ConfigurationError, "3:8 does not begin after 0:5"):
        st.open_trial(hold, unloaded=[(0, 5), (3, 8)])


def test_a_model_remembers_the_spans(hold: Path, tmp_path: Path, capsys: Any) -> None:
    model, spans = tmp_path / "m.json", ["--unloaded", "0:3"]
    assert call(capsys, "fit", hold, *spans, "--segment", "all", "-o", model)[0] == 0
    assert json.loads(model.read_text())["trial"]["unloaded"] == [[0.0, 3.0]]
    judged = ["evaluate", hold, "--model", model]
    assert "fitted with --unloaded" in call(capsys, *judged)[2]
    assert "--unloaded" not in call(capsys, *judged, *spans)[2]
