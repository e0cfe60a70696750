"""Drift between baselines: measured, flagged, taken off."""

import dataclasses

import numpy as np
import pytest
from support.benches import FULL_SCALE, bench_of, exact_bench, nominal, sensor_bench

from socket_testbed.calibration.bench_data import join_benches
from socket_testbed.calibration.calibrate import calibrate_bench
from socket_testbed.calibration.drift import (
    DRIFT_LIMIT,
    Baseline,
    average_baseline,
    correct_bench,
    correct_drift,
    measure_drift,
)
from socket_testbed.calibration.fit import predict_stress
from socket_testbed.errors import CalibrationError

REST = exact_bench().capacitance[0]
DRIFT = np.array([0.05, -0.02, 0.08, 0.03])  # [pF] over a run


def test_a_baseline_is_the_median_of_the_whole_readings():
    readings = np.array([REST, REST + 0.1, REST - 0.1, REST, REST + 9.0])
    readings = np.vstack([readings, np.where(np.arange(4) == 2, np.nan, REST + 5.0)])
    np.testing.assert_array_equal(average_baseline(3.0, readings, "x").capacitance, REST)
    with pytest.raises(CalibrationError, match=r"before.csv: 2 complete readings are too few"):
        average_baseline(0.0, readings[-3:], "before.csv")


def test_the_drift_in_stress_is_that_of_the_calibration_and_flagged_above_the_limit():
    """A common drift is read as normal stress by the gain; none of it as shear."""
    gain = nominal().normal[1]
    for part, flagged in ((0.95, False), (-0.95, False), (1.05, True)):
        shift = part * DRIFT_LIMIT / gain
        drift = measure_drift(nominal(), Baseline(0.0, REST), Baseline(9.0, REST + shift))
        np.testing.assert_allclose(drift.capacitance, shift, rtol=1e-9)
        np.testing.assert_allclose(drift.stress, [part * DRIFT_LIMIT, 0, 0], atol=1e-6)
        assert drift.flagged is flagged


def test_a_linear_drift_is_taken_off_between_the_baselines_and_stays_outside_of_them():
    time = np.linspace(-3.0, 22.0, 101)
    true = exact_bench().capacitance[:101].copy()
    true[7, 3] = np.nan
    before, after = Baseline(2.0, REST), Baseline(12.0, REST + DRIFT)
    drifted = true + np.outer(np.clip((time - 2.0) / 10.0, 0.0, 1.0), DRIFT)
    np.testing.assert_allclose(correct_drift(drifted, time, before, after), true, atol=1e-12)
    # A single baseline corrects to that of the calibration, if there is one.
    alone = Baseline(0.0, REST + DRIFT)
    np.testing.assert_array_equal(correct_drift(true, time, alone), true)
    found = correct_drift(true + DRIFT, time, alone, reference=REST)
    np.testing.assert_allclose(found, true, atol=1e-12)
    with pytest.raises(CalibrationError, match=r"not later.*before first"):
        correct_drift(true, time, before, before)


def test_a_bench_run_s_drift_comes_off_its_calibration():
    bench = sensor_bench()
    part = (bench.time / bench.time[-1])[:, None]
    drifted = dataclasses.replace(bench, capacitance=bench.capacitance + 10.0 * part * DRIFT)
    rest = bench.capacitance[0]
    before, after = Baseline(0.0, rest), Baseline(bench.time[-1], rest + 10.0 * DRIFT)
    wiring = nominal().wiring
    clean, spoilt, corrected = (
        calibrate_bench(b, wiring, True, False)
        for b in (bench, drifted, correct_bench(drifted, before, after))
    )
    assert spoilt.held_out[0].rmse > 10.0 * clean.held_out[0].rmse
    np.testing.assert_allclose(corrected.cluster.normal, clean.cluster.normal, rtol=1e-9)
    assert measure_drift(corrected.cluster, before, after).flagged


def test_a_trial_s_drift_and_offset_come_off_its_stresses():
    """End to end: calibrated on the bench, mounted with an offset, drifting during a trial."""
    bench = sensor_bench()
    cluster = calibrate_bench(bench, nominal().wiring, True, False).cluster
    cluster = dataclasses.replace(cluster, baseline=bench.capacitance[0])
    trial = sensor_bench(draw=1)
    mounted = np.array([0.2, -0.1, 0.1, 0.3])
    part = (trial.time / trial.time[-1])[:, None]
    read = trial.capacitance + mounted + 4.0 * part * DRIFT
    before = Baseline(trial.time[0], read[0])
    after = Baseline(trial.time[-1], read[-1])
    corrected = correct_drift(read, trial.time, before, after, cluster.baseline)
    error = np.abs(predict_stress(cluster, corrected) - trial.stress).max(axis=0) / FULL_SCALE
    raw = np.abs(predict_stress(cluster, read) - trial.stress).max(axis=0) / FULL_SCALE
    assert (error < 0.05).all() and (raw > 2.0 * error).all()


def test_drift_over_several_files_or_without_time_is_refused():
    bench = bench_of(np.full((9, 4), 6.0), np.zeros((9, 3)))
    before, after = Baseline(0.0, REST), Baseline(0.8, REST + DRIFT)
    with pytest.raises(CalibrationError, match=r"2 bench files cannot share.*the one file"):
        correct_bench(join_benches([bench, bench]), before, after)
    timeless = dataclasses.replace(bench, time=np.full(9, np.nan))
    with pytest.raises(CalibrationError, match=r"bench.csv: has no time.*time \[s\]"):
        correct_bench(timeless, before, after)
