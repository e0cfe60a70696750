"""The figures of single results, read back from their axes: cycles, fit, evaluate, calibrate.

Cycles, bench data and the model are by hand; `evaluate` judges the constants of `scene.model`.
"""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from support import results_by_hand, scene
from support.benches import bench_of

import socket_testbed as st
from socket_testbed.api.cycles import Cycles
from socket_testbed.api.design import CalibratedCluster
from socket_testbed.api.tradeoff import theta_values
from socket_testbed.calibration.bench_data import STRESSES
from socket_testbed.calibration.calibrate import BenchCalibration, CrossValidation, Groups
from socket_testbed.calibration.fit import Outlier
from socket_testbed.errors import ConfigurationError
from socket_testbed.figures.style import COLUMN
from socket_testbed.results.models import Evaluation, TrialFit
from socket_testbed.results.validation import Validation
from socket_testbed.trials.metadata import TrialMetadata
from socket_testbed.trials.trial import Trial

SIGMA = "\N{GREEK SMALL LETTER SIGMA}"
VERMILION = "#D55E00"


@pytest.fixture(scope="module", autouse=True)
def without_layout() -> Iterator[None]:
    """Positions on paper are tested elsewhere; they take most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConstrainedLayoutEngine, "execute", lambda *_: None)
        yield


def legend(axis: Axes) -> list[str]:
    """Title and entries of a panel's legend."""
    found = axis.get_legend()
    return [found.get_title().get_text(), *(text.get_text() for text in found.texts)]


def labelled(axis: Axes, label: str) -> np.ndarray:
    """Points of the line with a label, (N, 2)."""
    (found,) = [line for line in axis.lines if line.get_label() == label]
    return np.asarray(found.get_xydata())


# --- cycles

# Three cycles of 1.0, 1.5 and 1.2 s. Fz is 90, 100 and 110 N at the start and gains 1 N a percent:
# mean 100 N, deviation 10 N (divisor 2). Mx is constantly 1, 2 and 4.5 N m: mean 2.5 N m, deviation
# sqrt((2.25 + 0.25 + 4) / 2) = 1.80278 N m. Mz is missing.
SPANS = np.array([[2.0, 3.0], [3.0, 4.5], [5.0, 6.2]])
PERCENT = np.arange(101.0)
CURVES = np.stack(
    [
        np.array([[90.0], [100.0], [110.0]]) + PERCENT,
        np.array([[1.0], [2.0], [4.5]]) + 0.0 * PERCENT,
        np.full((3, 101), np.nan),
    ],
    axis=-1,
)
TITLES = ("Fz [N]", "Mx [N m]", "Mz [N m]")
COUNTED = "3 cycles from each 'step' to the next one, 1.20 s (1.00 to 1.50 s)"


@pytest.fixture(scope="module")
def cycles(trial: Trial) -> Cycles:
    return Cycles(trial, "step", SPANS, 1, TITLES, CURVES)


@pytest.fixture(scope="module")
def drawn_cycles(cycles: Cycles) -> Figure:
    return cycles.figure()


def band(axis: Axes, percent: float) -> list[float]:
    """Lower and upper end of the band at a percent."""
    (found,) = [each for each in axis.collections if isinstance(each, PolyCollection)]
    points = found.get_paths()[0].vertices
    return sorted({*np.round(points[points[:, 0] == percent, 1], 6)})


@pytest.mark.parametrize(
    ("panel", "ends", "middle"),
    [(0, [115.0, 135.0], 125.0), (1, [0.697224, 4.302776], 2.5)],
    ids=["Fz", "Mx"],
)
def test_a_band_is_one_deviation_about_the_mean(
    panel: int, ends: list[float], middle: float, drawn_cycles: Figure
) -> None:
    axis = drawn_cycles.axes[panel]
    assert band(axis, 25.0) == pytest.approx(ends, abs=1e-5)
    *single, mean = axis.lines
    assert mean.get_xydata()[25] == pytest.approx([25.0, middle])
    assert mean.get_color() == "#0072B2"
    assert [line.get_ydata()[25] for line in single] == pytest.approx([*CURVES[:, 25, panel]])
    assert {line.get_color() for line in single} == {"0.8"}
    assert axis.get_xlim() == (0.0, 100.0)


def test_cycles_name_axes_and_quantities(drawn_cycles: Figure) -> None:
    axes = drawn_cycles.axes
    assert [axis.get_ylabel() for axis in axes] == [*TITLES]
    assert [axis.get_xlabel() for axis in axes] == ["", "cycle [%]", "cycle [%]"]
    assert [text.get_text() for text in axes[2].texts] == ["no value"]
    assert not axes[0].texts and not len(axes[2].get_yticks())
    assert drawn_cycles.get_suptitle().replace("\n", " ") == (
        f"scene: {COUNTED}; 1 left out, longer than twice the median; mean and one standard"
        " deviation"
    )


@pytest.mark.parametrize(
    ("width", "columns", "height"),
    [(180, [0, 1, 0], 100.0), (88, [0, 0, 0], 144.0)],
    ids=["page", "column"],
)
def test_cycles_are_in_two_columns_of_a_page(
    width: int, columns: list[int], height: float, cycles: Cycles
) -> None:
    """Rows of 44 mm, and a heading of 12 mm."""
    figure = cycles.figure(width=width)
    specs = [axis.get_subplotspec() for axis in figure.axes]
    assert [spec.colspan.start for spec in specs] == columns
    assert figure.get_size_inches() * 25.4 == pytest.approx([width, height])


def test_two_cycles_have_no_band(trial: Trial) -> None:
    found = Cycles(trial, "on:off", SPANS[:2], 0, TITLES[:1], CURVES[:2, :, :1])
    assert str(found) == ("2 cycles from each 'on' to the next 'off', 1.25 s (1.00 to 1.50 s)")
    figure = found.figure()
    assert figure.get_suptitle().endswith("; mean, no band")
    (axis,) = figure.axes
    assert axis.lines[-1].get_ydata()[0] == 95.0
    assert not np.isfinite(found.deviation).any()


@pytest.mark.parametrize(("count", "lines"), [(30, 31), (31, 1)])
def test_many_cycles_are_not_drawn_singly(count: int, lines: int, trial: Trial) -> None:
    repeated = np.tile(CURVES[:1, :, :1], (count, 1, 1))
    found = Cycles(trial, "step", np.tile(SPANS[:1], (count, 1)), 0, TITLES[:1], repeated)
    assert len(found.figure().axes[0].lines) == lines


def test_own_axes_hold_one_quantity(cycles: Cycles) -> None:
    axes = Figure().subplots()
    replace(cycles, titles=TITLES[1:2], curves=CURVES[:, :, 1:2]).draw(ax=axes)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("cycle [%]", "Mx [N m]")
    assert axes.lines[-1].get_ydata()[0] == 2.5
    with pytest.raises(ConfigurationError, match="one of these 3 quantities"):
        cycles.draw(ax=axes)


@pytest.mark.parametrize("count", [12, 13])
def test_at_most_twelve_quantities_are_drawn(count: int, trial: Trial) -> None:
    titles = tuple(f"q{number} [-]" for number in range(count))
    found = Cycles(trial, "step", SPANS, 0, titles, np.zeros((3, 101, count)))
    if count == 12:
        assert len(found.figure().axes) == 12
    else:
        with pytest.raises(ConfigurationError, match="a figure of 13 quantities"):
            found.figure()


def test_the_table_of_cycles_holds_the_band(cycles: Cycles) -> None:
    row = cycles.to_dataframe().loc[25.0]
    assert row["Fz mean [N]"] == 125.0 and row["Fz sd [N]"] == pytest.approx(10.0)
    assert row["Mx mean [N m]"] == 2.5 and row["Mx sd [N m]"] == pytest.approx(1.80278, rel=1e-5)
    assert row["Fz n [-]"] == 3 and row["Mz n [-]"] == 0 and np.isnan(row["Mz mean [N m]"])


@pytest.fixture(scope="module")
def judged(trial: Trial, tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    model = scene.model(tmp_path_factory.mktemp("models") / "model.json")
    return st.evaluate(trial, model, "all")


# --- fit


@pytest.fixture(scope="module")
def fitted(trial: Trial, judged: Evaluation) -> TrialFit:
    """With the errors of another model, which are known."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "socket_testbed.results.models.fit_contact_model", results_by_hand.fit_by_hand
        )
        found = st.fit(trial, "all", variant="stiffness_bias")
    rmse = np.array([error.rmse for error in judged.errors[:6]])
    return replace(found, fit=replace(found.fit, errors=judged.errors, wrench_rmse=rmse))


@pytest.fixture(scope="module")
def drawn_fit(fitted: TrialFit) -> Figure:
    return fitted.figure()


def panels(figure: Figure, title: str) -> tuple[Axes, Axes]:
    """Wall and distal end of a map by its title."""
    (place,) = [i for i, axis in enumerate(figure.axes) if axis.get_title("left") == title]
    return figure.axes[place], figure.axes[place + 1]


def fill_near(axis: Axes, place: tuple[float, float]) -> tuple[float, ...]:
    """The fill of the square nearest to a place [deg, mm] or [mm, mm]."""
    squares = next(each for each in axis.collections if isinstance(each, PolyCollection))
    centres = np.array([path.vertices[:4].mean(axis=0) for path in squares.get_paths()])
    nearest = int(np.linalg.norm(centres - place, axis=1).argmin())
    return tuple(squares.get_facecolor()[nearest][:3])


STIFFNESSES = {
    # title, which of wall and end, place, share of the scale
    "x": ("k along x of {S}", 0, (0.0, 120.0), 1.0),  # ant_prox 1 N/m
    "y": ("k along y of {S}", 0, (90.0, 60.0), 0.5),  # left_mid 0.5 N/m, on the scale of x
    "z": ("k along z of {S}", 1, (0.0, -20.0), 1.0),  # post_end 5000 N/m
    "x elsewhere": ("k along x of {S}", 0, (90.0, 60.0), 0.0),
    "z elsewhere": ("k along z of {S}", 1, (0.0, 20.0), 0.0),
}


@pytest.mark.parametrize("name", STIFFNESSES)
def test_a_fit_shows_stiffness_by_axis(name: str, drawn_fit: Figure) -> None:
    title, part, place, share = STIFFNESSES[name]
    found = fill_near(panels(drawn_fit, title)[part], place)
    assert found == pytest.approx(colormaps["viridis"](share)[:3], abs=0.01)


def test_a_fit_names_trial_part_and_scale(drawn_fit: Figure) -> None:
    heading = "scene, all 0.00 s to 23.75 s: stiffness, stiffness_bias"
    assert drawn_fit.get_suptitle() == heading
    labels = [(axis.get_ylabel().replace("\n", " "), axis.get_ylim()) for axis in drawn_fit.axes]
    bars = [ends for label, ends in labels if label == "stiffness [N/m]"]
    assert bars == [(0.0, 1.0), (0.0, 1.0), (0.0, 5000.0)]
    wall, _ = panels(drawn_fit, "k along x of {S}")
    words = dict(zip(wall.get_xticks(), wall.get_xticklabels(), strict=True))
    assert "lat" in words[-90.0].get_text() and "med" in words[90.0].get_text()  # a right leg


def test_a_saved_fit_names_its_trial(fitted: TrialFit, trial: Trial, tmp_path: Path) -> None:
    fitted.save(tmp_path / "model.json")
    for found in (st.read_model(tmp_path / "model.json"), fitted.fit):
        assert (found.trial, found.segment) == ("scene", "all 0.00 s to 23.75 s")
        assert (found.first_stamp, found.last_stamp) == (scene.STAMPS[0], scene.STAMPS[-1])
        assert (found.samples, found.status) == (96, fitted.fit.status)
        assert found.fingerprint == trial.fingerprint
        rmse = [1.1180, 1.5, 0.21213, 7.0711, 7.0711, 45.2769]
        assert found.wrench_rmse == pytest.approx(rmse, rel=1e-4)
    identity = json.loads((tmp_path / "model.json").read_text())["trial"]
    assert identity["name"] == "scene" and identity["fingerprint"] == trial.fingerprint
    stamps = identity["first_stamp"], identity["last_stamp"]
    assert stamps == (1_800_000_000_000_000_000, 1_800_000_023_750_000_000)
    assert identity["samples"] == 96


def test_a_fit_is_shown_in_one_line(fitted: TrialFit) -> None:
    assert repr(fitted) == (
        "TrialFit(stiffness_bias on scene, all 0.00 s to 23.75 s, theta 0.5; mean moment RMSE"
        " 0.943 N m, mean force RMSE 19.8 N, median local RMSE 7.64 N)"
    )


def test_a_fit_s_document_holds_the_errors(fitted: TrialFit) -> None:
    document = fitted.document()
    assert document["model"] == {"trial": "scene", "variant": "stiffness_bias"}
    assert document["segment"] == {"kind": "all", "start": 0.0, "end": 23.75}
    assert (document["trial"], document["samples"]) == ("scene", 96)
    assert document["in_objective"]["mean_force_rmse [N]"] == pytest.approx(19.8064, rel=1e-4)
    assert document["channels"][5]["name"] == "Fz"
    assert document["channels"][5]["rmse"] == pytest.approx(45.2769, rel=1e-5)
    assert fitted.to_dataframe().loc["Fz", "MAE"] == pytest.approx(40.0)


# --- evaluate


@pytest.fixture(scope="module")
def drawn_evaluation(judged: Evaluation) -> Figure:
    return judged.figure()


CHANNELS = {
    # panel, quantity, measured at 12.0 s and predicted, key; errors as in `test_models`
    "Fx": (0, "force [N]", (14.0, 14.0), ("7.07 N", "6.36", "7.07", "0.00")),
    "Fz": (2, "force [N]", (-90.0, -100.0), ("45.28 N", "40.00", "21.21", "-1.13")),
    "My": (4, "moment [N m]", (0.1, 1.1), ("1.50 N m", "1.21", "1.12", "-0.34")),
}


@pytest.mark.parametrize("channel", CHANNELS)
def test_an_evaluation_shows_measured_and_predicted(channel: str, drawn_evaluation: Figure) -> None:
    place, label, (measured, predicted), (rmse, mae, sigma, skill) = CHANNELS[channel]
    axis = drawn_evaluation.axes[place]
    assert axis.get_ylabel() == label
    key = f"stiffness_bias: RMSE {rmse},\nMAE {mae}, {SIGMA} {sigma}, skill {skill}"
    assert legend(axis) == [channel, "measured", key]
    assert labelled(axis, "measured")[48] == pytest.approx([12.0, measured], abs=1e-6)
    assert labelled(axis, key)[48] == pytest.approx([12.0, predicted])


def test_an_evaluation_shades_its_segment(trial: Trial, tmp_path: Path) -> None:
    found = st.evaluate(trial, scene.model(tmp_path / "model.json"), "6:18")
    figure = found.figure()
    title = figure.get_suptitle()
    assert title.startswith("scene, ") and title.endswith(": measured and predicted wrench")
    (span,) = figure.axes[0].patches
    ends = [span.get_x(), span.get_x() + span.get_width()]
    assert ends == pytest.approx([6.0, 18.0])
    assert len(labelled(figure.axes[0], "measured")) == 96  # the whole trial is drawn


# --- calibrate


KNOWN = np.array(
    [[0.0, -4e3, 1e3], [20e3, 5e3, -2e3], [60e3, 8e3, 6e3], [30e3, 5e3, 0.0]]
)  # normal, shear x, shear y [Pa]; the last reading is an outlier along shear x


def errors_by_hand(percent: list[float]) -> pd.DataFrame:
    zeros = np.zeros(3)
    columns = {"rmse": zeros, "mae": zeros, "r2": zeros, "percent": percent}
    return pd.DataFrame(columns, STRESSES)


@pytest.fixture(scope="module")
def drawn_bench() -> Figure:
    """Known stress plus 600, -300, 100 Pa in the fit, and 1200, 500, -200 Pa held out."""
    quality = BenchCalibration(
        cluster=scene.calibration().clusters["distal"],
        bench=bench_of(np.zeros((4, 4)), KNOWN),
        sound=np.array([True, True, True, False]),
        outliers=(Outlier(3, "bench.csv line 5", 1, 5e3, 9e3),),
        dropped=False,
        fitted=KNOWN + np.array([600.0, -300.0, 100.0]),
        cross_validation=CrossValidation(
            Groups("cycle", np.array([0, 0, 1, 1])),
            KNOWN + np.array([1200.0, 500.0, -200.0]),
            np.zeros((2, 2)),
            np.zeros((2, 2, 6)),
        ),
        training=errors_by_hand([9.0, 9.0, 9.0]),
        held_out=errors_by_hand([0.5, 12.34, 0.7]),
        normal_half_width=np.zeros(2),
        shear_half_width=np.zeros((2, 6)),
        figures=pd.DataFrame(),
    )
    return CalibratedCluster("distal", quality, None, None).figure()


BENCH = {
    # column, title, known stresses, calibrated, residuals in the fit and held out [kPa]
    "normal": (0, "0.5 %", [0, 20, 60, 30], [0.6, 20.6, 60.6, 30.6], 0.6, 1.2),
    "shear_x": (1, "12.3 %", [-4, 5, 8, 5], [-4.3, 4.7, 7.7, 4.7], -0.3, 0.5),
    "shear_y": (2, "0.7 %", [1, -2, 6, 0], [1.1, -1.9, 6.1, 0.1], 0.1, -0.2),
}


@pytest.mark.parametrize("name", BENCH)
def test_a_calibration_shows_stress_and_residual(name: str, drawn_bench: Figure) -> None:
    column, percent, known, calibrated, fitted, held_out = BENCH[name]
    above, below = drawn_bench.axes[column], drawn_bench.axes[3 + column]
    assert above.get_title() == f"{name}\nheld-out:\n{percent} of\nfull scale"
    equal, points = above.lines[:2]
    ends = [min(known), max(known)]
    assert equal.get_xydata().tolist() == [[end, end] for end in ends]
    assert points.get_xdata() == pytest.approx(known)
    assert points.get_ydata() == pytest.approx(calibrated)
    for label, residual in (("in the fit", fitted), ("held out", held_out)):
        found = labelled(below, label)
        assert found[:, 0] == pytest.approx(known)
        assert found[:, 1] == pytest.approx([residual] * 4)
    assert below.lines[-1].get_ydata() == [0.0, 0.0]


def test_a_calibration_circles_its_outlier(drawn_bench: Figure) -> None:
    counts = [len(axis.lines) for axis in drawn_bench.axes[:3]]
    assert counts == [2, 3, 2]
    circle = drawn_bench.axes[1].lines[2]
    assert circle.get_xydata().tolist() == [[5.0, 9.0]]
    assert (circle.get_color(), circle.get_fillstyle()) == (VERMILION, "none")


def test_a_calibration_names_axes_and_marks(drawn_bench: Figure) -> None:
    assert drawn_bench.get_suptitle() == "distal: bench.csv; 2 cycles held out in turn"
    axes = drawn_bench.axes
    assert [axes[0].get_ylabel(), axes[3].get_ylabel()] == ["calibrated [kPa]", "residual [kPa]"]
    assert [axis.get_xlabel() for axis in axes] == ["", "", "", *["known [kPa]"] * 3]
    (key,) = drawn_bench.legends
    found = zip(key.texts, key.legend_handles, strict=True)
    marks = {text.get_text(): (mark.get_marker(), mark.get_color()) for text, mark in found}
    assert marks == {
        "outlier": ("o", VERMILION), "held out": ("x", VERMILION), "in the fit": (".", "0.2")
    }  # fmt: skip


# --- pareto


def test_a_trade_off_names_trial_and_part(trial: Trial) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "socket_testbed.results.tradeoff.pareto_front", results_by_hand.fronts_by_hand
        )
        found = st.pareto(trial, "all", thetas=4)
    figure = found.figure()
    title = "scene, all 0.00 s to 23.75 s: trade-off between wrench and clusters"
    assert figure.get_suptitle() == title
    (axis,) = figure.axes
    knee = next(line for line in axis.lines if line.get_marker() == "*")
    assert (knee.get_xdata()[0], knee.get_ydata()[0]) == (0.3, 0.2)
    marks = found.to_dataframe().set_index(["variant", "theta [-]"])["mark"]
    assert [*marks["stiffness"]] == ["sensor-only", "knee", "", "wrench-only"]


@pytest.mark.parametrize(
    ("thetas", "values"), [(2, [0.0, 1.0]), (4, [0.0, 0.3333333333, 0.6666666667, 1.0])]
)
def test_thetas_are_evenly_spaced(thetas: int, values: list[float]) -> None:
    assert theta_values(thetas).tolist() == values


# --- validate


@pytest.mark.parametrize(
    ("names", "title"),
    [(("scene",), "scene: validation"), (("scene", "other"), "2 trials, means: validation")],
    ids=["one", "several"],
)
def test_a_validation_names_its_trials(names: tuple[str, ...], title: str) -> None:
    judgements = tuple(results_by_hand.judgements_by_hand())
    found = Validation(names, ("scene",), judgements, tuple(TrialMetadata() for _ in names))
    assert found.figure().get_suptitle() == title
    errors, _ = found.figure(width=COLUMN).axes
    lengths = {bars.get_label(): [bar.get_width() for bar in bars] for bars in errors.containers}
    assert lengths["force map"] == [0.35, 0.25, 0.3, 0.45]
    number = "2 trials" if len(names) == 2 else "1 trial"
    assert repr(found) == f"Validation({number}, models fitted on 1; {len(judgements)} judgements)"
