"""Whether tiles are whole and share nothing, measured on the surface itself."""

from __future__ import annotations

import trimesh

from socket_testbed.arrays import IntArray
from socket_testbed.tiling.footprint import Footprint, FootprintCutter
from socket_testbed.tiling.squares import Squares, gaps

_COVER = 0.003  # [-]; a footprint that differs more from its square is cut, folded or double
_CLOSE = 0.1  # [edges]; gap from which on footprints cannot share anything
_SHARED = 1e-8  # [m^2]; what rounding may make of two footprints that touch


class Verification:
    """Judges sets of tiles by their footprints, each of which is cut out once.

    Args:
        mesh: The surface, its normals inwards [m].
        squares: The squares that the tiles are taken from.
        flatness: Largest distance of the surface from a tile's plane [m].
    """

    def __init__(self, mesh: trimesh.Trimesh, squares: Squares, flatness: float) -> None:
        self._squares = squares
        self._flatness = flatness
        self._cutter = FootprintCutter(mesh, squares, flatness)
        self._footprints: dict[int, Footprint] = {}
        self._shared: dict[tuple[int, int], float] = {}

    def footprint(self, tile: int) -> Footprint:
        """The footprint of a tile."""
        if tile not in self._footprints:
            self._footprints[tile] = self._cutter.footprint(tile)
        return self._footprints[tile]

    def unfit(self, tiles: IntArray) -> list[int]:
        """Tiles that are cut, folded, double or too far from flat."""
        unfit = []
        for tile in map(int, tiles):
            footprint = self.footprint(tile)
            whole = abs(footprint.cover - 1.0) < _COVER and footprint.fold < _COVER
            if not whole or footprint.flatness > self._flatness:
                unfit.append(tile)
        return unfit

    def overlapping(self, tiles: IntArray) -> list[tuple[int, int]]:
        """Pairs of tiles whose footprints share a piece of the surface."""
        pairs = []
        for place, tile in enumerate(map(int, tiles)):
            later = tiles[place + 1 :]
            close = later[gaps(self._squares, tile, later) < _CLOSE * self._squares.edge]
            pairs += [(tile, o) for o in map(int, close) if self.shared_area(tile, o) > _SHARED]
        return pairs

    def shared_area(self, tile: int, other: int) -> float:
        """Area of the surface under both of two tiles [m^2]."""
        pair = (min(tile, other), max(tile, other))
        if pair not in self._shared:
            self._shared[pair] = self._cutter.shared_area(self.footprint(pair[0]), pair[1])
        return self._shared[pair]
