"""Rivals against their definitions, and judgements against known answers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize
from support.problems import make_samples, random_socket

from socket_testbed.identification.contact import wrench_map
from socket_testbed.identification.validation import (
    CONSTANT,
    REGRESSION,
    close_wrench,
    fit_regression,
    inverse_distance,
    judge_wrench,
    loaded_rows,
    without_cluster,
    wrench_rivals,
)


def local_to_socket(geometry, local):
    return np.einsum("iab,...ib->...ia", geometry.rotations, local)


def moving_samples(rng, count=60, slope=None, noise=0.0):
    """Samples whose wrench is linear in the pose, plus noise."""
    slope = rng.normal(size=(6, 6)) * 1e4 if slope is None else slope
    pose = rng.normal(0.0, 1e-3, (count, 6)) + rng.normal(size=6)
    wrench = rng.normal(size=6) + pose @ slope + noise * rng.normal(size=(count, 6))
    samples = make_samples(pose[:, :3], wrench, {"cluster_0": np.zeros((count, 3))})
    return dataclasses.replace(samples, rotation=pose[:, 3:]), slope


@pytest.mark.parametrize("seed", range(3))
def test_a_uniform_pressure_is_interpolated_exactly(seed):
    rng = np.random.default_rng(seed)
    geometry = random_socket(rng)
    local = rng.normal(size=3)
    given = np.tile(local, (5, len(geometry.clusters), 1))
    found = inverse_distance(geometry, tuple(geometry.clusters), given)
    expected = local_to_socket(geometry, np.tile(local, (len(geometry), 1)))
    assert np.allclose(found, expected)


def test_a_cluster_s_tile_keeps_its_force_and_two_clusters_share_by_distance():
    rng = np.random.default_rng(1)
    geometry = random_socket(rng, clusters=2)
    given = rng.normal(size=(4, 2, 3))
    found = inverse_distance(geometry, tuple(geometry.clusters), given)
    a, b = geometry.clusters.values()
    for column, tile in enumerate((a, b)):
        expected = given[:, column] @ geometry.rotations[tile].T
        assert np.allclose(found[:, tile], expected, rtol=1e-6, atol=1e-6)
    other = next(i for i in range(len(geometry)) if i not in (a, b))
    squared = [np.sum((geometry.anchors[other] - geometry.anchors[i]) ** 2) for i in (a, b)]
    share = squared[1] / (squared[0] + squared[1])  # of the first: the nearer counts more
    local = share * given[:, 0] + (1.0 - share) * given[:, 1]
    assert np.allclose(found[:, other], local @ geometry.rotations[other].T)


def test_a_cluster_without_a_value_does_not_count():
    rng = np.random.default_rng(2)
    geometry = random_socket(rng, clusters=3)
    names = tuple(geometry.clusters)
    given = rng.normal(size=(3, 3, 3))
    given[1, 2, 0] = np.nan
    given[2] = np.nan
    found = inverse_distance(geometry, names, given)
    alone = inverse_distance(geometry, names[:2], given[:, :2])
    assert np.allclose(found[1], alone[1])
    assert not np.allclose(found[0], alone[0])
    assert np.isnan(found[2]).all()


@pytest.mark.parametrize("held", [(), (0, 3)])
def test_the_closed_wrench_is_met_by_the_smallest_change(held):
    rng = np.random.default_rng(3)
    geometry = random_socket(rng)
    geometry = dataclasses.replace(geometry, areas=rng.uniform(5e-4, 2e-3, len(geometry)))
    forces = rng.normal(size=(2, len(geometry), 3))
    wrench = rng.normal(0.0, [1.0] * 3 + [50.0] * 3, (2, 6))
    found = close_wrench(geometry, forces, wrench, held)
    mapping = wrench_map(geometry.anchors)
    assert np.allclose(found.reshape(2, -1) @ mapping.T, wrench)
    assert np.array_equal(found[:, list(held)], forces[:, list(held)])

    free = [i for i in range(len(geometry)) if i not in held]
    columns = np.array([3 * i + axis for i in free for axis in range(3)])
    weights = 1e-3 / np.repeat(geometry.areas[free], 3)
    lacking = wrench[0] - mapping @ forces[0].ravel()
    least = minimize(  # an independent solver
        lambda x: 0.5 * weights @ x**2,
        np.zeros(len(columns)),
        jac=lambda x: weights * x,
        method="SLSQP",
        constraints={
            "type": "eq",
            "fun": lambda x: mapping[:, columns] @ x - lacking,
            "jac": lambda x: mapping[:, columns],
        },
        options={"ftol": 1e-14, "maxiter": 500},
    )
    change = (found[0] - forces[0]).ravel()[columns]
    assert np.allclose(change, least.x, atol=1e-4 * np.abs(least.x).max())


def test_the_regression_finds_a_linear_law_and_ignores_a_pose_that_does_not_move():
    rng = np.random.default_rng(4)
    samples, slope = moving_samples(rng)
    found = fit_regression(samples.pose, samples.wrench)
    assert np.allclose(found.slope, slope, rtol=1e-6)
    assert np.allclose(found.predict(samples.pose), samples.wrench)
    pose = samples.pose.copy()
    pose[:, 4] = 0.3  # constant
    pose[:, 5] = 2.0 * pose[:, 0]  # and one that is another's multiple
    found = fit_regression(pose, pose[:, :4] @ slope[:4])
    assert np.allclose(found.predict(pose), pose[:, :4] @ slope[:4])
    assert np.all(found.slope[4] == 0.0)


def test_the_wrench_s_rivals_have_the_skill_that_they_must():
    rng = np.random.default_rng(5)
    samples, slope = moving_samples(rng, 200, noise=0.5)
    samples.wrench[3] = np.nan  # passed over
    rivals = wrench_rivals(samples)
    found = {j.predictor: j for j in judge_wrench(samples, rivals, "a", "a", in_sample=True)}
    assert found[CONSTANT].moment_skill == pytest.approx(0.0, abs=1e-12)
    assert found[CONSTANT].force_skill == pytest.approx(0.0, abs=1e-12)
    assert found[REGRESSION].force_rmse == pytest.approx(0.5, rel=0.1)
    assert found[REGRESSION].moment_skill > 0.9
    assert all(j.in_sample and j.samples == 199 for j in found.values())

    other, _ = moving_samples(rng, slope=slope)
    by_hand = other.wrench - np.nanmean(samples.wrench, axis=0)
    found = {j.predictor: j for j in judge_wrench(other, rivals, "a", "b")}
    rmse = np.sqrt(np.mean(by_hand**2, axis=0))
    assert found[CONSTANT].moment_rmse == pytest.approx(rmse[:3].mean())
    assert found[CONSTANT].force_skill == pytest.approx(
        1.0 - rmse[3:].mean() / other.wrench[:, 3:].std(axis=0).mean()
    )
    assert found[CONSTANT].force_skill <= 0.0


def test_loaded_samples_are_complete_and_pressed():
    rng = np.random.default_rng(6)
    samples, _ = moving_samples(rng, 5)
    samples.wrench[:, 3:] = [[0, 0, -30], [0, 0, -5], [30, 0, 0], [0, np.nan, -40], [0, 0, -40]]
    samples.position[4, 0] = np.nan
    assert loaded_rows(samples, 20.0).tolist() == [True, False, True, False, False]


def test_a_left_out_cluster_is_missing_and_nothing_else_changes():
    rng = np.random.default_rng(7)
    forces = {name: rng.normal(size=(4, 3)) for name in ("cluster_0", "cluster_1")}
    samples = make_samples(np.zeros((4, 3)), np.zeros((4, 6)), forces)
    less = without_cluster(samples, "cluster_1")
    assert np.isnan(less.trusted_forces[:, 1]).all()
    assert np.array_equal(less.trusted_forces[:, 0], samples.trusted_forces[:, 0])
    assert np.isfinite(samples.trusted_forces).all()
