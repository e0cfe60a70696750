"""Both stages against the problem written out row by row, and the certificates."""

import dataclasses

import numpy as np
import pytest
import qpsolvers
from problems import (
    KILONEWTON_PER_METRE,
    MILLIMETRE,
    make_samples,
    moving_limb,
    naive_gated,
    random_bed,
    random_socket,
    samples_of_bed,
    stack_stage_one,
    stack_stage_two,
)

from socket_testbed.contact import VARIANTS, wrench_map
from socket_testbed.errors import ConfigurationError, IdentificationError
from socket_testbed.evaluation import evaluate
from socket_testbed.identification import box_qp
from socket_testbed.identification.box_qp import BoxQP, UncertifiedSolutionError, solve_box_qp
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.moments import gate_moments
from socket_testbed.identification.objective import build_objective, smoothness_matrix
from socket_testbed.identification.stages import build_stage_one, build_stage_two, recover_offsets
from socket_testbed.settings import IdentificationSettings

FAR = np.array([0.01, -0.02, 0.03])  # [m]; no sign may hide behind a mean position of zero
OPTIMUM = 1e-6  # [-]; what two solvers of one convex problem may differ by
LEFT_OUT = [
    (),
    ("cluster_1.Fx",),
    ("Mz", "cluster_0.Fz", "cluster_2.Fy"),
    ("cluster_1.Fx", "cluster_1.Fy", "cluster_1.Fz"),
    ("Mx", "My", "Mz"),
    ("Mx", "My", "Mz", "Fx", "Fy", "Fz"),
]


def spoil(rng, samples):
    """The same samples with gaps in the clusters: single channels, whole clusters, statuses."""
    forces, status = samples.local_forces.copy(), samples.status.copy()
    forces[rng.random(forces.shape) < 0.1] = np.nan
    forces[5:9, 0] = np.nan
    status[12:16, 1] = 3
    forces[12:16, 1] += 1e4  # what no fit may see
    return dataclasses.replace(samples, local_forces=forces, status=status)


def make_case(seed, variant="stiffness_bias", gaps=False, clusters=3, noise=1.0, **changes):
    """A random bed and its samples: the socket, the bed, the samples and the settings.

    Little smoothness and many tiles without contact put part of the solution on its bound.
    """
    rng = np.random.default_rng(seed)
    geometry = random_socket(rng, clusters=clusters)
    bed = random_bed(rng, geometry, variant, untouched=0.4)
    samples = samples_of_bed(rng, bed, moving_limb(rng, 40), noise)
    if gaps:
        samples = spoil(rng, samples)
    return (
        geometry,
        bed,
        samples,
        IdentificationSettings(variant=variant, **({"smoothness": 1e-5} | changes)),
    )


def solve_stage_two(geometry, samples, settings, rest_positions):
    """Stiffnesses [kN/m] and the offsets of the package at given rest positions."""
    objective = build_objective(samples, geometry, settings)
    stage = build_stage_two(objective, geometry, settings, rest_positions)
    x = solve_box_qp(stage.program, settings.solver, settings.solver_tolerance).x
    stiffness = KILONEWTON_PER_METRE * x.reshape(-1, 3)
    offsets = recover_offsets(objective, geometry, settings, stage, stiffness)
    return x, offsets


def stacked_offsets(x, samples, settings):
    """The explicit offsets of a stacked solution by the channel's name."""
    kept = [name for name in samples.channels if name not in settings.leave_out]
    return dict(zip(kept, x[len(x) - len(kept) :], strict=True))


def named_offsets(offsets, samples):
    """The package's offsets by the channel's name; zero where it gives none."""
    wrench, clusters = offsets
    values = [*wrench]
    for cluster in samples.clusters:
        values += [*clusters.get(cluster, np.zeros(3))]
    return dict(zip(samples.channels, values, strict=True))


def relative(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


# --- moments


MOTIONS = {
    "hold": lambda rng: np.array([0.001, -0.002, 0.0005]) + rng.normal(0.0, 1e-5, (300, 3)),
    "ramp": lambda rng: np.linspace([0.0, 0.0, 0.0], [0.002, -0.004, 0.006], 300),
    "one axis": lambda rng: np.linspace(-0.002, 0.003, 200)[:, None] * [1.0, 0.0, 0.0],
    "multi-directional": lambda rng: moving_limb(rng, 300),
    "more rows than one block": lambda rng: moving_limb(rng, 9001),
    "still": lambda rng: np.tile([[0.001, -0.002, 0.0005]], (50, 1)),
    "single": lambda rng: np.array([[0.001, -0.002, 0.0005]]),
}


def naive_moments(position, rest_positions, sharpness, targets):
    """Means and centred products in extended precision."""
    wide = np.longdouble
    S = naive_gated(position.astype(wide)[:, None] - rest_positions.astype(wide), wide(sharpness))
    S, Y = S.reshape(len(position), -1), targets.astype(wide)
    means = S.mean(axis=0), Y.mean(axis=0)
    S, Y = S - means[0], Y - means[1]
    return *means, S.T @ S, S.T @ Y, (Y**2).sum(axis=0)


@pytest.mark.parametrize("method", ["direct", "chebyshev", "auto"])
@pytest.mark.parametrize("kind", MOTIONS)
def test_moments_are_those_of_the_naive_sums(kind, method):
    rng = np.random.default_rng(11)
    position = MOTIONS[kind](rng)
    rest = rng.uniform(-0.004, 0.004, (4, 3))
    targets = rng.normal(0.0, 50.0, (len(position), 6))
    found = gate_moments(position, rest, 2000.0, targets, method)
    mean, target_mean, gram, cross, power = naive_moments(position, rest, 2000.0, targets)
    assert found.count == len(position)
    np.testing.assert_allclose(found.mean, mean.astype(float), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found.target_mean, target_mean.astype(float), atol=1e-11)
    # Each product against the size of its two columns, which carry a rounding of their own.
    rounding = np.sqrt(len(position)) * 1e-16  # [m]
    spread = np.sqrt(np.diag(gram)).astype(float)
    limit = 1e-10 * np.outer(spread, spread) + rounding * np.add.outer(spread, spread)
    assert (np.abs(found.gram - gram) <= limit + rounding**2).all()
    target_size = np.sqrt(power).astype(float)
    limit = np.outer(1e-10 * spread + rounding, target_size)
    assert (np.abs(found.cross - cross) <= limit + 1e-24).all()
    np.testing.assert_allclose(found.target_power, power.astype(float), rtol=1e-10, atol=1e-20)


@pytest.mark.parametrize("sharpness", [1.0, 300.0, 2e4])
def test_both_ways_to_the_moments_agree_for_any_sharpness(sharpness):
    rng = np.random.default_rng(12)
    position, rest = moving_limb(rng, 200, 0.002), rng.uniform(-0.002, 0.002, (5, 3))
    targets = rng.normal(size=(200, 6))
    direct = gate_moments(position, rest, sharpness, targets, "direct")
    series = gate_moments(position, rest, sharpness, targets, "chebyshev")
    for name in ("mean", "gram", "cross", "target_mean", "target_power"):
        a, b = getattr(direct, name), getattr(series, name)
        assert np.abs(a - b).max() <= 1e-9 * np.abs(a).max(), name


def test_moments_about_zero_are_the_plain_sums():
    rng = np.random.default_rng(13)
    position, rest = moving_limb(rng, 60), rng.uniform(-0.002, 0.002, (3, 3))
    targets = rng.normal(3.0, 1.0, (60, 2))
    found = gate_moments(position, rest, 2000.0, targets).about_zero()
    S = naive_gated(position[:, None] - rest, 2000.0).reshape(60, -1)
    np.testing.assert_allclose(found.gram, S.T @ S, rtol=1e-9, atol=1e-16)
    np.testing.assert_allclose(found.cross, S.T @ targets, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(found.target_power, (targets**2).sum(axis=0), rtol=1e-12)
    assert not found.mean.any()
    assert not found.target_mean.any()


# --- the objective


def test_smoothness_is_the_mean_square_difference_between_neighbours():
    rng = np.random.default_rng(14)
    geometry = random_socket(rng, rings=3, columns=5)
    matrix = smoothness_matrix(len(geometry), geometry.neighbours)
    for x in rng.normal(size=(5, len(geometry))):
        a, b = geometry.neighbours.T
        assert x @ matrix @ x == pytest.approx(np.mean((x[a] - x[b]) ** 2))
    np.testing.assert_allclose(matrix @ np.ones(len(geometry)), 0.0, atol=1e-15)


def test_a_socket_without_neighbours_is_not_smoothed():
    matrix = smoothness_matrix(4, np.zeros((0, 2), dtype=np.int64))
    np.testing.assert_array_equal(matrix, np.zeros((4, 4)))


def random_stiffness(rng, n):
    return rng.uniform(0.0, 10.0, 3 * n) * (rng.random(3 * n) < 0.7)  # [kN/m]


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("leave_out", LEFT_OUT)
@pytest.mark.parametrize("variant", VARIANTS)
def test_stage_two_is_the_stacked_objective_up_to_scale_and_constant(variant, leave_out, gaps):
    geometry, bed, samples, settings = make_case(21, variant, gaps, leave_out=leave_out)
    objective = build_objective(samples, geometry, settings)
    program = build_stage_two(objective, geometry, settings, bed.rest_positions).program
    rows = stack_stage_two(samples, geometry, settings, bed.rest_positions)
    rng = np.random.default_rng(22)
    points = [random_stiffness(rng, len(geometry)) for _ in range(12)]
    ours = np.array([program.objective(x) for x in points])
    stacked = np.array([rows.cost(x) for x in points])
    scale = (ours[1] - ours[0]) / (stacked[1] - stacked[0])
    assert scale > 0.0
    np.testing.assert_allclose(
        ours - ours[0], scale * (stacked - stacked[0]), rtol=0.0, atol=1e-9 * np.ptp(ours)
    )


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("leave_out", LEFT_OUT)
def test_stage_one_is_the_stacked_objective_up_to_scale_and_constant(leave_out, gaps):
    geometry, _, samples, settings = make_case(23, gaps=gaps, leave_out=leave_out)
    program = build_stage_one(build_objective(samples, geometry, settings), geometry, settings)
    rows = stack_stage_one(samples, geometry, settings)
    points = np.random.default_rng(24).uniform(-8.0, 8.0, (12, 3 * len(geometry)))  # [mm]
    ours = np.array([program.objective(u) for u in points])
    stacked = np.array([rows.cost(u) for u in points])
    scale = (ours[1] - ours[0]) / (stacked[1] - stacked[0])
    assert scale > 0.0
    np.testing.assert_allclose(
        ours - ours[0], scale * (stacked - stacked[0]), rtol=0.0, atol=1e-9 * np.ptp(ours)
    )


@pytest.mark.parametrize("variant", VARIANTS)
def test_programs_are_symmetric_and_convex(variant):
    geometry, bed, samples, settings = make_case(25, variant, gaps=True)
    objective = build_objective(samples, geometry, settings)
    for program in (
        build_stage_one(objective, geometry, settings),
        build_stage_two(objective, geometry, settings, bed.rest_positions).program,
    ):
        np.testing.assert_allclose(program.P, program.P.T, atol=1e-12)
        assert np.linalg.eigvalsh(program.P).min() > -1e-12


# --- Stage 1


def linear_samples(rng, geometry, rest_positions, k0, count=30):
    """Noise-free samples of linear springs F_i = k0 (q - q_r,i)."""
    position = moving_limb(rng, count) + FAR
    forces = k0 * (position[:, None] - rest_positions)
    moment = np.cross(geometry.anchors, forces).sum(axis=1)
    local = {name: forces[:, i] @ geometry.rotations[i] for name, i in geometry.clusters.items()}
    return make_samples(position, np.hstack([moment, forces.sum(axis=1)]), local)


def solve_stage_one(geometry, samples, settings):
    """Rest positions in {S} [m]."""
    program = build_stage_one(build_objective(samples, geometry, settings), geometry, settings)
    u = solve_box_qp(program, settings.solver, settings.solver_tolerance).x
    return samples.position.mean(axis=0) + MILLIMETRE * u.reshape(-1, 3)


@pytest.mark.parametrize("variant", VARIANTS)
def test_stage_one_recovers_linear_springs_and_does_not_mirror_them(variant):
    rng = np.random.default_rng(31)
    geometry = random_socket(rng, clusters=8)  # a cluster on every tile determines it
    settings = IdentificationSettings(variant=variant, smoothness=0.0)
    rest = FAR + rng.uniform(-0.004, 0.004, (8, 3))
    samples = linear_samples(rng, geometry, rest, settings.initial_stiffness)
    np.testing.assert_allclose(solve_stage_one(geometry, samples, settings), rest, atol=1e-9)


def test_stage_one_recovers_one_rest_position_of_all_springs_from_the_wrench_alone():
    rng = np.random.default_rng(32)
    geometry = random_socket(rng, clusters=0)
    settings = IdentificationSettings(theta=1.0)
    rest = np.tile([0.012, -0.024, 0.031], (8, 1))
    samples = linear_samples(rng, geometry, rest, settings.initial_stiffness)
    np.testing.assert_allclose(solve_stage_one(geometry, samples, settings), rest, atol=1e-9)


def test_stage_one_gives_the_measured_mean_wrench_with_its_sign():
    rng = np.random.default_rng(33)
    geometry = random_socket(rng)
    settings = IdentificationSettings(smoothness=1e-9)
    k0 = settings.initial_stiffness
    rest = FAR + rng.uniform(-0.004, 0.004, (8, 3))
    samples = linear_samples(rng, geometry, rest, k0)
    found = solve_stage_one(geometry, samples, settings)
    forces = k0 * (samples.position.mean(axis=0) - found)
    wrench = np.concatenate([np.cross(geometry.anchors, forces).sum(axis=0), forces.sum(axis=0)])
    np.testing.assert_allclose(wrench, samples.wrench.mean(axis=0), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("limit", [0.008, 0.0008])
def test_stage_one_agrees_with_bounded_least_squares_on_the_rows(seed, limit):
    geometry, _, samples, settings = make_case(seed, gaps=True, rest_position_limit=limit)
    expected = stack_stage_one(samples, geometry, settings).solve()
    found = solve_stage_one(geometry, samples, settings) - samples.position.mean(axis=0)
    assert relative(found.reshape(-1), MILLIMETRE * expected) < OPTIMUM
    assert np.abs(found).max() <= limit + 1e-11
    if limit < 0.001:
        assert np.isclose(np.abs(found), limit, rtol=1e-9).any()  # the bound matters here


# --- Stage 2


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("leave_out", LEFT_OUT)
@pytest.mark.parametrize("variant", VARIANTS)
def test_stage_two_agrees_with_bounded_least_squares_on_the_rows(variant, leave_out, gaps):
    geometry, bed, samples, settings = make_case(41, variant, gaps, leave_out=leave_out)
    rest = bed.rest_positions + 5e-4  # a wrong bed, so that bounds become active
    expected = stack_stage_two(samples, geometry, settings, rest).solve()
    x, offsets = solve_stage_two(geometry, samples, settings, rest)
    assert relative(x, expected[: len(x)]) < OPTIMUM
    assert x.min() >= -1e-8
    named = named_offsets(offsets, samples)
    if variant == "stiffness":
        assert not any(named.values())
        return
    for name, value in stacked_offsets(expected, samples, settings).items():
        assert named[name] == pytest.approx(value, rel=1e-5, abs=1e-5), name
    for name in leave_out:
        assert named[name] == 0.0


@pytest.mark.parametrize("seed", range(50, 56))
@pytest.mark.parametrize("variant", VARIANTS)
def test_stage_two_agrees_with_the_rows_on_many_beds(variant, seed):
    geometry, bed, samples, settings = make_case(seed, variant, gaps=True)
    rng = np.random.default_rng(seed + 1000)
    rest = bed.rest_positions + rng.normal(0.0, 1e-3, bed.rest_positions.shape)
    expected = stack_stage_two(samples, geometry, settings, rest).solve()
    x, _ = solve_stage_two(geometry, samples, settings, rest)
    assert relative(x, expected[: len(x)]) < OPTIMUM
    assert np.sum(x == 0.0) >= 2  # otherwise the bounds were not tried


@pytest.mark.parametrize("theta", [0.0, 0.1, 0.9, 1.0])
@pytest.mark.parametrize("variant", VARIANTS)
def test_stage_two_agrees_with_the_rows_for_every_theta(variant, theta):
    geometry, bed, samples, settings = make_case(57, variant, gaps=True, theta=theta)
    expected = stack_stage_two(samples, geometry, settings, bed.rest_positions).solve()
    x, _ = solve_stage_two(geometry, samples, settings, bed.rest_positions)
    assert relative(x, expected[: len(x)]) < OPTIMUM


@pytest.mark.parametrize("backend", ["daqp", "clarabel"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_stage_two_agrees_with_another_backend_on_the_stacked_rows(variant, backend):
    if backend not in qpsolvers.available_solvers:
        pytest.skip(f"{backend} is not installed")
    geometry, bed, samples, settings = make_case(58, variant)
    rest = bed.rest_positions + 5e-4
    rows = stack_stage_two(samples, geometry, settings, rest)
    clarabel = {"sparse_conversion": True} | dict.fromkeys(
        ("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-14
    )
    expected = qpsolvers.solve_ls(
        rows.A,
        rows.b,
        lb=rows.lower,
        ub=rows.upper,
        solver=backend,
        **(clarabel if backend == "clarabel" else {"sparse_conversion": False}),
    )
    x, _ = solve_stage_two(geometry, samples, settings, rest)
    assert relative(x, expected[: len(x)]) < OPTIMUM


@pytest.mark.parametrize("solver", ["osqp", "daqp", "clarabel"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_installed_solver_finds_the_same_optimum(variant, solver):
    if solver not in qpsolvers.available_solvers:
        pytest.skip(f"{solver} is not installed")
    geometry, bed, samples, settings = make_case(59, variant, gaps=True, solver=solver)
    rest = bed.rest_positions + 5e-4
    expected = stack_stage_two(samples, geometry, settings, rest).solve()
    x, _ = solve_stage_two(geometry, samples, settings, rest)
    assert relative(x, expected[: len(x)]) < OPTIMUM


@pytest.mark.parametrize("variant", VARIANTS)
def test_stage_two_recovers_the_truth_at_the_true_rest_positions(variant):
    geometry, bed, samples, settings = make_case(61, variant, clusters=8, noise=0.0, smoothness=0.0)
    x, offsets = solve_stage_two(geometry, samples, settings, bed.rest_positions)
    stiffness = KILONEWTON_PER_METRE * x.reshape(-1, 3)
    np.testing.assert_allclose(stiffness, bed.stiffness, rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(offsets[0], bed.wrench_bias, atol=1e-6)
    assert set(offsets[1]) == set(bed.force_bias)
    for name, bias in bed.force_bias.items():
        np.testing.assert_allclose(offsets[1][name], bias, atol=1e-6)


def test_a_heavy_smoothness_makes_all_tiles_alike():
    geometry, bed, samples, settings = make_case(62, smoothness=1e6)
    x, _ = solve_stage_two(geometry, samples, settings, bed.rest_positions)
    assert np.ptp(x.reshape(-1, 3), axis=0).max() < 1e-3 * x.max()


def test_every_sample_twice_changes_nothing():
    geometry, bed, samples, settings = make_case(63, gaps=True)
    twice = samples[np.repeat(np.arange(len(samples)), 2)]
    once, _ = solve_stage_two(geometry, samples, settings, bed.rest_positions)
    again, _ = solve_stage_two(geometry, twice, settings, bed.rest_positions)
    assert relative(again, once) < 1e-8


@pytest.mark.parametrize("variant", VARIANTS)
def test_determined_directions_are_the_trace_of_the_hat_matrix(variant):
    geometry, bed, samples, settings = make_case(64, variant)
    rest = bed.rest_positions + 5e-4
    objective = build_objective(samples, geometry, settings)
    stage = build_stage_two(objective, geometry, settings, rest)
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


# --- what cannot be fitted


@pytest.mark.parametrize("how", ["value", "status"])
def test_a_channel_without_any_value_is_named_with_the_mend(how):
    geometry, _, samples, settings = make_case(71)
    if how == "value":
        samples.local_forces[:, 1, 2] = np.nan
    else:
        samples.status[:, 1] = 2
    with pytest.raises(IdentificationError) as caught:
        fit_contact_model(samples, geometry, settings)
    channel = "cluster_1.Fz" if how == "value" else "cluster_1.Fx"
    assert channel in caught.value.fact
    assert "leave it out" in caught.value.mend
    assert channel in caught.value.mend
    assert "\n" not in str(caught.value)


def test_a_wrench_channel_without_any_value_is_named_with_the_mend():
    geometry, _, samples, settings = make_case(71)
    samples.wrench[:, 2] = np.nan
    with pytest.raises(IdentificationError) as caught:
        fit_contact_model(samples, geometry, settings)
    assert "Mz" in caught.value.fact
    assert "--leave-out Mz" in caught.value.mend


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("lost", [("Mz",), ("Mx", "My", "Mz", "Fx", "Fy", "Fz")])
def test_what_a_left_out_wrench_channel_measured_does_not_matter(variant, lost):
    geometry, _, samples, settings = make_case(77, variant, leave_out=lost)
    expected = fit_contact_model(samples, geometry, settings)
    samples.wrench[:, [samples.channels.index(name) for name in lost]] = np.nan
    found = fit_contact_model(samples, geometry, settings)
    assert found.samples == expected.samples
    np.testing.assert_allclose(
        found.model.stiffness, expected.model.stiffness, rtol=1e-8, atol=1e-6
    )
    np.testing.assert_allclose(found.model.wrench_bias, expected.model.wrench_bias, atol=1e-8)
    assert {e.samples for e in found.errors if e.name in lost} == {0}


def test_a_channel_without_any_value_may_be_left_out():
    geometry, _, samples, settings = make_case(71, leave_out=("cluster_1.Fz",))
    samples.local_forces[:, 1, 2] = np.nan
    fit = fit_contact_model(samples, geometry, settings)
    errors = {e.name: e for e in fit.errors}
    assert errors["cluster_1.Fz"].samples == 0
    assert np.isfinite(fit.model.stiffness).all()


@pytest.mark.parametrize(
    ("leave_out", "meant"), [("cluster_1.Fq", "cluster_1.F"), ("mz", "Mz"), ("Fw", "F")]
)
def test_an_unknown_channel_to_leave_out_is_named_with_a_likely_one(leave_out, meant):
    geometry, _, samples, settings = make_case(72, leave_out=(leave_out,))
    with pytest.raises(ConfigurationError) as caught:
        fit_contact_model(samples, geometry, settings)
    assert f"'{leave_out}'" in caught.value.fact
    assert "leave_out" in caught.value.fact
    assert meant in caught.value.mend


def test_a_fit_without_any_channel_is_refused():
    geometry, _, samples, _ = make_case(73)
    settings = IdentificationSettings(leave_out=samples.channels)
    with pytest.raises(IdentificationError, match="every channel is left out"):
        fit_contact_model(samples, geometry, settings)


@pytest.mark.parametrize("count", [0, 1])
def test_a_fit_without_samples_says_how_many_there_are(count):
    geometry, _, samples, settings = make_case(74)
    samples.wrench[count:, 0] = np.nan
    with pytest.raises(IdentificationError) as caught:
        fit_contact_model(samples, geometry, settings)
    assert str(count) in caught.value.fact


def test_a_cluster_of_another_socket_is_named():
    geometry, _, samples, settings = make_case(75)
    other = dataclasses.replace(samples, clusters=("cluster_0", "brim", "cluster_2"))
    with pytest.raises(ConfigurationError, match="'brim'"):
        fit_contact_model(other, geometry, settings)


def test_an_unknown_solver_is_named_with_a_likely_one():
    geometry, _, samples, settings = make_case(76, solver="osqq")
    with pytest.raises(ConfigurationError) as caught:
        fit_contact_model(samples, geometry, settings)
    assert "osqq" in caught.value.fact
    assert "osqp" in caught.value.mend


# --- certificates


def known_problem(rng, size=12):
    """A box QP made around its solution, with its solution."""
    root = rng.normal(size=(size, size))
    P = root @ root.T / size + 0.1 * np.eye(size)
    lower = np.where(rng.random(size) < 0.2, -np.inf, -rng.uniform(0.5, 1.0, size))
    upper = np.where(rng.random(size) < 0.2, np.inf, rng.uniform(0.5, 1.0, size))
    x, gradient = rng.uniform(-0.4, 0.4, size), np.zeros(size)
    side = rng.integers(0, 3, size)
    at_lower, at_upper = (side == 1) & np.isfinite(lower), (side == 2) & np.isfinite(upper)
    x[at_lower], gradient[at_lower] = lower[at_lower], rng.uniform(0.1, 1.0, at_lower.sum())
    x[at_upper], gradient[at_upper] = upper[at_upper], -rng.uniform(0.1, 1.0, at_upper.sum())
    return BoxQP(P, gradient - P @ x, lower, upper, "known"), x


@pytest.mark.parametrize("seed", range(5))
def test_the_certificate_is_zero_at_the_optimum_and_nowhere_else(seed):
    rng = np.random.default_rng(seed)
    problem, optimum = known_problem(rng)
    assert problem.certificate(optimum).worst < 1e-13
    for step in (1e-5, 1e-3, 1e-1):
        direction = rng.normal(size=len(optimum))
        inside = np.clip(optimum + step * direction, problem.lower, problem.upper)
        assert problem.objective(inside) > problem.objective(optimum)
        assert problem.certificate(inside).worst > 0.01 * step
    outside = np.where(np.isfinite(problem.upper), problem.upper + 0.25, optimum)
    assert problem.certificate(outside).primal == pytest.approx(0.25)


def test_the_gap_bounds_the_distance_to_the_best_objective():
    rng = np.random.default_rng(81)
    problem, optimum = known_problem(rng)
    bounded = dataclasses.replace(
        problem,
        lower=np.where(np.isfinite(problem.lower), problem.lower, -2.0),
        upper=np.where(np.isfinite(problem.upper), problem.upper, 2.0),
    )
    for _ in range(20):
        x = rng.uniform(bounded.lower, bounded.upper)
        gap = bounded.certificate(x).gap * (1.0 + abs(bounded.objective(x)))
        assert gap >= bounded.objective(x) - bounded.objective(optimum) - 1e-12


def test_without_bounds_stationarity_is_the_gradient_of_the_objective():
    rng = np.random.default_rng(82)
    problem, _ = known_problem(rng)
    free = np.full(12, np.inf)
    problem = dataclasses.replace(problem, lower=-free, upper=free)
    x, h = rng.normal(size=12), 1e-6
    gradient = [
        (problem.objective(x + step) - problem.objective(x - step)) / (2.0 * h)
        for step in h * np.eye(12)
    ]
    assert problem.certificate(x).stationarity == pytest.approx(np.abs(gradient).max(), rel=1e-7)


@pytest.mark.parametrize("spoilt", ["P", "q", "x"])
def test_what_is_not_a_number_is_never_certified(spoilt):
    problem, x = known_problem(np.random.default_rng(83))
    arrays = {"P": problem.P.copy(), "q": problem.q.copy(), "x": x.copy()}
    arrays[spoilt][3] = np.nan
    problem = dataclasses.replace(problem, P=arrays["P"], q=arrays["q"])
    assert not problem.certificate(arrays["x"]).worst <= 1e-2


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("step", [0.0, 1e-4, 1e-2])
def test_refining_a_near_answer_gives_the_optimum(seed, step):
    rng = np.random.default_rng(seed)
    problem, optimum = known_problem(rng)
    near = np.clip(optimum + step * rng.normal(size=12), problem.lower, problem.upper)
    found, certificate = box_qp.refine(problem, near)
    np.testing.assert_allclose(found, optimum, atol=1e-11)
    assert certificate == problem.certificate(found)


@pytest.mark.parametrize("seed", range(3))
def test_refining_never_makes_an_answer_worse(seed):
    rng = np.random.default_rng(seed)
    problem, _ = known_problem(rng)
    flat = dataclasses.replace(problem, P=np.zeros_like(problem.P))
    for program in (problem, flat):
        x = np.clip(rng.normal(size=12), program.lower, program.upper)
        found, certificate = box_qp.refine(program, x)
        assert certificate.worst <= program.certificate(x).worst
        assert (found >= program.lower).all()
        assert (found <= program.upper).all()


@pytest.mark.parametrize("solver", ["osqp", "daqp", "clarabel"])
@pytest.mark.parametrize("seed", range(3))
def test_solvers_find_known_optima_and_say_how_well(seed, solver):
    if solver not in qpsolvers.available_solvers:
        pytest.skip(f"{solver} is not installed")
    problem, optimum = known_problem(np.random.default_rng(seed))
    solution = solve_box_qp(problem, solver, 1e-9)
    np.testing.assert_allclose(solution.x, optimum, atol=1e-8)
    assert solution.certificate == problem.certificate(solution.x)
    assert solution.certificate.worst <= 1e-9
    assert solver in solution.status


def test_a_flat_direction_is_solved_all_the_same():
    problem, _ = known_problem(np.random.default_rng(84))
    P, q = problem.P.copy(), problem.q.copy()
    P[:, 0] = P[0] = q[0] = 0.0
    solution = solve_box_qp(dataclasses.replace(problem, P=P, q=q), "osqp", 1e-6)
    assert solution.certificate.worst <= 1e-6


def patch_answer(monkeypatch, x):
    """Make every solver answer x and nobody correct it."""

    def answer(problem, *_, **__):
        return qpsolvers.Solution(problem, found=True, x=x)

    monkeypatch.setattr(qpsolvers, "solve_problem", answer)
    monkeypatch.setattr(box_qp, "refine", lambda problem, x: (x, problem.certificate(x)))


def test_a_wrong_answer_is_refused_whatever_the_solver_says(monkeypatch):
    problem, optimum = known_problem(np.random.default_rng(85))
    wrong = np.clip(optimum + 0.05, problem.lower, problem.upper)
    patch_answer(monkeypatch, wrong)
    with pytest.raises(UncertifiedSolutionError) as caught:
        solve_box_qp(problem, "osqp", 1e-6)
    assert caught.value.problem is problem
    np.testing.assert_array_equal(caught.value.x, wrong)
    assert "known" in caught.value.fact
    assert "KKT" in caught.value.fact
    monkeypatch.undo()
    again = solve_box_qp(caught.value.problem, "osqp", 1e-6)  # what the problem is carried for
    np.testing.assert_allclose(again.x, optimum, atol=1e-8)


@pytest.mark.parametrize("x", [None, np.full(12, np.nan)])
def test_no_answer_is_an_error_that_carries_the_problem(monkeypatch, x):
    problem, _ = known_problem(np.random.default_rng(86))
    patch_answer(monkeypatch, x)
    with pytest.raises(UncertifiedSolutionError) as caught:
        solve_box_qp(problem, "osqp", 1e-6)
    assert caught.value.problem is problem
    assert caught.value.x is None


def test_a_failing_solver_is_an_error_that_carries_the_problem(monkeypatch):
    problem, _ = known_problem(np.random.default_rng(87))

    def fail(*_, **__):
        raise qpsolvers.exceptions.SolverError("out of luck")

    monkeypatch.setattr(qpsolvers, "solve_problem", fail)
    with pytest.raises(UncertifiedSolutionError, match="out of luck") as caught:
        solve_box_qp(problem, "osqp", 1e-6)
    assert caught.value.problem is problem


# --- the whole fit


@pytest.mark.parametrize("leave_out", LEFT_OUT[:3])
@pytest.mark.parametrize("variant", VARIANTS)
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
    if variant == "stiffness_bias":
        named = named_offsets((fit.model.wrench_bias, fit.model.force_bias), samples)
        for name, value in stacked_offsets(expected, samples, settings).items():
            assert named[name] == pytest.approx(value, rel=1e-4, abs=1e-4), name


@pytest.mark.parametrize("variant", VARIANTS)
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


def test_samples_without_a_wrench_or_a_position_do_not_count():
    geometry, _, samples, settings = make_case(93, gaps=True)
    lost = np.zeros(len(samples), dtype=bool)
    lost[[0, 7, 20]] = True
    expected = fit_contact_model(samples[~lost], geometry, settings).model
    samples.wrench[[0, 7], 2] = np.nan
    samples.position[20] = np.nan
    found = fit_contact_model(samples, geometry, settings).model
    np.testing.assert_array_equal(found.stiffness, expected.stiffness)
    np.testing.assert_array_equal(found.rest_positions, expected.rest_positions)


def test_the_fit_does_not_change_the_samples():
    geometry, _, samples, settings = make_case(94, gaps=True)
    before = [samples.position.copy(), samples.wrench.copy(), samples.local_forces.copy()]
    fit_contact_model(samples, geometry, settings)
    for array, copy in zip(
        (samples.position, samples.wrench, samples.local_forces), before, strict=True
    ):
        np.testing.assert_array_equal(array, copy)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(("theta", "ignored"), [(1.0, "clusters"), (0.0, "wrench")])
def test_at_its_ends_theta_ignores_the_other_group(variant, theta, ignored):
    geometry, _, samples, settings = make_case(95, variant, theta=theta)
    rng = np.random.default_rng(96)
    if ignored == "clusters":
        other = rng.normal(0.0, 100.0, samples.local_forces.shape)
        changed = dataclasses.replace(samples, local_forces=other)
    else:
        changed = dataclasses.replace(samples, wrench=rng.normal(0.0, 100.0, (len(samples), 6)))
    expected = fit_contact_model(samples, geometry, settings).model
    found = fit_contact_model(changed, geometry, settings).model
    np.testing.assert_allclose(found.rest_positions, expected.rest_positions, atol=1e-9)
    np.testing.assert_allclose(found.stiffness, expected.stiffness, rtol=1e-6, atol=1e-3)


def test_theta_trades_the_wrench_against_the_clusters():
    geometry, bed, samples, settings = make_case(97, noise=3.0)
    rest = bed.rest_positions + 5e-4

    def mean_square(theta, x):
        alone = dataclasses.replace(settings, theta=theta, smoothness=0.0)
        return stack_stage_two(samples, geometry, alone, rest).cost(x)

    answers = [
        solve_stage_two(geometry, samples, dataclasses.replace(settings, theta=theta), rest)[0]
        for theta in (0.05, 0.5, 0.95)
    ]
    assert (np.diff([mean_square(1.0, x) for x in answers]) < 0.0).all()  # the wrench's error
    assert (np.diff([mean_square(0.0, x) for x in answers]) > 0.0).all()  # the clusters'


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
@pytest.mark.parametrize("variant", VARIANTS)
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
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_fit_predicts_most_of_the_force_of_the_truth_on_another_motion(variant, seed):
    geometry, bed, samples, settings = make_case(seed, variant, noise=0.1)
    model = fit_contact_model(samples, geometry, settings).model
    rng = np.random.default_rng(seed)
    unseen = samples_of_bed(rng, bed, moving_limb(rng, 100))
    skills = {e.name: e.skill for e in evaluate(unseen, model)}
    assert min(skills[name] for name in ("Fx", "Fy", "Fz")) > 0.5


def test_the_wrench_map_of_the_stack_is_the_packages():
    geometry, bed, samples, settings = make_case(99, noise=0.0)
    forces = bed.stiffness * naive_gated(samples.position[:, None] - bed.rest_positions, 2000.0)
    wrench = forces.reshape(len(samples), -1) @ wrench_map(geometry.anchors).T + bed.wrench_bias
    np.testing.assert_allclose(wrench, samples.wrench, atol=1e-9)
    exact = dataclasses.replace(settings, smoothness=0.0)
    rows = stack_stage_two(samples, geometry, exact, bed.rest_positions)
    assert rows.cost(bed.stiffness.reshape(-1) / KILONEWTON_PER_METRE) < 1e-20
