"""The socket's body in {S} and the limb in the pylon's body, from a static take.

On either side of the limb's joint with the socket, a triad that stays on its body and landmarks
that are known in the frame of interest are rigid to each other. The triad gives
world <- body, the landmarks give world <- frame; together they are frame <- body. The body's
frame is defined by the very take: what is uncertain of it is how well a later triad finds it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.errors import RegistrationError
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.rigid import PoseUncertainty, pose_uncertainty
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.registration.bodies import fit_labels, own_frame, relabel, tracked_frame
from socket_testbed.registration.landmark_file import LandmarkFile, Side, TriadLabels
from socket_testbed.registration.landmarks import LandmarkFit, register_landmarks
from socket_testbed.registration.motive_csv import read_motive_csv
from socket_testbed.registration.motive_take import MotiveTake
from socket_testbed.registration.stillness import StillMarkers, average_still

NOTED_RESIDUAL = 0.002  # [m]
MOST_RESIDUAL = 0.010  # [m]


@dataclass(frozen=True)
class RegisteredBody:
    """A marker body and the frame that the landmarks beside it give.

    Attributes:
        still: Its markers in the take: the triad's three, then the landmarks.
        markers: The triad in the body's frame, shape (3, 3) [m].
        in_frame: Pose of the body in the frame of the landmarks.
        landmarks: Fit of the landmarks, to `world`.
        reference: Uncertainty of a later pose of the body that comes from `markers`.
        single: Uncertainty of a later pose from the noise of a single frame.
    """

    still: StillMarkers
    markers: FloatArray
    in_frame: Pose
    landmarks: LandmarkFit
    reference: PoseUncertainty
    single: PoseUncertainty

    def covariance_at(self, point: FloatArray) -> FloatArray:
        """Covariance of a point between body and frame, in the frame's axes, (3, 3) [m^2].

        Args:
            point: The point in the frame of the landmarks, shape (3,) [m].
        """
        in_body = self.in_frame.inverse().apply(point)
        return self.landmarks.uncertainty.at(point) + _turn(
            self.reference.at(in_body), self.in_frame.rotation
        )

    def rotation_covariance(self) -> FloatArray:
        """Covariance of the rotation between body and frame, in the frame's axes [rad^2]."""
        return self.landmarks.uncertainty.rotation + _turn(
            self.reference.rotation, self.in_frame.rotation
        )


@dataclass(frozen=True)
class Registration:
    """A socket registered with a static take.

    Attributes:
        take: The take.
        geometry: The socket with its new triads, `socket_body` and `limb`.
        socket: The socket's body and {S}.
        pylon: The pylon's body and the limb's frame.
        limb_position: Limb position q in {S} during the take, shape (3,) [m].
        covariance: Covariance of a limb position that comes from the registration, in {S},
            shape (3, 3) [m^2]; it is the same error in every frame of a trial.
        single: Covariance that the markers' noise adds in every single frame, likewise.
        notes: What a person should look at.
    """

    take: MotiveTake
    geometry: SocketGeometry
    socket: RegisteredBody
    pylon: RegisteredBody
    limb_position: FloatArray
    covariance: FloatArray
    single: FloatArray
    notes: tuple[str, ...]

    def socket_body_covariances(self) -> tuple[FloatArray, FloatArray]:
        """Covariances of `socket_body`: position [m^2] and rotation [rad^2], in {S}."""
        position = self.socket.covariance_at(self.geometry.socket_body.translation)
        return position, self.socket.rotation_covariance()

    def limb_covariances(self) -> tuple[FloatArray, FloatArray]:
        """Covariances of `limb`: position [m^2] and rotation [rad^2], in the pylon's body."""
        to_body = self.geometry.limb.rotation
        position = self.pylon.covariance_at(np.zeros(3))
        return _turn(position, to_body), _turn(self.pylon.rotation_covariance(), to_body)


def read_static_take(path: Path) -> MotiveTake:
    """Read a take to register with.

    Raises:
        RegistrationError: If it is none, as a trial is, which has triads but no landmarks.
    """
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
        take: A static take that shows both triads and all landmarks.
        landmarks: Which marker is what.
        geometry: The socket, whose tiles stay.
        force: Accept landmarks whose residual is above `MOST_RESIDUAL`.

    Raises:
        RegistrationError: If a marker is missing, the take is not static, shows too few whole
            frames, or the landmarks do not fit.
    """
    notes = [*take.notes]
    bodies = []
    for side in (landmarks.socket, landmarks.pylon):
        body = _register_body(take, side)
        _require_residual(body.landmarks, side.where, force)
        notes += [f"{side.frame}: {note}" for note in _notes(body)]
        bodies.append(body)
    socket, pylon = bodies
    limb_in_cell = socket.landmarks.pose.inverse() @ pylon.landmarks.pose
    covariance, single = _limb_covariances(socket, pylon, limb_in_cell)
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
        limb_position=limb_in_cell.translation,
        covariance=covariance,
        single=single,
        notes=tuple(notes),
    )


def _register_body(take: MotiveTake, side: Side) -> RegisteredBody:
    where = f"{take.path}: {side.body}"
    triad = _triad_names(take, side.triad, where)
    observed = take.stack(triad)
    fit = fit_labels(observed, where)
    positions = np.concatenate([relabel(observed, fit.order), take.stack(side.landmarks)], axis=1)
    still = average_still((*triad, *side.landmarks), positions, fit.order[:, 0] >= 0, where)
    if isinstance(side.triad, str):
        tracked = take.body(side.triad).pose
        used = Pose(tracked.rotation[still.used], tracked.translation[still.used])
        in_world = tracked_frame(positions[still.used, :3], used, where)
    else:
        in_world = own_frame(still.mean[:3])
    markers = in_world.inverse().apply(still.mean[:3])
    landmarks = _register_landmarks(side, still)
    return RegisteredBody(
        still=still,
        markers=markers,
        in_frame=landmarks.pose.inverse() @ in_world,
        landmarks=landmarks,
        reference=pose_uncertainty(markers, still.noise),
        single=pose_uncertainty(markers, fit.noise),
    )


def _triad_names(take: MotiveTake, triad: TriadLabels, where: str) -> tuple[str, ...]:
    if not isinstance(triad, str):
        return triad
    names = take.markers_of(triad)
    if len(names) != 3:
        raise RegistrationError(
            f"{where}: the rigid body '{triad}' has {len(names)} measured markers in the take"
            f" ({', '.join(names) or 'none'})",
            "export its markers, or name the three markers of its triad instead of 'rigid_body'",
        )
    return names


def _register_landmarks(side: Side, still: StillMarkers) -> LandmarkFit:
    known, measured = np.array(list(side.landmarks.values())), still.mean[3:]
    names = tuple(side.landmarks)
    try:
        fit = register_landmarks(known, measured, names)
        # Few landmarks may fit by chance better than their means are known.
        if fit.noise < still.noise:
            fit = register_landmarks(known, measured, names, still.noise)
    except RegistrationError as error:
        raise RegistrationError(f"{side.where}: {error.fact}", error.mend) from None
    return fit


def _require_residual(fit: LandmarkFit, where: str, force: bool) -> None:
    worst = int(fit.residual.argmax())
    if fit.residual[worst] > MOST_RESIDUAL and not force:
        raise RegistrationError(
            f"{where}: landmark {fit.names[worst]} is {1e3 * fit.residual[worst]:.1f} mm off (at"
            f" most {1e3 * MOST_RESIDUAL:g} mm; rms {1e3 * fit.rms:.1f} mm)",
            "check the landmarks' coordinates and names, or accept it with --force",
        )


def _notes(body: RegisteredBody) -> list[str]:
    fit = body.landmarks
    off = [
        f"landmark {name} is {1e3 * residual:.1f} mm off"
        for name, residual in zip(fit.names, fit.residual, strict=True)
        if residual > NOTED_RESIDUAL
    ]
    return [*body.still.notes, *off, *fit.blind]


def _limb_covariances(
    socket: RegisteredBody, pylon: RegisteredBody, limb_in_cell: Pose
) -> tuple[FloatArray, FloatArray]:
    """Covariances of q in {S}: from the registration, and from the noise of a single frame."""
    q = limb_in_cell.translation
    registered = socket.covariance_at(q) + _turn(
        pylon.covariance_at(np.zeros(3)), limb_in_cell.rotation
    )
    in_socket = socket.in_frame.inverse().apply(q)
    in_pylon = pylon.in_frame.inverse().translation
    pylon_in_cell = limb_in_cell.rotation @ pylon.in_frame.rotation
    single = _turn(socket.single.at(in_socket), socket.in_frame.rotation) + _turn(
        pylon.single.at(in_pylon), pylon_in_cell
    )
    return registered, single


def _turn(covariance: FloatArray, rotation: FloatArray) -> FloatArray:
    """A covariance in other axes."""
    return rotation @ covariance @ rotation.T
