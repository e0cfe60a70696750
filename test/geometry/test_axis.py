"""The socket's axis: where a tile is, in height and angle; and the regions about it."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation
from support.problems import ring_socket

from socket_testbed.files import packaged
from socket_testbed.geometry.axis import (
    all_regions,
    anatomical_regions,
    axis_through,
    proximal_direction,
    socket_axis,
)
from socket_testbed.geometry.socket import HEIGHTS, read_socket

RINGS, PACKAGED = ring_socket(), read_socket(packaged("config", "socket.yaml"))


def test_tiles_in_rings_are_at_their_heights_and_angles_however_the_socket_stands():
    axis = socket_axis(RINGS)
    np.testing.assert_allclose(axis.proximal, [0.0, 0.0, 1.0], atol=0.03)
    anchors = RINGS.anchors[[name.startswith("ring") for name in RINGS.names]]
    expected = np.arctan2(anchors[:, 1], anchors[:, 0])
    turned = (axis.angles(anchors) - expected + np.pi) % (2.0 * np.pi) - np.pi
    np.testing.assert_allclose(turned, 0.0, atol=np.radians(4.0))
    heights = anchors[:, 2] - RINGS.anchors[:, 2].min()
    np.testing.assert_allclose(axis.heights(anchors), heights, atol=0.003)
    np.testing.assert_allclose(axis.radii(anchors), np.hypot(*anchors[:, :2].T), atol=0.004)

    turn = Rotation.from_euler("xyz", [50.0, -70.0, 120.0], degrees=True).as_matrix()
    turned = dataclasses.replace(
        RINGS, rotations=turn @ RINGS.rotations, anchors=RINGS.anchors @ turn.T
    )
    np.testing.assert_allclose(proximal_direction(turned), turn @ axis.proximal, atol=1e-12)
    heights = socket_axis(turned).heights(turned.anchors)
    np.testing.assert_allclose(heights, axis.heights(RINGS.anchors), atol=1e-12)


def test_anterior_is_across_the_axis_however_that_stands():
    for proximal in ([1.0, 0.0, 0.0], [0.6, 0.0, 0.8]):
        axis = axis_through(np.zeros(3), np.array(proximal))
        frame = np.stack([axis.anterior, axis.left, axis.proximal])
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)


def test_tiles_on_the_distal_end_or_around_a_point_have_the_axis_of_the_load_cell():
    quarters = Rotation.from_euler("z", [[0.0], [90.0], [180.0], [270.0]], degrees=True)
    for turns in (np.tile(np.diag([-1.0, -1.0, 1.0]), (len(RINGS), 1, 1)), quarters.as_matrix()):
        end = dataclasses.replace(RINGS, rotations=turns)
        np.testing.assert_array_equal(proximal_direction(end), [0.0, 0.0, 1.0])


def test_every_tile_is_in_one_sector_one_height_and_one_of_their_intersections():
    for geometry, side in ((PACKAGED, "left"), (PACKAGED, None), (RINGS, "right")):
        regions = anatomical_regions(geometry, side)
        assert len(regions) == 4 + 3 + 12
        for group in (regions[:4], regions[4:7], regions[7:]):
            tiles = np.concatenate([region.tiles for region in group])
            np.testing.assert_array_equal(np.sort(tiles), np.arange(len(geometry)))
        tiles = {region.name: set(region.tiles.tolist()) for region in regions}
        for name in list(tiles)[7:]:
            sector, height = name.split()
            assert tiles[name] == tiles[sector] & tiles[height]


def test_regions_are_where_their_names_say():
    own = {"fibula head": (3, 5), "patellar tendon": (40,)}
    geometry = dataclasses.replace(RINGS, regions=own)
    names = [region.name for region in all_regions(geometry)]
    assert names[-4:] == ["fibula head", "patellar tendon", "unmeasured wall", "socket"]
    centre = {r.name: geometry.anchors[r.tiles].mean(axis=0) for r in anatomical_regions(geometry)}
    assert centre["anterior middle"][0] > 0.03 > -0.03 > centre["posterior middle"][0]
    assert centre["left middle"][1] > 0.03 > -0.03 > centre["right middle"][1]
    for sector in ("anterior", "posterior", "left", "right"):
        heights = [centre[f"{sector} {height}"][2] for height in HEIGHTS]
        assert heights == sorted(heights, reverse=True)
    # Medial is left on a right leg, and right on a left leg.
    left_leg, right_leg, neither = (
        {r.name: r.tiles.tolist() for r in anatomical_regions(PACKAGED, side)}
        for side in ("left", "right", None)
    )
    for height in HEIGHTS:
        left, right = neither[f"left {height}"], neither[f"right {height}"]
        assert right_leg[f"medial {height}"] == left_leg[f"lateral {height}"] == left
        assert right_leg[f"lateral {height}"] == left_leg[f"medial {height}"] == right
