"""The socket: points of interest, their frames and neighbours, clusters and marker bodies."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from scipy.spatial import cKDTree

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.documents import Document, FieldError, Text, convert, dump_yaml, load_yaml
from socket_testbed.errors import ConfigurationError, closest
from socket_testbed.files import write_text
from socket_testbed.geometry.marker_bodies import MAX_MARKERS, MIN_MARKERS, body_fault
from socket_testbed.geometry.pose import (
    Point,
    Pose,
    PoseDocument,
    RotationRows,
    about_z,
    check_rotation,
    pose_document,
    rounded,
)
from socket_testbed.settings.options import Side

HEIGHTS = ("proximal", "middle", "distal")
# Quarter turns about the axis from anterior towards left, by leg.
SECTOR_TURNS: dict[Side | None, dict[str, int]] = {
    "right": {"anterior": 0, "posterior": 2, "medial": 1, "lateral": 3},
    "left": {"anterior": 0, "posterior": 2, "medial": 3, "lateral": 1},
    None: {"anterior": 0, "posterior": 2, "left": 1, "right": 3},
}
SECTORS = tuple(dict.fromkeys(chain(*SECTOR_TURNS.values())))
SECTOR_PARTS = [f"{sector} {height}" for sector in SECTORS for height in HEIGHTS]
SOCKET = "socket"  # the region of all tiles
UNMEASURED = "unmeasured wall"  # the region of the tiles without a cluster

_STANDARD_REGIONS = {SOCKET, UNMEASURED, *SECTORS, *HEIGHTS, *SECTOR_PARTS}
_SAME_PLACE = 1e-4  # [m]
_MAX_GAP_RATIO, _MAX_GAP = 4.0, 0.06  # over the median gap [-], and [m]; beyond both: off the wall
AREA_LIMITS = (1e-8, 0.05)  # [m^2]; of a tile
_FromScan = Annotated[float, Meta(ge=-100.0, le=100.0)]  # [m]; the scanner's origin is arbitrary
_InBody = Annotated[float, Meta(ge=-1.0, le=1.0)]  # [m]; larger values have another unit


@dataclass(frozen=True)
class ScanFrame:
    """Unit and pose of the scan from which the tiles were made.

    Attributes:
        unit: Length of the scan's unit [m], such as 0.001 for mm.
        in_load_cell: Pose of the scan's frame in {S}, for coordinates of the scan in metres.
    """

    unit: float
    in_load_cell: Pose

    def points(self, picked: FloatArray) -> FloatArray:
        """Points in {S}, shape (3,) or (N, 3) [m], from the scan's coordinates in its unit."""
        return self.in_load_cell.apply(self.unit * picked)


@dataclass(frozen=True)
class SocketGeometry:
    """Geometry of a socket in the frame of the load cell, {S}.

    Attributes:
        names: Names of the n points of interest (tiles).
        anchors: Centres a_i of the tiles in {S}, shape (n, 3) [m].
        rotations: Frames of the tiles, shape (n, 3, 3) [-]: R_i maps {L_i} to {S}; its columns are
            x (tangent towards the proximal end), y = z x x, and z (inward normal).
        areas: Areas of the tiles, shape (n,) [m^2].
        neighbours: Indices of neighbouring tiles, a pair per row, shape (e, 2), the smaller first.
        clusters: Index of the tile under each cluster, keyed by the cluster's name.
        socket_markers: The 3 to 8 markers of the socket in the frame of its marker body, shape
            (k, 3) [m].
        pylon_markers: The 3 to 8 markers of the pylon in the frame of its marker body, shape
            (k, 3) [m].
        socket_body: Pose of the socket's marker body in {S}.
        limb: Pose of the limb in the pylon's marker body; its origin is the lumped mass.
        source: Where the tiles come from, in words; empty if unknown.
        registration: What the marker bodies were registered with, in words, such as the take and
            the residuals of its landmarks; empty if they are nominal.
        regions: Indices of the tiles in each of the user's own regions, ascending, keyed by the
            region's name.
        turned: Angle from the tile's x axis to the cluster's x axis about the inward normal
            [rad], keyed by the cluster's name; zero for a cluster that is not a key.
        scan: Unit and pose of the scan from which the tiles were made; None if unknown.
        tile_share: Share of the inner wall's area that the tiles cover, in (0, 1] [-]; None if
            unknown.
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
    tile_share: float | None = None

    def __len__(self) -> int:
        return len(self.names)

    @property
    def bodies(self) -> str:
        """Origin of the marker bodies' registration, or what follows without one."""
        return self.registration or (
            "the marker bodies are nominal, and every limb position depends on them: register them"
        )

    @property
    def markers(self) -> dict[str, FloatArray]:
        """Markers in their body's frame, shape (k, 3) each [m], by body: `socket`, then `pylon`."""
        return {"socket": self.socket_markers, "pylon": self.pylon_markers}

    def same_tiles(self, other: SocketGeometry) -> bool:
        """Whether another geometry has the same tiles in the same places.

        Anchors must be within 0.1 mm per coordinate, frames within 1e-3 per entry. Names must be
        equal, except for tiles that are called like a cluster, as `tile` calls them.
        """
        clusters = self.clusters.keys() | other.clusters.keys()
        return (
            len(self) == len(other)
            and all(
                own == name or own in clusters or name in clusters
                for own, name in zip(self.names, other.names, strict=True)
            )
            and np.allclose(self.anchors, other.anchors, rtol=0.0, atol=_SAME_PLACE)
            and np.allclose(self.rotations, other.rotations, rtol=0.0, atol=1e-3)
        )

    def require(self, clusters: Iterable[str], of: str) -> None:
        """Refuse a socket that lacks one of the clusters.

        Args:
            clusters: Names of the clusters.
            of: What these clusters belong to, for the error, such as `the samples`.

        Raises:
            ConfigurationError: If a cluster is on no tile.
        """
        for name in clusters:
            if name not in self.clusters:
                raise ConfigurationError(
                    f"the cluster '{name}' of {of} is on no tile of the socket (which has"
                    f" {', '.join(self.clusters) or 'none'})",
                    "give the socket.yaml of these clusters, or correct the name",
                )

    def limb_pose(self, socket_in_world: Pose, pylon_in_world: Pose) -> Pose:
        """N poses of the limb in {S} from those of both marker bodies; NaN if either is NaN.

        The origin of the limb is q.

        Args:
            socket_in_world: N poses of the socket's marker body in `world`, or one.
            pylon_in_world: Poses of the pylon's marker body in `world`, as many.
        """
        return self.socket_body @ socket_in_world.inverse() @ pylon_in_world @ self.limb

    @property
    def cluster_names(self) -> list[str]:
        """Name of the cluster on each of the n tiles; empty without one."""
        clusters = {tile: cluster for cluster, tile in self.clusters.items()}
        return [clusters.get(tile, "") for tile in range(len(self))]

    @property
    def covered(self) -> BoolArray:
        """Tiles with a cluster, shape (n,)."""
        return np.array([bool(name) for name in self.cluster_names])

    def limb_of(self, socket: FloatArray, pylon: FloatArray) -> Pose:
        """`limb_pose` from the vectors of the bodies' poses (see `Pose.vector`).

        Args:
            socket: Poses of the socket's marker body in `world`, positions [m] and quaternions
                (x, y, z, w) [-], shape (7,) or (N, 7).
            pylon: Poses of the pylon's marker body in `world`, positions [m] and quaternions
                (x, y, z, w) [-], shape (7,) or (N, 7).

        Returns:
            The pose of the limb in {S}, or N of them; NaN if either body's pose is NaN.
        """
        return self.limb_pose(Pose.from_vector(socket), Pose.from_vector(pylon))

    def cluster_force(self, cluster: str, stress: FloatArray) -> FloatArray:
        """Force on a cluster in its tile's frame {L}, ``A Rz(turned) [tau_x, tau_y, -sigma]`` [N].

        Args:
            cluster: Name of the cluster.
            stress: Normal stress (positive in compression), shear x and shear y along the cluster's
                own axes, shape (..., 3) [Pa].

        Returns:
            The force of the limb on the socket, components x, y, z in {L}, shape (..., 3) [N].
        """
        x, y = _turn(stress[..., 1], stress[..., 2], self.turned.get(cluster, 0.0))
        return np.stack([x, y, -stress[..., 0]], axis=-1) * self.areas[self.clusters[cluster]]

    def cluster_stress(self, cluster: str, force: FloatArray) -> FloatArray:
        """Stress of a cluster from the force on it, the inverse of `cluster_force`.

        Args:
            cluster: Name of the cluster.
            force: Force of the limb on the socket in the frame {L} of the cluster's tile, shape
                (..., 3) [N].

        Returns:
            Normal stress (positive in compression), shear x and shear y along the cluster's own
            axes, shape (..., 3) [Pa].
        """
        x, y = _turn(force[..., 0], force[..., 1], -self.turned.get(cluster, 0.0))
        return np.stack([-force[..., 2], x, y], axis=-1) / self.areas[self.clusters[cluster]]

    def square_frames(self) -> FloatArray:
        """Frames in {S} with x and y along the tiles' edges, turned with their clusters.

        Rotation matrices like `rotations`, shape (n, 3, 3) [-], from which they differ by the
        angles in `turned`.
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
        if self.tile_share is not None:
            document["tile_share"] = self.tile_share
        document["tiles"] = {
            name: {"anchor": rounded(anchor), "frame": rounded(frame), "area": float(area)}
            for name, anchor, frame, area in zip(
                self.names, self.anchors, self.rotations, self.areas, strict=True
            )
        }
        document["neighbours"] = [[self.names[a], self.names[b]] for a, b in self.neighbours]
        clusters: dict[str, Any] = {name: self.names[i] for name, i in self.clusters.items()}
        for name, angle in self.turned.items():
            turned = round(float(np.degrees(angle)), 9)
            clusters[name] = {"tile": clusters[name], "turned": turned}
        document["clusters"] = clusters
        if self.regions:
            own = {name: [self.names[i] for i in tiles] for name, tiles in self.regions.items()}
            document["regions"] = own
        socket = {"in_load_cell": pose_document(self.socket_body)}
        pylon = {"limb_in_body": pose_document(self.limb)}
        document["bodies"] = {
            **({"registration": self.registration} if self.registration else {}),
            "socket": {"markers": rounded(self.socket_markers)} | socket,
            "pylon": {"markers": rounded(self.pylon_markers)} | pylon,
        }
        return document


def _turn(x: FloatArray, y: FloatArray, angle: float) -> tuple[FloatArray, FloatArray]:
    """Rotate vector components about z by an angle [rad]."""
    if not angle:  # keeps a NaN in one component out of the other
        return x, y
    return np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y


_HEADER = """\
# Geometry of the socket in the frame of the load cell, {S}. Lengths in m, areas in m^2.
# frame: rows of R = [x y z], which maps the tile's frame to {S}; z is the inward normal of the
# surface, x the tangent towards the proximal end, y = z x x.
# source: origin of the tiles; scan: its unit [m] and the pose of its frame in {S}.
# tile_share: share of the inner wall's area that the tiles cover.
# clusters: the tile under each; turned: from the tile's x to the cluster's, about z [deg].
# regions: your own, each a list of tiles; they may overlap.
# bodies: the markers of each in its own frame; in_load_cell: the socket body's pose in {S};
# limb_in_body: the limb's pose in the pylon's body, its origin being the lumped mass;
# registration: origin of their registration; without it they are nominal.
"""


class _Tile(Document):
    anchor: Point
    frame: RotationRows
    area: Annotated[float, Meta(ge=AREA_LIMITS[0], le=AREA_LIMITS[1], description="the area [m^2]")]

    def __post_init__(self) -> None:
        check_rotation(self.frame, "frame")


class _OnTile(Document):
    tile: Text
    turned: Annotated[float, Meta(ge=-360.0, le=360.0, description="the angle [deg]")]


class _ScanPose(PoseDocument):
    translation: tuple[_FromScan, _FromScan, _FromScan]


class _Scan(Document):
    unit: Annotated[float, Meta(ge=1e-6, le=1.0, description="the scan's unit [m]")]
    in_load_cell: _ScanPose


class _Body(Document):
    markers: Annotated[
        list[tuple[_InBody, _InBody, _InBody]], Meta(min_length=MIN_MARKERS, max_length=MAX_MARKERS)
    ]

    def __post_init__(self) -> None:
        fault = body_fault(np.array(self.markers))
        if fault:
            raise FieldError(f"markers: {fault[0]}", fault[1])


class _SocketBody(_Body):
    in_load_cell: PoseDocument


class _PylonBody(_Body):
    limb_in_body: PoseDocument


class _Bodies(Document):
    socket: _SocketBody
    pylon: _PylonBody
    registration: Text = ""


class _Socket(Document):
    tiles: Annotated[dict[str, _Tile], Meta(min_length=1)]
    neighbours: list[Annotated[list[Text], Meta(min_length=2, max_length=2)]]
    clusters: dict[str, Text | _OnTile]
    bodies: _Bodies
    source: Text = ""
    scan: _Scan | None = None
    tile_share: Annotated[float, Meta(gt=0.0, le=1.0)] | None = None
    regions: dict[str, list[Text]] = msgspec.field(default_factory=dict)


def write_socket(geometry: SocketGeometry, path: Path) -> None:
    """Write `socket.yaml` atomically.

    Args:
        geometry: The socket.
        path: The file, which is replaced if it exists.

    Raises:
        ConfigurationError: If two tiles have the same name, or `read_socket` would refuse the file.
    """
    document = geometry.to_document()
    if twins := [name for name, times in Counter(geometry.names).items() if times > 1]:
        hint = "give the cluster another name"
        raise ConfigurationError(f"{path}: two tiles would be called '{twins[0]}'", hint)
    socket_from_document(document, str(path))
    text = dump_yaml(document, default_flow_style=None, width=100)
    write_text(path, _HEADER + text)


def read_socket(path: Path) -> SocketGeometry:
    """Read `socket.yaml`: tiles in {S} [m], neighbours, clusters, marker bodies and regions."""
    return socket_from_document(load_yaml(path), str(path))


def socket_from_document(data: Any, where: str) -> SocketGeometry:
    """Build and check the geometry from the content of `socket.yaml`.

    Args:
        data: The parsed content; None for an empty file.
        where: Start of every error, such as the path of the file.

    Raises:
        ConfigurationError: If a field is missing, unknown or out of its range, a tile is not
            found, two clusters are on one tile, or a tile is at another one or far off the wall.
    """
    document: _Socket = convert({} if data is None else data, _Socket, where)
    tiles, bodies = document.tiles, document.bodies
    names = tuple(tiles)
    on = {
        name: on if isinstance(on, _OnTile) else _OnTile(tile=on, turned=0.0)
        for name, on in document.clusters.items()
    }
    clusters = {n: _index(at.tile, names, f"{where}: clusters: {n}") for n, at in on.items()}
    if len(set(clusters.values())) < len(clusters):
        shared = Counter(clusters.values()).most_common(1)[0][0]
        raise ConfigurationError(
            f"{where}: clusters: two clusters are on '{names[shared]}'", "give each its own tile"
        )
    anchors = np.array([tile.anchor for tile in tiles.values()])
    _check_anchors(anchors, names, where)
    scan = document.scan
    return SocketGeometry(
        names=names,
        anchors=anchors,
        rotations=np.array([tile.frame for tile in tiles.values()]),
        areas=np.array([tile.area for tile in tiles.values()]),
        neighbours=_neighbours(document.neighbours, names, f"{where}: neighbours"),
        clusters=clusters,
        socket_markers=np.array(bodies.socket.markers),
        pylon_markers=np.array(bodies.pylon.markers),
        socket_body=bodies.socket.in_load_cell.pose(),
        limb=bodies.pylon.limb_in_body.pose(),
        source=str(document.source),
        registration=str(bodies.registration),
        regions=find_regions(document.regions, names, f"{where}: regions"),
        turned={name: float(np.radians(at.turned)) for name, at in on.items() if at.turned},
        scan=ScanFrame(scan.unit, scan.in_load_cell.pose()) if scan else None,
        tile_share=document.tile_share,
    )


def _index(tile: Text, names: tuple[str, ...], where: str) -> int:
    """Index of a tile by its name; errors start with `where`."""
    if str(tile) not in names:
        raise ConfigurationError(f"{where}: no tile '{tile}'", closest(str(tile), names))
    return names.index(str(tile))


def _check_anchors(anchors: FloatArray, names: tuple[str, ...], where: str) -> None:
    apart, nearest = cKDTree(anchors).query(anchors, k=2)
    if apart[:, 1].min() < _SAME_PLACE:
        a, b = sorted(nearest[apart[:, 1].argmin()])
        raise ConfigurationError(
            f"{where}: tiles: {names[a]}: is at the same place as {names[b]}", "remove one of them"
        )
    lone = int(apart[:, 1].argmax())
    if apart[lone, 1] > max(_MAX_GAP_RATIO * np.median(apart[:, 1]), _MAX_GAP):
        raise ConfigurationError(
            f"{where}: tiles: {names[lone]}: is {1e3 * apart[lone, 1]:.0f} mm from all others",
            "correct its anchor, in m",
        )


def _neighbours(pairs: list[list[Text]], names: tuple[str, ...], where: str) -> IntArray:
    found = set()
    for pair in pairs:
        a, b = sorted(_index(name, names, where) for name in pair)
        if a == b:
            raise ConfigurationError(f"{where}: {pair} is not a pair", "give two different tiles")
        found.add((a, b))
    return np.array(sorted(found), dtype=np.int64).reshape(-1, 2)


def find_regions(
    regions: Mapping[str, Sequence[Text]], names: tuple[str, ...], where: str
) -> dict[str, tuple[int, ...]]:
    """Ascending tile indices of the user's own regions, by name.

    Args:
        regions: Names of the tiles in each region, keyed by the region's name.
        names: Names of the socket's n tiles; an index is the place in them.
        where: Start of every error, such as the file and its field.

    Raises:
        ConfigurationError: If a region has the name of a standard one, is empty, or holds an
            unknown tile or a tile twice.
    """
    found = {}
    for name, tiles in regions.items():
        field = f"{where}: {name}"
        if name in _STANDARD_REGIONS:
            raise ConfigurationError(f"{field} is the name of a standard region", "choose another")
        if isinstance(tiles, str) or not tiles:
            raise ConfigurationError(f"{field} has no tiles", f"write '{name}: [TILE, TILE]'")
        found[name] = tuple(sorted({_index(tile, names, field) for tile in tiles}))
        if len(found[name]) < len(tiles):
            raise ConfigurationError(f"{field} holds a tile twice", "name each tile once")
    return found
