"""Regions of a socket: the parts that clinicians name, and the user's own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from socket_testbed.arrays import IntArray
from socket_testbed.geometry.axis import socket_axis
from socket_testbed.geometry.socket import HEIGHTS, SOCKET, SocketGeometry

Side = Literal["left", "right"]

UNMEASURED = "unmeasured wall"
"""The tiles without a cluster."""
_TINY = 1e-9  # [m]
# Quarter turns about the axis from anterior towards left, by the leg.
_SECTORS: dict[Side | None, dict[str, int]] = {
    "right": {"anterior": 0, "posterior": 2, "medial": 1, "lateral": 3},
    "left": {"anterior": 0, "posterior": 2, "medial": 3, "lateral": 1},
    None: {"anterior": 0, "posterior": 2, "left": 1, "right": 3},
}


@dataclass(frozen=True, eq=False)
class Region:
    """A part of a socket."""

    name: str  # its name
    tiles: IntArray  # indices of its tiles, ascending; (k,)


def anatomical_regions(geometry: SocketGeometry, side: Side | None = None) -> tuple[Region, ...]:
    """Four sectors, three heights, and the sectors by the heights.

    The sectors are quarter turns about the socket's axis (`geometry.axis.socket_axis`), centred on
    anterior, left, posterior and right; the heights are thirds of the span of the tiles' centres
    along the axis. Every tile is in exactly one sector, one height and one of their intersections.

    Args:
        geometry: Geometry of the socket.
        side: The leg. Medial is left of the axis on a right leg, right of it on a left leg; without
            a side the sectors are called `left` and `right`.

    Returns:
        Regions such as `anterior`, `proximal` and `anterior proximal`, less those without a tile.
    """
    axis = socket_axis(geometry)
    turns = np.round(axis.angles(geometry.anchors) / (0.5 * np.pi)) % 4
    heights = axis.heights(geometry.anchors)
    below = (heights.max() - heights) / max(np.ptp(heights), _TINY)
    thirds = np.minimum(np.floor(3.0 * below), 2.0)
    sectors = {name: turns == turn for name, turn in _SECTORS[side].items()}
    levels = {name: thirds == third for third, name in enumerate(HEIGHTS)}
    fields = {
        f"{sector} {height}": inside & level
        for sector, inside in sectors.items()
        for height, level in levels.items()
    }
    inside = {**sectors, **levels, **fields}
    return tuple(Region(name, np.flatnonzero(of)) for name, of in inside.items() if of.any())


def all_regions(geometry: SocketGeometry, side: Side | None = None) -> tuple[Region, ...]:
    """The anatomical regions, those of `socket.yaml`, the tiles without a cluster, and the socket.

    They come in this order; where every tile has a cluster, nothing is unmeasured.
    """
    own = [Region(name, np.array(tiles)) for name, tiles in geometry.regions.items()]
    every = np.arange(len(geometry))
    bare = np.setdiff1d(every, [*geometry.clusters.values()])
    if len(bare):
        own.append(Region(UNMEASURED, bare))
    return (*anatomical_regions(geometry, side), *own, Region(SOCKET, every))
