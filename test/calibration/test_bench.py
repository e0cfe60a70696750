"""A bench's calibration: the fit and the loads it needs, its quality, the drift of baselines."""

import dataclasses

import numpy as np
import pytest
from support.benches import FULL_SCALE, bench_of, exact_bench, load_path, nominal, sensor_bench
from support.wording import refused

from socket_testbed.calibration import calibrate, drift, fit
from socket_testbed.calibration.bench_data import BenchData, join_benches
from socket_testbed.calibration.model import channel_features
from socket_testbed.errors import CalibrationError

WIRING = nominal().wiring
ALL = np.ones(len(exact_bench()), dtype=bool)


def far_from_balance(rng) -> np.ndarray:
    """Channels of which differences of 5 +- 0.1 pF make the columns nearly parallel."""
    return rng.uniform(-0.1, 0.1, (500, 4)) + np.array([5.0, 10.0, 5.0, 10.0])


@pytest.mark.parametrize(
    ("name", "draw", "rtol"),
    [
        pytest.param("brim_lateral", lambda rng: rng.uniform(5.0, 9.0, (200, 4)), 1e-9, id="near"),
        pytest.param("distal", far_from_balance, 1e-6, id="far-from-balance"),
    ],
)
def test_coefficients_of_exact_data_are_recovered(rng, name, draw, rtol):
    cluster, channels = nominal(name), draw(rng)
    stress = fit.predict_stress(cluster, channels[:, np.argsort(cluster.wiring)])
    normal, shear = fit.fit_polynomials(channels, stress)
    np.testing.assert_allclose(normal, cluster.normal, rtol=rtol)
    np.testing.assert_allclose(shear, cluster.shear, rtol=rtol)


def test_inexact_data_is_fitted_by_least_squares():
    channels, stress = sensor_bench(play=0.05).capacitance[:, WIRING], load_path()
    normal, shear = fit.fit_polynomials(channels, stress)
    mean, x, y = channel_features(channels)
    np.testing.assert_allclose(normal, np.polyfit(mean, stress[:, 0], 1)[::-1], rtol=1e-9)
    terms = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    np.testing.assert_allclose(shear.T, np.linalg.lstsq(terms, stress[:, 1:])[0], rtol=1e-7)


def test_channels_that_share_an_input_are_refused():
    channels = sensor_bench(play=0.05).capacitance[:, WIRING]
    with refused(CalibrationError, "always go together", "input of its own"):
        fit.fit_polynomials(channels[:, [0, 0, 2, 2]], load_path())


@pytest.mark.parametrize("part", ["all", "some"])
def test_the_range_is_that_of_both_differences(part: str):
    bench = exact_bench()
    mean, x, y = channel_features(bench.capacitance[:, WIRING])
    rows = ALL if part == "all" else mean < np.median(mean)
    found = fit.fit_cluster(bench.capacitance, bench.stress, WIRING, rows)
    np.testing.assert_array_equal(found.mean_range, [mean[rows].min(), mean[rows].max()])
    both = [max(x[rows].min(), y[rows].min()), min(x[rows].max(), y[rows].max())]
    np.testing.assert_array_equal(found.difference_range, both)


def crossed() -> np.ndarray:
    """Stresses in one direction at a time, with noise."""
    ramp = np.concatenate([np.linspace(0.0, 1.0, 25), np.linspace(1.0, 0.0, 25)])
    directions = [[1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    path = np.concatenate([np.outer(ramp, FULL_SCALE * direction) for direction in directions])
    return path + np.random.default_rng(5).normal(0.0, 0.005, (250, 3)) * FULL_SCALE


NORMAL, SHEAR_X, SHEAR_Y = load_path().T


@pytest.mark.parametrize(
    ("stress", "named"),
    [
        pytest.param(load_path()[:29], ("29 readings are too few", "several"), id="few-readings"),
        pytest.param(
            load_path() / 1e3, ("normal spans only 60 Pa", "--units normal=UNIT"), id="wrong-unit"
        ),
        pytest.param(
            np.column_stack([NORMAL, 0.5 * SHEAR_Y, SHEAR_Y]),
            ("shear_x always goes with", "stay as"),
            id="one-direction",
        ),
        pytest.param(
            np.column_stack([NORMAL, (SHEAR_X > 1e3) * 1e4, SHEAR_Y]),
            ("shear_x takes too few values", "three"),
            id="two-values",
        ),
        pytest.param(
            crossed(), ("shear_x and shear_y are never applied together", "together"), id="crossed"
        ),
    ],
)
def test_the_stress_that_is_missing_is_named(stress: np.ndarray, named: tuple[str, ...]):
    with refused(CalibrationError, "bench.csv: ", *named):
        fit.check_excitation(stress, "bench.csv")


def test_a_spike_does_not_hide_sufficient_stress():
    path = load_path()
    path[40] = [2e6, -9e5, 9e5]
    fit.check_excitation(path, "bench.csv")


@pytest.mark.parametrize(
    "wiring", [(0, 1, 2, 3), (1, 2, 3, 0), (3, 0, 2, 1), (2, 3, 0, 1)], ids=str
)
def test_a_wiring_is_found(wiring: tuple[int, ...]):
    channels = sensor_bench(play=0.05).capacitance[:, WIRING]
    channels[7, 2] += 30.0
    assert tuple(fit.find_wiring(channels[:, np.argsort(wiring)], load_path())) == wiring


# --- the quality


def calibrated(bench: BenchData, drop_outliers: bool = False):
    return calibrate.calibrate_bench(bench, WIRING, True, drop_outliers)


def true_cycles(bench: BenchData, cycles: int = 18) -> np.ndarray:
    return np.arange(len(bench)) // (len(bench) // cycles)


def test_cycles_are_found_despite_noise_and_spikes():
    bench = sensor_bench()
    noise = np.random.default_rng(0).normal(0.0, 0.01, bench.stress.shape)
    stress = bench.stress + noise * FULL_SCALE
    stress[70] = [1.9e6, 9e5, 0.0]
    found = calibrate.cycle_ids(dataclasses.replace(bench, stress=stress))
    assert (found != true_cycles(bench)).mean() < 0.05 and found.max() == 17


def test_a_file_without_readings_has_no_cycle():
    bench = sensor_bench()
    half = 2 * (true_cycles(bench) > 8)  # all readings of another file were outliers
    split = dataclasses.replace(bench, files=("a", "b", "c"), file=half)
    assert calibrate.cycle_ids(split).max() == 17


def test_files_never_share_a_cycle():
    bench = sensor_bench()
    named = dataclasses.replace(bench, cycle=np.arange(len(bench)) % 4)
    ids = calibrate.cycle_ids(join_benches([named, bench]))
    np.testing.assert_array_equal(ids[: len(bench)], named.cycle)
    assert set(ids[len(bench) :]) == set(range(4, 22))


@pytest.mark.parametrize(
    ("files", "groups"),
    [pytest.param(2, "36 cycles", id="two-files"), pytest.param(3, "3 files", id="three-files")],
)
def test_groups_are_the_largest_to_leave_out(files: int, groups: str):
    assert str(calibrate.choose_groups(join_benches([sensor_bench()] * files))) == groups


def test_a_file_that_alone_has_shear_stays():
    """Of three such files none can be left out, but cycles can."""
    bench = sensor_bench()
    plain = bench.stress[:, 1:].any(axis=1)
    parts = [bench, bench[~plain], bench[~plain]]
    assert calibrate.choose_groups(join_benches(parts)).unit == "cycle"


def test_cycles_that_none_may_miss_are_refused():
    with refused(CalibrationError, "without the cycle that starts at bench.csv line", "repeat"):
        calibrate.choose_groups(sensor_bench(directions=4, repeats=1))


@pytest.fixture(scope="module")
def cross_validated():
    """A bench, its cycles, and what each says of itself by a fit to the others."""
    bench = sensor_bench(play=0.05)
    groups = calibrate.Groups("cycle", true_cycles(bench))
    return (
        bench,
        groups,
        calibrate.cross_validate(bench.capacitance[:, WIRING], bench.stress, groups),
    )


@pytest.mark.parametrize("group", [0, 7, 17])
def test_each_group_is_predicted_by_the_others(cross_validated, group: int):
    bench, groups, found = cross_validated
    held = groups.ids == group
    other = fit.fit_cluster(bench.capacitance[~held], bench.stress[~held], WIRING, ALL[~held])
    np.testing.assert_allclose(found.shear[group], other.shear, rtol=1e-7)
    expected = fit.predict_stress(other, bench.capacitance[held])
    np.testing.assert_allclose(found.predicted[held], expected, rtol=1e-8, atol=1e-6)


@pytest.mark.parametrize(
    "noise_of_cycle", [0.0, 1.0], ids=["independent-errors", "errors-that-hang-together"]
)
def test_the_intervals_cover_95_percent(noise_of_cycle: float):
    cluster, bench = nominal(), exact_bench(steps=10)
    stress, channels = bench.stress, bench.capacitance[:, WIRING]
    groups = calibrate.Groups("cycle", np.arange(len(stress)) // 19)
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


@pytest.mark.parametrize("play", [0.02, 0.05, 0.1])
def test_play_is_found_as_hysteresis(play: float):
    found = calibrated(sensor_bench(play=play))
    np.testing.assert_allclose(found.figures["hysteresis"], 100.0 * play, atol=0.7)


def test_noise_alone_is_little_hysteresis():
    assert (calibrated(sensor_bench()).figures["hysteresis"] < 0.6).all()


def test_branches_leave_out_where_a_stress_dwells():
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


@pytest.mark.parametrize("seed", range(4))
def test_exactly_the_wrong_readings_are_outliers(seed: int):
    spoilt, rows = spoil(sensor_bench(seed, play=0.04), seed)
    assert {outlier.row for outlier in fit.find_outliers(spoilt, WIRING)} == rows


@pytest.mark.parametrize("seed", range(4))
def test_a_block_of_wrong_neighbours_is_found(seed: int):
    """Wrong alike, they pull the fit harder."""
    bench = sensor_bench(seed, play=0.04)
    capacitance = bench.capacitance.copy()
    capacitance[300:340, 2] += 1.0
    block = fit.find_outliers(dataclasses.replace(bench, capacitance=capacitance), WIRING)
    assert [outlier.row for outlier in block] == [*range(300, 340)]


@pytest.fixture(scope="module")
def clean():
    """The calibration of a bench without outliers."""
    return calibrated(sensor_bench(play=0.04))


def test_errors_of_training_are_those_by_hand(clean):
    stress = sensor_bench(play=0.04).stress
    squares = ((clean.fitted - stress) ** 2).mean(axis=0)
    np.testing.assert_allclose(clean.training["rmse"] ** 2, squares)
    np.testing.assert_allclose(clean.training["r2"], 1.0 - squares / stress.var(axis=0))


def test_outliers_are_outside_the_range_they_pull(clean):
    """They stay in the fit unless they are dropped."""
    spoilt, rows = spoil(sensor_bench(play=0.04), 1)
    kept, dropped = calibrated(spoilt), calibrated(spoilt, drop_outliers=True)
    assert len(kept.bench) == len(dropped.bench) + len(rows)
    assert np.ptp(kept.cluster.mean_range) < np.ptp(clean.cluster.mean_range) + 1e-9
    np.testing.assert_array_equal(kept.full_scale, clean.full_scale)
    assert np.abs(kept.cluster.normal / clean.cluster.normal - 1.0).max() > 1e-3
    np.testing.assert_allclose(dropped.cluster.normal, clean.cluster.normal, rtol=1e-3)


def test_a_tenth_of_readings_are_no_outliers():
    bench = sensor_bench(play=0.04)
    bench.stress[::11, 0] += 30e3
    with refused(CalibrationError, "97 of 1062 readings would be dropped"):
        calibrated(bench, drop_outliers=True)


# --- the drift

REST = exact_bench().capacitance[0]
DRIFT = np.array([0.05, -0.02, 0.08, 0.03])  # [pF] over a run


@pytest.mark.parametrize(
    ("part", "flagged"),
    [
        pytest.param(-1.05, True, id="down-beyond"),
        pytest.param(-0.95, False, id="down-within"),
        pytest.param(0.95, False, id="up-within"),
        pytest.param(1.05, True, id="up-beyond"),
    ],
)
def test_a_drift_beyond_the_limit_is_flagged(part: float, flagged: bool):
    """A common drift is read as normal stress by the gain; none of it as shear."""
    shift = part * drift.DRIFT_LIMIT / nominal().normal[1]
    before, after = drift.Baseline(0.0, REST), drift.Baseline(9.0, REST + shift)
    found = drift.measure_drift(nominal(), before, after)
    np.testing.assert_allclose(found.capacitance, shift, rtol=1e-9)
    np.testing.assert_allclose(found.stress, [part * drift.DRIFT_LIMIT, 0, 0], atol=1e-6)
    assert found.flagged is flagged


TIME = np.linspace(-3.0, 22.0, 101)


@pytest.mark.parametrize(
    "mounted", [np.zeros(4), np.array([0.2, -0.1, 0.1, 0.3])], ids=["as-calibrated", "offset"]
)
def test_a_linear_drift_is_taken_off(mounted: np.ndarray):
    """Between the baselines; outside of them it stays. Mounted with an offset, it starts there."""
    true = exact_bench().capacitance[:101]
    drifted = true + np.outer(np.clip((TIME - 2.0) / 10.0, 0.0, 1.0), DRIFT)
    rest = REST + mounted
    before, after = drift.Baseline(2.0, rest), drift.Baseline(12.0, rest + DRIFT)
    found = drift.correct_drift(drifted + mounted, TIME, before, after, reference=REST)
    np.testing.assert_allclose(found, true, atol=1e-12)
    found = drift.correct_drift(drifted + mounted, TIME, before, after)
    np.testing.assert_allclose(found, true + mounted, atol=1e-12)


def test_a_single_baseline_corrects_to_the_calibration_s():
    true = exact_bench().capacitance[:101]
    alone = drift.Baseline(0.0, REST + DRIFT)
    found = drift.correct_drift(true + DRIFT, TIME, alone, reference=REST)
    np.testing.assert_allclose(found, true, atol=1e-12)


def test_baselines_of_one_time_are_refused():
    before = drift.Baseline(2.0, REST)
    with refused(CalibrationError, "not later", "before first"):
        drift.correct_drift(exact_bench().capacitance[:101], TIME, before, before)
