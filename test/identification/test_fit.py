"""The fit, from samples to a model, against the stacked problems and known truths."""

import copy
import dataclasses

import numpy as np
import pytest
from support.problems import (
    FAR,
    LEFT_OUT,
    make_case,
    moving_limb,
    random_bed,
    random_socket,
    samples_of_bed,
)
from support.stacked import (
    KILONEWTON_PER_METRE,
    MILLIMETRE,
    OPTIMUM,
    named_offsets,
    relative,
    stack_stage_one,
    stack_stage_two,
    stacked_offsets,
)

from socket_testbed.errors import IdentificationError
from socket_testbed.identification.evaluation import evaluate
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.noise import smooth_poses
from socket_testbed.settings.identification import PAPER_VARIANTS, IdentificationSettings


@pytest.mark.parametrize("leave_out", LEFT_OUT[:3])
@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_the_fit_is_both_stages_of_the_stacked_problem(variant, leave_out):
    geometry, _, samples, settings = make_case(91, variant, gaps=True, leave_out=leave_out)
    u = stack_stage_one(samples, geometry, settings).solve()
    rest = samples.position.mean(axis=0) + MILLIMETRE * u.reshape(-1, 3)
    expected = stack_stage_two(samples, geometry, settings, rest).solve()
    fit = fit_contact_model(samples, geometry, settings)
    np.testing.assert_allclose(fit.model.rest_positions, rest, atol=1e-8)
    stiffness = fit.model.stiffness.reshape(-1) / KILONEWTON_PER_METRE
    assert relative(stiffness, expected[: len(stiffness)]) < 10.0 * OPTIMUM
    assert fit.model.variant == variant
    assert fit.model.cluster_points == geometry.clusters
    offsets = named_offsets(fit.model.wrench_bias, fit.model.force_bias, samples)
    assert offsets == pytest.approx(
        stacked_offsets(expected, samples, settings), rel=1e-4, abs=1e-4
    )


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_the_fit_says_what_it_rests_on(variant):
    geometry, _, samples, settings = make_case(92, variant, leave_out=("Mz",))
    samples.wrench[-2:, 3] = np.nan
    samples.position[4] = np.nan
    fit = fit_contact_model(samples, geometry, settings)
    assert fit.samples == len(samples) - 3
    assert fit.last_stamp == samples.stamps[-3]
    assert fit.settings == settings
    assert 0.0 < fit.determined <= 3 * len(geometry)
    assert tuple(e.name for e in fit.errors) == samples.channels
    assert {e.samples for e in fit.errors} == {fit.samples}
    assert [e.name for e in fit.errors if not e.in_objective] == ["Mz"]
    for solution in (fit.stage_one, fit.stage_two):
        assert solution.certificate.worst <= settings.solver_tolerance
        assert solution.status in fit.status
    assert fit.model.stiffness.min() >= 0.0


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_the_fit_averages_the_poses_without_their_outliers(variant):
    geometry, _, samples, settings = make_case(95, variant)
    expected = fit_contact_model(smooth_poses(samples, 1.5), geometry, settings)
    settings = dataclasses.replace(settings, pose_smoothing=1.5)
    fit = fit_contact_model(samples, geometry, settings)
    np.testing.assert_allclose(fit.model.stiffness, expected.model.stiffness)
    assert fit.errors == expected.errors
    samples.position[7] = 1e9
    spoilt = fit_contact_model(samples, geometry, settings)
    assert spoilt.samples == fit.samples - 1
    assert np.abs(spoilt.model.rest_positions - fit.model.rest_positions).max() < 1e-3


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
@pytest.mark.parametrize("window", [0.0, 0.5])
def test_the_noise_correction_gives_back_the_stiffness_that_noise_shrinks(variant, window):
    rng = np.random.default_rng(96)
    geometry = random_socket(rng)
    bed = random_bed(rng, geometry, variant)
    time = np.arange(1200) / 4.0
    slow = np.sin(2.0 * np.pi * time[:, None] / [23.0, 31.0, 41.0])
    samples = samples_of_bed(rng, bed, -0.006 + 0.0004 * slow)  # all tiles stay in contact
    noisy = dataclasses.replace(
        samples, position=samples.position + rng.normal(0.0, 2e-4, slow.shape)
    )
    settings = IdentificationSettings(
        variant=variant, smoothness=1e-6, rest_position_limit=0.02, pose_smoothing=window
    )
    corrected = dataclasses.replace(settings, noise_correction=True)
    # The slope of the force with the position, which the data determine.
    exact, shrunk, found = (
        fit_contact_model(*case).model.stiffness.sum(axis=0)
        for case in (
            (samples, geometry, settings),
            (noisy, geometry, settings),
            (noisy, geometry, corrected),
        )
    )
    assert np.abs(found - exact).max() < 0.3 * np.abs(shrunk - exact).max()


def test_without_known_noise_there_is_no_correction():
    geometry, _, samples, settings = make_case(97)
    settings = dataclasses.replace(settings, noise_correction=True)
    with pytest.raises(IdentificationError, match="noise of the limb position is not known"):
        fit_contact_model(samples[:14], geometry, settings)


def test_the_fit_does_not_change_the_samples():
    geometry, _, samples, settings = make_case(94, gaps=True)
    before = copy.deepcopy(samples)
    fit_contact_model(samples, geometry, settings)
    for field in dataclasses.fields(samples):
        np.testing.assert_array_equal(getattr(samples, field.name), getattr(before, field.name))


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
@pytest.mark.parametrize(("theta", "ignored"), [(1.0, "local_forces"), (0.0, "wrench")])
def test_at_its_ends_theta_ignores_the_other_group(variant, theta, ignored):
    geometry, _, samples, settings = make_case(95, variant, theta=theta)
    rng = np.random.default_rng(96)
    other = rng.normal(0.0, 100.0, getattr(samples, ignored).shape)
    changed = dataclasses.replace(samples, **{ignored: other})
    expected = fit_contact_model(samples, geometry, settings).model
    found = fit_contact_model(changed, geometry, settings).model
    np.testing.assert_allclose(found.rest_positions, expected.rest_positions, atol=1e-9)
    np.testing.assert_allclose(found.stiffness, expected.stiffness, rtol=1e-6, atol=1e-3)


def compressed_bed(rng, geometry, variant, rest_spread):
    """A bed of one stiffness in compression throughout, where both stages' laws are one."""
    bed = random_bed(rng, geometry)
    return dataclasses.replace(
        bed,
        variant=variant,
        stiffness=np.full((len(geometry), 3), 3000.0),
        rest_positions=FAR + 0.006 + rest_spread * rng.uniform(-1.0, 1.0, (len(geometry), 3)),
        sharpness=5000.0,
    )


@pytest.mark.parametrize(
    ("clusters", "rest_spread", "smoothness"), [(8, 0.001, 0.0), (0, 0.0, 1e-3), (3, 0.0, 1e-3)]
)
@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_the_fit_recovers_a_truth_that_both_stages_can_express(
    variant, clusters, rest_spread, smoothness
):
    rng = np.random.default_rng(98)
    geometry = random_socket(rng, clusters=clusters)
    bed = compressed_bed(rng, geometry, variant, rest_spread)
    samples = samples_of_bed(rng, bed, FAR + moving_limb(rng, 50, 0.001))
    settings = IdentificationSettings(
        variant=variant, gate_sharpness=bed.sharpness, smoothness=smoothness
    )
    model = fit_contact_model(samples, geometry, settings).model
    np.testing.assert_allclose(model.rest_positions, bed.rest_positions, atol=1e-8)
    np.testing.assert_allclose(model.stiffness, bed.stiffness, rtol=1e-4)
    unseen = FAR + moving_limb(rng, 100, 0.006)
    np.testing.assert_allclose(model.wrench(unseen), bed.wrench(unseen), rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_the_fit_predicts_most_of_the_force_of_the_truth_on_another_motion(variant, seed):
    geometry, bed, samples, settings = make_case(seed, variant, noise=0.1)
    model = fit_contact_model(samples, geometry, settings).model
    rng = np.random.default_rng(seed)
    unseen = samples_of_bed(rng, bed, moving_limb(rng, 100))
    skills = {e.name: e.skill for e in evaluate(unseen, model)}
    assert min(skills[name] for name in ("Fx", "Fy", "Fz")) > 0.5
