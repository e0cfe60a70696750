"""What tiling a scan costs: processor time and peak memory, beside reading it and one look at it.

The floor is trimesh reading the same file, its normals and areas, and the nearest of all centres
of faces to each of 100,000 points drawn on it, by a k-d tree. Each run has a process of its own.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import trimesh
from machine import describe_machine
from scipy.spatial import KDTree

from socket_testbed.__main__ import run as verb
from socket_testbed.simulation.socket_scan import make_socket_scan

FACES = {2.6: "20,000", 0.378: "1,000,000"}  # about, by the edge of a triangle [mm]
DRAWN = 100_000


def look(scan: Path) -> None:
    """The floor."""
    mesh = trimesh.load_mesh(scan)
    points = trimesh.sample.sample_surface(mesh, DRAWN, seed=0)[0]
    nearest = KDTree(mesh.triangles_center).query(points)[1]
    print(
        f"faces {len(mesh.faces)}, {mesh.area_faces.sum():.0f}, {len(mesh.face_normals[nearest])}"
    )


def tile(scan: Path, words: list[str]) -> None:
    """The verb, with what it writes."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "socket.yaml"
        verb(["tile", str(scan), "-o", str(output), *words])


def measure(what: str, scan: Path, words: list[str]) -> tuple[float, float, str]:
    """Processor time [s], peak memory [MB] and the line about the tiles of a run of its own."""
    done = subprocess.run(
        [sys.executable, __file__, str(scan), "--only", what, "--", *words],
        capture_output=True,
        text=True,
        check=True,
    )
    *lines, used = done.stdout.splitlines()
    seconds, memory = map(float, used.split())
    return seconds, memory, next((line for line in lines if line.startswith("tiles")), "")


def main() -> None:
    """Print a row for each scan."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scans", nargs="*", type=Path, help="default: simulated ones")
    parser.add_argument("--only", choices=("look", "tile"), help=argparse.SUPPRESS)
    parser.add_argument("--words", default="", help="further words of the verb, as '--seed 1'")
    known, words = parser.parse_known_args()
    if known.only:
        look(known.scans[0]) if known.only == "look" else tile(known.scans[0], words[1:])
        used = resource.getrusage(resource.RUSAGE_SELF)
        print(f"{time.process_time()} {used.ru_maxrss / 1024.0}")
        return
    print(describe_machine(1))
    print("scan                    look [s]  [MB] | tile [s]  [MB] | ratio |")
    with tempfile.TemporaryDirectory() as folder:
        for scan in known.scans or simulated(Path(folder)):
            floor, floor_memory, _ = measure("look", scan, [])
            seconds, memory, tiles = measure("tile", scan, known.words.split())
            print(
                f"{scan.name[-22:]:22}  {floor:8.2f}  {floor_memory:4.0f} | {seconds:8.1f}"
                f"  {memory:4.0f} | {seconds / floor:5.1f} | {tiles}",
                flush=True,
            )


def simulated(folder: Path) -> list[Path]:
    """Scans of the same socket, coarse and fine."""
    scans = []
    for edge, faces in FACES.items():
        scans.append(folder / f"{faces} faces.stl")
        make_socket_scan(edge=edge, noise=min(0.12, 0.05 * edge)).export(scans[-1])
    return scans


if __name__ == "__main__":
    main()
