"""Register-level simulation of the ADS131M06 and ADS131M08 with a load cell."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from struct import unpack

import numpy as np

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray
from socket_testbed.drivers.load_cell.ads131m0x import checksum
from socket_testbed.drivers.load_cell.load_cell import check_settings
from socket_testbed.settings.acquisition import LoadCellSettings
from socket_testbed.simulation.devices.failed_transfer import FailedTransfer, next_failure

_ID, _STATUS, _MODE, _CLOCK, _GAIN1, _GAIN2 = range(6)  # those with an effect
_RESET_BIT, _ANSI_BIT, _WORD_LENGTH = 0x0400, 0x0800, 0x0300
_RESET, _LOCK, _UNLOCK = 0x0011, 0x0555, 0x0655
_RREG, _WREG = 0xA000, 0x6000
_WORD = 3  # [bytes]
_START_UP = 300  # modulator clocks
_FAST = 2  # conversions from the fast filter after a start
_FAST_ERROR = 0.01  # [V]; exaggerated, so that using them is noticed
_FIFO_SIZE = 2  # conversions
_MAX_TRANSFER = 4096  # [bytes]; of spidev


class SimulatedAds131m0x:
    """One converter: an `SpiDevice`, and an `EdgeLine` if its DRDY is wired.

    Args:
        volts: Gives the voltages at its inputs, shape (channels,) [V], at a time of the steady
            clock [s].
        channels: Number of channels: 6 (M06) or 8 (M08).
        faults: Faults of `simulation.world`, read at each frame; None for none.
        clock_in: Its clock [Hz].
        seed: Seed of the flipped bits; None for a random one.
        noise: Gives the noise of one conversion, added to `volts`, a number or shape (channels,)
            [V].

    Attributes:
        is_wired: Whether DRDY is connected; without it there are no edges.
        failing: Single frames that fail, in their order; each is removed when it has failed.
    """

    def __init__(
        self,
        volts: Callable[[float], FloatArray],
        channels: int = 6,
        faults: Mapping[str, float] | None = None,
        clock_in: float = 8.192e6,
        seed: int | None = None,
        noise: Callable[[], FloatArray | float] = lambda: 0.0,
    ) -> None:
        self._volts = volts
        self._noise = noise
        self._channels = channels
        self._faults = {} if faults is None else faults
        self._modulator = clock_in / 2.0  # [Hz]
        self._rng = np.random.default_rng(seed)
        self._unplugged = False
        self._edges_until = self._supplied_since = now = clocks.monotonic()
        self.is_wired = True
        self.failing: list[FailedTransfer] = []
        self._power_on(now)

    def _power_on(self, now: float) -> None:
        """Enter the reset state."""
        self._locked = False
        self._response: list[int] = []  # empty: STATUS at the time of sending
        self._latest = [0] * self._channels  # codes
        self._registers = [0] * (_GAIN2 + 1)
        self._registers[_ID] = 0x2002 | self._channels << 8
        self._registers[_MODE] = 0x0510
        self._registers[_CLOCK] = {6: 0x7F0E, 8: 0xFF0E}[self._channels]
        self._start(now)

    def _start(self, now: float) -> None:
        """Restart the conversions with the current rate and gain."""
        self._count = 0
        self._fifo: list[list[int]] = []
        oversampling = 128 << (self._registers[_CLOCK] >> 2 & 7)
        self._period = oversampling / self._modulator  # [s]
        self._first = now + _START_UP / self._modulator  # start of the first conversion [s]
        # Impulse response of the filter: three boxes, then a mean of several outputs [s].
        inner = min(oversampling, 1024)
        several = oversampling // inner
        samples = 3.0 * (inner - 1) / 2.0 + inner * (several - 1) / 2.0
        variance = 3.0 * (inner**2 - 1) / 12.0 + inner**2 * (several**2 - 1) / 12.0
        self._mean = samples / self._modulator
        self._deviation = math.sqrt(variance) / self._modulator

    def close(self) -> None:
        """Do nothing: the chip keeps running."""

    def edges(self, within: float) -> list[float]:
        """Falling edges of DRDY since the last call on the steady clock [s].

        Unlike a real line it never waits, whatever `within` [s] is.
        """
        until = clocks.monotonic()
        silent = self._fault("unplugged") or self._fault("frozen") or not self.is_wired
        ended = 0 if silent else self._finished(until)
        found = [self._first + k * self._period for k in range(1, ended + 1)]
        since, self._edges_until = self._edges_until, until
        return [edge for edge in found if since < edge <= until]

    def xfer2(self, data: list[int], /) -> list[int]:
        """Exchange the bytes, 0..255 each, of one frame.

        It sends the response to the command before, a word per channel and the checksum, and
        receives a command. Words have three bytes.

        Raises:
            TypeError: The bytes are not ints, or there are none, as in spidev.
            ValueError: A byte is not in 0..255, which spidev would cut.
            OverflowError: There are more bytes than spidev transfers.
            OSError: This frame fails.
        """
        _check_bytes(data)
        failed = next_failure(self.failing)
        if failed is not None and not failed.executed:
            raise failed.error()
        answer = self._exchange(data)
        if failed is not None:
            raise failed.error()
        return answer

    def _exchange(self, data: list[int]) -> list[int]:
        now = clocks.monotonic()
        if self._fault("unplugged"):
            self._unplugged = True
            return [0] * len(data)
        if self._unplugged:
            self._unplugged = False
            self._power_on(now)
        self._brown_out(now)
        self._convert(now)
        answer = self._answer(len(data))
        self._execute(unpack(">" + "Hx" * (len(data) // _WORD), bytes(data)), now)
        if self._rng.random() < self._fault("flipped_bits"):
            bit = int(self._rng.integers(8 * len(answer)))
            answer[bit // 8] ^= 1 << bit % 8
        return answer

    def _fault(self, name: str) -> float:
        return self._faults.get(f"load_cell.{name}", 0.0)

    def _brown_out(self, now: float) -> None:
        every = self._fault("brown_out")
        if every <= 0.0:
            self._supplied_since = now
        elif now - self._supplied_since >= every:
            self._supplied_since = now
            self._power_on(now)

    def _finished(self, now: float) -> int:
        """Number of conversions finished since the start."""
        return math.floor((now - self._first) / self._period + 1e-9)

    def _convert(self, now: float) -> None:
        ended = self._finished(now)
        if not self._fault("frozen"):
            while self._count < ended and len(self._fifo) < _FIFO_SIZE:
                self._count += 1
                self._fifo.append(self._conversion(self._first + self._count * self._period))
        self._count = max(self._count, ended)  # further conversions are lost

    def _conversion(self, end: float) -> list[int]:
        """Codes of the conversion that ends at a time [s]."""
        if self._count <= _FAST:
            volts = self._volts(end - 0.5 * self._period) + _FAST_ERROR
        else:
            # Two points with the mean and variance of the filter's impulse response: exact up to
            # cubic signals.
            middle, deviation = end - self._mean, self._deviation
            volts = 0.5 * (self._volts(middle - deviation) + self._volts(middle + deviation))
        volts = volts + self._noise()
        rail = int(self._fault("rail")) - 1
        codes = []
        for channel, voltage in enumerate(volts.tolist()):
            gain = 1 << (self._registers[_GAIN1 + channel // 4] >> 4 * (channel % 4) & 7)
            code = max(-0x800000, min(0x7FFFFF, round(voltage * gain * 2**23 / 1.2)))
            codes.append(0x7FFFFF if channel == rail else code & 0xFFFFFF)
        return codes

    @property
    def _enabled(self) -> int:
        """Enabled channels, one bit each."""
        return self._registers[_CLOCK] >> 8 & (1 << self._channels) - 1

    def _answer(self, length: int) -> list[int]:
        response = self._response or [self._read(_STATUS)]
        words = [word << 8 for word in response]
        if len(response) == 1:
            if self._fifo:
                self._latest = self._fifo.pop(0)
            enabled = self._enabled
            words += [code if enabled >> k & 1 else 0 for k, code in enumerate(self._latest)]
        answer = b"".join(word.to_bytes(_WORD, "big") for word in words)
        kind = "ansi" if self._registers[_MODE] & _ANSI_BIT else "ccitt"
        answer += checksum(answer, kind).to_bytes(2, "big") + b"\0"
        return list(answer[:length].ljust(length, b"\0"))

    def _execute(self, words: tuple[int, ...], now: float) -> None:
        command, self._response = words[0], []
        address, count = command >> 7 & 0x3F, (command & 0x7F) + 1
        if command & 0xE000 == _RREG:
            values = [self._read(address + k) for k in range(count)]
            head = 0xE000 | command & 0x1FFF
            self._response = values if count == 1 else [head, *values]
        elif command == _UNLOCK:
            self._locked, self._response = False, [command]
        elif self._locked:
            return
        elif command & 0xE000 == _WREG:
            written = self._write(address, words[1 : 1 + count], now)
            self._response = [0x4000 | address << 7 | written - 1 & 0x7F]
        elif command == _RESET:
            self._power_on(now)
            self._response = [0xFF20 | self._channels]
        elif command == _LOCK:
            self._locked, self._response = True, [command]

    def _read(self, address: int) -> int:
        """A register; 0 if it does not exist."""
        if address == _STATUS:
            mode = self._registers[_MODE] & (_ANSI_BIT | _RESET_BIT | _WORD_LENGTH)
            return self._locked << 15 | mode | (self._enabled if self._fifo else 0)
        return self._registers[address] if address <= _GAIN2 else 0

    def _write(self, address: int, values: Sequence[int], now: float) -> int:
        """Write registers from an address on, except read-only ones; returns their number."""
        before = self._registers[_CLOCK:]
        places = range(max(address, _MODE), min(address + len(values), _GAIN2 + 1))
        for place in places:
            self._registers[place] = self._written(place, values[place - address])
        if self._registers[_CLOCK:] != before:
            self._start(now)
        return len(places)

    def _written(self, place: int, value: int) -> int:
        """Content of a register after writing a value to it."""
        old = self._registers[place]
        if place == _MODE:  # the reset bit can only be cleared; words stay at 24 bits
            changeable = 0xFFFF & ~(_RESET_BIT | _WORD_LENGTH)
            return value & changeable | old & _WORD_LENGTH | old & value & _RESET_BIT
        if place == _CLOCK and self._channels == 6:
            return value & 0x3FFF | old & 0xC000
        return value


def _check_bytes(data: Sequence[object]) -> None:
    """Refuse what spidev would refuse before anything is on the wire."""
    for value in data:
        if not isinstance(value, int):  # nor numpy's integers
            raise TypeError(f"Non-Int/Long value in arguments: {value!r}")
        if not 0 <= value <= 0xFF:
            raise ValueError(f"{value} is no byte")
    if not data:
        raise TypeError("Empty argument list.")
    if len(data) > _MAX_TRANSFER:
        raise OverflowError(f"Argument list size exceeds {_MAX_TRANSFER} bytes.")


def simulated_load_cell(
    wrench: Callable[[float], FloatArray],
    settings: LoadCellSettings,
    faults: Mapping[str, float] | None = None,
    seed: int | None = None,
    noise: Callable[[], FloatArray] = lambda: np.zeros(6),
) -> SimulatedAds131m0x:
    """The converter of a load cell under a load.

    Wrong settings raise a `ConfigurationError`.

    Args:
        wrench: Gives the load [M; F] in {S} at a time of the steady clock [s], shape (6,) [N m, N].
        settings: The load cell's matrix, signs and excitation, its amplifiers and its converter.
        faults: Faults of `simulation.world`, read at each frame; None for none.
        seed: Seed of the flipped bits; None for a random one.
        noise: Gives the noise of the load [M; F] in one conversion, shape (6,) [N m, N].
    """
    check_settings(settings)
    # Apart from the driver's `Bridges`, whose inverse would hide its errors of sign and order.
    to_ratio = np.linalg.inv(np.array(settings.matrix).reshape(6, 6))
    per_bridge = np.array(settings.sign) * settings.excitation * settings.amplifier_gain
    to_volts = np.zeros((settings.channels, 6))  # of [M; F], by channel
    to_volts[list(settings.inputs)] = np.roll(1e-3 * per_bridge[:, None] * to_ratio, 3, axis=1)
    return SimulatedAds131m0x(
        lambda moment: to_volts @ wrench(moment),
        settings.channels, faults, settings.clock_in, seed,
        lambda: to_volts @ noise(),
    )  # fmt: skip
