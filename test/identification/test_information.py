"""Who bears the load, how far the pose moves beyond its noise, and what noise is known to be."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import problems
from support.problems import GEOMETRY, make_samples, random_socket

from socket_testbed.identification import information, noise
from socket_testbed.identification.suspension import find_suspension
from socket_testbed.samples import Samples, Status, turned


def moving(rng, geometry, motion, sd, count=400):
    """Samples whose pose moves slowly by `motion` with noise `sd`, (6,) each; any limb frame."""
    phase = np.linspace(0.0, 2.0 * np.pi, count)[:, None] * [3, 4, 5, 6, 7, 8]
    pose = np.sqrt(2.0) * np.array(motion) * np.sin(phase) + rng.normal(0.0, sd, (count, 6))
    pose[:, 3:] = turned(pose[:, 3:], rng.normal(size=3))
    return make_samples(pose, np.zeros((count, 6)), {})


def bed_with_samples(rng):
    bed = problems.random_bed(rng, random_socket(rng), "stiffness_bias")
    return bed, problems.samples_of_bed(rng, bed, problems.moving_limb(rng, 30))


@pytest.mark.parametrize(
    ("name", "part"),
    [("Fz", [5]), ("force", [3, 4, 5]), ("moment", [0, 1, 2])],
    ids=["Fz", "force", "moment"],
)
def test_the_shares_of_a_bed_are_its_own(rng, name: str, part: list[int]):
    bed, samples = bed_with_samples(rng)
    shares = {share.name: share for share in information.load_shares(samples, bed)}
    assert set(shares) == {"Fz", "force", "moment"}
    share = shares[name]
    assert share.springs + share.offsets + share.residual == pytest.approx(1.0)
    assert share.residual == pytest.approx(0.0, abs=1e-9)
    measured = samples.wrench[:, part]
    by_hand = np.sum(bed.wrench_bias[part] * measured) / np.sum(measured**2)
    assert share.offsets == pytest.approx(by_hand)


def test_channels_never_measured_have_no_share(rng):
    bed, samples = bed_with_samples(rng)
    samples.wrench[:, 1] = np.nan  # My was never measured
    samples.position[3] = np.nan
    assert np.isnan(information.load_shares(samples, bed)[2].springs)
    assert information.load_shares(samples, bed)[0].residual == pytest.approx(0.0, abs=1e-9)


def test_motion_is_told_from_noise(rng):
    geometry = random_socket(rng)  # along z
    motion = np.array([1e-4, 2e-3, 1e-3, 2e-3, 2e-2, 0.0])
    known = np.array([2e-4, 2e-4, 1e-4, 1e-3, 1e-3, 1e-3])
    found = information.measure_motion(moving(rng, geometry, motion, known), geometry)
    for excitation, moved, noisy in zip(found.excitations, motion, known, strict=True):
        assert excitation.noise == pytest.approx(noisy, rel=0.15)
        assert excitation.motion == pytest.approx(moved, rel=0.15, abs=0.5 * noisy)
    enough = [excitation.sufficient for excitation in found.excitations]
    assert enough == [False, True, True, False, True, False]
    assert found.directions == 3
    assert str(found.excitations[5]).endswith("twist the limb in the socket")


def test_motion_above_unknown_noise_is_insufficient(rng):
    geometry = random_socket(rng)
    unknown = information.measure_motion(moving(rng, geometry, [1e-3] * 6, [0.0] * 6, 8), geometry)
    assert unknown.directions == 0
    assert all("unknown noise" in str(excitation) for excitation in unknown.excitations)


def test_springs_are_engaged_in_compression(rng, monkeypatch):
    """A limb at rest, turned far from {S}, whose pose has noise: no formula but the motion."""
    monkeypatch.setattr(information, "_BLOCK", 700)
    count, centre = 3000, np.array([0.01, -0.02, 0.13])
    bed = replace(
        problems.random_bed(rng, random_socket(rng, 4, 8), "rigid_bias", untouched=0.2),
        reference_pose=np.array([*centre, 1.6, -0.9, 1.2]),
        rest_positions=rng.uniform(-4e-4, 4e-4, (32, 3)),
    )
    shifts, turns = rng.normal(0.0, 1e-4, (count, 3)), rng.normal(0.0, 2e-3, (count, 3))
    turned = Rotation.from_rotvec(turns) * Rotation.from_rotvec([1.6, -0.9, 1.2])
    pose = np.hstack([centre + shifts, turned.as_rotvec()])
    pose[5] = np.nan
    samples = make_samples(pose, np.zeros((count, 6)), {})
    found = information.engagement(samples, bed, rows=slice(4, 2000))
    # Along the normal of each tile, at its centre.
    arms = np.stack([Rotation.from_rotvec(turns).apply(a - centre) for a in bed.anchors], 1)
    moved = shifts[:, None] + arms - (bed.anchors - centre)
    delta = np.einsum("kni,ni->kn", moved, bed.rotations[:, :, 2]) - bed.rest_positions[:, 2]
    stiff = bed.stiffness.any(axis=1)
    uncertain = ((np.abs(delta) < delta.std(axis=0)) & stiff).sum(axis=1).mean()
    assert uncertain > 2.0
    assert np.nanmean(found.uncertain) == pytest.approx(uncertain, rel=0.04)
    pressed = (delta < 0.0) & stiff
    assert np.flatnonzero(np.isnan(found.engaged)).tolist() == [5] and found.springs == 32
    assert np.nanmean(found.engaged) == pytest.approx(pressed.sum(axis=1).mean(), rel=1e-3)
    chosen = np.delete(pressed, 5, axis=0)[4:1999].mean(axis=0)
    np.testing.assert_allclose(found.time_share[:, 0], chosen, atol=5e-3)


# --- How the limb sits: a suspension that is known, a linear one

SIZES = np.array([4e4, 4e4, 9e4, 150.0, 150.0, 60.0])  # [N/m, N m/rad]


def suspended(seed: int, moments: float = 1.0, count: int = 400) -> tuple[np.ndarray, Samples]:
    """A random stiffness about the tiles' centre, and noisy samples of a limb that it holds."""
    rng, centre = np.random.default_rng(seed), GEOMETRY.anchors.mean(axis=0)
    mixed = np.eye(6) + 0.12 * rng.normal(size=(6, 6))
    stiffness = np.sqrt(SIZES)[:, None] * (mixed @ mixed.T) * np.sqrt(SIZES)
    time = np.linspace(0.0, 40.0, count)
    phases = 2.0 * np.pi * time[:, None, None] / 40.0 * np.arange(1.0, 7.0)
    waves = np.sin(phases + rng.uniform(0.0, 6.28, (6, 6))) * rng.normal(size=(6, 6))
    load = waves.sum(axis=2) * [20.0, 20.0, 60.0, 2.0 * moments, 2.0 * moments, 0.5 * moments]
    moved = load @ np.linalg.inv(stiffness).T
    origin = np.array([0.0, 0.0, 0.15])
    position = origin + moved[:, :3] - np.cross(moved[:, 3:], centre - origin)
    force = load[:, :3] + [0.0, 0.0, -200.0]
    wrench = np.hstack([load[:, 3:] + np.cross(centre, force), force])
    wrench += rng.normal(0.0, [0.02] * 3 + [0.2] * 3, (count, 6))
    position += rng.normal(0.0, 2e-5, position.shape)
    rotation = turned(moved[:, 3:] + rng.normal(0.0, 1e-4, (count, 3)), rng.normal(size=3))
    return stiffness, make_samples(np.hstack([position, rotation]), wrench, {})


def test_a_linear_suspension_is_within_its_intervals() -> None:
    held = []
    for seed in range(6):
        known, samples = suspended(seed)
        found = find_suspension(samples, GEOMETRY)
        assert found is not None
        stiffness = found.stiffness
        np.testing.assert_allclose(np.diag(stiffness.value), np.diag(known), rtol=0.1)
        held.append((stiffness.low <= known) & (known <= stiffness.high))
        assert found.pistoning.low <= found.pistoning.value <= found.pistoning.high
    assert np.mean(held) > 0.88


def test_a_suspension_without_moments_has_no_stiffness() -> None:
    _, samples = suspended(0, moments=0.0)  # no load in every direction
    found = find_suspension(samples, GEOMETRY)
    assert found is not None and not found.stiffness.certain().any()
    assert np.isfinite(found.pistoning.value)


def test_no_pose_shows_no_suspension() -> None:
    _, samples = suspended(0, moments=0.0)
    samples.position[:] = np.nan
    assert find_suspension(samples, GEOMETRY) is None


# --- The noise of every channel: what is known of it comes back


WRENCH_NOISE = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.4])  # [N m, N]
LOCAL_NOISE = np.array([[0.05, 0.06, 0.02], [0.5, 0.1, 0.3]])  # [N]
POSE_NOISE = np.array([2e-4, 1e-4, 5e-5, 1e-4, 2e-4, 5e-5])  # [m, rad]


def noisy_samples(seed: int, count: int = 800) -> Samples:
    """Slow motion, 100 times larger than its white noise."""
    rng = np.random.default_rng(seed)
    sizes = np.concatenate([POSE_NOISE, WRENCH_NOISE, LOCAL_NOISE.ravel()])
    time, phase = 0.25 * np.arange(count)[:, None], rng.uniform(0.0, 2.0 * np.pi, sizes.shape)
    slow = 100.0 * (np.sin(2.0 * np.pi * time / 20.0 + phase) + 0.02 * time)
    values = sizes * (slow + rng.normal(size=(count, len(sizes))))
    brim, distal = values[:, 12:15], values[:, 15:]
    return make_samples(values[:, :6], values[:, 6:12], {"brim": brim, "distal": distal})


def spoilt_samples() -> Samples:
    """Noisy samples with outliers, steps, gaps and forces that nobody trusts."""
    samples, rng = noisy_samples(20, 1600), np.random.default_rng(21)
    for array in (samples.position, samples.rotation, samples.wrench, samples.local_forces):
        motion = array.std(axis=0)  # some 100 times the noise
        array[rng.choice(1600, 48, replace=False)] += 10.0 * motion  # 3 %
        array[300:] += motion
    samples.status[100:180, 0] = Status.OUT_OF_RANGE
    samples.local_forces[100:180, 0] = rng.normal(0.0, 1e3, (80, 3))
    samples.wrench[rng.random(samples.wrench.shape) < 0.05] = np.nan
    samples.position[rng.random(1600) < 0.05] = np.nan
    kept = np.sort(rng.choice(1600, 1500, replace=False))  # triggers were lost
    return samples[kept[(kept < 400) | (kept > 700)]]


@pytest.mark.parametrize(
    "make", [lambda: noisy_samples(80), spoilt_samples], ids=["sound", "spoilt"]
)
def test_known_noise_comes_back(make):
    found = noise.channel_noise(make())
    np.testing.assert_allclose(found.wrench, WRENCH_NOISE, rtol=0.15)
    np.testing.assert_allclose(found.local_forces, LOCAL_NOISE, rtol=0.15)
    np.testing.assert_allclose(found.pose, POSE_NOISE, rtol=0.15)


def test_motion_and_engagement_estimate_the_noise_of_the_pose_alone(rng, monkeypatch):
    bed, samples = bed_with_samples(rng)
    estimated, estimate = [], noise._deviation
    monkeypatch.setattr(noise, "_deviation", lambda *of: estimated.append(of) or estimate(*of))
    information.measure_motion(samples, GEOMETRY)
    information.engagement(samples, bed)
    assert len(estimated) == 2 * 6  # components of a pose


def test_a_quantised_channel_has_the_noise_of_steps():
    samples = noisy_samples(40)
    slow = np.sin(2.0 * np.pi * samples.time[:, None] / 60.0)
    coarse = replace(samples, wrench=np.round(np.tile(slow, 6), 1))  # [N]; without noise
    found = noise.channel_noise(coarse).wrench
    np.testing.assert_allclose(found, 0.1 / np.sqrt(12.0), rtol=0.01)


@pytest.mark.parametrize("count", [0, 3, noise.MIN_DIFFERENCES + 2])
def test_few_values_have_no_noise(count: int):
    assert np.isnan(noise.channel_noise(noisy_samples(40)[:count]).values).all()


def test_constant_and_missing_channels_have_no_noise():
    samples = noisy_samples(40)
    samples.wrench[:, 0], samples.wrench[:, 1] = 0.0, np.nan
    assert np.isnan(noise.channel_noise(samples).wrench).tolist() == [True] * 2 + [False] * 4


def test_smoothing_keeps_linear_motion():
    samples = noisy_samples(91)
    drift = np.outer(samples.time, POSE_NOISE)
    steady = replace(samples, position=drift[:, :3], rotation=drift[:, 3:])
    # Rotations about different axes do not add up exactly: (0.4 rad)^2 of some mrad.
    np.testing.assert_allclose(noise.smooth_poses(steady, 2.0).pose, drift, atol=2e-5)


def test_smoothing_averages_the_noise(rng):
    samples, jitter = noisy_samples(91), POSE_NOISE * rng.normal(size=(800, 6))
    still = replace(samples, position=jitter[:, :3], rotation=jitter[:, 3:])
    ratio = noise.smooth_poses(still, 2.0).pose.std(axis=0) / jitter.std(axis=0)
    np.testing.assert_allclose(ratio, 1.0 / 3.0, rtol=0.15)  # nine samples at 4 Hz
    assert noise.smoothing_gain(still, 2.0) == pytest.approx(1.0 / 9.0, rel=0.05)


def test_smoothing_does_not_reach_across_a_gap():
    """It fills nothing that is missing."""
    samples, late = noisy_samples(92, 40), np.arange(40) >= 20
    position = 0.01 * late[:, None] * np.ones(3)
    position[30] = np.nan
    stamps = samples.stamps + 500_000_000 * late
    apart = replace(samples, stamps=stamps, position=position)
    smooth = noise.smooth_poses(apart, 4.0)
    np.testing.assert_allclose(smooth.position, position, atol=1e-15)
    assert np.isnan(smooth.rotation[30]).all() and np.isfinite(smooth.rotation[29]).all()


def test_smoothing_holds_in_any_frame():
    samples = noisy_samples(92, 40)
    around = Rotation.from_rotvec([0.0, 0.0, np.pi])  # rotation vectors jump there
    vectors = (around * Rotation.from_rotvec(samples.rotation)).as_rotvec()
    turned = noise.smooth_poses(replace(samples, rotation=vectors), 2.0).rotation
    expected = around * Rotation.from_rotvec(noise.smooth_poses(samples, 2.0).rotation)
    assert (expected.inv() * Rotation.from_rotvec(turned)).magnitude().max() < 1e-12
