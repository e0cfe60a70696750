"""Whole lines that refuse a scan, its clusters, a take or its landmarks: place, number and hint."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from support import meshes, scene, takes

from socket_testbed.errors import TestbedError
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.regions import SocketAxis, socket_axis, tiles_named
from socket_testbed.socket_design import clusters, design, interior, motive, registration, scan_file
from socket_testbed.socket_design.clusters import ClusterPlace, ClusterPlacement
from socket_testbed.socket_design.squares import (
    Squares,
    SurfacePoints,
    Surroundings,
    rim_points,
    spread_points,
    squares_at,
)
from socket_testbed.socket_design.tiling import TilingSettings, tile_interior

X, Y, Z = np.eye(3)


def line(call: Callable[[], object]) -> str:
    """The error of a call."""
    with pytest.raises(TestbedError) as found:
        call()
    return str(found.value)


# --- directions and points

POINTS = {
    "no direction": (
        lambda: design.parse_direction("0 0 0", "--proximal"),
        "--proximal is '0 0 0', no direction: give +z or three numbers",
    ),
    "no axis": (
        lambda: design.parse_direction("up", "--proximal"),
        "--proximal is 'up': give an axis, such as +z, or three numbers",
    ),
    "two numbers": (
        lambda: design.parse_point("1, 2", "--points"),
        "--points is '1, 2': give three numbers, such as '0 0 1'",
    ),
    "infinite": (
        lambda: design.parse_point("1 2 inf", "--points"),
        "--points is '1 2 inf': give three numbers, such as '0 0 1'",
    ),
    "anterior along proximal": (
        lambda: design.place_by_directions(np.eye(3), Z, -Z, 0.08),
        "--anterior is along the proximal direction: give the direction of the shin's front",
    ),
    "points on a line": (
        lambda: design.place_by_points(np.array([X, 2.0 * X, 3.0 * X])),
        "the three --points are on one line or at one place: pick the origin of {S}, a point on"
        " its +x axis, and a third one towards +y",
    ),
    "region": (
        lambda: tiles_named("antreior", {"anterior": np.array([0])}),
        "--keep-out: there is no region or tile 'antreior': did you mean 'anterior'?",
    ),
}


@pytest.mark.parametrize("case", POINTS)
def test_a_wrong_direction_has_this_line(case: str) -> None:
    call, expected = POINTS[case]
    assert line(call) == expected


@pytest.mark.parametrize(
    ("text", "found"), [("-y", -Y), ("X", X), ("0 3 4", [0.0, 0.6, 0.8])], ids=["-y", "X", "long"]
)
def test_a_direction_has_unit_length(text: str, found: np.ndarray) -> None:
    assert design.parse_direction(text, "--proximal") == pytest.approx(np.array(found))


def test_landmarks_name_the_one_farthest_off(tmp_path: Path) -> None:
    """Corners of a square of 100 mm; one is picked 60 mm too high."""
    corners = {"a": (0, 0, 0), "b": (100, 0, 0), "c": (100, 100, 0), "d": (0, 100, 0)}
    landmarks = {
        name: {"scan": [x, y, 60.0 * (name == "c")], "load_cell": [1e-3 * x, 1e-3 * y, 0.0]}
        for name, (x, y, _) in corners.items()
    }
    path = tmp_path / "l.yaml"
    path.write_text(yaml.safe_dump({"landmarks": landmarks}))
    assert line(lambda: design.place_by_landmarks(path, 1e-3)) == (
        f"{path}: the landmarks only fit to 15.6 mm: check the scan's unit and the coordinates,"
        " first of 'c'"
    )


# --- clusters

WALL = meshes.open_cone(0.05, 0.05, 0.12, 0.004, closed=False)


@cache
def around(edge: float) -> tuple[Squares, Surroundings]:
    """One square on the far side, so that only the clusters' own places are tried."""
    rng = np.random.default_rng(2)
    points = spread_points(WALL, 0.0025, rng)
    surroundings = Surroundings(points, rim_points(WALL, 0.0005), Z, X)
    far = SurfacePoints(np.array([[-0.05, 0.0, 0.06]]), np.array([X]), np.zeros(1))
    return squares_at(far, surroundings, edge), surroundings


def asked(name: str, angle: float, height: float, frame: np.ndarray | None = None) -> ClusterPlace:
    place = np.array([0.05 * math.cos(angle), 0.05 * math.sin(angle), height])
    return ClusterPlace(name, place, frame, f"c.yaml: clusters: {name}")


def lay(*places: ClusterPlace, edge: float = 0.03) -> Any:
    return clusters.lay_clusters(WALL, places, *around(edge), 0.008)


def inwards(tilt: float) -> np.ndarray:
    """A frame at angle 0 whose z is so far off the inward normal -x [deg]."""
    angle = np.radians(tilt)
    z = np.array([-np.cos(angle), np.sin(angle), 0.0])
    return np.column_stack([Z, np.cross(z, Z), z])


def turn_angle(frame: np.ndarray) -> float:
    """On a square at angle 0 [deg]."""
    square = Squares(np.array([[0.05, 0.0, 0.06]]), inwards(0.0)[None], 0.03)
    return math.degrees(clusters._turn_angle(asked("a", 0.0, 0.06, frame), square))


LAID = {
    "at the rim": (
        lambda: lay(asked("a", 0.0, 0.115)),
        "c.yaml: clusters: a: no 30 mm tile fits within 15 mm of it: the interior has a rim there,"
        " or is not flat enough: check its place, or give a smaller --size or a larger --flatness",
    ),
    "overlapping": (
        lambda: lay(asked("a", 0.0, 0.05), asked("b", 0.0, 0.07), edge=0.025),
        "c.yaml: clusters: b: overlaps a, their centres are 20.0 mm apart: check their places: each"
        " covers 25 x 25 mm",
    ),
    "far off": (
        lambda: lay(asked("a", 0.0, 0.16)),
        "c.yaml: clusters: a: is 40 mm from the interior: give its place on the interior, in {S} in"
        " m or in the scan's coordinates",
    ),
    "tilted": (
        lambda: turn_angle(inwards(31.0)),
        "c.yaml: clusters: a: its z is 31 deg off the inward normal of the interior: give the"
        " columns x, y, z of its frame, z inwards",
    ),
}


@pytest.mark.parametrize("case", LAID)
def test_a_cluster_is_refused_with_this_line(case: str) -> None:
    call, expected = LAID[case]
    assert line(call) == expected


@pytest.mark.parametrize(
    ("tilt", "turn", "found"),
    [(29.0, 0.0, 0.0), (0.0, 20.0, 20.0), (0.0, -160.0, -160.0), (0.0, 0.09, 0.0)],
    ids=["tilted", "turned", "backwards", "hardly"],
)
def test_a_cluster_is_turned_about_its_normal(tilt: float, turn: float, found: float) -> None:
    """From its tile's x towards its y; less than 0.1 deg is none, and a tilt none either."""
    cosine, sine = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    x, y, z = inwards(tilt).T
    frame = np.column_stack([cosine * x + sine * y, cosine * y - sine * x, z])
    assert turn_angle(frame) == pytest.approx(found, abs=1e-9)


def test_a_cluster_may_be_29_millimetres_off() -> None:
    far = replace(asked("a", 0.0, 0.06), centre=np.array([0.079, 0.0, 0.06]))
    assert len(lay(far)[0]) == 1
    beyond = replace(far, centre=np.array([0.081, 0.0, 0.06]))
    assert "a: is 31 mm from the interior: " in line(lambda: lay(beyond))


@pytest.mark.parametrize(
    ("lower", "fits"), [(0.0149, True), (0.0151, False)], ids=["half an edge", "more"]
)
def test_a_tile_is_moved_by_half_an_edge(lower: float, fits: bool) -> None:
    """From 114.8 mm, over the brim at 120 mm, to a square of 30 mm so much lower."""
    place = asked("a", 0.0, 0.1148)
    _, surroundings = around(0.03)
    below = SurfacePoints(np.array([[0.05, 0.0, 0.1148 - lower]]), np.array([-X]), np.zeros(1))
    others = squares_at(below, surroundings, 0.03)
    call = lambda: clusters.lay_clusters(WALL, [place], others, surroundings, 0.008)  # noqa: E731
    if not fits:
        assert "no 30 mm tile fits within 15 mm of it" in line(call)
        return
    ((laid,),) = [call()[1]]
    assert laid.moved == pytest.approx(lower, abs=2e-4)
    assert str(laid).startswith("asked at (50.0, 0.0, 114.8), laid at (50.0, ")


def test_a_wall_turned_away_has_no_place() -> None:
    """A single triangle whose normal is +z, and a cluster that faces -z."""
    triangle = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], [[0, 1, 2]], process=False)
    place = ClusterPlace("a", np.zeros(3), np.diag([1.0, -1.0, -1.0]), "c.yaml: clusters: a")
    assert line(lambda: clusters._on_surface(triangle, place)) == (
        "c.yaml: clusters: a: is turned away from the interior: give its place on the interior, in"
        " {S} in m or in the scan's coordinates"
    )


PLACES = {
    "none": ("{}", "has no place"),
    "two": ("{point: [0, 0, 0], scan: [0, 0, 0]}", "has point and scan"),
    "anchor alone": ("{anchor: [0, 0, 0]}", "has anchor"),
    "frame alone": ("{frame: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}", "has frame"),
}


@pytest.mark.parametrize("case", PLACES)
def test_a_place_is_one_of_three(case: str, tmp_path: Path) -> None:
    text, fact = PLACES[case]
    (path := tmp_path / "c.yaml").write_text(f"clusters: {{a: {text}}}")
    assert line(lambda: clusters.read_cluster_places(path)) == (
        f"{path}: clusters: a: {fact}: give a point, or a point of the scan, or anchor and frame"
    )


@pytest.mark.parametrize("count", [6, 0], ids=["too many", "less than stay"])
def test_more_clusters_than_free_tiles_are_refused(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the 12 tiles, five are free and one of them has a cluster that stays."""
    monkeypatch.setattr(clusters, "_ExpectedError", lambda geometry: None)
    socket, allowed = scene.geometry(), np.arange(12) < 5
    assert line(lambda: clusters.place_clusters(socket, count, [2], allowed)) == (
        f"{count} clusters, of which 1 stay, do not fit on 4 free tiles: place others, or keep"
        " out of fewer regions"
    )


def test_proposed_clusters_have_names_and_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    """The scene's three clusters stay; `cluster_1` goes to tile 5, `cluster_2` to tile 7."""
    geometry = scene.geometry()
    before = [*geometry.clusters.values()]
    found = ClusterPlacement(np.array([*before, 5, 7]), {3: 0.5, 4: 0.25, 5: 0.125}, (0.2, 0.3))
    given: list[Any] = []
    monkeypatch.setattr(design, "place_clusters", lambda *asked: given.append(asked) or found)
    made: Any = design.SocketDesign("a", None, None, None, None, geometry, None, ("first",))  # type: ignore[arg-type]
    proposed = design.with_proposed_clusters(made, 5, [geometry.names[0]])
    assert [*proposed.geometry.clusters] == [*geometry.clusters, "cluster_1", "cluster_2"]
    assert [*proposed.geometry.clusters.values()] == [*before, 5, 7]
    assert proposed.geometry.names[5] == "cluster_1" and proposed.geometry.names[7] == "cluster_2"
    assert proposed.notes == (
        "first",
        "the clusters are proposed. Expected error of the force map on tiles without one, over"
        " their rms, by the number of clusters: 3: 0.50, 4: 0.25, 5: 0.12; with 5 at random 0.20 to"
        " 0.30: the number matters more than the places",
    )
    ((_, count, stay, allowed),) = given
    assert (count, stay) == (5, before)
    assert np.flatnonzero(~allowed).tolist() == [0]


AXIS = SocketAxis(np.zeros(3), Z, X)


def test_few_tiles_hold_no_usual_clusters() -> None:
    squares = Squares(np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1)), 0.03)
    assert line(lambda: design.nominal_places(squares, AXIS)) == (
        "3 tiles do not hold the usual 4 clusters: give the places of yours with --clusters FILE"
    )


def test_places_that_are_not_there_are_all_named() -> None:
    """Four tiles on the anterior side, 30, 60, 90 and 120 mm high; the third stays for `distal`."""
    anchors = np.array([[0.05, 0.0, 0.03 * n] for n in (1, 2, 3, 4)])
    squares = Squares(anchors, np.tile(np.eye(3), (4, 1, 1)), 0.03)
    assert line(lambda: design.nominal_places(squares, AXIS)) == (
        "the usual places of clusters are not on this socket (brim_lateral 120 mm above the distal"
        " end and 90 deg from its side; posterior_distal 30 mm above the distal end and 180 deg"
        " from its side; distal 90 mm above the distal end): give the places of yours with"
        " --clusters FILE"
    )


# --- the interior


def test_no_unit_makes_a_flat_cavity_a_socket() -> None:
    assert line(lambda: interior.refuse_implausible("a.stl", 0.2, 90.0, "m")) == (
        "a.stl: in m its cavity is 0.2 m long and 90 m around, which fits no socket (0.04 to 0.7 m"
        " and 0.12 to 0.85 m): no unit makes it one: export the model in its real size"
    )


@pytest.mark.parametrize(
    ("length", "girth"), [(0.04, 0.12), (0.7, 0.85)], ids=["smallest", "largest"]
)
def test_a_cavity_at_a_limit_is_a_socket(length: float, girth: float) -> None:
    interior.refuse_implausible("a.stl", length, girth, "m")


def test_a_plate_has_no_cavity() -> None:
    plate = trimesh.creation.box((0.1, 0.13, 0.02)).subdivide().subdivide()
    assert line(lambda: interior.find_interior(plate)) == (
        "the scan: has no cavity, it is solid or flat: scan the inside of the socket, or cut a"
        " closed model open at the brim"
    )


def test_a_tube_needs_its_direction() -> None:
    tube = meshes.shell(0.05, 0.05, 0.2, 0.008, 0.005, closed=False)
    tube.metadata["file_name"] = "tube.stl"
    assert line(lambda: interior.find_interior(tube)) == (
        "tube.stl: the two ends of the cavity are equally open, either may be proximal: give"
        " --proximal, the direction to the brim"
    )
    assert interior.find_interior(tube, Z).notes[-1] == (
        "the ends of the cavity are equally open: the given proximal direction decides"
    )


def test_a_bowl_has_no_clear_axis() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.08)
    bowl = meshes.with_faces(ball, ball.triangles_center[:, 2] < 0.0)
    assert interior.find_interior(bowl).notes[-1] == (
        "no axis of the cavity is clear: check the proximal direction or give it"
    )


@pytest.mark.parametrize(("lost", "noted"), [(0.06, True), (0.04, False)], ids=["6 %", "4 %"])
def test_what_is_seen_but_left_out_is_noted(lost: float, noted: bool) -> None:
    """Of 100 cm2 kept; another 5 cm2 are not seen."""
    areas = 1e-4 * np.array([60.0, 40.0, 100.0 * lost, 5.0])
    cavity: Any = SimpleNamespace(
        mesh=SimpleNamespace(area_faces=areas), seen=np.array([True, True, True, False])
    )
    notes = interior._notes_on_area(cavity, np.array([True, True, False, False]))
    assert notes[0] == (
        f"kept the inner wall, 100 of {105 + 100 * lost:.0f} cm2: no outer wall, rim or cut"
    )
    left = "left out 6 cm2 that are seen from the cavity but do not belong to it"
    assert notes[1:] == [left] * noted


def test_no_tile_on_a_rough_sheet_has_this_line() -> None:
    sheet = trimesh.Trimesh(
        1e-3 * np.array([[0, 0, 0], [20, 0, 0], [20, 20, 0], [0, 20, 0]]), [[0, 1, 2], [0, 2, 3]]
    )
    settings = TilingSettings(edge=0.03, flatness=0.002)
    assert line(lambda: tile_interior(sheet, Y, X, settings, lambda done, of: None)) == (
        "no 30 mm tile fits the interior (4.0 cm^2) within 2 mm of flat: check the unit of the"
        " scan, or give a smaller --size or a larger --flatness"
    )


# --- scan files

CORNERS = [(0, 0, 0), (200, 0, 0), (200, 100, 0), (0, 100, 0)]  # [mm]


def obj(*faces: str, scale: float = 1.0, comment: str = "", more: str = "") -> bytes:
    """A plate of 200 x 100 mm of triangles that are given by their corners, from 1."""
    vertices = "".join(f"v {x * scale} {y * scale} {z * scale}\n" for x, y, z in CORNERS)
    return (comment + vertices + more + "".join(f"f {face}\n" for face in faces)).encode()


WHOLE = ("1 2 3", "1 3 4")
HEAD = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
HEAD += b"property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
CUT = "the file is cut off or damaged: copy or export it again"

SCANS: dict[str, tuple[str, bytes | None, dict[str, str], str]] = {
    "unit": ("a.obj", obj(*WHOLE), {"unit": "mn"}, "the unit 'mn' is unknown: did you mean 'm'?"),
    "missing": (
        "a.obj",
        None,
        {},
        "{}: cannot be read (No such file or directory): check the path",
    ),
    "format": (
        *("a.step", b"", {}),
        "{}: '.step' is not a supported scan format: export the scan as STL, PLY or OBJ",
    ),
    "stl": ("a.stl", bytes(84) + b"1", {}, f"{{}}: is not a valid STL file: {CUT}"),
    "ply": ("a.ply", HEAD + b"0 0 0\n", {}, f"{{}}: has fewer lines than elements: {CUT}"),
    "index": ("a.obj", obj("1 2 9"), {}, f"{{}}: is not a valid OBJ file: {CUT}"),
    "line": (
        *("a.obj", obj("1 2 x"), {}),
        "{}: line 5 is not a vertex or a face ('f 1 2 x'): export the scan again, as OBJ with"
        " plain indices or as binary STL",
    ),
    "points": (
        *("a.obj", obj(), {}),
        "{}: has no faces: export the surface, not only its points",
    ),
    "infinite": (
        *("a.obj", b"v nan 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", {}),
        "{}: no face has finite corners: export the scan again",
    ),
    "flat": (
        *("a.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", {}),
        "{}: no face has an area: export the scan again, as a surface",
    ),
    "length": (
        *("a.obj", obj(*WHOLE, scale=0.05), {}),
        "{}: body 0: its length 10 is that of a socket, 0.1 to 0.6 m, neither in m nor in mm (10 m"
        " in m, 0.1 m in cm, 0.01 m in mm, 0.254 m in in): give its unit with --unit, or export the"
        " scan in its real size",
    ),
    "body": (
        *("a.obj", obj(*WHOLE), {"body": "2"}),
        "{}: has no body '2' among 0 (2 faces, 200 x 100 x 0): choose one with --body",
    ),
}


@pytest.mark.parametrize("case", SCANS)
def test_a_scan_is_refused_with_this_line(case: str, tmp_path: Path) -> None:
    name, content, options, expected = SCANS[case]
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    assert line(lambda: scan_file.read_scan(path, **options)) == expected.format(path)


def test_two_bodies_are_listed_with_their_sizes(tmp_path: Path) -> None:
    """Names of objects come with them."""
    far = "".join(f"v {x} {y} 500\n" for x, y, _ in CORNERS[:3])
    path = tmp_path / "a.obj"
    path.write_bytes(obj(*WHOLE, comment="o limb\n") + b"o plate\n" + far.encode() + b"f 5 6 7\n")
    shown = "0 'limb' (2 faces, 200 x 100 x 0), 1 'plate' (1 faces, 200 x 100 x 0)"
    assert line(lambda: scan_file.read_scan(path)) == (
        f"{path}: has 2 bodies of {shown}: choose one by number: --body N"
    )


REPAIRS = {
    "twice": (obj(*WHOLE, "3 2 1"), "removed 1 duplicate faces"),
    "no area": (obj(*WHOLE, "1 1 2"), "removed 1 faces without area, of fewer than three vertices"),
    "turned": (obj("1 2 3", "1 4 3"), "reversed 1 faces so that all wind the same way"),
    "not finite": (
        obj(*WHOLE, "1 2 5", more="v nan 0 0\n"),
        "removed 1 faces with a corner that is not finite",
    ),
    "speck": (
        obj(*WHOLE, "5 6 7", more="v 0 0 9\nv 1 0 9\nv 0 1 9\n"),
        "dropped 1 faces of pieces too small to be a body",
    ),
    "stated": (
        obj(*WHOLE, comment="# units: cm\n"),
        "the file states the unit cm, which is ignored",
    ),
}


@pytest.mark.parametrize("case", REPAIRS)
def test_a_repair_has_this_note(case: str, tmp_path: Path) -> None:
    content, note = REPAIRS[case]
    (path := tmp_path / "a.obj").write_bytes(content)
    notes = scan_file.read_scan(path, "mm").notes
    assert [each for each in notes if "unit mm" not in each and "left open" not in each] == [note]
    assert notes[-1] == "edges of the surface left open: 1, 600 mm around"


# --- takes of Motive


@pytest.fixture
def lines() -> list[str]:
    """A take of 25 frames of a rigid body with three markers."""
    rng = np.random.default_rng(3)
    bench = takes.make_bench(rng, frames=25, noise=0.0)
    bench = takes.track(bench, "Socket", takes.SOCKET_NAMES, Pose(np.eye(3), np.zeros(3)))
    return takes.motive_lines(bench.take)


def changed(old: str, new: str, at: int = 0) -> Callable[[list[str]], list[str]]:
    """Replaces a text in one line."""

    def change(lines: list[str]) -> list[str]:
        assert old in lines[at]
        return [*lines[:at], lines[at].replace(old, new, 1), *lines[at + 1 :]]

    return change


AGAIN = "export the take from Motive again"
WITH_HEADER = "export the take to CSV from Motive, with the header information"
TAKES: dict[str, tuple[Callable[[list[str]], list[str]], str]] = {
    "another file": (
        lambda lines: ["a,b", "1,2"],
        f"is not a Motive export, which begins with 'Format Version': {WITH_HEADER}",
    ),
    "no titles": (
        lambda lines: lines[:4],
        "has no rows of types, names, properties and axes above its frames: " + WITH_HEADER,
    ),
    "no frame": (lambda lines: lines[:6] if "Frame" in lines[5] else lines[:7], "holds no frame"),
    "no unit": (changed("Length Units,", "Length,"), f"the header has no 'Length Units': {AGAIN}"),
    "no version": (
        changed("Format Version,1.21", "Format Version,"),
        f"the header has no 'Format Version': {AGAIN}",
    ),
    "angles": (
        changed("Type,Quaternion", "Type,XYZ"),
        "has rotations of the type XYZ: export quaternions",
    ),
    "furlongs": (
        changed("Units,Meters", "Units,Furlongs"),
        "has lengths in 'Furlongs': export metres, centimetres or millimetres",
    ),
    "local": (
        changed("Space,Global", "Space,Local"),
        "has coordinates in the space 'Local': export global coordinates",
    ),
    "old": (changed("1.21", "1.19"), "has the format version 1.19: use 1.20 to 1.25"),
    "no rate": (
        changed("Export Frame Rate,120.000000", "Export Frame Rate,0"),
        f"has no frame rate in its header: {AGAIN}",
    ),
}


@pytest.mark.parametrize("case", TAKES)
def test_a_take_is_refused_with_this_line(case: str, lines: list[str], tmp_path: Path) -> None:
    change, expected = TAKES[case]
    path = takes.write_lines(change(lines), tmp_path / "take.csv")
    found = line(lambda: motive.read_motive_csv(path))
    assert found == f"{path}: {expected}" + (f": {AGAIN}" if case == "no frame" else "")


def test_a_folder_is_no_take(tmp_path: Path) -> None:
    assert line(lambda: motive.read_motive_csv(tmp_path)) == (
        f"{tmp_path}: is a folder; a trial holds the two triads but no landmarks: record a static"
        " take with landmark markers in Motive and export it to CSV"
    )


def take(**changes: Any) -> motive.MotiveTake:
    """A take with two measured markers, one solved and one of two names."""
    here = np.zeros((30, 3))
    given: dict[str, Any] = {
        "path": Path("take.csv"), "version": "1.21", "frame_rate": 120.0, "units": "Meters",
        "frames": np.arange(30), "times": np.arange(30) / 120.0, "bodies": {},
        "markers": {"Socket:Marker1": here, "Unlabeled:7": here}, "solved": {"Socket_2": here},
        "doubled": frozenset({"Socket:Marker3"}), "notes": (),
    }  # fmt: skip
    return motive.MotiveTake(**given | changes)


MISSING = {
    "Socket_2": (
        "take.csv: 'Socket_2' is where a rigid body expects a marker, not a measured one: export"
        " the take with its markers ('Markers' in Motive's export)"
    ),
    "Socket:Marker3": "take.csv: the name 'Socket:Marker3' occurs twice: rename one in Motive",
    "Sockt:Marker1": ("take.csv: has no marker 'Sockt:Marker1': did you mean 'Socket:Marker1'?"),
    "Unlabeled:8": "take.csv: has no marker 'Unlabeled:8': use one of Socket:Marker1",
}


@pytest.mark.parametrize("name", MISSING)
def test_a_missing_marker_has_this_line(name: str) -> None:
    assert line(lambda: take().stack([name])) == MISSING[name]


def test_a_missing_body_has_this_line() -> None:
    assert line(lambda: take().body("Socket")) == (
        "take.csv: has no rigid body 'Socket': use one of (none)"
    )


NOTED: dict[str, tuple[Callable[[list[str]], list[str]], list[str]]] = {
    "whole": (lambda lines: lines, []),
    "newest": (changed("1.21", "1.25"), []),
    "newer": (changed("1.21", "1.26"), ["the format version 1.26 is not known; read as 1.25"]),
    "shorter": (lambda lines: lines[:-2], ["holds 23 frames, 25 were exported"]),
    "cut": (
        lambda lines: [*lines[:-1], lines[-1].rpartition(",")[0]],
        [
            "line {last}, the last, is cut short; it is left out",
            "holds 24 frames, 25 were exported",
        ],
    ),
}


@pytest.mark.parametrize("case", NOTED)
def test_a_take_has_these_notes(case: str, lines: list[str], tmp_path: Path) -> None:
    change, notes = NOTED[case]
    path = takes.write_lines(change(lines), tmp_path / "take.csv")
    expected = tuple(f"{path}: {note.format(last=len(lines))}" for note in notes)
    assert motive.read_motive_csv(path).notes == expected


# --- landmarks and stillness


def document(**changes: Any) -> dict[str, Any]:
    names = {"socket": ["S1", "S2", "S3"], "pylon": ["P1", "P2", "P3"]}
    cell = {"C1": [0.0, 0.0, 0.0], "C2": [0.1, 0.0, 0.0], "C3": [0.0, 0.1, 0.0]}
    limb = {"L1": [0.0, 0.0, 0.0], "L2": [0.1, 0.0, 0.0], "L3": [0.0, 0.1, 0.0]}
    return {"bodies": names, "load_cell": cell, "limb": limb} | changes


DOCUMENTS = {
    "twice": (
        document(bodies={"socket": ["S1", "S2", "S3"], "pylon": ["P1", "P2", "P1"]}),
        "bodies: pylon names a marker twice: name each marker once",
    ),
    "two landmarks": (
        document(limb={"L1": [0.0, 0.0, 0.0], "L2": [0.1, 0.0, 0.0]}),
        "limb: 2 landmarks hold no frame: give 3 or more that are not on one line",
    ),
    "both sides": (
        document(limb={"L1": [0.0, 0.0, 0.0], "C2": [0.1, 0.0, 0.0], "L3": [0.0, 0.1, 0.0]}),
        "'C2' is on the socket's side and on the limb's: name each marker on one side",
    ),
}


@pytest.mark.parametrize("case", DOCUMENTS)
def test_wrong_landmarks_have_this_line(case: str, tmp_path: Path) -> None:
    given, expected = DOCUMENTS[case]
    path = takes.write_landmarks(given, tmp_path / "l.yaml")
    assert line(lambda: registration.read_landmarks(path)) == f"{path}: {expected}"


CELL = 1e-3 * np.array([[0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 3, 0]])

LANDMARKS = {
    "two": (
        CELL[:2],
        "2 landmarks (A, B) hold no frame: give 3 or more that are not on one line",
    ),
    "near": (CELL, "landmarks A and D are given 3.0 mm apart: give landmarks far from each other"),
    "line": (
        1e-3 * np.array([[0, 0, 0], [100, 0, 0], [200, 3, 0]]),
        "landmarks A, B, C are given on one line (within 0.7 mm): move one of them away from the"
        " line of the others",
    ),
}


@pytest.mark.parametrize("case", LANDMARKS)
def test_landmarks_without_a_frame_have_this_line(case: str) -> None:
    known, expected = LANDMARKS[case]
    names = "ABCD"[: len(known)]
    assert line(lambda: registration.register_landmarks(known, known, names)) == expected


def markers(frames: int = 60) -> np.ndarray:
    """Three still markers, (frames, 3, 3) [m]."""
    return np.tile(1e-3 * np.array([[0.0, 0, 0], [80, 0, 0], [0, 60, 0]]), (frames, 1, 1))


def average(positions: np.ndarray, unlike: int = 0) -> registration.StillMarkers:
    """Averages them; in the last frames of the take the distances are not the usual ones."""
    fits = np.arange(len(positions)) < len(positions) - unlike
    return registration.average_still("ABC", positions, fits, "take.csv: socket")


def test_too_few_whole_frames_have_this_line() -> None:
    positions = markers()
    positions[:38, 1], positions[:5, 2] = np.nan, np.nan
    assert line(lambda: average(positions, 4)) == (
        "take.csv: socket: 18 of 60 frames show all of A, B, C (B is occluded in 38, the distances"
        " are not the usual ones in 4): record 20 frames or more in which the cameras see them all"
    )
    average(positions, 2)


def test_a_marker_that_jumps_has_this_line() -> None:
    positions = markers()
    positions[:7, 2, 0] += 0.0051
    assert line(lambda: average(positions)) == (
        "take.csv: socket: in 7 of 60 frames a marker, mostly C, is more than 5 mm from its usual"
        " place: record a take in which nothing moves, and check its labels"
    )
    positions[6] = markers(1)
    assert average(positions).jumped == 6


@pytest.mark.parametrize("away", [1.1, 0.9], ids=["1.1 mm", "0.9 mm"])
def test_a_drift_has_its_limit(away: float) -> None:
    """The first third is at rest, the last so far off; none is between."""
    positions = markers()
    positions[30:, 0, 1] += 1e-3 * away
    if away < 1.0:
        assert average(positions).notes == (
            "A drifted by 0.90 mm over the take",
            "A moved about by 0.45 mm over the take",
        )
        return
    assert line(lambda: average(positions)) == (
        "take.csv: socket: A drifted by 1.10 mm over the take (at most 1 mm): record a take in"
        " which nothing moves, or export its still part"
    )


def test_unseen_markers_have_this_line() -> None:
    unseen = np.full((5, 3, 3), np.nan)
    assert line(lambda: registration.fit_labels(unseen, "take.csv: pylon")) == (
        "take.csv: pylon: no frame shows all 3 markers: check their labels in Motive"
    )


@pytest.mark.parametrize("tracked", [14, 15], ids=["14 of 30", "half"])
def test_a_body_is_tracked_in_half_of_the_frames(tracked: int) -> None:
    body = Pose(np.tile(np.eye(3), (30, 1, 1)), np.zeros((30, 3)))
    body.translation[tracked:] = np.nan
    if tracked == 15:
        found = registration.tracked_frame(markers(30), body, "take.csv: pylon")
        assert found.translation == pytest.approx(np.zeros(3))
        return
    assert line(lambda: registration.tracked_frame(markers(30), body, "take.csv: pylon")) == (
        "take.csv: pylon: Motive tracked its rigid body in 14 of 30 frames that show its markers:"
        " name its markers instead of 'rigid_body'"
    )


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("Socket", "1 measured markers in the take (Socket:Marker1)"),
        ("Pylon", "0 measured markers in the take (none)"),
    ],
    ids=["one", "none"],
)
def test_a_body_with_few_markers_has_this_line(name: str, shown: str) -> None:
    bodies = {"Socket": Pose(np.eye(3), np.zeros(3)), "Pylon": Pose(np.eye(3), np.zeros(3))}
    found = line(lambda: registration._markers_of(take(bodies=bodies), name, "take.csv: a"))
    assert found == (
        f"take.csv: a: the rigid body '{name}' has {shown}: export its markers, or name 3 to 8"
        " of them instead of 'rigid_body'"
    )


@pytest.mark.parametrize(
    ("height", "aside", "inside"),
    [(-0.029, 0.0, True), (-0.031, 0.0, False), (0.029, 0.0, True), (0.031, 0.0, False),
     (0.0, 0.029, True), (0.0, 0.031, False)],
    ids=["low", "too low", "high", "too high", "aside", "too far aside"],
)  # fmt: skip
def test_a_limb_is_within_30_mm_of_the_tiles(height: float, aside: float, inside: bool) -> None:
    """Beyond the lowest tile, the highest one, and the one farthest from the axis."""
    geometry = scene.geometry()
    axis = socket_axis(geometry)
    up = axis.proximal
    highest, widest = axis.heights(geometry.anchors).max(), axis.radii(geometry.anchors).max()
    across = np.cross(up, Y)
    across /= np.linalg.norm(across)
    base = highest if height > 0.0 else 0.0
    limb = axis.end + (base + height) * up
    if aside:
        limb = axis.end + 0.5 * highest * up + (widest + aside) * across
    call = lambda: registration._require_limb_in_socket(limb, geometry, "l.yaml")  # noqa: E731
    if inside:
        call()
        return
    assert ", outside the socket: check the signs" in line(call)


def test_a_limb_outside_has_this_line() -> None:
    """The scene's tiles: 30 mm beyond them are allowed."""
    geometry = scene.geometry()
    assert line(
        lambda: registration._require_limb_in_socket(
            np.array([0.01, -0.02, -0.5]), geometry, "l.yaml: load_cell"
        )
    ) == (
        "l.yaml: load_cell: the limb would be at (10, -20, -500) mm of {S}, outside the socket:"
        " check the signs of the landmarks' coordinates, and that the take has right-handed axes,"
        " or accept it with --force"
    )
