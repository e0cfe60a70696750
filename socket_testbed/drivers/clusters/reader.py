"""The clusters, read for each trigger: what fails is left out while the others go on."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.clocks import Backoff
from socket_testbed.drivers.clusters.fdc1004 import ADDRESS, INPUTS, Fdc1004, FreshInputs
from socket_testbed.drivers.clusters.i2c import (
    BusError,
    BusGoneError,
    BusTimeoutError,
    I2cBus,
    I2cPort,
    Multiplexer,
    ReopenedBus,
)
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.settings.acquisition import ClusterSettings

OK, SATURATED, MISSING = 0, 1, 2  # as in calibration.Status, which is on a higher floor

_PAUSE = 0.05  # between two looks at the chips that still convert [cycles]


@dataclass(frozen=True)
class ClusterReading:
    """What belongs to one trigger.

    Attributes:
        names: Names of the c clusters.
        capacitance: Capacitances by input, shape (c, 4) [pF]; NaN where there is none.
        status: `OK`, `SATURATED` or `MISSING` of each input, shape (c, 4).
        faults: What is wrong now and how to fix it, in one line, by the cluster's name.
        notes: What was done in this reading, such as a set-up.
    """

    names: tuple[str, ...]
    capacitance: FloatArray
    status: StatusArray
    faults: dict[str, str]
    notes: tuple[str, ...] = ()


class ClusterReader:
    """Reads all clusters, and never fails for what the hardware does."""

    def __init__(
        self,
        settings: ClusterSettings,
        open_bus: Callable[[int], I2cBus],
        clock: Callable[[], float] = clocks.monotonic,
        sleep: Callable[[float], None] = clocks.sleep,
    ) -> None:
        """Describe the array; the first reading opens the buses.

        Args:
            settings: What is wired where.
            open_bus: Opens the bus of a number.
            clock: The steady clock [s].
            sleep: Waits [s].

        Raises:
            ConfigurationError: If the settings do not fit together.
        """
        check_settings(settings)
        self._settings = settings
        self._clock = clock
        self._sleep = sleep
        self._cycle = INPUTS / settings.sample_rate  # [s]
        self._buses = {number: _Bus(number, open_bus, settings) for number in settings.buses}
        self._clusters = [
            self._describe(*wired)
            for wired in zip(settings.names, settings.buses, settings.channels, strict=True)
        ]

    def read(self, trigger: float) -> ClusterReading:
        """Read what belongs to a trigger at a time of the steady clock [s]."""
        for bus in self._buses.values():
            bus.given_up = ""
        for cluster in self._clusters:
            cluster.inputs.begin(trigger)
        if self._clock() > trigger + self._settings.latest:
            return self._reading(trigger, self._too_late)

        # Those to be set up come last: they would hold up the others.
        waiting = sorted(self._clusters, key=lambda cluster: not cluster.configured)
        while waiting := [cluster for cluster in waiting if self._advance(cluster)]:
            self._sleep(_PAUSE * self._cycle)
        return self._reading(trigger)

    @property
    def _too_late(self) -> str:
        fact = f"read more than {self._settings.latest:g} s after the trigger"
        return str(DeviceError(fact, "lower the trigger's rate, or relieve the computer"))

    def identify(self) -> dict[str, str | DeviceError]:
        """What is found at each cluster's place, or what is wrong there, by its name."""
        found: dict[str, str | DeviceError] = {}
        for cluster in self._clusters:
            chip = cluster.inputs.chip
            try:
                cluster.bus.line.open()
                cluster.select()
                chip.check_identity()
                found[cluster.name] = f"FDC1004 at {chip.where}"
            except DeviceError as error:
                found[cluster.name] = error
        return found

    def close(self) -> None:
        """Disconnect the chips and close the buses."""
        for bus in self._buses.values():
            if bus.multiplexer and bus.line.is_open:
                with suppress(DeviceError):
                    bus.multiplexer.off()
            self._close(bus)

    def _describe(self, name: str, number: int, channel: int) -> _Cluster:
        bus, address = self._buses[number], self._settings.multiplexer
        place = f"behind channel {channel} of 0x{address:02X}" if address else ""
        chip = Fdc1004(I2cPort(bus.line, bus.line.name, ADDRESS, place), self._sleep)
        return _Cluster(name, bus, channel, FreshInputs(chip, self._clock, self._cycle))

    def _advance(self, cluster: _Cluster) -> bool:
        """Look at a cluster once; returns whether to look again."""
        bus, now = cluster.bus, self._clock()
        if not bus.line.is_open and not bus.backoff.due(now):
            bus.given_up = bus.fault
        if bus.given_up:
            cluster.fault = bus.given_up
            return False
        try:
            bus.line.open()
            if not cluster.configured and not cluster.backoff.due(now):
                return False
            cluster.select()
            if not cluster.configured:
                cluster.inputs.configure(self._settings.sample_rate)
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
        of_multiplexer = isinstance(error, BusError) and error.address != ADDRESS
        if bus.line.is_open and not of_multiplexer and not isinstance(error, BusGoneError):
            cluster.backoff.failed(now)
            return
        bus.given_up = bus.fault = str(error)
        bus.backoff.failed(now)
        self._close(bus)

    def _close(self, bus: _Bus) -> None:
        bus.line.close()
        for cluster in self._clusters:
            if cluster.bus is bus:
                cluster.configured = False

    def _reading(self, trigger: float, fault: str = "") -> ClusterReading:
        shape = (len(self._clusters), INPUTS)
        reading = ClusterReading(
            self._settings.names,
            np.full(shape, np.nan),
            np.full(shape, MISSING, dtype=np.uint8),
            faults={},
            notes=tuple(f"{c.name}: {note}" for c in self._clusters for note in c.inputs.notes),
        )
        for row, cluster in enumerate(self._clusters):
            inputs, wrong = cluster.inputs, fault or cluster.fault
            complete = not inputs.pending
            if complete and inputs.read > trigger + self._settings.latest:
                complete, wrong = False, self._too_late
            if complete:
                for n in range(INPUTS):
                    reading.capacitance[row, n] = inputs.value(n)
                    reading.status[row, n] = SATURATED if inputs.saturated(n) else OK
                wrong = wrong or inputs.faults
            if wrong:
                reading.faults[cluster.name] = wrong
        return reading


class _Bus:
    """A bus, its multiplexer if it has one, and what is known of its state."""

    def __init__(
        self, number: int, open_bus: Callable[[int], I2cBus], settings: ClusterSettings
    ) -> None:
        self.line = ReopenedBus(number, open_bus)
        self.backoff = Backoff()
        self.fault = ""  # why it was closed
        self.given_up = ""  # why nothing more is read from it for the present trigger
        self.multiplexer: Multiplexer | None = None
        if settings.multiplexer:
            port = I2cPort(self.line, self.line.name, settings.multiplexer, part="multiplexer")
            self.multiplexer = Multiplexer(port)


@dataclass
class _Cluster:
    name: str
    bus: _Bus
    channel: int
    inputs: FreshInputs
    backoff: Backoff = field(default_factory=Backoff)
    configured: bool = False
    fault: str = ""

    def select(self) -> None:
        if self.bus.multiplexer:
            self.bus.multiplexer.select(self.channel)


def check_settings(settings: ClusterSettings) -> None:
    """Check what the ranges of single settings cannot.

    Raises:
        ConfigurationError: If the settings do not fit together.
    """
    names, buses, channels = settings.names, settings.buses, settings.channels
    if not names or not len(names) == len(buses) == len(channels):
        raise ConfigurationError(
            f"{len(names)} names, {len(buses)} buses and {len(channels)} channels of clusters",
            "give each cluster one of each",
        )
    if settings.sample_rate not in {100, 200, 400}:
        raise ConfigurationError(f"sample_rate is {settings.sample_rate}", "give 100, 200 or 400")
    if settings.multiplexer and settings.multiplexer < 0x70:
        fact = f"multiplexer is 0x{settings.multiplexer:02X}"
        raise ConfigurationError(fact, "give 0x70 to 0x77, or 0 for none")
    at: dict[str, str] = {}
    for name, bus, channel in zip(names, buses, channels, strict=True):
        place = f"bus {bus}" + (f", channel {channel}" if settings.multiplexer else "")
        if name in at.values() or place in at:
            raise ConfigurationError(
                f"the clusters '{at.get(place, name)}' and '{name}' share a name or {place}",
                "give each cluster a name and a place of its own",
            )
        at[place] = name
