"""What figures share: colours, lines that differ in grey, plain axes, files, thinning."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from socket_testbed.arrays import FloatArray
from socket_testbed.files import atomic_output, check_picture

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif"  # of the pages
SURFACE = "#D9D9D9"
VEIL = "#A8A8A8"  # the surface where one sees through it
TILE = "#A6CBE3"
CLUSTER = "#D55E00"  # Okabe & Ito's vermilion
EDGE = "#2B5C7D"
NO_VALUE = "#FFFFFF"
PROXIMAL = "#333333"
AXES = ("#B2182B", "#1B7837", "#2166AC")  # x, y, z
SCALE = "cividis"  # Nunez et al. 2018, doi:10.1371/journal.pone.0199239: even in lightness


# Okabe & Ito's colours differ in lightness, too, and every line has its own dashes.
MODEL_STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#D55E00", "linestyle": (0, (4, 1.5)), "linewidth": 1.1},
    {"color": "#0072B2", "linestyle": "-", "linewidth": 1.1},
    {"color": "#222222", "linestyle": (0, (1, 1.2)), "linewidth": 1.3},
)
MEASURED_STYLE: dict[str, Any] = {"color": "0.72", "linewidth": 2.4}
SEGMENT_STYLE: dict[str, Any] = {"color": "0.94", "linewidth": 0.0, "zorder": 0.5}

_TYPES = {"pdf.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": "figure"}
_NO_LAYOUT = {"figure.autolayout": False, "figure.constrained_layout.use": False}


def style_axes(axis: Axes) -> None:
    """A light grid behind the lines, and no frame above and to the right."""
    axis.grid(color="0.9")
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)


def lay_out(figure: Figure) -> Figure:
    """The same figure with its layout done once; every saving would repeat it."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        with mpl.rc_context(_NO_LAYOUT):
            figure.set_layout_engine(None)  # "none" leaves a placeholder: savefig draws twice
    return figure


def save_figure(figure: Figure, path: Path, dpi: int = 150) -> None:
    """Write a figure; text stays text in a PDF.

    Args:
        figure: The figure.
        path: File to write or replace, `.png` or `.pdf`.
        dpi: Resolution of pixels [1/inch].

    Raises:
        ConfigurationError: If the suffix is another, or the file cannot be written.
    """
    check_picture(path)
    with mpl.rc_context(_TYPES), atomic_output(path) as staging:
        figure.savefig(staging, dpi=dpi)


def svg_of(figure: Figure) -> str:
    """A figure as a stand-alone SVG that needs no fonts."""
    buffer = io.StringIO()
    with mpl.rc_context(_TYPES):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def thin(x: FloatArray, y: FloatArray, most: int) -> tuple[FloatArray, FloatArray]:
    """Keep the lowest and the highest value of each of equally many samples.

    Args:
        x: Positions, shape (N,).
        y: Values, shape (N,); NaN where there is none.
        most: Largest number of points to keep.

    Returns:
        The kept points in their order, shape (M,) each, M <= `most`; all of them if they
        are no more. A gap is kept where all values of its samples are missing.
    """
    if len(x) <= most:
        return x, y
    size = -(-2 * len(x) // most)
    whole = len(x) // size * size
    kept = [_extremes(y[:whole].reshape(-1, size), 0)]
    if whole < len(x):
        kept.append(_extremes(y[None, whole:], whole))
    index = np.concatenate(kept)
    return x[index], y[index]


def _extremes(rows: FloatArray, first: int) -> FloatArray:
    """Indices of the lowest and the highest value of each row, in their order."""
    start = first + rows.shape[1] * np.arange(len(rows))
    lowest = start + np.where(np.isnan(rows), np.inf, rows).argmin(axis=1)
    highest = start + np.where(np.isnan(rows), -np.inf, rows).argmax(axis=1)
    return np.sort(np.stack([lowest, highest], axis=1), axis=1).ravel()
