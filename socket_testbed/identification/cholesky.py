"""Systems with a Cholesky factor, by numpy alone.

numpy has no triangular solve, and scipy's brings a thread pool of its own: where both have
one, the two stall each other.
"""

from __future__ import annotations

import numpy as np

from socket_testbed.arrays import FloatArray

_ROWS = 48  # at a time; fewer cost calls, more cost arithmetic


def factorise(matrix: FloatArray) -> FloatArray:
    """Cholesky factor L of a symmetric matrix, shape (p, p).

    Raises:
        LinAlgError: Unless the matrix is positive definite.
    """
    return np.linalg.cholesky(matrix).astype(np.float64, copy=False)


def solve_factored(factor: FloatArray, target: FloatArray) -> FloatArray:
    """Solve ``L L' x = b`` by substitution.

    Args:
        factor: Lower triangular L, shape (p, p).
        target: Right-hand side b, shape (p,).
    """
    x = target.copy()
    blocks = [slice(start, start + _ROWS) for start in range(0, len(x), _ROWS)]
    for rows in blocks:
        known = factor[rows, : rows.start] @ x[: rows.start]
        x[rows] = np.linalg.solve(factor[rows, rows], x[rows] - known)
    for rows in reversed(blocks):
        known = x[rows.stop :] @ factor[rows.stop :, rows]
        x[rows] = np.linalg.solve(factor[rows, rows].T, x[rows] - known)
    return x


def least_pivot(factor: FloatArray) -> float:
    """Least pivot of a Cholesky factor, shape (p, p); infinite without any."""
    return float(np.diagonal(factor).min(initial=np.inf) ** 2)


def is_definite(matrix: FloatArray, least: float) -> bool:
    """Whether a symmetric matrix, shape (p, p), is positive definite with pivots above `least`."""
    try:
        return least_pivot(factorise(matrix)) > least
    except np.linalg.LinAlgError:
        return False
