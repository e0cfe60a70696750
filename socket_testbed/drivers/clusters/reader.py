"""The clusters, read for each trigger: one that fails is left out while the others go on."""

from __future__ import annotations

import errno
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from smbus2 import i2c_msg

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.drivers.clusters.chip import INPUTS, CapacitiveChip, InputReader
from socket_testbed.drivers.clusters.i2c import (
    BusError,
    BusGoneError,
    BusTimeoutError,
    I2cBus,
    I2cPort,
    opening_failed,
)
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.samples import Status
from socket_testbed.settings.acquisition import ClusterSettings

_PAUSE = 0.05  # between two polls of the chips that still convert [cycles]


@dataclass(frozen=True)
class ClusterReading:
    """The clusters' values for one trigger."""

    names: tuple[str, ...]  # names of the c clusters
    capacitance: FloatArray  # capacitances by input, shape (c, 4) [pF]; NaN where there is none
    status: StatusArray  # OK, SATURATED or MISSING (`Status`) of each input, shape (c, 4)
    # fault and hint in one line, by the cluster's name
    faults: dict[str, str]
    notes: tuple[str, ...] = ()  # of this reading, such as a set-up


class ClusterReader:
    """Reads all clusters, and never raises for a fault of the hardware.

    The first reading opens the buses.

    Args:
        chip: The chip that each cluster has.
        open_bus: Opens the bus of a number.
    """

    def __init__(
        self,
        settings: ClusterSettings,
        chip: type[CapacitiveChip],
        open_bus: Callable[[int], I2cBus],
        clock: Callable[[], float] = clocks.monotonic,
        sleep: Callable[[float], None] = clocks.sleep,
    ) -> None:
        check_settings(settings, chip)
        self._settings = settings
        self._chip = chip
        self._clock = clock
        self._sleep = sleep
        self._pause = _PAUSE * INPUTS / settings.sample_rate  # [s]
        self._buses = {number: _Bus(number, open_bus) for number in settings.buses}
        places = zip(settings.buses, settings.each_multiplexer, settings.channels, strict=True)
        self._clusters = [
            self._describe(name, *place) for name, place in zip(settings.names, places, strict=True)
        ]

    def read(self, trigger: float) -> ClusterReading:
        """Read the clusters for a trigger at a time of the steady clock [s]."""
        for bus in self._buses.values():
            bus.given_up = ""
        for cluster in self._clusters:
            cluster.inputs.begin(trigger)
        if self._clock() > trigger + self._settings.latest:
            return self._reading(trigger, self._too_late)

        # Those to be set up come last: they would hold up the others.
        waiting = sorted(self._clusters, key=lambda cluster: not cluster.configured)
        while waiting := [cluster for cluster in waiting if self._advance(cluster)]:
            self._sleep(self._pause)
        return self._reading(trigger)

    @property
    def _too_late(self) -> str:
        return (
            f"read more than {self._settings.latest:g} s after the trigger:"
            " lower the trigger's rate, or relieve the computer"
        )

    def identify(self) -> dict[str, str | DeviceError]:
        """The chip found at each cluster's place, or the error there, by the cluster's name."""
        found: dict[str, str | DeviceError] = {}
        for cluster in self._clusters:
            chip = cluster.inputs.chip
            try:
                cluster.select()
                chip.check_identity()
                found[cluster.name] = f"{chip.name} at {chip.where}"
            except DeviceError as error:
                found[cluster.name] = error
        return found

    def close(self) -> None:
        """Disconnect the chips and close the buses."""
        for bus in self._buses.values():
            if bus.is_open:
                with suppress(DeviceError):
                    bus.disconnect()
            self._close(bus)

    def _describe(self, name: str, number: int, address: int, channel: int) -> _Cluster:
        bus = self._buses[number]
        bus.add_multiplexer(address)
        place = f"behind channel {channel} of 0x{address:02X}" if address else ""
        port, rate = I2cPort(bus, bus.name, self._chip.address, place), self._settings.sample_rate
        inputs = InputReader(self._chip(port, rate, self._sleep), rate, self._clock)
        return _Cluster(name, bus, address, channel, inputs)

    def _advance(self, cluster: _Cluster) -> bool:
        """Poll a cluster once; returns whether to poll it again."""
        bus, now = cluster.bus, self._clock()
        if not bus.is_open and not bus.backoff.due(now):
            bus.given_up = bus.fault
        if bus.given_up:
            cluster.fault = bus.given_up
            return False
        try:
            bus.open()
            if not cluster.configured and not cluster.backoff.due(now):
                return False
            cluster.select()
            if not cluster.configured:
                cluster.inputs.configure()
                cluster.configured = True
            if cluster.inputs.poll():
                return True
        except DeviceError as error:
            self._failed(cluster, error)
            return False
        cluster.fault = ""
        cluster.backoff.succeeded()
        bus.backoff.succeeded()
        return False

    def _failed(self, cluster: _Cluster, error: DeviceError) -> None:
        bus, now = cluster.bus, self._clock()
        cluster.configured = False
        cluster.fault = str(error)
        if isinstance(error, BusTimeoutError):
            # Every transfer on a bus that hangs takes its whole time-out: one is enough.
            bus.given_up = str(error)
        of_multiplexer = isinstance(error, BusError) and error.address != self._chip.address
        if bus.is_open and not of_multiplexer and not isinstance(error, BusGoneError):
            cluster.backoff.failed(now)
            return
        bus.given_up = bus.fault = str(error)
        bus.backoff.failed(now)
        self._close(bus)

    def _close(self, bus: _Bus) -> None:
        bus.close()
        for cluster in self._clusters:
            if cluster.bus is bus:
                cluster.configured = False

    def _reading(self, trigger: float, fault: str = "") -> ClusterReading:
        shape = (len(self._clusters), INPUTS)
        reading = ClusterReading(
            self._settings.names,
            np.full(shape, np.nan),
            np.full(shape, Status.MISSING, dtype=np.uint8),
            faults={},
            notes=tuple(f"{c.name}: {note}" for c in self._clusters for note in c.inputs.notes),
        )
        for row, cluster in enumerate(self._clusters):
            inputs, wrong = cluster.inputs, fault or cluster.fault
            if not inputs.pending:
                if inputs.read > trigger + self._settings.latest:
                    wrong = self._too_late
                else:
                    reading.capacitance[row] = inputs.capacitance
                    reading.status[row] = inputs.status
                    wrong = wrong or inputs.faults
            if wrong:
                reading.faults[cluster.name] = wrong
        return reading


class _Bus:
    """A bus with its multiplexers (TI TCA9548A), if it has any, and its state as far as known.

    It is opened when needed, and can be closed and opened under the chips on it. The chips share
    one address: two channels at once would put them on the same wires.
    """

    def __init__(self, number: int, open_bus: Callable[[int], I2cBus]) -> None:
        self.name = f"i2c-{number}"  # its name, such as i2c-1
        self.backoff = clocks.Backoff()
        self.fault = ""  # why it was closed
        self.given_up = ""  # why nothing more is read from it for the present trigger
        self._number = number
        self._open_bus = open_bus
        self._bus: I2cBus | None = None
        self._multiplexers: dict[int, I2cPort] = {}  # by their addresses

    def add_multiplexer(self, address: int) -> None:
        """Say that there is a multiplexer at an address; 0: none."""
        if address:
            self._multiplexers[address] = I2cPort(self, self.name, address, part="multiplexer")

    @property
    def is_open(self) -> bool:
        return self._bus is not None

    def open(self) -> None:
        if self._bus is None:
            try:
                self._bus = self._open_bus(self._number)
            except OSError as error:
                raise opening_failed(self._number, error) from error

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        """Transfer messages; raises OSError, as the bus itself does."""
        if self._bus is None:
            raise OSError(errno.ENODEV, "the bus is closed")
        self._bus.i2c_rdwr(*messages)

    def select(self, multiplexer: int, channel: int) -> None:
        """Connect one channel, 0..7 [1], of one multiplexer, and it alone.

        It is always written: after a brown-out a remembered selection would be wrong.
        """
        self.disconnect(but=multiplexer)
        if multiplexer:
            self._multiplexers[multiplexer].write_byte(1 << channel)

    def disconnect(self, but: int = 0) -> None:
        """Connect no channel, of any multiplexer but one."""
        for address, multiplexer in self._multiplexers.items():
            if address != but:
                multiplexer.write_byte(0)

    def close(self) -> None:
        """Close it; one that is gone is closed already."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with suppress(OSError):
                bus.close()


@dataclass
class _Cluster:
    name: str
    bus: _Bus
    multiplexer: int  # its address; 0: none
    channel: int
    inputs: InputReader
    backoff: clocks.Backoff = field(default_factory=clocks.Backoff)
    configured: bool = False
    fault: str = ""

    def select(self) -> None:
        self.bus.open()
        self.bus.select(self.multiplexer, self.channel)


def check_settings(settings: ClusterSettings, chip: type[CapacitiveChip]) -> None:
    """Check that the settings fit together, beyond the range of each."""
    names, buses, channels = settings.names, settings.buses, settings.channels
    multiplexers = settings.each_multiplexer
    if not names or not len(names) == len(buses) == len(channels) == len(multiplexers):
        raise ConfigurationError(
            f"{len(names)} names, {len(buses)} buses, {len(channels)} channels and"
            f" {len(multiplexers)} multiplexers of clusters",
            "give each cluster one of each, or no multiplexers for one address for all",
        )
    if settings.sample_rate not in chip.sample_rates:
        raise ConfigurationError(
            f"sample_rate is {settings.sample_rate}",
            f"give one of those of the {chip.name}: {', '.join(map(str, chip.sample_rates))}",
        )
    for address in multiplexers:
        if address and address < 0x70:
            fact = f"multiplexer is 0x{address:02X}"
            raise ConfigurationError(fact, "give 0x70 to 0x77, or 0 for none")
    at: dict[str, str] = {}
    for name, bus, address, channel in zip(names, buses, multiplexers, channels, strict=True):
        place = f"bus {bus}" + (f", channel {channel} of 0x{address:02X}" if address else "")
        if name in at.values() or place in at:
            raise ConfigurationError(
                f"the clusters '{at.get(place, name)}' and '{name}' share a name or {place}",
                "give each cluster a name and a place of its own",
            )
        at[place] = name
