"""A socket's geometry from its tiling: names of the tiles, and the tiles of the clusters."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import Section, read_document
from socket_testbed.geometry.axis import axis_through
from socket_testbed.geometry.pose import read_rotation
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.socket_design.squares import Squares
from socket_testbed.socket_design.tiling import Tiling


def tile_names(
    anchors: FloatArray, end: FloatArray, proximal: FloatArray, anterior: FloatArray
) -> tuple[str, ...]:
    """Names such as `h092_a045`: 92 mm above the distal end, 45 degrees from anterior.

    The angle is about the axis through the end, counterclockwise seen from above. Tiles at one
    place to the millimetre and the degree differ by a letter.

    Args:
        anchors: Centres of the tiles, shape (n, 3) [m].
        end: Centre of the distal end, shape (3,) [m].
        proximal: Direction towards the proximal end, shape (3,) [-].
        anterior: Direction from which angles count, shape (3,) [-].
    """
    axis = axis_through(end, proximal, anterior)
    heights = np.maximum(np.round(1e3 * axis.heights(anchors)), 0).astype(int)
    angles = np.degrees(axis.angles(anchors))
    names: list[str] = []
    for height, angle in zip(heights, np.round(angles).astype(int) % 360, strict=True):
        name = f"h{height:03d}_a{angle:03d}"
        twins = sum(other.startswith(name) for other in names)
        names.append(name + (chr(ord("a") + twins) if twins else ""))
    return tuple(names)


_FARTHEST = 1.0  # [edges]; a cluster farther from every tile is on none
_LEAST_SHARE = 0.05  # [-]; part of a cluster on another tile, or beside its own, to speak of
_GRID = 40  # points along an edge, to measure what squares share


@dataclass(frozen=True)
class ClusterPlace:
    """Where a cluster is in the socket.

    Attributes:
        name: Name of the cluster.
        centre: Its centre in {S}, shape (3,) [m].
        frame: Its own frame in {S}, shape (3, 3) [-]; None for that of the nearest tile.
        where: What names it in an error.
    """

    name: str
    centre: FloatArray
    frame: FloatArray | None
    where: str


def read_cluster_places(path: Path) -> list[ClusterPlace]:
    """Read where the clusters are in {S}.

    Below the key `clusters`, by name: a `point` [m], or an `anchor` [m] and a `frame`.

    Raises:
        ConfigurationError: If anything in the file is not as it must be.
    """
    document = read_document(path).expect(("clusters",))
    return [_place(name, section) for name, section in document.sections("clusters")]


def _place(name: str, section: Section) -> ClusterPlace:
    section.expect(("point", "anchor", "frame"))
    if "point" in section.names():
        if len(section.names()) > 1:
            raise ConfigurationError(
                f"{section.where}: has a point and a frame", "give a point, or anchor and frame"
            )
        return ClusterPlace(name, section.array("point", (3,), limit=2.0), None, section.where)
    centre = section.array("anchor", (3,), limit=2.0)
    return ClusterPlace(name, centre, read_rotation(section, "frame"), section.where)


def nominal_places(
    squares: Squares, end: FloatArray, proximal: FloatArray, anterior: FloatArray
) -> list[ClusterPlace]:
    """The four clusters of the testbed where they usually are, for a socket without a file.

    Args:
        squares: The tiles.
        end: Centre of the distal end, shape (3,) [m].
        proximal: Direction towards the proximal end, shape (3,) [-].
        anterior: Direction towards anterior, shape (3,) [-].
    """
    axis = axis_through(end, proximal, anterior)
    height, angle = axis.heights(squares.anchors), axis.angles(squares.anchors)
    sideways = np.column_stack([np.cos(angle), np.sin(angle)])
    level = height / max(float(height.max()), 1e-9)
    score = {
        "brim_lateral": 3.0 * sideways @ [0.0, 1.0] + 4.0 * level,
        "mid_anterior": 3.0 * sideways @ [1.0, 0.0] - 4.0 * np.abs(level - 0.6),
        "posterior_distal": 3.0 * sideways @ [-1.0, 0.0] - 4.0 * np.abs(level - 0.2),
        "distal": -np.linalg.norm(squares.anchors - end, axis=1),
    }
    taken: set[int] = set()
    places = []
    for name, value in score.items():
        best = next((int(i) for i in np.argsort(-value) if int(i) not in taken), None)
        if best is not None:
            taken.add(best)
            places.append(ClusterPlace(name, squares.anchors[best], None, name))
    return places


def assign_clusters(
    places: list[ClusterPlace], squares: Squares, names: tuple[str, ...]
) -> tuple[dict[str, int], list[str]]:
    """The tile of each cluster, and notes on clusters that do not sit on one tile.

    Args:
        places: Where the clusters are.
        squares: The tiles.
        names: Their names.

    Raises:
        ConfigurationError: If a cluster is on no tile, or two are on the same.
    """
    clusters: dict[str, int] = {}
    notes: list[str] = []
    for place in places:
        distance = np.linalg.norm(squares.anchors - place.centre, axis=1)
        nearest = int(distance.argmin())
        if distance[nearest] > _FARTHEST * squares.edge:
            raise ConfigurationError(
                f"{place.where}: is {1e3 * distance[nearest]:.0f} mm from the nearest tile",
                "give its place in {S} in m, on the interior",
            )
        if nearest in clusters.values():
            other = next(name for name, tile in clusters.items() if tile == nearest)
            raise ConfigurationError(
                f"{place.where}: is on {names[nearest]}, where {other} is", "move one of them"
            )
        clusters[place.name] = nearest
        notes += _notes(place, squares, names, nearest)
    return clusters, notes


def _notes(
    place: ClusterPlace, squares: Squares, names: tuple[str, ...], nearest: int
) -> list[str]:
    """How a cluster lies that is not on one tile."""
    if place.frame is None:  # a point only chooses the tile
        return []
    shares = _shares(place.centre, place.frame, squares)
    others = [int(i) for i in np.argsort(-shares) if i != nearest and shares[i] > _LEAST_SHARE]
    if shares[nearest] >= 1.0 - _LEAST_SHARE and not others:
        return []
    on = ", ".join(f"{100 * shares[i]:.0f} % on {names[i]}" for i in [nearest, *others])
    return [
        f"cluster {place.name} does not sit on one tile ({on}): its stress is taken as that of"
        f" {names[nearest]}"
    ]


def _shares(centre: FloatArray, frame: FloatArray, squares: Squares) -> FloatArray:
    """Parts of a square that lie over each tile of the same wall, shape (n,) [-]."""
    steps = ((np.arange(_GRID) + 0.5) / _GRID - 0.5) * squares.edge
    grid = np.array([[x, y, 0.0] for x in steps for y in steps])
    points = centre + grid @ frame.T
    offset = points[None] - squares.anchors[:, None]
    x, y, height = np.moveaxis(offset @ squares.rotations, 2, 0)
    half = 0.5 * squares.edge
    inside = (np.abs(x) < half) & (np.abs(y) < half) & (np.abs(height) < half)
    facing = squares.rotations[:, :, 2] @ frame[:, 2] > 0.0
    return np.where(facing, inside.mean(axis=1), 0.0)


def tiled_socket(
    tiling: Tiling,
    end: FloatArray,
    proximal: FloatArray,
    anterior: FloatArray,
    places: list[ClusterPlace] | None,
    bodies: SocketGeometry,
    source: str,
) -> tuple[SocketGeometry, list[str]]:
    """The geometry of a tiled socket in {S}, its tiles in the order of their names.

    A tile that a cluster is on has the cluster's name.

    Args:
        tiling: The tiles in {S}.
        end: Centre of the distal end in {S}, shape (3,) [m].
        proximal: Direction towards the proximal end in {S}, shape (3,) [-].
        anterior: Direction from which the names' angles count, shape (3,) [-].
        places: Where the clusters are; None for where they usually are.
        bodies: A geometry with the marker bodies to take over.
        source: What the tiles were made from.

    Returns:
        The geometry, and notes on the clusters.

    Raises:
        ConfigurationError: If a cluster is on no tile, or two are on the same.
    """
    names = tile_names(tiling.squares.anchors, end, proximal, anterior)
    if places is None:
        places = nominal_places(tiling.squares, end, proximal, anterior)
    clusters, notes = assign_clusters(places, tiling.squares, names)
    order = np.array(sorted(range(len(names)), key=names.__getitem__))
    place_of = np.argsort(order)
    name_of_cluster_tile = {tile: cluster for cluster, tile in clusters.items()}
    geometry = dataclasses.replace(
        bodies,
        names=tuple(name_of_cluster_tile.get(int(tile), names[tile]) for tile in order),
        anchors=tiling.squares.anchors[order],
        rotations=tiling.squares.rotations[order],
        areas=np.full(len(names), tiling.squares.edge**2),
        neighbours=_renumbered(tiling.neighbours, place_of),
        clusters={cluster: int(place_of[tile]) for cluster, tile in clusters.items()},
        source=source,
    )
    return geometry, notes


def _renumbered(pairs: IntArray, place_of: IntArray) -> IntArray:
    """Pairs of tiles by their new indices, each and all sorted."""
    pairs = np.sort(place_of[pairs], axis=1)
    return pairs[np.lexsort(pairs.T[::-1])]
