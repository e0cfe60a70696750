"""Pictures of a socket with its tiles: four sides, the distal end, the wall unrolled."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.files import check_picture
from socket_testbed.geometry.axis import socket_axis
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.report.figures.style import (
    AXES,
    CLUSTER,
    EDGE,
    SMALL,
    SURFACE,
    TILE,
    lay_out,
    save_figure,
)
from socket_testbed.report.figures.tiles import (
    AXIS_NAMES,
    AxesOfS,
    TilePaint,
    drawable_surface,
    drawn_bounds,
    paint_tiles,
    place_axes,
    tile_squares,
)
from socket_testbed.report.figures.unrolled import (
    CENTRED,
    OUTLINED,
    DrawnTiles,
    break_name,
    draw_unrolled,
    label_tiles,
    polygons,
    wall_tiles,
    write_in,
)

_LEAST_FACING = 0.15  # [-]; cosine; what is seen more edge-on is no square any more
_LABEL_FACING = 0.5  # [-]; likewise, room for a name
_DARKEST, _LIGHTEST = 0.64, 0.91  # greys of the surface
_LIGHT = np.array([-0.3, 0.35, 0.9])  # to the right, up and towards the viewer
_MARGIN = 1.12
_NAME = 0.18  # [-]; of an arrow's length, from its tip to its name


@dataclass(frozen=True)
class View:
    """A parallel projection along an axis of {S}.

    Attributes:
        title: What is seen, and from where.
        towards: Axis that points to the viewer: 1, 2, 3 for x, y, z, negative if opposed.
        right: Axis that points to the right, likewise.
        up: Axis that points upwards, never opposed.
        inside: Whether one looks at the interior, not through the near wall from outside.
    """

    title: str
    towards: int
    right: int
    up: int
    inside: bool = False

    def project(self, points: FloatArray) -> FloatArray:
        """Coordinates in {S} along the panel's two axes, shape (..., 2) [mm]."""
        return 1e3 * points[..., [abs(self.right) - 1, abs(self.up) - 1]]

    def basis(self) -> FloatArray:
        """Unit vectors to the right, up and towards the viewer in {S}, shape (3, 3) [-]."""
        axes = (self.right, self.up, self.towards)
        return np.array([np.sign(axis) * np.eye(3)[abs(axis) - 1] for axis in axes])


# By REP 103, x of {S} is anterior, y left and z proximal. Which of left and right is lateral
# depends on the leg, which the geometry does not say.
SIDES = (
    View("anterior side\nseen from +x", towards=1, right=2, up=3),
    View("left side (lateral on a left leg)\nseen from +y", towards=2, right=-1, up=3),
    View("posterior side\nseen from -x", towards=-1, right=-2, up=3),
    View("right side (medial on a left leg)\nseen from -y", towards=-2, right=1, up=3),
)
DISTAL = View(
    "distal end\nseen from +z, through the opening", towards=3, right=-2, up=1, inside=True
)


def draw_view(
    axis: Axes, view: View, geometry: SocketGeometry, paint: TilePaint, tiles: IntArray
) -> DrawnTiles:
    """Draw the tiles that face the viewer, through the wall if need be, and their names.

    From outside only the clusters are named; the unrolled wall names the others.

    Args:
        axis: The panel.
        view: Where from.
        geometry: The socket.
        paint: How its tiles are painted.
        tiles: Which tiles may be drawn, by index.
    """
    towards = view.basis()[2]
    facing = geometry.rotations[:, :, 2] @ (towards if view.inside else -towards)
    shown = tiles[facing[tiles] > _LEAST_FACING]
    shown = shown[np.argsort(geometry.anchors[shown] @ towards)]
    squares = view.project(tile_squares(geometry))
    drawn = DrawnTiles(axis, paint, shown, squares[shown])
    named = shown[facing[shown] > _LABEL_FACING]
    if view.inside:
        label_tiles(axis, paint, named, squares[named])
        return drawn
    for cluster, tile in geometry.clusters.items():
        if tile in named:  # at one size, whatever the tile's
            write_in(axis, break_name(cluster), squares[tile], fontsize=SMALL, **OUTLINED)
    return drawn


def draw_surface(axis: Axes, view: View, surface: trimesh.Trimesh) -> None:
    """Paint the faces from the back to the front, so that none needs to be wound rightly."""
    basis = view.basis()
    order = np.argsort(surface.triangles_center @ basis[2])
    light = _LIGHT @ basis / np.linalg.norm(_LIGHT)
    brightness = np.abs(surface.face_normals[order] @ light)
    greys = np.repeat(_DARKEST + (_LIGHTEST - _DARKEST) * brightness[:, None], 3, axis=1)
    axis.add_collection(
        polygons(
            view.project(surface.triangles[order]),
            facecolors=greys,
            edgecolors=greys,  # no hairlines between the faces
            linewidths=0.2,
            rasterized=True,
        ),
        autolim=False,
    )


def frame_view(axis: Axes, view: View, low: FloatArray, high: FloatArray) -> None:
    """Set limits in mm, with an equal aspect, and name the axes.

    Args:
        axis: The panel.
        view: Where from.
        low: Lowest coordinates to show in {S}, shape (3,) [m].
        high: Highest coordinates, shape (3,) [m].
    """
    across, upwards = view.project(np.stack([low, high], axis=-2)).T
    if view.right < 0:
        across = across[::-1]
    axis.set_xlim(*_widened(across))
    axis.set_ylim(*_widened(upwards))
    axis.set_aspect("equal")
    axis.set_title(view.title, fontsize=9)
    axis.set_xlabel(f"{AXIS_NAMES[abs(view.right) - 1]} of {{S}} [mm]")
    axis.set_ylabel(f"{AXIS_NAMES[abs(view.up) - 1]} of {{S}} [mm]")


def draw_axes(axis: Axes, view: View, axes: AxesOfS) -> None:
    """Draw the axes of {S}; a circle with a dot comes towards the viewer, one with a cross goes."""
    start_x, start_y = view.project(axes.start)
    for number, (name, colour) in enumerate(zip(AXIS_NAMES, AXES, strict=True)):
        lettering: dict[str, Any] = {"color": colour, "style": "italic", **CENTRED}
        if abs(view.towards) - 1 == number:
            mark = "." if view.towards > 0 else "x"
            axis.plot(start_x, start_y, "o", ms=7, mfc="white", mec=colour, zorder=4)
            axis.plot(start_x, start_y, mark, ms=4, color=colour, zorder=5)
            beside: dict[str, Any] = {"xytext": (-9, 9), "textcoords": "offset points"}
            axis.annotate(name, (start_x, start_y), **beside, **lettering)
            continue
        x, y = view.project(axes.start + axes.length * np.eye(3)[number])
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.4, "shrinkA": 0, "shrinkB": 0}
        axis.annotate("", xy=(x, y), xytext=(start_x, start_y), arrowprops=arrow, zorder=3)
        axis.text(x + _NAME * (x - start_x), y + _NAME * (y - start_y), name, **lettering)


def _widened(ends: FloatArray) -> FloatArray:
    return ends.mean() + _MARGIN * (ends - ends.mean())


_MOST_FACES = 30_000
_SIZE = (12.0, 11.0)  # [inch]
_DPI = 200
_LINE_OF_TITLE = 110  # characters


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
    check_picture(path)
    surface = drawable_surface(vertices, faces, _MOST_FACES)
    save_figure(_draw_socket(surface, geometry, title), path, _DPI)


def _draw_socket(surface: trimesh.Trimesh, geometry: SocketGeometry, title: str) -> Figure:
    figure = Figure(figsize=_SIZE, dpi=_DPI, layout="constrained")
    figure.suptitle(textwrap.fill(title, _LINE_OF_TITLE), fontsize=12, parse_math=False)
    grid = figure.add_gridspec(2, 4)
    paint = paint_tiles(geometry)
    around = socket_axis(geometry)
    low, high = drawn_bounds(geometry, surface)
    axes = place_axes(low, high)
    low, high = np.minimum(low, axes.start), np.maximum(high, axes.start + axes.length)
    every_tile = np.arange(len(geometry))
    unrolled = figure.add_subplot(grid[1, :3])
    draw_unrolled(unrolled, geometry, paint, around, surface)
    unrolled.set_title("the wall unrolled, seen from outside", fontsize=9)
    # At the origin they would hide the tiles of the end.
    aside = replace(axes, start=low, length=0.4 * axes.length)
    end_tiles = every_tile[~wall_tiles(geometry, around)]
    for place, view, arrows, tiles in (
        *((grid[0, column], view, axes, every_tile) for column, view in enumerate(SIDES)),
        (grid[1, 3], DISTAL, aside, end_tiles),
    ):
        panel = figure.add_subplot(place)
        frame_view(panel, view, low, high)
        draw_surface(panel, view, surface)
        draw_view(panel, view, geometry, paint, tiles)
        draw_axes(panel, view, arrows)
    _add_legend(figure, axes)
    return lay_out(figure)


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
