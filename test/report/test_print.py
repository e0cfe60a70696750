"""Figures as they are printed: their width, the size of their type, and room for every word."""

import re
import zlib
from contextlib import suppress
from itertools import product

import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import imread
from matplotlib.text import Text
from support.benches import nominal, sensor_bench

from socket_testbed.api import CalibratedCluster, Cycles
from socket_testbed.calibration.calibrate import calibrate_bench
from socket_testbed.report.results import Results
from socket_testbed.report.style import (
    WIDTHS,
    FigureStyle,
    in_style,
    save_figure,
    wrap,
)
from socket_testbed.report.write import SECTIONS


@pytest.fixture(scope="module")
def figures(results: Results) -> dict:
    """What draws every figure of the report and two of the API, by its name."""
    drawn = {
        f.name: f.draw
        for makers in SECTIONS.values()
        for make in makers
        for f in make(results).figures
    }
    quality = calibrate_bench(sensor_bench(play=2e3, repeats=1), nominal().wiring, True, False)
    curves = np.random.default_rng(5).normal(size=(9, 101, 3))
    spans = np.arange(18.0).reshape(9, 2)
    of_cycles = ("Fz [N]", "mean pressure of the region [kPa]", "Mx [N m]")
    return drawn | {
        "bench": in_style(CalibratedCluster("distal", quality, None, None)._figure),
        "cycles": in_style(Cycles(results.trial, "placed", spans, 0, of_cycles, curves)._figure),
    }


@in_style  # as figures are saved
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


def check_pdf(content: bytes, width: float) -> None:
    """A PDF is as wide as stated, and its text is text, of 7 pt, in TrueType."""
    box = re.search(rb"/MediaBox \[([\d. ]+)\]", content)[1].split()
    assert float(box[2]) / 72.0 * 25.4 == pytest.approx(width, abs=1.0)
    sizes = []
    for start in re.finditer(rb"stream\r?\n", content):
        with suppress(zlib.error):
            stream = zlib.decompressobj().decompress(content[start.end() :])
            sizes += [float(size) for size in re.findall(rb"/F\d+ ([\d.]+) Tf", stream)]
    assert sizes and min(sizes) >= 7.0
    assert b"/TrueType" in content or b"/CIDFontType2" in content
    assert b"/Type3" not in content


@pytest.mark.slow
def test_every_figure_is_as_wide_as_stated_and_every_word_legible(figures, tmp_path):
    alike = {"tile_stiffness_stiffness", "tile_stiffness_stiffness_bias", "tile_stiffness_given"}
    for name, width, titles in product({*figures} - alike, WIDTHS, (True, False)):
        figure = figures[name](FigureStyle(width, titles))
        check_words(name, figure)
        assert titles or not figure.get_suptitle()  # then the caption says what is shown
        if titles:
            save_figure(figure, tmp_path / "figure.pdf")
            check_pdf((tmp_path / "figure.pdf").read_bytes(), width)


def test_a_png_has_300_pixels_to_the_inch_whatever_a_user_has_set(figures, tmp_path):
    for width in WIDTHS:
        figure = figures["pareto"](FigureStyle(width))
        expected = [size for _, size, _ in drawn_texts(figure)[0]]
        with rc_context({"font.size": 4.0, "xtick.labelsize": 3.0, "savefig.bbox": "tight"}):
            save_figure(figure, tmp_path / "figure.png")
            found = drawn_texts(figures["pareto"](FigureStyle(width, True)))[0]
        pixels = imread(tmp_path / "figure.png").shape[1]
        assert pixels == pytest.approx(width / 25.4 * 300, abs=1.0)
        assert [size for _, size, _ in found] == expected


def test_a_wrapped_text_keeps_its_words():
    for text in ("one two three " * 20, "a" * 300, "$\\frac$ " * 30, "", "  "):
        lines = wrap(text, 84.0).split("\n")
        assert "".join("".join(lines).split()) == "".join(text.split())
        assert max(map(len, lines)) < 80
