"""The force map against an independent conditioning, and its properties."""

from dataclasses import replace

import numpy as np
import pytest
from support.problems import make_samples

from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.force_map import (
    ForceMap,
    MapEstimate,
    _draw,
    _mapping,
    _noise,
    _prior,
    _rice_deviation,
    _rigid_motions,
    map_samples,
    surface_correlation,
)
from socket_testbed.identification.validation import close_wrench, inverse_distance
from socket_testbed.samples import Samples, Status
from socket_testbed.settings.identification import ForceMapSettings
from socket_testbed.simulation.limb import LoadedLimb, TissueKind

GEOMETRY = read_socket(packaged("config", "socket.yaml"))
CLUSTERS = tuple(GEOMETRY.clusters)
LOAD = np.array([0.5, 1.5, 0.0, 5.0, -3.0, -270.0])  # [N m, N]


def some_samples(count: int = 6, seed: int = 0) -> Samples:
    """Samples without a physical meaning: what holds for the map holds for any values."""
    rng = np.random.default_rng(seed)
    wrench = rng.normal(0.0, [1.0, 1.0, 0.3, 5.0, 5.0, 50.0], (count, 6)) - [0, 0, 0, 0, 0, 200.0]
    local = rng.normal(0.0, [1.0, 1.0, 3.0], (4, count, 3)) - [0.0, 0.0, 6.0]
    return make_samples(np.zeros((count, 3)), wrench, dict(zip(CLUSTERS, local, strict=True)))


@pytest.fixture(scope="module")
def force_map() -> ForceMap:
    return ForceMap(GEOMETRY, CLUSTERS)


def fields(estimate: MapEstimate) -> list[np.ndarray]:
    return [value for value in vars(estimate).values() if isinstance(value, np.ndarray)]


def test_the_correlation_of_the_surface_is_positive_definite() -> None:
    for length in (0.01, 0.05, 0.3):
        correlation = surface_correlation(GEOMETRY, length)
        assert np.linalg.eigvalsh(correlation).min() > 0.0
        np.testing.assert_allclose(np.diag(correlation), 1.0)


def test_live_and_offline_agree_and_pressures_are_those_of_the_forces(force_map: ForceMap) -> None:
    samples = some_samples()
    samples.status[2, 1] = Status.SATURATED
    samples.wrench[3, 4] = np.nan
    together = force_map.estimate(samples)
    for k in range(len(samples)):
        alone = force_map.update(samples.wrench[k], samples.local_forces[k], samples.status[k])
        for one, many in zip(fields(alone), fields(together), strict=True):
            np.testing.assert_allclose(one[0], many[k], rtol=1e-9, atol=1e-9)
    local = np.einsum("nji,knj->kni", GEOMETRY.rotations, together.forces)
    np.testing.assert_allclose(together.normal_pressure, -local[..., 2] / GEOMETRY.areas)
    shear = np.linalg.norm(local[..., :2], axis=-1) / GEOMETRY.areas
    np.testing.assert_allclose(together.shear, shear)


def test_a_dropped_channel_is_as_if_it_never_was() -> None:
    """It leaves the map of a socket that has one cluster less."""
    samples = some_samples()
    samples.status[:, 3] = Status.MISSING
    dropped = ForceMap(GEOMETRY, CLUSTERS).estimate(samples)
    fewer = replace(GEOMETRY, clusters={c: GEOMETRY.clusters[c] for c in CLUSTERS[:3]})
    three = replace(
        samples,
        clusters=CLUSTERS[:3],
        local_forces=samples.local_forces[:, :3],
        status=samples.status[:, :3],
    )
    never = ForceMap(fewer, CLUSTERS[:3]).estimate(three)
    for one, other in zip(fields(dropped), fields(never), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-7)


def test_less_is_known_with_less_measured(force_map: ForceMap) -> None:
    samples = some_samples()
    settings = ForceMapSettings(draws=1, cluster_error_spread=0.0)
    single = ForceMap(GEOMETRY, CLUSTERS, settings)
    complete = single.estimate(samples)
    samples.status[:, 0] = Status.OUT_OF_RANGE
    tile = GEOMETRY.clusters[CLUSTERS[0]]
    without = single.estimate(samples)
    ratio = without.standard_deviations[:, tile] / complete.standard_deviations[:, tile]
    assert ratio.min() > 1.0  # the amplitude is estimated without the cluster, too
    assert ratio.mean() > 2.0
    assert CLUSTERS[0] in complete.source
    assert CLUSTERS[0] not in without.source
    samples.status[:] = Status.MISSING
    samples.wrench[:] = np.nan
    nothing = force_map.estimate(samples)
    assert (nothing.forces == 0.0).all() and (nothing.standard_deviations > 0.0).all()


@pytest.mark.parametrize("tissue", ["soft", "stiff"])
def test_the_truth_of_a_simulated_hold_is_within_the_intervals(tissue: TissueKind) -> None:
    limb = LoadedLimb(GEOMETRY, LOAD, np.random.default_rng(77), tissue)
    truth = limb.step(LOAD, 5.0)[None]
    tiles = list(GEOMETRY.clusters.values())
    local = np.einsum("cji,kcj->kci", GEOMETRY.rotations[tiles], truth[:, tiles])
    samples = replace(some_samples(1), wrench=LOAD[None], local_forces=local)
    estimate = ForceMap(GEOMETRY, CLUSTERS).estimate(samples)

    free = np.setdiff1d(np.arange(len(GEOMETRY)), tiles)
    errors = (estimate.forces - truth)[:, free]
    rival = close_wrench(
        GEOMETRY, inverse_distance(GEOMETRY, CLUSTERS, local), samples.wrench, tiles
    )
    assert np.linalg.norm(errors) < 0.9 * np.linalg.norm((rival - truth)[:, free])
    within = np.abs(errors) < 1.96 * estimate.standard_deviations[:, free]
    assert within.mean() > 0.85


def test_the_shear_s_deviation_is_that_of_a_rice_distribution() -> None:
    random = np.random.default_rng(1)
    for size, sigma in ((0.0, 1.0), (1.0, 1.0), (5.0, 0.5)):
        drawn = random.normal([size, 0.0], sigma, (200_000, 2))
        expected = np.sqrt(np.mean((np.hypot(*drawn.T) - size) ** 2))
        found = _rice_deviation(np.array([size]), np.array([sigma]))[0]
        assert found == pytest.approx(expected, rel=0.01)


def test_outliers_and_channels_left_out_do_not_count() -> None:
    samples = some_samples(40)
    samples.local_forces[7, 2, 0] = 1e9
    samples.wrench[:, 2] += 40.0
    found = map_samples(samples, GEOMETRY, ForceMapSettings(), ("Mz",))
    samples.local_forces[7, 2, 0] = np.nan
    samples.wrench[:, 2] = np.nan
    expected = ForceMap(GEOMETRY, CLUSTERS).estimate(samples)
    np.testing.assert_allclose(found.forces, expected.forces)


def test_joint_draws_have_the_posterior_of_a_plain_conditioning() -> None:
    """With one draw of the prior's sizes, the posterior is a multivariate t distribution."""
    settings = ForceMapSettings(draws=1, cluster_error_spread=0.0, spread=0.0)
    force_map = ForceMap(GEOMETRY, CLUSTERS, settings)
    samples = some_samples(1)
    samples.status[0, 2] = Status.MISSING
    (joint,) = force_map.sample(samples, 6000)
    assert joint.rows.tolist() == [0]
    draws = joint.values()[0]

    (drawn, *_) = _draw(settings)
    correlation = surface_correlation(GEOMETRY, settings.length)
    prior = _prior(GEOMETRY, correlation, _rigid_motions(GEOMETRY, settings.arm), drawn)
    kept = np.repeat([True, True, True, True, False, True], 3)
    mapping = _mapping(GEOMETRY, CLUSTERS, drawn.share)
    total = mapping @ prior @ mapping.T
    total = (total + _noise(total, drawn))[np.ix_(kept, kept)]
    mapping = mapping[kept]
    measured = np.concatenate([samples.wrench[0], samples.local_forces[0].ravel()])[kept]
    gain = np.linalg.solve(total, mapping @ prior).T
    square = measured @ np.linalg.solve(total, measured)
    covariance = (prior - gain @ mapping @ prior) * (6.0 + square) / (6.0 + 15.0 - 2.0)

    deviation = np.sqrt(np.diag(covariance))
    assert np.abs((draws.mean(axis=0) - gain @ measured) / deviation).max() < 1e-6  # in pairs
    found = np.cov(draws.T) / np.outer(deviation, deviation)
    expected = covariance / np.outer(deviation, deviation)
    assert np.abs(found - expected).max() < 0.1
    assert np.abs(found - expected).mean() < 0.02  # 3000 pairs


def test_joint_draws_agree_with_the_map(force_map: ForceMap) -> None:
    samples = some_samples(5)
    samples.status[2, 1] = Status.SATURATED
    estimate = force_map.estimate(samples)
    seen = []
    for draws in force_map.sample(samples, 1000):
        rows = draws.rows
        seen += rows.tolist()
        forces = np.einsum(
            "nij,kdnj->kdni", GEOMETRY.rotations, draws.values().reshape(len(rows), 1000, -1, 3)
        )
        mean = np.einsum("nij,knj->kni", GEOMETRY.rotations, draws.mean().reshape(len(rows), -1, 3))
        np.testing.assert_allclose(mean, estimate.forces[rows], atol=1e-7)  # [N]
        deviation = estimate.standard_deviations[rows]
        assert np.abs((forces.mean(axis=1) - estimate.forces[rows]) / deviation).max() < 0.1
        ratio = forces.std(axis=1) / deviation
        assert 0.9 < np.median(ratio) < 1.1
    assert sorted(seen) == [0, 1, 2, 3, 4]
