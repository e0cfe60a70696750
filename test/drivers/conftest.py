"""Drivers on real threads and sockets run in testbed time, as slow as this machine needs."""

import pytest

from socket_testbed import clocks
from socket_testbed.live.time_scale import measure_speed


@pytest.fixture(scope="session")
def time_scale() -> float:
    """Testbed seconds per real second that this machine manages [-]."""
    return measure_speed().time_scale()


@pytest.fixture(autouse=True)
def testbed_time(monkeypatch: pytest.MonkeyPatch, time_scale: float) -> None:
    """The clock of this process at that scale."""
    monkeypatch.setattr(clocks, "_scale", time_scale)
