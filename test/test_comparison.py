"""Differences with intervals, against sums of variances and against chance itself."""

import numpy as np
import pytest
from scipy.stats import gamma

from socket_testbed.api.comparison import Comparison, difference_intervals, values_table

RNG = np.random.default_rng(12)
TRIALS = ("one", "two")


def test_an_upper_end_takes_the_lower_reach_of_the_first() -> None:
    values, low, high = np.array([[10.0], [4.0]]), np.array([[7.0], [3.0]]), [[11.0], [9.0]]
    difference, lower, upper = difference_intervals(values, low, np.array(high))
    assert np.isnan([difference[0], lower[0], upper[0]]).all()
    assert difference[1, 0] == -6.0
    assert lower[1, 0] == pytest.approx(-6.0 - np.hypot(1.0, 1.0))
    assert upper[1, 0] == pytest.approx(-6.0 + np.hypot(5.0, 3.0))


def test_errors_that_two_trials_share_cancel() -> None:
    values, reach = np.array([[10.0], [12.0]]), 5.0
    for correlation, expected in ((0.0, np.hypot(5.0, 5.0)), (0.7, np.sqrt(15.0)), (1.0, 0.0)):
        ends = difference_intervals(values, values - reach, values + reach, correlation)
        np.testing.assert_allclose(
            [end[1, 0] for end in ends], 2.0 + expected * np.array([0, -1, 1])
        )


def test_95_percent_intervals_of_skew_quantities_hold_the_true_difference() -> None:
    """Rates of exponential samples have skew intervals whose ends are known exactly."""
    count, pairs, true = 8, 4000, np.array([1.0, 3.0])
    means = RNG.gamma(count, true[:, None] / count, size=(2, pairs))
    # mean * count / scale is gamma distributed: the exact ends of the mean's interval.
    low, high = (means * count / gamma.ppf(q, count) for q in (0.975, 0.025))
    _, lower, upper = difference_intervals(means, low, high)
    held = (lower[1] <= true[1] - true[0]) & (true[1] - true[0] <= upper[1])
    assert 0.93 < held.mean() < 0.97


def test_angles_differ_the_short_way_round() -> None:
    values = np.array([[170.0, -10.0], [-170.0, 20.0]])
    title = "shear direction [deg]"
    table = values_table("regions", ["a", "b"], title, TRIALS, values, values - 5.0, values + 5.0)
    table = table.query("item == 'two'")
    for column, reach in (("", 0.0), (" high", np.hypot(5, 5)), (" low", -np.hypot(5, 5))):
        np.testing.assert_allclose(table[f"difference{column}"], np.array([20.0, 30.0]) + reach)


def test_clear_differences_are_counted_against_chance_and_sorted() -> None:
    values = np.array([[1.0, 1.0, 1.0, 1.0], [1.2, 9.0, -4.0, 1.0]])
    reach = np.array([1.0, 1.0, 1.0, 0.0])  # the last has no uncertainty, as a share of all
    names = ["anterior", "medial", "distal", "socket"]
    ends = values - reach, values + reach
    table = values_table("regions", names, "shear [kPa]", TRIALS, values, *ends)
    nothing = np.zeros((2, 0))
    found = Comparison(TRIALS, "", (), table, None, nothing, nothing)
    first, *lines = found.differing()
    assert first.startswith("2 of 3 intervals") and "about 0 would" in first
    assert lines == [
        "two - one, medial: shear +8.0 (6.6 to 9.4) kPa",
        "two - one, distal: shear -5.0 (-6.4 to -3.6) kPa",
    ]
