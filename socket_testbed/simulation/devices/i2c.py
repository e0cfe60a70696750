"""The clusters' I2C bus with its multiplexers, chips and faults."""

from __future__ import annotations

import errno
import math
import os
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from ctypes import memmove
from functools import partial, reduce
from operator import and_
from types import MappingProxyType
from typing import TypeAlias

from smbus2 import i2c_msg

from socket_testbed import clocks
from socket_testbed.drivers import DeviceBusyError
from socket_testbed.drivers.clusters.i2c import I2cBus, bus_opening_failed
from socket_testbed.settings.acquisition import ClusterSettings
from socket_testbed.simulation.devices.failed_transfer import FailedTransfer, next_failure

_BROWN_OUT_PERIOD = 0.3  # [s]
_BEYOND = 1e3  # [pF]; out of range of every chip
_BITS_PER_BYTE = 9
_FREQUENCY = 400e3  # [Hz]; of the bus
_MIN_SLEEP = 5e-4  # [s]; shorter times are carried over to later transfers
_MAX_CREDIT = 1e-3  # [s]
_READ = 0x0001  # flag of linux/i2c.h
_MAX_MESSAGES, _MAX_LENGTH = 42, 8192  # of a transfer, and of a message [bytes]; linux/i2c-dev.h


def no_answer() -> OSError:
    """The error for a transfer without acknowledgement, EREMOTEIO."""
    return OSError(errno.EREMOTEIO, "no acknowledgement (simulated)")


class SimulatedChip:
    """A cluster's chip, possibly behind a multiplexer, with the faults that apply to it.

    Subclasses simulate a chip without faults: they define `address`, `write` and `read`, which
    raise `no_answer` if the chip does not acknowledge, `power_up` and `stop`.

    Args:
        capacitance: Gives the capacitance [pF] of an input, 0..3, at a time of the steady clock
            [s].
        faults: Faults of `simulation.world`, read at each transfer.
        number: Number of the cluster in these faults, from 1.
        speed: Speed of the chip's oscillator relative to the nominal one [-].

    Attributes:
        address: Its address on the bus, 7 bits.
    """

    address = 0

    def __init__(
        self,
        capacitance: Callable[[int, float], float],
        faults: Mapping[str, float] = MappingProxyType({}),
        number: int = 1,
        speed: float = 1.0,
    ) -> None:
        self._capacitance = capacitance
        self._faults = faults
        self._number = number
        self._speed = speed
        self._stuck = False
        self._browned_out = -math.inf
        self.power_up()

    def power_up(self) -> None:
        """Enter the reset state, as after a reset command."""
        self._shift = 0  # of the inputs

    def stop(self) -> None:
        """Stop converting until reset; finished conversions stay."""

    def write(self, data: bytes) -> None:
        """Handle the bytes of a write."""

    def read(self, length: int) -> bytes:
        """Answer a read with a number of bytes."""
        return bytes(length)

    def input(self, n: int, moment: float) -> float:
        """Capacitance at an input [pF]; 1000 pF, out of every range, if it is at a rail.

        Args:
            n: The input, 0..3.
            moment: Time on the steady clock [s].
        """
        return _BEYOND if self._has("rail") else self._capacitance((n + self._shift) % 4, moment)

    def host_restarted(self) -> None:
        """Handle a reopened bus, which can shift the chip's inputs by one."""
        if self._has("shifted"):
            self._shift = 1

    def parts_at(self, address: int) -> list[Part]:
        """The chip itself if the address matches, otherwise nothing; applies the active faults."""
        if address != self.address:
            return []
        was_stuck, self._stuck = self._stuck, self._has("stuck_done")
        if self._stuck and not was_stuck:
            self.stop()
        now = clocks.monotonic()
        if self._has("brown_out") and now - self._browned_out >= _BROWN_OUT_PERIOD:
            self._browned_out = now
            self.power_up()
        if self._has("nack"):
            raise no_answer()
        return [self]

    def _has(self, fault: str) -> bool:
        return self._faults.get(f"clusters.{fault}", 0.0) == self._number


class SimulatedTca9548a:
    """A multiplexer: a mask of the channels that are connected.

    Attributes:
        address: Its address on the bus, 0x70 to 0x77.
        mask: Connected channels: bit n for channel n.
        chips: The chip behind each channel, by the channel, 0..7.
    """

    def __init__(self, address: int = 0x70) -> None:
        self.address = address
        self.mask = 0
        self.chips: dict[int, SimulatedChip] = {}

    def power_up(self) -> None:
        """Disconnect all channels; the chips lose power as well."""
        self.mask = 0
        for chip in self.chips.values():
            chip.power_up()

    def host_restarted(self) -> None:
        """Pass a reopened bus on to the chips."""
        for chip in self.chips.values():
            chip.host_restarted()

    def parts_at(self, address: int) -> list[Part]:
        """Chips behind connected channels that match an address, and the multiplexer."""
        reached: list[Part] = [self] if address == self.address else []
        for channel, chip in self.chips.items():
            if self.mask >> channel & 1:
                reached += chip.parts_at(address)
        return reached

    def write(self, data: bytes) -> None:
        """Set the mask to the last byte of a write."""
        self.mask = data[-1]

    def read(self, length: int) -> bytes:
        """Answer a read with a number of bytes, the mask each."""
        return bytes([self.mask]) * length


Part: TypeAlias = SimulatedTca9548a | SimulatedChip


class SimulatedI2cBus:
    """An open bus with its multiplexers and chips.

    Opening it looks like a restart of the host to the chips.

    Args:
        parts: What is on the bus itself: multiplexers, and chips without one.
        faults: Faults of `simulation.world`, read at each transfer.
        failing: Single transfers that fail, in their order; each is removed when it has failed.

    Attributes:
        is_open: Whether it has not been closed; the kernel gives an unplugged adapter back only
            when every open file of it is closed.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        faults: Mapping[str, float] = MappingProxyType({}),
        failing: list[FailedTransfer] | None = None,
    ) -> None:
        self.is_open = True
        self._parts = parts
        self._faults = faults
        self._failing = [] if failing is None else failing
        self._owed = 0.0  # transfer time not yet slept [s]
        self._gone = 0  # errno of every transfer from now on
        for part in parts:
            part.host_restarted()

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        """Transfer messages with repeated starts between them; fills the buffers of reads.

        Raises:
            TypeError: An argument is no message, as in smbus2.
            OSError: The messages are not a transfer (EINVAL), no chip acknowledges (EREMOTEIO), the
                bus hangs (ETIMEDOUT), is gone (ENODEV, or the errno of the fault) or is closed
                (EBADF), or this transfer fails.
        """
        _check_transfer(messages)
        if not self.is_open:
            raise OSError(errno.EBADF, "the bus is closed (simulated)")
        if unplugged := self._faults.get("clusters.unplugged", 0.0):
            self._gone = unplugged_errno(unplugged)
            for part in self._parts:
                part.power_up()
        if self._gone:
            raise OSError(self._gone, "the bus is gone (simulated)")
        hangs_for = self._faults.get("clusters.timeout", 0.0)
        if hangs_for:
            clocks.sleep(hangs_for)
            raise OSError(errno.ETIMEDOUT, "the bus hangs (simulated)")
        failed = next_failure(self._failing)
        if failed is not None and not failed.executed:
            raise failed.error()
        self._take_time(sum(1 + message.len for message in messages))
        self._carry_out(messages)
        if failed is not None:
            raise failed.error()

    @property
    def is_gone(self) -> bool:
        """Whether its adapter was unplugged since it was opened."""
        return bool(self._gone)

    def _carry_out(self, messages: Sequence[i2c_msg]) -> None:
        parts: list[Part] = []
        reached = None  # their address
        for message in messages:
            if message.addr != reached:
                reached = message.addr
                parts = [part for each in self._parts for part in each.parts_at(reached)]
            if not parts:
                raise no_answer()
            length = message.len
            if message.flags & _READ:
                sent = [int.from_bytes(part.read(length)) for part in parts]
                # On open-drain wires, zeros win.
                memmove(message.buf, reduce(and_, sent).to_bytes(length), length)
            else:
                for part in parts:
                    part.write(message.buf[:length])

    def close(self) -> None:
        """Close the bus: further transfers fail."""
        self.is_open = False

    def _take_time(self, transferred: int) -> None:
        self._owed += transferred * _BITS_PER_BYTE / _FREQUENCY
        if self._owed >= _MIN_SLEEP:
            # Sleeps are always too long: shorten the next ones to keep the average rate.
            before = clocks.monotonic()
            clocks.sleep(self._owed)
            self._owed = max(self._owed - (clocks.monotonic() - before), -_MAX_CREDIT)


def unplugged_errno(value: float) -> int:
    """The errno that the fault `clusters.unplugged` stands for; 1 is the kernel's usual ENODEV."""
    return errno.ENODEV if value == 1.0 else int(value)


def _check_transfer(messages: Sequence[object]) -> None:
    """Refuse what smbus2 or the kernel would refuse before anything is on the wire."""
    for message in messages:
        if not isinstance(message, i2c_msg):
            raise TypeError(f"expected i2c_msg instance, got {type(message).__name__}")
        if message.len > _MAX_LENGTH:
            raise OSError(errno.EINVAL, f"a message of {message.len} bytes (simulated)")
    if not 1 <= len(messages) <= _MAX_MESSAGES:
        raise OSError(errno.EINVAL, f"a transfer of {len(messages)} messages (simulated)")


class SimulatedClusterHardware:
    """The chips of all clusters in the places given by the settings.

    Args:
        settings: Bus, multiplexer and channel of each cluster.
        chip: The simulated chip.
        capacitance: Gives a capacitance [pF] from the cluster's index in the settings, from 0, its
            input, 0..3, and a time of the steady clock [s].
        faults: Faults of `simulation.world`, read at each transfer.
        speeds: Speed of each chip's oscillator relative to the nominal one [-]; empty for nominal
            speed.

    Attributes:
        multiplexers: The multiplexers by number of the bus and address.
        failing: Single transfers that fail, by number of the bus, in their order; a list that
            tests fill.
        is_locked: Whether the buses are locked by who opens them, as the drivers lock the device
            files; without it, two readers may use one bus.
    """

    def __init__(
        self,
        settings: ClusterSettings,
        chip: type[SimulatedChip],
        capacitance: Callable[[int, int, float], float],
        faults: Mapping[str, float],
        speeds: Sequence[float] = (),
    ) -> None:
        self.multiplexers: dict[tuple[int, int], SimulatedTca9548a] = {}
        self._buses: dict[int, list[Part]] = defaultdict(list)
        for n, (bus, address, channel) in enumerate(settings.places):
            speed = speeds[n] if speeds else 1.0
            made = chip(partial(capacitance, n), faults, 1 + n, speed)
            if not address:
                self._buses[bus].append(made)
                continue
            if (bus, address) not in self.multiplexers:
                self.multiplexers[bus, address] = SimulatedTca9548a(address)
                self._buses[bus].append(self.multiplexers[bus, address])
            self.multiplexers[bus, address].chips[channel] = made
        self.failing: dict[int, list[FailedTransfer]] = defaultdict(list)
        self.is_locked = True
        self._faults = faults
        self._opened: dict[int, list[SimulatedI2cBus]] = defaultdict(list)

    def open_bus(self, number: int) -> I2cBus:
        """Open a bus by its number; unplugged chips come back reset.

        Raises:
            TypeError: The number is no int, as in smbus2.
            DeviceError: The bus is unplugged, was not closed since, or has no chips: it is missing.
            DeviceBusyError: It is open and locked.
        """
        if not isinstance(number, int):
            raise TypeError(f"Unexpected type(bus)={type(number)}")
        parts = self._buses.get(number, [])
        if unplugged := self._faults.get("clusters.unplugged", 0.0):
            for part in parts:
                part.power_up()
        opened = self._opened[number] = [bus for bus in self._opened[number] if bus.is_open]
        if unplugged or not parts or any(bus.is_gone for bus in opened):
            raise bus_opening_failed(number, FileNotFoundError(errno.ENOENT, "simulated"))
        if opened and self.is_locked:
            raise DeviceBusyError(f"i2c-{number}", f"process {os.getpid()}, simulated")
        opened.append(SimulatedI2cBus(parts, self._faults, self.failing[number]))
        return opened[-1]
