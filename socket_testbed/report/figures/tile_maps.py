"""Values of the tiles as maps of the socket: the wall unrolled, and beside it the distal end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.geometry.axis import socket_axis
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.report.figures.socket_picture import DISTAL, draw_view, frame_view
from socket_testbed.report.figures.style import (
    DEFAULT_STYLE,
    MM,
    SMALL,
    FigureStyle,
    in_style,
    lay_out,
    wrap,
)
from socket_testbed.report.figures.tiles import TilePaint, drawn_bounds, paint_tiles, value_range
from socket_testbed.report.figures.unrolled import (
    DrawnTiles,
    draw_unrolled,
    wall_aspect,
    wall_tiles,
)

_PALEST = 0.15  # [-]; of a tile's colour: white has no value
_ALIKE = 2.0  # [-]; ratio of ranges that are still seen on one scale
_WALL_SHARE = 3.4  # [-]; width of the wall by that of the distal end
_AXIS, _BAR = 12.0, 15.0  # [mm]; beside a map: its axis; the bar of colours
_BAR_LABEL = 38.0  # [mm]; longest line beside a bar
_UNDER = 14.0  # [mm]; above and below a map: its name and its axis
HEADING = 12.0  # [mm]; for a title above the maps and a key below


def scales_of(
    geometry: SocketGeometry, values: Mapping[str, FloatArray], from_zero: bool = False
) -> list[tuple[float, float]]:
    """Ends of the colour scale of every map: the same for those whose ranges are alike.

    Args:
        geometry: The socket.
        values: One value per tile, shape (n,), by what it is.
        from_zero: Whether the scale begins at zero, unless a value is below.
    """
    ranges = np.array([value_range(geometry, row) for row in values.values()])
    if from_zero:
        ranges[:, 0] = np.minimum(ranges[:, 0], 0.0)
    spans = np.ptp(ranges, axis=1)
    left = np.ones(len(ranges), dtype=bool)
    while left.any():
        alike = left & (_ALIKE * spans >= spans[left].max())
        ranges[alike] = ranges[alike, 0].min(), ranges[alike, 1].max()
        left &= ~alike
    return [(float(low), float(high)) for low, high in ranges]


def columns_of(count: int, style: FigureStyle) -> int:
    """Number of maps in a row."""
    return 1 if style.is_narrow else min(2, count)


def maps_height(
    geometry: SocketGeometry, width: float, scales: Sequence[tuple[float, float]], columns: int
) -> float:
    """Height that maps in columns need [mm].

    Args:
        geometry: The socket.
        width: Width of the figure [mm].
        scales: Ends of the colour scale of every map.
        columns: Number of maps in a row.
    """
    bars = 1 if len(set(scales)) == 1 else columns
    wall = (width - _AXIS * columns - _BAR * bars) / columns * _WALL_SHARE / (_WALL_SHARE + 1.0)
    rows = -(-len(scales) // columns)
    return rows * (wall * wall_aspect(geometry, socket_axis(geometry)) + _UNDER)


def draw_maps(
    figure: Figure | SubFigure,
    geometry: SocketGeometry,
    values: Mapping[str, FloatArray],
    unit: str,
    scales: list[tuple[float, float]],
    columns: int = 1,
    side: str = "",
    certainty: Mapping[str, FloatArray] | None = None,
    determined: Mapping[str, BoolArray] | None = None,
) -> list[DrawnTiles]:
    """Draw maps of values in rows, with one bar for all if their scales are the same.

    Args:
        figure: What is drawn on.
        geometry: The socket.
        values: One value per tile, shape (n,), by what it is; NaN, hatched, where there is none.
        unit: What the values are, with their unit, such as `pressure [kPa]`.
        scales: Ends of the colour scale of every map.
        columns: Number of maps in a row.
        side: The leg that wears the socket, `left` or `right`; empty where that is not known.
        certainty: How certain the values of a map are, see `paint_tiles`, by what it is.
        determined: Which values of a map are determined, likewise.

    Returns:
        What is drawn of each map: the tiles of its wall and those of its distal end.
    """
    certainty, determined = certainty or {}, determined or {}
    around = socket_axis(geometry)
    end = np.flatnonzero(~wall_tiles(geometry, around))
    labels = [""] * len(geometry)
    for number, tile in enumerate(geometry.clusters.values(), start=1):
        labels[tile] = str(number)
    rows = -(-len(values) // columns)
    axes = figure.subplots(
        rows, 2 * columns, width_ratios=(_WALL_SHARE, 1.0) * columns, squeeze=False
    ).reshape(-1, 2)
    free = figure.bbox.width / figure.dpi / MM / columns - _AXIS - _BAR
    common, drawn = len(set(scales)) == 1, []
    for panels, (name, row), limits in zip(axes, values.items(), scales, strict=False):
        paint = paint_tiles(
            geometry, row, limits, labels, certainty.get(name), determined.get(name)
        )
        drawn.append(draw_unrolled(panels[0], geometry, paint, around, side=side))
        heading = wrap(name, 0.9 * free)  # bold type is wider
        panels[0].set_title(heading, loc="left", fontweight="bold", parse_math=False)
        drawn.append(_draw_end(panels[1], geometry, paint, end))
        if not common:
            add_bar(figure, paint, list(panels), unit, 20.0)
    for panel in axes[len(values) :].flat:
        panel.set_visible(False)
    if common:
        add_bar(figure, paint, list(axes.flat), unit, 25.0 * rows)
    return drawn


def add_bar(
    figure: Figure | SubFigure, paint: TilePaint, panels: list[Axes], unit: str, slenderness: float
) -> None:
    """Add the bar of a paint's colours beside panels; its length by its width is given."""
    assert paint.scale is not None
    label = wrap(unit, _BAR_LABEL)
    figure.colorbar(paint.scale, ax=panels, label=label, pad=0.01, aspect=slenderness)


def _draw_end(axis: Axes, geometry: SocketGeometry, paint: TilePaint, end: IntArray) -> DrawnTiles:
    """The distal end from inside, anterior up and left on the left, at the scale of the socket."""
    low, high = drawn_bounds(geometry)
    frame_view(axis, DISTAL, low, high)
    drawn = draw_view(axis, DISTAL, geometry, paint, end)
    axis.set_axis_off()
    axis.set_title("distal end" if len(end) else "", fontsize=SMALL, y=1.0)
    return drawn


def cluster_key(geometry: SocketGeometry, notes: Mapping[str, str] | None = None) -> list[str]:
    """What the numbers on the tiles stand for: clusters, each with what is to be said of it."""
    notes = notes or {}
    return [
        f"{number} {cluster}" + (f": {notes[cluster]}" if cluster in notes else "")
        for number, cluster in enumerate(geometry.clusters, start=1)
    ]


def add_key(figure: Figure | SubFigure, style: FigureStyle, *parts: str) -> None:
    """Write what marks mean below a figure, in lines that fit; no markup."""
    text = wrap(", ".join(filter(None, parts)), 0.96 * style.width, SMALL)
    if text:
        figure.supxlabel(text, fontsize=SMALL, parse_math=False)


@in_style
def tile_map_figure(
    geometry: SocketGeometry,
    values: Mapping[str, FloatArray],
    unit: str,
    title: str,
    notes: Mapping[str, str] | None = None,
    certainty: Mapping[str, FloatArray] | None = None,
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """Tiles by their values in colours that print in grey, a map per set of values.

    The socket's wall is unrolled around its axis; beside it is the distal end. Maps whose ranges
    differ have a scale each. Tiles with a cluster have a thick outline and a number, explained
    below the maps.

    Args:
        geometry: The socket.
        values: One value per tile in `unit`, shape (n,), by what it is; NaN where there is none.
        unit: What the values are, with their unit, such as `stiffness [N/m]`.
        title: What is shown.
        notes: What to say of a cluster, by its name.
        certainty: How certain the values of a row are, see `paint_tiles`, by what it is.
        style: How it is set.

    Raises:
        ConfigurationError: If the values are not those of these tiles.
    """
    scales = scales_of(geometry, values)
    columns = columns_of(len(values), style)
    figure = style.figure(maps_height(geometry, style.width, scales, columns) + HEADING)
    style.add_title(figure, title)
    draw_maps(figure, geometry, values, unit, scales, columns, certainty=certainty)
    add_key(figure, style, *cluster_key(geometry, notes))
    return lay_out(figure)


def force_map_figure(
    geometry: SocketGeometry,
    estimate: MapEstimate,
    title: str,
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """Normal pressure of the first sample of a force map, and below its standard deviation.

    The pressure fades to white where it is uncertain: see `certainty_of`.

    Args:
        geometry: The socket.
        estimate: The map, such as the mean of a segment.
        title: What is shown.
        style: How it is set.
    """
    pressure = 1e-3 * estimate.normal_pressure[0]
    deviation = 1e-3 * estimate.normal_pressure_standard_deviation[0]
    name = "normal pressure; pale where it is uncertain"
    maps = {name: pressure, "its standard deviation": deviation}
    certainty = {name: certainty_of(pressure, deviation)}
    return tile_map_figure(
        geometry, maps, "pressure [kPa]", title, certainty=certainty, style=style
    )


def certainty_of(values: FloatArray, deviation: FloatArray) -> FloatArray:
    """How certain values are, from their standard deviation relative to their size.

    The size is that of the value or half of the largest one, whichever is more.

    Args:
        values: One value per tile, shape (n,).
        deviation: Their standard deviations, shape (n,).

    Returns:
        1 where certain, less where not, never so little that nothing is seen, shape (n,) [-].
    """
    size = np.maximum(np.abs(values), 0.5 * np.abs(values).max())
    return np.asarray(np.clip(1.0 - deviation / size, _PALEST, 1.0))
