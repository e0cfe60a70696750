"""The time line, the bars and the cards of socket.js, and the switches beside the pictures.

Expected values are worked out by hand from `support.hand_made`.
"""

import json
import re
from typing import Any

import pytest
from support.hand_made import hand_bars, hand_cards, hand_course, hand_moment, hand_socket
from support.tabs import DARK, INK, Picture, Tab, hover_text

BOXES = """<html><body>
<div id="cards"></div><div id="map"></div><div id="solid"></div><div id="course"></div>
<input type="range" id="cursor"><select id="bar-value"></select><strong id="when"></strong>
<div id="bars"></div><select id="kind"></select><select id="scale"></select><p id="legend"></p>
<script src="plotly.js"></script><script src="socket.js"></script></body></html>"""
AUTOMATIC = "automatic"


def opened(*extra: Any) -> Tab:
    """The pictures of a page; times that are sought are kept in `sought`."""
    tab = Tab(BOXES)
    given = "".join(f", {json.dumps(one)}" for one in extra)
    tab.run("const sought = []")
    tab.run(
        f"const view = new SocketView({json.dumps(hand_socket())},"
        f" (time) => sought.push(time){given})"
    )
    return tab


def show(tab: Tab, **found: Any) -> None:
    tab.run(f"view.show({json.dumps(found)})")


def course(at: float | None = 12.5, **changed: Any) -> Picture:
    tab = opened()
    show(tab, course=hand_course(**changed), moment=hand_moment(time=at, words="now"))
    return tab.picture("#course")


# --- time line


def test_lines_over_time_are_what_they_say() -> None:
    lines = {line["name"]: line for line in course().traces if line.get("name")}
    assert set(lines) == {"95 % interval", "peak pressure [kPa]", "force along the socket [N]"}
    peak, force = lines["peak pressure [kPa]"], lines["force along the socket [N]"]
    assert (peak["x"], peak["y"]) == ([0, 10, 40], [5, 50, 8])
    assert (force["x"], force["y"]) == ([0, 10, 40], [100, 800, -20])
    assert "yaxis" not in peak and force["yaxis"] == "y2"
    assert all(line["mode"] == "lines" for line in lines.values())


def test_band_lies_between_low_and_high() -> None:
    first, second = course().traces[:2]
    assert (first["y"], second["y"]) == ([9, 70, 11], [2, 40, 6])
    assert second["fill"] == "tonexty" and "fill" not in first
    assert "yaxis" not in first and "yaxis" not in second  # on the axis of the pressure
    assert not first["showlegend"] and second["name"] == "95 % interval"
    assert first["line"]["width"] == second["line"]["width"] == 0


def test_pointer_reads_time_peak_and_force() -> None:
    lines = {line.get("name"): line for line in course().traces}
    peak, force = lines["peak pressure [kPa]"], lines["force along the socket [N]"]
    assert hover_text(peak["hovertemplate"], {"x": 10.0, "y": 50.25}) == "10.0 s: 50.2 kPa"
    assert hover_text(force["hovertemplate"], {"y": 799.6}) == "800 N"


def test_axes_of_time_pressure_and_force() -> None:
    layout = course().layout
    assert layout["xaxis"]["range"] == [0, 40] and layout["xaxis"]["ticksuffix"] == " s"
    assert layout["yaxis"]["title"]["text"] == "kPa" and "side" not in layout["yaxis"]
    assert layout["yaxis2"]["title"]["text"] == "N"
    assert (layout["yaxis2"]["overlaying"], layout["yaxis2"]["side"]) == ("y", "right")
    assert layout["yaxis"]["rangemode"] == layout["yaxis2"]["rangemode"] == "tozero"


def vertical_lines(picture: Picture) -> list[tuple[float, str]]:
    """Times and colours of the lines from the bottom to the top."""
    found = picture.layout["shapes"]
    for line in found:
        assert line["x0"] == line["x1"] and (line["y0"], line["y1"]) == (0, 1)
        assert (line["type"], line["yref"]) == ("line", "paper")
    return [(line["x0"], line["line"]["color"]) for line in found]


def test_cursor_stands_at_the_shown_time() -> None:
    assert vertical_lines(course()) == [(10.0, "#888"), (25.0, "#888"), (12.5, INK)]
    assert vertical_lines(course(at=0.0))[-1] == (0.0, INK)
    assert vertical_lines(course(at=None)) == [(10.0, "#888"), (25.0, "#888")]


def test_events_are_labelled_at_their_time() -> None:
    notes = course().notes
    assert {text: note["x"] for text, note in notes.items()} == {"push": 10.0, "a&lt;b": 25.0}
    assert all((note["y"], note["yref"]) == (1, "paper") for note in notes.values())


def test_twelve_events_are_labelled_and_all_marked() -> None:
    events = [{"time": float(k), "label": f"e{k}"} for k in range(15)]
    picture = course(events=events)
    assert list(picture.notes) == [f"e{k}" for k in range(12)]
    assert len(picture.layout["shapes"]) == 16  # and the cursor


def test_slider_spans_the_course_in_any_step() -> None:
    tab = opened()
    show(tab, course=hand_course(time=[2.0, 10.0, 62.0]), moment=hand_moment(time=12.5))
    slider = [float(tab.get("#cursor", name)) for name in ("min", "max", "value")]
    assert slider == [2.0, 62.0, 12.5]
    assert tab.get("#cursor", "step") == "any"
    show(tab, moment=hand_moment(time=61.25))
    assert float(tab.get("#cursor", "value")) == 61.25


def test_slider_lies_below_the_plot() -> None:
    tab = opened()
    show(tab, course=hand_course())
    margin = tab.picture("#course").layout["margin"]
    style = tab.get("#cursor", "style")
    assert style["margin"] == f"0 {margin['r']}px 0 {margin['l']}px"
    assert style["width"] == f"calc(100% - {margin['l'] + margin['r']}px)"


def test_slider_and_click_seek_their_time() -> None:
    tab = opened()
    show(tab, course=hand_course(), moment=hand_moment())
    show(tab, moment=hand_moment(time=13.0))
    tab.type("#cursor", 21.75)
    tab.send("#course", "plotly_click", {"points": [{"x": 31.5, "y": 7.0}, {"x": 1.0}]})
    assert tab.evaluate("sought") == [21.75, 31.5]


def test_time_line_follows_the_colours_of_the_window() -> None:
    tab = opened()
    show(tab, course=hand_course(), moment=hand_moment())
    tab.run("browser.ink = 'rgb(250, 250, 250)'; undefined")
    tab.run(f"browser.setMedia('{DARK}', true)")
    assert vertical_lines(tab.picture("#course"))[-1] == (12.5, "rgb(250, 250, 250)")


# --- cards


def test_cards_show_value_interval_and_words_in_order() -> None:
    tab = opened()
    show(tab, cards=hand_cards())
    parts = "children.map((one) => [one.tagName, one.className, one.textContent])"
    cards = tab.get("#cards", f"children.map((card) => [card.className, card.{parts}])")
    assert cards == [
        [
            "card",
            [
                ["H3", "", "Peak"],
                ["STRONG", "", "45.0 kPa"],
                ["SPAN", "interval", "95 %: 20.0 to 95.0"],
                ["P", "", "distal, <base>"],
            ],
        ],
        [
            "card bad",
            [["H3", "", "Data"], ["STRONG", "", "check clock"], ["P", "", "it stands still"]],
        ],
    ]


def test_new_cards_replace_the_old() -> None:
    tab = opened()
    show(tab, cards=hand_cards())
    show(tab, cards=hand_cards()[1:])
    assert tab.texts("h3") == ["Data"]
    show(tab, moment=hand_moment())
    assert tab.texts("h3") == ["Data"]


# --- bars


def percent(text: str) -> float:
    """A length of a style as a percentage: `P%` or `calc(P% - Q%)`."""
    number = r"(-?[\d.]+)%"
    found = re.fullmatch(rf"{number}|calc\({number} - {number}\)", text)
    assert found, text
    alone, end, start = found.groups()
    return float(alone) if alone else float(end) - float(start)


def spans(tab: Tab, kind: str) -> list[tuple[float, float]]:
    """Left and right ends of all bars or whiskers [%]."""
    styles = tab.evaluate(f"document.querySelectorAll('.{kind}').map((one) => one.style)")
    return [
        (percent(style["left"]), percent(style["left"]) + percent(style["width"]))
        for style in styles
    ]


def test_bars_reach_from_zero_to_the_value() -> None:
    tab = opened()
    show(tab, bars=hand_bars())
    # Of 0 to 100 kPa, the highest end of an interval.
    assert spans(tab, "bar") == [pytest.approx((0.0, 20.0)), pytest.approx((0.0, 50.0))]


def test_whiskers_reach_from_low_to_high() -> None:
    tab = opened()
    show(tab, bars=hand_bars())
    first, second = spans(tab, "whisker")
    assert first == pytest.approx((10.04, 40.06)) and second == pytest.approx((25.0, 100.0))


def test_bars_of_negative_values_reach_left() -> None:
    tab = opened()
    show(tab, bars=hand_bars())
    tab.choose("#bar-value", "share of load [%]")
    # From -20, the lowest value, to 100: zero is at 20 / 120, 60 at 80 / 120.
    zero = 100.0 * 20.0 / 120.0
    found = [pytest.approx(span) for span in spans(tab, "bar")]
    assert found == [(zero, 100.0 * 80.0 / 120.0), (0.0, zero), (zero, 100.0)]
    # -30 is beyond the left end, -10 is at 10 / 120.
    assert spans(tab, "whisker")[1] == pytest.approx((0.0, 100.0 * 10.0 / 120.0))


def test_bars_say_value_and_interval() -> None:
    tab = opened()
    show(tab, bars=hand_bars())
    rows = "children.map((row) => row.children.map((part) => part.textContent))"
    assert tab.get("#bars", rows)[:3] == [
        ["anterior", "", "20.0 (10.0 to 40.1)"],
        ["left", "", "none"],
        ["socket", "", "50.0 (25.0 to 100.0)"],
    ]
    assert tab.text("#bars").endswith("Whiskers and parentheses: 95 % intervals.")
    tab.choose("#bar-value", "share of load [%]")
    assert tab.texts(".said") == ["60 (40 to 80)", "-20 (-30 to -10)", "100 (100 to 100)"]


def test_chosen_output_stays_with_new_values() -> None:
    tab = opened()
    show(tab, bars=hand_bars())
    assert tab.options("#bar-value") == ["peak pressure [kPa]", "share of load [%]"]
    tab.choose("#bar-value", "share of load [%]")
    bars = hand_bars()
    bars["values"]["share of load [%]"][0] = [70.0, 60.0, 80.0]
    show(tab, bars=bars)
    assert tab.get("#bar-value", "value") == "share of load [%]"
    assert tab.texts(".said")[0] == "70 (60 to 80)"
    tab.choose("#bar-value", "peak pressure [kPa]")
    assert tab.texts(".said")[0] == "20.0 (10.0 to 40.1)"


def test_regions_without_values_draw_nothing() -> None:
    tab = opened()
    bars = hand_bars()
    bars["values"] = {"peak pressure [kPa]": [[None] * 3] * 3}
    show(tab, bars=bars)
    assert tab.texts(".said") == ["none"] * 3 and not tab.texts(".bar")


# --- the moment and the switches


@pytest.mark.parametrize(
    ("moment", "words"),
    [
        pytest.param({"time": 12.346}, "at 12.35 s", id="time"),
        pytest.param({"time": 0.0, "words": "no force map"}, "no force map", id="words"),
    ],
)
def test_moment_is_named(moment, words) -> None:
    tab = opened()
    show(tab, moment=moment)
    assert tab.text("#when") == words


def test_scales_are_offered_and_chosen() -> None:
    tab = opened()
    show(tab, moment=hand_moment())
    ends = {25, 50, 100, 200, 400}
    assert tab.options("#scale") == [AUTOMATIC, *(f"0 to {end} kPa" for end in sorted(ends))]
    for end in ends:
        tab.choose("#scale", f"0 to {end} kPa")
        assert tab.picture("#map").heatmap().trace["zmax"] == end
    tab.choose("#scale", AUTOMATIC)
    assert tab.picture("#map").heatmap().trace["zmax"] == 50


def test_another_value_begins_with_its_own_scale() -> None:
    """The largest shear is 5 kPa; a scale that was chosen for the pressure is not that of shear."""
    tab = opened()
    show(tab, moment=hand_moment())
    tab.choose("#scale", "0 to 400 kPa")
    tab.choose("#kind", "shear")
    assert tab.picture("#map").heatmap().trace["zmax"] == 5
    tab.choose("#kind", "pressure")
    assert tab.picture("#map").heatmap().trace["zmax"] == 50


def test_shown_value_is_chosen() -> None:
    tab = opened({"area": {"values": [1.0, 2.0, 3.0, 4.0, 5.0], "unit": "mm²"}})
    show(tab, moment=hand_moment())
    assert tab.options("#kind") == ["pressure", "shear", "area"]
    found = {}
    for kind in ("shear", "area", "pressure"):
        tab.choose("#kind", kind)
        found[kind] = tab.picture("#map").heatmap().hover(90.0, 60.0)
    assert found == {
        "shear": "2.0 kPa",
        "area": "2.0 mm²",
        "pressure": "20.0 kPa, 95 %: 8.0 to 32.0",
    }


def test_legend_explains_grey_outlines_and_side() -> None:
    tab = opened()
    legend = " ".join(tab.get("#legend", "markup").split())
    assert '<i class="full"></i> certain <i class="grey"></i> the greyer, the farther' in legend
    assert "the 95 % interval reaches beyond the value" in legend
    assert "clusters, with their measured pressure [kPa]" in legend
    assert "seen from outside" in legend
