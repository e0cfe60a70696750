r"""Differences between trials or conditions, and their 95 % intervals.

The interval of a difference :math:`x_1 - x_0` comes from the intervals :math:`[l, u]` of both
values, as a + b - 2 r sqrt(a b) with a and b the squared half-widths of their intervals:

.. math:: \left[ d - \sqrt{a_l + b_u - 2 r \sqrt{a_l b_u}},\;
          d + \sqrt{a_u + b_l - 2 r \sqrt{a_u b_l}} \right], \quad
          a_l = (x_1 - l_1)^2, \; b_u = (u_0 - x_0)^2, \ldots

The errors have a correlation of r: `SAME_LIMB` for trials of one subject in one socket, else 0.

Asymmetric intervals stay asymmetric (Zou & Donner, Construction of confidence limits about effect
measures, Statistics in Medicine 27, 2008).

For conditions with several trials, x is the mean of the condition and [l, u] the mean of its
intervals: repetition does not reduce the uncertainty left by the sensors. The spread between
donnings is the standard deviation s of the trials about the means of their conditions, pooled over
all conditions, with nu degrees of freedom. It adds to each half-width, in quadrature,

.. math:: t_{0.975, \nu} \, s \sqrt{1 / k_1 + 1 / k_0}

for k_1 and k_0 trials. The smallest detectable difference, at 5 % with a power of 80 %, is the root
sum of squares of :math:`\lambda s \sqrt{1 / k_1 + 1 / k_0}`, with the noncentrality lambda at
which a t test has this power (Owen, The power of Student's t-test, Journal of the American
Statistical Association 60, 1965), and (1.96 + 0.84) / 1.96 times the half-width without spread.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from scipy.special import nctdtrinc, ndtri, stdtrit

from socket_testbed.arrays import NORMAL_QUANTILE, UPPER_QUANTILE, FloatArray, IntArray

T = TypeVar("T")

# Correlation of the map's errors in two trials of one limb in one socket: docs/compare.md [-].
SAME_LIMB = 0.7
_ROUNDING = 1e-9  # [-]; of a value; a smaller difference is none
POWER = 0.8  # [-]; probability that a difference of the detectable size is significant
VALUE = ("value", "low", "high")
DIFFERENCE = ("difference", "difference low", "difference high")
VALUES = (*VALUE, *DIFFERENCE)


@dataclass(frozen=True)
class Conditions:
    """The c conditions under which k trials are compared; a single trial may be a condition.

    Attributes:
        names: Names of the c conditions; the others are compared with the first.
        numbers: Index of each trial's condition, shape (k,).
    """

    names: tuple[str, ...]
    numbers: IntArray

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the spread between donnings; 0 with one trial per condition."""
        return len(self.numbers) - len(self.names)

    def grouped(self, values: Sequence[T]) -> dict[str, list[T]]:
        """One value per trial, k of any type, grouped by the names of the conditions."""
        found: dict[str, list[T]] = {name: [] for name in self.names}
        for number, value in zip(self.numbers, values, strict=True):
            found[self.names[number]].append(value)
        return found

    def mean(self, values: FloatArray) -> FloatArray:
        """Means over the trials of each condition, (c, m), of m values per trial, (k, m)."""
        return np.array([np.mean(group, axis=0) for group in self.grouped([*values]).values()])

    def columns(
        self,
        values: FloatArray,
        low: FloatArray,
        high: FloatArray,
        correlation: FloatArray | float = 0.0,
    ) -> dict[str, FloatArray]:
        """Values of the conditions and their differences from the first one, with intervals.

        The module docstring gives the equations.

        Args:
            values: m values of each trial, in any units, shape (k, m); NaN if unknown.
            low: Lower ends of their 95 % intervals, shape (k, m).
            high: Upper ends of their 95 % intervals, shape (k, m).
            correlation: Correlation of the errors of each condition with those of the first, shape
                (c, m) or one number [-].

        Returns:
            Columns of shape (c, m) in the units of the values: `VALUES`, and with several trials
            in a condition also `spread`, `degrees of freedom` [1] and `detectable`. Differences of
            the first condition from itself are NaN.
        """
        value, low, high = map(self.mean, (values, low, high))
        below, above = np.maximum(value - low, 0.0), np.maximum(high - value, 0.0)
        with np.errstate(invalid="ignore"):  # the reach of an open interval is unknown
            lower, upper = (
                np.sqrt(own**2 + first**2 - 2.0 * correlation * own * first)
                for own, first in ((below, above[0]), (above, below[0]))
            )
        rounding = _ROUNDING * np.abs(value[0])
        difference, lower, upper = (
            np.where(np.abs(found) < rounding, 0.0, found)
            for found in (value - value[0], lower, upper)
        )
        found = (value, low, high, difference, difference - lower, difference + upper)
        columns = dict(zip(VALUES, found, strict=True))
        if self.freedom:
            squares = (values - value[self.numbers]) ** 2
            known = (np.bincount(self.numbers) - 1.0) @ np.isfinite(value)  # degrees of freedom
            freedom = np.where(known > 0.0, known, np.nan)
            spread = np.sqrt(np.nansum(squares, axis=0) / freedom)
            share = 1.0 / np.bincount(self.numbers)[:, None]
            error = spread * np.sqrt(share + share[0])
            quantile = stdtrit(freedom, UPPER_QUANTILE)
            noncentrality = nctdtrinc(freedom, 1.0 - POWER, quantile)
            normal = 1.0 + ndtri(POWER) / NORMAL_QUANTILE
            reach = quantile * spread * np.sqrt(share)
            columns |= {
                "low": value - np.hypot(below, reach),
                "high": value + np.hypot(above, reach),
                "difference low": difference - np.hypot(lower, quantile * error),
                "difference high": difference + np.hypot(upper, quantile * error),
                "spread": np.tile(spread, (len(value), 1)),
                "degrees of freedom": np.tile(freedom, (len(value), 1)),
                "detectable": np.hypot(normal * np.maximum(lower, upper), noncentrality * error),
            }
        for name in columns.keys() & {*DIFFERENCE, "detectable"}:
            columns[name][0] = np.nan
        return columns


def is_clear(low: Any, high: Any) -> Any:
    """Whether the intervals of differences exclude 0; false where both ends are NaN.

    Args:
        low: Lower ends, numbers or arrays, in any unit.
        high: Upper ends, in the unit and shape of the lower ones.
    """
    return (low > 0.0) | (high < 0.0)
