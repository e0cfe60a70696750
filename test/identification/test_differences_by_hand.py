"""Differences of asymmetric intervals against hand values, on either side.

Condition `a` is one trial, 10 with 2 below and 1 above; `b` two, 12.99 and 13.01, that is 13 with
3 below and 4 above. Their spread is s = sqrt(2) 0.01 with one degree of freedom: t = 12.7062, and
a t test sees 16.334 standard errors with a power of 80 %. The standard error of the difference is
s sqrt(1 / 2 + 1) = 0.0173205; 12.7062 times it is 0.220078, 16.334 times 0.282913. The same values
upside down, -10 and -13, have their ends exchanged.

The sensors leave the difference of 3 sqrt(3^2 + 1^2) = 3.16228 below and sqrt(4^2 + 2^2) = 4.47214
above. The farther end counts for what is detectable: 1.42941 times it is 6.39252.
"""

import numpy as np
import pytest

from socket_testbed.identification.differences import Conditions

CONDITIONS = Conditions(("a", "b"), np.array([0, 1, 1]))
VALUES = np.array([[10.0], [12.99], [13.01]])
BELOW = np.array([[2.0], [3.0], [3.0]])
ABOVE = np.array([[1.0], [4.0], [4.0]])
# hypot(3.16228, 0.220078), hypot(4.47214, 0.220078)
NEAR, FAR = 3.16993, 4.47755


def columns(sign: float, conditions: Conditions = CONDITIONS, count: int = 3) -> dict[str, float]:
    """The columns of `b`, of the values as given or upside down."""
    ends = (VALUES - BELOW, VALUES + ABOVE)
    low, high = ends if sign > 0.0 else (-ends[1], -ends[0])
    found = conditions.columns(sign * VALUES[:count], low[:count], high[:count])
    return {name: float(column[1, 0]) for name, column in found.items()}


@pytest.mark.parametrize(
    ("sign", "low", "high"),
    [(1.0, 3.0 - NEAR, 3.0 + FAR), (-1.0, -3.0 - FAR, -3.0 + NEAR)],
    ids=["upright", "upside down"],
)
def test_ends_of_a_difference_stay_asymmetric(sign: float, low: float, high: float) -> None:
    found = columns(sign)
    assert found["difference"] == pytest.approx(3.0 * sign)
    assert found["difference low"] == pytest.approx(low, abs=1e-4)
    assert found["difference high"] == pytest.approx(high, abs=1e-4)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["upright", "upside down"])
def test_the_farther_end_decides_what_is_detectable(sign: float) -> None:
    """hypot(6.39252, 0.282913)."""
    assert columns(sign)["detectable"] == pytest.approx(6.39878, abs=1e-3)


def test_a_mean_s_ends_stay_asymmetric() -> None:
    """12.7062 s / sqrt(2) = 0.127062: hypot(3, 0.127062) below, hypot(4, 0.127062) above."""
    found = columns(1.0)
    ends = (found["value"] - found["low"], found["high"] - found["value"])
    assert ends == pytest.approx((3.00269, 4.00202), abs=1e-4)


def test_single_trials_differ_by_their_ends_alone() -> None:
    """2.99 - sqrt(10) and 2.99 + sqrt(20), without a spread."""
    found = columns(1.0, Conditions(("a", "b"), np.array([0, 1])), 2)
    assert [found["difference low"], found["difference high"]] == pytest.approx(
        [2.99 - 3.16228, 2.99 + 4.47214], abs=1e-4
    )
    assert not {"spread", "detectable"} & {*found}


def test_freedom_is_that_of_known_conditions() -> None:
    """Three trials of `b` and two of `a`: two degrees of freedom where `a` is unknown."""
    conditions = Conditions(("a", "b"), np.array([0, 0, 1, 1, 1]))
    values = np.array([[1.0, np.nan], [2.0, 1.0], [3.0, 5.0], [4.0, 6.0], [5.0, 7.0]])
    found = conditions.columns(values, values, values)
    assert found["degrees of freedom"].tolist() == [[3.0, 2.0], [3.0, 2.0]]
    # Squares about the means: 0.5 + 2 over 3, and 2 over 2.
    assert found["spread"][0] == pytest.approx([np.sqrt(2.5 / 3.0), 1.0])
