"""How the limb moves and what bears its load: words, advice and intervals worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest
from support import scene
from support.problems import make_samples

from socket_testbed.identification import information, noise, suspension
from socket_testbed.identification.information import Engagement, Excitation, LoadShare
from socket_testbed.samples import Samples

GEOMETRY = scene.geometry()


# --- who bears the load


def shares(springs: float) -> tuple[LoadShare, ...]:
    return (
        LoadShare("Fz", 0.31, 0.6, 0.09),
        LoadShare("force", springs, 0.52, 0.48 - springs),
        LoadShare("moment", 0.9, 0.0, 0.1),
    )


@pytest.mark.parametrize("springs", [0.5, 0.9, np.nan])
def test_half_of_the_load_is_enough(springs: float) -> None:
    assert information.share_warning(shares(springs)) == ""


def test_the_warning_has_its_shares() -> None:
    assert information.share_warning(shares(0.42)) == (
        "the springs bear only 42 % of the measured force (31 % of Fz), the offsets 52 %: the model"
        " says little about another load"
    )


# --- how far the pose moves


@pytest.mark.parametrize(
    ("motion", "of_noise", "words"),
    [
        (0.0031, 0.001, "position z: 3.1 mm of motion, 1 of noise"),
        (0.0029, 0.001, "position z: 2.9 mm of motion, 1 of noise: load the limb"),
        (0.0031, np.nan, "position z: 3.1 mm of motion, unknown noise: load the limb"),
    ],
    ids=["enough", "too little", "unknown noise"],
)
def test_motion_is_three_times_noise(motion: float, of_noise: float, words: str) -> None:
    found = Excitation("position z", "mm", motion, of_noise, "load the limb")
    assert str(found) == words


def swinging(sizes: list[float], count: int = 400) -> Samples:
    """Components of the pose that swing by such amplitudes, with a little noise [m, rad]."""
    cycles = np.array([3, 4, 5, 6, 7, 8])
    phase = 2.0 * np.pi * np.arange(count)[:, None] / count
    white = np.random.default_rng(0).normal(0.0, 1e-5, (count, 6))
    pose = np.array(sizes) * np.sin(phase * cycles) + white
    return make_samples(pose, np.zeros((count, 6)), {})


def test_each_component_has_its_advice() -> None:
    found = information.measure_motion(swinging([1e-3] * 6), GEOMETRY).excitations
    assert [(each.name, each.unit, each.advice) for each in found] == [
        ("position x", "mm", "push from the sides"),
        ("position y", "mm", "push from the sides"),
        ("position z", "mm", "load and unload the limb"),
        ("rotation about x", "mrad", "push from the sides, high and low"),
        ("rotation about y", "mrad", "push from the sides, high and low"),
        ("rotation about z", "mrad", "twist the limb in the socket"),
    ]


def test_motion_is_without_its_noise() -> None:
    """A swing has an effective size of 1 / sqrt(2) of its amplitude."""
    sizes = [1e-3, 2e-3, 0.0, 4e-3, 5e-3, 6e-3]
    found = information.measure_motion(swinging(sizes), GEOMETRY)
    motion = [each.motion for each in found.excitations]
    np.testing.assert_allclose(motion, np.array(sizes) / np.sqrt(2.0), rtol=0.01, atol=3e-6)
    assert found.directions == 5
    np.testing.assert_allclose([each.noise for each in found.excitations], 1e-5, rtol=0.2)


def test_a_direction_counts_from_three_times_noise() -> None:
    """Noise of 10 um; effective sizes of 33 um and 27 um."""
    sizes = [np.sqrt(2.0) * size for size in (33e-6, 27e-6, 1e-3, 0.0, 0.0, 0.0)]
    assert information.measure_motion(swinging(sizes, 4000), GEOMETRY).directions == 2


def test_averaging_lowers_the_noise() -> None:
    """Nine samples at 4 Hz in 2 s: a third of the noise."""
    found = information.measure_motion(swinging([1e-3] * 6), GEOMETRY, 2.0)
    np.testing.assert_allclose([each.noise for each in found.excitations], 3.3e-6, rtol=0.2)


def test_engagement_is_in_numbers_and_shares() -> None:
    engaged, uncertain = np.array([2.0, np.nan, 3.0]), np.array([1.0, np.nan, 0.0])
    columns = Engagement(4, engaged, uncertain, np.zeros((4, 1))).columns("bed: ")
    assert [*columns] == ["bed: engaged [1]", "bed: engaged_share [-]", "bed: uncertain_share [-]"]
    found = np.array([*columns.values()])[:, [0, 2]]
    assert found.tolist() == [[2.0, 3.0], [0.5, 0.75], [0.25, 0.0]]


# --- noise and its averages


def test_noise_is_in_the_channels_order() -> None:
    found = noise.ChannelNoise(
        wrench=np.arange(6.0),
        local_forces=np.arange(6.0, 12.0).reshape(2, 3),
        pose=np.zeros(6),
    )
    assert found.values.tolist() == [*range(12)]


def test_the_noise_of_averaged_poses_is_correlated() -> None:
    found = noise.PoseNoise(
        deviation=np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0]),
        correlation=np.eye(6) + 0.5 * np.eye(6, k=1) + 0.5 * np.eye(6, k=-1),
    )
    covariance = found.covariance(0.25)
    assert covariance[:3, :3].tolist() == [[0.25, 0.25, 0.0], [0.25, 1.0, 0.75], [0.0, 0.75, 2.25]]


def test_a_window_shrinks_at_the_ends() -> None:
    """Samples at 4 Hz in 1 s: one, three, then five of them on either side."""
    pose = np.zeros((7, 6))
    pose[:, 0] = [1.0, 2.0, 6.0, 3.0, 3.0, 9.0, 5.0]
    samples = make_samples(pose, np.zeros((7, 6)), {})
    found = noise.smooth_poses(samples, 1.0).position[:, 0]
    assert found == pytest.approx([1.0, 3.0, 3.0, 4.6, 5.2, 17.0 / 3.0, 5.0])
    gain = (1.0 + 1.0 / 3.0 + 0.2 + 0.2 + 0.2 + 1.0 / 3.0 + 1.0) / 7.0
    assert noise.smoothing_gain(samples, 1.0) == pytest.approx(gain)
    assert noise.smoothing_gain(samples, 0.0) == 1.0
    assert noise.smooth_poses(samples, 0.0) is samples


# --- the suspension


DRAWS = {
    # value, draws, low, high. Of 41 draws 0 to 40 the 2.5 % quantile is 1, the 97.5 % one 39; the
    # reach is widened by 1.5.
    "inside": (10.0, np.arange(41.0), -3.5, 53.5),
    "below all": (0.0, np.arange(41.0), 0.0, 58.5),
    "above all": (50.0, np.arange(41.0), -23.5, 50.0),
    "an unknown one": (10.0, np.r_[np.arange(40.0), np.nan], -5.0, 53.5),
    "two unknown ones": (10.0, np.r_[np.arange(39.0), np.nan, np.nan], -np.inf, np.inf),
}


@pytest.mark.parametrize("case", DRAWS)
def test_an_interval_is_wider_than_draws(case: str) -> None:
    value, draws, low, high = DRAWS[case]
    found = suspension._quantity(np.array(value), draws)
    assert (float(found.value), float(found.scale)) == (value, abs(value))
    if case != "an unknown one":
        assert (float(found.low), float(found.high)) == pytest.approx((low, high))
    else:
        assert np.isfinite([found.low, found.high]).all()


def test_noise_of_the_load_is_taken_off() -> None:
    """A load of variance 8, 2 of it noise, moves the limb as 6 would: 8 / 6 of the compliance."""
    phase = 2.0 * np.pi * np.outer(np.arange(64) / 64, [1, 2, 3, 4, 5, 6])
    load = 4.0 * np.sin(phase)
    stiffness = np.array([1e3, 2e3, 3e3, 10.0, 20.0, 30.0])
    found = suspension._stiffness(load / stiffness, load, np.array([2.0, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(np.diag(found), [750.0, 2e3, 3e3, 10.0, 20.0, 30.0])
    np.testing.assert_allclose(found - np.diag(np.diag(found)), 0.0, atol=1e-9)


def test_a_missing_direction_leaves_it_unknown() -> None:
    phase = 2.0 * np.pi * np.outer(np.arange(64) / 64, [1, 2, 3, 4, 5, 5])
    load = np.sin(phase)
    assert np.isnan(suspension._stiffness(load, load, np.zeros(6))).all()
    load[:, 5] = 0.0
    assert np.isnan(suspension._stiffness(load, load, np.zeros(6))).all()


def limb_samples() -> Samples:
    limb = scene.limb()
    return make_samples(np.hstack([limb.translation, limb.rotation_vector()]), scene.wrench(), {})


def test_64_samples_are_needed() -> None:
    samples = limb_samples()
    assert suspension.find_suspension(samples[:64], GEOMETRY) is not None
    assert suspension.find_suspension(samples[:63], GEOMETRY) is None
    samples.wrench[10, 1] = np.nan
    assert suspension.find_suspension(samples[:64], GEOMETRY) is None


def test_a_coupling_is_certain_by_both_axes() -> None:
    """The geometric mean of both stiffnesses, 40 and 20 N/mm: 28.28 N/mm."""
    found = suspension.find_suspension(limb_samples(), GEOMETRY)
    assert found is not None
    scale = found.stiffness.scale
    assert scale[0, 2] == pytest.approx(28.28e3, rel=0.02) and scale[2, 0] == scale[0, 2]
    assert scale[1, 1] == pytest.approx(30e3, rel=0.02)
    assert abs(found.stiffness.value[0, 2]) < 0.02 * scale[0, 2]


def test_pistoning_is_along_a_leaning_socket() -> None:
    """Turned with its limb and load, a socket has the same pistoning: 3 mm."""
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    leaning = replace(
        GEOMETRY, anchors=GEOMETRY.anchors @ turn.T, rotations=turn @ GEOMETRY.rotations
    )
    samples = limb_samples()
    wrench = np.hstack([samples.wrench[:, :3] @ turn.T, samples.wrench[:, 3:] @ turn.T])
    samples = replace(
        samples,
        position=samples.position @ turn.T,
        rotation=samples.rotation @ turn.T,
        wrench=wrench,
    )
    found = suspension.find_suspension(samples, leaning)
    assert found is not None
    assert float(found.pistoning.value) == pytest.approx(3e-3, rel=0.01)
    assert np.diag(found.stiffness.value)[:3] == pytest.approx([20e3, 40e3, 30e3], rel=0.01)
