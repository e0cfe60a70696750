"""TI ADS131M06 and ADS131M08 on SPI (datasheet SBAS950B)."""

from __future__ import annotations

import binascii
import errno
import importlib
import re
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from socket_testbed import clocks
from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.drivers import GONE, lock_device, opening_failed
from socket_testbed.errors import ConfigurationError, DeviceError

_MAX_SINC3 = 1024  # a sinc1 filter follows for higher oversampling
_REFERENCE = 1.2  # [V]
_WORD = 3  # [bytes]
_START_UP = 300  # modulator clocks from a reset to the first sample
_RESET_TIME = 1e-3  # [s]; the registers are ready after 5 us

_NULL, _RESET, _UNLOCK = 0x0000, 0x0011, 0x0655
_READ, _WRITE = 0xA000, 0x6000
_FAMILY = range(0x21, 0x29)  # upper bytes of the IDs of converters of 1 to 8 channels
_ID, _MODE = 0x00, 0x02  # CLOCK, GAIN1 and GAIN2 follow MODE
_RESET_BIT = 0x0400
_WORDS_OF_24_BITS, _TIMEOUT, _ANSI = 0x0100, 0x0010, 0x0800
_HIGH_RESOLUTION = 0x0002

CHECK_WIRING = (
    "check the wiring and the chip select (docs/faults.md), or lower load_cell_node's spi_clock"
)


class SpiDevice(Protocol):
    """The part of `spidev.SpiDev` in use."""

    def xfer2(self, data: list[int], /) -> list[int]:
        """Send bytes, 0..255 each, and return as many; the chip stays selected throughout."""

    def close(self) -> None:
        """Release the bus."""


def check_device(device: str) -> tuple[int, int]:
    """Bus N and chip select M from a device name 'N.M'.

    Raises:
        ConfigurationError: The name has another form.
    """
    match = re.fullmatch(r"(\d+)\.(\d+)", device)
    if match is None:
        raise ConfigurationError(
            f"load_cell_node: device is '{device}'", "give bus and chip select as N.M, such as 0.0"
        )
    return int(match[1]), int(match[2])


def open_spi(device: str, clock: float) -> SpiDevice:
    """Open /dev/spidevN.M in SPI mode 1 and lock it against other programs.

    Args:
        device: Bus and chip select as 'N.M'.
        clock: Clock of the bus, 25 MHz at most for this converter [Hz].

    Raises:
        DeviceError: The module spidev is not installed, or the device cannot be opened; a
            `DeviceBusyError` if another program has locked it.
    """
    bus, select = check_device(device)
    path = f"/dev/spidev{bus}.{select}"
    try:
        # Imported late: it has no wheel for aarch64, and simulations do not need it.
        library: Any = importlib.import_module("spidev")
    except ImportError:
        raise DeviceError(
            f"{path}: the Python module spidev is not installed",
            "install python3-spidev (apt) or requirements/hardware.txt",
        ) from None
    spi = library.SpiDev()
    try:
        spi.open(bus, select)
        lock_device(spi.fileno(), f"spidev{device}")
        spi.mode = 1  # clock idles low, data is latched on the falling edge
        spi.max_speed_hz = int(clock)
    except OSError as error:
        spi.close()
        raise opening_failed(
            path,
            error,
            group="spi",
            missing="enable SPI (dtparam=spi=on in config.txt), or set load_cell_node's device",
            otherwise="check load_cell_node's spi_clock, and that the controller has SPI mode 1",
        ) from None
    except DeviceError:
        spi.close()
        raise
    return spi


def checksum(data: bytes, crc: str) -> int:
    """CRC-16 from 0xFFFF, not reflected, without a final XOR; returns 0..0xFFFF [1].

    Args:
        data: All bytes of a frame before its checksum.
        crc: The polynomial: 'ccitt' (0x1021) or 'ansi' (0x8005).
    """
    if crc == "ccitt":
        return binascii.crc_hqx(data, 0xFFFF)
    remainder = 0xFFFF
    for byte in data:
        remainder ^= byte << 8
        for _ in range(8):
            remainder = (remainder << 1 ^ (0x8005 if remainder & 0x8000 else 0)) & 0xFFFF
    return remainder


class ChecksumError(DeviceError):
    """A frame does not match its checksum; its content is unusable."""


class TransferError(DeviceError):
    """The bus failed to transfer a frame."""


def _transfer_failed(name: str, error: OSError) -> TransferError:
    said = error.strerror or error
    if error.errno in GONE | {errno.ENXIO}:
        hint = "check the adapter or the overlay; it is opened again automatically"
        return TransferError(f"{name}: the bus is gone ({said})", hint)
    if error.errno == errno.ETIMEDOUT:
        hint = "see dmesg; restart the computer if it persists"
        return TransferError(f"{name}: the SPI controller hangs ({said})", hint)
    hint = "check load_cell_node's device and spi_clock; restart the computer if it persists"
    return TransferError(f"{name}: the bus fails ({said})", hint)


@dataclass(frozen=True)
class ConverterFrame:
    """The content of a frame.

    Attributes:
        codes: Signed codes of 24 bits by channel, shape (channels,) [1]; those of an earlier frame
            unless this one is new.
        new: Whether all channels hold a conversion that was not read before.
    """

    codes: IntArray
    new: bool


def conversion_period(clock_in: float, oversampling: int) -> float:
    """Time between conversions [s], 2 oversampling / clock_in.

    Args:
        clock_in: The converter's clock [Hz].
        oversampling: Modulator clocks per conversion, at half of that clock [1].
    """
    return 2.0 * oversampling / clock_in


def group_delay(clock_in: float, oversampling: int) -> float:
    """Time from the middle of a conversion's filter to its end [s].

    A sinc3 filter spans three periods, so its middle is 1.5 periods back. Above an oversampling
    of 1024, the filter keeps 1024 and oversampling / 1024 of its outputs are averaged, which adds
    half the span of that mean (datasheet SBAS950B, table 8-3).

    Args:
        clock_in: The converter's clock [Hz].
        oversampling: Modulator clocks per conversion, at half of that clock [1].
    """
    inner = min(oversampling, _MAX_SINC3)
    return (1.5 * inner + 0.5 * (oversampling - inner)) * 2.0 / clock_in


def volts(codes: IntArray, gain: int) -> FloatArray:
    """Voltages at the converter's inputs [V], before its internal amplifier; shaped as the codes.

    Args:
        codes: Signed codes of 24 bits, of any shape [1].
        gain: Gain of the internal amplifier, 1 to 128 [1]; full scale is 1.2 V / gain.
    """
    return codes.astype(np.float64) * (_REFERENCE / (gain * 2.0**23))


def at_rail(codes: IntArray) -> BoolArray:
    """Whether each signed 24-bit code is clipped at an end of its range; shape of the codes."""
    return (codes == 0x7FFFFF) | (codes == -0x800000)


class Ads131m0x:
    """One converter of 6 (M06) or 8 (M08) channels.

    Args:
        spi: The bus, in SPI mode 1.
        channels: Number of channels, 6 or 8.
        crc: Checksum to configure, 'ccitt' or 'ansi' (see `checksum`).
        name: Name of the device, for errors.

    Attributes:
        identity: Content of its ID register, 0x26xx or 0x28xx; 0 until configured.
    """

    def __init__(
        self, spi: SpiDevice, channels: int, crc: str = "ccitt", name: str = "spidev0.0"
    ) -> None:
        self.identity = 0
        self._spi = spi
        self._channels = channels
        self._wanted_crc = crc
        self._crc = crc
        self._name = name

    @property
    def description(self) -> str:
        """Type and place of the converter."""
        return f"ADS131M{self._channels:02d} on {self._name}, ID 0x{self.identity:04X}"

    def reset_and_configure(self, oversampling: int, gain: int, clock_in: float) -> None:
        """Reset the chip, write its registers, read them back and drop unsettled conversions.

        Args:
            oversampling: Modulator clocks per conversion, a power of two from 128 to 16384 [1].
            gain: Gain of the internal amplifier of all channels, a power of two from 1 to 128 [1].
            clock_in: The converter's clock [Hz].

        Raises:
            DeviceError: Another converter answers, it does not reset, a register does not hold what
                was written to it, or the bus fails; a `ChecksumError` for a corrupted frame.
        """
        self._crc = "ccitt"
        # Before the reset, either checksum may be in use.
        self._transfer(_UNLOCK)
        self._transfer(_RESET)
        clocks.sleep(_RESET_TIME)
        acknowledged = self._transfer(_READ | _ID << 7)
        answer = self._transfer(_NULL)
        # Before the checksum, whose position depends on the number of channels.
        self.identity = _response(answer)
        wanted = 0x20 | self._channels
        another = DeviceError(
            f"{self._name}: the converter says ID 0x{self.identity:04X}, not 0x{wanted:02X}xx",
            "check load_cell_node's channels, and that its device is this converter",
        )
        if self.identity >> 8 in _FAMILY and self.identity >> 8 != wanted:
            raise another
        self._check(answer)
        said = _response(acknowledged)
        if said != 0xFF00 | wanted:
            if not any(_is_intact(acknowledged, crc) for crc in ("ccitt", "ansi")):
                raise self._corrupted()
            raise DeviceError(
                f"{self._name}: the converter did not reset (it says 0x{said:04X})",
                "check DIN and SCLK, or lower load_cell_node's spi_clock",
            )
        if self.identity >> 8 != wanted:
            raise another
        self._configure(oversampling, gain)
        # The first two conversions come from a faster, noisier filter; they are the two now
        # waiting, or older.
        clocks.sleep(conversion_period(clock_in, 3 * oversampling + _START_UP))
        for _ in range(2):
            self._transfer(_NULL)

    def read(self) -> ConverterFrame:
        """Read a frame.

        Raises:
            DeviceError: The converter has lost its settings: configure it again. A `ChecksumError`
                for a corrupted frame, or a `TransferError` for one that was not transferred, after
                which reading may go on.
        """
        answer = self._exchange(_NULL)
        status = _response(answer)
        if status & _RESET_BIT:
            raise DeviceError(
                f"{self._name}: the converter fell back to its reset state",
                "check its supply and its SYNC/RESET pin",
            )
        codes = [
            int.from_bytes(answer[at : at + _WORD], "big", signed=True)
            for at in range(_WORD, len(answer) - _WORD, _WORD)
        ]
        ready = (1 << self._channels) - 1
        return ConverterFrame(np.array(codes), status & ready == ready)

    def check_frames(self, count: int) -> int:
        """Read `count` frames; returns how many do not match their checksum."""
        errors = 0
        for _ in range(count):
            try:
                self._exchange(_NULL)
            except ChecksumError:
                errors += 1
        return errors

    def _configure(self, oversampling: int, gain: int) -> None:
        enabled = ((1 << self._channels) - 1) << 8
        rate = (oversampling.bit_length() - 8) << 2
        crc_bit = _ANSI if self._wanted_crc == "ansi" else 0
        gains = 0x1111 * (gain.bit_length() - 1)
        upper_gains = 0x7777 & (1 << 4 * (self._channels - 4)) - 1  # of channels 4 onwards
        # Values and masks from MODE onwards. Editions of the datasheet differ in the values of
        # reserved bits, so these are masked.
        registers = (
            (_WORDS_OF_24_BITS | _TIMEOUT | crc_bit, 0xFFFF),  # clears the reset bit
            (enabled | rate | _HIGH_RESOLUTION, enabled | 0x1F),
            (gains, 0x7777),
            (gains & upper_gains, upper_gains),
        )
        # The checksum type may change within the frame that sets it.
        values = [value for value, _ in registers]
        self._transfer(_WRITE | _MODE << 7 | len(values) - 1, *values)
        self._crc = self._wanted_crc
        reads = [_READ | _MODE + k << 7 for k in range(len(values))]
        _, *answers = [_response(self._exchange(command)) for command in (*reads, _NULL)]
        for k, (answer, (value, mask)) in enumerate(zip(answers, registers, strict=True)):
            if answer & mask != value:
                raise DeviceError(
                    f"{self._name}: register 0x{_MODE + k:02X} reads 0x{answer:04X} after"
                    f" 0x{value:04X} was written",
                    "check DIN, or lower load_cell_node's spi_clock",
                )

    def _exchange(self, *words: int) -> bytes:
        answer = self._transfer(*words)
        self._check(answer)
        return answer

    def _check(self, answer: bytes) -> None:
        if not _is_intact(answer, self._crc):
            raise self._corrupted()

    def _corrupted(self) -> ChecksumError:
        return ChecksumError(f"{self._name}: a frame does not match its checksum", CHECK_WIRING)

    def _transfer(self, *words: int) -> bytes:
        """Send 16-bit words, each left-aligned in a bus word; returns the unchecked answer."""
        frame = bytearray(_WORD * (self._channels + 2))
        for k, word in enumerate(words):
            frame[_WORD * k : _WORD * k + 2] = word.to_bytes(2, "big")
        try:
            answer = bytes(self._spi.xfer2(list(frame)))
        except OSError as error:
            raise _transfer_failed(self._name, error) from None
        if not any(answer) or answer == b"\xff" * len(frame):
            raise DeviceError(
                f"{self._name}: no answer (every bit reads {answer[0] & 1})",
                "check MISO, CS and the supply of the converter",
            )
        return answer


def _is_intact(answer: bytes, crc: str) -> bool:
    """Whether a frame matches its checksum of a kind, see `checksum`."""
    return checksum(answer[:-_WORD], crc) == int.from_bytes(answer[-_WORD:-1], "big")


def _response(answer: bytes) -> int:
    return int.from_bytes(answer[:2], "big")
