"""The load cell on its simulated converter: no stale and no corrupted wrench, ever.

With DRDY on a GPIO line (`line`) each edge is a conversion's time; without, times are inferred.
"""

import dataclasses
import errno
import fcntl
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from support.clocks import FakeClock
from support.wording import check_line, refused

from socket_testbed import clocks
from socket_testbed.drivers import DeviceBusyError
from socket_testbed.drivers.load_cell import ads131m0x, converter_reader
from socket_testbed.drivers.load_cell.converter_reader import ConversionClock, ConverterReader
from socket_testbed.drivers.load_cell.load_cell import (
    LoadCell,
    check_settings,
    in_words,
    pressed,
    unrest,
)
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.samples import Status
from socket_testbed.settings.acquisition import LoadCellSettings, averaging_span
from socket_testbed.simulation.devices.ads131m0x import SimulatedAds131m0x, simulated_load_cell
from socket_testbed.simulation.devices.failed_transfer import FailedTransfer

_CROSS_TALK = 0.1 * np.random.default_rng(7).standard_normal((6, 6))
MATRIX = np.diag([900.0, 950.0, 1800.0, 40.0, 42.0, 60.0]) @ (np.eye(6) + _CROSS_TALK)
SETTINGS = LoadCellSettings(
    matrix=tuple(MATRIX.ravel()),
    full_scale=(1500.0, 1500.0, 2500.0, 80.0, 80.0, 60.0),
    inputs=(3, 0, 5, 1, 4, 2),
    sign=(1.0, -1.0, 1.0, 1.0, -1.0, 1.0),
    oversampling=4096,
)
AMPLITUDE = np.array([8.0, 6.0, 4.0, 120.0, 90.0, 400.0])
FREQUENCY = np.array([1.1, 0.7, 1.7, 1.3, 0.9, 1.9])  # [Hz]
SPEED = 2 * np.pi * FREQUENCY * AMPLITUDE
QUANTUM = 2e-3 * AMPLITUDE  # of the codes, and of what curves within a window
BEGIN, STAMP = 50.0, 1_795_000_000_000_001_000  # [s], and [ns] since the epoch
FAULTS = ("unplugged", "flipped_bits", "rail", "brown_out", "frozen")


def moving(moment):
    """A wrench [M; F] that is another one at any other time."""
    phase = np.pi * np.arange(6) / 5
    return AMPLITUDE * np.sin(2 * np.pi * FREQUENCY * np.asarray(moment)[..., None] + phase)


def still(values):
    wrench = np.array(values, dtype=float)
    return lambda moment: np.broadcast_to(wrench, (*np.shape(moment), 6))


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeClock:
    return FakeClock(BEGIN).install(monkeypatch)


class Bench:
    """A load cell under a fake clock, and everything that it measured checked against the truth."""

    def __init__(self, settings=SETTINGS, wrench=moving, seed=0, late=0.05, span=0.0, line=False):
        self.clock: Any = clocks.monotonic
        self.clock.now = BEGIN
        self.span = span  # [s]; to be averaged around a trigger
        self.wrench = wrench
        self.faults: dict[str, float] = {}
        self.rng = np.random.default_rng(seed)
        self.late = late  # [s]; patience of the caller
        self.tared = np.zeros(6)
        self.chip = simulated_load_cell(wrench, settings, self.faults, seed=seed)
        self.line = line
        open_line = (lambda: self.chip) if line else None
        self.converter = ConverterReader(settings, lambda: self.chip, open_line)
        self.cell = LoadCell(settings, self.converter)
        self.readings: list[tuple[float, object]] = []
        self._asked: list[float] = []
        self._next = BEGIN

    @property
    def now(self) -> float:
        return self.clock.now

    def fault(self, name: str, value: float) -> None:
        self.faults[f"load_cell.{name}"] = value

    def run(self, duration: float, pause: float = 0.0) -> None:
        """Poll for a while, now and then late; ask for a wrench every 13 ms."""
        end = self.now + duration
        while self.now < end:
            self.clock.now += self.converter.period * self.rng.uniform(0.4, 1.6)
            if self.rng.random() < pause:
                self.clock.now += self.rng.uniform(2.0, 9.0) * self.converter.period
            self.converter.poll()
            if self.now >= self._next:
                self._asked.append(self.now)
                self._next = self.now + 0.013
            while self._asked and (
                self.cell.ready(self._asked[0], self.span)
                or self.now > self._asked[0] + self.late + 0.5 * self.span
            ):
                moment = self._asked.pop(0)
                self.check(moment, self.cell.wrench_at(moment, self.span))

    def check(self, moment: float, reading) -> None:
        self.readings.append((moment, reading))
        missing = np.isnan(reading.wrench)
        assert missing.all() or not missing.any()
        raw = np.roll(MATRIX, 3, axis=0) @ reading.ratios - reading.tare
        np.testing.assert_allclose(raw, reading.wrench, rtol=1e-12, atol=1e-11)
        if missing.all():
            assert reading.fault and reading.status in (Status.SATURATED, Status.MISSING)
            return
        assert reading.status == Status.OK
        # The line through the window at the trigger; a mean over a longer span, of which
        # conversions may be missing, is between this and the complete mean.
        around = self.cell.settings.window * np.linspace(-0.75, 0.25, 101)
        truth = [np.polyfit(around, self.wrench(moment + around), 1)[1] - self.tared]
        if self.span > 0.02:
            around = self.span * np.linspace(-0.5, 0.5, 101)
            truth.append(self.wrench(moment + around).mean(axis=0) - self.tared)
        right = np.clip(reading.wrench, np.min(truth, axis=0), np.max(truth, axis=0))
        # Conversions are known to a fraction of a period, in which the wrench moves by so much.
        slack = (0.15 if self.line else 0.5) * self.converter.period * SPEED + QUANTUM
        np.testing.assert_array_less(np.abs(reading.wrench - right), slack)

    def worst(self) -> float:
        """The largest error of a settled wrench over its amplitude [-]."""
        after = [(t, r.wrench) for t, r in self.readings if t > BEGIN + 0.1]
        return float(np.max([np.abs(found - self.wrench(t)) / AMPLITUDE for t, found in after]))

    def health(self) -> tuple[int, str]:
        return self.cell.health(self.now)

    def valid(self, start: float = -np.inf, end: float = np.inf) -> list[bool]:
        return [not np.isnan(r.wrench).any() for t, r in self.readings if start <= t <= end]


def test_a_wrench_is_that_of_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """And no more conversions are kept than those of the last moments."""
    monkeypatch.setattr(converter_reader, "_HISTORY", 0.2)
    bench = Bench()
    bench.run(1.0)
    assert all(bench.valid(start=BEGIN + 0.05)) and bench.worst() < 4e-3
    assert bench.health() == (0, "spidev0.0 converts")
    assert 200 <= len(bench.converter.between(0.0, bench.now)[0]) < 400


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param(
            {"channels": 8, "inputs": (7, 6, 0, 1, 2, 3), "crc": "ansi"}, id="8-channels-ansi"
        ),
        pytest.param({"oversampling": 16384, "window": 0.05}, id="slow"),
        pytest.param({"gain": 2, "excitation": 3.3, "clock_in": 4.096e6}, id="gain-and-clock"),
    ],
)
def test_other_settings_give_the_wrench_of_its_time(changes: dict[str, Any]) -> None:
    bench = Bench(dataclasses.replace(SETTINGS, **changes), late=0.2)
    bench.run(0.5)
    assert all(bench.valid(start=BEGIN + 0.2))
    assert len(bench.valid(start=BEGIN + 0.2)) >= 5


@pytest.mark.parametrize(
    ("span", "fewest"),
    [pytest.param(0.01, 19, id="10-ms"), pytest.param(0.25, 249, id="250-ms")],
)
def test_a_wrench_is_the_mean_over_a_span(span: float, fewest: int) -> None:
    bench = Bench(span=span)
    bench.run(1.2)
    assert all(bench.valid(start=BEGIN + 0.2))
    counts = {r.conversions for t, r in bench.readings if t > BEGIN + 0.2}
    assert counts <= {fewest, fewest + 1, fewest + 2}
    moment = bench.now - 0.3
    mean = moving(moment + np.linspace(-0.5 * span, 0.5 * span, 1001)).mean(axis=0)
    off = np.abs(bench.cell.wrench_at(moment, span).wrench - mean)
    assert (off < 0.5 * bench.converter.period * SPEED + QUANTUM).all()


@pytest.mark.parametrize(
    ("period", "span"),
    [
        pytest.param(0.0, 0.0, id="no-rate"),
        pytest.param(0.01, 0.01, id="100-Hz"),
        pytest.param(1.0, 0.25, id="1-Hz"),
    ],
)
def test_the_span_follows_the_period_to_a_limit(period: float, span: float) -> None:
    assert averaging_span(-1.0, period) == span


@pytest.mark.parametrize(
    ("lost", "fewest", "most"),
    [
        pytest.param(0.015, 225, 245, id="some"),  # leave the mean
        pytest.param(0.05, 19, 21, id="many"),  # leave the window alone
    ],
)
def test_a_mean_without_lost_conversions_does_not_lag(lost: float, fewest: int, most: int) -> None:
    speed = np.array([10.0, -8.0, 6.0, 200.0, -100.0, 900.0])  # [N m/s, N/s]
    bench = Bench(wrench=lambda t: (np.asarray(t)[..., None] - BEGIN) * speed, span=0.25)
    bench.run(0.5)
    moment = bench.now
    bench.run(0.06)
    bench.clock.now += lost  # two conversions wait, the others are lost
    bench.run(0.2)
    reading = bench.cell.wrench_at(moment, 0.25)
    assert fewest <= reading.conversions <= most
    off = np.abs(reading.wrench - (moment - BEGIN) * speed)
    assert (off < 1e-3 * np.abs(speed) + 1e-2).all()


@pytest.mark.parametrize(
    ("seed", "name"),
    [
        *(pytest.param(seed, name, id=name) for seed, name in enumerate(FAULTS)),
        pytest.param(5, "", id="any-order"),
        pytest.param(6, "", id="any-order-again"),
    ],
)
@pytest.mark.parametrize("line", [False, True], ids=["inferred", "drdy"])
def test_no_fault_makes_a_wrong_wrench(line: bool, seed: int, name: str) -> None:
    """And each is overcome."""
    bench = Bench(seed=seed, line=line)
    rng = np.random.default_rng(100 + seed)
    bench.run(0.2)
    for _ in range(1 if name else 20):
        fault = name or str(rng.choice(list(FAULTS)))
        high = {"flipped_bits": 0.4, "brown_out": 0.2, "rail": 6.0}.get(fault, 1.0)
        value = np.ceil(high * rng.random()) if fault == "rail" else high
        bench.fault(fault, float(value) if name or rng.random() < 0.5 else 0.0)
        bench.run(0.25 if name else float(rng.uniform(0.005, 0.2)), pause=0.02)
    assert all(bench.valid(BEGIN + 0.1, BEGIN + 0.18))
    if name in {"unplugged", "frozen", "rail"}:
        assert not any(bench.valid(bench.now - 0.15, bench.now - 0.02))
        # Nobody waits for a wrench that does not come.
        assert bench.cell.ready(bench.now - 0.1) and not bench.cell.ready(bench.now + 0.1)
    bench.faults.clear()
    off = bench.now
    bench.run(1.4)
    assert all(bench.valid(start=off + 0.5)) and bench.health()[0] == 0


ERRNOS = {
    "EIO": "the bus fails (",
    "ETIMEDOUT": "the SPI controller hangs (",
    "EAGAIN": "the bus fails (",
    "EPROTO": "the bus fails (",
    "EREMOTEIO": "the bus fails (",
    "ESHUTDOWN": "the bus is gone (",
    "ENODEV": "the bus is gone (",
    "ENXIO": "the bus is gone (",
}


@pytest.mark.parametrize("executed", [False, True], ids=["unsent", "executed"])
@pytest.mark.parametrize("line", [False, True], ids=["inferred", "drdy"])
@pytest.mark.parametrize("name", ERRNOS)
def test_a_single_failed_frame_costs_no_wrench(name: str, line: bool, executed: bool) -> None:
    """The wrench takes half of the conversions around it at least."""
    bench = Bench(line=line)
    bench.run(0.2)
    begin = bench.now
    for _ in range(4):
        bench.chip.failing.append(FailedTransfer(getattr(errno, name), 3, executed))
        bench.run(0.1)
        assert not bench.chip.failing
    assert all(bench.valid(begin, bench.now - 0.05)) and bench.health()[0] == 0
    assert bench.cell.figures()["failed_transfers"] == 4
    assert bench.cell.figures()["restarts"] == 0


@pytest.mark.parametrize("name", ERRNOS)
def test_a_device_is_heard_within_a_second(name: str) -> None:
    bench = Bench()
    bench.run(0.2)
    bench.chip.failing += [FailedTransfer(getattr(errno, name)) for _ in range(9)]
    bench.run(0.02)
    level, text = bench.health()
    assert level == 2
    check_line(text, f"spidev0.0: {ERRNOS[name]}")
    while bench.chip.failing:
        bench.run(0.02)
    back = bench.now
    bench.run(1.2)
    assert all(bench.valid(start=back + 0.9)) and bench.health()[0] == 0


def test_a_transfer_that_does_not_end_is_named() -> None:
    """The computer is not to blame while the controller hangs."""
    bench = Bench()
    bench.run(0.2)
    said: list[tuple[int, str]] = []

    class Hanging(FailedTransfer):
        def error(self) -> OSError:
            said.append(bench.health())
            return super().error()

    bench.chip.failing.append(Hanging(errno.ETIMEDOUT, takes=0.3))
    bench.run(0.02)
    ((level, text),) = said
    assert level == 2
    check_line(text, "spidev0.0: a transfer does not end: see dmesg for the SPI controller")


def test_each_conversion_has_the_time_of_its_edge() -> None:
    bench = Bench(dataclasses.replace(SETTINGS, data_ready_line=22), line=True)
    bench.run(1.0)
    assert bench.worst() < 3e-3
    assert bench.health()[0] == bench.cell.figures()["status_disagrees"] == 0
    bench.run(1.0, pause=0.05)  # what a late reader lost is missing
    bench.chip.is_wired = False
    bench.run(0.5)
    level, text = bench.health()
    assert level == 2
    check_line(text, "converts, but no edge comes on line 22: check the wire", "data_ready_line")
    bench.chip.is_wired = True
    bench.run(0.9)
    assert bench.health()[0] == 0


@pytest.mark.parametrize(
    ("axis", "load", "level", "text"),
    [
        pytest.param(
            *(5, 2600.0, 2, "Fz is above 100 % of its full scale of 2500 N: unload the cell"),
            id="force-over-100-percent",
        ),
        pytest.param(
            *(2, -50.0, 1, "Mz is above 80 % of its full scale of 60 N m: do not load it further"),
            id="moment-over-80-percent",
        ),
        pytest.param(2, -47.0, 0, "spidev0.0 converts", id="moment-under-80-percent"),
    ],
)
def test_a_load_near_full_scale_is_reported(axis: int, load: float, level: int, text: str) -> None:
    wrench = load * np.eye(6)[axis]
    bench = Bench(wrench=still(wrench))
    bench.run(0.2)
    _, reading = bench.readings[-1]
    np.testing.assert_allclose(reading.wrench, wrench, atol=1e-2)
    assert bench.health() == (level, text)
    assert reading.fault == (text if level == 2 else "")


def test_a_bridge_at_its_rail_is_named() -> None:
    bench = Bench(wrench=still(np.zeros(6)))
    bench.run(0.2)
    bench.fault("rail", 6.0)  # 1 + input 5, where the third bridge is
    bench.run(0.1)
    level, text = bench.health()
    assert level == 2
    check_line(text, "bridge 3 (input 5) is at its rail for 5 conversions or more: a broken wire?")
    _, reading = bench.readings[-1]
    assert reading.fault == "bridge 3 (input 5) is at its rail: unload the cell, or lower the gain"
    assert reading.status == Status.SATURATED and np.isnan(reading.ratios).all()


LOAD = np.array([1.5, -2.5, 0.5, 10.0, -20.0, 300.0])


@pytest.fixture
def storing(tmp_path: Path) -> LoadCellSettings:
    """Settings with a file for the tare; what else may stand in it: test_documents.py."""
    return dataclasses.replace(SETTINGS, tare_file=str(tmp_path / "tare.json"))


def loaded_bench(settings: LoadCellSettings) -> Bench:
    bench = Bench(settings, wrench=still(LOAD))
    bench.run(1.2)
    return bench


def test_a_tare_takes_the_load_away(storing: LoadCellSettings) -> None:
    bench = loaded_bench(storing)
    text = in_words(bench.cell.tare(STAMP, forced=True))
    assert text == "Mx 1.5 N m, My -2.5 N m, Mz 0.5 N m, Fx 10 N, Fy -20 N, Fz 300 N"
    reading = bench.cell.wrench_at(bench.now - 0.1)
    np.testing.assert_allclose(reading.wrench, 0.0, atol=1e-2)
    np.testing.assert_allclose(reading.tare, LOAD, atol=1e-2)
    assert reading.tared == STAMP  # whatever the system clock says


def test_a_tare_outlives_a_restart(storing: LoadCellSettings) -> None:
    bench = loaded_bench(storing)
    bench.cell.tare(STAMP, forced=True)
    reading = bench.cell.wrench_at(bench.now - 0.1)
    again = Bench(storing, wrench=still(LOAD + 1.0))
    again.tared = LOAD
    again.run(0.2)
    later = again.readings[-1][1]
    np.testing.assert_allclose(later.wrench, 1.0, atol=1e-2)
    np.testing.assert_array_equal(later.tare, reading.tare)
    assert later.tared == reading.tared == STAMP


def test_a_stored_tare_of_other_settings_is_refused(storing: LoadCellSettings) -> None:
    loaded_bench(storing).cell.tare(STAMP, forced=True)
    with refused(ConfigurationError, "tare.json: was taken with other", "tare again"):
        Bench(dataclasses.replace(storing, excitation=2.5))


def test_a_broken_tare_file_is_refused(storing: LoadCellSettings) -> None:
    Path(storing.tare_file).write_text("{")
    with refused(ConfigurationError, "tare.json", "remove the file and tare again"):
        Bench(storing)


@pytest.mark.parametrize(
    ("stresses", "words"),
    [
        ({}, ""),
        ({"distal": 5e3}, ""),
        ({"distal": np.nan}, ""),
        ({"distal": 5.01e3}, "distal (5.01 kPa) is pressed by more than 5 kPa"),
        ({"a": 12e3, "b": -2e4, "c": 7e3}, "a (12 kPa), c (7 kPa) are pressed by more than 5 kPa"),
    ],
    ids=["none", "at limit", "missing", "one", "two"],
)
def test_pressed_clusters_are_named(stresses: dict[str, float], words: str) -> None:
    given = {name: (np.array([normal, 0.0, 0.0]), 0) for name, normal in stresses.items()}
    assert pressed(given, SETTINGS) == words


def test_a_missing_cluster_is_not_pressed() -> None:
    assert pressed({"distal": (np.array([1e5, 0.0, 0.0]), Status.MISSING)}, SETTINGS) == ""


def test_a_loaded_cell_is_tared_by_force_only() -> None:
    bench = loaded_bench(SETTINGS)
    with refused(DeviceError, "the cell bears 301 N, more than 40 N", "force_tare"):
        bench.cell.tare(STAMP)
    assert bench.cell.tare(STAMP, forced=True) is not None


@pytest.mark.parametrize(
    ("duration", "text"),
    [
        pytest.param(0.3, "of 1000 conversions in the last 1 s", id="too-few-conversions"),
        pytest.param(1.3, "Fz moves by 2", id="moving-load"),
    ],
)
def test_an_unsteady_cell_is_not_tared(duration: float, text: str) -> None:
    bench = Bench()
    bench.run(duration)
    with refused(DeviceError, "cannot tare: ", text):
        bench.cell.tare(STAMP)


@pytest.mark.parametrize(
    ("channel", "swing", "text"),
    [
        pytest.param(
            1, 0.5, "My moves by 0.5 N m (standard deviation), more than 0.2 N m", id="moment"
        ),
        pytest.param(1, 0.1, "", id="small-moment"),
        pytest.param(5, 3.0, "Fz moves by 3 N (standard deviation), more than 2 N", id="force"),
        pytest.param(5, 1.0, "", id="small-force"),
    ],
)
def test_moments_and_forces_have_their_limits(channel: int, swing: float, text: str) -> None:
    """Half of the values are above, half below: the swing is the standard deviation."""
    wrenches = np.zeros((10, 6))
    wrenches[:, channel] = swing * np.tile([1.0, -1.0], 5)
    assert unrest(wrenches, LoadCellSettings()) == text


def test_a_rail_within_the_last_second_prevents_tare() -> None:
    bench = Bench(wrench=still(np.zeros(6)))
    bench.run(1.1)
    bench.fault("rail", 1.0)
    bench.run(0.05)
    bench.fault("rail", 0.0)
    bench.run(0.2)
    with refused(DeviceError, "bridge 2 (input 0) is at its rail"):
        bench.cell.tare(STAMP)


def test_a_silent_cell_is_not_tared() -> None:
    bench = Bench(wrench=still(np.zeros(6)))
    bench.run(1.1)
    bench.fault("unplugged", 1.0)
    bench.run(0.05)
    with refused(DeviceError, "cannot tare: ", "no answer"):
        bench.cell.tare(STAMP)


@pytest.mark.parametrize(
    ("name", "value", "fact"),
    [
        pytest.param("matrix", (1.0,) * 36, " cannot be inverted", id="singular-matrix"),
        pytest.param("matrix", (1.0,) * 35, " has 35 numbers", id="short-matrix"),
        pytest.param("matrix", (1.0,) * 37, " has 37 numbers", id="long-matrix"),
        pytest.param("inputs", (0, 1, 2, 3, 4, 4), " names an input twice", id="input-twice"),
        pytest.param("inputs", (0, 1, 2, 3, 4, 7), " names input 7", id="input-7"),
        pytest.param("gain", 3, " is 3: ", id="gain"),
        pytest.param("full_scale", (1.0, 2.0), " has 2 numbers", id="full-scale"),
        pytest.param("channels", 7, " is 7: ", id="channels"),
        pytest.param("sign", (1.0, 1.0, 1.0, 1.0, 1.0, 0.5), " holds", id="sign"),
        pytest.param("window", 0.001, " is 0.001 s", id="window-too-short"),
        pytest.param("device", "spi0", " is 'spi0': ", id="device"),
    ],
)
def test_settings_of_wrong_wrenches_are_refused(name: str, value: Any, fact: str) -> None:
    with refused(ConfigurationError, f"load_cell_node: {name}{fact}"):
        check_settings(dataclasses.replace(SETTINGS, oversampling=16384, **{name: value}))


# --- the converter, byte by byte

CONVERSION = 1e-3  # [s]


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


def converter_on_a_wire(channels=6, crc="ccitt", chip_channels=None):
    constant = np.linspace(-0.5, 0.5, chip_channels or channels)
    chip = SimulatedAds131m0x(lambda moment: constant, len(constant), {}, seed=1)
    wire = Wire(chip)
    return chip, wire, ads131m0x.Ads131m0x(wire, channels, crc)


@pytest.mark.parametrize(("kind", "expected"), [("ccitt", 0x29B1), ("ansi", 0xAEE7)])
def test_checksums_are_those_of_the_data_sheet(kind: str, expected: int) -> None:
    assert ads131m0x.checksum(b"123456789", kind) == expected


def test_the_period_is_that_of_the_data_sheet() -> None:
    assert ads131m0x.conversion_period(8.192e6, 16384) == pytest.approx(1 / 250)


@pytest.mark.parametrize("oversampling", [128, 1024, 2048, 4096, 16384])
def test_the_delay_is_the_middle_of_the_filter(oversampling: int) -> None:
    box = np.ones(min(oversampling, 1024))
    response = np.convolve(np.convolve(box, box), box)
    if oversampling > 1024:
        outputs = np.zeros(oversampling - 1023)
        outputs[::1024] = 1.0
        response = np.convolve(response, outputs)
    middle = np.arange(len(response)) @ response / response.sum() / 4.096e6
    assert ads131m0x.group_delay(8.192e6, oversampling) == pytest.approx(middle, abs=5e-7)


def test_the_configuration_is_that_of_the_data_sheet() -> None:
    _, wire, converter = converter_on_a_wire()
    converter.reset_and_configure(4096, 8, 8.192e6)
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


def test_a_flipped_bit_fails_the_checksum() -> None:
    _, wire, converter = converter_on_a_wire()
    converter.reset_and_configure(4096, 8, 8.192e6)
    wire.alter = lambda answer: [*answer[:7], answer[7] ^ 1, *answer[8:]]
    with pytest.raises(ads131m0x.ChecksumError):
        converter.read()
    assert converter.check_frames(3) == 3


def test_a_frame_is_that_of_the_data_sheet() -> None:
    body = bytes.fromhex("013F00000001FFFFFF7FFFFF800000123456FEDCBA")
    frame = body + ads131m0x.checksum(body, "ccitt").to_bytes(2, "big") + b"\0"
    read = ads131m0x.Ads131m0x(Mock(xfer2=lambda data: list(frame)), 6).read()
    assert read.new
    assert read.codes.tolist() == [1, -1, 0x7FFFFF, -0x800000, 0x123456, 0xFEDCBA - (1 << 24)]
    assert ads131m0x.at_rail(read.codes).tolist() == [False, False, True, True, False, False]
    assert ads131m0x.volts(read.codes, 4)[3] == pytest.approx(-0.3)


def test_another_chip_is_named() -> None:
    _, _, converter = converter_on_a_wire(8, chip_channels=6)
    with refused(DeviceError, "the converter says ID 0x2602, not 0x28xx"):
        converter.reset_and_configure(4096, 1, 8.192e6)


@pytest.mark.parametrize(("byte", "bit"), [(255, 1), (0, 0)], ids=["all-ones", "all-zeros"])
def test_a_dead_chip_is_named(byte: int, bit: int) -> None:
    _, wire, converter = converter_on_a_wire()
    wire.alter = lambda answer: [byte] * len(answer)
    with refused(DeviceError, f"spidev0.0: no answer (every bit reads {bit})", "MISO"):
        converter.reset_and_configure(4096, 1, 8.192e6)


def test_a_register_that_is_not_written_is_named() -> None:
    chip, _, _ = converter_on_a_wire()
    deaf = Mock(xfer2=lambda data: chip.xfer2(words(0) if data[:2] == [0x61, 0x03] else data))
    with refused(DeviceError, "register 0x02"):
        ads131m0x.Ads131m0x(deaf, 6).reset_and_configure(4096, 1, 8.192e6)


def test_another_configuration_follows_an_earlier_one() -> None:
    """After a crash of the computer the chip is as it was left, checksum and lock included."""
    chip, wire, converter = converter_on_a_wire(crc="ansi")
    converter.reset_and_configure(1024, 2, 8.192e6)
    chip.xfer2(words(0x0555))
    chip.xfer2(words(0x0011))
    assert int.from_bytes(chip.xfer2(words(0))[:2], "big") & 0x8500 == 0x8100  # locked, no reset
    again = ads131m0x.Ads131m0x(wire, 6)
    again.reset_and_configure(4096, 1, 8.192e6)
    clocks.sleep(CONVERSION)
    assert again.read().new


def test_conversions_are_timed_closer_than_they_are_read(rng) -> None:
    times, worst, taken = ConversionClock(CONVERSION), 0.0, 0
    ends = 5.0 + 1.0003 * CONVERSION * np.arange(3000)  # the chip's clock is a bit slow
    now, waiting = 4.99, 0
    while waiting < len(ends):
        now += rng.uniform(0.4, 1.7) * CONVERSION
        while waiting < len(ends) and ends[waiting] <= now:
            end = times.conversion_end(now)
            if end is not None and waiting > 200:
                worst = max(worst, abs(end - ends[waiting]))
                taken += 1
            waiting += 1
        times.nothing_waits(now, now)
        if waiting % 500 == 250:
            times.lose()
            times.nothing_waits(now, now)
    assert taken > 2700
    assert worst < 0.25 * CONVERSION


def test_a_pause_leaves_no_wrong_time() -> None:
    times = ConversionClock(CONVERSION)
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


def test_what_is_known_of_the_phase_bounds_a_pause() -> None:
    """Read just before the fourth conversion ends, the second and third still wait."""
    times, first = ConversionClock(CONVERSION), 1.0
    times.nothing_waits(first - 0.01 * CONVERSION, first - 0.01 * CONVERSION)
    assert times.conversion_end(first + 0.05 * CONVERSION) == pytest.approx(first, abs=1e-4)
    times.nothing_waits(first + 0.06 * CONVERSION, first + 0.06 * CONVERSION)
    read = first + 2.9 * CONVERSION
    for number in (1, 2):
        end = first + number * CONVERSION
        assert times.conversion_end(read) == pytest.approx(end, abs=0.1 * CONVERSION)
    assert times.conversion_end(first + 6.0 * CONVERSION) is None


def test_contradictory_bounds_are_forgotten() -> None:
    """The chip converts 2 % faster than its settings say."""
    times, read = ConversionClock(CONVERSION), 1.0
    times.nothing_waits(read - 1e-6, read - 1e-6)
    dated = 0
    for _ in range(200):
        read += 0.98 * CONVERSION
        end = times.conversion_end(read + 1e-6)
        assert end is None or end == pytest.approx(read, abs=0.51 * CONVERSION)
        dated += end is not None
        times.nothing_waits(read + 1e-6, read + 1e-6)
    assert dated > 100


def test_polls_follow_the_conversions(clock: FakeClock) -> None:
    """A poll soon after each conversion, with little more than one frame: wakes cost the most."""
    converter = Bench().converter
    polled: list[float] = []
    frames = Mock(wraps=converter.connect()._spi.xfer2)
    converter.connect()._spi.xfer2 = frames
    converter.poll_until(lambda: clock.now > BEGIN + 4.0, lambda: polled.append(clock.now))
    conversions = converter.counts()["conversions"]
    assert conversions >= 4.0 / CONVERSION - 10
    assert len(polled) < 1.05 * conversions
    assert frames.call_count < 1.1 * conversions
    ends = np.array(converter._times[500:]) + converter.end_time(0.0)
    after = np.searchsorted(ends, polled[600:-5], side="right") - 1
    behind = polled[600:-5] - ends[after]
    assert np.quantile(behind, 0.95) < 0.3 * CONVERSION


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Mock]:
    """The SPI device that is opened."""
    file = os.open(tmp_path / "spidev0.0", os.O_RDWR | os.O_CREAT)
    device = Mock(**{"fileno.return_value": file})
    monkeypatch.setitem(sys.modules, "spidev", SimpleNamespace(SpiDev=lambda: device))
    yield device
    os.close(file)


def test_the_bus_is_opened_in_mode_1(device: Mock) -> None:
    spi = ads131m0x.open_spi("1.2", 8e6)
    device.open.assert_called_once_with(1, 2)
    assert (spi.mode, spi.max_speed_hz) == (1, 8_000_000)


@pytest.mark.parametrize(
    ("number", "hint"),
    [
        pytest.param(errno.ENOENT, "dtparam=spi=on", id="ENOENT"),
        pytest.param(errno.EACCES, "group spi", id="EACCES"),
    ],
)
def test_a_bus_that_cannot_be_opened_is_named(device: Mock, number: int, hint: str) -> None:
    device.open.side_effect = OSError(number, "x")
    with refused(DeviceError, "/dev/spidev0.0", hint):
        ads131m0x.open_spi("0.0", 8e6)
    assert device.close.call_count == 1


def test_a_device_of_another_program_is_refused(device: Mock, tmp_path: Path) -> None:
    other = os.open(tmp_path / "spidev0.0", os.O_RDWR)
    fcntl.flock(other, fcntl.LOCK_EX)
    with refused(DeviceBusyError, f"another program uses spidev0.0 (process {os.getpid()}, "):
        ads131m0x.open_spi("0.0", 8e6)
    assert device.close.call_count == 1
    os.close(other)
    assert ads131m0x.open_spi("0.0", 8e6) is device


@pytest.mark.usefixtures("device")
def test_a_bus_is_named_by_two_numbers() -> None:
    with refused(ConfigurationError, "N.M"):
        ads131m0x.open_spi("spidev0.0", 8e6)
