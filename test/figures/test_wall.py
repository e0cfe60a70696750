"""The socket's surface unrolled against the ring socket's cone."""

import numpy as np
import pytest
from support.problems import ring_socket

from socket_testbed.figures.wall import Patch, patches, unrolled_tiles

GEOMETRY = ring_socket()


TILES = unrolled_tiles(GEOMETRY)


def test_each_tile_is_at_its_angle() -> None:
    x, y, _ = GEOMETRY.anchors[TILES.on_wall].T
    angles = TILES.places[TILES.on_wall, 0]
    np.testing.assert_allclose((angles - np.degrees(np.arctan2(y, x)) + 180.0) % 360.0, 180.0)


def test_each_tile_is_at_its_height() -> None:
    z, heights = GEOMETRY.anchors[TILES.on_wall, 2], TILES.places[TILES.on_wall, 1]
    np.testing.assert_allclose(heights - heights[0], 1e3 * (z - z[0]), atol=1e-9)


def test_no_tile_is_torn_where_the_turn_ends() -> None:
    """Each is as wide as its edge at its radius."""
    x, y, _ = GEOMETRY.anchors[TILES.on_wall].T
    width = np.radians(np.ptp(TILES.corners[TILES.on_wall, :, 0], axis=1)) * np.hypot(x, y)
    np.testing.assert_allclose(width, 0.030, rtol=0.12)


def test_the_distal_end_is_seen_from_above() -> None:
    """With anterior (x) up and left (y) on the left."""
    x, y, _ = 1e3 * GEOMETRY.anchors[~TILES.on_wall].T
    np.testing.assert_allclose(TILES.places[~TILES.on_wall], np.column_stack([-y, x]), atol=1e-9)


def test_an_even_field_stays_even() -> None:
    for patch in patches(GEOMETRY):
        known = np.isfinite(patch.points[..., 0])
        found = (patch.weights @ np.ones(len(GEOMETRY)))[known]
        np.testing.assert_allclose(found, 1.0, atol=1e-9)


@pytest.fixture(scope="module")
def wall() -> Patch:
    return next(patches(GEOMETRY))


def test_a_sloped_field_is_smooth_between_tiles(wall: Patch) -> None:
    between = (wall.y > 30.0) & (wall.y < 170.0)
    found = (wall.weights @ GEOMETRY.anchors[:, 2])[between]
    np.testing.assert_allclose(found, wall.points[between][..., 2], atol=4e-3)


def test_a_tile_keeps_its_value_in_place(wall: Patch) -> None:
    tile = GEOMETRY.clusters["mid_anterior"]
    field = np.where(np.isfinite(wall.points[..., 0]), wall.weights[..., tile], -np.inf)
    place = wall.points[np.unravel_index(field.argmax(), field.shape)]
    assert np.linalg.norm(place - GEOMETRY.anchors[tile]) < 0.012
    assert 0.7 < field.max() < 1.1
