"""The figures of a report hold what they were given."""

import dataclasses

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.collections import PolyCollection, QuadMesh
from matplotlib.colors import Normalize
from matplotlib.image import imread
from matplotlib.patches import Rectangle
from support.problems import random_socket

from socket_testbed.identification.evaluation import channel_errors
from socket_testbed.identification.validation import CLOSED, FORCE_MAP, INVERSE_DISTANCE, Judgement
from socket_testbed.report.figures.channels import (
    MOST_POINTS,
    Panel,
    Prediction,
    offsets_figure,
    overview_figure,
    panels_figure,
    wrench_figure,
)
from socket_testbed.report.figures.style import SCALE, save_figure, svg_of
from socket_testbed.report.figures.tile_maps import scales_of, tile_map_figure
from socket_testbed.report.figures.validation import validation_figure
from socket_testbed.samples import channel_names

NASTY = "a$_b <i>"


@pytest.fixture
def rng():
    return np.random.default_rng(6)


def make_panel(rng, name="Fx", count=300, in_objective=True) -> Panel:
    time, measured = np.arange(count) / 4.0, rng.normal(size=count)
    predictions = []
    for label in ("stiffness", "stiffness_bias"):
        predicted = measured + rng.normal(1.0, 0.2, count)
        errors = channel_errors(name, measured, predicted, in_objective)
        predictions.append(Prediction(label, predicted, errors))
    return Panel(time, measured, tuple(predictions), (5.0, 20.0))


def test_a_panel_holds_its_lines_and_the_figures_of_its_errors(rng):
    panel = make_panel(rng)
    (axis,) = panels_figure([panel], 1).axes
    expected = [panel.measured, *(p.values for p in panel.predictions)]
    for line, values in zip(axis.lines, expected, strict=True):
        np.testing.assert_array_equal(line.get_xydata(), np.stack([panel.time, values], axis=1))
    key = [text.get_text() for text in axis.get_legend().get_texts()]
    assert key[0] == "measured"
    for text, prediction in zip(key[1:], panel.predictions, strict=True):
        error = prediction.errors
        assert text.startswith(f"{prediction.label}: RMSE {error.rmse:.2f}, MAE {error.mae:.2f}")
        assert f"{error.sigma:.2f} N" in text and "skill" in text
    assert axis.get_ylabel() == "force [N]" and axis.get_xlabel() == "time [s]"
    dashes = {str(line.get_linestyle()) + str(line.get_color()) for line in axis.lines}
    assert len(dashes) == 3


@pytest.mark.parametrize("in_objective", [True, False])
def test_a_channel_that_was_left_out_is_marked(rng, in_objective):
    (axis,) = panels_figure([make_panel(rng, "a.Fz", in_objective=in_objective)], 1).axes
    title = axis.get_legend().get_title().get_text()
    assert title.startswith("a.Fz") and ("(not in objective)" in title) is not in_objective


def test_a_long_line_is_thinned_and_keeps_its_peak(rng):
    panel = make_panel(rng, count=50_000)
    panel.measured[12_345] = 99.0
    (axis,) = panels_figure([panel], 1).axes
    assert all(len(line.get_xdata()) <= MOST_POINTS for line in axis.lines)
    assert axis.lines[0].get_ydata().max() == 99.0


def test_a_channel_without_a_value_is_drawn_and_says_so(rng):
    panel = make_panel(rng, f"{NASTY}.Fx")
    nothing = np.full(300, np.nan)
    errors = channel_errors(f"{NASTY}.Fx", nothing, nothing)
    empty = Panel(panel.time, nothing, (Prediction("stiffness", nothing, errors),), panel.span)
    figure = panels_figure([panel, empty], 2, NASTY)
    assert svg_of(figure).startswith("<?xml")
    assert "no value" in figure.axes[1].get_legend().get_texts()[1].get_text()


def test_the_wrench_has_six_panels_with_their_units(rng, tmp_path):
    time, rows = np.arange(200) / 4.0, np.arange(200) > 50
    measured = rng.normal(size=(200, 6))
    predicted = {"stiffness": np.where(rows[:, None], measured + 1.0, np.nan)}
    figure = wrench_figure(time, measured, predicted, rows, "A hold")
    save_figure(figure, tmp_path / "wrench.png")
    image = imread(tmp_path / "wrench.png")[..., :3]
    assert image.shape[1] > image.shape[0] > 500 and image.std() > 0.05


def test_the_overview_shows_when_what_was_lost(rng):
    time = np.arange(800) / 4.0  # two samples a bin
    lost = {"Mz": np.zeros(800, dtype=bool), NASTY: np.zeros(800, dtype=bool)}
    lost["Mz"][200:400] = True
    lost[NASTY][600] = True
    figure = overview_figure(time, rng.normal(size=(800, 6)), [(10.0, 50.0)], (60.0, 90.0), lost)
    force, moment, raster = figure.axes[:3]
    assert "[N]" in force.get_ylabel() and "[N m]" in moment.get_ylabel()
    assert raster.get_xlabel() == "time [s]"
    (mesh,) = [c for c in raster.collections if isinstance(c, QuadMesh)]
    share = np.asarray(mesh.get_array()).reshape(2, -1)
    np.testing.assert_allclose(share.sum(axis=1) * 2.0, [200, 1], atol=2.0)
    middle = share.shape[1] // 8 * 3
    assert share[0, middle] == 1.0 and share[1, middle] == 0.0
    assert [label.get_text() for label in raster.get_yticklabels()] == ["Mz", NASTY]


def test_the_bars_are_the_offsets(rng):
    channels = channel_names(("a", NASTY))
    offsets = {"stiffness_bias": rng.normal(size=12), "given": rng.normal(size=12)}
    figure = offsets_figure(channels, offsets)
    assert [axis.get_xlabel().rpartition(" [")[2] for axis in figure.axes] == ["N m]", "N]", "N]"]
    widths = [
        [bar.get_width() for bar in axis.patches if isinstance(bar, Rectangle)]
        for axis in figure.axes
    ]
    for axis, rows in zip(widths, (slice(0, 3), slice(3, 6), slice(6, 12)), strict=True):
        np.testing.assert_allclose(axis, np.concatenate([v[rows] for v in offsets.values()]))
    names = [label.get_text() for axis in figure.axes for label in axis.get_yticklabels()]
    assert names == list(channels)
    assert svg_of(figure).startswith("<?xml")


@pytest.mark.parametrize("larger", [1.5, 9.0])
def test_tiles_are_on_one_scale_unless_their_ranges_differ(rng, larger):
    geometry = random_socket(rng, rings=3, columns=6)
    geometry = dataclasses.replace(geometry, clusters={NASTY: 4})
    values = {"along x": rng.uniform(0.0, 1.0, 18), "along y": rng.uniform(0.0, larger, 18)}
    figure = tile_map_figure(geometry, values, "stiffness [N/m]", "Stiffness")
    bars = [axis for axis in figure.axes if axis.get_ylabel() == "stiffness [N/m]"]
    rows = [np.concatenate([*values.values()])] if larger < 2.0 else [*values.values()]
    ends = [(row.min(), row.max()) for row in rows]
    np.testing.assert_allclose([bar.get_ylim() for bar in bars], ends)
    maps = [axis for axis in figure.axes if axis.get_xlim()[0] < -180.0]
    for axis, row, scale in zip(maps, values.values(), [*ends, *ends], strict=False):
        squares = [c for c in axis.collections if isinstance(c, PolyCollection)][1]
        colours = squares.get_facecolors()
        np.testing.assert_allclose(colours, colormaps[SCALE](Normalize(*scale)(row)))
        # Its colours grow lighter with the value: they print in grey.
        lightness = colours[:, :3] @ [0.2126, 0.7152, 0.0722]
        assert (np.diff(lightness[np.argsort(row)]) > -0.01).all()
    assert NASTY in figure.get_supxlabel()


def test_maps_that_are_alike_share_a_scale_beside_another_one(rng):
    geometry = random_socket(rng, rings=3, columns=6)
    estimate, truth = rng.uniform(0.0, 30.0, 18), rng.uniform(0.0, 40.0, 18)
    maps = {"estimate": estimate, "its standard deviation": 0.1 * estimate, "truth": truth}
    first, second, third = scales_of(geometry, maps)
    assert first == third == (min(estimate.min(), truth.min()), max(estimate.max(), truth.max()))
    assert second == pytest.approx((0.1 * estimate.min(), 0.1 * estimate.max()))


def test_tiles_on_the_distal_end_alone_have_a_map(rng):
    geometry = random_socket(rng, rings=3, columns=6)
    upwards = np.tile(np.diag([-1.0, -1.0, 1.0]), (18, 1, 1))
    geometry = dataclasses.replace(geometry, rotations=upwards)
    values = {"along x": rng.uniform(0.0, 1.0, 18)}
    cluster = next(iter(geometry.clusters))
    figure = tile_map_figure(geometry, values, "N/m", "", notes={cluster: NASTY})
    assert f"1 {cluster}: {NASTY}" in figure.get_supxlabel()
    wall, end = figure.axes[0].collections[1], figure.axes[1].collections[0]
    assert len(wall.get_paths()) == 0 and len(end.get_paths()) == 18


def test_the_validation_shows_every_error_and_the_coverage():
    judgements = [
        Judgement(question, predictor, "left out", "", "a", cluster, 9, error, coverage=coverage)
        for question, cluster, errors in (
            ("cluster", NASTY, (0.8, 0.7, 0.5)),
            ("cluster", "", (0.9, 0.6, 0.4)),
            ("tiles", "", (0.5, 0.45, 0.3)),
        )
        for predictor, error, coverage in zip(
            (INVERSE_DISTANCE, CLOSED, FORCE_MAP),
            errors,
            ((np.nan,) * 3, (np.nan,) * 3, (0.5, 0.7, 0.9)),
            strict=True,
        )
    ]
    bars, coverage = validation_figure(judgements, NASTY).axes
    assert [text.get_text() for text in bars.get_yticklabels()] == [
        NASTY,
        "all clusters",
        "tiles without a sensor",
    ]
    widths = [[bar.get_width() for bar in shown] for shown in bars.containers]
    assert widths == [[0.8, 0.9, 0.5], [0.7, 0.6, 0.45], [0.5, 0.4, 0.3]]
    drawn = [line.get_xydata().tolist() for line in coverage.lines[1:]]
    assert drawn == [[[50.0, 50.0], [80.0, 70.0], [95.0, 90.0]]] * 2
