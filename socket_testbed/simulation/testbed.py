"""The simulated testbed: a load history through the physics and the sensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.calibration.model import Calibration
from socket_testbed.geometry.marker_bodies import fit_triad
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.simulation.limb import LoadedLimb, MarkerBodies, Scenario, load_history
from socket_testbed.simulation.sensors import (
    ClusterSensor,
    SensorErrors,
    cluster_stress,
    measure_capacitance,
    observe_markers,
    wrench_noise,
    wrench_offset,
)

_START = 1_767_258_000_000_000_000  # [ns]; 2026-01-01 09:00 UTC
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
        tiles: Names of the n tiles.
        stamps: Times of the triggers since the epoch, shape (N,) [ns].
        capacitance: Capacitances by cluster and input, shape (N, 4) each [pF].
        wrench: Measured wrench [M; F], shape (N, 6) [N m, N].
        socket_markers: Observed triad of the socket in the world, shape (N, 3, 3) [m].
        pylon_markers: Observed triad of the pylon in the world, shape (N, 3, 3) [m].
        socket_pose: Pose of the socket's body from its triad; NaN where there is none.
        pylon_pose: The same for the pylon's body.
        truth: The ground truth.
    """

    tiles: tuple[str, ...]
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
    for cluster in geometry.clusters:
        sensor = ClusterSensor(calibration.clusters[cluster], errors, cluster_rng)
        stress = cluster_stress(geometry, cluster, truth.forces)
        capacitance[cluster] = measure_capacitance(sensor, stress, time, errors, cluster_rng)
    offset = wrench_offset(errors, cell_rng)

    bodies = MarkerBodies(geometry, errors, marker_rng)
    socket_in_world, pylon_in_world = bodies.poses(truth.position, truth.rotation, load)
    socket_seen = observe_markers(socket_in_world, geometry.socket_markers, errors, marker_rng)
    pylon_seen = observe_markers(pylon_in_world, geometry.pylon_markers, errors, marker_rng)
    return SimulatedTrial(
        tiles=geometry.names,
        stamps=_START + np.round(time * 1e9).astype(np.int64),
        capacitance=capacitance,
        wrench=truth.wrench + offset + wrench_noise(errors, count, cell_rng),
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
    limb = LoadedLimb(geometry, load[0], rng)
    forces = np.zeros((len(load), len(geometry), 3))
    position, rotation = np.zeros((2, len(load), 3))
    for k, wrench in enumerate(load):
        forces[k] = limb.step(wrench, period)
        position[k], rotation[k] = limb.position, limb.rotation
        if progress is not None:
            progress(k + 1, len(load))
    return GroundTruth(forces, load, position, rotation)
