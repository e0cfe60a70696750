"""Readings of a bench that no calibration should follow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.calibration.bench_data import BenchData, scaled_stress
from socket_testbed.calibration.model import channel_features, shear_terms

_SCALES = 5.0  # residuals beyond as many scaled median absolute deviations
_MAD = 1.4826  # [-] makes the median absolute deviation of normal noise its standard deviation
_LEAST = 0.05  # [-] of the full scale; a smaller residual does no harm
_LOADED = 0.1  # [-] of the full scale; many rows at rest would make any load an outlier
_KEPT = 0.9  # [-] of the rows that the robust fit looks at
_STARTS, _START_ROWS, _FINALISTS, _STEPS, _MOST_ROWS = 30, 24, 4, 20, 3000


@dataclass(frozen=True)
class Outlier:
    """A reading far from the robust fit.

    Attributes:
        row: Row of the bench data.
        place: Its file and line.
        axis: The stress that is farthest off, in scaled deviations: 0, 1 or 2.
        known: Its known value [Pa].
        fitted: What the robust fit makes of the capacitances [Pa].
    """

    row: int
    place: str
    axis: int
    known: float
    fitted: float


def find_outliers(bench: BenchData, wiring: IntArray) -> tuple[Outlier, ...]:
    """Find readings whose residual exceeds five scaled median absolute deviations.

    The residuals are those of a polynomial of total degree 2 in the mean and the differences,
    by least trimmed squares over 90 % of the rows (Rousseeuw and Van Driessen 2006,
    doi:10.1007/s10618-005-0024-4), which neither a wrong stress nor a wrong capacitance can
    pull to itself. The deviation is taken over the loaded rows, and residuals below 5 % of the
    full scale never count.

    Args:
        bench: The bench data.
        wiring: Input that holds each channel, shape (4,).
    """
    basis = _rich_basis(bench.capacitance[:, wiring])
    fits = [fit_least_trimmed(basis, known) for known in bench.stress.T]
    fitted = basis @ np.column_stack(fits)
    residual = np.abs(fitted - bench.stress)
    excess = residual / _limits(residual, bench.stress)
    farthest = excess.argmax(axis=1)
    return tuple(
        Outlier(row, bench.place(row), axis, float(bench.stress[row, axis]), fitted[row, axis])
        for row in np.flatnonzero((excess > 1.0).any(axis=1)).tolist()
        for axis in (int(farthest[row]),)
    )


def _rich_basis(capacitance: FloatArray) -> FloatArray:
    """Orthonormal basis of all terms up to total degree 2 of mean and differences, (N, 10).

    What a calibration's polynomials miss, such as a normal stress that makes a difference, is no
    reason to call a reading an outlier.
    """
    mean, along_x, along_y = channel_features(capacitance)
    of_differences = shear_terms(along_x, along_y)
    terms = np.column_stack([of_differences, mean[:, None] * of_differences[:, :3], mean**2])
    return np.linalg.qr(terms / np.abs(terms).max(axis=0))[0]


def _limits(residual: FloatArray, stress: FloatArray) -> FloatArray:
    """Largest residual of a sound reading, shape (3,) [Pa]."""
    loaded = (np.abs(scaled_stress(stress)) > _LOADED).any(axis=1)
    limits = _SCALES * _MAD * np.median(residual[loaded], axis=0)
    # Again without those found, because a wrong stress makes a wrong full scale.
    for _ in range(2):
        sound = (residual <= np.maximum(limits, _LEAST * np.abs(stress).max(axis=0))).all(axis=1)
        stress, residual = stress[sound], residual[sound]
    return np.maximum(limits, _LEAST * np.abs(stress).max(axis=0))


def fit_least_trimmed(basis: FloatArray, target: FloatArray) -> FloatArray:
    """Coefficients with the least sum of the smallest 90 % of the squared residuals.

    Random starts, concentrated twice on the rows they fit best, and the best of them until
    nothing changes; always with the same seed.

    Args:
        basis: Design matrix with orthonormal columns, shape (N, p).
        target: Values to explain, shape (N,).

    Returns:
        Coefficients, shape (p,).
    """
    rng = np.random.default_rng(0)
    if len(target) > _MOST_ROWS:
        some = rng.choice(len(target), _MOST_ROWS, replace=False)
        basis, target = basis[some], target[some]
    size = min(_START_ROWS, len(target))
    starts = [np.arange(len(target))]
    starts += [rng.choice(len(target), size, replace=False) for _ in range(_STARTS)]
    tried = [_concentrate(basis, target, rows, steps=2) for rows in starts]
    tried.sort(key=lambda fit: fit.objective)
    ended = [_concentrate(basis, target, fit.rows, _STEPS) for fit in tried[:_FINALISTS]]
    return min(ended, key=lambda fit: fit.objective).coefficients


class _TrimmedFit(NamedTuple):
    objective: float
    rows: IntArray
    coefficients: FloatArray


def _concentrate(basis: FloatArray, target: FloatArray, rows: IntArray, steps: int) -> _TrimmedFit:
    """Fit some rows, take those that are fitted best, and again; it never gets worse."""
    kept = int(np.ceil(_KEPT * len(target)))
    fit = _TrimmedFit(np.inf, rows, np.zeros(basis.shape[1]))
    for _ in range(steps):
        part = basis[fit.rows]
        solution = np.linalg.lstsq(part.T @ part, part.T @ target[fit.rows], rcond=None)[0]
        squares = (basis @ solution - target) ** 2
        best = np.argpartition(squares, kept - 1)[:kept]
        objective = float(squares[best].sum())
        if objective >= fit.objective:
            break
        fit = _TrimmedFit(objective, best, np.asarray(solution, dtype=np.float64))
    return fit
