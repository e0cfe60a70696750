"""Simulated trials: a load history through the physics and the sensors, and their files.

A simulated trial is a bag like a recorded one, with the ground truth beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.calibration.model import Calibration
from socket_testbed.drivers.load_cell.load_cell import Bridges
from socket_testbed.errors import TrialError
from socket_testbed.files import atomic_output, check_new_folder, make_folder, packaged
from socket_testbed.geometry.marker_bodies import fit_body, nearest_rotations
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.samples import Status
from socket_testbed.settings.testbed import read_testbed
from socket_testbed.simulation.limb import LoadedLimb, Scenario, TissueKind, load_history
from socket_testbed.simulation.sensors import (
    CAMERA_RATE,
    ClusterSensor,
    MarkerBodies,
    cluster_stress,
    observe_markers,
    vibration,
    wrench_creep,
    wrench_offset,
    wrench_vibration,
)
from socket_testbed.simulation.world import SensorErrors
from socket_testbed.trials.bag import BagWriter
from socket_testbed.trials.messages import (
    capacitance_packer,
    load_cell_raw_packer,
    markers_packer,
    pose_packer,
    trigger_packer,
    wrench_packer,
)
from socket_testbed.trials.topics import (
    CAPACITANCE,
    LOAD_CELL_RAW,
    MARKERS,
    PYLON_POSE,
    SOCKET_POSE,
    TRIGGER,
    WRENCH,
    Topic,
)
from socket_testbed.trials.trial import read_configuration, store_configuration

TRUTH_FILE = "ground_truth.npz"

# When each measurement is recorded after its trigger [ns].
_DELAYS = {
    TRIGGER: 0,
    WRENCH: 3_000_000,
    LOAD_CELL_RAW: 3_100_000,
    SOCKET_POSE: 8_000_000,
    PYLON_POSE: 8_100_000,
    MARKERS: 8_200_000,
    CAPACITANCE: 17_000_000,
}
_FRAMES_AT_ONCE = 50_000
_START = 1_767_258_000_000_000_000  # [ns]; 2026-01-01 09:00 UTC

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class GroundTruth:
    """The true motion and forces, in {S}."""

    forces: FloatArray  # force of the limb on the socket at every tile, shape (N, n, 3) [N]
    wrench: FloatArray  # wrench on the socket [M; F], shape (N, 6) [N m, N]
    position: FloatArray  # limb position q, shape (N, 3) [m]
    rotation: FloatArray  # rotation vector of the limb since donning, shape (N, 3) [rad]


@dataclass(frozen=True)
class SimulatedTrial:
    """The measurements and the truth, one row per trigger."""

    tiles: tuple[str, ...]
    stamps: IntArray  # times of the triggers since the epoch, shape (N,) [ns]
    capacitance: dict[str, FloatArray]  # capacitances by cluster and input, shape (N, 4) each [pF]
    wrench: FloatArray  # measured wrench [M; F], shape (N, 6) [N m, N]
    # observed markers of the socket in the world, in the frame at the trigger, shape (N, k, 3) [m]
    socket_markers: FloatArray
    pylon_markers: FloatArray  # the same of the pylon
    # mean pose of the socket's body in the frames around the trigger; NaN where none of them shows
    # it
    socket_pose: Pose
    pylon_pose: Pose  # the same for the pylon's body
    truth: GroundTruth


def random_streams(seed: int) -> tuple[np.random.Generator, ...]:
    """Streams of tissue, load, load cell, clusters, markers and vibration.

    One each: another duration or error size leaves the other parts as they are.
    """
    return tuple(np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(6))


def simulate(
    geometry: SocketGeometry,
    calibration: Calibration,
    scenario: Scenario,
    duration: float,
    rate: float,
    seed: int,
    errors: SensorErrors | None = None,
    progress: Progress | None = None,
    tissue: TissueKind = "soft",
    mocap_window: float = 0.25,
) -> SimulatedTrial:
    """Simulate a trial.

    Args:
        geometry: The lab's geometry of the socket.
        calibration: The lab's calibration of the clusters.
        scenario: The load history.
        duration: Duration [s].
        rate: Rate of the trigger [Hz].
        seed: Seed of everything that is random.
        errors: Sizes of the sensors' errors; None for the usual ones.
        progress: Called with the steps done and their number.
        tissue: Kind of the limb's tissue, see `make_tissue`.
        mocap_window: Longest span around a trigger, at most its period, whose frames make a mean
            pose; 0 for one frame [s].
    """
    calibration.require(geometry.clusters, "the socket")
    errors = errors or SensorErrors()
    tissue_rng, load_rng, cell_rng, cluster_rng, marker_rng, shake_rng = random_streams(seed)
    count = max(2, round(duration * rate))
    time = np.arange(count) / rate
    load = load_history(scenario, time, load_rng)
    limb = LoadedLimb(geometry, load[0], tissue_rng, tissue)
    forces = np.zeros((count, len(geometry), 3))
    position, rotation = np.zeros((2, count, 3))
    for k, wrench in enumerate(load):
        forces[k] = limb.step(wrench, 1.0 / rate)
        position[k], rotation[k] = limb.position, limb.rotation
        if progress is not None:
            progress(k + 1, count)
    truth = GroundTruth(forces, load, position, rotation)

    capacitance = {}
    for cluster in geometry.clusters:
        sensor = ClusterSensor(calibration.clusters[cluster], errors, cluster_rng)
        stress = cluster_stress(geometry, cluster, forces)
        size = errors.stress_vibration * shake_rng.uniform(0.5, 1.5, 3)
        stress += vibration(size, time, shake_rng)
        capacitance[cluster] = sensor.read(stress, time, cluster_rng)
    felt = load + wrench_offset(errors, cell_rng)
    felt += cell_rng.normal(0.0, 1.0, load.shape) * errors.wrench_noise
    felt += wrench_creep(errors, load, time, cell_rng)
    felt += vibration(wrench_vibration(errors), time, shake_rng)

    window = min(mocap_window, 1.0 / rate)
    markers, poses = _motion_capture(geometry, truth, rate, window, errors, marker_rng)
    return SimulatedTrial(
        tiles=geometry.names,
        stamps=_START + np.round(time * 1e9).astype(np.int64),
        capacitance=capacitance,
        wrench=felt,
        socket_markers=markers[0],
        pylon_markers=markers[1],
        socket_pose=poses[0],
        pylon_pose=poses[1],
        truth=truth,
    )


def _motion_capture(
    geometry: SocketGeometry,
    truth: GroundTruth,
    rate: float,
    window: float,
    errors: SensorErrors,
    rng: np.random.Generator,
) -> tuple[list[FloatArray], list[Pose]]:
    """Markers of both bodies at each trigger and their mean poses in the window around it.

    Between the triggers the limb moves linearly, and so on before the first and after the last.
    """
    bodies = MarkerBodies(geometry, errors, rng)
    references = (geometry.socket_markers, geometry.pylon_markers)
    reach = int(0.5 * window * CAMERA_RATE)
    offsets = np.arange(-reach, reach + 1) * rate / CAMERA_RATE  # [triggers]
    count = len(truth.wrench)
    markers = [np.empty((count, *reference.shape)) for reference in references]
    poses = [Pose(np.empty((count, 3, 3)), np.empty((count, 3))) for _ in references]
    pieces = 1 + count * len(offsets) // _FRAMES_AT_ONCE
    for rows in np.array_split(np.arange(count), pieces):
        at = (rows[:, None] + offsets).ravel()
        after = np.clip(np.ceil(at).astype(int), 1, count - 1)
        moved = (truth.position, truth.rotation, truth.wrench)
        true = bodies.poses(*(_between(values, after, at - after + 1.0) for values in moved))
        for i, reference in enumerate(references):
            seen = observe_markers(true[i], reference, errors, rng)
            markers[i][rows] = seen[reach :: len(offsets)]
            mean = _mean_poses(fit_body(reference, seen).pose, len(rows))
            poses[i].rotation[rows], poses[i].translation[rows] = mean.rotation, mean.translation
    return markers, poses


def _mean_poses(pose: Pose, count: int) -> Pose:
    """Means of `count` groups of poses, without NaN: of positions, and chordal of rotations."""
    translation = pose.translation.reshape(count, -1, 3)
    seen = np.isfinite(translation[:, :, 0]).sum(axis=1)
    rotation = nearest_rotations(np.nansum(pose.rotation.reshape(count, -1, 3, 3), axis=1))
    rotation[seen == 0] = np.nan
    with np.errstate(invalid="ignore"):  # none seen: 0 / 0
        return Pose(rotation, np.nansum(translation, axis=1) / seen[:, None])


def write_simulated_trial(
    trial: SimulatedTrial,
    path: Path,
    geometry_file: Path | None = None,
    calibration_file: Path | None = None,
) -> None:
    """Write a simulated trial as a rosbag2 folder with its ground truth.

    Args:
        trial: The trial.
        path: Folder of the trial; it must not exist.
        geometry_file: The `socket.yaml` to store; None for the package's own.
        calibration_file: The `calibration.yaml` to store; None for the package's own.
    """
    check_new_folder(path)
    parameters = packaged("config", "simulated.yaml")
    configuration = read_configuration(geometry_file, calibration_file, parameters)
    ratios = Bridges(read_testbed(parameters).load_cell_node).ratios_at(trial.wrench)
    make_folder(path.parent)
    with atomic_output(path) as staging:
        with BagWriter(staging) as bag:
            for topic in _DELAYS:
                bag.add_topic("/" + topic.name, topic)
            for stamp, topic, message in _messages(trial, ratios):
                bag.write("/" + topic.name, stamp + _DELAYS[topic], message)
        store_configuration(staging, configuration)
        save_truth(staging / TRUTH_FILE, trial.tiles, trial.stamps, trial.truth)


def save_truth(
    path: Path,
    tiles: tuple[str, ...],
    stamps: IntArray,
    truth: GroundTruth,
    **more: FloatArray,
) -> None:
    """Write a ground truth with the names of its tiles, its times [ns], shape (N,), and more."""
    arrays: dict[str, Any] = {**vars(truth), "names": np.array(tiles), "stamps": stamps, **more}
    np.savez_compressed(path, **arrays)


def read_truth(path: Path, stamps: IntArray | None = None) -> GroundTruth:
    """Read the ground truth beside a simulated trial.

    Args:
        path: Folder of the trial.
        stamps: Times since the epoch for which it is wanted, shape (N,) [ns]; between the
            times of the simulation it is linear. None for the simulation's own.
    """
    return _read_truth(path, stamps)[0]


def read_true_forces(path: Path, stamps: IntArray, tiles: Sequence[str]) -> FloatArray | None:
    """Forces on the tiles in a trial's ground truth.

    Args:
        path: Folder of the trial.
        stamps: Times since the epoch for which they are wanted, shape (N,) [ns].
        tiles: Names of the n tiles.

    Returns:
        Force of the limb on the socket in {S}, shape (N, n, 3) [N]; None where the trial was not
        simulated, or with other tiles.
    """
    if not (path / TRUTH_FILE).is_file():
        return None
    truth, simulated = _read_truth(path, stamps)
    return truth.forces if simulated == list(tiles) else None


def _read_truth(path: Path, stamps: IntArray | None) -> tuple[GroundTruth, list[str]]:
    """The ground truth, and the names of its tiles."""
    try:
        with np.load(path / TRUTH_FILE) as data:
            times, names = data["stamps"], data["names"].tolist()
            arrays = [data[field.name] for field in fields(GroundTruth)]
        if times.ndim != 1 or len(times) < 2 or any(len(times) != len(array) for array in arrays):
            raise ValueError("its arrays differ in length")
    except Exception as error:  # it raises whatever its parsing meets
        raise TrialError(
            f"{path / TRUTH_FILE}: is damaged ({error})",
            "simulate the trial again, or remove the file",
        ) from None
    stamps = times if stamps is None else stamps
    after = np.clip(np.searchsorted(times, stamps), 1, len(times) - 1)
    span = times[after] - times[after - 1]
    share = np.clip((stamps - times[after - 1]) / span, 0.0, 1.0)
    return GroundTruth(*(_between(array, after, share) for array in arrays)), names


def _between(values: FloatArray, after: IntArray, share: FloatArray) -> FloatArray:
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((1.0 - share) * values[after - 1] + share * values[after])


def _messages(trial: SimulatedTrial, ratios: FloatArray) -> Iterator[tuple[int, Topic, bytes]]:
    """Stamps [ns], topics and messages in the order of their recording.

    Args:
        trial: The trial.
        ratios: Ratios of the load cell's bridges, shape (N, 6) [mV/V].
    """
    pack_trigger, pack_wrench, pack_pose = trigger_packer(), wrench_packer(), pose_packer()
    pack_raw = load_cell_raw_packer()
    markers = {"socket": trial.socket_markers, "pylon": trial.pylon_markers}
    pack_markers = markers_packer({name: seen.shape[1] for name, seen in markers.items()})
    pack_capacitance = capacitance_packer(list(trial.capacitance))
    capacitance = np.stack(list(trial.capacitance.values()), axis=1)
    status = np.where(np.isfinite(capacitance), Status.OK, Status.MISSING).astype(np.uint8)
    socket, pylon = (
        np.hstack([pose.translation, pose.quaternion()])
        for pose in (trial.socket_pose, trial.pylon_pose)
    )
    for k, stamp in enumerate(trial.stamps.tolist()):
        yield stamp, TRIGGER, pack_trigger(stamp, k)
        yield stamp, WRENCH, pack_wrench(stamp, trial.wrench[k])
        yield stamp, LOAD_CELL_RAW, pack_raw(stamp, ratios[k], np.zeros(6), 0, Status.OK)
        yield stamp, SOCKET_POSE, pack_pose(stamp, socket[k])
        yield stamp, PYLON_POSE, pack_pose(stamp, pylon[k])
        yield stamp, MARKERS, pack_markers(stamp, [seen[k] for seen in markers.values()])
        yield stamp, CAPACITANCE, pack_capacitance(stamp, capacitance[k], status[k])
