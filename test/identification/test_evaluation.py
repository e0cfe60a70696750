"""Errors per channel against hand formulas."""

import dataclasses
import math

import numpy as np
import pytest
from support.problems import moving_limb, random_bed, random_socket, samples_of_bed

from socket_testbed.identification.evaluation import channel_errors, errors_to_dataframe, evaluate
from socket_testbed.samples import channel_unit


def test_errors_of_a_small_channel_by_hand():
    found = channel_errors(
        "Fx", np.array([1.0, 2.0, 3.0, 6.0]), np.array([2.0, 2.0, 1.0, 6.0]), in_objective=False
    )
    # Residuals 1, 0, -2, 0 with mean -1/4; measured with mean 3 and variance 14/4.
    assert found.rmse == pytest.approx(math.sqrt(5.0 / 4.0))
    assert found.mae == pytest.approx(3.0 / 4.0)
    assert found.sigma == pytest.approx(math.sqrt(5.0 / 4.0 - 1.0 / 16.0))
    assert found.skill == pytest.approx(1.0 - math.sqrt(5.0 / 14.0))
    assert (found.name, found.unit, found.samples, found.in_objective) == ("Fx", "N", 4, False)


@pytest.mark.parametrize("seed", range(3))
def test_the_mean_square_is_spread_plus_offset(seed):
    rng = np.random.default_rng(seed)
    measured, predicted = rng.normal(size=50), rng.normal(2.0, 1.0, 50)
    found = channel_errors("Fx", measured, predicted)
    offset = (predicted - measured).mean()
    assert found.rmse**2 == pytest.approx(found.sigma**2 + offset**2)
    assert found.mae <= found.rmse


def test_a_perfect_prediction_has_all_skill_and_the_best_constant_none():
    measured = np.array([1.0, -2.0, 4.0, 0.5])
    perfect = channel_errors("Fx", measured, measured)
    assert (perfect.rmse, perfect.mae, perfect.sigma, perfect.skill) == (0.0, 0.0, 0.0, 1.0)
    constant = channel_errors("Fx", measured, np.full(4, measured.mean()))
    assert constant.skill == pytest.approx(0.0, abs=1e-12)
    worse = channel_errors("Fx", measured, np.full(4, measured.mean() + 1.0))
    assert worse.skill < 0.0


def test_samples_without_a_value_are_left_out():
    measured = np.array([1.0, np.nan, 3.0, 6.0, 9.0])
    predicted = np.array([2.0, 2.0, np.nan, 6.0, np.inf])
    found = channel_errors("Mx", measured, predicted)
    assert found == channel_errors("Mx", measured[[0, 3]], predicted[[0, 3]])
    assert found.samples == 2


@pytest.mark.parametrize("count", [0, 4])
def test_a_channel_without_any_value_has_no_errors(count):
    found = channel_errors("Mx", np.full(count, np.nan), np.zeros(count))
    assert found.samples == 0
    assert all(math.isnan(v) for v in (found.rmse, found.mae, found.sigma, found.skill))


@pytest.mark.parametrize("value", [0.0, 2.5, 0.1, -1.1e3, 1e-7])
@pytest.mark.parametrize("count", [1, 3, 7, 1000])
def test_a_constant_channel_has_no_skill(value, count):
    found = channel_errors("Fx", np.full(count, value), np.full(count, value + 1.0))
    assert found.rmse == pytest.approx(1.0)
    assert math.isnan(found.skill)


@pytest.mark.parametrize(
    ("name", "unit"),
    [("Mx", "N m"), ("Mz", "N m"), ("Fx", "N"), ("distal.Fz", "N"), ("Mid.Fx", "N")],
)
def test_a_channels_unit_follows_its_name(name, unit):
    assert channel_unit(name) == unit


@pytest.fixture
def case():
    rng = np.random.default_rng(5)
    geometry = random_socket(rng)
    bed = random_bed(rng, geometry, "stiffness_bias")
    return samples_of_bed(rng, bed, moving_limb(rng, 30)), bed


def test_the_truth_has_no_errors_in_any_channel(case):
    samples, bed = case
    errors = evaluate(samples, bed)
    assert tuple(e.name for e in errors) == samples.channels
    assert max(e.rmse for e in errors) < 1e-10
    assert all(e.samples == 30 for e in errors)


def test_each_error_belongs_to_its_own_channel(case):
    samples, bed = case
    shifts = np.arange(1.0, 1.0 + len(samples.channels))
    local = samples.local_forces + shifts[6:].reshape(1, -1, 3)
    shifted = dataclasses.replace(samples, wrench=samples.wrench + shifts[:6], local_forces=local)
    errors = evaluate(shifted, bed)
    np.testing.assert_allclose([e.rmse for e in errors], shifts, rtol=1e-9)
    np.testing.assert_allclose([e.sigma for e in errors], 0.0, atol=1e-9)


def test_channels_left_out_of_the_objective_are_marked_and_still_judged(case):
    samples, bed = case
    left_out = ("My", "cluster_1.Fz")
    errors = evaluate(samples, bed, left_out)
    assert tuple(e.name for e in errors if not e.in_objective) == left_out
    assert all(math.isfinite(e.rmse) for e in errors)


def test_an_unknown_limb_position_counts_in_no_channel(case):
    samples, bed = case
    position = samples.position.copy()
    position[[2, 9]] = np.nan
    errors = evaluate(dataclasses.replace(samples, position=position), bed)
    assert {e.samples for e in errors} == {28}


def test_the_errors_are_a_table_by_channel(case):
    samples, bed = case
    shifted = dataclasses.replace(samples, wrench=samples.wrench + 2.0)
    errors = evaluate(shifted, bed, ("My",))
    table = errors_to_dataframe(errors)
    assert tuple(table.index) == samples.channels and table.index.name == "channel"
    np.testing.assert_allclose(table.loc["Mx":"Fz", "RMSE"], 2.0)
    assert table.loc["Mz", "unit"] == "N m" and table.loc["cluster_0.Fz", "unit"] == "N"
    assert table["skill"].tolist() == pytest.approx([e.skill for e in errors])
    assert table.index[~table["in objective"]].tolist() == ["My"]
