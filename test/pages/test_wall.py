"""The socket's surface unrolled against the ring socket's cone."""

import numpy as np
from support.problems import ring_socket

from socket_testbed.pages.wall import patches, unrolled_tiles

GEOMETRY = ring_socket()
BASE, TAPER = 0.046, np.tan(np.radians(6.0))  # [m], [-]; of the cone


def test_each_tile_is_at_its_angle_and_height_or_on_the_distal_end() -> None:
    tiles = unrolled_tiles(GEOMETRY)
    x, y, z = GEOMETRY.anchors[tiles.on_wall].T
    angles, heights = tiles.places[tiles.on_wall].T
    np.testing.assert_allclose((angles - np.degrees(np.arctan2(y, x)) + 180.0) % 360.0, 180.0)
    np.testing.assert_allclose(heights - heights[0], 1e3 * (z - z[0]), atol=1e-9)
    # No tile is torn at the end of the turn: each is as wide as its edge at its radius.
    width = np.radians(np.ptp(tiles.corners[tiles.on_wall, :, 0], axis=1)) * np.hypot(x, y)
    np.testing.assert_allclose(width, 0.030, rtol=0.12)
    # The end is seen from above, with anterior (x) up and left (y) on the left.
    x, y, _ = 1e3 * GEOMETRY.anchors[~tiles.on_wall].T
    np.testing.assert_allclose(tiles.places[~tiles.on_wall], np.column_stack([-y, x]), atol=1e-9)


def test_what_the_tiles_say_is_kept_and_smooth_between_them() -> None:
    even, sloped = np.ones(len(GEOMETRY)), GEOMETRY.anchors[:, 2]
    for patch in patches(GEOMETRY):
        known = np.isfinite(patch.points[..., 0])
        np.testing.assert_allclose((patch.weights @ even)[known], 1.0, atol=1e-9)
    wall = next(patches(GEOMETRY))
    between = (wall.y > 30.0) & (wall.y < 170.0)
    found = (wall.weights @ sloped)[between]
    np.testing.assert_allclose(found, wall.points[between][..., 2], atol=4e-3)
    tile = GEOMETRY.clusters["mid_anterior"]
    field = np.where(np.isfinite(wall.points[..., 0]), wall.weights[..., tile], -np.inf)
    place = wall.points[np.unravel_index(field.argmax(), field.shape)]
    assert np.linalg.norm(place - GEOMETRY.anchors[tile]) < 0.012
    assert 0.7 < field.max() < 1.1
