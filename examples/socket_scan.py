"""A synthetic scan of a socket's interior.

    python examples/socket_scan.py SCAN.stl [EDGE]

The shape is a transtibial socket for the left leg: narrower towards a domed end, flattened behind,
with the crest of the shin, the bar below the kneecap, and a brim cut lower behind the knee. It has
the scanner's axes, millimetres as its unit, and noise on the vertices.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from socket_testbed.arrays import FloatArray
from socket_testbed.files import atomic_output

_END = 46.0  # [mm]; radius of the wall above the domed end
_TAPER = 0.10  # [-]; growth of the radius along the wall
_DOME = 38.0  # [mm]; height of the domed end
_BRIM = 225.0  # [mm]; mean height of the brim
_EDGE = 2.6  # [mm]; of a triangle
_NOISE = 0.12  # [mm]; of a vertex
# The scanner's y axis points up, its z axis roughly anterior; the socket is slightly tilted.
_SCANNER = Rotation.from_matrix([[0, 1, 0], [0, 0, 1], [1, 0, 0]]) * Rotation.from_euler(
    "xy", [4.0, -3.0], degrees=True
)
_OFFSET = np.array([34.0, -18.0, 410.0])  # [mm]; from the scanner's origin


def make_socket_scan(edge: float = _EDGE) -> trimesh.Trimesh:
    """The scanned interior of the socket in mm; normals point outwards, as from many tools.

    `edge` is the length of a triangle's edge [mm]. The noise of the vertices is at most 5 % of it.
    """
    rng, noise = np.random.default_rng(0), min(_NOISE, 0.05 * edge)
    # Mesh a flat disc of points, with radius = distance from the middle of the end up the wall,
    # then shape it: the triangles are irregular and there is no seam.
    reach = _BRIM + _END
    rings = np.arange(0.0, reach, edge)
    disc = [np.zeros((1, 2))]
    for ring, way in enumerate(rings[1:]):
        count = int(2.0 * np.pi * _END / edge) if way > _END else int(2.0 * np.pi * way / edge)
        angle = 2.0 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / count
        angle = angle + rng.uniform(-0.2, 0.2, count) * 2.0 * np.pi / count
        disc.append(np.column_stack([way * np.cos(angle), way * np.sin(angle)]))
    points = np.vstack(disc)
    faces = Delaunay(points).simplices
    vertices = _shape(np.linalg.norm(points, axis=1), np.arctan2(points[:, 1], points[:, 0]))
    vertices += rng.normal(0.0, noise, vertices.shape)
    mesh = trimesh.Trimesh(_SCANNER.apply(vertices) + _OFFSET, faces, process=False)
    mesh.fix_normals()
    return mesh


def _shape(way: FloatArray, angle: FloatArray) -> FloatArray:
    """Vertices from distance along the surface and angle from anterior, shape (v, 3) [mm]."""
    along = np.maximum(way - _END, 0.0) / _BRIM  # 0 at the end of the wall, 1 at the brim
    brim = _BRIM + 12.0 * np.cos(2.0 * angle) - 14.0 * np.cos(angle + np.pi) ** 4 * _behind(angle)
    in_dome = np.minimum(way / _END, 1.0)
    height = np.where(
        way < _END, _DOME * (1.0 - np.sqrt(1.0 - 0.995 * in_dome**2)), _DOME + along * brim
    )
    radius = np.where(way < _END, _END * in_dome, _END + _TAPER * along * brim)
    wall = np.clip(along * 6.0, 0.0, 1.0)
    crest = 3.5 * np.exp(-(((angle - 0.2) / 0.22) ** 2)) * (1.0 - along)
    flat = -4.0 * _behind(angle) * np.sin(np.pi * np.clip(along, 0.0, 1.0))
    bar = -5.0 * np.exp(-((angle / 0.5) ** 2) - (((along - 0.72) / 0.07) ** 2))
    flare = 9.0 * np.clip((along - 0.9) / 0.1, 0.0, 1.0) ** 2
    radius = radius + wall * (crest + flat + bar + flare)
    x, y = radius * np.cos(angle), 0.94 * radius * np.sin(angle)
    return np.column_stack([x + 0.03 * height, y, height])


def _behind(angle: FloatArray) -> FloatArray:
    """1 straight behind, falling to 0 at the sides, shape (v,) [-]."""
    return np.maximum(-np.cos(angle), 0.0) ** 2


def main() -> None:
    """Write the scan to a file."""
    path, *edge = sys.argv[1:] or ["scan.stl"]
    mesh = make_socket_scan(*map(float, edge))
    with atomic_output(Path(path)) as output:
        mesh.export(output, file_type="stl")
    print(f"{path}: {len(mesh.faces)} faces, in mm")


if __name__ == "__main__":
    main()
