"""A bench's calibration: the fit and the loads it needs, its quality, the drift of baselines."""

import dataclasses
import itertools

import numpy as np
from support.benches import FULL_SCALE, bench_of, exact_bench, load_path, nominal, sensor_bench
from support.wording import refused

from socket_testbed.calibration import calibrate, drift, fit
from socket_testbed.calibration.bench_data import BenchData, join_benches
from socket_testbed.calibration.model import channel_features
from socket_testbed.errors import CalibrationError

WIRING = nominal().wiring
ALL = np.ones(len(exact_bench()), dtype=bool)


def test_the_coefficients_of_exact_data_are_recovered(rng):
    near = rng.uniform(5.0, 9.0, (200, 4))
    # Differences of 5 +- 0.1 pF make the columns nearly parallel.
    far = rng.uniform(-0.1, 0.1, (500, 4)) + np.array([5.0, 10.0, 5.0, 10.0])
    for name, channels, rtol in (("brim_lateral", near, 1e-9), ("distal", far, 1e-6)):
        cluster = nominal(name)
        stress = fit.predict_stress(cluster, channels[:, np.argsort(cluster.wiring)])
        normal, shear = fit.fit_polynomials(channels, stress)
        np.testing.assert_allclose(normal, cluster.normal, rtol=rtol)
        np.testing.assert_allclose(shear, cluster.shear, rtol=rtol)
    channels, stress = sensor_bench(play=0.05).capacitance[:, WIRING], load_path()
    normal, shear = fit.fit_polynomials(channels, stress)  # by least squares where it is not exact
    mean, x, y = channel_features(channels)
    np.testing.assert_allclose(normal, np.polyfit(mean, stress[:, 0], 1)[::-1], rtol=1e-9)
    terms = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    np.testing.assert_allclose(shear.T, np.linalg.lstsq(terms, stress[:, 1:])[0], rtol=1e-7)
    with refused(CalibrationError, "always go together", "input of its own"):
        fit.fit_polynomials(channels[:, [0, 0, 2, 2]], stress)


def test_the_range_is_that_of_both_differences():
    bench = exact_bench()
    mean, x, y = channel_features(bench.capacitance[:, WIRING])
    some = mean < np.median(mean)
    for rows in (ALL, some):
        found = fit.fit_cluster(bench.capacitance, bench.stress, WIRING, rows)
        np.testing.assert_array_equal(found.mean_range, [mean[rows].min(), mean[rows].max()])
        both = [max(x[rows].min(), y[rows].min()), min(x[rows].max(), y[rows].max())]
        np.testing.assert_array_equal(found.difference_range, both)


def test_the_stress_that_is_missing_is_named():
    ramp = np.concatenate([np.linspace(0.0, 1.0, 25), np.linspace(1.0, 0.0, 25)])
    directions = [[1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    crossed = np.concatenate([np.outer(ramp, FULL_SCALE * direction) for direction in directions])
    noise = np.random.default_rng(5).normal(0.0, 0.005, (250, 3)) * FULL_SCALE
    path = load_path()
    n, x, y = path.T
    for stress, *named in (
        (path[:29], "29 readings are too few", "several"),
        (path / 1e3, "normal spans only 60 Pa", "--units normal=UNIT"),
        (np.column_stack([n, 0.5 * y, y]), "shear_x always goes with", "stay as"),
        (np.column_stack([n, (x > 1e3) * 1e4, y]), "shear_x takes too few values", "three"),
        (crossed + noise, "shear_x and shear_y are never applied together", "together"),
    ):
        with refused(CalibrationError, "bench.csv: ", *named):
            fit.check_excitation(stress, "bench.csv")
    path[40] = [2e6, -9e5, 9e5]  # a spike
    fit.check_excitation(path, "bench.csv")


def test_every_wiring_is_found():
    channels = sensor_bench(play=0.05).capacitance[:, WIRING]
    channels[7, 2] += 30.0
    for wiring in itertools.permutations(range(4)):
        assert tuple(fit.find_wiring(channels[:, np.argsort(wiring)], load_path())) == wiring


# --- the quality


def calibrated(bench: BenchData, drop_outliers: bool = False):
    return calibrate.calibrate_bench(bench, WIRING, True, drop_outliers)


def true_cycles(bench: BenchData, cycles: int = 18) -> np.ndarray:
    return np.arange(len(bench)) // (len(bench) // cycles)


def test_cycles_are_the_file_s_own_or_found_in_spite_of_noise_and_a_spike():
    bench = sensor_bench()
    noise = np.random.default_rng(0).normal(0.0, 0.01, bench.stress.shape)
    stress = bench.stress + noise * FULL_SCALE
    stress[70] = [1.9e6, 9e5, 0.0]
    found = calibrate.cycle_ids(dataclasses.replace(bench, stress=stress))
    assert (found != true_cycles(bench)).mean() < 0.05 and found.max() == 17
    half = 2 * (true_cycles(bench) > 8)  # all readings of another file were outliers
    split = dataclasses.replace(bench, files=("a", "b", "c"), file=half)
    assert calibrate.cycle_ids(split).max() == 17
    named = dataclasses.replace(bench, cycle=np.arange(len(bench)) % 4)
    ids = calibrate.cycle_ids(join_benches([named, bench]))  # files never share one
    np.testing.assert_array_equal(ids[: len(bench)], named.cycle)
    assert set(ids[len(bench) :]) == set(range(4, 22))


def test_groups_are_the_largest_that_can_be_left_out():
    bench = sensor_bench()
    assert str(calibrate.choose_groups(join_benches([bench] * 2))) == "36 cycles"
    assert str(calibrate.choose_groups(join_benches([bench] * 3))) == "3 files"
    # Of three files, one alone has shear: no file can be left out, but cycles can.
    plain = bench.stress[:, 1:].any(axis=1)
    parts = [bench, bench[~plain], bench[~plain]]
    assert calibrate.choose_groups(join_benches(parts)).unit == "cycle"
    with refused(CalibrationError, "without the cycle that starts at bench.csv line", "repeat"):
        calibrate.choose_groups(sensor_bench(directions=4, repeats=1))


def test_each_group_is_predicted_by_a_fit_to_the_others():
    bench = sensor_bench(play=0.05)
    groups = calibrate.Groups("cycle", true_cycles(bench))
    found = calibrate.cross_validate(bench.capacitance[:, WIRING], bench.stress, groups)
    for group in (0, 7, 17):
        held = groups.ids == group
        other = fit.fit_cluster(bench.capacitance[~held], bench.stress[~held], WIRING, ALL[~held])
        np.testing.assert_allclose(found.shear[group], other.shear, rtol=1e-7)
        expected = fit.predict_stress(other, bench.capacitance[held])
        np.testing.assert_allclose(found.predicted[held], expected, rtol=1e-8, atol=1e-6)


def test_the_intervals_cover_95_percent_even_if_the_errors_of_a_cycle_hang_together():
    cluster, bench = nominal(), exact_bench(steps=10)
    stress, channels = bench.stress, bench.capacitance[:, WIRING]
    groups = calibrate.Groups("cycle", np.arange(len(stress)) // 19)
    for noise_of_cycle in (0.0, 1.0):
        covered = []
        for seed in range(120):
            rng = np.random.default_rng(seed)
            errors = rng.normal(size=stress.shape)
            errors += noise_of_cycle * rng.normal(size=(len(groups), 3))[groups.ids]
            known = stress + 0.005 * FULL_SCALE * errors
            normal, shear = fit.fit_polynomials(channels, known)
            checked = calibrate.cross_validate(channels, known, groups)
            for name, found in (("normal", normal), ("shear", shear)):
                width = calibrate.half_widths(found, getattr(checked, name))
                covered += (np.abs(found - getattr(cluster, name)) <= width).ravel().tolist()
        assert 0.93 < np.mean(covered) < 0.98


def test_play_of_some_width_is_found_as_hysteresis_of_that_width():
    for play in (0.02, 0.05, 0.1):
        found = calibrated(sensor_bench(play=play))
        np.testing.assert_allclose(found.figures["hysteresis"], 100.0 * play, atol=0.7)
    assert (calibrated(sensor_bench()).figures["hysteresis"] < 0.6).all()  # that of the noise
    # A branch leaves out where a stress dwells.
    ramp = np.concatenate([np.zeros(30), np.linspace(0, 1, 20), np.ones(30), np.linspace(1, 0, 20)])
    branches = calibrate.find_branches(bench_of(np.ones((100, 4)), ramp[:, None] * FULL_SCALE))
    assert (branches[32:48] == 1).all() and (branches[82:98] == -1).all()
    assert (branches[:30] == 0).all() and (branches[50:80] == 0).all()


def test_repeatability_is_the_spread_between_cycles():
    bench = sensor_bench(repeats=4)
    cycles = true_cycles(bench, 36)
    branches = calibrate.find_branches(bench)
    variances = []
    for seed in range(20):
        offsets = np.random.default_rng(seed).normal(0.0, 0.02, (36, 3)) * FULL_SCALE
        residuals = [offsets[cycles]] * 2
        found = calibrate.quality_figures(bench, *residuals, branches, cycles)["repeatability"]
        variances.append(found**2)
    np.testing.assert_allclose(np.sqrt(np.mean(variances, axis=0)), 2.0, rtol=0.1)


def spoil(bench: BenchData, seed: int) -> tuple[BenchData, set[int]]:
    """Ten wrong capacitances and ten wrong stresses, and the rows they are in."""
    rng = np.random.default_rng(seed)
    rows = rng.choice(len(bench), 20, replace=False)
    capacitance, stress = bench.capacitance.copy(), bench.stress.copy()
    capacitance[rows[:10], rng.integers(0, 4, 10)] += rng.choice([-2.0, 1.0, 3.0], 10)
    stress[rows[10:], rng.integers(0, 3, 10)] += rng.choice([-20e3, 20e3], 10)
    return dataclasses.replace(bench, capacitance=capacitance, stress=stress), set(rows.tolist())


def test_exactly_the_wrong_readings_are_outliers():
    for seed in range(4):
        bench = sensor_bench(seed, play=0.04)
        spoilt, rows = spoil(bench, seed)
        assert {outlier.row for outlier in fit.find_outliers(spoilt, WIRING)} == rows
        # A block of neighbours that are wrong alike pulls the fit harder.
        capacitance = bench.capacitance.copy()
        capacitance[300:340, 2] += 1.0
        block = fit.find_outliers(dataclasses.replace(bench, capacitance=capacitance), WIRING)
        assert [outlier.row for outlier in block] == [*range(300, 340)]


def test_outliers_stay_in_the_fit_but_not_in_its_range_unless_they_are_dropped():
    bench = sensor_bench(play=0.04)
    clean, (spoilt, rows) = calibrated(bench), spoil(bench, 1)
    kept, dropped = calibrated(spoilt), calibrated(spoilt, drop_outliers=True)
    assert len(kept.bench) == len(dropped.bench) + len(rows)
    squares = ((clean.fitted - bench.stress) ** 2).mean(axis=0)
    np.testing.assert_allclose(clean.training["rmse"] ** 2, squares)
    np.testing.assert_allclose(clean.training["r2"], 1.0 - squares / bench.stress.var(axis=0))
    assert np.ptp(kept.cluster.mean_range) < np.ptp(clean.cluster.mean_range) + 1e-9
    np.testing.assert_array_equal(kept.full_scale, clean.full_scale)
    assert np.abs(kept.cluster.normal / clean.cluster.normal - 1.0).max() > 1e-3
    np.testing.assert_allclose(dropped.cluster.normal, clean.cluster.normal, rtol=1e-3)
    bench.stress[::11, 0] += 30e3
    with refused(CalibrationError, "97 of 1062 readings would be dropped"):
        calibrated(bench, drop_outliers=True)  # a tenth of the readings are no outliers


# --- the drift

REST = exact_bench().capacitance[0]
DRIFT = np.array([0.05, -0.02, 0.08, 0.03])  # [pF] over a run


def test_the_drift_in_stress_is_that_of_the_calibration_and_flagged_above_the_limit():
    """A common drift is read as normal stress by the gain; none of it as shear."""
    for part, flagged in ((-0.95, False), (1.05, True)):
        shift = part * drift.DRIFT_LIMIT / nominal().normal[1]
        before, after = drift.Baseline(0.0, REST), drift.Baseline(9.0, REST + shift)
        found = drift.measure_drift(nominal(), before, after)
        np.testing.assert_allclose(found.capacitance, shift, rtol=1e-9)
        np.testing.assert_allclose(found.stress, [part * drift.DRIFT_LIMIT, 0, 0], atol=1e-6)
        assert found.flagged is flagged


def test_a_linear_drift_is_taken_off_between_the_baselines_and_stays_outside_of_them():
    time = np.linspace(-3.0, 22.0, 101)
    true = exact_bench().capacitance[:101]
    drifted = true + np.outer(np.clip((time - 2.0) / 10.0, 0.0, 1.0), DRIFT)
    # Mounted with an offset, it drifts from there.
    for mounted in (np.zeros(4), np.array([0.2, -0.1, 0.1, 0.3])):
        rest = REST + mounted
        before, after = drift.Baseline(2.0, rest), drift.Baseline(12.0, rest + DRIFT)
        found = drift.correct_drift(drifted + mounted, time, before, after, reference=REST)
        np.testing.assert_allclose(found, true, atol=1e-12)
        found = drift.correct_drift(drifted + mounted, time, before, after)
        np.testing.assert_allclose(found, true + mounted, atol=1e-12)
    # A single baseline corrects to that of the calibration.
    alone = drift.Baseline(0.0, REST + DRIFT)
    found = drift.correct_drift(true + DRIFT, time, alone, reference=REST)
    np.testing.assert_allclose(found, true, atol=1e-12)
    with refused(CalibrationError, "not later", "before first"):
        drift.correct_drift(true, time, before, before)
