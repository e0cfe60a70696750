"""Contact laws, the objective's weights and the force map on cases that paper and pencil solve."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from support import scene
from support.problems import GEOMETRY, make_case, make_samples

from socket_testbed.arrays import FloatArray
from socket_testbed.errors import ConfigurationError, IdentificationError
from socket_testbed.identification import contact, force_map, map_posterior, map_prior, problem
from socket_testbed.identification.checked import CheckedSamples
from socket_testbed.identification.contact import Loading, PaperLaw, RigidLaw
from socket_testbed.identification.force_map import ForceMap, MapEstimate
from socket_testbed.identification.map_posterior import JointDraws
from socket_testbed.samples import Samples, Status, local_channels, refuse_unknown_channels
from socket_testbed.settings.identification import (
    ForceMapSettings,
    IdentificationSettings,
)

NAN = float("nan")
SOCKET = scene.geometry()
CLUSTERS = tuple(scene.CLUSTERS)


# --- contact laws


def test_the_gate_opens_at_rest() -> None:
    """1 / (1 + exp(2 * 1000 / m * d)): a half at rest, 0.1192 after 1 mm, 0.8808 before."""
    found = contact.gate(np.array([-1e-3, 0.0, 1e-3, 10.0, NAN]), 1000.0)
    assert found == pytest.approx([0.880797, 0.5, 0.119203, 0.0, NAN], nan_ok=True, abs=1e-6)


def test_a_force_changes_relative_to_itself() -> None:
    """(3, 0, 4) and (5, 0, 4): 1 N of deviation, RMS of sqrt((25 + 41) / 2)."""
    force = np.array([[3.0, 0.0, 4.0], [5.0, 0.0, 4.0]])
    assert contact.relative_change(force) == pytest.approx(1.0 / np.sqrt(33.0))
    assert contact.relative_change(np.zeros((2, 3))) == 0.0


def test_forces_act_at_their_anchors() -> None:
    """10 N along y at x = 0.2 m are 2 N m about z; 5 N along x at z = 0.1 m are 0.5 about y."""
    mapping = contact.wrench_map(np.array([[0.2, 0.0, 0.0], [0.0, 0.0, 0.1]]))
    wrench = mapping @ [0.0, 10.0, 0.0, 5.0, 0.0, 0.0]
    assert wrench == pytest.approx([0.0, 0.5, 2.0, 5.0, 10.0, 0.0])


def test_a_rotation_moves_an_arm() -> None:
    """1 rad about z moves a point at 0.3 m along x by 0.3 m along y."""
    motions = contact.rigid_motions(np.array([[0.3, 0.0, 0.0]]))[0]
    assert motions[:, 5] == pytest.approx([0.0, 0.3, 0.0])
    np.testing.assert_allclose(motions[:, :3], np.eye(3))


def test_motion_is_since_the_reference() -> None:
    """0.1 rad about z behind 0.4 rad about z; a row with NaN is unknown."""
    pose = np.array([[1.0, 2.0, 3.0, 0.0, 0.0, 0.5], [1.0, NAN, 3.0, 0.0, 0.0, 0.5]])
    found = contact.relative_pose(pose, np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.4]))
    assert found[0] == pytest.approx([0.0, 1.0, 2.0, 0.0, 0.0, 0.1])
    assert np.isnan(found[1]).all()


def loading(motion: np.ndarray, wrench: np.ndarray, zero: float = 1.0) -> Loading:
    return Loading(motion, wrench, np.full(6, 0.5), SOCKET.neighbours, zero)


def law(kind: type[contact.ContactLaw]) -> contact.ContactLaw:
    return kind(SOCKET.anchors, SOCKET.rotations, 1000.0, np.zeros(6))


SINKING = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.001], [0.0, 0.0, -0.003]])


def test_a_bed_has_the_slope_of_the_wrench() -> None:
    """The load falls by 12 kN/m along z: 1 kN/m per tile of the twelve, without residual."""
    wrench = np.zeros((3, 6))
    wrench[:, 5] = 7.0 + 12e3 * SINKING[:, 2]
    bed = law(PaperLaw)
    stiffness, missed = bed.bed_stiffness(loading(SINKING, wrench), np.ones(3))
    assert stiffness == pytest.approx(1e3) and missed == pytest.approx(0.0, abs=1e-12)
    stiffness, _ = bed.bed_stiffness(loading(SINKING, -wrench), np.ones(3))
    assert stiffness == 0.0
    # Half of its stiffness along z: twice the stiffness of the bed.
    stiffness, _ = bed.bed_stiffness(loading(SINKING, wrench), np.array([1.0, 1.0, 0.5]))
    assert stiffness == pytest.approx(2e3)


def test_what_the_bed_leaves_is_weighed() -> None:
    """A moment of +1 and -1 N m that no sinking explains, with a weight of 0.5: 1.0."""
    wrench = np.zeros((2, 6))
    wrench[:, 0] = [1.0, -1.0]
    _, missed = law(PaperLaw).bed_stiffness(loading(SINKING[:2], wrench), np.ones(3))
    assert missed == pytest.approx(1.0)


def test_springs_carry_the_load_within_20_mm() -> None:
    """60 N on twelve tiles: 60 / (12 * 0.02) N/m; at least 1 N."""
    wrench = np.tile([0.0, 0.0, 0.0, 0.0, 36.0, -48.0], (2, 1))
    assert law(PaperLaw).min_stiffness(loading(SINKING[:2], wrench)) == pytest.approx((60.0, 250.0))
    assert law(PaperLaw).min_stiffness(loading(SINKING[:2], 0.0 * wrench))[0] == 1.0


def test_the_papers_prior_is_of_neighbours() -> None:
    """20 pairs: smoothness 6 / (3 * 20) = 0.1, times (1 / 2)^2 and (1 / 4)^2 by the expected."""
    settings = IdentificationSettings(
        smoothness=6.0,
        stiffness_difference=2e3,
        rest_position_difference=4e-3,
        rest_position_limit=0.007,
        initial_stiffness=1500.0,
    )
    sizes = law(PaperLaw).sizes(settings, loading(SINKING, np.zeros((3, 6))))
    assert len(SOCKET.neighbours) == 20 and sizes.limit == 0.007
    assert sizes.scale[:, 0].tolist() == [1e3] * 3 + [1e-3] * 3
    assert not sizes.start.any() and (sizes.springs == 1500.0).all()
    corner, pair = sizes.prior[:, 0, 0], sizes.prior[:, 0, 1]  # three neighbours; the next one
    assert corner.tolist() == pytest.approx([0.1 * 3 / 4, 0.1 * 3 / 16])
    assert pair.tolist() == pytest.approx([-0.1 / 4, -0.1 / 16])


@pytest.mark.parametrize(
    ("motion", "expected"),
    [pytest.param(SINKING, 1e3, id="slope"), pytest.param(0.0 * SINKING, 250.0, id="still")],
)
def test_a_stiffness_follows_from_the_slope(motion: FloatArray, expected: float) -> None:
    """1 kN/m per tile by the slope; 250 N/m if the limb does not move under 60 N."""
    wrench = np.zeros((3, 6))
    wrench[:, 5] = -60.0 + 12e3 * (SINKING[:, 2] - SINKING[:, 2].mean())
    settings = IdentificationSettings(initial_stiffness=0.0)
    sizes = law(PaperLaw).sizes(settings, loading(motion, wrench))
    np.testing.assert_allclose(sizes.springs, expected)


def test_the_rigid_prior_is_about_its_mean() -> None:
    """Still limb under 60 N: 250 N/m in the mean, a settling of 60 / (12 * 250) = 20 mm.

    Weight 2 * 9 / (3 * 12) = 0.5; a corner has three neighbours and 0.3 of the common mean.
    """
    wrench = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, -60.0], (3, 1))
    settings = IdentificationSettings(prior=9.0)
    sizes = law(RigidLaw).sizes(settings, loading(np.zeros((3, 6)), wrench, zero=2.0))
    np.testing.assert_allclose(sizes.springs, 250.0)
    assert sizes.scale[:, 0] == pytest.approx([250.0] * 3 + [0.02] * 3)
    assert sizes.start[:, 5].tolist() == [1.0] * 3 + [0.0] * 3 and np.isinf(sizes.limit)
    assert sizes.prior[:, 0, 0].tolist() == pytest.approx([1.65, 1.65])
    assert sizes.prior[:, 0, 1].tolist() == pytest.approx([-0.5, -0.5])


@pytest.mark.parametrize("ratio", [0.1, 0.2, 0.45, 1.0])
def test_the_bed_shears_by_the_data(ratio: float) -> None:
    """Of a limb that moves in all directions on a bed of 2 kN/m with such a ratio."""
    moved = 1e-3 * np.sin(2.0 * np.pi * np.outer(np.arange(40) / 40, np.arange(1.0, 7.0)))
    rigid = law(RigidLaw)
    along = 2e3 * np.array([ratio, ratio, 1.0])
    forces = along[:, None] * rigid.displacements(moved)
    wrench = np.einsum("can,tan->tc", rigid.onto, forces)
    wrench[:, 5] -= 60.0
    sizes = rigid.sizes(IdentificationSettings(), loading(moved, wrench))
    np.testing.assert_allclose(sizes.springs[:, 0], along, rtol=1e-6)
    settled = 60.0 / (12 * along.mean())
    assert sizes.scale[3, 0] == pytest.approx(settled, rel=1e-3)


def test_offsets_follow_the_motion() -> None:
    """A slope of 5 kN/m of Fx along x, 0.3 % less by its ridge; the constant at zero motion."""
    motion = np.zeros((8, 6))
    motion[:, 0] = 1e-3 * np.array([1.0, 3.0] * 4)
    residual = np.zeros((8, 6))
    residual[:, 3] = 20.0 + 5e3 * motion[:, 0]
    wrench = np.zeros((8, 6))
    wrench[:, 5] = [-100.0, -300.0] * 4
    constant, slope = law(RigidLaw).wrench_offsets(motion, residual, wrench)
    assert slope[3, 0] == pytest.approx(5e3 / 1.0035, rel=1e-3)
    assert constant[3] == pytest.approx(30.0 - slope[3, 0] * 2e-3)
    assert np.count_nonzero(slope) == 1 and not constant[[0, 1, 2, 4, 5]].any()


def test_a_hold_has_hardly_a_slope() -> None:
    """A load that changes by a hundredth: a ridge of 1.003, so that the slope is halved."""
    motion = np.zeros((8, 6))
    motion[:, 0] = 1e-3 * np.array([-1.0, 1.0] * 4)
    residual, wrench = np.zeros((8, 6)), np.zeros((8, 6))
    residual[:, 3], wrench[:, 5] = 5e3 * motion[:, 0], -100.0 + np.array([-1.0, 1.0] * 4)
    _, slope = law(RigidLaw).wrench_offsets(motion, residual, wrench)
    assert slope[3, 0] == pytest.approx(5e3 / 2.003, rel=1e-3)


# --- the objective


def test_blocks_are_means_of_known_rows() -> None:
    values = np.array([1.0, 3.0, NAN, 5.0, NAN])
    assert problem._block_means(values, 2) == pytest.approx([2.0, 5.0, NAN], nan_ok=True)
    assert problem._block_means(values[:, None], 3)[:, 0].tolist() == [2.0, 5.0]


def test_groups_have_their_sizes() -> None:
    """RMS of moments, forces and cluster forces; at least 0.1 N m, 1 N and 1 N."""
    values = np.array([[3.0, 4.0, NAN, 6.0, 8.0, 0.0, 1.0, 7.0, NAN]])
    expected = [np.sqrt(12.5), np.sqrt(100.0 / 3.0), 5.0]
    assert problem.group_sizes(values) == pytest.approx(expected)
    assert problem.group_sizes(0.01 * values[:, :9]) == [0.1, 1.0, 1.0]


def scene_samples() -> Samples:
    """The scene's samples with a clean limb; the weights follow from their wrench."""
    limb, tiles = scene.limb(), [*SOCKET.clusters.values()]
    forces = scene.forces_in_tiles(scene.STAMPS)[:, tiles].swapaxes(0, 1)
    pose = np.hstack([limb.translation, limb.rotation_vector()])
    return make_samples(pose, scene.wrench(), dict(zip(SOCKET.clusters, forces, strict=True)))


OUT = ("Mz", "distal.Fx", "distal.Fy", "distal.Fz")


def objective(weights: str, samples: Samples | None = None) -> problem.Objective:
    settings = IdentificationSettings(weights=weights, leave_out=OUT, pose_smoothing=0.0)
    return problem.build_objective(samples or scene_samples(), SOCKET, settings)


def test_sizes_weigh_each_group() -> None:
    """Zero would give J_w = J_f = 1: five channels of the wrench, nine of clusters."""
    found = objective("size")
    samples = scene_samples()
    moment = np.mean(samples.wrench[:, :2] ** 2)
    force = np.mean(samples.wrench[:, 3:] ** 2)
    local = np.mean(samples.local_forces[:, :3] ** 2)
    assert found.wrench_shares == pytest.approx(
        np.array([1 / moment, 1 / moment, 0.0, 1 / force, 1 / force, 1 / force]) / 5
    )
    np.testing.assert_allclose(found.channel_shares, 1.0 / local / 9)
    power = (samples.wrench**2).mean(axis=0)
    assert found.wrench_shares @ power == pytest.approx((2 + 3) / 5)
    assert found.names == (
        *("Mx", "My", "Fx", "Fy", "Fz"),
        *(f"{name}.F{axis}" for name in CLUSTERS[:3] for axis in "xyz"),
    )


def test_raw_weights_are_common() -> None:
    """One factor, with which predicting zero costs 2 in the sum of both."""
    found, samples = objective("raw"), scene_samples()
    factor = found.channel_shares[0]
    assert (found.channel_shares == factor).all()
    assert found.wrench_shares.tolist() == [factor, factor, 0.0, factor, factor, factor]
    power = (samples.wrench**2).mean(axis=0)[[0, 1, 3, 4, 5]].sum()
    power += (samples.local_forces[:, :3] ** 2).mean(axis=0).sum()
    assert factor == pytest.approx(2.0 / power)


def test_noise_weighs_by_channel() -> None:
    """A noisy Fx of the wrench has less weight; zero still costs 1 in each group."""
    samples = scene_samples()
    white = np.random.default_rng(0).normal(0.0, 3.0, 96)
    samples.wrench[:, 3] += white - white.mean()
    found = objective("noise", samples)
    model_error = 0.01 * np.sqrt(np.mean(samples.wrench[:, 3:] ** 2))
    assert found.wrench_shares[2] == 0.0
    ratio = found.wrench_shares[4] / found.wrench_shares[3]
    noise = problem.channel_noise(samples).wrench
    expected = (noise[3] ** 2 + model_error**2) / (noise[4] ** 2 + model_error**2)
    assert ratio == pytest.approx(expected) and ratio > 10.0
    lever = np.sqrt(np.mean((SOCKET.anchors**2).sum(axis=1)))
    moment = noise[0] ** 2 + (lever * model_error) ** 2
    assert found.wrench_shares[0] / found.wrench_shares[4] == pytest.approx(
        (noise[4] ** 2 + model_error**2) / moment
    )
    power = (samples.wrench**2).mean(axis=0)
    assert found.wrench_shares @ power == pytest.approx(1.0)
    local = (samples.local_forces[:, :3] ** 2).mean(axis=0).ravel()
    assert found.channel_shares @ local == pytest.approx(1.0)


@pytest.mark.parametrize(("count", "refused"), [(9, False), (10, True)])
def test_a_tenth_may_be_outliers(count: int, refused: bool) -> None:
    """Of 90 samples 9 may be left out."""
    samples = scene_samples()[:90]
    samples.wrench[5 : 5 + 8 * count : 8, 3] = 6e3
    checked = CheckedSamples(samples, SOCKET, OUT)
    if refused:
        with pytest.raises(IdentificationError, match="10 of 90 samples are outliers: Fx has 10"):
            checked.part()
    else:
        assert len(objective("size", checked.part()).samples) == 81


def test_twelve_samples_are_needed() -> None:
    samples = scene_samples()
    samples.position[12:] = NAN
    assert len(objective("size", samples).samples) == 12
    samples.position[3] = NAN
    with pytest.raises(IdentificationError) as refusal:
        objective("size", samples)
    assert refusal.value.fact == (
        "only 11 of 96 samples have a limb position (11) and a wrench, and a fit needs 12"
    )


UNUSABLE: dict[str, tuple[Callable[[Samples], object], str]] = {
    "a dead channel": (
        lambda s: s.wrench.__setitem__((slice(None), 1), NAN),
        "My of the load cell has no value in any of the 96 samples",
    ),
    "a dead cluster": (
        lambda s: s.status.__setitem__((slice(1, None), 1), Status.MISSING),
        "mid_anterior.Fx has fewer than 2 usable values in the 96 samples",
    ),
}


@pytest.mark.parametrize("case", UNUSABLE)
def test_a_channel_without_values_is_named(case: str) -> None:
    spoil, fact = UNUSABLE[case]
    samples = scene_samples()
    spoil(samples)
    with pytest.raises(IdentificationError) as refusal:
        objective("size", samples)
    assert refusal.value.fact == fact


def test_a_dead_channel_may_be_left_out() -> None:
    samples = scene_samples()
    samples.wrench[:, 2], samples.status[:, 3] = NAN, Status.MISSING  # Mz and distal
    assert len(objective("size", samples).samples) == 96


def test_known_channels_may_be_left_out() -> None:
    refuse_unknown_channels(("Mz", "distal.Fx"), scene_samples().channels)


@pytest.mark.parametrize(
    ("name", "hint"),
    [("distal", "give distal.Fx distal.Fy distal.Fz"), ("distal.Fw", "did you mean")],
    ids=["cluster", "misspelt"],
)
def test_unknown_channels_have_a_hint(name: str, hint: str) -> None:
    with pytest.raises(ConfigurationError) as refusal:
        refuse_unknown_channels((name,), scene_samples().channels)
    assert refusal.value.fact == f"leave_out: no channel '{name}'"
    assert hint in refusal.value.hint


# --- the force map


def test_correlation_falls_with_distance() -> None:
    """(1 + x) exp(-x) at x = sqrt(3) d / l: 2 / e at l / sqrt(3)."""
    found = map_prior.matern(np.array([0.0, 0.04 / np.sqrt(3.0), 0.04]), 0.04)
    assert found == pytest.approx([1.0, 2.0 / np.e, 0.4833577])


def test_unlikely_hypotheses_do_not_count() -> None:
    """Of evidence to the power 0.6, less than 1 / 500 of the likeliest."""
    found = map_posterior.probabilities(3.0 + np.log([1.0, 0.5, 3.2e-5, 3.1e-5]))
    assert found == pytest.approx(np.array([1.0, 0.6597540, 0.0020094, 0.0]) / 1.6617634, rel=1e-4)


def test_a_magnitude_is_uncertain_by_rice() -> None:
    """sqrt(2) sigma about zero; one sigma where the vector is long."""
    found = force_map._rice_deviation(np.array([0.0, 1e3, 5.0]), np.array([2.0, 1.0, 0.0]))
    assert found == pytest.approx([2.0 * np.sqrt(2.0), 1.0, 0.0], abs=1e-3)


def test_the_first_hypothesis_has_the_medians() -> None:
    settings = ForceMapSettings()
    first, *others = map_prior.hypotheses(settings, None)
    for name in ("length", "shear", "preload", "bed", "sinking", "rotation", "bed_shear"):
        assert getattr(first, name) == pytest.approx(getattr(settings, name)), name
    for name in ("bed_variation", "arm", "drag", "share", "moment_error", "force_error"):
        assert getattr(first, name) == pytest.approx(getattr(settings, name)), name
    assert first.cluster_error == pytest.approx(settings.cluster_error)
    assert first.normal_deviation == settings.normal_deviation
    assert max(each.share for each in others) <= 1.0


def test_hypotheses_have_their_spreads() -> None:
    """Standard deviations over 256 even points: each has its own."""
    settings = replace(ForceMapSettings(), draws=256, share=0.5, share_spread=0.05, drag_spread=0.3)
    found = [*map_prior.hypotheses(settings, None)]
    for name, spread in (
        ("length", settings.length_spread),
        ("cluster_error", settings.cluster_error_spread),
        *((name, settings.spread) for name in ("shear", "preload", "bed", "rotation")),
    ):
        logs = np.log([getattr(each, name) for each in found])
        assert logs.std() == pytest.approx(spread, rel=0.08), name
    for name, spread in (("drag", 0.3), ("share", 0.05)):
        assert np.std([getattr(each, name) for each in found]) == pytest.approx(spread, rel=0.08)


def test_the_wall_under_the_tiles_bears_its_share() -> None:
    """Within 0.03, whatever the settings say of other sockets."""
    settings = replace(ForceMapSettings(), draws=256, share=0.5, share_spread=0.2)
    shares = [each.share for each in map_prior.hypotheses(settings, 0.7)]
    assert shares[0] == pytest.approx(0.7)
    assert np.mean(shares) == pytest.approx(0.7, abs=0.002)
    assert np.std(shares) == pytest.approx(0.03, rel=0.08)


def test_a_map_knows_its_tiles_share() -> None:
    """Half the wall under tiles: the springs that the wrench shows bear about half of it."""
    stated = replace(SOCKET, tile_share=0.5)
    pushed = scene_samples()
    pushed = pushed.without([name for cluster in CLUSTERS for name in local_channels(cluster)])
    whole, half = (
        force_map.ForceMap(socket, CLUSTERS).estimate(pushed).forces[0].sum(axis=0)[2]
        for socket in (replace(SOCKET, tile_share=1.0), stated)
    )
    assert half / whole == pytest.approx(0.5, abs=0.1)


def sizes(**changes: float) -> map_prior.Hypothesis:
    first = next(iter(map_prior.hypotheses(ForceMapSettings(), None)))
    return replace(first, **changes)


def test_noise_is_of_its_channels() -> None:
    errors = {"moment_error": 0.2, "force_error": 3.0, "cluster_error": 0.5}
    plain = map_prior.Prior(SOCKET, CLUSTERS, sizes(**errors, cluster_gain_error=0.0))
    np.testing.assert_allclose(plain.noise, [0.04] * 3 + [9.0] * 3 + [0.25] * 12)
    gained = map_prior.Prior(SOCKET, CLUSTERS, sizes(**errors, cluster_gain_error=0.1))
    extra = 0.01 * np.diag(gained.signal)[6:]
    np.testing.assert_allclose(gained.noise, plain.noise + np.r_[np.zeros(6), extra])


def test_the_wrench_bears_the_whole_load() -> None:
    """Tiles that bear half of the load: a force of 1 N on one of them makes 2 N of the wrench."""
    prior = map_prior.Prior(SOCKET, CLUSTERS, sizes(share=0.5))
    tile = SOCKET.names.index("ant_mid")
    normal = prior.mapping[:, 3 * tile + 2]  # inwards, along -x of {S}, at 50 mm along x
    assert normal[3:6] == pytest.approx([-2.0, 0.0, 0.0], abs=1e-12)
    assert normal[:3] == pytest.approx([0.0, -2.0 * 0.15, 0.0], abs=1e-12)
    own = 6 + 3 * CLUSTERS.index("mid_anterior") + 2
    assert normal[own] == 1.0 and np.count_nonzero(np.abs(normal[6:]) > 1e-12) == 1


def test_the_mean_map_is_of_its_samples() -> None:
    samples = scene_samples()[::8]
    whole = ForceMap(SOCKET, CLUSTERS, ForceMapSettings(draws=4), trial=samples)
    each, mean = whole.estimate(samples), whole.mean(samples)
    for name in ("forces", "normal_pressure", "shear"):
        expected = getattr(each, name).mean(axis=0)
        np.testing.assert_allclose(getattr(mean, name)[0], expected, err_msg=name)
    for name in (
        *("standard_deviations", "normal_pressure_standard_deviation"),
        "shear_standard_deviation",
    ):
        expected = np.sqrt((getattr(each, name) ** 2).mean(axis=0))
        np.testing.assert_allclose(getattr(mean, name)[0], expected, err_msg=name)
    assert mean.source == each.source == whole.source(samples)


def test_unmeasured_shear_has_both_tangential_deviations() -> None:
    """Of mean zero, its mean square is the sum of both variances; `ant_mid` faces along -x."""
    samples = scene_samples()[:1]
    samples.wrench[:], samples.status[:] = NAN, Status.MISSING
    found = ForceMap(SOCKET, CLUSTERS, ForceMapSettings(draws=1)).estimate(samples)
    tile = SOCKET.names.index("ant_mid")
    x, y, z = found.standard_deviations[0, tile]
    area = 9e-4  # [m^2]
    assert found.shear[0, tile] == pytest.approx(0.0, abs=1e-6)
    assert found.shear_standard_deviation[0, tile] == pytest.approx(np.hypot(y, z) / area)
    assert found.normal_pressure_standard_deviation[0, tile] == pytest.approx(x / area)


def test_the_source_names_what_is_measured() -> None:
    samples = scene_samples()[:2]
    whole = ForceMap(SOCKET, CLUSTERS, ForceMapSettings(draws=1))
    samples.status[:, 1:3] = Status.MISSING
    words = "prior: mean zero; measured:"
    assert whole.source(samples) == f"{words} wrench, brim_lateral, distal"
    samples.wrench[:], samples.status[:] = NAN, Status.MISSING
    assert whole.source(samples) == f"{words} nothing"


def test_live_evidence_is_a_mean() -> None:
    """A sample without a channel changes nothing."""
    samples = scene_samples()[10:12]
    live, both = (ForceMap(SOCKET, CLUSTERS, ForceMapSettings(draws=8)) for _ in range(2))
    live.update(samples[:1])
    empty = replace(
        samples[:1], wrench=np.full((1, 6), NAN), status=np.full((1, 4), 2, dtype=np.uint8)
    )
    live.update(empty)
    found = live.update(samples[1:])
    np.testing.assert_allclose(found.forces[0], both.estimate(samples).forces[1])


def estimate() -> MapEstimate:
    """Two samples of two tiles, whose values tell what they are."""
    forces = np.arange(12.0).reshape(2, 2, 3)
    one = np.array([[1.0, 2.0], [3.0, 4.0]])
    return MapEstimate(forces, 100.0 + forces, 1e3 * one, 10.0 * one, 2e3 * one, 20.0 * one, "made")


def test_a_maps_columns_have_units() -> None:
    columns = estimate().columns(("a", "b"), "map: ")
    assert {title: values.tolist() for title, values in columns.items()} == {
        "map: a.Fx [N]": [0.0, 6.0],
        "map: a.Fx.sd [N]": [100.0, 106.0],
        "map: a.Fy [N]": [1.0, 7.0],
        "map: a.Fy.sd [N]": [101.0, 107.0],
        "map: a.Fz [N]": [2.0, 8.0],
        "map: a.Fz.sd [N]": [102.0, 108.0],
        "map: a.pressure [Pa]": [1e3, 3e3],
        "map: a.pressure.sd [Pa]": [10.0, 30.0],
        "map: a.shear [Pa]": [2e3, 6e3],
        "map: a.shear.sd [Pa]": [20.0, 60.0],
        "map: b.Fx [N]": [3.0, 9.0],
        "map: b.Fx.sd [N]": [103.0, 109.0],
        "map: b.Fy [N]": [4.0, 10.0],
        "map: b.Fy.sd [N]": [104.0, 110.0],
        "map: b.Fz [N]": [5.0, 11.0],
        "map: b.Fz.sd [N]": [105.0, 111.0],
        "map: b.pressure [Pa]": [2e3, 4e3],
        "map: b.pressure.sd [Pa]": [20.0, 40.0],
        "map: b.shear [Pa]": [4e3, 8e3],
        "map: b.shear.sd [Pa]": [40.0, 80.0],
    }
    assert estimate().pressure_reach.tolist() == [[19.6, 39.2], [58.8, 78.4]]


def test_draws_come_in_pairs() -> None:
    """G y +- b E: two hypotheses, 2 y and 3 y; scales 10 and 100; errors 1 and 2."""
    draws = JointDraws(
        rows=np.array([4]),
        channels=np.array([[5.0]]),
        gain=np.array([[[2.0]], [[3.0]]]),
        weights=np.array([0.25, 0.75]),
        sizes=np.array([[10.0, 100.0]]),
        hypotheses=np.array([1, 0]),
        errors=np.array([[1.0], [2.0]]),
    )
    assert draws.values()[0, :, 0].tolist() == [115.0, 30.0, -85.0, -10.0]
    assert draws.mean().tolist() == [[0.25 * 10.0 + 0.75 * 15.0]]
    halved = draws.mapped(np.array([[0.5, 2.0]]))
    assert halved.values()[0].tolist() == [[57.5, 230.0], [15, 60], [-42.5, -170.0], [-5, -20]]


def test_the_case_of_a_fit_is_scaled() -> None:
    """The package's own socket has the prior of its tiles, whatever the case."""
    geometry, bed, samples, settings = make_case(1)
    model = problem.Problem(problem.build_objective(samples, geometry, settings))
    assert model.start.shape == (6, len(geometry)) and len(GEOMETRY) > len(bed.names)
    assert (model.lower[:3] == 0.0).all() and np.isinf(model.upper[:3]).all()
    limit = settings.rest_position_limit / 1e-3
    assert (model.lower[3:] == -limit).all() and (model.upper[3:] == limit).all()
