"""The clusters' I2C bus with its multiplexer and chips, for the unmodified drivers."""

from __future__ import annotations

import errno
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from smbus2 import i2c_msg

from socket_testbed.drivers.clusters.i2c import I2cBus, opening_failed
from socket_testbed.simulation.devices.fdc1004 import SimulatedFdc1004

_CHIP = 0x50
_BITS_PER_BYTE = 9
_LONGEST_CREDIT = 1e-3  # [s]
_READ = 0x0001  # flag of linux/i2c.h


class SimulatedTca9548a:
    """The multiplexer: a mask of the channels that are connected.

    Attributes:
        mask: Bit n connects channel n [1].
    """

    def __init__(self) -> None:
        self.mask = 0

    def write(self, data: bytes) -> None:
        """Take the mask, the last byte of a write."""
        self.mask = data[-1]

    def read(self, length: int) -> bytes:
        """Answer with the mask."""
        return bytes([self.mask]) * length


class SimulatedI2cBus:
    """The bus as a host has it open; what `smbus2.SMBus` does to messages, it does, too."""

    def __init__(
        self,
        chips: Sequence[SimulatedFdc1004],
        multiplexer: SimulatedTca9548a | None = None,
        address: int = 0x70,
        faults: Mapping[str, float] | None = None,
        frequency: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Open the bus, which restarts the host as far as the chips can tell.

        Args:
            chips: The chip on each channel; without a multiplexer all are on the same wires.
            multiplexer: The multiplexer, or None.
            address: Address of the multiplexer [1].
            faults: The faults of `simulation.devices.faults`, looked up at each transfer.
            frequency: Clock of the bus [Hz]; None: transfers take no time.
            clock: The steady clock [s].
            sleep: Waits [s].
        """
        self._chips = chips
        self._multiplexer = multiplexer
        self._address = address
        self._faults = {} if faults is None else faults
        self._frequency = frequency
        self._clock = clock
        self._sleep = sleep
        self._owed = 0.0  # time of the transfers that was not slept yet [s]
        self._is_gone = False
        for chip in chips:
            chip.host_restarted()

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        """Transfer messages with repeated starts between them.

        Raises:
            OSError: As the kernel does: ENODEV, ETIMEDOUT, EREMOTEIO.
        """
        if self._faults.get("clusters.unplugged", 0.0):
            self._is_gone = True
            _power_down(self._chips, self._multiplexer)
        if self._is_gone:
            raise OSError(errno.ENODEV, "the bus is gone (simulated)")
        hangs_for = self._faults.get("clusters.timeout", 0.0)
        if hangs_for:
            self._sleep(hangs_for)
            raise OSError(errno.ETIMEDOUT, "the bus hangs (simulated)")
        self._take_time(sum(1 + message.len for message in messages))
        for message in messages:
            if message.flags & _READ:
                # On open-drain wires whoever sends a zero wins.
                answers = [part.read(message.len) for part in self._addressed(message.addr)]
                for index, sent in enumerate(zip(*answers, strict=True)):
                    message.buf[index] = bytes([_wired_and(sent)])
            else:
                for part in self._addressed(message.addr):
                    part.write(bytes(message.buf[: message.len]))

    def close(self) -> None:
        """Close the bus: nothing goes over it any more."""
        self._is_gone = True

    def _addressed(self, address: int) -> Sequence[SimulatedTca9548a | SimulatedFdc1004]:
        found: Sequence[SimulatedTca9548a | SimulatedFdc1004] = ()
        if self._multiplexer is not None and address == self._address:
            found = (self._multiplexer,)
        elif address == _CHIP:
            mask = 0xFF if self._multiplexer is None else self._multiplexer.mask
            found = [chip for n, chip in enumerate(self._chips) if mask >> n & 1]
        if not found:
            raise OSError(errno.EREMOTEIO, "no acknowledgement (simulated)")
        return found

    def _take_time(self, transferred: int) -> None:
        if self._frequency is None:
            return
        self._owed += transferred * _BITS_PER_BYTE / self._frequency
        if self._owed > 0.0:
            # A sleep is always too long; the next ones are shorter, so that the rate is right.
            before = self._clock()
            self._sleep(self._owed)
            self._owed = max(self._owed - (self._clock() - before), -_LONGEST_CREDIT)


class SimulatedClusterHardware:
    """Four chips on channels 0 to 3 of a multiplexer at 0x70 on bus 1."""

    def __init__(
        self,
        capacitance: Callable[[int, int, float], float],
        faults: Mapping[str, float],
        frequency: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        speeds: Sequence[float] = (1.0, 1.0, 1.0, 1.0),
    ) -> None:
        """Power the array up.

        Args:
            capacitance: Capacitance by the chip's channel and its input, both 0..3, at a time
                of the clock [pF].
            faults: The faults of `simulation.devices.faults`, looked up at each transfer.
            frequency: Clock of the bus [Hz]; None: transfers take no time.
            clock: The steady clock [s].
            sleep: Waits [s].
            speeds: Frequency of each chip's oscillator over the nominal one [-].
        """
        self.multiplexer = SimulatedTca9548a()
        self.chips = [
            SimulatedFdc1004(partial(capacitance, n), clock, faults, n, speed)
            for n, speed in enumerate(speeds)
        ]
        self._faults = faults
        self._frequency = frequency
        self._clock = clock
        self._sleep = sleep

    def open_bus(self, number: int) -> I2cBus:
        """Open a bus by its number [1]; chips that were unplugged come back reset.

        Raises:
            DeviceError: As for hardware, if there is no such bus at present.
        """
        unplugged = bool(self._faults.get("clusters.unplugged", 0.0))
        if unplugged:
            _power_down(self.chips, self.multiplexer)
        if unplugged or number != 1:
            raise opening_failed(number, FileNotFoundError(errno.ENOENT, "simulated"))
        return SimulatedI2cBus(
            self.chips,
            self.multiplexer,
            faults=self._faults,
            frequency=self._frequency,
            clock=self._clock,
            sleep=self._sleep,
        )


def _power_down(chips: Sequence[SimulatedFdc1004], multiplexer: SimulatedTca9548a | None) -> None:
    if multiplexer is not None:
        multiplexer.mask = 0
    for chip in chips:
        chip.power_up()


def _wired_and(sent: tuple[int, ...]) -> int:
    value = 0xFF
    for byte in sent:
        value &= byte
    return value
