"""The force map of live samples, without ROS."""

import dataclasses
from pathlib import Path

import numpy as np
from support.problems import make_samples

from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.force_map import ForceMap, MapEstimate
from socket_testbed.identification.pressure import THRESHOLD, pressure_outputs
from socket_testbed.live.estimator import OnlineMap
from socket_testbed.settings.identification import ForceMapSettings, IdentificationSettings
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.topics import PYLON_POSE, SOCKET_POSE, STRESS, WRENCH
from socket_testbed.trials.trial import Trial

GEOMETRY = read_socket(packaged("config", "socket.yaml"))
CLUSTERS = tuple(GEOMETRY.clusters)
PRIOR = ForceMapSettings(draws=4)
RNG = np.random.default_rng(0)
STRESSES = {name: (RNG.normal([1e4, 0.0, 0.0], 3e3), 0) for name in CLUSTERS}
MEASURED = np.array([2.0, -3.0, 0.5, 10.0, 20.0, -280.0])
NOTHING = {name: (np.full(3, np.nan), 2) for name in CLUSTERS}


class Bench:
    """A map with settings that a test changes while it runs."""

    def __init__(self, **identification: object) -> None:
        chosen = IdentificationSettings(**identification)
        self.settings = EstimatorSettings(identification=chosen, force_map=PRIOR)
        self.map = OnlineMap(GEOMETRY, lambda: self.settings)

    def send(
        self, stamp: int = 1, wrench: np.ndarray = MEASURED, stresses: dict = STRESSES
    ) -> MapEstimate:
        assert self.map.add(STRESS, stamp, stresses) is None
        found = self.map.add(WRENCH, stamp, wrench)
        assert found is not None
        return found


def expected(
    wrench: np.ndarray = MEASURED, missing: str = "", prior: ForceMapSettings = PRIOR
) -> MapEstimate:
    forces = np.array([GEOMETRY.cluster_force(name, STRESSES[name][0]) for name in CLUSTERS])
    if missing:
        forces[CLUSTERS.index(missing), 2] = np.nan
    named = dict(zip(CLUSTERS, forces[:, None], strict=True))
    sample = make_samples(np.zeros((1, 3)), wrench[None], named)
    return ForceMap(GEOMETRY, CLUSTERS, prior).update(sample)


def assert_same(found: MapEstimate, other: MapEstimate) -> None:
    for field in dataclasses.fields(MapEstimate):
        a, b = getattr(found, field.name), getattr(other, field.name)
        if isinstance(a, str):
            assert a == b
        else:
            np.testing.assert_allclose(a, b, rtol=1e-9, err_msg=field.name)


def test_clusters_and_wrench_make_a_map_without_poses_or_a_model() -> None:
    bench = Bench()
    assert_same(bench.send(), expected())
    for topic, value in ((WRENCH, MEASURED), (SOCKET_POSE, np.zeros(7)), (PYLON_POSE, np.zeros(7))):
        assert bench.map.add(topic, 2, value) is None
    found = bench.map.add(STRESS, 2, STRESSES)
    assert found is not None
    assert_same(found, expected())
    assert bench.map.count == 2
    assert bench.map.add(STRESS, 3, STRESSES) is None
    bench.map.clear()  # time jumps back
    assert bench.map.add(WRENCH, 3, MEASURED) is None


def test_a_channel_that_is_left_out_or_that_no_limb_gives_does_not_count() -> None:
    wrench = MEASURED.copy()
    wrench[3] = np.nan
    spoilt = MEASURED.copy()
    spoilt[3] = 1e9
    assert_same(Bench().send(wrench=spoilt), expected(wrench))
    bench = Bench(leave_out=("distal.Fz", "no such channel"))
    assert_same(bench.send(), expected(missing="distal"))


def test_a_changed_prior_counts_from_the_next_sample() -> None:
    bench = Bench()
    usual = bench.send()
    prior = dataclasses.replace(PRIOR, length=0.1)
    bench.settings = dataclasses.replace(bench.settings, force_map=prior)
    changed = bench.send(2)
    assert_same(changed, expected(prior=prior))
    assert not np.allclose(changed.forces, usual.forces)


# --- outputs by region


def test_outputs_of_a_sample_are_those_of_pressure(hold: Path) -> None:
    trial = Trial(hold)
    geometry, one = trial.geometry, trial.samples()[100:101]
    unit = {c: np.array([geometry.cluster_force(c, axis) for axis in np.eye(3)]) for c in CLUSTERS}
    stresses = {
        name: (np.linalg.solve(unit[name].T, one.local_forces[0, k]), int(one.status[0, k]))
        for k, name in enumerate(one.clusters)
    }
    live = OnlineMap(geometry, EstimatorSettings)
    live.add(STRESS, 1, stresses)
    live.add(WRENCH, 1, one.wrench[0])
    found = live.newest_outputs()
    whole = ForceMap(geometry, one.clusters)
    whole.update(one)
    theirs = pressure_outputs(whole, one, geometry, live.places, THRESHOLD).regions
    assert found is not None
    for name in ("mean", "peak", "area", "share"):
        for end in ("value", "high"):
            ours, known = (getattr(getattr(of, name), end) for of in (found.regions, theirs))
            np.testing.assert_allclose(ours, known, rtol=1e-9)


def test_a_sample_without_any_value_has_no_outputs() -> None:
    bench = Bench()
    bench.send(wrench=np.full(6, np.nan), stresses=NOTHING)
    assert bench.map.newest_outputs() is None
