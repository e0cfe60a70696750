"""The methods that solve the same Stage 2, and the product that they are measured against."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import qpsolvers
from problems import KILONEWTON_PER_METRE, StageTwoInput, gated_displacement, with_rest
from scipy import sparse
from scipy.optimize import lsq_linear
from stacked import Solution, bounds, stack_dense, stack_sparse, to_solution

from socket_testbed.arrays import FloatArray
from socket_testbed.identification.box_qp import BoxQP, BoxSolution, pivot, solve_box_qp
from socket_testbed.identification.problem import Problem

Run = Callable[[], Solution | None]
Prepare = Callable[[StageTwoInput], Run]

_OSQP_TIGHT: dict[str, Any] = {
    "eps_abs": 1e-9,
    "eps_rel": 0.0,
    "polishing": True,
    "max_iter": 200_000,
}
_LSQ_TOLERANCE = 1e-14  # [-]; on the scaled gradient, the tightest with which it ends


@dataclass(frozen=True)
class Method:
    """One row of the table.

    Attributes:
        label: What the table calls it.
        conditions: Settings and what is timed, in words.
        prepare: What is not timed; gives what is timed.
        module: Module that must be imported before the memory counts.
    """

    label: str
    conditions: str
    prepare: Prepare
    module: str = "numpy"


def pivot_from_zero(problem: BoxQP) -> BoxSolution:
    """Pivoting without a solver: from the point of the box nearest to zero."""
    return pivot(problem, np.clip(np.zeros_like(problem.q), problem.lower, problem.upper))


def prepare_ours(stage: StageTwoInput, without_solver: bool = False) -> Run:
    """The package's own Stage 2: moments, program, certified solution, offsets."""
    settings = stage.settings

    def run() -> Solution:
        problem = Problem(stage.objective)
        x = with_rest(problem, stage.rest_positions)
        program = problem.stage_two(problem.moments(x))
        found = (
            pivot_from_zero(program)
            if without_solver
            else solve_box_qp(program, settings.solver, settings.solver_tolerance)
        )
        x[:3] = found.x.reshape(3, -1)
        model = problem.model(x)
        channels = stage.objective.channels
        bias = np.array([model.force_bias[c.cluster][c.axis] for c in channels])
        return Solution(model.stiffness.ravel(), model.wrench_bias, bias, found.status)

    return run


def prepare_product(stage: StageTwoInput) -> Run:
    """The symmetric product S'S alone, of the N x 3n matrix S that is there already."""
    s = gated_displacement(
        stage.objective.samples.position, stage.rest_positions, stage.settings.gate_sharpness
    ).reshape(len(stage.objective.samples.position), -1)

    def run() -> None:
        _ = s.T @ s  # numpy sees the symmetry and multiplies out one half

    return run


def prepare_cvxpy_plain(stage: StageTwoInput) -> Run:
    """CVXPY with OSQP on the sparse rows, in kN/m, N and N m, at CVXPY's own settings."""
    springs = 3 * len(stage.geometry)

    def run() -> Solution:
        A, y = stack_sparse(stage)
        unit = np.ones(A.shape[1])
        unit[:springs] = KILONEWTON_PER_METRE  # in N/m OSQP's answer is 100 % off
        z, status = _solve_with_cvxpy(A @ sparse.diags_array(unit), y, springs, {})
        return to_solution(stage, unit * z, status)

    return run


def prepare_cvxpy_scaled(stage: StageTwoInput) -> Run:
    """CVXPY with OSQP on the sparse rows, with scaled columns and tight tolerances."""

    def run() -> Solution:
        A, y = stack_sparse(stage)
        unit = 1.0 / np.sqrt(A.multiply(A).sum(axis=0))
        scaled = A @ sparse.diags_array(unit)
        z, status = _solve_with_cvxpy(scaled, y, 3 * len(stage.geometry), _OSQP_TIGHT)
        return to_solution(stage, unit * z, status)

    return run


def _solve_with_cvxpy(
    A: sparse.csr_array, y: FloatArray, springs: int, options: dict[str, Any]
) -> tuple[FloatArray, str]:
    import cvxpy

    z = cvxpy.Variable(A.shape[1])
    problem = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(A @ z - y)), [z[:springs] >= 0])
    problem.solve(solver="OSQP", **options)
    if z.value is None:
        raise ArithmeticError(f"no answer ({problem.status})")
    return z.value, f"{problem.status}, {problem.solver_stats.num_iters} iterations"


def prepare_qpsolvers(stage: StageTwoInput) -> Run:
    """A'A from the dense rows, then OSQP with scaled variables through qpsolvers."""

    def run() -> Solution:
        A, y = stack_dense(stage)
        P, q = A.T @ A, -(A.T @ y)
        unit = 1.0 / np.sqrt(P.diagonal())
        problem = qpsolvers.Problem(
            sparse.csc_matrix(P * np.outer(unit, unit)), q * unit, lb=bounds(stage)
        )
        answer = qpsolvers.solve_problem(problem, "osqp", **_OSQP_TIGHT)
        if answer.x is None:
            raise ArithmeticError("no answer")
        found = "solved" if answer.found else "not found"
        status = f"{found}, {answer.extras['info'].iter} iterations"
        return to_solution(stage, unit * answer.x, status)

    return run


def prepare_lsq_linear(stage: StageTwoInput) -> Run:
    """Bounded least squares of scipy on the dense rows with scaled columns."""

    def run() -> Solution:
        A, y = stack_dense(stage)
        unit = 1.0 / np.linalg.norm(A, axis=0)
        A *= unit  # in place: a second copy would count as the method's memory
        answer = lsq_linear(A, y, (bounds(stage), np.inf), tol=_LSQ_TOLERANCE, max_iter=300)
        return to_solution(stage, unit * answer.x, f"{answer.message} {answer.nit} iterations")

    return run


METHODS: dict[str, Method] = {
    "product": Method(
        "product S'S alone",
        "numpy S.T @ S; S is made before the clock starts, but its memory counts",
        prepare_product,
    ),
    "ours": Method(
        "ours: moments + OSQP, certified",
        "Problem: moments, Stage 2, solve_box_qp (OSQP, then pivoting; KKT residuals and gap"
        " <= 1e-6), model with its offsets",
        prepare_ours,
    ),
    "pivoting": Method(
        "the same, pivoting from zero alone",
        "as ours, without OSQP",
        partial(prepare_ours, without_solver=True),
    ),
    "qpsolvers": Method(
        "qpsolvers + OSQP, A'A of dense rows",
        "rows + A'A + solve; columns of norm 1; eps_abs 1e-9, eps_rel 0, polish, 200000 iterations",
        prepare_qpsolvers,
    ),
    "lsq_linear": Method(
        "scipy lsq_linear (trf), dense rows",
        f"rows + solve; columns of norm 1; tol {_LSQ_TOLERANCE:.0e}, 300 iterations",
        prepare_lsq_linear,
    ),
    "cvxpy_scaled": Method(
        "CVXPY + OSQP, sparse rows, scaled",
        "rows + compile + solve; columns of norm 1; eps_abs 1e-9, eps_rel 0, polish,"
        " 200000 iterations",
        prepare_cvxpy_scaled,
        "cvxpy",
    ),
    "cvxpy_plain": Method(
        "CVXPY + OSQP, sparse rows, defaults",
        "rows + compile + solve; kN/m, N, N m; CVXPY's own settings (eps 1e-5, 10000 iterations)",
        prepare_cvxpy_plain,
        "cvxpy",
    ),
}
