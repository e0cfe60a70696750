"""A socket's design: from a scan to tiles, clusters and frames in {S}.

{S} is placed in a scan by directions, landmarks, or three picked points.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
import trimesh

from socket_testbed.arrays import FloatArray
from socket_testbed.documents import Document, read_document
from socket_testbed.errors import ConfigurationError, RegistrationError, naming
from socket_testbed.geometry.pose import Point, Pose, ScanPoint, about_z
from socket_testbed.geometry.regions import SocketAxis, all_regions, axis_between, tiles_named
from socket_testbed.geometry.socket import ScanFrame, SocketGeometry
from socket_testbed.socket_design.clusters import ClusterPlace, place_clusters
from socket_testbed.socket_design.interior import find_interior, refuse_implausible
from socket_testbed.socket_design.registration import MAX_RESIDUAL, own_frame, register_landmarks
from socket_testbed.socket_design.scan_file import METRES, Scan
from socket_testbed.socket_design.squares import Squares
from socket_testbed.socket_design.tiling import Tiling, TilingSettings, tile_interior

_MIN_SINE = 0.1  # [-]; about 6 degrees between directions that span a plane


@dataclass(frozen=True)
class Placement:
    """Pose of the scan in {S}.

    Attributes:
        scan_in_load_cell: Pose of the scan's frame in {S}, for coordinates of the scan in metres.
        source: How the pose was found, in words.
    """

    scan_in_load_cell: Pose
    source: str


def parse_direction(text: str, where: str) -> FloatArray:
    """A unit vector, shape (3,) [-], in the frame that the text refers to, such as the scan's.

    Args:
        text: An axis, such as `+z`, or three numbers, such as `0 0.1 1`, of any length.
        where: Start of the error, such as the option.

    Raises:
        ConfigurationError: If the text is neither, or the vector has no length.
    """
    axis = re.fullmatch(r"([+-]?)([xyz])", text.strip().lower())
    if axis:
        direction = np.eye(3)["xyz".index(axis[2])]
        return -direction if axis[1] == "-" else direction
    try:
        vector = parse_point(text, where)
    except ConfigurationError as error:
        raise ConfigurationError(error.fact, "give an axis, such as +z, or three numbers") from None
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        raise ConfigurationError(f"{where} is '{text}', no direction", "give +z or three numbers")
    return vector / length


def parse_point(text: str, where: str) -> FloatArray:
    """Three numbers, shape (3,), in the unit of the text.

    Args:
        text: Three numbers with spaces or commas between them.
        where: Start of the error, such as the option.

    Raises:
        ConfigurationError: If the text does not hold three finite numbers.
    """
    try:
        point = np.array([float(word) for word in re.split(r"[\s,]+", text.strip())])
    except ValueError:
        point = np.zeros(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ConfigurationError(f"{where} is '{text}'", "give three numbers, such as '0 0 1'")
    return point


def place_by_directions(
    vertices: FloatArray, proximal: FloatArray, anterior: FloatArray | None, height: float
) -> Placement:
    """Place {S} below the distal end, z proximal and x anterior.

    Args:
        vertices: Vertices of the interior in the scan's frame, shape (v, 3) [m].
        proximal: Unit vector from the distal end to the opening in the scan's frame, shape (3,)
            [-].
        anterior: Unit vector towards anterior in the scan's frame, shape (3,) [-]; None for +x of
            the scan, or +y if +x is along the socket.
        height: Height of the distal end's lowest point above the origin of {S} [m].

    Raises:
        ConfigurationError: If anterior is within about 6 degrees of the proximal or distal
            direction.
    """
    how = "given as"
    if anterior is None:
        anterior, how = np.eye(3)[0 if abs(proximal[0]) < 0.7 else 1], "assumed"
    if np.linalg.norm(np.cross(proximal, anterior)) < _MIN_SINE * np.linalg.norm(proximal):
        raise ConfigurationError(
            "--anterior is along the proximal direction", "give the direction of the shin's front"
        )
    axis = axis_between(vertices, proximal, anterior)
    return Placement(
        Pose(axis.frame, np.array([0.0, 0.0, height]) - axis.frame @ axis.end),
        f"z proximal, x {how} anterior, the distal end's lowest point {1e3 * height:g} mm above the"
        " load cell: nominal",
    )


def place_by_points(points: FloatArray) -> Placement:
    """Place {S} by three points in the scan, (3, 3) [m]: its origin, one on +x, one towards +y.

    Each row is a point in the scan's frame.

    Raises:
        RegistrationError: If two points are at one place or all are on one line.
    """
    along, aside = points[1] - points[0], points[2] - points[0]
    normal = np.cross(along, aside)
    size = float(np.linalg.norm(along) * np.linalg.norm(aside))
    if size == 0.0 or np.linalg.norm(normal) < _MIN_SINE * size:
        raise RegistrationError(
            "the three --points are on one line or at one place",
            "pick the origin of {S}, a point on its +x axis, and a third one towards +y",
        )
    return Placement(own_frame(points).inverse(), "three picked points")


class _PickedLandmark(Document):
    scan: ScanPoint
    load_cell: Point


class _PickedLandmarks(Document):
    landmarks: dict[str, _PickedLandmark]


def place_by_landmarks(path: Path, scale: float) -> Placement:
    """Place {S} by landmarks with coordinates in {S} and in the scan.

    Args:
        path: YAML file whose key `landmarks` holds for each name the coordinates `scan`, in the
            scan's frame and unit, and `load_cell`, in {S} [m].
        scale: Length of the scan's unit [m].

    Raises:
        RegistrationError: If fewer than three landmarks are given, they are too close to each other
            or on one line, or their RMS residual exceeds `MAX_RESIDUAL`.
    """
    landmarks = read_document(path, _PickedLandmarks).landmarks
    scan, load_cell = (
        np.array([getattr(each, frame) for each in landmarks.values()]).reshape(-1, 3)
        for frame in ("scan", "load_cell")
    )
    with naming(path):
        fit = register_landmarks(scan * scale, load_cell, tuple(landmarks))
    if fit.rms > MAX_RESIDUAL:
        worst = fit.names[int(fit.residual.argmax())]
        raise RegistrationError(
            f"{path}: the landmarks only fit to {1e3 * fit.rms:.1f} mm",
            f"check the scan's unit and the coordinates, first of '{worst}'",
        )
    return Placement(fit.pose, f"{len(landmarks)} landmarks, rms {1e3 * fit.rms:.2f} mm")


_NOTED_SHIFT = 1e-4  # [m]; distance of a tile from its cluster's place that is noted
_ANTERIOR = np.array([1.0, 0.0, 0.0])  # in {S}


@dataclass(frozen=True)
class SocketDesign:
    """A scan with the tiles laid out on it.

    Attributes:
        name: Name of the scan's file.
        scan: The body of the scan, in its own axes [m].
        mesh: Its interior in {S} [m], with normals into the cavity.
        placement: Pose of the scan in {S}.
        tiling: The tiles as found, in {S}, and how well they cover the interior; its indices are
            not those of `geometry`.
        geometry: The socket in {S}, its tiles sorted by the names of their places.
        settings: Settings of the tiling.
        notes: Remarks for the user, one per finding.
    """

    name: str
    scan: Scan
    mesh: trimesh.Trimesh
    placement: Placement
    tiling: Tiling
    geometry: SocketGeometry
    settings: TilingSettings
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        return (
            f"SocketDesign({self.name}: {len(self.geometry)} tiles on"
            f" {100.0 * self.tiling.cover:.0f} % of"
            f" {1e4 * self.tiling.interior_area:.0f} cm^2)"
        )

    def facts(self) -> list[tuple[str, str]]:
        """Key figures for the user: names and values in words, with their units."""
        scan, tiling, edge = self.scan, self.tiling, 1e3 * self.settings.edge
        tiles, area = len(self.geometry), 1e4 * tiling.interior_area
        covered = 1e4 * float(tiling.footprint_areas.sum())
        inside = f"more than {edge / 2:g} mm from its rim"
        cover_inside = (
            f"none of it is {inside}"
            if math.isnan(tiling.cover_inside)
            else f"{100 * tiling.cover_inside:.0f} % of the area {inside}"
        )
        facts = {
            "scan": f"body {scan.body}, {len(scan.mesh.faces)} faces, in {scan.unit}"
            f" ({scan.unit_source})",
            "{S}": self.placement.source,
            "tiles": f"{tiles} of {edge:g} x {edge:g} mm",
            "covered": f"{covered:.0f} of {area:.0f} cm^2 of the interior"
            f" ({100 * tiling.cover:.0f} %); {cover_inside}",
            "upper bound": f"{tiling.upper_bound:.1f} tiles by area:"
            f" {100 * tiles / tiling.upper_bound:.0f} % reached",
            "largest gap": f"{1e3 * tiling.largest_gap:.0f} mm from the nearest tile",
            "flatness": f"the surface is within {1e3 * tiling.flatness.max():.1f} mm of every"
            f" tile's plane (median {1e3 * np.median(tiling.flatness):.1f},"
            f" limit {1e3 * self.settings.flatness:g})",
            "neighbours": f"{len(self.geometry.neighbours)} pairs",
        }
        laid = {cluster.name: str(cluster) for cluster in tiling.clusters}
        for name, tile in self.geometry.clusters.items():
            anchor = ", ".join(f"{1e3 * value:z.1f}" for value in self.geometry.anchors[tile])
            facts[f"cluster {name}"] = laid.get(name, f"placed at ({anchor}) mm of {{S}}")
        if not self.geometry.clusters:
            facts["clusters"] = "none"
        return [*facts.items()]


def design_socket(
    name: str,
    scan: Scan,
    place: Callable[[FloatArray, FloatArray, float], Placement],
    proximal: FloatArray | None,
    clusters: list[ClusterPlace] | None,
    bodies: SocketGeometry,
    settings: TilingSettings,
    progress: Callable[[int, int], None],
) -> SocketDesign:
    """Lay out tiles on the interior of a scan, for a socket with the marker bodies of `bodies`.

    Args:
        name: Name of the scan's file, for errors and the geometry's source.
        scan: The scan.
        place: Returns the placement of {S}, given the interior's vertices, shape (v, 3) [m], the
            proximal unit vector, shape (3,) [-], both in the scan's axes, and the length of the
            scan's unit [m].
        proximal: Direction from the distal end to the opening in the scan's axes, of any length,
            shape (3,) [-]; None to infer it.
        clusters: Places of glued clusters, in {S} or in the scan; None for the usual places.
        bodies: The socket whose marker bodies, limb and registration are kept.
        settings: Settings of the tiling.
        progress: Called after each round of the tiling with the rounds done and their number.
    """
    interior = find_interior(scan.mesh, proximal)
    refuse_implausible(name, interior.length, interior.girth, scan.unit)
    vertices = np.asarray(interior.mesh.vertices)
    placement = place(vertices, interior.proximal, METRES[scan.unit])
    pose = placement.scan_in_load_cell
    frame = ScanFrame(METRES[scan.unit], pose)
    mesh = trimesh.Trimesh(pose.apply(vertices), interior.mesh.faces, process=False)
    upwards = pose.rotation @ interior.proximal
    known = [place.in_load_cell(frame) for place in clusters or ()]
    tiling = tile_interior(mesh, upwards, _ANTERIOR, settings, progress, known)
    axis = axis_between(np.asarray(mesh.vertices), upwards)
    notes = [
        f"no tile fits at cluster {laid.name}: the nearest one is {1e3 * laid.moved:.1f} mm off"
        for laid in tiling.clusters
        if laid.moved > _NOTED_SHIFT
    ]
    if bodies.regions:
        notes.append(f"the regions {', '.join(bodies.regions)} are not kept: the tiles are new")
    nominal: dict[str, int] = {}
    if clusters is None:
        nominal = nominal_places(tiling.squares, axis)
        notes.append("the clusters are at their usual places: check them, or give --clusters")
    source = f"{name} [{scan.unit}], {placement.source}"
    geometry = _tiled_socket(tiling, axis, nominal, bodies, source, frame)
    notes = [*scan.notes, *interior.notes, *notes]
    return SocketDesign(name, scan, mesh, placement, tiling, geometry, settings, tuple(notes))


TILE_NAME = re.compile(r"h\d{3}_a\d{3}[a-z]?")


def tile_names(anchors: FloatArray, axis: SocketAxis) -> tuple[str, ...]:
    """Names such as `h092_a045`: 92 mm above the distal end, 45 degrees from anterior.

    The angle is about the axis, counterclockwise seen from above. A letter distinguishes tiles with
    the same rounded height and angle.

    Args:
        anchors: Centres of the n tiles in {S}, shape (n, 3) [m].
        axis: Axis of the socket in {S}.

    Returns:
        The n names in the order of the tiles.
    """
    heights = np.maximum(np.round(1e3 * axis.heights(anchors)), 0).astype(int)
    angles = np.degrees(axis.angles(anchors))
    names: list[str] = []
    for height, angle in zip(heights, np.round(angles).astype(int) % 360, strict=True):
        name = f"h{height:03d}_a{angle:03d}"
        twins = sum(other.startswith(name) for other in names)
        names.append(name + (chr(ord("a") + twins) if twins else ""))
    return tuple(names)


def with_proposed_clusters(
    design: SocketDesign, number: int, keep_out: Sequence[str]
) -> SocketDesign:
    """The design with clusters at the most informative tiles, and a note on their benefit.

    Args:
        design: The design, whose own clusters stay.
        number: Number of clusters in all.
        keep_out: Names of regions and tiles that get no proposed cluster.
    """
    geometry = design.geometry
    tiles = {tile: np.array([number]) for number, tile in enumerate(geometry.names)}
    tiles |= {region.name: region.tiles for region in all_regions(geometry)}
    allowed = np.ones(len(geometry), dtype=bool)
    for name in keep_out:
        allowed[tiles_named(name, tiles)] = False
    found = place_clusters(geometry, number, list(geometry.clusters.values()), allowed)
    names, clusters = list(geometry.names), dict(geometry.clusters)
    free = (name for n in count(1) if (name := f"cluster_{n}") not in clusters)
    for tile, name in zip(found.tiles[len(clusters) :].tolist(), free, strict=False):
        clusters[name], names[tile] = tile, name
    errors = ", ".join(f"{n}: {error:.2f}" for n, error in found.errors.items())
    low, high = found.at_random
    note = (
        "the clusters are proposed. Expected error of the force map on tiles without one, over"
        f" their rms, by the number of clusters: {errors}; with {number} at random {low:.2f} to"
        f" {high:.2f}: the number matters more than the places"
    )
    geometry = dataclasses.replace(geometry, names=tuple(names), clusters=clusters)
    return dataclasses.replace(design, geometry=geometry, notes=(*design.notes, note))


# Usual places of three of the testbed's clusters: angle from anterior [deg], relative height [-].
_USUAL = {"brim_lateral": (90.0, 1.0), "mid_anterior": (0.0, 0.6), "posterior_distal": (180.0, 0.2)}
_MAX_TURN = 45.0  # [deg]; about the axis, of a tile from its usual place
_MAX_RAISE = 1.5  # [edges]; along the axis, of a tile from its usual place
_GIVE_PLACES = "give the places of yours with --clusters FILE"


def nominal_places(squares: Squares, axis: SocketAxis) -> dict[str, int]:
    """Tiles at the usual places of the testbed's four clusters, for a socket without a file.

    Args:
        squares: The tiles.
        axis: Axis of the socket in the frame of the tiles.

    Returns:
        Index of the square under each cluster, keyed by the cluster's name.

    Raises:
        ConfigurationError: If the socket has too few tiles or lacks one of these places.
    """
    if len(squares) <= len(_USUAL):
        fact = f"{len(squares)} tiles do not hold the usual {len(_USUAL) + 1} clusters"
        raise ConfigurationError(fact, _GIVE_PLACES)
    height = axis.heights(squares.anchors)
    highest = max(float(height.max()), 1e-9)
    places: dict[str, int] = {}
    found = []
    for name, (angle, level) in _USUAL.items():
        off = np.cos(axis.angles(squares.anchors) - np.radians(angle))
        raised = np.abs(height / highest - level)
        places[name] = tile = _best(3.0 * off - 4.0 * raised, places)
        turned = float(np.degrees(np.arccos(off[tile])))
        if turned > _MAX_TURN or raised[tile] > _MAX_RAISE * squares.edge / highest:
            where = f"{name} {1e3 * height[tile]:.0f} mm above the distal end"
            found.append(f"{where} and {turned:.0f} deg from its side")
    from_end = np.linalg.norm(squares.anchors - axis.end, axis=1)
    places["distal"] = tile = _best(-from_end, places)
    if from_end[tile] > squares.edge:
        found.append(f"distal {1e3 * height[tile]:.0f} mm above the distal end")
    if found:
        fact = f"the usual places of clusters are not on this socket ({'; '.join(found)})"
        raise ConfigurationError(fact, _GIVE_PLACES)
    return places


def _best(score: FloatArray, taken: dict[str, int]) -> int:
    """The free tile with the highest score."""
    return next(int(tile) for tile in np.argsort(-score) if tile not in taken.values())


def _tiled_socket(
    tiling: Tiling,
    axis: SocketAxis,
    nominal: dict[str, int],
    bodies: SocketGeometry,
    source: str,
    scan: ScanFrame,
) -> SocketGeometry:
    """The geometry of a tiled socket in {S}, its tiles sorted by the names of their places.

    A tile under a cluster then gets the cluster's name.
    """
    squares = tiling.squares
    clusters = {laid.name: tile for tile, laid in enumerate(tiling.clusters)} | nominal
    turned = {laid.name: laid.turned for laid in tiling.clusters if laid.turned}
    rotations = squares.rotations.copy()
    for name, angle in turned.items():  # a tile's x stays proximal under a turned cluster
        rotations[clusters[name]] = rotations[clusters[name]] @ about_z(-angle)
    names = tile_names(squares.anchors, axis)
    order = np.array(sorted(range(len(names)), key=names.__getitem__))
    place_of = np.argsort(order)
    pairs = np.sort(place_of[tiling.neighbours], axis=1)
    name_of_cluster_tile = {tile: cluster for cluster, tile in clusters.items()}
    return dataclasses.replace(
        bodies,
        names=tuple(name_of_cluster_tile.get(int(tile), names[tile]) for tile in order),
        anchors=squares.anchors[order],
        rotations=rotations[order],
        areas=np.full(len(names), squares.edge**2),
        neighbours=pairs[np.lexsort(pairs.T[::-1])],
        clusters={cluster: int(place_of[tile]) for cluster, tile in clusters.items()},
        source=source,
        regions={},
        turned=turned,
        scan=scan,
        tile_share=round(tiling.cover, 3),
    )
