"""The simulated testbed: a load history through the physics and the sensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.calibration import Calibration
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.geometry.triad import fit_triad
from socket_testbed.simulation.loading import Scenario, load_history
from socket_testbed.simulation.sensors import (
    SensorErrors,
    measure_capacitance,
    measure_wrench,
    misregister,
    observe_markers,
)
from socket_testbed.simulation.tissue import LimbInSocket, make_tissue

_START = 1_767_258_000_000_000_000  # [ns]; 2026-01-01 09:00 UTC
_SOCKET_IN_WORLD = Pose(
    Rotation.from_euler("zyx", [35.0, 4.0, -3.0], degrees=True).as_matrix(),
    np.array([0.42, -0.31, 0.74]),
)

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class GroundTruth:
    """What really happened, in {S}.

    Attributes:
        forces: Force of the limb on the socket at every tile, shape (N, n, 3) [N].
        wrench: Wrench on the socket [M; F], shape (N, 6) [N m, N].
        position: Limb position q, shape (N, 3) [m].
        rotation: Rotation vector of the limb since donning, shape (N, 3) [rad].
    """

    forces: FloatArray
    wrench: FloatArray
    position: FloatArray
    rotation: FloatArray


@dataclass(frozen=True)
class SimulatedTrial:
    """What the testbed measures and what really happened, one row a trigger.

    Attributes:
        stamps: Times of the triggers since the epoch, shape (N,) [ns].
        capacitance: Capacitances by cluster and input, shape (N, 4) each [pF].
        wrench: Measured wrench [M; F], shape (N, 6) [N m, N].
        socket_markers: Observed triad of the socket in the world, shape (N, 3, 3) [m].
        pylon_markers: Observed triad of the pylon in the world, shape (N, 3, 3) [m].
        socket_pose: Pose of the socket's body from its triad; NaN where there is none.
        pylon_pose: The same for the pylon's body.
        truth: The ground truth.
    """

    stamps: IntArray
    capacitance: dict[str, FloatArray]
    wrench: FloatArray
    socket_markers: FloatArray
    pylon_markers: FloatArray
    socket_pose: Pose
    pylon_pose: Pose
    truth: GroundTruth


def simulate(
    geometry: SocketGeometry,
    calibration: Calibration,
    scenario: Scenario,
    duration: float,
    rate: float,
    seed: int,
    errors: SensorErrors | None = None,
    progress: Progress | None = None,
) -> SimulatedTrial:
    """Simulate a trial.

    Args:
        geometry: What the lab believes of the socket.
        calibration: What the lab believes of its clusters.
        scenario: The load history.
        duration: Duration [s].
        rate: Rate of the trigger [Hz].
        seed: Seed of everything that is random.
        errors: Sizes of the sensors' errors; None for the usual ones.
        progress: Called with the steps done and their number.

    Raises:
        CalibrationError: If the calibration lacks a cluster of the socket.
    """
    calibration.require(geometry.clusters, "the socket")
    errors = errors or SensorErrors()
    # One stream a part: another duration or error size leaves the other parts as they are.
    tissue_rng, load_rng, cell_rng, cluster_rng, marker_rng = (
        np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(5)
    )
    count = max(2, round(duration * rate))
    time = np.arange(count) / rate
    load = load_history(scenario, time, load_rng)
    truth = _move(geometry, load, 1.0 / rate, tissue_rng, progress)

    capacitance = {}
    for cluster, tile in geometry.clusters.items():
        local = truth.forces[:, tile] @ geometry.rotations[tile] / geometry.areas[tile]
        stress = np.column_stack([-local[:, 2], local[:, 0], local[:, 1]])
        capacitance[cluster] = measure_capacitance(
            calibration.clusters[cluster], stress, time, errors, cluster_rng
        )

    socket_in_world, pylon_in_world = _bodies(geometry, truth, errors, marker_rng)
    socket_seen = observe_markers(socket_in_world, geometry.socket_markers, errors, marker_rng)
    pylon_seen = observe_markers(pylon_in_world, geometry.pylon_markers, errors, marker_rng)
    return SimulatedTrial(
        stamps=_START + np.round(time * 1e9).astype(np.int64),
        capacitance=capacitance,
        wrench=measure_wrench(truth.wrench, errors, cell_rng),
        socket_markers=socket_seen,
        pylon_markers=pylon_seen,
        socket_pose=fit_triad(geometry.socket_markers, socket_seen).pose,
        pylon_pose=fit_triad(geometry.pylon_markers, pylon_seen).pose,
        truth=truth,
    )


def _move(
    geometry: SocketGeometry,
    load: FloatArray,
    period: float,
    rng: np.random.Generator,
    progress: Progress | None,
) -> GroundTruth:
    """Take the limb through a load history, from equilibrium to equilibrium."""
    tissue = make_tissue(geometry, rng)
    centre = geometry.anchors.mean(axis=0)
    limb = LimbInSocket(tissue, centre)
    covered = tissue.tile >= 0
    forces = np.zeros((len(load), len(geometry), 3))
    moved = np.zeros((len(load), 6))
    for share in (0.25, 0.5, 0.75):  # donning: the first load comes in steps
        limb.step(share * load[0], 1.0)
    for k, wrench in enumerate(load):
        response = limb.step(wrench, period)
        np.add.at(forces[k], tissue.tile[covered], response[covered])
        moved[k] = limb.displacement
        if progress is not None:
            progress(k + 1, len(load))
    return GroundTruth(forces, load, centre + moved[:, :3], moved[:, 3:])


def _bodies(
    geometry: SocketGeometry, truth: GroundTruth, errors: SensorErrors, rng: np.random.Generator
) -> tuple[Pose, Pose]:
    """True poses of the marker bodies of socket and pylon in the world, N of each."""
    count = len(truth.position)
    # The stand gives a little under the load.
    shift = rng.normal(0.0, 2e-5, (count, 3)) - 1e-6 * truth.wrench[:, 3:]
    world = Pose(
        np.tile(_SOCKET_IN_WORLD.rotation, (count, 1, 1)), _SOCKET_IN_WORLD.translation + shift
    )
    limb = Pose(Rotation.from_rotvec(truth.rotation).as_matrix(), truth.position)
    socket_body = misregister(geometry.socket_body, errors, rng)
    limb_in_body = misregister(geometry.limb, errors, rng)
    # socket_body maps the body to {S}; world maps {S} to the world.
    return world @ socket_body, world @ limb @ limb_in_body.inverse()
