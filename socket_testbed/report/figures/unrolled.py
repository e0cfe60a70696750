"""The wall of a socket unrolled: angle around its axis against height above its distal end."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.geometry.axis import SocketAxis
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.report.figures.style import HATCH, MM, SMALL, SURFACE
from socket_testbed.report.figures.tiles import TilePaint, tile_squares

CENTRED: dict[str, Any] = {"ha": "center", "va": "center"}
OUTLINED: dict[str, Any] = {"path_effects": [withStroke(linewidth=2.0, foreground="white")]}
_SMALLEST = 3.0  # [pt]; of a name on a tile
_LONGEST_LINE = 9  # characters
_CHARACTER = 0.62  # [-]; width of a character by the size of the font
_LINE = 1.25  # [-]; height of a line, likewise


def label_tiles(axis: Axes, paint: TilePaint, tiles: IntArray, squares: FloatArray) -> None:
    """Write a name inside each tile, as large as fits; leave it out where that is too small.

    A number of one or two digits is written at full size, legible on any fill. Nothing in a label
    is markup. The panel must have its limits and its aspect.

    Args:
        axis: The panel.
        paint: What is written on the tiles.
        tiles: Which tiles, by index, m of them.
        squares: Their corners in the panel's coordinates, shape (m, 4, 2).
    """
    for tile, corners in zip(tiles, squares, strict=True):
        lines = break_name(paint.labels[tile])
        if not any(lines):
            continue
        width, height = np.ptp(corners, axis=0) * _points_per_unit(axis)
        size = min(
            SMALL,
            width / (_CHARACTER * max(len(line) for line in lines)),
            height / (_LINE * len(lines)),
        )
        if len(paint.labels[tile]) <= 2:
            write_in(axis, lines, corners, fontsize=SMALL, **OUTLINED)
        elif size >= _SMALLEST:
            write_in(axis, lines, corners, color=paint.ink(tile), fontsize=size, linespacing=1.0)


def write_in(axis: Axes, lines: Sequence[str], corners: FloatArray, **style: Any) -> None:
    """Write lines in the middle of a polygon; nothing in them is markup."""
    x, y = corners.mean(axis=0)
    axis.text(x, y, "\n".join(lines), parse_math=False, zorder=3, **CENTRED, **style)


def break_name(label: str) -> list[str]:
    """Break a long name behind its underscores and at its spaces."""
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


def polygons(corners: FloatArray, **style: Any) -> PolyCollection:
    """Polygons of k corners, shape (m, k, 2); matplotlib makes them faster from an array."""
    array: Any = corners  # matplotlib takes an array, too, but its types name sequences only
    return PolyCollection(array, **style)


class DrawnTiles:
    """Tiles in a panel; those whose value is not determined are hatched.

    Args:
        axis: The panel.
        paint: How the tiles are painted.
        tiles: Which tiles, by index, m of them.
        squares: Their corners in the panel's coordinates, shape (m, 4, 2).
    """

    def __init__(self, axis: Axes, paint: TilePaint, tiles: IntArray, squares: FloatArray) -> None:
        self._tiles, self._squares = tiles, squares
        look: dict[str, Any] = {
            "edgecolors": paint.edges[tiles],
            "linewidths": paint.widths[tiles],
        }
        hatch: dict[str, Any] = {"facecolors": "none", "edgecolors": "0.35", "hatch": HATCH}
        self._filled = polygons(squares, facecolors=paint.fills[tiles], **look)
        self._hatched = polygons(squares[:0], linewidths=0.0, **hatch)
        axis.add_collection(self._filled)
        axis.add_collection(self._hatched, autolim=False)
        self.repaint(paint)

    def set_visible(self, visible: bool) -> None:
        """Show or hide them."""
        self._filled.set_visible(visible)
        self._hatched.set_visible(visible)

    def repaint(self, paint: TilePaint) -> None:
        """Change the fills and the hatches."""
        self._filled.set_facecolor(paint.fills[self._tiles])
        hatched: Any = self._squares[paint.hatched[self._tiles]]
        self._hatched.set_verts(hatched)


_WALL = np.sqrt(0.5)  # [-]; of the normals of what is at 45 degrees; the end faces up more
_WIDEST_FACE = 60.0  # [deg]; a wider one is at the axis, where there is no angle
_BESIDE = 3.0  # [deg]; free on both sides of the unrolled wall
_ABOVE = 0.03  # [-]; of its height, free above and below


def wall_tiles(geometry: SocketGeometry, around: SocketAxis) -> BoolArray:
    """Which tiles are on the wall, not on the distal end, shape (n,).

    Args:
        geometry: The socket.
        around: Its axis; a tile at it counts as one of the end.
    """
    steep = geometry.rotations[:, :, 2] @ around.proximal < _WALL
    return steep & (around.radii(geometry.anchors) >= np.sqrt(geometry.areas))


def sides_of(side: str) -> tuple[str, str, str, str]:
    """What is anterior, left, posterior and right of the socket of a side.

    Args:
        side: `left` or `right`, the leg that wears it; empty where that is not known: only then
            left and right keep their names.
    """
    left, right = {"left": ("lateral", "medial"), "right": ("medial", "lateral")}.get(
        side, ("left", "right")
    )
    return "anterior", left, "posterior", right


def wall_aspect(geometry: SocketGeometry, around: SocketAxis) -> float:
    """Height of the unrolled wall by its width [-], lengths being true at its median radius."""
    heights = around.heights(tile_squares(geometry))
    turn = np.radians(360.0 + 2.0 * _BESIDE) * _radius(geometry, around)
    return float(np.ptp(heights) * (1.0 + 2.0 * _ABOVE) / turn)


def draw_unrolled(
    axis: Axes,
    geometry: SocketGeometry,
    paint: TilePaint,
    around: SocketAxis,
    surface: trimesh.Trimesh | None = None,
    side: str = "",
) -> DrawnTiles:
    """Draw the wall as one sees it walking around it outside: anterior, left, posterior, right.

    The angle is that around the socket's axis, from anterior towards left. Lengths across are
    true at the tiles' median radius only.

    Args:
        axis: The panel.
        geometry: The socket.
        paint: How its tiles are painted.
        around: The socket's axis.
        surface: The interior surface in {S}; None where it is not known.
        side: The leg that wears it, see `sides_of`.
    """
    tiles = np.flatnonzero(wall_tiles(geometry, around))
    corners = tile_squares(geometry)
    squares = _unroll(corners[tiles], geometry.anchors[tiles], around)
    faces = np.zeros((0, 3, 2)) if surface is None else _faces_around(surface, around)
    heights = np.concatenate([faces[..., 1].ravel(), 1e3 * around.heights(corners).ravel()])
    _frame(axis, squares[..., 0], heights, _radius(geometry, around))
    _name_sides(axis, sides_of(side))
    wall = polygons(faces, facecolors=SURFACE, edgecolors=SURFACE, linewidths=0.3, rasterized=True)
    axis.add_collection(wall, autolim=False)
    wall.set_clip_path(Rectangle((-180.0, 0.0), 360.0, 1.0, transform=axis.get_xaxis_transform()))
    drawn = DrawnTiles(axis, paint, tiles, squares)
    label_tiles(axis, paint, tiles, squares)
    return drawn


def _radius(geometry: SocketGeometry, around: SocketAxis) -> float:
    """Median radius of the tiles on the wall, or of all where none is [m]."""
    tiles = wall_tiles(geometry, around)
    radii = around.radii(geometry.anchors)
    return float(np.median(radii[tiles] if tiles.any() else radii))


def _frame(axis: Axes, angles: FloatArray, heights: FloatArray, radius: float) -> None:
    """Limits [deg, mm], and an aspect that is equal at the radius [m]."""
    left, right = min(-180.0, angles.min(initial=0.0)), max(180.0, angles.max(initial=0.0))
    low, high = heights.min(), heights.max()
    margin = _ABOVE * (high - low)
    axis.set_xlim(left - _BESIDE, right + _BESIDE)
    axis.set_ylim(low - margin, high + margin)
    axis.set_aspect(1.0 / (1e3 * np.radians(1.0) * max(radius, 1e-3)))
    axis.set_ylabel("height [mm]")


_WORD = 0.62 * len("posterior") * SMALL / 72.0 / MM  # [mm]; width of the longest of the sides
_SHORT = {"anterior": "ant.", "posterior": "post.", "lateral": "lat.", "medial": "med."}


def _name_sides(axis: Axes, sides: tuple[str, str, str, str]) -> None:
    anterior, left, posterior, right = sides
    names: tuple[str, ...] = (posterior, right, anterior, left, posterior)
    quarter = 90.0 * _points_per_unit(axis)[0] / 72.0 / MM
    if quarter < _WORD:
        names = tuple(_SHORT.get(name, name) for name in names)
    angles = (-180, -90, 0, 90, 180)
    degrees = ("\N{MINUS SIGN}180°", "\N{MINUS SIGN}90°", "0°", "90°", "180°")
    axis.set_xticks(angles, [f"{d}\n{n}" for d, n in zip(degrees, names, strict=True)])


def _faces_around(surface: trimesh.Trimesh, around: SocketAxis) -> FloatArray:
    """Faces around the axis, those beyond an end of the turn at both ends, shape (f, 3, 2)."""
    faces = _unroll(surface.triangles, surface.triangles[:, 0], around)
    faces = faces[np.ptp(faces[..., 0], axis=1) < _WIDEST_FACE]
    over = faces[(np.abs(faces[..., 0]) > 180.0).any(axis=1)]
    turn = np.where(over[:, :1, :1] > 0.0, -360.0, 360.0)
    return np.concatenate([faces, over + turn * [1.0, 0.0]])


def _unroll(points: FloatArray, near: FloatArray, around: SocketAxis) -> FloatArray:
    """Angles [deg] and heights [mm] of points, in the turn of the point that they are near.

    Args:
        points: Points in {S}, shape (m, k, 3) [m].
        near: A point beside each k of them, shape (m, 3) [m]; its own angle is in +-180 deg.
        around: The socket's axis.
    """
    angles = np.degrees(around.angles(points))
    reference = np.degrees(around.angles(near))[:, None]
    turned = reference + (angles - reference + 180.0) % 360.0 - 180.0
    return np.stack([turned, 1e3 * around.heights(points)], axis=-1)
