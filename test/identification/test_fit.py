"""Contact laws, and fits from samples to a model, against stacked problems and known truths."""

import json
import math
from dataclasses import replace
from unittest.mock import Mock, patch

import numpy as np
import pytest
import qpsolvers
from scipy.spatial.transform import Rotation
from support import problems, stacked
from support.damage import changed
from support.wording import refused

from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.identification import fit as fitting
from socket_testbed.identification import solver as solving
from socket_testbed.identification.channel_errors import channel_errors, summarise_errors
from socket_testbed.identification.contact import LAWS, ContactModel, wrench_map
from socket_testbed.identification.model_file import read_model, write_model
from socket_testbed.identification.problem import MIN_SAMPLES, Problem, build_objective
from socket_testbed.identification.solver import WARM_START, BoxQP, pivot_regularised, solve_box_qp
from socket_testbed.settings.identification import PAPER_VARIANTS, VARIANTS, IdentificationSettings

SOLVERS = [solver for solver in ("osqp", "daqp") if solver in qpsolvers.available_solvers]
REFERENCE = np.array([0.01, -0.02, 0.15, 0.02, 0.1, -0.05])  # [m, rad]
LEFT_OUT = {
    "nothing": (),
    "one": ("cluster_1.Fx",),
    "three": ("Mz", "cluster_0.Fz", "cluster_2.Fy"),
    "wrench": ("Mx", "My", "Mz", "Fx", "Fy", "Fz"),
}
ALL = slice(None)


def value_of(program: BoxQP, x: np.ndarray) -> float:
    return float(0.5 * x @ program.P @ x + program.q @ x)


@pytest.mark.parametrize("leave_out", LEFT_OUT.values(), ids=LEFT_OUT)
@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_the_fit_solves_the_stacked_problem(variant, leave_out):
    geometry, _, samples, settings = problems.make_case(91, variant, gaps=True, leave_out=leave_out)
    centre = samples.position.mean(axis=0)
    if len(leave_out) == 1:
        settings = replace(settings, weights="raw", theta=0.3)
    elif leave_out:  # then about a given reference, and with rest positions at their limit
        centre = centre + np.array([0.003, -0.002, 0.004])
        settings = replace(settings, reference_position=(*centre,), rest_position_limit=8e-4)
    u = stacked.stack_stage_one(samples, geometry, settings).solve()
    assert not leave_out[1:] or np.isclose(np.abs(u), 0.8).any()
    rest = centre + stacked.MILLIMETRE * u.reshape(-1, 3)
    expected = stacked.stack_stage_two(samples, geometry, settings, rest).solve()
    fit = fitting.fit_contact_model(samples, geometry, settings)
    np.testing.assert_allclose(fit.model.rest_positions, rest, atol=1e-8)
    stiffness = fit.model.stiffness.reshape(-1) / stacked.KILONEWTON_PER_METRE
    assert stacked.relative(stiffness, expected[: len(stiffness)]) < 10.0 * stacked.OPTIMUM
    assert (stiffness == 0.0).sum() >= 2  # otherwise the bounds were not tried
    local = [fit.model.force_bias.get(name, np.zeros(3)) for name in samples.clusters]
    offsets = np.concatenate([fit.model.wrench_bias, *local])
    kept = [variant == "stiffness_bias" and name not in leave_out for name in samples.channels]
    assert (offsets[~np.array(kept)] == 0.0).all()
    np.testing.assert_allclose(offsets[kept], expected[len(stiffness) :], rtol=1e-4, atol=1e-4)


def test_k0_is_the_slope_of_wrench_over_position():
    geometry, _, samples, settings = problems.make_case(95, initial_stiffness=0.0)
    moved = np.tile(samples.position, len(geometry))  # every tile with the limb
    samples.wrench[:] = -300.0 + 4e3 * moved @ wrench_map(geometry.anchors).T
    fit = fitting.fit_contact_model(samples, geometry, settings)
    assert fit.settings.initial_stiffness == pytest.approx(4e3)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(
    ("variant", "programs"),
    [
        pytest.param("stiffness_bias", 2, id="stiffness_bias"),  # both stages
        pytest.param("rigid_bias", 3, id="rigid_bias"),  # and the refinement's first step
    ],
)
def test_the_chosen_solver_gets_every_program(solver, variant, programs: int):
    """The fit repeats exactly."""
    # Without beds for the wrench, which are fitted as well.
    geometry, _, samples, settings = problems.make_case(31, solver=solver)
    settings = replace(settings, variant=variant)
    with patch("qpsolvers.solve_problem", wraps=qpsolvers.solve_problem) as solve:
        fit, again = (fitting.fit_contact_model(samples, geometry, settings) for _ in range(2))
    called = [call.args[1] for call in solve.call_args_list]
    assert called == 2 * [solver] * programs
    np.testing.assert_array_equal(fit.model.stiffness, again.model.stiffness)


def test_weights_by_noise_follow_the_noise(rng):
    geometry = problems.random_socket(rng)
    noise = np.array([1.0, 2.0, 4.0, 10.0, 20.0, 40.0])  # [N m, N]; far above 1 % of the size
    local = np.array([0.5, 1.0, 2.0])  # [N]
    forces = {name: rng.normal(0.0, local, (1000, 3)) for name in geometry.clusters}
    wrench = rng.normal(0.0, noise, (1000, 6))
    samples = problems.make_samples(rng.normal(0.0, 1e-3, (1000, 3)), wrench, forces)
    objective = build_objective(samples, geometry, IdentificationSettings(weights="noise"))
    weight = objective.wrench_shares * noise**2, objective.channel_shares * np.tile(local, 3) ** 2
    for of_group in weight:
        np.testing.assert_allclose(of_group, of_group.mean(), rtol=0.2)


@pytest.mark.parametrize(
    "lost", [("Mz",), ("Mx", "My", "Mz", "Fx", "Fy", "Fz")], ids=["Mz", "wrench"]
)
def test_what_is_left_out_does_not_matter(lost):
    """The fit says what it rests on."""
    geometry, _, samples, settings = problems.make_case(77, leave_out=(*lost, "cluster_1.Fz"))
    samples.local_forces[:, 1, 2] = np.nan  # a dead channel may be left out
    expected = fitting.fit_contact_model(samples[:-3], geometry, settings)
    samples.wrench[:, [samples.channels.index(name) for name in lost]] = np.nan
    samples.position[-3:] = np.nan
    fit = fitting.fit_contact_model(samples, geometry, settings)
    assert fit.samples == len(samples) - 3 and fit.last_stamp == samples.stamps[-4]
    stiffness = expected.model.stiffness
    np.testing.assert_allclose(fit.model.stiffness, stiffness, rtol=1e-8, atol=1e-6)
    np.testing.assert_allclose(fit.model.wrench_bias, expected.model.wrench_bias, atol=1e-8)
    for error in fit.errors:
        assert error.in_objective == (error.name not in settings.leave_out)
        assert error.samples == fit.samples * error.in_objective


def missing(array: str, *place):
    """Makes values of an array of samples missing."""

    def change(samples):
        values = getattr(samples, array).copy()
        values[place] = np.nan
        return {array: values}

    return change


@pytest.mark.parametrize(
    ("leave_out", "change", "names"),
    [
        pytest.param(
            *((), missing("local_forces", ALL, 1, 2), ("cluster_1.Fz ", "(--leave-out ")),
            id="dead-cluster-channel",
        ),
        pytest.param(
            (), missing("wrench", ALL, 2), ("Mz ", "(--leave-out "), id="dead-wrench-channel"
        ),
        pytest.param(
            (),
            missing("position", np.s_[MIN_SAMPLES - 1 :]),
            ("only 11 of 40 samples", "needs 12"),
            id="few-positions",
        ),
        pytest.param(
            (),
            missing("position"),
            ("none of the 40 samples has a limb position",),
            id="no-position",
        ),
        pytest.param(
            (),
            lambda _: {"clusters": ("cluster_0", "brim", "cluster_2")},
            ("'brim'",),
            id="unknown-cluster",
        ),
        pytest.param(
            ("mz",), lambda _: {}, ("leave_out: no channel 'mz'", "Mz"), id="unknown-channel"
        ),
        pytest.param(..., lambda _: {}, ("every channel is left out",), id="all-left-out"),
    ],
)
def test_what_cannot_be_fitted_is_named(leave_out, change, names):
    geometry, _, samples, settings = problems.make_case(71)
    leave_out = samples.channels if leave_out is ... else leave_out
    with refused(TestbedError, *names):
        spoilt = replace(samples, **change(samples))
        fitting.fit_contact_model(spoilt, geometry, replace(settings, leave_out=leave_out))


def test_twelve_samples_with_a_position_are_enough():
    geometry, _, samples, settings = problems.make_case(71)
    few = replace(samples, **missing("position", np.s_[MIN_SAMPLES:])(samples))
    assert fitting.fit_contact_model(few, geometry, settings).samples == MIN_SAMPLES == 12


# --- Stage 2 at given rest positions


def solve_stage_two(samples, geometry, settings, rest):
    """The problem, its moments at given rest positions, and the solution of Stage 2 there."""
    problem = Problem(build_objective(samples, geometry, settings))
    x = problem.start.copy()
    x[3:] = (rest - problem.law.reference_pose[:3]).T / stacked.MILLIMETRE
    moments = problem.moments(x)
    x[:3] = solve_box_qp(problem.stage_two(moments), "osqp", 1e-6).x.reshape(3, -1)
    return problem, moments, x


def test_determined_directions_are_decided_by_the_data():
    geometry, bed, samples, settings = problems.make_case(64, smoothness=1e-12)
    problem, moments, found = solve_stage_two(samples, geometry, settings, bed.rest_positions)
    free = (found[:3] > 0.0).sum()  # nearly no smoothness: the data decides all that is free
    assert problem.determined_directions(found, moments) == pytest.approx(free, abs=0.5)


def test_samples_that_repeat_change_nothing():
    geometry, bed, samples, settings = problems.make_case(64, smoothness=1e-12)
    found = solve_stage_two(samples, geometry, settings, bed.rest_positions)[2]
    # Every sample 20 times is more than a block of the products.
    many = samples[np.repeat(np.arange(len(samples)), 20)]
    again = solve_stage_two(many, geometry, settings, bed.rest_positions)[2]
    assert stacked.relative(again, found) < 1e-6


# --- The rigid variants: the joint refinement, and what it recovers


def rigid_motion(rng: np.random.Generator, count: int, bed: ContactModel) -> np.ndarray:
    """Poses that move along all six directions, (N, 6) [m, rad]."""
    phase = np.linspace(0.0, 2.0 * np.pi, count)[:, None] * [1.0, 2.0, 3.0, 2.0, 3.0, 1.0]
    way = np.sin(phase + rng.uniform(0.0, 2.0 * np.pi, 6)) * ([0.002] * 3 + [0.03] * 3)
    turned = Rotation.from_rotvec(way[:, 3:]) * Rotation.from_rotvec(bed.reference_pose[3:])
    return np.hstack([bed.reference_pose[:3] + way[:, :3], turned.as_rotvec()])


def rigid_case(seed: int, variant="rigid", count: int = 80, **changes):
    """A rigid bed that presses everywhere a little: a limb that settled."""
    rng = np.random.default_rng(seed)
    geometry = problems.random_socket(rng, rings=3, columns=5)
    size, inwards = (len(geometry), 3), geometry.rotations[:, 2]
    bed = replace(
        problems.random_bed(np.random.default_rng(0), geometry, variant),
        rest_positions=rng.normal([0.0, 0.0, 0.003], 0.001, size) - 0.004 * inwards,
        stiffness=rng.uniform(0.5, 1.5, size) * [2000.0, 2000.0, 6000.0],
        sharpness=300.0,
        reference_pose=REFERENCE,
    )
    pose = rigid_motion(rng, count, bed)
    samples = problems.make_samples(pose, bed.wrench(pose), bed.cluster_forces(pose))
    settings = IdentificationSettings(variant=variant, contact_sharpness=bed.sharpness, **changes)
    return geometry, bed, samples, settings


REFINED = pytest.mark.parametrize("variant", [v for v in VARIANTS if LAWS[v].REFINED])


@REFINED
def test_derivatives_agree_with_differences(variant, rng):
    geometry, _, samples, settings = rigid_case(4, variant)
    problem = Problem(build_objective(samples, geometry, settings))
    x = problem.start + 0.3 * rng.normal(size=problem.start.shape)
    way = rng.normal(size=x.shape)
    step, terms = 1e-5 * way, problem.evaluate(x)
    slope = (problem.value(x + step) - problem.value(x - step)) / 2e-5
    assert terms.gradient @ way.reshape(-1) == pytest.approx(slope, rel=1e-5)
    change = problem.evaluate(x + step).gradient - problem.evaluate(x - step).gradient
    hessian = terms.gauss_newton + problem.prior + terms.curvature
    scale = np.abs(change).max() / 2e-5
    np.testing.assert_allclose(hessian @ way.reshape(-1), change / 2e-5, atol=1e-6 * scale)


@REFINED
def test_stage_two_is_the_objective_up_to_scale(variant, rng):
    """And up to a constant: forces are linear in the stiffnesses."""
    geometry, _, samples, settings = rigid_case(4, variant)
    problem = Problem(build_objective(samples, geometry, settings))
    x = problem.start + 0.3 * rng.normal(size=problem.start.shape)
    program = problem.stage_two(problem.moments(x))
    points = rng.uniform(0.0, 3.0, (6, *x[:3].shape))
    ours = np.array([value_of(program, k.reshape(-1)) for k in points])
    values = np.array([problem.value(np.vstack([k, x[3:]])) for k in points])
    scale = (ours[1] - ours[0]) / (values[1] - values[0])
    np.testing.assert_allclose(ours - ours[0], scale * (values - values[0]), rtol=1e-9)


def test_constants_of_clusters_move_only_their_offsets():
    geometry, _, samples, settings = rigid_case(13, "rigid_bias")
    mean = samples.local_forces.mean(axis=0)
    moved = replace(samples, local_forces=samples.local_forces - 2.0 * mean)
    one, other = (fitting.fit_contact_model(s, geometry, settings) for s in (samples, moved))
    np.testing.assert_allclose(other.stage_one.x, one.stage_one.x, atol=1e-9)
    np.testing.assert_allclose(other.model.stiffness, one.model.stiffness, rtol=1e-6)
    for cluster, (name, bias) in enumerate(one.model.force_bias.items()):
        found = other.model.force_bias[name]
        np.testing.assert_allclose(found, bias - 2.0 * mean[cluster], atol=1e-4)


@pytest.mark.parametrize("variant", ("rigid", "rigid_bias"))
def test_joint_refinement_recovers_what_the_bed_bears(variant):
    geometry, bed, samples, settings = rigid_case(5, variant, prior=1e-6)
    fit = fitting.fit_contact_model(samples, geometry, settings)
    assert fit.joint is not None and fit.joint.certificate.worst <= settings.solver_tolerance
    unseen = rigid_motion(np.random.default_rng(6), 50, bed)
    springs = replace(fit.model, of_wrench=None)
    error = springs.wrench(unseen) - bed.wrench(unseen)
    spread = bed.wrench(unseen).std(axis=0)
    assert (np.sqrt((error**2).mean(axis=0)) < 0.02 * spread).all()


def test_a_rotation_that_stands_still_gives_no_slope():
    geometry, _, samples, settings = rigid_case(12, "rigid_bias")
    # The mean of the rotation differs from it by rounding.
    still = replace(samples, rotation=np.tile([0.1, -0.2, 0.3], (80, 1)))
    model = fitting.fit_contact_model(still, geometry, settings).model
    assert (model.wrench_slope[:, 3:] == 0.0).all()


def test_a_creeping_limb_gives_no_slope():
    """While its load stays, it tells nothing about another load."""
    geometry, bed, samples, settings = rigid_case(12, "rigid_bias")
    noise = np.random.default_rng(0).normal(0.0, [0.001] * 3 + [0.1] * 3, (80, 6))
    creeping = replace(samples, wrench=samples.wrench.mean(axis=0) + noise)
    held = fitting.fit_contact_model(creeping, geometry, settings).model
    size = np.abs(bed.wrench(samples.pose) - bed.wrench(samples.pose).mean(axis=0)).max(axis=0)
    reach = np.abs(samples.pose - held.reference_pose).max(axis=0)
    assert (np.abs(held.wrench_slope) @ reach < 0.1 * size).all()


# --- What the wrench is taken from


def test_one_load_says_nothing_about_the_wrench():
    geometry, _, samples, settings = rigid_case(4, "rigid_bias", count=160)
    change = samples.wrench - samples.wrench.mean(axis=0)
    held = replace(samples, wrench=np.array([0, 1, 0, 5, 3, -250.0]) + 1e-3 * change)
    fit = fitting.fit_contact_model(held, geometry, settings)
    assert fit.model.of_wrench is None
    assert fit.wrench == "the bed's own springs: the force changes by less than a tenth"


@pytest.fixture(scope="module")
def linear():
    """The socket, samples with a wrench linear in the pose, settings, and the fit to them."""
    geometry, _, samples, settings = rigid_case(4, "rigid_bias", count=160)
    slope = np.random.default_rng(2).normal(size=(6, 6)) * np.repeat([[40.0], [2000.0]], 3, axis=0)
    pose = samples.pose - samples.pose.mean(axis=0)
    samples.wrench[:] = [0.5, 1.0, 0.1, 5.0, 3.0, -250.0] + pose @ slope.T
    return geometry, samples, settings, fitting.fit_contact_model(samples, geometry, settings)


def test_a_wrench_linear_in_the_pose_is_regressed(linear):
    """The bed keeps the clusters' forces."""
    _, samples, _, fit = linear
    assert fit.wrench.startswith("linear regression on the pose")
    np.testing.assert_allclose(fit.model.wrench(samples.pose), samples.wrench, atol=0.5)
    alone = replace(fit.model, of_wrench=None)
    np.testing.assert_array_equal(alone.forces(samples.pose), fit.model.forces(samples.pose))


def test_a_left_out_channel_decides_nothing(linear):
    geometry, samples, settings, _ = linear
    without = replace(settings, leave_out=("Mz",))
    fit = fitting.fit_contact_model(samples, geometry, without)
    assert fit.model.of_wrench is None
    assert fit.wrench == "the bed's own springs: a channel of the wrench is missing or left out"


def test_a_law_without_a_choice_says_nothing(linear):
    geometry, samples, settings, _ = linear
    rigid = fitting.fit_contact_model(samples, geometry, replace(settings, variant="rigid"))
    assert rigid.wrench == "" and rigid.model.of_wrench is None


def test_a_regression_comes_back_from_its_file(linear, tmp_path):
    _, samples, _, fit = linear
    path = tmp_path / "model.json"
    write_model(fit, path, {"name": "made up"})
    found = read_model(path).model.wrench(samples.pose)
    np.testing.assert_allclose(found, fit.model.wrench(samples.pose), atol=1e-6)


# --- Errors per channel


def test_errors_are_those_by_hand():
    measured = np.array([1.0, np.nan, 2.0, 3.0, 6.0, 9.0])
    predicted = np.array([2.0, 2.0, 2.0, 1.0, 6.0, np.inf])
    found = channel_errors("Fx", measured, predicted, in_objective=False)
    # Residuals 1, 0, -2, 0 with mean -1/4; measured with mean 3 and variance 14/4.
    assert found.rmse == pytest.approx(math.sqrt(5.0 / 4.0))
    assert found.mae == pytest.approx(3.0 / 4.0)
    assert found.sigma == pytest.approx(math.sqrt(5.0 / 4.0 - 1.0 / 16.0))
    assert found.skill == pytest.approx(1.0 - math.sqrt(5.0 / 14.0))
    assert (found.name, found.unit, found.samples, found.in_objective) == ("Fx", "N", 4, False)


def test_a_channel_without_a_value_has_no_errors():
    found = channel_errors("Mx", np.full(4, np.nan), np.zeros(4))
    assert found.samples == 0 and math.isnan(found.rmse) and math.isnan(found.skill)


def test_a_constant_channel_has_no_skill():
    found = channel_errors("Fx", np.full(1000, 1e-7), np.full(1000, 1.0 + 1e-7))
    assert found.rmse == pytest.approx(1.0) and math.isnan(found.skill)


def test_quoted_figures_are_of_the_objective_s_channels(rng):
    names = ("Mx", "My", "Mz", "Fx", "Fy", "Fz", "a.Fx", "a.Fy", "Mid.Fx")
    errors = [channel_errors(name, *rng.normal(size=(2, 50))) for name in names]
    left_out = channel_errors("Mx", 1e3 * np.ones(5), np.zeros(5), in_objective=False)
    dead = channel_errors("Mz", np.full(30, np.nan), np.zeros(30))
    found = summarise_errors([*errors, left_out, dead])
    rmse = np.array([error.rmse for error in errors])
    means = (found.mean_moment_rmse, found.mean_force_rmse, found.median_local_rmse)
    assert means == pytest.approx((rmse[:3].mean(), rmse[3:6].mean(), np.median(rmse[6:])))
    assert found.without_value == ("Mz",)


# --- The file of a model


SPOILT = {
    "older-format": (
        ("format",),
        "socket_testbed model 0",
        "is of the format 'socket_testbed model 0': fit the",
    ),
    "missing-rows": (("parameters", "stiffness"), [[1.0, 2.0, 3.0]], "stiffness has 1 rows for "),
    "too-large": (
        ("parameters", "rest_positions", 1, 2),
        1e300,
        "rest_positions[1][2] is 1e+300: give",
    ),
    "too-small": (
        ("parameters", "rest_positions", 1, 2),
        -1e300,
        "rest_positions[1][2] is -1e+300: give",
    ),
    "unknown-bias": (
        ("parameters", "force_bias", "elsewhere"),
        [0, 0, 0],
        "unknown key 'elsewhere'",
    ),
    "unknown-cluster": (("parameters", "clusters"), ["nowhere"], "clusters: no cluster 'nowhere'"),
    # Such a fit cannot be repeated.
    "former-setting": (("settings", "noise_correction"), True, "unknown key"),
}


@pytest.mark.parametrize(("place", "value", "error"), SPOILT.values(), ids=SPOILT)
def test_a_spoilt_model_is_refused(hold_model, tmp_path, place, value, error):
    path, document = tmp_path / "model.json", json.loads(hold_model.read_text())
    path.write_text(json.dumps(changed(document, place, value)))
    with refused(ConfigurationError, str(path), error):
        read_model(path)


def test_a_model_of_an_older_version_is_read(hold_model, tmp_path):
    path, document = tmp_path / "model.json", json.loads(hold_model.read_text())
    document["quality"].pop("errors")
    document["parameters"]["parameter_factor"] = ["0 1 2"]
    document["settings"]["noise_correction"] = False
    path.write_text(json.dumps(document))
    assert read_model(path).errors == ()


# --- The contact laws against their definitions


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_the_paper_s_model_is_springs_with_offsets(rng, variant, monkeypatch):
    monkeypatch.setattr("socket_testbed.identification.contact._CHUNK", 7)
    geometry = problems.random_socket(rng)
    bed = problems.random_bed(rng, geometry, variant)
    q = problems.moving_limb(rng, 15)
    springs = bed.stiffness * problems.naive_gated(q[:, None] - bed.rest_positions, bed.sharpness)
    moment = np.cross(geometry.anchors, springs).sum(axis=1)
    wrench = np.hstack([moment, springs.sum(axis=1)]) + bed.wrench_bias
    np.testing.assert_allclose(bed.wrench(q), wrench, atol=1e-10)
    local = bed.cluster_forces(q)
    assert set(local) == set(geometry.clusters)
    channels = np.hstack([wrench, *local.values()])
    np.testing.assert_allclose(bed.predict(q, [*local]), channels, atol=1e-10)
    for name, tile in geometry.clusters.items():
        offset = geometry.rotations[tile] @ bed.force_bias.get(name, np.zeros(3))
        springs[:, tile] += offset
        expected = springs[:, tile] @ geometry.rotations[tile]
        np.testing.assert_allclose(local[name], expected, atol=1e-10)
    np.testing.assert_allclose(bed.forces(q), springs, atol=1e-10)


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_a_tile_far_out_of_contact_bears_nothing(rng, variant):
    geometry = problems.random_socket(rng)
    law = LAWS[variant](geometry.anchors, geometry.rotations, 2000.0, REFERENCE)
    with np.errstate(over="raise"):  # the law keeps its overflow quiet
        assert (law.columns(np.full((1, 3, 1), 1e3)) == 0.0).all()


def rigid_bed_at_reference(rng):
    """A rigid bed about the reference, far from {S}; small shifts and turns; their poses."""
    bed = problems.random_bed(rng, problems.random_socket(rng), "rigid")
    shifts, turns = rng.normal(0.0, 0.004, (40, 3)), rng.normal(0.0, 0.02, (40, 3))
    turned = Rotation.from_rotvec(turns) * Rotation.from_rotvec(REFERENCE[3:])
    pose = np.hstack([REFERENCE[:3] + shifts, turned.as_rotvec()])
    return replace(bed, reference_pose=REFERENCE), shifts, turns, pose


def test_a_rigid_model_gates_in_the_tile_frame(rng):
    """It never pulls."""
    bed, shifts, turns, pose = rigid_bed_at_reference(rng)
    forces, alpha = bed.forces(pose), bed.sharpness
    for tile, (kx, ky, kz) in enumerate(bed.stiffness):
        moved = shifts + np.cross(turns, bed.anchors[tile] - REFERENCE[:3])
        x, y, z = (moved @ bed.rotations[tile] - bed.rest_positions[tile]).T
        opened = 0.5 - 0.5 * np.tanh(alpha * z)
        normal = -kz * np.log1p(np.exp(-2.0 * alpha * z)) / (2.0 * alpha)
        expected = np.stack([kx * opened * x, ky * opened * y, normal], axis=1)
        found = forces[:, tile] @ bed.rotations[tile]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
        assert normal.max() <= 0.0


def test_no_pose_predicts_nothing(rng):
    bed, _, _, pose = rigid_bed_at_reference(rng)
    pose[4] = np.nan
    predicted = np.hstack([bed.predict(pose, [*bed.cluster_points]), bed.forces(pose)[:, 0]])
    assert np.flatnonzero(np.isnan(predicted).any(axis=1)).tolist() == [4]
    assert np.isnan(predicted[4]).all()


# --- The certificate of a program, its solution, and solvers that are not believed


def known_problem(seed, size=12):
    """A box QP made around its solution, with its solution."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(size, size))
    P = root @ root.T / size + 0.1 * np.eye(size)
    lower = np.where(rng.random(size) < 0.2, -np.inf, -rng.uniform(0.5, 1.0, size))
    upper = np.where(rng.random(size) < 0.2, np.inf, rng.uniform(0.5, 1.0, size))
    side = rng.integers(0, 3, size)
    at_lower, at_upper = (side == 1) & np.isfinite(lower), (side == 2) & np.isfinite(upper)
    x = np.select([at_lower, at_upper], [lower, upper], rng.uniform(-0.4, 0.4, size))
    gradient = rng.uniform(0.1, 1.0, size) * (at_lower.astype(float) - at_upper)
    return BoxQP(P, gradient - P @ x, lower, upper, "known"), x


def test_the_certificate_is_zero_at_the_optimum():
    problem, optimum = known_problem(1)
    assert problem.certificate(optimum).worst < 1e-13


@pytest.mark.parametrize("step", [1e-5, 1e-3, 1e-1])
def test_the_certificate_shows_a_step_inside(rng, step: float):
    problem, optimum = known_problem(1)
    direction = rng.normal(size=len(optimum))
    inside = np.clip(optimum + step * direction, problem.lower, problem.upper)
    assert value_of(problem, inside) > value_of(problem, optimum)
    assert problem.certificate(inside).worst > 0.01 * step


@pytest.mark.parametrize("side", ["lower", "upper"])
def test_the_certificate_shows_a_step_outside(side: str):
    problem, optimum = known_problem(1)
    bound, step = getattr(problem, side), 0.25 if side == "upper" else -0.25
    outside = np.where(np.isfinite(bound), bound + step, optimum)
    assert problem.certificate(outside).primal == pytest.approx(0.25)


@pytest.mark.parametrize("part", ["P", "q", "x"])
def test_what_is_not_a_number_is_never_certified(part: str):
    problem, optimum = known_problem(1)
    spoilt = optimum if part == "x" else getattr(problem, part)
    spoilt[3] = np.nan
    assert not problem.certificate(optimum).worst <= 1e-2


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("solver", SOLVERS)
def test_solvers_find_known_optima(solver, seed: int):
    problem, optimum = known_problem(seed)
    solution = solve_box_qp(problem, solver, 1e-9)
    np.testing.assert_allclose(solution.x, optimum, atol=1e-8)
    assert solution.certificate == problem.certificate(solution.x)
    assert solution.certificate.worst <= 1e-9
    assert solution.solver == solver and solver in solution.status


@pytest.mark.parametrize("step", [0.0, 0.01, 1.0, 100.0])
@pytest.mark.parametrize("solver", SOLVERS)
def test_near_a_solution_no_solver_is_called(monkeypatch, solver, step: float):
    problem, optimum = known_problem(2)
    monkeypatch.setattr(qpsolvers, "solve_problem", None)
    warm = solve_box_qp(problem, solver, 1e-9, optimum + step)
    np.testing.assert_allclose(warm.x, optimum, atol=1e-11)
    assert warm.certificate.worst <= 1e-9 and warm.determined and warm.solver == WARM_START


@pytest.fixture
def uncorrected(monkeypatch):
    """A solver whose answer nobody corrects."""
    for correct in ("pivot", "pivot_regularised"):
        place = f"socket_testbed.identification.solver.{correct}"
        monkeypatch.setattr(place, lambda of, x: solving.BoxSolution(x, of.certificate(x)))
    monkeypatch.setattr(qpsolvers, "solve_problem", solver := Mock())
    return solver


def test_a_wrong_answer_is_refused_by_its_residual(uncorrected):
    """Whatever the solver says."""
    problem, optimum = known_problem(85)
    wrong = np.clip(optimum + 0.05, problem.lower, problem.upper)
    uncorrected.side_effect = [qpsolvers.Solution(None, found=True, x=wrong)]
    with pytest.raises(solving.UncertifiedSolutionError, match="KKT") as caught:
        solve_box_qp(problem, "osqp", 1e-6)
    assert caught.value.residual == pytest.approx(problem.certificate(wrong).worst)


def test_a_solver_that_fails_is_named(uncorrected):
    uncorrected.side_effect = [qpsolvers.exceptions.SolverError("out of luck")]
    with pytest.raises(solving.UncertifiedSolutionError, match="out of luck") as caught:
        solve_box_qp(known_problem(85)[0], "osqp", 1e-6)
    assert math.isnan(caught.value.residual)


NO_ANSWERS = [pytest.param(None, id="no-vector"), pytest.param(np.full(12, np.nan), id="nan")]


@pytest.mark.parametrize("answer", NO_ANSWERS)
def test_without_an_answer_pivoting_finds_the_optimum(monkeypatch, answer):
    problem, optimum = known_problem(1)
    monkeypatch.setattr(qpsolvers, "solve_problem", solver := Mock())
    solver.side_effect = [qpsolvers.Solution(None, found=False, x=answer)]
    solution = solve_box_qp(problem, "osqp", 1e-9)
    np.testing.assert_allclose(solution.x, optimum, atol=1e-8)
    assert solution.status.startswith("osqp without an answer, pivoting ")


@pytest.mark.parametrize("answer", NO_ANSWERS)
def test_without_any_answer_the_solver_is_named(uncorrected, answer):
    uncorrected.side_effect = [qpsolvers.Solution(None, found=True, x=answer)]
    with pytest.raises(solving.UncertifiedSolutionError, match="osqp without an answer misses"):
        solve_box_qp(known_problem(85)[0], "osqp", 1e-6)


@pytest.mark.parametrize(
    ("curvature", "start", "solver"),
    [
        pytest.param(0.0, 0.29, "osqp", id="exactly-flat"),  # a near solution leads nowhere
        pytest.param(1e-14, 0.0, WARM_START, id="flat-but-for-rounding"),  # it does
    ],
)
def test_a_flat_program_is_solved_but_undetermined(rng, curvature, start, solver):
    root = rng.normal(size=(12, 12))
    P, q = root @ root.T / 12 + 0.1 * np.eye(12), rng.normal(size=12)
    P[:, 0] = P[0] = q[0] = 0.0
    P[0, 0] = curvature
    flat = BoxQP(P, q, np.full(12, -0.3), np.full(12, 0.3), "flat")
    solution = solve_box_qp(flat, "osqp", 1e-6, np.full(12, start))
    assert solution.certificate.worst <= 1e-6
    assert solution.solver == solver and not solution.determined


def test_the_optimum_nearest_to_zero_is_found():
    program = BoxQP(np.ones((2, 2)), np.full(2, -4.0), np.full(2, -5.0), np.full(2, 5.0), "a line")
    found = pivot_regularised(program, np.array([0.001, 4.001]))
    np.testing.assert_allclose(found.x, 2.0, atol=1e-5)
