"""`tile`: from a scan of the socket's interior to tiles, frames, neighbours and clusters."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from socket_testbed.arrays import FloatArray
from socket_testbed.commands.text import Progress
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import check_number, packaged
from socket_testbed.geometry.socket import SocketGeometry, read_socket, write_socket
from socket_testbed.report.figures.scene import socket_page
from socket_testbed.report.figures.socket_picture import socket_picture
from socket_testbed.socket_design.interior import find_interior
from socket_testbed.socket_design.layout import read_cluster_places, tiled_socket
from socket_testbed.socket_design.placement import (
    Placement,
    parse_direction,
    parse_point,
    place_by_directions,
    place_by_landmarks,
    place_by_points,
)
from socket_testbed.socket_design.scan_file import METRES, Scan, read_scan
from socket_testbed.socket_design.tiling import Tiling, TilingSettings, tile_interior


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("scan", type=Path, metavar="SCAN", help="STL, PLY or OBJ file")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="SOCKET.yaml",
        help="the geometry; a picture (.png) and a page (.html) are written beside it",
    )
    scan = parser.add_argument_group("the scan")
    scan.add_argument("--unit", choices=tuple(METRES), help="unit of the scan (default: inferred)")
    scan.add_argument("--body", metavar="NAME|INDEX", help="which body, where there are several")
    scan.add_argument(
        "--proximal",
        metavar="AXIS",
        help="direction of the opening in the scan, such as +z or '0 0.1 1' (default: worked out)",
    )
    _add_placement(parser.add_argument_group("where {S}, the load cell's frame, is"))
    _add_tiles(parser.add_argument_group("tiles, clusters and bodies"))
    parser.set_defaults(run=run)


def _add_placement(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--anterior", metavar="AXIS", help="direction of x of {S} in the scan")
    group.add_argument(
        "--height",
        type=float,
        default=80.0,
        metavar="MM",
        help="of the distal end above the load cell [mm] (default: 80)",
    )
    either = group.add_mutually_exclusive_group()
    either.add_argument(
        "--landmarks", type=Path, metavar="FILE.yaml", help="points known in the scan and in {S}"
    )
    either.add_argument(
        "--points",
        nargs=3,
        metavar="'X Y Z'",
        help="origin of {S}, a point on +x, one towards +y: picked in the scan, in its unit",
    )


def _add_tiles(group: argparse._ArgumentGroup) -> None:
    settings = TilingSettings()
    group.add_argument(
        "--size",
        type=float,
        default=1e3 * settings.edge,
        metavar="MM",
        help="edge of a tile [mm] (default: %(default)g)",
    )
    group.add_argument(
        "--flatness",
        type=float,
        default=1e3 * settings.flatness,
        metavar="MM",
        help="largest distance of the surface from a tile's plane [mm] (default: %(default)g)",
    )
    group.add_argument(
        "--rounds",
        type=int,
        default=settings.rounds,
        help="of the search; more may find another tile (default: %(default)s)",
    )
    group.add_argument(
        "--seed", type=int, default=settings.seed, help="of the search (default: %(default)s)"
    )
    group.add_argument(
        "--clusters",
        type=Path,
        metavar="FILE.yaml",
        help="where the clusters are in {S} (default: where they usually are)",
    )
    group.add_argument(
        "--bodies",
        type=Path,
        metavar="SOCKET.yaml",
        help="a registered socket whose marker bodies are kept (default: nominal ones)",
    )


@dataclass(frozen=True)
class _Interior:
    """The interior in {S}: surface, directions, and how it came there."""

    mesh: trimesh.Trimesh
    proximal: FloatArray
    placement: Placement
    notes: tuple[str, ...]


def run(options: argparse.Namespace) -> None:
    """Tile, draw and write."""
    settings = _settings(options)
    if options.output.suffix not in {".yaml", ".yml"}:
        raise ConfigurationError(f"{options.output}: is no .yaml file", "name the output so")
    places = read_cluster_places(options.clusters) if options.clusters else None
    _refuse_to_lose_registration(options)
    bodies = read_socket(options.bodies or packaged("config", "socket.yaml"))
    if not options.bodies:
        bodies = dataclasses.replace(bodies, registration="")
    scan = read_scan(options.scan, options.unit, options.body)
    interior = _place(scan, options)
    anterior = np.array([1.0, 0.0, 0.0])
    tiling = tile_interior(interior.mesh, interior.proximal, anterior, settings, Progress("tiling"))
    geometry, notes = tiled_socket(
        tiling,
        _distal_end(interior),
        interior.proximal,
        anterior,
        places,
        bodies,
        f"{options.scan.name} [{scan.unit}], {interior.placement.source}",
    )
    facts = _facts(tiling, geometry, scan, interior, settings)
    write_socket(geometry, options.output)
    _draw(interior.mesh, geometry, options, facts)
    for note in (*scan.notes, *interior.notes):
        print(f"note: {note}", file=sys.stderr)
    if places is None:
        notes.append("the clusters are put where they usually are: look, or give --clusters")
    if options.anterior is None and not (options.points or options.landmarks):
        notes.append("x of the scan is assumed to be anterior: look, or give --anterior")
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
    if not geometry.registration:
        print("note: the marker bodies are nominal: register them", file=sys.stderr)
    width = max(len(name) for name, _ in facts)
    for name, value in facts:
        print(f"{name.ljust(width)}  {value}")


def _refuse_to_lose_registration(options: argparse.Namespace) -> None:
    if options.output.exists() and not options.bodies:
        registration = read_socket(options.output).registration
        if registration:
            raise ConfigurationError(
                f"{options.output} holds registered marker bodies ({registration})",
                f"keep them with --bodies {options.output}, or name another output",
            )


def _settings(options: argparse.Namespace) -> TilingSettings:
    check_number(options.height, "--height", 0.0, 1000.0)
    return TilingSettings(
        edge=1e-3 * check_number(options.size, "--size", 5.0, 100.0),
        flatness=1e-3 * check_number(options.flatness, "--flatness", 0.1, options.size / 2.0),
        rounds=int(check_number(options.rounds, "--rounds", 0, 100_000)),
        seed=int(check_number(options.seed, "--seed", 0)),
    )


def _place(scan: Scan, options: argparse.Namespace) -> _Interior:
    """The interior of a scan, moved to {S}."""
    given = parse_direction(options.proximal, "--proximal") if options.proximal else None
    interior = find_interior(scan.mesh, given)
    vertices, scale = np.asarray(interior.mesh.vertices), METRES[scan.unit]
    if options.landmarks:
        placement = place_by_landmarks(options.landmarks, scale)
    elif options.points:
        picked = [parse_point(point, "--points") for point in options.points]
        placement = place_by_points(np.array(picked) * scale)
    else:
        anterior = parse_direction(options.anterior, "--anterior") if options.anterior else None
        placement = place_by_directions(
            vertices, interior.proximal, anterior, 1e-3 * options.height
        )
    pose = placement.scan_in_load_cell
    mesh = trimesh.Trimesh(pose.apply(vertices), interior.mesh.faces, process=False)
    return _Interior(mesh, pose.rotation @ interior.proximal, placement, interior.notes)


def _distal_end(interior: _Interior) -> FloatArray:
    """The point of the socket's axis at the height of its lowest point, shape (3,) [m]."""
    vertices = np.asarray(interior.mesh.vertices)
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    lowest = float((vertices @ interior.proximal).min())
    return middle + (lowest - middle @ interior.proximal) * interior.proximal


def _facts(
    tiling: Tiling,
    geometry: SocketGeometry,
    scan: Scan,
    interior: _Interior,
    settings: TilingSettings,
) -> list[tuple[str, str]]:
    """What a user wants to know, as rows of a table."""
    tiles, area = len(geometry), 1e4 * tiling.interior_area
    covered = 1e4 * float(tiling.footprint_areas.sum())
    edge = 1e3 * settings.edge
    return [
        (
            "scan",
            f"body {scan.body}, {len(scan.mesh.faces)} faces, in {scan.unit} ({scan.unit_source})",
        ),
        ("{S}", interior.placement.source),
        ("tiles", f"{tiles} of {edge:g} x {edge:g} mm"),
        (
            "covered",
            f"{covered:.0f} of {area:.0f} cm^2 of the interior ({100 * covered / area:.0f} %);"
            f" {100 * tiling.cover_inside:.0f} % of what is more than {edge / 2:g} mm from its rim",
        ),
        (
            "upper bound",
            f"{tiling.upper_bound:.1f} tiles by area: {100 * tiles / tiling.upper_bound:.0f} %"
            " reached",
        ),
        ("largest gap", f"{1e3 * tiling.largest_gap:.0f} mm from the nearest tile"),
        (
            "flatness",
            f"the surface is within {1e3 * tiling.flatness.max():.1f} mm of every tile's plane"
            f" (median {1e3 * np.median(tiling.flatness):.1f}, limit {1e3 * settings.flatness:g})",
        ),
        ("neighbours", f"{len(geometry.neighbours)} pairs"),
        ("clusters", _places(geometry)),
    ]


def _places(geometry: SocketGeometry) -> str:
    """Where the clusters are, in {S}."""
    places = (
        f"{name} at {', '.join(f'{1e3 * c:.0f}' for c in geometry.anchors[tile])}"
        for name, tile in geometry.clusters.items()
    )
    return "; ".join(places) + " mm of {S}" if geometry.clusters else "none"


def _draw(
    mesh: trimesh.Trimesh,
    geometry: SocketGeometry,
    options: argparse.Namespace,
    facts: list[tuple[str, str]],
) -> None:
    """The picture and the page beside the output."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    title = f"{options.scan.name}: {len(geometry)} tiles"
    picture, page = (options.output.with_suffix(suffix) for suffix in (".png", ".html"))
    socket_picture(vertices, faces, geometry, picture, title)
    socket_page(vertices, faces, geometry, page, title, facts)
    print(f"{options.output}, {picture.name} and {page.name} written")
