"""The certificate of a box QP, its refinement, and solvers that are not believed."""

from unittest.mock import Mock

import numpy as np
import pytest
import qpsolvers

from socket_testbed.identification.solver import (
    WARM_START,
    BoxQP,
    BoxSolution,
    UncertifiedSolutionError,
    pivot_regularised,
    solve_box_qp,
)

SOLVERS = [solver for solver in ("osqp", "daqp") if solver in qpsolvers.available_solvers]


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


def test_the_certificate_is_zero_at_the_optimum_and_nowhere_else(rng):
    problem, optimum = known_problem(1)
    assert problem.certificate(optimum).worst < 1e-13
    for step in (1e-5, 1e-3, 1e-1):
        direction = rng.normal(size=len(optimum))
        inside = np.clip(optimum + step * direction, problem.lower, problem.upper)
        assert problem.objective(inside) > problem.objective(optimum)
        assert problem.certificate(inside).worst > 0.01 * step
    outside = np.where(np.isfinite(problem.upper), problem.upper + 0.25, optimum)
    assert problem.certificate(outside).primal == pytest.approx(0.25)
    for spoilt in (problem.P, problem.q, optimum):  # what is not a number is never certified
        kept = spoilt[3].copy()
        spoilt[3] = np.nan
        assert not problem.certificate(optimum).worst <= 1e-2
        spoilt[3] = kept


@pytest.mark.parametrize("solver", SOLVERS)
def test_solvers_find_known_optima_and_near_a_solution_none_is_called(monkeypatch, solver):
    for seed in range(3):
        problem, optimum = known_problem(seed)
        solution = solve_box_qp(problem, solver, 1e-9)
        np.testing.assert_allclose(solution.x, optimum, atol=1e-8)
        assert solution.certificate == problem.certificate(solution.x)
        assert solution.certificate.worst <= 1e-9
        assert solution.solver == solver and solver in solution.status
    monkeypatch.setattr(qpsolvers, "solve_problem", None)
    for step in (0.0, 0.01, 1.0, 100.0):
        warm = solve_box_qp(problem, solver, 1e-9, optimum + step)
        np.testing.assert_allclose(warm.x, optimum, atol=1e-11)
        assert warm.certificate.worst <= 1e-9 and warm.determined and warm.solver == WARM_START


def test_a_wrong_answer_is_refused_whatever_the_solver_says(monkeypatch):
    problem, optimum = known_problem(85)
    wrong = np.clip(optimum + 0.05, problem.lower, problem.upper)
    monkeypatch.setattr(qpsolvers, "solve_problem", solver := Mock())
    for correct in ("pivot", "pivot_regularised"):  # nobody corrects its answer
        place = f"socket_testbed.identification.solver.{correct}"
        monkeypatch.setattr(place, lambda of, x: BoxSolution(x, of.certificate(x)))
    for result, reason in (
        (qpsolvers.Solution(None, found=True, x=wrong), "KKT"),
        (qpsolvers.Solution(None, found=True, x=None), "gave no answer"),
        (qpsolvers.Solution(None, found=True, x=np.full(12, np.nan)), "gave no answer"),
        (qpsolvers.exceptions.SolverError("out of luck"), "out of luck"),
    ):
        solver.side_effect = [result]
        with pytest.raises(UncertifiedSolutionError, match=reason) as caught:
            solve_box_qp(problem, "osqp", 1e-6)
        residual = problem.certificate(wrong).worst if reason == "KKT" else np.nan
        assert caught.value.residual == pytest.approx(residual, nan_ok=True)


def test_flat_and_singular_programs_are_solved_and_called_undetermined(rng):
    """Exactly flat, a near solution leads nowhere; flat but for rounding, it does."""
    for curvature, start, solver in ((0.0, 0.29, "osqp"), (1e-14, 0.0, WARM_START)):
        root = rng.normal(size=(12, 12))
        P, q = root @ root.T / 12 + 0.1 * np.eye(12), rng.normal(size=12)
        P[:, 0] = P[0] = q[0] = 0.0
        P[0, 0] = curvature
        flat = BoxQP(P, q, np.full(12, -0.3), np.full(12, 0.3), "flat")
        solution = solve_box_qp(flat, "osqp", 1e-6, np.full(12, start))
        assert solution.certificate.worst <= 1e-6
        assert solution.solver == solver and not solution.determined
    program = BoxQP(np.ones((2, 2)), np.full(2, -4.0), np.full(2, -5.0), np.full(2, 5.0), "a line")
    found = pivot_regularised(program, np.array([0.001, 4.001]))
    np.testing.assert_allclose(found.x, 2.0, atol=1e-5)  # of all optima the one nearest to zero
