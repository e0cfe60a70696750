"""Places in the scene's socket, poses and marker bodies by hand; limits below and above."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import scene

from socket_testbed.documents import FieldError
from socket_testbed.errors import ConfigurationError
from socket_testbed.geometry import marker_bodies, pose, regions
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.regions import Region
from socket_testbed.geometry.socket import read_socket, socket_from_document, write_socket

GEOMETRY = scene.geometry()
AXIS = regions.socket_axis(GEOMETRY)
QUARTER = 0.5 * np.pi


# --- the axis


def test_the_axis_stands_on_the_lowest_tile() -> None:
    assert AXIS.end == pytest.approx([0.0, 0.0, 0.09], abs=1e-12)
    np.testing.assert_allclose(AXIS.frame, np.eye(3), atol=1e-12)


def test_places_are_about_the_axis() -> None:
    """In the tiles' order, by level: heights above 90 mm, angles from anterior towards left."""
    np.testing.assert_allclose(AXIS.heights(GEOMETRY.anchors), np.repeat([0.12, 0.06, 0.0], 4))
    np.testing.assert_allclose(AXIS.radii(GEOMETRY.anchors), np.repeat([0.05, 0.05, 0.02], 4))
    angles = np.degrees(AXIS.angles(GEOMETRY.anchors))
    assert np.abs(angles[::4]).max() < 1e-9 and angles[1::4] == pytest.approx([90.0] * 3)
    assert np.abs(angles[2::4]) == pytest.approx([180.0] * 3)
    assert angles[3::4] == pytest.approx([-90.0] * 3)


def test_an_axis_along_x_has_minus_z_anterior() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.3, 0.1, 0.2], [0.1, 0.02, 0.02]])
    axis = regions.axis_between(points, np.array([2.0, 0.0, 0.0]))
    assert axis.proximal.tolist() == [1.0, 0.0, 0.0] and axis.anterior.tolist() == [0.0, 0.0, -1.0]
    assert axis.left.tolist() == [0.0, 1.0, 0.0]
    assert axis.end == pytest.approx([0.0, 0.05, 0.1])


def test_a_slanted_axis_has_minus_z_across() -> None:
    """3 degrees from x: anterior is 3 degrees from -z, towards the proximal end's shadow."""
    slant = np.radians(3.0)
    axis = regions.axis_between(np.eye(3), np.array([np.cos(slant), 0.0, np.sin(slant)]))
    assert axis.anterior == pytest.approx([np.sin(slant), 0.0, -np.cos(slant)])


def test_anterior_is_across_the_axis() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    axis = regions.axis_between(points, np.array([0.0, 0.0, 1.0]), np.array([0.0, 3.0, 4.0]))
    assert axis.anterior == pytest.approx([0.0, 1.0, 0.0])
    assert axis.left == pytest.approx([-1.0, 0.0, 0.0])


def leaning(angles: list[float]):
    """As many tiles whose x axes lean from z towards x by such angles [deg]."""
    rotations = Rotation.from_euler("y", [[a - 90.0] for a in angles], degrees=True).as_matrix()
    return replace(GEOMETRY, rotations=rotations)


PROXIMAL = {
    # angles of the x axes from z towards x [deg], direction's angle; None: z of {S}
    "all alike": ([30.0, 30.0], 30.0),
    "the mean": ([20.0, 40.0], 30.0),
    "across, left out": ([30.0, 30.0, 30.0, 30.0, 110.0], 30.0),
    "across, kept": ([30.0, 30.0, 30.0, 30.0, 95.0], 41.5810),
    "against each other": ([0.0, 175.0], None),
}


@pytest.mark.parametrize("case", PROXIMAL)
def test_proximal_is_the_walls_mean(case: str) -> None:
    """A tile counts up to 60 degrees from the mean of all.

    95 degrees are 53 from the mean of all, 41.58; 110 are 67 from theirs, 43.28.
    """
    angles, expected = PROXIMAL[case]
    found = regions.proximal_direction(leaning(angles))
    if expected is None:
        assert found.tolist() == [0.0, 0.0, 1.0]
    else:
        assert np.degrees(np.arctan2(found[0], found[2])) == pytest.approx(expected, abs=1e-3)


def test_tiles_that_face_up_have_no_wall() -> None:
    flat = replace(GEOMETRY, rotations=np.tile(np.eye(3), (3, 1, 1)))
    assert regions.proximal_direction(flat).tolist() == [0.0, 0.0, 1.0]
    leant = Rotation.from_euler("y", [[-44.0], [-44.0], [-46.0]], degrees=True).as_matrix()
    found = regions.proximal_direction(replace(flat, rotations=leant))
    assert found[0] > 0.5  # one of them is a wall


def test_load_is_positive_downwards() -> None:
    wrench = np.array([[1.0, 2.0, 3.0, 4.0, 5.0, -60.0], [0.0, 0.0, 0.0, 0.0, 0.0, 7.0]])
    assert regions.axial_force(GEOMETRY, wrench) == pytest.approx([60.0, -7.0])


def test_the_wall_is_steep_and_apart() -> None:
    """The end faces up; a tile nearer to the axis than its own width is none."""
    assert regions.wall_tiles(GEOMETRY, AXIS).tolist() == [True] * 8 + [False] * 4
    wide = replace(GEOMETRY, areas=np.where(np.arange(12) == 2, 0.0026, GEOMETRY.areas))
    assert regions.wall_tiles(wide, AXIS).tolist()[:4] == [True, True, False, True]
    near = replace(GEOMETRY, areas=np.where(np.arange(12) == 2, 0.0024, GEOMETRY.areas))
    assert regions.wall_tiles(near, AXIS)[2]


# --- regions


def test_thirds_divide_the_heights() -> None:
    assert regions.third_edges(GEOMETRY) == pytest.approx([0.0, 0.04, 0.08, 0.12])


REGIONS = {
    # side, region, tiles: 4 per level, anterior, left, posterior, right
    "anterior": (None, "anterior", [0, 4, 8]),
    "left": (None, "left", [1, 5, 9]),
    "posterior": (None, "posterior", [2, 6, 10]),
    "right": (None, "right", [3, 7, 11]),
    "medial of a right leg": ("right", "medial", [1, 5, 9]),
    "medial of a left leg": ("left", "medial", [3, 7, 11]),
    "lateral of a left leg": ("left", "lateral", [1, 5, 9]),
    "proximal": (None, "proximal", [0, 1, 2, 3]),
    "middle": (None, "middle", [4, 5, 6, 7]),
    "distal": (None, "distal", [8, 9, 10, 11]),
    "a part": ("right", "lateral distal", [11]),
    "own": (None, "fibula", [3, 7]),
    "bare": (None, "unmeasured wall", [0, 1, 2, 5, 7, 8, 9, 11]),
    "all": (None, "socket", [*range(12)]),
}


@pytest.mark.parametrize("case", REGIONS)
def test_a_region_is_its_tiles(case: str) -> None:
    side, name, tiles = REGIONS[case]
    found = {region.name: region.tiles.tolist() for region in regions.all_regions(GEOMETRY, side)}
    assert found[name] == tiles


def test_regions_are_in_the_tables_order() -> None:
    names = [region.name for region in regions.all_regions(GEOMETRY, "right")]
    sectors = ["anterior", "posterior", "medial", "lateral"]
    heights = ["proximal", "middle", "distal"]
    parts = [f"{sector} {height}" for sector in sectors for height in heights]
    assert names == [*sectors, *heights, *parts, "tibia", "fibula", "unmeasured wall", "socket"]
    assert [r.name for r in regions.main_regions(regions.all_regions(GEOMETRY, "right"))] == [
        *(*sectors, *heights, "tibia", "fibula")
    ]
    covered = replace(GEOMETRY, clusters=dict(zip(GEOMETRY.names, range(12), strict=True)))
    assert "unmeasured wall" not in [region.name for region in regions.all_regions(covered)]


@pytest.mark.parametrize(
    ("height", "third"), [(0.1299, "distal"), (0.1301, "middle"), (0.1701, "proximal")]
)
def test_thirds_begin_above_their_edges(height: float, third: str) -> None:
    """40 and 80 mm above the distal end, which is at 90 mm."""
    anchors = GEOMETRY.anchors.copy()
    anchors[4, 2] = height
    found = regions.anatomical_regions(replace(GEOMETRY, anchors=anchors))
    assert [r.name for r in found if 4 in r.tiles] == ["anterior", third, f"anterior {third}"]


def test_a_tile_is_in_its_smallest_region() -> None:
    places = [
        Region("anterior", np.arange(6)),
        Region("brim", np.array([0, 1])),
        Region("socket", np.arange(12)),
        Region("unmeasured wall", np.array([7])),
    ]
    assert regions.part_of(places, 1) == "brim" and regions.part_of(places, 5) == "anterior"
    assert regions.part_of(places, 7) == "socket"


# --- poses


def test_a_pose_turns_then_moves() -> None:
    """A quarter turn about z and 1 m along x: (2, 0, 0) comes to (1, 2, 0)."""
    found = Pose(pose.about_z(QUARTER), np.array([1.0, 0.0, 0.0]))
    assert found.apply(np.array([2.0, 0.0, 0.0])) == pytest.approx([1.0, 2.0, 0.0])
    assert found.inverse().apply(np.array([1.0, 2.0, 0.0])) == pytest.approx([2.0, 0.0, 0.0])
    assert (found @ found).translation == pytest.approx([1.0, 1.0, 0.0])
    assert found.vector == pytest.approx([1.0, 0.0, 0.0, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    assert found.rotation_vector() == pytest.approx([0.0, 0.0, QUARTER])
    placed = found.place(np.array([[2.0, 0.0, 0.0], [0.0, 3.0, 0.5]]))
    np.testing.assert_allclose(placed, [[1.0, 2.0, 0.0], [-2.0, 0.0, 0.5]], atol=1e-12)


@pytest.mark.parametrize(("off", "refused"), [(0.9e-6, False), (1.1e-6, True)])
def test_a_frame_is_orthonormal(off: float, refused: bool) -> None:
    rows = np.eye(3)
    rows[0, 1] = off
    if not refused:
        pose.check_rotation(tuple(map(tuple, rows.tolist())), "frame")
        return
    with pytest.raises(FieldError, match="frame is not a right-handed orthonormal frame"):
        pose.check_rotation(tuple(map(tuple, rows.tolist())), "frame")


def test_files_have_nanometres() -> None:
    found = pose.pose_document(Pose(np.eye(3), np.array([0.1234567891, -1e-12, 2.0])))
    assert found == {
        "rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        "translation": [0.123456789, 0.0, 2.0],
    }
    assert str(found["translation"][1]) == "0.0"


# --- marker bodies


def triangle(base: float, height: float, foot: float) -> np.ndarray:
    """Two markers on x, and a third above it at a distance from the first's foot [mm]."""
    return 1e-3 * np.array([[0.0, 0.0, 0.0], [base, 0.0, 0.0], [foot, height, 0.0]])


BODIES = {
    # markers, fact, hint; empty: usable
    "usable": (triangle(90.0, 45.0, 30.0), "", ""),
    "near": (triangle(9.9, 45.0, 3.0), "markers 1 and 2 are 9.9 mm apart", "10 mm apart or more"),
    "near enough": (triangle(10.1, 45.0, -30.0), "", ""),
    "on a line": (
        triangle(90.0, 1.9, 30.0),
        "the markers are on one line",
        "move a marker 2 mm or more away from the line",
    ),
    "off the line": (triangle(90.0, 2.1, 30.0), "", ""),
    # Two distances must differ by twice the tolerance of 2 mm for labels to be told apart.
    "alike": (
        triangle(90.0, 60.0, 43.0),  # 73.8 and 76.2 mm
        "the markers look alike with labels 1, 2 exchanged, so swapped labels cannot be found",
        "move one of them until all its distances differ by 4 mm or more",
    ),
    "told apart": (triangle(90.0, 60.0, 41.0), "", ""),  # 72.7 and 77.5 mm
    "four on a line": (
        np.vstack([triangle(90.0, 9.0, 30.0), [[0.05, 0.004, 0.0]]]),
        "the markers are on one line",
        "10 mm or more",
    ),
    "four off the line": (np.vstack([triangle(90.0, 11.0, 30.0), [[0.05, 0.004, 0.0]]]), "", ""),
}  # fmt: skip


@pytest.mark.parametrize("case", BODIES)
def test_a_body_is_told_apart(case: str) -> None:
    markers, fact, hint = BODIES[case]
    found = marker_bodies.body_fault(markers)
    if not fact:
        assert found is None
        return
    assert found is not None and found[0] == fact and hint in found[1]


BODY = triangle(90.0, 45.0, 30.0)
QUAD = np.vstack([BODY, [[0.04, 0.02, 0.07]]])


@pytest.mark.parametrize(("off", "found"), [(1.9e-3, True), (2.1e-3, False)])
def test_distances_agree_within_2_mm(off: float, found: bool) -> None:
    """The third marker is moved along the line to the first."""
    seen = BODY.copy()
    seen[1, 0] += off
    assert bool(marker_bodies.fit_body(BODY, seen[None]).found[0]) is found


@pytest.mark.parametrize(
    ("off", "found"), [(0.6e-3, True), (1.4e-3, False)], ids=["0.6 mm", "1.4 mm"]
)
def test_three_of_four_fit_tightly(off: float, found: bool) -> None:
    """RMS of 0.5 mm at most; a fourth marker is hidden, and one of the others moved."""
    seen = QUAD.copy()
    seen[3] = np.nan
    seen[1, 0] += off
    fit = marker_bodies.fit_body(QUAD, seen[None])
    assert bool(fit.found[0]) is found
    if found:
        assert fit.order[0].tolist() == [0, 1, 2, -1]


def test_exchanged_labels_are_named() -> None:
    """Observed as 1, 0, 2, 3 and moved by 1 m."""
    fit = marker_bodies.fit_body(QUAD, (QUAD + [1.0, 0.0, 0.0])[None, [1, 0, 2, 3]])
    assert fit.order[0].tolist() == [1, 0, 2, 3]
    assert fit.pose.translation[0] == pytest.approx([1.0, 0.0, 0.0])
    assert fit.residual[0] == pytest.approx(0.0, abs=1e-9)


def test_a_mirrored_frame_is_refused() -> None:
    with pytest.raises(FieldError, match="frame is not a right-handed orthonormal frame"):
        pose.check_rotation(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)), "frame")


def test_equal_sides_match_twice() -> None:
    """A triangle with two equal sides: its labels could be either way round."""
    isosceles = marker_bodies.distances(triangle(80.0, 60.0, 40.0))
    assert len(marker_bodies._matches(isosceles, isosceles, 2e-3)) == 2
    own = marker_bodies.distances(BODY)
    assert marker_bodies._matches(own, own, 2e-3) == [((0, 0), (1, 1), (2, 2))]


SURE = {
    # pairs of markers of the body and seen, markers seen, size of the body, verdict
    "all": (((0, 0), (1, 1), (2, 2)), 3, 3, True),
    "all, exchanged": (((0, 1), (1, 0), (2, 2)), 3, 3, True),
    "three of four": (((0, 0), (1, 1), (2, 2)), 3, 4, True),
    "three of four, exchanged": (((0, 1), (1, 0), (2, 2)), 3, 4, False),
    "four of five, exchanged": (((0, 1), (1, 0), (2, 2), (3, 3)), 4, 5, True),
    "half of those seen": (((0, 0), (1, 1), (2, 2)), 6, 6, False),
}


@pytest.mark.parametrize("case", SURE)
def test_chance_is_excluded(case: str) -> None:
    match, seen, size, sure = SURE[case]
    assert marker_bodies._is_sure(match, seen, size) is sure


def test_three_exchanged_labels_are_no_pose() -> None:
    """Three of four markers may fit by chance if their labels do not agree."""
    seen = QUAD[[1, 0, 2, 3]] + [1.0, 0.0, 0.0]
    seen[3] = np.nan
    assert not marker_bodies.fit_body(QUAD, seen[None]).found.any()
    assert marker_bodies.fit_body(QUAD, seen[[1, 0, 2, 3]][None]).found.all()


def test_noise_is_per_degree_of_freedom() -> None:
    """RMS of 1 mm of 3 markers: 3 mm^2 over 3; of 4 markers: 4 mm^2 over 6; together 7 / 9."""
    order = np.array([[0, 1, 2, -1], [0, 1, 2, 3], [-1] * 4])
    residual = np.array([1e-3, 1e-3, np.nan])
    fit = marker_bodies.BodyFit(Pose(np.zeros((3, 3, 3)), np.zeros((3, 3))), residual, order)
    assert fit.noise == pytest.approx(1e-3 * np.sqrt(7.0 / 9.0))
    assert fit.found.tolist() == [True, True, False]
    assert np.isnan(replace(fit, residual=np.full(3, np.nan)).noise)


def test_a_pose_is_known_best_at_its_centroid() -> None:
    """Six markers 0.1 m along the axes: sigma^2 / 6 per axis, sigma^2 / (4 * 0.01) of rotation."""
    points = 0.1 * np.vstack([np.eye(3), -np.eye(3)]) + [1.0, 2.0, 3.0]
    found = marker_bodies.pose_uncertainty(points, 1e-3)
    assert found.centroid == pytest.approx([1.0, 2.0, 3.0])
    np.testing.assert_allclose(found.shift, np.eye(3) * 1e-6 / 6.0)
    np.testing.assert_allclose(found.rotation, np.eye(3) * 1e-6 / 0.04)
    far = found.at(np.array([1.0, 2.0, 3.2]))  # 0.2 m along z moves along x and y
    np.testing.assert_allclose(
        far, np.diag([1e-6 / 6 + 1e-6, 1e-6 / 6 + 1e-6, 1e-6 / 6]), atol=1e-18
    )


def test_misfits_are_distances() -> None:
    off = marker_bodies.misfit(BODY, BODY + [0.003, 0.0, 0.004], Pose(np.eye(3), np.zeros(3)))
    assert off == pytest.approx([0.005] * 3)


# --- the socket


def test_a_turned_cluster_is_written_in_degrees(tmp_path) -> None:
    write_socket(GEOMETRY, tmp_path / "socket.yaml")
    found = read_socket(tmp_path / "socket.yaml")
    assert found.turned == pytest.approx({"mid_anterior": QUARTER})
    assert "mid_anterior: {tile: ant_mid, turned: 90.0}" in (tmp_path / "socket.yaml").read_text()
    assert found.source == "a scene made by hand" and found.registration == "made by hand"
    assert found.bodies == "made by hand"
    bare = replace(GEOMETRY, registration="").bodies
    assert bare.startswith("the marker bodies are nominal")


def test_the_tiles_share_of_the_wall_is_written(tmp_path) -> None:
    write_socket(replace(GEOMETRY, tile_share=0.818), tmp_path / "socket.yaml")
    assert "\ntile_share: 0.818\n" in (tmp_path / "socket.yaml").read_text()
    assert read_socket(tmp_path / "socket.yaml").tile_share == 0.818


def test_a_socket_without_a_tile_share_has_none() -> None:
    document = GEOMETRY.to_document()
    assert "tile_share" not in document
    assert socket_from_document(document, "").tile_share is None


@pytest.mark.parametrize("share", [0.0, -0.1, 1.01, 82.0])
def test_a_tile_share_beyond_the_wall_is_refused(share: float) -> None:
    document = GEOMETRY.to_document() | {"tile_share": share}
    with pytest.raises(ConfigurationError, match=r"^a\.yaml: tile_share"):
        socket_from_document(document, "a.yaml")


def test_a_turn_is_kept_to_a_nanodegree() -> None:
    turned = replace(GEOMETRY, turned={"distal": float(np.radians(-12.3456789))})
    document = turned.to_document()
    assert document["clusters"]["distal"] == {"tile": "post_end", "turned": -12.3456789}
    assert socket_from_document(document, "").turned["distal"] == pytest.approx(-0.215472745)


def test_tiles_know_their_clusters() -> None:
    names = GEOMETRY.cluster_names
    assert [names[tile] for tile in (3, 4, 6, 10)] == [
        *("brim_lateral", "mid_anterior", "posterior_distal", "distal")
    ]
    assert GEOMETRY.covered.sum() == 4 and GEOMETRY.covered[[3, 4, 6, 10]].all()


SAME = {
    "itself": (lambda g: g, True),
    "a little off": (lambda g: replace(g, anchors=g.anchors + 0.9e-4), True),
    "off": (lambda g: replace(g, anchors=g.anchors + [0.0, 0.0, 1.1e-4]), False),
    "turned a little": (lambda g: replace(g, rotations=g.rotations + 0.9e-3), True),
    "turned": (lambda g: replace(g, rotations=g.rotations + 1.1e-3), False),
    "other names": (lambda g: replace(g, names=g.names[::-1]), False),
    "a tile less": (lambda g: replace(g, names=g.names[:-1]), False),
    "a tile called like its cluster": (
        lambda g: replace(g, names=("cluster_1", *g.names[1:]), clusters={"cluster_1": 0}),
        True,
    ),
    "other areas": (lambda g: replace(g, areas=2.0 * g.areas), True),
}


@pytest.mark.parametrize("case", SAME)
def test_the_same_tiles_are_in_their_places(case: str) -> None:
    change, same = SAME[case]
    assert GEOMETRY.same_tiles(change(GEOMETRY)) is same


def moved(tile: str, anchor: list[float]) -> Callable[[dict], None]:
    return lambda d: d["tiles"][tile].__setitem__("anchor", anchor)


DOCUMENTS: dict[str, tuple[Callable[[dict], None], str]] = {
    "good": (lambda d: None, ""),
    "two in one place": (
        moved("left_prox", [0.05, 0.00005, 0.21]),
        "ant_prox: is at the same place as left_prox",
    ),
    # 60 mm is the usual distance; a tile is off the wall beyond four of the median and 60 mm.
    "a lone tile": (moved("ant_prox", [0.05, 0.0, 0.60]), "ant_prox: is 396 mm from all others"),
    "a distant tile": (moved("ant_prox", [0.05, 0.0, 0.27]), ""),
    "no pair": (
        lambda d: d["neighbours"].append(["ant_mid", "ant_mid"]),
        "is not a pair",
    ),
    "no neighbour": (lambda d: d["neighbours"].append(["ant_mid", "ant_mod"]), "no tile 'ant_mod'"),
    "no tiles in a region": (
        lambda d: d["regions"].__setitem__("heel", []),
        "regions: heel has no tiles",
    ),
    "a tile twice": (
        lambda d: d["regions"].__setitem__("heel", ["ant_mid", "ant_mid"]),
        "regions: heel holds a tile twice",
    ),
    "a large area": (lambda d: d["tiles"]["ant_mid"].__setitem__("area", 0.051), "area"),
    "a turn": (
        lambda d: d["clusters"].__setitem__("distal", {"tile": "post_end", "turned": 361.0}),
        "turned",
    ),
}


@pytest.mark.parametrize("case", DOCUMENTS)
def test_a_socket_is_checked(case: str) -> None:
    change, fact = DOCUMENTS[case]
    document = GEOMETRY.to_document()
    change(document)
    if not fact:
        socket_from_document(document, "socket.yaml")
        return
    with pytest.raises(ConfigurationError) as refusal:
        socket_from_document(document, "socket.yaml")
    assert fact in str(refusal.value)


def test_twins_are_not_written(tmp_path) -> None:
    names = ("ant_prox", "ant_prox", *GEOMETRY.names[2:])
    with pytest.raises(ConfigurationError, match="two tiles would be called 'ant_prox'"):
        write_socket(replace(GEOMETRY, names=names), tmp_path / "socket.yaml")


def test_lacking_clusters_are_named() -> None:
    GEOMETRY.require(["distal"], "the samples")
    with pytest.raises(ConfigurationError, match="the cluster 'heel' of the samples is on no tile"):
        GEOMETRY.require(["distal", "heel"], "the samples")
