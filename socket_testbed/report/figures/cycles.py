"""Quantities over a cycle: every cycle, their mean, and a band of one standard deviation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from socket_testbed.arrays import FloatArray
from socket_testbed.report.figures.style import (
    DEFAULT_STYLE,
    LINE_STYLES,
    FigureStyle,
    in_style,
    lay_out,
    style_axes,
    wrap,
)

_PANEL, _HEADING = 44.0, 12.0  # [mm]; heights
_MOST_LINES = 30  # single cycles, in a panel
_BAND = 0.25  # [-]; opacity


@in_style
def cycles_figure(
    titles: Sequence[str],
    curves: FloatArray,
    mean: FloatArray,
    deviation: FloatArray,
    title: str = "",
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """Draw quantities over 0 to 100 % of a cycle, a panel each.

    Args:
        titles: Names of the m quantities, with their units.
        curves: Values in each of K cycles, shape (K, p, m); lines where they are no more than 30.
        mean: Mean over the cycles, shape (p, m).
        deviation: Standard deviation over the cycles, shape (p, m); NaN for no band.
        title: What is shown.
        style: How it is set.
    """
    columns = 1 if style.is_narrow else min(2, len(titles))
    rows = -(-len(titles) // columns)
    figure = style.figure(_HEADING + rows * _PANEL)
    style.add_title(figure, title)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    percent = np.linspace(0.0, 100.0, len(mean))
    for number, (panel, name) in enumerate(zip(panels, titles, strict=False)):
        if len(curves) <= _MOST_LINES:
            panel.plot(percent, curves[:, :, number].T, color="0.8", linewidth=0.5)
        middle, spread, colour = mean[:, number], deviation[:, number], LINE_STYLES[1]["color"]
        band = middle - spread, middle + spread
        panel.fill_between(percent, *band, color=colour, alpha=_BAND, linewidth=0.0)
        panel.plot(percent, middle, color=colour)
        if not np.isfinite(middle).any():
            panel.text(0.5, 0.5, "no value", transform=panel.transAxes, ha="center", color="0.3")
            panel.set_yticks([])
        panel.set_ylabel(wrap(name, 0.75 * _PANEL), parse_math=False)
        panel.set_xlim(0.0, 100.0)
        style_axes(panel)
    for panel in panels[len(titles) :]:
        panel.remove()
    for panel in panels[max(0, len(titles) - columns) : len(titles)]:
        panel.tick_params(labelbottom=True)
        panel.set_xlabel("cycle [%]")
    return lay_out(figure)
