"""The load cell with its converter's DRDY on a GPIO line: each edge is a conversion's time."""

import dataclasses
from types import SimpleNamespace

import gpiod
import numpy as np
import pytest
from gpiod.line import Clock, Direction, Edge

from socket_testbed import clocks
from socket_testbed.drivers import gpio
from socket_testbed.drivers.load_cell.ads131m0x import Ads131m0x
from socket_testbed.drivers.load_cell.load_cell import LoadCell
from socket_testbed.errors import DeviceError
from socket_testbed.live.hardware import make_load_cell
from socket_testbed.settings.acquisition import LoadCellSettings
from socket_testbed.simulation.devices.ads131m0x import SimulatedLoadCellHardware

SETTINGS = LoadCellSettings(
    matrix=tuple(np.diag([900.0, 950.0, 1800.0, 40.0, 42.0, 60.0]).ravel()),
    full_scale=(1500.0, 1500.0, 2500.0, 80.0, 80.0, 60.0),
    data_ready_line=22,
)
SPEED = np.array([2.0, -1.6, 1.2, 40.0, -20.0, 180.0])  # [N m/s, N/s]
FAULTS = {"flipped_bits": 0.05, "unplugged": 1.0, "frozen": 1.0, "brown_out": 0.07}


@pytest.fixture
def hardware(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hardware keeps to real time, however slow this machine is."""
    monkeypatch.setattr(clocks, "_scale", 1.0)


class Bench:
    """A load cell with the line, under a fake clock and a load that never rests."""

    def __init__(self, settings: LoadCellSettings = SETTINGS, seed: int = 0) -> None:
        self.now = 50.0
        self.faults: dict[str, float] = {}
        self.rng = np.random.default_rng(seed)
        self.hardware = SimulatedLoadCellHardware(
            self.wrench, settings, self.faults, lambda: self.now, seed
        )
        self.cell = LoadCell(
            settings, self.hardware.open_device, lambda: self.now, self.sleep,
            self.hardware.open_line,
        )  # fmt: skip

    def sleep(self, duration: float) -> None:
        self.now += duration

    def wrench(self, moment) -> np.ndarray:
        return np.sin(0.5 * np.asarray(moment)[..., None]) * SPEED

    def run(self, duration: float, pause: float = 0.0) -> None:
        """Poll for a while, now and then late by several periods."""
        end = self.now + duration
        while self.now < end:
            self.now += self.cell.period * self.rng.uniform(0.4, 1.6)
            if self.rng.random() < pause:
                self.now += self.rng.uniform(1.0, 9.0) * self.cell.period
            self.cell.poll()

    def conversions(self, span: float) -> tuple[np.ndarray, np.ndarray]:
        """Times and errors [N m, N] of the conversions of the last seconds."""
        times, ratios, _ = self.cell._reader.between(self.now - span, self.now)
        return times, self.cell._bridges.wrenches(ratios) - self.wrench(times)

    def check(self, span: float, fewest: int) -> None:
        """Each is the load at its time; with a neighbour's time it would be off by 1e-3."""
        times, errors = self.conversions(span)
        assert len(times) >= fewest
        assert (np.abs(errors) < 1e-4 * np.abs(SPEED)).all()


def test_each_conversion_has_the_time_of_its_edge() -> None:
    bench = Bench()
    bench.run(2.0)
    bench.check(1.5, fewest=749)
    assert bench.cell.health(bench.now)[0] == 0
    assert bench.cell.figures()["status_disagrees"] == 0


@pytest.mark.parametrize("seed", range(4))
def test_what_a_late_reader_lost_is_missing_and_nothing_is_taken_for_another(seed: int) -> None:
    bench = Bench(seed=seed)
    bench.run(4.0, pause=0.05)
    bench.check(3.5, fewest=700)


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_leave_no_wrong_conversion(fault: str) -> None:
    bench = Bench(seed=3)
    bench.run(0.5)
    bench.faults[f"load_cell.{fault}"] = FAULTS[fault]
    bench.run(1.0)
    if fault in ("unplugged", "frozen"):
        assert bench.cell.health(bench.now)[0] == 2
    bench.faults.clear()
    bench.run(1.5)
    bench.check(3.0, fewest=500)
    assert bench.cell.health(bench.now) == (0, "spidev0.0 converts")
    bench.check(0.5, fewest=249)


def test_status_bits_that_do_not_show_conversions_do_no_harm(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The bits are an assumption about the chip: with the line they are only counted."""
    read = Ads131m0x.read
    monkeypatch.setattr(Ads131m0x, "read", lambda chip: dataclasses.replace(read(chip), new=False))
    bench = Bench()
    bench.run(1.0)
    bench.check(0.8, fewest=399)
    assert bench.cell.figures()["status_disagrees"] > 400


def test_a_wire_that_is_off_is_named() -> None:
    bench = Bench()
    bench.run(0.5)
    bench.hardware.line.connected = False
    bench.run(0.5)
    level, text = bench.cell.health(bench.now)
    assert level == 2
    assert "converts, but no edge comes on line 22: check the wire from DRDY, or set" in text
    bench.hardware.line.connected = True
    bench.run(0.8)
    assert bench.cell.health(bench.now)[0] == 0


@pytest.mark.usefixtures("hardware")
def test_the_line_is_asked_for_falling_edges_on_the_steady_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = {}
    events = [SimpleNamespace(timestamp_ns=5_000_000_000 + 2_000_000 * k) for k in range(3)]
    request = SimpleNamespace(
        wait_edge_events=lambda timeout: bool(events),
        read_edge_events=lambda: [events.pop(0) for _ in range(len(events))],
        release=lambda: asked.update(released=True),
    )

    def request_lines(path: str, consumer: str, config: dict) -> SimpleNamespace:
        asked.update(path=path, config=config)
        return request

    monkeypatch.setattr(gpio, "_chip", lambda *_: "/dev/gpiochip4")
    monkeypatch.setattr(gpiod, "request_lines", request_lines)
    line = make_load_cell(SETTINGS)._reader._open_line()
    settings = asked["config"][22]
    assert asked["path"] == "/dev/gpiochip4" and list(asked["config"]) == [22]
    assert settings.direction == Direction.INPUT and settings.edge_detection == Edge.FALLING
    assert settings.event_clock == Clock.MONOTONIC
    assert line.edges(0.0) == pytest.approx([5.0, 5.002, 5.004]) and line.edges(0.0) == []
    line.close()
    assert asked["released"]


@pytest.mark.usefixtures("hardware")
def test_a_chip_that_is_not_there_names_the_load_cell_s_settings(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(gpio.Path, "glob", lambda *_: iter(()))
    with pytest.raises(DeviceError, match="data_ready_chip, or its data_ready_line to -1"):
        make_load_cell(SETTINGS)._reader._open_line()


@pytest.mark.usefixtures("hardware")
def test_without_a_line_there_is_none() -> None:
    cell = make_load_cell(dataclasses.replace(SETTINGS, data_ready_line=-1))
    assert cell._reader._open_line is None
    assert "status_disagrees" not in cell.figures()
