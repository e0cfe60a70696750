"""Array types and shared array helpers of the package."""

from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
StatusArray: TypeAlias = NDArray[np.uint8]

# Steps between samples that are longer than so many usual ones [-]
GAP = 1.5  # samples were lost; a difference across it is not noise
BREAK = 3.0  # the data is unknown: no value holds and no line runs across it

_AROUND = 10  # steps on either side of one that show the usual step
TOLERANCE = 1e-6  # [s]; of a time
_MEDIAN = 0.67449  # [-]; median magnitude of a standard normal variable


def rms(values: FloatArray, empty: float = float("nan")) -> float:
    """Root mean square of the finite values; `empty` without any."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else empty


def finite_mean(values: Iterable[float], mean: Callable[[list[float]], Any] = np.mean) -> float:
    """Mean, or another `mean`, of the finite values; NaN without any."""
    finite = [value for value in values if np.isfinite(value)]
    return float(mean(finite)) if finite else float("nan")


def finite_quantile(values: FloatArray, share: float) -> float:
    """A quantile of the finite values; 0 without any."""
    finite = values[np.isfinite(values)]
    return float(np.quantile(finite, share)) if len(finite) else 0.0


def robust_deviation(errors: FloatArray) -> FloatArray:
    """Standard deviation of normal errors from their median magnitude, along the first axis."""
    return np.asarray(np.median(np.abs(errors), axis=0) / _MEDIAN)


def runs(flags: BoolArray) -> IntArray:
    """Half-open index ranges in which the flags are set, shape (n, 2)."""
    edges = np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8))
    return np.flatnonzero(edges).reshape(-1, 2)


def usual_period(time: FloatArray | IntArray) -> float:
    """Median step between samples, in the unit of their times; NaN for fewer than two."""
    return float(np.median(np.diff(time))) if len(time) > 1 else float("nan")


def gaps(time: FloatArray | IntArray, longer: float = GAP) -> BoolArray:
    """Steps between samples that are longer than so many usual ones, shape (max(N - 1, 0),).

    The usual step is that around each one, as the rate of the trigger may be changed meanwhile.
    """
    steps, width = np.diff(time), 2 * _AROUND + 1
    few = len(steps) < width
    usual = usual_period(time) if few else median_filter(steps, width, mode="mirror")
    return np.asarray(steps > longer * usual)


def sample_at(time: FloatArray, when: float) -> int | None:
    """Index of the latest of some samples at a time; None before the first and after a break."""
    row = int(np.searchsorted(time, when + TOLERANCE, "right")) - 1
    usual = usual_period(time[max(row - _AROUND, 0) : row + _AROUND + 1])
    holds = BREAK * np.nan_to_num(usual) + TOLERANCE
    return row if row >= 0 and when - time[row] <= holds else None


def within(time: FloatArray, start: float, end: float) -> BoolArray:
    """Which samples lie in a span [s] including its ends, shape (N,)."""
    return (time >= start - TOLERANCE) & (time <= end + TOLERANCE)


def evenly(count: int, most: int) -> IntArray:
    """At most `most` of `count` indices, evenly spread from the first to the last."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)


def line_weights(offsets: FloatArray) -> FloatArray:
    """Weights of n values in their least-squares line at offset 0, shape (n,) [-].

    The offsets are times relative to the requested time, shape (n,) [s]. If they are symmetric
    about 0 the result is the mean. Otherwise, such as with missing values, the mean would lag
    behind a steady motion; the line does not. The sum of the squared weights is the variance of the
    result for values of variance 1.
    """
    if len(offsets) == 0:
        return offsets
    mean = offsets.mean()
    centred = offsets - mean
    spread = float(centred @ centred)
    weights = np.full(len(offsets), 1.0 / len(offsets))
    return weights - centred * (mean / spread) if spread > 0.0 else weights
