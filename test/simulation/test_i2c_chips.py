"""The simulated FDC1004 register by register, as a host sees it over a bus."""

import errno
from collections.abc import Callable

import pytest
from smbus2 import i2c_msg
from support.clocks import FakeClock

from socket_testbed.simulation.devices.fdc1004 import SimulatedFdc1004
from socket_testbed.simulation.devices.i2c import SimulatedI2cBus

CHIP, FDC_CONF = 0x50, 0x0C
UNIT = 2.0**-19  # [pF]


class Host:
    """The registers of one chip, as a host sees them over a bus without a multiplexer."""

    def __init__(self, capacitance: Callable[[int, float], float] = lambda n, t: n + 1.0) -> None:
        self.clock = FakeClock()
        chip = SimulatedFdc1004(capacitance, self.clock)
        self.bus = SimulatedI2cBus([chip])

    def read(self, register: int) -> int:
        answer = i2c_msg.read(CHIP, 2)
        self.bus.i2c_rdwr(i2c_msg.write(CHIP, [register]), answer)
        return int.from_bytes(answer.buf[:2], "big")

    def write(self, register: int, value: int) -> None:
        self.bus.i2c_rdwr(i2c_msg.write(CHIP, [register, value >> 8, value & 0xFF]))

    def code(self, n: int) -> int:
        code = self.read(2 * n) << 8 | self.read(2 * n + 1) >> 8
        return code - (1 << 24) if code & 0x800000 else code


def test_the_registers_reset_to_what_the_datasheet_says() -> None:
    host = Host()
    expected = dict.fromkeys(range(8), 0) | dict.fromkeys(range(0x08, 0x0C), 0x1C00)
    expected |= {FDC_CONF: 0} | dict.fromkeys(range(0x0D, 0x11), 0)
    expected |= dict.fromkeys(range(0x11, 0x15), 0x4000) | {0xFE: 0x5449, 0xFF: 0x1004}
    for register in (0x08, 0x0D, 0x11):
        host.write(register, 0x1234)
        assert host.read(register) == 0x1234
        host.write(FDC_CONF, 0x8000)
        assert {register: host.read(register) for register in expected} == expected
    for register in (0x00, 0x07, 0x15, 0xFD, 0xFE, 0xFF):  # read-only or unused
        with pytest.raises(OSError, match="acknowledgement") as caught:
            host.write(register, 0)
        assert caught.value.errno == errno.EREMOTEIO


def test_conversions_end_in_turn_and_done_falls_after_msb_and_lsb() -> None:
    host = Host()
    for n in range(4):
        host.write(0x08 + n, n << 13 | 4 << 10)
    host.write(FDC_CONF, 0x0DF0)
    for n in range(4):
        assert host.read(FDC_CONF) & 0xF == sum(8 >> k for k in range(n))
        host.clock.now += 2.5e-3 + 1e-9
    assert host.read(FDC_CONF) == 0x0DFF
    for register, done in ((0x00, 0xF), (0x01, 0x7)):
        host.read(register)
        assert host.read(FDC_CONF) & 0xF == done
    host.clock.now += 2.5e-3
    host.read(0x01)
    assert host.read(FDC_CONF) & 0xF == 0xF  # an LSB alone clears nothing


def test_a_code_is_the_difference_at_the_end_of_its_conversion_clipped_to_the_rails() -> None:
    for rate, period in ((1, 0.01), (2, 0.005), (3, 0.0025)):
        host = Host(lambda n, t: t - 100.0 + 2.0 * n)
        host.write(0x08, 4 << 10)
        host.write(0x09, 1 << 13 | 4 << 10)
        host.write(FDC_CONF, rate << 10 | 0x01C0)
        host.clock.now += 100.5 * period
        assert host.code(0) * UNIT == pytest.approx(99 * period, abs=UNIT)
        assert host.code(1) * UNIT == pytest.approx(2.0 + 100 * period, abs=UNIT)
    for settings, picofarads in (
        (0 << 13 | 4 << 10 | 3 << 5, 20.0 - 9.375),
        (0 << 13 | 4 << 10 | 31 << 5, -16.0),  # 20.0 - 96.875
        (0 << 13 | 7 << 10 | 3 << 5, 16.0 - UNIT),  # 20.0: CAPDAC acts with CHB = 4 alone
    ):
        host = Host(lambda n, t: 20.0 + 2.0 * n)
        host.write(0x08, settings)
        host.write(FDC_CONF, 0x0D80)
        host.clock.now += 1e-3
        host.write(0x08, 4 << 10 | 2 << 5)  # not of the conversion under way
        host.clock.now += 2e-3
        assert host.code(0) * UNIT == picofarads
        host.clock.now += 2.5e-3
        assert host.code(0) * UNIT == 20.0 - 6.25
