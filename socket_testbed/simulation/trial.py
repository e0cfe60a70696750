"""Simulated trials: a load history, the physics, the sensors, and the files.

A simulated trial is a bag like a recorded one, plus the ground truth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.calibration.model import Calibration
from socket_testbed.drivers.load_cell.load_cell import Bridges
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import (
    PARAMETERS_FILE,
    REPLACE_HINT,
    atomic_output,
    check_new_folder,
    make_folder,
    packaged,
)
from socket_testbed.geometry.marker_bodies import fit_body, nearest_rotations
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.samples import Status
from socket_testbed.settings.acquisition import LoadCellSettings, MocapSettings, averaging_span
from socket_testbed.settings.options import Scenario, SimulationOptions, TissueKind
from socket_testbed.settings.testbed import read_testbed
from socket_testbed.simulation import sensors
from socket_testbed.simulation.limb import LoadedLimb, draw_donning, load_history
from socket_testbed.trials.bag import BagWriter
from socket_testbed.trials.trial import read_configuration, store_configuration
from socket_testbed.trials.truth import TRUTH_FILE, GroundTruth, save_truth
from socket_testbed.wire import messages, topics

# Delay of each measurement after its trigger [ns].
_DELAYS = {
    topics.TRIGGER: 0,
    topics.WRENCH: 3_000_000,
    topics.LOAD_CELL_RAW: 3_100_000,
    topics.SOCKET_POSE: 8_000_000,
    topics.PYLON_POSE: 8_100_000,
    topics.MARKERS: 8_200_000,
    topics.CAPACITANCE: 17_000_000,
}
_MAX_FRAMES = 50_000  # at once
_LEAVE_OUT = """estimator_node:
  ros__parameters:
    # Implausible, so left out of the objective.
    identification.leave_out: [{}]
"""
_START = 1_767_258_000_000_000_000  # [ns]; 2026-01-01 09:00 UTC


@dataclass(frozen=True)
class SimulatedTrial:
    """The measurements and the truth, one row per trigger.

    Attributes:
        stamps: Times of the triggers since the epoch, shape (N,) [ns].
        capacitance: Capacitances by the cluster's name and the converter's input, shape (N, 4) each
            [pF].
        wrench: Measured wrench [M; F] in {S}, tared, shape (N, 6) [N m, N].
        markers: Observed markers in the world at the trigger, by the body's name (`socket`,
            `pylon`) and the label, shape (N, k, 3) each [m]; NaN if occluded.
        poses: Mean poses of each body in the world in the frames around the trigger, by the body's
            name, N each; NaN if no frame shows it.
        truth: The truth at the triggers.
    """

    stamps: IntArray
    capacitance: dict[str, FloatArray]
    wrench: FloatArray
    markers: dict[str, FloatArray]
    poses: dict[str, Pose]
    truth: GroundTruth


def random_streams(seed: int, donning: int | None = None) -> tuple[np.random.Generator, ...]:
    """Separate streams for tissue, load, load cell, clusters, markers, vibration and donning.

    The size of one error does not affect the other parts. Another donning of a limb has the same
    tissue, and other random numbers for everything else.

    Args:
        seed: Seed of the limb and, without a donning, of everything else.
        donning: Seed of a donning; None for the nominal one.
    """
    streams = np.random.default_rng(seed).spawn(7)
    if donning is None:
        return tuple(streams)
    return streams[0], *np.random.default_rng([seed, donning]).spawn(6)


def simulate(
    geometry: SocketGeometry,
    calibration: Calibration,
    scenario: Scenario,
    duration: float,
    rate: float,
    seed: int,
    errors: sensors.SensorErrors | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    tissue: TissueKind = "soft",
    mocap_window: float = MocapSettings.window,
    donning: int | None = None,
    donning_share: float = SimulationOptions.donning_share,
) -> SimulatedTrial:
    """Simulate a trial with the lab's geometry and calibration.

    Args:
        geometry: The nominal geometry; the sensors differ from it by `errors`.
        calibration: The nominal calibration; one without a cluster of the geometry raises a
            `CalibrationError`.
        scenario: The load history, see `load_history`.
        duration: Duration [s]; there are duration times rate triggers, at least two.
        rate: Rate of the trigger [Hz].
        seed: Seed of the random numbers: of the limb, its load and all errors.
        errors: Sizes of the sensors' errors; None for the default ones.
        progress: Called after each trigger with the number of those simulated and the total.
        tissue: Kind of the limb's tissue, see `make_tissue`.
        mocap_window: Span of the frames averaged around a trigger [s]; negative for the trigger's
            period, 0.25 s at most; 0 for a single frame.
        donning: Seed of another donning of the same limb, with load, sensors and errors of its own;
            None for the nominal one.
        donning_share: How much such a donning differs, see `draw_donning` [-].
    """
    calibration.require(geometry.clusters, "the socket")
    errors = errors or sensors.SensorErrors()
    streams = random_streams(seed, donning)
    tissue_rng, load_rng, cell_rng, cluster_rng, marker_rng, shake_rng, donning_rng = streams
    count = max(2, round(duration * rate))
    time = np.arange(count) / rate
    load = load_history(scenario, time, load_rng)
    donned = None if donning is None else draw_donning(donning_share, donning_rng)
    limb = LoadedLimb(geometry, load[0], tissue_rng, tissue, donned)
    forces = np.zeros((count, len(geometry), 3))
    position, rotation = np.zeros((2, count, 3))
    for k, wrench in enumerate(load):
        forces[k] = limb.step(wrench, 1.0 / rate)
        position[k], rotation[k] = limb.position, limb.rotation
        progress(k + 1, count)
    truth = GroundTruth(geometry.names, forces, load, position, rotation)

    capacitance = {}
    for cluster in geometry.clusters:
        own = errors.clusters.get(cluster)
        sensor = sensors.ClusterSensor(calibration.clusters[cluster], errors, cluster_rng, own)
        stress = sensors.cluster_stress(geometry, cluster, forces)
        size = errors.stress_vibration * shake_rng.uniform(0.5, 1.5, 3)
        size = size if own is None else np.array(own.vibration)
        stress += sensors.vibration(size, time, shake_rng)
        capacitance[cluster] = sensor.read(stress, time, cluster_rng)
    felt = load + sensors.wrench_offset(errors, cell_rng)
    noise = errors.wrench_noise(averaging_span(LoadCellSettings.average_over, 1.0 / rate))
    felt += cell_rng.normal(0.0, 1.0, load.shape) * noise
    felt += sensors.wrench_creep(errors, load, time, cell_rng)
    felt += sensors.vibration(np.array(errors.wrench_vibration), time, shake_rng)

    window = averaging_span(mocap_window, 1.0 / rate)
    markers, poses = _motion_capture(geometry, truth, rate, window, errors, marker_rng)
    stamps = _START + np.round(time * 1e9).astype(np.int64)
    return SimulatedTrial(stamps, capacitance, felt, markers, poses, truth)


def _motion_capture(
    geometry: SocketGeometry,
    truth: GroundTruth,
    rate: float,
    window: float,
    errors: sensors.SensorErrors,
    rng: np.random.Generator,
) -> tuple[dict[str, FloatArray], dict[str, Pose]]:
    """Markers of both bodies at each trigger and their mean poses in the window around it.

    The limb's motion is linear between triggers and extrapolated at either end.
    """
    bodies = sensors.MarkerBodies(geometry, errors, rng)
    reach = int(0.5 * window * sensors.CAMERA_RATE)
    offsets = np.arange(-reach, reach + 1) * rate / sensors.CAMERA_RATE  # [triggers]
    count = len(truth.wrench)
    markers = {name: np.empty((count, *own.shape)) for name, own in geometry.markers.items()}
    poses = {name: Pose(np.empty((count, 3, 3)), np.empty((count, 3))) for name in markers}
    motions = [
        make_interp_spline(np.arange(count), values, k=1)
        for values in (truth.position, truth.rotation, truth.wrench)
    ]
    chunks = 1 + count * len(offsets) // _MAX_FRAMES
    for rows in np.array_split(np.arange(count), chunks):
        at = (rows[:, None] + offsets).ravel()
        true = bodies.poses(*(motion(at) for motion in motions))
        for pose, (name, own) in zip(true, geometry.markers.items(), strict=True):
            seen = sensors.observe_markers(pose, own, errors, rng)
            markers[name][rows] = seen[reach :: len(offsets)]
            mean = _mean_poses(fit_body(own, seen).pose, len(rows))
            poses[name].rotation[rows] = mean.rotation
            poses[name].translation[rows] = mean.translation
    return markers, poses


def _mean_poses(pose: Pose, count: int) -> Pose:
    """Means of `count` groups of poses, ignoring NaN; chordal means of the rotations."""
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
    leave_out: Sequence[str] = (),
    replace: bool = False,
) -> None:
    """Write a simulated trial as a rosbag2 folder with its ground truth.

    Args:
        trial: The simulated trial.
        path: The folder.
        geometry_file: The `socket.yaml` to store with it, that of the simulation; None for the
            package's own.
        calibration_file: The `calibration.yaml` to store with it, that of the simulation; None for
            the package's own.
        leave_out: Channels, such as `distal.Fx`, that the settings stored with it leave out of the
            identification; those of clusters that the trial lacks are not stored.
        replace: As in `check_trial_folder`.

    Raises:
        ConfigurationError: If the folder exists and is not to be replaced, or cannot be written.
    """
    check_trial_folder(path, replace)
    parameters = packaged("config", "simulated.yaml")
    configuration = read_configuration(geometry_file, calibration_file, parameters)
    left_out = [name for name in leave_out if name.rpartition(".")[0] in trial.capacitance]
    if left_out:
        configuration[PARAMETERS_FILE] += _LEAVE_OUT.format(", ".join(left_out)).encode()
    ratios = Bridges(read_testbed(parameters).load_cell_node).ratios_at(trial.wrench)
    make_folder(path.parent)
    with atomic_output(path, replace) as staging:
        with BagWriter(staging) as bag:
            for topic in _DELAYS:
                bag.add_topic("/" + topic.name, topic)
            for stamp, topic, message in _messages(trial, ratios):
                bag.write("/" + topic.name, stamp + _DELAYS[topic], message)
        store_configuration(staging, configuration)
        save_truth(staging / TRUTH_FILE, trial.stamps, trial.truth)


def check_trial_folder(path: Path, replace: bool) -> None:
    """Check the folder of a new simulated trial before any work.

    Args:
        path: The folder.
        replace: Whether an older simulated trial there may be replaced; nothing else ever is.

    Raises:
        ConfigurationError: If the folder exists and is not to be replaced, or is not a simulated
            trial, or cannot be made there.
    """
    is_simulated = (path / TRUTH_FILE).is_file()
    if is_simulated and not replace:
        raise ConfigurationError(f"{path} exists already", REPLACE_HINT)
    if not (replace and path.exists()):
        check_new_folder(path)
    elif not is_simulated:
        raise ConfigurationError(
            f"{path} is not a simulated trial, and only such a one is replaced",
            "name another folder",
        )


def _messages(
    trial: SimulatedTrial, ratios: FloatArray
) -> Iterator[tuple[int, topics.Topic, bytes]]:
    """Stamps [ns], topics and messages; the bridges' ratios have shape (N, 6) [mV/V]."""
    pack_trigger, pack_wrench = messages.trigger_packer(), messages.wrench_packer()
    pack_pose, pack_raw = messages.pose_packer(), messages.load_cell_raw_packer()
    sizes = {name: seen.shape[1] for name, seen in trial.markers.items()}
    pack_markers = messages.markers_packer(sizes)
    pack_capacitance = messages.capacitance_packer(list(trial.capacitance))
    capacitance = np.array([*trial.capacitance.values()]).reshape(-1, len(trial.stamps), 4)
    capacitance = capacitance.swapaxes(0, 1)
    status = np.where(np.isfinite(capacitance), Status.OK, Status.MISSING).astype(np.uint8)
    poses = {topic: trial.poses[name].vector for name, topic in topics.POSES.items()}
    for k, stamp in enumerate(trial.stamps.tolist()):
        yield stamp, topics.TRIGGER, pack_trigger(stamp, k)
        yield stamp, topics.WRENCH, pack_wrench(stamp, trial.wrench[k])
        yield stamp, topics.LOAD_CELL_RAW, pack_raw(stamp, ratios[k], np.zeros(6), 0, Status.OK)
        for topic, pose in poses.items():
            yield stamp, topic, pack_pose(stamp, pose[k])
        markers = [seen[k] for seen in trial.markers.values()]
        yield stamp, topics.MARKERS, pack_markers(stamp, markers)
        yield stamp, topics.CAPACITANCE, pack_capacitance(stamp, capacitance[k], status[k])
