r"""How much the residuals of successive samples have in common, and what they are worth.

The decorrelation time of a series sampled every :math:`\Delta t` is

.. math:: \tau = \Delta t \Bigl(1 + 2 \sum_{k=1}^{M} \rho_k\Bigr)

with rho_k the autocorrelation at lag k, and M the smallest lag that is `_WINDOW` times the
sum (Sokal, Monte Carlo Methods in Statistical Mechanics, 1997, section 3). The mean of N
samples is as uncertain as that of N Delta t / tau independent ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from socket_testbed.arrays import FloatArray
from socket_testbed.report.gaps import usual_period

_WINDOW = 5.0  # [-]; of the decorrelation time: Sokal's choice
_PADDING = 4  # [-]; of the samples: all that the gaps between them may add
_LEAST_SAMPLES = 8
_ROUNDING = 1e-24  # [-]; mean square of residuals that are constant, against their size


@dataclass(frozen=True)
class Autocorrelation:
    """What the residuals of one channel have in common.

    Attributes:
        samples: Number of residuals.
        lag_one: Autocorrelation of successive samples [-].
        decorrelation: Time tau after which a sample counts as a new one [s].
        effective: Number of independent samples that they are worth [1], at most `samples`.
    """

    samples: int
    lag_one: float
    decorrelation: float
    effective: float


def autocorrelation(time: FloatArray, residual: FloatArray) -> Autocorrelation:
    """Autocorrelation of the residuals of a channel; NaN where they are too few or constant.

    Args:
        time: Times, rising, shape (N,) [s].
        residual: Residuals in any unit, shape (N,); NaN where there is none.
    """
    finite = np.isfinite(residual)
    count = int(finite.sum())
    unknown = Autocorrelation(count, *([float("nan")] * 3))
    if count < _LEAST_SAMPLES:
        return unknown
    centred = np.where(finite, residual - residual[finite].mean(), 0.0)
    if (centred @ centred) / count <= _ROUNDING * float(np.abs(residual[finite]).max()) ** 2:
        return unknown
    period = usual_period(time)
    rho = _correlations(_on_grid(time, period, centred), _on_grid(time, period, 1.0 * finite))
    worth = _integrate(rho)
    effective = min(count / worth, float(count))
    return Autocorrelation(count, float(rho[1]), period * worth, effective)


def _on_grid(time: FloatArray, period: float, values: FloatArray) -> FloatArray:
    """Values in places that are a period apart, zero in the gaps; long gaps are shortened."""
    steps = np.round(np.diff(time) / period)
    gaps = max(1, int((steps > 1.0).sum()))
    steps = np.clip(steps, 1.0, 1 + _PADDING * len(time) // gaps)
    place = np.concatenate([[0], np.cumsum(steps)]).astype(np.int64)
    grid = np.zeros(place[-1] + 1)
    grid[place] = values
    return grid


def _correlations(values: FloatArray, present: FloatArray) -> FloatArray:
    """Autocorrelation at every lag: the mean over the pairs that were measured."""
    pairs = np.round(_products(present))
    covariance = _products(values) / np.maximum(pairs, 1.0)
    return np.where(pairs > 0.0, covariance / covariance[0], 0.0)


def _products(values: FloatArray) -> FloatArray:
    """Sums of the products of values k places apart, for every k."""
    length = next_fast_len(2 * len(values), real=True)
    power = np.abs(rfft(values, length)) ** 2
    return np.asarray(irfft(power, length)[: len(values)])


def _integrate(rho: FloatArray) -> float:
    """The sum of the autocorrelations on both sides, over a window that fits itself."""
    sums = 1.0 + 2.0 * np.cumsum(rho[1:])
    lags = np.arange(1, len(rho))
    within = np.flatnonzero(lags >= _WINDOW * sums)
    last = int(within[0]) if len(within) else len(sums) - 1
    # Residuals that alternate would be worth more than they are; they count as independent.
    return max(float(sums[last]), 1.0)
