"""A box QP solved from the solution of a similar one."""

import dataclasses

import numpy as np
import qpsolvers

from socket_testbed.identification.box_qp import BoxQP, solve_box_qp


def near_problem():
    rng = np.random.default_rng(61)
    root = rng.normal(size=(12, 12))
    P = root @ root.T / 12 + 0.1 * np.eye(12)
    return BoxQP(P, rng.normal(size=12), np.full(12, -0.3), np.full(12, 0.3), "near")


def test_from_a_near_solution_the_optimum_needs_no_solver(monkeypatch):
    problem = near_problem()
    cold = solve_box_qp(problem, "osqp", 1e-9)
    monkeypatch.setattr(qpsolvers, "solve_problem", None)
    for step in (0.0, 0.01, 1.0, 100.0):
        warm = solve_box_qp(problem, "osqp", 1e-9, cold.x + step)
        np.testing.assert_allclose(warm.x, cold.x, atol=1e-12)
        assert warm.certificate.worst <= 1e-9
        assert warm.determined and cold.determined


def test_where_a_near_solution_leads_nowhere_the_solver_is_asked():
    problem = near_problem()
    P, q = problem.P.copy(), problem.q.copy()
    P[:, 0] = P[0] = q[0] = 0.0
    flat = dataclasses.replace(problem, P=P, q=q)
    solution = solve_box_qp(flat, "osqp", 1e-6, np.full(12, 0.29))
    assert solution.certificate.worst <= 1e-6
    assert solution.found_by == "osqp" and not solution.determined


def test_a_direction_flat_but_for_rounding_is_not_determined():
    problem = near_problem()
    P, q = problem.P.copy(), problem.q.copy()
    P[:, 0] = P[0] = q[0] = 0.0
    P[0, 0] = 1e-14
    nearly_flat = dataclasses.replace(problem, P=P, q=q)
    solution = solve_box_qp(nearly_flat, "osqp", 1e-6, np.zeros(12))
    assert solution.certificate.worst <= 1e-6 and solution.found_by == "warm start"
    assert not solution.determined
