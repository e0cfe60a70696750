"""The force map of live samples, without ROS."""

import dataclasses
from pathlib import Path

import numpy as np

from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.force_map import ForceMap, MapEstimate
from socket_testbed.identification.pressure import THRESHOLD, pressure_outputs
from socket_testbed.live.estimator import OnlineMap
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import ForceMapSettings, IdentificationSettings
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.trial import Trial

GEOMETRY = read_socket(packaged("config", "socket.yaml"))
CLUSTERS = tuple(GEOMETRY.clusters)
PRIOR = ForceMapSettings(draws=4)


def sample(wrench: np.ndarray, forces: np.ndarray) -> Samples:
    unknown = np.full((1, 3), np.nan)
    status = np.zeros((1, len(CLUSTERS)), np.uint8)
    return Samples(np.zeros(1, int), unknown, unknown, wrench[None], CLUSTERS, forces[None], status)


FORCES = np.random.default_rng(0).normal([0.0, 0.0, -9.0], 3.0, (len(CLUSTERS), 3))
WRENCH = np.array([2.0, -3.0, 0.5, 10.0, 20.0, -280.0])
SAMPLE = sample(WRENCH, FORCES)


def same(found: MapEstimate, other: MapEstimate) -> bool:
    assert found.source == other.source
    return all(
        np.allclose(getattr(found, field.name), getattr(other, field.name), rtol=1e-9)
        for field in dataclasses.fields(MapEstimate)
        if field.name != "source"
    )


def test_channels_that_are_left_out_or_that_no_limb_gives_do_not_count() -> None:
    """And a changed prior counts from the next sample."""
    settings = EstimatorSettings(force_map=PRIOR)
    live = OnlineMap(GEOMETRY, lambda: settings)

    def usual(taken: Samples, prior: ForceMapSettings = PRIOR) -> MapEstimate:
        return ForceMap(GEOMETRY, CLUSTERS, prior).update(taken)

    assert same(live.update(SAMPLE), usual(SAMPLE)) and live.count == 1
    live = OnlineMap(GEOMETRY, lambda: settings)
    spoilt, lacking = WRENCH.copy(), WRENCH.copy()
    spoilt[3], lacking[3] = 1e9, np.nan
    assert same(live.update(sample(spoilt, FORCES)), usual(sample(lacking, FORCES)))
    without = FORCES.copy()
    without[CLUSTERS.index("distal"), 2] = np.nan
    left_out = IdentificationSettings(leave_out=("distal.Fz", "no such channel"))
    prior = dataclasses.replace(PRIOR, length=0.1)
    settings = EstimatorSettings(identification=left_out, force_map=prior)
    assert same(live.update(SAMPLE), usual(sample(WRENCH, without), prior))


def test_outputs_of_a_sample_are_those_of_pressure_and_none_without_a_value(hold: Path) -> None:
    trial = Trial(hold)
    geometry, one = trial.geometry, trial.samples()[100:101]
    live = OnlineMap(geometry, EstimatorSettings)
    live.update(one)
    found = live.outputs()
    whole = ForceMap(geometry, one.clusters)
    whole.update(one)
    theirs = pressure_outputs(whole, one, geometry, live.places, THRESHOLD).regions
    assert found is not None
    for name in ("mean", "peak", "area", "share"):
        for end in ("value", "high"):
            ours, known = (getattr(getattr(of, name), end) for of in (found.regions, theirs))
            np.testing.assert_allclose(ours, known, rtol=1e-9)
    live.update(dataclasses.replace(one, wrench=one.wrench * np.nan, status=one.status + 2))
    assert live.outputs() is None
