"""The clusters' driver: its conversation with each chip, and every fault of a simulated bus."""

import errno
import itertools
import os
import random
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from smbus2 import I2cFunc, i2c_msg
from support.clocks import FakeClock
from support.wording import check_line, refused

from socket_testbed import clocks
from socket_testbed.drivers import DeviceBusyError
from socket_testbed.drivers.clusters import i2c
from socket_testbed.drivers.clusters.fdc1004 import Fdc1004
from socket_testbed.drivers.clusters.i2c import BusError, Conversion, I2cBus, I2cPort
from socket_testbed.drivers.clusters.reader import ClusterReader, ClusterReading, check_settings
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.live import doctor, hardware
from socket_testbed.live.bringup import Testbed
from socket_testbed.samples import Status
from socket_testbed.settings.acquisition import ClusterSettings
from socket_testbed.simulation.devices.failed_transfer import FailedTransfer
from socket_testbed.simulation.devices.fdc1004 import SimulatedFdc1004
from socket_testbed.simulation.devices.i2c import SimulatedClusterHardware, SimulatedI2cBus
from socket_testbed.simulation.world import FAULTS

OK, SATURATED, MISSING = Status.OK, Status.SATURATED, Status.MISSING
SETTINGS = ClusterSettings()
CYCLE = 0.01  # [s]
START = 1000.0  # [s]


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeClock:
    return FakeClock(START).install(monkeypatch)


class Schedule(dict[str, list[tuple[float, float, float]]]):
    """Faults with their values and spans of time, as they are at present."""

    def add(self, name: str, value: float, begin: float, end: float = np.inf) -> None:
        self.setdefault(f"clusters.{name}", []).append((value, begin, end))

    def get(self, name: str, default: float = 0.0) -> float:  # type: ignore[override]
        now = clocks.monotonic()
        spans = super().get(name, ())
        return next((value for value, begin, end in spans if begin <= now < end), default)


class Bench:
    """A reader on simulated hardware whose inputs all rise with time, each elsewhere."""

    def __init__(self, slope=0.2, settings=SETTINGS, speeds=(), overhead=0.0) -> None:
        self.clock: Any = clocks.monotonic
        self.clock.now = START
        self.faults = Schedule()
        self.slope = slope  # [pF/s]
        self.offsets: dict[tuple[int, int], float] = {}
        driver, simulated = hardware.capacitive_chip(settings)
        made = (settings, simulated, self.capacitance, self.faults, speeds)
        self.hardware = SimulatedClusterHardware(*made)
        self.settings = settings
        self.overhead = overhead
        self.reader = ClusterReader(settings, driver, self.hardware.open_bus)

    def base(self, cluster: int, channel: int) -> float:
        return self.offsets.get((cluster, channel), 1.0 + 0.05 * (4 * cluster + channel))

    def capacitance(self, cluster: int, channel: int, moment: float) -> float:
        return self.base(cluster, channel) + self.slope * (moment - START)

    def read(self, trigger: float | None = None) -> ClusterReading:
        """A reading, every value of which was measured for this trigger at this input."""
        trigger = self.clock.now if trigger is None else trigger
        self.clock.now = max(self.clock.now, trigger) + self.overhead
        reading = self.reader.read(trigger)
        missing = reading.status == MISSING
        for row, name in enumerate(self.settings.names):
            assert missing[row].all() or not missing[row].any()
            if missing[row].any() or name in reading.faults:
                list(map(check_line, reading.faults[name]))
        assert (np.isnan(reading.capacitance) == (reading.status != OK)).all()
        cycle = 4 / self.settings.sample_rate
        for (row, n), value in np.ndenumerate(reading.capacitance):
            if not np.isnan(value):
                moment = START + (value - self.base(row, n)) / self.slope
                resolution = 2.0**-19 / self.slope
                assert trigger - 2 * cycle - resolution <= moment <= self.clock.now + resolution
        return reading

    def run(self, rate: float, triggers: int, start: float | None = None) -> list[ClusterReading]:
        start = self.clock.now if start is None else start
        return [self.read(start + n / rate) for n in range(triggers)]


def is_good(reading: ClusterReading) -> bool:
    return bool((reading.status == OK).all()) and not reading.faults


def missing(reading: ClusterReading) -> list[int]:
    return [row for row, status in enumerate(reading.status) if (status == MISSING).all()]


class Script:
    """A bus that expects exactly these transfers."""

    def __init__(self, *transfers: tuple[tuple[str, bytes], ...]) -> None:
        self.transfers = list(transfers)

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        for message, (kind, data) in zip(messages, self.transfers.pop(0), strict=True):
            assert (message.addr, message.len) == (0x50, len(data))
            assert message.flags == int(kind == "read")
            if kind == "read":
                for index, byte in enumerate(data):
                    message.buf[index] = bytes([byte])
            else:
                assert bytes(message.buf[: message.len]) == data

    def close(self) -> None:
        assert not self.transfers


def reads(register: int, value: int) -> tuple[tuple[str, bytes], ...]:
    """A pointer and, behind a repeated start, two bytes."""
    return ("write", bytes([register])), ("read", value.to_bytes(2, "big"))


def writes(register: int, value: int) -> tuple[tuple[str, bytes], ...]:
    return (("write", bytes([register, *value.to_bytes(2, "big")])),)


PLACE = "0x50 behind channel 2 of 0x70 on i2c-1"
IDENTITY = (reads(0xFE, 0x5449), reads(0xFF, 0x1004))
INPUTS = [(0x08, 0x1000), (0x09, 0x3000), (0x0A, 0x5000), (0x0B, 0x7000)]


def fdc1004(bus: I2cBus, rate: int = 400) -> Fdc1004:
    return Fdc1004(I2cPort(bus, "i2c-1", 0x50, "behind channel 2 of 0x70"), rate)


@pytest.mark.parametrize(
    ("rate", "conf"),
    [(100, 0x05F0), (200, 0x09F0), (400, 0x0DF0)],
    ids=["100-Hz", "200-Hz", "400-Hz"],
)
def test_the_conversation_with_an_fdc1004(rate: int, conf: int) -> None:
    bus = Script(
        writes(0x0C, 0x8000),
        reads(0x0C, 0x8000),
        reads(0x0C, 0x0000),
        *IDENTITY,
        *(writes(*setting) for setting in [*INPUTS, (0x0C, conf)]),
        *(reads(*setting) for setting in INPUTS),
        reads(0x0C, conf | 0x8),  # DONE does not count
        reads(0x0C, conf | 0xA),
        reads(0x04, 0xFFFF),
        reads(0x05, 0xFE00),
        writes(0x0A, 0x5100),
        reads(0x0C, 0x0000),
    )
    chip = fdc1004(bus, rate)
    chip.reset_and_configure()
    assert chip.done() == (True, False, True, False)
    assert chip.read(2) == -2
    assert chip.convert(2, -2) == Conversion(-2 / 2**19)
    assert chip.convert(2, 0x7FFFFF).shifted
    assert chip.convert(2, 2**19) == Conversion(1.0 + 8 * 3.125)
    with refused(DeviceError, PLACE, "fell back"):
        chip.done()
    bus.close()


def test_another_device_at_the_address_is_refused() -> None:
    with refused(DeviceError, PLACE, "device 0x1234, not 0x1004"):
        fdc1004(Script(reads(0xFE, 0x5449), reads(0xFF, 0x1234))).check_identity()


def test_a_chip_that_stays_in_reset_is_named() -> None:
    with refused(DeviceError, PLACE, "does not leave its reset"):
        fdc1004(Script(writes(0x0C, 0x8000), *[reads(0x0C, 0x8000)] * 10)).reset_and_configure()


@pytest.mark.parametrize(
    ("number", "text"),
    [
        pytest.param(errno.EREMOTEIO, "plug", id="EREMOTEIO"),
        pytest.param(errno.ENXIO, "plug", id="ENXIO"),
        pytest.param(errno.ETIMEDOUT, "the bus hangs at", id="ETIMEDOUT"),
        pytest.param(errno.ENODEV, "adapter of i2c-1", id="ENODEV"),
        pytest.param(errno.EBADF, "adapter of i2c-1", id="EBADF"),
        pytest.param(errno.ESHUTDOWN, "adapter of i2c-1", id="ESHUTDOWN"),
        pytest.param(errno.EIO, "(x): check the cluster's wiring (SDA, SCL", id="EIO"),
        pytest.param(errno.EPROTO, "(x): check the cluster's wiring (SDA, SCL", id="EPROTO"),
        pytest.param(errno.EAGAIN, "check SDA and SCL for interference", id="EAGAIN"),
        pytest.param(errno.EOPNOTSUPP, "the adapter of i2c-1 lacks", id="EOPNOTSUPP"),
    ],
)
def test_a_failed_transfer_names_the_place(number: int, text: str) -> None:
    chip = fdc1004(Mock(i2c_rdwr=Mock(side_effect=OSError(number, "x"))))
    with refused(BusError, PLACE, text) as caught:
        chip.done()
    assert caught.value.address == 0x50


@pytest.fixture
def smbus(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Mock]:
    """The bus that is opened, with the requests to the kernel in `smbus.ioctl`."""
    file = os.open(tmp_path / "i2c-7", os.O_RDWR | os.O_CREAT)
    bus = Mock(fd=file, funcs=I2cFunc.I2C | I2cFunc.SMBUS_QUICK)
    monkeypatch.setattr(i2c, "SMBus", lambda: bus)
    monkeypatch.setattr(i2c, "ioctl", bus.ioctl)
    yield bus
    os.close(file)


def test_an_opened_bus_has_the_time_out(smbus: Mock) -> None:
    i2c.open_i2c(7, 0.05)
    smbus.ioctl.assert_called_once_with(smbus.fd, 0x0702, 5)


def test_an_adapter_for_smbus_alone_is_named(smbus: Mock) -> None:
    smbus.funcs = I2cFunc.SMBUS_BYTE_DATA | I2cFunc.SMBUS_QUICK
    with refused(DeviceError, "i2c-7", "SMBus alone", "cluster_node's buses"):
        i2c.open_i2c(7, 0.05)
    assert smbus.close.call_count == 1


def test_a_bus_of_another_program_is_refused(smbus: Mock, tmp_path: Path) -> None:
    """Its process and its command are named; when it ends, the bus opens."""
    program = "import fcntl, sys; f = open(sys.argv[1], 'r+'); fcntl.flock(f, fcntl.LOCK_EX)"
    program += "; print(flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", program, str(tmp_path / "i2c-7")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdin is not None and other.stdout is not None
        other.stdout.readline()
        with refused(DeviceBusyError, f"another program uses i2c-7 (process {other.pid}, "):
            i2c.open_i2c(7, 0.05)
        assert smbus.close.call_count == 1
        other.stdin.close()
    assert i2c.open_i2c(7, 0.05) is smbus


@pytest.mark.parametrize(
    ("number", "hint"),
    [
        pytest.param(errno.EACCES, "group i2c", id="EACCES"),
        pytest.param(errno.ENOENT, "enable the bus", id="ENOENT"),
        pytest.param(errno.ENXIO, "enable the bus", id="ENXIO"),
        pytest.param(errno.ENOTTY, "check that it is an I2C bus", id="ENOTTY"),
    ],
)
def test_a_bus_that_cannot_be_opened_is_named(smbus: Mock, number: int, hint: str) -> None:
    smbus.open.side_effect = OSError(number, "x")
    with refused(DeviceError, "/dev/i2c-7", hint):
        i2c.open_i2c(7, 0.05)
    assert smbus.close.call_count == 1


@pytest.mark.parametrize(
    ("text", "change"),
    [
        pytest.param("3 buses", {"buses": (1, 1, 1)}, id="buses-and-names"),
        pytest.param("sample_rate is 300", {"sample_rate": 300}, id="sample-rate"),
        pytest.param(
            "latest is 0.04 s, shorter", {"sample_rate": 100, "latest": 0.04}, id="latest-too-short"
        ),
        pytest.param(
            "'mid_anterior' and 'distal' share", {"channels": (0, 1, 2, 1)}, id="shared-channel"
        ),
        pytest.param(
            "without a multiplexer beside 'mid_anterior'",
            {"multiplexers": (0, 0x70, 0x70, 0x70)},
            id="one-without-multiplexer",
        ),
        pytest.param("cluster_node: chip is 'fdc1005'", {"chip": "fdc1005"}, id="unknown-chip"),
    ],
)
def test_settings_that_do_not_fit_together_are_refused(text: str, change: dict[str, Any]) -> None:
    settings = replace(SETTINGS, **change)
    with refused(ConfigurationError, text):
        check_settings(settings, hardware.capacitive_chip(settings)[0])


def test_chips_at_one_address_are_told_apart() -> None:
    """A channel left open on another multiplexer would mix two of them."""
    ten = replace(
        SETTINGS,
        names=tuple("abcdefghij"),
        buses=(1,) * 6 + (3,) * 4,
        multiplexers=(0x70,) * 4 + (0x71,) * 2 + (0x70,) * 4,
        channels=(0, 1, 2, 3, 0, 1, 7, 2, 1, 0),
    )
    bench = Bench(settings=ten)
    for _ in range(3):
        assert is_good(bench.read())
        bench.clock.now += 0.1
    bench.hardware._buses[1].remove(bench.hardware.multiplexers[1, 0x71])  # unplugged
    for _ in range(3):
        assert missing(bench.read()) == [4, 5]
        bench.clock.now += 0.1


def test_another_chip_is_read_at_its_own_address(monkeypatch: pytest.MonkeyPatch) -> None:
    pair = (type("Other", (kind,), {"address": 0x2A}) for kind in (Fdc1004, SimulatedFdc1004))
    monkeypatch.setitem(hardware.CAPACITIVE_CHIPS, "other", tuple(pair))
    bench = Bench(settings=replace(SETTINGS, chip="other"))
    assert "0x2A behind channel 3 of 0x70 on i2c-1" in str(bench.reader.identify()["distal"])
    assert is_good(bench.read())


def test_an_absent_adapter_costs_its_own_cluster_only() -> None:
    own = replace(SETTINGS, multiplexer=0, buses=(3, 4, 5, 6), channels=(0, 0, 0, 0))
    bench = Bench(settings=own)
    bench.hardware._buses.pop(5)  # an adapter that is not there
    reading = bench.read()
    assert missing(reading) == [2] and list(reading.faults) == ["posterior_distal"]
    assert bench.reader.identify()["distal"] == "FDC1004 at 0x50 on i2c-6"


@pytest.mark.parametrize(
    ("rate", "longest_wait"),
    [
        pytest.param(4.0, 2.5 * CYCLE, id="4-Hz"),
        pytest.param(77.0, 2.5 * CYCLE, id="77-Hz"),
        pytest.param(100.0, 0.9 * CYCLE, id="100-Hz"),
    ],
)
def test_triggers_of_any_rate_lose_nothing(rate: float, longest_wait: float) -> None:
    """Each waits about a cycle, at 100 Hz even with oscillators slower than the triggers."""
    bench = Bench(speeds=(1.03, 0.97, 0.985, 1.001), overhead=1e-3)
    bench.run(rate, 20)
    begin = bench.clock.now
    for n in range(150):
        assert is_good(bench.read(begin + n / rate))
        assert bench.clock.now - (begin + n / rate) < longest_wait


def test_a_silent_chip_is_named_by_its_place() -> None:
    bench = Bench()
    bench.faults.add("nack", 3.0, START, START + 1.0)
    found = str(bench.reader.identify()["posterior_distal"])
    check_line(found, f"no answer at {PLACE}", "the cluster's plug")
    assert missing(bench.read()) == [2]


def test_a_reading_that_comes_too_late_is_missing() -> None:
    bench = Bench()
    bench.read()
    bench.clock.now += 1.0
    trigger = bench.clock.now
    bench.clock.now += 0.03  # and 14 ms for the conversions
    assert is_good(bench.read(trigger))
    bench.clock.now += 1.0
    trigger = bench.clock.now
    bench.clock.now += 0.051
    late = bench.read(trigger)
    assert missing(late) == [0, 1, 2, 3]
    check_line(late.faults["distal"][0], "read more than 0.05 s after the trigger")


def test_a_closed_reader_leaves_no_chip_connected() -> None:
    bench = Bench()
    bench.read()
    multiplexer = bench.hardware.multiplexers[1, 0x70]
    assert multiplexer.mask != 0
    bench.reader.close()
    assert multiplexer.mask == 0
    bench.clock.now += 1.0
    assert is_good(bench.read())


def test_a_silent_multiplexer_is_one_fault_for_all() -> None:
    bench = Bench()
    bench.read()
    bench.hardware.multiplexers[1, 0x70].write = Mock(side_effect=OSError(errno.EREMOTEIO, "x"))
    reading = bench.read()
    assert missing(reading) == [0, 1, 2, 3]
    ((fault,),) = set(reading.faults.values())
    check_line(fault, "no answer at 0x70 on i2c-1", "multiplexer's plug")


@pytest.mark.parametrize("picofarads", [-14.0, 110.0], ids=["below", "above"])
@pytest.mark.parametrize("rate", [4.0, 100.0], ids=["4-Hz", "100-Hz"])
def test_the_range_follows_an_input(rate: float, picofarads: float) -> None:
    bench = Bench(slope=0.05)
    bench.offsets[2, 1] = picofarads
    readings = bench.run(rate, 12)
    status = np.array([reading.status.ravel() for reading in readings])
    assert (status[-1] == OK).all() and not any(reading.faults for reading in readings)
    assert set(np.argwhere(status != OK)[:, 1]) <= {4 * 2 + 1}
    bench.offsets[2, 1] = 1.0
    bench.clock.now += 0.1  # so that no reading is torn by the jump
    assert is_good(bench.run(rate, 12)[-1])


@pytest.mark.parametrize(
    ("picofarads", "capdac"),
    [pytest.param(120.0, 31, id="above"), pytest.param(-20.0, 0, id="below")],
)
def test_an_input_beyond_every_range_is_saturated(picofarads: float, capdac: int) -> None:
    bench = Bench()
    bench.offsets[0, 3] = picofarads
    reading = bench.run(4.0, 8)[-1]
    assert reading.status[0].tolist() == [OK, OK, OK, SATURATED]
    (fault,) = reading.faults["brim_lateral"]
    check_line(fault, "input 4 is out of range", f"CAPDAC {capdac}: ")


@pytest.mark.parametrize(
    "pause", [0.0, 8e-3, 9e-3, 11e-3], ids=["no-pause", "8-ms", "9-ms", "11-ms"]
)
def test_a_conversion_with_the_former_range_is_unused(clock: FakeClock, pause: float) -> None:
    """An input that jumps out of the range and back has one of its two values, or none."""
    settings = replace(SETTINGS, names=("distal",), buses=(1,), channels=(0,), multiplexer=0)
    for back in np.linspace(0.0, 0.03, 16):
        clock.now = START

        def jumping(n: int, moment: float, back: float = back) -> float:
            return 30.0 if START + 0.1 <= moment < START + 0.1 + back else 1.0

        chip = SimulatedFdc1004(jumping)
        bus = SimulatedI2cBus([chip])
        reader = ClusterReader(settings, Fdc1004, lambda n, bus=bus: bus)
        while clock.now < START + 0.25:
            for wait in (pause, 0.0):
                clock.now += wait
                reading = reader.read(clock.now)
                assert set(reading.capacitance[reading.status == OK]) <= {1.0, 30.0}
        assert is_good(reading), f"back after {back:.3f} s"


def test_a_chip_that_hangs_gives_nothing_old() -> None:
    bench = Bench()
    bench.read()
    hangs = bench.clock.now + 0.2
    bench.faults.add("stuck_done", 1.0, hangs)
    bench.clock.now = hangs
    # The chip hangs with its DONE bits up; any transfer to it makes the simulation notice.
    bench.reader.identify()
    assert missing(bench.read(hangs + 1.0)) == [0]
    assert is_good(bench.read(hangs + 2.0))


ERRNOS = ("EREMOTEIO", "EAGAIN", "EIO", "ETIMEDOUT", "EPROTO", "ESHUTDOWN", "ENODEV", "ENXIO")
OWN_BUSES = replace(SETTINGS, multiplexer=0, buses=(3, 4, 5, 6), channels=(0, 0, 0, 0))
TWO_MULTIPLEXERS = replace(SETTINGS, multiplexers=(0x70, 0x70, 0x71, 0x71))
LAYOUTS = {"multiplexer": SETTINGS, "bridges": OWN_BUSES, "two": TWO_MULTIPLEXERS}


@pytest.mark.parametrize("executed", [False, True], ids=["unsent", "executed"])
@pytest.mark.parametrize("rate", [20.0, 50.0], ids=["20-Hz", "50-Hz"])
@pytest.mark.parametrize("layout", ["multiplexer", "bridges"])
@pytest.mark.parametrize("name", ERRNOS)
def test_a_single_failed_transfer_costs_nothing(
    name: str, layout: str, rate: float, executed: bool
) -> None:
    """One in each of 10 samples, anywhere in its conversation."""
    bench = Bench(settings=LAYOUTS[layout])
    bench.run(rate, 4)
    failing = bench.hardware.failing[bench.settings.buses[0]]
    for n in range(10):
        failing.append(FailedTransfer(getattr(errno, name), after=5 * n, executed=executed))
        assert is_good(bench.read(bench.clock.now + 1.0 / rate)), n
        failing.clear()


@pytest.mark.parametrize("rate", [20.0, 50.0], ids=["20-Hz", "50-Hz"])
def test_a_transfer_that_times_out_costs_nothing(rate: float) -> None:
    """Each takes the whole timeout; the next trigger may have come meanwhile."""
    bench = Bench()
    bench.run(rate, 4)
    begin = bench.clock.now + 1.0 / rate
    lost = 0
    for n in range(60):
        if n % 6 == 0:
            slow = FailedTransfer(errno.ETIMEDOUT, after=n // 2, takes=SETTINGS.bus_timeout)
            bench.hardware.failing[1].append(slow)
        lost += not is_good(bench.read(begin + n / rate))
    assert not bench.hardware.failing[1]
    assert lost == 0


# Each errno behind one multiplexer; the other layouts with an adapter that hangs, and that is gone.
ABSENCES = [
    *((name, "multiplexer") for name in ERRNOS),
    *((name, layout) for layout in ("bridges", "two") for name in ("ETIMEDOUT", "ENODEV")),
]


@pytest.mark.parametrize(("name", "layout"), ABSENCES)
@pytest.mark.parametrize("rate", [1 / 0.3, 4.0, 50.0], ids=["idle", "4-Hz", "50-Hz"])
@pytest.mark.parametrize("absent", [0.2, 1.0, 3.0], ids=["for 0.2 s", "for 1 s", "for 3 s"])
def test_an_adapter_is_heard_within_a_second(
    name: str, rate: float, layout: str, absent: float
) -> None:
    """The kernel gives it back only when it is closed, whatever the errno; twice in a row."""
    bench = Bench(settings=LAYOUTS[layout])
    bench.run(rate, 4)
    for _ in range(2):
        bench.faults.clear()
        begin = bench.clock.now
        bench.faults.add("unplugged", getattr(errno, name), begin, begin + absent)
        readings = bench.run(rate, round(absent * rate))
        assert missing(readings[-1]) == [0, 1, 2, 3]
        bench.clock.now = max(bench.clock.now, begin + absent)
        readings = bench.run(rate, 1 + round(rate))
        assert is_good(readings[-1])


def test_a_chip_alone_does_not_close_its_bus() -> None:
    """The others of its multiplexers answer: they are not reset."""
    bench = Bench()
    bench.read()
    opened = list(bench.hardware._opened[1])
    bench.faults.add("nack", 2.0, bench.clock.now)
    assert [missing(reading) for reading in bench.run(4.0, 8)] == [[1]] * 8
    assert bench.hardware._opened[1] == opened


@pytest.mark.parametrize("rate", [20.0, 50.0], ids=["20-Hz", "50-Hz"])
def test_two_programs_on_one_bus_are_kept_apart(rate: float) -> None:
    """Without the lock one would select between the other's select and read."""
    bench = Bench()
    bench.run(rate, 4)
    other = ClusterReader(SETTINGS, Fdc1004, bench.hardware.open_bus)
    found = other.read(bench.clock.now)
    assert missing(found) == [0, 1, 2, 3]
    check_line(found.faults["distal"][0], "another program uses i2c-1 (process ")
    assert is_good(bench.read())
    bench.reader.close()
    bench.clock.now += 1.0
    assert is_good(other.read(bench.clock.now))


class Foreign:
    """A bus on which another program selects a channel after every 37th transfer."""

    def __init__(self, bus: I2cBus, other: I2cBus) -> None:
        self._bus, self._other = bus, other
        self._masks = itertools.cycle([None] * 36 + [1] + [None] * 36 + [8])

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        self._bus.i2c_rdwr(*messages)
        if (mask := next(self._masks)) is not None:
            self._other.i2c_rdwr(i2c_msg.write(0x70, [mask]))

    def close(self) -> None:
        self._bus.close()


def test_a_foreign_reader_gives_wrong_values() -> None:
    """This is what the lock keeps off: another cluster's value, with status OK."""
    bench = Bench()
    bench.hardware.is_locked = False
    opened = bench.hardware.open_bus
    bench.reader = ClusterReader(SETTINGS, Fdc1004, lambda n: Foreign(opened(n), opened(n)))
    wrong = 0
    for n in range(20):
        reading = bench.reader.read(START + 0.25 * n)
        truth = [[bench.capacitance(c, i, START + 0.25 * n) for i in range(4)] for c in range(4)]
        with np.errstate(invalid="ignore"):
            wrong += int((np.abs(reading.capacitance - truth) > 0.1).sum())
        bench.clock.now = max(bench.clock.now, START + 0.25 * n + 0.25)
    assert wrong > 0


def test_a_hung_bus_silences_no_other_chip(monkeypatch: pytest.MonkeyPatch) -> None:
    """It costs one time-out, two at first, and so do all four of them."""
    bench, transfer = Bench(), SimulatedI2cBus.i2c_rdwr
    masks: set[int] = set()  # the channels whose chips hang the bus

    def hang(bus: SimulatedI2cBus, *messages: i2c_msg) -> None:
        if bench.hardware.multiplexers[1, 0x70].mask in masks and messages[0].addr == 0x50:
            bench.clock.sleep(SETTINGS.bus_timeout)
            raise OSError(errno.ETIMEDOUT, "x")
        transfer(bus, *messages)

    monkeypatch.setattr(SimulatedI2cBus, "i2c_rdwr", hang)
    bench.read()
    masks.add(0b10)
    readings = bench.run(50.0, 200, START + 1.0)
    assert sum(missing(reading) == [1] for reading in readings) > 150
    masks |= {1, 4, 8}
    for n in range(6, 16):
        assert missing(bench.read(START + n)) == [0, 1, 2, 3]
        assert bench.clock.now - (START + n) < 0.06
    masks.clear()
    assert is_good(bench.run(4.0, 8, START + 17.0)[-1])


def test_doctor_gives_the_whole_hint_of_a_chip(monkeypatch) -> None:
    bench = Bench(speeds=(0.0, 1.0, 1.0, 1.0))
    monkeypatch.setattr(doctor, "make_clusters", lambda _: bench.reader)
    dead, *others = doctor.check_clusters(Testbed())
    assert dead.hint == "the chip is reset; if this recurs, check its supply"
    assert not any(other.hint for other in others)


@pytest.mark.parametrize(
    ("seed", "rate"),
    [
        pytest.param(0, 4.0, id="4-Hz"),
        pytest.param(1, 4.0, id="4-Hz-again"),
        pytest.param(2, 50.0, id="50-Hz"),
        pytest.param(3, 100.0, id="100-Hz"),
    ],
)
def test_random_faults_give_no_wrong_value(seed: int, rate: float) -> None:
    """After them, every chip is repaired."""
    faults = [name.removeprefix("clusters.") for name in FAULTS if name.startswith("clusters.")]
    rng = random.Random(seed)
    triggers = 200
    duration = triggers / rate
    bench = Bench(
        slope=8.0 / duration,
        speeds=tuple(rng.uniform(0.97, 1.03) for _ in range(4)),
        overhead=rng.choice([0.0, 1e-3]),
    )
    moment = START
    while moment < START + duration:
        moment += rng.expovariate(1.0 / (8 / rate))
        fault = rng.choice(faults)
        length = rng.choice([0.003, 0.3, 2.0])
        value = {"timeout": 0.05, "unplugged": 1.0}.get(fault)
        bench.faults.add(fault, value or 1.0 + rng.randrange(4), moment, moment + length)
    readings = bench.run(rate, triggers)
    assert sum(int((r.status == OK).sum()) for r in readings) > 0.1 * triggers * 16
    bench.faults.clear()
    assert is_good(bench.run(rate, round(max(3 * rate, 10)))[-1])
