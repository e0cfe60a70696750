"""A conical socket with tiles in rings and on its distal end: a geometry whose places are known."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry

_TILE = 0.030  # [m]; edge of a square tile
_PITCH = 0.033  # [m]; of the rings along the wall
_RINGS = 6
_DISTAL_HEIGHT = 0.080  # [m]; of the distal end above the load cell
_DISTAL_RADIUS = 0.046  # [m]; of the wall at the distal end
_TAPER = math.radians(6.0)
_REACH = 0.047  # [m]; largest distance between neighbours


def ring_socket() -> SocketGeometry:
    """A right circular cone, open at the top, standing on the load cell; x is anterior."""
    names: list[str] = []
    anchors: list[FloatArray] = []
    frames: list[FloatArray] = []
    for ring in range(_RINGS):
        along = (ring + 0.75) * _PITCH
        radius = _DISTAL_RADIUS + along * math.sin(_TAPER)
        height = _DISTAL_HEIGHT + along * math.cos(_TAPER)
        count = int(2.0 * math.pi * radius / _PITCH)
        for place in range(count):
            angle = 2.0 * math.pi * place / count
            names.append(f"ring{ring + 1}_{place + 1:02d}")
            outward = np.array([math.cos(angle), math.sin(angle), 0.0])
            anchors.append(radius * outward + [0.0, 0.0, height])
            inward = -math.cos(_TAPER) * outward + [0.0, 0.0, math.sin(_TAPER)]
            proximal = math.sin(_TAPER) * outward + [0.0, 0.0, math.cos(_TAPER)]
            frames.append(np.column_stack([proximal, np.cross(inward, proximal), inward]))
    for place, (x, y) in enumerate([(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)]):
        names.append(f"end_{place + 1}")
        anchors.append(np.array([x * _PITCH, y * _PITCH, _DISTAL_HEIGHT]))
        frames.append(np.eye(3))  # on the end no tangent is proximal: x is anterior

    points = np.array(anchors)
    rotations = np.array(frames)
    clusters = {
        "brim_lateral": _nearest(points, 0.0, 1.0, _RINGS - 1),
        "mid_anterior": _nearest(points, 1.0, 0.0, 3),
        "posterior_distal": _nearest(points, -1.0, 0.0, 0),
        "distal": names.index("end_1"),
    }
    for cluster, tile in clusters.items():
        names[tile] = cluster
    return SocketGeometry(
        names=tuple(names),
        anchors=points,
        rotations=rotations,
        areas=np.full(len(names), _TILE**2),
        neighbours=_neighbours(points, rotations),
        clusters=clusters,
        socket_markers=np.array([[0.0, 0.0, 0.0], [0.090, 0.0, 0.0], [0.025, 0.050, 0.0]]),
        pylon_markers=np.array([[0.0, 0.0, 0.0], [0.110, 0.0, 0.010], [0.040, 0.075, 0.0]]),
        socket_body=Pose(_about_z(90.0), np.array([0.080, -0.030, 0.150])),
        limb=Pose(_about_z(-30.0), np.array([-0.045, -0.030, -0.220])),
    )


def _nearest(points: FloatArray, x: float, y: float, ring: int) -> int:
    """The tile of a ring that faces the direction (x, y)."""
    height = _DISTAL_HEIGHT + (ring + 0.75) * _PITCH * math.cos(_TAPER)
    facing = points[:, :2] @ [x, y]
    on_ring = np.abs(points[:, 2] - height) < 0.1 * _PITCH
    return int(np.argmax(np.where(on_ring, facing, -np.inf)))


def _neighbours(points: FloatArray, rotations: FloatArray) -> IntArray:
    pairs = [
        (a, b)
        for a, b in combinations(range(len(points)), 2)
        if np.linalg.norm(points[a] - points[b]) < _REACH
        and rotations[a][:, 2] @ rotations[b][:, 2] > -0.2
    ]
    return np.array(pairs, dtype=np.int64)


def _about_z(degrees: float) -> FloatArray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
