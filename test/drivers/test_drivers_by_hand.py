"""Drivers at the ends of their limits, against times, places and lines written by hand."""

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import gpiod
import numpy as np
import pytest
from support.clocks import FakeClock
from support.wording import refused

from socket_testbed.drivers import ERROR, WARN, gpio
from socket_testbed.drivers.clusters.fdc1004 import Fdc1004
from socket_testbed.drivers.clusters.reader import ClusterReader, ClusterReading
from socket_testbed.drivers.clusters.reader import check_settings as check_clusters
from socket_testbed.drivers.gpio import GpiodLines, GpioTrigger
from socket_testbed.drivers.load_cell.ads131m0x import Ads131m0x
from socket_testbed.drivers.load_cell.converter_reader import ConverterReader
from socket_testbed.drivers.load_cell.load_cell import Bridges, LoadCell, Tare
from socket_testbed.drivers.load_cell.load_cell import check_settings as check_load_cell
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.files import packaged
from socket_testbed.samples import Status
from socket_testbed.settings.acquisition import ClusterSettings, LoadCellSettings, TriggerSettings
from socket_testbed.settings.testbed import read_testbed
from socket_testbed.simulation.devices.ads131m0x import SimulatedAds131m0x, simulated_load_cell
from socket_testbed.simulation.devices.fdc1004 import SimulatedFdc1004
from socket_testbed.simulation.devices.i2c import SimulatedClusterHardware


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeClock:
    return FakeClock(1000.0).install(monkeypatch)


# --- the trigger


class SlowLines:
    """Lines of a machine so busy that the edge is read long after the kernel has stamped it."""

    def __init__(self, clock: FakeClock, edge: float) -> None:
        self._clock, self._edge = clock, edge  # [s] after the pulse
        self._pulse = 0.0
        self._waiting: list[float] = []

    def set(self, line: int, active: bool) -> None:
        self._pulse = self._clock.now
        self._waiting = [self._pulse + self._edge] * active

    def edges(self, within: float) -> list[float]:
        if within > 0.0:
            self._clock.sleep(0.5)
            return []
        found, self._waiting = self._waiting, []
        return found

    def close(self) -> None:
        """Do nothing."""


def fired(clock: FakeClock, edge: float) -> float:
    """Time of a trigger after its pulse, whose edge comes so long [s] after it."""
    lines = SlowLines(clock, edge)
    return GpioTrigger(lines, TriggerSettings(edge_within=0.001)).fire() - 1000.0


def test_an_edge_in_time_may_be_read_late(clock: FakeClock) -> None:
    assert fired(clock, 0.0009) == pytest.approx(0.0009, abs=1e-9)


@pytest.mark.parametrize("edge", [0.0011, -0.0001], ids=["too late", "before the pulse"])
def test_an_edge_out_of_time_is_none(edge: float, clock: FakeClock) -> None:
    with refused(DeviceError, "no edge on line 27 within 1 ms of the pulse on line 17"):
        fired(clock, edge)


def test_a_refused_chip_names_its_group(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its file is not there: the group is the distribution's."""
    monkeypatch.setattr(gpio, "_chip", lambda *given: "/dev/gpiochip4x")
    monkeypatch.setattr(gpiod, "request_lines", Mock(side_effect=PermissionError))
    with pytest.raises(DeviceError) as found:
        GpiodLines("a chip", {17: "output"}, "trigger_node", "chip", "source to timer")
    hint = "add the user to the group gpio (sudo usermod -aG gpio $USER), then log in again"
    assert str(found.value) == f"/dev/gpiochip4x: permission denied: {hint}"


# --- the clusters


def one_cluster(begun: float, clock: FakeClock) -> ClusterReading:
    """A reading that began so long [s] after its trigger, at the default `latest` of 50 ms.

    Each conversion takes 2.5 ms, so that the four inputs are read within 10 ms.
    """
    settings = ClusterSettings(
        names=("a",), buses=(1,), channels=(0,), multiplexers=(0,), latest=0.05, sample_rate=400
    )
    hardware = SimulatedClusterHardware(settings, SimulatedFdc1004, lambda *_: 5.0, {})
    reader = ClusterReader(settings, Fdc1004, hardware.open_bus)
    reader.read(clock.now)
    clock.now += 1.0
    trigger = clock.now
    clock.now += begun
    return reader.read(trigger)


def test_a_reading_within_its_time_counts(clock: FakeClock) -> None:
    found = one_cluster(0.030, clock)
    assert (found.status == Status.OK).all() and not found.faults


def test_the_last_input_must_be_in_time(clock: FakeClock) -> None:
    """Its first input is read before 50 ms, its last one after them."""
    found = one_cluster(0.045, clock)
    assert (found.status == Status.MISSING).all() and np.isnan(found.capacitance).all()
    hint = "lower the trigger's rate, or relieve the computer"
    assert found.faults == {"a": (f"read more than 0.05 s after the trigger: {hint}",)}


def inputs_seen(faults: dict[str, float], number: int) -> list[float]:
    """Capacitances at the inputs of the n-th chip after the host was restarted, truly 0 to 3 pF."""
    chip = SimulatedFdc1004(lambda n, moment: float(n), faults, number)
    chip.host_restarted()
    return [chip.input(n, 0.0) for n in range(4)]


@pytest.mark.parametrize(
    ("fault", "seen"),
    [
        ({}, [0.0, 1.0, 2.0, 3.0]),
        ({"clusters.shifted": 2.0}, [1.0, 2.0, 3.0, 0.0]),
        ({"clusters.shifted": 1.0}, [0.0, 1.0, 2.0, 3.0]),
        ({"clusters.rail": 2.0}, [1000.0] * 4),
        ({"clusters.rail": 3.0}, [0.0, 1.0, 2.0, 3.0]),
    ],
    ids=["none", "shifted", "another shifted", "rail", "another at its rail"],
)
def test_a_fault_moves_its_chip_s_inputs(fault: dict[str, float], seen: list[float]) -> None:
    assert inputs_seen(fault, 2) == seen


@pytest.mark.parametrize(
    ("fault", "resets"), [(2.0, [True, False, True]), (1.0, [False] * 3)], ids=["own", "another's"]
)
def test_a_chip_browns_out_every_300_ms(fault: float, resets: list[bool], clock: FakeClock) -> None:
    """At 0 s, not 0.2 s later, and again 0.35 s after the first time."""
    chip = SimulatedFdc1004(lambda n, moment: 1.0, {"clusters.brown_out": fault}, 2)
    found = []
    for moment in (1000.0, 1000.2, 1000.35):
        clock.now = moment
        chip.write(bytes([0x08, 0x12, 0x34]))
        assert chip.parts_at(0x50) == [chip]
        chip.write(bytes([0x08]))
        found.append(chip.read(2) != bytes([0x12, 0x34]))
    assert found == resets


def test_a_chip_without_settings_is_read_last(clock: FakeClock) -> None:
    """The first cluster was reset meanwhile: the second one, on channel 1, does not wait for it."""
    settings = ClusterSettings(
        names=("a", "b"), buses=(1, 1), channels=(0, 1), multiplexers=(0x70, 0x70)
    )
    faults: dict[str, float] = {}
    hardware = SimulatedClusterHardware(settings, SimulatedFdc1004, lambda *_: 5.0, faults)
    reader = ClusterReader(settings, Fdc1004, hardware.open_bus)
    reader.read(clock.now)
    faults["clusters.nack"] = 1.0
    reader.read(clock.now)
    faults.clear()
    clock.now += 1.0
    multiplexer = hardware.multiplexers[1, 0x70]
    opened: list[int] = []
    keep = multiplexer.write
    multiplexer.write = lambda data: (opened.append(data[-1]), keep(data))  # type: ignore[assignment]
    assert (reader.read(clock.now).status == Status.OK).all()
    assert opened[0] == 0b10 and 0b01 in opened


CLUSTER_LINES: dict[str, tuple[dict[str, Any], str]] = {
    "one bus too few": (
        {"buses": (1, 1, 1)},
        "4 names, 3 buses, 4 channels and 4 multiplexers of clusters:"
        " give one of each per cluster; multiplexers may be empty if all share one address",
    ),
    "rate": ({"sample_rate": 300}, "sample_rate is 300: the FDC1004 supports 100, 200, 400"),
    "latest": (  # 1.25 * 4 / 400
        {"sample_rate": 400, "latest": 0.012},
        "latest is 0.012 s, shorter than a cycle of 4 conversions:"
        " set it to 0.0125 s or more, or raise sample_rate",
    ),
    "multiplexer": (
        {"multiplexers": (0x6F,) * 4},
        "multiplexer is 0x6F: give 0x70 to 0x77, or 0 for none",
    ),
    "place": (
        {"channels": (0, 1, 2, 1)},
        "the clusters 'mid_anterior' and 'distal' share a name or bus 1, channel 1 of 0x70:"
        " give each cluster its own name and place",
    ),
}


@pytest.mark.parametrize("case", CLUSTER_LINES)
def test_wrong_clusters_are_refused_in_a_line(case: str) -> None:
    change, line = CLUSTER_LINES[case]
    with pytest.raises(ConfigurationError) as found:
        check_clusters(replace(ClusterSettings(), **change), Fdc1004)
    assert str(found.value) == line


# --- the load cell

CELL = read_testbed(packaged("config", "simulated.yaml")).load_cell_node

OTHERS: dict[str, dict[str, Any]] = {
    "inputs": {"inputs": CELL.inputs[::-1]},
    "gain": {"gain": 2 * CELL.gain},
    "sign": {"sign": tuple(-sign for sign in CELL.sign)},
    "excitation": {"excitation": 0.5 * CELL.excitation},
    "amplifier": {"amplifier_gain": tuple(2.0 * gain for gain in CELL.amplifier_gain)},
}


def tare_of(settings: LoadCellSettings, path: Path) -> Tare:
    return Tare(str(path), Bridges(settings).description)


@pytest.mark.parametrize("name", OTHERS)
def test_a_tare_is_of_its_own_bridges(name: str, tmp_path: Path) -> None:
    tare_of(CELL, tmp_path / "tare.json").set(np.arange(6.0), 5_000)
    line = "tare.json: was taken with other inputs, signs, gains or excitation: remove the file"
    with refused(ConfigurationError, line):
        tare_of(replace(CELL, **OTHERS[name]), tmp_path / "tare.json")


def test_a_tare_serves_another_matrix(tmp_path: Path) -> None:
    """It is stored in mV/V, on which neither the matrix nor the window has an effect."""
    tare_of(CELL, tmp_path / "tare.json").set(np.arange(6.0), 5_000)
    matrix = tuple(2.0 * number for number in CELL.matrix)
    again = tare_of(replace(CELL, matrix=matrix, window=2.0 * CELL.window), tmp_path / "tare.json")
    ratios, time = again.no_load
    assert ratios.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0] and time == 5_000


class Wire:
    """A bus of a converter that garbles frames while its chip has the fault `garbled`.

    All but every n-th one, if its value is n; 0: all.
    """

    def __init__(self, chip: SimulatedAds131m0x, faults: dict[str, float]) -> None:
        self._chip, self._faults = chip, faults
        self._frames = 0

    def xfer2(self, data: list[int], /) -> list[int]:
        answer = self._chip.xfer2(data)
        self._frames += 1
        if "garbled" in self._faults:
            every = int(self._faults["garbled"])
            answer[-2] ^= not every or self._frames % every > 0  # of the checksum
        return answer

    def close(self) -> None:
        """Do nothing."""


def polled(clock: FakeClock, faults: dict[str, float], wired: bool | None) -> tuple[int, str]:
    """Level and line of the first error of a converter that worked for 0.3 s.

    Args:
        clock: The steady clock.
        faults: Faults of the simulated chip after 0.3 s.
        wired: Whether DRDY still has its wire then; None if it never had one.
    """
    settings = CELL if wired is None else replace(CELL, data_ready_line=22)
    active: dict[str, float] = {}
    chip = simulated_load_cell(lambda moment: np.zeros(6), settings, active, seed=1)
    open_line = None if wired is None else (lambda: chip)
    reader = ConverterReader(settings, lambda: Wire(chip, active), open_line)
    for _ in range(int(0.3 / reader.period)):
        clock.now += reader.period
        reader.poll()
    assert reader.fault_at(clock.now) == (0, None)
    active |= faults
    chip.is_wired = wired is not False
    for _ in range(1000):
        clock.now += reader.period
        reader.poll()
        level, error = reader.fault_at(clock.now)
        if level == ERROR:
            break
    return level, str(error)


UNMATCHED = (
    "matches its checksum: check the wiring and the chip select (docs/faults.md), or lower"
    " load_cell_node's spi_clock"
)
CONVERTER_LINES: dict[str, tuple[dict[str, float], bool | None, str]] = {
    "no edge": (
        {},
        False,
        "spidev0.0: converts, but no edge comes on line 22: check the wire from DRDY, or set"
        " load_cell_node's data_ready_line to -1",
    ),
    "frozen": (
        {"load_cell.frozen": 1.0},
        None,
        "spidev0.0: no longer converts: check the converter's clock and its supply",
    ),
    "frozen with DRDY": (
        {"load_cell.frozen": 1.0},
        True,
        "spidev0.0: no longer converts: check the converter's clock and its supply",
    ),
    "corrupted": ({"garbled": 0.0}, None, f"spidev0.0: no frame {UNMATCHED}"),
    "corrupted with DRDY": ({"garbled": 0.0}, True, f"spidev0.0: no frame {UNMATCHED}"),
    "nearly all corrupted": ({"garbled": 50.0}, None, f"spidev0.0: hardly any frame {UNMATCHED}"),
    # The few intact ones are dropped while the reader empties the converter.
    "nearly all corrupted with DRDY": ({"garbled": 41.0}, True, f"spidev0.0: no frame {UNMATCHED}"),
    "frozen and now and then corrupted": (
        {"load_cell.frozen": 1.0, "load_cell.flipped_bits": 0.1},
        None,
        "spidev0.0: no longer converts: check the converter's clock and its supply",
    ),
    "unplugged": (
        {"load_cell.unplugged": 1.0},
        None,
        "spidev0.0: no answer (every bit reads 0): check MISO, CS and the supply of the converter",
    ),
}


# A frame of the start that is changed: its number, the byte with a wrong bit (None: another
# converter's ID), and the line.
STARTS: dict[str, tuple[int, int | None, str]] = {
    "reset": (2, 1, f"a frame does not match {UNMATCHED[8:]}"),
    "ID": (3, 0, f"a frame does not match {UNMATCHED[8:]}"),
    "ID of another": (
        3,
        None,
        "the converter says ID 0x2802, not 0x26xx: check load_cell_node's channels, and that its"
        " device is this converter",
    ),
}


@pytest.mark.parametrize("case", STARTS)
def test_a_garbled_start_is_no_other_converter(case: str) -> None:
    number, byte, line = STARTS[case]
    chip = SimulatedAds131m0x(lambda moment: np.zeros(6), seed=1)
    sent: list[list[int]] = []

    def xfer2(data: list[int], /) -> list[int]:
        answer = chip.xfer2(data)
        if len(sent) == number and byte is None:
            answer[0] = 0x28
        elif len(sent) == number:
            answer[byte] ^= 0x40
        sent.append(data)
        return answer

    with pytest.raises(DeviceError) as found:
        Ads131m0x(Mock(xfer2=xfer2), 6).reset_and_configure(4096, 1, 8.192e6)
    assert str(found.value) == f"spidev0.0: {line}"


def test_a_deaf_converter_did_not_reset() -> None:
    """Its DIN is off: it answers each command with its STATUS, in frames that are intact."""
    chip = SimulatedAds131m0x(lambda moment: np.zeros(6), seed=1)
    deaf = Mock(xfer2=lambda data: chip.xfer2([0] * len(data)))
    with pytest.raises(DeviceError) as found:
        Ads131m0x(deaf, 6).reset_and_configure(4096, 1, 8.192e6)
    line = "the converter did not reset (it says 0x053F): check DIN and SCLK, or lower"
    assert str(found.value) == f"spidev0.0: {line} load_cell_node's spi_clock"


@pytest.mark.parametrize("case", CONVERTER_LINES)
def test_a_silent_converter_says_why(case: str, clock: FakeClock) -> None:
    faults, wired, line = CONVERTER_LINES[case]
    assert polled(clock, faults, wired) == (ERROR, line)


def test_a_reader_that_comes_too_late_says_so(clock: FakeClock) -> None:
    """Three periods after the last time: the conversions in between cannot be dated."""
    chip = simulated_load_cell(lambda moment: np.zeros(6), CELL, {}, seed=1)
    reader = ConverterReader(CELL, lambda: chip)
    for _ in range(int(0.4 / reader.period)):
        clock.now += 3.0 * reader.period
        reader.poll()
    level, error = reader.fault_at(clock.now)
    assert (level, str(error)) == (
        ERROR,
        "spidev0.0: conversions are read too late to date them: relieve the computer, or raise"
        " load_cell_node's oversampling",
    )


def test_a_recovered_converter_warns_for_a_moment(clock: FakeClock) -> None:
    faults: dict[str, float] = {}
    chip = simulated_load_cell(lambda moment: np.zeros(6), CELL, faults, seed=1)
    reader = ConverterReader(CELL, lambda: chip)

    def poll(duration: float) -> None:
        for _ in range(int(duration / reader.period)):
            clock.now += reader.period
            reader.poll()

    poll(0.3)
    faults["load_cell.unplugged"] = 1.0
    poll(2.0 * reader.period)
    faults.clear()
    poll(0.3)
    level, error = reader.fault_at(clock.now)
    line = "spidev0.0: no answer (every bit reads 0), but has recovered: check MISO, CS and the"
    assert (level, str(error)) == (WARN, f"{line} supply of the converter")
    poll(0.8)
    assert reader.fault_at(clock.now) == (0, None)


def test_a_clipped_bridge_is_no_overload(clock: FakeClock) -> None:
    """Its few conversions at the rail are no load, of 100 % of an axis or more."""
    faults: dict[str, float] = {}
    chip = simulated_load_cell(lambda moment: np.zeros(6), CELL, faults, seed=1)
    cell = LoadCell(CELL, ConverterReader(CELL, lambda: chip))
    bridge = CELL.inputs[2]
    for number in range(int(0.3 / cell.converter.period)):
        faults["load_cell.rail"] = 1.0 + bridge if number in (50, 51) else 0.0
        clock.now += cell.converter.period
        cell.converter.poll()
    line = f"bridge 3 (input {bridge}) is at its rail at times"
    assert cell.health(clock.now) == (WARN, f"{line}: unload the cell, or lower the gain")


CELL_LINES: dict[str, tuple[dict[str, Any], str]] = {
    "channels": ({"channels": 7}, "channels is 7: give 6 (ADS131M06) or 8 (ADS131M08)"),
    "gain": ({"gain": 3}, "gain is 3: give a power of two"),
    "oversampling": ({"oversampling": 1000}, "oversampling is 1000: give a power of two"),
    "inputs": (
        {"inputs": (0, 1, 2, 3, 4, 6), "channels": 6},
        "inputs names input 6 of a converter of 6: give inputs from 0 to 5",
    ),
    "sign": (
        {"sign": (1.0, 1.0, 1.0, 1.0, 1.0, 0.5)},
        "sign holds a value other than 1 and -1:"
        " give the sign, 1 or -1, of each of the six bridges",
    ),
    "matrix": ({"matrix": ()}, "matrix is empty: give the maker's 36 numbers, row by row"),
    "full scale": (
        {"full_scale": (1.0, 2.0)},
        "full_scale has 2 numbers: give the maker's full scale of each axis, 6 numbers",
    ),
    "device": ({"device": "0"}, "device is '0': give bus and chip select as N.M, such as 0.0"),
    "window": (  # 2 * 16384 / 8.192 MHz
        {"window": 0.003, "oversampling": 16384, "clock_in": 8.192e6},
        "window is 0.003 s, shorter than a conversion (0.004 s):"
        " give a longer window or less oversampling",
    ),
}


@pytest.mark.parametrize("case", CELL_LINES)
def test_a_wrong_load_cell_gets_a_line(case: str) -> None:
    change, line = CELL_LINES[case]
    with pytest.raises(ConfigurationError) as found:
        check_load_cell(replace(CELL, **change))
    assert str(found.value) == f"load_cell_node: {line}"
