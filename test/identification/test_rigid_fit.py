"""The rigid variants: the joint refinement and what it recovers."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.problems import make_samples, random_bed, random_socket

from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.model_file import read_model, write_model
from socket_testbed.identification.objective import build_objective
from socket_testbed.identification.problem import Problem
from socket_testbed.settings.identification import RIGID_VARIANTS, IdentificationSettings


def rigid_bed(rng: np.random.Generator, geometry, variant="rigid") -> ContactModel:
    """A rigid bed that presses everywhere a little: a limb that settled."""
    size, inwards = (len(geometry), 3), geometry.rotations[:, 2]
    return dataclasses.replace(
        random_bed(np.random.default_rng(0), geometry, variant),
        rest_positions=rng.normal([0.0, 0.0, 0.003], 0.001, size) - 0.004 * inwards,
        stiffness=rng.uniform(0.5, 1.5, size) * [2000.0, 2000.0, 6000.0],
        sharpness=300.0,
        reference_pose=np.array([0.01, -0.02, 0.15, 0.02, 0.1, -0.05]),
    )


def rigid_motion(rng: np.random.Generator, count: int, bed: ContactModel) -> np.ndarray:
    """Poses that move along all six directions, (N, 6) [m, rad]."""
    phase = np.linspace(0.0, 2.0 * np.pi, count)[:, None] * [1.0, 2.0, 3.0, 2.0, 3.0, 1.0]
    way = np.sin(phase + rng.uniform(0.0, 2.0 * np.pi, 6)) * ([0.002] * 3 + [0.03] * 3)
    turned = Rotation.from_rotvec(way[:, 3:]) * Rotation.from_rotvec(bed.reference_pose[3:])
    return np.hstack([bed.reference_pose[:3] + way[:, :3], turned.as_rotvec()])


def rigid_case(seed: int, variant="rigid", count: int = 80, **changes):
    rng = np.random.default_rng(seed)
    geometry = random_socket(rng, rings=3, columns=5)
    bed = rigid_bed(rng, geometry, variant)
    pose = rigid_motion(rng, count, bed)
    samples = make_samples(pose, bed.wrench(pose), bed.cluster_forces(pose))
    settings = IdentificationSettings(variant=variant, contact_sharpness=bed.sharpness, **changes)
    return geometry, bed, samples, settings


@pytest.mark.parametrize("variant", RIGID_VARIANTS)
def test_derivatives_agree_with_differences(variant):
    geometry, _, samples, settings = rigid_case(4, variant)
    problem = Problem(build_objective(samples, geometry, settings))
    rng = np.random.default_rng(0)
    x = problem.start + 0.3 * rng.normal(size=problem.start.shape)
    way = rng.normal(size=x.shape)
    step, terms = 1e-5 * way, problem.evaluate(x)
    slope = (problem.value(x + step) - problem.value(x - step)) / 2e-5
    assert terms.gradient @ way.reshape(-1) == pytest.approx(slope, rel=1e-5)
    change = problem.evaluate(x + step).gradient - problem.evaluate(x - step).gradient
    hessian = terms.gauss_newton + problem.prior + terms.curvature
    scale = np.abs(change).max() / 2e-5
    np.testing.assert_allclose(hessian @ way.reshape(-1), change / 2e-5, atol=1e-6 * scale)


@pytest.mark.parametrize("variant", RIGID_VARIANTS)
def test_stage_two_is_the_objective_at_given_rest_displacements(variant):
    """Exactly, up to scale and constant: the forces are linear in the stiffnesses."""
    geometry, _, samples, settings = rigid_case(4, variant)
    problem = Problem(build_objective(samples, geometry, settings))
    rng = np.random.default_rng(1)
    x = problem.start + 0.3 * rng.normal(size=problem.start.shape)
    program = problem.stage_two(problem.moments(x))
    points = rng.uniform(0.0, 3.0, (6, *x[:3].shape))
    ours = np.array([program.objective(k.reshape(-1)) for k in points])
    values = np.array([problem.value(np.vstack([k, x[3:]])) for k in points])
    scale = (ours[1] - ours[0]) / (values[1] - values[0])
    np.testing.assert_allclose(ours - ours[0], scale * (values - values[0]), rtol=1e-9)


def test_constants_of_the_clusters_move_nothing_but_their_offsets():
    geometry, _, samples, settings = rigid_case(13, "rigid_bias")
    mean = samples.local_forces.mean(axis=0)
    moved = dataclasses.replace(samples, local_forces=samples.local_forces - 2.0 * mean)
    one, other = (fit_contact_model(s, geometry, settings) for s in (samples, moved))
    np.testing.assert_allclose(other.stage_one.x, one.stage_one.x, atol=1e-9)
    np.testing.assert_allclose(other.model.stiffness, one.model.stiffness, rtol=1e-6)
    for cluster, (name, bias) in enumerate(one.model.force_bias.items()):
        found = other.model.force_bias[name]
        np.testing.assert_allclose(found, bias - 2.0 * mean[cluster], atol=1e-4)


@pytest.mark.parametrize("variant", RIGID_VARIANTS)
def test_joint_refinement_recovers_what_the_bed_bears(variant):
    geometry, bed, samples, settings = rigid_case(5, variant, prior=1e-6)
    fit = fit_contact_model(samples, geometry, settings)
    assert fit.joint is not None and fit.joint.certificate.worst <= settings.solver_tolerance
    assert "joint refinement in " in fit.status
    unseen = rigid_motion(np.random.default_rng(6), 50, bed)
    error = fit.model.wrench(unseen) - bed.wrench(unseen)
    spread = bed.wrench(unseen).std(axis=0)
    assert (np.sqrt((error**2).mean(axis=0)) < 0.02 * spread).all()


def test_a_pose_or_a_load_that_stands_still_gives_no_slope():
    geometry, bed, samples, settings = rigid_case(12, "rigid_bias")
    # The mean of the rotation differs from it by rounding.
    still = dataclasses.replace(samples, rotation=np.tile([0.1, -0.2, 0.3], (80, 1)))
    model = fit_contact_model(still, geometry, settings).model
    assert (model.wrench_slope[:, 3:] == 0.0).all()
    # A limb that creeps while its load stays tells nothing about another load.
    noise = np.random.default_rng(0).normal(0.0, [0.001] * 3 + [0.1] * 3, (80, 6))
    creeping = dataclasses.replace(samples, wrench=samples.wrench.mean(axis=0) + noise)
    held = fit_contact_model(creeping, geometry, settings).model
    size = np.abs(bed.wrench(samples.pose) - bed.wrench(samples.pose).mean(axis=0)).max(axis=0)
    reach = np.abs(samples.pose - held.reference_pose).max(axis=0)
    assert (np.abs(held.wrench_slope) @ reach < 0.1 * size).all()


def test_the_wrench_is_taken_from_what_predicts_the_unseen_half_best(tmp_path):
    """A wrench that is linear in the pose is a regression's; the bed keeps the clusters' forces."""
    geometry, bed, samples, settings = rigid_case(4, "rigid_bias", count=160)
    own = fit_contact_model(samples, geometry, settings)
    assert own.wrench == "" and own.model.of_wrench is None  # the bed is the truth
    soft = {"contact_sharpness": 20.0, "wrench_sharpness": (20.0, bed.sharpness)}
    fit = fit_contact_model(samples, geometry, dataclasses.replace(settings, **soft))
    assert fit.wrench.startswith("springs of sharpness 300 /m: ")
    assert fit.model.sharpness == 20.0 and fit.model.of_wrench.sharpness == bed.sharpness
    change = samples.wrench - samples.wrench.mean(axis=0)  # under one load it says nothing
    held = dataclasses.replace(samples, wrench=np.array([0, 1, 0, 5, 3, -250.0]) + 1e-3 * change)
    assert fit_contact_model(held, geometry, settings).model.of_wrench is None
    slope = np.random.default_rng(2).normal(size=(6, 6)) * np.repeat([[40.0], [2000.0]], 3, axis=0)
    pose = samples.pose - samples.pose.mean(axis=0)
    samples.wrench[:] = [0.5, 1.0, 0.1, 5.0, 3.0, -250.0] + pose @ slope.T
    fit = fit_contact_model(samples, geometry, settings)
    assert fit.wrench.startswith("linear regression on the pose: ")
    np.testing.assert_allclose(fit.model.wrench(samples.pose), samples.wrench, atol=0.5)
    alone = dataclasses.replace(fit.model, of_wrench=None)
    np.testing.assert_array_equal(alone.forces(samples.pose), fit.model.forces(samples.pose))
    write_model(fit, geometry, {"name": "made up"}, "all", tmp_path / "model.json")
    stored = read_model(tmp_path / "model.json").model
    np.testing.assert_allclose(
        stored.wrench(samples.pose), fit.model.wrench(samples.pose), atol=1e-6
    )
