"""Reads the clusters for each trigger; a failed cluster does not stop the others."""

from __future__ import annotations

import errno
import math
from collections.abc import Callable
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

# In cycles; a chip converts its four inputs in one cycle.
_POLL_INTERVAL = 0.05  # while chips still convert
_MAX_AGE = 2.0  # of a conversion at the trigger
_REUSE_AGE = 0.5  # a value read this shortly before a trigger is closer than the next conversion
_CONVERSION_TIMEOUT = 2.5
_MIN_CYCLES = 1.25  # between a trigger and the `latest` reading
_SETTLING = 0.5  # two conversions: the one in progress still has the old range

_TRIES = 2  # of a transfer that no chip should answer
_MAX_SILENT = 2  # readings in a row without an answer on a bus, until it is opened again


@dataclass(frozen=True)
class ClusterReading:
    """The clusters' values for one trigger, in the order of the settings' `names`.

    Attributes:
        capacitance: Capacitance of each cluster's inputs, by the converter's input (not by the
            cluster's channel), shape (c, 4) [pF]; NaN if saturated or missing.
        status: `Status` of each input, shape (c, 4): OK, SATURATED or MISSING.
        faults: Faults by the cluster's name, each in one line with its hint; clusters without a
            fault have no entry.
    """

    capacitance: FloatArray
    status: StatusArray
    faults: dict[str, tuple[str, ...]]


class ClusterReader:
    """Reads all clusters and never raises for a hardware fault.

    The first reading opens the buses. Settings that do not fit together raise a
    `ConfigurationError`.

    Args:
        settings: Names and places of the clusters, and their rate.
        chip: Driver of the clusters' chips.
        open_bus: Opens the bus /dev/i2c-N from N; may raise a `DeviceError`, and is then called
            again later.
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
        self._buses = {number: _Bus(number, open_bus, chip.address) for number in settings.buses}
        self._clusters: dict[str, _Cluster] = {}
        for name, (number, address, channel) in zip(settings.names, settings.places, strict=True):
            bus = self._buses[number]
            if address:
                bus.multiplexers[address] = i2c.I2cPort(bus, bus.name, address, part="multiplexer")
            place = f"behind channel {channel} of 0x{address:02X}" if address else ""
            made = chip(i2c.I2cPort(bus, bus.name, chip.address, place), settings.sample_rate)
            self._clusters[name] = _Cluster(bus, (address, channel), made, cycle)

    def read(self, trigger: float) -> ClusterReading:
        """Read the clusters for a trigger at a time of the steady clock [s].

        It returns when each cluster was read or has failed. Values read later than the settings'
        `latest` after the trigger count as missing.
        """
        for bus in self._buses.values():
            bus.begin()
        clusters = self._clusters.values()
        for cluster in clusters:
            cluster.begin(trigger)
        latest = trigger + self._settings.latest
        late = clocks.monotonic() > latest
        # Unconfigured clusters come last, as they would delay the others.
        waiting = [] if late else sorted(clusters, key=lambda cluster: not cluster.configured)
        while waiting := [cluster for cluster in waiting if cluster.advance()]:
            clocks.sleep(_POLL_INTERVAL * waiting[0].cycle)
        for bus in self._buses.values():
            bus.close_if_silent(clocks.monotonic())

        shape = (len(clusters), i2c.INPUTS)
        capacitance = np.full(shape, np.nan)
        status = np.full(shape, Status.MISSING, dtype=np.uint8)
        faults = {}
        for row, (name, cluster) in enumerate(self._clusters.items()):
            found, complete = [cluster.fault], not cluster.pending
            if late or (complete and max(entry.read for entry in cluster.inputs) > latest):
                hint = "lower the trigger's rate, or relieve the computer"
                found = [f"read more than {self._settings.latest:g} s after the trigger: {hint}"]
            elif complete:
                capacitance[row] = values = [entry.value for entry in cluster.inputs]
                status[row] = np.where(np.isnan(values), Status.SATURATED, Status.OK)
                found += [entry.fault for entry in cluster.inputs]
            if told := tuple(filter(None, found)):
                faults[name] = told
        return ClusterReading(capacitance, status, faults)

    def identify(self) -> dict[str, str | DeviceError]:
        """Type and place of each cluster's chip, or the error, by the cluster's name."""
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
            with suppress(DeviceError):
                bus.disconnect()
            bus.close()


class _Bus:
    """A bus with its multiplexers (TI TCA9548A), if any, and its known state.

    It is opened when needed, and can be closed and reopened while chips refer to it. All chips have
    one address, so only one channel may be connected at a time.
    """

    def __init__(self, number: int, open_bus: Callable[[int], i2c.I2cBus], chip: int) -> None:
        self.name, self._chip = f"i2c-{number}", chip  # the address of all its chips
        self.configured: set[tuple[int, int]] = set()  # places of configured chips
        self.multiplexers: dict[int, i2c.I2cPort] = {}  # by address
        self.given_up = ""  # why it is not read any more for the current trigger
        self.backoff = clocks.Backoff()
        self._closed_by = ""  # the fault that closed it
        self._last_fault = ""
        self._answered = self._failed = False  # a transfer, for the current trigger
        self._silent = 0  # readings in a row with failed transfers only
        self._number = number
        self._open_bus = open_bus
        self._bus: i2c.I2cBus | None = None

    def begin(self) -> None:
        """Begin a reading."""
        self.given_up = ""
        self._answered = self._failed = False

    def close_if_silent(self, now: float) -> None:
        """End a reading at a time [s]; close the bus if nothing has answered for several.

        Its adapter may be unplugged, whatever errors the kernel reports: it comes back only when
        every open file of it is closed.
        """
        if self._answered:
            self._silent = 0
        elif self._failed:
            self._silent += 1
            if self._silent >= _MAX_SILENT and self._bus is not None:
                self._close_after(self._last_fault, now)

    def unusable(self, now: float) -> str:
        """Why the bus cannot be used at a time [s]; empty if it is open or may be opened."""
        waits = self._bus is None and not self.backoff.due(now)
        return self.given_up or (self._closed_by if waits else "")

    def handle_fault(self, error: DeviceError, chip: int, now: float) -> bool:
        """Handle a fault while accessing a chip at an address; returns whether only it is affected.

        Otherwise the bus is gone or its only multiplexer fails: the bus is closed and reopened
        later. One of several multiplexers fails for its own clusters alone.
        On a hanging bus every transfer takes its full timeout, so only one per trigger is tried.
        """
        self._last_fault = str(error)
        if isinstance(error, i2c.BusTimeoutError):
            self.given_up = str(error)
        only_chip = not isinstance(error, i2c.BusError) or error.address == chip
        only_chip |= len(self.multiplexers) > 1  # the others' clusters go on
        if self._bus is not None and only_chip and not isinstance(error, i2c.BusGoneError):
            return True
        self.given_up = str(error)
        self._close_after(str(error), now)
        return False

    def _close_after(self, fault: str, now: float) -> None:
        """Close the bus because of a fault at a time [s]; it is opened again later."""
        self._closed_by = fault
        self.backoff.failed(now)
        self.close()

    def open(self) -> None:
        if self._bus is None:
            self._bus = self._open_bus(self._number)

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        """Transfer messages; raises OSError like the bus itself."""
        if self._bus is None:
            raise OSError(errno.ENODEV, "the bus is closed")
        try:
            self._bus.i2c_rdwr(*messages)
        except OSError:
            self._failed = True
            raise
        self._answered = True

    def select(self, multiplexer: int, channel: int) -> None:
        """Connect only one channel, 0..7 [1], of one multiplexer.

        It is always written, since a brown-out may have reset the selection.
        """
        self.disconnect(but=multiplexer)
        if multiplexer:
            self.multiplexers[multiplexer].write_byte(1 << channel)

    def disconnect(self, but: int = 0) -> None:
        """Disconnect all channels of all multiplexers except one.

        An unplugged one has none. One that only does not answer may have a channel open: then a
        chip answers although all others are disconnected, and all clusters would be mixed with it.
        """
        silent: list[i2c.BusError] = []
        for address, multiplexer in self.multiplexers.items():
            try:
                if address != but:
                    multiplexer.write_byte(0)
            except i2c.BusError as error:
                if not but or isinstance(error, i2c.BusTimeoutError | i2c.BusGoneError):
                    raise
                silent.append(error)
        if silent and self._answers(but):
            raise silent[0]

    def _answers(self, multiplexer: int) -> bool:
        """Whether a chip answers with this multiplexer disconnected, too."""
        self.multiplexers[multiplexer].write_byte(0)
        for _ in range(_TRIES):
            with suppress(OSError):
                self.i2c_rdwr(i2c_msg.read(self._chip, 1))
                return True
        return False

    def close(self) -> None:
        """Close the bus, unless it is closed already."""
        self.configured.clear()
        bus, self._bus = self._bus, None
        if bus is not None:
            with suppress(OSError):
                bus.close()


@dataclass
class _Input:
    low: float  # last time it was known not to be done [s]
    settled: float = -math.inf  # conversions that may have ended earlier have the old range [s]
    since: float = -math.inf  # the value's conversion ended after this time [s]
    read: float = -math.inf  # time of the last read of a conversion [s]
    value: float = math.nan  # [pF]; NaN if out of range
    fault: str = ""


@dataclass
class _Cluster:
    """A chip and its place; its four inputs are read for each trigger.

    A conversion ended after the last time its input was known not to be done. This bound, not the
    time of the read, limits the age of a value, even if the chip has hung in between.
    """

    bus: _Bus
    place: tuple[int, int]  # address of its multiplexer (0: none) and channel
    chip: i2c.CapacitiveChip
    cycle: float  # [s]
    inputs: list[_Input] = field(default_factory=list)
    pending: set[int] = field(default_factory=set)  # inputs without a value for the current trigger
    trigger: float = -math.inf  # [s]
    begun: float = -math.inf  # start of the reading for it [s]
    fault: str = ""
    backoff: clocks.Backoff = field(default_factory=clocks.Backoff)

    @property
    def configured(self) -> bool:
        return self.place in self.bus.configured

    def begin(self, trigger: float) -> None:
        """Start reading the inputs for a trigger at a time of the steady clock [s]."""
        self.pending = set(range(i2c.INPUTS))
        self.trigger = trigger
        self.begun = clocks.monotonic()

    def advance(self) -> bool:
        """Poll the chip once; returns whether to poll it again."""
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
            if self.bus.handle_fault(error, self.chip.address, now):
                self.backoff.failed(now)
            return False
        self.fault = ""
        self.backoff.succeeded()
        self.bus.backoff.succeeded()
        return False

    def select(self) -> None:
        """Connect only this chip."""
        self.bus.open()
        self.bus.select(*self.place)

    def _configure(self) -> None:
        """Reset and configure the chip; drops all earlier values."""
        begun = clocks.monotonic()
        self.chip.reset_and_configure()
        self.inputs = [_Input(low=begun) for _ in range(i2c.INPUTS)]
        self.begun = clocks.monotonic()
        self.bus.configured.add(self.place)

    def _poll(self) -> bool:
        """Read finished conversions; returns whether inputs are still pending."""
        asked = clocks.monotonic()
        done = self.chip.done()
        codes = {n: self._read(n) for n in sorted(self.pending) if done[n]}
        for n in self.pending - codes.keys():
            self._await(n, asked)
        if codes:
            # A chip that loses its supply during the read returns zeros that look valid.
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
        """The code of an input [1], or None if it may be too old; cleared in either case."""
        entry = self.inputs[n]
        entry.since, entry.low = entry.low, clocks.monotonic()
        code = self.chip.read(n)
        entry.read = clocks.monotonic()
        if entry.since < max(self.trigger - _MAX_AGE * self.cycle, entry.settled):
            entry.since = -math.inf
            return None
        return code

    def _await(self, n: int, asked: float) -> None:
        entry = self.inputs[n]
        entry.low = asked
        # With triggers as fast as the cycle, waiting for the next conversion each time would make
        # the readings lag; the last conversion may be closer to this trigger.
        near = _REUSE_AGE * self.cycle
        is_recent = entry.since >= self.trigger - _MAX_AGE * self.cycle
        if asked >= self.trigger + near and entry.read >= self.trigger - near and is_recent:
            self.pending.discard(n)
        elif asked - max(self.begun, entry.read) > _CONVERSION_TIMEOUT * self.cycle:
            raise DeviceError(
                f"conversions of input {n + 1} do not finish at {self.chip.where}",
                "the chip is reset; if this recurs, check its supply",
            )


def check_settings(settings: ClusterSettings, chip: type[i2c.CapacitiveChip]) -> None:
    """Check that the settings fit together, beyond the range of each.

    Args:
        settings: Names and places of the clusters, their rate and the time to read them.
        chip: Driver of the clusters' chips, with their possible rates.

    Raises:
        ConfigurationError: The lists differ in length, the chip lacks the rate, `latest` is shorter
            than 1.25 cycles of the four inputs, a multiplexer's address is below 0x70, a cluster
            without a multiplexer shares a bus with one behind a multiplexer, or two clusters share
            a name or a place.
    """
    names, buses, channels = settings.names, settings.buses, settings.channels
    multiplexers = settings.each_multiplexer
    if not names or not len(names) == len(buses) == len(channels) == len(multiplexers):
        raise ConfigurationError(
            f"{len(names)} names, {len(buses)} buses, {len(channels)} channels and"
            f" {len(multiplexers)} multiplexers of clusters",
            "give one of each per cluster; multiplexers may be empty if all share one address",
        )
    if settings.sample_rate not in chip.sample_rates:
        raise ConfigurationError(
            f"sample_rate is {settings.sample_rate}",
            f"the {chip.name} supports {', '.join(map(str, chip.sample_rates))}",
        )
    least = _MIN_CYCLES * i2c.INPUTS / settings.sample_rate
    if settings.latest < least:
        raise ConfigurationError(
            f"latest is {settings.latest:g} s, shorter than a cycle of {i2c.INPUTS} conversions",
            f"set it to {least:g} s or more, or raise sample_rate",
        )
    at: dict[str, str] = {}
    alone = {bus for bus, address, _ in settings.places if not address}
    for name, (bus, address, channel) in zip(names, settings.places, strict=True):
        if address and address < 0x70:
            fact = f"multiplexer is 0x{address:02X}"
            raise ConfigurationError(fact, "give 0x70 to 0x77, or 0 for none")
        if address and bus in alone:  # the chips have one address: both would answer
            raise ConfigurationError(
                f"bus {bus} has a cluster without a multiplexer beside '{name}' behind one",
                "put it on a channel of the multiplexer, or on a bus of its own",
            )
        place = f"bus {bus}" + (f", channel {channel} of 0x{address:02X}" if address else "")
        if name in at.values() or place in at:
            raise ConfigurationError(
                f"the clusters '{at.get(place, name)}' and '{name}' share a name or {place}",
                "give each cluster its own name and place",
            )
        at[place] = name
