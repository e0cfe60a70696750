"""The socket's axis: heights above its distal end, and angles around it from anterior to left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.geometry.socket import SocketGeometry

_AWAY = 0.5  # [-]; cosine of the angle at which a tile's x is no longer the proximal direction
_UP = np.sqrt(0.5)  # [-]; z of the normals of what faces up at 45 degrees or more
_NO_DIRECTION = 0.1  # [-]; length of a mean of unit vectors that cancel
_X, _Z = np.eye(3)[[0, 2]]


@dataclass(frozen=True)
class SocketAxis:
    """The axis of a socket with the direction from which angles around it count."""

    end: FloatArray  # where the axis meets the distal end in {S}; (3,) [m]
    proximal: FloatArray  # unit vector along it towards the proximal end; (3,) [-]
    anterior: FloatArray  # unit vector across it, from which angles count; (3,) [-]

    @property
    def left(self) -> FloatArray:
        """Unit vector towards left, at +90 degrees, shape (3,) [-]."""
        return np.cross(self.proximal, self.anterior)

    def heights(self, points: FloatArray) -> FloatArray:
        """Heights of points in {S} above the distal end, shape (...) of (..., 3) [m]."""
        return np.asarray((points - self.end) @ self.proximal)

    def angles(self, points: FloatArray) -> FloatArray:
        """Angles of points in {S} from anterior towards left, in +-pi, (...) of (..., 3) [rad]."""
        offset = points - self.end
        return np.asarray(np.arctan2(offset @ self.left, offset @ self.anterior))

    def radii(self, points: FloatArray) -> FloatArray:
        """Distances of points in {S} from the axis, shape (...) of (..., 3) [m]."""
        offset = points - self.end
        return np.hypot(offset @ self.left, offset @ self.anterior)


def axis_through(end: FloatArray, proximal: FloatArray, anterior: FloatArray = _X) -> SocketAxis:
    """The axis through the distal end in a direction.

    Args:
        end: Centre of the distal end in {S}, shape (3,) [m].
        proximal: Direction towards the proximal end, shape (3,) [-].
        anterior: Direction of which the part across the axis is anterior, x of {S} by default
            (REP 103), shape (3,) [-]. Along the axis it says nothing: then -z of {S} is anterior.
    """
    along = proximal / np.linalg.norm(proximal)
    across = anterior - (anterior @ along) * along
    if np.linalg.norm(across) < _NO_DIRECTION:
        across = -_Z + (_Z @ along) * along
    return SocketAxis(np.asarray(end), along, across / np.linalg.norm(across))


def proximal_direction(geometry: SocketGeometry) -> FloatArray:
    """Unit vector in {S} towards the proximal end, the mean x axis of the tiles on the wall.

    On the distal end no tangent is proximal, so tiles whose x axis is far from the mean of
    all are left out. Where the x axes cancel or all tiles face up it is z of {S}.

    Returns:
        The direction, shape (3,) [-].
    """
    x_axes = geometry.rotations[:, :, 0]
    mean = x_axes.mean(axis=0)
    length = np.linalg.norm(mean)
    if length < _NO_DIRECTION or (geometry.rotations[:, 2, 2] > _UP).all():
        return _Z.copy()
    along = x_axes @ (mean / length) >= _AWAY
    if along.any():
        mean = x_axes[along].mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def socket_axis(geometry: SocketGeometry) -> SocketAxis:
    """The axis of a socket from its tiles: in the middle of their anchors, from the lowest one.

    With it, `heights(geometry.anchors)` and `angles(geometry.anchors)` say where each tile is.
    """
    through_s = axis_through(np.zeros(3), proximal_direction(geometry))
    frame = np.stack([through_s.anterior, through_s.left, through_s.proximal])
    along = geometry.anchors @ frame.T
    low, high = along.min(axis=0), along.max(axis=0)
    end = np.array([*0.5 * (low + high)[:2], low[2]]) @ frame
    return SocketAxis(end, through_s.proximal, through_s.anterior)


def wall_tiles(geometry: SocketGeometry, around: SocketAxis) -> BoolArray:
    """Which tiles are on the wall, shape (n,); those of the end and at the axis are not."""
    steep = geometry.rotations[:, :, 2] @ around.proximal < _UP
    return np.asarray(steep & (around.radii(geometry.anchors) >= np.sqrt(geometry.areas)))
