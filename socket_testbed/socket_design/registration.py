"""The socket's body in {S} and the limb in the pylon's body, from a static take.

The default frame of a body has its origin at the first marker, x towards the second, z along the
normal of their plane with the third, ``z ~ x x (m3 - m1)``, and y = z x x. With more than three
markers, the one farthest from x replaces the third.

On each side, socket and limb, the body's permanent markers and the landmarks, known in the frame
of interest, are rigid to each other. The markers give world <- body, the landmarks world <- frame;
together they give frame <- body. The take itself defines the body's frame, so its uncertainty is
that of later poses found from the markers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from socket_testbed.arrays import BoolArray, FloatArray, IntArray, rms
from socket_testbed.documents import Document, FieldError, Text, read_document
from socket_testbed.errors import ConfigurationError, RegistrationError, naming
from socket_testbed.geometry.marker_bodies import (
    MAX_MARKERS,
    MIN_MARKERS,
    BodyFit,
    PoseUncertainty,
    body_fault,
    distances,
    fit_body,
    fit_rigid,
    misfit,
    pose_uncertainty,
)
from socket_testbed.geometry.pose import Point, Pose
from socket_testbed.geometry.regions import socket_axis
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.socket_design.motive import MotiveTake

_MIN_LANDMARKS = 3
_TOO_FEW = f"give {_MIN_LANDMARKS} or more that are not on one line"
_Names = Annotated[list[Text], Meta(min_length=MIN_MARKERS, max_length=MAX_MARKERS)]


class _RigidBody(Document):
    rigid_body: Text


class _Bodies(Document):
    socket: _RigidBody | _Names
    pylon: _RigidBody | _Names

    def __post_init__(self) -> None:
        for body, names in (("socket", self.socket), ("pylon", self.pylon)):
            if isinstance(names, list) and len({*map(str, names)}) < len(names):
                raise FieldError(f"{body} names a marker twice", "name each marker once")


class _LandmarkFile(Document):
    bodies: _Bodies
    load_cell: dict[str, Point]
    limb: dict[str, Point]

    def __post_init__(self) -> None:
        for frame, known in (("load_cell", self.load_cell), ("limb", self.limb)):
            if len(known) < _MIN_LANDMARKS:
                raise FieldError(f"{frame}: {len(known)} landmarks hold no frame", _TOO_FEW)


@dataclass(frozen=True)
class LandmarkSide:
    """A marker body and the landmarks that are rigid to it.

    Attributes:
        body: The body, `socket` or `pylon`.
        markers: Names of its three to eight markers, or the name of a rigid body of Motive.
        frame: Frame of the landmarks' coordinates: `load_cell`, which is {S}, or `limb`.
        where: Start of errors about the landmarks: file and frame.
        names: Names of the k landmarks in the take.
        known: Coordinates of the landmarks in `frame`, shape (k, 3) [m].
    """

    body: str
    markers: str | tuple[str, ...]
    frame: str
    where: str
    names: tuple[str, ...]
    known: FloatArray


def read_landmarks(path: Path) -> tuple[LandmarkSide, LandmarkSide]:
    """Read LANDMARKS.yaml: the sides of the socket and the limb.

    Raises:
        ConfigurationError: If a marker or landmark is on both sides, or the file is not as in
            `socket-testbed register --help`.
    """
    document = read_document(path, _LandmarkFile)
    sides, named = [], list[set[str]]()
    for body, frame in (("socket", "load_cell"), ("pylon", "limb")):
        given, landmarks = getattr(document.bodies, body), getattr(document, frame)
        markers = [given.rigid_body] if isinstance(given, _RigidBody) else given
        words = tuple(map(str, markers))
        known = np.array([*landmarks.values()])
        labels = words[0] if isinstance(given, _RigidBody) else words
        sides.append(LandmarkSide(body, labels, frame, f"{path}: {frame}", tuple(landmarks), known))
        named.append({*words, *landmarks})
    # The socket and the limb move relative to each other: no marker is on both.
    for name in sorted(named[0] & named[1]):
        raise ConfigurationError(
            f"{path}: '{name}' is on the socket's side and on the limb's",
            "name each marker on one side",
        )
    return sides[0], sides[1]


_MIN_THICKNESS = 0.001  # [m]; mirrored landmarks have twice this residual
_MIN_SPREAD = 0.005  # [m]; between landmarks, and of landmarks from a line, for a rotation


@dataclass(frozen=True)
class LandmarkFit:
    """A frame registered by k landmarks.

    Attributes:
        names: Names of the landmarks.
        pose: Pose of the registered frame in the frame of the measurement, such as `world`.
        residual: Distance of each measured landmark from the fitted one, shape (k,) [m].
        noise: 1-sigma error of a landmark's coordinate [m].
        degrees: Degrees of freedom of the residual, 3k - 6.
        uncertainty: 1-sigma uncertainty of the pose, in axes of the registered frame.
        flat: Whether the landmarks are coplanar, so that a coordinate's wrong sign has no residual.
    """

    names: tuple[str, ...]
    pose: Pose
    residual: FloatArray
    noise: float
    degrees: int
    uncertainty: PoseUncertainty
    flat: bool

    @property
    def rms(self) -> float:
        """Root-mean-square residual [m]."""
        return rms(self.residual)


def register_landmarks(
    known: FloatArray, measured: FloatArray, names: Sequence[str], noise: float = 0.0
) -> LandmarkFit:
    """Least-squares pose of a frame from known landmarks, measured in another frame.

    The uncertainty is of first order (`pose_uncertainty`). Sigma comes from the residuals,
    ``sigma^2 = sum(residual^2) / (3k - 6)``, but is at least the noise: few landmarks may fit
    better than their accuracy by chance (three leave 3 degrees of freedom). Residuals cannot show
    an error common to all landmarks, such as a wrong origin of the registered frame.

    Args:
        known: Coordinates of the k landmarks in the frame to register, shape (k, 3) [m].
        measured: Coordinates of the landmarks in the frame of the measurement, shape (k, 3) [m].
        names: Names of the landmarks.
        noise: Smallest 1-sigma error of a coordinate [m].

    Raises:
        RegistrationError: If there are fewer than three landmarks, two of them are too close to
            each other, or all are on one line.
    """
    if len(names) < _MIN_LANDMARKS:
        named = ", ".join(names) or "none"
        raise RegistrationError(f"{len(names)} landmarks ({named}) hold no frame", _TOO_FEW)
    _require_spread(known, names, "are given")
    _require_spread(measured, names, "were measured")

    pose = fit_rigid(known, measured)
    residual = misfit(known, measured, pose)
    degrees = 3 * len(names) - 6
    sigma = max(float(np.sqrt((residual**2).sum() / degrees)), noise)
    return LandmarkFit(
        names=tuple(names),
        pose=pose,
        residual=residual,
        noise=sigma,
        degrees=degrees,
        uncertainty=pose_uncertainty(known, sigma),
        flat=float(_extents(known)[2]) < _MIN_THICKNESS,
    )


def _require_spread(points: FloatArray, names: Sequence[str], how: str) -> None:
    for (name, point), (other, neighbour) in combinations(zip(names, points, strict=True), 2):
        apart = float(np.linalg.norm(point - neighbour))
        if apart < _MIN_SPREAD:
            raise RegistrationError(
                f"landmarks {name} and {other} {how} {1e3 * apart:.1f} mm apart",
                "give landmarks far from each other",
            )
    off_line = float(np.hypot(*_extents(points)[1:]))
    if off_line < _MIN_SPREAD:
        raise RegistrationError(
            f"landmarks {', '.join(names)} {how} on one line (within {1e3 * off_line:.1f} mm)",
            "move one of them away from the line of the others",
        )


def _extents(points: FloatArray) -> FloatArray:
    """Root-mean-square extents along the principal axes, the longest first, shape (3,) [m]."""
    stretch = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return np.asarray(stretch / np.sqrt(len(points)))


NOTED_DRIFT = 0.0002  # [m]
NOTED_SPREAD = 0.0004  # [m]; well above the noise of a marker
MAX_MOTION = 0.001  # [m]; for either
_MAX_JUMP = 0.005  # [m]; a larger offset of a marker is a wrong label or a reflection
_MAX_JUMP_SHARE = 0.1  # of the frames; with more, the body moved
_MIN_FRAMES = 20
_BLOCKS = 10


@dataclass(frozen=True)
class StillMarkers:
    """Markers of a static take, averaged over the frames that show all of them.

    Attributes:
        names: Names of the k markers.
        mean: Mean positions in `world`, shape (k, 3) [m].
        spread: Root-mean-square distance of each marker from its mean, shape (k,) [m].
        drift: Distance between each marker's means over the first and the last third of the
            averaged frames, shape (k,) [m].
        noise: 1-sigma error of a mean's coordinate, pooled over the markers [m]; from means over
            blocks of frames, to include slow motion and correlated noise.
        used: Which of the N frames were averaged, shape (N,).
        occluded: Number of frames in which each marker is occluded, shape (k,).
        mislabelled: Number of frames left out because no order of the labels fits.
        jumped: Number of frames left out because a marker is far from its usual place.
        notes: Markers that moved beyond noise but within the limit, in words.
    """

    names: tuple[str, ...]
    mean: FloatArray
    spread: FloatArray
    drift: FloatArray
    noise: float
    used: BoolArray
    occluded: IntArray
    mislabelled: int
    jumped: int
    notes: tuple[str, ...]


def average_still(
    names: Sequence[str], positions: FloatArray, fits: BoolArray, where: str
) -> StillMarkers:
    """Average k stationary markers over a take of N frames.

    Args:
        names: Names of the markers.
        positions: Their positions in `world`, shape (N, k, 3) [m]; NaN if occluded.
        fits: Frames in which the body's markers fit in some order of their labels, shape (N,).
        where: Start of every error, such as the file and the body.

    Raises:
        RegistrationError: If too few frames show all markers, a marker jumps in many of them, or it
            moves by more than `MAX_MOTION`.
    """
    occluded = np.isnan(positions).any(axis=2).sum(axis=0)
    seen = np.isfinite(positions).all(axis=(1, 2))
    candidates = seen & fits
    count, mislabelled = int(candidates.sum()), int((seen & ~fits).sum())
    if count < _MIN_FRAMES:
        worst = int(occluded.argmax())
        raise RegistrationError(
            f"{where}: {count} of {len(positions)} frames show all of {', '.join(names)}"
            f" ({names[worst]} is occluded in {int(occluded[worst])}, the distances are not the"
            f" usual ones in {mislabelled})",
            f"record {_MIN_FRAMES} frames or more in which the cameras see them all",
        )
    usual = np.median(positions[candidates], axis=0)
    far = np.linalg.norm(positions - usual, axis=2) > _MAX_JUMP  # False where occluded
    used = candidates & ~far.any(axis=1)
    jumped = count - int(used.sum())
    if jumped > _MAX_JUMP_SHARE * count:
        worst = int(far[candidates].sum(axis=0).argmax())
        raise RegistrationError(
            f"{where}: in {jumped} of {count} frames a marker, mostly {names[worst]}, is more than"
            f" {1e3 * _MAX_JUMP:g} mm from its usual place",
            "record a take in which nothing moves, and check its labels",
        )
    positions = positions[used]
    mean, third = positions.mean(axis=0), len(positions) // 3
    spread = np.sqrt(((positions - mean) ** 2).sum(axis=2).mean(axis=0))
    moved = positions[-third:].mean(axis=0) - positions[:third].mean(axis=0)
    drift = np.linalg.norm(moved, axis=1)
    blocks = np.array([block.mean(axis=0) for block in np.array_split(positions, _BLOCKS)])
    notes = []
    for verb, motion, noted in (
        ("drifted", drift, NOTED_DRIFT),
        ("moved about", spread, NOTED_SPREAD),
    ):
        words = [
            f"{name} {verb} by {1e3 * way:.2f} mm over the take"
            for name, way in zip(names, motion, strict=True)
        ]
        if motion.max() > MAX_MOTION:
            raise RegistrationError(
                f"{where}: {words[int(motion.argmax())]} (at most {1e3 * MAX_MOTION:g} mm)",
                "record a take in which nothing moves, or export its still part",
            )
        notes += [words[marker] for marker in np.flatnonzero(motion > noted)]
    return StillMarkers(
        names=tuple(names),
        mean=mean,
        spread=spread,
        drift=drift,
        noise=float(np.sqrt(blocks.var(axis=0, ddof=1).mean() / _BLOCKS)),
        used=used,
        occluded=occluded,
        mislabelled=mislabelled,
        jumped=jumped,
        notes=tuple(notes),
    )


def own_frame(markers: FloatArray) -> Pose:
    """Pose of a body's default frame (see the module) in the frame of its markers.

    The k >= 3 markers have the shape (k, 3) [m]: the first is the origin, the second is on +x.
    """
    x = (markers[1] - markers[0]) / np.linalg.norm(markers[1] - markers[0])
    normals = np.cross(x, markers - markers[0])
    lengths = np.linalg.norm(normals, axis=1)
    z = normals[lengths.argmax()] / lengths.max()
    return Pose(np.column_stack([x, np.cross(z, x), z]), markers[0])


def fit_labels(observed: FloatArray, where: str) -> BodyFit:
    """Identify the observed markers by the distances that most frames agree on.

    Labels swapped in fewer than half of the frames are corrected: `BodyFit.order`.

    Args:
        observed: The body's k markers in `world` in N frames, shape (N, k, 3) [m]; NaN if occluded.
        where: Start of every error, such as the file and the body.

    Returns:
        The fit to the markers' own mean shape. Its poses are of an arbitrary frame of the body; its
        order, residual and noise do not depend on that frame.

    Raises:
        RegistrationError: If no frame shows all markers, or they are too close to each other, on
            one line or look alike with labels exchanged.
    """
    between = distances(observed)
    seen = np.isfinite(between).all(axis=(1, 2))
    if not seen.any():
        raise RegistrationError(
            f"{where}: no frame shows all {observed.shape[1]} markers",
            "check their labels in Motive",
        )
    usual = np.median(between[seen], axis=0)
    # The frame nearest to the median has no swapped labels.
    nearest = int(np.abs(between[seen] - usual).max(axis=(1, 2)).argmin())
    reference = observed[seen][nearest]
    fault = body_fault(reference)
    if fault:
        raise RegistrationError(f"{where}: {fault[0]}", fault[1])
    fit = fit_body(reference, observed)
    arms = relabel(observed, fit.order) - fit.pose.translation[:, None]
    in_body = arms @ fit.pose.rotation
    return fit_body(in_body[(fit.order >= 0).all(axis=1)].mean(axis=0), observed)


def relabel(observed: FloatArray, order: IntArray) -> FloatArray:
    """Markers in the order found by a fit, shape (N, k, 3) [m].

    Args:
        observed: Markers in the order of their labels, shape (N, k, 3) [m]; NaN if occluded.
        order: `BodyFit.order`, shape (N, k); frames in which it lacks a marker (-1) stay unchanged.
    """
    known = np.where((order < 0).any(axis=1, keepdims=True), np.arange(order.shape[1]), order)
    return np.take_along_axis(observed, known[:, :, None], axis=1)


def tracked_frame(markers: FloatArray, body: Pose, where: str) -> Pose:
    """Pose of the tracked frame of a body that was stationary over N frames.

    The median of the markers in the tracked frame is robust to frames with wrong tracking; it is
    fitted to the mean of the markers.

    Args:
        markers: The body's markers in `world`, none occluded, shape (N, k, 3) [m].
        body: N poses of the rigid body in `world` as tracked by Motive; NaN if not tracked.
        where: Start of the error, such as the file and the body.

    Returns:
        One pose of the body in `world`.

    Raises:
        RegistrationError: If Motive tracked the body in fewer than half of the frames.
    """
    tracked = np.isfinite(body.rotation).all(axis=(1, 2)) & np.isfinite(body.translation).all(1)
    if 2 * tracked.sum() < len(markers):
        raise RegistrationError(
            f"{where}: Motive tracked its rigid body in {int(tracked.sum())} of {len(markers)}"
            " frames that show its markers",
            "name its markers instead of 'rigid_body'",
        )
    arms = markers[tracked] - body.translation[tracked, None]
    in_body = np.median(arms @ body.rotation[tracked], axis=0)
    return fit_rigid(in_body, markers.mean(axis=0))


NOTED_RESIDUAL = 0.002  # [m]
MAX_RESIDUAL = 0.010  # [m]


def _rotated(covariance: FloatArray, rotation: FloatArray) -> FloatArray:
    """A covariance in the axes to which a rotation maps, shape (3, 3) each."""
    return rotation @ covariance @ rotation.T


@dataclass(frozen=True)
class RegisteredBody:
    """A marker body and the frame given by the landmarks rigid to it.

    Attributes:
        still: Markers in the take: the body's own, then the landmarks.
        markers: The body's own markers in the body's frame, shape (k, 3) [m].
        in_frame: Pose of the body in the landmarks' frame: {S} for the socket, the limb's frame for
            the pylon.
        landmarks: Fit of the landmarks: pose of their frame in `world`.
        reference: Uncertainty of later poses of the body due to errors of `markers`, in axes of the
            landmarks' frame.
        single: Uncertainty of later poses of the body due to the markers' noise in a single frame,
            in axes of the landmarks' frame.
    """

    still: StillMarkers
    markers: FloatArray
    in_frame: Pose
    landmarks: LandmarkFit
    reference: PoseUncertainty
    single: PoseUncertainty

    def covariance_at(self, point: FloatArray) -> FloatArray:
        """Covariance of a point between body and landmarks' frame, shape (3, 3) [m^2].

        The point, shape (3,) [m], and its covariance are in the landmarks' frame.
        """
        return self.landmarks.uncertainty.at(point) + self.reference.at(point)

    def rotation_covariance(self) -> FloatArray:
        """Covariance of the rotation between body and landmarks' frame, shape (3, 3) [rad^2].

        It is in the axes of the landmarks' frame.
        """
        return self.landmarks.uncertainty.rotation + self.reference.rotation


@dataclass(frozen=True)
class Registration:
    """A socket registered with a static take.

    Attributes:
        take: The take.
        geometry: The socket with its new marker bodies, `socket_body` and `limb`.
        socket: The socket's marker body and {S}.
        pylon: The pylon's marker body and the limb's frame.
        limb_position: Limb position q in {S} during the take, shape (3,) [m].
        covariance: Covariance of a limb position due to the registration, in {S}, shape (3, 3)
            [m^2]; this error is common to all frames of a trial.
        single: Additional covariance of the limb position in each single frame due to the markers'
            noise, in {S}, shape (3, 3) [m^2].
        notes: Remarks for the user.
    """

    take: MotiveTake
    geometry: SocketGeometry
    socket: RegisteredBody
    pylon: RegisteredBody
    limb_position: FloatArray
    covariance: FloatArray
    single: FloatArray
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        fits = (self.socket.landmarks, self.pylon.landmarks)
        residuals = " and ".join(f"{1e3 * fit.rms:.2f}" for fit in fits)
        return f"Registration({self.take.path}: {len(self.take)} frames; {residuals} mm rms)"

    def socket_body_covariances(self) -> tuple[FloatArray, FloatArray]:
        """Covariances of the pose `geometry.socket_body`, in {S}.

        Returns:
            That of its position, shape (3, 3) [m^2], and of its rotation, shape (3, 3) [rad^2].
        """
        position = self.socket.covariance_at(self.geometry.socket_body.translation)
        return position, self.socket.rotation_covariance()

    def limb_covariances(self) -> tuple[FloatArray, FloatArray]:
        """Covariances of the pose `geometry.limb`, in the pylon's marker body.

        Returns:
            That of its position, shape (3, 3) [m^2], and of its rotation, shape (3, 3) [rad^2].
        """
        to_body = self.geometry.limb.rotation
        position = self.pylon.covariance_at(np.zeros(3))
        return _rotated(position, to_body), _rotated(self.pylon.rotation_covariance(), to_body)


def register_take(
    take: MotiveTake,
    sides: tuple[LandmarkSide, LandmarkSide],
    geometry: SocketGeometry,
    force: bool = False,
) -> Registration:
    """Register a socket's marker bodies and its limb with a static take that shows all landmarks.

    The socket's tiles are kept.

    Args:
        take: The take.
        sides: Markers and landmarks of the socket and of the limb, as `read_landmarks` returns
            them.
        geometry: The socket in {S}.
        force: Whether to accept a landmark with a residual above `MAX_RESIDUAL`, and landmarks that
            place the limb outside the socket.

    Raises:
        RegistrationError: If a marker is missing, moves or cannot be identified, or the landmarks
            do not fit.
    """
    socket, pylon = (_register_body(take, side, force) for side in sides)
    limb_in_cell = socket.landmarks.pose.inverse() @ pylon.landmarks.pose
    q, turn, origin = limb_in_cell.translation, limb_in_cell.rotation, np.zeros(3)
    if not force:
        _require_limb_in_socket(q, geometry, sides[0].where)
    notes = [
        f"{side.frame}: {note}"
        for side, body in zip(sides, (socket, pylon), strict=True)
        for note in _notes(body)
    ]
    return Registration(
        take=take,
        geometry=dataclasses.replace(
            geometry,
            socket_markers=socket.markers,
            pylon_markers=pylon.markers,
            socket_body=socket.in_frame,
            limb=pylon.in_frame.inverse(),
            registration=f"{take.path.name}, landmarks within {1e3 * socket.landmarks.rms:.2f} mm"
            f" (load cell) and {1e3 * pylon.landmarks.rms:.2f} mm (limb)",
        ),
        socket=socket,
        pylon=pylon,
        limb_position=q,
        covariance=socket.covariance_at(q) + _rotated(pylon.covariance_at(origin), turn),
        single=socket.single.at(q) + _rotated(pylon.single.at(origin), turn),
        notes=(*take.notes, *notes),
    )


def _register_body(take: MotiveTake, side: LandmarkSide, force: bool) -> RegisteredBody:
    where, labels = f"{take.path}: {side.body}", side.markers
    names = _markers_of(take, labels, where) if isinstance(labels, str) else labels
    observed = take.stack(names)
    fit = fit_labels(observed, where)
    observed = relabel(observed, fit.order)
    positions = np.concatenate([observed, take.stack(side.names)], axis=1)
    whole = np.asarray((fit.order >= 0).all(axis=1))
    still = average_still((*names, *side.names), positions, whole, where)
    own, measured = np.split(still.mean, [len(names)])
    if isinstance(labels, str):
        body, used = take.body(labels), still.used
        pose = Pose(body.rotation[used], body.translation[used])
        in_world = tracked_frame(observed[used], pose, where)
    else:
        in_world = own_frame(own)
    with naming(side.where):
        landmarks = register_landmarks(side.known, measured, side.names, still.noise)
    worst = int(landmarks.residual.argmax())
    if landmarks.residual[worst] > MAX_RESIDUAL and not force:
        raise RegistrationError(
            f"{side.where}: landmark {side.names[worst]} is"
            f" {1e3 * landmarks.residual[worst]:.1f} mm off (at most {1e3 * MAX_RESIDUAL:g} mm;"
            f" rms {1e3 * landmarks.rms:.1f} mm)",
            "check the landmarks' coordinates and names, or accept it with --force",
        )
    in_landmarks = landmarks.pose.inverse().apply(own)
    return RegisteredBody(
        still=still,
        markers=in_world.inverse().apply(own),
        in_frame=landmarks.pose.inverse() @ in_world,
        landmarks=landmarks,
        reference=pose_uncertainty(in_landmarks, still.noise),
        single=pose_uncertainty(in_landmarks, fit.noise),
    )


def _markers_of(take: MotiveTake, body: str, where: str) -> tuple[str, ...]:
    """The names of the measured markers of a rigid body of Motive."""
    names = take.markers_of(body)
    if not MIN_MARKERS <= len(names) <= MAX_MARKERS:
        raise RegistrationError(
            f"{where}: the rigid body '{body}' has {len(names)} measured markers in the take"
            f" ({', '.join(names) or 'none'})",
            f"export its markers, or name {MIN_MARKERS} to {MAX_MARKERS} of them instead of"
            " 'rigid_body'",
        )
    return names


_LIMB_MARGIN = 0.03  # [m]; of the limb's position around the tiles' cylinder


def _require_limb_in_socket(limb: FloatArray, geometry: SocketGeometry, where: str) -> None:
    """Refuse a limb position, (3,) [m], outside the socket, due to a coordinate's wrong sign."""
    axis = socket_axis(geometry)
    highest, widest = axis.heights(geometry.anchors).max(), axis.radii(geometry.anchors).max()
    inside = -_LIMB_MARGIN < axis.heights(limb) < highest + _LIMB_MARGIN
    if not inside or axis.radii(limb) >= widest + _LIMB_MARGIN:
        place = ", ".join(f"{1e3 * value:.0f}" for value in limb)
        raise RegistrationError(
            f"{where}: the limb would be at ({place}) mm of {{S}}, outside the socket",
            "check the signs of the landmarks' coordinates, and that the take has right-handed"
            " axes, or accept it with --force",
        )


def _notes(body: RegisteredBody) -> list[str]:
    fit = body.landmarks
    off = [
        f"landmark {name} is {1e3 * residual:.1f} mm off"
        for name, residual in zip(fit.names, fit.residual, strict=True)
        if residual > NOTED_RESIDUAL
    ]
    if fit.flat:
        names = ", ".join(fit.names)
        off.append(f"{names} lie in one plane: a wrong sign of a coordinate would not be seen")
    return [*body.still.notes, *off]
