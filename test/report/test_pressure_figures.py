"""Figures of pressure hold what they were given, at the size of print."""

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.collections import PolyCollection
from support.ring_socket import ring_socket

from socket_testbed.report.figures.pressure import (
    Band,
    group_regions,
    pressure_maps_figure,
    pressure_views_figure,
    regions_figure,
)
from socket_testbed.report.figures.style import LINE_STYLES, SCALE, thin_band

SIDES = ("anterior", "lateral", "posterior", "medial")


@pytest.fixture(scope="module")
def geometry():
    return ring_socket()


@pytest.fixture
def maps(geometry, rng):
    mean = rng.uniform(5.0, 30.0, len(geometry))
    mean[[3, 11]] = np.nan
    return {"mean over the hold": mean, "peak": mean + 10.0}


@pytest.fixture
def rng():
    return np.random.default_rng(3)


@pytest.mark.parametrize(
    ("side", "at_left", "at_right"),
    [("right", "medial", "lateral"), ("left", "lateral", "medial"), ("", "left", "right")],
)
def test_the_sides_of_a_map_are_those_of_the_leg(geometry, maps, side, at_left, at_right):
    figure = pressure_maps_figure(geometry, {"mean": maps["peak"]}, side)
    axis = figure.axes[0]
    names = {
        round(float(place)): label.get_text().split("\n")[1]
        for place, label in zip(axis.get_xticks(), axis.get_xticklabels(), strict=True)
    }
    assert at_left.startswith(names[90].strip("."))
    assert at_right.startswith(names[-90].strip("."))
    assert "anterior".startswith(names[0].strip("."))
    assert names[180] == names[-180] and "posterior".startswith(names[180].strip("."))


def test_what_is_not_determined_is_hatched(geometry, maps):
    figure = pressure_maps_figure(geometry, maps)
    hatched = [
        sum(len(c.get_paths()) for c in axis.collections if c.get_hatch()) for axis in figure.axes
    ]
    assert sum(hatched) == 2 * 2  # two tiles in two maps
    assert "hatched: not determined" in figure.get_supxlabel()
    known = {name: np.nan_to_num(values, nan=1.0) for name, values in maps.items()}
    assert "hatched" not in pressure_maps_figure(geometry, known).get_supxlabel()


def test_pressure_is_shown_from_zero_on_one_scale_if_alike(geometry, maps):
    figure = pressure_maps_figure(geometry, maps)
    (bar,) = [axis for axis in figure.axes if axis.get_ylabel() == "pressure [kPa]"]
    highest = max(np.nanmax(values) for values in maps.values())
    assert bar.get_ylim() == pytest.approx((0.0, highest))
    far = {"mean": maps["peak"], "peak": 10.0 * maps["peak"]}
    bars = [
        axis
        for axis in pressure_maps_figure(geometry, far).axes
        if axis.get_ylabel() == "pressure [kPa]"
    ]
    assert len(bars) == 2


def test_a_view_shows_every_tile_the_nearer_over_the_farther(geometry, maps):
    maps["peak"] = np.nan_to_num(maps["peak"], nan=20.0)
    figure = pressure_views_figure(geometry, {"peak": maps["peak"]}, "left")
    front, back = figure.axes[:2]
    assert len(front.patches) == len(back.patches) == len(geometry)
    assert [text.get_text() for text in front.texts] == ["anterior", "lateral"]
    assert [text.get_text() for text in back.texts] == ["posterior", "medial"]
    # From in front, what is drawn last is anterior and left.
    last = front.patches[-1].get_facecolor()
    colours = colormaps[SCALE](maps["peak"] / figure.axes[-1].get_ylim()[1])
    nearest = int(np.abs(colours - last).sum(axis=1).argmin())
    assert geometry.anchors[nearest] @ [1.0, 1.0, 0.0] > 0.0


def band(rng, count):
    values = rng.normal(10.0, 1.0, count)
    return Band(values, values - 2.0, values + 3.0)


def test_regions_of_one_kind_share_a_panel():
    names = [f"{side} {height}" for side in SIDES for height in ("proximal", "middle", "distal")]
    groups = group_regions([*names, "fibula head", "tendon"])
    assert [heading for heading, _ in groups] == ["proximal", "middle", "distal", ""]
    assert groups[0][1] == {f"{side} proximal": side for side in SIDES}
    assert groups[3][1] == {"fibula head": "fibula head", "tendon": "tendon"}
    parts = group_regions([*SIDES, "proximal", "middle", "distal", "socket"])
    assert [heading for heading, _ in parts] == ["sectors", "heights", ""]
    assert [*parts[0][1]] == [*SIDES]
    several = group_regions([f"r{i}" for i in range(2 * len(LINE_STYLES) + 1)])
    assert [len(group) for _, group in several] == [len(LINE_STYLES)] * 2 + [1]


def test_regions_have_their_lines_bands_and_events(rng):
    time = np.linspace(0.0, 60.0, 250)
    regions = {name: band(rng, 250) for name in ("a$_b", "fibula head")}
    figure = regions_figure(time, regions, [(30.0, "removed"), (10.0, "placed"), (50.0, "placed")])
    (axis,) = figure.axes
    lines = [line for line in axis.lines if len(line.get_xdata()) == 250]
    for line, drawn in zip(lines, regions.values(), strict=True):
        np.testing.assert_array_equal(line.get_xydata(), np.stack([time, drawn.values], axis=1))
    assert len({str(line.get_linestyle()) for line in lines}) == 2
    for shade, drawn in zip(axis.collections, regions.values(), strict=True):
        points = shade.get_paths()[0].vertices
        assert points[:, 1].min() == pytest.approx(drawn.low.min())
        assert points[:, 1].max() == pytest.approx(drawn.high.max())
    assert isinstance(axis.collections[0], PolyCollection)
    marks = sorted(line.get_xdata()[0] for line in axis.lines if len(line.get_xdata()) == 2)
    assert marks == [10.0, 30.0, 50.0]
    assert "1 placed, 2 removed" in figure.get_supxlabel()


def test_a_thinned_band_keeps_its_extremes(rng):
    x = np.arange(10_001.0)
    low, high = rng.normal(size=(2, 10_001))
    low[5000:5100] = np.nan
    thinned = thin_band(x, low, high, 500)
    assert all(len(part) <= 500 for part in thinned)
    assert np.nanmin(thinned[1]) == np.nanmin(low) and thinned[2].max() == high.max()
