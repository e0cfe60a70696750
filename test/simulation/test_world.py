"""The simulated world that processes share."""

from pathlib import Path

import numpy as np
import pytest
from support.wording import refused

from socket_testbed.errors import ConfigurationError
from socket_testbed.simulation.world import FAULTS, World


def push(world: World, moment: float) -> None:
    """A state whose every number is known from its time."""
    poses = np.hstack([np.full((2, 3), moment), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))])
    world.push(moment, np.arange(16.0).reshape(4, 4) + moment, np.full(6, 2.0 * moment), poses)


def test_another_process_sees_the_world_and_its_faults_and_nothing_is_extrapolated(
    tmp_path: Path,
) -> None:
    with refused(ConfigurationError, "no simulated world: start one with"):
        World(tmp_path)
    world, other = World(tmp_path, create=True), World(tmp_path)
    push(world, 10.0)
    for moment in (1.0, 10.0, 19.0):
        assert other.capacitance(0, 0, moment) == 10.0
    for k in range(1, 200):
        push(world, 10.0 + 0.02 * k)
        for moment in (10.0 + 0.02 * k - 0.013, max(10.0, 10.0 + 0.02 * k - 0.15)):
            assert other.capacitance(2, 3, moment) == pytest.approx(11.0 + moment)
            np.testing.assert_allclose(other.wrench(moment), 2.0 * moment)
            np.testing.assert_allclose(other.poses(moment)[:, :3], moment)
    assert other.capacitance(0, 0, 1e6) == pytest.approx(13.98)
    assert 10.0 < other.capacitance(0, 0, 0.0) < 13.98  # the oldest that is kept

    assert dict(other.faults) == dict.fromkeys(FAULTS, 0.0)
    world.faults.switch("mocap.drop", 0.25)
    assert other.faults["mocap.drop"] == 0.25
