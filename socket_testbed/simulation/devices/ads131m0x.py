"""The converter ADS131M06 or ADS131M08, register by register, with a load cell on it."""

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

ID, STATUS, MODE, CLOCK, GAIN1, GAIN2, CFG, LAST = 0x00, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x30
RESET_BIT, _ANSI_BIT, _WORD_LENGTH = 0x0400, 0x0800, 0x0300
_GAIN_CALIBRATION = 0x0C
_RESET, _LOCK, _UNLOCK = 0x0011, 0x0555, 0x0655
_RREG, _WREG = 0xA000, 0x6000
_WORD = 3  # [bytes]
_START_UP = 300  # modulator clocks
_FAST = 2  # conversions after a start that come from the fast filter
_FAST_ERROR = 0.01  # [V]; far more than the real one, so that nobody can take them for good
_WAITING = 2  # conversions that the FIFO holds


class AdcRegisters:
    """The registers of a converter of 6 or 8 channels, as after a reset until they are written."""

    def __init__(self, channels: int) -> None:
        self._channels = channels
        self.locked = False
        self._values = [0] * (LAST + 1)
        self._values[ID] = 0x2002 | channels << 8
        self._values[MODE] = 0x0510
        self._values[CLOCK] = {6: 0x7F0E, 8: 0xFF0E}[channels]
        self._values[CFG] = 0x0600
        for channel in range(channels):
            self._values[_GAIN_CALIBRATION + 5 * channel] = 0x8000

    @property
    def oversampling(self) -> int:
        """Oversampling ratio."""
        return 128 << (self._values[CLOCK] >> 2 & 7)

    @property
    def enabled(self) -> int:
        """The channels that are enabled, a bit each."""
        return self._values[CLOCK] >> 8 & (1 << self._channels) - 1

    def gain(self, channel: int) -> int:
        """Gain of a channel."""
        return 1 << (self._values[GAIN1 + channel // 4] >> 4 * (channel % 4) & 7)

    def status(self, ready: bool) -> int:
        """The STATUS register, while a conversion waits or not."""
        mode = self._values[MODE] & (_ANSI_BIT | RESET_BIT | _WORD_LENGTH)
        return self.locked << 15 | mode | (self.enabled if ready else 0)

    def read(self, address: int, ready: bool) -> int:
        """A register; 0 where there is none."""
        if address == STATUS:
            return self.status(ready)
        return self._values[address] if address <= LAST else 0

    def write(self, address: int, values: Sequence[int]) -> tuple[int, bool]:
        """Write registers from an address on; read-only ones stay as they are.

        Returns:
            How many were written, and whether that restarts the conversions.
        """
        before = self._values[CLOCK : GAIN2 + 1]
        written = 0
        for place, value in enumerate(values, start=address):
            if STATUS < place <= LAST:
                self._values[place] = self._kept(place, value)
                written += 1
        return written, self._values[CLOCK : GAIN2 + 1] != before

    def checksum(self, data: bytes) -> int:
        """CRC-16 of a frame, of the kind that MODE says."""
        return checksum(data, "ansi" if self._values[MODE] & _ANSI_BIT else "ccitt")

    def _kept(self, place: int, value: int) -> int:
        """The content of a register after a value was written to it."""
        old = self._values[place]
        if place == MODE:  # the reset bit can only be cleared; words stay of 24 bits
            changeable = 0xFFFF & ~(RESET_BIT | _WORD_LENGTH)
            return value & changeable | old & _WORD_LENGTH | old & value & RESET_BIT
        if place == CLOCK and self._channels == 6:
            return value & 0x3FFF | old & 0xC000
        return value


class SimulatedAds131m0x:
    """One converter: an `SpiDevice`, and an `EdgeLine` where its DRDY is wired.

    Args:
        volts: Called with a time of the steady clock [s] for the voltages at the inputs,
            shape (channels,) [V].
        channels: 6 (M06) or 8 (M08).
        clock_in: Clock of the converter [Hz].
    """

    def __init__(
        self,
        volts: Callable[[float], FloatArray],
        channels: int = 6,
        faults: Mapping[str, float] | None = None,
        clock: Callable[[], float] = clocks.monotonic,
        clock_in: float = 8.192e6,
        seed: int | None = None,
    ) -> None:
        self._volts = volts
        self._channels = channels
        self._faults = {} if faults is None else faults
        self._clock = clock
        self._modulator = clock_in / 2.0  # [Hz]
        self._rng = np.random.default_rng(seed)
        self._response: list[int] = []  # empty: STATUS, as it is when it is sent
        self._unplugged = False
        self._next_dip: float | None = None  # of the supply [s]
        self._edges_until = clock()
        self.is_wired = True  # DRDY to its line
        self._power_on(clock())

    def close(self) -> None:
        """The chip keeps running."""

    def edges(self, within: float) -> list[float]:
        """Falling edges of DRDY since the last call [s]; the reader never waits for one."""
        until = self._clock()
        first = self._began + _START_UP / self._modulator
        over = math.floor((until - first) / self._period + 1e-9)
        silent = self._fault("unplugged") or self._fault("frozen") or not self.is_wired
        found = [] if silent else [first + k * self._period for k in range(1, over + 1)]
        since, self._edges_until = self._edges_until, until
        return [edge for edge in found if since < edge <= until]

    def xfer2(self, data: list[int], /) -> list[int]:
        """Exchange one frame."""
        now = self._clock()
        if self._fault("unplugged"):
            self._unplugged = True
            return [0] * len(data)
        if self._unplugged:
            self._unplugged = False
            self._power_on(now)
        self._dip(now)
        self._convert(now)
        count = len(data) // _WORD
        words = unpack(">" + "Hx" * count, bytes(data[: _WORD * count]))
        complete = len(words) >= self._channels + 2
        answer = self._answer(len(data), complete)
        if len(data) % _WORD or not words:
            self._response = []
        elif words[0] == _RESET and not complete:
            self._response = [_RESET]  # which says that there was none
        else:
            self._execute(words, now)
        if self._rng.random() < self._fault("flipped_bits"):
            bit = int(self._rng.integers(8 * len(answer)))
            answer[bit // 8] ^= 1 << bit % 8
        return answer

    def _fault(self, name: str) -> float:
        return self._faults.get(f"load_cell.{name}", 0.0)

    def _power_on(self, now: float) -> None:
        self._registers = AdcRegisters(self._channels)
        self._response = []
        self._latest = [0] * self._channels
        self._start(now)

    def _start(self, now: float) -> None:
        """Restart the conversions at the rate and gain that are set."""
        self._began = now
        self._count = 0
        self._fifo: list[list[int]] = []
        self._period = self._registers.oversampling / self._modulator

    def _dip(self, now: float) -> None:
        every = self._fault("brown_out")
        if every <= 0.0:
            self._next_dip = None
        elif self._next_dip is None:
            self._next_dip = now + every
        elif now >= self._next_dip:
            self._next_dip = now + every
            self._power_on(now)

    def _convert(self, now: float) -> None:
        first = self._began + _START_UP / self._modulator
        over = math.floor((now - first) / self._period + 1e-9)
        if not self._fault("frozen"):
            while self._count < over and len(self._fifo) < _WAITING:
                self._count += 1
                self._fifo.append(self._conversion(first + self._count * self._period))
        self._count = max(self._count, over)  # the others are lost

    def _conversion(self, end: float) -> list[int]:
        """Codes of the conversion that ends at a time [s]."""
        if self._count <= _FAST:
            volts = self._volts(end - 0.5 * self._period) + _FAST_ERROR
        else:
            # Two points with the mean and the variance of the filter's impulse response: that
            # is exact for whatever bends no more than a cubic.
            mean, deviation = self._filter()
            volts = 0.5 * (
                self._volts(end - mean - deviation) + self._volts(end - mean + deviation)
            )
        rail = int(self._fault("rail")) - 1
        codes = []
        for channel, voltage in enumerate(volts.tolist()):
            code = round(voltage * self._registers.gain(channel) * 2**23 / 1.2)
            code = max(-0x800000, min(0x7FFFFF, code))
            codes.append(0x7FFFFF if channel == rail else code & 0xFFFFFF)
        return codes

    def _filter(self) -> tuple[float, float]:
        """Mean and deviation of the impulse response [s]: three boxes, then a mean of several."""
        inner = min(self._registers.oversampling, 1024)
        several = self._registers.oversampling // inner
        samples = 3.0 * (inner - 1) / 2.0 + inner * (several - 1) / 2.0
        variance = 3.0 * (inner**2 - 1) / 12.0 + inner**2 * (several**2 - 1) / 12.0
        return samples / self._modulator, math.sqrt(variance) / self._modulator

    def _answer(self, length: int, complete: bool) -> list[int]:
        response = self._response or [self._registers.status(bool(self._fifo))]
        words = [word << 8 for word in response]
        if len(response) == 1:
            if self._fifo:
                self._latest = self._fifo.pop(0) if complete else self._fifo[0]
            enabled = self._registers.enabled
            words += [code if enabled >> k & 1 else 0 for k, code in enumerate(self._latest)]
        answer = b"".join(word.to_bytes(_WORD, "big") for word in words)
        answer += self._registers.checksum(answer).to_bytes(2, "big") + b"\0"
        return list(answer[:length].ljust(length, b"\0"))

    def _execute(self, words: tuple[int, ...], now: float) -> None:
        command, self._response = words[0], []
        address, count = command >> 7 & 0x3F, (command & 0x7F) + 1
        if command & 0xE000 == _RREG:
            values = [self._registers.read(address + k, bool(self._fifo)) for k in range(count)]
            head = 0xE000 | command & 0x1FFF
            self._response = values if count == 1 else [head, *values]
        elif command == _UNLOCK:
            self._registers.locked, self._response = False, [command]
        elif self._registers.locked:
            return
        elif command & 0xE000 == _WREG:
            written, restarts = self._registers.write(address, words[1 : 1 + count])
            if restarts:
                self._start(now)
            self._response = [0x4000 | address << 7 | written - 1 & 0x7F]
        elif command == _RESET:
            self._power_on(now)
            self._response = [0xFF20 | self._channels]
        elif command == _LOCK:
            self._registers.locked, self._response = True, [command]


def simulated_load_cell(
    wrench: Callable[[float], FloatArray],
    settings: LoadCellSettings,
    faults: Mapping[str, float] | None = None,
    clock: Callable[[], float] = clocks.monotonic,
    seed: int | None = None,
) -> SimulatedAds131m0x:
    """The converter of a load cell, its bridges under a load.

    Args:
        wrench: Called with a time of the steady clock [s] for the load, [M; F], shape (6,)
            [N m, N].
        settings: How the bridges are wired, and their decoupling.
        faults: The faults of `simulation.world`, looked up at each frame.
        clock: The steady clock [s].
        seed: Seed of the flipped bits.
    """
    check_settings(settings)
    to_ratio = np.linalg.inv(np.array(settings.matrix).reshape(6, 6))
    per_bridge = np.array(settings.sign) * settings.excitation * settings.amplifier_gain
    to_volts = np.zeros((settings.channels, 6))  # of [M; F], by channel
    to_volts[list(settings.inputs)] = np.roll(1e-3 * per_bridge[:, None] * to_ratio, 3, axis=1)
    return SimulatedAds131m0x(
        lambda moment: to_volts @ wrench(moment),
        settings.channels, faults, clock, settings.clock_in, seed,
    )  # fmt: skip
