"""Differences with intervals, against sums of variances and against chance itself."""

import numpy as np
import pytest

from socket_testbed.comparison.table import (
    Compared,
    Comparison,
    difference_intervals,
    texts_table,
)

RNG = np.random.default_rng(12)


def test_variances_add_for_symmetric_intervals() -> None:
    values = RNG.normal(size=(3, 50))
    reach = RNG.uniform(0.5, 3.0, size=(3, 50))
    difference, low, high = difference_intervals(values, values - reach, values + reach)
    assert np.isnan(difference[0]).all() and np.isnan(low[0]).all() and np.isnan(high[0]).all()
    np.testing.assert_allclose(difference[1:], values[1:] - values[0])
    both = np.sqrt(reach[1:] ** 2 + reach[0] ** 2)
    np.testing.assert_allclose(high[1:] - difference[1:], both)
    np.testing.assert_allclose(difference[1:] - low[1:], both)


def test_the_upper_end_takes_the_lower_reach_of_the_first() -> None:
    values, low, high = (
        np.array([[10.0], [4.0]]),
        np.array([[7.0], [3.0]]),
        np.array([[11.0], [9.0]]),
    )
    difference, lower, upper = difference_intervals(values, low, high)
    assert difference[1, 0] == -6.0
    assert lower[1, 0] == pytest.approx(-6.0 - np.hypot(1.0, 1.0))
    assert upper[1, 0] == pytest.approx(-6.0 + np.hypot(5.0, 3.0))


def test_95_percent_intervals_of_skew_quantities_hold_the_true_difference() -> None:
    """Rates of exponential samples have skew intervals whose ends are known exactly."""
    from scipy.stats import gamma

    count, pairs, true = 8, 4000, np.array([1.0, 3.0])
    means = RNG.gamma(count, true[:, None] / count, size=(2, pairs))
    # mean * count / scale is gamma distributed: the exact ends of the mean's interval.
    low, high = (means * count / gamma.ppf(q, count) for q in (0.975, 0.025))
    _, lower, upper = difference_intervals(means, low, high)
    held = (lower[1] <= true[1] - true[0]) & (true[1] - true[0] <= upper[1])
    assert 0.93 < held.mean() < 0.97


def test_angles_differ_the_short_way_round() -> None:
    values = np.array([[170.0, -10.0], [-170.0, 20.0]])
    everywhere = np.full((2, 2), True)
    compared = Compared(
        "regions",
        ["a", "b"],
        "direction [deg]",
        values,
        values - 5.0,
        values + 5.0,
        everywhere,
        360.0,
    )
    table = compared.to_dataframe(["one", "two"]).query("item == 'two'")
    np.testing.assert_allclose(table["difference"], [20.0, 30.0])
    np.testing.assert_allclose(table["difference high"], np.array([20.0, 30.0]) + np.hypot(5, 5))


def test_what_is_not_determined_has_an_interval_alone() -> None:
    values = np.array([[1.0, 2.0], [3.0, 5.0]])
    determined = np.array([[True, True], [False, True]])
    compared = Compared(
        "tiles", ["a", "b"], "pressure [kPa]", values, values - 1.0, values + 1.0, determined
    )
    table = compared.to_dataframe(["one", "two"]).set_index(["name", "item"])
    assert np.isnan(table.loc[("a", "two"), "value"])
    assert np.isnan(table.loc[("a", "two"), "difference"])
    assert table.loc[("a", "two"), "low"] == 2.0
    assert table.loc[("a", "two"), "difference low"] == pytest.approx(2.0 - np.sqrt(2.0))
    assert table.loc[("b", "two"), "difference"] == 3.0


def test_words_stand_in_the_same_columns() -> None:
    table = texts_table("metadata", {"liner": ["gel", "sock"]}, ["one", "two"])
    numbers = Compared.plain("sizes", ["a"], "area [cm^2]", np.ones((2, 1)))
    assert list(table) == list(numbers.to_dataframe(["one", "two"]))
    assert table["text"].tolist() == ["gel", "sock"] and table["value"].isna().all()


def test_what_differs_clearly_is_counted_against_chance_and_sorted() -> None:
    values = np.array([[1.0, 1.0, 1.0, 1.0], [1.2, 9.0, -4.0, 1.0]])
    reach = np.array([1.0, 1.0, 1.0, 0.0])  # the last has no uncertainty, as a share of all
    everywhere = np.full(values.shape, True)
    names = ["anterior", "medial", "distal", "socket"]
    compared = Compared(
        "regions", names, "shear [kPa]", values, values - reach, values + reach, everywhere
    )
    found = Comparison("trials", ("one", "two"), "", (), compared.to_dataframe(["one", "two"]))
    first, *lines = found.differing()
    assert first.startswith("2 of 3 intervals") and "about 0 would" in first
    assert lines == [
        "two - one, medial: shear +8.0 (6.6 to 9.4) kPa",
        "two - one, distal: shear -5.0 (-6.4 to -3.6) kPa",
    ]
    assert found.differing(most=1) == [first, lines[0]]
