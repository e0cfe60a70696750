"""A conical socket with tiles in rings and on its distal end: a geometry whose places are known."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry

_TILE = 0.030  # [m]; edge of a square tile
_PITCH = 0.033  # [m]; of the rings along the wall
_RINGS = 6
_DISTAL_HEIGHT = 0.080  # [m]; of the distal end above the load cell
_DISTAL_RADIUS = 0.046  # [m]; of the wall at the distal end
_SIN, _COS = math.sin(math.radians(6.0)), math.cos(math.radians(6.0))  # of the taper
_REACH = 0.047  # [m]; largest distance between neighbours
_CLUSTERS = {"brim_lateral": 53, "mid_anterior": 28, "posterior_distal": 4, "distal": 62}


def ring_socket() -> SocketGeometry:
    """A right circular cone, open at the top, standing on the load cell; x is anterior."""
    names, places, frames = [], [], []
    for ring in range(_RINGS):
        along = (ring + 0.75) * _PITCH
        radius = _DISTAL_RADIUS + along * _SIN
        count = int(2.0 * math.pi * radius / _PITCH)
        for place in range(count):
            angle = 2.0 * math.pi * place / count
            outward = np.array([math.cos(angle), math.sin(angle), 0.0])
            inward = np.array([0.0, 0.0, _SIN]) - _COS * outward
            proximal = np.array([0.0, 0.0, _COS]) + _SIN * outward
            names.append(f"ring{ring + 1}_{place + 1:02d}")
            places.append(radius * outward + [0.0, 0.0, _DISTAL_HEIGHT + along * _COS])
            frames.append(np.column_stack([proximal, np.cross(inward, proximal), inward]))
    for place, (x, y) in enumerate([(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)]):
        names.append(f"end_{place + 1}")
        places.append(np.array([x * _PITCH, y * _PITCH, _DISTAL_HEIGHT]))
        frames.append(np.eye(3))  # on the end no tangent is proximal: x is anterior
    anchors, rotations = np.array(places), np.array(frames)
    for cluster, tile in _CLUSTERS.items():
        names[tile] = cluster
    near = np.linalg.norm(anchors[:, None] - anchors, axis=2) < _REACH
    alike = rotations[:, :, 2] @ rotations[:, :, 2].T > -0.2
    turns = Rotation.from_rotvec(np.radians([[0.0, 0.0, 90.0], [0.0, 0.0, -30.0]])).as_matrix()
    return SocketGeometry(
        names=tuple(names),
        anchors=anchors,
        rotations=rotations,
        areas=np.full(len(names), _TILE**2),
        neighbours=np.argwhere(np.triu(near & alike, 1)),
        clusters=_CLUSTERS,
        socket_markers=np.array([[0.0, 0.0, 0.0], [0.090, 0.0, 0.0], [0.025, 0.050, 0.0]]),
        pylon_markers=np.array([[0.0, 0.0, 0.0], [0.110, 0.0, 0.010], [0.040, 0.075, 0.0]]),
        socket_body=Pose(turns[0], np.array([0.080, -0.030, 0.150])),
        limb=Pose(turns[1], np.array([-0.045, -0.030, -0.220])),
    )
