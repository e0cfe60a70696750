"""The four inputs of one chip: conversions that are new enough for a trigger, or none.

A conversion ended after the last time that its DONE bit was known to be low. That bound, not
the time of the read, says how old a value can be, also when a chip has hung in between.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from socket_testbed.drivers.clusters.fdc1004 import (
    INPUTS,
    Fdc1004,
    capacitance,
    is_saturated,
)
from socket_testbed.errors import DeviceError

# In cycles, each the time that a chip takes for its four inputs.
_OLDEST = 2.0  # age at the trigger
_SHARED = 0.5  # what was read so shortly before a trigger is nearer than what comes so late
_UNFINISHED = 2.5
_SETTLING = 0.5  # two conversions: the one under way has the former CAPDAC


class ConversionTimeoutError(DeviceError):
    """A chip that answers does not convert."""


@dataclass
class _Input:
    low: float = -math.inf  # its DONE bit was low then [s]
    settled: float = -math.inf  # what may have ended before has another CAPDAC [s]
    since: float = -math.inf  # the value's conversion ended after this [s]
    read: float = -math.inf  # a conversion was last read then [s]
    value: float = math.nan  # [pF]
    saturated: bool = False
    fault: str = ""


@dataclass
class FreshInputs:
    """The inputs of a chip that is selected whenever one of these methods is called.

    Attributes:
        chip: The chip.
        clock: The steady clock [s].
        cycle: Time in which the chip converts all its inputs [s].
        pending: Inputs without a value for the present trigger.
        notes: What was done for the present trigger.
    """

    chip: Fdc1004
    clock: Callable[[], float]
    cycle: float
    pending: set[int] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)
    _inputs: list[_Input] = field(default_factory=list)
    _trigger: float = -math.inf
    _begun: float = -math.inf

    def begin(self, trigger: float) -> None:
        """Begin to gather what belongs to a trigger at a time of the steady clock [s]."""
        self.pending = set(range(INPUTS))
        self.notes = []
        self._trigger = trigger
        self._begun = self.clock()

    def configure(self, sample_rate: int) -> None:
        """Reset and configure the chip for a sample rate [1/s]; drops what came before.

        Raises:
            DeviceError: If the chip does not do what it is told.
        """
        begun = self.clock()
        self.chip.reset_and_configure(sample_rate)
        self._inputs = [_Input(low=begun) for _ in range(INPUTS)]
        self._begun = self.clock()
        self.notes.append("set up")

    def poll(self) -> bool:
        """Read what is done; returns whether inputs are still pending.

        Raises:
            ConversionTimeoutError: If a conversion should have ended long ago.
            DeviceError: If the chip fails otherwise; what it has given is not to be used.
        """
        asked = self.clock()
        done = self.chip.done()
        codes = {}
        for n in sorted(self.pending):
            if done[n]:
                codes[n] = self._read(n)
            else:
                self._await(n, asked)
        if codes:
            # A chip that lost its supply while it was read gave zeros that look like values.
            self.chip.done()
        for n, code in codes.items():
            self._take(n, code)
        return bool(self.pending)

    def value(self, n: int) -> float:
        """Capacitance of an input for the present trigger [pF]; NaN if saturated."""
        return self._inputs[n].value

    def saturated(self, n: int) -> bool:
        """Whether an input is out of the converter's range."""
        return self._inputs[n].saturated

    @property
    def read(self) -> float:
        """When the last of the inputs was read [s]."""
        return max(entry.read for entry in self._inputs)

    @property
    def faults(self) -> str:
        """What is wrong with inputs that were read; empty if nothing."""
        return "; ".join(entry.fault for entry in self._inputs if entry.fault)

    @property
    def _oldest(self) -> float:
        return self._trigger - _OLDEST * self.cycle

    def _read(self, n: int) -> int | None:
        """The code of an input [1], or None if it may be too old; it is cleared either way."""
        entry = self._inputs[n]
        entry.since, entry.low = entry.low, self.clock()
        code = self.chip.read(n)
        entry.read = self.clock()
        if entry.since < max(self._oldest, entry.settled):
            entry.since = -math.inf
            return None
        return code

    def _await(self, n: int, asked: float) -> None:
        entry = self._inputs[n]
        entry.low = asked
        # At triggers as fast as the cycle, waiting for the next conversion each time would
        # make the readings fall behind; the last one may be nearer to this trigger.
        near = _SHARED * self.cycle
        is_late = asked >= self._trigger + near
        if is_late and entry.read >= self._trigger - near and entry.since >= self._oldest:
            self.pending.discard(n)
        elif asked - max(self._begun, entry.read) > _UNFINISHED * self.cycle:
            raise ConversionTimeoutError(
                f"conversions of input {n + 1} do not finish at {self.chip.where}",
                "the chip is reset; if this comes again, check its supply",
            )

    def _take(self, n: int, code: int | None) -> None:
        if code is None:
            return
        entry = self._inputs[n]
        entry.value, entry.saturated, entry.fault = math.nan, is_saturated(code), ""
        if not entry.saturated:
            entry.value = capacitance(code, self.chip.capdac[n])
        elif self.chip.step_capdac(n, code):
            entry.settled = self.clock() + _SETTLING * self.cycle
            self.notes.append(f"CAPDAC of input {n + 1} set to {self.chip.capdac[n]}")
        else:
            entry.fault = str(
                DeviceError(
                    f"input {n + 1} is out of range at {self.chip.where}, CAPDAC"
                    f" {self.chip.capdac[n]}",
                    "check its sensor for a short or a broken wire",
                )
            )
        self.pending.discard(n)
