"""What a front says of solutions that are not to be used, and of wrong input."""

import dataclasses

import numpy as np
import pytest
from support.pareto_cases import THETAS, make_hold
from support.problems import make_case

from socket_testbed.errors import ConfigurationError, IdentificationError, TestbedError
from socket_testbed.identification import pareto
from socket_testbed.identification.box_qp import UncertifiedSolutionError, solve_box_qp
from socket_testbed.identification.pareto import SENSOR_ONLY, pareto_front


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
    ],
)
def test_wrong_settings_get_one_line(changes, said):
    geometry, _, samples, settings = make_case(51)
    settings = dataclasses.replace(settings, **changes)
    with pytest.raises(TestbedError, match=said) as caught:
        pareto_front(samples, geometry, settings, THETAS)
    assert "\n" not in str(caught.value)


def test_a_trial_without_clusters_has_nothing_to_trade_off():
    geometry, _, samples, settings = make_case(52, clusters=0)
    with pytest.raises(IdentificationError, match="no channel of the clusters"):
        pareto_front(samples, geometry, settings, THETAS)


def test_no_samples_are_an_error():
    geometry, _, samples, settings = make_case(53)
    with pytest.raises(IdentificationError, match="only 0 of 0 samples"):
        pareto_front(samples[:0], geometry, settings, THETAS)


@pytest.mark.parametrize("thetas", [(), (0.5, 0.5), (1.0, 0.0), (0.0, 1.1), (-0.1, 1.0), (np.nan,)])
def test_thetas_must_rise_within_zero_and_one(thetas):
    geometry, _, samples, settings = make_case(54)
    with pytest.raises(ConfigurationError, match="theta"):
        pareto_front(samples, geometry, settings, thetas)
