"""Drift of the clusters, taken off a trial by its spans without load."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from support.verbs import call

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
    time = (found.stamps - found.stamps[0]) * 1e-9
    rest = (time < 10.0) | (time > time[-1] - 10.0)
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
    time = (measured.stamps - measured.stamps[0]) * 1e-9
    end, said = time[-1], []
    trial = Trial(hold, notify=said.append, unloaded=((0.0, 8.0), (end - 8.0, end)))
    drift = 0.2 * (time - 4.0) / (end - 8.0)
    drifted = dataclasses.replace(measured, capacitance=measured.capacitance + drift[:, None, None])
    corrected = correct(trial, drifted)
    inner = (time > 8.0) & (time < end - 8.0)
    np.testing.assert_allclose(
        corrected.capacitance[inner], measured.capacitance[inner], atol=0.003
    )
    assert len(said) == 4 and all("more than 1 kPa" in note for note in said)
    # What was not measured stays so.
    assert np.array_equal(np.isnan(corrected.capacitance), np.isnan(measured.capacitance))
    plain = make_samples(measured, trial.calibration, trial.geometry)
    corrected = make_samples(corrected, trial.calibration, trial.geometry)
    np.testing.assert_allclose(
        corrected.local_forces[inner], plain.local_forces[inner], atol=0.15, rtol=0.01
    )


def with_baselines(trial: Trial) -> Trial:
    """The trial with a baseline of 5 pF in the calibration of every cluster."""
    clusters = {
        name: dataclasses.replace(cluster, baseline=np.full(4, 5.0))
        for name, cluster in trial.calibration.clusters.items()
    }
    calibration = dataclasses.replace(trial.calibration, clusters=clusters)
    trial.__dict__["calibration"] = calibration
    return trial


def test_a_stored_baseline_takes_off_earlier_drift(hold: Path, measured: Measurements) -> None:
    trial = with_baselines(Trial(hold, unloaded=((0.0, 8.0),)))
    wrench = measured.wrench.copy()
    wrench[measured.time <= 8.0] = 0.0
    corrected = correct(trial, dataclasses.replace(measured, wrench=wrench))
    np.testing.assert_allclose(corrected.capacitance[3], np.full((4, 4), 5.0))


def test_under_the_pylon_s_weight_only_the_drift_since_then_counts(
    hold: Path, measured: Measurements
) -> None:
    """A baseline is of a cluster that bears nothing: it would take off what the pylon presses."""
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
        with pytest.raises(TrialError, match=r"25:30 is not without load, .* 279 N there: .* 92 N"):
            Trial(hold, unloaded=spans).samples()
    with pytest.raises(CalibrationError, match=r"from 900 s to 901 s.*too few"):
        correct(Trial(hold, unloaded=((900.0, 901.0),)), measured)
    notes: list[str] = []
    Trial(hold, notify=notes.append, unloaded=((0.0, 3.0),)).samples()
    (note,) = notes
    assert "distal is not corrected: give a second span" in note
    for wrong in (["5"], ["8:2"], ["nan:1"], ["0:1", "2:3", "4:5"], ["9:10", "0:1"]):
        with pytest.raises(ConfigurationError, match="--unloaded"):
            parse_unloaded(wrong)
    with pytest.raises(ConfigurationError, match="3:8 does not begin after 0:5"):
        st.open_trial(hold, unloaded=[(0, 5), (3, 8)])


def test_a_model_remembers_the_spans(
    hold: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, spans = tmp_path / "m.json", ["--unloaded", "0:3"]
    assert call(capsys, "fit", hold, *spans, "--segment", "all", "-o", model)[0] == 0
    assert json.loads(model.read_text())["trial"]["unloaded"] == [[0.0, 3.0]]
    judged = ["evaluate", hold, "--model", model]
    assert "fitted with --unloaded" in call(capsys, *judged)[2]
    assert "--unloaded" not in call(capsys, *judged, *spans)[2]
