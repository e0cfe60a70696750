"""Creates drivers on the machine's buses and lines, or on those of a simulated world."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray
from socket_testbed.drivers import DeviceBusyError, gpio, lock_device
from socket_testbed.drivers.clusters.fdc1004 import Fdc1004
from socket_testbed.drivers.clusters.i2c import CapacitiveChip, I2cBus, open_i2c
from socket_testbed.drivers.clusters.reader import ClusterReader
from socket_testbed.drivers.load_cell.ads131m0x import conversion_period, open_spi
from socket_testbed.drivers.load_cell.converter_reader import ConverterReader
from socket_testbed.drivers.load_cell.load_cell import LoadCell
from socket_testbed.errors import ConfigurationError, closest
from socket_testbed.settings.acquisition import ClusterSettings, LoadCellSettings, TriggerSettings
from socket_testbed.settings.testbed import TestbedSettings
from socket_testbed.simulation.devices.ads131m0x import simulated_load_cell
from socket_testbed.simulation.devices.fdc1004 import SimulatedFdc1004
from socket_testbed.simulation.devices.gpio import SimulatedLines
from socket_testbed.simulation.devices.i2c import SimulatedChip, SimulatedClusterHardware
from socket_testbed.simulation.world import World

# Driver and simulated counterpart of each chip for clusters, by the value of cluster_node's setting
# `chip`.
CAPACITIVE_CHIPS: dict[str, tuple[type[CapacitiveChip], type[SimulatedChip]]] = {
    "fdc1004": (Fdc1004, SimulatedFdc1004)
}


_DEVICES = Path("/dev")
_FREE_WITHIN = 3.0  # [s]; how long a program that is ending may still hold a bus
_FREE_INTERVAL = 0.1  # [s]


def find_user(settings: TestbedSettings) -> DeviceBusyError | None:
    """Which other program uses a bus of the testbed's settings; None if all are free.

    A bus that is not there or not permitted counts as free: its node reports it.
    """
    names: list[str] = []
    if "cluster_node" in settings.own_nodes:
        names += sorted({f"i2c-{number}" for number in settings.cluster_node.buses})
    if "load_cell_node" in settings.own_nodes:
        names.append(f"spidev{settings.load_cell_node.device}")
    for name in names:
        with suppress(OSError):
            file = os.open(_DEVICES / name, os.O_RDWR | os.O_NONBLOCK)
            try:
                lock_device(file, name)
            except DeviceBusyError as error:
                return error
            finally:
                os.close(file)
    return None


def require_free(settings: TestbedSettings) -> None:
    """Wait until no other program uses a bus of the testbed's settings.

    A program that is ending may still hold one for some seconds.

    Args:
        settings: Settings of the nodes, with their buses.

    Raises:
        DeviceBusyError: Another program still uses one then.
    """
    deadline = clocks.monotonic() + _FREE_WITHIN
    while (user := find_user(settings)) is not None:
        if clocks.monotonic() >= deadline:
            raise user
        clocks.sleep(_FREE_INTERVAL)


def _require_real_time() -> None:
    """Refuse a time scale with hardware, which runs in real time."""
    if clocks.time_scale() != 1.0:
        raise ConfigurationError(
            f"{clocks.TIME_SCALE}={clocks.time_scale():g} is for a simulated testbed, not hardware",
            "unset it",
        )


def make_trigger(settings: TriggerSettings) -> gpio.Trigger:
    """Create the trigger: a timer, or wired lines of the machine or of a simulated world."""
    if settings.source != "gpio":
        return gpio.TimerTrigger()
    if settings.simulation:
        faults = World(Path(settings.simulation)).faults
        return gpio.GpioTrigger(SimulatedLines(faults), settings)
    _require_real_time()
    uses: dict[int, gpio.Use] = {settings.output_line: "output", settings.input_line: "rising"}
    names = ("trigger_node", "chip", "source to timer")
    return gpio.GpioTrigger(gpio.GpiodLines(settings.chip, uses, *names), settings)


def wall_clock(settings: TriggerSettings) -> Callable[[], int]:
    """A function for the time since the epoch [ns], by the system or a simulated world."""
    if settings.simulation:
        return World(Path(settings.simulation)).wall_clock
    return time.time_ns


def capacitive_chip(settings: ClusterSettings) -> tuple[type[CapacitiveChip], type[SimulatedChip]]:
    """Driver class of the clusters' chip, and class of its simulated counterpart.

    Raises:
        ConfigurationError: If the settings name an unknown chip.
    """
    if settings.chip not in CAPACITIVE_CHIPS:
        raise ConfigurationError(
            f"cluster_node: chip is '{settings.chip}'", closest(settings.chip, CAPACITIVE_CHIPS)
        )
    return CAPACITIVE_CHIPS[settings.chip]


def make_clusters(settings: ClusterSettings) -> ClusterReader:
    """Create the reader of the clusters, on the machine's buses or in a simulated world."""
    return ClusterReader(settings, capacitive_chip(settings)[0], i2c_opener(settings))


def i2c_opener(settings: ClusterSettings) -> Callable[[int], I2cBus]:
    """A function that opens an I2C bus by number.

    Raises:
        ConfigurationError: If a time scale is set for hardware, or there is no simulated world.
    """
    if not settings.simulation:
        _require_real_time()
        return lambda number: open_i2c(number, settings.bus_timeout)
    world = World(Path(settings.simulation))
    rng = np.random.default_rng()

    def capacitance(cluster: int, channel: int, moment: float) -> float:
        noise = float(rng.normal(0.0, world.capacitance_noise[0]))
        if world.faults["clusters.exchanged"] and cluster < 2:
            cluster = 1 - cluster
        return world.capacitance(cluster, channel, moment) + noise

    chip = capacitive_chip(settings)[1]
    return SimulatedClusterHardware(settings, chip, capacitance, world.faults).open_bus


def make_load_cell(settings: LoadCellSettings) -> LoadCell:
    """Create the load cell, with its converter's DRDY if wired."""
    open_device = spi_opener(settings)
    open_line: Callable[[], gpio.EdgeLine] | None = None
    if settings.data_ready_line >= 0 and settings.simulation:
        open_line = open_device
    elif settings.data_ready_line >= 0:
        uses: dict[int, gpio.Use] = {settings.data_ready_line: "falling"}
        names = ("load_cell_node", "data_ready_chip", "data_ready_line to -1")
        open_line = partial(gpio.GpiodLines, settings.data_ready_chip, uses, *names)
    return LoadCell(settings, ConverterReader(settings, open_device, open_line=open_line))


def spi_opener(settings: LoadCellSettings) -> Callable[[], Any]:
    """A function that opens the converter as an `SpiDevice`; if simulated, also as its line.

    Raises:
        ConfigurationError: If a time scale is set for hardware, or there is no simulated world.
    """
    if not settings.simulation:
        _require_real_time()
        return lambda: open_spi(settings.device, settings.spi_clock)
    world = World(Path(settings.simulation))
    rng = np.random.default_rng()
    per_conversion = conversion_period(settings.clock_in, settings.oversampling) ** -0.5

    def noise() -> FloatArray:
        return rng.standard_normal(6) * world.wrench_noise * per_conversion

    chip = simulated_load_cell(world.wrench, settings, world.faults, noise=noise)
    return lambda: chip
