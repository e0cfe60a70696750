"""Register-level simulation of the FDC1004."""

from __future__ import annotations

import math

from socket_testbed import clocks
from socket_testbed.simulation.devices.i2c import SimulatedChip, no_answer

_CONF_MEAS, _FDC_CONF = 0x08, 0x0C
_IDENTITY = {0xFE: 0x5449, 0xFF: 0x1004}
_RESET, _REPEAT_ALL, _SETTABLE = 0x8000, 0x01F0, 0x0DF0
_RATES = (0.0, 100.0, 200.0, 400.0)  # [1/s]
_CAPDAC = 4  # CHB; other values mean single-ended without offset
_CAPDAC_UNIT = 3.125  # [pF]
_MAX_CODE, _MIN_CODE = 0x7FFFFF, -0x800000


class SimulatedFdc1004(SimulatedChip):
    """The chip in repeat mode; it converts continuously, whether or not it is read.

    Offset and gain registers and other modes are not simulated. See `SimulatedChip` for the
    arguments.
    """

    address = 0x50

    def power_up(self) -> None:
        """Enter the reset state, as after RST."""
        super().power_up()
        self._pointer = 0
        self._conf_meas = {_CONF_MEAS + n: 0x1C00 for n in range(4)}
        self._conf = 0  # FDC_CONF without DONE
        self._done = [False] * 4
        self._codes = [0] * 4
        self._lsb = [0] * 4  # LSB registers, latched when the MSB was read
        self._msb_was_read = [False] * 4
        self._next = 0  # input of the current conversion
        self._settings = 0  # CONF_MEAS at its start
        self._end = math.inf  # its end [s]

    def stop(self) -> None:
        """Stop converting until reset; finished conversions stay."""
        self._convert(clocks.monotonic())
        self._end = math.inf

    def write(self, data: bytes) -> None:
        """Handle a write: the number of a register, then its two bytes unless it is to be read."""
        self._convert(clocks.monotonic())
        register = data[0]
        known = register <= _FDC_CONF or register in _IDENTITY
        if not known or len(data) not in {1, 3}:
            raise no_answer()
        self._pointer = register
        if len(data) == 1:
            return
        value = int.from_bytes(data[1:], "big")
        if register == _FDC_CONF:
            self._configure(value)
        elif register in self._conf_meas:
            self._conf_meas[register] = value
        else:
            raise no_answer()  # read-only

    def read(self, length: int) -> bytes:
        """Answer with some bytes: those of the register at the pointer, repeated."""
        self._convert(clocks.monotonic())
        value = self._value(self._pointer).to_bytes(2, "big")
        return (value * length)[:length]

    def _value(self, register: int) -> int:
        if register in _IDENTITY:
            return _IDENTITY[register]
        if register == _FDC_CONF:
            return self._conf | sum(8 >> n for n in range(4) if self._done[n])
        if register in self._conf_meas:
            return self._conf_meas[register]
        n = register // 2
        if register % 2 == 0:
            self._lsb[n] = (self._codes[n] & 0xFF) << 8
            self._msb_was_read[n] = True
            return self._codes[n] >> 8 & 0xFFFF
        if self._msb_was_read[n]:
            self._done[n] = self._msb_was_read[n] = False
        return self._lsb[n]

    def _configure(self, value: int) -> None:
        if value & _RESET:
            self.power_up()
            return
        self._conf = value & _SETTABLE
        self._done = [False] * 4
        self._end = math.inf
        if value & _REPEAT_ALL == _REPEAT_ALL and self._period:
            self._next = 0
            self._start(0)
            self._end = clocks.monotonic() + self._period

    @property
    def _period(self) -> float:
        """Time of one conversion [s]; 0 for the reserved rate."""
        rate = _RATES[self._conf >> 10 & 3] * self._speed
        return 1.0 / rate if rate else 0.0

    def _convert(self, now: float) -> None:
        if now < self._end:
            return
        # Earlier conversions would be overwritten: compute only the last round.
        behind = math.floor((now - self._end) / self._period) + 1
        skipped = max(0, behind - 4)
        if skipped:
            self._end += skipped * self._period
            self._start(skipped)
        while now >= self._end:
            self._codes[self._next] = self._code(self._end)
            self._done[self._next] = True
            self._end += self._period
            self._start(1)

    def _start(self, further: int) -> None:
        """Start the conversion of the input `further` inputs on."""
        self._next = (self._next + further) % 4
        self._settings = self._conf_meas[_CONF_MEAS + self._next]

    def _code(self, moment: float) -> int:
        difference = self.input(self._settings >> 13 & 7, moment)
        if self._settings >> 10 & 7 == _CAPDAC:
            difference -= _CAPDAC_UNIT * (self._settings >> 5 & 0x1F)
        return min(max(round(difference * 2**19), _MIN_CODE), _MAX_CODE)
