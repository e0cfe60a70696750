"""The pressure map for RViz: a tile and an arrow at every point of interest."""

from __future__ import annotations

import math

import numpy as np
from geometry_msgs.msg import Quaternion
from scipy.spatial.transform import Rotation
from visualization_msgs.msg import Marker, MarkerArray

from socket_testbed.arrays import FloatArray
from socket_testbed.contact import ContactModel
from socket_testbed.nodes.conversions import LOAD_CELL_FRAME, header_to_ros, point_to_ros

_ARROW_SCALE = 0.002  # [m/N]
_FULL_COLOUR_FORCE = 25.0  # [N]


class PressureMap:
    """The markers of a model, of which only what a sample changes is made anew.

    Args:
        model: The model, for the anchors and frames of the points.
        areas: Areas of the tiles, shape (n,) [m^2].
    """

    def __init__(self, model: ContactModel, areas: FloatArray) -> None:
        self._anchors = model.anchors
        self._normals = model.rotations[:, :, 2]
        self._tiles = []
        self._arrows = []
        quaternions = Rotation.from_matrix(model.rotations).as_quat().tolist()
        for i, (anchor, (x, y, z, w)) in enumerate(zip(model.anchors, quaternions, strict=True)):
            tile = Marker(ns="tiles", id=i, type=Marker.CUBE, action=Marker.ADD)
            tile.pose.position = point_to_ros(anchor)
            tile.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
            tile.scale.x = tile.scale.y = math.sqrt(areas[i])
            tile.scale.z = 0.001
            arrow = Marker(ns="forces", id=i, type=Marker.ARROW, action=Marker.ADD)
            arrow.scale.x, arrow.scale.y = 0.002, 0.004
            self._tiles.append(tile)
            self._arrows.append(arrow)

    def markers(self, stamp: int, forces: FloatArray) -> MarkerArray:
        """The message of a sample.

        Args:
            stamp: Stamp since the epoch [ns].
            forces: Forces on the socket in {S}, shape (n, 3) [N].
        """
        header = header_to_ros(stamp, LOAD_CELL_FRAME)
        normal_forces = -np.einsum("ni,ni->n", forces, self._normals)
        tips = self._anchors + _ARROW_SCALE * np.nan_to_num(forces)
        markers = []
        for tile, arrow, tip, force in zip(
            self._tiles, self._arrows, tips, normal_forces.tolist(), strict=True
        ):
            arrow.points = [tile.pose.position, point_to_ros(tip)]
            for marker in (tile, arrow):
                marker.header = header
                _paint(marker, force)
                markers.append(marker)
        return MarkerArray(markers=markers)


def _paint(marker: Marker, normal_force: float) -> None:
    """From pale to dark red with the normal force; grey where it is not known."""
    if not math.isfinite(normal_force):
        marker.color.r = marker.color.g = marker.color.b = 0.6
    else:
        share = min(max(normal_force / _FULL_COLOUR_FORCE, 0.0), 1.0)
        marker.color.r = 1.0 - 0.4 * share
        marker.color.g = marker.color.b = 0.9 * (1.0 - share)
    marker.color.a = 0.9
