"""Helpers of arrays by hand: means without gaps, spans of time, breaks and evenly spread rows."""

import numpy as np
import pytest

from socket_testbed import arrays

NAN, INF = float("nan"), float("inf")
QUARTERS = 0.25 * np.arange(41)  # [s]


@pytest.mark.parametrize(
    ("values", "expected"),
    [([3.0, 4.0], np.sqrt(12.5)), ([3.0, NAN, INF], 3.0), ([-2.0, 2.0], 2.0), ([NAN], NAN)],
    ids=["two", "unknown", "negative", "none"],
)
def test_rms_is_of_finite_values(values: list[float], expected: float) -> None:
    assert arrays.rms(np.array(values)) == pytest.approx(expected, nan_ok=True)


def test_rms_of_nothing_can_be_zero() -> None:
    assert arrays.rms(np.array([NAN]), 0.0) == 0.0


def test_means_are_of_finite_values() -> None:
    assert arrays.finite_mean([1.0, NAN, 4.0, INF]) == 2.5
    assert arrays.finite_mean([1.0, 2.0, NAN, 9.0], np.median) == 2.0
    assert np.isnan(arrays.finite_mean([NAN]))


def test_quantiles_are_of_finite_values() -> None:
    values = np.array([[0.0, 1.0, NAN], [2.0, INF, 4.0]])
    assert arrays.finite_quantile(values, 0.5) == 1.5
    assert arrays.finite_quantile(values, 1.0) == 4.0
    assert arrays.finite_quantile(np.array([NAN]), 0.5) == 0.0


def test_a_robust_deviation_is_by_column() -> None:
    """The median magnitude of a standard normal variable is 0.67449."""
    errors = np.array([[-0.67449, 6.7449], [0.1, -1.0], [100.0, 1000.0]])
    np.testing.assert_allclose(arrays.robust_deviation(errors), [1.0, 10.0])


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ([0, 1, 1, 0, 1], [[1, 3], [4, 5]]),
        ([1, 0, 0], [[0, 1]]),
        ([1, 1], [[0, 2]]),
        ([0, 0], []),
        ([], []),
    ],
    ids=["inside and end", "start", "all", "none", "empty"],
)
def test_runs_are_rows_up_to_the_next(flags: list[int], expected: list[list[int]]) -> None:
    found = arrays.runs(np.array(flags, dtype=bool))
    assert found.tolist() == expected and found.shape == (len(expected), 2)


def test_the_usual_period_is_the_median_step() -> None:
    assert arrays.usual_period(np.array([0.0, 0.2, 0.4, 3.0])) == pytest.approx(0.2)
    assert arrays.usual_period(np.array([1.0, 4.0])) == 3.0
    assert np.isnan(arrays.usual_period(np.array([1.0])))


def test_a_gap_is_longer_than_its_neighbours() -> None:
    """Steps of 0.25 s, then of 0.1 s; 0.37 s and 0.14 s are no gaps, 0.38 s and 0.16 s are."""
    steps = np.array([0.25] * 30 + [0.37, 0.38] + [0.25] * 30 + [0.1] * 30 + [0.14, 0.16])
    found = arrays.gaps(np.append(0.0, np.cumsum([*steps, *[0.1] * 30])))
    assert np.flatnonzero(found).tolist() == [31, 93]


def test_few_steps_are_judged_together() -> None:
    """20 steps, one less than the window: the median is 0.1 s, though 0.25 s come first."""
    steps = [0.25] * 9 + [0.1] * 11
    assert arrays.gaps(np.append(0.0, np.cumsum(steps))).tolist() == [True] * 9 + [False] * 11


def test_another_length_makes_a_gap() -> None:
    steps = [0.25] * 10 + [0.74, 0.76] + [0.25] * 10
    time = np.append(0.0, np.cumsum(steps))
    assert np.flatnonzero(arrays.gaps(time, 3.0)).tolist() == [11]
    assert arrays.gaps(time[:1]).tolist() == []


MOMENTS = {
    # time, row of the latest sample
    "at a sample": (2.5, 10),
    "just before it": (2.5 - 5e-7, 10),
    "before it": (2.499, 9),
    "between": (2.6, 10),
    "at the first": (0.0, 0),
    "before the first": (-0.01, None),
    "held for three steps": (10.75, 40),
    "after a break": (10.76, None),
}


@pytest.mark.parametrize("case", MOMENTS)
def test_the_latest_sample_holds(case: str) -> None:
    when, row = MOMENTS[case]
    assert arrays.sample_at(QUARTERS, when) == row


def test_the_step_near_a_sample_counts() -> None:
    """Steps of 0.1 s, then of 1 s: at the end a sample holds for 3 s, at the start for 0.3 s."""
    time = np.concatenate([0.1 * np.arange(40), 3.9 + np.arange(1.0, 41.0)])
    assert arrays.sample_at(time, time[-1] + 2.9) == 79
    assert arrays.sample_at(time[:40], 3.9 + 0.31) is None


def test_a_single_sample_holds_for_its_moment() -> None:
    assert arrays.sample_at(np.array([1.0]), 1.0) == 0
    assert arrays.sample_at(np.array([1.0]), 1.001) is None


def test_a_span_includes_its_ends() -> None:
    found = arrays.within(QUARTERS, 1.0 + 5e-7, 2.0 - 5e-7)
    assert np.flatnonzero(found).tolist() == [4, 5, 6, 7, 8]
    assert np.flatnonzero(arrays.within(QUARTERS, 1.01, 1.99)).tolist() == [5, 6, 7]


def test_rows_are_spread_from_end_to_end() -> None:
    assert arrays.evenly(9, 3).tolist() == [0, 4, 8]
    assert arrays.evenly(3, 9).tolist() == [0, 1, 2]
    assert arrays.evenly(0, 9).tolist() == []


LINES = {
    # offsets [s], weights: of 2 t + 1 they give 1, and symmetric ones are the mean
    "symmetric": ([-1.0, 0.0, 1.0], [1 / 3, 1 / 3, 1 / 3]),
    "single": ([0.5], [1.0]),
    "together": ([0.5, 0.5], [0.5, 0.5]),
    "late": ([1.0, 2.0], [2.0, -1.0]),  # 2 f(1) - f(2)
    "none": ([], []),
}


@pytest.mark.parametrize("case", LINES)
def test_the_line_is_read_at_zero(case: str) -> None:
    offsets, weights = LINES[case]
    found = arrays.line_weights(np.array(offsets))
    np.testing.assert_allclose(found, weights, atol=1e-12)
