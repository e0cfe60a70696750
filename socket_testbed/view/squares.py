"""The tiles as they are drawn: their squares, labels and values, and what they face."""

from __future__ import annotations

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry

# Corners of a square of edge 2 in {L}, counter-clockwise about the inward normal.
_CORNERS = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
_AWAY = 0.5  # [-]; cosine of the angle at which a tile's x is no longer the proximal direction
_NO_DIRECTION = 0.1  # [-]; length of a mean of unit vectors that cancel


def tile_squares(geometry: SocketGeometry) -> FloatArray:
    """Corners of the tiles' squares in {S}, of edge sqrt(area) around the anchors.

    Returns:
        Corners (-x, -y), (+x, -y), (+x, +y), (-x, +y) of each tile's frame, shape
        (n, 4, 3) [m].
    """
    half_edges = 0.5 * np.sqrt(geometry.areas)
    corners_in_tile = half_edges[:, None, None] * _CORNERS
    tiles_in_socket = Pose(geometry.rotations[:, None], geometry.anchors[:, None])
    return tiles_in_socket.apply(corners_in_tile)


def tile_labels(geometry: SocketGeometry) -> list[str]:
    """Names of the tiles, each with its cluster where that has another name."""
    labels = list(geometry.names)
    for cluster, tile in geometry.clusters.items():
        if cluster != labels[tile]:
            labels[tile] += f" ({cluster})"
    return labels


def covered_tiles(geometry: SocketGeometry) -> BoolArray:
    """Which tiles a cluster covers, shape (n,)."""
    covered = np.zeros(len(geometry), dtype=bool)
    covered[list(geometry.clusters.values())] = True
    return covered


def proximal_direction(geometry: SocketGeometry) -> FloatArray | None:
    """Unit vector in {S} towards the proximal end, the mean x axis of the tiles on the wall.

    On the distal end no tangent is proximal, so tiles whose x axis is far from the mean of
    all are left out.

    Returns:
        The direction, shape (3,) [-]; None if the tiles' x axes cancel.
    """
    x_axes = geometry.rotations[:, :, 0]
    mean = x_axes.mean(axis=0)
    length = np.linalg.norm(mean)
    if length < _NO_DIRECTION:
        return None
    along = x_axes @ (mean / length) >= _AWAY
    if along.any():
        mean = x_axes[along].mean(axis=0)
    return mean / np.linalg.norm(mean)


def check_values(geometry: SocketGeometry, values: FloatArray) -> None:
    """Refuse values that are not one a tile, finite, or NaN where there is none.

    Raises:
        ConfigurationError: If the values are not those of these tiles.
    """
    if values.shape != (len(geometry),):
        raise ConfigurationError(
            f"values of the shape {values.shape} do not fit {len(geometry)} tiles",
            "give one value a tile, NaN where there is none",
        )
    if np.isinf(values).any():
        name = geometry.names[int(np.flatnonzero(np.isinf(values))[0])]
        raise ConfigurationError(
            f"the value of tile '{name}' is infinite", "give a finite value, or NaN for none"
        )


def value_range(values: FloatArray) -> tuple[float, float]:
    """Ends of the colour scale: the finite values' range, widened where it is a point.

    Args:
        values: Values of the tiles, NaN where there is none.
    """
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    if low == high:
        margin = 0.1 * abs(low) or 1.0
        return low - margin, high + margin
    return low, high
