"""Stage 1 and Stage 2 against the problems written out row by row, and known truths."""

import dataclasses

import numpy as np
import pytest
import qpsolvers
from support.problems import (
    FAR,
    LEFT_OUT,
    installed,
    make_case,
    make_samples,
    moving_limb,
    naive_gated,
    random_socket,
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

from socket_testbed.identification.box_qp import solve_box_qp
from socket_testbed.identification.contact import wrench_map
from socket_testbed.identification.problem import (
    StageTwoData,
    build_objective,
    build_stage_one,
    build_stage_two,
    recover_offsets,
)
from socket_testbed.settings.identification import PAPER_VARIANTS, IdentificationSettings

WRONG = 5e-4  # [m]; a bed beside the true one, so that bounds become active
STACKED_OPTIONS = {
    "daqp": {"sparse_conversion": False},
    "clarabel": {"sparse_conversion": True}
    | dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-14),
}


def random_stiffness(rng, n):
    return rng.uniform(0.0, 10.0, 3 * n) * (rng.random(3 * n) < 0.7)  # [kN/m]


def stage_two_at(objective, rest_positions):
    return build_stage_two(objective, StageTwoData(objective).moments(rest_positions))


def solve_stage_one(samples, geometry, settings):
    """Rest positions in {S} [m]."""
    program = build_stage_one(build_objective(samples, geometry, settings))
    u = solve_box_qp(program, settings.solver, settings.solver_tolerance).x
    return samples.position.mean(axis=0) + MILLIMETRE * u.reshape(-1, 3)


def solve_stage_two(samples, geometry, settings, rest_positions):
    """Stiffnesses [kN/m] and the offsets of the package at given rest positions."""
    objective = build_objective(samples, geometry, settings)
    moments = StageTwoData(objective).moments(rest_positions)
    stage = build_stage_two(objective, moments)
    x = solve_box_qp(stage.program, settings.solver, settings.solver_tolerance).x
    stiffness = KILONEWTON_PER_METRE * x.reshape(-1, 3)
    offsets = recover_offsets(objective, moments, stiffness)
    return x, offsets


def solve_both_ways(samples, geometry, settings, rest_positions):
    """Stiffnesses [kN/m] and offsets of the package, and the stacked rows' solution of both."""
    rows = stack_stage_two(samples, geometry, settings, rest_positions)
    return *solve_stage_two(samples, geometry, settings, rest_positions), rows.solve()


def assert_same_up_to_scale_and_constant(program, rows, points):
    ours = np.array([program.objective(x) for x in points])
    stacked = np.array([rows.cost(x) for x in points])
    scale = (ours[1] - ours[0]) / (stacked[1] - stacked[0])
    assert scale > 0.0
    np.testing.assert_allclose(
        ours - ours[0], scale * (stacked - stacked[0]), rtol=0.0, atol=1e-9 * np.ptp(ours)
    )


def linear_samples(rng, geometry, rest_positions, k0, count=30):
    """Noise-free samples of linear springs F_i = k0 (q - q_r,i)."""
    position = moving_limb(rng, count) + FAR
    forces = k0 * (position[:, None] - rest_positions)
    moment = np.cross(geometry.anchors, forces).sum(axis=1)
    local = {name: forces[:, i] @ geometry.rotations[i] for name, i in geometry.clusters.items()}
    return make_samples(position, np.hstack([moment, forces.sum(axis=1)]), local)


def test_the_wrench_map_of_the_stack_is_the_packages():
    geometry, bed, samples, settings = make_case(99, noise=0.0)
    forces = bed.stiffness * naive_gated(samples.position[:, None] - bed.rest_positions, 2000.0)
    wrench = forces.reshape(len(samples), -1) @ wrench_map(geometry.anchors).T + bed.wrench_bias
    np.testing.assert_allclose(wrench, samples.wrench, atol=1e-9)
    exact = dataclasses.replace(settings, smoothness=0.0)
    rows = stack_stage_two(samples, geometry, exact, bed.rest_positions)
    assert rows.cost(bed.stiffness.reshape(-1) / KILONEWTON_PER_METRE) < 1e-20


@pytest.mark.parametrize("leave_out", LEFT_OUT)
@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_raw_weights_are_the_sums_that_the_paper_prints(variant, leave_out):
    geometry, bed, samples, settings = make_case(
        22, variant, gaps=True, leave_out=leave_out, weights="raw", theta=0.3
    )
    rng = np.random.default_rng(24)
    programs = (
        build_stage_one(build_objective(samples, geometry, settings)),
        stage_two_at(build_objective(samples, geometry, settings), bed.rest_positions).program,
    )
    rows = (
        stack_stage_one(samples, geometry, settings),
        stack_stage_two(samples, geometry, settings, bed.rest_positions),
    )
    for program, stacked in zip(programs, rows, strict=True):
        points = rng.uniform(0.0, 8.0, (12, 3 * len(geometry)))  # [mm], [kN/m]
        assert_same_up_to_scale_and_constant(program, stacked, points)


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("leave_out", LEFT_OUT)
def test_stage_one_is_the_stacked_objective_up_to_scale_and_constant(leave_out, gaps):
    geometry, _, samples, settings = make_case(23, gaps=gaps, leave_out=leave_out)
    program = build_stage_one(build_objective(samples, geometry, settings))
    rows = stack_stage_one(samples, geometry, settings)
    points = np.random.default_rng(24).uniform(-8.0, 8.0, (12, 3 * len(geometry)))  # [mm]
    assert_same_up_to_scale_and_constant(program, rows, points)


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("leave_out", LEFT_OUT)
@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_stage_two_is_the_stacked_objective_up_to_scale_and_constant(variant, leave_out, gaps):
    geometry, bed, samples, settings = make_case(21, variant, gaps, leave_out=leave_out)
    objective = build_objective(samples, geometry, settings)
    program = stage_two_at(objective, bed.rest_positions).program
    rows = stack_stage_two(samples, geometry, settings, bed.rest_positions)
    rng = np.random.default_rng(22)
    points = [random_stiffness(rng, len(geometry)) for _ in range(12)]
    assert_same_up_to_scale_and_constant(program, rows, points)


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_programs_are_symmetric_and_convex(variant):
    geometry, bed, samples, settings = make_case(25, variant, gaps=True)
    objective = build_objective(samples, geometry, settings)
    for program in (
        build_stage_one(objective),
        stage_two_at(objective, bed.rest_positions).program,
    ):
        np.testing.assert_allclose(program.P, program.P.T, atol=1e-12)
        assert np.linalg.eigvalsh(program.P).min() > -1e-12


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_stage_one_recovers_linear_springs_and_does_not_mirror_them(variant):
    rng = np.random.default_rng(31)
    geometry = random_socket(rng, clusters=8)  # a cluster on every tile determines it
    settings = IdentificationSettings(variant=variant, smoothness=0.0)
    rest = FAR + rng.uniform(-0.004, 0.004, (8, 3))
    samples = linear_samples(rng, geometry, rest, settings.initial_stiffness)
    np.testing.assert_allclose(solve_stage_one(samples, geometry, settings), rest, atol=1e-9)


def test_stage_one_recovers_one_rest_position_of_all_springs_from_the_wrench_alone():
    rng = np.random.default_rng(32)
    geometry = random_socket(rng, clusters=0)
    settings = IdentificationSettings(theta=1.0)
    rest = np.tile([0.012, -0.024, 0.031], (8, 1))
    samples = linear_samples(rng, geometry, rest, settings.initial_stiffness)
    np.testing.assert_allclose(solve_stage_one(samples, geometry, settings), rest, atol=1e-9)


def test_stage_one_gives_the_measured_mean_wrench_with_its_sign():
    rng = np.random.default_rng(33)
    geometry = random_socket(rng)
    settings = IdentificationSettings(smoothness=1e-9)
    k0 = settings.initial_stiffness
    rest = FAR + rng.uniform(-0.004, 0.004, (8, 3))
    samples = linear_samples(rng, geometry, rest, k0)
    found = solve_stage_one(samples, geometry, settings)
    forces = k0 * (samples.position.mean(axis=0) - found)
    wrench = np.concatenate([np.cross(geometry.anchors, forces).sum(axis=0), forces.sum(axis=0)])
    np.testing.assert_allclose(wrench, samples.wrench.mean(axis=0), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("limit", [0.008, 0.0008])
def test_stage_one_agrees_with_bounded_least_squares_on_the_rows(seed, limit):
    geometry, _, samples, settings = make_case(seed, gaps=True, rest_position_limit=limit)
    expected = stack_stage_one(samples, geometry, settings).solve()
    found = solve_stage_one(samples, geometry, settings) - samples.position.mean(axis=0)
    assert relative(found.reshape(-1), MILLIMETRE * expected) < OPTIMUM
    assert np.abs(found).max() <= limit + 1e-11
    if limit < 0.001:
        assert np.isclose(np.abs(found), limit, rtol=1e-9).any()  # the bound matters here


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("leave_out", LEFT_OUT)
@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_stage_two_agrees_with_bounded_least_squares_on_the_rows(variant, leave_out, gaps):
    geometry, bed, samples, settings = make_case(41, variant, gaps, leave_out=leave_out)
    rest = bed.rest_positions + WRONG
    x, offsets, stacked = solve_both_ways(samples, geometry, settings, rest)
    assert relative(x, stacked[: len(x)]) < OPTIMUM
    assert x.min() >= -1e-8
    named = named_offsets(*offsets, samples)
    expected = stacked_offsets(stacked, samples, settings)
    assert named == pytest.approx(expected, rel=1e-5, abs=1e-5)
    without = samples.channels if variant == "stiffness" else leave_out
    assert not any(named[name] for name in without)


@pytest.mark.parametrize("seed", range(50, 56))
@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_stage_two_agrees_with_the_rows_on_many_beds(variant, seed):
    geometry, bed, samples, settings = make_case(seed, variant, gaps=True)
    rng = np.random.default_rng(seed + 1000)
    rest = bed.rest_positions + rng.normal(0.0, 1e-3, bed.rest_positions.shape)
    x, _, stacked = solve_both_ways(samples, geometry, settings, rest)
    assert relative(x, stacked[: len(x)]) < OPTIMUM
    assert np.sum(x == 0.0) >= 2  # otherwise the bounds were not tried


@pytest.mark.parametrize("theta", [0.0, 0.1, 0.9, 1.0])
@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_stage_two_agrees_with_the_rows_for_every_theta(variant, theta):
    geometry, bed, samples, settings = make_case(57, variant, gaps=True, theta=theta)
    x, _, stacked = solve_both_ways(samples, geometry, settings, bed.rest_positions)
    assert relative(x, stacked[: len(x)]) < OPTIMUM


@pytest.mark.parametrize("backend", installed("daqp", "clarabel"))
@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_stage_two_agrees_with_another_backend_on_the_stacked_rows(variant, backend):
    geometry, bed, samples, settings = make_case(58, variant)
    rest = bed.rest_positions + WRONG
    rows = stack_stage_two(samples, geometry, settings, rest)
    expected = qpsolvers.solve_ls(
        rows.A, rows.b, lb=rows.lower, ub=rows.upper, solver=backend, **STACKED_OPTIONS[backend]
    )
    x, _ = solve_stage_two(samples, geometry, settings, rest)
    assert relative(x, expected[: len(x)]) < OPTIMUM


@pytest.mark.parametrize("solver", installed("osqp", "daqp", "clarabel"))
@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_every_installed_solver_finds_the_same_optimum(variant, solver):
    geometry, bed, samples, settings = make_case(59, variant, gaps=True, solver=solver)
    rest = bed.rest_positions + WRONG
    x, _, stacked = solve_both_ways(samples, geometry, settings, rest)
    assert relative(x, stacked[: len(x)]) < OPTIMUM


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_stage_two_recovers_the_truth_at_the_true_rest_positions(variant):
    geometry, bed, samples, settings = make_case(61, variant, clusters=8, noise=0.0, smoothness=0.0)
    x, offsets = solve_stage_two(samples, geometry, settings, bed.rest_positions)
    stiffness = KILONEWTON_PER_METRE * x.reshape(-1, 3)
    np.testing.assert_allclose(stiffness, bed.stiffness, rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(offsets[0], bed.wrench_bias, atol=1e-6)
    assert set(offsets[1]) == set(bed.force_bias)
    for name, bias in bed.force_bias.items():
        np.testing.assert_allclose(offsets[1][name], bias, atol=1e-6)


def test_a_heavy_smoothness_makes_all_tiles_alike():
    geometry, bed, samples, settings = make_case(62, smoothness=1e6)
    x, _ = solve_stage_two(samples, geometry, settings, bed.rest_positions)
    assert np.ptp(x.reshape(-1, 3), axis=0).max() < 1e-3 * x.max()


def test_every_sample_twice_changes_nothing():
    geometry, bed, samples, settings = make_case(63, gaps=True)
    twice = samples[np.repeat(np.arange(len(samples)), 2)]
    once, _ = solve_stage_two(samples, geometry, settings, bed.rest_positions)
    again, _ = solve_stage_two(twice, geometry, settings, bed.rest_positions)
    assert relative(again, once) < 1e-8


def test_theta_trades_the_wrench_against_the_clusters():
    geometry, bed, samples, settings = make_case(97, noise=3.0)
    rest = bed.rest_positions + WRONG

    def mean_square(theta, x):
        alone = dataclasses.replace(settings, theta=theta, smoothness=0.0)
        return stack_stage_two(samples, geometry, alone, rest).cost(x)

    answers = [
        solve_stage_two(samples, geometry, dataclasses.replace(settings, theta=theta), rest)[0]
        for theta in (0.05, 0.5, 0.95)
    ]
    assert (np.diff([mean_square(1.0, x) for x in answers]) < 0.0).all()  # the wrench's error
    assert (np.diff([mean_square(0.0, x) for x in answers]) > 0.0).all()  # the clusters'


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_determined_directions_are_the_trace_of_the_hat_matrix(variant):
    geometry, bed, samples, settings = make_case(64, variant)
    rest = bed.rest_positions + WRONG
    objective = build_objective(samples, geometry, settings)
    stage = stage_two_at(objective, rest)
    x = solve_box_qp(stage.program, "osqp", 1e-6).x
    rows = stack_stage_two(samples, geometry, settings, rest)
    offsets = rows.A.shape[1] - len(x)
    free = np.concatenate([np.flatnonzero(x > 0.0), len(x) + np.arange(offsets)])
    A = rows.A[:, free]
    data = A[: len(A) - 3 * len(geometry.neighbours)]
    hat = data @ np.linalg.solve(A.T @ A, data.T)
    expected = np.trace(hat) - offsets  # each offset takes one direction for itself
    assert stage.determined_directions(x) == pytest.approx(expected, abs=1e-5)
    assert stage.determined_directions(np.zeros_like(x)) == 0.0
