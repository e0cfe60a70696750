"""The verb `calibrate` on a bench whose coefficients are known, and the calibration it leaves.

    normal  = -100 kPa + 20 kPa/pF mean
    shear_x = 100 + 30e3 dx + 2e3 dy + 5e3 dx^2 + 3e3 dx dy + 1e3 dy^2  [Pa, pF]
    shear_y = -50 + 1e3 dx + 25e3 dy + 4e3 dx^2 - 2e3 dx dy + 6e3 dy^2

The mean goes from 5 to 8 pF, dx from -0.5 to 0.6 pF, dy from -0.4 to 0.7 pF, in three cycles.
"""

import io
import itertools
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from support import verbs

import socket_testbed as st
from socket_testbed.__main__ import run
from socket_testbed.api import CalibratedCluster
from socket_testbed.calibration.bench_data import BenchData
from socket_testbed.calibration.calibrate import (
    FALLING,
    NEITHER,
    RISING,
    quality_figures,
    stress_errors,
)
from socket_testbed.calibration.drift import Baseline, Drift, correct_drift
from socket_testbed.calibration.model import ClusterCalibration, read_calibration
from socket_testbed.errors import CalibrationError
from socket_testbed.samples import Status

NORMAL = [-100e3, 20e3]
SHEAR_X = [100.0, 30e3, 2e3, 5e3, 3e3, 1e3]
SHEAR_Y = [-50.0, 1e3, 25e3, 4e3, -2e3, 6e3]
WIRING = (2, 0, 3, 1)  # the input of each channel
STRESSES = ("normal", "shear_x", "shear_y")
MEAN = np.array([5.0, 6.0, 8.0])
DX = np.array([-0.5, -0.2, 0.1, 0.6])
DY = np.array([-0.4, 0.0, 0.3, 0.7])


def grid() -> np.ndarray:
    """Mean, dx and dy [pF] of a cycle up and down, thrice, (288, 3)."""
    up = np.array([*itertools.product(MEAN, DX, DY)])
    return np.tile(np.vstack([up, up[::-1]]), (3, 1))


def inputs(mean: Any, dx: Any, dy: Any, wiring: Sequence[int] = WIRING) -> np.ndarray:
    """What the inputs of the converter read, (..., 4) [pF]; the signs are those of the channels."""
    found = np.empty((*np.shape(mean), 4))
    for channel, (x, y) in enumerate(((-1, 1), (1, 1), (-1, -1), (1, -1))):
        found[..., wiring[channel]] = mean + 0.5 * (x * dx + y * dy)
    return found


def stresses() -> np.ndarray:
    mean, dx, dy = grid().T
    terms = np.column_stack([np.ones_like(dx), dx, dy, dx * dx, dx * dy, dy * dy])
    normal = NORMAL[0] + NORMAL[1] * mean
    return np.column_stack([normal, terms @ SHEAR_X, terms @ SHEAR_Y])


def write(path: Path, titles: Sequence[str], scales: Sequence[float]) -> Path:
    """A bench file with the columns time [s], cycle, three stresses and c0 to c3, each scaled."""
    count = len(grid())
    columns = [0.5 * np.arange(count), np.repeat([1, 2, 3], count // 3)]
    columns += [*stresses().T, *inputs(*grid().T).T]
    table = np.column_stack(columns) * scales
    rows = [",".join(f"{value:.12g}" for value in row) for row in table]
    path.write_text("\n".join([",".join(titles), *rows]) + "\n")
    return path


PASCAL = ["time [s]", "cycle", *(f"{name} [Pa]" for name in STRESSES)]
PASCAL += [f"c{k} [pF]" for k in range(4)]
KILO = [
    "time (ms)",
    "cycle",
    *(f"{name}_kPa" for name in STRESSES),
    *(f"c{k} fF" for k in range(4)),
]
FORCE = ["time [s]", "cycle", "normal [N]", "shear_x [N]", "shear_y [kN]"]
FORCE += [f"c{k} [counts]" for k in range(4)]
OTHER = ["t", "run", "Fn", "Tx", "Ty", "A", "B", "C", "D"]
NAMES = dict(zip(("time", "cycle", *STRESSES, "c0", "c1", "c2", "c3"), OTHER, strict=True))
MEGA = {"time": "s", **dict.fromkeys(STRESSES, "MPa"), **{f"c{k}": "nF" for k in range(4)}}

# Titles of the columns, what SI values are multiplied with, and what the call adds
WRITTEN: dict[str, tuple[list[str], list[float], dict[str, Any]]] = {
    "Pa": (PASCAL, [1.0] * 9, {}),
    "kPa": (KILO, [1e3, 1.0, *[1e-3] * 3, *[1e3] * 4], {}),
    # on 9 cm^2; 2^19 counts per pF
    "N": (FORCE, [1.0, 1.0, 9e-4, 9e-4, 9e-7, *[524288.0] * 4], {"area": 9e-4}),
    "named": (OTHER, [1.0, 1.0, *[1e-6] * 3, *[1e-3] * 4], {"columns": NAMES, "units": MEGA}),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_every_writing_gives_the_known_coefficients(name: str, tmp_path: Path) -> None:
    titles, scales, more = WRITTEN[name]
    bench = write(tmp_path / "bench.csv", titles, scales)
    cluster = st.calibrate(bench, "exact", wiring=WIRING, **more).quality.cluster
    assert cluster.normal == pytest.approx(NORMAL, rel=1e-6)
    assert cluster.shear[0] == pytest.approx(SHEAR_X, rel=1e-5)
    assert cluster.shear[1] == pytest.approx(SHEAR_Y, rel=1e-5)
    assert cluster.mean_range == pytest.approx([5.0, 8.0])
    assert cluster.difference_range == pytest.approx([-0.4, 0.6])  # common to dx and dy


# --- the terminal and the file


class Calibrated:
    """What one run of the verb printed and wrote."""

    def __init__(self, words: list[str]) -> None:
        out, err = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(err):
            assert run(words) == 0, err.getvalue()
        self.lines = [" ".join(line.split()) for line in out.getvalue().splitlines()]
        self.path = Path(words[words.index("-o") + 1])
        self.stored = yaml.safe_load(self.path.read_text())["clusters"]["exact"]


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Calibrated:
    """The bench drifts by 0.06 pF on all inputs: 1.2 kPa."""
    folder = tmp_path_factory.mktemp("bench")
    bench = write(folder / "bench.csv", KILO, WRITTEN["kPa"][1])
    table = pd.read_csv(bench)
    share = np.linspace(0.0, 1.0, len(table))
    for k in range(4):
        table[f"c{k} fF"] += 60.0 * share
    table.to_csv(bench, index=False)
    unloaded = np.array([5.01, 5.02, 5.03, 5.04])
    for name, own in (("before", unloaded), ("after", unloaded + 0.06)):
        rows = [",".join(f"{value:.6g}" for value in own)] * 3
        (folder / f"{name}.csv").write_text("\n".join(["c0 [pF],c1 [pF],c2 [pF],c3 [pF]", *rows]))
    words = ["calibrate", str(bench), "-o", str(folder / "calibration.yaml"), "--cluster", "exact"]
    words += ["--wiring", *map(str, WIRING)]
    words += ["--baseline", str(folder / "before.csv"), str(folder / "after.csv")]
    return Calibrated(words)


PRINTED = (
    "exact: 288 readings of bench.csv; 3 cycles held out in turn",
    "stress term coefficient +- (95 %) unit",
    "normal 1 -100000.0 0.0 Pa",
    "normal mean 20000.0 0.0 Pa/pF",
    "shear_x 1 100.0 0.0 Pa",
    "shear_x dx 30000.0 0.0 Pa/pF",
    "shear_x dy 2000.0 0.0 Pa/pF",
    "shear_x dx^2 5000.0 0.0 Pa/pF^2",
    "shear_x dx dy 3000.0 0.0 Pa/pF^2",
    "shear_x dy^2 1000.0 0.0 Pa/pF^2",
    "shear_y dy 25000.0 0.0 Pa/pF",
    "shear_y dx dy -2000.0 0.0 Pa/pF^2",
    "calibrated range: mean 5.000 to 8.000 pF, differences -0.400 to 0.600 pF",
    "no outliers",
    "drift, corrected: +0.0600 +0.0600 +0.0600 +0.0600 pF, normal +1200 Pa, shear_x +0 Pa,"
    " shear_y +0 Pa: above the limit of 1000 Pa",
)


@pytest.mark.parametrize("line", PRINTED, ids=range(len(PRINTED)))
def test_the_verb_prints_the_known_numbers(line: str, calibrated: Calibrated) -> None:
    assert line in calibrated.lines


def test_the_range_of_every_stress_is_printed(calibrated: Calibrated) -> None:
    """Least and largest of shear x: -15000 - 800 + 2010 + 100 Pa and 18000 + 1400 + 3650 Pa."""
    starts = ("normal 0.000 60000.000 ", "shear_x -13690.000 23050.000 ", "shear_y -9290.000 ")
    for start in starts:
        assert any(line.startswith(start) for line in calibrated.lines), start


def test_the_file_holds_the_known_coefficients(calibrated: Calibrated) -> None:
    stored = calibrated.stored
    assert stored["normal"] == pytest.approx(NORMAL)
    assert stored["shear_x"] == pytest.approx(SHEAR_X) and stored["shear_y"] == pytest.approx(
        SHEAR_Y
    )
    assert stored["mean_range"] == pytest.approx([5.0, 8.0])
    assert stored["difference_range"] == pytest.approx([-0.4, 0.6])
    assert stored["wiring"] == [2, 0, 3, 1]
    assert stored["baseline"] == pytest.approx([5.01, 5.02, 5.03, 5.04])
    assert read_calibration(calibrated.path).clusters["exact"].normal == pytest.approx(NORMAL)


def test_the_file_records_the_bench(calibrated: Calibrated) -> None:
    bench = calibrated.stored["bench"]
    assert (bench["source"], bench["readings"], bench["held_out_by"]) == (
        "bench.csv",
        288,
        "3 cycles",
    )
    assert (bench["forced"], bench["limit_percent"]) == (False, 10.0)
    scale = {"normal": 60000.0, "shear_x": 23050.0, "shear_y": 21590.0}
    assert bench["full_scale"] == pytest.approx(scale)
    assert bench["stress_range"]["shear_x"] == pytest.approx([-13690.0, 23050.0])
    assert bench["stress_range"]["shear_y"] == pytest.approx([-9290.0, 21590.0])
    drift = bench["drift"]
    assert drift["capacitance"] == pytest.approx([0.06] * 4)
    assert drift["stress"]["normal"] == pytest.approx(1200.0)
    assert drift["limit"] == 1000.0 and drift["flagged"] is True


# --- figures of quality by hand


@pytest.fixture(scope="module")
def by_hand(tmp_path_factory: pytest.TempPathFactory) -> CalibratedCluster:
    """The exact bench, said to have these errors and intervals."""
    bench = write(tmp_path_factory.mktemp("hand") / "bench.csv", PASCAL, [1.0] * 9)
    found = st.calibrate(bench, "exact", wiring=WIRING)
    held_out = {"rmse": [300.0, 456.0, 7.0], "mae": [200.0, 300.0, 5.0]}
    held_out |= {"r2": [0.99, 0.95, 0.999], "percent": [0.5, 12.34, 0.7]}
    training = {**held_out, "rmse": [250.0, 400.0, 6.0]}
    figures = {"hysteresis": [4.5, 3.25, 2.0], "repeatability": [1.5, 1.25, 1.0]}
    figures |= {"cross_talk": [np.nan, 2.5, np.nan]}
    quality = replace(
        found.quality,
        held_out=pd.DataFrame(held_out, STRESSES),
        training=pd.DataFrame(training, STRESSES),
        figures=pd.DataFrame(figures, STRESSES),
        normal_half_width=np.array([1234.5, 67.8]),
        shear_half_width=np.arange(12.0).reshape(2, 6),
    )
    return replace(found, quality=quality)


@pytest.fixture(scope="module")
def shown(by_hand: CalibratedCluster, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    out = io.StringIO()
    words = ["calibrate", "bench.csv", "--cluster", "exact", "--force"]
    words += ["-o", str(tmp_path_factory.mktemp("shown") / "calibration.yaml")]
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out):
        patch.setattr("socket_testbed.api.calibrate", lambda *_, **__: by_hand)
        assert run(words) == 0
    return [" ".join(line.split()) for line in out.getvalue().splitlines()]


QUALITY = (
    "stress from [Pa] to [Pa] held-out RMSE [Pa] held-out RMSE [%] held-out MAE [Pa]"
    " held-out R2 [-] training RMSE [Pa] hysteresis [%] repeatability [%] cross-talk [%]",
    "normal 0.000 60000.000 300.000 0.500 200.000 0.990 250.000 4.500 1.500 no pure shear",
    "shear_x -13690.000 23050.000 456.000 12.340 300.000 0.950 400.000 3.250 1.250 2.500",
    "shear_y -9290.000 21590.000 7.000 0.700 5.000 0.999 6.000 2.000 1.000 no pure normal",
    "normal 1 -100000.0 1234.5 Pa",
    "normal mean 20000.0 67.8 Pa/pF",
    "shear_x dx 30000.0 1.0 Pa/pF",
    "shear_y dx dy -2000.0 10.0 Pa/pF^2",
)


@pytest.mark.parametrize("line", QUALITY, ids=range(len(QUALITY)))
def test_the_verb_prints_the_known_quality(line: str, shown: list[str]) -> None:
    assert line in shown


def test_a_calibrated_cluster_is_shown_in_one_line(by_hand: CalibratedCluster) -> None:
    assert repr(by_hand) == (
        "CalibratedCluster(exact: 288 readings; held-out RMSE of full scale: normal 0.5 %,"
        " shear_x 12 %, shear_y 0.7 %)"
    )


def test_the_limit_is_in_percent_of_full_scale(by_hand: CalibratedCluster) -> None:
    with pytest.raises(CalibrationError) as found:
        by_hand.calibration(limit=12.0)
    assert found.value.fact == (
        "the held-out RMSE exceeds 12 % of the full scale: shear_x 12.3 % (456 Pa)"
    )
    record = by_hand.calibration(limit=12.0, force=True).clusters["exact"].bench
    assert (record["forced"], record["limit_percent"]) == (True, 12.0)
    assert by_hand.calibration(limit=12.5).clusters["exact"].bench["forced"] is False


def test_the_record_keeps_the_known_quality(by_hand: CalibratedCluster) -> None:
    record = by_hand.calibration(force=True).clusters["exact"].bench
    assert record["held_out"]["shear_x"] == {
        "rmse": 456.0,
        "mae": 300.0,
        "r2": 0.95,
        "percent": 12.34,
    }
    assert record["training"]["normal"]["rmse"] == 250.0
    assert record["hysteresis_percent"] == {"normal": 4.5, "shear_x": 3.25, "shear_y": 2.0}
    assert record["repeatability_percent"]["shear_x"] == 1.25
    assert record["cross_talk_percent"] == {"normal": None, "shear_x": 2.5, "shear_y": None}
    assert record["interval_95"]["normal"] == [1234.0, 67.8]  # four digits
    assert record["interval_95"]["shear_y"] == [6.0, 7.0, 8.0, 9.0, 10.0, 11.0]


def test_errors_are_of_prediction_minus_known() -> None:
    """Residuals 1, -1, 2, 0: rms sqrt(6 / 4), mean magnitude 1; the variance of 0..30 is 125."""
    known = np.outer([0.0, 10.0, 20.0, 30.0], [1.0, 1.0, 1.0])
    predicted = known + np.outer([1.0, -1.0, 2.0, 0.0], [1.0, 10.0, 0.1])
    found = stress_errors(known, predicted, np.array([30.0, 60.0, 30.0]))
    assert found.loc["normal"].tolist() == pytest.approx([1.224745, 1.0, 0.988, 4.082483])
    assert found.loc["shear_x"].tolist() == pytest.approx([12.24745, 10.0, -0.2, 20.412415])
    assert found.loc["shear_y", "percent"] == pytest.approx(0.4082483)


# Known stress [Pa], branch of the normal stress, cycle; residuals of the fit and held out [Pa]
READINGS = [
    ((50, 0, 0), RISING, 0, (2.0, 0, 0), (0, 0.3, 0.10)),
    ((50, 0, 0), RISING, 1, (4.0, 0, 0), (0, 0.5, 0.10)),
    ((50, 0, 0), FALLING, 0, (0.0, 0, 0), (0, 0.3, 0.10)),
    ((50, 0, 0), FALLING, 1, (-2.0, 0, 0), (0, 0.5, 0.10)),
    ((100, 0, 0), NEITHER, 0, (0, 0, 0), (0, -0.6, 0.0)),
    ((0, 10, 0), NEITHER, 0, (0, 0, 0), (5.0, 0, 0)),
    ((1, -10, 5), NEITHER, 0, (0, 0, 0), (-7.0, 0, 0)),
    ((30, 10, 10), NEITHER, 0, (0, 0, 0), (-30.0, 5.0, 5.0)),  # neither is pure
]


def test_figures_are_in_percent_of_full_scale() -> None:
    """Full scale is 100, 10 and 10 Pa.

    At 50 Pa the rising mean is 3 Pa, the falling one -1 Pa; each branch's cycles are 2 Pa apart, so
    1 Pa from their mean: sqrt((2 + 2) / 2). Pure shear feels like -7 Pa of normal stress at most,
    100 Pa of pure normal stress like -0.6 Pa of shear x, 50 Pa like 0.1 Pa of shear y.
    """
    known, branch, cycle, fitted, unseen = (np.array(own) for own in zip(*READINGS, strict=True))
    count = len(READINGS)
    bench = BenchData(
        files=("bench.csv",),
        file=np.zeros(count, dtype=np.int64),
        line=np.arange(count),
        time=np.full(count, np.nan),
        cycle=cycle,
        capacitance=np.ones((count, 4)),
        stress=known.astype(float),
    )
    branches = np.full((count, 3), NEITHER)
    branches[:, 0] = branch
    found = quality_figures(bench, fitted.astype(float), unseen.astype(float), branches, cycle)
    assert found.loc["normal"].tolist() == pytest.approx([4.0, np.sqrt(2.0), 7.0])
    assert found["cross_talk"].tolist() == pytest.approx([7.0, 6.0, 1.0])
    assert np.isnan(found.loc["shear_x", "hysteresis"])


# --- drift by hand


@pytest.mark.parametrize(
    ("change", "flagged"),
    [(999.0, False), (1001.0, True), (-999.0, False), (-1001.0, True)],
    ids=["rise within", "rise beyond", "fall within", "fall beyond"],
)
def test_a_drift_is_flagged_on_either_side(change: float, flagged: bool) -> None:
    assert Drift(np.zeros(4), np.array([0.0, change, 0.0])).flagged is flagged


def test_a_drift_is_taken_off_by_time() -> None:
    """1 pF over 10 s: at 2.5 s a quarter of it, before and after as at the ends."""
    before, after = Baseline(0.0, np.full(4, 5.0)), Baseline(10.0, np.full(4, 6.0))
    time = np.array([-5.0, 0.0, 2.5, 10.0, 20.0])
    found = correct_drift(np.full((5, 4), 8.0), time, before, after)
    assert found[:, 0].tolist() == [8.0, 8.0, 7.75, 7.0, 7.0]
    again = correct_drift(np.full((1, 4), 8.0), time[:1], before, reference=np.full(4, 4.5))
    assert again[0].tolist() == [7.5] * 4


# --- the calibration applied: below and above its range

CLUSTER = ClusterCalibration(
    normal=np.array(NORMAL),
    shear=np.array([SHEAR_X, SHEAR_Y]),
    mean_range=np.array([4.0, 12.0]),
    difference_range=np.array([-0.4, 0.6]),
    wiring=np.array(WIRING),
)
OK, SATURATED, MISSING, OUT = (0, 1, 2, 3)
# mean, dx, dy [pF], the cluster's status
RANGES = {
    "inside": (6.0, 0.1, 0.2, OK),
    "mean at the low end": (4.0, 0.25, 0.25, OK),
    "mean below": (3.99, 0.1, 0.2, OUT),
    "mean at the high end": (12.0, 0.25, 0.25, OK),
    "mean above": (12.01, 0.1, 0.2, OUT),
    "x near its low end": (6.0, -0.399, 0.0, OK),
    "x below": (6.0, -0.41, 0.0, OUT),
    "x near its high end": (6.0, 0.599, 0.0, OK),
    "x above": (6.0, 0.61, 0.0, OUT),
    "y near its low end": (6.0, 0.0, -0.399, OK),
    "y below": (6.0, 0.0, -0.41, OUT),
    "y near its high end": (6.0, 0.0, 0.599, OK),
    "y above": (6.0, 0.0, 0.61, OUT),
}
FINE = np.zeros(4, dtype=np.uint8)


@pytest.mark.parametrize("case", RANGES)
def test_readings_beyond_either_end_are_out_of_range(case: str) -> None:
    *place, known = RANGES[case]
    stress, status = CLUSTER.apply(inputs(*place), FINE)
    assert int(status) == known
    assert stress[0] == pytest.approx(-100e3 + 20e3 * place[0])  # out of range it goes on


@pytest.mark.parametrize("wiring", [*itertools.permutations(range(4))], ids=str)
def test_every_wiring_gives_the_known_stress(wiring: tuple[int, ...]) -> None:
    """At a mean of 6, dx = 0.1 and dy = 0.2 pF.

    3000 + 400 + 50 + 60 + 40 + 100 Pa, and 100 + 5000 + 40 - 40 + 240 - 50 Pa.
    """
    cluster = replace(CLUSTER, wiring=np.array(wiring))
    stress, status = cluster.apply(inputs(6.0, 0.1, 0.2, wiring), FINE)
    assert stress == pytest.approx([20e3, 3650.0, 5290.0]) and int(status) == OK


@pytest.mark.parametrize("name", range(4), ids="c{}".format)
@pytest.mark.parametrize(
    ("own", "value", "known"),
    [
        (Status.SATURATED, np.nan, SATURATED),
        (Status.SATURATED, 15.0, SATURATED),
        (Status.MISSING, np.nan, MISSING),
        (Status.OK, np.nan, MISSING),
        (Status.OK, np.inf, MISSING),
    ],
    ids=["saturated", "saturated with a value", "missing", "not a number", "infinite"],
)
def test_a_faulty_input_leaves_no_stress(name: int, own: Status, value: float, known: int) -> None:
    status, read = FINE.copy(), inputs(6.0, 0.1, 0.2)
    status[name], read[name] = own, value
    stress, found = CLUSTER.apply(read, status)
    assert int(found) == known and np.isnan(stress).all()


def test_a_missing_input_hides_a_saturated_one() -> None:
    status = np.array([Status.SATURATED, Status.OK, Status.MISSING, Status.OK], dtype=np.uint8)
    assert int(CLUSTER.apply(inputs(6.0, 0.1, 0.2), status)[1]) == MISSING


# --- wrong files


@pytest.mark.parametrize(
    ("titles", "more", "words"),
    [
        (FORCE, (), ["'normal [N]' is a force in N", "--area, in m^2"]),
        ([t.replace("[pF]", "[mV]") for t in PASCAL], (), ["'c0 [mV]' is in 'mV'", "pF, fF, nF"]),
        (
            [t.replace("normal [Pa]", "normal [MPa]") for t in PASCAL],
            (),
            ["outside -0.001 to 2 MPa"],
        ),
        (PASCAL[:5] + PASCAL[6:] + ["x"], (), ["no column for c0"]),
        (PASCAL, ("--wiring", 0, 0, 1, 2), ["--wiring is [0, 0, 1, 2]"]),
    ],
    ids=["force", "millivolts", "megapascals", "column", "wiring"],
)
def test_a_wrong_bench_is_refused(
    titles: list[str],
    more: tuple[object, ...],
    words: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bench = write(tmp_path / "bench.csv", titles, [1.0] * 9)
    call = ("calibrate", bench, "-o", tmp_path / "out.yaml", "--cluster", "exact", *more)
    verbs.refused(capsys, *call, named=words)
    assert not (tmp_path / "out.yaml").exists()


def test_a_default_wiring_that_is_wrong_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = write(tmp_path / "bench.csv", PASCAL, [1.0] * 9)
    call = ("calibrate", bench, "-o", tmp_path / "out.yaml", "--cluster", "exact")
    verbs.refused(capsys, *call, named=["with the wiring 0 1 2 3, but do with 2 0 3 1"])
