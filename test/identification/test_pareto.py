"""The front over theta against single fits, and its theorems."""

import dataclasses

import numpy as np
import pytest
from support.pareto_cases import THETAS, make_hold
from support.problems import count_solver_calls, make_case
from support.stacked import MILLIMETRE, stack_stage_one, stack_stage_two

from socket_testbed.errors import ConfigurationError, IdentificationError, TestbedError
from socket_testbed.identification import pareto
from socket_testbed.identification.box_qp import (
    Certificate,
    UncertifiedSolutionError,
    solve_box_qp,
)
from socket_testbed.identification.evaluation import evaluate
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.objective import build_objective
from socket_testbed.identification.pareto import SENSOR_ONLY, pareto_front
from socket_testbed.identification.problem import Problem
from socket_testbed.settings.identification import PAPER_VARIANTS, VARIANTS


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
def test_every_solution_is_the_fit_at_its_theta(leave_out):
    geometry, _, samples, settings = make_case(2, gaps=True, leave_out=leave_out)
    samples.wrench[3, 4] = samples.position[8, 0] = np.nan
    if leave_out:
        samples.local_forces[:, 0, 2] = np.nan  # a channel that is left out may be dead
    settings, steps = dataclasses.replace(settings, theta=1.0, variant="rigid"), []  # no matter
    fronts = pareto_front(
        samples, geometry, settings, THETAS, progress=lambda *step: steps.append(step)
    )
    assert steps == [(i, len(THETAS)) for i in range(1, len(THETAS) + 1)]
    assert tuple(fronts) == PAPER_VARIANTS
    for variant, front in fronts.items():
        assert front.variant == variant
        assert front.theta.tolist() == list(THETAS)
        for index in range(len(THETAS)):
            assert_is_the_fit(front, index, samples, geometry, settings)


def test_every_solution_is_the_fit_on_a_hold():
    geometry, _, samples, settings = make_hold(0)
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
    found, near = [], None
    for theta in np.linspace(0.0, 1.0, 21):
        problem = Problem(objective.with_settings(theta=float(theta)))
        x = problem.start.copy()
        x[3:] = (rest - problem.law.reference_pose[:3]).T / MILLIMETRE
        near = solve_box_qp(problem.stage_two(problem.moments(x)), "osqp", 1e-8, near).x
        found.append(near.reshape(3, -1).T.reshape(-1))
    sums = []
    for theta in (1.0, 0.0):
        alone = dataclasses.replace(settings, theta=theta)
        rows = stack_stage_two(samples, geometry, alone, rest)
        sums.append([rows.cost(x) for x in found])
    assert_traded(*sums)


def test_the_solver_is_called_for_the_programs_of_the_first_theta_alone(monkeypatch):
    geometry, _, samples, settings = make_hold(3)
    calls = count_solver_calls(monkeypatch)
    fronts = pareto_front(samples, geometry, settings, np.linspace(0.0, 1.0, 21))
    assert all(front.sound.all() for front in fronts.values())
    assert calls == ["osqp"] * 3  # Stage 1, and Stage 2 of both variants


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


def split_socket(geometry):
    """The same socket with a row of tiles, none of them under a cluster, joined to no other."""
    island = {i for i in range(len(geometry)) if i not in geometry.clusters.values()}
    pairs = [p for p in geometry.neighbours if (p[0] in island) == (p[1] in island)]
    return dataclasses.replace(geometry, neighbours=np.array(pairs))


def test_what_nothing_decides_is_not_on_the_front():
    geometry, _, samples, settings = make_hold(4)
    fronts = pareto_front(samples, split_socket(geometry), settings, THETAS)
    for front in fronts.values():
        assert "Stage 1" in front.flaws[0] and "determine" in front.flaws[0]
        assert not front.sound[0] and not front.non_dominated[0]
        assert SENSOR_ONLY not in front.marks
    whole = pareto_front(samples, geometry, settings, THETAS)
    assert all(front.sound.all() for front in whole.values())


def test_without_any_smoothness_the_front_is_refused_with_a_hint():
    geometry, _, samples, settings = make_case(41, smoothness=0.0)
    with pytest.raises(IdentificationError, match=r"determine.*more smoothness"):
        pareto_front(samples, geometry, settings, THETAS)


def fail_where(monkeypatch, fails, answer=True):
    """A solver path that gives up on some programs; `fails` gets the name and the count."""
    counts = {}

    def solve(problem, *more):
        counts[problem.name] = count = counts.get(problem.name, -1) + 1
        if fails(problem.name, count):
            x = np.ones_like(problem.q) if answer else None
            raise UncertifiedSolutionError(f"{problem.name}: missed", "hint", problem, x)
        return solve_box_qp(problem, *more)

    monkeypatch.setattr(pareto, "solve_box_qp", solve)


@pytest.mark.parametrize("answer", [False, True])
def test_an_uncertified_solution_is_flagged_and_the_walk_goes_on(monkeypatch, answer):
    geometry, _, samples, settings = make_case(42)
    expected = pareto_front(samples, geometry, settings, THETAS)
    # Stage 1 at the second theta; Stage 2 of the bias variant at the third.
    fail_where(
        monkeypatch, lambda name, i: (name[6] == "1" and i == 1) or (name[6] == "2" and i == 3),
        answer,
    )  # fmt: skip
    fronts = pareto_front(samples, geometry, settings, THETAS)
    for variant, flawed in (("stiffness", [1]), ("stiffness_bias", [1, 2])):
        front, sound = fronts[variant], np.setdiff1d(range(len(THETAS)), flawed)
        assert np.flatnonzero(~front.sound).tolist() == flawed
        assert np.isnan(front.wrench_error[flawed]).all() and np.isnan(front.rmse[flawed]).all()
        assert not front.non_dominated[flawed].any()
        assert [front.models[i] for i in flawed] == [None] * len(flawed)
        assert all("missed" in front.flaws[i] for i in flawed)
        assert (np.isfinite(front.residual[flawed]) == answer).all()
        for name in ("wrench_error", "local_error"):
            found, other = getattr(front, name), getattr(expected[variant], name)
            np.testing.assert_allclose(found[sound], other[sound], rtol=1e-7)


def test_a_front_without_one_certified_solution_is_an_error(monkeypatch):
    geometry, _, samples, settings = make_case(43)
    fail_where(monkeypatch, lambda *_: True)
    with pytest.raises(IdentificationError, match="missed"):
        pareto_front(samples, geometry, settings, THETAS)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"leave_out": ("Mx", "My", "Mz", "Fx", "Fy", "Fz")}, "no channel of the wrench"),
        ({"leave_out": tuple(f"cluster_{i}.F{a}" for i in range(3) for a in "xyz")}, "clusters"),
        ({"leave_out": ("cluster_9.Fx",)}, "cluster_9.Fx"),
        ({"solver": "osqq"}, "did you mean 'osqp'"),
        ({}, "not for rigid"),
    ],
)
def test_wrong_settings_get_one_line(changes, said):
    geometry, _, samples, settings = make_case(51)
    settings = dataclasses.replace(settings, **changes)
    with pytest.raises(TestbedError, match=said) as caught:
        pareto_front(samples, geometry, settings, THETAS, PAPER_VARIANTS if changes else VARIANTS)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("thetas", [(), (0.5, 0.5), (1.0, 0.0), (0.0, 1.1), (-0.1, 1.0), (np.nan,)])
def test_thetas_must_rise_within_zero_and_one(thetas):
    geometry, _, samples, settings = make_case(54)
    with pytest.raises(ConfigurationError, match="theta"):
        pareto_front(samples, geometry, settings, thetas)
