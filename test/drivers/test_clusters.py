import errno
import random
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from smbus2 import i2c_msg
from support.clocks import FakeClock

from socket_testbed.drivers.clusters import i2c
from socket_testbed.drivers.clusters.fdc1004 import ChipResetError, Fdc1004, WrongChipError
from socket_testbed.drivers.clusters.i2c import (
    BusError,
    BusGoneError,
    BusTimeoutError,
    I2cBus,
    I2cPort,
    NoAnswerError,
)
from socket_testbed.drivers.clusters.reader import ClusterReader, ClusterReading
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.samples import Status
from socket_testbed.settings.acquisition import ClusterSettings
from socket_testbed.simulation.devices.i2c import (
    SimulatedClusterHardware,
    SimulatedFdc1004,
    SimulatedI2cBus,
)
from socket_testbed.simulation.world import FAULTS

OK, SATURATED, MISSING = Status.OK, Status.SATURATED, Status.MISSING
SETTINGS = ClusterSettings()
CYCLE = 0.01  # [s]
FREQUENCY = 400e3  # [Hz]
START = 1000.0  # [s]
CLUSTER_FAULTS = [name for name in FAULTS if name.startswith("clusters.")]


class Schedule(dict[str, float]):
    """Faults by their spans of time, as they are at present."""

    def __init__(self, clock: FakeClock) -> None:
        super().__init__()
        self.clock = clock
        self.spans: list[tuple[str, float, float, float]] = []
        self._changes_at = -np.inf  # [s]; what is on stays until then

    def add(self, name: str, value: float, begin: float, end: float = np.inf) -> None:
        self.spans.append((name, value, begin, end))
        self._changes_at = -np.inf

    def switch_off(self) -> None:
        self.spans.clear()
        self._changes_at = -np.inf

    def get(self, name: str, default: float = 0.0) -> float:  # type: ignore[override]
        now = self.clock.now
        if now >= self._changes_at:
            self.clear()
            for fault, value, begin, end in self.spans:
                if begin <= now < end:
                    self.setdefault(fault, value)
            edges = [edge for _, _, *span in self.spans for edge in span if edge > now]
            self._changes_at = min(edges, default=np.inf)
        return super().get(name, default)


class Spy:
    """A bus that notes its messages and checks that two chips are never connected."""

    def __init__(self, bus: I2cBus) -> None:
        self.bus = bus
        self.log: list[tuple[int, str, bytes]] = []
        self.is_open = True

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        assert self.is_open
        for message in messages:
            sent = bytes(message.buf[: message.len])
            if message.addr == 0x70:
                assert len(sent) == 1 and sent[0].bit_count() <= 1
        self.bus.i2c_rdwr(*messages)
        for message in messages:
            kind = "read" if message.flags & 1 else "write"
            self.log.append((message.addr, kind, bytes(message.buf[: message.len])))

    def close(self) -> None:
        self.is_open = False
        self.bus.close()


class Bench:
    """A reader on simulated hardware whose inputs all rise with time, each elsewhere."""

    def __init__(
        self,
        slope: float = 0.2,
        settings: ClusterSettings = SETTINGS,
        speeds: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0),
        overhead: float = 0.0,
    ) -> None:
        self.clock = FakeClock(START)
        self.faults = Schedule(self.clock)
        self.slope = slope  # [pF/s]
        self.offsets: dict[tuple[int, int], float] = {}
        self.hardware = SimulatedClusterHardware(
            self.capacitance, self.faults, FREQUENCY, self.clock, self.clock.sleep, speeds
        )
        self.settings = settings
        self.overhead = overhead
        self.buses: list[Spy] = []
        self.reader = ClusterReader(settings, self.open_bus, self.clock, self.clock.sleep)

    def open_bus(self, number: int) -> I2cBus:
        self.buses.append(Spy(self.hardware.open_bus(number)))
        return self.buses[-1]

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
        for row, name in enumerate(reading.names):
            assert missing[row].all() or not missing[row].any()
            # What is missing is explained, in one line.
            assert not missing[row].any() or ": " in reading.faults[name]
            assert "\n" not in reading.faults.get(name, "")
        assert (np.isnan(reading.capacitance) == (reading.status != OK)).all()
        cycle = 4 / self.settings.sample_rate
        for (row, n), value in np.ndenumerate(reading.capacitance):
            if not np.isnan(value):
                moment = START + (value - self.base(row, n)) / self.slope
                resolution = 2.0**-19 / self.slope
                assert trigger - 2 * cycle - resolution <= moment <= self.clock.now + resolution
        return reading

    def run(self, rate: float, triggers: int, start: float | None = None) -> list[ClusterReading]:
        """Readings at a rate [Hz]."""
        start = self.clock.now if start is None else start
        return [self.read(start + n / rate) for n in range(triggers)]


def missing(reading: ClusterReading) -> list[int]:
    """Rows of the clusters that are missing."""
    return [row for row in range(4) if (reading.status[row] == MISSING).all()]


# The conversations


class Script:
    """A bus that expects exactly these transfers."""

    def __init__(self, *transfers: tuple[tuple[str, int, bytes], ...]) -> None:
        self.transfers = list(transfers)

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        expected = self.transfers.pop(0)
        assert len(messages) == len(expected)
        for message, (kind, address, data) in zip(messages, expected, strict=True):
            assert (message.addr, message.len, message.flags) == (
                *(address, len(data)),
                int(kind == "read"),
            )
            if kind == "read":
                for index, byte in enumerate(data):
                    message.buf[index] = bytes([byte])
            else:
                assert bytes(message.buf[: message.len]) == data

    def close(self) -> None:
        assert not self.transfers


def reads(register: int, value: int) -> tuple[tuple[str, int, bytes], ...]:
    answer = value.to_bytes(2, "big")
    return (("write", 0x50, bytes([register])), ("read", 0x50, answer))


def writes(register: int, value: int) -> tuple[tuple[str, int, bytes], ...]:
    return (("write", 0x50, bytes([register, *value.to_bytes(2, "big")])),)


IDENTITY = (reads(0xFE, 0x5449), reads(0xFF, 0x1004))


def fdc1004(bus: I2cBus) -> Fdc1004:
    port = I2cPort(bus, "i2c-1", 0x50, "behind channel 2 of 0x70")
    return Fdc1004(port, sleep=lambda duration: None)


def test_a_register_is_read_in_one_transfer_with_a_repeated_start() -> None:
    bus = Script(reads(0x0C, 0x0DF3))
    assert I2cPort(bus, "i2c-1", 0x50).read(0x0C) == 0x0DF3
    bus.close()


def test_the_multiplexer_is_sent_one_byte_per_channel() -> None:
    bench = Bench()
    bench.reader.identify()
    sent = [data for address, _, data in bench.buses[0].log if address == 0x70]
    assert sent == [b"\x01", b"\x02", b"\x04", b"\x08"]


@pytest.mark.parametrize(("rate", "conf"), [(100, 0x05F0), (200, 0x09F0), (400, 0x0DF0)])
def test_a_chip_is_reset_identified_configured_and_read_back(rate: int, conf: int) -> None:
    settings = [(0x08, 0x1000), (0x09, 0x3000), (0x0A, 0x5000), (0x0B, 0x7000), (0x0C, conf)]
    bus = Script(
        writes(0x0C, 0x8000),
        reads(0x0C, 0x8000),
        reads(0x0C, 0x0000),
        *IDENTITY,
        *(writes(*setting) for setting in settings),
        *(reads(*setting) for setting in settings[:-1]),
        reads(0x0C, conf | 0x8),
        reads(0x0C, conf | 0xA),
        reads(0x04, 0xFFFF),
        reads(0x05, 0xFE00),
        reads(0x0C, 0x0000),
    )
    chip = fdc1004(bus)
    chip.reset_and_configure(rate)
    assert chip.done() == (True, False, True, False)
    assert chip.read(2) == -2
    with pytest.raises(ChipResetError, match="0x50 behind channel 2 of 0x70 on i2c-1 fell back"):
        chip.done()
    bus.close()


def test_another_chip_is_refused() -> None:
    bus = Script(reads(0xFE, 0x5449), reads(0xFF, 0x1234))
    text = r"0x50 behind channel 2 of 0x70 on i2c-1 says device 0x1234, not 0x1004: check the"
    with pytest.raises(WrongChipError, match=text):
        fdc1004(bus).check_identity()


def test_settings_that_do_not_stick_are_refused() -> None:
    settings = [(0x08, 0x1000), (0x09, 0x3000), (0x0A, 0x5000), (0x0B, 0x7000), (0x0C, 0x0DF0)]
    bus = Script(
        *(writes(0x0C, 0x8000), reads(0x0C, 0), *IDENTITY),
        *(writes(*setting) for setting in settings),
        reads(0x08, 0x1C00),
    )
    with pytest.raises(DeviceError, match=r"0x1C00 in register 0x08 where 0x1000.*: check the bus"):
        fdc1004(bus).reset_and_configure(400)


# Errors


class FailingBus:
    def __init__(self, number: int) -> None:
        self.number = number

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        raise OSError(self.number, "x")

    def close(self) -> None:
        raise OSError(errno.EBADF, "x")


@pytest.mark.parametrize(
    ("number", "kind", "text"),
    [
        (errno.EREMOTEIO, NoAnswerError, r"no answer at .*: check the cluster's plug and its"),
        (errno.ENXIO, NoAnswerError, r"no answer at .*: check the cluster's plug and its supply"),
        (errno.ETIMEDOUT, BusTimeoutError, r"the bus hangs at .*: check SDA and SCL"),
        (errno.ENODEV, BusGoneError, r"the bus is gone at .*: check the adapter of i2c-1"),
        (errno.EBADF, BusGoneError, r"the bus is gone at .*: check the adapter of i2c-1"),
        (errno.EIO, BusGoneError, r"the bus is gone at .*: check the adapter of i2c-1"),
        (errno.EAGAIN, BusError, r"transfer failed at .*temporarily.*: check the cluster's"),
    ],
)
def test_errors_name_the_place_and_the_hint(number: int, kind: type[BusError], text: str) -> None:
    port = I2cPort(FailingBus(number), "i2c-1", 0x50, "behind channel 2 of 0x70")
    for call in (lambda: port.read(0), lambda: port.write(0, 0), lambda: port.write_byte(0)):
        with pytest.raises(BusError, match=text) as caught:
            call()
        assert type(caught.value) is kind
        assert caught.value.address == 0x50
        assert "0x50 behind channel 2 of 0x70 on i2c-1" in str(caught.value)


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (
            PermissionError(errno.EACCES, "x"),
            r"/dev/i2c-7: permission denied: add the user to",
        ),
        (FileNotFoundError(errno.ENOENT, "x"), r"there is no /dev/i2c-7: enable the bus"),
        (OSError(errno.ENOTTY, "x"), r"/dev/i2c-7 cannot be opened .*: check"),
    ],
)
def test_a_bus_that_cannot_be_opened_says_why(
    monkeypatch: pytest.MonkeyPatch, error: OSError, text: str
) -> None:
    class Refused:
        closed = False

        def open(self, number: int) -> None:
            raise error

        def close(self) -> None:
            Refused.closed = True

    monkeypatch.setattr(i2c, "SMBus", Refused)
    with pytest.raises(DeviceError, match=text):
        i2c.open_i2c(7, 0.05)
    assert Refused.closed
    settings = replace(SETTINGS, buses=(7, 7, 7, 7))
    clock = FakeClock(START)
    reader = ClusterReader(settings, lambda n: i2c.open_i2c(n, 0.05), clock, clock.sleep)
    reading = reader.read(clock.now)
    assert (reading.status == MISSING).all()
    assert len(reading.faults) == 4 and len(set(reading.faults.values())) == 1


def test_the_kernel_gets_the_time_out_of_the_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    class Opened:
        fd = 5

        def open(self, number: int) -> None:
            assert number == 1

    calls = []
    monkeypatch.setattr(i2c, "SMBus", Opened)
    monkeypatch.setattr(i2c, "ioctl", lambda *request: calls.append(request))
    i2c.open_i2c(1, 0.05)
    assert calls == [(5, 0x0702, 5)]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"buses": (1, 1, 1)}, "3 buses"),
        ({"names": ()}, "0 names"),
        ({"sample_rate": 300}, "sample_rate is 300"),
        ({"channels": (0, 1, 2, 1)}, "'mid_anterior' and 'distal' share"),
        ({"names": ("a", "b", "a", "c")}, "'a' and 'a' share"),
        ({"multiplexer": 0}, "share"),
        ({"multiplexer": 0x50}, "multiplexer is 0x50"),
    ],
)
def test_settings_that_do_not_fit_together_are_refused(
    change: dict[str, object], text: str
) -> None:
    with pytest.raises(ConfigurationError, match=text):
        ClusterReader(replace(SETTINGS, **change), lambda number: FailingBus(1))


# A healthy array


@pytest.mark.parametrize("sample_rate", [100, 200, 400])
@pytest.mark.parametrize("rate", [0.5, 4.0])
def test_slow_triggers_get_new_conversions_within_about_a_cycle(
    rate: float, sample_rate: int
) -> None:
    bench = Bench(settings=replace(SETTINGS, sample_rate=sample_rate))
    bench.run(rate, 1)
    for n in range(1, 10):
        trigger = START + n / rate
        reading = bench.read(trigger)
        assert (reading.status == OK).all() and not reading.faults and not reading.notes
        assert bench.clock.now - trigger < 1.1 * 4 / sample_rate + 8e-3


@pytest.mark.slow
@pytest.mark.parametrize("speeds", [(1.03, 0.97, 0.999, 1.001), (1.0, 0.99, 1.0, 0.985)])
@pytest.mark.parametrize("overhead", [0.0, 1e-3])
def test_at_100_hz_nothing_is_lost_nor_falls_behind(
    speeds: tuple[float, ...], overhead: float
) -> None:
    """Even with oscillators that are slower than the triggers."""
    bench = Bench(speeds=speeds, overhead=overhead)
    bench.run(100.0, 20)
    begin = bench.clock.now
    repeated, delays = np.zeros(4), []
    previous = np.full((4, 4), np.nan)
    for n in range(1000):
        reading = bench.read(begin + n / 100)
        assert (reading.status == OK).all() and not reading.faults
        repeated += (reading.capacitance == previous).sum(axis=1)
        delays.append(bench.clock.now - (begin + n / 100))
        previous = reading.capacitance
    # A chip that is slower than the triggers has nothing new for some of them.
    assert (repeated <= np.maximum(0.0, 1.0 - np.array(speeds)) * 1000 * 4 + 30).all()
    assert max(delays) < 0.9 * CYCLE


@pytest.mark.slow
@pytest.mark.parametrize("rate", [33.0, 50.0, 77.0])
def test_triggers_of_any_rate_lose_nothing(rate: float) -> None:
    bench = Bench()
    for reading in bench.run(rate, 500):
        assert (reading.status == OK).all() and not reading.faults


def test_a_cluster_can_have_a_bus_of_its_own() -> None:
    clock = FakeClock(START)
    hardware = SimulatedClusterHardware(
        lambda c, n, t: c + 0.1 * n, {}, FREQUENCY, clock, clock.sleep
    )
    settings = replace(SETTINGS, multiplexer=0, buses=(3, 4, 5, 6), channels=(0, 0, 0, 0))
    opened = []

    def open_bus(number: int) -> I2cBus:
        opened.append(number)
        if number == 5:
            raise OSError(errno.ENOENT, "x")
        return SimulatedI2cBus([hardware.chips[number - 3]], sleep=clock.sleep)

    reader = ClusterReader(settings, open_bus, clock, clock.sleep)
    reading = reader.read(clock.now)
    assert missing(reading) == [2] and opened == [3, 4, 5, 6]
    assert list(reading.faults) == ["posterior_distal"]
    assert reading.capacitance[3] == pytest.approx(3 + 0.1 * np.arange(4), abs=1e-5)
    assert reader.identify()["distal"] == "FDC1004 at 0x50 on i2c-6"


def test_a_late_reading_is_missing_and_leaves_the_bus_alone() -> None:
    bench = Bench()
    bench.run(4.0, 3)
    transfers = len(bench.buses[0].log)
    trigger = bench.clock.now
    bench.clock.now += 0.051
    reading = bench.read(trigger)
    assert missing(reading) == [0, 1, 2, 3]
    assert all(
        "read more than 0.05 s after the trigger" in fault for fault in reading.faults.values()
    )
    assert len(bench.buses[0].log) == transfers
    assert not bench.read().faults


def test_what_is_wired_is_identified() -> None:
    bench = Bench()
    bench.faults.add("clusters.nack", 3.0, START)
    found = bench.reader.identify()
    assert found["distal"] == "FDC1004 at 0x50 behind channel 3 of 0x70 on i2c-1"
    assert str(found["posterior_distal"]).startswith(
        "no answer at 0x50 behind channel 2 of 0x70 on i2c-1: check the cluster's plug"
    )
    assert missing(bench.read()) == [2]


def test_closing_disconnects_the_chips_and_closes_the_bus() -> None:
    bench = Bench()
    bench.read()
    bench.reader.close()
    assert bench.buses[0].log[-1] == (0x70, "write", b"\x00")
    assert not bench.buses[0].is_open
    bench.reader.close()
    assert not bench.read().faults and len(bench.buses) == 2


@pytest.mark.parametrize("fault", ["clusters.unplugged", "clusters.timeout"])
def test_closing_a_dead_bus_does_not_raise(fault: str) -> None:
    bench = Bench()
    bench.read()
    bench.faults.add(fault, 0.05, START)
    bench.reader.close()


def test_a_bus_whose_close_fails_is_closed() -> None:
    clock = FakeClock(START)
    reader = ClusterReader(SETTINGS, lambda n: FailingBus(errno.ENODEV), clock, clock.sleep)
    assert missing(reader.read(clock.now)) == [0, 1, 2, 3]
    reader.close()


# Range


@pytest.mark.parametrize("picofarads", [-14.0, 17.0, 30.0, 60.0, 90.0, 110.0])
@pytest.mark.parametrize("rate", [4.0, 50.0, 100.0])
def test_the_range_follows_an_input(picofarads: float, rate: float) -> None:
    bench = Bench(slope=0.05)
    bench.offsets[2, 1] = picofarads
    readings = bench.run(rate, 12)
    statuses = [reading.status[2, 1] for reading in readings]
    assert statuses[-1] == OK and set(statuses) <= {OK, SATURATED}
    assert statuses == sorted(statuses, reverse=True)
    assert sum(status == SATURATED for status in statuses) <= 8
    for reading in readings:
        others = np.delete(reading.status.ravel(), 4 * 2 + 1)
        assert (others == OK).all() and not reading.faults
    bench.offsets[2, 1] = 1.0
    bench.clock.now += 0.1  # so that no reading is torn by the jump
    assert (bench.run(rate, 12)[-1].status == OK).all()


@pytest.mark.parametrize("pause", [0.0, 8e-3, 9e-3, 10e-3, 11e-3])
@pytest.mark.parametrize("back", np.linspace(0.0, 0.03, 31))
def test_a_conversion_with_the_former_range_is_not_used(back: float, pause: float) -> None:
    """An input that jumps out of the range and back has one of its two values, or none."""
    clock = FakeClock(START)

    def jumping(n: int, moment: float) -> float:
        return 30.0 if START + 0.1 <= moment < START + 0.1 + back else 1.0

    chip = SimulatedFdc1004(jumping, clock)
    bus = SimulatedI2cBus([chip], frequency=FREQUENCY, clock=clock, sleep=clock.sleep)
    settings = replace(SETTINGS, names=("distal",), buses=(1,), channels=(0,), multiplexer=0)
    reader = ClusterReader(settings, lambda number: bus, clock, clock.sleep)
    while clock.now < START + 0.25:
        for wait in (pause, 0.0):
            clock.now += wait
            reading = reader.read(clock.now)
            assert set(reading.capacitance[reading.status == OK]) <= {1.0, 30.0}
    assert (reading.status == OK).all()


@pytest.mark.parametrize(("picofarads", "capdac"), [(120.0, 31), (-20.0, 0)])
def test_an_input_beyond_every_range_is_saturated_and_said(picofarads: float, capdac: int) -> None:
    bench = Bench()
    bench.offsets[0, 3] = picofarads
    reading = bench.run(4.0, 8)[-1]
    assert reading.status[0].tolist() == [OK, OK, OK, SATURATED]
    assert (
        f"input 4 is out of range at 0x50 behind channel 0 of 0x70 on i2c-1, CAPDAC {capdac}"
        in (reading.faults["brim_lateral"])
    )


# Faults

FAULT_CASES = [
    ("clusters.unplugged", 1.0, [0, 1, 2, 3], "i2c-1"),
    ("clusters.nack", 3.0, [2], "no answer at 0x50 behind channel 2 of 0x70 on i2c-1: check"),
    ("clusters.timeout", 0.05, [0, 1, 2, 3], "the bus hangs at 0x70 on i2c-1: check SDA"),
    ("clusters.stuck_done", 2.0, [1], "do not finish at 0x50 behind channel 1 of 0x70 on i2c-1"),
    ("clusters.brown_out", 4.0, [3], "channel 3 of 0x70 on i2c-1 fell back to its reset state"),
]


@pytest.mark.parametrize("rate", [4.0, 50.0, 100.0])
@pytest.mark.parametrize(("fault", "value", "rows", "text"), FAULT_CASES)
def test_a_fault_is_reported_and_overcome(
    fault: str, value: float, rows: list[int], text: str, rate: float
) -> None:
    bench = Bench()
    assert not bench.run(rate, 5)[-1].faults
    begin = bench.clock.now + 0.5 / rate
    bench.faults.add(fault, value, begin, begin + 2.0)
    struck = bench.run(rate, round(2.0 * rate), begin)
    # Some readings come too late where a bus hangs; apart from that the others go on.
    reported = [r for r in struck if r.faults and "too late" not in "".join(r.faults.values())]
    assert reported and all(missing(reading) == rows for reading in reported)
    assert all(text in reading.faults[reading.names[row]] for reading in reported for row in rows)
    after = bench.run(rate, round(2.0 * rate), begin + 2.0)
    good = [not reading.faults for reading in after]
    assert all(good[round(1.0 * rate) :])


def test_a_rail_saturates_its_chip_alone_and_is_left_again() -> None:
    bench = Bench()
    bench.faults.add("clusters.rail", 2.0, START + 1.0, START + 3.0)
    for n, reading in enumerate(bench.run(4.0, 24)):
        assert (reading.status[[0, 2, 3]] == OK).all()
        if 4 < n < 12:
            assert (reading.status[1] == SATURATED).all()
        if n < 4 or n >= 17:
            assert (reading.status[1] == OK).all()


def test_shifted_inputs_are_never_taken_for_the_right_ones() -> None:
    bench = Bench()
    bench.faults.add("clusters.shifted", 3.0, START)
    bench.faults.add("clusters.unplugged", 1.0, START + 1.0, START + 1.5)
    readings = bench.run(4.0, 20)
    assert not readings[0].faults and not readings[-1].faults and len(bench.buses) == 2


def test_a_chip_that_hangs_between_slow_triggers_gives_nothing_old() -> None:
    bench = Bench()
    bench.read()
    hangs = bench.clock.now + 0.2
    bench.faults.add("clusters.stuck_done", 1.0, hangs)
    bench.clock.now = hangs
    # The chip hangs with its DONE bits up; any transfer to it makes the simulation notice.
    bench.reader.identify()
    assert missing(bench.read(hangs + 1.0)) == [0]
    assert not bench.read(hangs + 2.0).faults


def test_a_hung_bus_costs_one_time_out_a_reading() -> None:
    bench = Bench()
    bench.read()
    bench.faults.add("clusters.timeout", 0.05, START)
    for n in range(1, 20):
        trigger = START + n
        bench.read(trigger)
        assert bench.clock.now - trigger < 0.06


def test_a_chip_that_hangs_the_bus_does_not_silence_the_others() -> None:
    bench = Bench()
    bench.read()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SimulatedI2cBus, "i2c_rdwr", hanging(bench, masks={0b10}))
        readings = bench.run(50.0, 200, START + 1.0)
    others = [reading for reading in readings if missing(reading) == [1]]
    assert len(others) > 150
    assert not bench.read(START + 6.0).faults


def test_chips_that_hang_the_bus_cost_one_time_out_a_reading() -> None:
    bench = Bench()
    bench.read()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SimulatedI2cBus, "i2c_rdwr", hanging(bench, masks={1, 2, 4, 8}))
        for n in range(1, 10):
            reading = bench.read(START + n)
            assert missing(reading) == [0, 1, 2, 3]
            assert bench.clock.now - (START + n) < 0.06
    assert not bench.run(4.0, 8)[-1].faults


def hanging(bench: Bench, masks: set[int]) -> Callable[..., None]:
    """Transfers that hang with the chips of these channels, but not with the multiplexer."""
    transfer = SimulatedI2cBus.i2c_rdwr

    def hang(bus: SimulatedI2cBus, *messages: i2c_msg) -> None:
        if bench.hardware.multiplexer.mask in masks and messages[0].addr == 0x50:
            bench.clock.sleep(0.05)
            raise OSError(errno.ETIMEDOUT, "x")
        transfer(bus, *messages)

    return hang


def test_a_multiplexer_that_does_not_answer_is_named_once_for_all() -> None:
    bench = Bench()
    bench.read()
    bench.hardware.multiplexer.write = _refuse  # type: ignore[method-assign]
    reading = bench.read(START + 1.0)
    assert missing(reading) == [0, 1, 2, 3]
    assert set(reading.faults.values()) == {
        "no answer at 0x70 on i2c-1: check the multiplexer's plug and its supply"
    }


def _refuse(data: bytes) -> None:
    raise OSError(errno.EREMOTEIO, "x")


@pytest.mark.parametrize("moment", np.linspace(0.0, 0.03, 61))
def test_a_reset_at_any_moment_of_a_reading_gives_no_zeros(moment: float) -> None:
    bench = Bench()
    bench.run(4.0, 4)
    trigger = START + 1.0
    bench.faults.add("clusters.brown_out", 2.0, trigger + moment)
    for n in range(4):
        bench.read(trigger + 0.25 * n)


# Random faults


def value_of(fault: str, rng: random.Random) -> float:
    if fault == "clusters.timeout":
        return rng.choice([0.01, 0.05])
    return 1.0 if fault == "clusters.unplugged" else 1.0 + rng.randrange(4)


PAIRS = [(a, b) for k, a in enumerate(CLUSTER_FAULTS) for b in CLUSTER_FAULTS[k + 1 :]]


@pytest.mark.parametrize("pair", PAIRS, ids="+".join)
@pytest.mark.parametrize("rate", [4.0, 50.0])
def test_pairs_of_faults_give_no_wrong_value_and_are_repaired(
    pair: tuple[str, str], rate: float
) -> None:
    rng = random.Random("+".join(pair))
    bench = Bench()
    bench.faults.add(pair[0], value_of(pair[0], rng), START + 0.5, START + 1.5)
    bench.faults.add(pair[1], value_of(pair[1], rng), START + 1.0, START + 2.0)
    readings = bench.run(rate, round(3.5 * rate))
    assert (readings[-1].status == OK).all() and not readings[-1].faults


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("rate", [4.0, 50.0, 100.0])
def test_random_faults_give_no_wrong_value_and_are_repaired(rate: float, seed: int) -> None:
    rng = random.Random(seed)
    triggers = 400
    duration = triggers / rate
    bench = Bench(
        slope=8.0 / duration,
        speeds=tuple(rng.uniform(0.97, 1.03) for _ in range(4)),
        overhead=rng.choice([0.0, 1e-3]),
    )
    moment = START
    while moment < START + duration:
        moment += rng.expovariate(1.0 / (8 / rate))
        fault = rng.choice(CLUSTER_FAULTS)
        length = rng.choice([0.003, 0.3, 2.0])
        bench.faults.add(fault, value_of(fault, rng), moment, moment + length)
    readings = bench.run(rate, triggers)
    got = sum(int((reading.status == OK).sum()) for reading in readings)
    assert got > 0.1 * triggers * 16
    bench.faults.switch_off()
    readings = bench.run(rate, round(max(3 * rate, 10)))
    assert (readings[-1].status == OK).all() and not readings[-1].faults
