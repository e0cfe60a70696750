"""The front over theta against single fits and its theorems; where it bends, on known fronts."""

import json
from dataclasses import replace
from unittest.mock import DEFAULT, Mock

import numpy as np
import pytest
from support.problems import make_case
from support.wording import refused

from socket_testbed.errors import TestbedError
from socket_testbed.identification import pareto
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.solver import UncertifiedSolutionError, solve_box_qp
from socket_testbed.settings.identification import PAPER_VARIANTS

THETAS = (0.0, 0.07, 0.5, 0.93, 1.0)


LEAVE_OUT = ("Mz", "cluster_0.Fz", "cluster_2.Fy")


@pytest.fixture(scope="module")
def case():
    """A socket, samples, settings, and the fronts of them."""
    geometry, _, samples, settings = make_case(2, gaps=True, leave_out=LEAVE_OUT)
    samples.local_forces[:, 0, 2] = np.nan  # a channel that is left out may be dead
    # Neither theta nor variant matter.
    settings = replace(settings, theta=1.0, variant="rigid")
    fronts = pareto.pareto_front(samples, geometry, settings, THETAS)
    assert tuple(fronts) == PAPER_VARIANTS
    return geometry, samples, settings, fronts


EVERY_SOLUTION = [
    pytest.param(variant, i, id=f"{variant}-theta-{theta:g}")
    for variant in PAPER_VARIANTS
    for i, theta in enumerate(THETAS)
]


@pytest.mark.parametrize(("variant", "i"), EVERY_SOLUTION)
def test_every_solution_is_the_fit_at_its_theta(case, variant, i: int) -> None:
    geometry, samples, settings, fronts = case
    front, counted = fronts[variant], [name for name in samples.channels if name not in LEAVE_OUT]
    assert front.theta.tolist() == list(THETAS) and list(front.channels) == counted
    single = replace(settings, theta=THETAS[i], variant=variant)
    fit = fit_contact_model(samples, geometry, single)  # which starts from nothing
    assert front.flaws[i] == "" and front.residual[i] <= settings.solver_tolerance
    rmse = np.array([e.rmse for e in fit.errors if e.in_objective])
    assert front.rmse[i] == pytest.approx(rmse, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize(("variant", "i"), EVERY_SOLUTION)
def test_errors_are_shares_of_what_was_measured(case, variant, i: int) -> None:
    _, samples, _, fronts = case
    front = fronts[variant]
    measured = dict(zip(samples.channels, samples.trusted_values.T, strict=True))
    counted = [name for name in samples.channels if name not in LEAVE_OUT]

    def kind_of(name):
        return "." if "." in name else name[0]

    sizes = {
        kind: np.sqrt(np.nanmean([measured[n] ** 2 for n in counted if kind_of(n) == kind]))
        for kind in "MF."
    }
    rmse = front.rmse[i]
    share = rmse / [sizes[kind_of(name)] for name in counted]
    errors = [np.sqrt(np.mean(part**2)) for part in (share[:5], share[5:])]
    assert [front.wrench_error[i], front.local_error[i]] == pytest.approx(errors, rel=1e-5)
    means = [rmse[:2].mean(), rmse[2:5].mean(), np.median(rmse[5:])]
    found = front.mean_moment_rmse, front.mean_force_rmse, front.median_local_rmse
    assert [group[i] for group in found] == pytest.approx(means, rel=1e-5)


def test_what_nothing_decides_is_not_on_the_front() -> None:
    geometry, _, samples, settings = make_case(4)
    # A row of tiles, none of them under a cluster, that is joined to no other.
    island = {i for i in range(len(geometry)) if i not in geometry.clusters.values()}
    pairs = [p for p in geometry.neighbours if (p[0] in island) == (p[1] in island)]
    split = replace(geometry, neighbours=np.array(pairs))
    for front in pareto.pareto_front(samples, split, settings, THETAS).values():
        assert "Stage 1" in front.flaws[0] and "determine" in front.flaws[0]
        assert not front.sound[0] and not front.non_dominated[0]
        assert pareto.SENSOR_ONLY not in front.marks


def test_a_front_without_smoothness_is_refused() -> None:
    geometry, _, samples, settings = make_case(4)
    with refused(TestbedError, "more smoothness"):
        pareto.pareto_front(samples, geometry, replace(settings, smoothness=0.0), THETAS)


def test_the_walk_goes_on_after_an_uncertified_solution(monkeypatch):
    geometry, _, samples, settings = make_case(42)
    expected = pareto.pareto_front(samples, geometry, settings, THETAS)
    missed = UncertifiedSolutionError("missed", "hint")
    # Both stages without and with offsets at each theta; here Stage 1 is missed at the second.
    solve = Mock(wraps=solve_box_qp, side_effect=[*[DEFAULT] * 3, missed, *[DEFAULT] * 9])
    monkeypatch.setattr(pareto, "solve_box_qp", solve)
    fronts = pareto.pareto_front(samples, geometry, settings, THETAS)
    for variant, front in fronts.items():
        assert front.flaws == ("", "missed", "", "", "") and np.isnan(front.rmse[1]).all()
        for name in ("wrench_error", "local_error"):
            found, other = (np.delete(getattr(f, name), 1) for f in (front, expected[variant]))
            np.testing.assert_allclose(found, other, rtol=1e-7)


def test_what_is_kept_is_what_the_definition_keeps(rng):
    for count in (0, 1, 5, 60, 60, 60, 60):
        wrench, local = rng.integers(0, 12, (2, count)).astype(float)  # with ties of all kinds
        sound = rng.random(count) < 0.8
        wrench[~sound & (rng.random(count) < 0.5)] = np.nan
        better = (wrench[:, None] <= wrench) & (local[:, None] <= local)
        better &= (wrench[:, None] < wrench) | (local[:, None] < local)
        dominated = (better & sound[:, None]).any(axis=0)
        found = pareto.find_non_dominated(wrench, local, sound)
        np.testing.assert_array_equal(found, sound & ~dominated)


def knee_of(wrench, local):
    wrench, local = np.array(wrench, dtype=float), np.array(local, dtype=float)
    kept = pareto.find_non_dominated(wrench, local, np.ones(len(wrench), dtype=bool))
    return pareto.find_knee(wrench, local, kept)


def test_the_knee_has_the_slope_of_the_chord() -> None:
    x = np.geomspace(0.1, 10.0, 401)  # y = 1 / x: the slope is the chord's at the middle
    knee = knee_of(0.05 * x, 7.0 / x)
    assert knee.index == 200
    assert knee.depth == pytest.approx(1.0 - 2.0 * 0.9 / 9.9)
    assert knee.span == pytest.approx((9.9 * 0.05, 9.9 * 7.0))


LINE = np.linspace(0.0, 1.0, 9)


@pytest.mark.parametrize(
    ("wrench", "local", "reason"),
    [
        pytest.param(
            *([0.3, 0.3 + 0.9 * pareto.RESOLUTION], [0.5, 0.2], "nothing to trade off"),
            id="a-point",
        ),
        pytest.param(LINE, 1.0 - LINE, "straight", id="a-line"),
        pytest.param([], [], "without flaw", id="nothing"),
    ],
)
def test_a_front_without_a_knee_says_why(wrench, local, reason: str) -> None:
    knee = knee_of(wrench, local)
    assert knee.index is None and knee.verdict.startswith("no knee") and reason in knee.verdict


def hyperbola() -> list[pareto.FrontPoint]:
    """A hyperbola with its corner at theta 0.4, dominated from theta 0.9 on."""
    points = []
    for i, t in enumerate(np.linspace(0.0, 1.0, 11)):
        errors = (0.1 + 0.01 / (t + 0.01), 0.1 + 0.01 / (0.81 - t)) if i < 9 else (2.0 + t, 2.0)
        rmse = np.arange(1.0, 7.0) * (1.0 + t)
        points.append(pareto.FrontPoint(float(t), 1e-12 * (i + 1), rmse, "", *errors))
    return points


def flawed_hyperbola() -> list[pareto.FrontPoint]:
    """The same without its knee and its ends."""
    points = hyperbola()
    points[4] = pareto.FrontPoint(0.4, np.nan, np.full(6, np.nan), "none")
    for flawed in (0, 8, 10):
        points[flawed] = replace(points[flawed], flaw="not determined")
    return points


CHANNELS = ("Mx", "Fx", "Fz", "distal.Fx", "distal.Fy", "distal.Fz")


def test_a_front_marks_its_ends_and_its_knee() -> None:
    front = pareto.Front("stiffness", CHANNELS, hyperbola())
    assert front.marks == {pareto.SENSOR_ONLY: 0, pareto.KNEE: 4, pareto.WRENCH_ONLY: 10}
    assert front.non_dominated.tolist() == [True] * 9 + [False] * 2


def test_a_front_marks_nothing_flawed() -> None:
    spoilt = pareto.Front("stiffness", CHANNELS, flawed_hyperbola())
    assert not spoilt.non_dominated[[0, 4, 8, 10]].any()
    assert set(spoilt.marks) == {pareto.KNEE} and spoilt.marks[pareto.KNEE] in (3, 5)
    assert spoilt.worst_residual == pytest.approx(10e-12)


def test_table_and_document_of_a_front_state_flaws() -> None:
    front = pareto.Front("stiffness", CHANNELS, hyperbola())
    spoilt = pareto.Front("stiffness", CHANNELS, flawed_hyperbola())
    assert pareto.front_table([front, spoilt]).loc[15, "flaw"] == "none"
    document = json.loads(json.dumps(pareto.front_document(spoilt), allow_nan=False))
    assert document["marks"].keys() == spoilt.marks.keys()
    assert document["solutions"][4]["rmse"]["Mx"] is None  # JSON has no NaN
