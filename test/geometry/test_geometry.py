"""Poses, the socket's file, and the way from two marker bodies to q."""

import dataclasses

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support.damage import changed
from support.problems import random_pose, random_socket
from support.wording import refused

from socket_testbed.errors import ConfigurationError
from socket_testbed.geometry.pose import Pose, rotation_of, rotation_vectors, turned_quaternion
from socket_testbed.geometry.socket import ScanFrame, read_socket, write_socket


@pytest.fixture
def rng():
    return np.random.default_rng(2)


def homogeneous(pose: Pose) -> np.ndarray:
    """A single pose as a 4 x 4 matrix."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotation, pose.translation
    return matrix


def rows(pose: Pose) -> list[Pose]:
    """A batch as single poses."""
    return [Pose(R, t) for R, t in zip(pose.rotation, pose.translation, strict=True)]


# --- poses


def test_quaternions_give_back_the_rotation(rng):
    pose = random_pose(rng, count=50)
    back = Pose.from_quaternion(pose.translation, pose.quaternion())
    np.testing.assert_allclose(back.rotation, pose.rotation, atol=1e-14)
    np.testing.assert_array_equal(back.translation, pose.translation)


def test_quaternions_are_ordered_x_y_z_w():
    half = np.sqrt(0.5)
    quarter_turn_about_z = np.array([[0.0, 0.0, half, half]])
    pose = Pose.from_quaternion(np.zeros((1, 3)), quarter_turn_about_z)
    np.testing.assert_allclose(
        pose.apply(np.array([[1.0, 0.0, 0.0]])), [[0.0, 1.0, 0.0]], atol=1e-15
    )
    unit = pose.quaternion() * np.sign(pose.quaternion()[:, 3:])
    np.testing.assert_allclose(unit, quarter_turn_about_z, atol=1e-15)


def test_rotation_vectors_quaternions_and_matrices_are_scipy_s(rng):
    axes = rng.normal(size=(200, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.concatenate([[0.0, 1e-12, 1e-6, 3.1], rng.uniform(0.0, 3.1, 196)])
    turns = angles[:, None] * axes
    given = Rotation.from_rotvec(turns)
    np.testing.assert_allclose(rotation_vectors(given.as_matrix()), turns, atol=1e-13)
    for turn, expected in zip(turns, given, strict=True):
        np.testing.assert_allclose(
            rotation_of(expected.as_quat()), expected.as_matrix(), atol=1e-15
        )
        first = random_pose(rng).rotation
        product = (Rotation.from_matrix(first) * expected).as_quat()
        np.testing.assert_allclose(turned_quaternion(first, turn), product, atol=1e-14)


@pytest.mark.parametrize("factor", [-1.0, 7.0, 1e-6, -1e6])
def test_the_length_and_sign_of_a_quaternion_do_not_matter(rng, factor):
    quaternion = rng.normal(size=(20, 4))
    expected = Pose.from_quaternion(np.zeros((20, 3)), quaternion)
    found = Pose.from_quaternion(np.zeros((20, 3)), factor * quaternion)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-14)


def test_a_single_pose_behaves_like_a_batch_of_one(rng):
    batch = random_pose(rng, count=1)
    single = rows(batch)[0]
    np.testing.assert_allclose(single.quaternion(), batch.quaternion()[0], atol=1e-15)
    again = Pose.from_quaternion(single.translation, single.quaternion())
    np.testing.assert_allclose(again.rotation, single.rotation, atol=1e-14)


@pytest.mark.parametrize(
    "bad", [[np.nan] * 4, [0.0] * 4, [0.0, 0.0, np.nan, 1.0], [np.inf, 0.0, 0.0, 0.0]]
)
def test_an_unusable_quaternion_gives_no_pose_and_spoils_no_other(rng, bad):
    quaternion = rng.normal(size=(3, 4))
    expected = Rotation.from_quat(quaternion).as_matrix()
    quaternion[1] = bad
    pose = Pose.from_quaternion(np.zeros((3, 3)), quaternion)
    assert np.isnan(pose.rotation[1]).all()
    np.testing.assert_allclose(pose.rotation[[0, 2]], expected[[0, 2]], atol=1e-14)
    assert np.isnan(pose.quaternion()[1]).all()
    assert np.isfinite(pose.quaternion()[[0, 2]]).all()


@pytest.mark.parametrize("count", [None, 20])
def test_the_inverse_undoes_the_pose(rng, count):
    pose = random_pose(rng, count=count)
    points = rng.normal(size=pose.translation.shape)
    np.testing.assert_allclose(pose.inverse().apply(pose.apply(points)), points, atol=1e-14)
    both = pose @ pose.inverse()
    np.testing.assert_allclose(
        both.rotation, np.broadcast_to(np.eye(3), both.rotation.shape), atol=1e-14
    )
    np.testing.assert_allclose(both.translation, 0.0, atol=1e-14)


def test_composition_is_the_product_of_homogeneous_matrices(rng):
    a, b = random_pose(rng, count=10), random_pose(rng, count=10)
    for first, second, both in zip(rows(a), rows(b), rows(a @ b), strict=True):
        np.testing.assert_allclose(
            homogeneous(both), homogeneous(first) @ homogeneous(second), atol=1e-14
        )


def test_a_single_pose_composes_with_a_batch(rng):
    single, batch = random_pose(rng), random_pose(rng, count=4)
    for other, both in zip(rows(batch), rows(single @ batch), strict=True):
        np.testing.assert_allclose(
            homogeneous(both), homogeneous(single) @ homogeneous(other), atol=1e-14
        )


# --- from marker bodies to q, from stresses to forces


def test_limb_pose_composes_the_four_poses(rng):
    geometry = random_socket(rng)
    socket, pylon = random_pose(rng, 2.0, 25), random_pose(rng, 2.0, 25)
    found = geometry.limb_pose(socket, pylon)
    limb = homogeneous(geometry.limb)
    for pose, in_socket, in_pylon in zip(rows(found), rows(socket), rows(pylon), strict=True):
        world_to_load_cell = homogeneous(geometry.socket_body) @ np.linalg.inv(
            homogeneous(in_socket)
        )
        expected = world_to_load_cell @ homogeneous(in_pylon) @ limb
        np.testing.assert_allclose(homogeneous(pose), expected, atol=1e-13)
        turned = Rotation.from_rotvec(pose.rotation_vector()).as_matrix()
        np.testing.assert_allclose(turned, expected[:3, :3], atol=1e-13)


def test_limb_pose_does_not_depend_on_where_the_world_is(rng):
    geometry = random_socket(rng)
    socket, pylon, move = random_pose(rng, count=8), random_pose(rng, count=8), random_pose(rng)
    np.testing.assert_allclose(
        geometry.limb_pose(move @ socket, move @ pylon).translation,
        geometry.limb_pose(socket, pylon).translation,
        atol=1e-13,
    )


@pytest.mark.parametrize("lost", ["socket", "pylon"])
def test_limb_pose_is_unknown_where_a_body_is(rng, lost):
    geometry = random_socket(rng)
    poses = {"socket": random_pose(rng, count=3), "pylon": random_pose(rng, count=3)}
    poses[lost].rotation[1], poses[lost].translation[1] = np.nan, np.nan
    limb = geometry.limb_pose(poses["socket"], poses["pylon"])
    for values in (limb.translation, limb.rotation_vector()):
        np.testing.assert_array_equal(np.isnan(values).all(axis=1), [False, True, False])
        assert np.isfinite(values[[0, 2]]).all()


def test_cluster_force_is_the_area_times_shear_and_inward_pull(rng):
    geometry = random_socket(rng)
    pressure = np.array([20_000.0, 0.0, 0.0])  # [Pa], compression
    for name, tile in geometry.clusters.items():
        force = geometry.cluster_force(name, pressure)
        # 20 kPa on 9 cm^2 push the socket outwards, against the inward normal, with 18 N.
        np.testing.assert_allclose(
            geometry.rotations[tile] @ force, -18.0 * geometry.rotations[tile][:, 2], atol=1e-12
        )
        shear = geometry.cluster_force(name, np.array([0.0, 1_000.0, -2_000.0]))
        np.testing.assert_allclose(shear, [0.9, -1.8, 0.0], atol=1e-12)


@pytest.mark.parametrize("angle", [0.5 * np.pi, -2.5])
def test_the_force_of_a_turned_cluster_is_turned_into_its_tile_frame(rng, angle):
    geometry = dataclasses.replace(random_socket(rng), turned={"cluster_1": angle})
    tile, stress = geometry.clusters["cluster_1"], rng.normal(0.0, 1e4, (7, 3))
    cluster_in_load_cell = geometry.square_frames()[tile]
    x_in_tile = geometry.rotations[tile].T @ cluster_in_load_cell[:, 0]
    assert x_in_tile == pytest.approx([np.cos(angle), np.sin(angle), 0.0], abs=1e-12)
    on_cluster = 9e-4 * np.column_stack([stress[:, 1], stress[:, 2], -stress[:, 0]])
    force = geometry.cluster_force("cluster_1", stress)
    np.testing.assert_allclose(  # the same force in {S}, whichever frame it comes from
        force @ geometry.rotations[tile].T, on_cluster @ cluster_in_load_cell.T, atol=1e-9
    )
    np.testing.assert_allclose(geometry.cluster_stress("cluster_1", force), stress, atol=1e-8)
    for name in ("cluster_0", "cluster_2"):
        plain = random_socket(np.random.default_rng(0)).cluster_force(name, stress)
        np.testing.assert_array_equal(geometry.cluster_force(name, stress), plain)


def test_a_turned_cluster_and_the_scan_are_stored_and_may_be_missing(rng, tmp_path):
    scan = ScanFrame(0.001, random_pose(rng))
    plain = random_socket(rng)
    socket = dataclasses.replace(plain, turned={"cluster_1": 0.5 * np.pi}, scan=scan)
    write_socket(socket, tmp_path / "socket.yaml")
    text = (tmp_path / "socket.yaml").read_text()
    assert "turned: 90.0}" in text and "unit: 0.001" in text
    found = read_socket(tmp_path / "socket.yaml")
    assert found.clusters == socket.clusters
    assert found.turned == pytest.approx(socket.turned, abs=1e-9)
    picked = rng.normal(0.0, 100.0, (5, 3))
    expected = scan.in_load_cell.apply(0.001 * picked)
    np.testing.assert_allclose(found.scan.points(picked), expected, atol=1e-8)
    write_socket(plain, tmp_path / "old.yaml")
    old = read_socket(tmp_path / "old.yaml")
    assert old.turned == {} and old.scan is None


def test_cluster_force_takes_any_batch_and_keeps_what_is_missing(rng):
    geometry = random_socket(rng)
    name = next(iter(geometry.clusters))
    stress = rng.normal(0.0, 1e4, (4, 2, 3))
    stress[1, 0] = np.nan
    force = geometry.cluster_force(name, stress)
    assert force.shape == stress.shape
    np.testing.assert_array_equal(np.isnan(force).all(axis=2), np.isnan(stress).all(axis=2))


def test_the_sockets_of_these_tests_keep_the_frame_convention(rng):
    geometry = random_socket(rng, rings=3, columns=6)
    x, y, z = np.moveaxis(geometry.rotations, 2, 0)
    np.testing.assert_allclose(np.cross(z, x), y, atol=1e-14)
    assert (np.einsum("ni,ni->n", z[:, :2], geometry.anchors[:, :2]) < 0.0).all()  # inwards
    assert (x[:, 2] > 0.0).all()  # proximally


# --- the file


@pytest.mark.parametrize("seed", range(3))
def test_a_file_gives_back_what_was_written(tmp_path, seed):
    geometry = random_socket(np.random.default_rng(seed), rings=3, columns=5, clusters=4)
    path = tmp_path / "socket.yaml"
    write_socket(geometry, path)
    found = read_socket(path)
    assert found.names == geometry.names
    assert found.clusters == geometry.clusters
    np.testing.assert_array_equal(found.neighbours, geometry.neighbours)
    np.testing.assert_array_equal(found.areas, geometry.areas)
    for field in ("anchors", "rotations", "socket_markers", "pylon_markers"):
        np.testing.assert_allclose(getattr(found, field), getattr(geometry, field), atol=1e-8)
    for field in ("socket_body", "limb"):
        np.testing.assert_allclose(
            homogeneous(getattr(found, field)), homogeneous(getattr(geometry, field)), atol=1e-8
        )
    write_socket(found, tmp_path / "again.yaml")
    assert (tmp_path / "again.yaml").read_text() == path.read_text()


@pytest.fixture
def document(rng):
    return random_socket(rng).to_document()


def write_document(document, tmp_path):
    path = tmp_path / "socket.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return path


def test_a_pair_of_neighbours_may_be_given_twice(document, tmp_path):
    document["neighbours"] += [pair[::-1] for pair in document["neighbours"]]
    found = read_socket(write_document(document, tmp_path))
    np.testing.assert_array_equal(
        found.neighbours, np.unique(np.sort(found.neighbours, axis=1), axis=0)
    )


def test_tiles_may_be_numbered(document, tmp_path):
    number = {name: i for i, name in enumerate(document["tiles"])}
    document["tiles"] = {number[name]: tile for name, tile in document["tiles"].items()}
    document["neighbours"] = [[number[a], number[b]] for a, b in document["neighbours"]]
    document["clusters"] = {name: number[tile] for name, tile in document["clusters"].items()}
    found = read_socket(write_document(document, tmp_path))
    assert found.names == tuple(str(i) for i in range(len(number)))


LEFT_HANDED = np.diag([1.0, 1.0, -1.0]).tolist()
STRETCHED = np.diag([1.0, 1.0, 1.001]).tolist()
LINE = [[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.1, 0.0, 0.0]]
IN_MILLIMETRES_OF_NOTHING = [[0.0, 0.0, 0.0], [0.001, 0.0, 0.0], [0.0, 0.001, 0.0]]
TILE = ("tiles", "tile_0_1")


@pytest.mark.parametrize(
    ("place", "value", "error"),
    [
        ((*TILE, "frame"), LEFT_HANDED, "tile_0_1: frame is not a right-handed orthonormal"),
        ((*TILE, "frame"), STRETCHED, "frame is not a right-handed orthonormal frame (off by 0.00"),
        ((*TILE, "area"), 9.0, "area is 9.0: give a number from 1e-08 to 0.05: the area [m^2]"),
        ((*TILE, "anchor"), [0.0, 0.0, 120.0], "anchor[2] is 120.0: give a number from -2 to 2"),
        (("tiles",), {}, "tiles is an empty mapping: give 'key"),
        (("neighbours",), [["tile_0_0", "tile_0_9"]], "no tile 'tile_0_9': did you mean 'tile_0_"),
        (("neighbours",), [["tile_0_0", "tile_0_0"]], "give two different tiles"),
        (("neighbours",), [["tile_0_0"]], "neighbours[0] is a list of 1: give a list of 2"),
        (("clusters", "cluster_0"), "tile_0_x", "cluster_0: no tile 'tile_0_x': did you mean"),
        (("bodies", "socket", "markers"), LINE, "make a triangle of them"),
        (("bodies", "pylon", "markers"), IN_MILLIMETRES_OF_NOTHING, "with edges of 10 mm"),
        (("bodies", "pylon", "markers"), LINE[:2], "markers is a list of 2: give a list of 3 to 8"),
        (("bodies", "pylon", "limb_in_body", "rotation"), LEFT_HANDED, "rotation is not a right"),
    ],
)
def test_a_socket_that_cannot_be_is_refused(document, tmp_path, place, value, error):
    path = write_document(changed(document, place, value), tmp_path)
    with refused(ConfigurationError, str(path), error):
        read_socket(path)


def test_two_clusters_on_one_tile_are_refused(document, tmp_path):
    tile = document["clusters"]["cluster_0"]
    path = write_document(changed(document, ("clusters", "cluster_1"), tile), tmp_path)
    with refused(ConfigurationError, f"two clusters are on '{tile}': give each its own tile"):
        read_socket(path)
