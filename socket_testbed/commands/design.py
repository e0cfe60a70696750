"""`tile` and `register`: a socket from a scan, and its marker bodies from a static take."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed import api
from socket_testbed.arrays import FloatArray
from socket_testbed.commands.arguments import takes
from socket_testbed.commands.terminal import Progress, number, table
from socket_testbed.documents import check_number
from socket_testbed.files import check_outputs
from socket_testbed.geometry.pose import Pose
from socket_testbed.socket_design.landmarks import LANDMARK_FILE_HELP
from socket_testbed.socket_design.placement import parse_point
from socket_testbed.socket_design.registration import RegisteredBody, Registration
from socket_testbed.socket_design.tiling import TilingSettings

_MM = 1e3


@takes("tile", "files.check_outputs", exclusive="landmarks points")
def tile(
    scan: Path,
    *,
    output: Path,
    height: float = 80.0,
    size: float = 1e3 * TilingSettings.edge,
    flatness: float = 1e3 * TilingSettings.flatness,
    rounds: int = TilingSettings.rounds,
    seed: int = TilingSettings.seed,
    points: tuple[str, str, str] | None = None,
    replace: bool = False,
    **options: Any,
) -> None:
    """Turn a scan into tiles, frames and neighbours.

    Args:
        height: Height of the distal end above the load cell [mm].
        size: Edge of a tile [mm].
        flatness: Largest distance of the surface from a tile's plane [mm].
        rounds: Rounds of the search; more may find another tile.
        seed: Seed of the search.
    """
    check_number(height, "--height", 0.0, 1000.0)
    settings = TilingSettings(
        edge=1e-3 * check_number(size, "--size", 5.0, 100.0),
        flatness=1e-3 * check_number(flatness, "--flatness", 0.1, size / 2.0),
        rounds=int(check_number(rounds, "--rounds", 0, 100_000)),
        seed=int(check_number(seed, "--seed", 0)),
    )
    picked = [parse_point(point, "--points") for point in points or ()]
    beside = [output.with_suffix(suffix) for suffix in (".png", ".html")]
    check_outputs(output, *beside, replace=replace)
    design = api.tile(
        scan,
        output,
        **options,
        height=1e-3 * height,
        points=np.array(picked) if picked else None,
        settings=settings,
        progress=Progress,
    )
    picture, page = (path.name for path in beside)
    print(f"{output}, {picture} and {page} written")
    for note in design.notes:
        print(f"note: {note}", file=sys.stderr)
    if not design.geometry.registration:
        print("note: the marker bodies are nominal: register them", file=sys.stderr)
    facts = design.facts()
    width = max(len(name) for name, _ in facts)
    for name, value in facts:
        print(f"{name.ljust(width)}  {value}")


@takes("register", "files.check_outputs", epilog=LANDMARK_FILE_HELP)
def register(
    take: Path,
    *,
    landmarks: Path,
    socket: Path,
    output: Path | None = None,
    force: bool = False,
    replace: bool = False,
) -> None:
    """Locate the marker bodies' frames from a static take and landmarks.

    Args:
        output: File of the registered socket (default: the socket itself is replaced).
    """
    output = output or socket
    if output != socket:
        check_outputs(output, replace=replace)
    found = api.register(take, landmarks, socket, output, force=force)
    for note in found.notes:
        print(f"note: {note}", file=sys.stderr)
    print(f"{_report(found)}\n\nregistered socket in {output}")


def _report(found: Registration) -> str:
    take, geometry = found.take, found.geometry
    socket, pylon = found.socket, found.pylon
    limb, single = _MM * _sigma(found.covariance), _MM * _sigma(found.single)
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
            _place("socket body in {S}", geometry.socket_body, *found.socket_body_covariances()),
            _place("limb in the pylon's body", geometry.limb, *found.limb_covariances()),
            f"limb position q in {{S}}: {_vector(_MM * found.limb_position)} mm",
            f"  1 sigma: {_vector(limb)} mm, {np.linalg.norm(limb):.2f} mm in all;"
            f" noise of a single frame: {np.linalg.norm(single):.2f} mm",
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
        for name, occluded, *lengths in zip(
            still.names, still.occluded, still.spread, still.drift, residuals, strict=True
        ):
            rows.append([name, str(occluded), *(number(_MM * length) for length in lengths)])
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


def _sigma(covariance: FloatArray) -> FloatArray:
    """1 sigma along each axis, shape (3,)."""
    return np.sqrt(np.diag(covariance))


def _vector(values: FloatArray, digits: int = 2) -> str:
    return f"({', '.join(number(value, digits) for value in values)})"
