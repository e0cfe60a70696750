"""Repairs of scans: each undoes a known damage and is reported."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.meshes import assert_same_surface, open_cone, shell, shifted, with_faces, write_stl

from socket_testbed.errors import ScanError
from socket_testbed.socket_design.scan_file import Scan, read_scan

CONE = (0.04, 0.06, 0.2)  # distal radius, proximal radius, height [m]
EDGE = 0.01


@pytest.fixture
def cone() -> trimesh.Trimesh:
    return open_cone(*CONE, EDGE, dome=True)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "scan.stl"


def noted(scan: Scan, words: str) -> bool:
    return any(words in note for note in scan.notes)


def test_specks_are_dropped_and_reported(cone, path):
    specks = [shifted(trimesh.creation.icosphere(1, 0.001), 0.2 + 0.01 * i) for i in range(3)]
    scan = read_scan(write_stl(trimesh.util.concatenate([specks[0], cone, *specks[1:]]), path))
    assert_same_surface(scan.mesh, cone)
    assert noted(scan, "dropped 240 faces")


def test_vertices_a_hair_apart_are_welded(cone, path):
    rng = np.random.default_rng(1)
    corners = cone.vertices[cone.faces] + rng.uniform(-2e-8, 2e-8, (len(cone.faces), 3, 3))
    loose = trimesh.Trimesh(
        corners.reshape(-1, 3), np.arange(3 * len(cone.faces)).reshape(-1, 3), process=False
    )
    assert_same_surface(read_scan(write_stl(loose, path)).mesh, cone)


def test_duplicate_faces_are_removed_whatever_their_winding(cone, path):
    extra = np.vstack([cone.faces[:7], cone.faces[5:15, ::-1], np.roll(cone.faces[20:22], 1, 1)])
    scan = read_scan(write_stl(with_faces(cone, np.vstack([cone.faces, extra])), path))
    assert_same_surface(scan.mesh, cone)
    assert noted(scan, f"removed {len(extra)} duplicate faces")


def test_faces_on_fewer_than_three_vertices_are_removed(cone, path):
    points = np.column_stack([cone.faces[:9, 0], cone.faces[:9, 0], cone.faces[:9, 1]])
    scan = read_scan(write_stl(with_faces(cone, np.vstack([points, cone.faces])), path))
    assert_same_surface(scan.mesh, cone)
    assert noted(scan, "removed 9 faces without area")


def test_a_sliver_on_a_line_is_removed_without_a_crack(cone, path):
    solid = shell(*CONE, EDGE, 0.005)
    a, b, c = solid.faces[100]
    middle = len(solid.vertices)
    vertices = np.vstack([solid.vertices, 0.5 * (solid.vertices[a] + solid.vertices[b])])
    faces = np.vstack(
        [np.delete(solid.faces, 100, axis=0), [[a, middle, c], [middle, b, c], [a, b, middle]]]
    )
    broken = trimesh.Trimesh(vertices, faces, process=False)
    scan = read_scan(write_stl(broken, path))
    assert scan.mesh.is_watertight
    assert scan.mesh.area_faces.min() > 1e-7
    assert scan.mesh.area == pytest.approx(solid.area, rel=1e-5)
    assert noted(scan, "removed 1 faces without area, of three vertices on a line")


def test_faces_with_corners_that_are_not_finite_are_removed(cone, path):
    vertices = cone.vertices.copy()
    vertices[50] = [np.nan, 0.0, np.inf]
    scan = read_scan(write_stl(trimesh.Trimesh(vertices, cone.faces, process=False), path))
    gone = int((cone.faces == 50).any(axis=1).sum())
    assert np.isfinite(scan.mesh.vertices).all()
    assert noted(scan, f"removed {gone} faces with a corner that is not finite")


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_the_winding_is_made_consistent_with_the_fewest_turns(path, share):
    solid = shell(*CONE, EDGE, 0.005)
    assert len(solid.faces) % 2 == 0
    flip = np.zeros(len(solid.faces), bool)
    flip[np.random.default_rng(3).permutation(len(flip))[: round(share * len(flip))]] = True
    faces = np.where(flip[:, None], solid.faces[:, ::-1], solid.faces)
    scan = read_scan(write_stl(with_faces(solid, faces), path))
    assert scan.mesh.is_winding_consistent
    assert abs(scan.mesh.volume) == pytest.approx(solid.volume, rel=1e-5)
    assert noted(scan, f"reversed {flip.sum()} faces")


def test_a_one_sided_surface_is_refused(path):
    turn = np.linspace(0.0, 2.0 * np.pi, 41)[:-1]
    across = np.array([-0.02, 0.02])
    half = 0.5 * turn[:, None]
    radius = 0.1 + across * np.cos(half)
    points = np.stack(
        [radius * np.cos(turn)[:, None], radius * np.sin(turn)[:, None], across * np.sin(half)], -1
    ).reshape(-1, 3)
    i = np.arange(40)
    low, high, next_low, next_high = 2 * i, 2 * i + 1, 2 * i + 2, 2 * i + 3
    next_low[-1], next_high[-1] = 1, 0
    faces = np.vstack(
        [np.column_stack([low, high, next_low]), np.column_stack([high, next_high, next_low])]
    )
    with pytest.raises(ScanError, match=r"one-sided.*mesh editor"):
        read_scan(write_stl(trimesh.Trimesh(points, faces, process=False), path))


def test_a_fin_on_the_wall_is_cut_off_and_the_wall_stays_whole(cone, path):
    a, b = cone.faces[200][:2]
    tip = 0.8 * cone.vertices[a]
    fin = trimesh.Trimesh(
        np.vstack([cone.vertices, tip]),
        np.vstack([cone.faces, [[a, b, len(cone.vertices)]]]),
        process=False,
    )
    scan = read_scan(write_stl(fin, path))
    assert_same_surface(scan.mesh, cone)
    assert noted(scan, "dropped 1 faces")


def pressed_together(mesh: trimesh.Trimesh, places: list, corners: int) -> trimesh.Trimesh:
    """One face's corners moved to another's, far away: the surface touches itself there."""
    here, there = (
        mesh.faces[np.argmin(np.linalg.norm(mesh.triangles_center - place, axis=1))]
        for place in places
    )
    vertices = mesh.vertices.copy()
    vertices[there[:corners]] = vertices[here[:corners]]
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


SIDES = [[0.05, 0.0, 0.1], [-0.05, 0.0, 0.1]]


@pytest.mark.parametrize(("corners", "sides"), [(1, 0), (2, 4)])
def test_where_the_surface_touches_itself_it_is_cut(path, corners, sides):
    touching = pressed_together(shell(*CONE, EDGE, 0.005), SIDES, corners)
    scan = read_scan(write_stl(touching, path))
    assert len(scan.mesh.vertices) == len(touching.vertices)
    assert scan.mesh.euler_number == touching.euler_number
    assert np.unique(scan.mesh.edges_sorted, axis=0, return_counts=True)[1].max() == 2
    assert noted(scan, f"more than two faces share, {sides} sides") == (sides > 0)


def test_where_an_edge_of_the_surface_touches_its_middle_it_is_cut(path, cone):
    """Three faces on one edge; the two that a cut must part lie on the surface's own edge."""
    edge = cone.edges[trimesh.grouping.group_rows(cone.edges_sorted, require_count=1)][0]
    onto = cone.faces[np.argmin(np.linalg.norm(cone.triangles_center - SIDES[0], axis=1))][:2]
    vertices = cone.vertices.copy()
    vertices[edge] = vertices[onto]
    scan = read_scan(write_stl(trimesh.Trimesh(vertices, cone.faces, process=False), path))
    assert np.unique(scan.mesh.edges_sorted, axis=0, return_counts=True)[1].max() == 2
    assert noted(scan, "more than two faces share, 3 sides")
    assert scan.mesh.area == pytest.approx(
        trimesh.Trimesh(vertices, cone.faces, process=False).area, rel=1e-5
    )


def test_small_holes_are_closed_and_a_large_one_through_both_walls_is_left(path):
    solid = shell(*CONE, 0.004, 0.005)
    centres = solid.triangles_center
    small = np.argmin(np.linalg.norm(centres - [0.05, 0.0, 0.1], axis=1))
    large = np.linalg.norm(centres - [0.0, 0.06, 0.1], axis=1) < 0.015
    keep = ~large
    keep[small] = False
    scan = read_scan(write_stl(with_faces(solid, solid.faces[keep]), path))
    assert noted(scan, "small holes closed: 1, ")
    assert noted(scan, "edges of the surface left open: 2, ")
    corrected = read_scan(write_stl(with_faces(solid, np.delete(solid.faces, small, 0)), path)).mesh
    assert corrected.is_watertight
    assert corrected.volume == pytest.approx(solid.volume, rel=1e-4)


def test_a_clean_scan_has_no_notes_but_of_its_unit_and_brim(cone, path):
    assert len(read_scan(write_stl(cone, path)).notes) == 2
    assert len(read_scan(write_stl(shell(*CONE, EDGE, 0.005), path)).notes) == 1


def test_a_hole_of_many_edges_is_closed_by_a_fan_that_fits(path):
    solid = shell(*CONE, 0.0025, 0.005)
    vertex = np.argmin(np.linalg.norm(solid.vertices - [0.05, 0.0, 0.1], axis=1))
    scan = read_scan(write_stl(with_faces(solid, (solid.faces != vertex).all(axis=1)), path))
    assert noted(scan, "small holes closed: 1, ")
    assert scan.mesh.is_watertight
    assert scan.mesh.is_winding_consistent
    assert_same_surface(scan.mesh, solid)
