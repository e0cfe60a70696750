"""Errors per channel against hand formulas."""

import dataclasses
import math

import numpy as np
import pytest
from support.problems import moving_limb, random_bed, random_socket, samples_of_bed

from socket_testbed.identification.evaluation import (
    channel_errors,
    errors_to_dataframe,
    evaluate,
    summarise_errors,
)


def test_errors_are_those_by_hand_of_the_samples_with_a_value_and_a_constant_has_no_skill():
    measured = np.array([1.0, np.nan, 2.0, 3.0, 6.0, 9.0])
    predicted = np.array([2.0, 2.0, 2.0, 1.0, 6.0, np.inf])
    found = channel_errors("Fx", measured, predicted, in_objective=False)
    # Residuals 1, 0, -2, 0 with mean -1/4; measured with mean 3 and variance 14/4.
    assert found.rmse == pytest.approx(math.sqrt(5.0 / 4.0))
    assert found.mae == pytest.approx(3.0 / 4.0)
    assert found.sigma == pytest.approx(math.sqrt(5.0 / 4.0 - 1.0 / 16.0))
    assert found.skill == pytest.approx(1.0 - math.sqrt(5.0 / 14.0))
    assert (found.name, found.unit, found.samples, found.in_objective) == ("Fx", "N", 4, False)
    found = channel_errors("Mx", np.full(4, np.nan), np.zeros(4))
    assert found.samples == 0 and math.isnan(found.rmse) and math.isnan(found.skill)
    found = channel_errors("Fx", np.full(1000, 1e-7), np.full(1000, 1.0 + 1e-7))
    assert found.rmse == pytest.approx(1.0) and math.isnan(found.skill)


def test_each_error_belongs_to_its_own_channel_whatever_the_chunks(monkeypatch):
    monkeypatch.setattr("socket_testbed.identification.evaluation._CHUNK", 7)
    rng = np.random.default_rng(5)
    bed = random_bed(rng, random_socket(rng), "stiffness_bias")
    samples = samples_of_bed(rng, bed, moving_limb(rng, 30))
    shifts = np.arange(1.0, 1.0 + len(samples.channels))
    local = samples.local_forces + shifts[6:].reshape(1, -1, 3)
    shifted = dataclasses.replace(samples, wrench=samples.wrench + shifts[:6], local_forces=local)
    shifted.position[[2, 9]] = np.nan
    table = errors_to_dataframe(evaluate(shifted, bed, ("My",)))
    assert tuple(table.index) == samples.channels and (table["samples"] == 28).all()
    np.testing.assert_allclose(table["RMSE"], shifts, rtol=1e-9)
    np.testing.assert_allclose(table["sigma"], 0.0, atol=1e-9)
    assert table.index[~table["in objective"]].tolist() == ["My"]


def test_the_quoted_figures_are_means_and_medians_of_the_channels_in_the_objective():
    rng = np.random.default_rng(1)
    names = ("Mx", "My", "Mz", "Fx", "Fy", "Fz", "a.Fx", "a.Fy", "Mid.Fx")
    errors = [channel_errors(name, *rng.normal(size=(2, 50))) for name in names]
    left_out = channel_errors("Mx", 1e3 * np.ones(5), np.zeros(5), in_objective=False)
    dead = channel_errors("Mz", np.full(30, np.nan), np.zeros(30))
    found = summarise_errors([*errors, left_out, dead])
    rmse = np.array([error.rmse for error in errors])
    means = (found.moment_rmse, found.force_rmse, found.local_rmse)
    assert means == pytest.approx((rmse[:3].mean(), rmse[3:6].mean(), np.median(rmse[6:])))
    assert found.skill == pytest.approx(np.median([error.skill for error in errors]))
    assert found.without_value == ("Mz",)
