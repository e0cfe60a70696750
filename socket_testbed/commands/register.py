"""`register`: the marker bodies and the limb of a socket from a static take with landmarks."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed import api
from socket_testbed.arrays import FloatArray
from socket_testbed.commands.options import add_replace
from socket_testbed.commands.text import number, table
from socket_testbed.files import check_outputs
from socket_testbed.geometry.pose import Pose
from socket_testbed.socket_design.landmarks import LANDMARK_FILE_HELP
from socket_testbed.socket_design.registration import MOST_RESIDUAL, RegisteredBody, Registration

_MM = 1e3


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = LANDMARK_FILE_HELP
    parser.add_argument(
        "take", type=Path, metavar="TAKE.csv", help="static take, exported from Motive"
    )
    parser.add_argument(
        "--landmarks",
        type=Path,
        required=True,
        metavar="LANDMARKS.yaml",
        help="which marker is what, and where the landmarks are",
    )
    parser.add_argument(
        "--socket", type=Path, required=True, metavar="SOCKET.yaml", help="the socket to register"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="NEW_SOCKET.yaml",
        help="file of the registered socket (default: SOCKET.yaml is replaced)",
    )
    parser.add_argument(
        "--force",
        action="store_true",
        help=f"accept landmarks that are more than {_MM * MOST_RESIDUAL:g} mm off, or that put the"
        " limb outside the socket",
    )
    add_replace(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Register, print and write."""
    output = options.output or options.socket
    if output != options.socket:
        check_outputs(output, replace=options.replace)
    found = api.register(
        options.take, options.landmarks, options.socket, output, force=options.force
    )
    for note in found.notes:
        print(f"note: {note}", file=sys.stderr)
    print(_report(found))
    print(f"\nregistered socket in {output}")


def _report(registration: Registration) -> str:
    take, geometry = registration.take, registration.geometry
    socket, pylon = registration.socket, registration.pylon
    return "\n".join(
        [
            f"{take.path}: {len(take)} frames at {take.frame_rate:g} Hz, format {take.version},"
            f" lengths in {take.units.lower()}",
            _frames("socket and load_cell", socket),
            _frames("pylon and limb", pylon),
            "",
            _markers(socket, pylon),
            "",
            _fit("load_cell", socket),
            _fit("limb", pylon),
            "",
            _place(
                "socket body in {S}", geometry.socket_body, *registration.socket_body_covariances()
            ),
            _place("limb in the pylon's body", geometry.limb, *registration.limb_covariances()),
            _limb(registration),
        ]
    )


def _frames(name: str, body: RegisteredBody) -> str:
    still = body.still
    used, count = int(still.used.sum()), len(still.used)
    occluded = count - used - still.mislabelled - still.jumped
    return (
        f"{name}: {used} frames used, {count - used} left out ({occluded} occluded,"
        f" {still.mislabelled} mislabelled, {still.jumped} jumped)"
    )


def _markers(*bodies: RegisteredBody) -> str:
    rows = []
    for body in bodies:
        residuals = [np.nan] * len(body.markers) + body.landmarks.residual.tolist()
        still = body.still
        for name, occluded, spread, drift, residual in zip(
            still.names, still.occluded, still.spread, still.drift, residuals, strict=True
        ):
            motion = [number(_MM * value) for value in (spread, drift, residual)]
            rows.append([name, str(occluded), *motion])
    return table(["marker", "occluded", "spread [mm]", "drift [mm]", "residual [mm]"], rows)


def _fit(name: str, body: RegisteredBody) -> str:
    fit = body.landmarks
    return (
        f"{name}: {len(fit.names)} landmarks, residual {_MM * fit.rms:.3f} mm rms"
        f" ({fit.degrees} degrees of freedom), so 1 sigma of a coordinate is"
        f" {_MM * fit.noise:.3f} mm"
    )


def _place(name: str, pose: Pose, position: FloatArray, rotation: FloatArray) -> str:
    turn = Rotation.from_matrix(pose.rotation).as_rotvec()
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle > 0.0 else turn
    return (
        f"{name}: at {_vector(_MM * pose.translation)} mm, turned by {np.degrees(angle):.2f} deg"
        f" about {_vector(axis, 3)}\n"
        f"  1 sigma: {_vector(_MM * _sigma(position))} mm,"
        f" {_vector(np.degrees(_sigma(rotation)), 3)} deg about x, y, z"
    )


def _limb(registration: Registration) -> str:
    sigma = _MM * _sigma(registration.covariance)
    single = _MM * _sigma(registration.single)
    return (
        f"limb position q in {{S}}: {_vector(_MM * registration.limb_position)} mm\n"
        f"  1 sigma: {_vector(sigma)} mm, {np.linalg.norm(sigma):.2f} mm in all;"
        f" noise of a single frame: {np.linalg.norm(single):.2f} mm"
    )


def _sigma(covariance: FloatArray) -> FloatArray:
    """1 sigma along each axis, shape (3,)."""
    return np.sqrt(np.diag(covariance))


def _vector(values: FloatArray, digits: int = 2) -> str:
    return f"({', '.join(number(value, digits) for value in values)})"
