"""How courses go together: correlation, lag, delay, and the drift that others do not explain."""

from __future__ import annotations

import math

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.identification.data_finding import LEAST_CHECKED

MIN_LAG_GAIN = 0.03  # [-]; gain in correlation for a lag to count
MIN_LAG_FIT = 0.5  # [-]; correlation with the lag
SEARCHED_LAG = 10.0  # [s]
SEARCHED_SHARE = 0.2  # [-]; of a trial, at most
DELAY_STEP = 0.1  # [s]; at least
LAG_STEP = 0.04  # [s]; at least
ROUNDING = 1e-12  # [-]; of a sum of squares


def correlation(one: FloatArray, other: FloatArray) -> float:
    """Correlation of two series (N,) where both are known [-]: 0 if one is constant.

    It is NaN if fewer than `LEAST_CHECKED` values are known in both.

    Args:
        one: A series, shape (N,), in its unit; NaN where it is missing.
        other: The other one, likewise.
    """
    known = np.isfinite(one) & np.isfinite(other)
    if known.sum() < LEAST_CHECKED:
        return float("nan")
    a, b = one[known] - one[known].mean(), other[known] - other[known].mean()
    size = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / size) if size > 0.0 else 0.0


def explained_share(course: FloatArray, by: FloatArray) -> float:
    """Share of the variance of a series that is linear in others [-].

    Args:
        course: The series, shape (N,), in its unit; NaN where it is missing.
        by: The others, shape (N, k), each in its unit.
    """
    known = np.isfinite(course) & np.isfinite(by).all(axis=1)
    if known.sum() < LEAST_CHECKED or not np.ptp(course[known]) > 0.0:
        return 0.0
    scaled = by[known] / np.maximum(by[known].std(axis=0), 1e-12)
    columns = np.column_stack([scaled, np.ones(len(scaled))])
    left = course[known] - columns @ np.linalg.lstsq(columns, course[known], rcond=None)[0]
    return float(1.0 - left.var() / course[known].var())


def clear_lag(reference: FloatArray, course: FloatArray, period: float) -> float:
    """Delay of a series behind another [s]; 0 unless a lag is clearly better.

    One that moves against the other at once is reversed rather than late.

    Args:
        reference: The other series, shape (N,), in its unit.
        course: The series, shape (N,), in its unit.
        period: Time between the values [s].
    """
    best, fit, at_once = best_lag(reference, course, period)
    return best if fit > max(abs(at_once) + MIN_LAG_GAIN, MIN_LAG_FIT) else 0.0


def best_lag(
    reference: FloatArray, course: FloatArray, period: float
) -> tuple[float, float, float]:
    """Delay of a series behind another with the highest correlation.

    Args:
        reference: The other series, shape (N,), or (N, k) of vectors with mean zero.
        course: The series, of the same shape.
        period: Time between the values [s].

    Returns:
        The delay [s], the correlation with it, and that without a delay [-]; zeros if unknown.
    """
    step = max(1, round(LAG_STEP / period))
    reference, course, period = reference[::step], course[::step], step * period
    limit = min(round(SEARCHED_LAG / period), len(course) // 3)
    found = _correlations(course, reference, limit)
    if 0 not in found:
        return 0.0, 0.0, 0.0
    best = max(found, key=lambda lag: (found[lag], -abs(lag)))
    return best * period, found[best], found[0]


def _correlations(course: FloatArray, reference: FloatArray, limit: int) -> dict[int, float]:
    """Correlation of a series with another by its delay behind it, up to a limit, in samples [-].

    Delays with which fewer than `LEAST_CHECKED` values are known in both are left out. Each is
    found as by `correlation`, from sums of products over the values known in both.

    Args:
        course: The series, shape (N,) or (N, k), in its unit; NaN where it is missing.
        reference: The other one, of the same shape, in its unit; NaN where it is missing.
        limit: The longest delay, as early and as late.
    """
    width = math.prod(course.shape[1:])
    (own, own_known), (other, other_known) = _centred(course), _centred(reference)
    own_squares, other_squares = own**2, other**2
    found = {}
    for lag in range(-limit, limit + 1):
        late = slice(width * max(lag, 0), len(own) + width * min(lag, 0))
        early = slice(width * max(-lag, 0), len(own) - width * max(lag, 0))
        count = float(own_known[late] @ other_known[early])
        if count < LEAST_CHECKED:
            continue
        own_sum = float(own[late] @ other_known[early])
        other_sum = float(own_known[late] @ other[early])
        own_spread = _spread(float(own_squares[late] @ other_known[early]), own_sum, count)
        other_spread = _spread(float(own_known[late] @ other_squares[early]), other_sum, count)
        together = float(own[late] @ other[early]) - own_sum * other_sum / count
        size = math.sqrt(own_spread * other_spread)
        found[lag] = together / size if size > 0.0 else 0.0
    return found


def _centred(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Values less their mean with zeros for missing ones, and 1 where one is known, (N k,) each."""
    flat = values.ravel()
    known = np.isfinite(flat)
    filled = np.where(known, flat, 0.0)
    filled[known] -= filled[known].mean() if known.any() else 0.0
    return filled, known.astype(np.float64)


def _spread(squares: float, total: float, count: float) -> float:
    """Sum of squares about the mean, from that about zero and the sum; 0 if it is only rounding."""
    spread = squares - total**2 / count
    return spread if spread > ROUNDING * squares else 0.0


def clear_delay(
    courses: FloatArray, causes: FloatArray, period: float, least: tuple[float, float]
) -> float:
    """Delay with which courses are explained by causes far better than at once.

    Args:
        courses: The courses, shape (N, k); each counts by its variance.
        causes: What explains them linearly, shape (N, m), with the times.
        period: Time between the values [s].
        least: The least share of the variance that is explained with the delay, and the least fall
            of log(1 - share) / 2 by it [-].

    Returns:
        The delay [s], negative for courses that are early; 0 without a clear one.
    """
    step = max(1, round(DELAY_STEP / period))
    courses, causes, period = courses[::step], causes[::step], step * period
    limit = round(min(SEARCHED_LAG, SEARCHED_SHARE * len(courses) * period) / period)
    middle = slice(limit, len(courses) - limit)
    scaled = causes[middle] - causes[middle].mean(axis=0)
    scaled /= np.maximum(scaled.std(axis=0), 1e-12)
    basis, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
    basis = basis[:, sizes > 1e-6 * sizes.max()]
    courses = courses / np.maximum(courses.std(axis=0), 1e-12)

    def unexplained(lag: int) -> float:
        moved = courses[middle.start + lag : middle.stop + lag]
        moved = moved - moved.mean(axis=0)
        explained = ((basis.T @ moved) ** 2).sum() / max(float((moved**2).sum()), 1e-12)
        return max(1.0 - float(explained), 1e-6)

    left = {lag: unexplained(lag) for lag in range(-limit, limit + 1)}
    best = min(left, key=lambda lag: (left[lag], abs(lag)))
    gain = 0.5 * np.log(left[0] / left[best])
    is_clear = 1.0 - left[best] > least[0] and gain > least[1]
    # At the end of the range the fit may still improve: no delay is found.
    return best * period if is_clear and abs(best) < limit else 0.0


def drift_of(courses: FloatArray, causes: FloatArray, time: FloatArray) -> FloatArray:
    """Change of courses over their times beside what is linear in causes, in their units, (k,).

    It is 0 if too few samples are known.

    Args:
        courses: The courses, shape (N, k); NaN where they are missing.
        causes: What explains them linearly, shape (N, m), each in its unit.
        time: Times of the samples, shape (N,) [s].
    """
    present = np.isfinite(courses)
    if (present != present[:, :1]).any():  # else one solution serves them all
        each = [drift_of(course[:, None], causes, time) for course in courses.T]
        return np.concatenate(each)
    known = present.all(axis=1) & np.isfinite(causes).all(axis=1)
    if known.sum() < LEAST_CHECKED:
        return np.zeros(courses.shape[1])
    scaled = causes[known] - causes[known].mean(axis=0)
    scaled /= np.maximum(scaled.std(axis=0), 1e-12)
    columns = np.column_stack([np.ones(len(scaled)), time[known] / time[-1], scaled])
    return np.asarray(np.linalg.lstsq(columns, courses[known], rcond=1e-8)[0][1])
