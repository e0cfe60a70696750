"""The physics of the live simulated testbed, without processes and without a clock that runs."""

from pathlib import Path

import numpy as np

from socket_testbed import clocks
from socket_testbed.calibration.model import read_calibration
from socket_testbed.clocks import SteadyClock
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.live.simulated_world import LiveTestbed, Simulation
from socket_testbed.simulation.limb import SCENARIOS
from socket_testbed.simulation.world import SensorErrors, World

GEOMETRY = read_socket(packaged("config", "socket.yaml"))


def test_the_limb_follows_a_scenario_again_and_again(tmp_path: Path) -> None:
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    for scenario, tissue in (*((name, "soft") for name in SCENARIOS), ("multi_direction", "stiff")):
        world = World(tmp_path, create=True)
        how = Simulation(scenario, 10.0, seed=1, pace=6.0, sway=0.05, tissue=tissue)
        testbed = LiveTestbed(world, GEOMETRY, calibration, how, SensorErrors())
        start = clocks.monotonic()
        for moment in np.arange(0.0, 16.0, 0.2):  # a busy machine makes long steps
            testbed.advance(start + moment)
            assert np.isfinite(world.poses(start + moment)).all()
        testbed.save(tmp_path / "truth.npz", SteadyClock())
        with np.load(tmp_path / "truth.npz") as data:
            carried = data["forces"].sum(axis=1)[:, 2] / data["wrench"][:, 5]
            travel = np.ptp(data["position"][:, 2])
        assert (carried > 0.4).all() and (carried < 1.0).all()  # the rest is between the tiles
        forgetful = LiveTestbed(world, GEOMETRY, calibration, how, SensorErrors(), remembers=False)
        forgetful.advance(clocks.monotonic())
        assert not forgetful._history  # it may run for days
        assert travel > {"soft": 2e-3, "stiff": 3e-4}[tissue], scenario
