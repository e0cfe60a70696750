"""The force map of live samples, without ROS."""

import dataclasses

import numpy as np
import pytest

from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.force_map import ForceMap, MapEstimate
from socket_testbed.live.online_map import OnlineMap
from socket_testbed.settings.identification import ForceMapSettings, IdentificationSettings
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.topics import PYLON_POSE, SOCKET_POSE, STRESS, WRENCH

GEOMETRY = read_socket(packaged("config", "socket.yaml"))
CLUSTERS = tuple(GEOMETRY.clusters)
PRIOR = ForceMapSettings(draws=4)
RNG = np.random.default_rng(0)
STRESSES = {name: (RNG.normal([1e4, 0.0, 0.0], 3e3), 0) for name in CLUSTERS}
MEASURED = np.array([2.0, -3.0, 0.5, 10.0, 20.0, -280.0])


class Bench:
    """A map with settings that a test changes while it runs."""

    def __init__(self, **identification: object) -> None:
        chosen = IdentificationSettings(**identification)
        self.settings = EstimatorSettings(identification=chosen, force_map=PRIOR)
        self.map = OnlineMap(GEOMETRY, lambda: self.settings)

    def send(self, stamp: int = 1, wrench: np.ndarray = MEASURED) -> MapEstimate:
        assert self.map.add(STRESS, stamp, STRESSES) is None
        found = self.map.add(WRENCH, stamp, wrench)
        assert found is not None
        return found


def expected(
    wrench: np.ndarray = MEASURED, missing: str = "", prior: ForceMapSettings = PRIOR
) -> MapEstimate:
    forces = np.array([GEOMETRY.cluster_force(name, STRESSES[name][0]) for name in CLUSTERS])
    if missing:
        forces[CLUSTERS.index(missing), 2] = np.nan
    return ForceMap(GEOMETRY, CLUSTERS, prior).update(wrench, forces, np.zeros(4, dtype=np.uint8))


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
    assert bench.map.add(WRENCH, 2, MEASURED) is None
    found = bench.map.add(STRESS, 2, STRESSES)
    assert found is not None
    assert_same(found, expected())
    assert bench.map.count == 2


def test_poses_and_other_stamps_make_no_map() -> None:
    bench = Bench()
    for topic in (SOCKET_POSE, PYLON_POSE, SOCKET_POSE):
        assert bench.map.add(topic, 1, np.zeros(7)) is None
    assert bench.map.add(STRESS, 1, STRESSES) is None
    assert bench.map.add(WRENCH, 2, MEASURED) is None


def test_after_a_jump_back_in_time_nothing_old_is_matched() -> None:
    bench = Bench()
    bench.map.add(STRESS, 1, STRESSES)
    bench.map.clear()
    assert bench.map.add(WRENCH, 1, MEASURED) is None


def test_a_value_that_no_limb_gives_does_not_count() -> None:
    wrench = MEASURED.copy()
    wrench[3] = np.nan
    for wrong in (1e9, -1e9, np.inf):
        spoilt = MEASURED.copy()
        spoilt[3] = wrong
        assert_same(Bench().send(wrench=spoilt), expected(wrench))


def test_a_channel_that_is_left_out_of_the_objective_does_not_count() -> None:
    bench = Bench(leave_out=("distal.Fz", "no such channel"))
    assert_same(bench.send(), expected(missing="distal"))


def test_without_any_channel_there_is_the_prior() -> None:
    bench = Bench()
    nothing = {name: (np.full(3, np.nan), 2) for name in CLUSTERS}
    bench.map.add(STRESS, 1, nothing)
    found = bench.map.add(WRENCH, 1, np.full(6, np.nan))
    assert found is not None and np.isfinite(found.standard_deviations).all()
    assert "nothing" in found.source
    assert (found.standard_deviations >= expected().standard_deviations - 1e-9).mean() > 0.9


def test_a_changed_prior_counts_from_the_next_sample() -> None:
    bench = Bench()
    bench.send()
    prior = dataclasses.replace(PRIOR, length=0.1)
    bench.settings = dataclasses.replace(bench.settings, force_map=prior)
    assert_same(bench.send(2), expected(prior=prior))
    with pytest.raises(AssertionError):
        assert_same(bench.send(3), expected())
