"""The noise of every channel: what is known of it comes back, what is no noise does not matter."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.problems import make_samples

from socket_testbed.identification.noise import (
    LEAST_DIFFERENCES,
    channel_noise,
    smooth_poses,
    smoothing_gain,
)
from socket_testbed.samples import Samples, Status

WRENCH_NOISE = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.4])  # [N m, N]
LOCAL_NOISE = np.array([[0.05, 0.06, 0.02], [0.5, 0.1, 0.3]])  # [N]
POSE_NOISE = np.array([2e-4, 1e-4, 5e-5, 1e-3, 2e-3, 5e-4])  # [m, rad]


def noisy_samples(seed: int, count: int = 800) -> Samples:
    """Slow motion, 100 times larger than its white noise."""
    rng = np.random.default_rng(seed)
    noise = np.concatenate([POSE_NOISE, WRENCH_NOISE, LOCAL_NOISE.ravel()])
    time, phase = 0.25 * np.arange(count)[:, None], rng.uniform(0.0, 2.0 * np.pi, noise.shape)
    slow = 100.0 * (np.sin(2.0 * np.pi * time / 20.0 + phase) + 0.02 * time)
    values = noise * (slow + rng.normal(size=(count, len(noise))))
    brim, distal = values[:, 12:15], values[:, 15:]
    return make_samples(values[:, :6], values[:, 6:12], {"brim": brim, "distal": distal})


def test_known_noise_comes_back_whatever_outliers_steps_gaps_and_untrusted_forces_there_are():
    samples, rng = noisy_samples(20, 1600), np.random.default_rng(21)
    for array in (samples.position, samples.rotation, samples.wrench, samples.local_forces):
        array[rng.choice(1600, 48, replace=False)] += 1e3 * array.std(axis=0)  # 3 %
        array[300:] += 50.0 * array.std(axis=0)
    samples.status[100:180, 0] = Status.OUT_OF_RANGE
    samples.local_forces[100:180, 0] = rng.normal(0.0, 1e3, (80, 3))
    samples.wrench[rng.random(samples.wrench.shape) < 0.05] = np.nan
    samples.position[rng.random(1600) < 0.05] = np.nan
    kept = np.sort(rng.choice(1600, 1500, replace=False))  # triggers were lost
    for spoilt in (noisy_samples(80), samples[kept[(kept < 400) | (kept > 700)]]):
        found = channel_noise(spoilt)
        np.testing.assert_allclose(found.wrench, WRENCH_NOISE, rtol=0.15)
        np.testing.assert_allclose(found.local_forces, LOCAL_NOISE, rtol=0.15)
        np.testing.assert_allclose(found.pose, POSE_NOISE, rtol=0.15)


def test_a_quantised_channel_has_the_noise_of_its_steps_and_few_values_have_none():
    samples = noisy_samples(40)
    slow = np.sin(2.0 * np.pi * samples.time[:, None] / 60.0)
    coarse = replace(samples, wrench=np.round(np.tile(slow, 6), 1))  # [N]; without noise
    found = channel_noise(coarse).wrench
    np.testing.assert_allclose(found, 0.1 / np.sqrt(12.0), rtol=0.01)
    for count in (0, 3, LEAST_DIFFERENCES + 2):
        assert np.isnan(channel_noise(samples[:count]).values).all()
    samples.wrench[:, 0], samples.wrench[:, 1] = 0.0, np.nan
    assert np.isnan(channel_noise(samples).wrench).tolist() == [True] * 2 + [False] * 4


def test_smoothing_keeps_linear_motion_and_averages_the_noise(rng):
    samples, noise = noisy_samples(91), POSE_NOISE * rng.normal(size=(800, 6))
    drift = np.outer(samples.time, POSE_NOISE)
    still, steady = (
        replace(samples, position=pose[:, :3], rotation=pose[:, 3:]) for pose in (noise, drift)
    )
    # Rotations about different axes do not add up exactly: (0.4 rad)^2 of some mrad.
    np.testing.assert_allclose(smooth_poses(steady, 2.0).pose, drift, atol=2e-5)
    ratio = smooth_poses(still, 2.0).pose.std(axis=0) / noise.std(axis=0)
    np.testing.assert_allclose(ratio, 1.0 / 3.0, rtol=0.15)  # nine samples at 4 Hz
    assert smoothing_gain(still, 2.0) == pytest.approx(1.0 / 9.0, rel=0.05)


def test_smoothing_does_not_reach_across_a_gap_fills_nothing_and_holds_in_any_frame():
    samples, late = noisy_samples(92, 40), np.arange(40) >= 20
    position = 0.01 * late[:, None] * np.ones(3)
    position[30] = np.nan
    stamps = samples.stamps + 500_000_000 * late
    apart = replace(samples, stamps=stamps, position=position)
    smooth = smooth_poses(apart, 4.0)
    np.testing.assert_allclose(smooth.position, position, atol=1e-15)
    assert np.isnan(smooth.rotation[30]).all() and np.isfinite(smooth.rotation[29]).all()
    around = Rotation.from_rotvec([0.0, 0.0, np.pi])  # rotation vectors jump there
    vectors = (around * Rotation.from_rotvec(samples.rotation)).as_rotvec()
    turned = smooth_poses(replace(samples, rotation=vectors), 2.0).rotation
    expected = around * Rotation.from_rotvec(smooth_poses(samples, 2.0).rotation)
    assert (expected.inv() * Rotation.from_rotvec(turned)).magnitude().max() < 1e-12
