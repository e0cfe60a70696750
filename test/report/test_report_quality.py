"""What a report says of the data: gaps, drop-outs, autocorrelation; and lines that keep peaks."""

import dataclasses
import math

import numpy as np
import pytest
from support.problems import make_samples

from socket_testbed.identification.evaluation import (
    channel_errors,
    evaluate,
    predict_channels,
    summarise_errors,
)
from socket_testbed.report.figures.style import thin
from socket_testbed.report.results import (
    autocorrelation,
    describe_triggers,
    find_drop_outs,
    find_gaps,
    unusable,
)
from socket_testbed.trials.segment import Segment

RATE = 4.0  # [Hz]


@pytest.fixture
def rng():
    return np.random.default_rng(8)


def first_order(rng, count: int, share: float) -> np.ndarray:
    """An autoregressive series of the first order: rho_k = share^k."""
    values = np.zeros(count)
    for k, noise in enumerate(rng.normal(size=count - 1), start=1):
        values[k] = share * values[k - 1] + noise
    return values


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_the_decorrelation_time_of_a_known_series(rng, share):
    count = 40_000
    found = autocorrelation(np.arange(count) / RATE, 5.0 + first_order(rng, count, share))
    worth = (1.0 + share) / (1.0 - share)  # 1 + 2 sum of share^k
    assert found.lag_one == pytest.approx(share, abs=0.02)
    assert found.decorrelation == pytest.approx(worth / RATE, rel=0.15)
    assert found.effective == pytest.approx(count / worth, rel=0.15)


def test_the_mean_is_as_uncertain_as_that_of_the_effective_samples(rng):
    series = [first_order(rng, 400, 0.8) for _ in range(300)]
    found = [autocorrelation(np.arange(400) / RATE, values) for values in series]
    spread = np.std([values.mean() for values in series])
    expected = np.std(series) / math.sqrt(np.mean([f.effective for f in found]))
    assert spread == pytest.approx(expected, rel=0.25)


def test_gaps_of_triggers_and_of_values_do_not_move_the_autocorrelation(rng):
    time, values = np.arange(20_000) / RATE, first_order(rng, 20_000, 0.7)
    whole = autocorrelation(time, values)
    lost = rng.random(len(values)) < 0.2
    for found in (
        autocorrelation(time, np.where(lost, np.nan, values)),
        autocorrelation(time[~lost], values[~lost]),
    ):
        assert found.samples == (~lost).sum()
        assert found.lag_one == pytest.approx(whole.lag_one, abs=0.03)
        assert found.decorrelation == pytest.approx(whole.decorrelation, rel=0.2)


def test_a_gap_of_years_is_no_matter_of_memory(rng):
    time = np.arange(1000) / RATE
    time[500:] += 1e9
    found = autocorrelation(time, first_order(rng, 1000, 0.5))
    assert found.lag_one == pytest.approx(0.5, abs=0.1)


def test_alternating_residuals_are_worth_no_more_than_they_are():
    found = autocorrelation(np.arange(100) / RATE, np.tile([1.0, -1.0], 50))
    assert found.lag_one == pytest.approx(-1.0)
    assert found.effective == 100


@pytest.mark.parametrize(
    "values", [np.zeros(0), np.ones(3), np.full(50, 0.1), np.full(50, np.nan)], ids=str
)
def test_too_few_or_constant_residuals_tell_nothing(values):
    found = autocorrelation(np.arange(len(values)) / RATE, values)
    assert found.samples == np.isfinite(values).sum()
    assert math.isnan(found.lag_one) and math.isnan(found.effective)


def test_gaps_are_found_the_longest_first():
    time = np.array([0.0, 0.25, 0.5, 1.5, 1.75, 2.0, 5.0, 5.25, 5.6])
    assert [(gap.start, gap.duration) for gap in find_gaps(time)] == [(2.0, 3.0), (0.5, 1.0)]
    assert find_gaps(np.arange(100) * 0.25) == ()
    assert find_gaps(np.array([1.0])) == find_gaps(np.zeros(0)) == ()


@pytest.fixture
def spoilt(rng):
    """Two hundred samples at 4 Hz with known holes."""
    samples = make_samples(
        rng.normal(size=(200, 3)), rng.normal(size=(200, 6)), {"a": rng.normal(size=(200, 3))}
    )
    samples.wrench[10:20, 2] = np.nan
    samples.position[190:] = np.nan
    samples.status[30:33, 0] = 1
    samples.status[40:44, 0] = 2
    samples.status[60:65, 0] = 3
    return samples


def test_drop_outs_are_counted_by_measurement(spoilt):
    segment = Segment("span", 0.0, 4.0, slice(0, 17))
    lost = find_drop_outs(spoilt, segment)
    assert tuple(lost.loc["Mz", ["missing [1]", "of them in the segment [1]"]]) == (10, 7)
    assert lost.loc["Mz", "missing [%]"] == pytest.approx(5.0)
    longest = lost["longest [s]"]
    assert longest["Mz"] == pytest.approx(11 / RATE)  # from the last value to the next
    assert longest["limb position"] == pytest.approx(10 / RATE)  # to the end
    assert lost.loc["Mx", "missing [1]"] == 0 and longest["Mx"] == 0.0
    assert math.isnan(lost.loc["Mx", "saturated [1]"])
    counts = ["missing [1]", "saturated [1]", "out of range [1]"]
    assert tuple(lost.loc["a (Fx, Fy, Fz)", counts]) == (4, 3, 5)
    flags = unusable(spoilt)
    assert {name: int(f.sum()) for name, f in flags.items() if f.any()} == {
        "Mz": 10, "limb position": 10, "a (Fx, Fy, Fz)": 12,
    }  # fmt: skip


def test_triggers_are_described(spoilt):
    kept = np.r_[0:50, 80:200]
    found = describe_triggers(spoilt[kept])
    assert (found.count, found.complete) == (170, 150)
    assert found.period == pytest.approx(0.25)
    (gap,) = found.gaps
    assert gap.duration == pytest.approx(31 / RATE) and gap.start == pytest.approx(49 / RATE)


@pytest.mark.parametrize("count", [10, 1000, 1001, 12_345])
@pytest.mark.parametrize("most", [10, 100, 1000])
def test_a_thinned_line_keeps_its_peaks_and_its_order(rng, count, most):
    x, y = np.arange(count) / RATE, rng.normal(size=count)
    thin_x, thin_y = thin(x, y, most)
    assert len(thin_x) <= max(most, 2) or len(x) <= most
    assert (np.diff(thin_x) >= 0.0).all()
    assert thin_y.min() == y.min() and thin_y.max() == y.max()
    np.testing.assert_array_equal(thin_y, y[np.round(thin_x * RATE).astype(int)])


def test_every_peak_is_within_a_piece_of_its_place(rng):
    y = np.zeros(100_000)
    peaks = rng.choice(100_000, 50, replace=False)
    y[peaks] = rng.uniform(1.0, 2.0, 50) * rng.choice([-1.0, 1.0], 50)
    x, kept = thin(np.arange(100_000.0), y, 4000)
    assert set(x[kept != 0.0]) == set(peaks.astype(float))


def test_a_gap_stays_a_gap(rng):
    y = rng.normal(size=10_000)
    y[4000:6000] = np.nan
    x, kept = thin(np.arange(10_000.0), y, 500)
    assert np.isnan(kept[(x >= 4100) & (x < 5900)]).all()
    assert np.isfinite(kept[(x < 3900) | (x > 6100)]).all()


def test_the_quoted_figures_are_means_and_medians():
    rng = np.random.default_rng(1)
    errors = [
        channel_errors(name, rng.normal(size=50), rng.normal(size=50))
        for name in ("Mx", "My", "Mz", "Fx", "Fy", "Fz", "a.Fx", "a.Fy", "Mid.Fx")
    ]
    found = summarise_errors(errors)
    rmse = np.array([error.rmse for error in errors])
    sigma = np.array([error.sigma for error in errors])
    assert found.moment_rmse == pytest.approx(rmse[:3].mean())
    assert found.force_rmse == pytest.approx(rmse[3:6].mean())
    assert found.local_rmse == pytest.approx(np.median(rmse[6:]))
    assert found.local_unsteadiness == pytest.approx(
        np.linalg.norm(sigma[6:]) / np.linalg.norm(rmse[6:])
    )
    assert found.skill == pytest.approx(np.median([error.skill for error in errors]))
    assert found.without_value == ()


def test_a_channel_without_a_value_is_named_and_counts_in_nothing():
    rng = np.random.default_rng(2)
    values = rng.normal(size=(2, 30))
    known = [channel_errors(name, *values) for name in ("Mx", "Fx", "a.Fx")]
    dead = [channel_errors(name, np.full(30, np.nan), values[1]) for name in ("Mz", "a.Fy")]
    found = summarise_errors([*known, *dead])
    assert found.without_value == ("Mz", "a.Fy")
    assert dataclasses.replace(found, without_value=()) == summarise_errors(known)
    assert math.isnan(summarise_errors(dead).moment_rmse)
    assert math.isnan(summarise_errors([]).local_rmse)


def test_predictions_do_not_depend_on_the_chunks(monkeypatch):
    from support.problems import make_case

    _, bed, samples, _ = make_case(3, gaps=True)
    whole = predict_channels(bed, samples.position, samples.clusters)
    errors = evaluate(samples, bed)
    monkeypatch.setattr("socket_testbed.identification.evaluation._CHUNK", 7)
    chunked = predict_channels(bed, samples.position, samples.clusters)
    np.testing.assert_allclose(chunked, whole, rtol=1e-12)
    np.testing.assert_allclose(
        [e.rmse for e in evaluate(samples, bed)], [e.rmse for e in errors], rtol=1e-12
    )
