"""Rivals against their definitions, and judgements against known answers."""

from dataclasses import replace

import numpy as np
import pytest
from support.problems import make_samples, random_socket

from socket_testbed.arrays import evenly
from socket_testbed.identification import validation
from socket_testbed.identification.contact import wrench_map
from socket_testbed.identification.noise import measurement_errors
from socket_testbed.identification.wrench import REGRESSION
from socket_testbed.samples import turned
from socket_testbed.settings.identification import ForceMapSettings


def rivals(geometry):
    """What needs no prior: the interpolations of the clusters."""
    found = validation.field_estimators(geometry, ForceMapSettings())
    return {name: found[name] for name in (validation.INVERSE_DISTANCE, validation.CLOSED)}


def moving_samples(rng, count=60, slope=None, noise=0.0):
    """Samples whose wrench is linear in the pose, plus noise."""
    slope = rng.normal(size=(6, 6)) * 1e4 if slope is None else slope
    pose = rng.normal(0.0, 1e-3, (count, 6)) + rng.normal(size=6)
    wrench = rng.normal(size=6) + pose @ slope + noise * rng.normal(size=(count, 6))
    return make_samples(pose, wrench, {"cluster_0": np.zeros((count, 3))}), slope


def test_clusters_share_by_distance(rng):
    geometry = random_socket(rng, clusters=2)
    given = rng.normal(size=(4, 2, 3))
    given[2, 1, 0] = np.nan
    given[3] = np.nan
    found = validation.inverse_distance(geometry, tuple(geometry.clusters), given)
    local = np.einsum("iba,kib->kia", geometry.rotations, found)
    a, b = geometry.clusters.values()
    for tile, anchor in enumerate(geometry.anchors):
        squared = [max(np.sum((anchor - geometry.anchors[i]) ** 2), 1e-20) for i in (a, b)]
        share = squared[1] / (squared[0] + squared[1])  # of the first: the nearer counts more
        expected = share * given[:2, 0] + (1.0 - share) * given[:2, 1]
        assert np.allclose(local[:2, tile], expected, rtol=1e-6, atol=1e-6)
    assert np.allclose(local[2], given[2, 0])
    assert np.isnan(found[3]).all()


def test_the_wrench_is_met_by_the_smallest_change(rng):
    geometry = random_socket(rng, clusters=2)
    geometry = replace(geometry, areas=rng.uniform(5e-4, 2e-3, len(geometry)))
    forces, held = rng.normal(size=(2, len(geometry), 3)), [0, 3]
    wrench = rng.normal(0.0, [1.0] * 3 + [50.0] * 3, (2, 6))
    found = validation.close_wrench(geometry, forces, wrench, held)
    mapping = wrench_map(geometry.anchors)
    assert np.allclose(found.reshape(2, -1) @ mapping.T, wrench)
    assert np.array_equal(found[:, held], forces[:, held])
    # At the minimum the gradient, the change over the area, is a combination of the constraints.
    free = np.setdiff1d(np.arange(len(geometry)), held)
    gradient = ((found - forces) / geometry.areas[:, None])[:, free].reshape(2, -1).T
    constraints = mapping.reshape(6, -1, 3)[:, free].reshape(6, -1).T
    multipliers = np.linalg.lstsq(constraints, gradient, rcond=None)[0]
    assert np.allclose(constraints @ multipliers, gradient, rtol=1e-6)


@pytest.mark.parametrize("about_y", [0.0, 1e-3], ids=["as-seen", "turned-where-nothing-moved"])
def test_the_regression_finds_a_linear_law(rng, about_y: float):
    """It ignores a direction in which the pose did not move."""
    samples, slope = moving_samples(rng)
    samples.position[:, 1] = 2.0 * samples.position[:, 0]  # another's multiple
    small = 1e-3 * rng.normal(size=(60, 1)) * [1.0, 0.0, 0.0]  # about x alone
    frame = rng.normal(size=3)  # of the limb
    samples.wrench[:] = np.hstack([samples.position, small]) @ slope
    seen = replace(samples, rotation=turned(small, frame))[:30]
    predict = validation.wrench_predictors(seen, {})[REGRESSION]
    turn = turned(small + np.array([0.0, about_y, 0.0]), frame)
    some = np.arange(20, 60)
    found = predict(replace(samples, rotation=turn), some)
    assert np.allclose(found, samples.wrench[some])


def predictions_of(predictors, samples):
    """The wrenches of each predictor at all samples."""
    every = np.arange(len(samples))
    return {name: predict(samples, every) for name, predict in predictors.items()}


def test_a_constant_has_no_skill_in_sample(rng):
    """A regression has the noise for its error."""
    samples, _ = moving_samples(rng, 200, noise=0.5)
    predicted = predictions_of(validation.wrench_predictors(samples, {}), samples)
    judged = validation.judge_wrench(samples.wrench, predicted, "in-sample")
    found = {j.predictor: j for j in judged}
    constant = found[validation.CONSTANT]
    assert (constant.moment_skill, constant.force_skill) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert found[REGRESSION].force_rmse == pytest.approx(0.5, rel=0.1)
    assert found[REGRESSION].moment_skill > 0.9


def test_channels_never_measured_are_judged_by_the_others(rng):
    samples, slope = moving_samples(rng, 200, noise=0.5)
    predictors = validation.wrench_predictors(samples, {})
    other, _ = moving_samples(rng, slope=slope)
    rmse = np.sqrt(np.mean((other.wrench - samples.wrench.mean(axis=0)) ** 2, axis=0))
    other.wrench[:, 2] = np.nan  # Mz was never measured: the others count
    predicted = predictions_of(predictors, other)
    (found,) = (
        judged
        for judged in validation.judge_wrench(other.wrench, predicted, "other trial")
        if judged.predictor == validation.CONSTANT
    )
    assert found.moment_rmse == pytest.approx(rmse[:2].mean())
    skill = 1.0 - rmse[3:].mean() / other.wrench[:, 3:].std(axis=0).mean()
    assert found.force_skill == pytest.approx(skill)


def samples_of_forces(geometry, forces, errors=0.0):
    """Samples of clusters and wrench that measure forces in {S}, shape (N, n, 3)."""
    tiles = [*geometry.clusters.values()]
    local = np.einsum("kca,cab->ckb", forces[:, tiles], geometry.rotations[tiles]) + errors
    wrench = forces.reshape(len(forces), -1) @ wrench_map(geometry.anchors).T
    named = dict(zip(geometry.clusters, local, strict=True))
    return make_samples(np.zeros((len(forces), 3)), wrench, named)


UNIFORM = np.array([1.0, -2.0, -10.0])  # [N] in each tile's frame
NO_NOISE = np.zeros((3, 3))


@pytest.fixture
def uniform(rng):
    """A socket, and samples of a force that is the same on every tile."""
    geometry = random_socket(rng)
    return geometry, samples_of_forces(geometry, np.tile(geometry.rotations @ UNIFORM, (6, 1, 1)))


def test_clusters_that_agree_are_judged_without_error(uniform):
    geometry, samples = uniform
    found = [*validation.judge_clusters(samples, geometry, rivals(geometry), NO_NOISE, "here")]
    assert len(found) == 2 * (3 + 1)
    assert all(j.error < 1e-9 and np.isnan(j.coverage).all() for j in found)


def test_measurement_errors_grow_with_the_force(uniform):
    _, samples = uniform
    settings = ForceMapSettings(cluster_error=0.5, cluster_gain_error=0.1)
    errors = measurement_errors(samples, NO_NOISE, settings)
    assert np.allclose(errors, np.hypot(0.5, [0.1, 0.2, 1.0]))


def test_a_left_out_cluster_is_judged_by_others(uniform):
    """One has nothing in common with them: by hand, its error and that of all."""
    geometry, samples = uniform
    first = [*validation.judge_clusters(samples, geometry, rivals(geometry), NO_NOISE, "here")]
    samples.local_forces[:, 0] = [5.0, 5.0, 5.0]
    samples.status[2:4, 1] = 3  # neither used nor judged
    found = [*validation.judge_clusters(samples, geometry, rivals(geometry), NO_NOISE)]
    chosen = {j.cluster: j for j in found if j.predictor == validation.INVERSE_DISTANCE}
    size = np.sqrt(np.nanmean(samples.trusted_forces**2))
    wrong = np.sqrt(np.mean((UNIFORM - 5.0) ** 2))
    assert chosen["cluster_0"].error == pytest.approx(wrong / size)
    assert chosen["cluster_1"].samples == 4 and chosen["cluster_0"].samples == 6
    table = validation.summarise_judgements([*first, *found])
    row = table.loc["cluster", "left out", validation.INVERSE_DISTANCE]
    assert row["judged [1]"] == 2 and row["worst error [-]"] == chosen[""].error
    assert row["error [-]"] == pytest.approx(0.5 * chosen[""].error)


def test_intervals_hold_what_they_say(rng):
    geometry = random_socket(rng)
    count, spread, noise = 4000, 2.0, 1.5
    truth = rng.normal(size=(count, len(geometry), 3))
    samples = samples_of_forces(geometry, truth, noise * rng.normal(size=(3, count, 3)))

    def estimate(_):
        forces = truth + spread * rng.normal(size=truth.shape)
        return forces, np.full(truth.shape, spread)

    (tiles,) = validation.judge_tiles(samples, geometry, truth, {"map": estimate})
    assert tiles.coverage == pytest.approx((0.5, 0.8, 0.95), abs=0.01)
    assert tiles.error == pytest.approx(spread, rel=0.05)
    stated = np.full((3, 3), noise)
    *_, clusters = validation.judge_clusters(samples, geometry, {"map": estimate}, stated)
    assert clusters.coverage == pytest.approx((0.5, 0.8, 0.95), abs=0.01)
    *_, too_sure = validation.judge_clusters(samples, geometry, {"map": estimate}, 0.0 * stated)
    assert too_sure.coverage[2] < 0.93


def test_tiles_with_a_sensor_do_not_count(rng):
    geometry = random_socket(rng)
    truth = rng.normal(size=(4000, len(geometry), 3))
    samples = samples_of_forces(geometry, truth, 1.5 * rng.normal(size=(3, 4000, 3)))
    closed = rivals(geometry)[validation.CLOSED]
    own = {validation.CLOSED: closed}
    (judged,) = validation.judge_tiles(samples, geometry, truth, own)
    bare = np.setdiff1d(np.arange(len(geometry)), [*geometry.clusters.values()])
    missed = (closed(samples)[0] - truth)[:, bare]
    expected = np.sqrt(np.mean(missed**2) / np.mean(truth[:, bare] ** 2))
    assert judged.error == pytest.approx(expected)


def test_samples_under_load_are_complete_and_pressed(rng):
    samples, _ = moving_samples(rng, 5)
    samples.wrench[:, 3:] = [[0, 0, -30], [0, 0, -5], [30, 0, 0], [0, np.nan, -40], [0, 0, -40]]
    samples.position[4, 0] = np.nan
    samples.wrench[:, 0] = np.nan  # a channel that is never measured is not asked for
    assert samples.under_load(20.0).tolist() == [True, False, True, False, False]


def test_samples_under_load_are_split_in_halves(rng):
    samples, _ = moving_samples(rng, 60)
    samples.wrench[:, 3:] = np.outer(np.arange(60) >= 10, [0.0, 0.0, -100.0])
    first, second = validation.split(samples, 20.0)
    assert first.tolist() == [*range(10, 35)] and second.tolist() == [*range(35, 60)]


def test_rows_that_are_spread_evenly_have_both_ends():
    assert np.arange(10, 60)[evenly(50, 3)].tolist() == [10, 34, 59]
