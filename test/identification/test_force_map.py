"""The force map against an independent conditioning, and its properties."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.problems import make_samples

from socket_testbed.files import packaged
from socket_testbed.geometry.axis import proximal_direction
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.force_map import (
    ForceMap,
    Prior,
    _rice_deviation,
    _rigid_motions,
    hypotheses,
    map_trial,
    wall_correlation,
)
from socket_testbed.samples import Samples, Status
from socket_testbed.settings.identification import ForceMapSettings

GEOMETRY = read_socket(packaged("config", "socket.yaml"))
CLUSTERS = tuple(GEOMETRY.clusters)


def some_samples(count: int = 6, seed: int = 0) -> Samples:
    """Samples without a physical meaning: what holds for the map holds for any values."""
    rng = np.random.default_rng(seed)
    wrench = rng.normal(0.0, [1.0, 1.0, 0.3, 5.0, 5.0, 50.0], (count, 6)) - [0, 0, 0, 0, 0, 200.0]
    local = rng.normal(0.0, [1.0, 1.0, 3.0], (4, count, 3)) - [0.0, 0.0, 6.0]
    return make_samples(np.zeros((count, 3)), wrench, dict(zip(CLUSTERS, local, strict=True)))


def whole_prior(sizes: SimpleNamespace) -> np.ndarray:
    """The prior's covariance as the module's equation states it, shape (3n, 3n)."""
    tiles = len(GEOMETRY)
    correlation = wall_correlation(GEOMETRY, sizes.length)
    bed = np.diag([sizes.bed_shear, sizes.bed_shear, 1.0]) @ _rigid_motions(GEOMETRY, sizes.arm)
    bed /= np.sqrt((bed**2).sum(axis=(0, 1)) / tiles)
    bed *= [sizes.bed, sizes.bed, sizes.sinking, *[sizes.rotation] * 3]
    bed = bed.reshape(-1, 6)
    prior = np.kron(correlation, np.diag([sizes.shear, sizes.shear, 1.0]) ** 2)
    prior += sizes.preload**2 * np.kron(np.ones((tiles, tiles)), np.diag([0.0, 0.0, 1.0]))
    varying = 1.0 + sizes.bed_variation**2 * correlation
    prior += (bed @ bed.T) * np.kron(varying, np.ones((3, 3)))
    drag, proximal = np.eye(3 * tiles), proximal_direction(GEOMETRY) @ GEOMETRY.rotations
    for axis in (0, 1):
        drag[axis::3, 2::3] = np.diag(sizes.drag * proximal[:, axis])
    return sizes.normal_deviation**2 * drag @ prior @ drag.T


def test_the_prior_s_parts_are_its_equation_s() -> None:
    tiles = len(GEOMETRY)
    for sizes in hypotheses(ForceMapSettings())[:3]:
        whole, prior = whole_prior(sizes), Prior(GEOMETRY, CLUSTERS, sizes)
        root = prior.draw(np.eye(9 * tiles + 7))  # a draw is linear in its numbers
        for found in (prior.covariance(), root.T @ root):
            np.testing.assert_allclose(found, whole, atol=1e-9 * whole.max())
        blocks = whole.reshape(tiles, 3, tiles, 3)[np.arange(tiles), :, np.arange(tiles)]
        np.testing.assert_allclose(prior.blocks, blocks, atol=1e-9 * whole.max())
    # Hypotheses follow the stated distributions.
    settings = ForceMapSettings(draws=256, spread=2.0)
    found = hypotheses(settings)
    assert vars(found[0]) == pytest.approx(vars(settings))
    for name, spread in (("sinking", 2.0), ("length", 0.5), ("cluster_error", 1.0)):
        logs = np.log([getattr(sizes, name) / getattr(settings, name) for sizes in found])
        assert abs(np.median(logs)) < 0.1 * spread and abs(logs.std() - spread) < 0.1 * spread
    assert max(sizes.share for sizes in found) <= 1.0


def test_a_trial_s_evidence_weighs_the_hypotheses_of_each_of_its_samples() -> None:
    samples = some_samples(30)
    whole = ForceMap(GEOMETRY, CLUSTERS, trial=samples)
    np.testing.assert_allclose(
        whole.estimate(samples[4:5]).forces[0], whole.estimate(samples).forces[4]
    )
    live = ForceMap(GEOMETRY, CLUSTERS)
    for k in range(30):
        last = live.update(samples[k : k + 1])
    np.testing.assert_allclose(last.forces[0], whole.estimate(samples).forces[29])


def test_a_dropped_channel_is_as_if_it_never_was_and_leaves_less_known() -> None:
    """It leaves the map of a socket that has one cluster less."""
    samples, force_map = some_samples(), ForceMap(GEOMETRY, CLUSTERS, ForceMapSettings(draws=1))
    complete = force_map.estimate(samples)
    local = np.einsum("nji,knj->kni", GEOMETRY.rotations, complete.forces)
    np.testing.assert_allclose(complete.normal_pressure, -local[..., 2] / GEOMETRY.areas)
    shear = np.linalg.norm(local[..., :2], axis=-1) / GEOMETRY.areas
    np.testing.assert_allclose(complete.shear, shear)
    samples.status[:, 3] = Status.OUT_OF_RANGE
    dropped = force_map.estimate(samples)
    fewer = replace(GEOMETRY, clusters={c: GEOMETRY.clusters[c] for c in CLUSTERS[:3]})
    local, status = samples.local_forces[:, :3], samples.status[:, :3]
    three = replace(samples, clusters=CLUSTERS[:3], local_forces=local, status=status)
    never = ForceMap(fewer, CLUSTERS[:3], ForceMapSettings(draws=1)).estimate(three)
    for name, values in vars(never).items():
        if name != "source":
            np.testing.assert_allclose(getattr(dropped, name), values, rtol=1e-6, atol=1e-7)
    tile = GEOMETRY.clusters[CLUSTERS[3]]
    assert (dropped.standard_deviations > complete.standard_deviations)[:, tile].all()
    samples.status[:] = Status.MISSING
    samples.wrench[:] = np.nan
    nothing = force_map.estimate(samples)
    assert (nothing.forces == 0.0).all() and (nothing.standard_deviations > 0.0).all()


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
    force_map, trusted = map_trial(samples, GEOMETRY, ForceMapSettings(), ("Mz",))
    found = force_map.estimate(trusted)
    samples.local_forces[7, 2, 0] = np.nan
    samples.wrench[:, 2] = np.nan
    expected = ForceMap(GEOMETRY, CLUSTERS).estimate(samples)
    np.testing.assert_allclose(found.forces, expected.forces)


def test_joint_draws_have_the_posterior_of_a_plain_conditioning() -> None:
    """With one draw of the prior's sizes, the posterior is a multivariate t distribution."""
    settings = ForceMapSettings(draws=1)
    force_map = ForceMap(GEOMETRY, CLUSTERS, settings)
    samples = some_samples(1)
    samples.status[0, 2] = Status.MISSING
    (joint,) = force_map.sample(samples, 6000)
    assert joint.rows.tolist() == [0]
    draws = joint.values()[0]

    (drawn,) = hypotheses(settings)
    prior = whole_prior(drawn)
    kept = np.repeat([True, True, True, True, False, True], 3)
    parts = Prior(GEOMETRY, CLUSTERS, drawn)
    mapping = parts.mapping
    total = (mapping @ prior @ mapping.T + np.diag(parts.noise))[np.ix_(kept, kept)]
    mapping = mapping[kept]
    measured = np.concatenate([samples.wrench[0], samples.local_forces[0].ravel()])[kept]
    gain = np.linalg.solve(total, mapping @ prior).T
    square = measured @ np.linalg.solve(total, measured)
    covariance = (prior - gain @ mapping @ prior) * (2.0 + square) / (2.0 + 15.0 - 2.0)

    deviation = np.sqrt(np.diag(covariance))
    assert np.abs((draws.mean(axis=0) - gain @ measured) / deviation).max() < 1e-6  # in pairs
    found = np.cov(draws.T) / np.outer(deviation, deviation)
    expected = covariance / np.outer(deviation, deviation)
    assert np.abs(found - expected).max() < 0.1
    assert np.abs(found - expected).mean() < 0.02  # 3000 pairs
    # Of many hypotheses, each has the draws that its probability gives it.
    (joint,) = ForceMap(GEOMETRY, CLUSTERS).sample(samples)
    drawn = np.bincount(joint.hypotheses, minlength=len(joint.weights))
    assert len(drawn) > 3 and np.abs(drawn - 100.0 * joint.weights).max() <= 1.0
