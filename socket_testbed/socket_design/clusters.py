"""Clusters on the interior: tiles for existing ones, and places for planned ones.

A glued sensor cannot move: the tiles are laid around it (`lay_clusters`).

Planned clusters are proposed where they are most informative about the forces on all tiles
(`place_clusters`), A-optimal over the force map's prior. The expected error of the map depends only
on the places, not on the measured values: it is the trace of the posterior covariance over that of
the prior, averaged over the hypotheses. Clusters are placed one by one, each where it lowers the
trace most (for greedy placement see Krause, Singh & Guestrin, Near-optimal sensor placements in
Gaussian processes, JMLR 2008).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from trimesh.triangles import closest_point

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.documents import Document, FieldError, read_document
from socket_testbed.errors import ConfigurationError
from socket_testbed.geometry.pose import Point, RotationRows, ScanPoint, about_z, check_rotation
from socket_testbed.geometry.socket import ScanFrame, SocketGeometry
from socket_testbed.identification.map_prior import Prior, hypotheses
from socket_testbed.settings.identification import ForceMapSettings
from socket_testbed.socket_design.squares import (
    Footprints,
    Squares,
    SurfacePoints,
    Surroundings,
    roughly_fit,
    squares_at,
)


@dataclass(frozen=True)
class ClusterPlace:
    """Where a cluster is in the socket.

    Attributes:
        name: Name of the cluster.
        centre: Centre of the cluster, shape (3,), in {S} [m], or in the scan's coordinates and unit
            if `in_scan`.
        frame: Frame of the cluster in {S}, shape (3, 3) [-], with columns x, y, z (inward normal);
            None for that of its tile.
        where: Start of errors about this place: the file and its field.
        in_scan: Whether `centre` is in the scan's coordinates and unit.
    """

    name: str
    centre: FloatArray
    frame: FloatArray | None
    where: str
    in_scan: bool = False

    def in_load_cell(self, scan: ScanFrame) -> ClusterPlace:
        """The same place with its centre in {S} [m]; unchanged if it is there already."""
        centre = scan.points(self.centre) if self.in_scan else self.centre
        return replace(self, centre=centre, in_scan=False)


def read_cluster_places(path: Path) -> list[ClusterPlace]:
    """Read the places of clusters.

    The key `clusters` holds for each name a `point` in {S} [m], a point in the `scan` (in its
    coordinates and unit), or an `anchor` in {S} [m] and a `frame`.
    """
    return [
        ClusterPlace(
            name,
            centre=np.array(place.point or place.scan or place.anchor),
            frame=None if place.frame is None else np.array(place.frame),
            where=f"{path}: clusters: {name}",
            in_scan=place.scan is not None,
        )
        for name, place in read_document(path, _Places).clusters.items()
    ]


class _Place(Document):
    point: Point | None = None
    scan: ScanPoint | None = None
    anchor: Point | None = None
    frame: RotationRows | None = None

    def __post_init__(self) -> None:
        given = [key for key in self.__struct_fields__ if getattr(self, key) is not None]
        if given not in (["point"], ["scan"], ["anchor", "frame"]):
            raise FieldError(
                f"has {' and '.join(given) or 'no place'}",
                "give a point, or a point of the scan, or anchor and frame",
            )
        if self.frame is not None:
            check_rotation(self.frame, "frame")


class _Places(Document):
    clusters: dict[str, _Place]


@dataclass(frozen=True)
class LaidCluster:
    """A cluster on the interior.

    Attributes:
        name: Name of the cluster.
        asked: Its specified place in {S}, shape (3,) [m].
        surface: The point of the interior nearest to its specified place, in {S}, shape (3,) [m].
        anchor: Centre of its tile in {S}, shape (3,) [m].
        turned: Angle from its tile's x axis to its own about the inward normal [rad].
    """

    name: str
    asked: FloatArray
    surface: FloatArray
    anchor: FloatArray
    turned: float

    @property
    def moved(self) -> float:
        """Distance of its tile from its specified place, projected on the interior [m]."""
        return float(np.linalg.norm(self.anchor - self.surface))

    def __str__(self) -> str:
        asked, anchor = (
            ", ".join(f"{1e3 * value:z.1f}" for value in point)
            for point in (self.asked, self.anchor)
        )
        distance = 1e3 * float(np.linalg.norm(self.anchor - self.asked))
        turned = f", turned by {np.degrees(self.turned):.1f} deg" if self.turned else ""
        return f"asked at ({asked}), laid at ({anchor}) mm of {{S}}, {distance:.1f} mm away{turned}"


_MAX_DISTANCE = 0.030  # [m]; of a place from the interior
_MAX_TILT = 30.0  # [deg]; of a frame's z from the inward normal
_MIN_TURN = np.radians(0.1)  # a smaller one is none
_MAX_SHIFT = 0.5  # [edges]; of a tile that does not fit at its cluster's place


def lay_clusters(
    mesh: trimesh.Trimesh,
    places: Sequence[ClusterPlace],
    others: Squares,
    surroundings: Surroundings,
    flatness: float,
) -> tuple[Squares, list[LaidCluster]]:
    """Lay each cluster's square at the point of the interior nearest to its place.

    If its footprint is incomplete there, it is laid at the nearest of the other squares' centres
    where it is complete.

    Args:
        mesh: The interior in {S} [m], with normals into the cavity.
        places: Places of the clusters in {S}.
        others: Squares whose centres in {S} may replace a cluster's place; all have their edge.
        surroundings: The interior as points in {S}, with the directions of the tiles' x axes.
        flatness: Largest distance of the surface from a tile's plane [m].

    Returns:
        A square for each place, in order, in {S}, its edges along the cluster's own axes; and the
        cluster on it.

    Raises:
        ConfigurationError: If a place is far from the interior, its frame's z axis is more than 30
            degrees off the inward normal, no tile fits near it, or it overlaps another.
    """
    edge = others.edge
    squares, laid = others.take(np.arange(0)), list[LaidCluster]()
    for place in places:
        own = squares_at(_on_surface(mesh, place), surroundings, edge)
        turned = _turn_angle(place, own)
        distance = np.linalg.norm(others.anchors - own.anchors, axis=1)
        order = np.argsort(distance)
        candidates = own.join(others.take(order[distance[order] < _MAX_SHIFT * edge]))
        candidates = replace(candidates, rotations=candidates.rotations @ about_z(turned))
        likely = roughly_fit(candidates, surroundings, flatness)
        likely[0] = True  # at the cluster's own place the exact footprint decides
        candidates = candidates.take(likely)
        footprints = Footprints(mesh, candidates, flatness)
        fits = next((i for i in range(len(candidates)) if not footprints.unfit([i])), None)
        if fits is None:
            raise ConfigurationError(
                f"{place.where}: no {1e3 * edge:g} mm tile fits within"
                f" {1e3 * _MAX_SHIFT * edge:g} mm of it: the interior has a rim there, or is not"
                " flat enough",
                "check its place, or give a smaller --size or a larger --flatness",
            )
        squares = squares.join(candidates.take(np.array([fits])))
        anchor = candidates.anchors[fits]
        laid.append(LaidCluster(place.name, place.centre, own.anchors[0], anchor, turned))
    for a, b in Footprints(mesh, squares, flatness).overlapping(np.arange(len(squares))):
        apart = 1e3 * float(np.linalg.norm(squares.anchors[a] - squares.anchors[b]))
        raise ConfigurationError(
            f"{places[b].where}: overlaps {laid[a].name}, their centres are {apart:.1f} mm apart",
            f"check their places: each covers {1e3 * edge:g} x {1e3 * edge:g} mm",
        )
    return squares, laid


def _on_surface(mesh: trimesh.Trimesh, place: ClusterPlace) -> SurfacePoints:
    """The point of the interior nearest to a place, on a wall that faces like its frame."""
    triangles, normals = np.asarray(mesh.triangles), np.asarray(mesh.face_normals)
    if place.frame is not None:
        facing = normals @ place.frame[:, 2] > 0.0
        triangles, normals = triangles[facing], normals[facing]
    points = closest_point(triangles, np.broadcast_to(place.centre, (len(triangles), 3)))
    distances = np.linalg.norm(points - place.centre, axis=1)
    nearest = int(distances.argmin()) if len(distances) else 0
    if not len(distances) or distances[nearest] > _MAX_DISTANCE:
        far = f"{1e3 * distances[nearest]:.0f} mm" if len(distances) else "turned away"
        raise ConfigurationError(
            f"{place.where}: is {far} from the interior",
            "give its place on the interior, in {S} in m or in the scan's coordinates",
        )
    return SurfacePoints(points[[nearest]], normals[[nearest]], np.zeros(1))


def _turn_angle(place: ClusterPlace, square: Squares) -> float:
    """Angle from the x axis of a cluster's tile to its own, about the inward normal [rad]."""
    if place.frame is None:
        return 0.0
    x, _, z = (square.rotations[0].T @ place.frame).T
    tilted = float(np.degrees(np.arccos(np.clip(z[2], -1.0, 1.0))))
    if tilted > _MAX_TILT:
        raise ConfigurationError(
            f"{place.where}: its z is {tilted:.0f} deg off the inward normal of the interior",
            "give the columns x, y, z of its frame, z inwards",
        )
    turned = float(np.arctan2(x[1], x[0]))
    return 0.0 if abs(turned) < _MIN_TURN else turned


_HYPOTHESES = 16
_RANDOM_PLACEMENTS = 20  # placements for comparison


@dataclass(frozen=True)
class ClusterPlacement:
    """Proposed places of clusters.

    Attributes:
        tiles: Indices of the clusters' tiles in the order of their choice, fixed ones first, shape
            (count,).
        errors: Expected error of the force map on the tiles without a cluster, over the RMS of
            their forces [-], keyed by the number of clusters: the first tiles of `tiles`.
        at_random: Smallest and largest expected error of random placements of as many clusters,
            over the RMS of the forces [-].
    """

    tiles: IntArray
    errors: dict[int, float]
    at_random: tuple[float, float]


class _ExpectedError:
    """Expected error of the map under its prior, given the wrench and clusters on some tiles."""

    def __init__(self, geometry: SocketGeometry) -> None:
        # Covariance K of the tiles' forces under each hypothesis, (3n, 3n) [N^2]
        self._prior: list[FloatArray] = []
        # Covariance of the tiles' forces given the wrench, under each hypothesis, (3n, 3n) [N^2]
        self._with_wrench: list[FloatArray] = []
        # Error variances of a cluster on each tile, under each hypothesis, (3n,) [N^2]
        self._noise: list[FloatArray] = []
        names = geometry.names
        everywhere = replace(geometry, clusters={name: tile for tile, name in enumerate(names)})
        for sizes in hypotheses(ForceMapSettings(draws=_HYPOTHESES), geometry.tile_share):
            prior = Prior(everywhere, names, sizes)
            whole, onto = prior.covariance(), prior.mapping[:6]
            mapped = whole @ onto.T
            known = onto @ mapped + np.diag(prior.noise[:6])
            self._prior.append(whole)
            self._with_wrench.append(whole - mapped @ np.linalg.solve(known, mapped.T))
            self._noise.append(prior.noise[6:])

    def error(self, tiles: Sequence[int]) -> float:
        """Expected error on the tiles without a cluster, over their RMS [-]."""
        after, before = (
            np.array([np.delete(np.diag(K).reshape(-1, 3), tiles, axis=0).sum() for K in found])
            for found in (self._posterior(tiles), self._prior)
        )
        return float(np.sqrt((after / before).mean()))

    def best(self, tiles: Sequence[int], free: IntArray) -> int:
        """The free tile on which another cluster lowers the error most."""
        gains = np.sum([*map(_gains, self._posterior(tiles), self._noise)], axis=0)
        return int(free[gains[free].argmax()])

    def _posterior(self, tiles: Sequence[int]) -> list[FloatArray]:
        rows = (3 * np.array(tiles, dtype=int)[:, None] + np.arange(3)).ravel()
        return [
            K - K[:, rows] @ np.linalg.solve(K[np.ix_(rows, rows)] + np.diag(noise[rows]), K[rows])
            for K, noise in zip(self._with_wrench, self._noise, strict=True)
        ]


def _gains(covariance: FloatArray, noise: FloatArray) -> FloatArray:
    """Relative decrease of the trace for a cluster on each tile, shape (n,) [-]."""
    columns = covariance.reshape(len(covariance), -1, 3)  # (3n, n, 3)
    squares = np.einsum("jia,jib->iab", columns, columns)
    tiles = np.arange(len(squares))
    own = covariance.reshape(len(tiles), 3, len(tiles), 3)[tiles, :, tiles]
    seen = own + np.eye(3) * noise.reshape(-1, 1, 3)
    lowered = np.linalg.solve(seen, squares).trace(axis1=1, axis2=2)
    return np.asarray(lowered / np.trace(covariance))


def place_clusters(
    geometry: SocketGeometry, count: int, stay: Sequence[int], allowed: BoolArray
) -> ClusterPlacement:
    """Propose tiles for `count` clusters, including those that `stay` on their tiles.

    The socket's own clusters are ignored.

    Args:
        geometry: The socket with its n tiles.
        count: Number of clusters in all.
        stay: Indices of the tiles whose clusters stay.
        allowed: Which tiles may take another cluster, shape (n,).

    Raises:
        ConfigurationError: If `count` is less than the clusters that stay, or more than fit on the
            free tiles.
    """
    expectation = _ExpectedError(geometry)
    free = np.setdiff1d(np.flatnonzero(allowed), stay)
    if not len(stay) <= count <= len(stay) + len(free):
        raise ConfigurationError(
            f"{count} clusters, of which {len(stay)} stay, do not fit on {len(free)} free tiles",
            "place others, or keep out of fewer regions",
        )
    chosen = [*stay]
    while len(chosen) < count:
        chosen.append(expectation.best(chosen, np.setdiff1d(free, chosen)))
    rng = np.random.default_rng(0)
    drawn = [
        expectation.error([*stay, *rng.choice(free, count - len(stay), replace=False)])
        for _ in range(_RANDOM_PLACEMENTS)
    ]
    errors = {n: expectation.error(chosen[:n]) for n in range(max(len(stay), 1), count + 1)}
    return ClusterPlacement(np.array(chosen), errors, (min(drawn), max(drawn)))
