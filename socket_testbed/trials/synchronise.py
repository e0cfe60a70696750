"""Synchronised samples of a trial: calibrated stresses and limb positions, one row a trigger."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.calibration import Status
from socket_testbed.errors import TrialError
from socket_testbed.geometry.pose import Pose
from socket_testbed.samples import Samples
from socket_testbed.trials.measurements import Measurements, decode_message, read_measurements
from socket_testbed.trials.topics import CAPACITANCE
from socket_testbed.trials.trial import Trial, required_topics
from socket_testbed.trials.unloaded import take_off_drift


def check_trial(trial: Trial) -> tuple[str, ...]:
    """Refuse a trial that cannot be worked on, before long work or a graph is started.

    Returns:
        Names of the trial's clusters.

    Raises:
        TrialError: If the trial cannot be read or lacks a topic.
        CalibrationError: If the calibration lacks a cluster of the trial.
        ConfigurationError: If the stored configuration is wrong.
    """
    with trial.open() as bag:
        name = required_topics(bag)[CAPACITANCE]
        first = next(bag.messages([name]))
    clusters = tuple(cluster.name for cluster in decode_message(trial, first).clusters)
    _require_clusters(clusters, trial)
    return clusters


def read_samples(trial: Trial) -> Samples:
    """Read a trial as synchronised samples, one a trigger.

    The stresses are computed anew from the capacitances with the trial's calibration.

    Args:
        trial: The trial.

    Returns:
        Samples in the order of their stamps; what is missing at a trigger is NaN.

    Raises:
        TrialError: If the trial cannot be read or lacks a topic.
        CalibrationError: If the calibration lacks a cluster of the trial.
        ConfigurationError: If the stored configuration is wrong.
    """
    return make_samples(trial, read_measurements(trial))


def make_samples(trial: Trial, measured: Measurements) -> Samples:
    """Samples from the measurements of a trial; see `read_samples`."""
    _require_clusters(measured.clusters, trial)
    if trial.unloaded:
        measured = take_off_drift(trial, measured)
    local_forces, status = _local_forces(trial, measured)
    socket, pylon = (
        Pose.from_quaternion(pose[:, :3], pose[:, 3:]) for pose in (measured.socket, measured.pylon)
    )
    return Samples(
        stamps=measured.stamps,
        position=trial.geometry.limb_position(socket, pylon),
        wrench=measured.wrench,
        clusters=measured.clusters,
        local_forces=local_forces,
        status=status,
    )


def _local_forces(trial: Trial, measured: Measurements) -> tuple[FloatArray, StatusArray]:
    shape = (len(measured.stamps), len(measured.clusters))
    forces = np.full((*shape, 3), np.nan)
    status = np.full(shape, Status.MISSING, dtype=np.uint8)
    for column, name in enumerate(measured.clusters):
        stress, status[:, column] = trial.calibration.clusters[name].apply(
            measured.capacitance[:, column], measured.status[:, column]
        )
        forces[:, column] = trial.geometry.cluster_force(name, stress)
    return forces, status


def _require_clusters(clusters: Collection[str], trial: Trial) -> None:
    trial.calibration.require(clusters, f"the trial {trial.path}")
    for name in clusters:
        if name not in trial.geometry.clusters:
            raise TrialError(
                f"{trial.path}: its cluster '{name}' is on no tile of the socket"
                f" (which has {', '.join(trial.geometry.clusters)})",
                "give the socket.yaml of this trial with --geometry",
            )
