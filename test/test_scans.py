"""The interior of sockets: against surfaces that are known by their making, and on real scans."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from meshes import FULL, cavity_area, open_cone, shell, wavy, with_faces
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from socket_testbed.errors import ScanError
from socket_testbed.scans.interior import Interior, find_interior
from socket_testbed.scans.scan_file import read_scan

CONE = (0.04, 0.06, 0.2)  # distal radius, proximal radius, height [m]
EDGE = 0.008
WALL = 0.005
UP = np.array([0.0, 0.0, 1.0])

SHAPES = {
    "flat end": {},
    "dome": {"dome": True},
    "tube": {"closed": False},
    "hole": {"hole": 0.008},
    "wide hole in a dome": {"dome": True, "hole": 0.02},
    "flared brim": {"dome": True, "flare": 0.02},
    "half": {"arc": np.pi},
    "third with a dome": {"dome": True, "arc": FULL / 3.0},
    "open along its side": {"closed": False, "arc": 5.2},
    "flared half": {"flare": 0.015, "arc": np.pi},
}


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def moved(mesh: trimesh.Trimesh, change) -> trimesh.Trimesh:
    """The mesh with its vertices changed by a function."""
    return trimesh.Trimesh(change(mesh.vertices.copy()), mesh.faces, process=False)


def unmatched_area(found: trimesh.Trimesh, expected: trimesh.Trimesh) -> float:
    """Area of the faces, wound alike, that are in one of two meshes only, of the expected one."""
    area = 0.0
    for one, other in ((found, expected), (expected, found)):
        ours, theirs = (
            np.hstack([m.triangles_center, 0.01 * m.face_normals]) for m in (one, other)
        )
        area += one.area_faces[cKDTree(theirs).query(ours)[0] > 1e-6].sum()
    return area / expected.area


def assert_is(interior: Interior, expected: trimesh.Trimesh, tolerance: float = 0.0) -> None:
    assert unmatched_area(interior.mesh, expected) <= tolerance


def angle_to(direction: np.ndarray, other: np.ndarray) -> float:
    """Angle between unit vectors [deg]."""
    return float(np.degrees(np.arccos(np.clip(direction @ other, -1.0, 1.0))))


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_of_a_shell_the_inner_wall_is_kept_and_nothing_else(shape):
    solid = shell(*CONE, EDGE, WALL, **shape)
    assert solid.is_watertight
    interior = find_interior(solid)
    assert_is(interior, open_cone(*CONE, EDGE, **shape))
    assert angle_to(interior.proximal, UP) < 1.0


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("turned", [False, True])
def test_one_surface_is_kept_whole_with_its_normals_into_the_cavity(shape, turned):
    cone = open_cone(*CONE, EDGE, **shape)
    interior = find_interior(inside_out(cone) if turned else cone)
    assert_is(interior, cone)
    assert angle_to(interior.proximal, UP) < 1.0


@pytest.mark.parametrize("shape", [{}, {"dome": True}, {"closed": False}, {"arc": np.pi}])
def test_the_area_is_that_of_the_formula_and_the_wall_faces_the_axis(shape):
    mesh = find_interior(shell(*CONE, 0.003, WALL, **shape)).mesh
    assert mesh.area == pytest.approx(cavity_area(*CONE, **shape), rel=0.01)
    to_axis = np.array([0.0, 0.0, 0.1]) - mesh.triangles_center
    assert (np.einsum("ij,ij->i", mesh.face_normals, to_axis) > 0.0).all()


@pytest.mark.parametrize("thickness", [0.0015, 0.003, 0.015])
def test_walls_of_any_thickness(thickness):
    interior = find_interior(shell(*CONE, 0.004, thickness, dome=True))
    assert_is(interior, open_cone(*CONE, 0.004, dome=True))


@pytest.mark.parametrize("shape", [{}, {"hole": 0.018}, {"arc": np.pi}])
def test_a_long_solid_distal_end(shape):
    """As of a socket printed with its adapter: the middle of the body is within the material."""
    cup = (0.05, 0.05, 0.15)

    def lengthened(points):
        return points - np.outer(0.12 * (points[:, 2] < -1e-6), UP)

    interior = find_interior(moved(shell(*cup, EDGE, WALL, **shape), lengthened))
    assert_is(interior, open_cone(*cup, EDGE, **shape))
    assert angle_to(interior.proximal, UP) < 1.0


def test_a_channel_that_a_scan_sees_into_is_no_wall():
    solid = shell(*CONE, EDGE, 0.01, hole=0.008)
    cut = solid.triangles_center[:, 2] < -0.0099
    interior = find_interior(with_faces(solid, ~cut))
    assert_is(interior, open_cone(*CONE, EDGE, hole=0.008))


def oval(points):
    return points * [1.35, 0.75, 1.0]


def bent(points):
    return points + np.outer((points[:, 2] / 0.2) ** 2, [0.06, 0.02, 0.0])


def three_sided(points):
    angle = np.arctan2(points[:, 1], points[:, 0])
    return points * np.column_stack([*2 * [1.0 + 0.12 * np.cos(3.0 * angle)], np.ones(len(points))])


def pressed_in(points):
    """A bar across the front, as for the patellar tendon."""
    angle = np.arctan2(points[:, 1], points[:, 0])
    depth = 0.35 * np.exp(-(((points[:, 2] - 0.12) / 0.02) ** 2) - (angle / 0.5) ** 2)
    return points * np.column_stack([1.0 - depth, 1.0 - depth, np.ones(len(points))])


def slanted(points):
    along = np.clip(points[:, 2] / 0.2, 0.0, None)
    angle = np.arctan2(points[:, 1], points[:, 0])
    return points + np.outer(0.05 * along * np.cos(angle), UP)


@pytest.mark.parametrize("change", [oval, bent, three_sided, pressed_in, slanted])
@pytest.mark.parametrize("shape", [{"dome": True}, {"dome": True, "arc": 3.6}])
def test_sockets_that_are_not_round(change, shape):
    wave = lambda mesh: moved(wavy(mesh, 0.02), change)  # noqa: E731
    interior = find_interior(wave(shell(*CONE, EDGE, WALL, **shape)))
    assert_is(interior, wave(open_cone(*CONE, EDGE, **shape)))


@pytest.mark.parametrize("height", [0.01, 0.03, 0.06])
def test_shallow_oval_sockets(height):
    cone = (0.05, 0.06, height)
    interior = find_interior(moved(shell(*cone, EDGE, WALL, dome=True), oval))
    assert_is(interior, moved(open_cone(*cone, EDGE, dome=True), oval))
    assert angle_to(interior.proximal, UP) < 2.0


def test_a_half_ball_has_no_axis_that_stands_out_and_a_socket_has():
    bowl = with_faces(ball(), ball().triangles_center[:, 2] < 0.0)
    for scan, unclear in ((bowl, True), (open_cone(*CONE, EDGE), False)):
        interior = find_interior(scan)
        assert any("no axis" in note for note in interior.notes) == unclear
        assert not any("no axis" in note for note in find_interior(scan, UP).notes)
        assert interior.proximal @ UP > 0.0


@pytest.mark.parametrize("noise", [0.0002, 0.0005])
def test_noise_makes_no_holes(rng, noise):
    clean = shell(*CONE, 0.003, WALL, dome=True)
    shift = rng.normal(0.0, noise, clean.vertices.shape)
    inner = open_cone(*CONE, 0.003, dome=True)
    interior = find_interior(moved(clean, lambda points: points + shift))
    expected = moved(inner, lambda points: points + shift[: len(points)])
    assert_is(interior, expected, 1e-3)
    assert len(interior.openings) == 1


@pytest.mark.parametrize("make", [open_cone, lambda *a, **k: shell(*a, WALL, **k)])
@pytest.mark.parametrize("shape", [{"dome": True}, {"arc": 4.0}])
def test_neither_the_pose_nor_the_winding_nor_the_order_of_the_faces_matters(rng, make, shape):
    mesh, cone = (kind(*CONE, EDGE, **shape) for kind in (make, open_cone))
    turn, shift = Rotation.random(random_state=5), rng.normal(0.0, 1.0, 3)
    order = rng.permutation(len(mesh.faces))
    faces = mesh.faces[order]
    flip = rng.random(len(faces)) < 0.4
    faces = np.where(flip[:, None], faces[:, ::-1], faces)
    scan = trimesh.Trimesh(turn.apply(mesh.vertices) + shift, faces, process=False)
    interior = find_interior(scan)
    assert_is(interior, moved(cone, lambda points: turn.apply(points) + shift))
    assert angle_to(interior.proximal, turn.apply(UP)) < 1.0


def test_a_scan_that_rolls_over_the_brim_ends_there():
    solid, inner = shell(*CONE, 0.004, WALL, dome=True), open_cone(*CONE, 0.004, dome=True)
    outer = solid.faces.max(axis=1) >= len(inner.vertices)
    rolled = with_faces(solid, ~outer | (solid.triangles_center[:, 2] > 0.18))
    assert not rolled.is_watertight
    assert_is(find_interior(rolled), inner)


def test_holes_in_the_outer_wall_do_not_matter(rng):
    solid, inner = shell(*CONE, 0.004, WALL, dome=True), open_cone(*CONE, 0.004, dome=True)
    centres = solid.triangles_center
    outer = solid.faces.max(axis=1) >= len(inner.vertices)
    places = centres[rng.choice(np.flatnonzero(outer & (centres[:, 2] < 0.15)), 6)]
    missing = outer & (cKDTree(places).query(centres)[0] < 0.02)
    assert_is(find_interior(with_faces(solid, ~missing)), inner)


def test_a_window_is_an_opening_and_its_rim_is_no_wall():
    cone = open_cone(*CONE, 0.004, dome=True)
    place = cone.triangles_center - [0.05, 0.0, 0.1]
    inner = with_faces(cone, np.linalg.norm(place, axis=1) > 0.02)
    interior = find_interior(thickened(inner, WALL))
    assert_is(interior, inner)
    assert len(interior.openings) == 2


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


@pytest.mark.parametrize("height", [0.06, 0.15])
def test_a_ledge_that_shades_the_wall_makes_no_hole(height):
    def overhanging(points):
        ring = np.exp(-(((points[:, 2] - height) / 0.012) ** 2))
        inward = 1.0 - 0.3 * ring
        ledge = points * np.column_stack([inward, inward, np.ones(len(points))])
        return ledge - np.outer(0.02 * ring, UP)

    cone = moved(open_cone(*CONE, 0.003, dome=True), overhanging)
    for scan in (cone, thickened(cone, 0.002)):
        assert_is(find_interior(scan), cone)


def test_what_the_cavity_sees_besides_its_wall_is_left_out_and_noted():
    cone = open_cone(*CONE, EDGE, dome=True)
    liner = moved(open_cone(0.03, 0.04, 0.1, EDGE, closed=False), lambda p: p + 0.05 * UP)
    interior = find_interior(trimesh.util.concatenate([cone, liner]))
    assert_is(interior, cone)
    area = round(1e4 * liner.area)
    assert any(f"left out {area} cm2" in note for note in interior.notes)


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
    assert angle_to(find_interior(down).proximal, -UP) < 1.0


def test_a_narrow_brim_is_still_the_opening():
    assert angle_to(find_interior(shell(0.06, 0.04, 0.2, EDGE, WALL, hole=0.03)).proximal, UP) < 1.0


def test_a_tube_with_equal_ends_needs_a_direction():
    tube = shell(0.05, 0.05, 0.2, EDGE, WALL, closed=False)
    with pytest.raises(ScanError, match=r"equally open.*--proximal"):
        find_interior(tube)
    for direction in (2.0 * UP, -UP):
        interior = find_interior(tube, direction)
        np.testing.assert_allclose(interior.proximal, direction / np.linalg.norm(direction))
        assert_is(interior, open_cone(0.05, 0.05, 0.2, EDGE, closed=False))
        assert any("decides" in note for note in interior.notes)


@pytest.mark.parametrize(
    ("direction", "words"),
    [([0, 0, -3], "closed end, 180 deg"), ([1, 0, 1], "45 deg off"), ([0.1, 0, 1], None)],
)
def test_a_given_direction_is_kept_and_what_contradicts_it_is_noted(direction, words):
    interior = find_interior(shell(*CONE, EDGE, WALL), np.array(direction))
    np.testing.assert_allclose(interior.proximal, direction / np.linalg.norm(direction))
    assert_is(interior, open_cone(*CONE, EDGE))
    notes = [note for note in interior.notes if "direction" in note]
    assert (words in notes[0]) if words else not notes


@pytest.mark.parametrize("direction", [[0, 0, 0], [0, np.nan, 1], [np.inf, 0, 0], [1, 2]])
def test_a_direction_that_is_none_is_refused(direction):
    with pytest.raises(ScanError, match="proximal direction"):
        find_interior(open_cone(*CONE, EDGE), np.array(direction, dtype=float))


def ball(radius: float = 0.08) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=radius)


def inside_out(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


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
    for _ in range(20):
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


def test_the_inner_wall_of_a_real_shell(shared_data: Path):
    body = read_scan(shared_data / "homebrew_socket" / "socket.STL", body="1").mesh
    interior = find_interior(body)
    mesh, thickness = interior.mesh, 0.007

    # The whole is the inner wall, its offset, and the strip between them along their edge.
    offset = moved(mesh, lambda points: points - thickness * mesh.vertex_normals)
    (loop,) = (mesh.vertices[opening] for opening in interior.openings)
    strip = thickness * np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1).sum()
    assert mesh.area + offset.area + strip == pytest.approx(body.area, rel=0.01)

    # A wall's thickness behind every face lies the body's surface, before it lies nothing.
    surface = cKDTree(trimesh.sample.sample_surface(body, 200_000, seed=1)[0])
    depth = thickness * mesh.face_normals
    assert surface.query(mesh.triangles_center - depth)[0].max() < 0.0015
    assert np.percentile(surface.query(mesh.triangles_center + depth)[0], 1) > 0.0055

    # It faces the middle of the half shell; its wide end is up.
    assert (
        np.einsum("ij,ij->i", mesh.face_normals, middle(mesh) - mesh.triangles_center) > 0
    ).mean() > 0.99
    assert angle_to(interior.proximal, UP) < 8.0


def middle(mesh: trimesh.Trimesh) -> np.ndarray:
    """A point amid a half shell that opens towards -x, (3,) [m]."""
    low, high = mesh.bounds
    return np.array([low[0], *(0.5 * (low + high))[1:]])


def test_a_real_limb_is_kept_whole_and_turned_inside_out(shared_data: Path):
    path = shared_data / "ampscan" / "stl_file.stl"
    raw = trimesh.load_mesh(path)
    interior = find_interior(read_scan(path).mesh)
    assert interior.mesh.area == pytest.approx(1e-6 * raw.area, rel=1e-9)
    # Capped by any plane, normals that point out of the limb give a positive volume.
    top = raw.bounds[1]
    outwards = np.einsum("ij,ij->i", raw.triangles_center - top, raw.face_normals)
    assert (outwards * raw.area_faces).sum() > 0.0
    mesh = interior.mesh
    inwards = np.einsum("ij,ij->i", mesh.triangles_center - 1e-3 * top, mesh.face_normals)
    assert (inwards * mesh.area_faces).sum() < 0.0
    assert angle_to(interior.proximal, UP) < 5.0
    assert len(interior.openings) == 1
    assert mesh.vertices[interior.openings[0]][:, 2].min() > 0.03


def test_a_shell_around_a_real_limb_is_told_from_the_limb(shared_data: Path):
    limb = find_interior(read_scan(shared_data / "ampscan" / "stl_file.stl").mesh).mesh
    interior = find_interior(thickened(limb, 0.006))
    assert_is(interior, limb, 2e-3)
