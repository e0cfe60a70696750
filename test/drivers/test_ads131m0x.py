"""The converter's driver and its simulated chip, byte by byte."""

import sys
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from support.clocks import FakeClock
from support.wording import refused

from socket_testbed import clocks
from socket_testbed.drivers.load_cell.ads131m0x import (
    Ads131m0x,
    ChecksumError,
    at_rail,
    checksum,
    conversion_period,
    group_delay,
    open_spi,
    volts,
)
from socket_testbed.drivers.load_cell.converter_reader import ConversionClock
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.simulation.devices.ads131m0x import SimulatedAds131m0x

PERIOD = 1e-3


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeClock:
    return FakeClock().install(monkeypatch)


class Wire:
    """A bus that keeps what was sent, and may change what comes back."""

    def __init__(self, chip) -> None:
        self.chip = chip
        self.alter = lambda answer: answer
        self.sent: list[list[int]] = []

    def xfer2(self, data: list[int], /) -> list[int]:
        self.sent.append(list(data))
        return self.alter(self.chip.xfer2(data))


def words(*values: int, length: int = 24) -> list[int]:
    """A frame of 16-bit words at the heads of words of 24 bits."""
    return list(b"".join(v.to_bytes(2, "big") + b"\0" for v in values).ljust(length, b"\0"))


def bench(channels=6, crc="ccitt", chip_channels=None):
    constant = np.linspace(-0.5, 0.5, chip_channels or channels)
    chip = SimulatedAds131m0x(lambda moment: constant, len(constant), {}, seed=1)
    wire = Wire(chip)
    return chip, wire, Ads131m0x(wire, channels, crc)


def test_checksums_delays_and_periods_are_those_of_the_data_sheet() -> None:
    assert (checksum(b"123456789", "ccitt"), checksum(b"123456789", "ansi")) == (0x29B1, 0xAEE7)
    assert conversion_period(8.192e6, 16384) == pytest.approx(1 / 250)
    for oversampling in (128, 1024, 2048, 4096, 16384):  # the delay is the middle of the filter
        box = np.ones(min(oversampling, 1024))
        response = np.convolve(np.convolve(box, box), box)
        if oversampling > 1024:
            outputs = np.zeros(oversampling - 1023)
            outputs[::1024] = 1.0
            response = np.convolve(response, outputs)
        middle = np.arange(len(response)) @ response / response.sum() / 4.096e6
        assert group_delay(8.192e6, oversampling) == pytest.approx(middle, abs=5e-7)


def test_the_conversation_is_that_of_the_data_sheet() -> None:
    _, wire, converter = bench()
    converter.reset_and_configure(4096, 8)
    assert wire.sent == [
        words(0x0655),
        words(0x0011),
        words(0xA000),
        words(0x0000),
        words(0x6103, 0x0110, 0x3F16, 0x3333, 0x0033),
        *(words(register) for register in (0xA100, 0xA180, 0xA200, 0xA280)),
        *[words(0x0000)] * 3,
    ]
    assert converter.identity == 0x2602 and "ADS131M06 on spidev0.0" in converter.description
    wire.alter = lambda answer: [*answer[:7], answer[7] ^ 1, *answer[8:]]
    with pytest.raises(ChecksumError):
        converter.read()
    assert converter.check_frames(3) == 3
    body = bytes.fromhex("013F00000001FFFFFF7FFFFF800000123456FEDCBA")
    frame = body + checksum(body, "ccitt").to_bytes(2, "big") + b"\0"
    read = Ads131m0x(Mock(xfer2=lambda data: list(frame)), 6).read()
    assert read.new
    assert read.codes.tolist() == [1, -1, 0x7FFFFF, -0x800000, 0x123456, 0xFEDCBA - (1 << 24)]
    assert at_rail(read.codes).tolist() == [False, False, True, True, False, False]
    assert volts(read.codes, 4)[3] == pytest.approx(-0.3)


def test_a_chip_that_is_another_or_dead_or_deaf_is_named() -> None:
    for channels, other in ((6, 8), (8, 6)):
        _, _, converter = bench(channels, chip_channels=other)
        with refused(DeviceError, f"the converter says ID 0x2{other}02, not 0x2{channels}xx"):
            converter.reset_and_configure(4096, 1)
    chip, wire, converter = bench()
    wire.alter = lambda answer: [255] * len(answer)
    with refused(DeviceError, "spidev0.0: no answer (every bit reads 1)", "MISO"):
        converter.reset_and_configure(4096, 1)
    wire.alter = Mock(side_effect=OSError(110, "Connection timed out"))
    with refused(DeviceError, "spidev0.0: the bus fails (Connection timed out)"):
        converter.read()
    deaf = Mock(xfer2=lambda data: chip.xfer2(words(0) if data[:2] == [0x61, 0x03] else data))
    with refused(DeviceError, "register 0x02"):
        Ads131m0x(deaf, 6).reset_and_configure(4096, 1)


def test_another_configuration_follows_an_earlier_one() -> None:
    """After a crash of the computer the chip is as it was left, checksum and lock included."""
    chip, wire, converter = bench(crc="ansi")
    converter.reset_and_configure(1024, 2)
    chip.xfer2(words(0x0555))
    chip.xfer2(words(0x0011))
    assert int.from_bytes(chip.xfer2(words(0))[:2], "big") & 0x8500 == 0x8100  # locked, no reset
    again = Ads131m0x(wire, 6)
    again.reset_and_configure(4096, 1)
    clocks.sleep(PERIOD)
    assert again.read().new


def test_conversions_are_timed_closer_than_they_are_read() -> None:
    rng = np.random.default_rng(4)
    times, worst, taken = ConversionClock(PERIOD), 0.0, 0
    ends = 5.0 + 1.0003 * PERIOD * np.arange(3000)  # the chip's clock is a bit slow
    now, waiting = 4.99, 0
    while waiting < len(ends):
        now += rng.uniform(0.4, 1.7) * PERIOD
        while waiting < len(ends) and ends[waiting] <= now:
            end = times.conversion_end(now)
            if end is not None and waiting > 200:
                worst = max(worst, abs(end - ends[waiting]))
                taken += 1
            waiting += 1
        times.nothing_waits(now, now)
    assert taken > 2700
    assert worst < 0.25 * PERIOD


def test_a_pause_leaves_no_conversion_with_a_wrong_time() -> None:
    times = ConversionClock(PERIOD)
    assert times.conversion_end(1.0) is None  # nothing is known of what waits at first
    times.nothing_waits(1.001, 1.001)
    assert times.conversion_end(1.004) is None  # a third one may have been lost
    times.nothing_waits(1.004, 1.004)
    assert times.conversion_end(1.0045) == pytest.approx(1.00425, abs=1e-4)
    times.nothing_waits(1.0505, 1.0505)  # the conversions themselves had paused
    assert times.conversion_end(1.0509) == pytest.approx(1.0507, abs=1e-4)
    times.lose()  # a frame that may have held one was corrupted
    assert times.conversion_end(1.0515) is None
    times.nothing_waits(1.06, 1.0604)  # held up: nobody knows when nothing waited
    assert times.conversion_end(1.0607) is None


def test_the_bus_is_opened_in_mode_1_or_says_why_not(monkeypatch: pytest.MonkeyPatch) -> None:
    device = Mock()
    monkeypatch.setitem(sys.modules, "spidev", SimpleNamespace(SpiDev=lambda: device))
    spi = open_spi("1.2", 8e6)
    device.open.assert_called_once_with(1, 2)
    assert (spi.mode, spi.max_speed_hz) == (1, 8_000_000)
    for number, hint in {2: "dtparam=spi=on", 13: "group spi", 16: "spi_clock"}.items():
        device.open.side_effect = OSError(number, "x")
        with refused(DeviceError, "/dev/spidev0.0", hint):
            open_spi("0.0", 8e6)
    assert device.close.call_count == 3
    with refused(ConfigurationError, "N.M"):
        open_spi("spidev0.0", 8e6)
