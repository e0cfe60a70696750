"""Poses, and the socket: its bodies, forces, file, axis and regions."""

import dataclasses

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support.damage import changed
from support.problems import GEOMETRY, random_pose, random_socket, ring_socket
from support.wording import refused

from socket_testbed.errors import ConfigurationError
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.regions import all_regions, anatomical_regions, socket_axis
from socket_testbed.geometry.socket import HEIGHTS, ScanFrame, read_socket, write_socket


def homogeneous(pose: Pose) -> np.ndarray:
    """Poses as 4 x 4 matrices, (4, 4) or (N, 4, 4)."""
    matrix = np.zeros((*pose.rotation.shape[:-2], 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = pose.rotation, pose.translation, 1
    return matrix


@pytest.mark.parametrize("length", [5e-324, 1e-200, 1e200, 1e300, 1.7e308])
def test_a_quaternion_of_extreme_length_is_a_rotation(length: float) -> None:
    """A half turn about x; squares of its components under- or overflow."""
    pose = Pose.from_vector(np.array([0.1, 0.2, 0.3, length, 0.0, 0.0, 0.0]))
    assert pose.rotation == pytest.approx(np.diag([1.0, -1.0, -1.0]))


def test_quaternions_of_any_length_are_rotations(rng):
    quaternions = rng.normal(size=(200, 4)) * 10.0 ** rng.integers(-6, 7, (200, 1))
    quaternions[[3, 50, 199]] = [[0.0] * 4, [np.nan, 0.0, 0.0, 1.0], [np.inf, 0.0, 0.0, 1.0]]
    unusable = np.isin(np.arange(200), [3, 50, 199])
    with np.errstate(all="raise"):
        pose = Pose.from_quaternion(rng.normal(size=(200, 3)), quaternions)
    expected = Rotation.from_quat(quaternions[~unusable])  # x, y, z, w
    np.testing.assert_allclose(pose.rotation[~unusable], expected.as_matrix(), atol=3e-15, rtol=0.0)
    vectors = pose.rotation_vector()
    np.testing.assert_allclose(vectors[~unusable], expected.as_rotvec(), atol=1e-13)
    for values in (pose.rotation[:, 0], pose.quaternion(), vectors):
        np.testing.assert_array_equal(np.isnan(values).all(axis=1), unusable)
    back = Pose.from_vector(pose.vector)
    np.testing.assert_allclose(back.rotation, pose.rotation, atol=1e-14)


@pytest.mark.parametrize("count", [None, 25], ids=["single-poses", "25-poses"])
def test_limb_pose_composes_the_four_poses(rng, count: int | None):
    """Wherever the world is."""
    geometry = random_socket(rng)
    reach = 0.3 if count is None else 2.0  # [m]
    socket, pylon = random_pose(rng, reach, count), random_pose(rng, reach, count)
    found = geometry.limb_pose(socket, pylon)
    world_to_load_cell = homogeneous(geometry.socket_body) @ np.linalg.inv(homogeneous(socket))
    expected = world_to_load_cell @ homogeneous(pylon) @ homogeneous(geometry.limb)
    np.testing.assert_allclose(homogeneous(found), expected, atol=1e-13)
    move = random_pose(rng)
    moved = geometry.limb_pose(move @ socket, move @ pylon).translation
    np.testing.assert_allclose(moved, found.translation, atol=1e-13)
    back = socket.inverse().apply(socket.apply(pylon.translation))
    np.testing.assert_allclose(back, pylon.translation, atol=1e-14)


@pytest.mark.parametrize("unknown", [0, 1], ids=["socket", "pylon"])
def test_a_body_of_unknown_place_gives_no_pose(rng, unknown: int):
    geometry = random_socket(rng)
    bodies = random_pose(rng, 2.0, 25), random_pose(rng, 2.0, 25)
    bodies[unknown].rotation[:2], bodies[unknown].translation[:2] = np.nan, np.nan
    limb = geometry.limb_pose(*bodies)
    for values in (limb.translation, limb.rotation_vector()):
        np.testing.assert_array_equal(np.isnan(values).all(axis=1), np.arange(25) < 2)
        assert np.isfinite(values[2:]).all()


def test_a_cluster_s_force_is_area_times_stress(rng):
    # 20 kPa of compression on 9 cm^2 push the socket outwards with 18 N.
    stress = np.array([20_000.0, 1_000.0, -2_000.0])
    force = random_socket(rng).cluster_force("cluster_0", stress)
    np.testing.assert_allclose(force, [0.9, -1.8, -18.0], atol=1e-12)


@pytest.mark.parametrize("angle", [0.5 * np.pi, -2.5], ids=["quarter-turn", "backwards"])
def test_a_turned_cluster_s_force_turns_with_it(rng, angle: float):
    plain = random_socket(rng)
    stress = rng.normal(0.0, 1e4, (7, 3))
    stress[1] = np.nan
    geometry = dataclasses.replace(plain, turned={"cluster_1": angle})
    tile = geometry.clusters["cluster_1"]
    cluster_in_load_cell = geometry.square_frames()[tile]
    x_in_tile = geometry.rotations[tile].T @ cluster_in_load_cell[:, 0]
    assert x_in_tile == pytest.approx([np.cos(angle), np.sin(angle), 0.0], abs=1e-12)
    on_cluster = 9e-4 * np.column_stack([stress[:, 1], stress[:, 2], -stress[:, 0]])
    force = geometry.cluster_force("cluster_1", stress)
    np.testing.assert_allclose(  # the same force in {S}, whichever frame it comes from
        force @ geometry.rotations[tile].T, on_cluster @ cluster_in_load_cell.T, atol=1e-9
    )
    np.testing.assert_allclose(geometry.cluster_stress("cluster_1", force), stress, atol=1e-8)
    expected = plain.cluster_force("cluster_2", stress)
    np.testing.assert_array_equal(geometry.cluster_force("cluster_2", stress), expected)


# --- the file


def scanned_socket(rng):
    """A socket with a turned cluster, a region of its own and a scan."""
    plain = random_socket(rng, rings=3, columns=5, clusters=4)
    scan = ScanFrame(0.001, random_pose(rng))
    more = {"turned": {"cluster_1": 0.5 * np.pi}, "regions": {"heel": (3, 5)}, "scan": scan}
    return dataclasses.replace(plain, **more)


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda rng: random_socket(rng, rings=3, columns=5, clusters=4), id="plain"),
        pytest.param(scanned_socket, id="scanned"),
    ],
)
def test_a_socket_survives_its_file(rng, tmp_path, make):
    path, geometry = tmp_path / "socket.yaml", make(rng)
    write_socket(geometry, path)
    found = read_socket(path)
    for field in ("names", "clusters", "regions"):
        assert getattr(found, field) == getattr(geometry, field), field
    assert found.turned == pytest.approx(geometry.turned, abs=1e-9)
    arrays = ("anchors", "rotations", "areas", "neighbours", "socket_markers", "pylon_markers")
    for field in arrays:
        expected = getattr(geometry, field)
        np.testing.assert_allclose(getattr(found, field), expected, atol=1e-8, err_msg=field)
    for field in ("socket_body", "limb"):
        expected = homogeneous(getattr(geometry, field))
        own = homogeneous(getattr(found, field))
        np.testing.assert_allclose(own, expected, atol=1e-8, err_msg=field)
    assert (found.scan is None) == (geometry.scan is None)
    write_socket(found, tmp_path / "again.yaml")
    assert (tmp_path / "again.yaml").read_text() == path.read_text()


def test_the_frame_of_a_scan_survives(rng, tmp_path):
    path, geometry = tmp_path / "socket.yaml", scanned_socket(rng)
    write_socket(geometry, path)
    assert "turned: 90.0}" in path.read_text() and "unit: 0.001" in path.read_text()
    picked = rng.normal(0.0, 100.0, (5, 3))
    expected = geometry.scan.in_load_cell.apply(0.001 * picked)
    np.testing.assert_allclose(read_socket(path).scan.points(picked), expected, atol=1e-8)


LEFT_HANDED = np.diag([1.0, 1.0, -1.0]).tolist()
LINE = [[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.1, 0.0, 0.0]]
TILE = ("tiles", "tile_0_1")
TWICE = {"a": "tile_0_0", "b": "tile_0_0"}
BAD = {
    "left-handed-frame": (
        (*TILE, "frame"),
        LEFT_HANDED,
        "tile_0_1: frame is not a right-handed orthonormal",
    ),
    "anchor-in-mm": (
        (*TILE, "anchor"),
        [0.0, 0.0, 120.0],
        "anchor[2] is 120.0: give a number from -2 to 2",
    ),
    "anchor-in-mm-below": (
        (*TILE, "anchor"),
        [0.0, 0.0, -120.0],
        "anchor[2] is -120.0: give a number from -2 to 2",
    ),
    "unknown-tile": (
        ("clusters", "cluster_0"),
        "tile_0_x",
        "cluster_0: no tile 'tile_0_x': did you mean",
    ),
    "shared-tile": (("clusters",), TWICE, "on 'tile_0_0': give each its own tile"),
    "markers-on-a-line": (("bodies", "socket", "markers"), LINE, "the markers are on one line"),
    "region-socket": (("regions",), {"socket": ["tile_0_0"]}, "name of a standard region"),
    "region-unmeasured-wall": (
        ("regions",),
        {"unmeasured wall": ["tile_0_0"]},
        "name of a standard region",
    ),
}


@pytest.mark.parametrize(("place", "value", "error"), BAD.values(), ids=BAD)
def test_a_socket_that_cannot_be_is_refused(rng, tmp_path, place, value, error):
    path, document = tmp_path / "socket.yaml", random_socket(rng).to_document()
    path.write_text(yaml.safe_dump(changed(document, place, value)))
    with refused(ConfigurationError, str(path), error):
        read_socket(path)


# --- the axis, where a tile is in height and angle, and the regions about it

RINGS = ring_socket()


def test_tiles_in_rings_are_at_their_heights():
    """And at their angles and radii."""
    axis = socket_axis(RINGS)
    np.testing.assert_allclose(axis.proximal, [0.0, 0.0, 1.0], atol=0.03)
    anchors = RINGS.anchors[[name.startswith("ring") for name in RINGS.names]]
    expected = np.arctan2(anchors[:, 1], anchors[:, 0])
    turned = (axis.angles(anchors) - expected + np.pi) % (2.0 * np.pi) - np.pi
    np.testing.assert_allclose(turned, 0.0, atol=np.radians(4.0))
    heights = anchors[:, 2] - RINGS.anchors[:, 2].min()
    np.testing.assert_allclose(axis.heights(anchors), heights, atol=0.003)
    np.testing.assert_allclose(axis.radii(anchors), np.hypot(*anchors[:, :2].T), atol=0.004)


def test_the_axis_turns_with_the_socket():
    axis = socket_axis(RINGS)
    turn = Rotation.from_euler("xyz", [50.0, -70.0, 120.0], degrees=True).as_matrix()
    places = {"rotations": turn @ RINGS.rotations, "anchors": RINGS.anchors @ turn.T}
    turned = dataclasses.replace(RINGS, **places)
    own = socket_axis(turned)
    np.testing.assert_allclose(own.proximal, turn @ axis.proximal, atol=1e-12)
    heights = own.heights(turned.anchors)
    np.testing.assert_allclose(heights, axis.heights(RINGS.anchors), atol=1e-12)


@pytest.mark.parametrize(
    ("geometry", "side"),
    [
        pytest.param(GEOMETRY, "left", id="left"),
        pytest.param(GEOMETRY, None, id="no-side"),
        pytest.param(RINGS, "right", id="rings-right"),
    ],
)
def test_regions_share_the_tiles_out(geometry, side):
    regions = anatomical_regions(geometry, side)
    for group in (regions[:4], regions[4:7], regions[7:]):  # sectors, heights, both
        tiles = np.concatenate([region.tiles for region in group])
        np.testing.assert_array_equal(np.sort(tiles), np.arange(len(geometry)))


def test_regions_of_a_lab_come_before_the_socket():
    own = {"fibula head": (3, 5), "patellar tendon": (40,)}
    names = [region.name for region in all_regions(dataclasses.replace(RINGS, regions=own))]
    assert names[-4:] == ["fibula head", "patellar tendon", "unmeasured wall", "socket"]


def test_regions_are_where_their_names_say():
    centre = {r.name: RINGS.anchors[r.tiles].mean(axis=0) for r in anatomical_regions(RINGS)}
    assert centre["anterior middle"][0] > 0.03 > -0.03 > centre["posterior middle"][0]
    assert centre["left middle"][1] > 0.03 > -0.03 > centre["right middle"][1]
    for sector in ("anterior", "posterior", "left", "right"):
        heights = [centre[f"{sector} {height}"][2] for height in HEIGHTS]
        assert heights == sorted(heights, reverse=True), sector


def test_medial_is_left_on_a_right_leg():
    """And right on a left leg."""
    left_leg, right_leg, neither = (
        {r.name: r.tiles.tolist() for r in anatomical_regions(GEOMETRY, side)}
        for side in ("left", "right", None)
    )
    assert right_leg["medial"] == left_leg["lateral"] == neither["left"]
    assert right_leg["lateral"] == left_leg["medial"] == neither["right"]
