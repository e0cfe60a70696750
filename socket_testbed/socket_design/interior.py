"""The interior surface of a socket: its cavity, the faces visible from it, and its inner wall."""

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
    METRES,
    boundary_half_edges,
    boundary_loops,
    loop_length,
    number_cells,
    plain_mesh,
    separate,
)

_MIN_MISFIT = 1e-6  # [-]; smaller misfits are practically zero
_MAX_LIKELY_RATIO = 5.0  # [-]; relative to the best misfit, for an axis that cannot be ruled out
_MAX_ALIKE_RATIO = 1.3  # [-]; between misfits of equivalent axes and all axes between them


@dataclass(frozen=True)
class Axis:
    """A line in the frame of the surface.

    Attributes:
        origin: A point on the line, shape (3,) [m].
        direction: Unit vector along the line, shape (3,) [-].
    """

    origin: FloatArray
    direction: FloatArray

    def cylindrical(self, mesh: trimesh.Trimesh) -> tuple[FloatArray, FloatArray]:
        """Positions of the faces along the axis and distances from it, shape (F,) each [m].

        They are those of the centres of the mesh's F faces; positions count from the origin along
        the direction.
        """
        offset = mesh.triangles_center - self.origin
        along = offset @ self.direction
        return along, np.linalg.norm(offset - along[:, None] * self.direction, axis=1)


@dataclass(frozen=True)
class AxisFit:
    """How well a surface is one of revolution about axes of any direction.

    Attributes:
        middle: Centroid of the surface, shape (3,) [m].
        moment: Matrix that maps an axis's direction to its best moment about the middle, shape
            (3, 3) [m].
        misfits: Mean square misfits of the principal directions, ascending, shape (3,) [-]; 0 for a
            surface of revolution.
        directions: The principal directions, a unit vector per row, shape (3, 3) [-].
    """

    middle: FloatArray
    moment: FloatArray
    misfits: FloatArray
    directions: FloatArray

    def likely(self) -> list[Axis]:
        """The best axis, and those at right angles to it that cannot be ruled out."""
        limit = _MAX_LIKELY_RATIO * max(float(self.misfits[0]), _MIN_MISFIT)
        return [self._along(direction) for direction in self.directions[self.misfits <= limit]]

    def near(self, direction: FloatArray) -> Axis:
        """The principal axis near a direction, or that direction if many fit equally well.

        The direction, shape (3,) [-], may have any length; the axis points to its side.
        """
        best = int(np.abs(self.directions @ direction).argmax())
        ratio = np.fmax(self.misfits, _MIN_MISFIT) / max(float(self.misfits[best]), _MIN_MISFIT)
        equivalent = self.directions[np.abs(np.log(ratio)) < np.log(_MAX_ALIKE_RATIO)]
        towards = equivalent.T @ (equivalent @ direction)
        return self._along(towards / np.linalg.norm(towards))

    @property
    def is_sharp(self) -> bool:
        """Whether the best axis stands out."""
        return float(self.misfits[1]) > _MAX_ALIKE_RATIO * max(float(self.misfits[0]), _MIN_MISFIT)

    def _along(self, direction: FloatArray) -> Axis:
        return Axis(self.middle + np.cross(direction, self.moment @ direction), direction)


def _fit_axis(mesh: trimesh.Trimesh) -> AxisFit:
    """Fit an axis of revolution to a surface.

    A rotation about the direction c with the moment m moves the point p by c x p + m. A surface of
    revolution slides in itself, so ``n . (c x p + m) = 0`` there; this is solved by least squares
    for |c| = 1 (Pottmann and Randrup 1998, Computing 60, 307-322). Neither the sign of the normals
    nor a missing part of the circumference matters.
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


_MAX_END_RADIUS = 0.45  # [-]; of the length
_MIN_WALL_DISTANCE = 0.5  # [-]; of the radius; nearer faces belong to a bore


@dataclass(frozen=True)
class Spine:
    """A segment along the cavity: interior points look sideways at the wall, its ends beyond.

    Attributes:
        axis: The line of the segment.
        low: Position of its start, from the axis's origin along its direction [m].
        high: Position of its end, from the axis's origin along its direction [m]; infinite if it
            has none.
        radius: Typical distance of the walls from it [m].
    """

    axis: Axis
    low: float
    high: float
    radius: float

    def feet(self, points: FloatArray) -> FloatArray:
        """The nearest points of the segment, from which points are seen, shape (N, 3) each [m]."""
        along = np.clip((points - self.axis.origin) @ self.axis.direction, self.low, self.high)
        return self.axis.origin + along[:, None] * self.axis.direction


def _spine_along(axis: Axis, wall: trimesh.Trimesh, open_above: bool = False) -> Spine:
    """Lay the segment so that it ends one radius before the ends of a wall.

    Faces much closer to the axis than the wall are ignored: a bore in the distal end would extend
    the segment too far down to see the floor around it.
    """
    along, distance = axis.cylindrical(wall)
    radius = _weighted_median(distance, wall.area_faces)
    wide = along[distance >= _MIN_WALL_DISTANCE * radius]
    low, high = float(wide.min()), float(wide.max())
    radius = min(radius, _MAX_END_RADIUS * (high - low))
    return Spine(axis, low + radius, np.inf if open_above else high - radius, radius)


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


_FINENESS = 100  # spacings along a square with the surface's area
_PER_SQUARE = 10  # average samples per square of the spacing
_MIN_DEPTH = 1e-9  # [m]; defines a direction even for points on the spine
_GRAZING = 0.2  # [-]; cosine below which a face is seen from neither side


@dataclass(frozen=True)
class SurfaceSamples:
    """Points on the faces of a surface; every face has one or more.

    Attributes:
        owners: Index of the face of each point, shape (P,).
        points: The points in the frame of the surface, shape (P, 3) [m].
        spacing: Approximate largest distance between neighbours [m].
    """

    owners: IntArray
    points: FloatArray
    spacing: float

    def majority(self, votes: BoolArray) -> BoolArray:
        """Faces, shape (F,), with votes, shape (P,), from more than half of their points."""
        return 2 * np.bincount(self.owners, votes) > np.bincount(self.owners)


_MIN_FRONT_SHARE = 0.5  # [-]; smallest front share of a cavity
_FLAT_RATIO = 0.95  # [-]; area of the caps over that of the wall, for a flat one
_MIN_OPENING = 0.1  # [-]; net opening over a cross-section of the cavity


@dataclass(frozen=True)
class Cavity:
    """A surface with normals into the cavity, and the visibility of its faces from the spine.

    Attributes:
        mesh: The surface with F faces, in the scan's frame [m].
        samples: Points on all of its faces.
        spine: The segment in the cavity from which faces are seen.
        facing: Cosine between each face's normal and the direction from its centre to the spine,
            shape (F,) [-].
        seen: Which faces are seen from the front, with nothing before them, shape (F,).
        hidden: Which faces are seen from the back, behind the front of another, shape (F,).
        front_share: Share of the non-empty directions that first hit a front [-].
    """

    mesh: trimesh.Trimesh
    samples: SurfaceSamples
    spine: Spine
    facing: FloatArray
    seen: BoolArray
    hidden: BoolArray
    front_share: float

    @cached_property
    def wall(self) -> trimesh.Trimesh:
        """The largest connected piece of seen faces."""
        return plain_mesh(self.mesh.vertices, self.mesh.faces[_main_piece(self.mesh, self.seen)])

    @cached_property
    def caps(self) -> FloatArray:
        """Outward area vector of the caps that would close the wall, shape (3,) [m^2].

        The area vectors of a closed surface sum to zero, so the wall's inward area vectors sum to
        that of its caps.
        """
        return np.asarray(0.5 * self.wall.triangles_cross.sum(axis=0))

    @property
    def net_opening(self) -> float:
        """Net area of the openings along the spine [m^2].

        Openings at the spine's start count as negative; those at its side do not count.
        """
        return float(self.caps @ self.spine.axis.direction)

    @property
    def has_clear_end(self) -> bool:
        """Whether one of its ends is clearly more open than the other."""
        return abs(self.net_opening) > _MIN_OPENING * np.pi * self.spine.radius**2

    def along(self, axis: Axis, open_above: bool = False) -> Cavity:
        """The same cavity seen from a segment of another axis.

        Args:
            axis: The axis in the frame of the mesh; the segment ends one radius before either end
                of the wall.
            open_above: Whether the segment has no end in the axis's direction, so that a face near
                the opening is seen sideways.
        """
        return _view(self.mesh, self.samples, _spine_along(axis, self.wall, open_above))


def _view(mesh: trimesh.Trimesh, samples: SurfaceSamples, spine: Spine) -> Cavity:
    rays = samples.points - spine.feet(samples.points)
    depth = np.fmax(np.linalg.norm(rays, axis=1), _MIN_DEPTH)
    facing = -diagonal_dot(mesh.face_normals[samples.owners], rays) / depth
    # A direction is a point on the capsule around the spine, which has no poles and no seam.
    capsule = samples.points + rays * (spine.radius / depth - 1.0)[:, None]
    # Centre a cell, not a corner, on the axis.
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
    points, owners = trimesh.sample.sample_surface(mesh, _PER_SQUARE * _FINENESS**2, seed=0)
    samples = SurfaceSamples(
        np.concatenate([np.arange(len(mesh.faces)), owners]),
        np.concatenate([mesh.triangles_center, points]),  # each face has a vote
        spacing=float(np.sqrt(mesh.area)) / _FINENESS,
    )
    likeliest = None
    for axis in _fit_axis(mesh).likely():
        cavity = _view(mesh, samples, _spine_along(axis, mesh))
        if cavity.front_share < _MIN_FRONT_SHARE and not mesh.is_watertight:
            # An open surface may have either winding.
            cavity = _view(_flipped(mesh), samples, cavity.spine)
        flat = np.linalg.norm(cavity.caps) >= _FLAT_RATIO * cavity.wall.area  # true without a wall
        if cavity.front_share <= _MIN_FRONT_SHARE or flat:
            continue
        # Repeat from the axis of the wall alone.
        cavity = cavity.along(_fit_axis(cavity.wall).near(cavity.spine.axis.direction))
        likeliest = likeliest or cavity
        # A shallow oval cup is also nearly round about its long axis, but closed at both ends of
        # that axis.
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


_FACE_ON = 0.4  # [-]; cosine above which a seen face surely belongs to the wall
_OPPOSITE = -0.75  # [-]; cosine between the normals of the two sides of a wall
_MAX_NEAR = 1.5  # [-]; of the thickness, for the outer wall to decide
_MAX_POCKET = 0.2  # [-]; of the seen area
_PROBES = 2000  # of the thickness


def _inner_wall(cavity: Cavity) -> BoolArray:
    """Faces of the inner wall, in one piece without shadow holes, shape (F,)."""
    mesh, seen = cavity.mesh, cavity.seen
    face_on = seen & (cavity.facing > _FACE_ON)
    # Small pieces enclosed by face-on faces are pockets in the shadow of the wall.
    labels = _pieces(mesh, ~face_on)
    small = np.bincount(labels, mesh.area_faces) < _MAX_POCKET * float(mesh.area_faces @ seen)
    small[labels[boundary_half_edges(mesh.faces) // 3]] = False
    pockets = ~face_on & small[labels]
    outside = cavity.hidden & ~pockets
    if not outside.any():
        return _main_piece(mesh, np.ones(len(mesh.faces), bool))
    wall = _main_piece(mesh, _without_rims(cavity, face_on | pockets, outside))
    # Pieces enclosed by the wall without any outside face belong to it.
    labels = _pieces(mesh, ~wall)
    return wall | (np.bincount(labels, outside) == 0)[labels]


def _main_piece(mesh: trimesh.Trimesh, chosen: BoolArray) -> BoolArray:
    """The largest connected piece of the chosen faces, shape (F,)."""
    labels = _pieces(mesh, chosen)
    areas = np.bincount(labels, mesh.area_faces * chosen)
    return chosen & (labels == np.argmax(areas))


def _pieces(mesh: trimesh.Trimesh, chosen: BoolArray) -> IntArray:
    """Labels of connected pieces; every other face is a piece of its own, shape (F,)."""
    pairs = mesh.face_adjacency
    return connected_component_labels(pairs[chosen[pairs].all(axis=1)], node_count=len(chosen))


def _without_rims(cavity: Cavity, sure: BoolArray, outside: BoolArray) -> BoolArray:
    """Faces of a wall, without the rim of its brim and cuts, shape (F,).

    A face of a rim has the outer wall next to it; a face of the inner wall has it behind, facing
    the opposite way, or far off. Faces seen at a slant must have it behind.
    """
    mesh, samples = cavity.mesh, cavity.samples
    back = np.flatnonzero(outside[samples.owners])
    places, normals = samples.points[back], mesh.face_normals[samples.owners[back]]
    front = cKDTree(samples.points[sure[samples.owners]])
    thickness = float(np.median(front.query(places[:: max(1, len(back) // _PROBES)])[0]))

    faces = np.flatnonzero(cavity.seen | sure)
    centres, own = mesh.triangles_center[faces], mesh.face_normals[faces]
    near = cKDTree(places).query(centres, distance_upper_bound=_MAX_NEAR * thickness)[0] < np.inf
    # The best matching part of the outer wall: a deviating normal counts as distance.
    turn = 2.0 * thickness
    suits = cKDTree(np.hstack([places, turn * normals]))
    partner = suits.query(np.hstack([centres, -turn * own]))[1]
    opposite = diagonal_dot(normals[partner], own) < _OPPOSITE
    kept = np.zeros(len(mesh.faces), bool)
    kept[faces] = np.where(near, opposite, sure[faces])
    return kept


_MIN_BRIM = 2.0  # [-]; circumference of a brim over the radius of the cavity
_NOTED_AREA = 0.05  # [-]; area left out over the area kept
_NOTED_ANGLE = 30.0  # [deg]; between a given direction and the axis


@dataclass(frozen=True)
class Interior:
    """The interior of a socket, in the scan's axes.

    Attributes:
        mesh: The inner wall including the distal end [m]; its normals point into the cavity.
        proximal: Unit vector from the distal end to the opening, shape (3,) [-].
        length: Extent of the interior along `proximal` [m].
        girth: Circumference at the median distance of the wall from the axis [m].
        notes: Remarks for the user, one line per finding.
    """

    mesh: trimesh.Trimesh
    proximal: FloatArray
    length: float
    girth: float
    notes: tuple[str, ...]


def find_interior(mesh: trimesh.Trimesh, proximal: FloatArray | None = None) -> Interior:
    """Find the surface that a limb touches: the inner wall of a shell, or all of a single surface.

    Faces seen from a spine within the cavity are the wall; faces seen from the back, behind the
    wall, are the outside. If there is an outside, the faces behind it tell the wall from rims and
    cuts.

    Args:
        mesh: One body in metres with consistent winding, as `read_scan` returns it.
        proximal: Direction from the distal end to the brim in the scan's axes, of any length, shape
            (3,) [-]; None: the more open end of the cavity is proximal.

    Raises:
        ScanError: If there is no cavity, it has no brim, or both ends are equally open and no
            direction is given.
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

    vertices, faces = separate(cavity.mesh.vertices, cavity.mesh.faces[kept])
    around = sorted((loop_length(vertices, loop) for loop in boundary_loops(faces)), reverse=True)
    if not around or around[0] < _MIN_BRIM * cavity.spine.radius:
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
        notes.append("no axis of the cavity is clear: check the proximal direction or give it")
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
    """Notes on the kept area, and on visible faces that were left out."""
    areas = cavity.mesh.area_faces
    area, total, lost = areas[kept].sum(), areas.sum(), areas[cavity.seen & ~kept].sum()
    if kept.all():
        return [f"the scan is one surface: all of it is the interior, {1e4 * area:.0f} cm2"]
    notes = [
        f"kept the inner wall, {1e4 * area:.0f} of {1e4 * total:.0f} cm2: no outer wall, rim or cut"
    ]
    if lost >= _NOTED_AREA * area:
        notes.append(
            f"left out {1e4 * lost:.0f} cm2 that are seen from the cavity but do not belong to it"
        )
    return notes


def _notes_on_direction(given: FloatArray, axis: Axis, decided: bool) -> list[str]:
    angle = np.degrees(np.arccos(np.clip(given @ axis.direction, -1.0, 1.0)))
    if not decided:
        return ["the ends of the cavity are equally open: the given proximal direction decides"]
    if angle > 90.0:
        return [f"the given proximal direction points to the closed end, {angle:.0f} deg off"]
    if angle > _NOTED_ANGLE:
        return [f"the given proximal direction is {angle:.0f} deg off the axis of the cavity"]
    return []


_LENGTH = (0.04, 0.7)  # [m]; of the cavity of a socket along its axis
_GIRTH = (0.12, 0.85)  # [m]; of its wall


def refuse_implausible(name: str, length: float, girth: float, unit: str) -> None:
    """Refuse a cavity that is too small or too large for a socket.

    Args:
        name: Start of the error, such as the file.
        length: Extent of the cavity along its axis [m].
        girth: Circumference of its wall [m].
        unit: Unit of the file with which these were found, a key of `METRES`.

    Raises:
        ScanError: If the sizes fit no socket; the hint names a unit with which they would.
    """

    def plausible(scale: float) -> bool:
        sizes = ((length, _LENGTH), (girth, _GIRTH))
        return all(low <= scale * size <= high for size, (low, high) in sizes)

    if plausible(1.0):
        return
    likely = [other for other, metres in METRES.items() if plausible(metres / METRES[unit])]
    hint = "no unit makes it one: export the model in its real size"
    if likely:
        hint = f"its unit is likely {' or '.join(likely)}: give --unit {likely[0]}"
    raise ScanError(
        f"{name}: in {unit} its cavity is {length:.3g} m long and {girth:.3g} m around, which fits"
        f" no socket ({_LENGTH[0]:g} to {_LENGTH[1]:g} m and {_GIRTH[0]:g} to {_GIRTH[1]:g} m)",
        hint,
    )
