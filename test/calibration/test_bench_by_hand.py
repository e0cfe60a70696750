"""A bench's quality by hand: errors, hysteresis, cross-talk, and what its record says."""

from dataclasses import replace

import numpy as np
import pytest
from support.benches import (
    FULL_SCALE,
    bench_of,
    exact_bench,
    load_path,
    nominal,
    sensor_bench,
    write_bench,
)

from socket_testbed.calibration import bench_data, calibrate, drift, fit, model
from socket_testbed.calibration.bench_data import BenchData
from socket_testbed.calibration.calibrate import FALLING, NEITHER, RISING, BenchCalibration
from socket_testbed.errors import CalibrationError
from socket_testbed.samples import Status

WIRING = nominal().wiring
NORMAL, X, Y = range(3)


def bench(stress: list[list[float]]) -> BenchData:
    return bench_of(np.ones((len(stress), 4)), np.array(stress, dtype=float))


# --- errors by stress


def test_errors_are_in_pascal_and_percent() -> None:
    """Residuals 10, -10 and 20 Pa of 0, 100 and 200 Pa, whose variance is 20000 / 3 Pa^2."""
    known = np.outer([0.0, 100.0, 200.0], [1.0, 2.0, 3.0])
    predicted = known + np.outer([10.0, -10.0, 20.0], [1.0, 0.0, 0.0])
    table = calibrate.stress_errors(known, predicted, np.array([200.0, 400.0, 600.0]))
    assert [*table.index] == ["normal", "shear_x", "shear_y"]
    rmse = np.sqrt(200.0)
    assert table.loc["normal"].to_dict() == pytest.approx(
        {"rmse": rmse, "mae": 40.0 / 3.0, "r2": 1.0 - 200.0 / (20000 / 3), "percent": rmse / 2.0}
    )
    assert table.loc["shear_y"].tolist() == [0.0, 0.0, 1.0, 0.0]


# --- quality figures


def figures(
    stress: list[list[float]],
    residual: list[float],
    branch: list[int] | None = None,
    cycle: list[int] | None = None,
    axis: int = NORMAL,
):
    """Quality of a few readings whose residuals are of one stress; their full scale is 100 Pa."""
    count = len(stress)
    fitted = np.zeros((count, 3))
    fitted[:, axis] = residual
    branches = np.zeros((count, 3), dtype=np.int64)
    branches[:, axis] = branch or [NEITHER] * count
    readings = bench(stress)
    assert readings.full_scale.tolist() == [100.0] * 3
    cycles = np.array(cycle or [0] * count)
    return calibrate.quality_figures(readings, fitted, fitted, branches, cycles)


ENDS = [[100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 100.0]]  # full scale of each


def test_hysteresis_is_between_the_branches() -> None:
    """At 50 Pa 3 Pa rising and -1 Pa falling, at 80 Pa 1 and 0: the larger counts, 4 %."""
    stress = [*ENDS, [50, 0, 0], [51, 0, 0], [49, 0, 0], [80, 0, 0], [80, 0, 0]]
    residual = [0.0, 0.0, 0.0, 2.0, 4.0, -1.0, 1.0, 0.0]
    branch = [0, 0, 0, RISING, RISING, FALLING, RISING, FALLING]
    found = figures(stress, residual, branch)
    assert found.loc["normal", "hysteresis"] == pytest.approx(4.0)
    assert np.isnan(found.loc["shear_x", "hysteresis"])


def test_cells_of_a_level_share_by_rows() -> None:
    """At 50 Pa 4 Pa without shear (2 rows each way), 1 Pa under shear (1 row): 9 / 3 Pa."""
    level = [[50, 0, 0]] * 4 + [[50, 30, 0]] * 2
    residual = [0.0] * 3 + [4.0, 4.0, 0.0, 0.0, 1.0, 0.0]
    branch = [0] * 3 + [RISING, RISING, FALLING, FALLING, RISING, FALLING]
    found = figures([*ENDS, *level], residual, branch)
    assert found.loc["normal", "hysteresis"] == pytest.approx(3.0)


def test_repeatability_is_between_cycles() -> None:
    """Cycle means 1 and 3 Pa in a cell, 5 and 5 in another: sqrt((1 + 1) / 2) Pa."""
    stress = [*ENDS, [50, 0, 0], [50, 0, 0], [50, 0, 0], [80, 0, 0], [80, 0, 0]]
    residual = [0.0, 0.0, 0.0, 0.0, 2.0, 3.0, 5.0, 5.0]
    found = figures(stress, residual, None, [0, 0, 0, 0, 0, 1, 0, 1])
    assert found.loc["normal", "repeatability"] == pytest.approx(1.0)


CROSS_TALK = {
    # stress of the reading [Pa], stress whose residual is 7 Pa, does it count?
    "normal under shear": ([0, 30, 0], NORMAL, True),
    "normal under both shears": ([0, 30, -20], NORMAL, True),
    "normal under both": ([30, 30, 0], NORMAL, False),
    "shear under normal": ([30, 0, 0], X, True),
    "shear under its own": ([0, 30, 0], X, False),
    "a little shear": ([30, 1.9, 0], Y, True),
    "too much shear": ([30, 2.1, 0], Y, False),
    "hardly loaded": ([9.9, 0, 0], X, False),
    "just loaded": ([10.1, 0, 0], X, True),
}


@pytest.mark.parametrize("case", CROSS_TALK)
def test_cross_talk_is_under_pure_load(case: str) -> None:
    stress, axis, counts = CROSS_TALK[case]
    found = figures([*ENDS, stress], [0.0, 0.0, 0.0, -7.0], axis=axis)
    name = ("normal", "shear_x", "shear_y")[axis]
    assert found.loc[name, "cross_talk"] == pytest.approx(7.0 if counts else 0.0)


# --- cycles and branches


EXTREMES = {
    "up and down": ([0, 5, 9, 5, 0, 4], 4.0, [0, 2, 4, 5]),
    "down first": ([9, 0, 9], 4.0, [0, 1, 2]),
    "small": ([0, 3, 0, 3.9, 0], 4.0, [0]),
    "at the threshold": ([0, 4, 0], 4.0, [0, 1, 2]),
    "the first of equals": ([0, 9, 9, 0, 0, 9], 4.0, [0, 1, 3, 5]),
    "within a rise": ([0, 5, 3, 9, 0], 4.0, [0, 3, 4]),
}


@pytest.mark.parametrize("case", EXTREMES)
def test_extremes_alternate(case: str) -> None:
    values, threshold, expected = EXTREMES[case]
    assert calibrate.find_extremes(np.array(values, dtype=float), threshold).tolist() == expected


LAST = [0.0, 100.0, 100.0]  # gives every stress a full scale


def test_a_branch_leaves_out_its_ends() -> None:
    """5 % of the travel at either end: 0 to 100 in steps of 4 Pa, and back."""
    ramp = 4.0 * np.arange(26)
    stress = [[each, 0.0, 0.0] for each in [*ramp, *ramp[-2::-1]]]
    found = calibrate.find_branches(bench([*stress, LAST]))[:, NORMAL]
    assert found[:26].tolist() == [0, 0, *[RISING] * 22, 0, 0]
    assert found[26:51].tolist() == [0, *[FALLING] * 22, 0, 0]


@pytest.mark.parametrize(("travel", "moves"), [(19.0, False), (21.0, True)])
def test_a_branch_is_a_fifth_of_full_scale(travel: float, moves: bool) -> None:
    ramp = np.linspace(0.0, travel, 20)
    stress = [[100.0, 0.0, 100.0], *([0.0, each, 0.0] for each in [*ramp, *ramp[::-1]])]
    found = calibrate.find_branches(bench([*stress, [0.0, -100.0, 0.0]]))[:, X]
    assert (found[4:18] == (RISING if moves else NEITHER)).all()


def test_groups_are_counted_in_words() -> None:
    groups = calibrate.Groups("cycle", np.array([1, 0, 1, 2]))
    assert str(groups) == "3 cycles" and [rows.tolist() for rows in groups.rows] == [
        [1],
        [0, 2],
        [3],
    ]


def test_few_cycles_make_ten_blocks() -> None:
    one = sensor_bench(repeats=2)
    named = replace(one, cycle=np.arange(len(one)) % 2)  # two names
    groups = calibrate.choose_groups(named)
    assert str(groups) == "10 blocks"
    assert np.bincount(groups.ids).tolist() == pytest.approx([len(one) / 10] * 10, abs=1)


def test_half_widths_are_jackknifed() -> None:
    """3 fits without a group, off by 1, -2 and 1: sqrt(2 / 3 * 6) times t(0.975, 2) = 4.3027."""
    widths = calibrate.half_widths(np.array([10.0]), np.array([[11.0], [8.0], [11.0]]))
    assert widths == pytest.approx([2.0 * 4.30265])


# --- the limits of a calibration


@pytest.fixture(scope="module")
def calibrated() -> BenchCalibration:
    readings = sensor_bench(play=0.05)
    stress = readings.stress.copy()
    stress[100, 1] += 12e3  # an outlier
    return calibrate.calibrate_bench(replace(readings, stress=stress), WIRING, True, False)


@pytest.mark.parametrize(
    ("gain", "refused"),
    [(99.0, True), (100.0, False), (-5e3, True)],
    ids=["small", "enough", "neg"],
)
def test_a_gain_is_at_least_100(gain: float, refused: bool, calibrated: BenchCalibration) -> None:
    cluster = replace(calibrated.cluster, normal=np.array([0.0, gain]))
    found = replace(calibrated, cluster=cluster)
    if not refused:
        found.require_gain()
        return
    with pytest.raises(CalibrationError, match=f"as {gain:g} Pa/pF, where .* at least 100"):
        found.require_gain()


def test_accuracy_is_by_each_stress(calibrated: BenchCalibration) -> None:
    held_out = calibrated.held_out.copy()
    held_out["percent"], held_out["rmse"] = [1.0, 3.1, 2.9], [600.0, 465.0, 435.0]
    found = replace(calibrated, held_out=held_out)
    assert found.above(3.0) == ("shear_x",) and found.above(2.0) == ("shear_x", "shear_y")
    found.require_accuracy(3.1)
    with pytest.raises(CalibrationError) as refusal:
        found.require_accuracy(2.0)
    assert refusal.value.fact == (
        "the held-out RMSE exceeds 2 % of the full scale: shear_x 3.1 % (465 Pa),"
        " shear_y 2.9 % (435 Pa)"
    )


def test_the_record_says_what_was_found(calibrated: BenchCalibration) -> None:
    found = drift.Drift(np.array([0.0123456, 0.0, 0.0, 0.0]), np.array([1200.0, 0.0, -50.0]))
    record = calibrate.bench_record(calibrated, "2026-01-31", 5.0, True, found)
    assert record["date"] == "2026-01-31" and record["source"] == "bench.csv"
    assert record["readings"] == 1062 and record["forced"] is True
    assert record["limit_percent"] == 5.0 and record["held_out_by"] == "18 cycles"
    assert record["full_scale"] == {"normal": 60e3, "shear_x": 15e3, "shear_y": 15e3}
    assert record["stress_range"] == {
        "normal": [0.0, 60e3],
        "shear_x": [-15e3, 15e3],
        "shear_y": [-15e3, 15e3],
    }
    assert record["outliers"] == ["bench.csv line 102"] and record["outliers_dropped"] is False
    assert record["drift"] == {
        "capacitance": [0.01235, 0.0, 0.0, 0.0],
        "stress": {"normal": 1200.0, "shear_x": 0.0, "shear_y": -50.0},
        "limit": 1000.0,
        "flagged": True,
    }
    for kind in ("held_out", "training"):
        table = getattr(calibrated, kind)
        for name in ("normal", "shear_x", "shear_y"):
            own = record[kind][name]
            assert [*own] == ["rmse", "mae", "r2", "percent"]
            assert own == pytest.approx(table.loc[name].to_dict(), rel=1e-3)
    for name in ("hysteresis", "repeatability", "cross_talk"):
        own = calibrated.figures[name].to_dict()
        stated = {n: np.nan if v is None else v for n, v in record[f"{name}_percent"].items()}
        assert stated == pytest.approx(own, rel=1e-3, nan_ok=True)
    widths = record["interval_95"]
    assert widths["normal"] == pytest.approx(calibrated.normal_half_width.tolist(), rel=1e-3)
    assert widths["shear_y"] == pytest.approx(calibrated.shear_half_width[1].tolist(), rel=1e-3)
    assert widths["shear_x"] == pytest.approx(calibrated.shear_half_width[0].tolist(), rel=1e-3)


def test_a_record_without_drift_has_none(calibrated: BenchCalibration) -> None:
    record = calibrate.bench_record(calibrated, "2026-01-31", 5.0, False, None)
    assert "drift" not in record and record["forced"] is False


def test_an_outlier_is_described(calibrated: BenchCalibration) -> None:
    (outlier,) = calibrated.outliers
    assert (outlier.row, outlier.axis, outlier.place) == (100, X, "bench.csv line 102")
    assert outlier.known == calibrated.bench.stress[100, X]
    assert outlier.fitted == pytest.approx(outlier.known - 12e3, abs=1e3)
    assert np.flatnonzero(~calibrated.sound).tolist() == [100]


# --- bench data


def test_scaled_stresses_are_clipped() -> None:
    """Of 200 rows the 99th percentile is the third largest, 198 Pa."""
    stress = np.zeros((200, 3))
    stress[:, 0], stress[0, 1] = np.arange(1.0, 201.0), 5.0
    found = bench_data.scaled_stress(stress)
    assert found[[98, 197, 199], 0].tolist() == [0.5, 1.0, 1.0]
    assert not found[:, 1].any()
    assert bench_data.scaled_stress(-stress)[[98, 199], 0].tolist() == [-0.5, -1.0]


def test_joined_files_keep_their_places() -> None:
    one, other = bench([[1, 2, 3]] * 2), replace(bench([[4, 5, 6]] * 3), files=("b.csv",))
    both = bench_data.join_benches([one, other, one])
    assert both.files == ("bench.csv", "b.csv", "bench.csv")
    assert both.file.tolist() == [0, 0, 1, 1, 1, 2, 2]
    assert both.place(3) == "b.csv line 3" and both.stress[4].tolist() == [4, 5, 6]


UNITS = {
    # header and cell of one column, expected in Pa, pF or s
    "kPa": ("normal [kPa]", "2", 2000.0),
    "MPa": ("normal [MPa]", "0.5", 500e3),
    "Pa": ("normal [Pa]", "-1000", -1000.0),
    "N": ("normal [N]", "9", 1e4),
    "kN": ("normal [kN]", "0.009", 1e4),
    "fF": ("c0 [fF]", "4000", 4.0),
    "nF": ("c0 [nF]", "0.004", 4.0),
    "counts": ("c0 [counts]", "2097152", 4.0),
}


@pytest.mark.parametrize("case", UNITS)
def test_a_unit_has_its_factor(case: str, tmp_path) -> None:
    title, cell, expected = UNITS[case]
    columns = {n: f"{n} [kPa]" for n in ("normal", "shear_x", "shear_y")}
    columns |= {f"c{n}": f"c{n} [pF]" for n in range(4)}
    name = title.split(" ")[0]
    columns[name] = title
    rows = []
    for value in (cell, "1"):
        own = dict.fromkeys(columns, "1" if value == cell else "2")
        rows.append(own | ({name: cell} if value == cell else {name: "1"}))
    if name == "c0":
        rows[1][name] = str(float(cell) * 1.5)
    path = tmp_path / "bench.csv"
    lines = [columns.values(), *(row.values() for row in rows)]
    path.write_text("\n".join(",".join(line) for line in lines) + "\n")
    found = bench_data.read_bench(path, {}, {}, area=9e-4)
    values = found.stress[0, 0] if name == "normal" else found.capacitance[0, 0]
    assert values == pytest.approx(expected)


@pytest.mark.parametrize(
    ("unit", "steps", "other"),
    [("s", 1e-4, "ms"), ("ms", 0.5, "s"), ("s", 61.0, "ms"), ("ms", 61e3, "s")],
)
def test_implausible_steps_have_another_unit(unit: str, steps: float, other: str, tmp_path) -> None:
    """1 ms to 60 s between readings."""
    path = tmp_path / "bench.csv"
    write_bench(path, replace(exact_bench(), time=steps * np.arange(len(exact_bench()))))
    path.write_text(path.read_text().replace("time [s]", f"time [{unit}]"))
    with pytest.raises(CalibrationError) as refusal:
        bench_data.read_bench(path, {}, {})
    assert f"has steps of {steps:.3g} {unit} in the median" in refusal.value.fact
    assert f"--units time={other} if these are {other}" in refusal.value.hint


# --- excitation and baselines


def test_30_readings_are_enough() -> None:
    stress = load_path(steps=4)[::2]
    fit.check_excitation(stress[:63], "bench.csv")
    with pytest.raises(CalibrationError, match="29 readings are too few for 14 coefficients"):
        fit.check_excitation(stress[:29], "bench.csv")


@pytest.mark.parametrize(("axis", "span"), [(0, 1000.0), (1, 200.0), (2, 200.0)])
def test_a_stress_spans_enough(axis: int, span: float) -> None:
    stress = load_path()
    stress[:, axis] *= 1.01 * span / np.ptp(stress[:, axis])
    fit.check_excitation(stress, "bench.csv")
    stress[:, axis] *= 0.98
    name = ("normal", "shear_x", "shear_y")[axis]
    with pytest.raises(CalibrationError, match=rf"{name} spans only .* less than {span:g} Pa"):
        fit.check_excitation(stress, "bench.csv")


def test_an_input_that_does_not_respond_is_named() -> None:
    readings = sensor_bench()
    noise = np.random.default_rng(1).normal(0.0, 0.3, readings.capacitance.shape)
    flat = readings.capacitance.mean(axis=1, keepdims=True) + noise
    with pytest.raises(CalibrationError, match="no input responds to shear_x, at most 15000 Pa"):
        fit.require_wiring(replace(readings, capacitance=flat), WIRING)


@pytest.fixture(scope="module")
def sound() -> tuple[BenchData, BenchCalibration]:
    """351 sound readings, and their calibration."""
    readings = sensor_bench(repeats=3)
    readings = readings[np.linspace(0, len(readings) - 1, 351).astype(int)]
    found = calibrate.calibrate_bench(readings, WIRING, wiring_stated=False, drop_outliers=False)
    return readings, found


@pytest.mark.parametrize("inputs", [[0], [1, 2], [0, 1, 2, 3]], ids=["one", "two", "all"])
@pytest.mark.parametrize("value", [0.02, 16.0 - 2.0**-19, 95.0], ids=["low", "rail", "high"])
def test_six_glitches_do_not_hide_the_response(sound, inputs: list[int], value: float) -> None:
    """The wiring is that of the sound readings, and so are the coefficients without them."""
    readings, expected = sound
    rows = np.random.default_rng(0).choice(351, 6, replace=False)
    capacitance = readings.capacitance.copy()
    capacitance[np.ix_(rows, inputs)] = value
    glitched = replace(readings, capacitance=capacitance)
    found = calibrate.calibrate_bench(glitched, WIRING, wiring_stated=False, drop_outliers=True)
    assert sorted(outlier.row for outlier in found.outliers) == sorted(rows.tolist())
    np.testing.assert_allclose(found.cluster.normal, expected.cluster.normal, rtol=1e-3)


def test_another_wiring_is_stated() -> None:
    readings = sensor_bench()
    fit.require_wiring(readings, WIRING)
    with pytest.raises(CalibrationError) as refusal:
        fit.require_wiring(readings, WIRING[[1, 0, 3, 2]])
    right = " ".join(map(str, WIRING.tolist()))
    assert refusal.value.hint.startswith(f"give --wiring {right}, or --wiring ")


def test_a_baseline_is_the_median() -> None:
    """Without the reading that is not complete and in spite of a spike."""
    readings = np.array([[1.0, 2, 3, 4], [1.2, 2, 3, 4], [9.0, 2, 3, 4], [np.nan, 2, 3, 4]])
    found = drift.average_baseline(7.0, readings, "rest.csv")
    assert found.time == 7.0 and found.capacitance.tolist() == [1.2, 2.0, 3.0, 4.0]
    with pytest.raises(CalibrationError, match=r"rest\.csv: 2 complete readings are too few"):
        drift.average_baseline(7.0, readings[1:], "rest.csv")


@pytest.mark.parametrize(
    ("stress", "flagged"),
    [(999.0, False), (1001.0, True), (-1001.0, True)],
    ids=["-", "up", "down"],
)
def test_drift_is_flagged_from_one_kilopascal(stress: float, flagged: bool) -> None:
    assert drift.Drift(np.zeros(4), np.array([0.0, stress, 0.0])).flagged is flagged


def test_a_run_of_several_files_is_not_corrected() -> None:
    one = exact_bench()
    before, after = drift.Baseline(0.0, np.zeros(4)), drift.Baseline(100.0, np.full(4, 0.1))
    found = drift.correct_bench(one, before, after)
    lifted = one.capacitance[500] - found.capacitance[500]  # at 50 s
    np.testing.assert_allclose(lifted, 0.05)
    with pytest.raises(CalibrationError, match="2 bench files cannot share the drift"):
        drift.correct_bench(bench_data.join_benches([one, one]), before, after)
    with pytest.raises(CalibrationError, match=r"bench\.csv: has no time"):
        drift.correct_bench(replace(one, time=np.full(len(one), np.nan)), before, after)


# --- the calibration


def test_features_are_of_the_channels_places() -> None:
    """Channels (-x,+y), (+x,+y), (-x,-y), (+x,-y): x is right less left, y is upper less lower."""
    mean, x, y = model.channel_features(np.array([1.0, 4.0, 2.0, 9.0]))
    assert (mean, x, y) == (4.0, 5.0, -3.0)
    many = model.channel_features(np.tile([1.0, 4.0, 2.0, 9.0], (3, 2, 1)))
    assert [values.tolist() for values in many] == [[[each] * 2] * 3 for each in (4.0, 5.0, -3.0)]
    terms = model.shear_terms(np.array(2.0), np.array(3.0))
    assert terms.tolist() == [1.0, 2.0, 3.0, 4.0, 6.0, 9.0]
    assert model.SHEAR_TERMS == ("1", "dx", "dy", "dx^2", "dx dy", "dy^2")


# Mean and difference along x [pF], and the status: 0 within the ranges, 3 outside
AT_THE_ENDS = {
    "lowest mean": (4.0, 0.0, Status.OK),
    "mean too low": (3.9, 0.0, Status.OUT_OF_RANGE),
    "highest mean": (6.0, 0.0, Status.OK),
    "mean too high": (6.1, 0.0, Status.OUT_OF_RANGE),
    "highest difference": (5.0, 0.5, Status.OK),
    "difference too high": (5.0, 0.6, Status.OUT_OF_RANGE),
    "lowest difference": (5.0, -1.0, Status.OK),
    "difference too low": (5.0, -1.1, Status.OUT_OF_RANGE),
}


@pytest.mark.parametrize("case", AT_THE_ENDS)
def test_ranges_include_their_ends(case: str) -> None:
    """The mean from 4 to 6 pF, both differences from -1 to 0.5 pF."""
    mean, dx, expected = AT_THE_ENDS[case]
    cluster = replace(
        nominal(), mean_range=np.array([4.0, 6.0]), difference_range=np.array([-1.0, 0.5])
    )
    channels = mean + 0.5 * dx * np.array([-1.0, 1.0, -1.0, 1.0])
    inputs = channels[np.argsort(cluster.wiring)]
    assert cluster.apply(inputs, np.zeros(4, np.uint8))[1] == expected


def test_a_calibration_has_an_origin() -> None:
    found = model.Calibration({"distal": nominal()}, "2026-01-31", "bench 7")
    assert found.origin == "bench 7 (2026-01-31)"
    assert FULL_SCALE[0] == 60e3
