"""Noise of the simulated cameras, and what the mean over a trigger's period leaves of it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from socket_testbed.calibration.model import read_calibration
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.simulation.sensor_errors import SensorErrors
from socket_testbed.simulation.sensors import CAMERA_RATE
from socket_testbed.simulation.trial import simulate
from socket_testbed.socket_design.motive import read_motive_csv

PERFECT = SensorErrors(**{field.name: 0.0 for field in dataclasses.fields(SensorErrors)})


def differences(markers: np.ndarray) -> np.ndarray:
    """Noise of a coordinate by third differences: what moves slowly drops out."""
    return np.asarray(np.diff(markers, 3, axis=0) / np.sqrt(20.0))


def test_the_noise_of_a_marker_is_that_of_a_real_take(shared_data: Path) -> None:
    """`sample_optitrack_take.csv` of cmuphyscomp/hmv-s16: a triad of 0.2 m, 250 frames at 120 Hz.

    At rest for 0.7 s, then it drifts by 0.4 mm: the differences leave the noise alone.
    """
    take = read_motive_csv(shared_data / "motive_csv" / "sample_optitrack_take.csv")
    markers = take.stack(take.markers_of("Rigid Body 1"))
    noise = np.sqrt(np.mean(differences(markers) ** 2))
    assert noise == pytest.approx(SensorErrors.marker_noise, rel=0.15)
    # White: a mean of n frames has the noise divided by the root of n.
    for frames in (2, 4):
        means = np.array([markers[k : k + frames].mean(axis=0) for k in range(0, 248, frames)])
        left = np.sqrt(np.mean(differences(means) ** 2))
        assert left == pytest.approx(noise / np.sqrt(frames), rel=0.2)


@pytest.fixture(scope="module")
def geometry():
    return read_socket(packaged("config", "socket.yaml"))


def measure(geometry, window: float, rate: float = 4.0, **errors: float) -> tuple[np.ndarray, ...]:
    """Errors of the limb's measured position [m], and the pylon's measured markers."""
    trial = simulate(
        geometry,
        read_calibration(packaged("config", "calibration.yaml")),
        "ramp",
        100.0 / rate,
        rate,
        seed=2,
        errors=dataclasses.replace(PERFECT, **errors),
        mocap_window=window,
    )
    limb = geometry.limb_pose(trial.socket_pose, trial.pylon_pose)
    return limb.translation - trial.truth.position, trial.pylon_markers


def test_the_mean_over_the_window_averages_the_cameras_noise(geometry) -> None:
    single, _ = measure(geometry, 0.0, marker_noise=5e-5)
    for rate, window in ((4.0, 0.25), (20.0, 0.05)):
        perfect, _ = measure(geometry, 0.25, rate)
        averaged, _ = measure(geometry, 0.25, rate, marker_noise=5e-5)
        frames = 2 * int(0.5 * window * CAMERA_RATE) + 1
        expected = single.std(axis=0) / np.sqrt(frames)
        np.testing.assert_allclose((averaged - perfect).std(axis=0), expected, rtol=0.35)


def test_the_mean_over_the_window_does_not_lag(geometry) -> None:
    error, _ = measure(geometry, 0.25)
    moved, _ = measure(geometry, 0.0)
    assert np.abs(moved).max() < 1e-9
    speed = 0.008 * np.pi / 30.0  # [m/s]; of the limb's settling under the ramp
    assert np.abs(error.mean(axis=0)).max() < 0.01 * 0.125 * speed


def test_a_pose_needs_one_frame_that_shows_the_body(geometry) -> None:
    error, markers = measure(geometry, 0.25, drop_out=0.3)
    assert np.isfinite(error).all()
    assert np.isnan(markers[:, :, 0]).mean() == pytest.approx(0.3, abs=0.1)
    assert np.isnan(measure(geometry, 0.25, drop_out=1.0)[0]).all()
