"""The script of pages that open offline: reports, comparisons and sockets, with their charts.

Pages are written as `report.page` writes them. Expected values are worked out by hand.
"""

import json
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import trimesh
from support.hand_made import hand_bars, hand_cards, hand_course, hand_moment, hand_socket
from support.hand_outputs import (
    GEOMETRY,
    PRESSURE,
    REACH,
    made_bars,
    made_cards,
    made_course,
    made_moment,
    made_socket,
)
from support.tabs import INK, Picture, Tab, read_colour, small_viewer

from socket_testbed.identification.differences import DIFFERENCE, VALUE
from socket_testbed.identification.pressure import Quantity
from socket_testbed.report.comparison import _map_data
from socket_testbed.report.page import (
    Maps,
    Pictures,
    ReportFigure,
    Section,
    line_chart,
    write_page,
    write_socket_page,
)
from socket_testbed.trials.segment import Segment

TOO_OLD = "delete globalThis.DecompressionStream"
DATA, CHART = "data of the test", "chart of the test"  # stand for what differs between tests
PARTS: dict[str, Any] = {
    "report": Pictures("The socket"),
    "tiles": Pictures("The socket", over_time=False),
    "maps": Maps({"map-0": "a", "map-1": "b", "map-2": "b - a"}, "legend"),
    "chart": ReportFigure("wrench", "Wrench", lambda _: None, pd.DataFrame(), CHART),
}


@cache
def written(part: str) -> str:
    """The page of a part, written once: most of the time goes into reading its template."""
    with small_viewer() as folder:
        path = folder / "page.html"
        write_page(path, "title", "subtitle", {"": [Section("all", "", [PARTS[part]])]}, DATA)
        return path.read_text(encoding="utf-8")


def opened(part: str, data: dict[str, Any], before: str = "", chart: Any = None) -> Tab:
    """A page of a part with its data."""
    text = written(part)
    for mark, given in ((DATA, data), (CHART, chart)):
        text = text.replace(json.dumps(mark), json.dumps(given, allow_nan=False))
    return Tab(text, before=before)


def hand_data(**changed: Any) -> dict[str, Any]:
    """The data of a report: moments at 0, 10 and 20 s, of 10, 20 and 30 kPa everywhere."""
    moments = [hand_moment(time=t, pressure=[p] * 5) for t, p in ((0, 10), (10, 20), (20, 30))]
    mean = hand_moment(time=None, pressure=[15.0] * 5, words="mean over plateau")
    found = {
        "socket": hand_socket(),
        "course": hand_course(),
        "start": 9.0,
        "moments": moments,
        "mean": mean,
        "cards": hand_cards(),
        "bars": hand_bars(),
        "extras": {"stiffness": {"values": [1.0, 2.0, 3.0, 4.0, 5.0], "unit": "N/mm"}},
    }
    return found | changed


def report(before: str = "", **changed: Any) -> Tab:
    return opened("report", hand_data(**changed), before)


def shown(tab: Tab) -> tuple[str, float, float]:
    """The words, the pressure to the left and the place of the slider."""
    pressure = tab.picture("#map").heatmap().value(90.0, 60.0)
    return tab.text("#when"), pressure, float(tab.get("#cursor", "value"))


# --- a report


def test_report_opens_at_the_moment_nearest_its_start() -> None:
    assert shown(report()) == ("at 10.00 s", 20.0, 10.0)
    assert shown(report(start=19.0)) == ("at 20.00 s", 30.0, 20.0)


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        (4.9, ("at 0.00 s", 10.0, 0.0)),
        (5.1, ("at 10.00 s", 20.0, 10.0)),
        (14.0, ("at 10.00 s", 20.0, 10.0)),
        (38.0, ("at 20.00 s", 30.0, 20.0)),
    ],
)
def test_slider_shows_the_nearest_moment(time, expected) -> None:
    tab = report()
    tab.type("#cursor", time)
    assert shown(tab) == expected


def test_click_on_the_time_line_shows_that_moment() -> None:
    tab = report()
    tab.send("#course", "plotly_click", {"points": [{"x": 1.0}]})
    assert shown(tab) == ("at 0.00 s", 10.0, 0.0)
    assert tab.picture("#course").layout["shapes"][-1]["x0"] == 0.0


def test_mean_and_peak_are_buttons() -> None:
    tab = report()
    assert tab.texts("button") == ["At the peak", "Mean over the segment"]
    tab.click('button[data-moment="mean"]')
    assert shown(tab) == ("mean over plateau", 15.0, 10.0)  # the slider stays
    assert all(line["x0"] in (10.0, 25.0) for line in tab.picture("#course").layout["shapes"])
    tab.type("#cursor", 0.0)
    tab.click('button[data-moment="peak"]')
    assert shown(tab) == ("at 10.00 s", 20.0, 10.0)


def test_report_shows_cards_bars_course_and_models() -> None:
    tab = report()
    assert tab.texts("h3")[:2] == ["Peak", "Data"]
    assert tab.texts(".said")[0] == "20.0 (10.0 to 40.1)"
    assert tab.picture("#course").layout["xaxis"]["range"] == [0, 40]
    assert tab.options("#kind") == ["pressure", "shear", "stiffness"]
    tab.choose("#kind", "stiffness")
    assert tab.picture("#map").heatmap().hover(90.0, 60.0) == "2.0 N/mm"


def test_note_below_is_hidden_once_pictures_are_drawn() -> None:
    tab = report()
    assert tab.get("#state", "hidden") and tab.drawn("#map") == tab.drawn("#solid") == 1


def test_an_old_browser_is_named() -> None:
    tab = report(before=TOO_OLD)
    expected = "This browser is too old for the pictures; the numbers are below."
    assert tab.text("#state") == expected and not tab.get("#state", "hidden")
    assert not tab.drawn("#map")


def test_report_draws_what_the_documents_say() -> None:
    data = {
        "socket": made_socket(),
        "course": made_course(),
        "start": 10.0,
        "moments": [made_moment(0.0, 0.5), made_moment(10.0)],
        "mean": made_moment(0.0) | {"time": None, "words": "mean"},
        "cards": made_cards(),
        "bars": made_bars(),
        "extras": {},
    }
    tab = opened("report", data)
    wall = tab.picture("#map").heatmap()
    highest, angle, height = wall.highest()
    # 40 kPa at 90 degrees and 50 mm above the end; the grid is 12 degrees x 11 mm.
    assert highest == pytest.approx(40.0, rel=0.1)
    assert (angle, height) == (pytest.approx(90.0, abs=7.0), pytest.approx(50.0, abs=6.0))
    tab.type("#cursor", 0.0)
    assert tab.picture("#map").heatmap().highest()[0] == pytest.approx(0.5 * highest, rel=1e-3)
    # Tables and time line in kPa, N and %; the documents are given Pa, N and shares.
    lines = {line["name"]: line["y"] for line in tab.picture("#course").traces if line.get("name")}
    assert lines["peak pressure [kPa]"] == [5, 50, 8] and lines["95 % interval"] == [2, 40, 6]
    assert lines["force along the socket [N]"] == [100, 800, -20]
    assert tab.picture("#course").notes["push"]["x"] == 10.0
    said = {}
    for title in tab.options("#bar-value"):
        tab.choose("#bar-value", title)
        said[title] = set(tab.texts(".said"))
    assert said == {
        "mean pressure [kPa]": {"15.0 (12.0 to 18.0)"},
        "peak pressure [kPa]": {"40.0 (30.0 to 62.5)"},
        "contact area [cm^2]": {"90 (80 to 100)"},
        "share of load [%]": {"25 (20 to 30)"},
        "shear [kPa]": {"2.0 (1.0 to 3.0)"},
    }
    regions = tab.get("#bars", "children.slice(0, -1).map((row) => row.children[0].textContent)")
    assert regions[:4] == ["anterior", "posterior", "medial", "lateral"]
    assert tab.texts(".interval") == ["95 %: 30.0 to 62.5"] * 2
    assert tab.texts("#cards")[0].startswith(
        "Peak40.0 kPa95 %: 30.0 to 62.5lateral middle, estimated"
    )


def test_map_of_a_uniform_pressure_is_uniform() -> None:
    reach = {"reach": [35.0] * len(GEOMETRY), "grey": [0.5] * len(GEOMETRY)}
    moment = made_moment(0.0) | {"pressure": [20.0] * len(GEOMETRY)} | reach
    data = {"socket": made_socket(), "start": 0.0, "moments": [moment]}
    tab = opened("tiles", data)
    for axis in ("x", "x2"):
        heatmap, veil = tab.picture("#map").heatmap(axis), tab.picture("#map").veil(axis)
        for part, expected in ((heatmap.trace["z"], 20.0), (veil.trace["z"], 0.5)):
            values = [value for row in part for value in row if value is not None]
            np.testing.assert_allclose(values, expected, rtol=2e-3)
    assert heatmap.hover(0.0, 0.0) == "20.0 kPa, 95 %: -15.0 to 55.0"  # 20 +- 35 kPa


def test_document_puts_names_and_clusters_in_place() -> None:
    data = {"socket": made_socket(), "start": 0.0, "moments": [made_moment()]}
    picture = opened("tiles", data).picture("#map")
    axis = picture.layout["xaxis"]
    named = dict(zip(axis["ticktext"], axis["tickvals"], strict=True))
    assert named == {"posterior": 180, "medial": -90, "anterior": 0, "lateral": 90}  # a left leg
    heights = picture.layout["yaxis"]
    named = dict(zip(heights["ticktext"], heights["tickvals"], strict=True))
    # Middles of thirds of 80 mm.
    assert named == pytest.approx({"distal": 13.3, "middle": 40.0, "proximal": 66.7}, abs=0.1)
    notes = picture.notes
    assert (notes["front: <b>21.3</b>"]["x"], notes["front: <b>21.3</b>"]["y"]) == (0, 80)
    assert (notes["side"]["x"], notes["side"]["y"]) == (90, 50)  # its cluster measured nothing
    assert notes["<b>peak 40.0</b>"]["x"] == 90


def test_document_puts_the_surface_in_space() -> None:
    data = {"socket": made_socket(), "start": 0.0, "moments": [made_moment()]}
    picture = opened("tiles", data).picture("#solid")
    wall = picture.of_type("mesh3d")[0]
    points = np.transpose([wall["x"], wall["y"], wall["z"]])
    colours = [read_colour(colour) for colour in wall["vertexcolor"]]
    yellow = max(range(len(colours)), key=lambda at: colours[at][1] - colours[at][2])
    # left2 is 50 mm to the left (y), 130 mm above the load cell.
    np.testing.assert_allclose(points[yellow], [0.0, 50.0, 130.0], atol=7.0)
    assert picture.layout["scene"]["camera"]["up"] == {"x": 0, "y": 0, "z": 1}
    front = picture.of_type("scatter3d")[0]  # anterior3, of 30 mm
    assert set(front["x"]) == {50} and (min(front["y"]), max(front["y"])) == (-15, 15)
    assert (min(front["z"]), max(front["z"])) == (145, 175)


# --- a socket, and a comparison


def test_socket_page_shows_tiles_areas_and_heights() -> None:
    box = trimesh.creation.box((0.1, 0.1, 0.2))
    with small_viewer() as folder:
        path = folder / "socket.html"
        write_socket_page(box, GEOMETRY, path, "socket", [])
        tab = Tab(path.read_text(encoding="utf-8"))
    assert tab.text("#when") == "13 tiles"
    assert tab.options("#kind") == ["tiles", "area [mm^2]", "height [mm]"]
    assert not tab.picture("#map").of_type("heatmap")
    tab.choose("#kind", "height [mm]")
    heatmap = tab.picture("#map").heatmap()
    highest, _, height = heatmap.highest()
    assert highest == pytest.approx(height, abs=10.0) and highest == pytest.approx(80.0, abs=10.0)
    assert heatmap.trace["colorbar"]["title"]["text"] == "mm"
    tab.choose("#kind", "area [mm^2]")
    areas = tab.picture("#map").heatmap("x2")
    assert areas.value(0.0, 0.0) == pytest.approx(900.0, rel=1e-3)
    assert areas.hover(0.0, 0.0).endswith(" mm²")
    tab.choose("#kind", "tiles")
    assert not tab.picture("#map").of_type("heatmap")
    tab.wait(1.0)
    mesh = tab.picture("#solid").of_type("mesh3d")[-1]
    assert (min(mesh["x"]), max(mesh["x"]), min(mesh["z"]), max(mesh["z"])) == (-50, 50, -100, 100)


def comparison() -> Tab:
    """Two trials: the second has 30 kPa more, clearly, on `left2`, and 10 kPa less on the end."""
    names, change = GEOMETRY.names, np.zeros(len(GEOMETRY))
    change[names.index("left2")], change[names.index("end")] = 30.0, -10.0
    values = 1e-3 * np.array([PRESSURE, PRESSURE + 1e3 * change])
    reach = 1e-3 * np.array([REACH, REACH])
    difference = np.array([np.zeros(len(names)), change])
    by_kind = {
        VALUE: Quantity(values, values - reach, values + reach, values),
        DIFFERENCE: Quantity(difference, difference - 15.0, difference + 15.0, difference),
    }
    found = SimpleNamespace(
        geometry=GEOMETRY,
        side=None,
        items=["a", "b"],
        tile_pressures=by_kind.get,
        difference_title=lambda item: f"{item} - a",
    )
    data, titles = _map_data(found)
    assert titles == PARTS["maps"].maps
    return opened("maps", data | {"cards": hand_cards()})


def test_compared_trials_share_a_scale() -> None:
    tab = comparison()
    first, second = (tab.picture(f"#map-{number}").heatmap() for number in (0, 1))
    # The highest is 40 + 30 = 70 kPa: both scales end at 100.
    assert [one.trace["zmax"] for one in (first, second)] == [100, 100]
    assert first.highest()[0] == pytest.approx(40.0, rel=0.1)
    assert second.highest()[0] == pytest.approx(70.0, rel=0.1)
    assert first.colour(0.0) == (68, 1, 84) and first.colour(100.0) == (253, 231, 37)
    assert tab.texts("h3") == ["Peak", "Data"]


def test_differences_are_red_where_higher_grey_where_unclear() -> None:
    picture = comparison().picture("#map-2")
    change = picture.heatmap()
    # The largest difference is 30 kPa.
    assert (change.trace["zmin"], change.trace["zmax"]) == (-30, 30)
    highest, angle, height = change.highest()
    assert highest == pytest.approx(30.0, rel=0.1) and angle == pytest.approx(90.0, abs=7.0)
    assert change.colour(30.0) == (178, 24, 43) and change.colour(-30.0) == (33, 102, 172)
    assert picture.heatmap("x2").value(0.0, 0.0) < -5.0
    # 30 +- 15 kPa excludes zero, -10 +- 15 kPa does not.
    assert picture.veil().value(angle, height) < 0.2
    assert picture.veil("x2").value(0.0, 0.0) > 0.8


# --- charts


def chart(**changed: Any) -> dict[str, Any]:
    """Four panels, each with what is measured and a model."""
    panels = [
        {
            "title": f"F{k} [N] <&>",
            "lines": {
                "measured": {
                    "x": [0.0, 1.0],
                    "y": [10.0 * k, 10.0 * k + 1.0],
                    "style": {"width": 2.5, "color": "#A6A6A6"},
                },
                "fit <a>": {"x": [0.0, 2.0], "y": [-1.0, -2.0], "style": {"dash": "2px"}},
            },
        }
        for k in range(1, 5)
    ]
    return {"over": "time [s]", "panels": panels, "shaded": [[15.0, 20.0]]} | changed


def with_chart(content: dict[str, Any], width: int = 900) -> Tab:
    """A page with a chart that is so wide [px]."""
    before = f"browser.find('#chart-wrench').clientWidth = {width}"
    return opened("chart", {"cards": []}, before, content)


def drawn_chart(width: int = 900, **changed: Any) -> Picture:
    return with_chart(chart(**changed), width).picture("#chart-wrench")


def test_each_panel_has_its_lines() -> None:
    traces = drawn_chart().traces
    found = [(line["name"], line["x"], line["y"], line["xaxis"], line["yaxis"]) for line in traces]
    expected = []
    for k, end in enumerate(("", "2", "3", "4"), start=1):
        axes = f"x{end}", f"y{end}"
        expected += [
            ("measured", [0, 1], [10 * k, 10 * k + 1], *axes),
            ("fit &lt;a>", [0, 2], [-1, -2], *axes),
        ]
    assert found == expected
    assert {line["mode"] for line in traces} == {"lines"}


def test_each_name_is_in_the_legend_once() -> None:
    traces = drawn_chart().traces
    assert [line["showlegend"] for line in traces] == [True, True] + 6 * [False]
    # A click in the legend hides the line in all panels.
    assert len({line["legendgroup"] for line in traces[::2]}) == 1
    assert traces[0]["legendgroup"] != traces[1]["legendgroup"]


def test_lines_have_their_style_or_the_ink() -> None:
    measured, fit = drawn_chart().traces[:2]
    assert measured["line"] == {"color": "#A6A6A6", "width": 2.5}
    assert fit["line"] == {"color": INK, "dash": "2px"}


def test_panels_are_titled_at_their_upper_left() -> None:
    notes = drawn_chart().notes
    assert list(notes) == [f"<b>F{k} [N] &lt;&amp;></b>" for k in range(1, 5)]
    places = [(note["xref"], note["yref"], note["x"], note["y"]) for note in notes.values()]
    ends = ("", "2", "3", "4")
    assert places == [(f"x{end} domain", f"y{end} domain", 0, 1) for end in ends]


@pytest.mark.parametrize(
    ("width", "rows", "columns", "titled"),
    [
        # The lowest panel of each column names the axis.
        pytest.param(900, 2, 3, ["", "time [s]", "time [s]", "time [s]"], id="wide"),
        pytest.param(600, 4, 1, ["", "", "", "time [s]"], id="narrow"),
    ],
)
def test_panels_fill_the_width(width, rows, columns, titled) -> None:
    layout = drawn_chart(width=width).layout
    grid = layout["grid"]
    assert (grid["rows"], grid["columns"], grid["pattern"]) == (rows, columns, "independent")
    axes = ("xaxis", "xaxis2", "xaxis3", "xaxis4")
    assert [layout[axis]["title"]["text"] for axis in axes] == titled
    assert layout["height"] == 60 + 190 * rows


def test_two_panels_take_two_columns() -> None:
    layout = drawn_chart(panels=chart()["panels"][:2]).layout
    assert (layout["grid"]["rows"], layout["grid"]["columns"]) == (1, 2)
    assert layout["xaxis"]["title"]["text"] == layout["xaxis2"]["title"]["text"] == "time [s]"


def test_segment_is_shaded_in_every_panel() -> None:
    shapes = drawn_chart(shaded=[[15.0, 20.0], [30.0, 31.0]]).layout["shapes"]
    spans = [(shape["xref"], shape["yref"], shape["x0"], shape["x1"]) for shape in shapes]
    assert spans[:2] == [("x", "y domain", 15, 20), ("x", "y domain", 30, 31)]
    assert spans[-1] == ("x4", "y4 domain", 30, 31) and len(spans) == 8
    for shape in shapes:
        assert (shape["type"], shape["y0"], shape["y1"], shape["layer"]) == ("rect", 0, 1, "below")


def test_fronts_are_dots_on_logarithmic_axes() -> None:
    content = chart(dots=True, log=True, over="wrench error [-]")
    del content["shaded"]
    picture = with_chart(content).picture("#chart-wrench")
    assert {line["mode"] for line in picture.traces} == {"lines+markers"}
    axes = [axis for name, axis in picture.layout.items() if name[1:5] == "axis"]
    assert len(axes) == 8 and {axis["type"] for axis in axes} == {"log"}
    assert picture.layout["xaxis4"]["title"]["text"] == "wrench error [-]"
    linear = drawn_chart().layout
    assert linear["xaxis"]["type"] == linear["yaxis"]["type"] == "-"


def test_folded_chart_is_drawn_once_when_unfolded() -> None:
    tab = with_chart(chart(), width=0)
    assert tab.drawn("#chart-wrench") == 0
    tab.send("body", "toggle")
    assert tab.drawn("#chart-wrench") == 0  # another group
    tab.run("browser.find('#chart-wrench').clientWidth = 500")
    tab.send("body", "toggle")
    tab.send("body", "toggle")
    assert tab.drawn("#chart-wrench") == 1
    assert tab.picture("#chart-wrench").how == "newPlot"


def test_chart_draws_what_the_document_says() -> None:
    time = np.array([0.0, 1.0, 2.0])
    panels = [{"title": "Fz [N]", "lines": {"measured": np.array([1.0, np.nan, 3.0]), "m": -time}}]
    content = line_chart(time, panels, [Segment("plateau", 0.5, 1.5, slice(0, 2))])
    picture = with_chart(content).picture("#chart-wrench")
    assert [(line["name"], line["y"]) for line in picture.traces] == [
        ("measured", [1, None, 3]),
        ("m", [0, -1, -2]),
    ]
    assert [line["x"] for line in picture.traces] == [[0, 1, 2], [0, 1, 2]]
    assert picture.layout["xaxis"]["title"]["text"] == "time [s]"
    (shape,) = picture.layout["shapes"]
    assert (shape["x0"], shape["x1"]) == (0.5, 1.5)
    assert picture.traces[0]["line"]["color"] == "#A6A6A6"  # measured is grey
