"""Around the tiling: names of tiles, clusters, proposals for them, placement on the load cell."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation
from support import meshes
from support.wording import refused

from socket_testbed.errors import ConfigurationError, RegistrationError
from socket_testbed.files import packaged
from socket_testbed.geometry.axis import axis_through
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import ScanFrame, read_socket
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import ForceMapSettings
from socket_testbed.socket_design.clusters import (
    ClusterPlace,
    LaidCluster,
    lay_clusters,
    place_clusters,
    read_cluster_places,
)
from socket_testbed.socket_design.design import (
    nominal_places,
    parse_direction,
    place_by_landmarks,
    place_by_points,
    tile_names,
)
from socket_testbed.socket_design.squares import Squares, Surroundings, rim_points, spread_points

Z = np.array([0.0, 0.0, 1.0])
X = np.array([1.0, 0.0, 0.0])


def test_names_say_where_a_tile_is() -> None:
    anchors = np.array([[0.05, 0.0, 0.12], [0.0, 0.05, 0.2], [-0.05, -1e-5, 0.12]])
    axis = axis_through(np.array([0.0, 0.0, 0.08]), Z, X)
    names = ("h040_a000", "h120_a090", "h040_a180")
    assert tile_names(anchors, axis) == names
    # Another tile changes no other tile's name.
    more = tile_names(np.vstack([anchors, [[0.05, 0.0, 0.1202]]]), axis)
    assert more == (*names, "h040_a000b")


WALL = meshes.open_cone(0.05, 0.05, 0.12, 0.004, closed=False)


def wall(angle: float, height: float, off: float = 0.0) -> np.ndarray:
    """A point beside the cylinder, off it towards the axis."""
    return np.array([(0.05 - off) * math.cos(angle), (0.05 - off) * math.sin(angle), height])


def frame_at(angle: float, turned: float = 0.0) -> np.ndarray:
    """The frame of a cluster on the cylinder, turned about the inward normal."""
    inward = -np.array([math.cos(angle), math.sin(angle), 0.0])
    tile = np.column_stack([Z, np.cross(inward, Z), inward])
    return Rotation.from_rotvec(turned * inward).as_matrix() @ tile


def asked_at(
    centre: np.ndarray, frame: np.ndarray | None = None, name: str = "distal"
) -> ClusterPlace:
    return ClusterPlace(name, centre, frame, f"{name}'s")


def lay(*places: ClusterPlace) -> tuple[Squares, list[LaidCluster]]:
    rng = np.random.default_rng(2)
    centres, points = spread_points(WALL, 0.001, rng), spread_points(WALL, 0.0025, rng)
    surroundings = Surroundings(points, rim_points(WALL, 0.0005), Z, X)
    return lay_clusters(WALL, places, centres, surroundings, 0.03, 0.008)


def test_a_cluster_stays_where_it_is_glued_and_as_it_is_turned() -> None:
    rng = np.random.default_rng(0)
    for angle, turned in rng.uniform(-math.pi, math.pi, (3, 2)):
        asked = wall(angle, rng.uniform(0.03, 0.09), off=rng.uniform(-0.003, 0.003))
        nearest = trimesh.proximity.closest_point(WALL, asked[None])[0][0]
        frame = frame_at(angle, turned)
        for given, expected in ((None, 0.0), (frame, turned)):
            squares, (laid,) = lay(asked_at(asked, given))
            assert np.linalg.norm(squares.anchors[0] - nearest) < 1e-9 and laid.moved == 0.0
            assert laid.turned == pytest.approx(expected, abs=math.radians(1.0))
        # Its square is turned with it: the sensor's edges are its own.
        assert np.abs(squares.rotations[0] - frame).max() < 0.04


def test_a_cluster_that_hangs_over_the_brim_is_laid_beside_it_and_says_so() -> None:
    squares, (laid,) = lay(asked_at(wall(1.0, 0.11)))
    assert squares.anchors[0, 2] == pytest.approx(0.105, abs=0.0015)
    assert 0.004 < laid.moved < 0.008
    assert "asked at (27.0, 42.1, 110.0)" in str(laid) and "mm away" in str(laid)


def test_a_cluster_that_cannot_be_laid_is_refused() -> None:
    on = wall(0.0, 0.06)
    for places, words in (
        ([asked_at(np.array([0.5, 0.0, 0.05]))], "distal's: is 450 mm from the interior"),
        ([asked_at(wall(0.0, 0.14))], "no 30 mm tile fits within 15 mm"),
        (
            [asked_at(on, name="a"), asked_at(wall(0.3, 0.06), name="b")],
            "b's: overlaps a, their centres are 14.9 mm apart",
        ),
        ([asked_at(on, frame_at(0.8))], "distal's: its z is 4[0-9] deg off the inward normal"),
    ):
        with pytest.raises(ConfigurationError, match=words):
            lay(*places)


def test_nominal_clusters_are_four_different_tiles() -> None:
    angle = np.tile(np.arange(8) * math.pi / 4, 3)
    height = np.repeat([0.1, 0.15, 0.2], 8)
    anchors = np.column_stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), height])
    anchors = np.vstack([anchors, [0.01, 0.0, 0.08]])
    squares = Squares(anchors, np.tile(np.eye(3), (25, 1, 1)), 0.03)
    axis = axis_through(0.08 * Z, Z, X)
    with refused(ConfigurationError, "3 tiles do not hold the usual 4 clusters"):
        nominal_places(squares.take(np.arange(3)), axis)
    tiles = nominal_places(squares, axis)
    places = {name: squares.anchors[tile] for name, tile in tiles.items()}
    assert list(places) == ["brim_lateral", "mid_anterior", "posterior_distal", "distal"]
    assert tiles["distal"] == 24
    assert places["brim_lateral"] == pytest.approx([0.0, 0.05, 0.2])
    assert places["mid_anterior"] == pytest.approx([0.05, 0.0, 0.15])
    assert places["posterior_distal"] == pytest.approx([-0.05, 0.0, 0.1])


def test_cluster_places_are_read(tmp_path: Path) -> None:
    path = tmp_path / "clusters.yaml"
    path.write_text(
        "clusters:\n  distal: {point: [0, 0, 0.1]}\n"
        "  brim: {anchor: [0.05, 0, 0.2], frame: [[0, 0, -1], [0, 1, 0], [1, 0, 0]]}\n"
        "  mid: {scan: [50.0, -10.0, 200.0]}\n"
    )
    distal, brim, mid = read_cluster_places(path)
    scan = ScanFrame(0.001, Pose(np.eye(3), np.array([0.0, 0.02, 0.0])))
    assert mid.in_load_cell(scan).centre == pytest.approx([0.05, 0.01, 0.2])
    assert distal.in_load_cell(scan).centre == pytest.approx([0.0, 0.0, 0.1])
    assert brim.frame is not None and brim.frame[:, 2] == pytest.approx([-1.0, 0.0, 0.0])
    for text, words in (
        ("clusters: {distal: {point: [0, 0, 100]}}", "point[2] is 100: give a number from -2 to 2"),
        ("clusters: {distal: {anchor: [0, 0, 0.1]}}", "has anchor: give a point"),
    ):
        path.write_text(text)
        with refused(ConfigurationError, words):
            read_cluster_places(path)


def test_directions() -> None:
    for text, expected in (("+z", [0, 0, 1]), ("-X", [-1, 0, 0]), ("0, 3 4", [0, 0.6, 0.8])):
        assert parse_direction(text, "--proximal") == pytest.approx(expected)
    for wrong in ("w", "0 0 0", "1 2", "1 nan 2"):
        with pytest.raises(ConfigurationError, match="--proximal is"):
            parse_direction(wrong, "--proximal")


def test_placement_by_landmarks_or_points(tmp_path: Path) -> None:
    turned, path = Rotation.random(random_state=8), tmp_path / "l.yaml"
    load_cell = 1e-3 * np.array([[0, 0, 0], [50, 0, 0], [10, 20, 0], [0, -60, 300], [0, 100, 200]])
    scan = 1e3 * (turned.apply(load_cell + np.array([0.3, 0.1, -0.2])))

    def place(scan: np.ndarray) -> Pose:
        pairs = enumerate(zip(scan.tolist(), load_cell.tolist(), strict=True))
        places = {f"L{i}": {"scan": picked, "load_cell": known} for i, (picked, known) in pairs}
        path.write_text(yaml.safe_dump({"landmarks": places}))
        return place_by_landmarks(path, 1e-3).scan_in_load_cell

    for pose in (place(scan), place_by_points(1e-3 * scan[:3]).scan_in_load_cell):
        assert pose.apply(1e-3 * scan) == pytest.approx(load_cell)
    with pytest.raises(RegistrationError, match=r"l\.yaml"):
        place(scan + np.random.default_rng(8).normal(0.0, 30.0, scan.shape))


GEOMETRY = read_socket(packaged("config", "socket.yaml"))


def test_clusters_that_are_there_stay_and_each_further_one_lowers_the_error() -> None:
    stay = [GEOMETRY.clusters["distal"], 40]
    allowed = np.arange(len(GEOMETRY)) < 60
    found = place_clusters(GEOMETRY, 6, stay, allowed)
    tiles = found.tiles.tolist()
    assert tiles[:2] == stay and len(set(tiles)) == 6 and max(tiles[2:]) < 60
    errors = [found.errors[count] for count in range(2, 7)]
    assert errors == sorted(errors, reverse=True) and 0.0 < errors[-1] < errors[0] < 1.0
    low, high = found.at_random
    assert errors[-1] < high and low < high
    with pytest.raises(ConfigurationError, match="do not fit"):
        place_clusters(GEOMETRY, 80)


def test_the_first_proposal_is_the_best_single_cluster_of_the_force_map() -> None:
    """Under one hypothesis: tried on every tile, by the map's own standard deviations."""
    settings = ForceMapSettings(draws=1)
    nothing = np.full((1, 3), np.nan)
    left = []
    for tile in range(len(GEOMETRY)):
        geometry = replace(GEOMETRY, clusters={"c": tile})
        samples = Samples(
            np.zeros(1, np.int64), nothing, nothing, np.zeros((1, 6)), ("c",),
            np.zeros((1, 1, 3)), np.zeros((1, 1), np.uint8),
        )  # fmt: skip
        estimate = ForceMap(geometry, ("c",), settings).estimate(samples)
        left.append((estimate.standard_deviations**2).sum())
    place = place_clusters(GEOMETRY, 1, settings=replace(settings, spread=0.0)).tiles[0]
    assert left[place] < 1.02 * min(left)
