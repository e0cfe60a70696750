"""The interior surface of a socket: its cavity, what the cavity sees, and its inner wall."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from trimesh.graph import connected_component_labels
from trimesh.util import diagonal_dot

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.errors import ScanError
from socket_testbed.socket_design.scan_file import (
    boundary_half_edges,
    boundary_loops,
    loop_length,
    number_cells,
    plain_mesh,
    separate,
)

_EXACT = 1e-6  # [-]; misfit of an axis that is as good as exact
_IN_QUESTION = 5.0  # [-]; misfit of an axis that cannot be ruled out, of the best misfit
_ALIKE = 1.3  # [-]; between misfits so close that all axes between theirs fit as well


@dataclass(frozen=True)
class Axis:
    """A line."""

    origin: FloatArray  # a point of it; (3,) [m]
    direction: FloatArray  # unit vector along it; (3,)

    def cylindrical(self, mesh: trimesh.Trimesh) -> tuple[FloatArray, FloatArray]:
        """Places of the faces along the axis from its origin and off it, each of shape (F,) [m]."""
        offset = mesh.triangles_center - self.origin
        along = offset @ self.direction
        return along, np.linalg.norm(offset - along[:, None] * self.direction, axis=1)


@dataclass(frozen=True)
class AxisFit:
    """How well a surface is one of revolution about axes of any direction."""

    middle: FloatArray  # middle of the surface; (3,) [m]
    moment: FloatArray  # best moment about the middle of an axis a unit direction; (3, 3) [m]
    misfits: FloatArray  # mean square misfit of the principal directions, rising; (3,) [-]
    directions: FloatArray  # the principal directions, one a row; (3, 3)

    def likely(self) -> list[Axis]:
        """The best axis, and those at right angles to it that cannot be ruled out."""
        limit = _IN_QUESTION * max(float(self.misfits[0]), _EXACT)
        return [self._along(direction) for direction in self.directions[self.misfits <= limit]]

    def near(self, direction: FloatArray) -> Axis:
        """The principal axis near a direction, or that direction where many fit alike."""
        best = int(np.abs(self.directions @ direction).argmax())
        ratio = np.fmax(self.misfits, _EXACT) / max(float(self.misfits[best]), _EXACT)
        alike = self.directions[np.abs(np.log(ratio)) < np.log(_ALIKE)]
        towards = alike.T @ (alike @ direction)
        return self._along(towards / np.linalg.norm(towards))

    @property
    def is_sharp(self) -> bool:
        """Whether the best axis stands out."""
        return float(self.misfits[1]) > _ALIKE * max(float(self.misfits[0]), _EXACT)

    def _along(self, direction: FloatArray) -> Axis:
        return Axis(self.middle + np.cross(direction, self.moment @ direction), direction)


def _fit_axis(mesh: trimesh.Trimesh) -> AxisFit:
    """Fit an axis of revolution to a surface.

    A rotation about the direction c with the moment m moves the point p by c x p + m. It leaves
    a surface of revolution in itself, so ``n . (c x p + m) = 0`` there; that is solved in least
    squares for |c| = 1 (Pottmann and Randrup 1998, Computing 60, 307-322). Neither the sign of
    the normals nor a part of the circumference that is missing matters.
    """
    weights = mesh.area_faces / mesh.area
    normals, centres = np.asarray(mesh.face_normals), np.asarray(mesh.triangles_center)
    middle = weights @ centres
    points = centres - middle
    scale = max(float(np.sqrt(weights @ (points**2).sum(axis=1))), np.finfo(float).tiny)
    columns = np.hstack([np.cross(points / scale, normals), normals])
    gram = columns.T @ (weights[:, None] * columns)
    moment = -np.linalg.pinv(gram[3:, 3:], rcond=1e-9, hermitian=True) @ gram[3:, :3]
    misfits, directions = np.linalg.eigh(gram[:3, :3] + gram[:3, 3:] @ moment)
    return AxisFit(middle, scale * moment, misfits, directions.T)


_LONGEST_ROUND = 0.45  # [-]; of the length, for the radius of a rounded end
_NARROW = 0.5  # [-]; of the radius, for what is no wall of the cavity but of a bore


@dataclass(frozen=True)
class Spine:
    """A segment; its points look at the walls beside them, its ends at what lies beyond."""

    axis: Axis  # the line it is on
    low: float  # where the segment begins, from the origin along the direction [m]
    high: float  # where it ends [m]
    radius: float  # typical distance of the walls [m]

    def feet(self, points: FloatArray) -> FloatArray:
        """The points of the segment that look at the given points, shape (N, 3) [m]."""
        along = np.clip((points - self.axis.origin) @ self.axis.direction, self.low, self.high)
        return self.axis.origin + along[:, None] * self.axis.direction


def _spine_along(axis: Axis, wall: trimesh.Trimesh, open_above: bool = False) -> Spine:
    """Lay the segment so that it ends a radius before the ends of a wall.

    What is much closer to the axis than the wall does not count: a bore in the distal end would
    draw the segment too far down to see the floor around it.
    """
    along, distance = axis.cylindrical(wall)
    radius = _weighted_median(distance, wall.area_faces)
    wide = along[distance >= _NARROW * radius]
    low, high = float(wide.min()), float(wide.max())
    radius = min(radius, _LONGEST_ROUND * (high - low))
    return Spine(axis, low + radius, np.inf if open_above else high - radius, radius)


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


_FINENESS = 100  # samples along the side of a square of the surface's area
_PER_SQUARE = 10  # samples in a square of the spacing, on average
_NO_DEPTH = 1e-9  # [m]; a point on the spine has a direction, too
_GRAZING = 0.2  # [-]; cosine below which a face is seen from neither side


@dataclass(frozen=True)
class SurfaceSamples:
    """Points on the faces of a surface."""

    owners: IntArray  # the face of each point; (P,)
    points: FloatArray  # shape (P, 3) [m]
    spacing: float  # how far apart they are at most, about [m]

    def majority(self, votes: BoolArray) -> BoolArray:
        """Faces with more than half of their points in favour, shape (F,)."""
        return 2 * np.bincount(self.owners, votes) > np.bincount(self.owners)


def _spread_samples(mesh: trimesh.Trimesh) -> SurfaceSamples:
    """Points on a surface, close enough together for its overall shape."""
    spacing = float(np.sqrt(mesh.area)) / _FINENESS
    count = int(_PER_SQUARE * _FINENESS**2)
    points, owners = trimesh.sample.sample_surface(mesh, count, seed=0)
    return SurfaceSamples(
        np.concatenate([np.arange(len(mesh.faces)), owners]),
        np.concatenate([mesh.triangles_center, points]),  # each face has a vote
        spacing,
    )


_SOLID = 0.5  # [-]; share of directions in which a cavity sees the front of something first
_FLAT = 0.95  # [-]; area of the caps that close a wall, of its own
_CLEARLY_OPEN = 0.1  # [-]; net opening, of a section of the cavity


@dataclass(frozen=True)
class Cavity:
    """A surface with its normals into the cavity, and what its spine sees of every face."""

    mesh: trimesh.Trimesh
    samples: SurfaceSamples  # points on all of its faces
    spine: Spine
    facing: FloatArray  # (F,); cosine between a face's normal and the direction to the spine
    seen: BoolArray  # faces whose front is the first thing in its direction; (F,)
    hidden: BoolArray  # faces that show their back, behind the front of another; (F,)
    front_share: float  # share of the directions with anything in them whose first thing is a front

    @cached_property
    def wall(self) -> trimesh.Trimesh:
        """The largest piece of what is seen from its front."""
        return plain_mesh(self.mesh.vertices, self.mesh.faces[_main_piece(self.mesh, self.seen)])

    @cached_property
    def caps(self) -> FloatArray:
        """Area vector of the caps that would close the wall, turned outwards, shape (3,) [m^2].

        The area vectors of a closed surface add up to nothing, so those of the wall, which
        point inwards, add up to those of its caps.
        """
        return np.asarray(0.5 * self.wall.triangles_cross.sum(axis=0))

    @property
    def net_opening(self) -> float:
        """Area of the openings in the direction of the spine [m^2].

        An opening at the spine's beginning counts against one at its end; one at its side not.
        """
        return float(self.caps @ self.spine.axis.direction)

    @property
    def has_clear_end(self) -> bool:
        """Whether one of its ends is clearly more open than the other."""
        return abs(self.net_opening) > _CLEARLY_OPEN * np.pi * self.spine.radius**2

    def along(self, axis: Axis, open_above: bool = False) -> Cavity:
        """The same cavity seen from another axis; see `_spine_along`."""
        return _look(self.mesh, self.samples, _spine_along(axis, self.wall, open_above))


def _look(mesh: trimesh.Trimesh, samples: SurfaceSamples, spine: Spine) -> Cavity:
    rays = samples.points - spine.feet(samples.points)
    depth = np.fmax(np.linalg.norm(rays, axis=1), _NO_DEPTH)
    facing = -diagonal_dot(mesh.face_normals[samples.owners], rays) / depth
    # Every direction is a point of the capsule around the spine: no poles, no seam.
    capsule = samples.points + rays * (spine.radius / depth - 1.0)[:, None]
    # A cell's middle, not its corner, is on the axis.
    cell = number_cells(capsule - spine.axis.origin + 0.5 * samples.spacing, samples.spacing)
    front, back = facing > _GRAZING, facing < -_GRAZING
    first_front, first_back = (np.full(int(cell.max()) + 1, np.inf) for _ in range(2))
    np.minimum.at(first_front, cell[front], depth[front])
    np.minimum.at(first_back, cell[back], depth[back])
    any_seen = np.isfinite(np.fmin(first_front, first_back))
    return Cavity(
        mesh,
        samples,
        spine,
        facing=facing[: len(mesh.faces)],  # the first samples are the faces' centres
        seen=samples.majority(front & (depth <= first_back[cell] + samples.spacing)),
        hidden=samples.majority(back & (first_front[cell] < depth)),
        front_share=float((first_front < first_back).sum() / max(any_seen.sum(), 1)),
    )


def _find_cavity(name: str, mesh: trimesh.Trimesh) -> Cavity:
    if mesh.is_watertight and mesh.volume < 0.0:
        mesh = _flipped(mesh)
    samples = _spread_samples(mesh)
    likeliest = None
    for axis in _fit_axis(mesh).likely():
        cavity = _look(mesh, samples, _spine_along(axis, mesh))
        if cavity.front_share < _SOLID and not mesh.is_watertight:
            # An open surface may be wound either way.
            cavity = _look(_flipped(mesh), samples, cavity.spine)
        flat = np.linalg.norm(cavity.caps) >= _FLAT * cavity.wall.area  # or there is no wall
        if cavity.front_share <= _SOLID or flat:
            continue
        # Seen from the axis of its wall alone.
        cavity = cavity.along(_fit_axis(cavity.wall).near(cavity.spine.axis.direction))
        likeliest = likeliest or cavity
        # A shallow oval cup is nearly round about its long side, too; but both ends of that axis
        # are closed.
        if cavity.has_clear_end:
            return cavity
    if likeliest is None:
        raise ScanError(
            f"{name}: has no cavity, it is solid or flat",
            "scan the inside of the socket, or cut a closed model open at the brim",
        )
    return likeliest


def _flipped(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return plain_mesh(mesh.vertices, mesh.faces[:, ::-1])


_FACE_ON = 0.4  # [-]; cosine from which on a seen face needs no other witness
_OPPOSITE = -0.75  # [-]; cosine between the normals of the two sides of a wall
_NEAR = 1.5  # [-]; of the thickness: here the outer wall decides
_POCKET = 0.2  # [-]; of the seen area, for a piece in the shadow of the wall itself
_PROBES = 2000  # of the thickness


def _inner_wall(cavity: Cavity) -> BoolArray:
    """Faces of the inner wall, in one piece without holes of shadow, shape (F,)."""
    mesh, seen = cavity.mesh, cavity.seen
    face_on = seen & (cavity.facing > _FACE_ON)
    # What those seen face-on surround, in small pieces, is a pocket in the shadow of the wall.
    labels = _pieces(mesh, ~face_on)
    small = np.bincount(labels, mesh.area_faces) < _POCKET * float(mesh.area_faces @ seen)
    small[labels[boundary_half_edges(mesh.faces) // 3]] = False
    pockets = ~face_on & small[labels]
    outside = cavity.hidden & ~pockets
    if not outside.any():
        return _main_piece(mesh, np.ones(len(mesh.faces), bool))
    wall = _main_piece(mesh, _without_rims(cavity, face_on | pockets, outside))
    # So is what the wall surrounds and that holds nothing of the outside.
    labels = _pieces(mesh, ~wall)
    return wall | (np.bincount(labels, outside) == 0)[labels]


def _main_piece(mesh: trimesh.Trimesh, chosen: BoolArray) -> BoolArray:
    """The largest connected piece of the chosen faces, shape (F,)."""
    labels = _pieces(mesh, chosen)
    areas = np.bincount(labels, mesh.area_faces * chosen)
    return chosen & (labels == np.argmax(areas))


def _pieces(mesh: trimesh.Trimesh, chosen: BoolArray) -> IntArray:
    """Numbers of the pieces; every face that is not chosen is a piece of its own."""
    pairs = mesh.face_adjacency
    return connected_component_labels(pairs[chosen[pairs].all(axis=1)], node_count=len(chosen))


def _without_rims(cavity: Cavity, sure: BoolArray, outside: BoolArray) -> BoolArray:
    """The faces that belong to a wall, not to the rim of its brim or to a cut, shape (F,).

    A face of a rim has the outer wall beside it; a face of the inner wall has it behind, turned
    the other way, or far off. What is seen at a slant needs it behind.
    """
    mesh, samples = cavity.mesh, cavity.samples
    back = np.flatnonzero(outside[samples.owners])
    places, normals = samples.points[back], mesh.face_normals[samples.owners[back]]
    front = cKDTree(samples.points[sure[samples.owners]])
    thickness = float(np.median(front.query(places[:: max(1, len(back) // _PROBES)])[0]))

    faces = np.flatnonzero(cavity.seen | sure)
    centres, own = mesh.triangles_center[faces], mesh.face_normals[faces]
    near = cKDTree(places).query(centres, distance_upper_bound=_NEAR * thickness)[0] < np.inf
    # The part of the outer wall that suits a face best: a normal that is off counts as distance.
    turn = 2.0 * thickness
    suits = cKDTree(np.hstack([places, turn * normals]))
    partner = suits.query(np.hstack([centres, -turn * own]))[1]
    opposite = diagonal_dot(normals[partner], own) < _OPPOSITE
    kept = np.zeros(len(mesh.faces), bool)
    kept[faces] = np.where(near, opposite, sure[faces])
    return kept


_NARROWEST = 2.0  # [-]; around a brim, of the radius of the cavity
_WORTH_A_NOTE = 0.05  # [-]; area left out, of the area kept
_SKEW = 30.0  # [deg]; between a given direction and the axis, worth a note


@dataclass(frozen=True)
class Interior:
    """The interior of a socket, in the scan's axes."""

    # The inner wall with the inside of the distal end; its normals point into the cavity
    mesh: trimesh.Trimesh
    proximal: FloatArray  # unit vector from the distal end to the opening; (3,)
    length: float  # extent along it [m]
    girth: float  # around the axis, at the median distance of the wall from it [m]
    notes: tuple[str, ...]  # one plain line for every finding


def find_interior(mesh: trimesh.Trimesh, proximal: FloatArray | None = None) -> Interior:
    """Find the surface that a limb touches: of a shell the inner wall, or all of one surface.

    The faces that are seen from a spine within the cavity are the wall; those seen from behind,
    behind the wall, are the outside. Where there is an outside, what lies behind a face
    separates the wall from rims and cuts.

    The mesh is one body in metres, as `read_scan` gives it: its faces are wound alike. If the
    direction from the distal end to the brim, in the scan's axes, shape (3,), is not given, the
    more open end of the cavity is the proximal one.
    """
    name = str(mesh.metadata.get("file_name", "the scan"))
    given = None if proximal is None else proximal / np.linalg.norm(proximal)
    cavity = _find_cavity(name, mesh)
    decided, axis = cavity.has_clear_end, cavity.spine.axis
    towards = cavity.net_opening if decided or given is None else given @ axis.direction
    if not towards > 0.0:
        axis = replace(axis, direction=-axis.direction)
    cavity = cavity.along(axis, open_above=True)
    kept = _inner_wall(cavity)

    vertices, faces = separate(
        np.asarray(cavity.mesh.vertices), np.asarray(cavity.mesh.faces)[kept]
    )
    around = sorted((loop_length(vertices, loop) for loop in boundary_loops(faces)), reverse=True)
    if not around or around[0] < _NARROWEST * cavity.spine.radius:
        raise ScanError(
            f"{name}: the cavity is closed, no hole in it is as wide as a brim",
            "cut the scan open at the brim",
        )
    if not decided and given is None:
        raise ScanError(
            f"{name}: the two ends of the cavity are equally open, either may be proximal",
            "give --proximal, the direction to the brim",
        )
    interior = plain_mesh(vertices, faces)
    shown = ", ".join(f"{1e3 * length:.0f}" for length in around)
    notes = [
        *_notes_on_area(cavity, kept),
        f"openings: {len(around)}, the brim first, {shown} mm around",
    ]
    if given is not None:
        notes += _notes_on_direction(given, axis, decided)
    elif not _fit_axis(interior).is_sharp:
        notes.append("no axis of the cavity stands out: check the proximal direction or give it")
    upwards = axis.direction if given is None else given
    _, distance = axis.cylindrical(interior)
    return Interior(
        mesh=interior,
        proximal=upwards,
        length=float(np.ptp(vertices @ upwards)),
        girth=2.0 * np.pi * _weighted_median(distance, interior.area_faces),
        notes=tuple(notes),
    )


def _notes_on_area(cavity: Cavity, kept: BoolArray) -> list[str]:
    """What was kept, and what was left out although the cavity sees it."""
    areas = cavity.mesh.area_faces
    area, total, lost = areas[kept].sum(), areas.sum(), areas[cavity.seen & ~kept].sum()
    if kept.all():
        return [f"the scan is one surface: all of it is the interior, {1e4 * area:.0f} cm2"]
    notes = [
        f"kept the inner wall, {1e4 * area:.0f} of {1e4 * total:.0f} cm2: no outer wall, rim or cut"
    ]
    if lost >= _WORTH_A_NOTE * area:
        notes.append(
            f"left out {1e4 * lost:.0f} cm2 that are seen from the cavity but are no part of it"
        )
    return notes


def _notes_on_direction(given: FloatArray, axis: Axis, decided: bool) -> list[str]:
    angle = np.degrees(np.arccos(np.clip(given @ axis.direction, -1.0, 1.0)))
    if not decided:
        return ["the ends of the cavity are equally open: the given proximal direction decides"]
    if angle > 90.0:
        return [f"the given proximal direction points to the closed end, {angle:.0f} deg off"]
    if angle > _SKEW:
        return [f"the given proximal direction is {angle:.0f} deg off the axis of the cavity"]
    return []
