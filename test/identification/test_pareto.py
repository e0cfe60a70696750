"""The front over theta against single fits and its theorems; where it bends, on known fronts."""

import dataclasses
import json

import numpy as np
import pytest
from support.problems import make_case
from support.wording import refused

from socket_testbed.errors import IdentificationError, TestbedError
from socket_testbed.identification import pareto
from socket_testbed.identification.box_qp import UncertifiedSolutionError, solve_box_qp
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.evaluation import evaluate
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.pareto import (
    KNEE,
    LEAST_DEPTH,
    RESOLUTION,
    SENSOR_ONLY,
    WRENCH_ONLY,
    Front,
    FrontPoint,
    find_knee,
    find_non_dominated,
    front_document,
    front_table,
    pareto_front,
)
from socket_testbed.settings.identification import PAPER_VARIANTS

CHANNELS = ("Mx", "Fx", "Fz", "distal.Fx", "distal.Mz", "distal.Fz")
THETAS = (0.0, 0.07, 0.5, 0.93, 1.0)
LOCAL = tuple(f"cluster_{i}.F{axis}" for i in range(3) for axis in "xyz")


def assert_is_the_fit(front, index, samples, geometry, settings):
    """One solution of a front against the fit alone, which starts from nothing."""
    theta = float(front.theta[index])
    settings = dataclasses.replace(settings, theta=theta, variant=front.variant)
    fit = fit_contact_model(samples, geometry, settings)
    model = front.points[index].model
    assert front.flaws[index] == ""
    assert front.residual[index] <= settings.solver_tolerance
    np.testing.assert_allclose(model.rest_positions, fit.model.rest_positions, atol=1e-9)
    position = samples.position[np.isfinite(samples.position).all(axis=1)]
    for predict in (ContactModel.wrench, ContactModel.forces):
        found, expected = predict(model, position), predict(fit.model, position)
        assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()
    errors = {e.name: e.rmse for e in fit.errors if e.in_objective}
    assert dict(zip(front.channels, front.rmse[index], strict=True)) == pytest.approx(
        errors, rel=1e-5, abs=1e-6
    )


def test_every_solution_is_the_fit_at_its_theta():
    leave_out = ("Mz", "cluster_0.Fz", "cluster_2.Fy")
    geometry, _, samples, settings = make_case(2, gaps=True, leave_out=leave_out)
    samples.wrench[3, 4] = samples.position[8, 0] = np.nan
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


def test_the_errors_are_normalised_by_what_was_measured():
    leave_out = ("Mx", "cluster_1.Fx")
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
        for index, point in enumerate(front.points):
            rmse = {e.name: e.rmse for e in evaluate(samples, point.model)}
            square = {name: (rmse[name] / sizes[name]) ** 2 for name in counted}
            wrench_error = np.sqrt(np.mean([square[name] for name in moments + forces]))
            local_error = np.sqrt(np.mean([square[name] for name in local]))
            assert front.wrench_error[index] == pytest.approx(wrench_error, rel=1e-6)
            assert front.local_error[index] == pytest.approx(local_error, rel=1e-6)


def test_what_nothing_decides_is_not_on_the_front():
    geometry, _, samples, settings = make_case(4)
    # A row of tiles, none of them under a cluster, that is joined to no other.
    island = {i for i in range(len(geometry)) if i not in geometry.clusters.values()}
    pairs = [p for p in geometry.neighbours if (p[0] in island) == (p[1] in island)]
    split = dataclasses.replace(geometry, neighbours=np.array(pairs))
    for front in pareto_front(samples, split, settings, THETAS).values():
        assert "Stage 1" in front.flaws[0] and "determine" in front.flaws[0]
        assert not front.sound[0] and not front.non_dominated[0]
        assert SENSOR_ONLY not in front.marks


def fail_where(monkeypatch, fails):
    """A solver path that gives up on some programs; `fails` gets the name and the count."""
    counts = {}

    def solve(problem, *more):
        counts[problem.name] = count = counts.get(problem.name, -1) + 1
        if fails(problem.name, count):
            raise UncertifiedSolutionError(f"{problem.name}: missed", "hint")
        return solve_box_qp(problem, *more)

    monkeypatch.setattr(pareto, "solve_box_qp", solve)


def test_an_uncertified_solution_is_flagged_and_the_walk_goes_on(monkeypatch):
    geometry, _, samples, settings = make_case(42)
    expected = pareto_front(samples, geometry, settings, THETAS)
    # Stage 1 at the second theta; Stage 2 of the bias variant at the third.
    fail_where(monkeypatch, lambda name, i: (name[6], i) in {("1", 1), ("2", 3)})
    fronts = pareto_front(samples, geometry, settings, THETAS)
    for variant, flawed in (("stiffness", [1]), ("stiffness_bias", [1, 2])):
        front, sound = fronts[variant], np.setdiff1d(range(len(THETAS)), flawed)
        assert np.flatnonzero(~front.sound).tolist() == flawed
        assert np.isnan(front.wrench_error[flawed]).all() and np.isnan(front.rmse[flawed]).all()
        assert not front.non_dominated[flawed].any()
        assert [front.points[i].model for i in flawed] == [None] * len(flawed)
        assert all("missed" in front.flaws[i] for i in flawed)
        for name in ("wrench_error", "local_error"):
            found, other = getattr(front, name), getattr(expected[variant], name)
            np.testing.assert_allclose(found[sound], other[sound], rtol=1e-7)
    fail_where(monkeypatch, lambda *_: True)
    with pytest.raises(IdentificationError, match="missed"):
        pareto_front(samples, geometry, settings, THETAS)


def test_without_a_trade_off_the_front_is_refused():
    for changes, reason in (
        ({"leave_out": ("Mx", "My", "Mz", "Fx", "Fy", "Fz")}, "no channel of the wrench"),
        ({"leave_out": LOCAL}, "no channel of the clusters"),
        ({"smoothness": 0.0}, "more smoothness"),
    ):
        geometry, _, samples, settings = make_case(41, **changes)
        with refused(TestbedError, reason):
            pareto_front(samples, geometry, settings, THETAS)


def knee_of(wrench, local):
    wrench, local = np.array(wrench, dtype=float), np.array(local, dtype=float)
    kept = find_non_dominated(wrench, local, np.ones(len(wrench), dtype=bool))
    return find_knee(wrench, local, kept)


def test_what_is_kept_is_what_the_definition_keeps():
    rng = np.random.default_rng(0)
    for count in (0, 1, 5, 60, 60, 60, 60):
        wrench, local = rng.integers(0, 12, (2, count)).astype(float)  # with ties of all kinds
        sound = rng.random(count) < 0.8
        wrench[~sound & (rng.random(count) < 0.5)] = np.nan
        better = (wrench[:, None] <= wrench) & (local[:, None] <= local)
        better &= (wrench[:, None] < wrench) | (local[:, None] < local)
        dominated = (better & sound[:, None]).any(axis=0)
        found = find_non_dominated(wrench, local, sound)
        np.testing.assert_array_equal(found, sound & ~dominated)


def test_the_knee_of_a_hyperbola_is_where_its_slope_is_the_chord_s_and_without_one_it_is_said_why():
    x = np.geomspace(0.1, 10.0, 401)  # y = 1 / x: the slope is -1 at x = 1
    for along, up in ((1.0, 1.0), (0.05, 7.0)):
        knee = knee_of(along * x, up / x)
        assert knee.index == 200
        assert knee.depth == pytest.approx(1.0 - 2.0 * 0.9 / 9.9)
        assert knee.span == pytest.approx((9.9 * along, 9.9 * up))
    line = np.linspace(0.0, 1.0, 9)
    for wrench, local, reason in (
        ([0.3] * 4, [0.4] * 4, "nothing to trade off"),
        ([0.3, 0.3 + 0.9 * RESOLUTION], [0.5, 0.2], "nothing to trade off"),
        (line, 1.0 - line, "straight"),
        (line, 1.0 - line**3, "straight"),  # bends outwards
        ([], [], "without flaw"),
    ):
        knee = knee_of(wrench, local)
        assert knee.index is None and not knee.depth >= LEAST_DEPTH
        assert knee.verdict.startswith("no knee") and reason in knee.verdict


def made_up_front(variant="stiffness", scale=1.0, flaws=(), channels=CHANNELS):
    """A hyperbola with its corner at theta 0.4, dominated from theta 0.9 on."""
    points = []
    for i, t in enumerate(np.linspace(0.0, 1.0, 11)):
        errors = (0.1 + 0.01 / (t + 0.01), 0.1 + 0.01 / (0.81 - t)) if i < 9 else (2.0 + t, 2.0)
        wrench, local = scale * errors[0], scale * errors[1]
        rmse = np.arange(1.0, 1.0 + len(channels)) * (1.0 + t)
        flaw = dict(flaws).get(i, "")
        if flaw == "not certified":
            wrench = local = np.nan
            rmse = rmse * np.nan
        points.append(FrontPoint(float(t), None, rmse, wrench, local, 1e-12 * (i + 1), flaw))
    return Front(variant, channels, points)


def test_a_front_marks_its_ends_and_its_knee_but_nothing_flawed():
    front = made_up_front()
    assert front.marks == {SENSOR_ONLY: 0, KNEE: 4, WRENCH_ONLY: 10}
    assert front.non_dominated.tolist() == [True] * 9 + [False] * 2
    groups = (front.moment_rmse, front.force_rmse, front.local_rmse)
    np.testing.assert_allclose(groups, np.outer([1.0, 2.5, 5.0], 1.0 + front.theta))
    assert np.isnan(made_up_front(channels=CHANNELS[1:]).moment_rmse).all()
    flaws = {0: "not determined", 4: "not certified", 8: "not certified", 10: "not certified"}
    front = made_up_front(flaws=flaws)
    assert front.sound.tolist() == [i not in flaws for i in range(11)]
    assert not front.non_dominated[[0, 4, 8, 10]].any()
    assert set(front.marks) == {KNEE} and front.marks[KNEE] in (3, 5)
    assert front.worst_residual == pytest.approx(10e-12)
    table = front_table([made_up_front(), front])
    assert table["variant"].tolist() == ["stiffness"] * 22 and table.loc[15, "flaw"] == flaws[4]
    np.testing.assert_array_equal(table["wrench error [-]"][11:], front.wrench_error)
    document = json.loads(json.dumps(front_document(front), allow_nan=False))
    assert document["marks"].keys() == front.marks.keys()
    assert document["solutions"][4]["rmse"]["Mx"] is None  # JSON has no NaN
