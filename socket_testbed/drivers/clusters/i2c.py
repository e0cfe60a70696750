"""I2C for the clusters: the bus, register access with named errors, and the chip interface."""

from __future__ import annotations

import errno
from dataclasses import dataclass
from fcntl import ioctl
from typing import Protocol

from smbus2 import SMBus, i2c_msg

from socket_testbed import drivers
from socket_testbed.errors import DeviceError

INPUTS = 4  # per chip

_I2C_TIMEOUT = 0x0702  # request of linux/i2c-dev.h
_TIMEOUT_UNIT = 0.01  # [s]


class I2cBus(Protocol):
    """The part of `smbus2.SMBus` in use; simulated buses implement it."""

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        """Transfer messages with repeated starts between them; fills the buffers of reads.

        A failed transfer raises OSError.
        """

    def close(self) -> None:
        """Close the bus."""


class BusError(DeviceError):
    """A transfer failed.

    Args:
        fact: What is wrong, with the place of the chip.
        hint: What to do about it.
        address: Address of the chip that was accessed, 7 bits.

    Attributes:
        address: Address of the chip that was accessed, a cluster's chip or a multiplexer.
    """

    def __init__(self, fact: str, hint: str, address: int) -> None:
        super().__init__(fact, hint)
        self.address = address


class BusTimeoutError(BusError):
    """The bus hung."""


class BusGoneError(BusError):
    """The bus itself is gone and must be reopened."""


def open_i2c(number: int, timeout: float) -> I2cBus:
    """Open `/dev/i2c-N`.

    Args:
        number: N of the bus.
        timeout: Time after which a hanging transfer ends [s]; rounded to steps of 10 ms, at least
            one.

    Raises:
        DeviceError: The bus is not there, not permitted or not usable.
    """
    bus = SMBus()
    try:
        bus.open(number)
        assert bus.fd is not None
        ioctl(bus.fd, _I2C_TIMEOUT, max(1, round(timeout / _TIMEOUT_UNIT)))
    except OSError as error:
        bus.close()  # smbus2 leaves the file open if a later step fails
        raise bus_opening_failed(number, error) from error
    return bus


def bus_opening_failed(number: int, error: OSError) -> DeviceError:
    """The error for a bus that could not be opened.

    Args:
        number: N of the bus `/dev/i2c-N`.
        error: What opening it raised.
    """
    return drivers.opening_failed(
        f"/dev/i2c-{number}",
        error,
        group="i2c",
        missing="enable the bus (dtparam=i2c_arm=on in config.txt), or set cluster_node's buses",
        otherwise="check that it is an I2C bus and that nothing else holds it",
    )


class I2cPort:
    """One chip on a bus, with big-endian registers.

    A failed transfer raises a `BusError` that names the bus, the place on it and the part to check.

    Args:
        bus: The bus.
        bus_name: Its name for messages, such as i2c-1.
        address: Address of the chip on the bus, 7 bits.
        place: Where the chip is on the bus, for messages, such as "behind channel 2 of 0x70"; empty
            if it is on the bus itself.
        part: What to check after a failure, for hints, such as "cluster" or "multiplexer".

    Attributes:
        where: Where the chip is wired, for messages, such as "0x50 behind channel 2 of 0x70 on
            i2c-1".
    """

    def __init__(
        self, bus: I2cBus, bus_name: str, address: int, place: str = "", part: str = "cluster"
    ) -> None:
        self._bus = bus
        self._bus_name = bus_name
        self._address = address
        self._part = part
        self.where = " ".join(f"0x{address:02X} {place} on {bus_name}".split())

    def read(self, register: int) -> int:
        """Read a register of 16 bits: its pointer, then a repeated start; returns 0..0xFFFF [1]."""
        answer = i2c_msg.read(self._address, 2)
        self._transfer(i2c_msg.write(self._address, [register]), answer)
        return int.from_bytes(answer.buf[:2], "big")

    def write(self, register: int, value: int) -> None:
        """Write a register of 16 bits.

        Args:
            register: Its number, 0..0xFF.
            value: Its new content, 0..0xFFFF [1].
        """
        self._transfer(i2c_msg.write(self._address, [register, value >> 8, value & 0xFF]))

    def write_byte(self, value: int) -> None:
        """Write one byte, 0..0xFF [1], to a chip without registers."""
        self._transfer(i2c_msg.write(self._address, [value]))

    def _transfer(self, *messages: i2c_msg) -> None:
        try:
            self._bus.i2c_rdwr(*messages)
        except OSError as error:
            raise self._bus_error(error) from error

    def _bus_error(self, error: OSError) -> BusError:
        said = error.strerror or error
        kind, fact = BusError, f"transfer failed at {self.where} ({said})"
        hint = f"check the {self._part}'s wiring"
        if error.errno in {errno.EREMOTEIO, errno.ENXIO}:
            fact = f"no answer at {self.where}"
            hint = f"check the {self._part}'s plug and its supply"
        elif error.errno == errno.ETIMEDOUT:
            kind, fact = BusTimeoutError, f"the bus hangs at {self.where}"
            hint = "check SDA and SCL for a short, their pull-ups, and doctor's kernel row"
        elif error.errno in {errno.ENODEV, errno.ENOENT, errno.EBADF, errno.EIO}:
            kind, fact = BusGoneError, f"the bus is gone at {self.where} ({said})"
            hint = f"check the adapter of {self._bus_name}; it will be reopened automatically"
        return kind(fact, hint, self._address)


@dataclass(frozen=True)
class Conversion:
    """A converted code.

    Attributes:
        picofarads: Capacitance of the input [pF]; NaN if it is out of range.
        shifted: Whether the input's range was shifted towards the capacitance; conversions that
            begin later have the new range.
        fault: Fact and hint in one line if the range cannot be shifted further; empty for none.
    """

    picofarads: float
    shifted: bool = False
    fault: str = ""


class CapacitiveChip(Protocol):
    """A chip that converts its four inputs continuously, in turn.

    Every method raises a `DeviceError` if the chip or its bus fails. The constructor takes the port
    to its registers and the rate, one of `sample_rates`.

    Attributes:
        name: Type of the chip, for messages.
        address: Its address on the bus, 7 bits; all chips of one type have the same.
        sample_rates: Possible rates of the chip in conversions per second, shared by its four
            inputs [1/s].
        where: Where it is wired, for messages.
    """

    name: str
    address: int
    sample_rates: tuple[int, ...]
    where: str

    def __init__(self, port: I2cPort, sample_rate: int, /) -> None: ...

    def check_identity(self) -> None:
        """Check that this is the expected chip."""

    def reset_and_configure(self) -> None:
        """Reset the chip, check its identity, and start converting all inputs in turn."""

    def done(self) -> tuple[bool, ...]:
        """Whether each input has a conversion that was not read, shape (4,).

        Raises an error if the chip has lost its settings.
        """

    def read(self, channel: int) -> int:
        """Code of the last conversion of an input, 0..3 [1]; clears its `done`."""

    def convert(self, channel: int, code: int) -> Conversion:
        """Convert an input's code to capacitance [pF]; shifts the range if it is out of range.

        Args:
            channel: The input, 0..3.
            code: What `read` returned for it [1].
        """
