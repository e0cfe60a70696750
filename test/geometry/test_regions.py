"""Regions of a socket: anatomical ones cover it, the user's own are checked."""

import dataclasses

import numpy as np
from support.ring_socket import ring_socket

from socket_testbed.files import packaged
from socket_testbed.geometry.regions import all_regions, anatomical_regions
from socket_testbed.geometry.socket import read_socket

GEOMETRY = read_socket(packaged("config", "socket.yaml"))


def test_every_tile_is_in_one_sector_one_height_and_one_of_their_intersections() -> None:
    for geometry, side in ((GEOMETRY, "left"), (GEOMETRY, None), (ring_socket(), "right")):
        regions = anatomical_regions(geometry, side)
        assert len(regions) == 4 + 3 + 12
        for group in (regions[:4], regions[4:7], regions[7:]):
            tiles = np.concatenate([region.tiles for region in group])
            np.testing.assert_array_equal(np.sort(tiles), np.arange(len(geometry)))
        tiles = {region.name: set(region.tiles.tolist()) for region in regions}
        for region in regions[7:]:
            sector, height = region.name.split()
            assert tiles[region.name] == tiles[sector] & tiles[height]


def test_regions_are_where_their_names_say() -> None:
    own = {"fibula head": (3, 5), "patellar tendon": (40,)}
    geometry = dataclasses.replace(ring_socket(), regions=own)
    names = [region.name for region in all_regions(geometry)]
    assert names[-4:] == ["fibula head", "patellar tendon", "unmeasured wall", "socket"]
    centre = {r.name: geometry.anchors[r.tiles].mean(axis=0) for r in anatomical_regions(geometry)}
    assert centre["anterior middle"][0] > 0.03 > -0.03 > centre["posterior middle"][0]
    assert centre["left middle"][1] > 0.03 > -0.03 > centre["right middle"][1]
    for sector in ("anterior", "posterior", "left", "right"):
        heights = [centre[f"{sector} {height}"][2] for height in ("proximal", "middle", "distal")]
        assert heights == sorted(heights, reverse=True)


def test_medial_is_left_on_a_right_leg_and_right_on_a_left_leg() -> None:
    def tiles(name: str, side) -> list[int]:
        found = {r.name: r.tiles.tolist() for r in anatomical_regions(GEOMETRY, side)}
        return found[name]

    for height in ("proximal", "middle", "distal"):
        left, right = tiles(f"left {height}", None), tiles(f"right {height}", None)
        assert tiles(f"medial {height}", "right") == tiles(f"lateral {height}", "left") == left
        assert tiles(f"lateral {height}", "right") == tiles(f"medial {height}", "left") == right
