"""The front over theta against single fits, and its theorems."""

import dataclasses

import numpy as np
import pytest
import qpsolvers
from support.pareto_cases import THETAS, make_hold
from support.problems import make_case
from support.stacked import MILLIMETRE, stack_stage_one, stack_stage_two

from socket_testbed.identification import moments as moments_module
from socket_testbed.identification import pareto
from socket_testbed.identification.box_qp import Certificate, solve_box_qp
from socket_testbed.identification.evaluation import evaluate
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.pareto import pareto_front
from socket_testbed.identification.problem import (
    StageTwoData,
    build_objective,
    build_stage_two,
)
from socket_testbed.settings.identification import PAPER_VARIANTS


def relative_difference(found, expected):
    return np.abs(found - expected).max() / np.abs(expected).max()


def assert_is_the_fit(front, index, samples, geometry, settings):
    """One solution of a front against the fit alone, which starts from nothing."""
    theta = float(front.theta[index])
    settings = dataclasses.replace(settings, theta=theta, variant=front.variant)
    fit = fit_contact_model(samples, geometry, settings)
    model, expected = front.models[index], fit.model
    assert front.flaws[index] == ""
    assert front.residual[index] <= settings.solver_tolerance
    np.testing.assert_allclose(model.rest_positions, expected.rest_positions, atol=1e-9)
    position = samples.position[np.isfinite(samples.position).all(axis=1)]
    assert relative_difference(model.forces(position), expected.forces(position)) < 1e-6
    assert relative_difference(model.wrench(position), expected.wrench(position)) < 1e-6
    errors = {e.name: e.rmse for e in fit.errors if e.in_objective}
    assert dict(zip(front.channels, front.rmse[index], strict=True)) == pytest.approx(
        errors, rel=1e-5, abs=1e-6
    )


@pytest.mark.parametrize("leave_out", [(), ("Mz", "cluster_0.Fz", "cluster_2.Fy")])
@pytest.mark.parametrize("seed", range(3))
def test_every_solution_is_the_fit_at_its_theta(seed, leave_out):
    geometry, _, samples, settings = make_case(seed, gaps=True, leave_out=leave_out)
    samples.wrench[3, 4] = samples.position[8, 0] = np.nan
    fronts = pareto_front(samples, geometry, settings, THETAS)
    assert tuple(fronts) == PAPER_VARIANTS
    for variant, front in fronts.items():
        assert front.variant == variant
        assert front.theta.tolist() == list(THETAS)
        for index in range(len(THETAS)):
            assert_is_the_fit(front, index, samples, geometry, settings)


@pytest.mark.parametrize("seed", range(2))
def test_every_solution_is_the_fit_where_the_series_gives_the_moments(seed, monkeypatch):
    geometry, _, samples, settings = make_hold(seed)
    # For the fronts alone: a single fit takes the direct products.
    monkeypatch.setattr(moments_module, "series_is_cheaper", lambda *args: args[-1] > 1)
    for front in pareto_front(samples, geometry, settings, THETAS).values():
        for index in range(len(THETAS)):
            assert_is_the_fit(front, index, samples, geometry, settings)


@pytest.mark.parametrize("leave_out", [(), ("Mx", "cluster_1.Fx")])
def test_the_errors_are_normalised_by_what_was_measured(leave_out):
    geometry, _, samples, settings = make_case(11, gaps=True, leave_out=leave_out)
    trusted = samples.trusted_forces.reshape(len(samples), -1)
    measured = dict(zip(samples.channels, np.hstack([samples.wrench, trusted]).T, strict=True))
    counted = [name for name in samples.channels if name not in leave_out]

    def size(group):
        values = np.concatenate([measured[name] for name in group])
        return np.sqrt(np.nanmean(values**2))

    moments = [name for name in counted if name[0] == "M"]
    forces = [name for name in counted if name[0] == "F"]
    local = [name for name in counted if "." in name]
    sizes = {name: size(group) for group in (moments, forces, local) for name in group}
    for front in pareto_front(samples, geometry, settings, THETAS).values():
        assert set(front.channels) == set(counted)
        for index, model in enumerate(front.models):
            rmse = {e.name: e.rmse for e in evaluate(samples, model)}
            square = {name: (rmse[name] / sizes[name]) ** 2 for name in counted}
            wrench_error = np.sqrt(np.mean([square[name] for name in moments + forces]))
            local_error = np.sqrt(np.mean([square[name] for name in local]))
            assert front.wrench_error[index] == pytest.approx(wrench_error, rel=1e-6)
            assert front.local_error[index] == pytest.approx(local_error, rel=1e-6)


def assert_traded(wrench, local):
    """Over rising theta, the wrench's sum falls and the clusters' rises, and not by nothing."""
    wrench, local = np.array(wrench), np.array(local)
    assert (np.diff(wrench) <= 1e-9 * wrench[:-1]).all()
    assert (np.diff(local) >= -1e-9 * local[:-1]).all()
    assert wrench[-1] < 0.999 * wrench[0] and local[-1] > 1.001 * local[0]


# theta J_w + (1 - theta) J_f + s is theta (J_w + s) + (1 - theta) (J_f + s): along the optima of
# one convex program, J_w + s must fall with theta and J_f + s rise. J_w alone need not.


@pytest.mark.parametrize("limit", [0.008, 0.001])
def test_along_stage_one_each_error_with_the_smoothness_is_monotone(limit):
    geometry, _, samples, settings = make_case(21, gaps=True, rest_position_limit=limit)
    thetas = np.linspace(0.0, 1.0, 11)
    front = pareto_front(samples, geometry, settings, thetas)["stiffness"]
    offsets = [m.rest_positions - samples.position.mean(axis=0) for m in front.models]
    sums = []
    for theta in (1.0, 0.0):
        rows = stack_stage_one(samples, geometry, dataclasses.replace(settings, theta=theta))
        sums.append([rows.cost(u.reshape(-1) / MILLIMETRE) for u in offsets])
    assert_traded(*sums)


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_along_stage_two_each_error_with_the_smoothness_is_monotone(variant):
    geometry, bed, samples, settings = make_case(22, variant, gaps=True, noise=3.0)
    rest = bed.rest_positions + 5e-4  # fixed: the theorem holds for one program alone
    objective = build_objective(samples, geometry, settings)
    moments = StageTwoData(objective).moments(rest)
    found, near = [], None
    for theta in np.linspace(0.0, 1.0, 21):
        weighted = objective.with_settings(theta=float(theta))
        program = build_stage_two(weighted, moments).program
        near = solve_box_qp(program, "osqp", 1e-8, near).x
        found.append(near)
    sums = []
    for theta in (1.0, 0.0):
        alone = dataclasses.replace(settings, theta=theta)
        rows = stack_stage_two(samples, geometry, alone, rest)
        sums.append([rows.cost(x) for x in found])
    assert_traded(*sums)


def test_theta_and_variant_of_the_settings_do_not_matter():
    geometry, _, samples, settings = make_case(31)
    other = dataclasses.replace(settings, theta=1.0, variant="stiffness")
    one, two = (pareto_front(samples, geometry, s, THETAS) for s in (settings, other))
    for variant in PAPER_VARIANTS:
        np.testing.assert_array_equal(one[variant].wrench_error, two[variant].wrench_error)
        np.testing.assert_array_equal(one[variant].local_error, two[variant].local_error)


def test_a_left_out_channel_that_is_dead_does_not_matter():
    geometry, _, samples, settings = make_case(32, leave_out=("Fy", "cluster_2.Fx"))
    expected = pareto_front(samples, geometry, settings, THETAS)
    samples.wrench[:, 4] = samples.local_forces[:, 2, 0] = np.nan
    for variant, front in pareto_front(samples, geometry, settings, THETAS).items():
        np.testing.assert_allclose(front.rmse, expected[variant].rmse, rtol=1e-6)
        assert not {"Fy", "cluster_2.Fx"} & set(front.channels)


def test_progress_is_reported_for_every_theta():
    geometry, _, samples, settings = make_case(33)
    steps = []
    pareto_front(samples, geometry, settings, THETAS, progress=lambda *step: steps.append(step))
    assert steps == [(i, len(THETAS)) for i in range(1, len(THETAS) + 1)]


def test_a_front_of_programs_with_one_optimum_needs_no_solver(monkeypatch):
    geometry, _, samples, settings = make_hold(3)
    monkeypatch.setattr(qpsolvers, "solve_problem", None)
    fronts = pareto_front(samples, geometry, settings, np.linspace(0.0, 1.0, 21))
    assert all(front.sound.all() for front in fronts.values())


def test_the_certificate_is_the_worst_of_both_stages(monkeypatch):
    geometry, _, samples, settings = make_case(34)
    worst = np.random.default_rng(34).uniform(0.0, 1e-9, 3 * len(THETAS))
    left = iter(worst.tolist())

    def certify(*args):
        certificate = Certificate(primal=0.0, stationarity=next(left), gap=0.0)
        return dataclasses.replace(solve_box_qp(*args), certificate=certificate)

    monkeypatch.setattr(pareto, "solve_box_qp", certify)
    fronts = pareto_front(samples, geometry, settings, THETAS)
    rest, plain, bias = worst.reshape(-1, 3).T
    np.testing.assert_array_equal(fronts["stiffness"].residual, np.maximum(rest, plain))
    np.testing.assert_array_equal(fronts["stiffness_bias"].residual, np.maximum(rest, bias))
