"""The socket's body in {S} and the limb in the pylon's body, from a static take.

A body without a frame of its own gets this one: origin at its first marker, x towards the
second, z along the normal of the plane of these and the third, ``z ~ x x (m3 - m1)``, and
y = z x x. Of more than three markers, that farthest from x takes the place of the third.

On either side of the limb's joint with the socket, markers that stay on their body and landmarks
that are known in the frame of interest are rigid to each other. The markers give
world <- body, the landmarks give world <- frame; together they are frame <- body. The body's
frame is defined by the very take: what is uncertain of it is how well later markers find it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.errors import RegistrationError
from socket_testbed.geometry.axis import socket_axis
from socket_testbed.geometry.marker_bodies import (
    FEWEST_MARKERS,
    MOST_MARKERS,
    BodyFit,
    PoseUncertainty,
    body_fault,
    distances,
    fit_body,
    fit_rigid,
    pose_uncertainty,
    root_mean_square,
)
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.socket_design.landmarks import (
    LandmarkFile,
    LandmarkFit,
    Side,
    TriadLabels,
    register_landmarks,
)
from socket_testbed.socket_design.motive import MotiveTake, read_motive_csv

NOTED_DRIFT = 0.0002  # [m]
NOTED_SPREAD = 0.0004  # [m]; well above the noise of a marker
MOST_MOTION = 0.001  # [m]; for either
_JUMP = 0.005  # [m]; a frame with a marker this far off shows another label or a reflection
_MOST_JUMPS = 0.1  # of the frames; more of them is a body that moved
_FEWEST_FRAMES = 20
_BLOCKS = 10


@dataclass(frozen=True)
class StillMarkers:
    """Markers of a static take, averaged over the frames that show all of them."""

    names: tuple[str, ...]
    mean: FloatArray  # mean positions; (k, 3) [m]
    spread: FloatArray  # Root-mean-square distances from the means; (k,) [m]
    drift: FloatArray  # distances between the means of the first and the last third; (k,) [m]
    # 1-sigma error of a coordinate of a mean, pooled over the markers [m]; from the means of
    # blocks of frames, so that slow motion and correlated noise count
    noise: float
    used: BoolArray  # which frames are averaged; (N,)
    occluded: IntArray  # number of frames in which each marker is occluded; (k,)
    mislabelled: int  # number of frames left out whose body fits in no order of its labels
    jumped: int  # number of frames left out in which a marker is far from its usual place

    def motions(self) -> tuple[tuple[str, FloatArray, float], ...]:
        """In words how the markers moved, how far, shape (k,) [m], and when it is noted [m]."""
        return (
            ("drifted", self.drift, NOTED_DRIFT),
            ("moved about", self.spread, NOTED_SPREAD),
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Markers that moved more than noise does, yet little enough to be used."""
        return tuple(
            f"{name} {verb} by {1e3 * moved:.2f} mm over the take"
            for verb, motion, limit in self.motions()
            for name, moved in zip(self.names, motion, strict=True)
            if moved > limit
        )


def average_still(
    names: Sequence[str], positions: FloatArray, fits: BoolArray, where: str
) -> StillMarkers:
    """Average markers over a take in which they stand still.

    Args:
        names: Names of the k markers.
        positions: Their positions over N frames, shape (N, k, 3) [m]; NaN where occluded.
        fits: Frames whose markers fit in some order of their labels, shape (N,).
        where: What names the body in an error.
    """
    occluded = np.isnan(positions).any(axis=2).sum(axis=0)
    seen = np.isfinite(positions).all(axis=(1, 2))
    candidates = seen & fits
    count, mislabelled = int(candidates.sum()), int((seen & ~fits).sum())
    if count < _FEWEST_FRAMES:
        worst = int(occluded.argmax())
        raise RegistrationError(
            f"{where}: {count} of {len(positions)} frames show all of {', '.join(names)}"
            f" ({names[worst]} is occluded in {int(occluded[worst])}, the distances are not the"
            f" usual ones in {mislabelled})",
            f"record {_FEWEST_FRAMES} frames or more in which the cameras see them all",
        )
    usual = np.median(positions[candidates], axis=0)
    far = np.linalg.norm(positions - usual, axis=2) > _JUMP  # False where occluded
    used = candidates & ~far.any(axis=1)
    jumped = count - int(used.sum())
    if jumped > _MOST_JUMPS * count:
        worst = int(far[candidates].sum(axis=0).argmax())
        raise RegistrationError(
            f"{where}: in {jumped} of {count} frames a marker, mostly {names[worst]}, is more than"
            f" {1e3 * _JUMP:g} mm from its usual place",
            "record a take in which nothing moves, and check its labels",
        )
    positions = positions[used]
    mean, third = positions.mean(axis=0), len(positions) // 3
    drift = positions[-third:].mean(axis=0) - positions[:third].mean(axis=0)
    blocks = np.array([block.mean(axis=0) for block in np.array_split(positions, _BLOCKS)])
    still = StillMarkers(
        names=tuple(names),
        mean=mean,
        spread=root_mean_square(np.linalg.norm(positions - mean, axis=2), axis=0),
        drift=np.linalg.norm(drift, axis=1),
        noise=float(np.sqrt(blocks.var(axis=0, ddof=1).mean() / _BLOCKS)),
        used=used,
        occluded=occluded,
        mislabelled=mislabelled,
        jumped=jumped,
    )
    for verb, motion, _ in still.motions():
        worst = int(motion.argmax())
        if motion[worst] > MOST_MOTION:
            raise RegistrationError(
                f"{where}: {names[worst]} {verb} by {1e3 * motion[worst]:.2f} mm over the take"
                f" (at most {1e3 * MOST_MOTION:g} mm)",
                "record a take in which nothing moves, or export its still part",
            )
    return still


def own_frame(markers: FloatArray) -> Pose:
    """Pose of a body's own frame (see above) in the frame of its markers."""
    x = (markers[1] - markers[0]) / np.linalg.norm(markers[1] - markers[0])
    normals = np.cross(x, markers - markers[0])
    lengths = np.linalg.norm(normals, axis=1)
    z = normals[lengths.argmax()] / lengths.max()
    return Pose(np.column_stack([x, np.cross(z, x), z]), markers[0])


def fit_labels(observed: FloatArray, where: str) -> BodyFit:
    """Find which observed marker is which, from the distances that most of the frames agree on.

    Labels that are swapped in fewer than half of the frames are put right: `BodyFit.order`.
    """
    between = distances(observed)
    seen = np.isfinite(between).all(axis=(1, 2))
    if not seen.any():
        raise RegistrationError(
            f"{where}: no frame shows all {observed.shape[1]} markers",
            "check their labels in Motive",
        )
    usual = np.median(between[seen], axis=0)
    # The frame that is nearest to the usual one has no swapped labels.
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
    """Markers in the order that a fit found, shape (N, k, 3) [m]; as they are where it has none."""
    known = np.where((order < 0).any(axis=1, keepdims=True), np.arange(order.shape[1]), order)
    return np.take_along_axis(observed, known[:, :, None], axis=1)


def tracked_frame(markers: FloatArray, body: Pose, where: str) -> Pose:
    """Pose of a frame that was tracked over N frames, in which a body stood still.

    The markers are taken into the tracked frame, where the median leaves out the frames in
    which the tracking went wrong, and the frame is fitted to the mean of the markers.
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
    pose = fit_rigid(in_body, markers.mean(axis=0)[None])
    return Pose(pose.rotation[0], pose.translation[0])


NOTED_RESIDUAL = 0.002  # [m]
MOST_RESIDUAL = 0.010  # [m]


def _in_axes(covariance: FloatArray, rotation: FloatArray) -> FloatArray:
    """A covariance in the axes to which a rotation maps, shape (3, 3)."""
    return rotation @ covariance @ rotation.T


@dataclass(frozen=True)
class RegisteredBody:
    """A marker body and the frame that the landmarks beside it give."""

    still: StillMarkers  # its markers in the take: the body's own, then the landmarks
    markers: FloatArray  # the body's own in its frame; (k, 3) [m]
    in_frame: Pose  # pose of the body in the frame of the landmarks
    landmarks: LandmarkFit  # fit of the landmarks, to `world`
    reference: PoseUncertainty  # uncertainty of a later pose of the body that comes from `markers`
    single: PoseUncertainty  # uncertainty of a later pose from the noise of a single frame

    def covariance_at(self, point: FloatArray) -> FloatArray:
        """Covariance of a point between body and frame, in the frame's axes, (3, 3) [m^2]."""
        return self.landmarks.uncertainty.at(point) + self.in_axes(self.reference, point)

    def rotation_covariance(self) -> FloatArray:
        """Covariance of the rotation between body and frame, in the frame's axes [rad^2]."""
        return self.landmarks.uncertainty.rotation + _in_axes(
            self.reference.rotation, self.in_frame.rotation
        )

    def in_axes(self, body: PoseUncertainty, point: FloatArray) -> FloatArray:
        """Covariance of a point of the frame by an uncertainty of the body, (3, 3) [m^2]."""
        return _in_axes(body.at(self.in_frame.inverse().apply(point)), self.in_frame.rotation)


@dataclass(frozen=True)
class Registration:
    """A socket registered with a static take."""

    take: MotiveTake
    geometry: SocketGeometry  # the socket with its new marker bodies, `socket_body` and `limb`
    socket: RegisteredBody  # the socket's body and {S}
    pylon: RegisteredBody  # the pylon's body and the limb's frame
    limb_position: FloatArray  # limb position q in {S} during the take; (3,) [m]
    # Covariance of a limb position that comes from the registration, in {S}; (3, 3) [m^2]; it is
    # the same error in every frame of a trial
    covariance: FloatArray
    single: FloatArray  # covariance that the markers' noise adds in every single frame, likewise
    notes: tuple[str, ...]  # what a person should look at

    def __repr__(self) -> str:
        fits = (self.socket.landmarks, self.pylon.landmarks)
        residuals = " and ".join(f"{1e3 * fit.rms:.2f}" for fit in fits)
        return f"Registration({self.take.path}: {len(self.take)} frames; {residuals} mm rms)"

    def socket_body_covariances(self) -> tuple[FloatArray, FloatArray]:
        """Covariances of `socket_body`: position [m^2] and rotation [rad^2], in {S}."""
        position = self.socket.covariance_at(self.geometry.socket_body.translation)
        return position, self.socket.rotation_covariance()

    def limb_covariances(self) -> tuple[FloatArray, FloatArray]:
        """Covariances of `limb`: position [m^2] and rotation [rad^2], in the pylon's body."""
        to_body = self.geometry.limb.rotation
        position = self.pylon.covariance_at(np.zeros(3))
        return _in_axes(position, to_body), _in_axes(self.pylon.rotation_covariance(), to_body)


def read_static_take(path: Path) -> MotiveTake:
    """Read a take to register with."""
    if path.is_dir():
        raise RegistrationError(
            f"{path}: is a folder; a trial holds the two triads but no landmarks",
            "record a static take with landmark markers in Motive and export it to CSV",
        )
    return read_motive_csv(path)


def register_take(
    take: MotiveTake, landmarks: LandmarkFile, geometry: SocketGeometry, force: bool = False
) -> Registration:
    """Register a socket's marker bodies and its limb.

    Args:
        take: A static take that shows both bodies and all landmarks.
        landmarks: Which marker is what.
        geometry: The socket, whose tiles stay.
        force: Accept landmarks whose residual is above `MOST_RESIDUAL`, or that put the limb
            outside the socket.
    """
    notes = [*take.notes]
    bodies = []
    for side in (landmarks.socket, landmarks.pylon):
        body = _register_body(take, side)
        fit = body.landmarks
        worst = int(fit.residual.argmax())
        if fit.residual[worst] > MOST_RESIDUAL and not force:
            raise RegistrationError(
                f"{side.where}: landmark {fit.names[worst]} is {1e3 * fit.residual[worst]:.1f} mm"
                f" off (at most {1e3 * MOST_RESIDUAL:g} mm; rms {1e3 * fit.rms:.1f} mm)",
                "check the landmarks' coordinates and names, or accept it with --force",
            )
        notes += [f"{side.frame}: {note}" for note in _notes(body)]
        bodies.append(body)
    socket, pylon = bodies
    limb_in_cell = socket.landmarks.pose.inverse() @ pylon.landmarks.pose
    q, turn, origin = limb_in_cell.translation, limb_in_cell.rotation, np.zeros(3)
    if not force:
        _require_limb_in_socket(q, geometry, landmarks.socket.where)
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
        covariance=socket.covariance_at(q) + _in_axes(pylon.covariance_at(origin), turn),
        single=socket.in_axes(socket.single, q)
        + _in_axes(pylon.in_axes(pylon.single, origin), turn),
        notes=tuple(notes),
    )


def _register_body(take: MotiveTake, side: Side) -> RegisteredBody:
    where = f"{take.path}: {side.body}"
    names = _body_names(take, side.triad, where)
    count = len(names)
    observed = take.stack(names)
    fit = fit_labels(observed, where)
    positions = np.concatenate([relabel(observed, fit.order), take.stack(side.landmarks)], axis=1)
    whole = np.asarray((fit.order >= 0).all(axis=1))
    still = average_still((*names, *side.landmarks), positions, whole, where)
    if isinstance(side.triad, str):
        tracked = take.body(side.triad)
        used = Pose(tracked.rotation[still.used], tracked.translation[still.used])
        in_world = tracked_frame(positions[still.used, :count], used, where)
    else:
        in_world = own_frame(still.mean[:count])
    markers = in_world.inverse().apply(still.mean[:count])
    landmarks = _register_landmarks(side, still)
    return RegisteredBody(
        still=still,
        markers=markers,
        in_frame=landmarks.pose.inverse() @ in_world,
        landmarks=landmarks,
        reference=pose_uncertainty(markers, still.noise),
        single=pose_uncertainty(markers, fit.noise),
    )


def _body_names(take: MotiveTake, triad: TriadLabels, where: str) -> tuple[str, ...]:
    if not isinstance(triad, str):
        return triad
    names = take.markers_of(triad)
    if not FEWEST_MARKERS <= len(names) <= MOST_MARKERS:
        raise RegistrationError(
            f"{where}: the rigid body '{triad}' has {len(names)} measured markers in the take"
            f" ({', '.join(names) or 'none'})",
            "export its markers, or name three to eight of them instead of 'rigid_body'",
        )
    return names


def _register_landmarks(side: Side, still: StillMarkers) -> LandmarkFit:
    known, measured = side.points(), still.mean[-len(side.landmarks) :]
    names = tuple(side.landmarks)
    try:
        fit = register_landmarks(known, measured, names)
        # Few landmarks may fit by chance better than their means are known.
        if fit.noise < still.noise:
            fit = register_landmarks(known, measured, names, still.noise)
    except RegistrationError as error:
        raise RegistrationError(f"{side.where}: {error.fact}", error.hint) from None
    return fit


_AROUND = 0.03  # [m]; a limb whose position is farther from the tiles' cylinder is in no socket


def _require_limb_in_socket(limb: FloatArray, geometry: SocketGeometry, where: str) -> None:
    """Refuse a limb position, (3,) [m], outside the socket: a coordinate's sign is wrong."""
    axis = socket_axis(geometry)
    highest, widest = axis.heights(geometry.anchors).max(), axis.radii(geometry.anchors).max()
    inside = -_AROUND < axis.heights(limb) < highest + _AROUND
    if not inside or axis.radii(limb) >= widest + _AROUND:
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
