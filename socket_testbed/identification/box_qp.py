r"""Quadratic programs with bounds, their solution and its certificate.

.. math:: \min_x \tfrac12 x^T P x + q^T x \quad \text{s.t.} \quad l \le x \le u

Pivoting moves from zero, or from the solution of a similar program, to the exact optimum. Where
it does not reach one that is the only one, a solver (OSQP through qpsolvers, unless another one is
named) gives it a start. The certificate, computed from the definition of an optimum, decides
whether the answer is accepted.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import qpsolvers
from scipy.sparse import csc_matrix

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import IdentificationError
from socket_testbed.settings.identification import check_solver

_ROWS = 32  # of a factor at a time; fewer cost calls, more cost arithmetic


# OSQP gives a start, from which pivoting takes over. Its own rule for adapting rho may come from
# a timer, and the same trial is to give the same answer.
_OPTIONS: dict[str, dict[str, Any]] = {
    "osqp": {
        "eps_abs": 1e-5,
        "eps_rel": 0.0,
        "max_iter": 25,
        "polishing": False,
        "adaptive_rho": False,
    }
}
_EXCHANGES = 300
_PATIENCE = 5  # block exchanges that may fail to help before single ones
_RIDGES = 10.0 ** -np.arange(2.0, 14.0)  # [-]; of regularised pivoting, one after the other
_ROUNDING = 1e-11  # [-]; of a value that counts as zero
_REFINED = 1e-13  # [-]; gradient that a factor's solution is left with
_FLAT = 1e-12  # [-]; curvature that counts as none, against the mean of a scaled problem


@dataclass(frozen=True)
class Certificate:
    """How well a point solves a box QP, all in the problem's scaled units [-].

    Attributes:
        primal: Largest violation of a bound.
        stationarity: Largest component of ``x - clip(x - (P x + q))``, the natural residual:
            zero if and only if the point is optimal.
        gap: Duality gap against ``1 + |objective|``.
    """

    primal: float
    stationarity: float
    gap: float

    @property
    def worst(self) -> float:
        """The largest of the three."""
        return float(np.max([self.primal, self.stationarity, self.gap]))  # NaN is the worst


@dataclass(frozen=True)
class BoxQP:
    """A strictly scaled quadratic program with bounds.

    Attributes:
        P: Symmetric positive semidefinite matrix, shape (p, p) [-].
        q: Linear term, shape (p,) [-].
        lower: Lower bounds, shape (p,) [-].
        upper: Upper bounds, shape (p,) [-]; infinite where there is none.
        name: What is solved, for errors.
    """

    P: FloatArray
    q: FloatArray
    lower: FloatArray
    upper: FloatArray
    name: str

    def objective(self, x: FloatArray) -> float:
        """Value of the objective at x [-]."""
        return float(0.5 * x @ self.P @ x + self.q @ x)

    def certificate(self, x: FloatArray) -> Certificate:
        """Karush-Kuhn-Tucker residuals and duality gap at x.

        The multipliers of the bounds are taken from the gradient g: the dual objective is
        ``-1/2 x'Px + sum(max(g, 0) l + min(g, 0) u)`` (Boyd & Vandenberghe, Convex
        Optimization, 5.5).
        """
        gradient = self.P @ x + self.q
        natural = x - np.clip(x - gradient, self.lower, self.upper)
        violation = np.maximum(self.lower - x, x - self.upper)
        towards = np.where(gradient > 0.0, self.lower, self.upper)
        # A gradient towards an open side is no multiplier: it counts by the step it leaves.
        bounded = np.isfinite(towards)
        gap = np.abs(gradient[bounded] * (x - towards)[bounded]).sum()
        gap += np.abs(gradient[~bounded] * x[~bounded]).sum()
        return Certificate(
            primal=float(violation.max(initial=0.0)),
            stationarity=float(np.abs(natural).max(initial=0.0)),
            gap=float(gap / (1.0 + abs(0.5 * x @ (gradient + self.q)))),
        )

    def is_determined_at(self, x: FloatArray) -> bool:
        """Whether the optimum x is the only one: P is definite over what is off its bounds."""
        free = np.flatnonzero((x > self.lower) & (x < self.upper))
        return is_definite(self.P[free][:, free], _FLAT)

    def to_qpsolvers(self, sparse: bool) -> qpsolvers.Problem:
        """The same problem for qpsolvers."""
        matrix = csc_matrix(self.P) if sparse else self.P
        return qpsolvers.Problem(matrix, self.q, lb=self.lower, ub=self.upper)


@dataclass(frozen=True)
class BoxSolution:
    """A solution of a box QP with its certificate.

    Attributes:
        x: The solution, shape (p,) [-].
        certificate: Its residuals.
        determined: Whether no other point is optimal.
        found_by: `pivoting` from zero, `warm start`, or the solver that gave the start.
    """

    x: FloatArray
    certificate: Certificate
    determined: bool
    found_by: str

    @property
    def status(self) -> str:
        """The solver's name with the certificate, in words."""
        kkt, gap = self.certificate.stationarity, self.certificate.gap
        return f"{self.found_by}: KKT {kkt:.1e}, gap {gap:.1e}"


class UncertifiedSolutionError(IdentificationError):
    """A solver's answer misses the KKT tolerance.

    Attributes:
        problem: The problem, to be solved again by other means.
        x: The solver's answer, or None.
    """

    def __init__(self, fact: str, hint: str, problem: BoxQP, x: FloatArray | None) -> None:
        super().__init__(fact, hint)
        self.problem = problem
        self.x = x


def solve_box_qp(
    problem: BoxQP,
    solver: str,
    tolerance: float,
    near: FloatArray | None = None,
    least_curvature: float = 0.0,
) -> BoxSolution:
    """Solve a box QP and certify the answer; a solver's own verdict does not count.

    Args:
        problem: The problem, in scaled units.
        solver: Any solver that qpsolvers finds.
        tolerance: Largest residual of the certificate [-].
        near: Solution of a similar problem, shape (p,) [-], from which pivoting takes fewer steps
            than from zero.
        least_curvature: What the eigenvalues of P are known to exceed [-]: where they leave one
            optimum, and it is the one near, nothing is factorised.

    Raises:
        ConfigurationError: If there is no such solver.
        UncertifiedSolutionError: If the answer misses the tolerance; it carries the problem.
    """
    check_solver(solver)
    _check_finite(problem)

    if near is not None:
        if least_curvature > _FLAT:
            certificate = problem.certificate(near)
            if certificate.worst <= min(_REFINED, tolerance):
                return BoxSolution(near, certificate, True, "warm start")
        found = pivot(problem, np.clip(near, problem.lower, problem.upper))
        if found.certificate.worst <= tolerance:
            return replace(found, found_by="warm start")
    found = pivot(problem, np.clip(np.zeros_like(problem.q), problem.lower, problem.upper))
    if found.certificate.worst <= min(_ROUNDING, tolerance) and found.determined:
        return found

    start = _call_solver(problem, solver)
    found = pivot_regularised(problem, np.clip(start, problem.lower, problem.upper))

    if not found.certificate.worst <= tolerance:
        raise UncertifiedSolutionError(
            f"{problem.name}: the answer of {solver} misses the KKT tolerance"
            f" ({found.certificate.worst:.1e} > {tolerance:.0e})",
            "try more smoothness, another solver or a longer segment",
            problem,
            found.x,
        )
    return replace(found, found_by=solver)


def _check_finite(problem: BoxQP) -> None:
    if not (np.isfinite(problem.P).all() and np.isfinite(problem.q).all()):
        raise UncertifiedSolutionError(
            f"{problem.name}: holds values that are not finite", "check the samples", problem, None
        )


def _call_solver(problem: BoxQP, solver: str) -> FloatArray:
    """The answer of a solver, certified or not."""
    try:
        with warnings.catch_warnings():
            # The certificate judges the answer: the solver's warnings say nothing new.
            warnings.simplefilter("ignore")
            answer = qpsolvers.solve_problem(
                problem.to_qpsolvers(sparse=solver not in qpsolvers.dense_solvers),
                solver,
                **_OPTIONS.get(solver, {}),
            )
    except Exception as error:  # each backend has errors of its own
        raise UncertifiedSolutionError(
            f"{problem.name}: {solver} failed ({error})", "try another solver", problem, None
        ) from error
    if answer.x is None or not np.isfinite(answer.x).all():
        raise UncertifiedSolutionError(
            f"{problem.name}: {solver} gave no answer", "try another solver", problem, None
        )
    x: FloatArray = answer.x
    return x


def pivot_regularised(problem: BoxQP, start: FloatArray) -> BoxSolution:
    r"""Pivot; where P is singular, or nearly so, with a ridge that falls tenfold each time.

    Each regularised program adds :math:`\tfrac12 \rho |x - x'|^2` with x' the optimum of the
    one before (the proximal point method: Rockafellar 1976, doi:10.1137/0314056), which makes
    P definite; its active set is near that of the next. Once the active set is the problem's
    own and leaves P definite over the free variables, pivoting is exact; otherwise the ridge
    vanishes. The first x' is the point of the box nearest to zero: of all optima one near zero
    is found.
    """
    best = pivot(problem, start)
    x, centre = best.x, np.clip(np.zeros_like(start), problem.lower, problem.upper)
    for ridge in _RIDGES:
        if best.certificate.worst <= _ROUNDING:
            break
        P = problem.P + ridge * np.eye(len(x))
        x = centre = pivot(replace(problem, P=P, q=problem.q - ridge * centre), x).x
        found = pivot(problem, x)
        if found.certificate.worst < best.certificate.worst:
            best = found
    return best


def pivot(problem: BoxQP, start: FloatArray) -> BoxSolution:
    """Move a point inside the box to the exact optimum near it, by its active set.

    Block principal pivoting (Judice & Pires 1994, doi:10.1016/0305-0548(94)90106-6): all
    variables on the wrong side change sides at once, or, when that stops helping, one at a
    time, which cannot cycle. From a solver's answer a few steps reach the optimum to
    rounding. It needs P to be definite over the free variables.

    Returns:
        The point with the smallest residuals on the way, at worst the start.
    """
    x, certificate = start, problem.certificate(start)
    trial = start - (problem.P @ start + problem.q)
    side = np.where(trial <= problem.lower, -1, np.where(trial >= problem.upper, 1, 0))
    fewest, patience, least = len(x) + 1, _PATIENCE, 0.0
    for _ in range(_EXCHANGES):
        try:
            candidate, gradient, least = _solve_on_sides(problem, side)
        except np.linalg.LinAlgError:
            least = 0.0
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
    else:
        least = 0.0
    determined = least > _FLAT or problem.is_determined_at(x)
    return BoxSolution(x, certificate, determined, "pivoting")


def _solve_on_sides(problem: BoxQP, side: IntArray) -> tuple[FloatArray, FloatArray, float]:
    """Optimum over the free variables with the others at bounds, gradient, least pivot."""
    x = np.where(side < 0, problem.lower, np.where(side > 0, problem.upper, 0.0))
    free = np.flatnonzero(side == 0)
    rest = (problem.q + problem.P @ x if x.any() else problem.q)[free]
    factor = Cholesky(problem.P if len(free) == len(x) else problem.P[free][:, free])
    x[free] = -factor.solve(rest)
    gradient = problem.P @ x + problem.q
    if np.abs(gradient[free]).max(initial=0.0) > _REFINED:  # of an ill-conditioned matrix
        x[free] -= factor.solve(gradient[free])
        gradient = problem.P @ x + problem.q
    return x, gradient, factor.least_pivot


def _wrong_side(problem: BoxQP, side: IntArray, x: FloatArray, gradient: FloatArray) -> IntArray:
    """The side each variable belongs on: -1 lower bound, 0 free, 1 upper bound."""
    change = side.copy()
    change[(side == 0) & (x < problem.lower - _ROUNDING)] = -1
    change[(side == 0) & (x > problem.upper + _ROUNDING)] = 1
    change[(side < 0) & (gradient < -_ROUNDING)] = 0
    change[(side > 0) & (gradient > _ROUNDING)] = 0
    return change


class Cholesky:
    """Factor L of a symmetric positive definite matrix, ``L L' = A``, by blocks.

    numpy has no triangular solve, and its own factor takes longer than this one and two
    substitutions. scipy's are faster, but bring a thread pool of their own: where both have one,
    the two stall each other.

    Args:
        matrix: The matrix A, shape (p, p).

    Attributes:
        least_pivot: Least pivot, which is the least squared diagonal element of L; infinite where
            p is 0.

    Raises:
        LinAlgError: Unless the matrix is positive definite.
    """

    def __init__(self, matrix: FloatArray) -> None:
        self._below = np.empty_like(matrix)  # what L has below its diagonal blocks
        self._blocks: list[tuple[slice, FloatArray]] = []  # diagonal blocks' rows and inverses
        pivots = np.empty(len(matrix))
        for start in range(0, len(matrix), _ROWS):
            rows = slice(start, min(start + _ROWS, len(matrix)))
            known = self._below[:, :start]
            left = matrix[start:, rows] - known[start:] @ known[rows].T
            diagonal = np.linalg.cholesky(left[:_ROWS])
            pivots[rows] = diagonal.diagonal()
            inverse = np.linalg.inv(diagonal)
            self._below[rows.stop :, rows] = left[_ROWS:] @ inverse.T
            self._blocks.append((rows, inverse))
        self.least_pivot = float(pivots.min(initial=np.inf)) ** 2

    def solve(self, target: FloatArray) -> FloatArray:
        """Solve ``A x = b`` for b, shape (p,)."""
        x = target.copy()
        for rows, inverse in self._blocks:
            x[rows] = inverse @ (x[rows] - self._below[rows, : rows.start] @ x[: rows.start])
        for rows, inverse in reversed(self._blocks):
            x[rows] = (x[rows] - x[rows.stop :] @ self._below[rows.stop :, rows]) @ inverse
        return x


def is_definite(matrix: FloatArray, least: float) -> bool:
    """Whether a symmetric matrix, shape (p, p), is positive definite with pivots above `least`."""
    try:
        return Cholesky(matrix).least_pivot > least
    except np.linalg.LinAlgError:
        return False
