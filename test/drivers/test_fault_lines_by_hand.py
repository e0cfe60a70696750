"""Each fault of a driver as the user reads it: the whole line, with its place, number and hint."""

import errno
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, ClassVar
from unittest.mock import Mock

import gpiod
import numpy as np
import pytest
from support.clocks import FakeClock

from socket_testbed.drivers import ERROR, OK, WARN, gpio
from socket_testbed.drivers.clusters import i2c
from socket_testbed.drivers.clusters.fdc1004 import Fdc1004
from socket_testbed.drivers.clusters.i2c import I2cPort
from socket_testbed.drivers.clusters.reader import ClusterReader
from socket_testbed.drivers.clusters.reader import check_settings as check_clusters
from socket_testbed.drivers.gpio import GpiodLines, GpioTrigger
from socket_testbed.drivers.load_cell import ads131m0x
from socket_testbed.drivers.load_cell.ads131m0x import Ads131m0x
from socket_testbed.drivers.load_cell.converter_reader import ConverterReader
from socket_testbed.drivers.load_cell.load_cell import Bridges, LoadCell, in_words
from socket_testbed.drivers.load_cell.load_cell import check_settings as check_load_cell
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.files import packaged
from socket_testbed.settings.acquisition import ClusterSettings, LoadCellSettings, TriggerSettings
from socket_testbed.settings.testbed import read_testbed
from socket_testbed.simulation.devices.ads131m0x import SimulatedAds131m0x, simulated_load_cell
from socket_testbed.simulation.devices.fdc1004 import SimulatedFdc1004
from socket_testbed.simulation.devices.i2c import SimulatedClusterHardware

CELL = read_testbed(packaged("config", "simulated.yaml")).load_cell_node


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeClock:
    return FakeClock(1000.0).install(monkeypatch)


def line_of(call: Callable[[], Any], kind: type[Exception] = DeviceError) -> str:
    """The line of the error that a call raises."""
    with pytest.raises(kind) as found:
        call()
    return str(found.value)


# --- files of devices

REFUSED = "permission denied: add the user to the group {0} (sudo usermod -aG {0} $USER), then log"
I2C_MISSING = "enable the bus (dtparam=i2c_arm=on in config.txt), or set cluster_node's buses"
SPI_MISSING = "enable SPI (dtparam=spi=on in config.txt), or set load_cell_node's device"
OPENED = {  # number of the error: lines of an I2C bus and of an SPI device
    "EACCES": (REFUSED.format("i2c") + " in again", REFUSED.format("spi") + " in again"),
    "EPERM": (REFUSED.format("i2c") + " in again", REFUSED.format("spi") + " in again"),
    "ENOENT": (I2C_MISSING, SPI_MISSING),
    "ENODEV": (I2C_MISSING, SPI_MISSING),
    "ENXIO": (I2C_MISSING, SPI_MISSING),
    "EBUSY": (
        "cannot be opened (said): check that it is an I2C bus, and doctor's kernel row",
        "cannot be opened (said): check load_cell_node's spi_clock, and that the controller has"
        " SPI mode 1",
    ),
}


@pytest.mark.parametrize("name", OPENED)
def test_a_device_that_cannot_be_opened_says_why(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    error = OSError(getattr(errno, name), "said")
    device = Mock(open=Mock(side_effect=error))
    monkeypatch.setattr(i2c, "SMBus", lambda: device)
    monkeypatch.setitem(sys.modules, "spidev", SimpleNamespace(SpiDev=lambda: device))
    opening = (lambda: i2c.open_i2c(7, 0.05)), (lambda: ads131m0x.open_spi("1.2", 8e6))
    paths = "/dev/i2c-7", "/dev/spidev1.2"
    for call, path, words in zip(opening, paths, OPENED[name], strict=True):
        if words in (I2C_MISSING, SPI_MISSING):
            expected = f"there is no {path}: {words}"
        else:
            expected = f"{path} {words}" if name == "EBUSY" else f"{path}: {words}"
        assert line_of(call) == expected


@pytest.mark.parametrize(
    ("module", "call", "line"),
    [
        (
            "spidev",
            lambda: ads131m0x.open_spi("0.0", 8e6),
            "/dev/spidev0.0: the Python module spidev is not installed: install python3-spidev"
            " (apt) or requirements/hardware.txt",
        ),
        (
            "gpiod",
            lambda: lines("a chip"),
            "gpiod cannot be imported: pip install -r requirements/hardware.txt, or set"
            " load_cell_node's data_ready_line to -1",
        ),
    ],
    ids=["spidev", "gpiod"],
)
def test_a_lacking_module_says_how_to_install_it(
    module: str, call: Callable[[], Any], line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    assert line_of(call) == line


# --- GPIO


def lines(label: str) -> GpiodLines:
    """Lines of load_cell_node, an output and an input."""
    node, setting, without = "load_cell_node", "data_ready_chip", "data_ready_line to -1"
    return GpiodLines(label, {5: "output", 22: "falling"}, node, setting, without)


class Chip:
    """Stands for `gpiod.Chip` of a path."""

    labels: ClassVar[dict[str, str | Exception]] = {}

    def __init__(self, path: str) -> None:
        self._label = self.labels[path]
        if isinstance(self._label, Exception):
            raise self._label

    def __enter__(self) -> "Chip":
        return self

    def __exit__(self, *given: object) -> None:
        """Do nothing."""

    def get_info(self) -> Any:
        return SimpleNamespace(label=self._label)


DENIED, BROKEN = PermissionError(), OSError(errno.EIO, "broken")
CHIPS: dict[str, tuple[dict[str, str | Exception], str]] = {
    "first of one label": ({"4": "rp1", "0": "rp1"}, "/dev/gpiochip0"),
    "beside a refused one": ({"0": DENIED, "4": "rp1"}, "/dev/gpiochip4"),
    "beside a broken one": ({"0": BROKEN, "4": "rp1"}, "/dev/gpiochip4"),
    "refused": (
        {"0": "other", "4": DENIED},
        "/dev/gpiochip4: permission denied: add the user to the group gpio (sudo usermod -aG"
        " gpio $USER), then log in again",
    ),
    "others": (
        {"0": "gpio-brcm", "4": "raspberrypi-exp"},
        "there is no GPIO chip 'rp1' (there is gpio-brcm, raspberrypi-exp): set load_cell_node's"
        " data_ready_chip, or its data_ready_line to -1",
    ),
    "none": (
        {"4": BROKEN},
        "there is no GPIO chip 'rp1' (there is none): set load_cell_node's data_ready_chip, or its"
        " data_ready_line to -1",
    ),
}


@pytest.mark.parametrize("case", CHIPS)
def test_a_chip_is_found_by_its_label(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    labels, expected = CHIPS[case]
    asked: list[str] = []
    monkeypatch.setattr(Chip, "labels", {f"/dev/gpiochip{n}": own for n, own in labels.items()})
    folder = SimpleNamespace(glob=lambda pattern: [*Chip.labels])
    monkeypatch.setattr(gpio, "Path", lambda path: folder)
    monkeypatch.setattr(gpiod, "Chip", Chip)
    monkeypatch.setattr(gpiod, "request_lines", lambda path, **given: asked.append(path))
    if ":" in expected:
        assert line_of(lambda: lines("rp1")) == expected
    else:
        lines("rp1")
        assert asked == [expected]


def test_lines_in_use_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpio, "_chip", lambda *given: "/dev/gpiochip4")
    monkeypatch.setattr(gpiod, "request_lines", Mock(side_effect=OSError("busy")))
    assert line_of(lambda: lines("rp1")) == (
        "/dev/gpiochip4: line 5 and line 22 cannot be used (busy): check that no overlay uses them"
        " and that the chip knows edges"
    )


def test_a_trigger_s_lost_lines_are_one_fault() -> None:
    """The pulse says so, not its end."""
    broken = Mock(set=Mock(side_effect=OSError(errno.ENODEV, "gone")), edges=lambda within: [])
    trigger = GpioTrigger(broken, TriggerSettings())
    fault = (
        "the GPIO lines of pinctrl-rp1 are gone (gone): check the chip's overlay or adapter; it is"
        " opened again automatically"
    )
    assert line_of(trigger.fire) == fault
    trigger.end_pulse()


# --- the clusters' chips

TRANSFERS = {  # number of the error: line of a part at a place
    "EREMOTEIO": "no answer at {place}: check the {part}'s plug and its supply",
    "ENXIO": "no answer at {place}: check the {part}'s plug and its supply",
    "ETIMEDOUT": "the bus hangs at {place}: check SDA and SCL for a short, their pull-ups, and"
    " doctor's kernel row",
    **dict.fromkeys(
        ("ENODEV", "ENOENT", "EBADF"),
        "the bus is gone at {place} (said): check the adapter of i2c-3; it will be reopened"
        " automatically",
    ),
    "EIO": "transfer failed at {place} (said): check the {part}'s wiring (SDA, SCL, ground) and"
    " plug, then the adapter of i2c-3",
    "EAGAIN": "the bus is disturbed at {place} (lost arbitration): check SDA and SCL for"
    " interference, and that no other master is on the bus",
}


@pytest.mark.parametrize("name", TRANSFERS)
@pytest.mark.parametrize("part", ["cluster", "multiplexer"])
def test_a_failed_transfer_names_its_part(part: str, name: str) -> None:
    bus = Mock(i2c_rdwr=Mock(side_effect=OSError(getattr(errno, name), "said")))
    behind = "behind channel 2 of 0x70" if part == "cluster" else ""
    port = I2cPort(bus, "i2c-3", 0x50, behind, part)
    place = "0x50 behind channel 2 of 0x70 on i2c-3" if behind else "0x50 on i2c-3"
    assert line_of(lambda: port.read(8)) == TRANSFERS[name].format(place=place, part=part)


class Registers:
    """Stands for the port of a chip, whose registers answer in turn with some words."""

    where = "0x50 on i2c-1"

    def __init__(self, *words: int) -> None:
        self._words = list(words)
        self.written: list[tuple[int, int]] = []

    def read(self, register: int) -> int:
        return self._words.pop(0)

    def write(self, register: int, value: int) -> None:
        self.written.append((register, value))


MAKER, DEVICE = 0x5449, 0x1004
CHIP_LINES: dict[str, tuple[tuple[int, ...], Callable[[Fdc1004], Any], str]] = {
    "maker": (
        (0x5448, DEVICE),
        Fdc1004.check_identity,
        "says maker 0x5448, not 0x5449: check the address and the wiring, this is not an FDC1004",
    ),
    "device": (
        (MAKER, 0x1005),
        Fdc1004.check_identity,
        "says device 0x1005, not 0x1004: check the address and the wiring, this is not an FDC1004",
    ),
    "reset": (
        (0x8000,) * 10,
        Fdc1004.reset_and_configure,
        "does not leave its reset: check its supply",
    ),
    "register": (
        (0, MAKER, DEVICE, 0x1000, 0x3040),
        Fdc1004.reset_and_configure,
        "holds 0x3040 in register 0x09 where 0x3000 was written: check the bus's wiring and its"
        " pull-ups",
    ),
    "brown-out": (
        (0x000F,),
        Fdc1004.done,
        "fell back to its reset state (FDC_CONF 0x000F, not 0x05F0): it is configured again; check"
        " its supply",
    ),
}


@pytest.mark.parametrize("case", CHIP_LINES)
def test_a_chip_s_fault_has_its_words(case: str) -> None:
    words, call, line = CHIP_LINES[case]
    port: Any = Registers(*words)
    assert line_of(lambda: call(Fdc1004(port, 100))) == f"0x50 on i2c-1 {line}"


@pytest.mark.parametrize(
    ("code", "steps", "capdac"), [(0x7FFFFF, 4, 31), (-0x800000, 0, 0)], ids=["above", "below"]
)
def test_an_input_out_of_every_range_is_named(code: int, steps: int, capdac: int) -> None:
    """Offsets of 0, 8, 16, 24 and 31 steps; the last range is at its end."""
    port: Any = Registers()
    chip = Fdc1004(port, 100)
    for _ in range(steps):
        assert chip.convert(2, code).shifted
    found = chip.convert(2, code)
    assert not found.shifted and np.isnan(found.picofarads)
    assert found.fault == (
        f"input 3 is out of range at 0x50 on i2c-1, CAPDAC {capdac}: check its sensor for a short"
        " or a broken wire"
    )


def stuck(duration: float, clock: FakeClock) -> tuple[str, ...]:
    """Faults of a chip that stopped converting, after readings for so long [s]."""
    settings = ClusterSettings(
        names=("a",), buses=(1,), channels=(0,), multiplexers=(0,), sample_rate=400
    )
    faults: dict[str, float] = {}
    hardware = SimulatedClusterHardware(settings, SimulatedFdc1004, lambda *_: 5.0, faults)
    reader = ClusterReader(settings, Fdc1004, hardware.open_bus)
    reader.read(clock.now)
    clock.now += 0.1
    faults["clusters.stuck_done"] = 1.0
    begun = clock.now
    found = reader.read(begun).faults.get("a", ())
    assert clock.now - begun == pytest.approx(duration, abs=2e-3)
    return found


def test_a_chip_may_take_two_and_a_half_cycles(clock: FakeClock) -> None:
    """Of 10 ms each, from the reading's begin."""
    line = "conversions of input 1 do not finish at 0x50 on i2c-1: the chip is reset; if this"
    assert stuck(0.025, clock) == (f"{line} recurs, check its supply",)


PLACES: dict[str, tuple[dict[str, Any], str]] = {
    "name": (
        {"names": ("a", "b", "a", "d")},
        "the clusters 'a' and 'a' share a name or bus 1, channel 2 of 0x70: give each cluster its"
        " own name and place",
    ),
    "bus": (
        {"multiplexers": (0,) * 4, "buses": (1, 3, 3, 4)},
        "the clusters 'mid_anterior' and 'posterior_distal' share a name or bus 3: give each"
        " cluster its own name and place",
    ),
    "beside a multiplexer": (
        {"multiplexers": (0x70, 0x70, 0, 0x70)},
        "bus 1 has a cluster without a multiplexer beside 'brim_lateral' behind one: put it on a"
        " channel of the multiplexer, or on a bus of its own",
    ),
}


@pytest.mark.parametrize("case", PLACES)
def test_clusters_at_one_place_are_named(case: str) -> None:
    change, line = PLACES[case]
    wrong = replace(ClusterSettings(), **change)
    assert line_of(lambda: check_clusters(wrong, Fdc1004), ConfigurationError) == line


# --- the load cell's converter


def sends(*changes: tuple[int, bytes]) -> Any:
    """An SPI device whose answers have some bytes at their heads, by the number of the frame."""
    chip = SimulatedAds131m0x(lambda moment: np.zeros(6), seed=1)
    heads, sent = dict(changes), []

    def xfer2(data: list[int], /) -> list[int]:
        answer = chip.xfer2(data)
        sent.append(data)
        if (head := heads.get(len(sent))) is None:
            return answer
        content = head + bytes(answer[len(head) : -3])
        return [*content, *ads131m0x.checksum(content, "ccitt").to_bytes(2, "big"), 0]

    return Mock(xfer2=xfer2)


def configure(device: Any) -> Callable[[], None]:
    return lambda: Ads131m0x(device, 6, name="spidev1.0").reset_and_configure(4096, 8, 8.192e6)


FAILING = Mock(xfer2=Mock(side_effect=OSError(errno.EIO, "said")))
CONVERTER_LINES: dict[str, tuple[Callable[[], Any], str]] = {
    "bus": (
        configure(FAILING),
        "the bus fails (said): check load_cell_node's device and spi_clock; restart the computer if"
        " it persists",
    ),
    "register": (  # gains of 8 for four channels
        configure(sends((9, b"\x33\x31"))),
        "register 0x04 reads 0x3331 after 0x3333 was written: check DIN, or lower load_cell_node's"
        " spi_clock",
    ),
    "not reset": (
        configure(sends((3, b"\x05\x3f"))),
        "the converter did not reset (it says 0x053F): check DIN and SCLK, or lower"
        " load_cell_node's spi_clock",
    ),
    "reset": (
        lambda: Ads131m0x(sends((1, b"\x05\x3f")), 6, name="spidev1.0").read(),
        "the converter fell back to its reset state: check its supply and its SYNC/RESET pin",
    ),
    "corrupted": (
        lambda: Ads131m0x(Mock(xfer2=lambda data: [1] * 24), 6, name="spidev1.0").read(),
        "a frame does not match its checksum: check the wiring and the chip select"
        " (docs/faults.md), or lower load_cell_node's spi_clock",
    ),
}


@pytest.mark.parametrize("case", CONVERTER_LINES)
def test_a_converter_s_fault_has_its_words(case: str) -> None:
    call, line = CONVERTER_LINES[case]
    assert line_of(call) == f"spidev1.0: {line}"


def test_a_converter_is_described_by_type_and_place() -> None:
    converter = Ads131m0x(sends(), 6, name="spidev1.0")
    converter.reset_and_configure(4096, 1, 8.192e6)
    assert converter.description == "ADS131M06 on spidev1.0, ID 0x2602"


class Bench:
    """A reader of a simulated converter under a fake clock, at 1 kHz."""

    def __init__(self, clock: FakeClock, settings: LoadCellSettings = CELL, load: Any = 0.0):
        self._clock = clock
        self.faults: dict[str, float] = {}
        wrench = np.zeros(6) + load
        self.chip = simulated_load_cell(lambda moment: wrench, settings, self.faults, seed=1)
        line = (lambda: self.chip) if settings.data_ready_line >= 0 else None
        self.reader = ConverterReader(settings, lambda: self.chip, line)
        self.cell = LoadCell(settings, self.reader)

    def poll(self, duration: float) -> None:
        for _ in range(round(duration / self.reader.period)):
            self._clock.now += self.reader.period
            self.reader.poll()

    def fault(self) -> tuple[int, str]:
        level, fault = self.reader.fault_at(self._clock.now)
        return level, str(fault or "")


def test_the_first_conversion_is_awaited(clock: FakeClock) -> None:
    assert Bench(clock).fault() == (WARN, "spidev0.0: no conversion yet: wait for the first")


def test_corrupted_frames_are_counted_and_left_out(clock: FakeClock) -> None:
    bench = Bench(clock)
    bench.poll(0.3)
    assert bench.fault() == (OK, "")
    bench.faults["load_cell.flipped_bits"] = 1.0
    bench.poll(bench.reader.period)
    assert bench.fault() == (
        WARN,
        "spidev0.0: frames do not match their checksums and are left out: check the wiring and the"
        " chip select (docs/faults.md), or lower load_cell_node's spi_clock",
    )
    assert bench.reader.counts()["checksum_errors"] == 8  # read in a row
    assert bench.reader.counts()["restarts"] == 0


@pytest.mark.parametrize(
    ("clock_in", "silence"), [(8.192e6, 0.1), (0.512e6, 0.32)], ids=["fast", "slow"]
)
def test_a_silent_converter_has_its_time(clock_in: float, silence: float, clock: FakeClock) -> None:
    """100 ms, or five conversions if they take longer: 2 * 16384 / 512 kHz are 64 ms."""
    bench = Bench(clock, replace(CELL, oversampling=16384, clock_in=clock_in, window=0.2))
    bench.poll(0.5)
    assert bench.fault() == (OK, "")
    bench.faults["load_cell.frozen"] = 1.0
    begun = clock.now
    while bench.fault()[0] == OK:
        bench.poll(bench.reader.period)
    assert clock.now - begun == pytest.approx(silence, abs=1.5 * bench.reader.period)


def test_an_unplugged_converter_restarts_until_it_is_back(clock: FakeClock) -> None:
    bench = Bench(clock)
    bench.poll(0.3)
    bench.faults["load_cell.unplugged"] = 1.0
    bench.poll(bench.reader.period)
    assert bench.reader.counts()["restarts"] == 1
    hint = "check MISO, CS and the supply of the converter"
    assert bench.fault() == (ERROR, f"spidev0.0: no answer (every bit reads 0): {hint}")


def test_a_line_that_fails_is_named(clock: FakeClock, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(clock, replace(CELL, data_ready_line=22))
    bench.poll(0.3)
    assert bench.reader.counts()["status_disagrees"] == 0
    broken = Mock(side_effect=OSError(errno.ENODEV, "gone"))
    monkeypatch.setattr(bench.chip, "edges", broken)
    bench.poll(bench.reader.period)
    line = (
        "spidev0.0: the edges of DRDY are gone (gone): check the chip's overlay or adapter; it is"
        " opened again automatically"
    )
    assert bench.fault() == (ERROR, line)


# --- the load cell

SETTINGS_LINES: dict[str, tuple[dict[str, Any], str]] = {
    "singular": (
        {"matrix": (*CELL.matrix[:30], *CELL.matrix[:6])},
        "matrix cannot be inverted: check the maker's 36 numbers, row by row",
    ),
    "a row of zeros": (
        {"matrix": (*CELL.matrix[:30], *[0.0] * 6)},
        "matrix cannot be inverted: check the maker's 36 numbers, row by row",
    ),
    "inputs": (
        {"inputs": (0, 1, 2, 3, 4, 4)},
        "inputs names an input twice: give each bridge an input of its own",
    ),
    "no inputs": ({"inputs": ()}, "inputs is empty: give the input of each of the six bridges"),
    "amplifiers": (
        {"amplifier_gain": (1.0,) * 5},
        "amplifier_gain has 5 numbers: give the gain of each of the six bridges",
    ),
}


@pytest.mark.parametrize("case", SETTINGS_LINES)
def test_a_load_cell_s_wrong_setting_has_a_hint(case: str) -> None:
    change, line = SETTINGS_LINES[case]
    wrong = replace(CELL, **change)
    found = line_of(lambda: check_load_cell(wrong), ConfigurationError)
    assert found == f"load_cell_node: {line}"


@pytest.mark.parametrize(
    ("close", "verdict"),
    [(1e-5, nullcontext()), (1e-7, pytest.raises(ConfigurationError))],
    ids=["far enough", "nearly parallel"],
)
def test_rows_that_nearly_coincide_are_refused(
    close: float, verdict: AbstractContextManager[Any]
) -> None:
    """The condition of rows at a small angle is 2 over it; 1e6 is the limit."""
    matrix = np.eye(6)
    matrix[1] = matrix[0] + close * matrix[1]
    with verdict:
        check_load_cell(replace(CELL, matrix=tuple(matrix.ravel())))


def test_an_input_that_was_not_recorded_is_named() -> None:
    recorded = Bridges(replace(CELL, channels=8, inputs=(7, 1, 3, 2, 6, 4)))
    own = Bridges(replace(CELL, channels=8, inputs=(1, 5, 2, 3, 4, 0)))
    found = line_of(lambda: own.ratios_from(recorded, np.zeros(6)), ConfigurationError)
    assert found == (
        "load_cell_node: inputs names input 0, which was not recorded: give inputs of 1, 2, 3, 4,"
        " 6, 7"
    )


def test_a_wrench_is_told_in_four_digits() -> None:
    found = in_words(np.array([1.23456, -0.5, 0.0, 1234.56, -20.0, 0.0012345]))
    assert found == ("Mx 1.235 N m, My -0.5 N m, Mz 0 N m, Fx 1235 N, Fy -20 N, Fz 0.001234 N")


def test_an_untared_cell_was_tared_never(clock: FakeClock) -> None:
    bench = Bench(clock, load=[0.0, 0.0, 0.0, 0.0, 0.0, 40.0])
    assert bench.cell.figures()["tared"] == "never"
    bench.poll(1.2)
    assert bench.cell.tare(0)[5] == pytest.approx(40.0, abs=0.01)
    # What a second tare takes away is what the first one left.
    assert bench.cell.tare(1_795_000_000_123_456_789) == pytest.approx(np.zeros(6), abs=1e-9)
    assert bench.cell.figures()["tared"] == "2026-11-18T11:06:40.123456+00:00"
    assert "Fz 40 N" in str(bench.cell.figures()["tare"])


def early(bench: Bench, clock: FakeClock) -> None:
    bench.poll(0.45)


def unplugged(bench: Bench, clock: FakeClock) -> None:
    bench.poll(1.2)
    bench.faults["load_cell.unplugged"] = 1.0
    bench.poll(0.01)


def at_rail(bench: Bench, clock: FakeClock) -> None:
    bench.faults["load_cell.rail"] = 1.0 + CELL.inputs[1]
    bench.poll(1.2)


def steady(bench: Bench, clock: FakeClock) -> None:
    bench.poll(1.2)


# What happens before, the load [M; F], and the line
TARES: dict[str, tuple[Callable[[Bench, FakeClock], None], list[float], str]] = {
    "unplugged": (
        unplugged,
        [0.0] * 6,
        "spidev0.0: no answer (every bit reads 0): check MISO, CS and the supply of the converter",
    ),
    "at a rail": (
        at_rail,
        [0.0] * 6,
        f"bridge 2 (input {CELL.inputs[1]}) is at its rail: unload the cell, or check the bridge"
        " and its wiring",
    ),
    # 120 N and 50 N are 130 N
    "loaded": (
        steady,
        [0.0, 0.0, 0.0, 120.0, 0.0, -50.0],
        "the cell bears 130 N, more than 40 N: take the limb out of the socket; if nothing loads"
        " the cell, force it (load_cell/force_tare)",
    ),
}


@pytest.mark.parametrize("case", TARES)
def test_a_refused_tare_says_what_to_do(case: str, clock: FakeClock) -> None:
    before, load, line = TARES[case]
    bench = Bench(clock, load=load)
    before(bench, clock)
    assert line_of(lambda: bench.cell.tare(1)) == f"cannot tare: {line}"


def test_a_tare_needs_half_of_its_conversions(clock: FakeClock) -> None:
    """Half of one second's."""
    bench = Bench(clock)
    bench.poll(0.45)
    found = line_of(lambda: bench.cell.tare(1))
    count = len(bench.reader.between(0.0, clock.now)[0])
    assert 0.4 < count * bench.reader.period < 0.45
    expected = round(1.0 / bench.reader.period)
    assert found == (
        f"cannot tare: {count} of {expected} conversions in the last 1 s: wait that long, or set a"
        " shorter tare_duration"
    )
    bench.poll(0.1)
    bench.cell.tare(1)


def test_a_moving_load_is_not_tared(clock: FakeClock) -> None:
    bench = Bench(clock)
    wrench = np.zeros(6)
    bench.chip = simulated_load_cell(
        lambda moment: wrench + 5.0 * (int(10.0 * moment) % 2) * np.eye(6)[5], CELL, {}, seed=1
    )
    bench.poll(1.2)
    line = line_of(lambda: bench.cell.tare(1))
    assert line.startswith("cannot tare: Fz moves by 2.")
    end = " N (standard deviation), more than 2 N: hold the cell still and tare again"
    assert line.endswith(end)


def test_a_missing_wrench_tells_its_cause(clock: FakeClock) -> None:
    bench = Bench(clock)
    bench.poll(0.3)
    bench.faults["load_cell.unplugged"] = 1.0
    bench.poll(0.05)
    expected = round(CELL.window / bench.reader.period)
    assert bench.cell.wrench_at(clock.now).fault == (
        f"0 of {expected} conversions around the trigger; spidev0.0: no answer (every bit reads 0):"
        " check MISO, CS and the supply of the converter"
    )


def test_a_wrench_is_awaited_until_its_conversions_ended(clock: FakeClock) -> None:
    """A failed converter gives none; a quarter of the window and the filter's delay later."""
    bench = Bench(clock)
    bench.poll(0.3)
    moment = clock.now
    bench.faults["load_cell.unplugged"] = 1.0
    after = 0.25 * CELL.window + ads131m0x.group_delay(CELL.clock_in, CELL.oversampling)
    bench.poll(after - 1.5 * bench.reader.period)
    assert bench.fault()[0] == ERROR and not bench.cell.ready(moment)
    bench.poll(3.0 * bench.reader.period)
    assert bench.cell.ready(moment)


def test_a_warning_does_not_end_the_wait(clock: FakeClock, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(clock)
    bench.poll(0.3)
    warning = WARN, DeviceError("frames are corrupted", "x")
    monkeypatch.setattr(bench.reader, "fault_at", lambda now: warning)
    assert not bench.cell.ready(clock.now - 0.001)
    clock.now += 1.0
    assert not bench.cell.ready(clock.now - 0.5)
