"""Differences with intervals, against sums of variances and against chance itself."""

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import brentq
from scipy.stats import chi2, gamma, nct, norm, t, ttest_ind

from socket_testbed.identification.differences import Conditions
from socket_testbed.results.comparing import values_table
from socket_testbed.results.comparison import Comparison

RNG = np.random.default_rng(12)
TRIALS = Conditions(("one", "two"), np.array([0, 1]))
ENDS = ("difference low", "difference high")


def table_of(conditions: Conditions, names: str, title: str, values, reach) -> pd.DataFrame:
    rows = [
        {
            ("regions", name, title): {"value": v, "low": v - r, "high": v + r}
            for name, v, r in zip(names.split(), of_trial, reach, strict=True)
        }
        for of_trial in values
    ]
    return values_table(conditions, rows)


def test_intervals_of_skew_quantities_hold_95_percent() -> None:
    """Rates of exponential samples have skew intervals whose ends are known exactly."""
    count, pairs, true = 8, 4000, np.array([1.0, 3.0])
    means = RNG.gamma(count, true[:, None] / count, size=(2, pairs))
    # mean * count / scale is gamma distributed: the exact ends of the mean's interval.
    low, high = (means * count / gamma.ppf(q, count) for q in (0.975, 0.025))
    lower, upper = (TRIALS.columns(means, low, high)[end][1] for end in ENDS)
    held = (lower <= true[1] - true[0]) & (true[1] - true[0] <= upper)
    assert 0.93 < held.mean() < 0.97


def test_clear_differences_are_said_with_their_sign() -> None:
    values = np.array([[1.0, 1.0, 1.0], [1.2, 9.0, -4.0]])
    table = table_of(TRIALS, "anterior medial distal", "shear [kPa]", values, [1.0] * 3)
    first, *lines = Comparison(TRIALS.grouped(TRIALS.names), "", (), table, None).differing()
    assert first.startswith("2 of 3 intervals")
    assert lines == [
        "medial: shear 8.0 kPa higher in two than in one (6.6 to 9.4)",
        "distal: shear 5.0 kPa lower in two than in one (3.6 to 6.4)",
    ]


def repeated(trials: int) -> Conditions:
    return Conditions(("a", "b"), np.repeat([0, 1], trials))


UNEVEN = Conditions(("a", "b"), np.array([0, 1, 1, 0, 1]))


@pytest.mark.filterwarnings("error")
def test_without_sensor_errors_it_is_student_s_test() -> None:
    values = RNG.normal(10.0, 2.0, (5, 40))
    found = UNEVEN.columns(values, values, values)
    expected = ttest_ind(values[[1, 2, 4]], values[[0, 3]]).confidence_interval()
    np.testing.assert_allclose([found[end][1] for end in ENDS], [*expected])
    pooled = np.sqrt((values[[0, 3]].var(axis=0) * 2 + values[[1, 2, 4]].var(axis=0) * 3) / 3)
    np.testing.assert_allclose(found["spread"], [pooled, pooled])
    assert (found["degrees of freedom"] == 3.0).all()
    assert np.isnan(found["detectable"][0]).all()


@pytest.mark.filterwarnings("error")
def test_an_interval_without_an_end_gives_none() -> None:
    """To the difference, as of a limb that hardly moved."""
    values = RNG.normal(10.0, 2.0, (5, 40))
    found = UNEVEN.columns(values, np.full_like(values, -np.inf), values + 1.0)
    assert np.isnan(found["difference"][0]).all() and np.isfinite(found["difference"][1]).all()
    assert not np.isfinite([found[name][1] for name in (*ENDS, "detectable")]).any()


@pytest.mark.parametrize("own", [0.0, 0.5, 2.0])  # error of the map, by that of donnings
@pytest.mark.parametrize("trials", [2, 3, 6], ids=["2-trials", "3-trials", "6-trials"])
def test_intervals_hold_and_see_the_detectable_difference(trials: int, own: float) -> None:
    """Errors that a limb shares, that a condition shares, and that differ by donning.

    The half width depends on the sample's spread alone, whose square is chi-squared: coverage and
    power are integrals over it.
    """
    studies, rng = 20_000, np.random.default_rng([12, trials, round(2 * own)])
    freedom, donning, of_map = 2 * (trials - 1), np.sqrt(2.0 / trials), own * np.sqrt(0.6)
    edge = float(t.ppf(0.975, freedom))
    noncentrality = brentq(lambda c: nct.sf(edge, freedom, c) - 0.8, 1.0, 9.0)
    size = np.hypot(of_map * (norm.ppf(0.975) + norm.ppf(0.8)), noncentrality * donning)
    spread = np.sqrt(chi2.ppf((np.arange(2000) + 0.5) / 2000, freedom) / freedom)
    half = np.hypot(1.96 * of_map, edge * spread * donning)
    total = np.hypot(of_map, donning)
    coverage = 2.0 * norm.cdf(half / total).mean() - 1.0
    power = norm.cdf((size - half) / total).mean()
    assert 0.9495 < coverage < 0.98 and 0.795 < power < 0.83

    shared = np.sqrt(0.7) * rng.normal(0.0, own, (1, studies))
    means = shared + np.sqrt(0.3) * rng.normal(0.0, own, (2, studies)) + [[0.0], [size]]
    values = np.repeat(means, trials, axis=0)
    values += rng.normal(0.0, 1.0, values.shape)
    ends = values - 1.96 * own, values + 1.96 * own
    found = repeated(trials).columns(values, *ends, 0.7)
    low, high = (found[end][1] for end in ENDS)
    assert ((low <= size) & (size <= high)).mean() == pytest.approx(coverage, abs=0.007)
    assert (low > 0.0).mean() == pytest.approx(power, abs=0.012)
    assert np.sqrt((found["detectable"][1] ** 2).mean()) == pytest.approx(size, rel=0.02)
    for mean, true in enumerate((0.0, size)):
        assert ((found["low"][mean] <= true) & (true <= found["high"][mean])).mean() > 0.94


@pytest.mark.parametrize(
    ("column", "reach"),
    [
        pytest.param("difference", 0.0, id="value"),
        pytest.param("difference high", np.hypot(5, 5), id="high"),
        pytest.param("difference low", -np.hypot(5, 5), id="low"),
    ],
)
def test_angles_differ_by_the_short_way_round(column: str, reach: float) -> None:
    values = np.array([[170.0, -10.0], [-170.0, 20.0]])
    table = table_of(TRIALS, "a b", "shear direction [deg]", values, [5.0, 5.0])
    table = table.query("item == 'two'")
    np.testing.assert_allclose(table[column], np.array([20.0, 30.0]) + reach)


def test_angles_are_averaged_the_short_way_round() -> None:
    values = np.array([[178.0], [-178.0], [-172.0], [-176.0]])
    table = table_of(repeated(2), "a", "shear direction [deg]", values, [0.0])
    assert table["value"].to_numpy() % 360.0 == pytest.approx([180.0, 186.0])
    assert table["spread"][1] == pytest.approx(np.sqrt((2 * 2.0**2 + 2 * 2.0**2) / 2))
