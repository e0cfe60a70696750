"""The 3D picture of socket.js: where surface, clusters and tiles lie, and in which colour.

Expected values are worked out by hand from `support.hand_made`.
"""

import json
from typing import Any

import numpy as np
import pytest
from support.hand_made import hand_moment, hand_socket
from support.tabs import INK, Picture, Tab, read_colour

BOXES = """<html><body><div id="map"></div><div id="solid"></div>
<script src="plotly.js"></script><script src="socket.js"></script></body></html>"""
NO_WALL = (200, 200, 200)
# Of a scale that ends at 50 kPa, certain but for the first tile.
MOMENT = hand_moment(pressure=[12.5, 50.0, 0.0, 6.125, 12.5], grey=[1.0, 0.0, 0.0, 0.0, 0.0])


def opened(**changed: Any) -> Tab:
    tab = Tab(BOXES)
    socket = json.dumps(hand_socket(**changed))
    tab.run(f"const map = new SocketMap(byId('map'), byId('solid'), {socket})")
    return tab


def drawn(moment: dict[str, Any] = MOMENT, **changed: Any) -> Picture:
    tab = opened(**changed)
    tab.run(f"map.show({json.dumps(moment)})")
    return tab.picture("#solid")


def surfaces(picture: Picture) -> list[dict[str, Any]]:
    """The surfaces of wall and end."""
    return [mesh for mesh in picture.of_type("mesh3d") if "vertexcolor" in mesh]


def points(trace: dict[str, Any]) -> np.ndarray:
    return np.transpose([trace["x"], trace["y"], trace["z"]])


def corners(mesh: dict[str, Any]) -> np.ndarray:
    """Corners of the triangles, (n, 3, 3) [mm]."""
    return points(mesh)[np.transpose([mesh["i"], mesh["j"], mesh["k"]])]


def lines(picture: Picture, width: int) -> list[np.ndarray]:
    found = picture.of_type("scatter3d")
    return [points(line) for line in found if line["line"]["width"] == width]


def colour_at(mesh: dict[str, Any], *place: float) -> tuple[int, ...]:
    """The colour of the vertex at a place [mm]."""
    (found,) = np.flatnonzero((points(mesh) == place).all(axis=1))[:1]
    return read_colour(mesh["vertexcolor"][found])


@pytest.mark.parametrize(
    ("place", "colour"),
    [
        # sqrt(12.5 / 50) = 0.5: (33, 145, 140), and 85 % of the way to the grey of 150.
        pytest.param((50.0, 0.0, 90.0), (132, 149, 149), id="anterior, greyest"),
        pytest.param((0.0, 50.0, 60.0), (253, 231, 37), id="left, highest"),
        pytest.param((-50.0, 0.0, 30.0), (68, 1, 84), id="posterior, lowest"),
        # sqrt(6.125 / 50) = 0.35: midway between (53, 95, 141) and (42, 120, 142).
        pytest.param((0.0, -50.0, 60.0), (47.5, 107.5, 141.5), id="right, between two colours"),
    ],
)
def test_each_place_has_its_tiles_colour(place, colour) -> None:
    wall, _ = surfaces(drawn())
    np.testing.assert_allclose(colour_at(wall, *place), colour, atol=0.6)


def test_the_end_lies_below_the_wall() -> None:
    _, end = surfaces(drawn())
    assert colour_at(end, -10.0, 10.0, 20.0) == (33, 145, 140)


def test_faces_cover_the_wall_once() -> None:
    wall, end = surfaces(drawn())
    # Of 4 x 2 squares that have a corner without wall are left out; so of 2 x 2 on the end.
    assert len(wall["i"]) == 2 * 7 and len(end["i"]) == 2 * 3
    # A quarter of the cylinder is drawn as a plane of 50 sqrt(2) mm x 30 mm: half of it a triangle.
    edges = corners(wall)[:, 1:] - corners(wall)[:, :1]
    areas = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    np.testing.assert_allclose(areas, 0.5 * 50.0 * np.sqrt(2.0) * 30.0)
    middles = {tuple(np.round(triangle.mean(axis=0), 6)) for triangle in corners(wall)}
    assert len(middles) == 14


def test_faces_of_a_surface_turn_the_same_way() -> None:
    wall, end = surfaces(drawn())
    for mesh, way in ((wall, [1.0, 1.0, 0.0]), (end, [0.0, 0.0, 1.0])):
        first, second, third = corners(mesh).transpose(1, 0, 2)
        normals = np.cross(second - first, third - first)
        assert (np.sum(normals * way * corners(mesh).mean(axis=1), axis=1) > 0.0).all()


def test_shear_is_drawn_without_grey() -> None:
    tab = opened()
    tab.run("map.kind = 'shear'")
    tab.run(f"map.show({json.dumps(hand_moment(shear=[2.5] * 5))})")
    wall, _ = surfaces(tab.picture("#solid"))
    assert colour_at(wall, 50.0, 0.0, 90.0) == (33, 145, 140)


def test_other_values_are_spread_evenly() -> None:
    tab = opened()
    extras = json.dumps({"height": {"values": [0.0, 40.0, 20.0, 20.0, 20.0], "unit": "mm"}})
    tab.run(f"Object.assign(map, {{extras: {extras}, kind: 'height'}})")
    tab.run(f"map.show({json.dumps(hand_moment())})")
    wall, _ = surfaces(tab.picture("#solid"))
    # The lowest, the middle and the highest.
    assert colour_at(wall, 50.0, 0.0, 90.0) == (68, 1, 84)
    assert colour_at(wall, 0.0, -50.0, 60.0) == (33, 145, 140)
    assert colour_at(wall, 0.0, 50.0, 60.0) == (253, 231, 37)


def test_values_of_either_sign_diverge() -> None:
    tab = opened()
    extras = json.dumps({"offset": {"values": [-40.0, 40.0, 0.0, 0.0, 0.0], "unit": "mm"}})
    tab.run(f"Object.assign(map, {{extras: {extras}, kind: 'offset'}})")
    tab.run(f"map.show({json.dumps(hand_moment())})")
    wall, _ = surfaces(tab.picture("#solid"))
    assert colour_at(wall, 50.0, 0.0, 90.0) == (33, 102, 172)
    assert colour_at(wall, 0.0, -50.0, 60.0) == (247, 247, 247)
    assert colour_at(wall, 0.0, 50.0, 60.0) == (178, 24, 43)


def test_clusters_are_outlined_at_their_corners() -> None:
    first, *others = lines(drawn(), width=6)
    np.testing.assert_array_equal(
        first, [[50, -13, 75], [50, 13, 75], [50, 13, 105], [50, -13, 105], [50, -13, 75]]
    )
    assert [outline[0, 0] for outline in others] == [2, 4]  # tiles of <back> and base


def test_tiles_are_outlined_only_without_values() -> None:
    assert not lines(drawn(), width=2)
    picture = drawn({"time": 0.0, "words": "5 tiles"})
    tiles = lines(picture, width=2)
    assert len(tiles) == 5
    np.testing.assert_array_equal(tiles[3][2], [3, 1, 1])
    assert {line["line"]["color"] for line in picture.of_type("scatter3d")} == {INK}
    for surface in surfaces(picture):
        assert set(map(read_colour, surface["vertexcolor"])) == {NO_WALL}


def test_scanned_surface_is_drawn_through() -> None:
    mesh = {
        "points": [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0], [10.0, 11.0, 12.0]],
        "faces": [[0, 1, 2], [0, 2, 3]],
    }
    (found,) = (m for m in drawn(surface=mesh).of_type("mesh3d") if "vertexcolor" not in m)
    np.testing.assert_array_equal(points(found), mesh["points"])
    assert (found["i"], found["j"], found["k"]) == ([0, 0], [1, 2], [2, 3])
    assert 0.0 < found["opacity"] < 0.5
    assert len(drawn().of_type("mesh3d")) == 2


def test_camera_has_proximal_up_and_equal_axes() -> None:
    scene = drawn(proximal=[0.1, 0.6, 0.79]).layout["scene"]
    assert scene["camera"]["up"] == {"x": 0.1, "y": 0.6, "z": 0.79}
    eye = scene["camera"]["eye"]  # seen from anterior and from left, a little from above
    assert eye["x"] > eye["y"] > eye["z"] > 0.0
    assert scene["aspectmode"] == "data"
    assert not any(scene[axis]["visible"] for axis in ("xaxis", "yaxis", "zaxis"))


def test_turned_view_is_kept_between_pictures() -> None:
    picture = drawn()
    assert picture.how == "react" and picture.layout["uirevision"]
    assert picture.layout["scene"]["dragmode"] == "orbit"


def test_pictures_follow_at_most_every_400_ms() -> None:
    tab = opened()
    pictures = []
    for highest in (10.0, 20.0, 30.0):
        tab.run(f"map.show({json.dumps(hand_moment(pressure=[highest] * 5))})")
        pictures.append((tab.drawn("#map"), tab.drawn("#solid")))
        tab.wait(0.1)
    assert pictures == [(1, 1), (2, 1), (3, 1)]
    tab.wait(0.09)
    assert tab.drawn("#solid") == 1
    tab.wait(0.02)  # 410 ms after the first
    assert tab.drawn("#solid") == 2
    tab.wait(5.0)
    assert tab.drawn("#solid") == 2
    # The last moment: sqrt(30 / 50) is beyond teal, sqrt(10 / 50) is not.
    red, _, blue = colour_at(surfaces(tab.picture("#solid"))[0], 0.0, 50.0, 60.0)
    assert red > 90 and blue < 110
