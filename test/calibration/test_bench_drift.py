"""Drift between baselines: measured, flagged, taken off."""

import dataclasses

import numpy as np
from support.benches import bench_of, exact_bench, nominal
from support.wording import refused

from socket_testbed.calibration.bench_data import join_benches
from socket_testbed.calibration.drift import (
    DRIFT_LIMIT,
    Baseline,
    average_baseline,
    correct_bench,
    correct_drift,
    measure_drift,
)
from socket_testbed.errors import CalibrationError

REST = exact_bench().capacitance[0]
DRIFT = np.array([0.05, -0.02, 0.08, 0.03])  # [pF] over a run


def test_a_baseline_is_the_median_of_the_whole_readings():
    readings = np.array([REST, REST + 0.1, REST - 0.1, REST, REST + 9.0])
    readings = np.vstack([readings, np.where(np.arange(4) == 2, np.nan, REST + 5.0)])
    np.testing.assert_array_equal(average_baseline(3.0, readings, "x").capacitance, REST)
    with refused(CalibrationError, "before.csv: 2 complete readings are too few"):
        average_baseline(0.0, readings[-3:], "before.csv")


def test_the_drift_in_stress_is_that_of_the_calibration_and_flagged_above_the_limit():
    """A common drift is read as normal stress by the gain; none of it as shear."""
    for part, flagged in ((0.95, False), (-0.95, False), (1.05, True)):
        shift = part * DRIFT_LIMIT / nominal().normal[1]
        drift = measure_drift(nominal(), Baseline(0.0, REST), Baseline(9.0, REST + shift))
        np.testing.assert_allclose(drift.capacitance, shift, rtol=1e-9)
        np.testing.assert_allclose(drift.stress, [part * DRIFT_LIMIT, 0, 0], atol=1e-6)
        assert drift.flagged is flagged


def test_a_linear_drift_is_taken_off_between_the_baselines_and_stays_outside_of_them():
    time = np.linspace(-3.0, 22.0, 101)
    true = exact_bench().capacitance[:101].copy()
    true[7, 3] = np.nan
    drifted = true + np.outer(np.clip((time - 2.0) / 10.0, 0.0, 1.0), DRIFT)
    # Mounted with an offset, it drifts from there.
    for mounted in (np.zeros(4), np.array([0.2, -0.1, 0.1, 0.3])):
        before, after = Baseline(2.0, REST + mounted), Baseline(12.0, REST + mounted + DRIFT)
        found = correct_drift(drifted + mounted, time, before, after, reference=REST)
        np.testing.assert_allclose(found, true, atol=1e-12)
        found = correct_drift(drifted + mounted, time, before, after)
        np.testing.assert_allclose(found, true + mounted, atol=1e-12)
    # A single baseline corrects to that of the calibration, if there is one.
    alone = Baseline(0.0, REST + DRIFT)
    np.testing.assert_array_equal(correct_drift(true, time, alone), true)
    found = correct_drift(true + DRIFT, time, alone, reference=REST)
    np.testing.assert_allclose(found, true, atol=1e-12)
    with refused(CalibrationError, "not later", "before first"):
        correct_drift(true, time, before, before)


def test_drift_over_several_files_or_without_time_is_refused():
    bench = bench_of(np.full((9, 4), 6.0), np.zeros((9, 3)))
    timeless = dataclasses.replace(bench, time=np.full(9, np.nan))
    for wrong, named in (
        (join_benches([bench, bench]), ("2 bench files cannot share", "the one file")),
        (timeless, ("bench.csv: has no time", "time [s]")),
    ):
        with refused(CalibrationError, *named):
            correct_bench(wrong, Baseline(0.0, REST), Baseline(0.8, REST + DRIFT))
