"""An I2C bus with its multiplexer (TI TCA9548A), and one chip on it, with named errors."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from contextlib import suppress
from fcntl import ioctl
from typing import Protocol

from smbus2 import SMBus, i2c_msg

from socket_testbed.errors import DeviceError

_I2C_TIMEOUT = 0x0702  # request of linux/i2c-dev.h
_TIMEOUT_UNIT = 0.01  # [s]


class I2cBus(Protocol):
    """What is used of `smbus2.SMBus`, and what simulated buses offer."""

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        """Transfer messages with repeated starts between them."""

    def close(self) -> None:
        """Close the bus."""


class BusError(DeviceError):
    """A transfer failed.

    Attributes:
        bus: Name of the bus, such as i2c-1.
        address: Address of the chip [1].
    """

    def __init__(self, fact: str, hint: str, bus: str, address: int) -> None:
        super().__init__(fact, hint)
        self.bus = bus
        self.address = address


class NoAnswerError(BusError):
    """The chip did not acknowledge."""


class BusTimeoutError(BusError):
    """The bus hung."""


class BusGoneError(BusError):
    """The bus itself is gone: it must be opened again."""


def open_i2c(number: int, timeout: float) -> I2cBus:
    """Open `/dev/i2c-N`.

    Args:
        number: N [1].
        timeout: Time after which a transfer on a bus that hangs is given up [s]; the kernel
            counts it in steps of 10 ms.

    Raises:
        DeviceError: If it cannot be opened.
    """
    bus = SMBus()
    try:
        bus.open(number)
        assert bus.fd is not None
        ioctl(bus.fd, _I2C_TIMEOUT, max(1, round(timeout / _TIMEOUT_UNIT)))
    except OSError as error:
        bus.close()  # smbus2 leaves the file open if what follows its opening fails
        raise opening_failed(number, error) from error
    return bus


def opening_failed(number: int, error: OSError) -> DeviceError:
    """The error, with its hint, of a bus that could not be opened."""
    name, path = f"i2c-{number}", f"/dev/i2c-{number}"
    if error.errno in {errno.EACCES, errno.EPERM}:
        return DeviceError(
            f"{name}: no permission to open {path}",
            "add the user to the group i2c: sudo usermod -aG i2c $USER, then log in again",
        )
    if error.errno in {errno.ENOENT, errno.ENODEV, errno.ENXIO}:
        return DeviceError(
            f"{name}: there is no {path}",
            "enable the bus (dtparam=i2c_arm=on in config.txt), or set cluster_node's buses",
        )
    return DeviceError(
        f"{name}: {path} cannot be opened ({_reason(error)})",
        "check that it is an I2C bus and that nothing else holds it",
    )


class I2cPort:
    """One chip on a bus, with registers of 16 bits, the most significant byte first.

    Attributes:
        where: Its place in words, such as "0x50 behind channel 2 of 0x70 on i2c-1".
    """

    def __init__(
        self, bus: I2cBus, bus_name: str, address: int, place: str = "", part: str = "cluster"
    ) -> None:
        """Describe the chip.

        Args:
            bus: The bus.
            bus_name: Its name, such as i2c-1.
            address: The chip's address [1].
            place: Where it is on the bus, such as "behind channel 2 of 0x70".
            part: What a person has to check when it does not answer.
        """
        self._bus = bus
        self._bus_name = bus_name
        self._address = address
        self._part = part
        self.where = " ".join(f"0x{address:02X} {place} on {bus_name}".split())

    def read(self, register: int) -> int:
        """Read a register, 0..0xFFFF [1]: its pointer, then a repeated start.

        Raises:
            BusError: If the transfer failed.
        """
        pointer = i2c_msg.write(self._address, [register])
        answer = i2c_msg.read(self._address, 2)
        self._transfer(pointer, answer)
        return int.from_bytes(answer.buf[:2], "big")

    def write(self, register: int, value: int) -> None:
        """Write a register, 0..0xFFFF [1].

        Raises:
            BusError: If the transfer failed.
        """
        self._transfer(i2c_msg.write(self._address, [register, value >> 8, value & 0xFF]))

    def write_byte(self, value: int) -> None:
        """Write one byte to a chip without registers.

        Raises:
            BusError: If the transfer failed.
        """
        self._transfer(i2c_msg.write(self._address, [value]))

    def _transfer(self, *messages: i2c_msg) -> None:
        try:
            self._bus.i2c_rdwr(*messages)
        except OSError as error:
            raise self._named(error) from error

    def _named(self, error: OSError) -> BusError:
        place = (self._bus_name, self._address)
        if error.errno in {errno.EREMOTEIO, errno.ENXIO}:
            hint = f"check the {self._part}'s plug and its supply"
            return NoAnswerError(f"no answer at {self.where}", hint, *place)
        if error.errno == errno.ETIMEDOUT:
            hint = "check SDA and SCL for a short, and their pull-ups"
            return BusTimeoutError(f"the bus hangs at {self.where}", hint, *place)
        if error.errno in {errno.ENODEV, errno.ENOENT, errno.EBADF, errno.EIO}:
            hint = f"check the adapter of {self._bus_name}; it is opened again by itself"
            fact = f"the bus is gone at {self.where} ({_reason(error)})"
            return BusGoneError(fact, hint, *place)
        hint = f"check the {self._part}'s wiring"
        return BusError(f"transfer failed at {self.where} ({_reason(error)})", hint, *place)


def _reason(error: OSError) -> str:
    return os.strerror(error.errno) if error.errno else str(error)


class ReopenedBus:
    """A bus that is opened when needed, and can be closed and opened under the chips on it."""

    def __init__(self, number: int, open_bus: Callable[[int], I2cBus]) -> None:
        self.name = f"i2c-{number}"
        self._number = number
        self._open_bus = open_bus
        self._bus: I2cBus | None = None

    @property
    def is_open(self) -> bool:
        """Whether it is open."""
        return self._bus is not None

    def open(self) -> None:
        """Open it, unless it is open.

        Raises:
            DeviceError: If it cannot be opened.
        """
        if self._bus is None:
            try:
                self._bus = self._open_bus(self._number)
            except OSError as error:
                raise opening_failed(self._number, error) from error

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        """Transfer messages; raises OSError, as the bus itself does."""
        if self._bus is None:
            raise OSError(errno.ENODEV, "the bus is closed")
        self._bus.i2c_rdwr(*messages)

    def close(self) -> None:
        """Close it; one that is gone is closed already."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with suppress(OSError):
                bus.close()


class Multiplexer:
    """The multiplexer, which connects one channel or none.

    Its chips share one address: two channels at once would put them on the same wires.
    """

    def __init__(self, port: I2cPort) -> None:
        self._port = port

    def select(self, channel: int) -> None:
        """Connect one channel, 0..7 [1], and it alone.

        It is always written: after a brown-out a remembered selection would be wrong.

        Raises:
            BusError: If the multiplexer does not take it.
        """
        self._port.write_byte(1 << channel)

    def off(self) -> None:
        """Connect no channel.

        Raises:
            BusError: If the multiplexer does not take it.
        """
        self._port.write_byte(0)
