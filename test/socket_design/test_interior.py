"""The interior of sockets: known by their making, and real."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from support.meshes import (
    FULL,
    angle_between,
    assert_same_faces,
    moved,
    open_cone,
    shell,
    wavy,
    with_faces,
)

from socket_testbed.errors import ScanError
from socket_testbed.socket_design.interior import find_interior
from socket_testbed.socket_design.scan_file import read_scan

CONE = (0.04, 0.06, 0.2)  # distal radius, proximal radius, height [m]
EDGE = 0.008
WALL = 0.005
UP = np.array([0.0, 0.0, 1.0])

SHAPES = {
    "flat end": {},
    "tube": {"closed": False},
    "hole": {"hole": 0.008},
    "wide hole in a dome": {"dome": True, "hole": 0.02},
    "flared brim": {"dome": True, "flare": 0.02},
    "half": {"arc": np.pi},
    "third with a dome": {"dome": True, "arc": FULL / 3.0},
    "open along its side": {"closed": False, "arc": 5.2},
}


def inside_out(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return with_faces(mesh, mesh.faces[:, ::-1])


def check(scan: trimesh.Trimesh, inner: trimesh.Trimesh, up=UP, off: float = 1.0) -> None:
    """The interior of a scan is its inner wall, and its opening is up [deg]."""
    interior = find_interior(scan)
    assert_same_faces(interior.mesh, inner)
    assert angle_between(interior.proximal, up) < off


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_the_inner_wall_of_a_shell_is_kept_and_a_single_surface_whole(shape):
    cone, solid = open_cone(*CONE, EDGE, **shape), shell(*CONE, EDGE, WALL, **shape)
    for scan in (solid, cone, inside_out(cone)):
        check(scan, cone)


def test_walls_of_any_thickness_a_slanted_cut_and_a_long_solid_distal_end():
    for thickness in (0.0015, 0.015):
        check(shell(*CONE, 0.004, thickness, dome=True), open_cone(*CONE, 0.004, dome=True))
    inner, cut = open_cone(*CONE, EDGE, arc=4.0), shell(*CONE, EDGE, 0.01, arc=4.0)
    outer = slice(len(inner.vertices), None)  # turned, so that the cavity sees a face of the cut
    cut.vertices[outer] = Rotation.from_rotvec(0.1 * UP).apply(cut.vertices[outer])
    check(cut, inner, off=2.0)

    for shape in ({"hole": 0.01, "dome": True}, {"arc": np.pi}):
        inner = open_cone(*CONE, EDGE, **shape)
        low = inner.vertices[:, 2].min() - 1e-6

        def lengthened(points, low=low):
            """As printed with its adapter: the middle of the body is within the material."""
            return points - np.outer(0.12 * (points[:, 2] < low), UP)

        check(moved(shell(*CONE, EDGE, WALL, **shape), lengthened), inner)


def oval(points):
    return points * [1.35, 0.75, 1.0]


def pressed_in(points):
    """A bar across the front, as for the patellar tendon."""
    angle = np.arctan2(points[:, 1], points[:, 0])
    depth = 0.35 * np.exp(-(((points[:, 2] - 0.12) / 0.02) ** 2) - (angle / 0.5) ** 2)
    return points * (1.0 - np.outer(depth, [1.0, 1.0, 0.0]))


def test_sockets_that_are_not_round_or_are_shallow():
    for change in (oval, pressed_in):
        for shape in ({"dome": True}, {"dome": True, "arc": 3.6}):
            scan, inner = shell(*CONE, EDGE, WALL, **shape), open_cone(*CONE, EDGE, **shape)
            found = find_interior(moved(wavy(scan, 0.02), change))
            assert_same_faces(found.mesh, moved(wavy(inner, 0.02), change))
    for height in (0.01, 0.06):
        cone = (0.05, 0.06, height)
        scan = moved(shell(*cone, EDGE, WALL, dome=True), oval)
        check(scan, moved(open_cone(*cone, EDGE, dome=True), oval), off=2.0)


def test_noise_makes_no_holes(rng):
    clean, inner = shell(*CONE, 0.003, WALL, dome=True), open_cone(*CONE, 0.003, dome=True)
    shift = rng.normal(0.0, 0.0005, clean.vertices.shape)
    interior = find_interior(moved(clean, lambda points: points + shift))
    expected = moved(inner, lambda points: points + shift[: len(points)])
    assert_same_faces(interior.mesh, expected, 1e-3)
    assert "openings: 1, " in interior.notes[1]


def test_neither_the_pose_nor_the_order_of_the_faces_matters(rng):
    cone, solid = open_cone(*CONE, EDGE, arc=4.0), shell(*CONE, EDGE, WALL, arc=4.0)
    turn, shift = Rotation.random(random_state=5), rng.normal(0.0, 1.0, 3)
    inner = moved(cone, lambda points: turn.apply(points) + shift)
    for mesh in (cone, solid, inside_out(solid)):
        shuffled = with_faces(mesh, rng.permutation(mesh.faces))
        check(moved(shuffled, lambda points: turn.apply(points) + shift), inner, turn.apply(UP))


def test_a_window_is_an_opening_and_its_rim_is_no_wall():
    cone = open_cone(*CONE, 0.004, dome=True)
    place = cone.triangles_center - [0.05, 0.0, 0.1]
    inner = with_faces(cone, np.linalg.norm(place, axis=1) > 0.02)
    interior = find_interior(thickened(inner, WALL))
    assert_same_faces(interior.mesh, inner)
    assert "openings: 2, the brim first, 377, " in interior.notes[1]


def thickened(surface: trimesh.Trimesh, thickness: float) -> trimesh.Trimesh:
    """The surface, its offset outwards, and the strips between their boundaries."""
    count = len(surface.vertices)
    edges = surface.edges[trimesh.grouping.group_rows(surface.edges_sorted, require_count=1)]
    a, b = edges.T
    strips = [np.column_stack([b, a, a + count]), np.column_stack([b, a + count, b + count])]
    return trimesh.Trimesh(
        np.vstack([surface.vertices, surface.vertices - thickness * surface.vertex_normals]),
        np.vstack([surface.faces, surface.faces[:, ::-1] + count, *strips]),
        process=False,
    )


def test_a_ledge_that_shades_the_wall_makes_no_hole():
    def overhanging(points):
        ring = np.exp(-(((points[:, 2] - 0.06) / 0.012) ** 2))
        ledge = points * (1.0 - np.outer(0.3 * ring, [1.0, 1.0, 0.0]))
        return ledge - np.outer(0.02 * ring, UP)

    cone = moved(open_cone(*CONE, 0.003, dome=True), overhanging)
    solid = shell(*CONE, 0.003, WALL, dome=True)
    solid.vertices[: len(cone.vertices)] = cone.vertices
    for scan in (cone, solid):
        assert_same_faces(find_interior(scan).mesh, cone)


# --- real scans


def test_the_inner_wall_of_a_real_shell(shared_data: Path):
    body = read_scan(shared_data / "homebrew_socket" / "socket.STL", body="1").mesh
    interior = find_interior(body)
    mesh, thickness = interior.mesh, 0.007

    # A wall's thickness behind every face lies the body's surface, before it lies nothing.
    surface = cKDTree(trimesh.sample.sample_surface(body, 200_000, seed=1)[0])
    depth = thickness * mesh.face_normals
    assert surface.query(mesh.triangles_center - depth)[0].max() < 0.0015
    assert np.percentile(surface.query(mesh.triangles_center + depth)[0], 1) > 0.0055

    assert angle_between(interior.proximal, UP) < 8.0  # its wide end is up


def test_a_real_limb_is_kept_whole_and_separated_from_a_shell_around_it(shared_data: Path):
    path = shared_data / "ampscan" / "stl_file.stl"
    raw = trimesh.load_mesh(path)
    interior = find_interior(read_scan(path).mesh)
    assert interior.mesh.area == pytest.approx(1e-6 * raw.area, rel=1e-9)
    mesh = interior.mesh  # its normals point into the limb: test_tile.py
    assert angle_between(interior.proximal, UP) < 5.0
    assert "openings: 1, " in interior.notes[1]
    assert_same_faces(find_interior(thickened(mesh, 0.006)).mesh, mesh, 2e-3)


def test_the_more_open_end_is_proximal_and_equal_ends_need_a_direction():
    down = shell(0.06, 0.05, 0.2, EDGE, WALL, closed=False)
    bottle = shell(0.06, 0.04, 0.2, EDGE, WALL, hole=0.03)
    for scan, proximal in ((down, -UP), (bottle, UP)):
        assert angle_between(find_interior(scan).proximal, proximal) < 1.0
    tube = shell(0.05, 0.05, 0.2, EDGE, WALL, closed=False)
    with pytest.raises(ScanError, match=r"equally open.*--proximal"):
        find_interior(tube)
    # A given direction is kept; what the scan says against it is noted.
    cup, socket = open_cone(0.05, 0.05, 0.2, EDGE, closed=False), open_cone(*CONE, EDGE)
    whole = shell(*CONE, EDGE, WALL)
    for scan, inner, direction, words in (
        (tube, cup, [0.0, 0.0, -2.0], "decides"),
        (whole, socket, [0.0, 0.0, -3.0], "closed end, 180 deg"),
        (whole, socket, [1.0, 0.0, 1.0], "45 deg off"),
        (whole, socket, [0.1, 0.0, 1.0], ""),
    ):
        interior = find_interior(scan, np.array(direction))
        np.testing.assert_allclose(interior.proximal, direction / np.linalg.norm(direction))
        assert_same_faces(interior.mesh, inner)
        notes = [note for note in interior.notes if "direction" in note or "decides" in note]
        assert (words in notes[0]) if words else not notes


def test_scans_without_a_cavity_or_an_opening_are_refused(rng):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.08)
    plate = trimesh.creation.box((0.1, 0.13, 0.02)).subdivide().subdivide()
    noise = rng.normal(0.0, 5e-4, plate.vertices.shape)
    sheet = moved(with_faces(plate, plate.face_normals[:, 2] > 0.5), lambda points: points + noise)
    hollow = trimesh.util.concatenate([ball, inside_out(trimesh.creation.icosphere(4, 0.07))])
    for solid, words in (
        (ball, "has no cavity"),
        (plate, "has no cavity"),
        (sheet, "has no cavity"),
        (with_faces(ball, ball.triangles_center[:, 2] < -0.074), "has no cavity"),  # a dish
        (hollow, "closed"),
        (with_faces(ball, ball.triangles_center[:, 2] < 0.0795), "closed|equally open"),
    ):
        with pytest.raises(ScanError, match=words):
            find_interior(solid)
    bowl = with_faces(ball, ball.triangles_center[:, 2] < 0.0)
    assert any("no axis" in note for note in find_interior(bowl).notes)
    with pytest.raises(ScanError, match=r"closed.*cut the scan open"):
        find_interior(with_faces(ball, ball.triangles_center[:, 2] < 0.0795), UP)
