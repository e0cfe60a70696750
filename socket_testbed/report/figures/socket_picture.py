"""Pictures of a socket with its tiles: four sides, the distal end, the wall unrolled."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.files import check_picture
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.report.figures.style import (
    AXES,
    CLUSTER,
    EDGE,
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
    value_range,
)

_CENTRED: dict[str, Any] = {"ha": "center", "va": "center"}
_LARGEST, _SMALLEST = 7.0, 3.0  # [pt]
_LONGEST_LINE = 9  # characters
_CHARACTER = 0.62  # [-]; width of a character by the size of the font
_PALEST = 0.15  # [-]; of a tile's colour: white has no value
_LINE = 1.25  # [-]; height of a line, likewise


def _label_tiles(axis: Axes, paint: TilePaint, tiles: IntArray, squares: FloatArray) -> None:
    """Write a label inside each tile, as large as fits; leave it out where that is too small.

    Nothing in a label is markup. The panel must have its limits and its aspect.

    Args:
        axis: The panel.
        paint: What is written on the tiles.
        tiles: Which tiles, by index, m of them.
        squares: Their corners in the panel's coordinates, shape (m, 4, 2).
    """
    for tile, corners in zip(tiles, squares, strict=True):
        lines = _break(paint.labels[tile])
        if not any(lines):
            continue
        width, height = np.ptp(corners, axis=0) * _points_per_unit(axis)
        size = min(
            _LARGEST,
            width / (_CHARACTER * max(len(line) for line in lines)),
            height / (_LINE * len(lines)),
        )
        if size >= _SMALLEST:
            _write(axis, lines, corners, color=paint.ink(tile), fontsize=size, linespacing=1.0)


def _write(axis: Axes, lines: Sequence[str], corners: FloatArray, **style: Any) -> None:
    x, y = corners.mean(axis=0)
    axis.text(x, y, "\n".join(lines), parse_math=False, zorder=3, **_CENTRED, **style)


def _break(label: str) -> list[str]:
    """Break a long label behind its underscores and at its spaces."""
    if len(label) <= _LONGEST_LINE:
        return [label.strip()]
    words = label.replace("_", "_ ").split()
    lines = textwrap.wrap(" ".join(words), _LONGEST_LINE, break_long_words=False)
    return [line.replace("_ ", "_") for line in lines]


def _points_per_unit(axis: Axes) -> FloatArray:
    """Printed size of a unit of the panel's two axes, shape (2,) [pt]."""
    figure = np.array(axis.figure.bbox.size) * 72.0 / axis.figure.dpi
    panel = axis.get_position(original=True).size * figure
    span = np.abs([np.subtract(*axis.get_xlim()), np.subtract(*axis.get_ylim())])
    aspect = axis.get_aspect()
    per_x = min(panel[0] / span[0], panel[1] / (span[1] * aspect))
    return np.array([per_x, per_x * aspect])


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
) -> None:
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
    _add_tiles(axis, paint, shown, squares[shown])
    named = shown[facing[shown] > _LABEL_FACING]
    if view.inside:
        _label_tiles(axis, paint, named, squares[named])
        return
    outlined: dict[str, Any] = {"path_effects": [withStroke(linewidth=2.0, foreground="white")]}
    for cluster, tile in geometry.clusters.items():
        if tile in named:  # at one size, whatever the tile's
            _write(axis, _break(cluster), squares[tile], fontsize=_LARGEST, **outlined)


def draw_surface(axis: Axes, view: View, surface: trimesh.Trimesh) -> None:
    """Paint the faces from the back to the front, so that none needs to be wound rightly."""
    basis = view.basis()
    order = np.argsort(surface.triangles_center @ basis[2])
    light = _LIGHT @ basis / np.linalg.norm(_LIGHT)
    brightness = np.abs(surface.face_normals[order] @ light)
    greys = np.repeat(_DARKEST + (_LIGHTEST - _DARKEST) * brightness[:, None], 3, axis=1)
    axis.add_collection(
        _polygons(
            view.project(surface.triangles[order]),
            facecolors=greys,
            edgecolors=greys,  # no hairlines between the faces
            linewidths=0.2,
            rasterized=True,
        ),
        autolim=False,
    )


def _polygons(corners: FloatArray, **style: Any) -> PolyCollection:
    """Polygons of k corners, shape (m, k, 2); matplotlib makes them faster from an array."""
    array: Any = corners  # matplotlib takes an array, too, but its types name sequences only
    return PolyCollection(array, **style)


def _add_tiles(axis: Axes, paint: TilePaint, tiles: IntArray, squares: FloatArray) -> None:
    axis.add_collection(
        _polygons(
            squares,
            facecolors=paint.fills[tiles],
            edgecolors=paint.edges[tiles],
            linewidths=paint.widths[tiles],
        )
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
        lettering: dict[str, Any] = {"color": colour, "style": "italic", **_CENTRED}
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


_WALL = np.sqrt(0.5)  # [-]; z of the normals of what is at 45 degrees; the end faces up more
_WIDEST_FACE = 60.0  # [deg]; a wider one is at the axis, where there is no angle
_BESIDE = 3.0  # [deg]; free on both sides of the unrolled wall
_ABOVE = 0.03  # [-]; of its height, free above and below


def wall_tiles(geometry: SocketGeometry, middle: FloatArray) -> BoolArray:
    """Which tiles are on the wall, not on the distal end, shape (n,).

    Args:
        geometry: The socket.
        middle: x and y of a vertical axis, shape (2,) [m]; a tile at it counts as one of the end.
    """
    steep = geometry.rotations[:, 2, 2] < _WALL
    return steep & (_radii(geometry.anchors, middle) >= np.sqrt(geometry.areas))


def draw_unrolled(
    axis: Axes,
    geometry: SocketGeometry,
    paint: TilePaint,
    middle: FloatArray,
    surface: trimesh.Trimesh | None = None,
) -> None:
    """Draw the wall as one sees it walking around it outside: anterior, left, posterior, right.

    The angle is that about a vertical axis, from x of {S} (anterior) towards y (left). Lengths
    across are true at the tiles' median radius only.

    Args:
        axis: The panel.
        geometry: The socket.
        paint: How its tiles are painted.
        middle: x and y of the axis, shape (2,) [m].
        surface: The interior surface in {S}; None where it is not known.
    """
    tiles = np.flatnonzero(wall_tiles(geometry, middle))
    corners = tile_squares(geometry)
    squares = _unroll(corners[tiles], geometry.anchors[tiles], middle)
    faces = np.zeros((0, 3, 2)) if surface is None else _faces_around(surface, middle)
    around = geometry.anchors[tiles if len(tiles) else slice(None)]
    radius = float(np.median(_radii(around, middle)))
    heights = np.concatenate([faces[..., 1].ravel(), 1e3 * corners[..., 2].ravel()])
    _frame(axis, squares[..., 0], heights, radius)
    wall = _polygons(faces, facecolors=SURFACE, edgecolors=SURFACE, linewidths=0.3, rasterized=True)
    axis.add_collection(wall, autolim=False)
    wall.set_clip_path(Rectangle((-180.0, 0.0), 360.0, 1.0, transform=axis.get_xaxis_transform()))
    _add_tiles(axis, paint, tiles, squares)
    _label_tiles(axis, paint, tiles, squares)


def _frame(axis: Axes, angles: FloatArray, heights: FloatArray, radius: float) -> None:
    """Limits [deg, mm], an aspect that is equal at the radius [m], and names of the axes."""
    left, right = min(-180.0, angles.min(initial=0.0)), max(180.0, angles.max(initial=0.0))
    low, high = heights.min(), heights.max()
    margin = _ABOVE * (high - low)
    axis.set_xlim(left - _BESIDE, right + _BESIDE)
    axis.set_ylim(low - margin, high + margin)
    axis.set_aspect(1.0 / (1e3 * np.radians(1.0) * radius))
    axis.set_xticks(
        [-180, -90, 0, 90, 180],
        [
            "-180°\nposterior",
            "-90°\nright\n(-y)",
            "0°\nanterior\n(+x)",
            "90°\nleft\n(+y)",
            "180°\nposterior",
        ],
        fontsize=7,
    )
    axis.set_ylabel("z of {S} [mm]")
    axis.set_title(
        f"the wall unrolled, seen from outside; across it, lengths hold at a radius of"
        f" {1e3 * radius:.0f} mm",
        fontsize=9,
    )


def _faces_around(surface: trimesh.Trimesh, middle: FloatArray) -> FloatArray:
    """Faces around the axis, those beyond an end of the turn at both ends, shape (f, 3, 2)."""
    faces = _unroll(surface.triangles, surface.triangles[:, 0], middle)
    faces = faces[np.ptp(faces[..., 0], axis=1) < _WIDEST_FACE]
    over = faces[(np.abs(faces[..., 0]) > 180.0).any(axis=1)]
    turn = np.where(over[:, :1, :1] > 0.0, -360.0, 360.0)
    return np.concatenate([faces, over + turn * [1.0, 0.0]])


def _unroll(points: FloatArray, near: FloatArray, middle: FloatArray) -> FloatArray:
    """Angles [deg] and heights [mm] of points, in the turn of the point that they are near.

    Args:
        points: Points in {S}, shape (m, k, 3) [m].
        near: A point beside each k of them, shape (m, 3) [m]; its own angle is in +-180 deg.
        middle: x and y of the vertical axis in {S}, shape (2,) [m].
    """
    angles = _angles(points, middle)
    reference = _angles(near, middle)[:, None]
    turned = reference + (angles - reference + 180.0) % 360.0 - 180.0
    return np.stack([turned, 1e3 * points[..., 2]], axis=-1)


def _angles(points: FloatArray, middle: FloatArray) -> FloatArray:
    x, y = np.moveaxis(points[..., :2] - middle, -1, 0)
    return np.degrees(np.arctan2(y, x))


def _radii(points: FloatArray, middle: FloatArray) -> FloatArray:
    return np.linalg.norm(points[..., :2] - middle, axis=-1)


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
    middle = surface.bounds.mean(axis=0)[:2]
    low, high = drawn_bounds(geometry, surface)
    axes = place_axes(low, high)
    low, high = np.minimum(low, axes.start), np.maximum(high, axes.start + axes.length)
    every_tile = np.arange(len(geometry))
    draw_unrolled(figure.add_subplot(grid[1, :3]), geometry, paint, middle, surface)
    # At the origin they would hide the tiles of the end.
    aside = replace(axes, start=low, length=0.4 * axes.length)
    end_tiles = every_tile[~wall_tiles(geometry, middle)]
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


_WIDTH, _ROW = 7.4, 2.9  # [inch]


def tile_map_figure(
    geometry: SocketGeometry,
    rows: Mapping[str, FloatArray],
    unit: str,
    title: str,
    notes: Mapping[str, str] | None = None,
    certainty: Mapping[str, FloatArray] | None = None,
) -> Figure:
    """Tiles by their values on one colour scale that prints in grey, a row per set of values.

    The socket's wall is unrolled around the vertical axis through the tiles' middle; beside
    it is the distal end. Tiles with a cluster have a thick outline and a number, which the
    title explains.

    Args:
        geometry: The socket.
        rows: One value per tile in `unit`, shape (n,), by what it is; NaN where there is none.
        unit: What the values are, with their unit, such as `stiffness [N/m]`.
        title: What is shown.
        notes: What to say of a cluster, by its name.
        certainty: How certain the values of a row are, see `paint_tiles`, by what it is.

    Raises:
        ConfigurationError: If the values are not those of these tiles.
    """
    notes = notes or {}
    certainty = certainty or {}
    figure = Figure(figsize=(_WIDTH, _ROW * len(rows) + 0.4), layout="constrained")
    labels = [""] * len(geometry)
    legend = []
    for number, (cluster, tile) in enumerate(geometry.clusters.items(), start=1):
        labels[tile] = str(number)
        legend.append(f"{number} {cluster}" + (f": {notes[cluster]}" if cluster in notes else ""))
    heading = [title, *(legend if notes else textwrap.wrap(", ".join(legend), _LINE_OF_TITLE))]
    size = 8.5 if notes else 10
    figure.suptitle("\n".join(filter(None, heading)), fontsize=size, parse_math=False)
    axes = figure.subplots(len(rows), 2, width_ratios=(3.2, 1.0), squeeze=False)
    limits = value_range(geometry, np.stack([*rows.values()]))
    low, high = drawn_bounds(geometry)
    middle = 0.5 * (low + high)[:2]
    end = np.flatnonzero(~wall_tiles(geometry, middle))
    for (wall_axis, end_axis), (name, values) in zip(axes, rows.items(), strict=True):
        paint = paint_tiles(geometry, values, limits, labels, certainty.get(name))
        draw_unrolled(wall_axis, geometry, paint, middle)
        wall_axis.set_title(name, fontsize=9.5, loc="left", fontweight="bold", parse_math=False)
        wall_axis.set_title("")
        frame_view(end_axis, DISTAL, low, high)
        draw_view(end_axis, DISTAL, geometry, paint, end)
        end_axis.set_title("distal end, from inside", fontsize=8)
    assert paint.scale is not None
    figure.colorbar(paint.scale, ax=[*axes.flat], label=unit, shrink=0.8, pad=0.01)
    return lay_out(figure)


def force_map_figure(geometry: SocketGeometry, estimate: MapEstimate, title: str) -> Figure:
    """Normal pressure of the first sample of a force map, and below its standard deviation.

    The pressure fades to white where it is uncertain: see `certainty_of`.

    Args:
        geometry: The socket.
        estimate: The map, such as the mean of a segment.
        title: What is shown.
    """
    pressure = 1e-3 * estimate.normal_pressure[0]
    deviation = 1e-3 * estimate.normal_pressure_standard_deviation[0]
    name = "normal pressure; pale where it is uncertain"
    rows = {name: pressure, "its standard deviation": deviation}
    certainty = {name: certainty_of(pressure, deviation)}
    return tile_map_figure(geometry, rows, "pressure [kPa]", title, certainty=certainty)


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
