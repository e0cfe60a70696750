"""The socket: points of interest, their frames and neighbours, clusters and marker bodies."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial import cKDTree

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import Section, atomic_output, closest, read_document
from socket_testbed.geometry.marker_bodies import FEWEST_MARKERS, MOST_MARKERS, body_fault
from socket_testbed.geometry.pose import (
    Pose,
    about_z,
    plain,
    pose_document,
    read_pose,
    read_rotation,
)

HEIGHTS = ("proximal", "middle", "distal")
SECTORS = ("anterior", "posterior", "medial", "lateral", "left", "right")
SOCKET = "socket"  # the region of all tiles

_STANDARD_REGIONS = {
    *(SOCKET, *SECTORS, *HEIGHTS),
    *(f"{sector} {height}" for sector in SECTORS for height in HEIGHTS),
}
_SAME_PLACE = 1e-4  # [m]
_LARGEST_SOCKET = 2.0  # [m]; what is farther from the load cell is in another unit
_FARTHEST_SCAN = 100.0  # [m]; its origin may be anywhere in a scanner's frame
_LARGEST_BODY = 1.0  # [m]; likewise for a marker in its body
_LARGEST_TILE = 0.05  # [m^2]


@dataclass(frozen=True)
class ScanFrame:
    """Where the scan is that the tiles were made from.

    Attributes:
        unit: Length of the scan's unit [m].
        in_load_cell: Pose of the scan's frame (in metres) in {S}.
    """

    unit: float
    in_load_cell: Pose

    def points(self, picked: FloatArray) -> FloatArray:
        """Points in {S} [m] of points in the scan's coordinates and unit, (3,) or (N, 3)."""
        return self.in_load_cell.apply(self.unit * picked)


@dataclass(frozen=True)
class SocketGeometry:
    """Geometry of a socket in the frame of the load cell, {S}.

    Attributes:
        names: Names of the n points of interest (tiles).
        anchors: Centres of the tiles a_i, shape (n, 3) [m].
        rotations: Frames of the tiles, columns x (towards the proximal end), y, z (inward
            normal); R_i maps {L_i} to {S}, shape (n, 3, 3) [-].
        areas: Areas of the tiles, shape (n,) [m^2].
        neighbours: Pairs of neighbouring tiles, shape (e, 2).
        clusters: Index of the tile that each cluster covers, by the cluster's name.
        socket_markers: Markers of the socket in its body frame, 3 to 8, shape (k, 3) [m].
        pylon_markers: Markers of the pylon in its body frame, likewise.
        socket_body: Pose of the socket's marker body in {S}.
        limb: Pose of the limb in the pylon's marker body; its origin is the lumped mass.
        source: What the tiles were made from.
        registration: What the bodies were registered with; empty if they are only nominal.
        regions: Indices of the tiles of the user's own regions, ascending, by their names.
        turned: Angle of a cluster's x axis from that of its tile about the inward normal, by the
            cluster's name [rad]; a cluster that is not named is not turned.
        scan: Where the scan is; None if it is not known.
    """

    names: tuple[str, ...]
    anchors: FloatArray
    rotations: FloatArray
    areas: FloatArray
    neighbours: IntArray
    clusters: dict[str, int]
    socket_markers: FloatArray
    pylon_markers: FloatArray
    socket_body: Pose
    limb: Pose
    source: str = ""
    registration: str = ""
    regions: dict[str, tuple[int, ...]] = field(default_factory=dict)
    turned: dict[str, float] = field(default_factory=dict)
    scan: ScanFrame | None = None

    def __len__(self) -> int:
        return len(self.names)

    def same_tiles(self, other: SocketGeometry) -> bool:
        """Whether another geometry has the same tiles at the same places."""
        return (
            self.names == other.names
            and np.allclose(self.anchors, other.anchors, rtol=0.0, atol=_SAME_PLACE)
            and np.allclose(self.rotations, other.rotations, rtol=0.0, atol=1e-3)
        )

    def limb_pose(self, socket_in_world: Pose, pylon_in_world: Pose) -> Pose:
        """Pose of the limb in {S} from the poses of the two marker bodies; its origin is q.

        Args:
            socket_in_world: Poses of the socket's marker body, N of them.
            pylon_in_world: Poses of the pylon's marker body, N of them.

        Returns:
            N poses; NaN where a pose is NaN.
        """
        return self.socket_body @ socket_in_world.inverse() @ pylon_in_world @ self.limb

    def cluster_force(self, cluster: str, stress: FloatArray) -> FloatArray:
        """Force on a cluster in its tile's frame {L}, ``A Rz(turned) [tau_x, tau_y, -sigma]``.

        Args:
            cluster: Name of the cluster.
            stress: Normal stress (positive in compression), shear x, shear y along the cluster's
                own axes, shape (..., 3) [Pa].

        Returns:
            Forces, shape (..., 3) [N].
        """
        x, y = _turn(stress[..., 1], stress[..., 2], self.turned.get(cluster, 0.0))
        return np.stack([x, y, -stress[..., 0]], axis=-1) * self.areas[self.clusters[cluster]]

    def cluster_stress(self, cluster: str, force: FloatArray) -> FloatArray:
        """Stresses of a cluster along its own axes from the force on it: undoes `cluster_force`.

        Args:
            cluster: Name of the cluster.
            force: Forces in its tile's frame {L}, shape (..., 3) [N].

        Returns:
            Normal stress (positive in compression), shear x, shear y, shape (..., 3) [Pa].
        """
        x, y = _turn(force[..., 0], force[..., 1], -self.turned.get(cluster, 0.0))
        return np.stack([-force[..., 2], x, y], axis=-1) / self.areas[self.clusters[cluster]]

    def square_frames(self) -> FloatArray:
        """Frames whose x and y lie along the tiles' edges, as those of turned clusters are turned.

        Returns:
            Columns x, y, z, shape (n, 3, 3) [-].
        """
        frames = self.rotations.copy()
        for cluster, angle in self.turned.items():
            frames[self.clusters[cluster]] @= about_z(angle)
        return frames

    def to_document(self) -> dict[str, Any]:
        """The content of `socket.yaml`."""
        document: dict[str, Any] = {"source": self.source} if self.source else {}
        if self.scan:
            pose = pose_document(self.scan.in_load_cell)
            document["scan"] = {"unit": self.scan.unit, "in_load_cell": pose}
        registration = {"registration": self.registration} if self.registration else {}
        regions = {name: [self.names[i] for i in tiles] for name, tiles in self.regions.items()}
        return document | {
            "tiles": {
                name: {
                    "anchor": plain(self.anchors[i]),
                    "frame": plain(self.rotations[i]),
                    "area": float(self.areas[i]),
                }
                for i, name in enumerate(self.names)
            },
            "neighbours": [[self.names[a], self.names[b]] for a, b in self.neighbours],
            "clusters": {name: self._cluster_document(name) for name in self.clusters},
            **({"regions": regions} if regions else {}),
            "bodies": registration
            | {
                "socket": {
                    "markers": plain(self.socket_markers),
                    "in_load_cell": pose_document(self.socket_body),
                },
                "pylon": {
                    "markers": plain(self.pylon_markers),
                    "limb_in_body": pose_document(self.limb),
                },
            },
        }

    def _cluster_document(self, cluster: str) -> str | dict[str, Any]:
        tile, turned = self.names[self.clusters[cluster]], self.turned.get(cluster, 0.0)
        return {"tile": tile, "turned": round(float(np.degrees(turned)), 9)} if turned else tile


def _turn(x: FloatArray, y: FloatArray, angle: float) -> tuple[FloatArray, FloatArray]:
    """Components of vectors after they are turned about z by an angle [rad]."""
    if not angle:  # what is missing of one is not missing of both
        return x, y
    return np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y


_HEADER = """\
# Geometry of the socket in the frame of the load cell, {S}. Lengths in m, areas in m^2.
# frame: rows of R = [x y z], which maps the tile's frame to {S}; z is the inward normal of the
# surface, x the tangent towards the proximal end, y = z x x.
# source: what the tiles were made from; scan: its unit [m] and its frame's pose in {S}.
# clusters: the tile that each covers; turned: from the tile's x to the cluster's, about z [deg].
# regions: your own, each a list of tiles; they may overlap.
# bodies: 3 to 8 markers each in their bodies' frames; in_load_cell: the socket body's pose in {S};
# limb_in_body: the limb's pose in the pylon's body, its origin being the lumped mass;
# registration: what they were registered with; without it they are nominal.
"""


def write_socket(geometry: SocketGeometry, path: Path) -> None:
    """Write `socket.yaml` atomically.

    Raises:
        ConfigurationError: If it could not be read again, or the file cannot be written.
    """
    document = geometry.to_document()
    socket_from_section(Section(document, str(path)))
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)
    with atomic_output(path) as output:
        output.write_text(_HEADER + text, encoding="utf-8")


def read_socket(path: Path) -> SocketGeometry:
    """Read `socket.yaml`.

    Raises:
        ConfigurationError: If the file is missing or anything in it is not as it must be.
    """
    return socket_from_section(read_document(path))


def socket_from_section(document: Section) -> SocketGeometry:
    """Build the geometry from the content of `socket.yaml`, with every check."""
    document.expect(("source", "scan", "tiles", "neighbours", "clusters", "regions", "bodies"))
    tiles = dict(document.sections("tiles"))
    if not tiles:
        raise ConfigurationError(f"{document.where}: tiles is empty", "give at least one tile")
    for tile in tiles.values():
        tile.expect(("anchor", "frame", "area"))
    index = {name: i for i, name in enumerate(tiles)}
    bodies = document.section("bodies").expect(("registration", "socket", "pylon"))
    socket = bodies.section("socket").expect(("markers", "in_load_cell"))
    pylon = bodies.section("pylon").expect(("markers", "limb_in_body"))
    clusters, turned = _clusters(document.section("clusters"), index)
    return SocketGeometry(
        names=tuple(tiles),
        anchors=_anchors(tiles),
        rotations=np.array([read_rotation(tile, "frame") for tile in tiles.values()]),
        areas=np.array([tile.number("area", 1e-8, _LARGEST_TILE) for tile in tiles.values()]),
        neighbours=_neighbours(document, index),
        clusters=clusters,
        socket_markers=_markers(socket),
        pylon_markers=_markers(pylon),
        socket_body=read_pose(socket.section("in_load_cell"), _LARGEST_SOCKET),
        limb=read_pose(pylon.section("limb_in_body"), _LARGEST_SOCKET),
        source=document.text("source") if "source" in document.names() else "",
        registration=bodies.text("registration") if "registration" in bodies.names() else "",
        regions=_regions(document, index),
        turned=turned,
        scan=_scan(document.section("scan")) if "scan" in document.names() else None,
    )


def _scan(section: Section) -> ScanFrame:
    section.expect(("unit", "in_load_cell"))
    unit = section.number("unit", 1e-6, 1.0)
    return ScanFrame(unit, read_pose(section.section("in_load_cell"), _FARTHEST_SCAN))


def _anchors(tiles: dict[str, Section]) -> FloatArray:
    anchors = np.array([t.array("anchor", (3,), limit=_LARGEST_SOCKET) for t in tiles.values()])
    apart, nearest = cKDTree(anchors).query(anchors, k=2)
    if apart[:, 1].min() < _SAME_PLACE:
        a = int(apart[:, 1].argmin())
        b = next(int(i) for i in nearest[a] if i != a)
        names = list(tiles)
        raise ConfigurationError(
            f"{tiles[names[a]].where}: is at the same place as {names[b]}", "remove one of them"
        )
    return anchors


def _neighbours(document: Section, index: dict[str, int]) -> IntArray:
    where = f"{document.where}: neighbours"
    pairs = document.take("neighbours")
    if not isinstance(pairs, list):
        raise ConfigurationError(f"{where} is not a list", "give pairs of tile names")
    found = set()
    for pair in pairs:
        names = [str(name) for name in pair] if isinstance(pair, list) else []
        if len(names) != 2 or names[0] == names[1]:
            raise ConfigurationError(f"{where}: {pair} is not a pair", "give two different tiles")
        for name in names:
            if name not in index:
                raise ConfigurationError(f"{where}: no tile '{name}'", closest(name, index))
        a, b = sorted(index[name] for name in names)
        found.add((a, b))
    return np.array(sorted(found), dtype=np.int64).reshape(-1, 2)


def _clusters(section: Section, index: dict[str, int]) -> tuple[dict[str, int], dict[str, float]]:
    """The tile of each cluster, and the angles of those that are turned [rad]."""
    clusters: dict[str, int] = {}
    turned: dict[str, float] = {}
    for name in section.names():
        if isinstance(section.take(name), dict):
            cluster = section.section(name).expect(("tile", "turned"))
            tile, angle = cluster.text("tile"), cluster.number("turned", -360.0, 360.0)
            turned |= {name: float(np.radians(angle))} if angle else {}
        else:
            tile = section.text(name)
        if tile not in index:
            raise ConfigurationError(
                f"{section.where}: {name} is on '{tile}', which is not a tile", closest(tile, index)
            )
        if index[tile] in clusters.values():
            raise ConfigurationError(
                f"{section.where}: two clusters are on '{tile}'", "give each its own tile"
            )
        clusters[name] = index[tile]
    return clusters, turned


def _regions(document: Section, index: dict[str, int]) -> dict[str, tuple[int, ...]]:
    if "regions" not in document.names():
        return {}
    section = document.section("regions")
    return {name: read_region(section, name, index) for name in section.names()}


def read_region(section: Section, name: str, index: dict[str, int]) -> tuple[int, ...]:
    """Indices of the tiles of a region, ascending.

    Args:
        section: Lists of tile names, by the names of the regions.
        name: Name of the region.
        index: Indices of the socket's tiles by their names.

    Raises:
        ConfigurationError: If it has no tile, an unknown one, one twice, or a reserved name.
    """
    where, tiles = f"{section.where}: {name}", section.take(name)
    if name in _STANDARD_REGIONS:
        raise ConfigurationError(f"{where} is the name of a standard region", "choose another name")
    if not isinstance(tiles, list | tuple) or not tiles:
        raise ConfigurationError(f"{where} has no tiles", f"write '{name}: [TILE, TILE]'")
    for tile in map(str, tiles):
        if tile not in index:
            raise ConfigurationError(f"{where}: no tile '{tile}'", closest(tile, index))
    found = sorted({index[str(tile)] for tile in tiles})
    if len(found) < len(tiles):
        raise ConfigurationError(f"{where} holds a tile twice", "name each tile once")
    return tuple(found)


def _markers(section: Section) -> FloatArray:
    given = section.take("markers")
    count = len(given) if isinstance(given, list) else FEWEST_MARKERS
    if count > MOST_MARKERS:
        raise ConfigurationError(
            f"{section.where}: markers has {count} rows",
            f"give {FEWEST_MARKERS} to {MOST_MARKERS} markers",
        )
    markers = section.array("markers", (max(count, FEWEST_MARKERS), 3), limit=_LARGEST_BODY)
    fault = body_fault(markers)
    if fault:
        raise ConfigurationError(f"{section.where}: {fault[0]}", fault[1])
    return markers
