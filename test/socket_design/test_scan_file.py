"""Scan files: what is read, and what is refused in one line."""

import io
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.meshes import UNITS, assert_same_surface, open_cone, scaled, shell, shifted, write_stl

from socket_testbed.errors import ScanError
from socket_testbed.socket_design.interior import find_interior
from socket_testbed.socket_design.scan_file import Scan, read_scan, stated_unit

CONE = (0.04, 0.06, 0.2)  # distal radius, proximal radius, height [m]
EDGE = 0.01


@pytest.fixture
def cone() -> trimesh.Trimesh:
    return open_cone(*CONE, EDGE, dome=True)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "scan.stl"


def export(mesh: trimesh.Trimesh, path: Path, **options) -> Path:
    """Write a file with another program's writer, in mm."""
    data = scaled(mesh, 1000.0).export(file_type=path.suffix[1:], **options)
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return path


def noted(scan: Scan, words: str) -> bool:
    return any(words in note for note in scan.notes)


WRITERS = {
    "binary stl": lambda mesh, folder: write_stl(mesh, folder / "a.stl"),
    "binary stl that begins with solid": lambda mesh, folder: write_stl(
        mesh, folder / "a.STL", header=b"solid socket"
    ),
    "text stl": lambda mesh, folder: ascii_stl(mesh, folder / "a.stl"),
    "binary ply": lambda mesh, folder: export(mesh, folder / "a.ply"),
    "text ply": lambda mesh, folder: export(mesh, folder / "a.PLY", encoding="ascii"),
    "obj": lambda mesh, folder: export(mesh, folder / "a.obj"),
}


def ascii_stl(mesh: trimesh.Trimesh, path: Path) -> Path:
    path.write_text(trimesh.exchange.stl.export_stl_ascii(scaled(mesh, 1000.0)))
    return path


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_every_kind_of_file_gives_the_same_surface(cone, tmp_path, write):
    if write is WRITERS["text ply"]:
        (tmp_path / "a.PLY").touch()
    scan = read_scan(write(cone, tmp_path))
    assert_same_surface(scan.mesh, cone)
    assert (scan.unit, scan.unit_source) == ("mm", "inferred")


@pytest.mark.parametrize("unit", UNITS)
def test_a_given_unit_is_taken(cone, path, unit):
    scan = read_scan(write_stl(cone, path, unit), unit=unit)
    assert_same_surface(scan.mesh, cone)
    assert scan.unit_source == "given"


@pytest.mark.parametrize("unit", ["m", "mm"])
def test_the_unit_is_inferred_where_only_one_makes_a_socket(path, unit):
    mesh = open_cone(0.04, 0.05, 0.2, EDGE)
    scan = read_scan(write_stl(mesh, path, unit))
    assert_same_surface(scan.mesh, mesh)
    assert (scan.unit, scan.unit_source) == (unit, "inferred")
    assert noted(scan, f"inferred unit {unit}")


def test_a_length_that_could_be_cm_or_inches_is_refused_with_both(cone, path):
    with pytest.raises(
        ScanError, match=r"more than one unit.*0.233 m in cm.*0.591 m in in.*--unit"
    ):
        read_scan(write_stl(scaled(cone, 0.97), path, "cm"))


@pytest.mark.parametrize(("unit", "length"), [("cm", 0.5), ("in", 0.2)])
def test_a_small_model_in_mm_is_not_read_as_a_socket_in_cm_or_inches(path, unit, length):
    size = length / UNITS[unit]  # of the file; in mm it is a tenth of a socket or less
    mesh = scaled(open_cone(0.04, 0.05, length, EDGE), 0.001 / UNITS[unit])
    with pytest.raises(ScanError, match=rf"{size:.4g} .* in {unit} .*model in mm.*--unit {unit}"):
        read_scan(write_stl(mesh, path, "mm"))


def test_a_length_that_no_unit_makes_a_socket_is_refused_with_all(cone, path):
    with pytest.raises(ScanError, match=r"no unit.*0.002.* m in mm.*--unit"):
        read_scan(write_stl(scaled(cone, 0.01), path, "mm"))


@pytest.mark.parametrize(("unit", "size"), [("m", "240 m"), ("furlong", "unknown")])
def test_a_given_unit_that_makes_no_possible_size_or_is_none_is_refused(cone, path, unit, size):
    with pytest.raises(ScanError, match=size):
        read_scan(write_stl(cone, path, "mm"), unit=unit)


def test_a_unit_that_the_file_states_is_taken(cone, tmp_path):
    stated = {
        "a.stl": write_stl(cone, tmp_path / "a.stl", "cm", b"scanner X; units: cm"),
        "a.obj": export(scaled(cone, 0.1), tmp_path / "a.obj", header="File units = centimeters"),
    }
    ply = export(scaled(cone, 0.1), tmp_path / "a.ply")
    ply.write_bytes(ply.read_bytes().replace(b"\nelement", b"\ncomment unit cm\nelement", 1))
    for file in (*stated.values(), ply):
        scan = read_scan(file)
        assert_same_surface(scan.mesh, cone)
        assert (scan.unit, scan.unit_source) == ("cm", "stated")


def test_a_given_unit_goes_before_the_stated_one_and_that_is_noted(cone, path):
    scan = read_scan(write_stl(cone, path, "mm", b"units: cm"), unit="mm")
    assert_same_surface(scan.mesh, cone)
    assert noted(scan, "states the unit cm")


@pytest.mark.parametrize(
    ("comment", "unit"),
    [
        ("UNITS=mm", "mm"),
        ("units: in", "in"),
        ("units in inches", "in"),
        ("Unit Millimetres", "mm"),
        ("unit:m", "m"),
        ("units in progress", None),
        ("the unit may be", None),
        ("10 mm", None),
    ],
)
def test_what_counts_as_stated(comment, unit):
    assert stated_unit(comment) == unit


@pytest.mark.parametrize("low", [0.0, -0.5, -1.0])
def test_a_model_in_normalised_units_is_refused(cone, path, low):
    extent = np.ptp(cone.vertices, axis=0)
    size = 2.0 if low == -1.0 else 1.0
    unit_box = size * (cone.vertices - cone.bounds[0] - 0.5 * extent) / extent.max()
    points = unit_box + low + 0.5 * size
    mesh = trimesh.Trimesh(points, cone.faces, process=False)
    for unit in (None, "m"):
        with pytest.raises(ScanError, match=r"normalised.*real size"):
            read_scan(write_stl(mesh, path, "m"), unit=unit)


def two_bodies(cone: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.util.concatenate([cone, shifted(shell(0.02, 0.02, 0.05, EDGE, 0.004), 0.2)])


def test_of_two_bodies_one_must_be_chosen_by_its_number(cone, path):
    write_stl(two_bodies(cone), path)
    with pytest.raises(ScanError, match=rf"scan.stl: has 2 bodies.*0 \({len(cone.faces)} faces"):
        read_scan(path)
    assert_same_surface(read_scan(path, body="0").mesh, cone)
    assert read_scan(path, unit="mm", body="1").mesh.is_watertight
    for wrong in ("2", "-1", "socket"):
        with pytest.raises(ScanError, match=rf"no body '{wrong}', but 2 bodies.*--body"):
            read_scan(path, body=wrong)


def test_the_bodies_of_an_obj_go_by_the_names_of_objects_and_groups(cone, tmp_path):
    path = tmp_path / "scan.obj"
    parts = {"o limb\ng skin": cone, "g plate 2": shifted(cone, 0.2), "o pin": shifted(cone, 0.4)}
    text, before = "# two kinds of names\n", 0
    for name, mesh in parts.items():
        text += name + "\n"
        text += "".join(f"v {x} {y} {z}\n" for x, y, z in 1e3 * mesh.vertices)
        text += "".join(f"f {a}//1 {b}//1 {c}//1\n" for a, b, c in mesh.faces + 1 + before)
        before += len(mesh.vertices)
    path.write_text(text)
    for name, x in {"skin": 0.0, "plate 2": 0.2, "pin": 0.4, "2": 0.4}.items():
        scan = read_scan(path, body=name)
        assert_same_surface(scan.mesh, shifted(cone, x))
    assert read_scan(path, body="skin").body == "limb"
    with pytest.raises(ScanError, match=r"has 3 bodies.*0 'limb' 'skin' .*2 'pin' "):
        read_scan(path)
    with pytest.raises(ScanError, match="2 bodies called 'limb'"):
        read_scan(path, body="limb")


def test_obj_polygons_and_indices_that_count_back(tmp_path, cone):
    path = tmp_path / "scan.obj"
    quads = "".join(
        "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "f -4 -3 -2 -1\n"
        for corners in quad_tube()
    )
    path.write_text(quads)
    scan = read_scan(path)
    assert len(scan.mesh.faces) == 2 * len(quad_tube())
    assert scan.mesh.area == pytest.approx(1e-6 * 24 * 2 * 50 * np.sin(np.pi / 24) * 200, rel=1e-6)


def quad_tube() -> np.ndarray:
    """A tube of 24 x 8 quads, radius 50, length 200, shape (192, 4, 3) [mm]."""
    angle = np.arange(25) * np.pi / 12
    ring = 50.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.array(
        [
            [[*ring[i], z], [*ring[i + 1], z], [*ring[i + 1], z + 25], [*ring[i], z + 25]]
            for i in range(24)
            for z in range(0, 200, 25)
        ]
    )


def binary(count: int, faces: int = 0) -> bytes:
    return bytes(80) + struct.pack("<I", count) + bytes(50 * faces)


POINTS = b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
POINTS += b"property float z\nend_header\n0 0 0\n1 1 1\n"
PLY = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
PLY += b"property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
FACET = (
    b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
)

BAD = {
    "no such.stl": (None, "no such file"),
    "empty.stl": (b"", "is empty"),
    "blank.obj": (b" \n\n", "is empty"),
    "kind.step": (b"ISO-10303-21;", "'.step' is not a supported scan format"),
    "none": (b"has no cavity", "'' is not a supported scan format"),
    "cut.stl": (binary(100, 60), "has 3084 bytes, but its 100 faces take 5084"),
    "short.stl": (b"sol", "is not a valid STL file"),
    "words.stl": (b"Dear prosthetist,\nthe scan is attached.\n" * 9, "is not a valid STL file"),
    "zero.stl": (binary(0), "has no faces"),
    "flat.stl": (binary(40, 40), "no face has an area"),
    "text cut.stl": (b"solid a\n" + 3 * FACET, "ends after 3 faces, without 'endsolid'"),
    "text odd.stl": (
        b"solid a\n" + FACET.replace(b"1 0 0", b"1 x 0") + b"endsolid a",
        "is not a valid STL file",
    ),
    "text few.stl": (
        b"solid a\n" + FACET.replace(b"vertex 1 0 0\n", b"") + b"endsolid",
        "is not a valid STL file",
    ),
    "text none.stl": (b"solid a\nendsolid a\n", "has no faces"),
    "points.ply": (POINTS, "has no faces"),
    "header.ply": (PLY[:40], "is not a valid PLY file"),
    "cut.ply": (PLY + b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "1 of the 2 elements 'face'"),
    "far.ply": (PLY + b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n3 0 1 7\n", "1 faces name vertices"),
    "words.ply": (b"Dear prosthetist,\n", "is not a valid PLY file"),
    "bytes.ply": (b"ply\n" + bytes(range(256)), "is not a valid PLY file"),
    "points.obj": (b"v 0 0 0\nv 1 0 0\n", "has no faces"),
    "words.obj": (b"Dear prosthetist,\n", "has no faces"),
    "far.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "1 faces name vertices"),
    "back.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -4\n", "line 4 is not valid OBJ"),
    "zero.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "line 4 is not valid OBJ"),
    "text.obj": (b"v 0 0 zero\n", "line 1 is not valid OBJ"),
    "short.obj": (b"v 0 0 0\nv 1 0 0\nf 1 2\n", "line 3 is not valid OBJ"),
    "binary.obj": (b"v 0 0 0\n\0\0\0", "is not a valid OBJ file"),
    "line.obj": (b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no face has an area"),
    "nan.obj": (b"v nan 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no face has finite corners"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line_that_names_them(tmp_path, name, capfd, caplog):
    content, words = BAD[name]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ScanError) as caught:
        read_scan(tmp_path / name)
    message = str(caught.value)
    assert words in message
    assert name in message
    assert "\n" not in message
    assert caught.value.hint
    assert capfd.readouterr() == ("", "")
    assert not caplog.records


def test_a_folder_is_no_scan(tmp_path):
    (tmp_path / "scan.stl").mkdir()
    with pytest.raises(ScanError, match="cannot be read"):
        read_scan(tmp_path / "scan.stl")


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_damage_anywhere_is_refused_or_survived(cone, tmp_path, write):
    path = write(cone, tmp_path)
    data = path.read_bytes()
    rng = np.random.default_rng(4)
    refused = 0
    for _ in range(25):
        damaged = bytearray(data)
        for place in rng.integers(0, len(data), 8):
            damaged[place] = rng.integers(256)
        path.write_bytes(bytes(damaged))
        try:
            assert np.isfinite(read_scan(path).mesh.vertices).all()
        except ScanError:
            refused += 1
    for share in rng.random(8):
        path.write_bytes(data[: int(share * len(data))])
        if path.suffix.lower() != ".obj":  # an OBJ says nowhere how long it is
            with pytest.raises(ScanError):
                read_scan(path)


def test_the_bodies_of_a_real_file(shared_data):
    path = shared_data / "homebrew_socket" / "socket.STL"
    with pytest.raises(
        ScanError, match=r"2 bodies.*0 \(7626 faces.*1 \(11052 faces, 111.8 x 154.7"
    ):
        read_scan(path)
    scan = read_scan(path, body="1")
    assert (len(scan.mesh.faces), scan.unit, scan.body) == (11052, "mm", "1")
    assert scan.mesh.is_watertight
    with pytest.raises(ScanError, match=r"socket.STL: has no cavity"):
        find_interior(read_scan(path, body="0").mesh)


def test_a_real_limb_needs_no_repair(shared_data):
    path = shared_data / "ampscan" / "stl_file.stl"
    scan = read_scan(path)
    raw = trimesh.load_mesh(io.BytesIO(path.read_bytes()), file_type="stl")
    assert_same_surface(scan.mesh, scaled(raw, 0.001))
    assert not any(
        word in note for note in scan.notes for word in ("removed", "closed", "reversed")
    )
