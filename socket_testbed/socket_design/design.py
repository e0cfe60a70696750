"""A socket's design: from a scan to its tiles, clusters and frames on the load cell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.axis import axis_through
from socket_testbed.geometry.socket import ScanFrame, SocketGeometry
from socket_testbed.socket_design.clusters import ClusterPlace
from socket_testbed.socket_design.interior import find_interior
from socket_testbed.socket_design.layout import (
    nominal_places,
    refuse_unusual,
    tiled_socket,
)
from socket_testbed.socket_design.placement import Placement
from socket_testbed.socket_design.scan_file import METRES, Scan, refuse_implausible
from socket_testbed.socket_design.tiling import Tiling, TilingSettings, tile_interior

_MOVED = 1e-4  # [m]; a cluster's tile that is farther from where it was asked is worth a note
_ANTERIOR = np.array([1.0, 0.0, 0.0])  # in {S}


@dataclass(frozen=True)
class SocketDesign:
    """A scan with the tiles laid out on it.

    Attributes:
        name: Name of the scan.
        scan: The scan.
        mesh: Its interior in {S} [m].
        placement: Where {S} is in the scan.
        tiling: The tiles.
        geometry: The socket that they make.
        settings: Settings of the tiling.
        notes: What a person should look at.
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
        covered = self.tiling.footprint_areas.sum() / self.tiling.interior_area
        return (
            f"SocketDesign({self.name}: {len(self.geometry)} tiles on {covered:.0%} of"
            f" {1e4 * self.tiling.interior_area:.0f} cm^2)"
        )

    def facts(self) -> list[tuple[str, str]]:
        """What a user wants to know, as rows of a table."""
        scan, tiling, edge = self.scan, self.tiling, 1e3 * self.settings.edge
        tiles, area = len(self.geometry), 1e4 * tiling.interior_area
        covered = 1e4 * float(tiling.footprint_areas.sum())
        return [
            (
                "scan",
                f"body {scan.body}, {len(scan.mesh.faces)} faces, in {scan.unit}"
                f" ({scan.unit_source})",
            ),
            ("{S}", self.placement.source),
            ("tiles", f"{tiles} of {edge:g} x {edge:g} mm"),
            (
                "covered",
                f"{covered:.0f} of {area:.0f} cm^2 of the interior ({100 * covered / area:.0f} %);"
                f" {100 * tiling.cover_inside:.0f} % of what is more than {edge / 2:g} mm from its"
                " rim",
            ),
            (
                "upper bound",
                f"{tiling.upper_bound:.1f} tiles by area:"
                f" {100 * tiles / tiling.upper_bound:.0f} % reached",
            ),
            ("largest gap", f"{1e3 * tiling.largest_gap:.0f} mm from the nearest tile"),
            (
                "flatness",
                f"the surface is within {1e3 * tiling.flatness.max():.1f} mm of every tile's plane"
                f" (median {1e3 * np.median(tiling.flatness):.1f},"
                f" limit {1e3 * self.settings.flatness:g})",
            ),
            ("neighbours", f"{len(self.geometry.neighbours)} pairs"),
            *_clusters(self.geometry, tiling),
        ]


def _clusters(geometry: SocketGeometry, tiling: Tiling) -> list[tuple[str, str]]:
    """A row for each cluster: what was asked and what it got, or where it usually is."""
    laid = {cluster.name: str(cluster) for cluster in tiling.clusters}
    rows = []
    for name, tile in geometry.clusters.items():
        anchor = ", ".join(f"{1e3 * value:.1f}" for value in geometry.anchors[tile])
        rows.append((f"cluster {name}", laid.get(name, f"put at ({anchor}) mm of {{S}}")))
    return rows or [("clusters", "none")]


def design_socket(
    name: str,
    scan: Scan,
    place: Callable[[FloatArray, FloatArray, float], Placement],
    proximal: FloatArray | None,
    clusters: list[ClusterPlace] | None,
    bodies: SocketGeometry,
    settings: TilingSettings,
    progress: Callable[[int, int], None] | None = None,
) -> SocketDesign:
    """Lay tiles out on the interior of a scan.

    Args:
        name: Name of the scan.
        scan: The scan.
        place: Finds {S}: given the interior's vertices, shape (v, 3) [m], the proximal direction,
            shape (3,) [-], both in the scan's axes, and the scan's unit [m].
        proximal: Direction of the opening in the scan's axes, shape (3,) [-]; None to find it.
        clusters: Where the clusters are; None for where they usually are.
        bodies: A socket whose marker bodies are taken over.
        settings: Settings of the tiling.
        progress: Called with the steps done and their number.

    Raises:
        ScanError: If the scan has no interior that takes tiles, or one of no socket's size.
        ConfigurationError: If a cluster fits nowhere at its place, or has no usual one.
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
    axis = axis_through(_distal_end(mesh, upwards), upwards, _ANTERIOR)
    nominal: dict[str, int] = {}
    notes = [
        f"no tile fits where cluster {laid.name} was asked: it is {1e3 * laid.moved:.1f} mm beside"
        for laid in tiling.clusters
        if laid.moved > _MOVED
    ]
    if bodies.regions:
        notes.append(f"the regions {', '.join(bodies.regions)} are not kept: the tiles are new")
    if clusters is None:
        nominal = nominal_places(tiling.squares, axis)
        refuse_unusual(nominal, tiling.squares, mesh, axis)
        notes.append("the clusters are put where they usually are: look, or give --clusters")
    source = f"{name} [{scan.unit}], {placement.source}"
    geometry = tiled_socket(tiling, axis, nominal, bodies, source, frame)
    return SocketDesign(
        name,
        scan,
        mesh,
        placement,
        tiling,
        geometry,
        settings,
        (*scan.notes, *interior.notes, *notes),
    )


def _distal_end(mesh: trimesh.Trimesh, proximal: FloatArray) -> FloatArray:
    """The point of the socket's axis at the height of its lowest point, shape (3,) [m]."""
    vertices = np.asarray(mesh.vertices)
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    lowest = float((vertices @ proximal).min())
    return middle + (lowest - middle @ proximal) * proximal
