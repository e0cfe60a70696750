"""The quality of a fit: cross-validation, intervals, hysteresis, repeatability, outliers."""

import dataclasses

import numpy as np
from support.benches import FULL_SCALE, bench_of, exact_bench, nominal, sensor_bench
from support.wording import refused

from socket_testbed.calibration.bench_data import BenchData, join_benches
from socket_testbed.calibration.calibrate import (
    Groups,
    calibrate_bench,
    choose_groups,
    cross_validate,
    half_widths,
    hysteresis,
    repeatability,
    stress_errors,
)
from socket_testbed.calibration.drift import cycle_ids, find_branches
from socket_testbed.calibration.fit import design_matrices, find_outliers, fit_polynomials
from socket_testbed.errors import CalibrationError

WIRING = nominal().wiring


def calibrated(bench: BenchData, drop_outliers: bool = False):
    return calibrate_bench(bench, WIRING, True, drop_outliers)


def true_cycles(bench: BenchData, cycles: int = 18) -> np.ndarray:
    return np.arange(len(bench)) // (len(bench) // cycles)


def test_cycles_are_the_file_s_own_or_found_in_spite_of_noise_and_a_spike():
    bench = sensor_bench()
    noise = np.random.default_rng(0).normal(0.0, 0.01, bench.stress.shape)
    stress = bench.stress + noise * FULL_SCALE
    stress[70] = [1.9e6, 9e5, 0.0]
    found = cycle_ids(dataclasses.replace(bench, stress=stress))
    assert (found != true_cycles(bench)).mean() < 0.05 and found.max() == 17
    named = dataclasses.replace(bench, cycle=np.arange(len(bench)) % 4)
    ids = cycle_ids(join_benches([named, bench]))  # files never share one
    np.testing.assert_array_equal(ids[: len(bench)], named.cycle)
    assert set(ids[len(bench) :]) == set(range(4, 22))


def test_groups_are_the_largest_that_can_be_left_out():
    bench = sensor_bench()
    assert str(choose_groups(join_benches([bench] * 2))) == "36 cycles"
    assert str(choose_groups(join_benches([bench] * 3))) == "3 files"
    # Of three files, one alone has shear: no file can be left out, but cycles can.
    plain = bench.stress[:, 1:].any(axis=1)
    parts = [bench, bench[~plain], bench[~plain]]
    assert choose_groups(join_benches(parts)).unit == "cycle"
    rise = np.linspace(0.0, 1.0, 400)  # of a load that goes round and round, but never down
    angle, radius = 6.0 * np.pi * rise, 0.5 + 0.5 * rise
    spiral = np.column_stack([rise, radius * np.cos(angle), radius * np.sin(angle)])
    found = choose_groups(bench_of(np.ones((400, 4)), spiral * FULL_SCALE))
    assert str(found) == "10 blocks"
    assert [rows.tolist() for rows in found.rows] == np.arange(400).reshape(10, 40).tolist()
    with refused(CalibrationError, "without the cycle that starts at bench.csv line", "repeat"):
        choose_groups(sensor_bench(directions=4, repeats=1))


def test_each_group_is_predicted_by_a_fit_to_the_others():
    bench = sensor_bench(play=0.05)
    groups = Groups("cycle", true_cycles(bench))
    channels = bench.capacitance[:, WIRING]
    found = cross_validate(channels, bench.stress, groups)
    for group in (0, 7, 17):
        held = groups.ids == group
        normal, shear = fit_polynomials(channels[~held], bench.stress[~held])
        np.testing.assert_allclose(found.normal[group], normal, rtol=1e-9)
        np.testing.assert_allclose(found.shear[group], shear, rtol=1e-7)
        of_mean, of_differences = design_matrices(channels[held])
        expected = np.column_stack([of_mean @ normal, of_differences @ shear.T])
        np.testing.assert_allclose(found.predicted[held], expected, rtol=1e-8, atol=1e-6)


def test_errors_are_those_of_their_definitions():
    known = np.array([[0.0, 1.0, -4.0], [2.0, -1.0, 4.0]])
    errors = stress_errors(known, known + np.array([[1.0], [-3.0]]), np.array([2.0, 1.0, 4.0]))
    root = np.sqrt(5.0)
    expected = [(root, 2.0, -4.0, 50 * root), (root, 2.0, -4.0, 100 * root)]
    expected.append((root, 2.0, 1 - 5 / 16, 25 * root))
    np.testing.assert_allclose(errors, expected)


def test_the_intervals_cover_95_percent_even_if_the_errors_of_a_cycle_hang_together():
    cluster, bench = nominal(), exact_bench(steps=10)
    stress, channels = bench.stress, bench.capacitance[:, WIRING]
    groups = Groups("cycle", np.arange(len(stress)) // 19)
    for noise_of_cycle in (0.0, 1.0):
        covered = []
        for seed in range(120):
            rng = np.random.default_rng(seed)
            errors = rng.normal(size=stress.shape)
            errors += noise_of_cycle * rng.normal(size=(len(groups), 3))[groups.ids]
            known = stress + 0.005 * FULL_SCALE * errors
            normal, shear = fit_polynomials(channels, known)
            checked = cross_validate(channels, known, groups)
            covered += [
                *(np.abs(normal - cluster.normal) <= half_widths(normal, checked.normal)),
                *(np.abs(shear - cluster.shear) <= half_widths(shear, checked.shear)).ravel(),
            ]
        assert 0.93 < np.mean(covered) < 0.98


def test_play_of_some_width_is_found_as_hysteresis_of_that_width():
    for play in (0.02, 0.05, 0.1):
        found = calibrated(sensor_bench(play=play))
        np.testing.assert_allclose(found.hysteresis, 100.0 * play, atol=0.7)
    assert (calibrated(sensor_bench()).hysteresis < 0.6).all()  # that of the noise
    # A branch leaves out where a stress dwells; a stress that only rises has no hysteresis.
    ramp = np.concatenate([np.zeros(30), np.linspace(0, 1, 20), np.ones(30), np.linspace(1, 0, 20)])
    bench = bench_of(np.ones((100, 4)), ramp[:, None] * FULL_SCALE)
    branches = find_branches(bench)
    assert (branches[32:48] == 1).all() and (branches[82:98] == -1).all()
    assert (branches[:30] == 0).all() and (branches[50:80] == 0).all()
    rows = np.arange(80)
    assert np.isnan(hysteresis(bench[rows], np.ones((80, 3)), branches[rows])).all()


def test_repeatability_is_the_spread_between_cycles():
    bench = sensor_bench(repeats=4)
    cycles = true_cycles(bench, 36)
    branches = find_branches(bench)
    variances = []
    for seed in range(20):
        offsets = np.random.default_rng(seed).normal(0.0, 0.02, (36, 3)) * FULL_SCALE
        variances.append(repeatability(bench, offsets[cycles], branches, cycles) ** 2)
    np.testing.assert_allclose(np.sqrt(np.mean(variances, axis=0)), 2.0, rtol=0.1)
    once = repeatability(bench, bench.stress, branches, np.zeros_like(cycles))
    assert np.isnan(once).all()


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
        assert {outlier.row for outlier in find_outliers(spoilt, WIRING)} == rows
        # A block of neighbours that are wrong alike pulls the fit harder.
        capacitance = bench.capacitance.copy()
        capacitance[300:340, 2] += 1.0
        block = find_outliers(dataclasses.replace(bench, capacitance=capacitance), WIRING)
        assert [outlier.row for outlier in block] == [*range(300, 340)]
    assert block[0].place == "bench.csv line 302"
    rest = bench[np.zeros(3000, dtype=np.int64)]  # many rows at rest make no load an outlier
    noise = np.random.default_rng(0).normal(0.0, 0.002, (3000, 4))
    rest = dataclasses.replace(rest, capacitance=rest.capacitance + noise)
    assert find_outliers(join_benches([rest, bench]), WIRING) == ()


def test_outliers_stay_in_the_fit_but_not_in_its_range_unless_they_are_dropped():
    bench = sensor_bench(play=0.04)
    clean, (spoilt, rows) = calibrated(bench), spoil(bench, 1)
    kept, dropped = calibrated(spoilt), calibrated(spoilt, drop_outliers=True)
    assert not clean.outliers and len(kept.outliers) == len(dropped.outliers) == len(rows)
    assert len(kept.bench) == len(spoilt) and len(dropped.bench) == len(spoilt) - len(rows)
    assert np.ptp(kept.cluster.mean_range) < np.ptp(clean.cluster.mean_range) + 1e-9
    np.testing.assert_array_equal(kept.full_scale, clean.full_scale)
    assert np.abs(kept.cluster.normal / clean.cluster.normal - 1.0).max() > 1e-3
    np.testing.assert_allclose(dropped.cluster.normal, clean.cluster.normal, rtol=1e-3)
    assert not kept.above(100.0) and len(kept.above(0.1)) == 3
    bench.stress[::11, 0] += 30e3
    with refused(CalibrationError, "97 of 1062 readings would be dropped"):
        calibrated(bench, drop_outliers=True)  # a tenth of the readings are no outliers
