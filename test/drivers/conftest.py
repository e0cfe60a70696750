"""Drivers on real threads and sockets run in testbed time, as slow as this machine needs."""

import pytest
from support.clocks import careful_time_scale

from socket_testbed import clocks


@pytest.fixture(scope="session")
def time_scale() -> float:
    """Testbed seconds per real second that this machine manages [-]."""
    return careful_time_scale()


@pytest.fixture(autouse=True)
def testbed_time(monkeypatch: pytest.MonkeyPatch, time_scale: float) -> None:
    """The clock of this process at that scale."""
    monkeypatch.setattr(clocks, "_scale", time_scale)
