"""The clusters, read for each trigger: one that fails is left out while the others go on."""

from __future__ import annotations

import errno
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from smbus2 import i2c_msg

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.drivers.clusters import i2c
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.samples import Status
from socket_testbed.settings.acquisition import ClusterSettings

# In cycles, each the time that a chip takes for its four inputs.
_PAUSE = 0.05  # between two polls of the chips that still convert
_OLDEST = 2.0  # age at the trigger
_SHARED = 0.5  # a value read so shortly before a trigger is nearer than the next conversion
_UNFINISHED = 2.5
_SETTLING = 0.5  # two conversions: the one under way has the former range


@dataclass(frozen=True)
class ClusterReading:
    """The clusters' values for one trigger."""

    capacitance: FloatArray  # of c clusters by input, shape (c, 4) [pF]; NaN where there is none
    status: StatusArray  # OK, SATURATED or MISSING (`Status`) of each input, shape (c, 4)
    faults: dict[str, str]  # fault and hint in one line, by the cluster's name


class ClusterReader:
    """Reads all clusters, and never raises for a fault of the hardware.

    The first reading opens the buses by their numbers; what opens one may raise a `DeviceError`.
    """

    def __init__(
        self,
        settings: ClusterSettings,
        chip: type[i2c.CapacitiveChip],
        open_bus: Callable[[int], i2c.I2cBus],
    ) -> None:
        check_settings(settings, chip)
        self._settings = settings
        cycle = i2c.INPUTS / settings.sample_rate  # [s]
        self._buses = {number: _Bus(number, open_bus) for number in settings.buses}
        self._clusters: dict[str, _Cluster] = {}
        for name, (number, address, channel) in _places(settings):
            bus = self._buses[number]
            if address:
                bus.multiplexers[address] = i2c.I2cPort(bus, bus.name, address, part="multiplexer")
            place = f"behind channel {channel} of 0x{address:02X}" if address else ""
            made = chip(i2c.I2cPort(bus, bus.name, chip.address, place), settings.sample_rate)
            self._clusters[name] = _Cluster(bus, (address, channel), made, cycle)

    def read(self, trigger: float) -> ClusterReading:
        """Read the clusters for a trigger at a time of the steady clock [s]."""
        for bus in self._buses.values():
            bus.given_up = ""
        clusters = self._clusters.values()
        for cluster in clusters:
            cluster.begin(trigger)
        latest = trigger + self._settings.latest
        late = clocks.monotonic() > latest
        # Those to be set up come last: they would hold up the others.
        waiting = [] if late else sorted(clusters, key=lambda cluster: not cluster.configured)
        while waiting := [cluster for cluster in waiting if cluster.advance()]:
            clocks.sleep(_PAUSE * waiting[0].cycle)

        shape = (len(clusters), i2c.INPUTS)
        capacitance = np.full(shape, np.nan)
        status = np.full(shape, Status.MISSING, dtype=np.uint8)
        faults = {}
        for row, (name, cluster) in enumerate(self._clusters.items()):
            fault, whole = cluster.fault, not cluster.pending
            if late or (whole and max(entry.read for entry in cluster.inputs) > latest):
                fault = (
                    f"read more than {self._settings.latest:g} s after the trigger:"
                    " lower the trigger's rate, or relieve the computer"
                )
            elif whole:
                capacitance[row] = values = [entry.value for entry in cluster.inputs]
                status[row] = np.where(np.isnan(values), Status.SATURATED, Status.OK)
                fault = fault or "; ".join(entry.fault for entry in cluster.inputs if entry.fault)
            if fault:
                faults[name] = fault
        return ClusterReading(capacitance, status, faults)

    def identify(self) -> dict[str, str | DeviceError]:
        """The chip found at each cluster's place, or the error there, by the cluster's name."""
        found: dict[str, str | DeviceError] = {}
        for name, cluster in self._clusters.items():
            try:
                cluster.select()
                cluster.chip.check_identity()
                found[name] = f"{cluster.chip.name} at {cluster.chip.where}"
            except DeviceError as error:
                found[name] = error
        return found

    def close(self) -> None:
        """Disconnect the chips and close the buses."""
        for bus in self._buses.values():
            if bus.is_open:
                with suppress(DeviceError):
                    bus.disconnect()
            bus.close()


class _Bus:
    """A bus with its multiplexers (TI TCA9548A), if it has any, and its state as far as known.

    It is opened when needed, and can be closed and opened under the chips on it. The chips share
    one address: two channels at once would put them on the same wires. What a fault costs is
    decided in `note`.
    """

    def __init__(self, number: int, open_bus: Callable[[int], i2c.I2cBus]) -> None:
        self.name = f"i2c-{number}"
        self.configured: set[tuple[int, int]] = set()  # places of the chips, since it was opened
        self.multiplexers: dict[int, i2c.I2cPort] = {}  # by their addresses
        self.given_up = ""  # why nothing more is read from it for the present trigger
        self.backoff = clocks.Backoff()
        self._closed_by = ""  # the fault for which it was closed
        self._number = number
        self._open_bus = open_bus
        self._bus: i2c.I2cBus | None = None

    @property
    def is_open(self) -> bool:
        return self._bus is not None

    def unusable(self, now: float) -> str:
        """Why nothing can be read from it at a time [s]; empty: it is open, or may be opened."""
        waits = not self.is_open and not self.backoff.due(now)
        return self.given_up or (self._closed_by if waits else "")

    def note(self, error: DeviceError, chip: int, now: float) -> bool:
        """Take a fault met on the way to a chip at an address; whether it is that chip's alone.

        Otherwise the bus is closed, to be opened again: it is gone, or its multiplexer fails.
        Every transfer on a bus that hangs takes its whole time-out: one for a trigger is enough.
        """
        if isinstance(error, i2c.BusTimeoutError):
            self.given_up = str(error)
        of_chip = not isinstance(error, i2c.BusError) or error.address == chip
        if self.is_open and of_chip and not isinstance(error, i2c.BusGoneError):
            return True
        self.given_up = self._closed_by = str(error)
        self.backoff.failed(now)
        self.close()
        return False

    def open(self) -> None:
        if self._bus is None:
            self._bus = self._open_bus(self._number)

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
            self.multiplexers[multiplexer].write_byte(1 << channel)

    def disconnect(self, but: int = 0) -> None:
        """Connect no channel, of any multiplexer but one."""
        for address, multiplexer in self.multiplexers.items():
            if address != but:
                multiplexer.write_byte(0)

    def close(self) -> None:
        """Close it; one that is gone is closed already."""
        self.configured.clear()
        bus, self._bus = self._bus, None
        if bus is not None:
            with suppress(OSError):
                bus.close()


@dataclass
class _Input:
    low: float  # it was not done then [s]
    settled: float = -math.inf  # a conversion that may have ended before has another range [s]
    since: float = -math.inf  # the value's conversion ended after this [s]
    read: float = -math.inf  # a conversion was last read then [s]
    value: float = math.nan  # [pF]; NaN if out of range
    fault: str = ""


@dataclass
class _Cluster:
    """A chip at its place, and its four inputs, read for each trigger.

    A conversion ended after the last time that its input was known not to be done. That bound,
    not the time of the read, limits how old a value can be, even if the chip has hung meanwhile.
    """

    bus: _Bus
    place: tuple[int, int]  # its multiplexer's address, 0: none, and channel
    chip: i2c.CapacitiveChip
    cycle: float  # [s]
    inputs: list[_Input] = field(default_factory=list)
    pending: set[int] = field(default_factory=set)  # without a value for the present trigger
    trigger: float = -math.inf  # [s]
    begun: float = -math.inf  # to read for it [s]
    fault: str = ""
    backoff: clocks.Backoff = field(default_factory=clocks.Backoff)

    @property
    def configured(self) -> bool:
        return self.place in self.bus.configured

    def begin(self, trigger: float) -> None:
        """Begin to gather the inputs' values for a trigger at a time of the steady clock [s]."""
        self.pending = set(range(i2c.INPUTS))
        self.trigger = trigger
        self.begun = clocks.monotonic()

    def advance(self) -> bool:
        """Poll it once; returns whether to poll it again."""
        now = clocks.monotonic()
        if unusable := self.bus.unusable(now):
            self.fault = unusable
            return False
        try:
            self.bus.open()
            if not self.configured and not self.backoff.due(now):
                return False
            self.select()
            if not self.configured:
                self._configure()
            if self._poll():
                return True
        except DeviceError as error:
            self.bus.configured.discard(self.place)
            self.fault, now = str(error), clocks.monotonic()
            if self.bus.note(error, self.chip.address, now):
                self.backoff.failed(now)
            return False
        self.fault = ""
        self.backoff.succeeded()
        self.bus.backoff.succeeded()
        return False

    def select(self) -> None:
        """Connect the chip, and it alone."""
        self.bus.open()
        self.bus.select(*self.place)

    def _configure(self) -> None:
        """Reset and configure the chip; drops what came before."""
        begun = clocks.monotonic()
        self.chip.reset_and_configure()
        self.inputs = [_Input(low=begun) for _ in range(i2c.INPUTS)]
        self.begun = clocks.monotonic()
        self.bus.configured.add(self.place)

    def _poll(self) -> bool:
        """Read what is done; returns whether inputs are still pending."""
        asked = clocks.monotonic()
        done = self.chip.done()
        codes = {n: self._read(n) for n in sorted(self.pending) if done[n]}
        for n in self.pending - codes.keys():
            self._await(n, asked)
        if codes:
            # A chip that lost its supply while it was read gave zeros that look like values.
            self.chip.done()
        for n, code in codes.items():
            if code is not None:
                entry, conversion = self.inputs[n], self.chip.convert(n, code)
                entry.value, entry.fault = conversion.picofarads, conversion.fault
                if conversion.shifted:
                    entry.settled = clocks.monotonic() + _SETTLING * self.cycle
                self.pending.discard(n)
        return bool(self.pending)

    def _read(self, n: int) -> int | None:
        """The code of an input [1], or None if it may be too old; it is cleared either way."""
        entry = self.inputs[n]
        entry.since, entry.low = entry.low, clocks.monotonic()
        code = self.chip.read(n)
        entry.read = clocks.monotonic()
        if entry.since < max(self.trigger - _OLDEST * self.cycle, entry.settled):
            entry.since = -math.inf
            return None
        return code

    def _await(self, n: int, asked: float) -> None:
        entry = self.inputs[n]
        entry.low = asked
        # At triggers as fast as the cycle, waiting for the next conversion each time would
        # make the readings fall behind; the last one may be nearer to this trigger.
        near = _SHARED * self.cycle
        is_young = entry.since >= self.trigger - _OLDEST * self.cycle
        if asked >= self.trigger + near and entry.read >= self.trigger - near and is_young:
            self.pending.discard(n)
        elif asked - max(self.begun, entry.read) > _UNFINISHED * self.cycle:
            raise DeviceError(
                f"conversions of input {n + 1} do not finish at {self.chip.where}",
                "the chip is reset; if this comes again, check its supply",
            )


def _places(settings: ClusterSettings) -> Iterator[tuple[str, tuple[int, int, int]]]:
    """The clusters' names with their bus, their multiplexer's address (0: none) and channel."""
    places = zip(settings.buses, settings.each_multiplexer, settings.channels, strict=True)
    return zip(settings.names, places, strict=True)


def check_settings(settings: ClusterSettings, chip: type[i2c.CapacitiveChip]) -> None:
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
    at: dict[str, str] = {}
    for name, (bus, address, channel) in _places(settings):
        if address and address < 0x70:
            fact = f"multiplexer is 0x{address:02X}"
            raise ConfigurationError(fact, "give 0x70 to 0x77, or 0 for none")
        place = f"bus {bus}" + (f", channel {channel} of 0x{address:02X}" if address else "")
        if name in at.values() or place in at:
            raise ConfigurationError(
                f"the clusters '{at.get(place, name)}' and '{name}' share a name or {place}",
                "give each cluster a name and a place of its own",
            )
        at[place] = name
