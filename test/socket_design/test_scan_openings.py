"""The openings of a cavity: which is the brim, which way is proximal, and where there is none."""

import contextlib

import numpy as np
import pytest
import trimesh
from support.meshes import angle_between, assert_same_faces, open_cone, shell, with_faces

from socket_testbed.errors import ScanError
from socket_testbed.socket_design.interior import find_interior

CONE = (0.04, 0.06, 0.2)  # distal radius, proximal radius, height [m]
EDGE = 0.008
WALL = 0.005
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def inside_out(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def test_the_brim_comes_first_of_the_openings_and_lies_on_the_circle():
    interior = find_interior(shell(*CONE, 0.003, WALL, hole=0.01))
    brim, hole = (interior.mesh.vertices[loop] for loop in interior.openings)
    for loop, radius, height in ((brim, 0.06, 0.2), (hole, 0.01, 0.0)):
        np.testing.assert_allclose(np.hypot(loop[:, 0], loop[:, 1]), radius, atol=1e-9)
        np.testing.assert_allclose(loop[:, 2], height, atol=1e-9)
        around = np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1)
        assert around.sum() == pytest.approx(2.0 * np.pi * radius, rel=0.01)


def test_the_openings_are_all_boundary_vertices_once():
    mesh = find_interior(shell(*CONE, EDGE, WALL, hole=0.01)).mesh
    interior = find_interior(mesh)
    edges = mesh.edges[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    found = np.concatenate(interior.openings)
    assert len(found) == len(np.unique(found)) == len(np.unique(edges))


def test_the_wider_end_of_a_tube_is_proximal():
    down = shell(0.06, 0.05, 0.2, EDGE, WALL, closed=False)
    assert angle_between(find_interior(down).proximal, -UP) < 1.0


def test_a_narrow_brim_is_still_the_opening():
    bottle = shell(0.06, 0.04, 0.2, EDGE, WALL, hole=0.03)
    assert angle_between(find_interior(bottle).proximal, UP) < 1.0


def test_a_tube_with_equal_ends_needs_a_direction():
    tube = shell(0.05, 0.05, 0.2, EDGE, WALL, closed=False)
    with pytest.raises(ScanError, match=r"equally open.*--proximal"):
        find_interior(tube)
    for direction in (2.0 * UP, -UP):
        interior = find_interior(tube, direction)
        np.testing.assert_allclose(interior.proximal, direction / np.linalg.norm(direction))
        assert_same_faces(interior.mesh, open_cone(0.05, 0.05, 0.2, EDGE, closed=False))
        assert any("decides" in note for note in interior.notes)


@pytest.mark.parametrize(
    ("direction", "words"),
    [([0, 0, -3], "closed end, 180 deg"), ([1, 0, 1], "45 deg off"), ([0.1, 0, 1], None)],
)
def test_a_given_direction_is_kept_and_what_contradicts_it_is_noted(direction, words):
    interior = find_interior(shell(*CONE, EDGE, WALL), np.array(direction))
    np.testing.assert_allclose(interior.proximal, direction / np.linalg.norm(direction))
    assert_same_faces(interior.mesh, open_cone(*CONE, EDGE))
    notes = [note for note in interior.notes if "direction" in note]
    assert (words in notes[0]) if words else not notes


@pytest.mark.parametrize("direction", [[0, 0, 0], [0, np.nan, 1], [np.inf, 0, 0], [1, 2]])
def test_a_direction_that_is_none_is_refused(direction):
    with pytest.raises(ScanError, match="proximal direction"):
        find_interior(open_cone(*CONE, EDGE), np.array(direction, dtype=float))


def ball(radius: float = 0.08) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=radius)


def limb_cast() -> trimesh.Trimesh:
    """A solid with a flat top, as a closed cast of a limb."""
    return trimesh.creation.cylinder(radius=0.05, height=0.2).subdivide().subdivide()


@pytest.mark.parametrize(
    ("solid", "words"),
    [
        (ball(), "has no cavity"),
        (inside_out(ball()), "has no cavity"),
        (limb_cast(), "has no cavity"),
        (trimesh.creation.box((0.1, 0.13, 0.02)).subdivide().subdivide(), "has no cavity"),
        (trimesh.util.concatenate([ball(), inside_out(ball(0.07))]), "closed"),
        (with_faces(ball(), ball().triangles_center[:, 2] < 0.0795), "closed|equally open"),
    ],
    ids=["ball", "ball inside out", "cast", "plate", "hollow ball", "ball with a small hole"],
)
def test_what_has_no_cavity_or_no_opening_is_refused(solid, words):
    with pytest.raises(ScanError, match=words):
        find_interior(solid)


def test_nonsense_is_refused_or_survived(rng):
    for _ in range(10):
        faces = rng.integers(0, 30, (60, 3))
        plain = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
        soup = trimesh.Trimesh(rng.normal(0.0, 0.1, (30, 3)), faces[plain], process=False)
        tetrahedron = trimesh.Trimesh(
            rng.normal(0.0, 0.1, (4, 3)),
            [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]],
            process=False,
        )
        with pytest.raises(ScanError, match="no cavity"):
            find_interior(tetrahedron)
        with contextlib.suppress(ScanError):
            assert np.isfinite(find_interior(soup).mesh.vertices).all()


def test_a_nearly_closed_cavity_is_refused_even_with_a_direction():
    with pytest.raises(ScanError, match=r"closed.*cut the scan open"):
        find_interior(with_faces(ball(), ball().triangles_center[:, 2] < 0.0795), UP)


def test_a_half_ball_has_no_axis_that_stands_out_and_a_socket_has():
    bowl = with_faces(ball(), ball().triangles_center[:, 2] < 0.0)
    for scan, unclear in ((bowl, True), (open_cone(*CONE, EDGE), False)):
        interior = find_interior(scan)
        assert any("no axis" in note for note in interior.notes) == unclear
        assert not any("no axis" in note for note in find_interior(scan, UP).notes)
        assert interior.proximal @ UP > 0.0
