"""`tile`: from a scan of the socket's interior to tiles, frames, neighbours and clusters."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from socket_testbed import api
from socket_testbed.commands.options import add_replace
from socket_testbed.commands.text import Progress
from socket_testbed.documents import check_number
from socket_testbed.files import check_outputs
from socket_testbed.socket_design.placement import parse_point
from socket_testbed.socket_design.scan_file import METRES
from socket_testbed.socket_design.tiling import TilingSettings


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
    add_replace(parser)
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
        help="where the clusters are, in {S} or in the scan (default: where they usually are)",
    )
    group.add_argument(
        "--bodies",
        type=Path,
        metavar="SOCKET.yaml",
        help="a registered socket whose marker bodies are kept (default: nominal ones)",
    )


def run(options: argparse.Namespace) -> None:
    """Tile, draw and write."""
    check_number(options.height, "--height", 0.0, 1000.0)
    settings = TilingSettings(
        edge=1e-3 * check_number(options.size, "--size", 5.0, 100.0),
        flatness=1e-3 * check_number(options.flatness, "--flatness", 0.1, options.size / 2.0),
        rounds=int(check_number(options.rounds, "--rounds", 0, 100_000)),
        seed=int(check_number(options.seed, "--seed", 0)),
    )
    points = [parse_point(point, "--points") for point in options.points or ()]
    output = options.output
    beside = [output.with_suffix(suffix) for suffix in (".png", ".html")]
    check_outputs(output, *beside, replace=options.replace)
    design = api.tile(
        options.scan,
        output,
        unit=options.unit,
        body=options.body,
        proximal=options.proximal,
        anterior=options.anterior,
        height=1e-3 * options.height,
        landmarks=options.landmarks,
        points=np.array(points) if points else None,
        clusters=options.clusters,
        bodies=options.bodies,
        settings=settings,
        progress=Progress,
    )
    picture, page = (output.with_suffix(suffix).name for suffix in (".png", ".html"))
    print(f"{output}, {picture} and {page} written")
    for note in design.notes:
        print(f"note: {note}", file=sys.stderr)
    if not design.geometry.registration:
        print("note: the marker bodies are nominal: register them", file=sys.stderr)
    facts = design.facts()
    width = max(len(name) for name, _ in facts)
    for name, value in facts:
        print(f"{name.ljust(width)}  {value}")
