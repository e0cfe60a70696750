"""Values of the tiles as a figure for a paper: the wall unrolled and the distal end, in rows."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgba
from matplotlib.figure import Figure

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.view.axes_of_s import drawn_bounds
from socket_testbed.view.colours import NO_VALUE, SCALE
from socket_testbed.view.paint import TilePaint, add_colour_bar, paint_tiles
from socket_testbed.view.paper import lay_out
from socket_testbed.view.side_panels import DISTAL, draw_view, frame_view
from socket_testbed.view.squares import tile_squares, value_range
from socket_testbed.view.surface import Surface
from socket_testbed.view.unrolled import draw_unrolled, wall_tiles

_WIDTH, _ROW = 8.6, 2.9  # [inch]
_TITLE = 110  # characters a line


def tile_map_figure(
    geometry: SocketGeometry, rows: Mapping[str, FloatArray], unit: str, title: str
) -> Figure:
    """Tiles by their values on one colour scale that prints in grey, a row a set of values.

    The socket's wall is unrolled around the vertical axis through the tiles' middle; beside
    it is the distal end. Tiles with a cluster have a thick outline and a number, which the
    title explains.

    Args:
        geometry: The socket.
        rows: One value a tile in `unit`, shape (n,), by what it is; NaN where there is none.
        unit: What the values are, with their unit, such as `stiffness [N/m]`.
        title: What is shown.

    Raises:
        ConfigurationError: If the values are not those of these tiles.
    """
    figure = Figure(figsize=(_WIDTH, _ROW * len(rows) + 0.4), layout="constrained")
    numbers = {name: str(i) for i, name in enumerate(geometry.clusters, start=1)}
    legend = ", ".join(f"{number} {name}" for name, number in numbers.items())
    heading = f"{title}\n{textwrap.fill(legend, _TITLE)}" if numbers else title
    figure.suptitle(heading, fontsize=10, parse_math=False)
    axes = figure.subplots(len(rows), 2, width_ratios=(3.2, 1.0), squeeze=False)
    scale = ScalarMappable(Normalize(*value_range(np.concatenate([*rows.values()]))), SCALE)
    geometry = _number_clusters(geometry, numbers)
    surface = _corners_of(geometry)
    end = np.flatnonzero(~wall_tiles(geometry, surface))
    for (wall_axis, end_axis), (name, values) in zip(axes, rows.items(), strict=True):
        paint = _paint_on(scale, geometry, values, unit)
        draw_unrolled(wall_axis, surface, geometry, paint)
        wall_axis.set_title(name, fontsize=9.5, loc="left", fontweight="bold", parse_math=False)
        wall_axis.set_title("")
        frame_view(end_axis, DISTAL, *drawn_bounds(surface, geometry))
        draw_view(end_axis, DISTAL, surface, geometry, paint, end)
        end_axis.set_title("distal end, from inside", fontsize=9)
    add_colour_bar(figure, list(axes.flat), paint)
    return lay_out(figure)


def _paint_on(
    scale: ScalarMappable, geometry: SocketGeometry, values: FloatArray, unit: str
) -> TilePaint:
    """Tiles painted on a scale that others share."""
    paint = paint_tiles(geometry, values, unit)
    fills = np.where(np.isnan(values)[:, None], to_rgba(NO_VALUE), scale.to_rgba(values))
    return replace(paint, fills=fills, scale=scale)


def _number_clusters(geometry: SocketGeometry, numbers: Mapping[str, str]) -> SocketGeometry:
    """The same socket with the clusters' numbers for names, the only ones that are legible."""
    names = [""] * len(geometry)
    for cluster, tile in geometry.clusters.items():
        names[tile] = numbers[cluster]
    clusters = {numbers[cluster]: tile for cluster, tile in geometry.clusters.items()}
    return replace(geometry, names=tuple(names), clusters=clusters)


def _corners_of(geometry: SocketGeometry) -> Surface:
    """The corners of the tiles as a surface of faces without area: a trial knows no scan."""
    corners = tile_squares(geometry).reshape(-1, 3)
    return Surface(corners, np.repeat(np.arange(len(corners))[:, None], 3, axis=1))
