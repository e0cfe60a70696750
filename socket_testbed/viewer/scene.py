"""The socket in 3D: its tiles coloured, shear as arrows, clusters and the limb."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from viser import ViserServer

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.axis import socket_axis
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.pressure import NORMAL_QUANTILE, SHARE
from socket_testbed.report.figures.style import CLUSTER, EDGE, SCALE
from socket_testbed.report.figures.tiles import covered_tiles, tile_squares
from socket_testbed.viewer.source import Instant

QUANTITIES = ("normal pressure", "shear", "standard deviation")

_SMALLEST = 0.35  # [-]; edge of a tile of which nothing is known, by its own
_GAP = 0.92  # [-]; edge of a tile that is certain
_PALEST = 0.15  # [-]; of a tile's colour, the rest is white
_SQUARE = 0.5 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
_FACES = np.array([[0, 1, 2], [0, 2, 3]])
_AWAY = 1.35  # [-]; of names from the axis, by the socket's radius
_COLOURS = np.round(255.0 * mpl.colormaps[SCALE](np.linspace(0.0, 1.0, 256))[:, :3])


class Scene:
    """The scene of a page.

    It shows the socket where it was first seen in the world, from where it moves.

    Args:
        server: Serves the page.
        geometry: Geometry of the socket.
    """

    def __init__(self, server: ViserServer, geometry: SocketGeometry) -> None:
        self._geometry = geometry
        self._world: Pose | None = None  # in the scene
        self._drawn: Instant | None = None
        self.quantity = QUANTITIES[0]
        self.limit = 30e3  # [Pa]; upper end of the colours
        axis = socket_axis(geometry)
        scene = server.scene
        scene.set_up_direction(axis.proximal)
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(hdri=None)
        scene.add_light_ambient("/light", intensity=np.pi)
        self._socket = scene.add_frame("/socket", show_axes=False)
        edges = np.sqrt(geometry.areas)
        self._edges = edges.astype(np.float32)
        self._nothing = np.full((len(geometry), 3), 235, dtype=np.uint8)
        self._tiles = scene.add_batched_meshes_simple(
            "/socket/tiles",
            _SQUARE,
            _FACES,
            _wxyz(Pose(geometry.rotations, geometry.anchors)),
            geometry.anchors,
            batched_scales=_SMALLEST * edges,
            batched_colors=np.full((len(geometry), 3), 255, dtype=np.uint8),
            lod="off",
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )
        squares = tile_squares(geometry)
        sides = np.stack([squares, np.roll(squares, -1, axis=1)], axis=2)
        covered = covered_tiles(geometry)
        for name, chosen, colour, width in (
            ("tiles", ~covered, EDGE, 0.5),
            ("clusters", covered, CLUSTER, 4.0),
        ):
            if chosen.any():
                lines = sides[chosen].reshape(-1, 2, 3)
                scene.add_line_segments(
                    f"/socket/edges_of_{name}", lines, _rgb(colour), thickness=width
                )
        for name, tile in geometry.clusters.items():
            scene.add_label(f"/socket/cluster_{name}", name, position=geometry.anchors[tile])
        radius = float(axis.radii(geometry.anchors).max())
        for name, direction in (
            ("anterior", axis.anterior),
            ("posterior", -axis.anterior),
            ("left", axis.left),
            ("right", -axis.left),
        ):
            scene.add_label(f"/{name}", name, position=axis.end + _AWAY * radius * direction)
        middle = 0.5 * (geometry.anchors.min(axis=0) + geometry.anchors.max(axis=0))
        span = float(np.linalg.norm(np.ptp(geometry.anchors, axis=0)))
        server.initial_camera.look_at = middle
        server.initial_camera.position = middle + span * (
            1.2 * axis.anterior + 0.6 * axis.left + 0.7 * axis.proximal
        )

    def update(self, instant: Instant) -> None:
        """Draw a sample, unless it is the one that is drawn."""
        if instant is self._drawn:
            return
        self._drawn = instant
        self._place(instant)
        estimate = instant.map
        if estimate is None:
            self._tiles.batched_colors = self._nothing
            self._tiles.batched_scales = _SMALLEST * self._edges
            return
        values = {
            "normal pressure": estimate.normal_pressure[0],
            "shear": estimate.shear[0],
            "standard deviation": estimate.normal_pressure_standard_deviation[0],
        }[self.quantity]
        certainty = _certainty(
            estimate.normal_pressure[0], estimate.normal_pressure_standard_deviation[0]
        )
        self._tiles.batched_colors = _colours(values / self.limit, certainty)
        self._tiles.batched_scales = self._edges * (_SMALLEST + (_GAP - _SMALLEST) * certainty)

    def _place(self, instant: Instant) -> None:
        """Move the socket as it moves in the world."""
        pose = instant.socket_in_world
        if pose is None:
            return
        if self._world is None:
            self._world = pose.inverse()
        moved = self._world @ pose
        self._socket.position = moved.translation
        self._socket.wxyz = _wxyz(moved)


def _certainty(values: FloatArray, deviations: FloatArray) -> NDArray[np.float32]:
    """How certain values are: 1 where they are determined, less where their interval is wider."""
    reach = np.maximum(NORMAL_QUANTILE * deviations, 1e-9)
    shares = np.clip(SHARE * np.abs(values) / reach, 0.0, 1.0)
    return np.nan_to_num(shares).astype(np.float32)


def _colours(shares: FloatArray, certainty: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colours of shares of the scale, RGB, shape (n, 3), the paler the less they are certain."""
    index = np.clip(np.nan_to_num(255.0 * shares), 0, 255).astype(int)
    strength = (_PALEST + (1.0 - _PALEST) * certainty)[:, None]
    return np.asarray(255.0 + strength * (_COLOURS[index] - 255.0)).astype(np.uint8)


def _rgb(colour: str) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in mpl.colors.to_rgb(colour))
    return red, green, blue


def _wxyz(pose: Pose) -> FloatArray:
    """Quaternions in viser's order."""
    return np.roll(pose.quaternion(), 1, axis=-1)
