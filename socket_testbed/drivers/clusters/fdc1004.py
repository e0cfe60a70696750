"""TI FDC1004: four capacitances by one converter (datasheet SNOSCY5B), read for each trigger."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.drivers.clusters.i2c import I2cPort
from socket_testbed.errors import DeviceError
from socket_testbed.samples import Status

ADDRESS = 0x50  # fixed
INPUTS = 4

_MSB, _LSB, _CONF_MEAS, _FDC_CONF = 0x00, 0x01, 0x08, 0x0C
_IDENTITY = {0xFE: ("maker", 0x5449), 0xFF: ("device", 0x1004)}
_RESET = 0x8000
_REPEAT_ALL = 0x01F0
_DONE = 0x000F
_RATES = {100: 1, 200: 2, 400: 3}  # [1/s] to the RATE bits
_TO_CAPDAC = 4  # CHB; the offset acts with no other
_LAST_CAPDAC = 31
_RAILS = (0x7FFFFF, -0x800000)
_PER_PICOFARAD = 2**19  # [1/pF]
_CAPDAC_UNIT = 3.125  # [pF]
_CAPDAC_STEP = 8  # 25 pF: two neighbouring ranges of 30 pF overlap
_RESET_POLLS = 10
_RESET_POLL = 1e-3  # [s]


class ChipResetError(DeviceError):
    """The chip fell back to its reset state."""


class WrongChipError(DeviceError):
    """Another chip answers."""


class Fdc1004:
    """The converter in repeat mode, four single-ended inputs.

    Attributes:
        where: Where it is wired, for messages.
        capdac: Offset of each input in steps of 3.125 pF, 0..31 [1]; a reset keeps them.
    """

    def __init__(self, port: I2cPort, sleep: Callable[[float], None] = clocks.sleep) -> None:
        self._port = port
        self._sleep = sleep
        self._conf = 0
        self.where = port.where
        self.capdac = [0] * INPUTS

    def check_identity(self) -> None:
        """Check that this is an FDC1004.

        Raises:
            WrongChipError: If its identity is another.
            BusError: If a transfer failed.
        """
        for register, (what, expected) in _IDENTITY.items():
            value = self._port.read(register)
            if value != expected:
                raise WrongChipError(
                    f"{self.where} says {what} 0x{value:04X}, not 0x{expected:04X}",
                    "check the address and the wiring: this is not an FDC1004",
                )

    def reset_and_configure(self, sample_rate: int) -> None:
        """Reset the chip, check what it is, and let it convert all inputs in turn.

        Args:
            sample_rate: Conversions, shared by the inputs: 100, 200 or 400 [1/s].

        Raises:
            DeviceError: If it does not answer or does not take its settings.
        """
        self._port.write(_FDC_CONF, _RESET)
        for _ in range(_RESET_POLLS):
            self._sleep(_RESET_POLL)
            if not self._port.read(_FDC_CONF) & _RESET:
                break
        else:
            raise DeviceError(f"{self.where} does not leave its reset", "check its supply")
        self.check_identity()
        wanted = {_CONF_MEAS + n: self._conf_meas(n) for n in range(INPUTS)}
        wanted[_FDC_CONF] = self._conf = _RATES[sample_rate] << 10 | _REPEAT_ALL
        for register, value in wanted.items():
            self._port.write(register, value)
        for register, value in wanted.items():
            kept = self._port.read(register) & ~(_DONE if register == _FDC_CONF else 0)
            if kept != value:
                raise DeviceError(
                    f"{self.where} holds 0x{kept:04X} in register 0x{register:02X} where"
                    f" 0x{value:04X} was written",
                    "check the bus's wiring and its pull-ups",
                )

    def done(self) -> tuple[bool, ...]:
        """Whether each input was converted since it was last read, shape (4,).

        Raises:
            ChipResetError: If the chip has lost its settings.
            BusError: If the transfer failed.
        """
        value = self._port.read(_FDC_CONF)
        if value & ~_DONE != self._conf:
            raise ChipResetError(
                f"{self.where} fell back to its reset state (FDC_CONF 0x{value:04X}, not"
                f" 0x{self._conf:04X})",
                "it is configured again; check its supply",
            )
        return tuple(bool(value & 8 >> n) for n in range(INPUTS))

    def read(self, channel: int) -> int:
        """Read the last conversion of an input, a signed code of 24 bits [1]; clears its DONE.

        Raises:
            BusError: If a transfer failed.
        """
        high = self._port.read(2 * channel + _MSB)  # first: it holds the other one still
        low = self._port.read(2 * channel + _LSB)
        code = high << 8 | low >> 8
        return code - (1 << 24) if code & 0x800000 else code

    def step_capdac(self, channel: int, code: int) -> bool:
        """Shift the range of an input towards a code that is at a rail.

        Conversions that began before still have the former offset.

        Returns:
            Whether there was room to shift it.

        Raises:
            BusError: If the transfer failed.
        """
        step = _CAPDAC_STEP if code > 0 else -_CAPDAC_STEP
        former = self.capdac[channel]
        self.capdac[channel] = min(max(former + step, 0), _LAST_CAPDAC)
        if self.capdac[channel] == former:
            return False
        self._port.write(_CONF_MEAS + channel, self._conf_meas(channel))
        return True

    def _conf_meas(self, channel: int) -> int:
        return channel << 13 | _TO_CAPDAC << 10 | self.capdac[channel] << 5


def is_saturated(code: int) -> bool:
    """Whether a code is at a rail, and so no measurement."""
    return code in _RAILS


def capacitance(code: int, capdac: int) -> float:
    """Capacitance of a code and its offset: C = code / 2^19 + 3.125 capdac [pF]."""
    return code / _PER_PICOFARAD + _CAPDAC_UNIT * capdac


# In cycles, each the time that a chip takes for its four inputs.
_OLDEST = 2.0  # age at the trigger
_SHARED = 0.5  # what was read so shortly before a trigger is nearer than what comes so late
_UNFINISHED = 2.5
_SETTLING = 0.5  # two conversions: the one under way has the former CAPDAC


class ConversionTimeoutError(DeviceError):
    """A chip that answers does not convert."""


@dataclass
class _Input:
    low: float  # its DONE bit was low then [s]
    settled: float = -math.inf  # what may have ended before has another CAPDAC [s]
    since: float = -math.inf  # the value's conversion ended after this [s]
    read: float = -math.inf  # a conversion was last read then [s]
    value: float = math.nan  # [pF]; NaN if saturated
    fault: str = ""


class InputReader:
    """Reads the four inputs of a chip for a trigger; the chip is selected at each call.

    A conversion ended after the last time that its DONE bit was known to be low. That bound, not
    the time of the read, limits how old a value can be, even if the chip has hung in between.

    Args:
        chip: The chip.
        sample_rate: Conversions, shared by the inputs: 100, 200 or 400 [1/s].
        clock: The steady clock [s].

    Attributes:
        chip: The chip.
        pending: Inputs without a value for the present trigger.
        notes: What was done for the present trigger.
    """

    def __init__(self, chip: Fdc1004, sample_rate: int, clock: Callable[[], float]) -> None:
        self.chip = chip
        self.pending: set[int] = set()
        self.notes: list[str] = []
        self._sample_rate = sample_rate
        self._cycle = INPUTS / sample_rate  # [s]
        self._clock = clock
        self._inputs: list[_Input] = []
        self._trigger = self._begun = -math.inf  # [s]

    def begin(self, trigger: float) -> None:
        """Begin to gather what belongs to a trigger at a time of the steady clock [s]."""
        self.pending = set(range(INPUTS))
        self.notes = []
        self._trigger = trigger
        self._begun = self._clock()

    def configure(self) -> None:
        """Reset and configure the chip; drops what came before.

        Raises:
            DeviceError: If the chip does not take its settings.
        """
        begun = self._clock()
        self.chip.reset_and_configure(self._sample_rate)
        self._inputs = [_Input(low=begun) for _ in range(INPUTS)]
        self._begun = self._clock()
        self.notes.append("set up")

    def poll(self) -> bool:
        """Read what is done; returns whether inputs are still pending.

        Raises:
            ConversionTimeoutError: If a conversion should have ended long ago.
            DeviceError: If the chip fails otherwise; what it has given is not to be used.
        """
        asked = self._clock()
        done = self.chip.done()
        codes = {n: self._read(n) for n in sorted(self.pending) if done[n]}
        for n in self.pending - codes.keys():
            self._await(n, asked)
        if codes:
            # A chip that lost its supply while it was read gave zeros that look like values.
            self.chip.done()
        for n, code in codes.items():
            if code is not None:
                self._take(n, code)
        return bool(self.pending)

    @property
    def capacitance(self) -> FloatArray:
        """Capacitances for the present trigger, shape (4,) [pF]; NaN if saturated."""
        return np.array([entry.value for entry in self._inputs])

    @property
    def status(self) -> StatusArray:
        """OK, or SATURATED for an input out of the converter's range, shape (4,)."""
        saturated = np.isnan(self.capacitance)
        return np.where(saturated, Status.SATURATED, Status.OK).astype(np.uint8)

    @property
    def read(self) -> float:
        """When the last of the inputs was read [s]."""
        return max(entry.read for entry in self._inputs)

    @property
    def faults(self) -> str:
        """What is wrong with inputs that were read; empty if nothing."""
        return "; ".join(entry.fault for entry in self._inputs if entry.fault)

    def _read(self, n: int) -> int | None:
        """The code of an input [1], or None if it may be too old; it is cleared either way."""
        entry = self._inputs[n]
        entry.since, entry.low = entry.low, self._clock()
        code = self.chip.read(n)
        entry.read = self._clock()
        if entry.since < max(self._trigger - _OLDEST * self._cycle, entry.settled):
            entry.since = -math.inf
            return None
        return code

    def _await(self, n: int, asked: float) -> None:
        entry = self._inputs[n]
        entry.low = asked
        # At triggers as fast as the cycle, waiting for the next conversion each time would
        # make the readings fall behind; the last one may be nearer to this trigger.
        near = _SHARED * self._cycle
        is_young = entry.since >= self._trigger - _OLDEST * self._cycle
        if asked >= self._trigger + near and entry.read >= self._trigger - near and is_young:
            self.pending.discard(n)
        elif asked - max(self._begun, entry.read) > _UNFINISHED * self._cycle:
            raise ConversionTimeoutError(
                f"conversions of input {n + 1} do not finish at {self.chip.where}",
                "the chip is reset; if this comes again, check its supply",
            )

    def _take(self, n: int, code: int) -> None:
        entry = self._inputs[n]
        entry.value, entry.fault = math.nan, ""
        if not is_saturated(code):
            entry.value = capacitance(code, self.chip.capdac[n])
        elif self.chip.step_capdac(n, code):
            entry.settled = self._clock() + _SETTLING * self._cycle
            self.notes.append(f"CAPDAC of input {n + 1} set to {self.chip.capdac[n]}")
        else:
            entry.fault = (
                f"input {n + 1} is out of range at {self.chip.where}, CAPDAC"
                f" {self.chip.capdac[n]}: check its sensor for a short or a broken wire"
            )
        self.pending.discard(n)
