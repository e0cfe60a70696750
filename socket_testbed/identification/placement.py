"""Where clusters tell most about the forces on all tiles: A-optimal over the force map's prior.

The expected error of the map does not depend on what is measured, only on where: it is the trace of
the posterior covariance over that of the prior, averaged over the hypotheses. Clusters are placed
one after the other, each where it lowers the trace most (Krause, Singh & Guestrin, Near-optimal
sensor placements in Gaussian processes, JMLR 2008, for such greedy choices).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import Prior, hypotheses
from socket_testbed.settings.identification import ForceMapSettings

_HYPOTHESES = 16
_RANDOM = 20  # placements to compare with


@dataclass(frozen=True)
class ClusterPlacement:
    """A proposal for the places of clusters."""

    tiles: IntArray  # of the clusters, in the order of their choice, those that stay first
    # expected error of the force map on the tiles without a cluster, over their rms, by the number
    # of clusters placed [-]
    errors: dict[int, float]
    at_random: tuple[float, float]  # the least and the largest with as many clusters at random [-]


class _Expectation:
    """What the prior expects of the map's error, given the wrench and clusters on some tiles."""

    def __init__(self, geometry: SocketGeometry, settings: ForceMapSettings) -> None:
        self._settings = settings
        self._before: list[FloatArray] = []  # K under each hypothesis
        self._loaded: list[FloatArray] = []  # likewise, given the wrench
        bare = replace(geometry, clusters={})
        for sizes in hypotheses(replace(settings, draws=_HYPOTHESES)):
            prior = Prior(bare, (), sizes)
            whole = prior.times(np.eye(3 * len(geometry)).reshape(len(geometry), 3, -1))
            whole = whole.reshape(3 * len(geometry), -1)
            mapped = whole @ prior.mapping.T
            known = prior.mapping @ mapped + np.diag(prior.noise)
            self._before.append(whole)
            self._loaded.append(whole - mapped @ np.linalg.solve(known, mapped.T))

    def error(self, tiles: Sequence[int]) -> float:
        """Expected error on the tiles without a cluster, over their rms [-]."""
        left = self._loaded
        for tile in tiles:
            left = self._with(left, tile)
        free = np.setdiff1d(np.arange(len(left[0]) // 3), tiles)
        rows = (3 * free[:, None] + np.arange(3)).ravel()
        ratios = [
            np.trace(after[np.ix_(rows, rows)]) / np.trace(before[np.ix_(rows, rows)])
            for after, before in zip(left, self._before, strict=True)
        ]
        return float(np.sqrt(np.mean(ratios)))

    def place(self, count: int, stay: Sequence[int], allowed: BoolArray) -> list[int]:
        """The tiles of so many clusters, those that stay first."""
        left, chosen, open_to = self._loaded, list(stay), allowed.copy()
        for tile in stay:
            left = self._with(left, tile)
        open_to[list(stay)] = False
        while len(chosen) < count:
            gains = np.where(open_to, np.sum([self._gains(each) for each in left], axis=0), -np.inf)
            best = int(gains.argmax())
            chosen.append(best)
            open_to[best] = False
            left = self._with(left, best)
        return chosen

    def _gains(self, covariance: FloatArray) -> FloatArray:
        """Relative decrease of the trace by a cluster on each tile, shape (n,) [-]."""
        columns = covariance.reshape(len(covariance), -1, 3)  # (3n, n, 3)
        squares = np.einsum("jia,jib->iab", columns, columns)
        tiles = np.arange(len(squares))
        own = covariance.reshape(len(tiles), 3, len(tiles), 3)[tiles, :, tiles]
        lowered = np.linalg.solve(own + self._noise(own), squares).trace(axis1=1, axis2=2)
        return np.asarray(lowered / np.trace(covariance))

    def _with(self, covariances: list[FloatArray], tile: int) -> list[FloatArray]:
        """The covariances given a cluster on a tile."""
        rows, found = 3 * tile + np.arange(3), []
        for covariance in covariances:
            columns = covariance[:, rows]
            own = covariance[np.ix_(rows, rows)]
            gained = np.linalg.solve(own + self._noise(own[None])[0], columns.T)
            found.append(covariance - columns @ gained)
        return found

    def _noise(self, own: FloatArray) -> FloatArray:
        """Covariances of the errors of clusters that measure forces of covariances (k, 3, 3)."""
        offset, gain = self._settings.cluster_error, self._settings.cluster_gain_error
        return np.asarray(np.eye(3) * (offset**2 + gain**2 * own))


def place_clusters(
    geometry: SocketGeometry,
    count: int,
    stay: Sequence[int] = (),
    allowed: BoolArray | None = None,
    settings: ForceMapSettings | None = None,
) -> ClusterPlacement:
    """Propose tiles for clusters.

    Args:
        geometry: The socket; its own clusters do not count.
        count: Number of clusters, those that stay included.
        stay: Tiles of clusters that are there already.
        allowed: Tiles that may take another cluster, shape (n,); all if not given.
        settings: The force map's prior.
    """
    expectation = _Expectation(geometry, settings or ForceMapSettings())
    allowed = np.ones(len(geometry), dtype=bool) if allowed is None else allowed
    free = np.setdiff1d(np.flatnonzero(allowed), stay)
    if not len(stay) <= count <= len(stay) + len(free):
        raise ConfigurationError(
            f"{count} clusters, of which {len(stay)} stay, do not fit on {len(free)} free tiles",
            "place others, or keep out of fewer regions",
        )
    chosen = expectation.place(count, stay, allowed)
    rng = np.random.default_rng(0)
    drawn = [
        expectation.error([*stay, *rng.choice(free, count - len(stay), replace=False)])
        for _ in range(_RANDOM)
    ]
    errors = {n: expectation.error(chosen[:n]) for n in range(max(len(stay), 1), count + 1)}
    return ClusterPlacement(np.array(chosen), errors, (min(drawn), max(drawn)))
