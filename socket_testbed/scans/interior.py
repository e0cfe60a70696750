"""The interior surface of a socket: the wall that the limb touches, and its openings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.errors import ScanError
from socket_testbed.scans.axis import Axis, fit_axis
from socket_testbed.scans.cavity import Cavity, find_cavity
from socket_testbed.scans.repair import loop_length, wind_alike
from socket_testbed.scans.surface import Surface
from socket_testbed.scans.topology import boundary_loops, match_edges, separate
from socket_testbed.scans.wall import inner_wall

_NARROWEST = 2.0  # [-]; around a brim, of the radius of the cavity
_WORTH_A_NOTE = 0.05  # [-]; area left out, of the area kept
_SKEW = 30.0  # [deg]; between a given direction and the axis, worth a note


@dataclass(frozen=True)
class Interior:
    """The interior of a socket, in the scan's axes.

    Attributes:
        mesh: The inner wall with the inside of the distal end; its normals point into the
            cavity, and every boundary vertex is on one opening.
        proximal: Unit vector from the distal end to the opening, shape (3,).
        openings: Vertices of the boundary loops, in order around; the brim (the longest) first.
        notes: One plain line for every finding.
    """

    mesh: trimesh.Trimesh
    proximal: FloatArray
    openings: tuple[IntArray, ...]
    notes: tuple[str, ...]


def find_interior(mesh: trimesh.Trimesh, proximal: FloatArray | None = None) -> Interior:
    """Find the surface that a limb touches: of a shell the inner wall, or all of one surface.

    The faces that are seen from a spine within the cavity are the wall; those seen from behind,
    behind the wall, are the outside. Where there is an outside, rims and cut faces are told from
    the wall by what lies behind them.

    Args:
        mesh: One body in metres, as `read_scan` gives it.
        proximal: Direction from the distal end to the brim, in the scan's axes, shape (3,); if
            it is not given, the more open end of the cavity is the proximal one.

    Raises:
        ScanError: If there is no cavity or no opening, or if it is not clear which end of the
            cavity is proximal and no direction was given.
    """
    name = str(mesh.metadata.get("file_name", "the scan"))
    given = None if proximal is None else _unit(proximal)
    cavity = find_cavity(name, _outward(name, mesh))
    decided = cavity.has_clear_end
    axis = _aim(cavity, given)
    cavity = cavity.along(axis, open_above=True)
    surface, seen = cavity.surface, cavity.sight.seen
    kept = inner_wall(surface, cavity.samples, cavity.sight)

    vertices, faces = separate(surface.vertices, surface.faces[kept])
    openings, lengths = _openings(vertices, faces)
    if not lengths or lengths[0] < _NARROWEST * cavity.spine.radius:
        raise ScanError(
            f"{name}: the cavity is closed, no hole in it is as wide as a brim",
            "cut the scan open at the brim",
        )
    if not decided and given is None:
        raise ScanError(
            f"{name}: the two ends of the cavity are equally open, either may be proximal",
            "give --proximal, the direction to the brim",
        )
    notes = [_note_on_walls(surface, kept), _note_on_openings(lengths)]
    notes += _notes_on_losses(surface, kept, seen)
    if given is not None:
        notes += _notes_on_direction(given, axis, decided)
    elif not fit_axis(Surface(vertices, faces)).is_sharp:
        notes.append("no axis of the cavity stands out: check the proximal direction or give it")
    return Interior(
        mesh=trimesh.Trimesh(vertices, faces, process=False, metadata=dict(mesh.metadata)),
        proximal=axis.direction if given is None else given,
        openings=openings,
        notes=tuple(notes),
    )


def _unit(proximal: FloatArray) -> FloatArray:
    direction = np.asarray(proximal, dtype=float)
    length = float(np.linalg.norm(direction))
    if direction.shape != (3,) or not 0.0 < length < np.inf:
        raise ScanError(
            f"the proximal direction {np.array2string(direction)} is none",
            "give three numbers, not all zero",
        )
    return direction / length


def _outward(name: str, mesh: trimesh.Trimesh) -> Surface:
    """The mesh wound alike; if it is watertight, with the normals out of its material."""
    faces, _, one_sided = wind_alike(np.asarray(mesh.faces, dtype=np.int64))
    surface = Surface(np.asarray(mesh.vertices, dtype=float), faces)
    if one_sided.any() or not surface.areas.any():
        raise ScanError(f"{name}: is no surface with two sides", "repair it in a mesh editor")
    inside_out = surface.is_watertight and surface.volume < 0.0
    return surface.flipped() if inside_out else surface


def _aim(cavity: Cavity, given: FloatArray | None) -> Axis:
    """The cavity's axis, from its distal end to its proximal one."""
    axis, towards = cavity.spine.axis, cavity.net_opening
    if given is not None and not cavity.has_clear_end:
        towards = float(given @ axis.direction)
    return axis if towards > 0.0 else axis.turned()


def _openings(vertices: FloatArray, faces: IntArray) -> tuple[tuple[IntArray, ...], list[float]]:
    """Boundary loops and how long they are around [m], the longest first."""
    loops = boundary_loops(faces, match_edges(faces).boundary)
    lengths = [loop_length(vertices, loop) for loop in loops]
    order = np.argsort(lengths)[::-1]
    return tuple(loops[i] for i in order), [lengths[i] for i in order]


def _note_on_walls(surface: Surface, kept: BoolArray) -> str:
    area, whole = 1e4 * surface.areas[kept].sum(), 1e4 * surface.areas.sum()
    if kept.all():
        return f"the scan is one surface: all of it is the interior, {area:.0f} cm2"
    return f"kept the inner wall, {area:.0f} of {whole:.0f} cm2: no outer wall, rim or cut"


def _note_on_openings(lengths: list[float]) -> str:
    shown = ", ".join(f"{1e3 * length:.0f}" for length in lengths)
    return f"openings: {len(lengths)}, the brim first, {shown} mm around"


def _notes_on_losses(surface: Surface, kept: BoolArray, seen: BoolArray) -> list[str]:
    lost, area = surface.areas[seen & ~kept].sum(), surface.areas[kept].sum()
    if lost < _WORTH_A_NOTE * area:
        return []
    return [f"left out {1e4 * lost:.0f} cm2 that are seen from the cavity but are no part of it"]


def _notes_on_direction(given: FloatArray, axis: Axis, decided: bool) -> list[str]:
    angle = np.degrees(np.arccos(np.clip(given @ axis.direction, -1.0, 1.0)))
    if not decided:
        return ["the ends of the cavity are equally open: the given proximal direction decides"]
    if angle > 90.0:
        return [f"the given proximal direction points to the closed end, {angle:.0f} deg off"]
    if angle > _SKEW:
        return [f"the given proximal direction is {angle:.0f} deg off the axis of the cavity"]
    return []
