"""What the figures for a paper share: lines told apart in grey, plain frames, the file formats."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

# Okabe & Ito's colours differ in lightness, too, and every line has its own dashes.
MODEL_STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#D55E00", "linestyle": (0, (4, 1.5)), "linewidth": 1.1},
    {"color": "#0072B2", "linestyle": "-", "linewidth": 1.1},
    {"color": "#222222", "linestyle": (0, (1, 1.2)), "linewidth": 1.3},
)
MEASURED_STYLE: dict[str, Any] = {"color": "0.72", "linewidth": 2.4}
SEGMENT_STYLE: dict[str, Any] = {"color": "0.94", "linewidth": 0.0, "zorder": 0.5}

_TYPES = {"pdf.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": "figure"}
_DPI = 150


def dress(axis: Axes) -> None:
    """A light grid behind the lines, and no frame above and to the right."""
    axis.grid(color="0.9")
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)


def lay_out(figure: Figure) -> Figure:
    """The same figure with its layout done, which every saving would do anew otherwise."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure; the suffix says the format. Text stays text in a PDF."""
    with mpl.rc_context(_TYPES):
        figure.savefig(path, dpi=_DPI)


def svg_of(figure: Figure) -> str:
    """A figure as a stand-alone SVG that needs no fonts."""
    buffer = io.StringIO()
    with mpl.rc_context(_TYPES):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()
