"""Tilings judged by points drawn on the surface; clusters, proposals for them, the load cell."""

import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation
from support import meshes
from support.problems import GEOMETRY, wall_frame

from socket_testbed.errors import ConfigurationError, RegistrationError
from socket_testbed.geometry.pose import Pose
from socket_testbed.socket_design import clusters
from socket_testbed.socket_design.design import place_by_landmarks, place_by_points
from socket_testbed.socket_design.squares import (
    Squares,
    Surroundings,
    overlapping,
    rim_points,
    spread_points,
    squares_at,
)
from socket_testbed.socket_design.tiling import Tiling, TilingSettings, tile_interior

Z = np.array([0.0, 0.0, 1.0])
X = np.array([1.0, 0.0, 0.0])


WALL = meshes.open_cone(0.05, 0.05, 0.12, 0.004, closed=False)


def wall(angle: float, height: float, off: float = 0.0) -> np.ndarray:
    """A point beside the cylinder, off it towards the axis."""
    return np.array([(0.05 - off) * math.cos(angle), (0.05 - off) * math.sin(angle), height])


def frame_at(angle: float, turned: float = 0.0) -> np.ndarray:
    """The frame of a cluster on the cylinder, turned about the inward normal."""
    outwards, tile = wall_frame(angle, 0.0)
    return Rotation.from_rotvec(-turned * outwards).as_matrix() @ tile


def asked_at(centre, frame=None, name="distal") -> clusters.ClusterPlace:
    return clusters.ClusterPlace(name, centre, frame, f"{name}'s")


@cache
def bare_wall() -> tuple[Squares, Surroundings]:
    """Squares all over the wall, and what surrounds them."""
    rng = np.random.default_rng(2)
    centres, points = spread_points(WALL, 0.001, rng), spread_points(WALL, 0.0025, rng)
    surroundings = Surroundings(points, rim_points(WALL, 0.0005), Z, X)
    return squares_at(centres, surroundings, 0.03), surroundings


def test_overlaps_are_found_beyond_a_block() -> None:
    """Squares on a space diagonal, corner to corner: 26 mm apart, in one block, then 42 mm.

    Squares of 30 mm overlap along their diagonal up to 42.4 mm.
    """
    along, normal = np.array([1.0, 1.0, 1.0]) / np.sqrt(3.0), np.array([1.0, -1.0, 0.0])
    normal /= np.sqrt(2.0)
    across = np.cross(normal, along)
    x = (along + across) / np.sqrt(2.0)
    frame = np.column_stack([x, np.cross(normal, x), normal])
    anchors = np.outer([0.0, 0.026, 0.026 + 0.042], along)
    squares = Squares(anchors, np.tile(frame, (3, 1, 1)), 0.03)
    found = overlapping(squares, np.arange(3), 0.0)
    assert [sorted(others.tolist()) for others in found] == [[0, 1], [0, 1, 2], [1, 2]]


def lay(*places: clusters.ClusterPlace) -> tuple[Squares, list[clusters.LaidCluster]]:
    others, surroundings = bare_wall()
    return clusters.lay_clusters(WALL, places, others, surroundings, 0.008)


@pytest.mark.parametrize("is_turned", [False, True], ids=["upright", "turned"])
def test_a_cluster_stays_where_it_is_glued(rng, is_turned: bool) -> None:
    """And as it is turned."""
    for angle, turned in rng.uniform(-math.pi, math.pi, (3, 2)):
        asked = wall(angle, rng.uniform(0.03, 0.09), off=rng.uniform(-0.003, 0.003))
        nearest = trimesh.proximity.closest_point(WALL, asked[None])[0][0]
        frame = frame_at(angle, turned if is_turned else 0.0)
        squares, (laid,) = lay(asked_at(asked, frame if is_turned else None))
        assert np.linalg.norm(squares.anchors[0] - nearest) < 1e-9 and laid.moved == 0.0
        expected = turned if is_turned else 0.0
        assert laid.turned == pytest.approx(expected, abs=math.radians(1.0))
        # Its square is turned with it: the sensor's edges are its own.
        assert np.abs(squares.rotations[0] - frame).max() < 0.04


@pytest.mark.parametrize(
    ("height", "laid_at"),
    [pytest.param(0.11, 0.105, id="proximal"), pytest.param(0.01, 0.015, id="distal")],
)
def test_a_cluster_over_the_brim_is_moved(height: float, laid_at: float) -> None:
    squares, (laid,) = lay(asked_at(wall(1.0, height)))
    assert squares.anchors[0, 2] == pytest.approx(laid_at, abs=0.0015)
    assert 0.004 < laid.moved < 0.008


ON_WALL = wall(0.0, 0.06)


@pytest.mark.parametrize(
    ("places", "words"),
    [
        pytest.param(
            [asked_at(np.array([0.5, 0.0, 0.05]))],
            "distal's: is 450 mm from the interior",
            id="far-away",
        ),
        pytest.param(
            [asked_at(ON_WALL, name="a"), asked_at(wall(0.3, 0.06), name="b")],
            "b's: overlaps a, their centres are 14.9 mm apart",
            id="overlapping",
        ),
        pytest.param(
            [asked_at(ON_WALL, frame_at(0.8))],
            "distal's: its z is 4[0-9] deg off the inward normal",
            id="off-the-normal",
        ),
    ],
)
def test_a_cluster_that_cannot_be_laid_is_refused(places, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        lay(*places)


LOAD_CELL = 1e-3 * np.array([[0, 0, 0], [50, 0, 0], [10, 20, 0], [0, -60, 300], [0, 100, 200]])
SCAN = 1e3 * Rotation.random(random_state=8).apply(LOAD_CELL + np.array([0.3, 0.1, -0.2]))  # [mm]


def place(scan: np.ndarray, path: Path) -> Pose:
    pairs = enumerate(zip(scan.tolist(), LOAD_CELL.tolist(), strict=True))
    places = {f"L{i}": {"scan": picked, "load_cell": known} for i, (picked, known) in pairs}
    path.write_text(yaml.safe_dump({"landmarks": places}))
    return place_by_landmarks(path, 1e-3).scan_in_load_cell


def test_landmarks_place_a_scan(tmp_path: Path) -> None:
    assert place(SCAN, tmp_path / "l.yaml").apply(1e-3 * SCAN) == pytest.approx(LOAD_CELL)


def test_three_points_place_a_scan() -> None:
    pose = place_by_points(1e-3 * SCAN[:3]).scan_in_load_cell
    assert pose.apply(1e-3 * SCAN) == pytest.approx(LOAD_CELL)


def test_landmarks_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RegistrationError, match=r"l\.yaml"):
        off = np.random.default_rng(8).normal(0.0, 30.0, SCAN.shape)
        place(SCAN + off, tmp_path / "l.yaml")


def test_each_further_cluster_lowers_the_error() -> None:
    """Those that are there stay."""
    stay = [GEOMETRY.clusters["distal"], 40]
    allowed = np.arange(len(GEOMETRY)) < 60
    found = clusters.place_clusters(GEOMETRY, 6, stay, allowed)
    tiles = found.tiles.tolist()
    assert tiles[:2] == stay and len(set(tiles)) == 6 and max(tiles[2:]) < 60
    errors = [found.errors[count] for count in range(2, 7)]
    assert errors == sorted(errors, reverse=True) and 0.0 < errors[-1] < errors[0] < 1.0
    low, high = found.at_random
    assert errors[-1] < high and low < high
    fewer = clusters.place_clusters(GEOMETRY, 3, stay, allowed)
    assert fewer.tiles.tolist() == tiles[:3]
    assert fewer.errors[3] == pytest.approx(found.errors[3])


# --- Whole tilings

FEW = TilingSettings(rounds=12)
EDGE = FEW.edge


def tile(mesh: trimesh.Trimesh) -> Tiling:
    return tile_interior(mesh, Z, X, FEW)


def prism(side: float, height: float) -> trimesh.Trimesh:
    """Four walls with sharp corners, the normals into it."""
    box = trimesh.creation.box((side, side, height))
    walls = np.abs(box.face_normals[:, 2]) < 0.5
    mesh = trimesh.Trimesh(box.vertices + 0.5 * height * Z, box.faces[walls][:, ::-1])
    for _ in range(5):
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


@pytest.mark.slow
@pytest.mark.parametrize("name", SURFACES)
def test_tiles_keep_the_contract(name: str) -> None:
    mesh, tiling = SURFACES[name], tiling_of(name)
    check_tiles(mesh, tiling)
    anchors, frames = tiling.squares.anchors, tiling.squares.rotations
    if name == "cylinder":  # nearly rings, of chords of one edge
        around = math.floor(math.pi / math.asin(0.5 * EDGE / 0.05))
        assert len(anchors) >= 0.9 * around * math.floor(0.095 / EDGE)
    if name == "dome":  # the same seed gives the same tiles
        np.testing.assert_array_equal(tile(mesh).squares.anchors, anchors)
    assert np.abs(np.swapaxes(frames, 1, 2) @ frames - np.eye(3)).max() < 1e-9
    assert np.allclose(np.linalg.det(frames), 1.0)
    x, z = frames[:, :, 0], frames[:, :, 2]
    _, off, nearest = trimesh.proximity.closest_point(mesh, anchors)
    assert off.max() < 1e-6
    assert np.einsum("ti,ti->t", z, mesh.face_normals[nearest]).min() > math.cos(0.25)
    on_wall = np.abs(z @ Z) < math.cos(math.radians(10.0))
    tangent = Z - (z @ Z)[:, None] * z
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    assert np.allclose(x[on_wall], tangent[on_wall])
    assert np.all(x[~on_wall] @ X > 0.98)
    # Tiles that touch on one wall are neighbours, and those are close by.
    pairs, apart = tiling.neighbours, np.linalg.norm(anchors[:, None] - anchors[None], axis=2)
    assert np.all(pairs[:, 0] < pairs[:, 1]) and len(np.unique(pairs, axis=0)) == len(pairs)
    assert apart[tuple(pairs.T)].min() > 0.9 * EDGE and apart[tuple(pairs.T)].max() < 2.2 * EDGE
    touching = np.argwhere(np.triu((apart < 1.05 * EDGE) & (z @ z.T > 0.5), 1))
    assert set(map(tuple, touching.tolist())) <= set(map(tuple, pairs.tolist()))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "name"),
    [pytest.param(0, "dome", id="dome"), pytest.param(1, "cylinder", id="cylinder")],
)
def test_tiles_are_laid_around_the_clusters(seed: int, name: str) -> None:
    mesh, rng = SURFACES[name], np.random.default_rng(seed)
    low, high = mesh.bounds[:, 2] + [0.025, -0.025]
    angles = rng.uniform(0.0, 1.0) + np.arange(3) * 2.0 * math.pi / 3.0
    heights = rng.uniform(low, high, 3)
    radius = 0.045 + rng.uniform(-0.003, 0.003, 3)  # beside the wall, as a sensor is thick
    asked = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), heights])
    nearest = trimesh.proximity.closest_point(mesh, asked)[0]
    places = [clusters.ClusterPlace(f"c{i}", p, None, f"c{i}") for i, p in enumerate(asked)]
    tiling = tile_interior(mesh, Z, X, FEW, clusters=places)
    assert [laid.name for laid in tiling.clusters] == ["c0", "c1", "c2"]
    assert np.linalg.norm(tiling.squares.anchors[:3] - nearest, axis=1).max() < 1e-4
    check_tiles(mesh, tiling)
    # Sensors anywhere break the rows of the densest tiling: at most two tiles each.
    assert len(tiling.squares) >= len(tiling_of(name).squares) - 6
