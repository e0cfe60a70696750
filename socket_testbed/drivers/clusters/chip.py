"""A cluster's converter as the reader sees it, and its four inputs read for each trigger."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.drivers.clusters.i2c import I2cPort
from socket_testbed.errors import DeviceError
from socket_testbed.samples import Status

INPUTS = 4

# In cycles, each the time that a chip takes for its four inputs.
_OLDEST = 2.0  # age at the trigger
_SHARED = 0.5  # a value read so shortly before a trigger is nearer than the next conversion
_UNFINISHED = 2.5
_SETTLING = 0.5  # two conversions: the one under way has the former range


@dataclass(frozen=True)
class Conversion:
    """The meaning of a code."""

    picofarads: float  # capacitance [pF]; NaN if it is out of range
    # how the chip shifted the input's range, which holds from the next conversion that begins;
    # empty if it did not
    change: str = ""
    fault: str = ""  # why an input that is out of range cannot have another one, and the hint


class CapacitiveChip(Protocol):
    """A converter of four capacitances, all the time and in turn.

    Every method raises a `DeviceError` if the chip or its bus fails.
    """

    name: str  # its name, for people
    address: int  # its address on the bus [1]
    sample_rates: tuple[int, ...]  # conversions, shared by the inputs, that it can make [1/s]
    where: str  # where it is wired, for messages

    def __init__(
        self, port: I2cPort, sample_rate: int, sleep: Callable[[float], None], /
    ) -> None: ...

    def check_identity(self) -> None:
        """Check that it is this chip."""

    def reset_and_configure(self) -> None:
        """Reset it, check its identity, and let it convert all inputs in turn."""

    def done(self) -> tuple[bool, ...]:
        """Whether each input was converted since it was last read, shape (4,).

        A chip that has lost its settings is an error.
        """
        ...

    def read(self, channel: int) -> int:
        """Code of the last conversion of an input [1]; the input is not `done` any more."""
        ...

    def convert(self, channel: int, code: int) -> Conversion:
        """Capacitance of a code of an input; shifts the range of an input that left it."""
        ...


@dataclass
class _Input:
    low: float  # it was not done then [s]
    settled: float = -math.inf  # a conversion that may have ended before has another range [s]
    since: float = -math.inf  # the value's conversion ended after this [s]
    read: float = -math.inf  # a conversion was last read then [s]
    value: float = math.nan  # [pF]; NaN if out of range
    fault: str = ""


class InputReader:
    """Reads the four inputs of a chip for a trigger; the chip is selected at each call.

    A conversion ended after the last time that its input was known not to be done. That bound,
    not the time of the read, limits how old a value can be, even if the chip has hung meanwhile.
    """

    def __init__(self, chip: CapacitiveChip, sample_rate: int, clock: Callable[[], float]) -> None:
        self.chip = chip
        self.pending: set[int] = set()  # inputs without a value for the present trigger
        self.notes: list[str] = []  # of set-ups and shifts of range for the present trigger
        self._cycle = INPUTS / sample_rate  # [s]
        self._clock = clock
        self._inputs: list[_Input] = []
        self._trigger = self._begun = -math.inf  # [s]

    def begin(self, trigger: float) -> None:
        """Begin to gather the inputs' values for a trigger at a time of the steady clock [s]."""
        self.pending = set(range(INPUTS))
        self.notes = []
        self._trigger = trigger
        self._begun = self._clock()

    def configure(self) -> None:
        """Reset and configure the chip; drops what came before."""
        begun = self._clock()
        self.chip.reset_and_configure()
        self._inputs = [_Input(low=begun) for _ in range(INPUTS)]
        self._begun = self._clock()
        self.notes.append("set up")

    def poll(self) -> bool:
        """Read what is done; returns whether inputs are still pending."""
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
        """Capacitances for the present trigger, shape (4,) [pF]; NaN if out of range."""
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
        """Faults of inputs that were read; empty for none."""
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
            raise DeviceError(
                f"conversions of input {n + 1} do not finish at {self.chip.where}",
                "the chip is reset; if this comes again, check its supply",
            )

    def _take(self, n: int, code: int) -> None:
        entry, conversion = self._inputs[n], self.chip.convert(n, code)
        entry.value, entry.fault = conversion.picofarads, conversion.fault
        if conversion.change:
            entry.settled = self._clock() + _SETTLING * self._cycle
            self.notes.append(f"{conversion.change} of input {n + 1}")
        self.pending.discard(n)
