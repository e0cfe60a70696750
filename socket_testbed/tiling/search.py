"""Search for the largest set of squares of which no two overlap.

The squares are the nodes of a graph, overlaps its edges: a largest independent set is wanted.
It is built greedily by least waste: of all squares that are still free, the one is placed that
takes the fewest other free ones away, so that tiles grow from corners, edges and other tiles.
Then parts of it are taken out and filled anew, with some chance in the order, and kept when no
tile is lost (ruin and recreate: Schrimpf et al. 2000, doi:10.1006/jcph.1999.6413).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.tiling.borders import border_gaps, border_points
from socket_testbed.tiling.squares import Squares, gaps
from socket_testbed.tiling.surface_points import SurfacePoints
from socket_testbed.tiling.verification import Verification

_WASTE_SPACING = 0.15  # [edges]; of the squares by which waste is counted
_REACH = 1.45  # [edges]; squares that overlap have their centres within it
_CHANCE = (0.0, 0.02, 0.1, 0.3)  # [-]; how far a recreation strays from least waste
_FEWEST_RUINED, _MOST_RUINED = 3, 14
_PLANE = 0.002  # [m]; gaps smaller than it are seen to on the surface itself
_CLEARANCE = 0.0001  # [m]; between tiles, for what the plane geometry of the search leaves out
_MORE = 0.0001  # [m]; it grows where footprints overlap all the same,
_AROUND = 0.003  # [m]; and around there


class Search:
    """Greedy placement and its improvement.

    The search sees squares as plane; each set of tiles that it keeps is verified on the surface
    itself, and what it got wrong it does not try again.

    Args:
        squares: The squares that fit.
        points: The surface.
        verification: Of the same squares.
    """

    def __init__(self, squares: Squares, points: SurfacePoints, verification: Verification) -> None:
        self._squares = squares
        self._borders = border_points(squares, points)
        self._verification = verification
        self._clearance = np.full(len(squares), _CLEARANCE)
        self._alive = np.ones(len(squares), dtype=bool)
        self._tree = KDTree(squares.anchors)
        self._overlaps_of_tile: dict[int, IntArray] = {}
        cell = np.floor(squares.anchors / (_WASTE_SPACING * squares.edge))
        self._witnesses = np.unique(cell, axis=0, return_index=True)[1]
        self._overlaps = self._overlaps_with_witnesses()

    def fill(self) -> IntArray:
        """A first set of tiles, to which none can be added."""
        tiles = np.zeros(0, dtype=np.int64)
        while True:
            free = self._alive.copy()
            for tile in tiles:
                free[self._overlapping(int(tile))] = False
            tiles = self._place(tiles, free, np.zeros(len(free)))
            wrong = self._wrong(tiles)
            if not wrong:
                return tiles
            tiles = np.array([tile for tile in tiles if tile not in wrong], dtype=np.int64)

    def improve(
        self,
        tiles: IntArray,
        rounds: int,
        rng: np.random.Generator,
        progress: Callable[[int, int], None] | None = None,
    ) -> IntArray:
        """Take out and fill anew, round by round; the set never gets smaller."""
        anchors = self._squares.anchors
        for done in range(rounds):
            centre = anchors[rng.integers(len(anchors))]
            order = np.argsort(np.linalg.norm(anchors[tiles] - centre, axis=1))
            ruined = int(rng.integers(_FEWEST_RUINED, _MOST_RUINED))
            kept, out = tiles[order[ruined:]], tiles[order[:ruined]]
            free = np.zeros(len(anchors), dtype=bool)
            for tile in out:
                free[self._overlapping(int(tile))] = True
            free &= self._alive
            for tile in kept:
                free[self._overlapping(int(tile))] = False
            found = self._place(kept, free, rng.choice(_CHANCE) * rng.random(len(free)))
            if len(found) >= len(tiles) and not self._wrong(found):
                tiles = found
                current = set(tiles.tolist())
                self._overlaps_of_tile = {
                    tile: near for tile, near in self._overlaps_of_tile.items() if tile in current
                }
            if progress is not None:
                progress(done + 1, rounds)
        return tiles

    def _place(self, tiles: IntArray, free: BoolArray, chance: FloatArray) -> IntArray:
        """Place free squares by least waste until none is left."""
        placed = list(tiles)
        candidates = np.flatnonzero(free)
        waste = np.full(len(free), np.inf)
        waste[candidates] = self._waste(candidates, free)
        while len(candidates):
            best = int(candidates[np.argmin(waste[candidates] * (1.0 + chance[candidates]))])
            placed.append(best)
            free[self._overlapping(best)] = False
            candidates = candidates[free[candidates]]
            offset = self._squares.anchors[candidates] - self._squares.anchors[best]
            changed = candidates[np.einsum("ci,ci->c", offset, offset) < (2.0 * self._reach) ** 2]
            waste[changed] = self._waste(changed, free)
        return np.array(placed, dtype=np.int64)

    def _wrong(self, tiles: IntArray) -> set[int]:
        """Tiles that must go, so that the others are whole and share nothing."""
        wrong = set(self._verification.unfit(tiles))
        self._alive[list(wrong)] = False
        for pair in self._verification.overlapping(tiles):
            if not wrong.intersection(pair):
                wrong.add(pair[1])
                for tile in pair:
                    near = self._tree.query_ball_point(self._squares.anchors[tile], _AROUND)
                    self._clearance[near] += _MORE
                self._overlaps_of_tile.clear()
        return wrong

    def _waste(self, candidates: IntArray, free: BoolArray) -> FloatArray:
        """Free witnesses that each candidate would take away."""
        return self._overlaps[candidates] @ free[self._witnesses].astype(np.float32)

    @property
    def _reach(self) -> float:
        return _REACH * self._squares.edge

    def _near(self, index: int) -> IntArray:
        return np.array(self._tree.query_ball_point(self._squares.anchors[index], self._reach))

    def _overlapping(self, index: int) -> IntArray:
        """Squares that overlap a given one, itself included."""
        if index not in self._overlaps_of_tile:
            near = self._near(index)
            gap = gaps(self._squares, index, near)
            close = np.abs(gap) < _PLANE
            gap[close] = border_gaps(self._squares, self._borders, index, near[close])
            clearance = np.maximum(self._clearance[near], self._clearance[index])
            self._overlaps_of_tile[index] = near[gap < clearance]
        return self._overlaps_of_tile[index]

    def _overlaps_with_witnesses(self) -> sparse.csr_matrix:
        """Which squares overlap which witnesses, shape (m, w)."""
        overlapping = []
        for witness in self._witnesses:
            near = self._near(int(witness))
            overlap = gaps(self._squares, int(witness), near) < _CLEARANCE
            overlapping.append(near[overlap].astype(np.int32))
        ends = np.cumsum([0, *map(len, overlapping)])
        ones = np.ones(ends[-1], dtype=np.float32)
        shape = (len(self._squares), len(self._witnesses))
        return sparse.csc_matrix((ones, np.concatenate(overlapping), ends), shape=shape).tocsr()
