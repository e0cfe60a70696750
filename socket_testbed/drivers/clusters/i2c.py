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
        """Transfer messages with repeated starts between them."""

    def close(self) -> None:
        """Close the bus."""


class BusError(DeviceError):
    """A transfer failed."""

    def __init__(self, fact: str, hint: str, address: int) -> None:
        super().__init__(fact, hint)
        self.address = address  # address of the chip [1]


class BusTimeoutError(BusError):
    """The bus hung."""


class BusGoneError(BusError):
    """The bus itself is gone and must be reopened."""


def open_i2c(number: int, timeout: float) -> I2cBus:
    """Open `/dev/i2c-N`; hanging transfers end after a timeout [s], in steps of 10 ms."""
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
    """The error for a bus that could not be opened."""
    return drivers.opening_failed(
        f"/dev/i2c-{number}",
        error,
        group="i2c",
        missing="enable the bus (dtparam=i2c_arm=on in config.txt), or set cluster_node's buses",
        otherwise="check that it is an I2C bus and that nothing else holds it",
    )


class I2cPort:
    """One chip on a bus, with big-endian registers.

    A failed transfer raises a `BusError` that names the bus, such as i2c-1, the place on it, such
    as "behind channel 2 of 0x70", and the part to check.
    """

    def __init__(
        self, bus: I2cBus, bus_name: str, address: int, place: str = "", part: str = "cluster"
    ) -> None:
        self._bus = bus
        self._bus_name = bus_name
        self._address = address
        self._part = part
        # where it is wired, such as "0x50 behind channel 2 of 0x70 on i2c-1"
        self.where = " ".join(f"0x{address:02X} {place} on {bus_name}".split())

    def read(self, register: int) -> int:
        """Read a register, 0..0xFFFF [1]: its pointer, then a repeated start."""
        answer = i2c_msg.read(self._address, 2)
        self._transfer(i2c_msg.write(self._address, [register]), answer)
        return int.from_bytes(answer.buf[:2], "big")

    def write(self, register: int, value: int) -> None:
        """Write a register, 0..0xFFFF [1]."""
        self._transfer(i2c_msg.write(self._address, [register, value >> 8, value & 0xFF]))

    def write_byte(self, value: int) -> None:
        """Write one byte to a chip without registers."""
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
    """A converted code."""

    picofarads: float  # capacitance [pF]; NaN if out of range
    # whether the input's range was shifted, starting with the next conversion
    shifted: bool = False
    fault: str = ""  # fact and hint if the range cannot be shifted further


class CapacitiveChip(Protocol):
    """A chip that converts its four inputs continuously, in turn.

    Every method raises a `DeviceError` if the chip or its bus fails.
    """

    name: str  # for messages
    address: int  # on the bus [1]
    sample_rates: tuple[int, ...]  # possible rates, shared by the inputs [1/s]
    where: str  # where it is wired, for messages

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
        """Code of the last conversion of an input [1]; clears its `done`."""

    def convert(self, channel: int, code: int) -> Conversion:
        """Convert an input's code to capacitance; shifts the range if it is out of range."""
