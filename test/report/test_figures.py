"""The figures hold what they were given."""

import dataclasses

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.collections import PolyCollection, QuadMesh
from matplotlib.colors import Normalize
from support.problems import random_socket, ring_socket

from socket_testbed.identification.evaluation import channel_errors
from socket_testbed.identification.pressure import Quantity
from socket_testbed.identification.validation import CLOSED, FORCE_MAP, INVERSE_DISTANCE, Judgement
from socket_testbed.report.channels import wrench_section
from socket_testbed.report.page import Section
from socket_testbed.report.pressure import draw_regions, group_regions
from socket_testbed.report.quality import section as quality_section
from socket_testbed.report.style import (
    DEFAULT_STYLE,
    LINE_STYLES,
    MOST_POINTS,
    SCALE,
    thin,
    thin_band,
)
from socket_testbed.report.tiles import tile_map_figure
from socket_testbed.report.validation import validation_figure

NASTY, UNIT = "a$_b <i>", "pressure [kPa]"


@pytest.fixture
def rng():
    return np.random.default_rng(6)


def drawn(section: Section, name: str):
    (figure,) = [figure for figure in section.figures if figure.name == name]
    return figure.draw(DEFAULT_STYLE)


def test_a_panel_draws_every_model_with_its_errors(results):
    axis, candidates = drawn(wrench_section(results), "wrench").axes[0], results.candidates
    expected = [results.samples.wrench[:, 3], *(c.predicted[:, 3] for c in candidates)]
    for line, values in zip(axis.lines, expected, strict=True):
        points = np.stack([results.samples.time, values], axis=1)
        np.testing.assert_array_equal(line.get_xydata(), points)
    measured, *key = [text.get_text() for text in axis.get_legend().get_texts()]
    assert measured == "measured" and axis.get_ylabel() == "force [N]"
    for text, candidate in zip(key, candidates, strict=True):
        error = candidate.errors[3]
        assert text.startswith(f"{candidate.label}:\nRMSE {error.rmse:.2f}, MAE {error.mae:.2f}")
        assert f"{error.sigma:.2f} N, skill" in text
    assert len({line.get_color() for line in axis.lines}) == 5

    first, *others = candidates
    errors = [*first.errors]
    errors[3] = channel_errors("Fx", *[np.full(3, np.nan)] * 2)
    errors[4] = dataclasses.replace(errors[4], in_objective=False)
    changed = dataclasses.replace(first, errors=tuple(errors))
    spoilt = dataclasses.replace(results, candidates=(changed, *others))
    legends = [axis.get_legend() for axis in drawn(wrench_section(spoilt), "wrench").axes[:2]]
    assert "no value" in legends[0].get_texts()[1].get_text()
    assert legends[1].get_title().get_text() == "Fy (not in objective)"


def test_a_thinned_line_keeps_its_peaks_its_order_and_its_gaps(rng):
    for count, most in ((10, 100), (1001, MOST_POINTS), (12_345, 10), (12_345, MOST_POINTS)):
        x, y = np.arange(count) / 4.0, rng.normal(size=count)
        thin_x, thin_y = thin(x, y, most)
        assert len(thin_x) <= most
        assert (np.diff(thin_x) >= 0.0).all()
        assert (thin_y.min(), thin_y.max()) == (y.min(), y.max())
        np.testing.assert_array_equal(thin_y, y[np.round(thin_x * 4.0).astype(int)])
    low, high = rng.normal(size=(2, 10_001))
    low[4000:6000] = np.nan
    x, kept = thin(np.arange(10_001.0), low, 500)
    assert np.isnan(kept[(x >= 4100) & (x < 5900)]).all()
    thinned = thin_band(np.arange(10_001.0), low, high, 500)
    assert all(len(part) <= 500 for part in thinned)
    assert np.nanmin(thinned[1]) == np.nanmin(low) and thinned[2].max() == high.max()


def test_the_overview_shows_when_what_was_lost(results):
    samples = dataclasses.replace(results.samples, wrench=results.samples.wrench.copy())
    samples.wrench[80:160, 2] = np.nan  # two in a bin
    spoilt = dataclasses.replace(results, samples=samples)
    raster = drawn(quality_section(spoilt), "overview").axes[2]
    (mesh,) = [c for c in raster.collections if isinstance(c, QuadMesh)]
    names = [label.get_text() for label in raster.get_yticklabels()]
    share = np.asarray(mesh.get_array()).reshape(len(names), -1)[names.index("Mz")]
    assert share.sum() * 2.0 == pytest.approx(80.0, abs=2.0)
    assert share[60] == 1.0 and share[20] == share[100] == 0.0


def test_the_validation_shows_every_error_and_the_coverage():
    unknown, known = (np.nan,) * 3, (0.5, 0.7, 0.9)
    predictors = ((INVERSE_DISTANCE, unknown), (CLOSED, unknown), (FORCE_MAP, known))
    errors = {
        ("cluster", NASTY): (0.8, 0.7, 0.5),
        ("cluster", ""): (0.9, 0.6, 0.4),
        ("tiles", ""): (0.5, 0.45, 0.3),
    }
    judgements = [
        Judgement(question, predictor, "left out", "", "a", cluster, 9, error, coverage=coverage)
        for (question, cluster), found in errors.items()
        for (predictor, coverage), error in zip(predictors, found, strict=True)
    ]
    bars, coverage = validation_figure(judgements, NASTY).axes
    names = [text.get_text() for text in bars.get_yticklabels()]
    assert names == [NASTY, "all clusters", "tiles without a sensor"]
    widths = [[bar.get_width() for bar in shown] for shown in bars.containers]
    assert widths == [list(row) for row in zip(*errors.values(), strict=True)]
    lines = [line.get_xydata().tolist() for line in coverage.lines[1:]]
    assert lines == [[[50.0, 50.0], [80.0, 70.0], [95.0, 90.0]]] * 2


def scales_of(figure) -> list[tuple[float, float]]:
    return [axis.get_ylim() for axis in figure.axes if axis.get_ylabel() == UNIT]


def test_tiles_have_the_colours_of_their_values_on_one_scale_unless_their_ranges_differ(rng):
    geometry = dataclasses.replace(random_socket(rng, rings=3, columns=6), clusters={NASTY: 4})
    for larger in (1.5, 9.0):
        values = {"x": rng.uniform(0.0, 1.0, 18), "y": rng.uniform(0.0, larger, 18)}
        figure = tile_map_figure(geometry, values, UNIT)
        rows = [np.concatenate([*values.values()])] if larger < 2.0 else [*values.values()]
        ends = [(row.min(), row.max()) for row in rows]
        np.testing.assert_allclose(scales_of(figure), ends)
        maps = [axis for axis in figure.axes if axis.get_xlim()[0] < -180.0]
        for axis, row, scale in zip(maps, values.values(), [*ends, *ends], strict=False):
            squares = next(c for c in axis.collections if isinstance(c, PolyCollection))
            expected = colormaps[SCALE](Normalize(*scale)(row))
            np.testing.assert_allclose(squares.get_facecolors(), expected)
        assert figure.get_supxlabel() == f"1 {NASTY}"
    # Pressure begins at zero; what has no value is hatched; a scale always has two ends.
    values = rng.uniform(5.0, 30.0, 18)
    values[3] = np.nan
    figure = tile_map_figure(geometry, {"mean": values}, UNIT, from_zero=True)
    hatched = sum(len(c.get_paths()) for a in figure.axes for c in a.collections if c.get_hatch())
    assert hatched == 1 and "hatched: no value" in figure.get_supxlabel()
    np.testing.assert_allclose(scales_of(figure), [(0.0, np.nanmax(values))])
    for same in (5.0, 0.0, -3.0, np.nan):
        ((low, high),) = scales_of(tile_map_figure(geometry, {"": np.full(18, same)}, UNIT))
        assert low < high and not (same < low or same > high)


def test_a_map_with_intervals_is_smooth_and_greyer_where_they_reach_far():
    geometry = ring_socket()
    values, known = np.full(len(geometry), 20.0), {"x": np.zeros(len(geometry))}
    unknown = {"x": np.full(len(geometry), 60.0)}
    colour = colormaps[SCALE](Normalize(0.0, 40.0)(20.0))[:3]
    for reach, expected in ((known, colour), (unknown, 0.15 * np.array(colour) + 0.85 * 150 / 255)):
        figure = tile_map_figure(geometry, {"x": values}, UNIT, limits=(0.0, 40.0), reach=reach)
        for panel in figure.axes[:2]:  # wall and end
            image = np.asarray(panel.images[0].get_array())
            shown = image[image[..., 3] == 1.0][:, :3]
            assert len(shown) > 100
            np.testing.assert_allclose(shown, np.broadcast_to(expected, shown.shape), atol=5e-3)
        grey = "the greyer, the less certain" in figure.get_supxlabel()
        assert grey == (reach is unknown)
    sides = {"right": ("medial", "lateral"), "left": ("lateral", "medial"), None: ("left", "right")}
    for side, (at_left, at_right) in sides.items():
        axis = tile_map_figure(geometry, {"mean": geometry.areas}, "", side=side).axes[0]
        names = [label.get_text().split("\n")[1].strip(".") for label in axis.get_xticklabels()]
        assert np.array_equal(axis.get_xticks(), [-180, -90, 0, 90, 180])
        for name, full in zip(names[1:], (at_right, "anterior", at_left, "posterior"), strict=True):
            assert full.startswith(name)


def test_regions_have_their_panels_lines_bands_and_events(rng):
    sides = ("anterior", "lateral", "posterior", "medial")
    parts = group_regions([*sides, "proximal", "fibula head", *(f"r{i}" for i in LINE_STYLES)])
    assert [heading for heading, _ in parts] == ["sectors", "heights", "", ""]
    time, values = np.linspace(0.0, 60.0, 250), rng.normal(10.0, 1.0, (250, 2))
    mean = Quantity(1e3 * values, 1e3 * values - 2e3, 1e3 * values + 3e3, 0.0 * values)
    events = [(30.0, "removed"), (10.0, "placed"), (50.0, "placed")]
    figure = DEFAULT_STYLE.figure(60.0)
    draw_regions(figure, time, mean, {"a$_b": 1, "fibula head": 0}, events, DEFAULT_STYLE)
    (axis,) = figure.axes
    lines = [line for line in axis.lines if len(line.get_xdata()) == 250]
    for line, shade, row in zip(lines, axis.collections, values.T[::-1], strict=True):
        np.testing.assert_allclose(line.get_xydata(), np.stack([time, row], axis=1))
        points = shade.get_paths()[0].vertices[:, 1]
        assert (points.min(), points.max()) == pytest.approx((row.min() - 2.0, row.max() + 3.0))
    marks = sorted(line.get_xdata()[0] for line in axis.lines if len(line.get_xdata()) == 2)
    assert marks == [10.0, 30.0, 50.0] and "1 placed, 2 removed" in figure.get_supxlabel()
