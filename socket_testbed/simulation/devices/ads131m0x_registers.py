"""The registers of the converter ADS131M06 or ADS131M08, and the checksum of its frames."""

from __future__ import annotations

ID, STATUS, MODE, CLOCK, GAIN1, GAIN2, CFG, LAST = 0x00, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x30
RESET_BIT, _ANSI_BIT, _WORD_LENGTH = 0x0400, 0x0800, 0x0300
_GAIN_CALIBRATION = 0x0C


class AdcRegisters:
    """The registers, as they are after a reset until they are written.

    Args:
        channels: 6 (M06) or 8 (M08).

    Attributes:
        locked: Whether the interface is locked.
    """

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

    def write(self, address: int, values: list[int]) -> tuple[int, bool]:
        """Write registers from an address on; what is read-only or beyond stays as it is.

        Returns:
            How many were written, and whether the conversions begin anew by it.
        """
        before = self._values[CLOCK : GAIN2 + 1]
        written = 0
        for place, value in enumerate(values, start=address):
            if STATUS < place <= LAST:
                self._values[place] = self._kept(place, value)
                written += 1
        return written, self._values[CLOCK : GAIN2 + 1] != before

    def checksum(self, data: bytes) -> int:
        """CRC-16 of a frame from 0xFFFF, bit by bit: another way than the driver's."""
        polynomial = 0x8005 if self._values[MODE] & _ANSI_BIT else 0x1021
        remainder = 0xFFFF
        for byte in data:
            remainder ^= byte << 8
            for _ in range(8):
                remainder = remainder << 1 ^ (polynomial if remainder & 0x8000 else 0)
                remainder &= 0xFFFF
        return remainder

    def _kept(self, place: int, value: int) -> int:
        """What a register holds after a value was written to it."""
        old = self._values[place]
        if place == MODE:  # the reset bit can only be cleared; words stay of 24 bits
            changeable = 0xFFFF & ~(RESET_BIT | _WORD_LENGTH)
            return value & changeable | old & _WORD_LENGTH | old & value & RESET_BIT
        if place == CLOCK and self._channels == 6:
            return value & 0x3FFF | old & 0xC000
        return value
