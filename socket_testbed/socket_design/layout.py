"""A socket's geometry from its tiling: names of the tiles, and the tiles of the clusters."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from trimesh.triangles import closest_point

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import Section, read_document
from socket_testbed.geometry.axis import SocketAxis, axis_through
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


# Where three of the testbed's clusters usually are: angle from anterior [deg], and height of all.
_USUAL = {"brim_lateral": (90.0, 1.0), "mid_anterior": (0.0, 0.6), "posterior_distal": (180.0, 0.2)}
_DISTAL = "distal"
_MOST_TURNED = 45.0  # [deg]; from there, for the name to be right
_MOST_RAISED = 1.5  # [edges]; likewise
_LOW = 0.06  # [m]; what is higher is no distal end
_OPEN = 0.005  # [m]; hole around the axis that opens it


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
    turned, raised = _from_usual(axis, squares.anchors)
    score = {name: 3.0 * np.cos(turned[name]) - 4.0 * raised[name] for name in _USUAL}
    score[_DISTAL] = -np.linalg.norm(squares.anchors - end, axis=1)
    taken: set[int] = set()
    places = []
    for name, value in score.items():
        best = next((int(i) for i in np.argsort(-value) if int(i) not in taken), None)
        if best is not None:
            taken.add(best)
            places.append(ClusterPlace(name, squares.anchors[best], None, name))
    return places


def _from_usual(
    axis: SocketAxis, points: FloatArray
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Angles [rad] and parts of the height [-] of points from the usual places, by their names."""
    height, angle = axis.heights(points), axis.angles(points)
    level = height / max(float(height.max()), 1e-9)
    turned = {name: angle - np.radians(usual) for name, (usual, _) in _USUAL.items()}
    return turned, {name: np.abs(level - usual) for name, (_, usual) in _USUAL.items()}


def refuse_unusual(
    places: list[ClusterPlace], squares: Squares, mesh: trimesh.Trimesh, axis: SocketAxis
) -> None:
    """Refuse nominal clusters that the socket has no usual place for.

    Args:
        places: The nominal places, each the centre of a tile.
        squares: The tiles.
        mesh: The interior [m].
        axis: The socket's axis.

    Raises:
        ConfigurationError: With the list of what is wrong.
    """
    turned, raised = _from_usual(axis, squares.anchors)
    most = (
        _MOST_RAISED * squares.edge / max(float(axis.heights(squares.anchors).max()), squares.edge)
    )
    found = []
    for place in places:
        tile = int(np.linalg.norm(squares.anchors - place.centre, axis=1).argmin())
        where = (
            f"{place.name} {1e3 * float(axis.heights(place.centre)):.0f} mm above the distal end"
        )
        if place.name != _DISTAL:
            off = float(np.degrees(np.arccos(np.cos(turned[place.name][tile]))))
            if off > _MOST_TURNED or raised[place.name][tile] > most:
                found.append(f"{where} and {off:.0f} deg from its side")
        elif np.linalg.norm(place.centre - axis.end) > squares.edge:
            found.append(where)
        elif (hole := _hole_around(mesh, axis)) > _OPEN:
            found.append(f"{place.name} beside a hole of {1e3 * hole:.0f} mm around the axis")
    if found:
        raise ConfigurationError(
            f"the usual places of clusters are not on this socket ({'; '.join(found)})",
            "give with --clusters FILE where yours are",
        )


def _hole_around(mesh: trimesh.Trimesh, axis: SocketAxis) -> float:
    """Distance of the distal end's surface from the axis, looking along it [m]."""
    triangles = np.asarray(mesh.triangles)
    low = triangles[axis.heights(triangles).min(axis=1) < _LOW]
    flat = low - axis.heights(low)[..., None] * axis.proximal
    nearest = closest_point(flat, np.broadcast_to(axis.end, (len(flat), 3)))
    return float(np.linalg.norm(nearest - axis.end, axis=1).min())


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
    places: list[ClusterPlace],
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
        places: Where the clusters are.
        bodies: A geometry with the marker bodies to take over.
        source: What the tiles were made from.

    Returns:
        The geometry, and notes on the clusters.

    Raises:
        ConfigurationError: If a cluster is on no tile, or two are on the same.
    """
    names = tile_names(tiling.squares.anchors, end, proximal, anterior)
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
