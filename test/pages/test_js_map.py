"""The map of socket.js: what stands at which place, in which colour, under which words.

Expected values are worked out by hand from `support.hand_made`.
"""

import json
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from support.hand_made import hand_moment, hand_socket
from support.tabs import DARK, INK, NARROW, Picture, Tab, read_colour

from socket_testbed.figures.scale import FIXED_ENDS

BOXES = """<html><body><div id="map"></div>
<script src="plotly.js"></script><script src="socket.js"></script></body></html>"""
VIOLET, TEAL, YELLOW = (68, 1, 84), (33, 145, 140), (253, 231, 37)  # viridis at 0, 0.5 and 1
BLUE, WHITE, RED = (33, 102, 172), (247, 247, 247), (178, 24, 43)
TWO_TILES = {"clusters": {}, "regions": {}}


def opened(socket: dict[str, Any] | None = None, setting: str = "", before: str = "") -> Tab:
    """A map of a socket; `setting` changes it before anything is shown."""
    tab = Tab(BOXES, before=before)
    tab.run(f"const map = new SocketMap(byId('map'), null, {json.dumps(socket or hand_socket())})")
    tab.run(setting)
    return tab


def show(tab: Tab, moment: dict[str, Any]) -> Picture:
    """The map once it shows a moment."""
    tab.run(f"map.show({json.dumps(moment)})")
    return tab.picture("#map")


def drawn(moment: dict[str, Any] | None = None, **how: Any) -> Picture:
    return show(opened(**how), hand_moment() if moment is None else moment)


def outlines(picture: Picture, **look: Any) -> list[dict[str, Any]]:
    """The outlines whose line has this look."""
    lines = picture.of_type("scatter")
    return [line for line in lines if look.items() <= line["line"].items()]


# --- values at their places


@pytest.mark.parametrize(
    ("axis", "angle", "height", "expected"),
    [
        pytest.param("x", 0.0, 90.0, 10.0, id="anterior"),
        pytest.param("x", 90.0, 60.0, 20.0, id="left"),
        pytest.param("x", -90.0, 60.0, 40.0, id="right"),
        pytest.param("x", -180.0, 30.0, 30.0, id="posterior"),
        pytest.param("x", 180.0, 30.0, 30.0, id="posterior, other border"),
        pytest.param("x", 90.0, 90.0, 25.0, id="mean of four: (10 + 20 + 30 + 40) / 4"),
        pytest.param("x", 0.0, 30.0, 7.5, id="1.25 x 10 - 0.25 x 20"),
        pytest.param("x", -180.0, 60.0, 22.5, id="-0.25 x 10 + 1.25 x 20"),
        pytest.param("x", 180.0, 90.0, None, id="no wall"),
        pytest.param("x2", -10.0, 10.0, 45.0, id="end"),
        pytest.param("x2", 10.0, 10.0, None, id="no end"),
    ],
)
def test_each_place_has_its_tiles_pressure(axis, angle, height, expected) -> None:
    assert drawn().heatmap(axis).value(angle, height) == expected


@pytest.mark.parametrize(
    ("axis", "angle", "height", "text"),
    [
        pytest.param("x", 0.0, 90.0, "10.0 kPa, 95 %: 9.0 to 11.0", id="10 +- 1"),
        pytest.param("x", 90.0, 60.0, "20.0 kPa, 95 %: 8.0 to 32.0", id="20 +- 12"),
        pytest.param("x", -90.0, 60.0, "40.0 kPa, 95 %: 36.0 to 44.0", id="40 +- 4"),
        # (1 + 12 + 3 + 4) / 4 = 5
        pytest.param("x", 90.0, 90.0, "25.0 kPa, 95 %: 20.0 to 30.0", id="25 +- 5"),
        # 1.25 x 1 - 0.25 x 12 < 0
        pytest.param("x", 0.0, 30.0, "7.5 kPa, 95 %: 7.5 to 7.5", id="no negative reach"),
        pytest.param("x2", 0.0, 0.0, "45.0 kPa, 95 %: -5.0 to 95.0", id="45 +- 50"),
    ],
)
def test_pointer_reads_value_low_and_high(axis, angle, height, text) -> None:
    assert drawn().heatmap(axis).hover(angle, height) == text


@pytest.mark.parametrize(
    ("axis", "angle", "height", "veil"),
    [
        pytest.param("x", -90.0, 60.0, 0.0, id="certain"),
        pytest.param("x", 180.0, 30.0, 0.5, id="halfway"),
        pytest.param("x", 0.0, 90.0, 1.0, id="uncertain"),
        pytest.param("x", 0.0, 30.0, 1.0, id="1.25 is at most 1"),
        pytest.param("x", -180.0, 60.0, 0.0, id="-0.25 is at least 0"),
        pytest.param("x2", 0.0, 0.0, 0.2, id="end"),
    ],
)
def test_veil_is_thicker_where_less_certain(axis, angle, height, veil) -> None:
    found = drawn().veil(axis)
    assert found.value(angle, height) == pytest.approx(veil, abs=1e-3)
    assert (found.trace["zmin"], found.trace["zmax"]) == (0, 1)
    # Grey of the socket's document, and as opaque as that says at the thickest.
    assert found.trace["colorscale"] == [[0, "rgba(150,150,150,0)"], [1, "rgba(150,150,150,0.85)"]]
    assert not found.trace["showscale"]


def test_wall_and_end_have_own_axes() -> None:
    picture = drawn()
    found = [(trace["xaxis"], trace["yaxis"]) for trace in picture.of_type("heatmap")]
    assert found == [("x", "y"), ("x", "y"), ("x2", "y2"), ("x2", "y2")]
    assert {trace["zsmooth"] for trace in picture.of_type("heatmap")} == {"best"}
    assert picture.heatmap().trace["x"] == [-180, -90, 0, 90, 180]
    assert picture.heatmap().trace["y"] == [30, 60, 90]


def test_shear_has_neither_interval_nor_veil() -> None:
    picture = drawn(setting="map.kind = 'shear'")
    assert picture.heatmap().hover(90.0, 60.0) == "2.0 kPa"
    assert not picture.has_veil("x") and not picture.has_veil("x2")
    assert not any("peak" in text for text in picture.notes)
    assert "front" in picture.notes  # without its measured pressure


def test_missing_pressure_counts_as_none() -> None:
    picture = drawn(hand_moment(pressure=[None, 20.0, 30.0, 40.0, None]))
    assert picture.heatmap().value(0.0, 90.0) == 0.0
    assert picture.notes["<b>peak 40.0</b>"]["x"] == -90.0


# --- colours and their scale


def test_colours_are_viridis() -> None:
    colours = [read_colour(colour) for _, colour in drawn().heatmap().trace["colorscale"]]
    reference = 255.0 * mpl.colormaps["viridis"](np.linspace(0.0, 1.0, 11))[:, :3]
    np.testing.assert_allclose(colours, reference, atol=1.0)


@pytest.mark.parametrize(
    ("pressure", "colour"),
    [
        pytest.param(0.0, VIOLET, id="lowest"),
        # The square root of a quarter is a half.
        pytest.param(12.5, TEAL, id="a quarter"),
        pytest.param(50.0, YELLOW, id="highest"),
        pytest.param(70.0, YELLOW, id="above"),
        pytest.param(-5.0, VIOLET, id="below"),
    ],
)
def test_low_is_violet_and_high_yellow(pressure, colour) -> None:
    for axis in ("x", "x2"):
        assert drawn().heatmap(axis).colour(pressure) == colour


@pytest.mark.parametrize(
    ("highest", "end"),
    [
        (0.0, 50),
        (49.9, 50),
        (50.0, 50),
        (50.1, 100),
        (100.0, 100),
        (101.0, 200),
        (200.5, 400),
        (400.0, 400),
        (401.0, 401),
    ],
)
def test_scale_ends_above_the_highest_pressure(highest, end) -> None:
    picture = drawn(hand_moment(pressure=[0.0, 0.0, 0.0, 0.0, highest]))
    for axis in ("x", "x2"):
        heatmap = picture.heatmap(axis).trace
        assert (heatmap["zmin"], heatmap["zmax"]) == (0, end)


def test_scale_never_shrinks() -> None:
    tab = opened()
    ends = [
        show(tab, hand_moment(pressure=[highest] * 5)).heatmap().trace["zmax"]
        for highest in (20.0, 120.0, 20.0, 500.0, 20.0)
    ]
    assert ends == [50, 200, 200, 500, 500]


def test_tension_does_not_widen_the_scale() -> None:
    picture = drawn(hand_moment(pressure=[-60.0, 0.0, 0.0, 0.0, 30.0]))
    assert (picture.heatmap().trace["zmin"], picture.heatmap().trace["zmax"]) == (0, 50)


def test_chosen_scale_holds_for_any_pressure() -> None:
    tab = opened(setting="map.chosen = 25")
    assert show(tab, hand_moment()).heatmap().trace["zmax"] == 25
    tab.run("map.chosen = undefined")
    assert show(tab, hand_moment()).heatmap().trace["zmax"] == 50


@pytest.mark.parametrize(
    ("change", "colour"),
    [
        pytest.param(-8.0, BLUE, id="lower is blue"),
        pytest.param(0.0, WHITE, id="no change is white"),
        pytest.param(8.0, RED, id="higher is red"),
    ],
)
def test_differences_diverge_from_white(change, colour) -> None:
    picture = drawn(setting="Object.assign(map, {chosen: 8, diverging: true})")
    heatmap = picture.heatmap()
    assert (heatmap.trace["zmin"], heatmap.trace["zmax"]) == (-8, 8)
    assert heatmap.colour(change) == colour
    assert not any("peak" in text for text in picture.notes)


def test_halves_of_the_diverging_scale_blend() -> None:
    heatmap = drawn(setting="Object.assign(map, {chosen: 8, diverging: true})").heatmap()
    assert heatmap.colour(-4.0) == (103, 169, 207)  # light blue, #67a9cf
    assert heatmap.colour(4.0) == (244, 165, 130)  # light red, #f4a582


@pytest.mark.parametrize(
    ("values", "low", "high"),
    [
        pytest.param([5.0, 10.0, 15.0, 20.0, 40.0], 0, 40, id="positive: from zero"),
        pytest.param([None, 10.0, 15.0, 20.0, 30.0], 0, 30, id="one unknown"),
    ],
)
def test_other_values_span_their_own_scale(values, low, high) -> None:
    extras = json.dumps({"area": {"values": values, "unit": "mm²"}})
    picture = drawn(setting=f"Object.assign(map, {{extras: {extras}, kind: 'area'}})")
    heatmap = picture.heatmap()
    assert (heatmap.trace["zmin"], heatmap.trace["zmax"]) == (low, high)
    assert heatmap.colour(0.5 * (low + high)) == TEAL  # evenly spread
    assert heatmap.hover(90.0, 60.0) == f"{values[1]:.1f} mm²"
    assert heatmap.trace["colorbar"]["title"]["text"] == "mm²"
    assert not picture.has_veil()


@pytest.mark.parametrize(
    ("values", "end"),
    [
        pytest.param([-5.0, 10.0, 15.0, 20.0, 40.0], 40, id="both signs"),
        pytest.param([-50.0, 10.0, 15.0, 20.0, 40.0], 50, id="more below"),
        pytest.param([-5.0, -4.0, -3.0, -2.0, -1.0], 5, id="negative"),
    ],
)
def test_values_of_either_sign_diverge(values, end) -> None:
    extras = json.dumps({"offset": {"values": values, "unit": "mm"}})
    heatmap = drawn(setting=f"Object.assign(map, {{extras: {extras}, kind: 'offset'}})").heatmap()
    assert (heatmap.trace["zmin"], heatmap.trace["zmax"]) == (-end, end)
    assert [heatmap.colour(value) for value in (-end, 0.0, end)] == [BLUE, WHITE, RED]


@pytest.mark.parametrize(
    ("highest", "end"), [(1.0, 5), (5.0, 5), (5.5, 10), (60.0, 100), (130.0, 130)]
)
def test_shear_has_its_own_scale(highest, end) -> None:
    tab = opened(setting="map.kind = 'shear'")
    heatmap = show(tab, hand_moment(shear=[0.0, 0.0, 0.0, 0.0, highest])).heatmap()
    assert (heatmap.trace["zmin"], heatmap.trace["zmax"]) == (0, end)
    tab.run("map.kind = 'pressure'")
    assert show(tab, hand_moment()).heatmap().trace["zmax"] == 50  # each kind keeps its own


def test_shear_is_drawn_with_arrows() -> None:
    """36 px at the end of the scale, 10 kPa; 0.1 kPa are too little, more is no longer."""
    arrows = [[0.0, 5.0], [5.0, 0.0], [0.0, 0.1], [None, None], [-24.0, -32.0]]
    moment = hand_moment(shear=[5.0, 5.0, 0.1, 0.0, 10.0], arrows=arrows)
    picture = drawn(moment, setting="map.kind = 'shear'")
    found = [note for note in picture.layout["annotations"] if note["showarrow"]]
    places = [(note["xref"], note["x"], note["y"]) for note in found]
    assert places == [("x", 0, 90), ("x", 90, 60), ("x2", 10, -5)]
    # From the tail to the tip, upwards counts negative; its middle is at the tile.
    tails = [(note["ax"], note["ay"], note["xshift"], note["yshift"]) for note in found]
    assert tails[0] == pytest.approx((0.0, 18.0, 0.0, 9.0))
    assert tails[1] == pytest.approx((-18.0, 0.0, 9.0, 0.0))
    assert tails[2] == pytest.approx((21.6, -28.8, -10.8, -14.4))
    assert not any(note["showarrow"] for note in drawn(moment).layout["annotations"])


def test_a_mean_has_no_peak() -> None:
    notes = drawn(hand_moment(highest="highest mean")).notes
    assert "<b>highest mean 45.0</b>" in notes and "<b>peak 45.0</b>" not in notes


def test_only_the_wall_shows_the_scale() -> None:
    picture = drawn()
    assert picture.heatmap("x").trace["showscale"] and not picture.heatmap("x2").trace["showscale"]
    assert picture.heatmap().trace["colorbar"]["title"]["text"] == "kPa"


def test_an_end_alone_shows_its_scale() -> None:
    end = hand_socket()["patches"][1]
    picture = drawn(socket=hand_socket(patches=[end], on_wall=[False] * 5))
    assert picture.heatmap("x2").trace["showscale"]
    assert picture.layout["xaxis2"]["domain"] == [0, 1]
    assert "xaxis" not in picture.layout and not picture.layout["shapes"]


def test_legend_shows_the_colours_of_the_map() -> None:
    style = opened().evaluate("document.documentElement.style")
    colours = [read_colour(colour) for colour in style["--certain"].replace("),", ");").split(";")]
    assert len(colours) == 11 and (colours[0], colours[-1]) == (VIOLET, YELLOW)
    # Viridis at 0.4, and the same 85 % of the way to the grey of 150: 42 + 0.85 x 108 and so on.
    assert style["--uncertain"] == "rgb(42,120,142),rgb(134,146,149)"


# --- words and lines on the map


@pytest.mark.parametrize(
    ("text", "x", "y", "axes", "side"),
    [
        pytest.param("front: <b>11.3</b>", 0.0, 90.0, ("x", "y"), "center", id="anterior"),
        pytest.param("&lt;back>", 180.0, 30.0, ("x", "y"), "right", id="at the right border"),
        pytest.param("base: <b>44.0</b>", 10.0, -5.0, ("x2", "y2"), "center", id="on the end"),
    ],
)
def test_clusters_show_their_measured_pressure(text, x, y, axes, side) -> None:
    note = drawn().notes[text]
    assert (note["x"], note["y"]) == (x, y)
    assert (note["xref"], note["yref"], note["xanchor"]) == (*axes, side)
    assert note["yshift"] == 26  # above the tile
    assert not note["showarrow"]


def test_label_at_the_left_border_stays_inside() -> None:
    places = [[0.0, 90.0], [90.0, 60.0], [-170.0, 30.0], [-90.0, 60.0], [10.0, -5.0]]
    assert drawn(socket=hand_socket(places=places)).notes["&lt;back>"]["xanchor"] == "left"


def test_peak_is_marked_on_its_tile() -> None:
    note = drawn(hand_moment(pressure=[10.0, 20.0, 30.0, 44.96, 44.0])).notes["<b>peak 45.0</b>"]
    assert (note["x"], note["y"], note["xref"], note["yref"]) == (-90.0, 60.0, "x", "y")
    assert note["yshift"] == 0 and note["font"]["color"] == "#fff"
    assert note["bgcolor"] == "rgba(17,17,17,0.85)"


def test_lowest_pressure_is_no_peak() -> None:
    picture = drawn(hand_moment(pressure=[-3.0, -2.0, -5.0, -4.0, -6.0]))
    assert picture.notes["<b>peak -2.0</b>"]["x"] == 90.0


def test_regions_are_dotted_and_named_below() -> None:
    picture = drawn()
    found = outlines(picture, dash="dot", color="#fff")
    middles = [np.mean(np.unique(line["x"])) for line in found]
    assert middles == [90.0, -90.0]
    note = picture.notes["a &lt; b"]
    assert (note["x"], note["y"], note["yshift"]) == (90.0, 60.0, -14)


def test_clusters_are_outlined_dark_on_white() -> None:
    picture = drawn()
    dark, light = outlines(picture, color="#111", width=2), outlines(picture, color="#fff", width=4)
    # Tile 2 reaches from 165 to 195 degrees: it is drawn on both borders of the wall.
    spans = [(min(line["x"]), max(line["x"]), line["xaxis"], line["yaxis"]) for line in dark]
    assert spans == [
        (-15, 15, "x", "y"),
        (-195, -165, "x", "y"),
        (165, 195, "x", "y"),
        (0, 20, "x2", "y2"),
    ]
    heights = [(min(line["y"]), max(line["y"])) for line in dark]
    assert heights == [(75, 105), (15, 45), (15, 45), (-15, 5)]
    assert len(light) == len(dark)
    order = [
        line["line"]["color"] for line in picture.of_type("scatter") if "dash" not in line["line"]
    ]
    assert order.index("#fff") < order.index("#111")
    assert all(line["mode"] == "lines" and line["hoverinfo"] == "skip" for line in dark + light)


def test_tile_across_the_left_border_is_drawn_twice() -> None:
    corners = hand_socket()["corners"]
    corners[2] = [[x - 360.0, y] for x, y in corners[2]]
    spans = [
        min(line["x"])
        for line in outlines(drawn(socket=hand_socket(corners=corners)), color="#111")
    ]
    assert spans == [-15, -195, 165, 0]


def test_without_values_tiles_and_names_are_shown() -> None:
    picture = drawn({"time": 0.0, "words": "5 tiles"}, socket=hand_socket(**TWO_TILES))
    assert not picture.of_type("heatmap")
    named = [line["text"] for line in picture.of_type("scatter")]
    assert named == ["t&lt;0>", "t1", "t2", "t2", "t3", "t4"]  # t2 on both borders
    assert {line["hoverinfo"] for line in picture.of_type("scatter")} == {"text"}
    assert {line["line"]["color"] for line in picture.of_type("scatter")} == {INK}


def test_names_never_become_markup() -> None:
    socket = hand_socket(clusters={"<b>&": 0}, regions={"<i>&": [1]})
    found = [text for text in drawn(socket=socket).notes if "lt;" in text]
    assert found == ["&lt;b>&amp;: <b>11.3</b>", "&lt;i>&amp;"]


# --- axes


def test_sides_of_the_leg_stand_at_their_angles() -> None:
    axis = drawn().layout["xaxis"]
    assert axis["range"] == [-180, 180]
    named = dict(zip(axis["ticktext"], axis["tickvals"], strict=True))
    assert named == {"posterior": 180, "right": -90, "anterior": 0, "left": 90}
    assert axis["tickvals"][0] == -180 and axis["ticktext"][0] == "posterior"


def test_proximal_is_above_distal() -> None:
    axis = drawn().layout["yaxis"]
    assert axis["range"] == [30, 90]
    # Middles of the thirds between 30, 50, 70 and 90 mm.
    named = dict(zip(axis["ticktext"], axis["tickvals"], strict=True))
    assert named == {"distal": 40, "middle": 60, "proximal": 80}


def test_lines_border_sectors_and_thirds() -> None:
    lines = [
        ((line["x0"], line["x1"]), (line["y0"], line["y1"])) for line in drawn().layout["shapes"]
    ]
    sectors = [((x, x), (30, 90)) for x in (-135, -45, 45, 135)]
    assert lines == [*sectors, ((-180, 180), (50, 50)), ((-180, 180), (70, 70))]


def test_the_end_lies_beside_the_wall_and_undistorted() -> None:
    picture = drawn()
    layout = picture.layout
    assert layout["xaxis"]["domain"][1] < layout["xaxis2"]["domain"][0]
    assert layout["xaxis2"]["domain"][1] == layout["yaxis"]["domain"][1] == 1
    assert (layout["yaxis2"]["scaleanchor"], layout["yaxis2"]["anchor"]) == ("x2", "x2")
    assert not layout["xaxis2"]["visible"] and not layout["yaxis2"]["visible"]
    note = picture.notes["distal end,<br>anterior up"]
    assert (note["xref"], note["yref"]) == ("x2 domain", "paper")


def test_a_wall_alone_takes_the_whole_width() -> None:
    wall = hand_socket()["patches"][0]
    socket = hand_socket(patches=[wall], clusters={"front": 0})
    picture = drawn(hand_moment(pressure=[10.0, 20.0, 30.0, 40.0, 0.0]), socket=socket)
    assert picture.layout["xaxis"]["domain"] == [0, 1] and "xaxis2" not in picture.layout
    assert not any("distal end" in text for text in picture.notes)


def test_a_narrow_window_has_the_end_below() -> None:
    layout = drawn(before=f"browser.setMedia('{NARROW}', true)").layout
    assert layout["xaxis"]["domain"] == layout["xaxis2"]["domain"] == [0, 1]
    assert layout["yaxis2"]["domain"][1] < layout["yaxis"]["domain"][0]
    assert layout["yaxis"]["domain"][1] == 1 and layout["yaxis2"]["domain"][0] == 0
    named = dict(zip(layout["xaxis"]["ticktext"], layout["xaxis"]["tickvals"], strict=True))
    assert named == {"right": -90, "anterior": 0, "left": 90}


def test_the_map_cannot_be_dragged_or_zoomed() -> None:
    picture = drawn()
    assert picture.config == {"displayModeBar": False, "responsive": True}
    assert picture.layout["dragmode"] is False and picture.how == "react"
    assert picture.layout["xaxis"]["fixedrange"] and picture.layout["yaxis"]["fixedrange"]
    assert not picture.layout["showlegend"]


@pytest.mark.parametrize("query", [DARK, NARROW], ids=["dark", "narrow"])
def test_the_map_follows_the_window(query) -> None:
    tab = opened()
    before = show(tab, hand_moment())
    tab.run("browser.ink = 'rgb(250, 250, 250)'; undefined")
    tab.run(f"browser.setMedia('{query}', true)")
    after = tab.picture("#map")
    assert tab.drawn("#map") == 2
    for axis in ("xaxis", "yaxis"):
        assert before.layout[axis]["tickfont"]["color"] == INK
        assert after.layout[axis]["tickfont"]["color"] == "rgb(250, 250, 250)"
    assert after.heatmap().trace["colorbar"]["tickfont"]["color"] == "rgb(250, 250, 250)"
    assert after.heatmap().trace["z"] == before.heatmap().trace["z"]


def test_automatic_scales_of_pressures_end_as_those_for_print() -> None:
    scale = opened().evaluate("SCALES.pressure")
    assert [end for end in scale["ends"] if end >= scale["least"]] == [*FIXED_ENDS]
