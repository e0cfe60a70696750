"""Notes on a scan's repairs and on the interior found in it, against lengths and areas on paper."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.meshes import open_cone, shell

from socket_testbed.socket_design.interior import find_interior
from socket_testbed.socket_design.scan_file import read_scan

CELL = 0.004  # [m]; of a sheet of 50 x 50 cells, 0.2 m x 0.2 m


def sheet(*cut: tuple[int, int, int, int]) -> trimesh.Trimesh:
    """The sheet without rectangles of cells: column, row, width and height, in cells."""
    gone = {
        (c + i, r + k) for c, r, width, height in cut for i in range(width) for k in range(height)
    }
    faces = []
    for column in range(50):
        for row in range(50):
            if (column, row) not in gone:
                a = 51 * row + column
                faces += [[a, a + 1, a + 52], [a, a + 52, a + 51]]
    y, x = np.divmod(np.arange(51 * 51), 51)
    vertices = CELL * np.column_stack([x, y, 0 * x])
    return trimesh.Trimesh(vertices, faces, process=False)


def notes(mesh: trimesh.Trimesh, path: Path) -> tuple[str, ...]:
    mesh.export(path)
    return read_scan(path, "m").notes


def test_the_longest_three_edges_are_noted(tmp_path: Path) -> None:
    """The sheet's own is 800 mm, those of the holes 2 (3 + 3), 2 (2 + 2), 2 (2 + 1) times 4 mm."""
    mesh = sheet((30, 10, 2, 1), (10, 10, 2, 2), (20, 30, 3, 3))
    found = notes(mesh, tmp_path / "sheet.ply")
    assert found[1:] == ("edges of the surface left open: 4, 800 mm, 48 mm, 32 mm around",)


def test_the_longest_three_closed_holes_are_noted(tmp_path: Path) -> None:
    """Three cells of 16 mm, and three triangles of 2 * 4 mm + 4 sqrt(2) mm = 13.7 mm."""
    mesh = sheet((10, 10, 1, 1), (20, 10, 1, 1), (30, 10, 1, 1))
    triangles = [120, 230, 340]  # halves of cells inside the sheet
    mesh.faces = np.delete(mesh.faces, triangles, axis=0)
    found = notes(mesh, tmp_path / "sheet.ply")
    assert found[1:] == (
        "small holes closed: 6, 16 mm, 16 mm, 16 mm around",
        "edges of the surface left open: 1, 800 mm around",
    )


CONE = (0.04, 0.06, 0.2)  # distal radius, proximal radius, height [m]


def areas(note: str) -> list[int]:
    """The whole numbers before `of` and before `cm2`."""
    found = re.match(r"kept the inner wall, (\d+) of (\d+) cm2: no outer wall, rim or cut$", note)
    assert found is not None, note
    return [int(number) for number in found.groups()]


def test_the_kept_area_comes_before_the_whole() -> None:
    """The wall of a cone is pi (r + R) s, with s = 201 mm, its end pi r^2: 631 + 50 cm2.

    Outside, 5 mm off, with R = 65 mm, s = 206 mm and r = 44.5 mm: 709 + 62 cm2, and a rim of
    pi (R^2 - 60^2 mm^2), 20 cm2: 791 cm2 more.
    """
    kept, whole = areas(find_interior(shell(*CONE, 0.008, 0.005)).notes[0])
    assert kept == pytest.approx(631 + 50, rel=0.01)
    assert whole == pytest.approx(631 + 50 + 791, rel=0.02)


def test_one_surface_is_all_interior() -> None:
    (note, *_) = find_interior(open_cone(*CONE, 0.008)).notes
    found = re.match(r"the scan is one surface: all of it is the interior, (\d+) cm2$", note)
    assert found is not None, note
    assert int(found[1]) == pytest.approx(631 + 50, rel=0.01)


def direction(angle: float) -> np.ndarray:
    """A direction so far from up [deg]."""
    return np.array([np.sin(np.radians(angle)), 0.0, np.cos(np.radians(angle))])


@pytest.mark.parametrize(
    ("angle", "note"),
    [
        (20.0, ""),
        (40.0, "the given proximal direction is 40 deg off the axis of the cavity"),
        (80.0, "the given proximal direction is 80 deg off the axis of the cavity"),
        (100.0, "the given proximal direction points to the closed end, 100 deg off"),
        (180.0, "the given proximal direction points to the closed end, 180 deg off"),
    ],
    ids=["near", "aslant", "across", "downwards", "down"],
)
def test_a_given_direction_is_compared_with_the_axis(angle: float, note: str) -> None:
    interior = find_interior(open_cone(*CONE, 0.008), direction(angle))
    found = [each for each in interior.notes if "proximal direction" in each]
    assert found == [note] * bool(note)
