"""The figures hold what they were given; in print every word is legible."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.colors import PowerNorm, to_hex
from matplotlib.text import Text
from support import CHECKOUT
from support.problems import random_socket, ring_socket

from socket_testbed.figures import style
from socket_testbed.figures.tiles import tile_map_figure
from socket_testbed.report.write import SECTIONS
from socket_testbed.results.report import Results

NASTY, UNIT = "a$_b <i>", "pressure [kPa]"


@pytest.mark.parametrize(
    ("count", "most"),
    [(10, 100), (1001, style.MAX_POINTS), (12_345, 10), (12_345, style.MAX_POINTS)],
    ids=["short", "medium", "to ten", "long"],
)
def test_a_thinned_line_keeps_its_peaks(count: int, most: int, rng):
    x, y = np.arange(count) / 4.0, rng.normal(size=count)
    thin_x, thin_y = style.thin(x, y, most)
    assert len(thin_x) <= most
    assert (np.diff(thin_x) >= 0.0).all()
    assert (thin_y.min(), thin_y.max()) == (y.min(), y.max())
    np.testing.assert_array_equal(thin_y, y[np.round(thin_x * 4.0).astype(int)])


@pytest.fixture
def gappy(rng) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times and the ends of a band, the lower of which has a gap."""
    time, (low, high) = np.arange(10_001.0), rng.normal(size=(2, 10_001))
    low[4000:6000] = np.nan
    return time, low, high


def test_a_thinned_line_keeps_its_gaps(gappy):
    time, low, _ = gappy
    x, kept = style.thin(time, low, 500)
    assert np.isnan(kept[(x >= 4100) & (x < 5900)]).all()


def test_a_thinned_band_keeps_its_ends(gappy):
    time, low, high = gappy
    _, lowest, highest = style.thin_band(time, low, high, 500)
    assert np.nanmin(lowest) == np.nanmin(low) and highest.max() == high.max()


def test_print_has_the_page_s_colour_scale() -> None:
    script = (
        (CHECKOUT / "socket_testbed/pages/static/socket.js")
        .read_text()
        .partition("const VIRIDIS")[2]
        .partition("].map")[0]
    )
    ours = [to_hex(colormaps[style.SCALE](place)) for place in np.linspace(0.0, 1.0, 11)]
    assert re.findall(r"#[0-9a-f]{6}", script) == ours


def scales_of(figure) -> list[tuple[float, float]]:
    return [axis.get_ylim() for axis in figure.axes if axis.get_ylabel() == UNIT]


@pytest.fixture
def socket(rng):
    return dataclasses.replace(random_socket(rng, rings=3, columns=6), clusters={NASTY: 4})


@pytest.mark.parametrize("larger", [1.5, 9.0], ids=["one scale", "own scales"])
def test_tiles_have_the_colours_of_their_values(larger: float, socket, rng):
    """On one scale unless their ranges differ."""
    values = {"x": rng.uniform(0.0, 1.0, 18), "y": rng.uniform(0.0, larger, 18)}
    figure = tile_map_figure(socket, values, UNIT)
    rows = [np.concatenate([*values.values()])] if larger < 2.0 else [*values.values()]
    ends = [(row.min(), row.max()) for row in rows]
    np.testing.assert_allclose(scales_of(figure), ends)
    maps = [axis for axis in figure.axes if axis.get_xlim()[0] < -180.0]
    for axis, row, scale in zip(maps, values.values(), [*ends, *ends], strict=False):
        squares = next(c for c in axis.collections if isinstance(c, PolyCollection))
        expected = colormaps[style.SCALE](PowerNorm(1.0, *scale)(row))
        np.testing.assert_allclose(squares.get_facecolors(), expected)
    assert figure.get_supxlabel() == f"1 {NASTY}"


def test_tiles_without_a_value_are_hatched(socket, rng):
    values = rng.uniform(5.0, 30.0, 18)
    values[3] = np.nan
    figure = tile_map_figure(socket, {"mean": values}, UNIT)
    hatched = sum(len(c.get_paths()) for a in figure.axes for c in a.collections if c.get_hatch())
    assert hatched == 1 and "hatched: no value" in figure.get_supxlabel()
    np.testing.assert_allclose(scales_of(figure), [(np.nanmin(values), np.nanmax(values))])


COLOUR = np.array(colormaps[style.SCALE](PowerNorm(0.5, 0.0, 40.0)(20.0))[:3])


@pytest.mark.parametrize(
    ("reach", "expected"),
    [(0.0, COLOUR), (60.0, 0.15 * COLOUR + 0.85 * 150 / 255)],
    ids=["known", "unknown"],
)
def test_a_map_is_greyer_where_intervals_reach_far(reach: float, expected: np.ndarray):
    """And smooth."""
    geometry = ring_socket()
    values, reaches = ({"x": np.full(len(geometry), own)} for own in (20.0, reach))
    figure = tile_map_figure(geometry, values, UNIT, limits=(0.0, 40.0), reach=reaches)
    for panel in figure.axes[:2]:  # wall and end
        image = np.asarray(panel.images[0].get_array())
        shown = image[image[..., 3] == 1.0][:, :3]
        assert len(shown) > 100
        np.testing.assert_allclose(shown, np.broadcast_to(expected, shown.shape), atol=5e-3)


# --- as they are printed: width, size of type, room for every word


@pytest.fixture(scope="module")
def figures(results: Results) -> dict:
    """What draws every figure of the report, by its name."""
    made = (make(results) for makers in SECTIONS.values() for make in makers)
    return {figure.name: figure.draw for section in made for figure in section.figures}


@style.in_style  # as figures are saved
def drawn_texts(figure):
    """What is drawn of text: its content, size [pt] and box [px]; and the boxes of the panels."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    texts = {}
    original = Text.draw

    def record(text, *arguments, **more):
        if text.get_visible() and text.get_text().strip():
            assert "$" not in text.get_text()  # sub- and superscripts are smaller
            texts[id(text)] = text
        return original(text, *arguments, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Text, "draw", record)
        figure.draw(renderer)
    assert texts
    boxes = [
        (t.get_text(), t.get_fontsize(), t.get_window_extent(renderer)) for t in texts.values()
    ]
    panels = [axis.get_window_extent(renderer) for axis in figure.axes if axis.get_visible()]
    return boxes, panels


def check_words(name: str, figure) -> None:
    """Every word is of 7 pt, inside the figure, and beside the panels and the other words."""

    def overlap(a, b) -> float:  # the smaller side of what two boxes share [px]
        return min(min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0))

    def is_within(a, b, margin: float = 0.0) -> bool:
        across = b.x0 - margin <= a.x0 and a.x1 <= b.x1 + margin
        return across and b.y0 - margin <= a.y0 and a.y1 <= b.y1 + margin

    texts, panels = drawn_texts(figure)
    for i, (text, size, box) in enumerate(texts):
        assert size >= 7.0 and is_within(box, figure.bbox, 0.5), (name, text)
        for panel in panels:
            assert is_within(box, panel) or overlap(box, panel) < 1.5, (name, text)
        for other, _, beside in texts[:i]:
            assert overlap(box, beside) < 1.5, (name, text, other)


ALIKE = {"tile_stiffness_stiffness", "tile_stiffness_stiffness_bias", "tile_stiffness_given"}


@pytest.mark.slow
@pytest.mark.parametrize("titles", [True, False], ids=["titles", "captions"])
@pytest.mark.parametrize("width", style.WIDTHS, ids=lambda width: f"{width:g} mm")
def test_every_word_is_legible(
    width: float, titles: bool, figures: dict, tmp_path: Path, subtests: pytest.Subtests
):
    """In figures as wide as stated; without a title the caption says what is shown."""
    for name in {*figures} - ALIKE:
        with subtests.test(name):
            figure = figures[name](style.FigureStyle(width, titles))
            check_words(name, figure)
            assert titles or not figure.get_suptitle()
            if titles:
                style.save_figure(figure, tmp_path / "figure.pdf")
                content = (tmp_path / "figure.pdf").read_bytes()
                box = re.search(rb"/MediaBox \[([\d. ]+)\]", content)[1].split()
                assert float(box[2]) / 72.0 * 25.4 == pytest.approx(width, abs=1.0)
                assert b"/Type3" not in content  # text is text
