"""Scans: files read, repaired or refused in one line, and the interior of sockets found in them."""

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from support import meshes
from support.meshes import assert_same_surface, moved, open_cone, shell, with_faces, write_stl
from support.wording import refused

from socket_testbed.errors import ScanError
from socket_testbed.socket_design.interior import find_interior
from socket_testbed.socket_design.scan_file import Scan, read_scan

CONE = (0.04, 0.06, 0.2)  # distal radius, proximal radius, height [m]
EDGE = 0.008  # [m]


@pytest.fixture
def cone() -> trimesh.Trimesh:
    return open_cone(*CONE, EDGE, dome=True)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "scan.stl"


def export(mesh: trimesh.Trimesh, path: Path, **options) -> Path:
    """Write a file with another program's writer, in mm."""
    data = meshes.scaled(mesh, 1000.0).export(**{"file_type": path.suffix[1:], **options})
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return path


def noted(scan: Scan, words: str) -> bool:
    return any(words in note for note in scan.notes)


WRITERS = {
    "a.stl": write_stl,
    "a.STL": lambda mesh, path: write_stl(mesh, path, header=b"solid socket"),
    "text.stl": lambda mesh, path: export(mesh, path, file_type="stl_ascii"),
    "a.ply": export,
    "text.PLY": lambda mesh, path: export(mesh, path, encoding="ascii"),
    "a.obj": export,
}


@pytest.mark.parametrize(("name", "write"), WRITERS.items(), ids=WRITERS)
def test_every_kind_of_file_gives_one_surface(cone, tmp_path, name, write):
    scan = read_scan(write(cone, tmp_path / name))
    assert_same_surface(scan.mesh, cone)
    assert (scan.unit, scan.unit_source) == ("mm", "inferred")
    assert len(scan.notes) == 2  # of its unit and its brim: nothing was repaired


def test_a_ply_may_be_called_stl(cone, path):
    scan = read_scan(export(cone, path, file_type="ply"))
    assert_same_surface(scan.mesh, cone)


def test_a_pointer_of_git_lfs_is_named(path):
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 9\n")
    with refused(ScanError, "is a Git LFS pointer", "git lfs pull"):
        read_scan(path)


@pytest.mark.parametrize("name", ["text.stl", "text.PLY"])
def test_a_text_may_lack_its_final_line_feed(cone, tmp_path, name: str):
    """And its solid may have any name."""
    path = WRITERS[name](cone, tmp_path / name)
    path.write_bytes(path.read_bytes().rstrip().replace(b"solid", b"solid vertex", 1))
    assert_same_surface(read_scan(path).mesh, cone)


@pytest.mark.parametrize("name", [name for name in WRITERS if name != "a.obj"])
def test_a_file_cut_anywhere_is_refused(cone, tmp_path, rng, name: str):
    """But an OBJ, which does not state its length."""
    path = WRITERS[name](cone, tmp_path / name)
    data = path.read_bytes()
    for share in rng.random(4):
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(ScanError):
            read_scan(path)


SIZED = pytest.mark.parametrize("size", [0.45, 2.4], ids=["small", "large"])


def sized_cone(size: float) -> trimesh.Trimesh:
    return meshes.scaled(open_cone(*CONE, 0.03, dome=True), size)  # 0.24 m long at size 1


@SIZED
@pytest.mark.parametrize("unit", meshes.UNITS)
def test_a_unit_that_is_given_is_taken(path, unit: str, size: float):
    mesh = sized_cone(size)
    write_stl(mesh, path, unit)
    assert_same_surface(read_scan(path, unit=unit).mesh, mesh)


@SIZED
@pytest.mark.parametrize("unit", ["m", "mm"])
def test_metres_or_millimetres_are_inferred(path, unit: str, size: float):
    mesh = sized_cone(size)
    write_stl(mesh, path, unit)
    assert_same_surface(read_scan(path).mesh, mesh)
    assert noted(read_scan(path), f"inferred unit {unit}")


@SIZED
@pytest.mark.parametrize("unit", [unit for unit in meshes.UNITS if unit not in {"m", "mm"}])
def test_other_units_are_not_inferred(path, unit: str, size: float):
    write_stl(sized_cone(size), path, unit)
    with pytest.raises(ScanError, match=r"neither in m nor in mm.*--unit"):
        read_scan(path)


def stl_in_cm(cone: trimesh.Trimesh, folder: Path) -> Path:
    return write_stl(cone, folder / "a.stl", "cm", b"scanner X; units: cm")


def obj_in_cm(cone: trimesh.Trimesh, folder: Path) -> Path:
    scaled = meshes.scaled(cone, 0.1)
    return export(scaled, folder / "a.obj", header="File units = centimeters")


def ply_in_cm(cone: trimesh.Trimesh, folder: Path) -> Path:
    ply = export(meshes.scaled(cone, 0.1), folder / "a.ply")
    ply.write_bytes(ply.read_bytes().replace(b"\nelement", b"\ncomment unit cm\nelement", 1))
    return ply


@pytest.mark.parametrize("write", [stl_in_cm, obj_in_cm, ply_in_cm], ids=["stl", "obj", "ply"])
def test_a_unit_that_the_file_states_is_taken(cone, tmp_path, write):
    scan = read_scan(write(cone, tmp_path))
    assert_same_surface(scan.mesh, cone)
    assert (scan.unit, scan.unit_source) == ("cm", "stated")


def test_a_given_unit_outweighs_a_stated_one(cone, path):
    scan = read_scan(write_stl(cone, path, "mm", b"units: cm"), unit="mm")
    assert_same_surface(scan.mesh, cone)
    assert noted(scan, "states the unit cm")


def test_of_two_bodies_one_must_be_chosen(cone, path):
    pin = meshes.shifted(shell(0.02, 0.02, 0.05, EDGE, 0.004), 0.2)
    write_stl(trimesh.util.concatenate([cone, pin]), path)
    with pytest.raises(ScanError, match=rf"has 2 bodies of 0 \({len(cone.faces)} faces, 1"):
        read_scan(path)
    assert_same_surface(read_scan(path, body="0").mesh, cone)
    with pytest.raises(ScanError, match=r"no body '2' among 0.*--body"):
        read_scan(path, body="2")


@pytest.mark.parametrize("word", ["o", "g"], ids=["objects", "groups"])
@pytest.mark.parametrize("name", ["limb", "plate 2"], ids=["limb", "plate-2"])
def test_bodies_of_an_obj_have_names(cone, tmp_path, word: str, name: str):
    bodies = {"limb": cone, "plate 2": meshes.shifted(cone, 0.2)}
    text, count = "", 1
    for body, mesh in bodies.items():
        text += f"{word} {body}\n"
        text += "".join(f"v {x} {y} {z}\n" for x, y, z in 1e3 * mesh.vertices)
        text += "".join(f"f {a} {b} {c}\n" for a, b, c in mesh.faces + count)
        count += len(mesh.vertices)
    (tmp_path / "scan.obj").write_text(text)
    scan = read_scan(tmp_path / "scan.obj", body=name)
    assert_same_surface(scan.mesh, bodies[name])
    assert scan.body == name


def obj_lines(mesh: trimesh.Trimesh, corner: str = "{0}") -> list[str]:
    """Lines of an OBJ in mm; a corner is written of its index and of the number of vertices."""
    lines = [f"v {x} {y} {z}" for x, y, z in 1e3 * mesh.vertices]
    lines += ["vt 0.5 0.5"] * len(mesh.vertices)
    for face in mesh.faces + 1:
        corners = [corner.format(k, k - len(mesh.vertices) - 1) for k in face]
        lines.append("f " + " ".join(corners))
    return lines


def continued(lines: list[str]) -> list[str]:
    return [line.replace(" ", " \\\n", 1) if k % 3 else line for k, line in enumerate(lines)]


@pytest.mark.parametrize(
    ("corner", "dress"),
    [
        pytest.param("{1}", list, id="relative"),
        pytest.param("{1}/{1}", list, id="relative-textured"),
        pytest.param("{1}//", list, id="relative-slashes"),
        pytest.param("{0}/{1}", list, id="mixed"),
        pytest.param("{0}", lambda lines: [f"{line} # of X" for line in lines], id="comments"),
        pytest.param("{1}", lambda lines: [f"  {line}\t#" for line in lines], id="indented"),
        pytest.param("{0}", continued, id="continued"),
        pytest.param("{1}", lambda lines: ["# C:\\scans\\", *continued(lines)], id="folder"),
    ],
)
@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"], ids=["lf", "crlf", "cr"])
def test_every_way_of_writing_an_obj_reads_alike(cone, tmp_path, corner, dress, ending: str):
    text = "\n".join(dress(obj_lines(cone, corner))) + "\n"
    (tmp_path / "scan.obj").write_bytes(text.replace("\n", ending).encode())
    scan = read_scan(tmp_path / "scan.obj")
    assert_same_surface(scan.mesh, cone)
    assert len(scan.notes) == 2


def test_relative_indices_count_from_their_line(cone, tmp_path):
    """Each of two objects follows its own vertices, and a name may hold a hash."""
    far = meshes.shifted(cone, 0.2)
    lines = ["o limb #1", *obj_lines(cone, "{1}"), "o plate", *obj_lines(far, "{1}")]
    (tmp_path / "scan.obj").write_text("\n".join(lines))
    assert_same_surface(read_scan(tmp_path / "scan.obj", body="limb #1").mesh, cone)
    assert_same_surface(read_scan(tmp_path / "scan.obj", body="plate").mesh, far)


def test_the_line_of_a_bad_face_counts_continued_ones(tmp_path):
    (tmp_path / "scan.obj").write_bytes(b"v 0 \\\r\n0 0\r\nv 1 0 0\r\nf 1 2 x\r\n")
    with refused(ScanError, "line 4 is not a vertex or a face ('f 1 2 x')"):
        read_scan(tmp_path / "scan.obj")


PLY = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
PLY += b"property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"

TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf "
BAD = {
    "no such.stl": (None, "cannot be read (No such file"),
    "kind.step": (b"ISO-10303-21;", "'.step' is not a supported scan format"),
    "cut.stl": (bytes(80) + struct.pack("<I", 100) + bytes(3000), "is not a valid STL file"),
    "cut.ply": (PLY + b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "fewer lines than elements"),
    "far.obj": (TRIANGLE + b"1 2 4\n", "not a valid OBJ"),
    "back.obj": (TRIANGLE + b"-1 -2 -4\n", "line 4 counts back beyond the first vertex"),
    "zero.obj": (TRIANGLE + b"0 1 2\n", "line 4 is not a vertex"),
    "joined.obj": (TRIANGLE + b"1 \\\r\n2 x\r\n", "line 4 is not a vertex"),
    "line.obj": (b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no face has an area"),
    "nan.obj": (b"v nan 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no face has finite corners"),
}


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [(name, *rest) for name, rest in BAD.items()],
    ids=[name.replace(" ", "-") for name in BAD],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, capfd, caplog, name, content, words):
    """That names it."""
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with refused(ScanError, words, name):
        read_scan(tmp_path / name)
    assert capfd.readouterr() == ("", "") and not caplog.records


# --- repairs: each undoes a known damage and is reported


def with_specks(cone: trimesh.Trimesh) -> trimesh.Trimesh:
    speck = trimesh.creation.icosphere(1, 0.001)
    specks = [meshes.shifted(speck, 0.2 + 0.01 * i) for i in range(3)]
    return trimesh.util.concatenate([specks[0], cone, *specks[1:]])


def with_faces_twice(cone: trimesh.Trimesh) -> trimesh.Trimesh:
    twice = np.vstack([cone.faces[:7], cone.faces[5:15, ::-1], np.roll(cone.faces[20:22], 1, 1)])
    return with_faces(cone, np.vstack([cone.faces, twice]))


def with_empty_faces(cone: trimesh.Trimesh) -> trimesh.Trimesh:
    points = np.column_stack([cone.faces[:9, 0], cone.faces[:9, 0], cone.faces[:9, 1]])
    return with_faces(cone, np.vstack([points, cone.faces]))


def with_a_fin(cone: trimesh.Trimesh) -> trimesh.Trimesh:
    a, b = cone.faces[200][:2]
    vertices = np.vstack([cone.vertices, 0.8 * cone.vertices[a]])
    fin = np.vstack([cone.faces, [[a, b, len(cone.vertices)]]])
    return trimesh.Trimesh(vertices, fin, process=False)


def with_loose_vertices(cone: trimesh.Trimesh) -> trimesh.Trimesh:
    """Vertices of each face a hair apart from those of the next."""
    hair = np.random.default_rng(1).uniform(-2e-8, 2e-8, (cone.faces.size, 3))
    corners = np.arange(cone.faces.size).reshape(-1, 3)
    return trimesh.Trimesh(cone.triangles.reshape(-1, 3) + hair, corners, process=False)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        pytest.param(with_specks, "dropped 240 faces", id="specks"),
        pytest.param(with_faces_twice, "removed 19 duplicate faces", id="doubles"),
        pytest.param(with_empty_faces, "removed 9 faces without area", id="empty-faces"),
        pytest.param(with_a_fin, "dropped 1 faces", id="fin"),
        pytest.param(with_loose_vertices, "inferred unit mm", id="loose-vertices"),
    ],
)
def test_a_damage_is_repaired_without_a_trace(cone, path, damage, words: str):
    """And reported."""
    scan = read_scan(write_stl(damage(cone), path))
    assert_same_surface(scan.mesh, cone)
    assert noted(scan, words)


def with_triangles(cone: trimesh.Trimesh, *places: list[float]) -> trimesh.Trimesh:
    """The cone between triangles of 2 mm at these places [m]."""
    corner = 0.002 * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    specks = [
        with_faces(trimesh.Trimesh(corner + place), np.array([[0, 1, 2]])) for place in places
    ]
    return trimesh.util.concatenate([*specks[:1], cone, *specks[1:]])


SCATTERED = np.random.default_rng(2).uniform(-1000.0, 1000.0, (50, 3))


@pytest.mark.parametrize(
    "places",
    [
        pytest.param([[1000.0, 0.0, 0.0]], id="along-x"),
        pytest.param([[0.0, 0.0, -1000.0]], id="along-z"),
        pytest.param([[600.0, 600.0, 600.0]], id="diagonal"),
        pytest.param([[1e5, 0.0, 0.0], [0.0, -30.0, 0.0]], id="two"),
        pytest.param(SCATTERED.tolist(), id="scattered"),
    ],
)
def test_specks_far_off_are_dropped_first(cone, path, places):
    """Before the extent determines the unit, what is welded, and whether there is an area."""
    scan = read_scan(write_stl(with_triangles(cone, *places), path))
    assert_same_surface(scan.mesh, cone)
    assert noted(scan, f"dropped {len(places)} faces of specks or spikes far off the rest")
    assert noted(scan, "inferred unit mm: the body is 0.24 m long")


def test_a_vertex_far_off_takes_only_its_faces(cone, path):
    gone = int((cone.faces == 50).any(axis=1).sum())
    around = (cone.faces == 50).any(axis=1)
    rest = with_faces(cone, cone.faces[~around])
    cone.vertices[50] = [0.0, 0.0, 1000.0]
    scan = read_scan(write_stl(cone, path))
    assert noted(scan, f"dropped {gone} faces of specks or spikes")
    assert scan.mesh.area == pytest.approx(rest.area, rel=1e-6)


def test_bodies_far_apart_are_no_specks(cone, path):
    write_stl(trimesh.util.concatenate([cone, meshes.shifted(cone, 100.0)]), path)
    with pytest.raises(ScanError, match="has 2 bodies of 0"):
        read_scan(path)


def test_faces_with_an_infinite_corner_are_removed(cone, path):
    gone = int((cone.faces == 50).any(axis=1).sum())
    cone.vertices[50] = [np.nan, 0.0, np.inf]
    scan = read_scan(write_stl(cone, path))
    assert np.isfinite(scan.mesh.vertices).all()
    assert noted(scan, f"removed {gone} faces with a corner that is not finite")


def test_the_winding_is_repaired_with_the_fewest_turns(rng, path):
    solid = shell(*CONE, EDGE, 0.005)
    flip = rng.random(len(solid.faces)) < 0.4
    faces = np.where(flip[:, None], solid.faces[:, ::-1], solid.faces)
    scan = read_scan(write_stl(with_faces(solid, faces), path))
    assert scan.mesh.is_winding_consistent
    assert abs(scan.mesh.volume) == pytest.approx(solid.volume, rel=1e-5)
    assert noted(scan, f"reversed {flip.sum()} faces")


def test_a_large_hole_through_walls_is_left(path):
    solid = shell(*CONE, 0.0025, 0.005)
    centres = solid.triangles_center
    small = np.argmin(np.linalg.norm(centres - [0.05, 0.0, 0.1], axis=1))
    large = np.linalg.norm(centres - [0.0, 0.06, 0.1], axis=1) < 0.015
    keep = ~large
    keep[small] = False
    scan = read_scan(write_stl(with_faces(solid, solid.faces[keep]), path))
    assert noted(scan, "small holes closed: 1, ")
    assert noted(scan, "edges of the surface left open: 2, ")


def test_small_holes_are_closed_by_fans(path):
    solid = shell(*CONE, 0.0025, 0.005)
    vertex = np.argmin(np.linalg.norm(solid.vertices - [-0.05, 0.0, 0.1], axis=1))
    scan = read_scan(write_stl(with_faces(solid, (solid.faces != vertex).all(axis=1)), path))
    assert noted(scan, "small holes closed: 1, ") and scan.mesh.is_watertight
    assert_same_surface(scan.mesh, solid)


# --- The interior of sockets: known by their making, and real


WALL = 0.005
UP = np.array([0.0, 0.0, 1.0])

SHAPES = {
    "flat end": {},
    "wide hole in a dome": {"dome": True, "hole": 0.02},
    "half": {"arc": np.pi},
    "third with a dome": {"dome": True, "arc": meshes.FULL / 3.0},
    "open along its side": {"closed": False, "arc": 5.2},
}


def inside_out(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return with_faces(mesh, mesh.faces[:, ::-1])


def check(scan: trimesh.Trimesh, inner: trimesh.Trimesh, up=UP, off: float = 1.0) -> None:
    """The interior of a scan is its inner wall, and its opening is up [deg]."""
    interior = find_interior(scan)
    meshes.assert_same_faces(interior.mesh, inner)
    assert meshes.angle_between(interior.proximal, up) < off


EVERY_SHAPE = pytest.mark.parametrize(
    "shape", SHAPES.values(), ids=[name.replace(" ", "-") for name in SHAPES]
)


@EVERY_SHAPE
def test_the_inner_wall_of_a_shell_is_kept(shape):
    check(shell(*CONE, EDGE, WALL, **shape), open_cone(*CONE, EDGE, **shape))


@EVERY_SHAPE
@pytest.mark.parametrize("wound", ["inwards", "outwards"])
def test_a_single_surface_is_kept_whole(shape, wound: str):
    cone = open_cone(*CONE, EDGE, **shape)
    check(cone if wound == "inwards" else inside_out(cone), cone)


@pytest.mark.parametrize("thickness", [0.0015, 0.015], ids=["thin", "thick"])
def test_a_wall_may_have_any_thickness(thickness: float):
    check(shell(*CONE, 0.004, thickness, dome=True), open_cone(*CONE, 0.004, dome=True))


def test_a_wall_may_be_cut_at_a_slant():
    inner, cut = open_cone(*CONE, EDGE, arc=4.0), shell(*CONE, EDGE, 0.01, arc=4.0)
    outer = slice(len(inner.vertices), None)  # turned, so that the cavity sees a face of the cut
    cut.vertices[outer] = Rotation.from_rotvec(0.1 * UP).apply(cut.vertices[outer])
    check(cut, inner, off=2.0)


@pytest.mark.parametrize(
    "shape",
    [
        pytest.param({"hole": 0.01, "dome": True}, id="dome"),
        pytest.param({"arc": np.pi}, id="half"),
    ],
)
def test_the_distal_end_may_be_long_and_solid(shape):
    inner = open_cone(*CONE, EDGE, **shape)
    low = inner.vertices[:, 2].min() - 1e-6

    def lengthened(points):
        """As printed with its adapter: the middle of the body is within the material."""
        return points - np.outer(0.12 * (points[:, 2] < low), UP)

    check(moved(shell(*CONE, EDGE, WALL, **shape), lengthened), inner)


def oval(points):
    """With a trim line that rises and falls, twice around."""
    wave = 0.1 * np.maximum(points[:, 2], 0.0) * np.cos(2.0 * np.arctan2(*points.T[1::-1]))
    return points * [1.35, 0.75, 1.0] + np.outer(wave, UP)


def pressed_in(points):
    """A bar across the front, as for the patellar tendon."""
    angle = np.arctan2(points[:, 1], points[:, 0])
    depth = 0.35 * np.exp(-(((points[:, 2] - 0.12) / 0.02) ** 2) - (angle / 0.5) ** 2)
    return points * (1.0 - np.outer(depth, [1.0, 1.0, 0.0]))


@pytest.mark.parametrize("change", [oval, pressed_in])
@pytest.mark.parametrize(
    "shape",
    [pytest.param({"dome": True}, id="whole"), pytest.param({"dome": True, "arc": 3.6}, id="open")],
)
def test_a_socket_need_not_be_round(change, shape):
    scan, inner = shell(*CONE, EDGE, WALL, **shape), open_cone(*CONE, EDGE, **shape)
    found = find_interior(moved(scan, change))
    meshes.assert_same_faces(found.mesh, moved(inner, change))


@pytest.mark.parametrize("height", [0.01, 0.06], ids=["10-mm", "60-mm"])
def test_a_socket_may_be_shallow(height: float):
    cone = (0.05, 0.06, height)
    scan = moved(shell(*cone, EDGE, WALL, dome=True), oval)
    check(scan, moved(open_cone(*cone, EDGE, dome=True), oval), off=2.0)


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: open_cone(*CONE, EDGE, arc=4.0), id="surface"),
        pytest.param(lambda: shell(*CONE, EDGE, WALL, arc=4.0), id="shell"),
        pytest.param(lambda: inside_out(shell(*CONE, EDGE, WALL, arc=4.0)), id="shell-inside-out"),
    ],
)
def test_neither_pose_nor_order_of_faces_matters(rng, make):
    turn, shift = Rotation.random(random_state=5), rng.normal(0.0, 1.0, 3)
    mesh, cone = make(), open_cone(*CONE, EDGE, arc=4.0)
    inner = moved(cone, lambda points: turn.apply(points) + shift)
    shuffled = with_faces(mesh, rng.permutation(mesh.faces))
    check(moved(shuffled, lambda points: turn.apply(points) + shift), inner, turn.apply(UP))


def test_the_rim_of_a_window_is_no_wall():
    cone = open_cone(*CONE, 0.004, dome=True)
    place = cone.triangles_center - [0.05, 0.0, 0.1]
    inner = with_faces(cone, np.linalg.norm(place, axis=1) > 0.02)
    interior = find_interior(thickened(inner, WALL))
    meshes.assert_same_faces(interior.mesh, inner)
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


# --- real scans


def test_the_inner_wall_of_a_real_shell(shared_data: Path):
    path = shared_data / "homebrew_socket" / "socket.STL"
    body = read_scan(path, body="1").mesh
    with pytest.raises(ScanError, match=r"socket.STL: has no cavity"):
        find_interior(read_scan(path, body="0").mesh)
    interior = find_interior(body)
    mesh, thickness = interior.mesh, 0.007

    # A wall's thickness behind every face lies the body's surface, before it lies nothing.
    surface = cKDTree(trimesh.sample.sample_surface(body, 200_000, seed=1)[0])
    depth = thickness * mesh.face_normals
    assert surface.query(mesh.triangles_center - depth)[0].max() < 0.0015
    assert np.percentile(surface.query(mesh.triangles_center + depth)[0], 1) > 0.0055

    assert meshes.angle_between(interior.proximal, UP) < 8.0  # its wide end is up
    assert not any("no axis" in note for note in interior.notes)


@pytest.fixture(scope="module")
def limb(shared_data: Path):
    """A real limb, with the area of its file [m^2]."""
    path = shared_data / "ampscan" / "stl_file.stl"
    return find_interior(read_scan(path).mesh), 1e-6 * trimesh.load_mesh(path).area


def test_a_real_limb_is_kept_whole(limb):
    interior, area = limb
    assert interior.mesh.area == pytest.approx(area, rel=1e-9)
    # Its normals point into the limb: test_tile.py.
    assert meshes.angle_between(interior.proximal, UP) < 5.0
    assert "openings: 1, " in interior.notes[1]


def test_a_limb_is_separated_from_its_shell(limb):
    mesh = limb[0].mesh
    meshes.assert_same_faces(find_interior(thickened(mesh, 0.006)).mesh, mesh, 2e-3)


@pytest.mark.parametrize(
    ("make", "proximal"),
    [
        pytest.param(
            lambda: shell(0.06, 0.05, 0.2, EDGE, WALL, closed=False), -UP, id="wider-below"
        ),
        pytest.param(lambda: shell(0.06, 0.04, 0.2, EDGE, WALL, hole=0.03), UP, id="bottle"),
    ],
)
def test_the_more_open_end_is_proximal(make, proximal):
    assert meshes.angle_between(find_interior(make()).proximal, proximal) < 1.0


@pytest.fixture(scope="module")
def tube() -> trimesh.Trimesh:
    """A shell with two equal ends."""
    return shell(0.05, 0.05, 0.2, EDGE, WALL, closed=False)


def test_equal_ends_need_a_direction(tube):
    with pytest.raises(ScanError, match=r"equally open.*--proximal"):
        find_interior(tube)


def check_direction(scan, inner, direction: list[float], words: str) -> None:
    """A given direction is kept; what the scan says against it is noted."""
    interior = find_interior(scan, np.array(direction))
    np.testing.assert_allclose(interior.proximal, direction / np.linalg.norm(direction))
    meshes.assert_same_faces(interior.mesh, inner)
    notes = [note for note in interior.notes if "direction" in note or "decides" in note]
    assert words in notes[0]


def test_a_direction_decides_between_equal_ends(tube):
    inner = open_cone(0.05, 0.05, 0.2, EDGE, closed=False)
    check_direction(tube, inner, [0.0, 0.0, -2.0], "decides")


@pytest.mark.parametrize(
    ("direction", "words"),
    [
        pytest.param([0.0, 0.0, -3.0], "closed end, 180 deg", id="opposite"),
        pytest.param([1.0, 0.0, 1.0], "45 deg off", id="aslant"),
    ],
)
def test_a_direction_against_the_scan_is_noted(direction: list[float], words: str):
    check_direction(shell(*CONE, EDGE, WALL), open_cone(*CONE, EDGE), direction, words)


def ball(*, below: float = np.inf) -> trimesh.Trimesh:
    """A ball, or its part below a height [m]."""
    whole = trimesh.creation.icosphere(subdivisions=4, radius=0.08)
    return with_faces(whole, whole.triangles_center[:, 2] < below)


def plate() -> trimesh.Trimesh:
    return trimesh.creation.box((0.1, 0.13, 0.02)).subdivide().subdivide()


def sheet() -> trimesh.Trimesh:
    """A noisy scan of a plane."""
    upper = with_faces(plate(), plate().face_normals[:, 2] > 0.5)
    noise = np.random.default_rng(1).normal(0.0, 5e-4, upper.vertices.shape)
    return moved(upper, lambda points: points + noise)


def hollow_ball() -> trimesh.Trimesh:
    return trimesh.util.concatenate([ball(), inside_out(trimesh.creation.icosphere(4, 0.07))])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        pytest.param(ball, "has no cavity", id="ball"),
        pytest.param(plate, "has no cavity", id="plate"),
        pytest.param(sheet, "has no cavity", id="sheet"),
        pytest.param(lambda: ball(below=-0.074), "has no cavity", id="dish"),
        pytest.param(hollow_ball, "closed", id="hollow-ball"),
        pytest.param(lambda: ball(below=0.0795), "closed|equally open", id="pinhole"),
    ],
)
def test_a_scan_of_no_socket_is_refused(make, words: str):
    with pytest.raises(ScanError, match=words):
        find_interior(make())


def test_a_bowl_without_an_axis_is_noted():
    assert any("no axis" in note for note in find_interior(ball(below=0.0)).notes)


def test_a_closed_scan_must_be_cut_open():
    """Though a direction is given."""
    with pytest.raises(ScanError, match=r"closed.*cut the scan open"):
        find_interior(ball(below=0.0795), UP)
