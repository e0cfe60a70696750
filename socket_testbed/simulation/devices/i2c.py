"""The clusters' I2C bus with its multiplexer and FDC1004 chips, register by register."""

from __future__ import annotations

import errno
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from operator import and_
from types import MappingProxyType

from smbus2 import i2c_msg

from socket_testbed import clocks
from socket_testbed.drivers.clusters.i2c import I2cBus, opening_failed

_CONF_MEAS, _FDC_CONF, _OFFSET, _GAIN = 0x08, 0x0C, 0x0D, 0x11
_IDENTITY = {0xFE: 0x5449, 0xFF: 0x1004}
_RESET, _REPEAT, _SETTABLE = 0x8000, 0x0100, 0x0DF0
_RATES = (0.0, 100.0, 200.0, 400.0)  # [1/s]
_CAPDAC, _NO_INPUT = 4, 7  # CHB
_CAPDAC_UNIT = 3.125  # [pF]
_HIGHEST, _LOWEST = 0x7FFFFF, -0x800000
_BROWN_OUT_PERIOD = 0.3  # [s]
_CHIP, _MULTIPLEXER = 0x50, 0x70
_BITS_PER_BYTE = 9
_LONGEST_CREDIT = 1e-3  # [s]
_READ = 0x0001  # flag of linux/i2c.h
_NO_FAULTS: Mapping[str, float] = MappingProxyType({})


class SimulatedFdc1004:
    """The chip; it converts as time passes, whether or not anyone reads it.

    The offset and gain registers are kept but have no effect.

    Args:
        capacitance: Capacitance of an input, 0..3, at a time of the clock [pF].
        clock: The steady clock [s].
        faults: The faults of `simulation.world`, looked up at each transfer.
        channel: Channel of the multiplexer, by which the faults name the chip [1].
        speed: Its oscillator's frequency over the nominal one [-].
    """

    def __init__(
        self,
        capacitance: Callable[[int, float], float],
        clock: Callable[[], float] = clocks.monotonic,
        faults: Mapping[str, float] = _NO_FAULTS,
        channel: int = 0,
        speed: float = 1.0,
    ) -> None:
        self._capacitance = capacitance
        self._clock = clock
        self._faults = faults
        self._channel = channel
        self._speed = speed
        self._stuck_before = False
        self._browned_out = -math.inf
        self._shift = 0
        self.power_up()

    def power_up(self) -> None:
        """Fall into the reset state, as a RST does."""
        self._pointer = 0
        self._kept = {_CONF_MEAS + n: 0x1C00 for n in range(4)}
        self._kept |= {_OFFSET + n: 0 for n in range(4)} | {_GAIN + n: 0x4000 for n in range(4)}
        self._conf = 0  # FDC_CONF without DONE
        self._done = [False] * 4
        self._codes = [0] * 4
        self._low = [0] * 4  # the LSB registers, held since the MSB was read
        self._high_was_read = [False] * 4
        self._shift = 0
        self._sequence: list[int] = []
        self._next = 0  # index in the sequence of the conversion under way
        self._settings = 0  # CONF_MEAS as it was when that one began
        self._end = math.inf  # when that one ends [s]

    def host_restarted(self) -> None:
        """The host opened its bus again, which can shift the chip's inputs by one."""
        if self._has("shifted"):
            self._shift = 1

    def write(self, data: bytes) -> None:
        """Take the bytes of a write.

        Raises:
            OSError: EREMOTEIO where the chip does not acknowledge.
        """
        self._live()
        register = data[0]
        known = register < _GAIN + 4 or register in _IDENTITY
        if not known or len(data) not in {1, 3}:
            raise _no_answer()
        self._pointer = register
        if len(data) == 1:
            return
        value = int.from_bytes(data[1:], "big")
        if register == _FDC_CONF:
            self._configure(value)
        elif register in self._kept:
            self._kept[register] = value
        else:
            raise _no_answer()  # read-only

    def read(self, length: int) -> bytes:
        """Answer with the register that the pointer is at, over and over.

        Raises:
            OSError: EREMOTEIO where the chip does not acknowledge.
        """
        self._live()
        value = self._value(self._pointer).to_bytes(2, "big")
        return (value * length)[:length]

    def _value(self, register: int) -> int:
        if register in _IDENTITY:
            return _IDENTITY[register]
        if register == _FDC_CONF:
            return self._conf | sum(8 >> n for n in range(4) if self._done[n])
        if register in self._kept:
            return self._kept[register]
        n = register // 2
        if register % 2 == 0:
            self._low[n] = (self._codes[n] & 0xFF) << 8
            self._high_was_read[n] = True
            return self._codes[n] >> 8 & 0xFFFF
        if self._high_was_read[n]:
            self._done[n] = self._high_was_read[n] = False
        return self._low[n]

    def _configure(self, value: int) -> None:
        if value & _RESET:
            self.power_up()
            return
        self._conf = value & _SETTABLE
        self._done = [False] * 4
        self._sequence = [n for n in range(4) if value & 0x80 >> n]
        # Without repeat, one measurement at a time is all that the chip can do.
        valid = bool(value & _REPEAT) or len(self._sequence) == 1
        if not valid or not self._sequence or not self._period:
            self._sequence, self._end = [], math.inf
            return
        self._next = 0
        self._start(0)
        self._end = self._clock() + self._period

    @property
    def _period(self) -> float:
        """Time of one conversion [s]; 0 for the reserved rate."""
        rate = _RATES[self._conf >> 10 & 3] * self._speed
        return 1.0 / rate if rate else 0.0

    def _live(self) -> None:
        """Catch up with the time and the faults since the last transfer."""
        now = self._clock()
        self._convert(now)
        stuck = self._has("stuck_done")
        if stuck and not self._stuck_before:
            self._sequence, self._end = [], math.inf  # with what is done left as it is
        self._stuck_before = stuck
        if self._has("brown_out") and now - self._browned_out >= _BROWN_OUT_PERIOD:
            self._browned_out = now
            self.power_up()
        if self._has("nack"):
            raise _no_answer()

    def _convert(self, now: float) -> None:
        if now < self._end:
            return
        # Rounds that nobody read leave no trace: only the last one is computed.
        behind = math.floor((now - self._end) / self._period) + 1
        skipped = max(0, behind - len(self._sequence)) if self._conf & _REPEAT else 0
        if skipped:
            self._end += skipped * self._period
            self._start(skipped)
        while now >= self._end:
            n = self._sequence[self._next]
            self._codes[n] = self._code(self._end)
            self._done[n] = True
            if not self._conf & _REPEAT:
                self._conf &= ~0x00F0
                self._sequence, self._end = [], math.inf
                return
            self._end += self._period
            self._start(1)

    def _start(self, further: int) -> None:
        """Begin a conversion so many further in the sequence."""
        self._next = (self._next + further) % len(self._sequence)
        self._settings = self._kept[_CONF_MEAS + self._sequence[self._next]]

    def _code(self, moment: float) -> int:
        if self._has("rail"):
            return _HIGHEST
        positive, negative = self._settings >> 13 & 7, self._settings >> 10 & 7
        difference = self._input(positive, moment)
        if negative == _CAPDAC:
            difference -= _CAPDAC_UNIT * (self._settings >> 5 & 0x1F)
        elif negative != _NO_INPUT:
            difference -= self._input(negative, moment)
        return min(max(round(difference * 2**19), _LOWEST), _HIGHEST)

    def _input(self, n: int, moment: float) -> float:
        return self._capacitance((n + self._shift) % 4, moment)

    def _has(self, fault: str) -> bool:
        return self._faults.get(f"clusters.{fault}", 0.0) == 1 + self._channel


def _no_answer() -> OSError:
    return OSError(errno.EREMOTEIO, "no acknowledgement (simulated)")


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
    """The bus as a host has it open, with the one method of `smbus2.SMBus` that drivers use.

    Opening it restarts the host, as the chips see it.

    Args:
        chips: The chip on each channel; without a multiplexer all are on the same wires.
        multiplexer: The multiplexer, or None.
        faults: The faults of `simulation.world`, looked up at each transfer.
        frequency: Clock of the bus [Hz]; None: transfers take no time.
        clock: The steady clock [s].
        sleep: Waits [s].
    """

    def __init__(
        self,
        chips: Sequence[SimulatedFdc1004],
        multiplexer: SimulatedTca9548a | None = None,
        faults: Mapping[str, float] = _NO_FAULTS,
        frequency: float | None = None,
        clock: Callable[[], float] = clocks.monotonic,
        sleep: Callable[[float], None] = clocks.sleep,
    ) -> None:
        self._chips = chips
        self._multiplexer = multiplexer
        self._faults = faults
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
                    message.buf[index] = bytes([reduce(and_, sent)])
            else:
                for part in self._addressed(message.addr):
                    part.write(bytes(message.buf[: message.len]))

    def close(self) -> None:
        """Close the bus: nothing goes over it any more."""
        self._is_gone = True

    def _addressed(self, address: int) -> Sequence[SimulatedTca9548a | SimulatedFdc1004]:
        found: Sequence[SimulatedTca9548a | SimulatedFdc1004] = ()
        if self._multiplexer is not None and address == _MULTIPLEXER:
            found = (self._multiplexer,)
        elif address == _CHIP:
            mask = 0xFF if self._multiplexer is None else self._multiplexer.mask
            found = [chip for n, chip in enumerate(self._chips) if mask >> n & 1]
        if not found:
            raise _no_answer()
        return found

    def _take_time(self, transferred: int) -> None:
        if self._frequency is None:
            return
        self._owed += transferred * _BITS_PER_BYTE / self._frequency
        if self._owed > 0.0:
            # A sleep is always too long: the next ones are shorter, so that the rate is right.
            before = self._clock()
            self._sleep(self._owed)
            self._owed = max(self._owed - (self._clock() - before), -_LONGEST_CREDIT)


class SimulatedClusterHardware:
    """Four chips on channels 0 to 3 of a multiplexer at 0x70 on bus 1.

    Args:
        capacitance: Capacitance by the chip's channel and its input, both 0..3, at a time
            of the clock [pF].
        faults: The faults of `simulation.world`, looked up at each transfer.
        frequency: Clock of the bus [Hz]; None: transfers take no time.
        clock: The steady clock [s].
        sleep: Waits [s].
        speeds: Frequency of each chip's oscillator over the nominal one [-].
    """

    def __init__(
        self,
        capacitance: Callable[[int, int, float], float],
        faults: Mapping[str, float],
        frequency: float | None = None,
        clock: Callable[[], float] = clocks.monotonic,
        sleep: Callable[[float], None] = clocks.sleep,
        speeds: Sequence[float] = (1.0, 1.0, 1.0, 1.0),
    ) -> None:
        self.multiplexer = SimulatedTca9548a()
        self.chips = [
            SimulatedFdc1004(partial(capacitance, n), clock, faults, n, speed)
            for n, speed in enumerate(speeds)
        ]
        self._faults = faults
        self._timing = frequency, clock, sleep

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
        return SimulatedI2cBus(self.chips, self.multiplexer, self._faults, *self._timing)


def _power_down(chips: Sequence[SimulatedFdc1004], multiplexer: SimulatedTca9548a | None) -> None:
    if multiplexer is not None:
        multiplexer.mask = 0
    for chip in chips:
        chip.power_up()
