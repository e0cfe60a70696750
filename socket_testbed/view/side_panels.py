"""Panels of a socket seen along an axis of {S}: its surface, the tiles that face us, the axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.view.axes_of_s import AXIS_NAMES, AxesOfS
from socket_testbed.view.colours import AXES
from socket_testbed.view.labels import write_cluster, write_label
from socket_testbed.view.paint import TilePaint
from socket_testbed.view.squares import tile_labels, tile_squares
from socket_testbed.view.surface import Surface

_LEAST_FACING = 0.15  # [-]; cosine; what is seen more edge-on is no square any more
_LABEL_FACING = 0.5  # [-]; likewise, room for a name
_DARKEST, _LIGHTEST = 0.64, 0.91  # greys of the surface
_LIGHT = np.array([-0.3, 0.35, 0.9])  # to the right, up and towards the viewer
_MARGIN = 1.12
_NAME = 0.18  # [-]; of an arrow's length, from its tip to its name
_CENTRED = {"ha": "center", "va": "center"}


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
# depends on the leg, which the geometry does not tell.
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
    axis: Axes,
    view: View,
    surface: Surface,
    geometry: SocketGeometry,
    paint: TilePaint,
    tiles: IntArray,
) -> None:
    """Draw the surface and the tiles on it that face the viewer, through the wall if need be.

    Args:
        axis: The panel.
        view: Where from.
        surface: The interior surface in {S}.
        geometry: The socket.
        paint: How its tiles are painted.
        tiles: Which tiles may be drawn, by index.
    """
    _draw_surface(axis, view, surface)
    towards = view.basis()[2]
    facing = geometry.rotations[:, :, 2] @ (towards if view.inside else -towards)
    shown = tiles[facing[tiles] > _LEAST_FACING]
    shown = shown[np.argsort(geometry.anchors[shown] @ towards)]
    squares = view.project(tile_squares(geometry))
    axis.add_collection(
        PolyCollection(
            list(squares[shown]),
            facecolors=paint.fills[shown],
            edgecolors=paint.edges[shown],
            linewidths=paint.widths[shown],
        )
    )
    _write_names(axis, view, geometry, paint, shown[facing[shown] > _LABEL_FACING])


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


def _write_names(
    axis: Axes, view: View, geometry: SocketGeometry, paint: TilePaint, tiles: IntArray
) -> None:
    """Name every tile inside, where nothing else does, but outside the clusters only."""
    squares = view.project(tile_squares(geometry))
    if view.inside:
        labels = tile_labels(geometry)
        for tile in tiles:
            write_label(axis, labels[tile], squares[tile], paint.ink(tile))
        return
    for cluster, tile in geometry.clusters.items():
        if tile in tiles:
            write_cluster(axis, cluster, squares[tile])


def _draw_surface(axis: Axes, view: View, surface: Surface) -> None:
    """Paint the faces from the back to the front, so that none needs to be wound rightly."""
    basis = view.basis()
    triangles = surface.vertices[surface.faces]
    order = np.argsort(triangles.mean(axis=1) @ basis[2])
    light = _LIGHT @ basis / np.linalg.norm(_LIGHT)
    brightness = np.abs(surface.normals()[order] @ light)
    greys = np.repeat(_DARKEST + (_LIGHTEST - _DARKEST) * brightness[:, None], 3, axis=1)
    axis.add_collection(
        PolyCollection(
            list(view.project(triangles[order])),
            facecolors=greys,
            edgecolors=greys,  # no hairlines between the faces
            linewidths=0.2,
            rasterized=True,
        )
    )


def _widened(ends: FloatArray) -> FloatArray:
    return ends.mean() + _MARGIN * (ends - ends.mean())
