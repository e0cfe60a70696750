"""The drivers at the doors of the kernel: types, sizes, and register words written by hand.

The fakes here refuse what smbus2, spidev, gpiod and ioctl refuse; where the real library is called
on a device that is none, it checks the arguments before it fails.
"""

import errno
import fcntl
import os
import sys
from collections.abc import Iterator, Sequence
from datetime import timedelta
from types import SimpleNamespace
from typing import Any

import gpiod
import numpy as np
import pytest
import spidev
from gpiod.line import Direction, Edge, Value
from smbus2 import I2cFunc, SMBus, i2c_msg
from support.clocks import FakeClock

from socket_testbed.drivers import ERROR, OK, WARN, gpio
from socket_testbed.drivers.clusters import i2c
from socket_testbed.drivers.clusters.fdc1004 import Fdc1004
from socket_testbed.drivers.clusters.i2c import I2cPort
from socket_testbed.drivers.clusters.reader import ClusterReader
from socket_testbed.drivers.load_cell import ads131m0x
from socket_testbed.drivers.load_cell.ads131m0x import Ads131m0x
from socket_testbed.drivers.load_cell.load_cell import Bridges, LoadCell
from socket_testbed.errors import DeviceError
from socket_testbed.samples import Status
from socket_testbed.settings.acquisition import ClusterSettings, LoadCellSettings
from socket_testbed.simulation.devices.ads131m0x import SimulatedAds131m0x
from socket_testbed.simulation.devices.fdc1004 import SimulatedFdc1004
from socket_testbed.simulation.devices.gpio import SimulatedLines
from socket_testbed.simulation.devices.i2c import (
    SimulatedClusterHardware,
    SimulatedI2cBus,
    SimulatedTca9548a,
)
from socket_testbed.simulation.world import FAULTS


@pytest.fixture
def null() -> Iterator[int]:
    """An open file that is no device: a call with the right arguments fails with ENOTTY."""
    file = os.open(os.devnull, os.O_RDWR)
    yield file
    os.close(file)


# --- the bus of the clusters


class Wire:
    """A bus with a chip of 16-bit registers, most significant byte first, that logs all bytes."""

    def __init__(self, registers: dict[int, int] | None = None) -> None:
        self.registers = registers or {}
        self.written: list[tuple[int, bytes]] = []
        self._pointer = 0

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        for message in messages:
            if message.flags & 1:
                assert message.len == 2  # one register
                word = self.registers[self._pointer]
                message.buf[0], message.buf[1] = bytes([word >> 8]), bytes([word & 0xFF])
            else:
                data = bytes(message.buf[: message.len])
                self.written.append((message.addr, data))
                self._pointer = data[0]
                if len(data) == 3:
                    self.registers[data[0]] = data[1] << 8 | data[2]

    def close(self) -> None:
        pass


def chip_on(wire: Wire, rate: int = 400) -> Fdc1004:
    return Fdc1004(I2cPort(wire, "i2c-1", 0x50), rate)


# Words of MSB and LSB register; signed code; capacitance [pF] with CAPDAC 0
CODES = {
    "1 pF": (0x0800, 0x0000, 524288, 1.0),
    "-1 pF": (0xF800, 0x0000, -524288, -1.0),
    "3.5 pF": (0x1C00, 0x0000, 1835008, 3.5),
    "smallest": (0x0000, 0x0100, 1, 1.9073486e-6),
    "smallest below": (0xFFFF, 0xFF00, -1, -1.9073486e-6),
    "lowest byte is none": (0x0000, 0x01FF, 1, 1.9073486e-6),
    "highest": (0x7FFF, 0xFE00, 8388606, 15.9999962),
    "lowest": (0x8000, 0x0100, -8388607, -15.9999981),
}


@pytest.mark.parametrize("case", CODES)
@pytest.mark.parametrize("channel", range(4))
def test_register_words_are_picofarads(channel: int, case: str) -> None:
    high, low, code, picofarads = CODES[case]
    wire = Wire({2 * channel: high, 2 * channel + 1: low})
    chip = chip_on(wire)
    assert chip.read(channel) == code
    assert wire.written == [(0x50, bytes([2 * channel])), (0x50, bytes([2 * channel + 1]))]
    found = chip.convert(channel, code)
    assert found.picofarads == pytest.approx(picofarads, rel=1e-7)
    assert not found.shifted and not found.fault


def test_a_code_at_a_rail_shifts_the_range() -> None:
    """25 pF up: CAPDAC 8 of channel 2, 2 << 13 | 4 << 10 | 8 << 5; then 1 pF is 26 pF."""
    wire = Wire({4: 0x7FFF, 5: 0xFF00})
    chip = chip_on(wire)
    found = chip.convert(2, chip.read(2))
    assert np.isnan(found.picofarads) and found.shifted
    assert wire.registers[0x0A] == 0x5100
    assert chip.convert(2, 524288).picofarads == pytest.approx(26.0)
    assert chip.convert(1, 524288).picofarads == pytest.approx(1.0)


def test_a_code_at_the_lower_rail_shifts_back() -> None:
    wire = Wire({4: 0x8000, 5: 0x0000})
    chip = chip_on(wire)
    chip.capdac[2] = 8
    found = chip.convert(2, chip.read(2))
    assert np.isnan(found.picofarads) and found.shifted and chip.capdac == [0, 0, 0, 0]
    assert wire.registers[0x0A] == 0x5000
    again = chip.convert(2, -8388608)
    assert np.isnan(again.picofarads) and not again.shifted
    assert again.fault.startswith("input 3 is out of range at 0x50 on i2c-1, CAPDAC 0: ")


def test_the_last_range_ends_at_its_upper_rail() -> None:
    """CAPDAC 31, 96.875 pF."""
    chip = chip_on(Wire())
    chip.capdac[0] = 31
    assert chip.convert(0, 524288).picofarads == pytest.approx(97.875)
    found = chip.convert(0, 8388607)
    assert np.isnan(found.picofarads) and "CAPDAC 31" in found.fault


@pytest.mark.parametrize(("rate", "conf"), [(100, 0x05F0), (200, 0x09F0), (400, 0x0DF0)], ids=str)
def test_all_inputs_convert_in_turn(rate: int, conf: int, monkeypatch: pytest.MonkeyPatch) -> None:
    FakeClock(0.0).install(monkeypatch)
    wire = Wire({0xFE: 0x5449, 0xFF: 0x1004})

    def settle(*messages: i2c_msg, own: Any = wire.i2c_rdwr) -> None:
        own(*messages)
        wire.registers[0x0C] = wire.registers.get(0x0C, 0) & 0x7FFF  # RST clears itself

    monkeypatch.setattr(wire, "i2c_rdwr", settle)
    chip_on(wire, rate).reset_and_configure()
    settings = [wire.registers[register] for register in (0x08, 0x09, 0x0A, 0x0B)]
    assert settings == [0x1000, 0x3000, 0x5000, 0x7000]
    assert wire.registers[0x0C] == conf
    assert wire.written[0] == (0x50, bytes([0x0C, 0x80, 0x00]))


@pytest.mark.parametrize(
    ("word", "done"),
    [(0x0DF8, (1, 0, 0, 0)), (0x0DF1, (0, 0, 0, 1)), (0x0DF6, (0, 1, 1, 0)), (0x0DF0, (0,) * 4)],
    ids=["first", "last", "middle", "none"],
)
def test_done_bits_are_read_from_the_left(word: int, done: tuple[int, ...]) -> None:
    assert chip_on(Wire({0x0C: word})).done() == done


@pytest.mark.parametrize(
    ("register", "value"),
    [(0x08, 0x10000), (0x100, 0), (0x08, -1), (0x08, 5.0)],
    ids=["17 bits", "register", "negative", "float"],
)
def test_a_register_has_sixteen_bits(register: Any, value: Any) -> None:
    wire = Wire()
    with pytest.raises((TypeError, ValueError)):
        I2cPort(wire, "i2c-1", 0x50).write(register, value)
    assert wire.written == []


# --- the multiplexer


def capacitance(cluster: int, channel: int, moment: float) -> float:
    return 2.0 + cluster + 0.125 * channel


def test_every_channel_reaches_its_own_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    """Channels 0, 5 and 7 of one multiplexer, 5 of another."""
    clock = FakeClock(100.0).install(monkeypatch)
    settings = ClusterSettings(
        names=("a", "b", "c", "d"),
        buses=(1, 1, 1, 1),
        multiplexers=(0x70, 0x70, 0x70, 0x77),
        channels=(0, 5, 7, 5),
    )
    hardware = SimulatedClusterHardware(settings, SimulatedFdc1004, capacitance, {})
    selected: list[tuple[int, int]] = []

    def open_bus(number: int) -> Any:
        bus = hardware.open_bus(number)

        def logged(*messages: i2c_msg) -> None:
            for message in messages:
                if message.addr >= 0x70 and not message.flags & 1:
                    assert message.len == 1
                    selected.append((message.addr, message.buf[0][0]))
            bus.i2c_rdwr(*messages)

        return SimpleNamespace(i2c_rdwr=logged, close=bus.close)

    reader = ClusterReader(settings, Fdc1004, open_bus)
    found = reader.read(clock.now)
    known = 2.0 + np.arange(4)[:, None] + 0.125 * np.arange(4)
    np.testing.assert_allclose(found.capacitance, known, atol=1e-5)
    assert {mask for address, mask in selected if address == 0x70} == {0x00, 0x01, 0x20, 0x80}
    assert {mask for address, mask in selected if address == 0x77} == {0x00, 0x20}
    reader.close()
    assert [multiplexer.mask for multiplexer in hardware.multiplexers.values()] == [0, 0]


def test_two_open_channels_collide() -> None:
    """On open-drain wires zeros win: 0x5449 & 0x5449, but codes are mixed."""
    first, second = (SimulatedFdc1004(lambda n, t: 1.0) for _ in range(2))
    multiplexer = SimulatedTca9548a()
    multiplexer.chips = {0: first, 3: second}
    bus = SimulatedI2cBus([multiplexer])
    port = I2cPort(bus, "i2c-1", 0x50)
    I2cPort(bus, "i2c-1", 0x70).write_byte(1 << 3)
    port.write(0x08, 0x1234)
    I2cPort(bus, "i2c-1", 0x70).write_byte(1 << 0)
    assert port.read(0x08) == 0x1C00  # as after its reset
    I2cPort(bus, "i2c-1", 0x70).write_byte(0b1001)
    assert port.read(0x08) == 0x1C00 & 0x1234
    I2cPort(bus, "i2c-1", 0x70).write_byte(0)
    with pytest.raises(DeviceError, match="no answer at 0x50 on i2c-1"):
        port.read(0x08)


# --- what the kernel and its libraries refuse, the simulation refuses, too


@pytest.fixture(params=["simulated", "smbus2"])
def bus(request: pytest.FixtureRequest, null: int) -> Iterator[Any]:
    """The simulated bus without chips, and smbus2 on a file that is no bus."""
    if request.param == "simulated":
        yield SimulatedI2cBus([])
        return
    real = SMBus()
    real.fd = null
    yield real
    real.fd = None


@pytest.mark.parametrize("message", ["a", b"\x08", [0x08], 8, None], ids=repr)
def test_only_messages_are_transferred(message: Any, bus: Any) -> None:
    with pytest.raises(TypeError, match="expected i2c_msg instance"):
        bus.i2c_rdwr(i2c_msg.write(0x50, [8]), message)


def test_a_message_passes_the_checks(bus: Any) -> None:
    """Then nobody answers, or the file is no bus."""
    with pytest.raises(OSError) as found:
        bus.i2c_rdwr(i2c_msg.write(0x50, [8]), i2c_msg.read(0x50, 2))
    assert found.value.errno in (errno.EREMOTEIO, errno.ENOTTY)


@pytest.mark.parametrize(
    ("count", "length"), [(0, 2), (43, 2), (1, 8193)], ids=["none", "too many", "too long"]
)
def test_a_transfer_has_the_kernel_s_sizes(count: int, length: int) -> None:
    with pytest.raises(OSError) as found:
        SimulatedI2cBus([]).i2c_rdwr(*[i2c_msg.read(0x50, length)] * count)
    assert found.value.errno == errno.EINVAL


@pytest.mark.parametrize("number", [1.0, "1", np.int64(1), None], ids=repr)
def test_a_bus_has_a_number(number: Any) -> None:
    hardware = SimulatedClusterHardware(ClusterSettings(), SimulatedFdc1004, capacitance, {})
    with pytest.raises(TypeError, match="Unexpected type"):
        hardware.open_bus(number)
    if not isinstance(number, str):  # smbus2 takes it for a path
        with pytest.raises(TypeError, match="Unexpected type"):
            SMBus().open(number)


@pytest.mark.parametrize(
    ("timeout", "steps"), [(0.05, 5), (0.002, 1), (0.028, 3), (1, 100)], ids=str
)
def test_the_timeout_is_set_in_whole_steps(
    timeout: float, steps: int, null: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """10 ms each, at least one; ioctl checks the types before it finds that this is no bus."""
    asked: list[tuple[int, int]] = []

    def ioctl(file: int, request: int, value: int) -> int:
        with pytest.raises(OSError) as found:
            fcntl.ioctl(file, request, value)
        assert found.value.errno == errno.ENOTTY
        asked.append((request, value))
        return 0

    opened = SimpleNamespace(fd=None, funcs=I2cFunc.I2C, close=lambda: None)
    opened.open = lambda number: setattr(opened, "fd", null)
    monkeypatch.setattr(i2c, "SMBus", lambda: opened)
    monkeypatch.setattr(i2c, "ioctl", ioctl)
    assert i2c.open_i2c(1, timeout) is opened
    assert asked == [(0x0702, steps)]


# Wrong bytes of a frame: their error in the simulation, and whether spidev has the same
FRAMES: dict[str, tuple[Any, type[Exception], bool]] = {
    "floats": ([0.0] * 24, TypeError, True),
    "numpy": ([*np.zeros(24, dtype=np.int64)], TypeError, True),
    "texts": (["0"] * 24, TypeError, True),
    "nothing": ([], TypeError, True),
    "a number": (24, TypeError, True),
    "too many": ([0] * 4097, OverflowError, True),
    "too large": ([256] * 24, ValueError, False),  # spidev cuts it
    "negative": ([-1] * 24, ValueError, False),
}


@pytest.mark.parametrize("case", FRAMES)
def test_only_bytes_are_exchanged(case: str) -> None:
    frame, error, in_spidev = FRAMES[case]
    with pytest.raises(error):
        SimulatedAds131m0x(lambda moment: np.zeros(6)).xfer2(frame)
    if in_spidev:
        with pytest.raises(error):
            spidev.SpiDev().xfer2(frame)


def test_a_frame_of_bytes_passes_the_checks() -> None:
    assert len(SimulatedAds131m0x(lambda moment: np.zeros(6)).xfer2([0] * 24)) == 24
    with pytest.raises(OSError) as found:
        spidev.SpiDev().xfer2([0] * 24)  # never opened
    assert found.value.errno == errno.EBADF


class StrictSpi:
    """`spidev.SpiDev` as far as it checks: attributes are set on a real one that is not open."""

    def __init__(self, file: int = -1) -> None:
        self.set: dict[str, int] = {}
        self.opened: tuple[int, int] | None = None
        self.fileno = lambda: file

    def open(self, bus: int, select: int) -> None:
        with pytest.raises(FileNotFoundError):
            spidev.SpiDev().open(bus, 200 + select)
        self.opened = (bus, select)

    def __setattr__(self, name: str, value: Any) -> None:
        if name in ("mode", "max_speed_hz"):
            with pytest.raises(OSError):
                setattr(spidev.SpiDev(), name, value)
            self.set[name] = value
        super().__setattr__(name, value)

    def close(self) -> None:
        pass


@pytest.mark.parametrize("clock", [8e6, 8_000_000, 8_000_000.7], ids=str)
def test_spi_is_opened_with_whole_numbers(
    clock: float, null: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    spi = StrictSpi(null)
    monkeypatch.setitem(sys.modules, "spidev", SimpleNamespace(SpiDev=lambda: spi))
    ads131m0x.open_spi("1.0", clock)
    assert spi.opened == (1, 0)
    assert spi.set == {"mode": 1, "max_speed_hz": 8_000_000}


def test_a_strict_device_refuses_a_float() -> None:
    with pytest.raises(TypeError, match="max_speed_hz"):
        StrictSpi().max_speed_hz = 8e6


class StrictRequest:
    """A `gpiod.LineRequest` as far as it checks."""

    def __init__(self, outputs: Sequence[int]) -> None:
        self._outputs = outputs
        self.set: list[tuple[int, Value]] = []
        self.waited: list[timedelta] = []

    def set_value(self, line: int, value: Value) -> None:
        if not isinstance(line, int) or not isinstance(value, Value):
            raise TypeError("a line's number and a Value are needed")
        if line not in self._outputs:
            raise ValueError("the line is not requested")
        self.set.append((line, value))

    def wait_edge_events(self, timeout: timedelta) -> bool:
        if not isinstance(timeout, timedelta):
            raise TypeError("a timedelta is needed")
        self.waited.append(timeout)
        return True

    def read_edge_events(self) -> list[SimpleNamespace]:
        return [SimpleNamespace(timestamp_ns=5_002_000_000), SimpleNamespace(timestamp_ns=7)]


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> tuple[gpio.GpiodLines, StrictRequest, dict[str, Any]]:
    request, asked = StrictRequest([17]), dict[str, Any]()

    def request_lines(path: str, consumer: str, config: dict[int, gpiod.LineSettings]) -> Any:
        asked.update(path=path, consumer=consumer, config=config)
        return request

    monkeypatch.setattr(gpio, "_chip", lambda *_: "/dev/gpiochip4")
    monkeypatch.setattr(gpiod, "request_lines", request_lines)
    uses: dict[int, gpio.Use] = {17: "output", 27: "rising"}
    return gpio.GpiodLines("pinctrl-rp1", uses, "trigger_node", "", ""), request, asked


def test_lines_are_requested_in_their_directions(lines: Any) -> None:
    asked = lines[2]
    assert all(type(line) is int for line in asked["config"])
    out, edge = asked["config"][17], asked["config"][27]
    assert (out.direction, out.edge_detection) == (Direction.OUTPUT, Edge.NONE)
    assert (edge.direction, edge.edge_detection) == (Direction.INPUT, Edge.RISING)
    assert asked["path"] == "/dev/gpiochip4"


def test_a_line_is_driven_high_and_low(lines: Any) -> None:
    lines[0].set(17, True)
    lines[0].set(17, False)
    assert lines[1].set == [(17, Value.ACTIVE), (17, Value.INACTIVE)]


def test_edges_are_in_seconds(lines: Any) -> None:
    """The kernel gives nanoseconds; a wait is a timedelta, never negative."""
    assert lines[0].edges(0.25) == pytest.approx([5.002, 7e-9])
    lines[0].edges(-1.0)
    assert lines[1].waited == [timedelta(milliseconds=250), timedelta(0)]


@pytest.mark.parametrize("line", [17.0, "17", None], ids=repr)
def test_a_simulated_line_has_a_number(line: Any) -> None:
    lines = SimulatedLines(dict.fromkeys(FAULTS, 0.0))
    with pytest.raises(TypeError, match="no number of a line"):
        lines.set(line, True)


# --- the load cell's converter


def crc(data: bytes) -> int:
    """CRC-16 with 0x1021 from 0xFFFF, bit by bit; 0x29B1 for the digits 1 to 9."""
    remainder = 0xFFFF
    for byte in data:
        for bit in range(7, -1, -1):
            carry = remainder >> 15 ^ byte >> bit & 1
            remainder = (remainder << 1 & 0xFFFF) ^ (0x1021 if carry else 0)
    return remainder


def test_the_checksum_is_the_datasheet_s() -> None:
    assert crc(b"123456789") == ads131m0x.checksum(b"123456789", "ccitt") == 0x29B1


class Frames:
    """An SPI device that answers with written frames and keeps what it was sent."""

    def __init__(self, *words: int, status: int = 0x013F) -> None:
        content = (status << 8).to_bytes(3, "big") + b"".join(w.to_bytes(3, "big") for w in words)
        self.answer = content + crc(content).to_bytes(2, "big") + b"\0"
        self.sent: list[list[int]] = []

    def xfer2(self, data: list[int], /) -> list[int]:
        assert type(data) is list and all(type(byte) is int for byte in data)
        assert len(data) == len(self.answer)
        self.sent.append(data)
        return list(self.answer)

    def close(self) -> None:
        pass


WORDS = (0x000001, 0xFFFFFF, 0x7FFFFF, 0x800000, 0x7FFFFE, 0x800001)
SIGNED = (1, -1, 8388607, -8388608, 8388606, -8388607)


def test_words_of_a_frame_are_signed_codes() -> None:
    """Two's complement of 24 bits, after STATUS; NULL is sent, with zeros."""
    device = Frames(*WORDS)
    frame = Ads131m0x(device, 6).read()
    assert frame.codes.tolist() == list(SIGNED)
    assert frame.new
    assert device.sent == [[0] * 24]
    assert ads131m0x.at_rail(frame.codes).tolist() == [False, False, True, True, False, False]


def test_eight_channels_have_ten_words() -> None:
    device = Frames(*WORDS, 0x123456, 0xEDCBAA, status=0x01FF)
    frame = Ads131m0x(device, 8).read()
    assert frame.codes[6:].tolist() == [1193046, -1193046] and len(device.sent[0]) == 30


@pytest.mark.parametrize("status", [0x0100, 0x013E, 0x011F], ids=["none", "not first", "not last"])
def test_a_frame_is_new_with_all_channels(status: int) -> None:
    assert not Ads131m0x(Frames(*WORDS, status=status), 6).read().new


def test_a_reset_of_the_converter_is_noticed() -> None:
    with pytest.raises(DeviceError, match="fell back to its reset state"):
        Ads131m0x(Frames(*WORDS, status=0x053F), 6).read()


@pytest.mark.parametrize(
    ("code", "gain", "volts"),
    [(4194304, 1, 0.6), (-4194304, 1, -0.6), (4194304, 32, 0.01875), (-8388608, 2, -0.6)],
    ids=["half", "half below", "gain 32", "lower rail"],
)
def test_codes_are_volts(code: int, gain: int, volts: float) -> None:
    """Full scale is 1.2 V over the gain."""
    assert float(ads131m0x.volts(np.array(code), gain)) == pytest.approx(volts, rel=1e-12)


# Bridge k reads input INPUTS[k]; its amplifier has AMPLIFIERS[k]; forces and moments of 1 mV/V are
# the maker's diagonal, Fx Fy Fz Mx My Mz. The converter's own gain is 2, the excitation 5 V.
INPUTS = (2, 0, 1, 5, 3, 4)
AMPLIFIERS = (30.0, 30.0, 30.0, 150.0, 150.0, 150.0)
SIGNS = (1.0, -1.0, 1.0, 1.0, 1.0, -1.0)
DIAGONAL = (900.0, 950.0, 1800.0, 40.0, 42.0, 60.0)
CELL = LoadCellSettings(
    inputs=INPUTS,
    amplifier_gain=AMPLIFIERS,
    sign=SIGNS,
    gain=2,
    excitation=5.0,
    matrix=tuple(np.diag(DIAGONAL).ravel()),
    full_scale=(1000.0, 1100.0, 2000.0, 60.0, 70.0, 80.0),
)
# 2^20 counts are 2^20 / 2^23 * 1.2 V / 2 = 75 mV: over 5 V and 30 they are 0.5 mV/V, over 5 V and
# 150 they are 0.1 mV/V.
COUNTS = 1 << 20
AXES = {  # bridge: row in [M; F] and value of that axis for 2^20 counts at its input
    0: (3, 450.0),
    1: (4, -475.0),
    2: (5, 900.0),
    3: (0, 4.0),
    4: (1, 4.2),
    5: (2, -6.0),
}


@pytest.mark.parametrize("bridge", AXES)
@pytest.mark.parametrize("sign", [1, -1], ids=["up", "down"])
def test_an_input_s_counts_are_its_axis_s_load(bridge: int, sign: int) -> None:
    codes = np.zeros((1, 6), dtype=np.int64)
    codes[0, INPUTS[bridge]] = sign * COUNTS
    bridges = Bridges(CELL)
    ratios = bridges.ratios(codes)
    expected = np.zeros(6)
    expected[bridge] = sign * SIGNS[bridge] * (0.5 if bridge < 3 else 0.1)
    np.testing.assert_allclose(ratios[0], expected, atol=1e-12)
    row, load = AXES[bridge]
    wrench = np.zeros(6)
    wrench[row] = sign * load
    np.testing.assert_allclose(bridges.wrenches(ratios)[0], wrench, atol=1e-9)
    np.testing.assert_allclose(bridges.ratios_at(wrench), expected, atol=1e-12)


def test_the_maker_s_rows_are_forces_first() -> None:
    """A load on Fx alone reads on bridges 0 and 3, by the first row."""
    matrix = np.diag(DIAGONAL)
    matrix[0, 3] = 100.0
    settings = LoadCellSettings(**{**vars(CELL), "matrix": tuple(matrix.ravel())})
    wrench = Bridges(settings).wrenches(np.array([1.0, 0.0, 0.0, 0.5, 0.0, 0.0]))
    np.testing.assert_allclose(wrench, [20.0, 0.0, 0.0, 950.0, 0.0, 0.0])
    assert Bridges(settings).full_scale.tolist() == [60.0, 70.0, 80.0, 1000.0, 1100.0, 2000.0]


# Loads [M; F] at one axis: level and words
LOADS = {
    "fine": (3, 790.0, OK, ""),
    "near": (
        3,
        850.0,
        WARN,
        "Fx is above 80 % of its full scale of 1000 N: do not load it further",
    ),
    "force": (3, 1050.0, ERROR, "Fx is above 100 % of its full scale of 1000 N: unload the cell"),
    "axial": (5, 2500.0, ERROR, "Fz is above 120 % of its full scale of 2000 N: unload the cell"),
    "moment": (2, 81.0, ERROR, "Mz is above 100 % of its full scale of 80 N m: unload the cell"),
    "near moment": (0, 55.0, WARN, "Mx is above 90 % of its full scale of 60 N m: do not load it"),
}


class Converter:
    """A `ConverterReader` with conversions at 1 kHz, all of the same codes."""

    period = 0.001

    def __init__(self, codes: Sequence[int], missing: slice = slice(0, 0)) -> None:
        self._times = 10.0 + 0.001 * np.arange(-2000, 1000) + 0.0005
        self._codes = np.tile(np.array(codes, dtype=np.int64), (len(self._times), 1))
        self._kept = np.ones(len(self._times), dtype=bool)
        self._kept[missing] = False

    def between(self, start: float, end: float) -> tuple[np.ndarray, np.ndarray]:
        rows = self._kept & (self._times > start) & (self._times <= end)
        return self._times[rows], self._codes[rows]

    def newest(self, count: int) -> np.ndarray:
        return self._codes[-count:]

    def fault_at(self, now: float) -> tuple[int, None]:
        return OK, None


def cell(codes: Sequence[int], missing: slice = slice(0, 0)) -> LoadCell:
    converter: Any = Converter(codes, missing)
    return LoadCell(CELL, converter)


def codes_of(row: int, load: float) -> list[int]:
    """Counts for a load on one axis, from the table above."""
    (bridge,) = (bridge for bridge, (own, _) in AXES.items() if own == row)
    codes = [0] * 6
    codes[INPUTS[bridge]] = round(COUNTS * load / AXES[bridge][1])
    return codes


@pytest.mark.parametrize("case", LOADS)
@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["up", "down"])
def test_an_overload_is_named_on_either_side(
    case: str, sign: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, load, level, words = LOADS[case]
    FakeClock(10.0).install(monkeypatch)
    own = cell(codes_of(row, sign * load))
    reading = own.wrench_at(10.0)
    assert reading.status == Status.OK
    assert reading.wrench[row] == pytest.approx(sign * load, rel=1e-5)
    assert np.delete(reading.wrench, row) == pytest.approx(np.zeros(5), abs=1e-9)
    found, text = own.health(10.0)
    assert found == level
    if level == OK:
        assert text == "spidev0.0 converts"
    else:
        assert text.startswith(words)
    assert reading.fault == (text if level == ERROR else "")


@pytest.mark.parametrize("bridge", range(6))
@pytest.mark.parametrize("code", [8388607, -8388608], ids=["upper", "lower"])
def test_a_bridge_at_either_rail_is_saturated(
    code: int, bridge: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    FakeClock(10.0).install(monkeypatch)
    codes = [0] * 6
    codes[INPUTS[bridge]] = code
    own = cell(codes)
    reading = own.wrench_at(10.0)
    assert reading.status == Status.SATURATED and np.isnan(reading.wrench).all()
    words = f"bridge {1 + bridge} (input {INPUTS[bridge]}) is at its rail"
    assert reading.fault == f"{words}: unload the cell, or lower the gain"
    level, text = own.health(10.0)
    assert level == ERROR and text.startswith(f"{words} for 5 conversions or more: a broken wire?")


@pytest.mark.parametrize("code", [8388606, -8388607], ids=["upper", "lower"])
def test_a_code_beside_the_rail_is_a_value(code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """8388606 counts over 2^20 are 7.999998 times 450 N."""
    FakeClock(10.0).install(monkeypatch)
    codes = [0] * 6
    codes[INPUTS[0]] = code
    reading = cell(codes).wrench_at(10.0)
    assert reading.status == Status.OK
    assert abs(reading.wrench[3]) == pytest.approx(3599.999, abs=0.001)


def test_missing_conversions_leave_no_wrench(monkeypatch: pytest.MonkeyPatch) -> None:
    """The window of 20 ms is from 15 ms before to 5 ms after: 11 of its 20 conversions are lost."""
    FakeClock(10.0).install(monkeypatch)
    reading = cell(codes_of(3, 100.0), slice(1985, 1996)).wrench_at(10.0)
    assert reading.status == Status.MISSING and np.isnan(reading.wrench).all()
    assert reading.fault == (
        "9 of 20 conversions around the trigger: relieve the computer if this happens often"
    )


def test_a_tare_is_taken_off(monkeypatch: pytest.MonkeyPatch) -> None:
    FakeClock(10.0).install(monkeypatch)
    own = cell(codes_of(3, 60.0))
    assert own.tare(1_000_000_000, forced=True)[3] == pytest.approx(60.0, rel=1e-5)
    reading = own.wrench_at(10.0)
    assert reading.wrench == pytest.approx(np.zeros(6), abs=1e-9)
    assert reading.tare[3] == pytest.approx(60.0, rel=1e-5) and reading.tared == 1_000_000_000
    assert reading.ratios[0] == pytest.approx(60.0 / 900.0, rel=1e-5)
