"""Style shared by all figures: printed size, type, colours, lines distinct in grey, files.

matplotlib takes half a second to import: the modules of this folder import it where they draw, so
that pages share their colours and lines without it.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeAlias, TypeVar

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import PICTURES, atomic_output, check_suffix

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

_P = ParamSpec("_P")
_R = TypeVar("_R")

SCALE = "viridis"  # perceptually uniform, safe for colour-blind readers
# Of errors and differences, white at zero; as in socket.js (ColorBrewer's RdBu, turned round)
DIVERGING = ("#2166ac", "#67a9cf", "#f7f7f7", "#f4a582", "#b2182b")

VERMILION, BLUE, GREEN = "#D55E00", "#0072B2", "#009E73"  # Okabe & Ito's
INK = "#222222"  # the colour of text on a page, also a dark one
# These colours also differ in lightness, and each line has its own dashes.
LINE_STYLES: tuple[dict[str, Any], ...] = (
    {"color": VERMILION, "linestyle": (0, (4, 1.5))},
    {"color": BLUE, "linestyle": "-"},
    {"color": INK, "linestyle": (0, (1, 1.2))},
    {"color": GREEN, "linestyle": (0, (5, 1.5, 1, 1.5))},
)
MAX_POINTS = 1000  # per line
THINNED = (
    f"Lines with more than {MAX_POINTS} samples show the lowest and highest value of each interval,"
    " so no peak is lost; the CSV holds all samples."
)
MEASURED_STYLE: dict[str, Any] = {"color": "#A6A6A6", "linewidth": 2.4}
SEGMENT_STYLE: dict[str, Any] = {"color": "0.94", "linewidth": 0.0, "zorder": 0.5}


def _page_line(style: Mapping[str, Any]) -> dict[str, Any]:
    """A line style of the figures for plotly, in pixels; no colour stands for `INK`."""
    found: dict[str, Any] = {"width": 1.2 * style.get("linewidth", 1.1)}
    if style["color"] != INK:
        found["color"] = style["color"]
    if not isinstance(style.get("linestyle", "-"), str):
        found["dash"] = ",".join(f"{2.0 * length:g}px" for length in style["linestyle"][1])
    return found


# Of measured lines, then as `LINE_STYLES`
PAGE_LINES = [_page_line(style) for style in (MEASURED_STYLE, *LINE_STYLES)]

Limits: TypeAlias = tuple[float | None, float | None]
COLUMN, PAGE = WIDTHS = (88, 180)  # [mm]; one column and two columns of a paper
MM = 1.0 / 25.4  # [inch]
LABEL, SMALL = 8.0, 7.0  # [pt]

_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # shipped with matplotlib: the same on every machine
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
    "svg.fonttype": "none",  # no outlines: text stays text
    "savefig.bbox": "standard",  # a tight box would change the width
    "text.usetex": False,
}
_NO_LAYOUT = {"figure.autolayout": False, "figure.constrained_layout.use": False}


def in_style(draw: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorator of drawing functions that shields them from the user's matplotlib settings."""

    @wraps(draw)
    def drawn(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        from matplotlib import rc_context

        with rc_context(_STYLE):
            return draw(*args, **kwargs)

    return drawn


@dataclass(frozen=True)
class FigureStyle:
    """Print layout of a figure.

    Attributes:
        width: Printed width, such as `COLUMN` (88) or `PAGE` (180) [mm].
        titles: Whether the figure has a title, and errors in its keys; a paper has them in its
            caption.
        limits: Ends of the colour scale of pressures, None for the usual end [kPa].
    """

    width: float = PAGE
    titles: bool = True
    limits: Limits = (None, None)

    @property
    def is_narrow(self) -> bool:
        """Whether the width is that of a column."""
        return self.width < 0.5 * (COLUMN + PAGE)

    def figure(self, height: float) -> Figure:
        """An empty figure of this width and the given height [mm]."""
        from matplotlib.figure import Figure

        return Figure(figsize=(self.width * MM, height * MM), layout="constrained")

    def add_title(self, figure: Figure | SubFigure, title: str) -> None:
        """Add a wrapped title without markup, unless titles are off.

        Args:
            figure: A figure, or a part of one, as wide as this style.
            title: The title; empty for none.
        """
        if self.titles and title:
            figure.suptitle(wrap(title, 0.96 * self.width), parse_math=False)


DEFAULT_STYLE = FigureStyle()


def figure_style(width: float, title: bool, limits: Limits = (None, None)) -> FigureStyle:
    """The requested style.

    Args:
        width: Printed width, 88 or 180 [mm].
        title: Whether figures have titles, and errors in their keys.
        limits: Ends of the colour scale of pressures, None for the usual end [kPa].

    Raises:
        ConfigurationError: The width is another one.
    """
    if width not in WIDTHS:
        raise ConfigurationError(
            f"figures are not laid out for a width of {width} mm",
            f"give {COLUMN} for a column of a paper or {PAGE} for a full page",
        )
    return FigureStyle(width, title, limits)


@in_style
def wrap(text: str, width: float, size: float = LABEL) -> str:
    """Break a text, including long words, into lines that fit a width.

    Args:
        text: The text; `$` is printed as such.
        width: Width of a line [mm].
        size: Size of the type [pt].
    """
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    if not text.strip():
        return text
    drawn = TextPath((0, 0), text.replace("$", "S"), size=size, prop=FontProperties())
    needed = drawn.get_extents().width / 72.0 / MM
    lines = int(np.ceil(needed / width))
    if lines <= 1:
        return text
    # Characters differ in width, hence the margin.
    return textwrap.fill(text, max(8, int(0.9 * len(text) * width / needed)))


def style_axes(axis: Axes) -> None:
    """Add a light grid behind the lines, and remove the frame above and to the right."""
    axis.grid(color="0.9")
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)


def panels(
    figure: Figure | SubFigure, count: int, across: int, label: str = "time [s]", **shared: Any
) -> list[Axes]:
    """Panels with a common x axis, row by row, labelled below the lowest of each column.

    Args:
        figure: The figure, or a part of one, without axes.
        count: Number of panels.
        across: Number of panels per row.
        label: Label of the x axis.
        shared: Further options of matplotlib's `subplots`, such as `sharey`.
    """
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
    """Add a legend without markup; for a panel, above it and with a bold title.

    Args:
        where: The panel, or the figure.
        entries: Handles and labels as in matplotlib's `legend`; none for all labelled lines.
        options: Options of matplotlib's `legend`, which override the usual ones.
    """
    from matplotlib.axes import Axes

    if isinstance(where, Axes):
        bold = {"size": LABEL, "weight": "bold"}
        above = {"loc": "lower left", "bbox_to_anchor": (-0.01, 1.0), "borderaxespad": 0.0}
        options = above | {"alignment": "left", "title_fontproperties": bold} | options
    legend = where.legend(*entries, **options)
    for text in (legend.get_title(), *legend.get_texts()):
        text.set_parse_math(False)


def lay_out(figure: Figure) -> Figure:
    """Do the layout of a figure once; otherwise every save would repeat it."""
    from matplotlib import rc_context

    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        if any(axis.get_aspect() != "auto" for axis in figure.axes):
            engine.execute(figure)  # panels with a fixed aspect need a second pass
        with rc_context(_NO_LAYOUT):
            figure.set_layout_engine(None)  # "none" leaves a placeholder: savefig draws twice
    return figure


@in_style
def save_figure(figure: Figure, path: Path, dpi: int = 300) -> None:
    """Write a figure at its printed size; text stays text.

    Args:
        figure: The figure.
        path: The file, `.png`, `.pdf` or `.svg`; an existing one is replaced.
        dpi: Resolution of a `.png` [dots per inch].
    """
    check_suffix(path, PICTURES, "picture")
    with atomic_output(path) as staging:
        figure.savefig(staging, dpi=dpi)


def thin(x: FloatArray, y: FloatArray, most: int = MAX_POINTS) -> tuple[FloatArray, FloatArray]:
    """Keep the lowest and highest value of each of several intervals of equal size.

    An interval without values remains a gap. Points keep their order.

    Args:
        x: Coordinates of N points, such as times [s], shape (N,).
        y: Their values in any unit, shape (N,); NaN where missing.
        most: Largest number of points that are all kept, and about the number of those kept
            otherwise.

    Returns:
        Coordinates and values of the kept points.
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
    """Keep the outermost ends of a band in each of several intervals of equal size.

    An interval without values remains a gap.

    Args:
        x: Coordinates of N points, such as times [s], shape (N,).
        low: Lower ends of the band in any unit, shape (N,); NaN where missing.
        high: Upper ends of the band in the unit of `low`, shape (N,); NaN where missing.
        most: Largest number of points kept.

    Returns:
        First coordinate, lowest lower end and highest upper end of each interval.
    """
    if len(x) <= most:
        return x, low, high
    starts = np.arange(0, len(x), -(-len(x) // most))
    return x[starts], np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)
