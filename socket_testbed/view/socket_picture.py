"""A picture of a socket with its tiles: four sides, the distal end, and the wall unrolled."""

from __future__ import annotations

import textwrap
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import whole_output
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.view.axes_of_s import AxesOfS, drawn_bounds, place_axes
from socket_testbed.view.colours import CLUSTER, EDGE, SURFACE, TILE
from socket_testbed.view.paint import paint_tiles
from socket_testbed.view.side_panels import DISTAL, SIDES, draw_axes, draw_view, frame_view
from socket_testbed.view.surface import Surface, drawable_surface
from socket_testbed.view.unrolled import draw_unrolled, wall_tiles

_SUFFIXES = (".png", ".pdf")
_MOST_FACES = 30_000
_SIZE = (12.0, 11.0)  # [inch]
_DPI = 200
_TITLE = 110  # characters a line


def socket_picture(
    vertices: FloatArray, faces: IntArray, geometry: SocketGeometry, path: Path, title: str
) -> None:
    """Draw the interior surface of a socket with its tiles, in mm, as a PNG or a PDF.

    The tiles are squares of edge sqrt(area), seen through the near wall.

    Args:
        vertices: Vertices of the interior surface in {S}, shape (v, 3) [m].
        faces: Indices of each face's vertices, shape (f, 3).
        geometry: The socket.
        path: File to write or replace; its suffix says the format.
        title: What is shown.

    Raises:
        ScanError: If this is no surface, or not in metres.
        ConfigurationError: If the suffix is another, or the file cannot be written.
    """
    if path.suffix.lower() not in _SUFFIXES:
        raise ConfigurationError(
            f"{path}: a picture cannot be a '{path.suffix}' file", "name a .png or .pdf file"
        )
    surface = drawable_surface(vertices, faces, _MOST_FACES)
    figure = _draw_socket(surface, geometry, title)
    with mpl.rc_context({"pdf.fonttype": 42}), whole_output(path) as output:
        figure.savefig(output, dpi=_DPI)


def _draw_socket(surface: Surface, geometry: SocketGeometry, title: str) -> Figure:
    figure = Figure(figsize=_SIZE, layout="constrained")
    figure.suptitle(textwrap.fill(title, _TITLE), fontsize=12, parse_math=False)
    grid = figure.add_gridspec(2, 4)
    paint = paint_tiles(geometry)
    low, high = drawn_bounds(surface, geometry)
    axes = place_axes(low, high)
    low, high = np.minimum(low, axes.start), np.maximum(high, axes.start + axes.length)
    every_tile = np.arange(len(geometry))
    for column, view in enumerate(SIDES):
        panel = figure.add_subplot(grid[0, column])
        frame_view(panel, view, low, high)
        draw_view(panel, view, surface, geometry, paint, every_tile)
        draw_axes(panel, view, axes)
    draw_unrolled(figure.add_subplot(grid[1, :3]), surface, geometry, paint)
    end = figure.add_subplot(grid[1, 3])
    frame_view(end, DISTAL, low, high)
    draw_view(end, DISTAL, surface, geometry, paint, every_tile[~wall_tiles(geometry, surface)])
    # At the origin they would hide the tiles of the end.
    draw_axes(end, DISTAL, replace(axes, start=low, length=0.4 * axes.length))
    _add_legend(figure, axes)
    return figure


def _add_legend(figure: Figure, axes: AxesOfS) -> None:
    figure.legend(
        handles=[
            Patch(facecolor=SURFACE, label="interior surface"),
            Patch(facecolor=TILE, edgecolor=EDGE, label="tile"),
            Patch(facecolor=CLUSTER, edgecolor="black", linewidth=1.6, label="tile with a cluster"),
            Patch(alpha=0.0, label=axes.describe()),
        ],
        loc="outside lower center",
        ncols=4,
        frameon=False,
        fontsize=9,
    )
