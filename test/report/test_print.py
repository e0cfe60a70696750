"""Figures as they are printed: their width, the size of their type, and room for every word."""

import re
import zlib
from functools import cache, partial

import numpy as np
import pytest
from matplotlib import colormaps, rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from matplotlib.text import Text
from support.benches import nominal, sensor_bench
from support.pareto_cases import made_up_front
from support.ring_socket import ring_socket

from socket_testbed.calibration.calibrate import calibrate_bench
from socket_testbed.identification.evaluation import channel_errors
from socket_testbed.identification.validation import CLOSED, FORCE_MAP, INVERSE_DISTANCE, Judgement
from socket_testbed.report.figures.calibration import bench_figure
from socket_testbed.report.figures.channels import (
    Panel,
    Prediction,
    offsets_figure,
    overview_figure,
    panels_figure,
)
from socket_testbed.report.figures.pareto import pareto_figure
from socket_testbed.report.figures.pressure import (
    Band,
    pressure_maps_figure,
    pressure_views_figure,
    regions_figure,
)
from socket_testbed.report.figures.style import (
    BAR_STYLES,
    LINE_STYLES,
    MODEL_STYLES,
    SCALE,
    WIDTHS,
    FigureStyle,
    in_style,
    save_figure,
    wrap,
)
from socket_testbed.report.figures.tile_maps import tile_map_figure
from socket_testbed.report.figures.validation import validation_figure
from socket_testbed.samples import channel_names

CLUSTERS = ("posterior_distal", "brim_lateral")
TITLE = "subject07_morning_walk_2, plateau 65.75 s to 104.50 s: a title of a usual length, and more"
RNG = np.random.default_rng(5)
TIME = np.linspace(0.0, 120.0, 400)
SOCKET = ring_socket()
TILES = RNG.uniform(5.0, 40.0, len(SOCKET))
SIDES = ("anterior", "medial", "posterior", "lateral")
BANDS = {
    f"{side} {height}": Band(TILES[:1] + RNG.normal(size=400), 0 * TIME, 60.0 + 0 * TIME)
    for side in SIDES
    for height in ("proximal", "middle", "distal")
}
EVENTS = [(10.0, "placed"), (60.0, "step"), (60.5, "note"), (118.0, "removed")]


def panel(name: str, scale: float) -> Panel:
    measured = scale * RNG.normal(size=400)
    labels = ("stiffness", "stiffness_bias", "rigid_bias")
    errors = channel_errors(name, measured, -measured, name != "Mz")
    return Panel(
        TIME, measured, tuple(Prediction(n, -measured, errors) for n in labels), (30.0, 90.0)
    )


def judgement(question: str, cluster: str, predictor: str) -> Judgement:
    return Judgement(
        question, predictor, "left out", "", "a", cluster, 9, 0.8, coverage=(0.5, 0.8, 0.9)
    )


WRENCH = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
LOCAL = [f"{cluster}.F{axis}" for cluster in CLUSTERS for axis in "xyz"]
MAPS = {
    "mean over the hold, 42.00 s to 60.00 s": TILES,
    "at the peak, 51.20 s": np.where(np.arange(len(SOCKET)) % 7, 1.5 * TILES, np.nan),
}
FIGURES = {
    "wrench": partial(panels_figure, [panel(n, 300.0) for n in WRENCH], 3, TITLE),
    "local": partial(panels_figure, [panel(n, 30.0) for n in LOCAL], 3, TITLE),
    "panel": partial(panels_figure, [panel(LOCAL[0], 30.0)], 1),
    "overview": partial(
        overview_figure,
        TIME,
        RNG.normal(size=(400, 6)),
        [(10.0, 50.0)],
        (60.0, 90.0),
        {name: RNG.random(400) < 0.1 for name in ("Mx", "posterior_distal (Fx, Fy, Fz)")},
    ),
    "offsets": partial(
        offsets_figure,
        channel_names(CLUSTERS),
        {name: RNG.normal(size=12) for name in ("stiffness_bias", "rigid_bias")},
    ),
    "pareto": partial(
        pareto_figure, [made_up_front(), made_up_front("stiffness_bias", 0.02)], TITLE
    ),
    "validation": partial(
        validation_figure,
        [
            judgement(*row, predictor)
            for row in [("cluster", name) for name in (*CLUSTERS, "")] + [("tiles", "")]
            for predictor in (INVERSE_DISTANCE, CLOSED, FORCE_MAP)
        ],
        TITLE,
    ),
    "tile_map": partial(
        tile_map_figure,
        SOCKET,
        {f"q_r along {axis} of the tile's frame": k * TILES for k, axis in enumerate("xyz", 1)},
        "rest position from the mean limb position [mm]",
        TITLE,
    ),
    "pressure_maps": partial(pressure_maps_figure, SOCKET, MAPS, "left", TITLE),
    "pressure_views": partial(pressure_views_figure, SOCKET, MAPS, "left", TITLE),
    "regions": partial(regions_figure, TIME, BANDS, EVENTS, TITLE),
}


@cache
def calibrated():
    bench = sensor_bench(play=2e3, repeats=1)
    return calibrate_bench(bench, nominal().wiring, True, False)


FIGURES["bench"] = lambda style: bench_figure(calibrated(), "distal", style)


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


def overlap(a, b) -> float:
    """The smaller side of what two boxes share [px]."""
    across = min(a.x1, b.x1) - max(a.x0, b.x0)
    along = min(a.y1, b.y1) - max(a.y0, b.y0)
    return min(across, along)


def check_words(figure) -> None:
    """Every word is of 7 pt, inside the figure, and beside the panels and the other words."""
    texts, panels = drawn_texts(figure)
    for text, size, box in texts:
        assert size >= 7.0, text
        assert box.x0 > -0.5 and box.x1 < figure.bbox.width + 0.5, text
        assert box.y0 > -0.5 and box.y1 < figure.bbox.height + 0.5, text
        for panel in panels:
            inside = panel.x0 <= box.x0 and box.x1 <= panel.x1
            inside = inside and panel.y0 <= box.y0 and box.y1 <= panel.y1
            assert inside or overlap(box, panel) < 1.5, text
    for i, (text, _, box) in enumerate(texts):
        for other, _, beside in texts[:i]:
            assert overlap(box, beside) < 1.5, (text, other)


def check_pdf(content: bytes, width: float) -> None:
    """A PDF is as wide as stated, and its text is text, of 7 pt, in TrueType."""
    box = re.search(rb"/MediaBox \[([\d. ]+)\]", content)[1].split()
    assert float(box[2]) / 72.0 * 25.4 == pytest.approx(width, abs=1.0)
    sizes = []
    for start in re.finditer(rb"stream\r?\n", content):
        try:
            stream = zlib.decompressobj().decompress(content[start.end() :])
        except zlib.error:
            continue
        sizes += [float(size) for size in re.findall(rb"/F\d+ ([\d.]+) Tf", stream)]
    assert sizes and min(sizes) >= 7.0
    assert b"/TrueType" in content or b"/CIDFontType2" in content
    assert b"/Type3" not in content


@pytest.mark.slow
@pytest.mark.parametrize("titles", [True, False])
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("draw", FIGURES.values(), ids=FIGURES)
def test_a_figure_is_as_wide_as_stated_and_every_word_legible(draw, width, titles, tmp_path):
    figure = draw(style=FigureStyle(width, titles))
    check_words(figure)
    assert titles or not figure.get_suptitle()  # then the caption says what is shown
    if titles:
        save_figure(figure, tmp_path / "figure.pdf")
        check_pdf((tmp_path / "figure.pdf").read_bytes(), width)


@pytest.mark.parametrize("width", WIDTHS)
def test_a_png_has_300_pixels_to_the_inch(width, tmp_path):
    save_figure(FIGURES["pareto"](style=FigureStyle(width)), tmp_path / "figure.png")
    assert imread(tmp_path / "figure.png").shape[1] == pytest.approx(width / 25.4 * 300, abs=1.0)


def test_a_users_settings_change_nothing():
    style = FigureStyle()
    expected = drawn_texts(FIGURES["offsets"](style=style))[0]
    with rc_context({"font.size": 4.0, "xtick.labelsize": 3.0, "savefig.bbox": "tight"}):
        found = drawn_texts(FIGURES["offsets"](style=style))[0]
    assert [size for _, size, _ in found] == [size for _, size, _ in expected]


def lightness(colour) -> float:
    """Lightness L* of a colour (CIE 1976) [-]."""
    linear = np.array([c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour])
    y = linear @ [0.2126, 0.7152, 0.0722]
    return 116.0 * np.cbrt(y) - 16.0 if y > 0.008856 else 903.3 * y


def test_the_scale_prints_in_grey_even_for_signed_values():
    """Its lightness rises throughout: the sign of a value about zero is not lost in grey."""
    values = [lightness(colour[:3]) for colour in colormaps[SCALE](np.linspace(0.0, 1.0, 101))]
    assert (np.diff(values) > 0.0).all() and np.ptp(values) > 70.0


@pytest.mark.parametrize("styles", [MODEL_STYLES, LINE_STYLES])
def test_lines_differ_without_colour(styles):
    assert len({str(style["linestyle"]) for style in styles}) == len(styles)


def test_bars_differ_without_colour():
    for i, style in enumerate(BAR_STYLES):
        for other in BAR_STYLES[:i]:
            apart = abs(
                lightness(to_rgb(style["facecolor"])) - lightness(to_rgb(other["facecolor"]))
            )
            assert apart > 20.0 or style.get("hatch") != other.get("hatch")


@pytest.mark.parametrize("text", ["one two three " * 20, "a" * 300, "$\\frac$ " * 30, "", "  "])
def test_a_wrapped_text_keeps_its_words(text):
    lines = wrap(text, 84.0).split("\n")
    assert "".join("".join(lines).split()) == "".join(text.split())
    assert max(map(len, lines)) < 80
