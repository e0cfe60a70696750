"""Whole lines that refuse bench data, a drift or a calibration: file, line, number and hint."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from support.benches import exact_bench

from socket_testbed.calibration import calibrate, drift, fit, model
from socket_testbed.calibration.bench_data import STRESSES, BenchData, join_benches, read_bench
from socket_testbed.calibration.calibrate import BenchCalibration
from socket_testbed.errors import TestbedError


def line(call: Callable[[], object]) -> str:
    """The error of a call."""
    with pytest.raises(TestbedError) as found:
        call()
    return str(found.value)


# --- a bench file

TITLES = ["time [s]", *(f"{name} [kPa]" for name in STRESSES), *(f"c{n} [pF]" for n in range(4))]
ROWS = [[f"{0.1 * k:.1f}", f"{k}", f"{k % 3}", f"{k % 2}", "5", "6", "7", "8"] for k in range(6)]
for k, row in enumerate(ROWS):
    row[4:] = [f"{5 + n + 0.1 * k:.1f}" for n in range(4)]


def table(
    titles: list[str] = TITLES, cell: tuple[int, int, str] | None = None, separator: str = ","
) -> str:
    """The bench file, with one cell changed: row, column and text."""
    rows = [[*row] for row in ROWS]
    if cell:
        rows[cell[0]][cell[1]] = cell[2]
    return "".join(separator.join(row) + "\n" for row in [titles, *rows])


def renamed(column: int, title: str) -> list[str]:
    return [*TITLES[:column], title, *TITLES[column + 1 :]]


FILES = {
    "no rows": (
        ",".join(TITLES),
        "{path}: has no data rows: give a header, and below it one row per reading",
    ),
    "only units": (
        "normal,c0\nkPa,pF\n",
        "{path}: has no data rows: give a row per reading below the units",
    ),
    "ragged": (
        table() + "1,2,3,4,5,6,7,8,9\n",
        "{path}: Expected 8 fields in line 8, saw 9: give every row as many fields as the header;"
        " separate them with ';' if the numbers have decimal commas",
    ),
    "no column": (
        table(renamed(7, "other [pF]")),
        "bench.csv: no column for c3 (its header has 'time [s]', 'normal [kPa]', 'shear_x [kPa]',"
        " 'shear_y [kPa]', 'c0 [pF]', 'c1 [pF]', 'c2 [pF]', 'other [pF]'): name it with --columns"
        " c3=NAME",
    ),
    "two columns": (
        table(renamed(0, "C1 [pF]")),
        "bench.csv: c1 is in 2 columns: 'C1 [pF]', 'c1 [pF]': rename all but one, or name it with"
        " --columns c1=NAME",
    ),
    "no unit": (
        table(renamed(1, "normal")),
        "bench.csv: 'normal' has no unit: write it into the header, such as 'normal [Pa]', or give"
        " --units normal=Pa",
    ),
    "no unit of an input": (
        table(renamed(4, "c0")),
        "bench.csv: 'c0' has no unit: write it into the header, such as 'c0 [pF]', or give --units"
        " c0=pF",
    ),
    "unknown unit": (
        table(renamed(1, "normal [psi]")),
        "bench.csv: 'normal [psi]' is in 'psi', not one of the units of normal: name one of Pa,"
        " kPa, MPa, N, kN in the header or with --units normal=UNIT",
    ),
    "millipascals": (
        table(renamed(1, "normal [mPa]")),
        "bench.csv: 'normal [mPa]' is in 'mPa', not one of the units of normal: name one of Pa,"
        " kPa, MPa, N, kN in the header or with --units normal=UNIT",
    ),
    "force": (
        table(renamed(1, "normal [N]")),
        "bench.csv: 'normal [N]' is a force in N: give the area it acts on with --area, in m^2, or"
        " with --geometry",
    ),
    "empty cell": (
        table(cell=(2, 5, "")),
        "bench.csv: 'c1 [pF]' is empty in line 4: fill the cell or its line",
    ),
    "no number": (
        table(cell=(3, 2, "2 kPa")),
        "bench.csv: 'shear_x [kPa]' holds '2 kPa' in line 5, which is not a number: give a number"
        " there; units belong in the header",
    ),
    "outside": (
        table(cell=(1, 1, "2001")),
        "bench.csv: 'normal [kPa]' is 2001 kPa in line 3, outside -1 to 2000 kPa: check the value,"
        " its sign and its unit; --units normal=UNIT names another",
    ),
    "input outside": (
        table(cell=(1, 6, "100.5")),
        "bench.csv: 'c2 [pF]' is 100.5 pF in line 3, outside 0.01 to 100 pF: check the value, its"
        " sign and its unit; --units c2=UNIT names another",
    ),
    "shear below": (
        table(cell=(1, 3, "-1001")),
        "bench.csv: 'shear_y [kPa]' is -1001 kPa in line 3, outside -1000 to 1000 kPa: check the"
        " value, its sign and its unit; --units shear_y=UNIT names another",
    ),
    "shear above": (
        table(cell=(1, 2, "1001")),
        "bench.csv: 'shear_x [kPa]' is 1001 kPa in line 3, outside -1000 to 1000 kPa: check the"
        " value, its sign and its unit; --units shear_x=UNIT names another",
    ),
    "constant input": (
        re.sub(r",[\d.]+\n", ",8.5\n", table()),
        "bench.csv: 'c3 [pF]' is 8.5 pF in every row: check the wire of this input, or name its"
        " column",
    ),
    "time stands": (
        table(cell=(4, 0, "0.3")),
        "bench.csv: 'time [s]' does not increase at line 6: give the readings in order, and each"
        " run in a separate file",
    ),
    "time in minutes": (
        re.sub(r"^0\.(\d)", r"\g<1>00", table(), flags=re.MULTILINE),
        "bench.csv: 'time [s]' has steps of 100 s in the median, implausible for a bench: correct"
        " the header, or give --units time=ms if these are ms",
    ),
}


@pytest.mark.parametrize("case", FILES)
def test_a_bench_file_is_refused_with_this_line(case: str, tmp_path: Path) -> None:
    text, expected = FILES[case]
    path = tmp_path / "bench.csv"
    path.write_text(text)
    assert line(lambda: read_bench(path, {}, {})) == expected.format(path=path)


LIMITS = [("normal", "-1"), ("normal", "2000"), ("shear_x", "-1000"), ("shear_y", "1000")]


@pytest.mark.parametrize(("name", "value"), LIMITS, ids=["rest", "normal", "x", "y"])
def test_a_stress_at_its_limit_is_read(name: str, value: str, tmp_path: Path) -> None:
    path, column = tmp_path / "bench.csv", 1 + STRESSES.index(name)
    path.write_text(table(cell=(2, column, value)))
    found = read_bench(path, {}, {})
    assert found.stress[2, column - 1] == 1e3 * float(value)
    assert found.place(2) == "bench.csv line 4"


# --- excitation and wiring


def stresses(count: int = 60) -> np.ndarray:
    """Three independent stresses of several levels [Pa], (count, 3)."""
    rng = np.random.default_rng(1)
    return rng.uniform([0.0, -15e3, -15e3], [60e3, 15e3, 15e3], (count, 3))


def levels(axis: int) -> np.ndarray:
    """The stresses, one of which takes two values only."""
    found = stresses()
    found[:, axis] = np.where(found[:, axis] > 0.0, 12e3, -12e3)
    return found


def one_at_a_time() -> np.ndarray:
    """Shear along x in one half, along y in the other."""
    found = stresses()
    found[:30, 2], found[30:, 1] = 0.0, 0.0
    return found


def together() -> np.ndarray:
    """Shear along y is always half of that along x."""
    found = stresses()
    found[:, 2] = 0.5 * found[:, 1]
    return found


def seldom() -> np.ndarray:
    """Shear along x in one reading of 300."""
    found = stresses(300)
    found[:, 1] = np.where(np.arange(300) == 7, 12e3, 0.0)
    return found


LACKS = {
    "few": (
        stresses(29),
        "29 readings are too few for 14 coefficients: give 30 or more; several bench files may be"
        " given",
    ),
    "small": (
        stresses() * [0.01, 1.0, 1.0],
        "normal spans only {span:.3g} Pa, less than 1000 Pa: apply normal, or give its true unit"
        " with --units normal=UNIT",
    ),
    "seldom": (
        seldom(),
        "shear_x hardly changes: apply shear_x in more of the readings",
    ),
    "together": (
        together(),
        "shear_x always goes with normal and shear_y: also apply shear_x while the others stay as"
        " they are",
    ),
    "two levels of x": (
        levels(1),
        "shear_x takes too few values for its square: apply at least three levels of shear_x",
    ),
    "two levels of y": (
        levels(2),
        "shear_y takes too few values for its square: apply at least three levels of shear_y",
    ),
    "never both": (
        one_at_a_time(),
        "shear_x and shear_y are never applied together: also apply them together, with equal and"
        " with opposite signs",
    ),
}


@pytest.mark.parametrize("case", LACKS)
def test_what_a_bench_lacks_has_this_line(case: str) -> None:
    stress, expected = LACKS[case]
    spelled = expected.format(span=np.ptp(stress[:, 0]))
    assert line(lambda: fit.check_excitation(stress, "bench.csv")) == f"bench.csv: {spelled}"


def test_sufficient_stresses_are_accepted() -> None:
    fit.check_excitation(stresses(30), "bench.csv")


def test_channels_on_one_input_have_this_line() -> None:
    inputs = np.random.default_rng(1).uniform(4.0, 8.0, (60, 4))
    inputs[:, 1] = inputs[:, 0]
    inputs[:, 3] = inputs[:, 2]
    assert line(lambda: fit.fit_polynomials(inputs, stresses())) == (
        "the four capacitances do not determine the coefficients: some of them always go together:"
        " check that each of c0 to c3 is an input of its own"
    )


def test_differences_without_a_common_range_have_this_line() -> None:
    """Along x 1.0 to 1.5 pF, along y -0.8 to -0.25 pF."""
    x, y = np.random.default_rng(1).uniform([1.0, -0.8], [1.5, -0.25], (60, 2)).T
    x[:2], y[:2] = (1.0, 1.5), (-0.8, -0.25)
    inputs = 6.0 + 0.5 * np.column_stack([y - x, y + x, -y - x, x - y])
    inputs += np.random.default_rng(2).uniform(-1.0, 1.0, (60, 1))
    every = np.ones(60, dtype=bool)
    assert line(lambda: fit.fit_cluster(inputs, stresses(), np.arange(4), every)) == (
        "the differences along x (1 to 1.5 pF) and y (-0.8 to -0.25 pF) share no range: load the"
        " cluster along both directions and to both sides"
    )


def bench(inputs: np.ndarray, stress: np.ndarray) -> BenchData:
    return replace(
        exact_bench(), capacitance=inputs, stress=stress, line=np.arange(len(stress)) + 2,
        file=np.zeros(len(stress), dtype=np.int64), time=0.1 * np.arange(len(stress)),
        cycle=np.full(len(stress), -1),
    )  # fmt: skip


def felt(stress: np.ndarray, wiring: list[int]) -> np.ndarray:
    """Inputs (N, 4) [pF] of channels that a shear raises on its own side by 1 pF per 10 kPa."""
    mean, x, y = 6.0 + 1e-5 * stress[:, 0], 1e-4 * stress[:, 1], 1e-4 * stress[:, 2]
    channels = np.column_stack([mean - x + y, mean + x + y, mean - x - y, mean + x - y])
    inputs = np.empty_like(channels)
    inputs[:, wiring] = channels
    return inputs


def test_another_wiring_has_this_line() -> None:
    found = bench(felt(stresses(), [2, 0, 3, 1]), stresses())
    fit.require_wiring(found, np.array([2, 0, 3, 1]))
    assert line(lambda: fit.require_wiring(found, np.arange(4))) == (
        "bench.csv: the shear stresses do not raise the channels on their own side with the wiring"
        " 0 1 2 3, but do with 2 0 3 1: give --wiring 2 0 3 1, or --wiring 0 1 2 3 to keep it"
    )


@pytest.mark.parametrize(("axis", "name"), [(1, "shear_x"), (2, "shear_y")], ids=["x", "y"])
def test_an_input_without_response_has_this_line(axis: int, name: str) -> None:
    stress = stresses()
    stress[0, axis] = -15e3  # the largest
    silent = stress.copy()
    silent[:, axis] = 0.0
    noise = np.random.default_rng(3).normal(0.0, 0.05, (60, 4))
    found = bench(felt(silent, [0, 1, 2, 3]) + noise, stress)
    assert line(lambda: fit.require_wiring(found, np.arange(4))) == (
        f"bench.csv: no input responds to {name}, at most 15000 Pa, above the noise: apply {name}"
        " on the bench; the wiring and its coefficients need it"
    )


# --- the fit's quality


def judged(**changes: Any) -> BenchCalibration:
    """A calibration with these errors on held-out data."""
    percent, rmse = [10.04, 12.345, 3.0], [6024.4, 1851.8, 450.0]
    held_out = pd.DataFrame({"rmse": rmse, "percent": percent}, index=[*STRESSES])
    made = BenchCalibration.__new__(BenchCalibration)
    cluster = SimpleNamespace(normal=np.array([0.0, 99.0]))
    vars(made).update({"held_out": held_out, "cluster": cluster} | changes)
    return made


def test_an_error_above_the_limit_has_this_line() -> None:
    assert line(lambda: judged().require_accuracy(10.0)) == (
        "the held-out RMSE exceeds 10 % of the full scale: normal 10.0 % (6024 Pa), shear_x 12.3 %"
        " (1852 Pa): see --figure; --drop-outliers may help, and --force writes it anyway"
    )
    assert judged().above(10.04) == ("shear_x",)
    judged().require_accuracy(12.345)


def test_a_small_gain_has_this_line() -> None:
    assert line(judged().require_gain) == (
        "the gain of the normal stress comes out as 99 Pa/pF, where compression should give at"
        " least 100: give compression as positive normal stress, and check units and outliers"
    )
    judged(cluster=SimpleNamespace(normal=np.array([0.0, 100.0]))).require_gain()


def test_many_outliers_have_this_line(monkeypatch: pytest.MonkeyPatch) -> None:
    stress = stresses(100)
    found = bench(felt(stress, [0, 1, 2, 3]), stress)
    outliers = tuple(fit.Outlier(k, f"bench.csv line {k + 2}", 0, 0.0, 1.0) for k in range(6))
    monkeypatch.setattr(fit, "find_outliers", lambda bench, wiring: outliers)
    assert line(lambda: calibrate.calibrate_bench(found, np.arange(4), True, True)) == (
        "6 of 100 readings would be dropped, more than 5 %: these are not outliers: inspect them"
        " with --figure, and omit --drop-outliers"
    )
    monkeypatch.setattr(fit, "find_outliers", lambda bench, wiring: outliers[:5])
    made = calibrate.calibrate_bench(found, np.arange(4), True, True)
    assert len(made.bench) == 95 and made.dropped and made.bench.line[0] == 7


@pytest.mark.parametrize(("wrong", "found"), [(2.0e3, 0), (4.0e3, 1)], ids=["within 5 %", "beyond"])
def test_a_small_residual_is_no_outlier(wrong: float, found: int) -> None:
    """Without noise every deviation would be: 5 % of 60 kPa are 3 kPa, normal."""
    stress = stresses(200)
    stress[:2, 0] = 0.0, 60e3
    readings = bench(felt(stress, [0, 1, 2, 3]), stress)
    readings.stress[50, 0] = 30e3 + wrong
    readings.capacitance[50] = felt(np.array([[30e3, *stress[50, 1:]]]), [0, 1, 2, 3])
    outliers = fit.find_outliers(readings, np.arange(4))
    assert len(outliers) == found
    for outlier in outliers:
        assert (outlier.row, outlier.place, outlier.axis) == (50, "bench.csv line 52", 0)
        assert (outlier.known, outlier.fitted) == (34e3, pytest.approx(30e3))


def test_a_cycle_that_must_stay_has_this_line() -> None:
    """Only the second of three has shear along x; its first reading is in line 22."""
    stress = stresses()
    stress[:20, 1], stress[40:, 1] = 0.0, 0.0
    found = replace(bench(felt(stress, [0, 1, 2, 3]), stress), cycle=np.arange(60) // 20)
    assert line(lambda: calibrate.choose_groups(found)) == (
        "without the cycle that starts at bench.csv line 22, shear_x hardly changes, so the fit"
        " cannot be checked on unseen data: repeat the loading of this part at least once"
    )


# --- drift


BEFORE, AFTER = drift.Baseline(2.5, np.zeros(4)), drift.Baseline(2.0, np.zeros(4))

DRIFTS = {
    "few readings": (
        lambda: drift.average_baseline(0.0, np.ones((2, 4)), "rest.csv"),
        "rest.csv: 2 complete readings are too few for a baseline: read the unloaded cluster 3"
        " times or more",
    ),
    "exchanged": (
        lambda: drift.correct_drift(np.ones((3, 4)), np.arange(3.0), BEFORE, AFTER),
        "the baseline after (2 s) is not later than the one before (2.5 s): give the unloaded"
        " readings before first, those after second",
    ),
    "two files": (
        lambda: drift.correct_bench(join_benches([exact_bench(), exact_bench()]), AFTER, BEFORE),
        "2 bench files cannot share the drift between two baselines: give the one file that was"
        " read between them, or the baseline before only",
    ),
    "no time": (
        lambda: drift.correct_bench(
            replace(exact_bench(), time=np.full(len(exact_bench()), np.nan)), AFTER, BEFORE
        ),
        "bench.csv: has no time, which the drift correction needs: add a column 'time [s]', or"
        " give the baseline before only",
    ),
}


@pytest.mark.parametrize("case", DRIFTS)
def test_a_drift_is_refused_with_this_line(case: str) -> None:
    call, expected = DRIFTS[case]
    assert line(call) == expected


def test_three_readings_make_a_baseline() -> None:
    readings = np.array([[1.0, 2, 3, 4], [1.5, 2, 3, 4], [3.0, 2, 3, 9]])
    found = drift.average_baseline(7.0, readings, "rest.csv")
    assert found.capacitance.tolist() == [1.5, 2.0, 3.0, 4.0]


# --- calibration.yaml

CALIBRATION = """\
date: 2026-01-31
source: the bench
clusters:
  brim:
    normal: [-1000, 20000]
    shear_x: [1, 2, 3, 4, 5, 6]
    shear_y: [7, 8, 9, 10, 11, 12]
    mean_range: [4, 12]
    difference_range: [-0.5, 0.25]
    wiring: [2, 3, 0, 1]
"""

DOCUMENTS = {
    "wiring": (
        ("[2, 3, 0, 1]", "[2, 3, 0, 0]"),
        "wiring is [2, 3, 0, 0]: give each of 0, 1, 2, 3 once",
    ),
    "mean range": (("[4, 12]", "[12, 4]"), "mean_range is [12, 4]: give [low, high] in pF"),
    "empty range": (
        ("[-0.5, 0.25]", "[0.25, 0.25]"),
        "difference_range is [0.25, 0.25]: give [low, high] in pF",
    ),
    "gain": (
        ("20000", "99.5"),
        "the gain of normal is 99.5 Pa/pF: give [offset in Pa, gain in Pa/pF], compression"
        " positive",
    ),
}


@pytest.mark.parametrize("case", DOCUMENTS)
def test_a_wrong_calibration_has_this_line(case: str, tmp_path: Path) -> None:
    change, expected = DOCUMENTS[case]
    path = tmp_path / "calibration.yaml"
    path.write_text(CALIBRATION.replace(*change))
    assert line(lambda: model.read_calibration(path)) == f"{path}: clusters: brim: {expected}"


def test_a_calibration_file_explains_its_entries(tmp_path: Path) -> None:
    """A file written by hand comes back with the same entries, below its explanation."""
    first, second = tmp_path / "first.yaml", tmp_path / "second.yaml"
    first.write_text(CALIBRATION)
    model.write_calibration(model.read_calibration(first), second)
    text = second.read_text()
    assert text.splitlines()[:9] == [
        "# Calibration of the clusters, four capacitances to stress.",
        "# normal: offset [Pa] and gain [Pa/pF] over the mean of the four channels.",
        "# shear_x, shear_y: coefficients of 1, dx, dy, dx^2, dx dy, dy^2 [Pa, Pa/pF, Pa/pF^2] with"
        " dx, dy",
        "#   the differences of the channel pairs along x and y [pF].",
        "# mean_range, difference_range: the calibrated ranges [pF].",
        "# wiring: the converter's input of each channel (-x,+y), (+x,+y), (-x,-y), (+x,-y).",
        "# baseline: the inputs of the unloaded cluster on the bench [pF].",
        "# bench: origin and quality of a cluster's coefficients.",
        "date: '2026-01-31'",
    ]
    own = model.read_calibration(second).clusters["brim"]
    assert own.normal.tolist() == [-1000.0, 20000.0]
    assert own.shear.tolist() == [[1, 2, 3, 4, 5, 6], [7, 8, 9, 10, 11, 12]]
    assert own.mean_range.tolist() == [4.0, 12.0]
    assert own.difference_range.tolist() == [-0.5, 0.25]
    assert own.wiring.tolist() == [2, 3, 0, 1]


def test_a_missing_cluster_has_this_line() -> None:
    found = model.Calibration({}, "today", "nowhere")
    assert line(lambda: found.require(["mid", "brim"], "the socket")) == (
        "the calibration has no cluster mid, brim of the socket (it has none): give the"
        " calibration.yaml of these clusters"
    )
