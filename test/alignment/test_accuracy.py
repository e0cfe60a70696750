"""Foreign sources against the truth of a simulated trial, beside our own drivers."""

from dataclasses import replace

import pytest
from support.foreign import OUR_LAB, ForeignLab, errors_of

from socket_testbed.calibration.model import read_calibration
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.simulation import sensors
from socket_testbed.simulation.trial import SimulatedTrial, simulate

SEED = 1


@pytest.fixture(scope="module")
def trial() -> SimulatedTrial:
    geometry = read_socket(packaged("config", "socket.yaml"))
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    errors = sensors.SensorErrors()
    return simulate(geometry, calibration, "protocol", 40.0, 25.0, SEED, errors)


@pytest.mark.parametrize("rate", [4.0, 25.0])
def test_foreign_sources_are_as_good_as_ours(trial: SimulatedTrial, rate: float) -> None:
    """Late, jittered wrenches and poses of a drifting clock; cameras at the same rate."""
    lab = ForeignLab()
    ours = errors_of(trial, replace(OUR_LAB, pose_rate=lab.pose_rate), rate, SEED)
    theirs = errors_of(trial, lab, rate, SEED)
    assert (theirs < 1.2 * ours).all()
    assert (theirs < [0.5, 30.0]).all()  # [N], [um]


def test_a_delay_that_is_left_shows(trial: SimulatedTrial) -> None:
    lab = ForeignLab(wrench_delay=0.2)
    left = errors_of(trial, lab, 4.0, SEED, corrected=0.0)[0]
    assert left > 3.0 * errors_of(trial, lab, 4.0, SEED)[0]
