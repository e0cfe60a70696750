"""Where things stand in figures and on the page of a socket, against hand values."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from support import results_by_hand, scene
from support.pages import Page

from socket_testbed.errors import ConfigurationError
from socket_testbed.figures import tiles
from socket_testbed.figures.fronts import describe_front, pareto_figure
from socket_testbed.figures.pressure import draw_regions, group_regions
from socket_testbed.figures.style import (
    COLUMN,
    DEFAULT_STYLE,
    FigureStyle,
    figure_style,
    panels,
    thin,
    thin_band,
    wrap,
)
from socket_testbed.identification.pressure import Quantity
from socket_testbed.report.page import ReportFigure, line_chart, write_socket_page
from socket_testbed.trials.segment import Segment

# --- thinned lines


def test_a_thinned_line_keeps_lowest_and_highest() -> None:
    """Of every four points, in their order."""
    y = np.array([0.0, 5.0, -1.0, 2.0, 3.0, 3.0, 9.0, 1.0])
    x, kept = thin(10.0 * np.arange(8), y, 4)
    assert x.tolist() == [10.0, 20.0, 60.0, 70.0] and kept.tolist() == [5.0, -1.0, 9.0, 1.0]
    assert thin(y, y, 8)[0] is y


def test_a_thinned_band_keeps_its_outermost_ends() -> None:
    low = np.array([0.0, -5.0, 1.0, np.nan, 3.0])
    x, lowest, highest = thin_band(np.arange(5.0), low, low + 10.0, 3)
    assert x.tolist() == [0.0, 2.0, 4.0]
    assert lowest.tolist() == [-5.0, 1.0, 3.0] and highest.tolist() == [10.0, 11.0, 13.0]


def test_a_page_s_chart_holds_lines_and_spans() -> None:
    values = np.array([1.0, np.nan, 3.123456])
    lines = {"measured": values, "model": values + 1.0}
    segment = Segment("all", 0.5, 1.5, slice(1, 2))
    found = line_chart(np.array([0.0, 1.0, 2.0]), [{"title": "Fz [N]", "lines": lines}], [segment])
    assert found["over"] == "time [s]" and found["shaded"] == [[0.5, 1.5]]
    (panel,) = found["panels"]
    assert panel["title"] == "Fz [N]" and panel["lines"]["measured"]["x"] == [0.0, 1.0, 2.0]
    assert panel["lines"]["measured"]["y"] == [1.0, None, 3.1235]
    assert panel["lines"]["model"]["y"] == [2.0, None, 4.1235]
    assert panel["lines"]["measured"]["style"]["color"] == "#A6A6A6"  # grey
    assert panel["lines"]["model"]["style"]["color"] == "#D55E00"  # vermilion


# --- panels and styles


@pytest.mark.parametrize(
    ("count", "across", "labelled"), [(5, 2, [3, 4]), (4, 2, [2, 3]), (3, 3, [0, 1, 2])]
)
def test_the_lowest_panel_of_a_column_is_labelled(
    count: int, across: int, labelled: list[int]
) -> None:
    axes = panels(Figure(), count, across)
    assert [number for number, axis in enumerate(axes) if axis.get_xlabel()] == labelled
    assert len(axes[0].figure.axes) == count


@pytest.mark.parametrize(("width", "narrow"), [(88, True), (180, False)])
def test_a_column_is_narrow(width: float, narrow: bool) -> None:
    style = figure_style(width, title=True)
    assert style.is_narrow is narrow
    assert style.figure(50.8).get_size_inches() == pytest.approx([width / 25.4, 2.0])


def test_other_widths_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="a width of 100 mm"):
        figure_style(100, title=True)


@pytest.mark.parametrize(("titles", "shown"), [(True, "a title"), (False, "")])
def test_a_title_can_be_left_out(titles: bool, shown: str) -> None:
    figure = Figure()
    FigureStyle(COLUMN, titles).add_title(figure, "a title")
    assert figure.get_suptitle() == shown


def test_long_texts_are_broken() -> None:
    """About 60 mm of 8 pt type."""
    text = "as many words as it takes to fill more than a line"
    assert wrap(text, 100.0) == text
    lines = wrap(text, 40.0).split("\n")
    assert len(lines) == 2 and " ".join(lines) == text


@pytest.mark.parametrize(("drawn", "suffixes"), [(False, ["csv"]), (True, ["csv", "pdf", "png"])])
def test_a_figure_names_its_files(drawn: bool, suffixes: list[str]) -> None:
    found = ReportFigure("map", "", None, None).files(drawn)  # type: ignore[arg-type]
    assert found == [f"map.{suffix}" for suffix in suffixes]


# --- regions over time


def test_regions_are_drawn_four_to_a_panel() -> None:
    own = [f"own {number}" for number in range(6)]
    names = ["anterior", *own[:1], "distal", "lateral", *own[1:]]
    assert group_regions(names) == [
        ("sectors", ["anterior", "lateral"]),
        ("", own[:4]),
        ("", own[4:]),
        ("heights", ["distal"]),
    ]


@pytest.fixture(scope="module")
def courses() -> Figure:
    """Ten regions in four panels, three to a row, over 10 s, with events of two labels."""
    names = ["anterior", "distal", *(f"own {number}" for number in range(8))]
    time = np.linspace(0.0, 10.0, 11)
    value = 1e3 * (np.arange(10.0) + np.zeros((11, 1)))
    events = [(5.0, "push"), (1.0, "step"), (1.1, "step"), (9.0, "step"), (10.5, "late")]
    regions = {name: number for number, name in enumerate(names)}
    mean = Quantity(value, value - 500.0, value + 700.0, value)
    figure = DEFAULT_STYLE.figure(100.0)
    draw_regions(figure, time, mean, regions, events, DEFAULT_STYLE)
    return figure


def test_the_first_panel_of_a_row_is_labelled(courses: Figure) -> None:
    labels = [axis.get_ylabel() for axis in courses.axes]
    assert labels == ["pressure [kPa]", "", "", "pressure [kPa]"]


def test_a_region_is_in_kilopascals_with_its_band(courses: Figure) -> None:
    panel = courses.axes[2]
    (line,) = [line for line in panel.lines if line.get_label() == "own 2"]
    assert set(line.get_ydata()) == {4.0}
    band = panel.collections[2].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == pytest.approx((3.5, 4.7))


def test_events_are_numbered_where_there_is_space(courses: Figure) -> None:
    """By label in the order of time; the second step is too close for its number."""
    panel = courses.axes[0]
    dotted = [line.get_xdata()[0] for line in panel.lines if line.get_linestyle() == ":"]
    assert dotted == [1.0, 1.1, 5.0, 9.0]
    assert [(text.xy[0], text.get_text()) for text in panel.texts] == [
        (1.0, "1"), (5.0, "2"), (9.0, "1")
    ]  # fmt: skip
    assert courses.get_supxlabel() == "bands: 95 % intervals, events: 1 step, 2 push"


# --- fronts


@pytest.mark.parametrize(
    ("knee", "words"), [(None, "a: no knee"), (1, "a: knee at \N{GREEK SMALL LETTER THETA} = 0.25")]
)
def test_a_front_names_its_knee(knee: int | None, words: str) -> None:
    front: Any = SimpleNamespace(
        variant="a", theta=np.array([0.0, 0.25, 1.0]), knee=SimpleNamespace(index=knee)
    )
    assert describe_front(front) == words


def test_axes_of_a_wide_front_have_round_ticks() -> None:
    """1, 2 and 5 of each power of ten; a narrow one has even steps."""
    made = results_by_hand.fronts_by_hand()["stiffness"]  # both errors from 0.1 to 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConstrainedLayoutEngine, "execute", lambda *_: None)
        (axes,) = pareto_figure([made], "", DEFAULT_STYLE).axes
    shown = [tick for tick in axes.get_xticks() if 0.09 < tick < 1.1]
    assert shown == pytest.approx([0.1, 0.2, 0.5, 1.0])


# --- maps of tiles


@pytest.mark.parametrize(
    ("values", "ends"),
    [
        ([3.0, np.nan, -1.0], (-1.0, 3.0)),
        ([5.0, 5.0], (4.5, 5.5)),
        ([-5.0], (-5.5, -4.5)),
        ([0.0], (-1.0, 1.0)),
        ([np.nan], (0.0, 1.0)),
    ],
    ids=["range", "one", "negative", "zero", "none"],
)
def test_a_scale_spans_its_values(values: list[float], ends: tuple[float, float]) -> None:
    assert tiles.value_range(np.array(values)) == ends


def test_similar_ranges_share_a_scale() -> None:
    """Up to a factor of 2: 10 and 5, but not 4.9."""
    rows = {"a": [0.0, 10.0], "b": [2.0, 7.0], "c": [1.0, 5.9], "d": [3.0, 6.0]}
    found = tiles._scales_of({name: np.array(row) for name, row in rows.items()})
    assert found == [(0.0, 10.0), (0.0, 10.0), (1.0, 6.0), (1.0, 6.0)]


def test_an_uncertain_map_is_grey() -> None:
    """10 kPa with an interval 2.5 times as far: 85 % of the grey 150 / 255 over yellow's place."""
    twelve = np.full(12, 10.0)
    twelve[0] = 0.0
    paint = tiles.paint_tiles(scene.geometry(), twelve, (0.0, 10.0), 2.5 * twelve)
    patch, image = paint.images[0]
    row, column = np.abs(patch.y - 60.0).argmin(), np.abs(patch.x - 180.0).argmin()
    yellow = np.array([0.993, 0.906, 0.144])
    expected = 0.15 * yellow + 0.85 * 150.0 / 255.0
    assert image[row, column] == pytest.approx([*expected, 1.0], abs=0.02)


@pytest.fixture(scope="module")
def unknown() -> Figure:
    """Two maps in a column, `second` without a value on `ant_mid`."""
    values = {"first": np.arange(12.0), "second": np.arange(12.0)}
    values["second"][4] = np.nan
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConstrainedLayoutEngine, "execute", lambda *_: None)
        return tiles.tile_map_figure(
            scene.geometry(), values, "any [-]", "a title", FigureStyle(COLUMN)
        )


def test_a_tile_without_a_value_is_hatched(unknown: Figure) -> None:
    for axis, count in zip(unknown.axes[::2][:2], (0, 1), strict=True):
        _, hatches = axis.collections[:2]
        assert len(hatches.get_paths()) == count
    key = unknown.get_supxlabel().replace("\n", " ")
    assert key == (
        "1 brim_lateral, 2 mid_anterior, 3 posterior_distal, 4 distal, distal end: anterior up,"
        " hatched: no value"
    )


def test_maps_of_a_column_are_below_each_other(unknown: Figure) -> None:
    """The wall is 3.4 times as wide as the distal end; a single bar for one scale."""
    walls = unknown.axes[0], unknown.axes[2]
    assert [axis.get_title("left") for axis in walls] == ["first", "second"]
    assert [axis.get_subplotspec().rowspan.start for axis in walls] == [0, 1]
    assert walls[0].get_gridspec().get_width_ratios() == (3.4, 1.0)
    assert len(unknown.axes) == 5 and unknown.axes[4].get_ylabel() == "any [-]"
    assert [axis.get_title() for axis in unknown.axes[1:4:2]] == ["distal end"] * 2


def test_a_wall_shows_a_full_turn(unknown: Figure) -> None:
    """Tiles at 180 degrees reach beyond: 15 mm at 50 mm are 16.7 degrees; heights 0 to 140 mm.

    The highest corners are those of `left_prox`, 20 mm above its centre at 210 mm.
    """
    left, right = unknown.axes[0].get_xlim()
    assert (left, right) == pytest.approx((-183.0, 196.7 + 3.0), abs=0.1)
    low, high = unknown.axes[0].get_ylim()
    assert (low, high) == pytest.approx((-4.2, 144.2), abs=0.1)
    assert unknown.axes[0].get_ylabel() == "height [mm]"
    reach = unknown.axes[1].get_xlim()[1]
    assert reach == pytest.approx(1.06 * np.hypot(50.0, 20.0), abs=0.1)


# --- the page of a socket


@pytest.fixture(scope="module")
def socket_page(tmp_path_factory: pytest.TempPathFactory) -> Page:
    path = tmp_path_factory.mktemp("page") / "socket.html"
    surface = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]],
                              [[0, 1, 2], [1, 3, 2]], process=False)  # fmt: skip
    write_socket_page(surface, scene.geometry(), path, "a socket", [("tiles", "12")])
    return Page(path.read_text(encoding="utf-8"))


def test_a_socket_s_page_holds_its_surface(socket_page: Page) -> None:
    data = json.loads(socket_page.script("page-data"))
    assert data["socket"]["surface"] == {
        "points": [[0, 0, 0], [100.0, 0, 0], [0, 200.0, 0], [0, 0, 300.0]],
        "faces": [[0, 1, 2], [1, 3, 2]],
    }
    assert data["moments"] == [{"time": 0.0, "words": "12 tiles"}]
    assert data["start"] == 0.0 and data["kinds"] == ["tiles"]


def test_a_socket_s_page_shows_areas_and_heights(socket_page: Page) -> None:
    extras = json.loads(socket_page.script("page-data"))["extras"]
    area, height = extras["area [mm^2]"], extras["height [mm]"]
    assert (area["values"][0], area["values"][1], area["unit"]) == (900.0, 1600.0, "mm²")
    assert height["values"][::4] == [120.0, 60.0, 0.0] and height["unit"] == "mm"
    assert socket_page.rows("facts")["tiles"] == ["12"]
