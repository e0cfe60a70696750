"""The verb `tile` on a box whose tiles are known, and what it says of a tiling by hand.

The box is 84 mm deep (x), 100 mm wide (y) and 80 mm high, open at the top; its floor is to be 60 mm
above the load cell. A tile of 45 mm fits once on the left and right walls and twice on the anterior
and posterior walls and on the floor. All are under clusters but one: the second tile on the floor.

The scan is in mm and lies: its x is proximal, its y posterior, its z towards the right.
"""

import io
import math
import struct
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import trimesh
from support import meshes, scene
from support.pages import Page

import socket_testbed as st
from socket_testbed.__main__ import run
from socket_testbed.errors import ConfigurationError, ScanError
from socket_testbed.figures.tiles import socket_figure
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.regions import SocketAxis
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.socket_design.clusters import ClusterPlace, LaidCluster
from socket_testbed.socket_design.design import (
    Placement,
    SocketDesign,
    nominal_places,
    place_by_directions,
    place_by_points,
    tile_names,
)
from socket_testbed.socket_design.interior import find_interior, refuse_implausible
from socket_testbed.socket_design.scan_file import Scan, read_scan
from socket_testbed.socket_design.squares import Squares
from socket_testbed.socket_design.tiling import Tiling, TilingSettings, tile_interior

X, Y, Z = np.eye(3)
DEPTH, WIDTH, HEIGHT, FLOOR = 0.084, 0.100, 0.080, 0.060
# Of a cluster's tile: centre in {S} [mm], its x and its inward z in {S}
TILES = {
    "ant_left": ((42, 24, 110), (0, 0, 1), (-1, 0, 0)),
    "ant_right": ((42, -25, 110), (0, 0, 1), (-1, 0, 0)),
    "post_left": ((-42, 24, 85), (0, 0, 1), (1, 0, 0)),
    "post_right": ((-42, -25, 85), (0, 0, 1), (1, 0, 0)),
    "right": ((0, -50, 105), (0, 0, 1), (0, 1, 0)),
    "distal": ((0, 25, 60), (1, 0, 0), (0, 0, 1)),
}
# `left` is asked 62 mm above the floor, where the brim would cut it; `ant_right` 3 mm inside the
# wall; `post_left` by its place in the scan; `right` is turned from the tile's x to its y.
PLACES = """
clusters:
  ant_left: {point: [0.042, 0.024, 0.110]}
  ant_right: {point: [0.039, -0.025, 0.110]}
  post_left: {scan: [425.0, 142.0, -224.0]}
  post_right: {point: [-0.042, -0.025, 0.085]}
  left: {point: [0.0, 0.050, 0.122]}
  right: {anchor: [0.0, -0.050, 0.105], frame: [[1, 0, 0], [0, 0, 1], [0, -1, 0]]}
  distal: {point: [0.0, 0.025, 0.060]}
"""


def box(depth: float, width: float, height: float, floor: bool = True) -> trimesh.Trimesh:
    """Four walls, normals inwards, with a floor at z = 0."""
    whole = trimesh.creation.box((depth, width, height))
    kept = whole.face_normals[:, 2] < (0.5 if floor else -0.5)
    kept = np.abs(whole.face_normals[:, 2]) < 0.5 if not floor else kept
    mesh = trimesh.Trimesh(whole.vertices + 0.5 * height * Z, whole.faces[kept][:, ::-1])
    for _ in range(3):
        mesh = mesh.subdivide()
    return mesh


def lying(points: np.ndarray) -> np.ndarray:
    """x proximal, y posterior, z towards the right, and away from the origin."""
    turned = np.stack([points[:, 2], -points[:, 0], -points[:, 1]], axis=1)
    return turned + np.array([0.4, 0.1, -0.2])


class Tiled:
    """What one run of the verb left behind."""

    def __init__(self, output: Path, out: str, err: str) -> None:
        self.geometry: SocketGeometry = read_socket(output)
        rows = (line.split("  ", 1) for line in out.splitlines() if "  " in line)
        self.facts = {name: fact.strip() for name, fact in rows}
        self.notes = [line.removeprefix("note: ") for line in err.splitlines()]
        self.page = Page(output.with_suffix(".html").read_text(encoding="utf-8"))
        self.data: dict[str, Any] = msgspec.json.decode(self.page.script("page-data"))

    def tile(self, cluster: str) -> int:
        return self.geometry.clusters[cluster]

    @property
    def free(self) -> int:
        """The only tile without a cluster."""
        (tile,) = set(range(len(self.geometry))) - set(self.geometry.clusters.values())
        return tile


@pytest.fixture(scope="module")
def tiled(tmp_path_factory: pytest.TempPathFactory) -> Tiled:
    folder = tmp_path_factory.mktemp("tiled")
    scan = meshes.write_stl(meshes.moved(box(DEPTH, WIDTH, HEIGHT), lying), folder / "box.stl")
    (folder / "clusters.yaml").write_text(PLACES)
    words = ["tile", str(scan), "-o", str(folder / "socket.yaml"), "--anterior=-y"]
    words += ["--height", "60", "--size", "45", "--flatness", "2", "--rounds", "0"]
    words += ["--clusters", str(folder / "clusters.yaml")]
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        assert run(words) == 0, err.getvalue()
    return Tiled(folder / "socket.yaml", out.getvalue(), err.getvalue())


# --- the socket file


@pytest.mark.parametrize("cluster", TILES)
def test_a_tile_lies_on_its_wall(cluster: str, tiled: Tiled) -> None:
    """Its z points into the socket, its x towards proximal, on the floor towards anterior."""
    centre, along, inward = TILES[cluster]
    tile = tiled.tile(cluster)
    assert tiled.geometry.names[tile] == cluster
    assert 1e3 * tiled.geometry.anchors[tile] == pytest.approx(centre, abs=0.01)
    frame = tiled.geometry.rotations[tile]
    assert frame[:, 0] == pytest.approx(along, abs=1e-3)
    assert frame[:, 2] == pytest.approx(inward, abs=1e-3)
    assert frame[:, 1] == pytest.approx(np.cross(inward, along), abs=1e-3)


def test_every_tile_has_its_square_s_area(tiled: Tiled) -> None:
    assert tiled.geometry.areas.tolist() == pytest.approx([45e-3**2] * 8)


def test_a_turned_cluster_leaves_its_tile_upright(tiled: Tiled) -> None:
    assert tiled.geometry.turned == pytest.approx({"right": 0.5 * math.pi}, abs=1e-3)


def test_a_cluster_over_the_brim_is_lowered(tiled: Tiled) -> None:
    """Its upper edge is at most at the brim, 140 mm above the load cell: its centre at 117.5 mm."""
    x, y, z = 1e3 * tiled.geometry.anchors[tiled.tile("left")]
    assert y == pytest.approx(50.0, abs=1e-6)
    assert 114.5 < z <= 117.5 and abs(x) < 5.0


def test_the_free_tile_fills_the_floor(tiled: Tiled) -> None:
    """Beside the tile that reaches to y = 2.5 mm; named by height and angle in degrees."""
    x, y, z = 1e3 * tiled.geometry.anchors[tiled.free]
    assert -19.5 <= x <= 19.5 and -27.5 <= y <= -20.0 and z == pytest.approx(60.0)
    angle = round(math.degrees(math.atan2(y, x))) % 360
    assert tiled.geometry.names[tiled.free] == f"h000_a{angle}"


def test_tiles_side_by_side_are_neighbours(tiled: Tiled) -> None:
    """Across an edge of the box the walls do not face each other."""
    names = tiled.geometry.names
    found = {frozenset(names[tile] for tile in pair) for pair in tiled.geometry.neighbours}
    floor = frozenset({"distal", names[tiled.free]})
    assert found == {
        frozenset({"ant_left", "ant_right"}),
        frozenset({"post_left", "post_right"}),
        floor,
    }


def test_the_scan_s_frame_is_stored(tiled: Tiled) -> None:
    """The floor's centre is at x = 400 mm in the scan."""
    scan = tiled.geometry.scan
    assert scan is not None and scan.unit == 0.001
    picked = np.array([[400.0, 100.0, -200.0], [480.0, 58.0, -250.0]])
    known = np.array([[0.0, 0.0, 0.060], [0.042, 0.050, 0.140]])
    np.testing.assert_allclose(scan.points(picked), known, atol=1e-6)


# --- the terminal

NOTES = (
    "inferred unit mm: the body is 0.1 m long",
    "edges of the surface left open: 1, 368 mm around",  # 2 (84 + 100)
    "the scan is one surface: all of it is the interior, 378 cm2",  # 2 * 80 + 2 * 67.2 + 84
    "openings: 1, the brim first, 368 mm around",
    "the marker bodies are nominal, and every limb position depends on them: register them",
)
FACTS = {
    "scan": "body 0, 640 faces, in mm (inferred)",
    "{S}": "z proximal, x given as anterior, the distal end's lowest point 60 mm above the load"
    " cell: nominal",
    "tiles": "8 of 45 x 45 mm",
    "upper bound": "18.7 tiles by area: 43 % reached",  # 378.4 / 20.25, 8 * 20.25 / 378.4
    "flatness": "the surface is within 0.0 mm of every tile's plane (median 0.0, limit 2)",
    "neighbours": "3 pairs",
    "cluster ant_right": "asked at (39.0, -25.0, 110.0), laid at (42.0, -25.0, 110.0) mm of {S},"
    " 3.0 mm away",
    "cluster post_left": "asked at (-42.0, 24.0, 85.0), laid at (-42.0, 24.0, 85.0) mm of {S},"
    " 0.0 mm away",
    "cluster right": "asked at (0.0, -50.0, 105.0), laid at (0.0, -50.0, 105.0) mm of {S},"
    " 0.0 mm away, turned by 90.0 deg",
    "cluster distal": "asked at (0.0, 25.0, 60.0), laid at (0.0, 25.0, 60.0) mm of {S},"
    " 0.0 mm away",
}


@pytest.mark.parametrize("note", NOTES, ids=["unit", "edges", "interior", "brim", "bodies"])
def test_the_verb_notes_what_it_found(note: str, tiled: Tiled) -> None:
    assert note in tiled.notes


def test_the_verb_notes_a_cluster_that_was_moved(tiled: Tiled) -> None:
    """By 4.5 mm in height, and some to the side."""
    start = "no tile fits at cluster left: the nearest one is "
    (note,) = (note for note in tiled.notes if note.startswith(start))
    assert note.endswith(" mm off")
    assert 4.5 <= float(note.removeprefix(start).removesuffix(" mm off")) < 8.0
    assert not any("no tile fits at cluster right" in note for note in tiled.notes)


@pytest.mark.parametrize("fact", FACTS)
def test_the_verb_prints_the_known_facts(fact: str, tiled: Tiled) -> None:
    assert tiled.facts[fact] == FACTS[fact]


def test_the_verb_prints_what_is_covered(tiled: Tiled) -> None:
    """Below 57.5 mm over the floor there are 295.6 cm^2, of tiles at least 131.9 cm^2.

    On the floor 40.5, posterior 40.5, on the right 45 * 35, anterior 2 * 45 * 30 mm^2; on the left
    45 mm * (22.5 to 25.5 mm).
    """
    start, middle, end = tiled.facts["covered"].partition(
        "162 of 378 cm^2 of the interior (43 %); "
    )
    assert (start, bool(middle)) == ("", True)
    share, _, words = end.partition(" ")
    assert words == "% of the area more than 22.5 mm from its rim"
    assert int(share) == pytest.approx(45, abs=2)


def test_the_verb_prints_the_largest_gap(tiled: Tiled) -> None:
    """32.5 mm over the tiles posterior; sqrt(13^2 + 32.5^2) = 35 mm if there were no left one."""
    gap = tiled.facts["largest gap"].removesuffix(" mm from the nearest tile")
    assert 31 <= int(gap) <= 36


# --- the page


def test_the_page_shows_areas_and_heights_in_millimetres(tiled: Tiled) -> None:
    extras = tiled.data["extras"]
    assert extras["area [mm^2]"] == {"values": [2025.0] * 8, "unit": "mm\N{SUPERSCRIPT TWO}"}
    heights = extras["height [mm]"]
    assert heights["unit"] == "mm"
    known = {"ant_left": 50.0, "post_left": 25.0, "right": 45.0, "distal": 0.0}
    found = {name: heights["values"][tiled.tile(name)] for name in known}
    assert found == pytest.approx(known, abs=0.1)


def test_the_page_shows_the_surface_in_millimetres(tiled: Tiled) -> None:
    points = np.array(tiled.data["socket"]["surface"]["points"])
    np.testing.assert_allclose(points.min(axis=0), [-42.0, -50.0, 60.0], atol=0.1)
    np.testing.assert_allclose(points.max(axis=0), [42.0, 50.0, 140.0], atol=0.1)


def test_the_page_repeats_the_facts(tiled: Tiled) -> None:
    rows = tiled.page.rows("facts")
    assert rows.pop("name") == ["value"]
    assert {name: row[0] for name, row in rows.items()} == tiled.facts
    assert "box.stl: 8 tiles" in tiled.page.text
    assert "lengths in mm in {S}, the frame of the load cell" in tiled.page.text


def test_the_picture_names_its_sides() -> None:
    """Seen from outside left is at +90 degrees; in the distal end right is on the right."""
    wall, end = socket_figure(scene.geometry()).axes
    sides = [label.get_text().splitlines() for label in wall.get_xticklabels()]
    assert [side[1] for side in sides] == ["posterior", "right", "anterior", "left", "posterior"]
    assert [side[0].strip("\N{MINUS SIGN}°") for side in sides] == ["180", "90", "0", "90", "180"]
    assert wall.get_ylabel() == "height [mm]"
    assert (end.get_xlabel(), end.get_ylabel()) == ("towards right [mm]", "towards anterior [mm]")
    names = {text.get_text().replace("\n", ""): text.get_position() for text in wall.texts}
    assert names["left_mid"] == pytest.approx((90.0, 60.0), abs=0.5)
    on_end = {text.get_text().replace("\n", ""): text.get_position() for text in end.texts}
    assert on_end["right_end"] == pytest.approx((20.0, 0.0), abs=0.5)
    assert on_end["ant_end"] == pytest.approx((0.0, 20.0), abs=0.5)


# --- the facts of a tiling by hand


def by_hand(cover_inside: float = 0.79) -> SocketDesign:
    """The scene's 12 tiles, said to lie on 200 cm^2 and to cover 9.5 cm^2 each."""
    geometry = scene.geometry()
    tiling = Tiling(
        squares=Squares(geometry.anchors, geometry.rotations, 0.030),
        footprint_areas=np.full(12, 9.5e-4),
        flatness=1e-3 * np.array([1.0] * 6 + [3.0] * 5 + [6.1]),
        neighbours=geometry.neighbours,
        interior_area=0.02,
        cover_inside=cover_inside,
        largest_gap=0.0234,
        clusters=(LaidCluster("distal", Z, Z, Z, 0.0),),
    )
    mesh = box(DEPTH, WIDTH, HEIGHT)
    scan = Scan(mesh, "liner", "in", "stated", ())
    placement = Placement(Pose(np.eye(3), np.zeros(3)), "by hand")
    settings = TilingSettings()
    return SocketDesign("a.stl", scan, mesh, placement, tiling, geometry, settings, ())


BY_HAND = {
    "scan": "body liner, 640 faces, in in (stated)",
    "{S}": "by hand",
    "tiles": "12 of 30 x 30 mm",
    "covered": "114 of 200 cm^2 of the interior (57 %); 79 % of the area more than 15 mm from its"
    " rim",
    "upper bound": "22.2 tiles by area: 54 % reached",  # 200 / 9; 12 / 22.2
    "largest gap": "23 mm from the nearest tile",
    "flatness": "the surface is within 6.1 mm of every tile's plane (median 2.0, limit 8)",
    "neighbours": "20 pairs",
    "cluster brim_lateral": "placed at (0.0, -50.0, 210.0) mm of {S}",
    "cluster mid_anterior": "placed at (50.0, 0.0, 150.0) mm of {S}",
    "cluster distal": "asked at (0.0, 0.0, 1000.0), laid at (0.0, 0.0, 1000.0) mm of {S}, 0.0 mm"
    " away",
}


@pytest.mark.parametrize("fact", BY_HAND)
def test_the_facts_have_their_units(fact: str) -> None:
    assert dict(by_hand().facts())[fact] == BY_HAND[fact]


def test_a_design_is_shown_in_one_line() -> None:
    assert repr(by_hand()) == "SocketDesign(a.stl: 12 tiles on 57 % of 200 cm^2)"


def test_a_socket_without_clusters_says_so() -> None:
    design = by_hand()
    bare = replace(design, geometry=replace(design.geometry, clusters={}, turned={}))
    assert dict(bare.facts())["clusters"] == "none"
    assert "clusters" not in dict(design.facts())


def test_a_narrow_interior_has_no_inner_share() -> None:
    fact = dict(by_hand(cover_inside=math.nan).facts())["covered"]
    assert (
        fact == "114 of 200 cm^2 of the interior (57 %); none of it is more than 15 mm from its rim"
    )


def test_a_round_wall_s_tile_has_its_area(tmp_path: Path) -> None:
    """On a radius of 50 mm the wall under 45 mm is 2 * 50 mm * asin(0.45) = 46.68 mm wide.

    At its edges it is 50 mm - sqrt(50^2 - 22.5^2) mm = 5.3 mm off the tile's plane.
    """
    wall = meshes.open_cone(0.05, 0.05, 0.05, 0.005, closed=False)
    (tmp_path / "clusters.yaml").write_text("clusters: {front: {point: [0.05, 0.0, 0.105]}}")
    design = st.tile(
        meshes.write_stl(wall, tmp_path / "ring.stl"),
        unit="mm",
        proximal="+z",
        anterior="+x",
        clusters=tmp_path / "clusters.yaml",
        settings=TilingSettings(0.045, 0.008, 0),
    )
    assert design.geometry.areas == pytest.approx(20.25e-4)
    assert design.tiling.footprint_areas == pytest.approx(21.0e-4, rel=0.01)
    covered = len(design.geometry) * 21.0e-4 / design.tiling.interior_area
    assert design.geometry.tile_share == pytest.approx(covered, rel=0.01)
    assert design.tiling.flatness.max() == pytest.approx(5.3e-3, abs=6e-4)


def test_a_narrow_strip_has_no_inside() -> None:
    """Nothing on a strip of 45 mm is more than 22.5 mm from its rims."""
    strip = box(DEPTH, WIDTH, 0.045, floor=False)
    place = ClusterPlace("front", np.array([0.042, 0.0, 0.0225]), None, "front")
    found = tile_interior(strip, Z, X, TilingSettings(0.045, 0.002, 0), clusters=[place])
    assert math.isnan(found.cover_inside)
    assert found.interior_area == pytest.approx(165.6e-4)  # 368 * 45 mm^2
    assert found.footprint_areas[0] == pytest.approx(20.25e-4)
    assert found.cover == pytest.approx(len(found.footprint_areas) * 20.25 / 165.6, rel=0.02)


def test_a_cluster_is_laid_at_some_distance() -> None:
    """3, 4 and -12 mm from its place on the wall, 5 mm from where it was asked."""
    asked, surface, anchor = 1e-3 * np.array([[10, 20, 30], [10, 20, 42], [13, 24, 30]])
    laid = LaidCluster("a", asked, surface, anchor, -0.5)
    assert laid.moved == pytest.approx(0.013)
    assert str(laid) == (
        "asked at (10.0, 20.0, 30.0), laid at (13.0, 24.0, 30.0) mm of {S}, 5.0 mm away, turned by"
        " -28.6 deg"
    )


# --- names, usual places, and {S} in the scan

AXIS = SocketAxis(np.array([0.0, 0.0, 0.06]), Z, X)


def test_a_tile_is_named_by_height_and_angle() -> None:
    """mm above the distal end, degrees from anterior towards left; twins get a letter."""
    places = [(35, 35, 152), (0, -50, 60), (35, 35, 152), (-50, 0, 59), (50, -0.1, 78.4)]
    assert tile_names(1e-3 * np.array(places), AXIS) == (
        *("h092_a045", "h000_a270", "h092_a045b"),
        *("h000_a180", "h018_a000"),
    )


# Centres of tiles [mm], the clusters whose usual places they are
USUAL = {
    "left brim": ((0, 50, 180), "brim_lateral"),
    "right brim": ((0, -50, 180), None),
    "ant mid": ((50, 0, 132), "mid_anterior"),
    "ant low": ((50, 0, 84), None),
    "post mid": ((-50, 0, 132), None),
    "post low": ((-50, 0, 84), "posterior_distal"),
    "end": ((10, 0, 60), "distal"),
    "end aside": ((-35, 0, 60), None),
    "left low": ((0, 50, 84), None),
}


def usual(*left_out: str) -> Squares:
    places = [place for name, (place, _) in USUAL.items() if name not in left_out]
    return Squares(1e-3 * np.array(places), np.tile(np.eye(3), (len(places), 1, 1)), 0.030)


def test_clusters_go_to_their_usual_places() -> None:
    """60 % and 20 % of the height of 120 mm are 72 and 24 mm."""
    known = {cluster: row for row, (_, cluster) in enumerate(USUAL.values()) if cluster}
    assert nominal_places(usual(), AXIS) == known


@pytest.mark.parametrize(
    ("left_out", "fact"),
    [
        (("post low", "end aside"), "posterior_distal 72 mm above the distal end and 0 deg from"),
        (("left brim", "left low"), "brim_lateral 72 mm above the distal end and 90 deg from"),
        (("end", "end aside"), "distal 24 mm above the distal end"),
    ],
    ids=["height", "angle", "end"],
)
def test_a_usual_place_that_is_missing_is_named(left_out: tuple[str, ...], fact: str) -> None:
    with pytest.raises(ConfigurationError) as found:
        nominal_places(usual(*left_out), AXIS)
    assert fact in found.value.fact


@pytest.mark.parametrize(
    ("proximal", "anterior", "x_in_scan", "how"),
    [(Z, None, X, "assumed"), (X, None, Y, "assumed"), (-Z, -Y, -Y, "given as")],
    ids=["upright", "lying", "upside down"],
)
def test_the_load_cell_is_below_the_distal_end(
    proximal: np.ndarray, anterior: np.ndarray | None, x_in_scan: np.ndarray, how: str
) -> None:
    """The middle of a cube of 100 mm is 50 mm above the distal end, that 80 mm above {S}."""
    corners = 0.1 * np.array([[i, j, k] for i in (1, 2) for j in (1, 2) for k in (1, 2)])
    placement = place_by_directions(corners, proximal, anterior, 0.08)
    pose, middle = placement.scan_in_load_cell, np.full(3, 0.15)
    assert pose.apply(middle) == pytest.approx([0.0, 0.0, 0.13])
    assert pose.apply(middle + 0.02 * x_in_scan) == pytest.approx([0.02, 0.0, 0.13])
    assert pose.apply(middle + 0.05 * proximal) == pytest.approx([0.0, 0.0, 0.18])
    assert placement.source == (
        f"z proximal, x {how} anterior, the distal end's lowest point 80 mm above the load cell:"
        " nominal"
    )


def test_picked_points_are_origin_x_and_y() -> None:
    placement = place_by_points(np.array([[1.0, 2.0, 3.0], [1.0, 2.0, 4.0], [2.0, 2.0, 3.5]]))
    pose = placement.scan_in_load_cell
    assert pose.apply(np.array([1.0, 2.0, 3.0])) == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)
    assert pose.apply(np.array([1.0, 2.0, 4.0])) == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)
    assert pose.apply(np.array([2.0, 2.0, 3.0])) == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)
    assert pose.apply(np.array([1.0, 3.0, 3.0])) == pytest.approx([0.0, 0.0, 1.0], abs=1e-12)
    assert placement.source == "three picked points"


@pytest.mark.parametrize("flip", [1.0, -1.0], ids=["as it lies", "turned round"])
def test_the_open_end_is_proximal(flip: float) -> None:
    mesh = meshes.moved(box(DEPTH, WIDTH, HEIGHT), lying)
    turned = meshes.moved(mesh, lambda points: points * [flip, flip, 1.0])
    found = find_interior(turned, None)
    assert found.proximal == pytest.approx([flip, 0.0, 0.0], abs=0.02)
    assert found.length == pytest.approx(HEIGHT, rel=0.02)
    assert found.mesh.area == pytest.approx(378.4e-4)


@pytest.mark.parametrize(
    ("length", "girth", "unit", "likely"),
    [(0.02, 0.04, "mm", "cm"), (20.0, 40.0, "m", "cm"), (200.0, 400.0, "m", "mm")],
    ids=["small", "large", "larger"],
)
def test_a_likely_unit_is_named(length: float, girth: float, unit: str, likely: str) -> None:
    """A cavity of 0.2 m with 0.4 m around is one; in inches it would be 1 m around."""
    with pytest.raises(ScanError) as found:
        refuse_implausible("a.stl", length, girth, unit)
    assert found.value.fact.startswith(
        f"a.stl: in {unit} its cavity is {length:g} m long and {girth:g} m around"
    )
    assert found.value.hint == f"its unit is likely {likely}: give --unit {likely}"
    refuse_implausible("a.stl", 0.2, 0.4, "mm")


# --- scan files, written by hand: a square tube of 100 x 100 mm, 200 mm long, from (5, 6, 7) mm

CORNERS = [(x, y, z) for z in (7, 207) for x, y in ((5, 6), (105, 6), (105, 106), (5, 106))]
SIDES = [(k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k) for k in range(4)]
TRIANGLES = [corners for a, b, c, d in SIDES for corners in ((a, b, c), (a, c, d))]


def ascii_stl() -> bytes:
    facets = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join("vertex {} {} {}\n".format(*CORNERS[corner]) for corner in triangle)
        + "endloop\nendfacet\n"
        for triangle in TRIANGLES
    )
    return f"solid tube\n{facets}endsolid tube\n".encode()


def binary_stl() -> bytes:
    facets = b"".join(
        struct.pack("<12fH", 0, 0, 0, *(x for corner in triangle for x in CORNERS[corner]), 0)
        for triangle in TRIANGLES
    )
    return bytes(80) + struct.pack("<I", len(TRIANGLES)) + facets


def obj() -> bytes:
    vertices = "".join("v {} {} {}\n".format(*corner) for corner in CORNERS)
    faces = "".join("f {} {} {} {}\n".format(*(1 + k for k in side)) for side in SIDES)
    return (vertices + faces).encode()


def ply() -> bytes:
    head = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\n"
    head += "property float z\nelement face 8\nproperty list uchar int vertex_indices\n"
    vertices = "".join("{} {} {}\n".format(*corner) for corner in CORNERS)
    faces = "".join("3 {} {} {}\n".format(*triangle) for triangle in TRIANGLES)
    return f"{head}end_header\n{vertices}{faces}".encode()


FILES: dict[str, tuple[str, Callable[[], bytes]]] = {
    "ascii": ("tube.stl", ascii_stl),
    "binary": ("tube.stl", binary_stl),
    "obj": ("tube.obj", obj),
    "ply": ("tube.ply", ply),
}


@pytest.mark.parametrize("kind", FILES)
def test_a_small_scan_file_is_read_in_metres(kind: str, tmp_path: Path) -> None:
    name, content = FILES[kind]
    (tmp_path / name).write_bytes(content())
    scan = read_scan(tmp_path / name)
    assert (scan.unit, scan.unit_source, scan.body) == ("mm", "inferred", "0")
    np.testing.assert_allclose(scan.mesh.bounds, [[0.005, 0.006, 0.007], [0.105, 0.106, 0.207]])
    assert scan.mesh.area == pytest.approx(0.08)
    assert len(scan.mesh.vertices) == 8 and len(scan.mesh.faces) == 8
    assert scan.notes == (
        "inferred unit mm: the body is 0.2 m long",
        "edges of the surface left open: 2, 400 mm, 400 mm around",
    )


@pytest.mark.parametrize(
    ("unit", "long"), [("m", 200.0), ("cm", 2.0), ("mm", 0.2), ("in", 5.08)], ids=str
)
def test_a_given_unit_scales_the_scan(unit: str, long: float, tmp_path: Path) -> None:
    (tmp_path / "tube.stl").write_bytes(binary_stl())
    scan = read_scan(tmp_path / "tube.stl", unit)
    assert (scan.unit, scan.unit_source) == (unit, "given")
    assert np.ptp(scan.mesh.vertices, axis=0) == pytest.approx([0.5 * long, 0.5 * long, long])
    assert scan.notes[0] == f"given unit {unit}: the body is {long:g} m long"


def test_a_scan_in_metres_is_recognised(tmp_path: Path) -> None:
    points = "".join("v {} {} {}\n".format(*(1e-3 * np.array(corner))) for corner in CORNERS)
    faces = "".join("f {} {} {}\n".format(*(1 + k for k in triangle)) for triangle in TRIANGLES)
    (tmp_path / "tube.obj").write_text(points + faces)
    scan = read_scan(tmp_path / "tube.obj")
    assert (scan.unit, scan.unit_source) == ("m", "inferred")
    assert np.ptp(scan.mesh.vertices[:, 2]) == pytest.approx(0.2)


def test_an_extent_of_neither_unit_is_listed(tmp_path: Path) -> None:
    """8 is 8 m or 8 mm: in cm it would be short, in inches a socket."""
    points = "".join("v {} {} {}\n".format(*(0.04 * np.array(corner))) for corner in CORNERS)
    faces = "".join("f {} {} {}\n".format(*(1 + k for k in triangle)) for triangle in TRIANGLES)
    (tmp_path / "tube.obj").write_text(points + faces)
    with pytest.raises(ScanError) as found:
        read_scan(tmp_path / "tube.obj")
    assert (
        "its length 8 is that of a socket, 0.1 to 0.6 m, neither in m nor in mm" in found.value.fact
    )
    assert "(8 m in m, 0.08 m in cm, 0.008 m in mm, 0.203 m in in)" in found.value.fact
