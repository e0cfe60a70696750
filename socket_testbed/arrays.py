"""Array types and shared array helpers of the package."""

from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
StatusArray: TypeAlias = NDArray[np.uint8]

# Steps between samples that are longer than so many usual ones [-]
GAP = 1.5  # samples were lost; a difference across it is not noise
BREAK = 3.0  # the data is unknown: no value holds and no line runs across it

# A 95 % interval
NORMAL_QUANTILE = 1.96  # [-]; standard deviations to each of its ends
UPPER_QUANTILE = 0.975  # [-]; share of the probability below its upper end

_AROUND = 10  # steps on either side of one that show the usual step
TOLERANCE = 1e-6  # [s]; of a time
_MEDIAN = 0.67449  # [-]; median magnitude of a standard normal variable


def rms(values: FloatArray, empty: float = float("nan")) -> float:
    """Root mean square of the finite values, in their unit.

    Args:
        values: Values of one unit, of any shape; NaN and infinite ones do not count.
        empty: The result if no value is finite.
    """
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else empty


def finite_mean(values: Iterable[float], mean: Callable[[list[float]], Any] = np.mean) -> float:
    """Mean of the finite values, in their unit; NaN without any.

    Args:
        values: Values of one unit; NaN and infinite ones do not count.
        mean: The kind of mean, such as `np.median`; it is given the list of the finite values.
    """
    finite = [value for value in values if np.isfinite(value)]
    return float(mean(finite)) if finite else float("nan")


def finite_quantile(values: FloatArray, share: float) -> float:
    """A quantile of the finite values, in their unit; 0 without any.

    Args:
        values: Values of one unit, of any shape; NaN and infinite ones do not count.
        share: Fraction of the finite values below the quantile, 0 to 1 [-].
    """
    finite = values[np.isfinite(values)]
    return float(np.quantile(finite, share)) if len(finite) else 0.0


def robust_deviation(errors: FloatArray) -> FloatArray:
    """Standard deviation of normal errors from their median magnitude, along the first axis.

    The errors have shape (N, ...) and mean zero; the result has shape (...) and their unit. It is
    NaN where one of them is.
    """
    return np.asarray(np.median(np.abs(errors), axis=0) / _MEDIAN)


def runs(flags: BoolArray) -> IntArray:
    """Ranges of rows in which the flags, shape (N,), are set: first and last + 1, shape (n, 2)."""
    edges = np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8))
    return np.flatnonzero(edges).reshape(-1, 2)


def usual_period(time: FloatArray | IntArray) -> float:
    """Median step between samples, in the unit of their times (N,); NaN for fewer than two."""
    return float(np.median(np.diff(time))) if len(time) > 1 else float("nan")


def gaps(time: FloatArray | IntArray, longer: float = GAP) -> BoolArray:
    """Which steps between samples are longer than so many usual ones, shape (max(N - 1, 0),).

    The usual step is that around each one, as the rate of the trigger may be changed meanwhile.

    Args:
        time: Times of the samples in any unit, ascending, shape (N,).
        longer: Length above which a step counts, in usual steps [-].
    """
    steps, width = np.diff(time), 2 * _AROUND + 1
    if len(steps) < width:
        return np.asarray(steps > longer * usual_period(time))
    from scipy.ndimage import median_filter  # 15 MB, which nodes need not hold

    return np.asarray(steps > longer * median_filter(steps, width, mode="mirror"))


def sample_at(time: FloatArray, when: float) -> int | None:
    """Row of the latest of some samples at a time; None before the first and after a break.

    Args:
        time: Times of the samples, ascending, shape (N,) [s].
        when: The time, from the same zero [s].
    """
    row = int(np.searchsorted(time, when + TOLERANCE, "right")) - 1
    usual = usual_period(time[max(row - _AROUND, 0) : row + _AROUND + 1])
    holds = BREAK * np.nan_to_num(usual) + TOLERANCE
    return row if row >= 0 and when - time[row] <= holds else None


def within(time: FloatArray, start: float, end: float) -> BoolArray:
    """Which samples lie in a span of time including its ends, shape (N,).

    Args:
        time: Times of the samples, shape (N,) [s].
        start: Start of the span, from the zero of `time` [s].
        end: End of the span, from the zero of `time` [s].
    """
    return (time >= start - TOLERANCE) & (time <= end + TOLERANCE)


def evenly(count: int, most: int) -> IntArray:
    """Some of the indices 0 to `count` - 1, evenly spread from the first to the last.

    Args:
        count: Number of items to choose from.
        most: Number of indices returned, if there are more items; otherwise each is.
    """
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)


def line_weights(offsets: FloatArray) -> FloatArray:
    """Weights of n values in their least-squares line at offset 0, shape (..., n) [-].

    The value of the line is the sum of the values times their weights. If the offsets are symmetric
    about 0 it is the mean. Otherwise, such as with missing values, the mean would lag behind a
    steady motion; the line does not. The sum of the squared weights is the variance of the result
    for values of variance 1.

    Args:
        offsets: Times of the values relative to the requested time, shape (..., n) [s]. NaN stands
            for a value that does not count; its weight is 0.
    """
    counts = np.isfinite(offsets)
    number = np.maximum(counts.sum(axis=-1, keepdims=True), 1)
    offsets = np.where(counts, offsets, 0.0)
    mean = offsets.sum(axis=-1, keepdims=True) / number
    centred = np.where(counts, offsets - mean, 0.0)
    spread = np.einsum("...n,...n->...", centred, centred)[..., None]
    slope = np.divide(mean, spread, out=np.zeros_like(mean), where=spread > 0.0)
    return np.asarray(counts / number - centred * slope)
