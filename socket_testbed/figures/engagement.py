"""Engaged springs of models, over the socket and over time, drawn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from socket_testbed.arrays import FloatArray
from socket_testbed.figures.style import (
    LINE_STYLES,
    SEGMENT_STYLE,
    FigureStyle,
    add_legend,
    panels,
    thin,
)
from socket_testbed.figures.tiles import tile_map_figure
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.information import Engagement
from socket_testbed.settings.options import Side
from socket_testbed.trials.segment import Segment

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

_SERIES_HEIGHT = 68.0  # [mm]; two panels over time with their key


def engagement_figure(
    geometry: SocketGeometry,
    time: FloatArray,
    models: Mapping[str, Engagement],
    segment: Segment,
    title: str,
    style: FigureStyle,
    side: Side | None,
) -> Figure:
    """Maps of the share of time with a tile's springs engaged; below, engaged springs over time.

    Args:
        geometry: The socket of n tiles.
        time: Times of N samples since the first one, shape (N,) [s].
        models: Engaged springs at these samples, and their shares of the segment, by model.
        segment: The segment, which is shaded.
        title: Title of the figure.
        style: Print layout.
        side: The leg that wears the socket; None if unknown.
    """

    def draw_lines(part: SubFigure) -> None:
        for axis, kind in zip(panels(part, 2, 1), ("engaged", "uncertain"), strict=True):
            for (name, found), line in zip(models.items(), LINE_STYLES, strict=False):
                share = 100.0 * getattr(found, kind) / found.springs
                axis.plot(*thin(time, share), label=name, **line)
            axis.axvspan(segment.start, segment.end, **SEGMENT_STYLE)
            axis.set_ylabel(f"{kind}\nsprings [%]")
            axis.set_ylim(bottom=0.0)
        add_legend(part.axes[0], ncols=2)

    return tile_map_figure(
        geometry,
        {name: 100.0 * found.time_share.mean(axis=1) for name, found in models.items()},
        "share of the time engaged [%]",
        title,
        style,
        limits=(0.0, 100.0),
        side=side,
        below=(_SERIES_HEIGHT, draw_lines),
    )
