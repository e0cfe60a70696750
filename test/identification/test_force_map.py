"""The force map against an independent conditioning, and the pressures read from it."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from support.outputs import outputs_of
from support.problems import GEOMETRY, make_samples, ring_socket

from socket_testbed.errors import TrialError
from socket_testbed.geometry.regions import all_regions, proximal_direction
from socket_testbed.identification import map_prior, pressure
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.map_prior import Hypothesis, Prior, hypotheses, wall_correlation
from socket_testbed.identification.validation import CLOSED, field_estimators
from socket_testbed.samples import Samples, Status
from socket_testbed.settings.identification import ForceMapSettings
from socket_testbed.simulation.limb import LoadedLimb, TissueKind

CLUSTERS = tuple(GEOMETRY.clusters)


def some_samples(count: int = 6, seed: int = 0) -> Samples:
    """Samples without a physical meaning: what holds for the map holds for any values."""
    rng = np.random.default_rng(seed)
    wrench = rng.normal(0.0, [1.0, 1.0, 0.3, 5.0, 5.0, 50.0], (count, 6)) - [0, 0, 0, 0, 0, 200.0]
    local = rng.normal(0.0, [1.0, 1.0, 3.0], (4, count, 3)) - [0.0, 0.0, 6.0]
    return make_samples(np.zeros((count, 3)), wrench, dict(zip(CLUSTERS, local, strict=True)))


def whole_prior(sizes: Hypothesis) -> np.ndarray:
    """The prior's covariance as the module's equation states it, shape (3n, 3n)."""
    tiles = len(GEOMETRY)
    correlation = wall_correlation(GEOMETRY, sizes.length)
    shares = np.diag([sizes.bed_shear, sizes.bed_shear, 1.0])
    bed = shares @ map_prior._rigid_motions(GEOMETRY, sizes.arm)
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
    for sizes in islice(hypotheses(ForceMapSettings(), None), 3):
        whole, prior = whole_prior(sizes), Prior(GEOMETRY, CLUSTERS, sizes)
        root = prior.draw(np.eye(9 * tiles + 7))  # a draw is linear in its numbers
        for found in (prior.covariance(), root.T @ root):
            np.testing.assert_allclose(found, whole, atol=1e-9 * whole.max())
        blocks = whole.reshape(tiles, 3, tiles, 3)[np.arange(tiles), :, np.arange(tiles)]
        np.testing.assert_allclose(prior.blocks, blocks, atol=1e-9 * whole.max())


def test_hypotheses_follow_the_stated_distributions() -> None:
    settings = ForceMapSettings(draws=256, spread=2.0)
    logs = np.log([sizes.sinking / settings.sinking for sizes in hypotheses(settings, None)])
    assert abs(np.median(logs)) < 0.2 and abs(logs.std() - 2.0) < 0.2


def test_the_whole_trial_weighs_the_hypotheses() -> None:
    samples = some_samples(30)
    whole = ForceMap(GEOMETRY, CLUSTERS, trial=samples)
    alone, among = whole.estimate(samples[4:5]).forces[0], whole.estimate(samples).forces[4]
    np.testing.assert_allclose(alone, among)
    live = ForceMap(GEOMETRY, CLUSTERS)
    for k in range(30):
        last = live.update(samples[k : k + 1])
    np.testing.assert_allclose(last.forces[0], whole.estimate(samples).forces[29])


def test_pressure_and_shear_are_those_of_forces() -> None:
    complete = ForceMap(GEOMETRY, CLUSTERS, ForceMapSettings(draws=1)).estimate(some_samples())
    local = np.einsum("nji,knj->kni", GEOMETRY.rotations, complete.forces)
    np.testing.assert_allclose(complete.normal_pressure, -local[..., 2] / GEOMETRY.areas)
    shear = np.linalg.norm(local[..., :2], axis=-1) / GEOMETRY.areas
    np.testing.assert_allclose(complete.shear, shear)


def test_a_dropped_cluster_is_as_if_never_there() -> None:
    """It leaves the map of a socket that has one cluster less, and less known than before."""
    samples, force_map = some_samples(), ForceMap(GEOMETRY, CLUSTERS, ForceMapSettings(draws=1))
    complete = force_map.estimate(samples)
    samples.status[:, 3] = Status.OUT_OF_RANGE
    dropped = force_map.estimate(samples)
    fewer = replace(GEOMETRY, clusters={c: GEOMETRY.clusters[c] for c in CLUSTERS[:3]})
    local, status = samples.local_forces[:, :3], samples.status[:, :3]
    three = replace(samples, clusters=CLUSTERS[:3], local_forces=local, status=status)
    never = ForceMap(fewer, CLUSTERS[:3], ForceMapSettings(draws=1)).estimate(three)
    for name, values in vars(never).items():
        if name != "source":
            found = getattr(dropped, name)
            np.testing.assert_allclose(found, values, rtol=1e-6, atol=1e-7, err_msg=name)
    tile = GEOMETRY.clusters[CLUSTERS[3]]
    assert (dropped.standard_deviations > complete.standard_deviations)[:, tile].all()


def test_many_samples_have_the_map_of_each_alone() -> None:
    samples = some_samples(200)
    samples.status[10:60, 3] = Status.OUT_OF_RANGE
    samples.wrench[190:] = np.nan
    force_map = ForceMap(GEOMETRY, CLUSTERS, trial=samples)
    assert (force_map._weights(samples).ordinary > 0.0).sum() > 1  # forces differ by hypothesis
    together = force_map.estimate(samples)
    apart = [force_map.estimate(samples[row : row + 1]) for row in range(len(samples))]
    for name, values in vars(together).items():
        if name != "source":
            expected = np.concatenate([getattr(each, name) for each in apart])
            np.testing.assert_allclose(values, expected, rtol=1e-9, atol=1e-9, err_msg=name)


def test_a_map_of_nothing_is_the_prior() -> None:
    samples, force_map = some_samples(), ForceMap(GEOMETRY, CLUSTERS, ForceMapSettings(draws=1))
    samples.status[:] = Status.MISSING
    samples.wrench[:] = np.nan
    nothing = force_map.estimate(samples)
    assert (nothing.forces == 0.0).all() and (nothing.standard_deviations > 0.0).all()


def test_joint_draws_are_a_plain_conditioning_s_posterior() -> None:
    """With one draw of the prior's sizes, the posterior is a multivariate t distribution."""
    settings = ForceMapSettings(draws=1)
    force_map = ForceMap(GEOMETRY, CLUSTERS, settings)
    samples = some_samples(1)
    samples.status[0, 2] = Status.MISSING
    (joint,) = force_map.sample(samples, 6000)
    assert joint.rows.tolist() == [0]
    draws = joint.values()[0]

    (drawn,) = hypotheses(settings, GEOMETRY.tile_share)
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


def test_each_hypothesis_has_its_share_of_draws() -> None:
    """By its probability."""
    samples = some_samples(1)
    samples.status[0, 2] = Status.MISSING
    (joint,) = ForceMap(GEOMETRY, CLUSTERS).sample(samples)
    drawn = np.bincount(joint.hypotheses, minlength=len(joint.weights))
    assert len(drawn) > 3 and np.abs(drawn - 100.0 * joint.weights).max() <= 1.0


# --- Outputs against numpy on known fields, and what their intervals promise


RING = ring_socket()
TILES = len(RING)
THRESHOLD = 5000.0  # [Pa]
LOAD = np.array([0.5, 1.5, 0.0, 5.0, -3.0, -270.0])  # [N m, N]


def samples_at(times: np.ndarray) -> Samples:
    count = len(times)
    local = {name: np.tile([0.5, -0.2, -9.0], (count, 1)) for name in CLUSTERS}
    samples = make_samples(np.zeros((count, 3)), np.tile(LOAD, (count, 1)), local)
    return replace(samples, stamps=(1e9 * times).astype(np.int64))


def test_what_was_not_measured_counts_in_nothing() -> None:
    samples = samples_at(0.25 * np.arange(9))
    samples.wrench[4] = np.nan
    samples.status[4] = Status.SATURATED
    assert pressure.measured_rows(samples).tolist() == [True] * 4 + [False] + [True] * 4
    force_map, regions = ForceMap(RING, CLUSTERS), all_regions(RING)
    found = pressure.pressure_outputs(force_map, samples, RING, regions, THRESHOLD)
    kept = np.arange(9) != 4
    fewer = pressure.pressure_outputs(force_map, samples[kept], RING, regions, THRESHOLD)
    np.testing.assert_allclose(found.regions.peak.value, fewer.regions.peak.value)
    np.testing.assert_allclose(found.regions.mean.high, fewer.regions.mean.high)
    assert np.isnan(found.series.mean.high[4]).all()
    highest = found.estimate.normal_pressure.max(axis=1)
    np.testing.assert_allclose(found.series.peak.value[kept, -1], highest[kept])


def test_a_segment_without_a_measurement_is_refused() -> None:
    samples = samples_at(0.25 * np.arange(9))
    samples.wrench[:] = np.nan
    samples.status[:] = Status.MISSING
    force_map, regions = ForceMap(RING, CLUSTERS), all_regions(RING)
    with pytest.raises(TrialError, match="no sample of the segment has a wrench or a trusted"):
        pressure.pressure_outputs(force_map, samples, RING, regions, THRESHOLD)


@pytest.mark.parametrize(
    ("value", "low", "high", "certain"),
    [
        pytest.param(10.0, 5.0, 15.0, True, id="within-half"),
        pytest.param(10.0, 4.9, 12.0, False, id="too-low"),
        pytest.param(10.0, 8.0, 15.1, False, id="too-high"),
        pytest.param(0.0, -1.0, 1.0, False, id="zero"),
    ],
)
def test_a_value_is_certain_by_its_interval(value, low, high, certain) -> None:
    parts = (np.array([part]) for part in (value, low, high, value))
    assert pressure.Quantity(*parts).certain(0.5).tolist() == [certain]


def test_an_interval_of_directions_crosses_half_a_turn() -> None:
    reader = pressure._Regions(RING, all_regions(RING)[:1])
    drawn = np.radians(np.tile([[179.0], [-179.0]], (100, 1)))  # 2 degrees apart
    direction = reader.interval("direction", np.radians([179.0]), drawn)
    np.testing.assert_allclose(np.degrees([*direction.low, *direction.high]), [179.0, 181.0])


def moving_samples(count: int) -> Samples:
    """A load that comes and goes, noise, and channels that drop out."""
    rng = np.random.default_rng(5)
    samples = samples_at(0.01 * np.arange(count))
    along = np.sin(np.linspace(0.0, 9.0, count))[:, None]
    samples.wrench[:] *= 0.6 + 0.5 * along
    samples.wrench[:] += rng.normal(0.0, 0.2, (count, 6))
    samples.local_forces[:] *= 0.7 - 0.6 * along[..., None]
    samples.local_forces[:] += rng.normal(0.0, 0.3, samples.local_forces.shape)
    samples.position[:] = np.nan  # which the map does not read
    samples.wrench[rng.random(count) < 0.05] = np.nan
    samples.status[rng.random(samples.status.shape) < 0.05] = Status.MISSING
    return samples


def test_a_span_has_the_intervals_of_its_draws():
    """The values are those of its map."""
    samples = moving_samples(120)
    samples.stamps[60:] += 9 * 10**9  # a gap is left out of integrals
    force_map, regions = ForceMap(RING, CLUSTERS, trial=samples), all_regions(RING)
    found = pressure.pressure_outputs(force_map, samples, RING, regions, THRESHOLD)

    def outputs(forces):
        return outputs_of(forces, samples.time, RING, regions, THRESHOLD)

    highest = found.estimate.normal_pressure.max(axis=0)
    np.testing.assert_allclose(found.tiles.peak.value, highest, rtol=1e-9)
    forces, drawn = found.estimate.forces, np.empty((200, 120, TILES, 3))
    for draws in force_map.sample(samples):
        local = draws.values().reshape(-1, 200, TILES, 3)
        drawn[:, draws.rows] = np.einsum("nij,kdnj->dkni", RING.rotations, local)
    of_draws = [outputs(each) for each in drawn]
    widened = [outputs(forces + 1.25 * (each - forces)) for each in drawn]
    areas = np.array([RING.areas[region.tiles].sum() for region in regions])
    for name, of_map in outputs(forces).items():
        own = widened if name in ("peak", "area", "integral") else of_draws
        off = np.array([each[name] for each in own]) - of_map
        if name == "direction":
            off = (off + np.pi) % (2.0 * np.pi) - np.pi
        low, middle, high = np.quantile(off, [0.025, 0.5, 0.975], axis=0)
        if name in ("peak", "area", "integral", "shear"):
            low, high = np.minimum(low, low - middle), np.maximum(high, high - middle)
        ends = [of_map + np.minimum(low, 0.0), of_map + np.maximum(high, 0.0)]
        if name in ("area", "integral", "shear"):
            ends = np.clip(ends, 0.0, areas if name == "area" else np.inf)
        quantity = getattr(found.regions, name)
        ours = (quantity.value, quantity.low, quantity.high)
        np.testing.assert_allclose(ours, (of_map, *ends), rtol=1e-9, atol=1e-9, err_msg=name)


def test_a_hold_is_no_better_known_than_samples():
    """What the channels leave open stays the same."""
    force_map, regions = ForceMap(RING, CLUSTERS, trial=moving_samples(120)), all_regions(RING)
    spans = (samples_at(0.25 * np.arange(count)) for count in (30, 2))
    held = (pressure.pressure_outputs(force_map, s, RING, regions, THRESHOLD) for s in spans)
    widths = (each.regions.mean.high - each.regions.mean.low for each in held)
    np.testing.assert_allclose(*widths, rtol=1e-6)


def test_draws_at_some_samples_suffice(monkeypatch):
    samples = moving_samples(700)
    samples.local_forces[333], samples.wrench[333] = [2.0, -0.8, -80.0], 6.0 * samples.wrench[0]
    samples.status[333] = Status.OK  # a peak of one sample
    force_map, regions = ForceMap(RING, CLUSTERS, trial=samples), all_regions(RING)
    found = pressure.pressure_outputs(force_map, samples, RING, regions, THRESHOLD)
    assert found.integrated == pytest.approx(pressure.integration_weights(samples.time).sum())
    monkeypatch.setattr(pressure, "MAX_DRAWN", 100)
    some = pressure.pressure_outputs(force_map, samples, RING, regions, THRESHOLD)
    assert some.peak_row == found.peak_row == 333
    for name, quantity in vars(some.regions).items():
        expected = getattr(found.regions, name)
        share = 0.2 if name in ("peak", "direction") else 0.05
        width = share * (expected.high - expected.low) + 1e-9
        for part in ("value", "low", "high"):
            off = getattr(quantity, part) - getattr(expected, part)
            assert (np.abs(off) <= width).all(), (name, part)


@pytest.mark.parametrize("tissue", ["soft", "stiff"])
def test_intervals_hold_the_truth_of_simulated_holds(tissue: TissueKind) -> None:
    """Of limbs that the map was not chosen by; `benchmark_force_map.py` has the shares."""
    geometry, clusters, regions = GEOMETRY, CLUSTERS, all_regions(GEOMETRY)
    tiles = list(geometry.clusters.values())
    free = np.setdiff1d(np.arange(len(geometry)), tiles)
    rival = field_estimators(geometry, ForceMapSettings())[CLOSED]
    force_map, within, covered = ForceMap(geometry, clusters), [], []
    for seed in (81, 82, 83):
        limb = LoadedLimb(geometry, LOAD, np.random.default_rng(seed), tissue)
        truth = limb.step(LOAD, 5.0)[None]
        local = np.einsum("cji,kcj->kci", geometry.rotations[tiles], truth[:, tiles])
        samples = replace(samples_at(np.zeros(1)), clusters=clusters, local_forces=local)
        found = pressure.pressure_outputs(force_map, samples, geometry, regions, THRESHOLD)
        true = outputs_of(truth, np.zeros(1), geometry, regions, THRESHOLD)
        for name in ("mean", "peak", "area", "shear", "share"):
            quantity: pressure.Quantity = getattr(found.regions, name)
            low, high = quantity.low - 1e-9, quantity.high + 1e-9
            within += ((low <= true[name]) & (true[name] <= high)).tolist()
        errors = (found.estimate.forces - truth)[:, free]
        missed = (rival(samples)[0] - truth)[:, free]
        assert np.linalg.norm(errors) < 0.9 * np.linalg.norm(missed)
        covered.append(np.abs(errors) < 1.96 * found.estimate.standard_deviations[:, free])
    assert np.mean(within) > 0.8 and np.mean(covered) > 0.78
