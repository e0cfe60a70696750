"""The distal end of the page's socket, with a side that is higher than the other."""

from dataclasses import replace

import numpy as np
import pytest
from support import scene

from socket_testbed.figures.wall import Patch, patches


def end_with_a_high(tile: str) -> Patch:
    """The end of the scene, 90 mm above the load cell, with one of its tiles 15 mm higher."""
    geometry = scene.geometry()
    anchors = geometry.anchors.copy()
    anchors[scene.TILES.index(tile), 2] += 0.015
    _, end = patches(replace(geometry, anchors=anchors, turned={}))
    return end


# Right and anterior of the axis [mm], on the page; x of {S} is anterior, y left.
PLACES = {
    "ant_end": (0.0, 20.0),
    "left_end": (-20.0, 0.0),
    "post_end": (0.0, -20.0),
    "right_end": (20.0, 0.0),
}


@pytest.mark.parametrize("tile", PLACES)
def test_the_end_is_high_at_its_high_tile(tile: str) -> None:
    end = end_with_a_high(tile)
    heights = {}
    for name, (right, anterior) in PLACES.items():
        row, column = np.abs(end.y - anterior).argmin(), np.abs(end.x - right).argmin()
        x, y, z = 1e3 * end.points[row, column]
        assert (x, y) == pytest.approx((end.y[row], -end.x[column]), abs=1e-6)
        heights[name] = z
    assert max(heights, key=heights.__getitem__) == tile
    assert heights[tile] > 96.0 and min(heights.values()) < 94.0


@pytest.mark.parametrize(
    ("height", "lowest"), [(0.150, 45.0), (0.100, 0.0)], ids=["high wall", "low wall"]
)
def test_the_wall_begins_above_the_end(height: float, lowest: float) -> None:
    """15 mm, half an edge, below its lowest tiles; not below the end, 90 mm above the load cell."""
    geometry = scene.geometry()
    anchors = geometry.anchors.copy()
    anchors[4:8, 2] = height
    wall, _ = patches(replace(geometry, anchors=anchors))
    assert (wall.name, wall.y[0]) == ("wall", pytest.approx(lowest, abs=1e-6))
    assert 1e3 * np.nanmin(wall.points[..., 2]) == pytest.approx(90.0 + lowest, abs=1e-6)
