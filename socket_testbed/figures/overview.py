"""The load of a trial over time, and what could not be measured, drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.figures.style import (
    BLUE,
    VERMILION,
    FigureStyle,
    in_style,
    lay_out,
    style_axes,
    thin,
)
from socket_testbed.trials.segment import Segment

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LOAD_HEIGHT, _ROW_HEIGHT, _AXIS_HEIGHT = 36.0, 4.5, 16.0  # [mm]; rows of drop-outs
_MAX_BINS = 400  # over time
_SEGMENT_GREY, _PLATEAU_GREY = "0.80", "0.93"
_COLOURS = (BLUE, VERMILION)  # of force and moment


@in_style
def overview_figure(
    time: FloatArray,
    loads: Mapping[str, FloatArray],
    lacking: Mapping[str, BoolArray],
    plateaus: Sequence[Segment],
    segment: Segment,
    style: FigureStyle,
) -> Figure:
    """Draw two loads over a trial, and the share of samples in which a measurement was unusable.

    Args:
        time: Times of the N samples since the first one, shape (N,) [s].
        loads: Force and moment magnitude by title with the unit, shape (N,) each [N, N m].
        lacking: Whether a measurement is unusable, by its name, shape (N,) each.
        plateaus: Segments in light grey.
        segment: The segment in darker grey.
        style: Print layout.
    """
    heights = (_LOAD_HEIGHT, _LOAD_HEIGHT, _ROW_HEIGHT * len(lacking) + _AXIS_HEIGHT)
    figure = style.figure(sum(heights))
    *axes, lowest = figure.subplots(3, 1, sharex=True, height_ratios=heights)
    spans = [*((plateau, _PLATEAU_GREY) for plateau in plateaus), (segment, _SEGMENT_GREY)]
    for axis, (name, load), colour in zip(axes, loads.items(), _COLOURS, strict=True):
        for part, grey in spans:
            axis.axvspan(part.start, part.end, color=grey, linewidth=0.0)
        axis.plot(*thin(time, load), color=colour, linewidth=1.0)
        axis.set_ylabel(name.replace(" [", "\n["))
        style_axes(axis)
    count = max(1, min(_MAX_BINS, len(time) // 2))
    edges = np.linspace(time[0], max(time[-1], time[0] + 1e-3), count + 1)
    triggers, _ = np.histogram(time, edges)
    lost = [np.histogram(time, edges, weights=1.0 * rows)[0] for rows in lacking.values()]
    # Without triggers, all measurements are missing.
    share = np.where(triggers > 0, np.array(lost) / np.maximum(triggers, 1), 1.0)
    rows = np.arange(len(lacking) + 1) - 0.5
    mesh = lowest.pcolormesh(edges, rows, share, cmap="Greys", vmin=0.0, vmax=1.0, rasterized=True)
    lowest.set_yticks(range(len(lacking)), list(lacking), parse_math=False)
    lowest.invert_yaxis()
    lowest.set_xlabel("time [s]")
    figure.colorbar(mesh, ax=lowest, pad=0.01, aspect=12).set_label("not usable [-]")
    return lay_out(figure)
