"""Tiles on surfaces of known shape, judged by points drawn on the surface independently."""

import math
from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support import meshes

from socket_testbed.socket_design.clusters import ClusterPlace
from socket_testbed.socket_design.tiling import Tiling, TilingSettings, tile_interior

pytestmark = pytest.mark.slow

PROXIMAL, ANTERIOR = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
FEW = TilingSettings(rounds=12)
EDGE = FEW.edge


def tile(mesh: trimesh.Trimesh, turned: Rotation | None = None) -> Tiling:
    turned = turned or Rotation.identity()
    mesh = trimesh.Trimesh(turned.apply(mesh.vertices), mesh.faces, process=False)
    return tile_interior(mesh, turned.apply(PROXIMAL), turned.apply(ANTERIOR), FEW)


def prism(side: float, height: float, subdivisions: int = 5) -> trimesh.Trimesh:
    """Four walls with sharp corners, the normals into it."""
    box = trimesh.creation.box((side, side, height))
    walls = np.abs(box.face_normals[:, 2]) < 0.5
    mesh = trimesh.Trimesh(box.vertices + 0.5 * height * PROXIMAL, box.faces[walls][:, ::-1])
    for _ in range(subdivisions):
        mesh = mesh.subdivide()
    return mesh


SURFACES = {
    "cylinder": meshes.open_cone(0.05, 0.05, 0.095, 0.004, closed=False),
    "cup": meshes.open_cone(0.046, 0.056, 0.075, 0.004),
    "dome": meshes.open_cone(0.045, 0.05, 0.05, 0.004, dome=True),
    "c_section": meshes.open_cone(0.055, 0.06, 0.09, 0.004, closed=False, arc=4.0),
    "holed": meshes.open_cone(0.055, 0.055, 0.04, 0.004, hole=0.010),
    "prism": prism(0.076, 0.070),
}


@cache
def tiling_of(name: str) -> Tiling:
    """The tiling of one of the surfaces, for all tests."""
    return tile(SURFACES[name])


def check_tiles(mesh: trimesh.Trimesh, tiling: Tiling) -> None:
    """No point drawn on the surface is under two tiles, and every tile is whole and flat."""
    points, face = trimesh.sample.sample_surface(mesh, 60_000, seed=7)
    squares, half, area = tiling.squares, 0.5 * tiling.squares.edge, mesh.area / len(points)
    local = (points[None] - squares.anchors[:, None]) @ squares.rotations
    facing = squares.rotations[:, :, 2] @ mesh.face_normals[face].T
    # The wall on the other side is under the square's column, too.
    under = (np.abs(local[:, :, :2]) < half).all(axis=2) & (facing > 0.0)
    under &= np.abs(local[:, :, 2]) < half
    assert under.sum(axis=0).max() == 1
    assert under.sum() * area == pytest.approx(tiling.footprint_areas.sum(), rel=0.03)
    # Projected onto the square, the surface under it has the square's area: no brim, hole or seam.
    projected = np.where(under, facing, 0.0).sum(axis=1) * area
    assert np.abs(projected - EDGE**2).max() < 5.0 * math.sqrt(area * EDGE**2)
    height = np.where(under, np.abs(local[:, :, 2]), 0.0).max(axis=1)
    assert np.all(height <= tiling.flatness + 1e-9)
    assert tiling.flatness.max() <= FEW.flatness
    assert len(squares) <= tiling.upper_bound


@pytest.mark.parametrize("name", SURFACES)
def test_tiles_share_nothing_and_keep_the_contract(name: str) -> None:
    mesh, tiling = SURFACES[name], tiling_of(name)
    check_tiles(mesh, tiling)
    anchors, frames = tiling.squares.anchors, tiling.squares.rotations
    if name == "dome":  # the same seed gives the same tiles
        np.testing.assert_array_equal(tile(mesh).squares.anchors, anchors)
    assert np.abs(np.swapaxes(frames, 1, 2) @ frames - np.eye(3)).max() < 1e-9
    assert np.allclose(np.linalg.det(frames), 1.0)
    x, z = frames[:, :, 0], frames[:, :, 2]
    _, off, nearest = trimesh.proximity.closest_point(mesh, anchors)
    assert off.max() < 1e-6
    assert np.einsum("ti,ti->t", z, mesh.face_normals[nearest]).min() > math.cos(0.25)
    on_wall = np.abs(z @ PROXIMAL) < math.cos(math.radians(10.0))
    tangent = PROXIMAL - (z @ PROXIMAL)[:, None] * z
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    assert np.allclose(x[on_wall], tangent[on_wall])
    assert np.all(x[~on_wall] @ ANTERIOR > 0.98)
    # Tiles that touch on one wall are neighbours, and those are close by.
    pairs, apart = tiling.neighbours, np.linalg.norm(anchors[:, None] - anchors[None], axis=2)
    assert np.all(pairs[:, 0] < pairs[:, 1]) and len(np.unique(pairs, axis=0)) == len(pairs)
    assert apart[tuple(pairs.T)].min() > 0.9 * EDGE and apart[tuple(pairs.T)].max() < 2.2 * EDGE
    touching = np.argwhere(np.triu((apart < 1.05 * EDGE) & (z @ z.T > 0.5), 1))
    assert set(map(tuple, touching.tolist())) <= set(map(tuple, pairs.tolist()))


def test_a_cylinder_is_tiled_as_by_rings() -> None:
    around = math.floor(math.pi / math.asin(0.5 * EDGE / 0.05))  # chords of one edge
    rings = math.floor(0.095 / EDGE)
    assert len(tiling_of("cylinder").squares) >= 0.9 * around * rings


def test_tiles_keep_to_one_wall_of_a_prism_however_coarse_its_mesh() -> None:
    for tiling in (tiling_of("prism"), tile(prism(0.076, 0.070, subdivisions=3))):
        assert len(tiling.squares) == 16
        assert tiling.flatness.max() < 1e-6


def test_turning_the_scan_changes_little() -> None:
    first, turned = tiling_of("cup"), tile(SURFACES["cup"], Rotation.random(random_state=1))
    assert abs(len(turned.squares) - len(first.squares)) <= 0.08 * len(first.squares)


def test_tiles_are_laid_around_the_clusters() -> None:
    for seed, name in enumerate(("dome", "cylinder")):
        mesh, rng = SURFACES[name], np.random.default_rng(seed)
        low, high = mesh.bounds[:, 2] + [0.025, -0.025]
        angles = rng.uniform(0.0, 1.0) + np.arange(3) * 2.0 * math.pi / 3.0
        heights = rng.uniform(low, high, 3)
        radius = 0.045 + rng.uniform(-0.003, 0.003, 3)  # beside the wall, as a sensor is thick
        asked = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), heights])
        nearest = trimesh.proximity.closest_point(mesh, asked)[0]
        places = [ClusterPlace(f"c{i}", point, None, f"c{i}") for i, point in enumerate(asked)]
        tiling = tile_interior(mesh, PROXIMAL, ANTERIOR, FEW, None, places)
        assert [laid.name for laid in tiling.clusters] == ["c0", "c1", "c2"]
        assert np.linalg.norm(tiling.squares.anchors[:3] - nearest, axis=1).max() < 1e-4
        check_tiles(mesh, tiling)
        # Sensors anywhere break the rows of the densest tiling: at most two tiles each.
        assert len(tiling.squares) >= len(tiling_of(name).squares) - 6
