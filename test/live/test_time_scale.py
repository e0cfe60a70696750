"""The speed of a simulated testbed follows from what the machine manages."""

import pytest

from socket_testbed import clocks
from socket_testbed.errors import ConfigurationError
from socket_testbed.live import hardware
from socket_testbed.live.time_scale import SCALES, MachineSpeed, busy_note, measure_speed
from socket_testbed.settings.acquisition import ClusterSettings, LoadCellSettings, TriggerSettings


@pytest.mark.parametrize(
    ("lateness", "speed", "scale"),
    [
        (1e-4, 1.0, 1.0),
        (1e-4, 0.1, 0.5),
        (1e-4, 0.04, 0.25),
        (4e-3, 1.0, 0.5),
        (8e-3, 0.3, 0.25),
        (6e-3, 0.02, 0.125),
        (0.02, 1.0, 0.125),
        (0.1, 0.001, 0.0625),
        (0.0, 5.0, 1.0),
    ],
)
def test_a_busier_machine_gets_a_slower_testbed(lateness, speed, scale) -> None:
    assert MachineSpeed(lateness, speed).time_scale() == scale


def test_this_machine_is_measured() -> None:
    assert measure_speed().time_scale() in SCALES


def test_it_says_so_unless_it_is_real_time() -> None:
    assert busy_note(1.0) == ""
    assert busy_note(0.25).endswith("the simulated testbed runs at a quarter of real time")
    assert busy_note(0.3).endswith("0.3 of real time")


def test_hardware_keeps_to_real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clocks, "_scale", 0.5)
    for make in (
        lambda: hardware.make_trigger(TriggerSettings()),
        lambda: hardware.i2c_opener(ClusterSettings()),
        lambda: hardware.spi_opener(LoadCellSettings()),
    ):
        with pytest.raises(ConfigurationError, match=r"TIME_SCALE=0\.5 is for a simulated testbed"):
            make()
