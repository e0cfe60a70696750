"""The wall of a socket unrolled: height against the angle around it, every tile with its name."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.patches import Rectangle

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.view.colours import SURFACE
from socket_testbed.view.labels import write_label
from socket_testbed.view.paint import TilePaint
from socket_testbed.view.squares import tile_labels, tile_squares
from socket_testbed.view.surface import Surface

_WALL = np.sqrt(0.5)  # [-]; z of the normals of what is at 45 degrees; the end faces up more
_WIDEST_FACE = 60.0  # [deg]; a wider one is at the axis, where there is no angle
_MARGIN = 0.03


def wall_tiles(geometry: SocketGeometry, surface: Surface) -> BoolArray:
    """Which tiles are on the wall, not on the distal end, shape (n,).

    A tile at the vertical axis through the surface's middle counts as one of the end.
    """
    steep = geometry.rotations[:, 2, 2] < _WALL
    return steep & (_radii(geometry.anchors, _middle(surface)) >= np.sqrt(geometry.areas))


def draw_unrolled(axis: Axes, surface: Surface, geometry: SocketGeometry, paint: TilePaint) -> None:
    """Draw the wall as one sees it walking around it outside: anterior, left, posterior, right.

    The angle is that about a vertical axis through the surface's middle, from x of {S}
    (anterior) towards y (left). Lengths across are true at the tiles' median radius only.

    Args:
        axis: The panel.
        surface: The interior surface in {S}.
        geometry: The socket.
        paint: How its tiles are painted.
    """
    middle = _middle(surface)
    tiles = np.flatnonzero(wall_tiles(geometry, surface))
    squares = _unroll(tile_squares(geometry)[tiles], geometry.anchors[tiles], middle)
    faces = _faces_around(surface, middle)
    around = surface.vertices if not len(tiles) else geometry.anchors[tiles]
    radius = float(np.median(_radii(around, middle)))
    _frame(axis, np.concatenate([faces.reshape(-1, 2), squares.reshape(-1, 2)]), squares, radius)
    wall = PolyCollection(
        list(faces), facecolors=SURFACE, edgecolors=SURFACE, linewidths=0.3, rasterized=True
    )
    axis.add_collection(wall)
    wall.set_clip_path(Rectangle((-180.0, 0.0), 360.0, 1.0, transform=axis.get_xaxis_transform()))
    axis.add_collection(
        PolyCollection(
            list(squares),
            facecolors=paint.fills[tiles],
            edgecolors=paint.edges[tiles],
            linewidths=paint.widths[tiles],
        )
    )
    _name_tiles(axis, geometry, tiles, squares, paint)


def _name_tiles(
    axis: Axes, geometry: SocketGeometry, tiles: IntArray, squares: FloatArray, paint: TilePaint
) -> None:
    labels = tile_labels(geometry)
    for tile, corners in zip(tiles, squares, strict=True):
        write_label(axis, labels[tile], corners, paint.ink(tile))


def _frame(axis: Axes, drawn: FloatArray, squares: FloatArray, radius: float) -> None:
    """Limits, an aspect that is equal at the radius [m], and names of the axes."""
    angles = squares[..., 0]
    left, right = min(-180.0, angles.min(initial=0.0)), max(180.0, angles.max(initial=0.0))
    low, high = drawn[:, 1].min(), drawn[:, 1].max()
    axis.set_xlim(left - 3.0, right + 3.0)
    axis.set_ylim(low - _MARGIN * (high - low), high + _MARGIN * (high - low))
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


def _faces_around(surface: Surface, middle: FloatArray) -> FloatArray:
    """Faces around the axis, those beyond an end of the turn at both ends, shape (f, 3, 2)."""
    triangles = surface.vertices[surface.faces]
    faces = _unroll(triangles, triangles[:, 0], middle)
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


def _middle(surface: Surface) -> FloatArray:
    low, high = surface.bounds()
    return 0.5 * (low + high)[:2]
