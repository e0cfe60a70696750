"""The figures for print of the scene, read back from their axes, against hand values.

Colours are those of viridis, from dark violet (lowest) to yellow (highest). On the wall a tile is
at its angle from anterior towards left and its height above the distal end, on the end at its
distances towards right and towards anterior. Models are those of `support.results_by_hand`.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from support import scene
from support.wording import refused

import socket_testbed as st
from socket_testbed.errors import ConfigurationError
from socket_testbed.figures.overview import overview_figure
from socket_testbed.figures.pressure import force_map_figure
from socket_testbed.figures.style import COLUMN, DEFAULT_STYLE, FigureStyle
from socket_testbed.figures.tiles import draw_wall, socket_figure
from socket_testbed.report.write import SECTIONS

YELLOW, VIOLET = (0.993, 0.906, 0.144), (0.267, 0.005, 0.329)  # the ends of viridis
VERMILION, LIGHT_BLUE = (0.835, 0.369, 0.0), (0.651, 0.796, 0.890)
PLACES = {
    "ant_prox": (0.0, 120.0),
    "left_prox": (90.0, 120.0),
    "right_prox": (-90.0, 120.0),
    "ant_mid": (0.0, 60.0),
    "left_mid": (90.0, 60.0),
    "right_mid": (-90.0, 60.0),
    "ant_end": (0.0, 20.0),
    "post_end": (0.0, -20.0),
    "left_end": (-20.0, 0.0),
}
AT_PEAK = 48  # of 96 samples, at 12.0 s

Draw = Callable[..., Figure]


@pytest.fixture(scope="module", autouse=True)
def without_layout() -> None:
    """Positions on paper are tested elsewhere; they take most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConstrainedLayoutEngine, "execute", lambda *_: None)
        yield


@pytest.fixture(scope="module")
def drawn(report) -> Draw:
    """Draws a figure of the report by its name, once for each style."""
    sections = [make(report.results) for makers in SECTIONS.values() for make in makers]
    found = {figure.name: figure.draw for section in sections for figure in section.figures}
    return cache(lambda name, style=DEFAULT_STYLE: found[name](style))


def panels(figure: Figure, title: str) -> tuple[Axes, Axes]:
    """Wall and distal end of a map by its title."""
    (place,) = [i for i, axis in enumerate(figure.axes) if axis.get_title("left") == title]
    return figure.axes[place], figure.axes[place + 1]


def bars(figure: Figure, label: str) -> list[tuple[float, float]]:
    """Ends of the colour bars with a label."""
    labels = [axis.get_ylabel().replace("\n", " ") for axis in figure.axes]
    axes = zip(figure.axes, labels, strict=True)
    return [axis.get_ylim() for axis, own in axes if own == label and not axis.lines]


def squares(axis: Axes) -> PolyCollection:
    """The tiles of a panel."""
    return next(found for found in axis.collections if isinstance(found, PolyCollection))


def square_at(axis: Axes, tile: str) -> int:
    """Which square of a panel is at the place of a tile."""
    centres = [path.vertices[:4].mean(axis=0) for path in squares(axis).get_paths()]
    apart = np.linalg.norm(np.array(centres) - PLACES[tile], axis=1)
    assert apart.min() < 1.0
    return int(apart.argmin())


def fill_at(axis: Axes, tile: str) -> tuple[float, ...]:
    """The fill of the square of a tile."""
    return tuple(squares(axis).get_facecolor()[square_at(axis, tile)][:3])


def image_at(axis: Axes, tile: str) -> tuple[float, ...]:
    """The colour of a smooth map at a tile's place, as drawn: rows begin below."""
    x, y = PLACES[tile]
    (image,) = [each for each in axis.images if each.get_extent()[0] <= x <= each.get_extent()[1]]
    assert image.origin == "lower"
    left, right, low, high = image.get_extent()
    pixels = np.asarray(image.get_array())
    column = int((x - left) / (right - left) * pixels.shape[1])
    row = int((y - low) / (high - low) * pixels.shape[0])
    return tuple(pixels[row, column, :3])


def ticks(axis: Axes) -> dict[float, str]:
    """Words below the unrolled wall, by the degrees where they stand."""
    places = zip(axis.get_xticks(), axis.get_xticklabels(), strict=True)
    return {float(place): label.get_text().partition("\n")[2] for place, label in places}


def line(axis: Axes, label: str) -> np.ndarray:
    """Values of a line by the first word of its label."""
    (found,) = [each for each in axis.lines if str(each.get_label()).startswith(label)]
    return np.asarray(found.get_ydata())


def legend(axis: Axes) -> list[str]:
    """Title and entries of a panel's legend."""
    found = axis.get_legend()
    return [found.get_title().get_text(), *(text.get_text() for text in found.texts)]


# --- pressure

AT_40 = tuple(colormaps["viridis"](np.sqrt(0.8))[:3])  # 40 of 50 kPa
MEAN, PEAK = "mean over the segment", "at the peak, 12.00 s"


def test_pressure_maps_share_a_fixed_scale(drawn: Draw) -> None:
    """For 60 kPa at the peak the scale of 50 kPa is too short, the next one ends at 100."""
    found = bars(drawn("pressure_map"), "pressure [kPa]")
    assert found == [pytest.approx((0.0, 100.0))]


COLOURS = {
    # of the scale's square root: value / 100
    (PEAK, "ant_mid"): 0.775,
    (PEAK, "right_prox"): 0.671,
    (PEAK, "left_prox"): 0.346,
    (MEAN, "ant_mid"): 0.632,
    (MEAN, "right_prox"): 0.548,
    (MEAN, "ant_end"): 0.387,
}


@pytest.mark.parametrize(("title", "tile"), COLOURS)
def test_a_pressure_map_is_coloured_at_its_place(title: str, tile: str, drawn: Draw) -> None:
    """The interpolated surface deviates from a tile's value by 1.5 kPa at most."""
    wall, end = panels(drawn("pressure_map"), title)
    found = image_at(end if tile.endswith("end") else wall, tile)
    expected = colormaps["viridis"](COLOURS[title, tile])[:3]
    assert found == pytest.approx(expected, abs=0.06)


def test_pull_has_the_darkest_colour(drawn: Draw) -> None:
    wall, _ = panels(drawn("pressure_map"), PEAK)
    assert image_at(wall, "right_mid") == pytest.approx(VIOLET, abs=0.2)


def test_the_wall_names_its_sides(drawn: Draw) -> None:
    """Left is medial on a right leg; the axis rises towards left and towards proximal."""
    wall, _ = panels(drawn("pressure_map"), MEAN)
    assert ticks(wall) == {
        -180.0: "post.", -90.0: "lat.", 0.0: "ant.", 90.0: "med.", 180.0: "post.",
    }  # fmt: skip
    assert wall.get_ylabel() == "height [mm]"
    left, right = wall.get_xlim()
    assert left < -180.0 and right > 180.0
    low, high = wall.get_ylim()
    assert low < 0.0 and high > 140.0


def test_a_tile_on_the_wall_is_printed_square(drawn: Draw) -> None:
    """At 50 mm from the axis a degree is 0.8727 mm wide."""
    wall, end = panels(drawn("pressure_map"), MEAN)
    assert wall.get_aspect() == pytest.approx(1.0 / 0.872665, rel=1e-4)
    assert end.get_aspect() == 1.0


def test_type_is_printed_at_its_size(drawn: Draw) -> None:
    """Labels and headings at 8 points, numbers and keys at 7."""
    figure = drawn("pressure_map")
    wall, _ = panels(figure, MEAN)
    first = course_panel(drawn, "sectors")
    assert {axis.yaxis.label.get_size() for axis in (wall, first)} == {8.0}
    assert {text.get_size() for text in (*wall.get_xticklabels(), *first.get_yticklabels())} == {
        7.0
    }
    key = first.get_legend()
    assert key.get_title().get_size() == 8.0 and {text.get_size() for text in key.texts} == {7.0}


def test_the_end_is_the_right_way_up(drawn: Draw) -> None:
    _, end = panels(drawn("pressure_map"), MEAN)
    assert end.get_xlim()[0] < -30.0 < 30.0 < end.get_xlim()[1]
    assert end.get_ylim()[0] < -30.0 < 30.0 < end.get_ylim()[1]


NUMBERS = {"1": "right_prox", "2": "ant_mid", "4": "post_end"}


@pytest.mark.parametrize("number", NUMBERS)
def test_a_cluster_s_number_is_on_its_tile(number: str, drawn: Draw) -> None:
    axes = panels(drawn("pressure_map"), MEAN)
    (text,) = [text for axis in axes for text in axis.texts if text.get_text() == number]
    assert text.get_position() == pytest.approx(PLACES[NUMBERS[number]], abs=0.05)


def test_the_key_names_clusters_and_greys(drawn: Draw) -> None:
    maps, below = drawn("pressure_map").subfigs
    assert maps.get_supxlabel().replace("\n", " ") == (
        "1 brim_lateral, 2 mid_anterior, 3 posterior_distal, 4 distal, distal end: anterior up,"
        " the greyer, the less certain"
    )
    assert below.get_supxlabel() == "bands: 95 % intervals, events: 1 placed, 2 removed"


COURSES = {
    # panel, value and band at 12.0 s
    "anterior": ("sectors", 35.5, (33.54, 37.46)),
    "lateral": ("sectors", 17.5, (15.8013, 19.1987)),
    "proximal": ("heights", 25.186, (23.226, 27.146)),  # 1.5 * 72.2 N / 43 cm^2
    "fibula": ("", 21.75, (19.79, 23.71)),
}


def course_panel(drawn: Draw, heading: str) -> Axes:
    axes = [axis for axis in drawn("pressure_map").axes if axis.get_legend() is not None]
    (found,) = [axis for axis in axes if legend(axis)[0] == heading]
    return found


@pytest.mark.parametrize("name", COURSES)
def test_a_course_is_in_kilopascals(name: str, drawn: Draw) -> None:
    heading, value, band = COURSES[name]
    panel = course_panel(drawn, heading)
    assert line(panel, name)[AT_PEAK] == pytest.approx(value, abs=1e-3)
    drawn_band = panel.collections[legend(panel).index(name) - 1]
    corners = drawn_band.get_paths()[0].vertices
    there = corners[np.abs(corners[:, 0] - 12.0) < 0.01, 1]
    assert (there.min(), there.max()) == pytest.approx(band, abs=1e-3)


def test_courses_name_axes_and_regions(drawn: Draw) -> None:
    first = course_panel(drawn, "sectors")
    assert first.get_ylabel() == "pressure [kPa]" and first.get_xlabel() == "time [s]"
    assert legend(first) == ["sectors", "anterior", "posterior", "medial", "lateral"]
    assert legend(course_panel(drawn, "heights")) == ["heights", "proximal", "middle", "distal"]
    assert legend(course_panel(drawn, "")) == ["", "tibia", "fibula"]


def test_events_stand_at_their_times(drawn: Draw) -> None:
    """The load passes half its range up near 6 s, down near 18 s."""
    panel = course_panel(drawn, "sectors")
    times = [each.get_xdata()[0] for each in panel.lines if len(each.get_xdata()) == 2]
    assert times == pytest.approx([6.0, 18.0], abs=1.0)
    assert [text.get_text() for text in panel.texts] == ["1", "2"]
    assert [text.xy[0] for text in panel.texts] == pytest.approx(times)


# --- the force map


@pytest.fixture(scope="module")
def force_map(trial) -> st.TrialMap:
    return st.force_map(trial, "all")


def test_a_force_map_is_beside_its_deviation(force_map: st.TrialMap) -> None:
    """Up to 40 kPa on the fixed scale, and 0.5 to 1 kPa on a scale of their own."""
    figure = force_map.figure()
    assert figure.get_suptitle().startswith("scene, all 0.00 s to 23.75 s: force map")
    found = bars(figure, "pressure [kPa]")
    assert found == [pytest.approx((0.0, 50.0)), pytest.approx((0.5, 1.0))]
    pressure, _ = panels(figure, "normal pressure")
    deviation, _ = panels(figure, "its standard deviation")
    assert image_at(pressure, "ant_mid") == pytest.approx(AT_40, abs=0.06)
    assert image_at(deviation, "left_mid") == pytest.approx(VIOLET, abs=0.2)
    assert image_at(deviation, "ant_mid") == pytest.approx(YELLOW, abs=0.1)


def test_pressures_alone_are_greyed(force_map: st.TrialMap) -> None:
    """8 kPa +- 39 kPa at left_prox is the greyest pressure, and the highest deviation."""
    estimate = force_map.mean
    deviation = estimate.normal_pressure_standard_deviation.copy()
    deviation[0, scene.TILES.index("left_prox")] = 20e3
    spoiled = replace(estimate, normal_pressure_standard_deviation=deviation)
    figure = force_map_figure(scene.geometry(), spoiled, "", DEFAULT_STYLE, "right")
    pressure, _ = panels(figure, "normal pressure")
    beside, _ = panels(figure, "its standard deviation")
    assert np.ptp(image_at(pressure, "left_prox")) < 0.15
    assert np.ptp(image_at(pressure, "ant_mid")) > 0.4
    assert image_at(beside, "left_prox") == pytest.approx(YELLOW, abs=0.1)


@pytest.fixture(scope="module")
def own_axes(force_map: st.TrialMap) -> Axes:
    axes = Figure().subplots()
    force_map.draw(ax=axes)
    return axes


def test_a_map_in_own_axes_has_its_unit(own_axes: Axes) -> None:
    assert bars(own_axes.figure, "pressure [kPa]") == [pytest.approx((0.0, 50.0))]
    assert own_axes.get_ylabel() == "height [mm]"
    assert image_at(own_axes, "ant_mid") == pytest.approx(AT_40, abs=0.06)
    assert image_at(own_axes, "right_mid") == pytest.approx(VIOLET, abs=0.2)


def test_own_axes_hold_the_distal_end(own_axes: Axes) -> None:
    """To the right of the wall, at its scale, and as high as half the wall."""
    wall, end = (np.array(image.get_extent()) for image in own_axes.images)
    assert end[0] > wall[1] and end[1] < own_axes.get_xlim()[1]
    degree = 50.0 * np.pi / 180.0  # [mm]; the tiles of the wall are 50 mm from the axis
    assert (end[1] - end[0]) * degree == pytest.approx(end[3] - end[2], rel=1e-3)
    texts = {text.get_text().replace("\n", ""): text.get_position() for text in own_axes.texts}
    assert {*texts} == {"distal end", *scene.CLUSTERS}
    assert texts["mid_anterior"] == pytest.approx(PLACES["ant_mid"], abs=0.05)
    assert end[0] < texts["distal"][0] < end[1]


@pytest.mark.parametrize(
    ("ends", "found"),
    [
        pytest.param({"vmax": 30.0}, (0.0, 30.0), id="upper"),
        pytest.param({"vmin": 10.0}, (10.0, 50.0), id="lower"),
        pytest.param({"vmin": -5.0, "vmax": 80.0}, (-5.0, 80.0), id="both"),
        pytest.param({"vmin": 60.0}, (60.0, 110.0), id="above all"),
    ],
)
def test_the_ends_of_the_scale_are_chosen(
    ends: dict[str, float], found: tuple[float, float], force_map: st.TrialMap
) -> None:
    axes = Figure().subplots()
    force_map.draw(ax=axes, **ends)
    assert bars(axes.figure, "pressure [kPa]") == [pytest.approx(found)]
    assert bars(force_map.figure(**ends), "pressure [kPa]")[0] == pytest.approx(found)


@pytest.mark.parametrize(
    ("ends", "words"),
    [
        pytest.param({"vmin": 5.0, "vmax": 5.0}, ("ends at 5 kPa", "vmin below vmax"), id="equal"),
        pytest.param({"vmax": -1.0}, ("ends at -1 kPa but begins at 0 kPa", "vmin"), id="below"),
        pytest.param({"vmax": float("nan")}, ("vmax", "finite"), id="nan"),
    ],
)
def test_a_scale_out_of_order_is_refused(
    ends: dict[str, float], words: tuple[str, str], force_map: st.TrialMap
) -> None:
    with refused(ConfigurationError, *words):
        force_map.draw(ax=Figure().subplots(), **ends)


@pytest.mark.parametrize(
    ("side", "left", "right"),
    [("right", "med", "lat"), ("left", "lat", "med"), (None, "left", "right")],
    ids=["right leg", "left leg", "unstated"],
)
def test_the_sides_follow_the_leg(side, left: str, right: str) -> None:
    """+90 degrees is the left side."""
    axes = Figure().subplots()
    draw_wall(axes, scene.geometry(), np.arange(12.0), "any [-]", side=side)
    assert ticks(axes)[90.0].startswith(left) and ticks(axes)[-90.0].startswith(right)


# --- models on the tiles

STIFFNESSES = {
    # figure, map, tile with the highest colour, tile with the lowest
    "x": ("tile_stiffness_stiffness_bias", "k along x of {S}", "ant_prox", "left_prox"),
    "z": ("tile_stiffness_stiffness_bias", "k along z of {S}", "post_end", "ant_end"),
    "normal": (
        *("tile_stiffness_rigid_bias", "k along z of the tile's frame"),
        *("right_prox", "ant_mid"),
    ),
}


@pytest.mark.parametrize("name", STIFFNESSES)
def test_a_stiffness_has_its_tile_s_colour(name: str, drawn: Draw) -> None:
    figure, title, stiff, soft = STIFFNESSES[name]
    wall, end = panels(drawn(figure), title)
    axis = end if stiff.endswith("end") else wall
    assert fill_at(axis, stiff) == pytest.approx(YELLOW, abs=1e-3)
    assert fill_at(axis, soft) == pytest.approx(VIOLET, abs=1e-3)


def test_stiffnesses_have_their_scales(drawn: Draw) -> None:
    """Along x up to 1 N/m, along y 0.5 N/m on the same scale, along z up to 5000 N/m."""
    figure = drawn("tile_stiffness_stiffness_bias")
    assert bars(figure, "stiffness [N/m]") == [(0.0, 1.0), (0.0, 1.0), (0.0, 5000.0)]
    assert figure.get_suptitle() == "scene: Stiffness of every tile, model stiffness_bias"
    wall, _ = panels(figure, "k along y of {S}")
    assert fill_at(wall, "left_mid") == pytest.approx(colormaps["viridis"](0.5)[:3], abs=0.01)


HEADINGS = {
    "wrench": "Measured and predicted wrench, all 0.00 s to 11.75 s",
    "local_forces": "Measured and predicted forces in the clusters' frames, all 0.00 s to 11.75 s",
    "validation": "Validation",
    "pareto": "Trade-off, all 0.00 s to 11.75 s",
    "tile_stiffness_rigid_bias": "Stiffness of every tile, model rigid_bias",
    "rest_positions": "Rest positions, the same for the paper's variants",
    "rest_positions_rigid_bias": "Rest positions, model rigid_bias",
}


@pytest.mark.parametrize("name", HEADINGS)
def test_a_figure_of_the_report_has_its_heading(name: str, drawn: Draw) -> None:
    assert drawn(name).get_suptitle().replace("\n", " ") == f"scene: {HEADINGS[name]}"


CAPTIONS = {
    "tile_stiffness_stiffness": "Stiffness of every tile, model stiffness, along the axes of {S};",
    "rest_positions": "Rest positions, the same for the paper's variants, along the axes of {S};",
    "rest_positions_rigid_bias": (
        "Rest positions, model rigid_bias, along the axes of the tile's frame;"
    ),
}


@pytest.mark.parametrize("name", CAPTIONS)
def test_a_map_of_tiles_has_its_caption(name: str, report) -> None:
    sections = [make(report.results) for makers in SECTIONS.values() for make in makers]
    (found,) = [own for section in sections for own in section.figures if own.name == name]
    assert found.caption.startswith(f"{CAPTIONS[name]} the wall is unrolled and seen from outside")


def test_a_map_of_tiles_outlines_clusters(drawn: Draw) -> None:
    wall, _ = panels(drawn("tile_stiffness_stiffness_bias"), "k along x of {S}")
    edges = squares(wall).get_edgecolor()
    assert edges[square_at(wall, "ant_mid")][:3] == pytest.approx(VERMILION, abs=1e-3)
    assert edges[square_at(wall, "ant_prox")][:3] != pytest.approx(VERMILION, abs=0.1)


def test_a_larger_tile_is_drawn_larger(drawn: Draw) -> None:
    """16 cm^2: 40 mm high, where others are 30 mm."""
    wall, _ = panels(drawn("tile_stiffness_stiffness_bias"), "k along x of {S}")
    paths = squares(wall).get_paths()
    sizes = [np.ptp(paths[square_at(wall, t)].vertices[:, 1]) for t in ("left_prox", "ant_prox")]
    assert sizes == pytest.approx([40.0, 30.0])


def test_rest_positions_are_in_millimetres(drawn: Draw) -> None:
    """From -0.35 mm along x to 2.97 mm along z, which is the same everywhere: 10 % beyond it."""
    figure = drawn("rest_positions")
    label = "rest position from the mean limb position [mm]"
    assert bars(figure, label) == [pytest.approx((-0.35, 3.26563), abs=1e-3)]
    wall, _ = panels(figure, "q_r along y of {S}")
    share = (0.82949 + 0.35) / 3.61563
    assert fill_at(wall, "left_mid") == pytest.approx(colormaps["viridis"](share)[:3], abs=0.01)
    wall, _ = panels(figure, "q_r along x of {S}")
    assert fill_at(wall, "left_mid") == pytest.approx(VIOLET, abs=1e-3)


def test_engaged_springs_are_in_percent(drawn: Draw) -> None:
    """`ant_prox` along one of three axes in 33 of 48 samples; at 3 s 1 of 36 and 1 of 12."""
    figure = drawn("engaged_springs")
    assert bars(figure, "share of the time engaged [%]") == [(0.0, 100.0)]
    wall, end = panels(figure, "stiffness")
    assert fill_at(wall, "ant_prox") == pytest.approx(colormaps["viridis"](0.229)[:3], abs=0.01)
    assert fill_at(end, "post_end") == pytest.approx(colormaps["viridis"](0.333)[:3], abs=0.01)
    wall, _ = panels(figure, "rigid_bias")
    assert fill_at(wall, "left_prox") == pytest.approx(YELLOW, abs=1e-3)
    assert fill_at(wall, "right_prox") == pytest.approx(VIOLET, abs=1e-3)
    engaged, uncertain = (axis for axis in figure.axes if axis.lines)
    assert engaged.get_ylabel() == "engaged\nsprings [%]"
    assert uncertain.get_ylabel() == "uncertain\nsprings [%]"
    assert uncertain.get_xlabel() == "time [s]"
    assert line(engaged, "rigid_bias")[12] == pytest.approx(100.0 / 12.0)
    own = [each for each in engaged.lines if each.get_label() == "stiffness"]
    assert own[0].get_ydata()[12] == pytest.approx(100.0 / 36.0)
    assert not line(uncertain, "rigid_bias").any()


def test_names_stand_on_their_tiles() -> None:
    """Of a socket alone, with clusters of another name."""
    figure = socket_figure(scene.geometry(), "a socket")
    wall, end = figure.axes
    assert end.get_xlabel() == "towards right [mm]" and end.get_ylabel() == "towards anterior [mm]"
    assert ticks(wall)[90.0].startswith("left") and ticks(wall)[-90.0].startswith("right")
    texts = {text.get_text().replace("\n", ""): text for axis in (wall, end) for text in axis.texts}
    for word, tile in (("ant_mid(mid_anterior)", "ant_mid"), ("left_end", "left_end")):
        assert texts[word].get_position() == pytest.approx(PLACES[tile], abs=0.05)
    assert fill_at(wall, "ant_mid") == pytest.approx(VERMILION, abs=1e-3)
    assert fill_at(wall, "ant_prox") == pytest.approx(LIGHT_BLUE, abs=1e-3)
    (key,) = figure.legends
    swatches = zip(key.texts, key.get_patches(), strict=True)
    colours = {text.get_text(): patch.get_facecolor()[:3] for text, patch in swatches}
    assert colours["tile with a cluster"] == pytest.approx(VERMILION, abs=1e-3)


# --- measured and predicted channels

WRENCH = {
    # place among the panels, label, measured and predicted by three models at 12.0 s
    "Fx": (0, "force [N]", (14.0, 0.0, 4.0, 14.0)),
    "Fz": (2, "force [N]", (-90.0, -22.5, -52.5, 0.0)),
    "Mx": (3, "moment [N m]", (0.55, 0.0, 0.0, 0.0)),
    "Mz": (5, "moment [N m]", (0.5, 0.0, 0.9, 0.0)),
}
LINES = ("measured", "stiffness:", "stiffness_bias:", "rigid_bias:")


@pytest.mark.parametrize("channel", WRENCH)
def test_a_channel_is_drawn_in_its_unit(channel: str, drawn: Draw) -> None:
    place, label, answers = WRENCH[channel]
    axis = drawn("wrench").axes[place]
    assert axis.get_ylabel() == label and legend(axis)[0] == channel
    for name, answer in zip(LINES, answers, strict=True):
        assert line(axis, name)[AT_PEAK] == pytest.approx(answer, abs=0.003), name


def test_a_key_holds_the_known_errors(drawn: Draw) -> None:
    """As in the table of errors."""
    sigma = "\N{GREEK SMALL LETTER SIGMA}"
    assert legend(drawn("wrench").axes[0]) == [
        *("Fx", "measured"),
        f"stiffness: RMSE 15.68 N,\nMAE 14.00, {sigma} 7.07, skill -1.22",
        f"stiffness_bias: RMSE 12.25 N,\nMAE 10.00, {sigma} 7.07, skill -0.73",
        f"rigid_bias: RMSE 3.54 N,\nMAE 3.18, {sigma} 3.54, skill 0.50",
    ]
    moment = legend(drawn("wrench").axes[5])
    assert moment[3] == f"stiffness_bias: RMSE 0.43 N m,\nMAE 0.37, {sigma} 0.21, skill -1.04"


def test_the_fitted_span_is_shaded(drawn: Draw) -> None:
    axis = drawn("wrench").axes[0]
    (span,) = axis.patches
    assert (span.get_x(), span.get_x() + span.get_width()) == (0.0, 11.75)
    assert drawn("wrench").axes[5].get_xlabel() == "time [s]"


@pytest.mark.parametrize(("name", "place"), [("distal.Fx", 9), ("distal.Fy", 10)])
def test_a_left_out_channel_is_called_so(name: str, place: int, drawn: Draw) -> None:
    """A column's figure has no errors; its titles name the channels."""
    axis = drawn("local_forces", FigureStyle(COLUMN)).axes[place]
    title = axis.get_title("left").replace("\n", " ")
    assert title == (f"{name} (not in objective)" if name == "distal.Fx" else name)
    assert axis.get_ylabel() == "force [N]"


LOCAL = {"brim_lateral.Fz": (2, (-40.5, 0.0, -50.0, 0.0)), "mid_anterior.Fy": (4, (5.4, 0, 0, 0))}


@pytest.mark.parametrize("channel", LOCAL)
def test_a_cluster_s_force_is_drawn(channel: str, drawn: Draw) -> None:
    place, answers = LOCAL[channel]
    axis = drawn("local_forces", FigureStyle(COLUMN)).axes[place]
    assert axis.get_title("left") == channel
    found = [each.get_ydata()[AT_PEAK] for each in axis.lines]
    assert found == pytest.approx(answers, abs=0.003)


# --- the other figures


def test_the_overview_is_in_its_units(drawn: Draw) -> None:
    """At 12.0 s |(14, 3, -90)| N and |(0.55, 0.1, 0.5)| N m."""
    force, moment, lacking, bar = drawn("overview").axes
    assert force.get_ylabel() == "force magnitude\n[N]"
    assert moment.get_ylabel() == "moment magnitude\n[N m]"
    assert force.lines[0].get_ydata()[AT_PEAK] == pytest.approx(91.1318, abs=1e-3)
    assert moment.lines[0].get_ydata()[AT_PEAK] == pytest.approx(0.75)
    assert lacking.get_xlabel() == "time [s]" and bar.get_ylabel() == "not usable [-]"
    words = [label.get_text() for label in lacking.get_yticklabels()]
    assert words[:7] == ["Mx", "My", "Mz", "Fx", "Fy", "Fz", "limb position"]
    assert lacking.yaxis_inverted() and not np.asarray(lacking.collections[0].get_array()).any()


def test_drop_outs_are_dark_at_their_time(report) -> None:
    """The second of two measurements is missing in the first 24 of 96 samples: two a column."""
    lost = np.arange(96) < 24
    loads = {"force magnitude [N]": np.zeros(96), "moment magnitude [N m]": np.zeros(96)}
    lacking = {"Mx": np.zeros(96, dtype=bool), "distal": lost}
    found = report.results
    figure = overview_figure(
        found.samples.time, loads, lacking, found.plateaus, found.segment, DEFAULT_STYLE
    )
    (mesh,) = figure.axes[2].collections
    found = np.asarray(mesh.get_array()).reshape(2, 48)
    assert not found[0].any()
    assert (found[1, :12] == 1.0).all() and not found[1, 13:].any()
    dark, light = mesh.cmap(1.0)[:3], mesh.cmap(0.0)[:3]
    assert sum(dark) < 0.1 and sum(light) > 2.9


def test_errors_are_bars_by_cluster(drawn: Draw) -> None:
    errors, _ = drawn("validation").axes
    words = [label.get_text() for label in errors.get_yticklabels()]
    assert words == ["brim_lateral", "distal", "all clusters", "tiles without a sensor"]
    lengths = {bars.get_label(): [bar.get_width() for bar in bars] for bars in errors.containers}
    assert lengths["force map"] == [0.35, 0.25, 0.3, 0.45]
    assert lengths["inverse distance"] == [0.9, 0.7, 0.8, 1.2]
    assert lengths["inverse distance, wrench met"][:3] == [0.6, 0.4, 0.5]
    assert errors.get_xlabel().startswith("error over the rms of the forces [-]")
    places = {bars.get_label(): bars[1].get_center()[1] for bars in errors.containers}
    assert all(place == pytest.approx(1.0, abs=0.4) for place in places.values())
    assert errors.yaxis_inverted()
    assert errors.lines[0].get_xdata()[0] == 1.0  # predicting zero


def test_coverage_is_in_percent(drawn: Draw) -> None:
    _, coverage = drawn("validation").axes
    assert coverage.get_xlabel() == "stated probability of the interval [%]"
    assert coverage.get_ylabel() == "values within the force map's\ninterval [%]"
    assert line(coverage, "all clusters").tolist() == pytest.approx([55.0, 85.0, 97.0])
    assert line(coverage, "tiles without").tolist() == pytest.approx([40.0, 70.0, 90.0])
    xs = [each.get_xdata() for each in coverage.lines if each.get_label() == "all clusters"]
    assert xs[0].tolist() == pytest.approx([50.0, 80.0, 95.0])


FRONT = {"s": (1.0, 0.1), "*": (0.3, 0.2), "^": (0.1, 1.0)}  # wrench and local error


@pytest.mark.parametrize("marker", FRONT, ids=["sensor-only", "knee", "wrench-only"])
def test_a_front_s_marks_are_at_their_errors(marker: str, drawn: Draw) -> None:
    (axes,) = drawn("pareto").axes
    first = next(each for each in axes.lines if each.get_marker() == marker)
    assert (first.get_xdata()[0], first.get_ydata()[0]) == FRONT[marker]


def test_a_front_names_its_axes_and_marks(drawn: Draw) -> None:
    figure = drawn("pareto")
    (axes,) = figure.axes
    root = "\N{SQUARE ROOT}"
    assert axes.get_xlabel() == f"wrench error {root}J_w [-]" and axes.get_xscale() == "log"
    assert axes.get_ylabel() == f"local error {root}J_f [-]" and axes.get_yscale() == "log"
    theta = "\N{GREEK SMALL LETTER THETA}"
    (key,) = figure.legends
    markers = {
        text.get_text(): handle.get_marker()
        for text, handle in zip(key.texts, key.legend_handles, strict=True)
    }
    assert markers[f"sensor-only ({theta} = 0)"] == "s"
    assert markers["knee"] == "*"
    assert markers[f"wrench-only ({theta} = 1)"] == "^"
    assert f"stiffness: knee at {theta} = 0.4" in markers


def test_a_dominated_solution_is_faint(drawn: Draw) -> None:
    (axes,) = drawn("pareto").axes
    faint = [each for each in axes.lines if each.get_alpha() is not None]
    points = [(*each.get_xdata(), *each.get_ydata()) for each in faint]
    assert points[0] == (0.35, 0.6)
    assert line(axes, "stiffness:").tolist() == [1.0, 0.2, 0.1]
