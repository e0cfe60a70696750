"""Socket-like meshes whose areas are known: cups, shells with two walls, C-sections.

All lengths are in metres. The axis is z, +z is proximal, the wall's distal rim is at z = 0, and
vertices are welded. Surfaces are wound with their normals into the cavity, shells with their
normals out of the solid (so those of the inner wall point into the cavity, too).
"""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
FULL = 2.0 * math.pi


def open_cone(
    distal: float, proximal: float, height: float, edge: float, arc: float = FULL, **ends: float
) -> trimesh.Trimesh:
    """A wall with its distal end (see `_profile`), open at the top: one surface."""
    return _revolve([_profile(distal, proximal, height, edge, **ends)], edge, arc)


def shell(
    distal: float, proximal: float, height: float, edge: float, wall: float, arc=FULL, **ends: float
) -> trimesh.Trimesh:
    """A watertight shell whose inner wall is `open_cone` of the same arguments."""
    inner = _profile(distal, proximal, height, edge, **ends)
    return _revolve([inner, _offset(inner, wall)], edge, arc)


def scaled(mesh: trimesh.Trimesh, factor: float) -> trimesh.Trimesh:
    return moved(mesh, lambda points: points * factor)


def shifted(mesh: trimesh.Trimesh, x: float) -> trimesh.Trimesh:
    return moved(mesh, lambda points: points + np.array([x, 0.0, 0.0]))


def with_faces(mesh: trimesh.Trimesh, faces: np.ndarray) -> trimesh.Trimesh:
    """Other faces, (F, 3), or some of its own, by a mask, on the same vertices."""
    chosen = mesh.faces[faces] if faces.dtype == bool else faces
    return trimesh.Trimesh(mesh.vertices, chosen, process=False)


def assert_same_surface(mesh: trimesh.Trimesh, expected: trimesh.Trimesh) -> None:
    """Assert that two welded meshes are the same but for the order of their parts."""
    assert len(mesh.faces) == len(expected.faces)
    assert len(mesh.vertices) == len(expected.vertices)
    assert mesh.area == pytest.approx(expected.area, rel=1e-5)
    np.testing.assert_allclose(mesh.bounds, expected.bounds, atol=1e-7)
    assert mesh.is_winding_consistent


def moved(mesh: trimesh.Trimesh, change: Callable[[np.ndarray], np.ndarray]) -> trimesh.Trimesh:
    return trimesh.Trimesh(change(mesh.vertices.copy()), mesh.faces, process=False)


def assert_same_faces(mesh: trimesh.Trimesh, expected: trimesh.Trimesh, tolerance=0.0) -> None:
    """Assert that two meshes have the same faces, wound alike, but for a share of the area."""
    ours, theirs = (
        np.hstack([each.triangles_center, 0.01 * each.face_normals]) for each in (mesh, expected)
    )
    unmatched = mesh.area_faces[cKDTree(theirs).query(ours)[0] > 1e-6].sum()
    unmatched += expected.area_faces[cKDTree(ours).query(theirs)[0] > 1e-6].sum()
    assert unmatched <= tolerance * expected.area


def angle_between(direction: np.ndarray, other: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(direction @ other, -1.0, 1.0))))


def write_stl(mesh: trimesh.Trimesh, path: Path, unit: str = "mm", header: bytes = b"") -> Path:
    """Write a binary STL in a unit of `UNITS`."""
    with np.errstate(invalid="ignore"):  # a corner may be infinite
        content = scaled(mesh, 1.0 / UNITS[unit]).export(file_type="stl")
    path.write_bytes(header.ljust(80, b"\0") + content[80:])
    return path


def _profile(
    distal: float, proximal: float, height: float, edge: float, dome=False, closed=True, hole=0.0
) -> np.ndarray:
    """Points (r, z) of the inner wall from the axis, or the hole, to the brim, (M, 2)."""
    wall = _along([[distal, 0.0], [proximal, height]], edge)
    if not closed:
        return wall
    if dome:
        angles = np.arcsin(hole / distal), 0.5 * math.pi
        steps = max(2, round(distal * (angles[1] - angles[0]) / edge))
        angle = np.linspace(*angles, steps + 1)
        end = distal * np.column_stack([np.sin(angle), -np.cos(angle)])
    else:
        end = _along([[hole, 0.0], [distal, 0.0]], edge)
    return np.vstack([end[:-1], wall])


def _along(ends: list[list[float]], edge: float) -> np.ndarray:
    start, stop = np.array(ends)
    return np.linspace(start, stop, max(1, round(float(np.linalg.norm(stop - start)) / edge)) + 1)


def _offset(profile: np.ndarray, thickness: float) -> np.ndarray:
    """The profile of the outer wall, point for point, mitred at the corners, (M, 2)."""
    along = np.diff(profile, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    outward = np.column_stack([along[:, 1], -along[:, 0]])
    if profile[0, 0] == 0.0:
        outward[0] = [0.0, -1.0]
    before, after = np.vstack([outward[:1], outward]), np.vstack([outward, outward[-1:]])
    both = before + after
    return profile + thickness * both / (0.5 * (both**2).sum(axis=1))[:, None]


def _revolve(profiles: list[np.ndarray], edge: float, arc: float) -> trimesh.Trimesh:
    """A wall, or an inner and an outer wall joined at the brim, at a hole and at the cuts."""
    r, z = np.vstack([profiles[0], *(p[::-1] for p in profiles[1:])]).T[:, :, None]
    angle = np.linspace(0.0, arc, max(3, round(arc * profiles[0][:, 0].max() / edge)) + 1)
    angle = angle[:-1] if arc == FULL else angle
    points = np.stack(np.broadcast_arrays(r * np.cos(angle), r * np.sin(angle), z), axis=2)
    number = np.arange(r.size * len(angle)).reshape(r.size, -1)  # by ring and angle
    number = np.where(r > 1e-9, number, number[:, :1])
    rings = np.vstack([number, number[:1]]) if len(profiles) == 2 and r[0] > 1e-9 else number
    grids = [np.hstack([rings, rings[:, :1]]) if arc == FULL else rings]
    if len(profiles) == 2 and arc < FULL:
        inner, outer = number[: len(profiles[0])], number[len(profiles[0]) :][::-1]
        grids += [np.stack([outer, inner], 2)[:, 0], np.stack([inner, outer], 2)[:, -1]]
    faces = np.vstack([_triangles(grid) for grid in grids])
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    return trimesh.Trimesh(points.reshape(-1, 3)[used], faces.reshape(-1, 3), process=False)


def _triangles(grid: np.ndarray) -> np.ndarray:
    """Two triangles for each cell of a grid of vertices, (F, 3)."""
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]
    return np.concatenate([np.dstack([b, a, c]), np.dstack([c, d, b])]).reshape(-1, 3)
