"""The socket's wall as a continuous surface, against a cone whose places are known."""

import dataclasses

import numpy as np
import pytest
from support.problems import random_socket
from support.ring_socket import ring_socket

from socket_testbed.geometry.axis import socket_axis
from socket_testbed.pages.wall import Patch, patches

GEOMETRY = ring_socket()
BASE, TAPER = 0.046, np.tan(np.radians(6.0))  # [m], [-]; of the cone


@pytest.fixture(scope="module")
def surface() -> dict[str, Patch]:
    return {patch.name: patch for patch in patches(GEOMETRY)}


def test_the_wall_and_the_end_are_where_the_socket_is(surface: dict[str, Patch]) -> None:
    wall, end = surface["wall"], surface["end"]
    x, y, z = np.moveaxis(wall.points, -1, 0)
    known = np.isfinite(x)
    assert known.mean() > 0.95
    heights = np.broadcast_to(1e-3 * wall.y[:, None], x.shape)
    np.testing.assert_allclose(z[known], 0.080 + heights[known], atol=1e-9)
    np.testing.assert_allclose(np.hypot(x, y)[known], (BASE + TAPER * heights)[known], atol=4e-3)
    angles = np.degrees(np.arctan2(y, x)) - wall.x
    np.testing.assert_allclose((angles[known] + 180.0) % 360.0, 180.0, atol=1e-6)
    # The end is flat in its middle; anterior (x) is up, left (y) on the left.
    inside = np.isfinite(end.points[..., 0])
    right, up = np.broadcast_arrays(end.x, end.y[:, None])
    middle = np.hypot(right, up) < 20.0
    np.testing.assert_allclose(end.points[middle][:, 2], 0.080, atol=1e-2)
    np.testing.assert_allclose(1e3 * end.points[inside][:, 0], up[inside], atol=1e-9)
    np.testing.assert_allclose(-1e3 * end.points[inside][:, 1], right[inside], atol=1e-9)


def test_what_the_tiles_say_is_kept_and_smooth_between_them(surface: dict[str, Patch]) -> None:
    even, sloped = np.ones(len(GEOMETRY)), GEOMETRY.anchors[:, 2]
    for patch in surface.values():
        known = np.isfinite(patch.points[..., 0])
        np.testing.assert_allclose((patch.weights @ even)[known], 1.0, atol=1e-9)
    wall = surface["wall"]
    between = (wall.y > 30.0) & (wall.y < 170.0)
    found = (wall.weights @ sloped)[between]
    np.testing.assert_allclose(found, wall.points[between][..., 2], atol=4e-3)
    # A single loaded tile is highest at its own place.
    tile = GEOMETRY.clusters["mid_anterior"]
    field = np.where(np.isfinite(wall.points[..., 0]), wall.weights[..., tile], -np.inf)
    place = wall.points[np.unravel_index(field.argmax(), field.shape)]
    assert np.linalg.norm(place - GEOMETRY.anchors[tile]) < 0.012
    assert 0.7 < field.max() < 1.1


def test_a_socket_without_an_end_or_without_a_wall_has_one_patch() -> None:
    around = socket_axis(GEOMETRY)
    assert around.proximal[2] == pytest.approx(1.0)
    open_ended = random_socket(np.random.default_rng(6), rings=3, columns=6)
    assert [patch.name for patch in patches(open_ended)] == ["wall"]
    upwards = np.tile(np.diag([-1.0, -1.0, 1.0]), (18, 1, 1))
    flat = dataclasses.replace(open_ended, rotations=upwards)
    (end,) = patches(flat)
    assert end.name == "end" and np.isfinite(end.points).any()
