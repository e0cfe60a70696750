"""The grids on which a page and a printed map draw the scene's surface, by hand.

The median tile has an edge of 30 mm; the wall has a radius of 50 mm, its tiles are 60 and 120 mm
above the distal end, which is 90 mm above the load cell. The usual step is 0.35 edges.
"""

from dataclasses import replace

import numpy as np
import pytest
from support import scene

from socket_testbed.figures import wall
from socket_testbed.figures.wall import Patch


@pytest.fixture(scope="module")
def grids() -> dict[str, Patch]:
    return {patch.name: patch for patch in wall.patches(scene.geometry())}


def at(patch: Patch, x: float, y: float) -> np.ndarray:
    """The nearest point of a grid in {S} [mm]."""
    return 1e3 * patch.points[np.abs(patch.y - y).argmin(), np.abs(patch.x - x).argmin()]


def test_the_wall_s_grid_is_a_full_turn(grids: dict[str, Patch]) -> None:
    """2 round(50 pi / 30 / 0.35) by round(90 / 30 / 0.35) points, half an edge beyond the tiles."""
    assert [*grids] == ["wall", "end"]
    patch = grids["wall"]
    assert (len(patch.x), len(patch.y)) == (30, 9)
    assert (patch.x[0], patch.x[-1]) == pytest.approx((-180.0, 180.0))
    assert (patch.y[0], patch.y[-1]) == pytest.approx((45.0, 135.0))
    assert patch.points.shape == (9, 30, 3) and patch.weights.shape == (9, 30, 12)


def test_the_end_s_grid_has_the_wall_s_radius(grids: dict[str, Patch]) -> None:
    """At least 25 points across; none at its corners."""
    patch = grids["end"]
    assert (len(patch.x), len(patch.y)) == (25, 25)
    assert (patch.x[0], patch.x[-1]) == pytest.approx((-50.0, 50.0))
    assert at(patch, 0.0, 0.0) == pytest.approx([0.0, 0.0, 90.0], abs=1e-6)
    assert at(patch, 25.0, 0.0) == pytest.approx([0.0, -25.0, 90.0], abs=1e-6)  # towards right
    assert at(patch, 0.0, 25.0) == pytest.approx([25.0, 0.0, 90.0], abs=1e-6)  # anterior
    assert np.isnan(at(patch, 50.0, 50.0)).all()
    assert np.isfinite(at(patch, 50.0, 0.0)).all()  # 30 mm from its tile


def test_a_wall_point_is_on_the_cylinder(grids: dict[str, Patch]) -> None:
    """The column nearest to the left is that of 93.1 degrees: 7.5 of 14.5 steps of 12.414."""
    found = at(grids["wall"], 90.0, 123.0)
    assert np.hypot(*found[:2]) == pytest.approx(50.0, abs=1e-6)
    assert found[2] == pytest.approx(90.0 + 123.75)
    assert np.degrees(np.arctan2(found[1], found[0])) == pytest.approx(93.103, abs=1e-3)


def test_far_from_every_tile_is_no_wall(grids: dict[str, Patch]) -> None:
    """Beyond 1.3 edges, 39 mm: between four tiles it is 48 mm to the next, below a tile 30 mm."""
    patch = grids["wall"]
    assert np.isnan(at(patch, 43.4, 90.0)).all()
    assert np.isfinite(at(patch, 6.2, 90.0)).all()


def test_weights_keep_a_uniform_field(grids: dict[str, Patch]) -> None:
    for patch in grids.values():
        np.testing.assert_allclose(patch.weights.sum(axis=-1), 1.0)


def test_a_wall_alone_has_no_end() -> None:
    geometry = scene.geometry()
    kept = np.arange(8)
    alone = replace(
        geometry,
        names=geometry.names[:8],
        anchors=geometry.anchors[kept],
        rotations=geometry.rotations[kept],
        areas=geometry.areas[kept],
        neighbours=geometry.neighbours[(geometry.neighbours < 8).all(axis=1)],
        clusters={"mid_anterior": 4},
        regions={},
        turned={},
    )
    assert [patch.name for patch in wall.patches(alone)] == ["wall"]


def test_a_finer_step_gives_more_points() -> None:
    """2 round(50 pi / 30 / 0.175) by round(90 / 30 / 0.175) points."""
    patch = next(wall.patches(scene.geometry(), 0.175))
    assert (len(patch.x), len(patch.y)) == (60, 17)


def test_a_coarse_step_keeps_enough_points() -> None:
    """16 by 4 on the wall, where 2 round(50 pi / 30) by round(90 / 30) would be fewer."""
    patch, end = wall.patches(scene.geometry(), 1.0)
    assert (len(patch.x), len(patch.y)) == (16, 4)
    assert (len(end.x), len(end.y)) == (25, 25)


def test_nearby_tiles_are_smoothed() -> None:
    """Weights 1 and exp(-0.5 / 0.49) = 0.360448, one edge away: (1 + 3 * 0.360448) / 1.360448."""
    found = wall._smooth(np.array([[0.0, 1.0], [0.0, 100.0]]), np.array([1.0, 3.0]))
    assert found == pytest.approx([1.529896, 1.0], abs=1e-6)


@pytest.mark.parametrize(
    ("tile", "corners"),
    [
        # (-x, -y), (+x, -y), (+x, +y), (-x, +y): x is up on the wall, y of ant_mid is left
        ("ant_mid", [(-16.7, 45.0), (-16.7, 75.0), (16.7, 75.0), (16.7, 45.0)]),
        # on the end x is anterior, y left
        ("ant_end", [(15.0, 5.0), (15.0, 35.0), (-15.0, 35.0), (-15.0, 5.0)]),
    ],
)
def test_corners_are_in_the_order_of_the_tile(
    tile: str, corners: list[tuple[float, float]]
) -> None:
    geometry = replace(scene.geometry(), turned={})
    found = wall.unrolled_tiles(geometry).corners[scene.TILES.index(tile)]
    np.testing.assert_allclose(found, corners, atol=0.01)


def test_a_turned_cluster_turns_its_square() -> None:
    """By 90 degrees: its (-x, -y) corner is the tile's (+x, -y) corner, or the (-x, +y) one."""
    found = wall.unrolled_tiles(scene.geometry()).corners[scene.TILES.index("ant_mid")]
    np.testing.assert_allclose(found[0], (-16.7, 75.0), atol=0.01)


def test_a_tile_at_the_back_is_not_torn() -> None:
    """At 180 degrees: from 163.3 to 196.7, or from -196.7 to -163.3."""
    found = wall.unrolled_tiles(scene.geometry()).corners[scene.TILES.index("post_mid"), :, 0]
    assert np.ptp(found) == pytest.approx(33.4, abs=0.01)
    assert np.abs(found).max() == pytest.approx(196.7, abs=0.01)
