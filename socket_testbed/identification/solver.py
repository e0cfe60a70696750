r"""The solver of a fit: OSQP, polished to the exact optimum and certified.

Both stages and every step of a refinement are quadratic programs with bounds:

.. math:: \min_x \tfrac12 x^T P x + q^T x \quad \text{s.t.} \quad l \le x \le u

A program without a warm start is first solved by OSQP through qpsolvers, or another solver by name.
Pivoting moves this answer, or the warm start, to the exact optimum. The certificate, computed from
the optimality conditions, decides whether the result is accepted.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csc_matrix

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import IdentificationError
from socket_testbed.settings.identification import check_solver

# OSQP's answer need only be near the optimum: pivoting makes it exact, so OSQP's own polishing is
# off. Other solvers keep their defaults.
OSQP_SETTINGS: dict[str, Any] = {
    "eps_abs": 1e-6,  # [-]; largest residual, in scaled units
    "eps_rel": 0.0,
    "max_iter": 4000,
    "polishing": False,
    # A fixed interval of iterations is reproducible; by default OSQP adapts rho after a measured
    # time.
    "adaptive_rho": True,
    "adaptive_rho_interval": 25,
}
WARM_START = "warm start"  # in place of a solver's name if none was called
_MAX_EXCHANGES = 300
_PATIENCE = 5  # block exchanges without progress before single ones
_RIDGES = 10.0 ** -np.arange(2.0, 14.0)  # [-]; successive ridges of regularised pivoting
_ROUNDING = 1e-11  # [-]; smaller values count as zero
_MAX_GRADIENT = 1e-13  # [-]; larger ones call for iterative refinement
_MIN_CURVATURE = 1e-12  # [-]; relative to the mean of a scaled problem


@dataclass(frozen=True)
class Certificate:
    """How well a point solves a box QP, in the problem's scaled units [-].

    Attributes:
        primal: Largest violation of a bound, 0 if there is none [-].
        stationarity: Largest component of ``x - clip(x - (P x + q))``, the natural residual [-]:
            zero if and only if the point is optimal.
        gap: Duality gap over ``1 + |objective|`` [-].
    """

    primal: float
    stationarity: float
    gap: float

    @property
    def worst(self) -> float:
        """The largest of the three [-]; NaN if one is NaN."""
        return float(np.max([self.primal, self.stationarity, self.gap]))  # NaN is the worst


@dataclass(frozen=True)
class BoxQP:
    """A strictly scaled quadratic program with bounds: see the module for its equation.

    Attributes:
        P: Symmetric positive semidefinite matrix, shape (p, p) [-].
        q: Linear term, shape (p,) [-].
        lower: Lower bounds, shape (p,) [-]; minus infinity for none.
        upper: Upper bounds, shape (p,) [-]; infinity for none.
        name: What the program solves for, such as `Stage 2 (stiffnesses)`; errors begin with it.
    """

    P: FloatArray
    q: FloatArray
    lower: FloatArray
    upper: FloatArray
    name: str

    def certificate(self, x: FloatArray) -> Certificate:
        """Karush-Kuhn-Tucker residuals and duality gap at x, shape (p,) [-].

        The multipliers of the bounds are taken from the gradient g: the dual objective is
        ``-1/2 x'Px + sum(max(g, 0) l + min(g, 0) u)`` (Boyd & Vandenberghe, Convex
        Optimization, 5.5).
        """
        gradient = self.P @ x + self.q
        natural = x - np.clip(x - gradient, self.lower, self.upper)
        violation = np.maximum(self.lower - x, x - self.upper)
        towards = np.where(gradient > 0.0, self.lower, self.upper)
        # A gradient towards an infinite bound is not a multiplier: it counts times x.
        bounded = np.isfinite(towards)
        gap = np.abs(gradient[bounded] * (x - towards)[bounded]).sum()
        gap += np.abs(gradient[~bounded] * x[~bounded]).sum()
        return Certificate(
            primal=float(violation.max(initial=0.0)),
            stationarity=float(np.abs(natural).max(initial=0.0)),
            gap=float(gap / (1.0 + abs(0.5 * x @ (gradient + self.q)))),
        )


@dataclass(frozen=True)
class BoxSolution:
    """A solution of a box QP with its certificate.

    Attributes:
        x: The solution, shape (p,) [-].
        certificate: Its residuals.
        determined: Whether the optimum is unique; only `solve_box_qp` determines it, otherwise it
            is True.
        solver: Name of the solver that was called, and whether it gave no answer; `WARM_START` if
            none was called.
        iterations: Number of iterations of the solver; None if it was not called or does not
            report them.
        exchanges: Number of exchanges of the active set while pivoting.
        course: Number of steps of a joint refinement, in words; empty for a single program.
    """

    x: FloatArray
    certificate: Certificate
    determined: bool = True
    solver: str = WARM_START
    iterations: int | None = None
    exchanges: int = 0
    course: str = ""

    @property
    def status(self) -> str:
        """How the solution was found, with its certificate, in words."""
        course = f"{self.course}, " if self.course else ""
        iterations = "" if self.iterations is None else f" {self.iterations} iterations"
        found_by = f"{course}{self.solver}{iterations}, pivoting {self.exchanges} exchanges"
        kkt, gap = self.certificate.stationarity, self.certificate.gap
        return f"{found_by}: KKT {kkt:.1e}, gap {gap:.1e}"


class UncertifiedSolutionError(IdentificationError):
    """A solver's answer exceeds the KKT tolerance, or there is no answer.

    Attributes:
        residual: Largest residual of the answer's certificate [-]; NaN without an answer.
    """

    def __init__(self, fact: str, hint: str, residual: float = math.nan) -> None:
        super().__init__(fact, hint)
        self.residual = residual


def solve_box_qp(
    problem: BoxQP, solver: str, tolerance: float, near: FloatArray | None = None
) -> BoxSolution:
    """Solve a box QP and certify the answer, regardless of the solver's own status.

    Args:
        problem: The program, in p variables.
        solver: Name of the solver, any that qpsolvers finds.
        tolerance: Largest accepted residual of the certificate [-].
        near: Solution of a similar program, shape (p,) [-]. Pivoting starts from its active set,
            and the solver is called only if that fails. None to call the solver at once.

    Raises:
        UncertifiedSolutionError: If the program has values that are not finite, or the solver gives
            no answer within the tolerance.
    """
    check_solver(solver)
    if not (np.isfinite(problem.P).all() and np.isfinite(problem.q).all()):
        raise UncertifiedSolutionError(
            f"{problem.name}: holds values that are not finite", "check the samples"
        )
    found = None
    if near is not None:
        found = pivot(problem, np.clip(near, problem.lower, problem.upper))
    if found is None or not found.certificate.worst <= tolerance:
        found = solve_cold(problem, solver)
    worst = found.certificate.worst
    if not worst <= tolerance:
        raise UncertifiedSolutionError(
            f"{problem.name}: the answer of {found.solver} misses the KKT tolerance"
            f" ({worst:.1e} > {tolerance:.0e})",
            "try more smoothness, another solver or a longer segment",
            worst,
        )
    # The optimum is unique if P is definite over the free variables.
    free = np.flatnonzero((found.x > problem.lower) & (found.x < problem.upper))
    return replace(found, determined=is_definite(problem.P[np.ix_(free, free)], _MIN_CURVATURE))


def solve_cold(problem: BoxQP, solver: str) -> BoxSolution:
    """Solve a box QP without a warm start: the solver, then pivoting from its answer.

    Where the solver has no finite answer, pivoting starts from the point nearest to zero. The
    certificate of the solution is for the caller to judge.

    Args:
        problem: The program.
        solver: Name of the solver, any that qpsolvers finds.

    Raises:
        UncertifiedSolutionError: If the solver fails.
    """
    import qpsolvers  # it imports every solver

    P = problem.P if solver in qpsolvers.dense_solvers else csc_matrix(problem.P)
    program = qpsolvers.Problem(P, problem.q, lb=problem.lower, ub=problem.upper)
    try:
        with warnings.catch_warnings():
            # The certificate makes the solver's warnings redundant.
            warnings.simplefilter("ignore")
            options = OSQP_SETTINGS if solver == "osqp" else {}
            answer = qpsolvers.solve_problem(program, solver, **options)
    except Exception as error:  # each backend has errors of its own
        raise UncertifiedSolutionError(
            f"{problem.name}: {solver} failed ({error})", "try another solver"
        ) from error
    start, name = answer.x, solver
    if start is None or not np.isfinite(start).all():
        start, name = np.zeros_like(problem.q), f"{solver} without an answer"
    found = pivot_regularised(problem, np.clip(start, problem.lower, problem.upper))
    iterations = getattr(answer.extras.get("info"), "iter", None)
    return replace(found, solver=name, iterations=None if iterations is None else int(iterations))


def pivot_regularised(problem: BoxQP, start: FloatArray) -> BoxSolution:
    r"""Pivot; if P is singular, or nearly so, with a ridge that falls tenfold each time.

    Each regularised program adds :math:`\tfrac12 \rho |x - x'|^2` with x' the previous optimum
    (the proximal point method: Rockafellar 1976, doi:10.1137/0314056), which makes P definite;
    its active set is near that of the next. Pivoting becomes exact once the active set is that of
    the original problem and leaves P definite over the free variables; otherwise the ridge
    vanishes. The first x' is the point of the box nearest to zero, so that a small optimum is
    found if there are many.

    Args:
        problem: The program, in p variables.
        start: A point inside the bounds, shape (p,) [-].
    """
    best = pivot(problem, start)
    x, centre = best.x, np.clip(np.zeros_like(start), problem.lower, problem.upper)
    exchanges = best.exchanges
    for ridge in _RIDGES:
        if best.certificate.worst <= _ROUNDING:
            break
        P = problem.P + ridge * np.eye(len(x))
        near = pivot(replace(problem, P=P, q=problem.q - ridge * centre), x)
        x = centre = near.x
        found = pivot(problem, x)
        exchanges += near.exchanges + found.exchanges
        if found.certificate.worst < best.certificate.worst:
            best = found
    return replace(best, exchanges=exchanges)


def pivot(problem: BoxQP, start: FloatArray) -> BoxSolution:
    """Move a point inside the box to the exact optimum near it, by its active set.

    Block principal pivoting (Judice & Pires 1994, doi:10.1016/0305-0548(94)90106-6): all
    variables on the wrong side change sides at once, or, without further progress, one at a time,
    which cannot cycle. From a solver's answer a few steps reach the optimum to rounding. P must be
    definite over the free variables. The result is the visited point with the smallest residuals,
    at worst the start.

    Args:
        problem: The program, in p variables.
        start: A point inside the bounds, shape (p,) [-].
    """
    x, certificate = start, problem.certificate(start)
    trial = start - (problem.P @ start + problem.q)
    side = np.where(trial <= problem.lower, -1, np.where(trial >= problem.upper, 1, 0))
    fewest, patience = len(x) + 1, _PATIENCE
    exchanges = 0
    while exchanges < _MAX_EXCHANGES:
        try:
            candidate, gradient = _solve_on_sides(problem, side)
        except np.linalg.LinAlgError:
            break
        inside = np.clip(candidate, problem.lower, problem.upper)
        residuals = problem.certificate(inside)
        if residuals.worst < certificate.worst:
            x, certificate = inside, residuals
        change = _wrong_side(problem, side, candidate, gradient)
        wrong = np.flatnonzero(change != side)
        if len(wrong) == 0:
            break
        if len(wrong) < fewest:
            fewest, patience = len(wrong), _PATIENCE
        elif patience > 0:
            patience -= 1
        else:
            wrong = wrong[-1:]
        side[wrong] = change[wrong]
        exchanges += 1
    return BoxSolution(x, certificate, exchanges=exchanges)


def _solve_on_sides(problem: BoxQP, side: IntArray) -> tuple[FloatArray, FloatArray]:
    """Optimum over the free variables with the others at their bounds, and its gradient, (p,) each.

    The sides of the variables are as in `_wrong_side`, shape (p,).
    """
    x = np.where(side < 0, problem.lower, np.where(side > 0, problem.upper, 0.0))
    free = np.flatnonzero(side == 0)
    if len(free) == 0:
        return x, problem.P @ x + problem.q
    rest = (problem.q + problem.P @ x if x.any() else problem.q)[free]
    factor = cho_factor(problem.P[np.ix_(free, free)], lower=True, check_finite=False)
    x[free] = -cho_solve(factor, rest, check_finite=False)
    gradient = problem.P @ x + problem.q
    if np.abs(gradient[free]).max() > _MAX_GRADIENT:  # ill-conditioned
        x[free] -= cho_solve(factor, gradient[free], check_finite=False)
        gradient = problem.P @ x + problem.q
    return x, gradient


def _wrong_side(problem: BoxQP, side: IntArray, x: FloatArray, gradient: FloatArray) -> IntArray:
    """The side each variable belongs on, shape (p,): -1 lower bound, 0 free, 1 upper bound."""
    beyond = np.where(x < problem.lower - _ROUNDING, -1, x > problem.upper + _ROUNDING)
    return np.where(side == 0, beyond, np.where(side * gradient > _ROUNDING, 0, side))


def is_definite(matrix: FloatArray, min_pivot: float) -> bool:
    """Whether a symmetric matrix is definite with all pivots above a limit.

    Args:
        matrix: The matrix, shape (p, p); only its lower triangle is read.
        min_pivot: The limit of the squared diagonal of its Cholesky factor, in the matrix's unit.
    """
    try:
        factor = np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return float(factor.diagonal().min(initial=np.inf)) ** 2 > min_pivot
