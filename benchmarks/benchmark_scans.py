"""What tiling a scan costs: processor time and peak memory, beside reading it and one look at it.

The floor is trimesh reading the same file, its normals and areas, and the nearest of all centres
of faces to each of 100,000 points drawn on it, by a k-d tree. Each run has a process of its own.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import trimesh
from machine import apart, describe_machine
from scipy.spatial import KDTree

from socket_testbed.__main__ import run as verb

EDGES = (2.6, 0.378)  # [mm]; of the triangles of simulated scans: 20,000 and 1,000,000 faces
DRAWN = 100_000
SCANNER = Path(__file__).parents[1] / "examples" / "socket_scan.py"


def look(scan: Path) -> None:
    """The floor."""
    mesh = trimesh.load_mesh(scan)
    points = trimesh.sample.sample_surface(mesh, DRAWN, seed=0)[0]
    nearest = KDTree(mesh.triangles_center).query(points)[1]
    assert mesh.area_faces.sum() > 0.0 and len(mesh.face_normals[nearest]) == DRAWN


def tile(scan: Path, words: list[str]) -> None:
    """The verb, with what it writes."""
    with tempfile.TemporaryDirectory() as folder:
        verb(["tile", str(scan), "-o", str(Path(folder) / "socket.yaml"), *words])


def main() -> None:
    """Print a row for each scan, below what the verb says of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scans", nargs="*", type=Path, help="default: simulated ones")
    parser.add_argument("--edges", nargs="+", type=float, default=EDGES,
                        help="of the triangles of simulated scans [mm] (2.6 0.378)")  # fmt: skip
    parser.add_argument("--words", default="", help="further words of the verb, as '--seed 1'")
    options = parser.parse_args()
    print(describe_machine(1))
    with tempfile.TemporaryDirectory() as folder:
        for scan in options.scans or simulated(Path(folder), options.edges):
            floor, floor_memory = apart(look, scan)
            seconds, memory = apart(tile, scan, options.words.split())
            print(
                f"{scan.name}: look {floor:.2f} s, {floor_memory:.0f} MB; tile {seconds:.1f} s,"
                f" {memory:.0f} MB; ratio {seconds / floor:.1f}\n",
                flush=True,
            )


def simulated(folder: Path, edges: Sequence[float]) -> list[Path]:
    """Scans of one socket, by the edges of their triangles [mm]."""
    scans = []
    for edge in edges:
        scans.append(folder / f"edges of {edge:g} mm.stl")
        subprocess.run([sys.executable, SCANNER, scans[-1], f"{edge}"], check=True)
    return scans


if __name__ == "__main__":
    main()
