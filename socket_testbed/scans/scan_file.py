"""A scan file read as one sound body in metres, with notes of all that was done to it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import ScanError
from socket_testbed.scans.bodies import Body, choose_body, find_bodies
from socket_testbed.scans.formats import Triangles, read_triangles
from socket_testbed.scans.repair import (
    are_finite,
    are_first,
    are_slivers,
    are_triangles,
    fill_holes,
    flip_slivers,
    weld,
    wind_alike,
)
from socket_testbed.scans.surface import Surface
from socket_testbed.scans.topology import match_edges, separate
from socket_testbed.scans.units import (
    METRES,
    Source,
    check_unit,
    find_unit,
    refuse_normalised,
    stated_unit,
)

_SMALL_HOLE = 0.020  # [m]; around


@dataclass(frozen=True)
class Scan:
    """One body of a scan file.

    Attributes:
        mesh: The body in metres and in the scan's own axes: welded, wound alike, without faces
            that have no area; every edge is in one or two faces.
        body: Its name in the file, or its number.
        unit: The unit of the file's lengths.
        unit_source: Whether the unit was given, stated by the file, or inferred from the size.
        notes: One plain line for every repair and finding.
    """

    mesh: trimesh.Trimesh
    body: str
    unit: str
    unit_source: Source
    notes: tuple[str, ...]


def read_scan(path: Path, unit: str | None = None, body: str | None = None) -> Scan:
    """Read one body of an STL, PLY or OBJ file, and repair what can be repaired.

    Args:
        path: The file.
        unit: The unit of its lengths, one of m, cm, mm, in; else stated or inferred.
        body: The name (an object or group of an OBJ) or the number of the body; needed if
            there is more than one.

    Raises:
        ScanError: If the file cannot be read as a surface, or its unit or the body is not clear.
    """
    if unit is not None:
        check_unit(unit)
    triangles = read_triangles(path)
    notes: list[str] = []
    surface, labels = _clean(path, triangles, notes)
    refuse_normalised(str(path), surface.vertices)
    bodies, specks = find_bodies(surface, labels, triangles.names)
    _note(notes, len(specks), "dropped {} faces of pieces too small to be a body")
    stated = stated_unit(triangles.comment)
    chosen = choose_body(str(path), bodies, body, _show_scale(bodies, unit, stated))
    size = float(chosen.extents.max())
    found, source = find_unit(f"{path}: body {chosen.name}", size, unit, stated)
    notes.append(f"{source} unit {found}: the body is {size * METRES[found]:.3g} m long")
    if stated and stated != found:
        notes.append(f"the file states the unit {stated}, which is passed over")
    vertices, faces = surface.vertices * METRES[found], surface.faces[chosen.faces]
    mesh = _mend(f"{path}: body {chosen.name}", vertices, faces, notes)
    mesh.metadata["file_name"] = str(path)
    return Scan(mesh, chosen.name, found, source, tuple(notes))


def _clean(path: Path, triangles: Triangles, notes: list[str]) -> tuple[Surface, IntArray]:
    """The welded surface of the sound faces, and their labels."""
    vertices, faces, labels = triangles.vertices, triangles.faces, triangles.labels
    finite = are_finite(vertices, faces)
    _note(notes, (~finite).sum(), "removed {} faces with a corner that is not finite")
    if not finite.any():
        raise ScanError(f"{path}: no face has finite corners", "export the scan again")
    vertices, faces = weld(vertices, faces[finite])
    plain = are_triangles(faces)
    _note(notes, (~plain).sum(), "removed {} faces without area, of fewer than three vertices")
    first = are_first(faces)
    _note(notes, (plain & ~first).sum(), "removed {} duplicate faces")
    kept = plain & first
    surface = Surface(vertices, faces[kept])
    if are_slivers(vertices, surface.faces).all():
        raise ScanError(f"{path}: no face has an area", "export the scan again, as a surface")
    return surface, labels[finite][kept] if len(labels) else np.empty((int(kept.sum()), 0), int)


def _show_scale(bodies: list[Body], given: str | None, stated: str | None) -> float | None:
    """Metres a unit for the list of the bodies, by the largest of them, if that is clear."""
    try:
        size = max(float(body.extents.max()) for body in bodies)
        return METRES[find_unit("", size, given, stated)[0]]
    except ScanError:
        return None


def _mend(name: str, vertices: FloatArray, faces: IntArray, notes: list[str]) -> trimesh.Trimesh:
    """A body in metres with one winding, no crowded edges, small holes or slivers."""
    faces, turned, one_sided = wind_alike(faces)
    _note(notes, turned, "turned {} faces so that all wind the same way")
    if one_sided.any():
        raise ScanError(
            f"{name}: is one-sided, as a Moebius band is; no winding fits its faces",
            "repair the surface in a mesh editor",
        )
    crowded = len(match_edges(faces).crowded)
    _note(notes, crowded, "cut at edges that more than two faces share, {} sides in all")
    vertices, faces = separate(vertices, faces)
    vertices, faces, closed, left = fill_holes(vertices, faces, _SMALL_HOLE)
    _note(notes, len(closed), f"small holes closed: {{}}, {_millimetres(closed)} around")
    _note(notes, len(left), f"edges of the surface left open: {{}}, {_millimetres(left)} around")
    faces, flat = flip_slivers(vertices, faces)
    if flat:
        notes.append(f"removed {flat} faces without area, of three vertices on a line")
        vertices, faces = separate(vertices, faces)
    return trimesh.Trimesh(vertices, faces, process=False)


def _note(notes: list[str], count: int, text: str) -> None:
    """Add a note of a count, unless it is zero."""
    if count:
        notes.append(text.format(count))


def _millimetres(lengths: list[float]) -> str:
    return ", ".join(f"{1e3 * length:.0f} mm" for length in sorted(lengths, reverse=True)[:3])
