"""Shared by all figures: printed size, type, colours, lines that differ in grey, files."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath

from socket_testbed.arrays import FloatArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import WIDTHS, atomic_output, check_picture

SCALE = "viridis"  # even in lightness, told apart by the colour-blind; as on the pages


# Okabe & Ito's colours differ in lightness, too, and each line has its own dashes.
LINE_STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#D55E00", "linestyle": (0, (4, 1.5))},
    {"color": "#0072B2", "linestyle": "-"},
    {"color": "#222222", "linestyle": (0, (1, 1.2))},
    {"color": "#009E73", "linestyle": (0, (5, 1.5, 1, 1.5))},
)
MOST_POINTS = 1000  # per line
THINNED = (
    f"Lines of more than {MOST_POINTS} samples are drawn by the lowest and highest value of equally"
    " many, so every peak shows; the CSV holds all."
)
MEASURED_STYLE: dict[str, Any] = {"color": "0.72", "linewidth": 2.4}
SEGMENT_STYLE: dict[str, Any] = {"color": "0.94", "linewidth": 0.0, "zorder": 0.5}

COLUMN, PAGE = WIDTHS
MM = 1.0 / 25.4  # [inch]
LABEL, SMALL = 8.0, 7.0  # [pt]; nothing is set smaller

_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same on every machine
    "font.size": SMALL,
    "axes.labelsize": LABEL,
    "axes.titlesize": LABEL,
    "xtick.labelsize": SMALL,
    "ytick.labelsize": SMALL,
    "legend.fontsize": SMALL,
    "legend.title_fontsize": LABEL,
    "figure.titlesize": LABEL,
    "legend.frameon": False,
    "axes.linewidth": 0.6,
    "grid.linewidth": 0.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "hatch.linewidth": 0.6,
    "lines.linewidth": 1.1,
    "figure.constrained_layout.w_pad": 0.02,
    "figure.constrained_layout.h_pad": 0.02,
    "pdf.fonttype": 42,  # TrueType: text stays text
    "savefig.bbox": "standard",  # a tight box would change the width
    "text.usetex": False,
}
# Decorates what draws, so that the user's settings of matplotlib change nothing.
in_style = mpl.rc_context(_STYLE)
_NO_LAYOUT = {"figure.autolayout": False, "figure.constrained_layout.use": False}


@dataclass(frozen=True)
class FigureStyle:
    """How a figure is set for print."""

    width: float = PAGE  # [mm], such as `COLUMN` or `PAGE`
    titles: bool = True  # and errors in keys; in a paper, the caption says these

    @property
    def is_narrow(self) -> bool:
        """Whether it is a column, not a page."""
        return self.width < 0.5 * (COLUMN + PAGE)

    def figure(self, height: float) -> Figure:
        """An empty figure of this width and a height [mm]."""
        return Figure(figsize=(self.width * MM, height * MM), layout="constrained")

    def add_title(self, figure: Figure | SubFigure, title: str) -> None:
        """Title of a figure, in lines that fit, unless it shall have none; no markup."""
        if self.titles and title:
            figure.suptitle(wrap(title, 0.96 * self.width), parse_math=False)


DEFAULT_STYLE = FigureStyle()


def figure_style(width: float, title: bool) -> FigureStyle:
    """The style that a user asks for; an error if figures are not laid out for its width."""
    if width not in WIDTHS:
        raise ConfigurationError(
            f"figures are not laid out for a width of {width:g} mm",
            f"give {COLUMN} for a column of a paper or {PAGE} for its page",
        )
    return FigureStyle(width, title)


@in_style
def wrap(text: str, width: float, size: float = LABEL) -> str:
    """Break a text into lines that fit into a width [mm] at a size [pt]; long words, too."""
    if not text.strip():
        return text
    drawn = TextPath((0, 0), text.replace("$", "S"), size=size, prop=FontProperties())
    needed = drawn.get_extents().width / 72.0 / MM
    lines = int(np.ceil(needed / width))
    if lines <= 1:
        return text
    # Characters differ in width: a line of narrow ones is followed by one of wide ones.
    return textwrap.fill(text, max(8, int(0.9 * len(text) * width / needed)))


def style_axes(axis: Axes) -> None:
    """A light grid behind the lines, and no frame above and to the right."""
    axis.grid(color="0.9")
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)


def panels(
    figure: Figure | SubFigure, count: int, across: int, label: str = "time [s]", **shared: Any
) -> list[Axes]:
    """Panels over a common axis, row by row, labelled below the lowest of each column."""
    rows = -(-count // across)
    axes = figure.subplots(rows, across, squeeze=False, sharex=True, **shared).ravel()
    for axis in axes[count:]:
        axis.remove()
    for number, axis in enumerate(axes[:count]):
        style_axes(axis)
        if number + across >= count:
            axis.set_xlabel(label)
            axis.tick_params(labelbottom=True)
    return [*axes[:count]]


def add_legend(where: Axes | Figure, *entries: Any, **options: Any) -> None:
    """A legend without markup; that of a panel is above it, with a bold title."""
    if isinstance(where, Axes):
        bold = {"size": LABEL, "weight": "bold"}
        above = {"loc": "lower left", "bbox_to_anchor": (-0.01, 1.0), "borderaxespad": 0.0}
        options = above | {"alignment": "left", "title_fontproperties": bold} | options
    legend = where.legend(*entries, **options)
    for text in (legend.get_title(), *legend.get_texts()):
        text.set_parse_math(False)


def lay_out(figure: Figure) -> Figure:
    """The same figure with its layout done once; every saving would repeat it."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        if any(axis.get_aspect() != "auto" for axis in figure.axes):
            engine.execute(figure)  # panels with a fixed aspect find their place in the second
        with mpl.rc_context(_NO_LAYOUT):
            figure.set_layout_engine(None)  # "none" leaves a placeholder: savefig draws twice
    return figure


@in_style
def save_figure(figure: Figure, path: Path, dpi: int = 300) -> None:
    """Write a figure at its printed size as `.png` or `.pdf`; text stays text in a PDF."""
    check_picture(path)
    with atomic_output(path) as staging:
        figure.savefig(staging, dpi=dpi)


def thin(x: FloatArray, y: FloatArray, most: int = MOST_POINTS) -> tuple[FloatArray, FloatArray]:
    """Keep the lowest and the highest value of each of equally many samples.

    Values, shape (N,), are NaN where there is none; a gap is kept where all values of its samples
    are missing. The kept points are in their order, all of them if they are no more than `most`.
    """
    if len(x) <= most:
        return x, y
    size = -(-2 * len(x) // most)
    rows = np.pad(y, (0, -len(y) % size), constant_values=np.nan).reshape(-1, size)
    start = size * np.arange(len(rows))
    lowest = start + np.where(np.isnan(rows), np.inf, rows).argmin(axis=1)
    highest = start + np.where(np.isnan(rows), -np.inf, rows).argmax(axis=1)
    index = np.sort(np.stack([lowest, highest], axis=1), axis=1).ravel()
    return x[index], y[index]


def thin_band(
    x: FloatArray, low: FloatArray, high: FloatArray, most: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Keep the outermost ends of an interval of each of equally many samples, as `thin`."""
    if len(x) <= most:
        return x, low, high
    starts = np.arange(0, len(x), -(-len(x) // most))
    return x[starts], np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)
