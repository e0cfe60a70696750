"""I2C for the clusters: the bus, register access with named errors, and the chip interface."""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import dataclass
from fcntl import ioctl
from typing import Protocol, TypeVar

from smbus2 import I2cFunc, SMBus, i2c_msg

from socket_testbed import drivers
from socket_testbed.errors import DeviceError

INPUTS = 4  # per chip

_REGISTER_SIZE = 2  # [bytes]
_I2C_TIMEOUT = 0x0702  # request of linux/i2c-dev.h
_TIMEOUT_UNIT = 0.01  # [s]

T = TypeVar("T")


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
    """Open `/dev/i2c-N` and lock it against other programs.

    Args:
        number: N of the bus.
        timeout: Time after which a hanging transfer ends [s]; rounded to steps of 10 ms, at least
            one.

    Raises:
        DeviceError: The bus is not there, not permitted, not usable or speaks SMBus alone; a
            `DeviceBusyError` if another program has locked it.
    """
    bus = SMBus()
    try:
        bus.open(number)
        assert bus.fd is not None
        drivers.lock_device(bus.fd, f"i2c-{number}")
        _require_plain_i2c(bus, number)
        ioctl(bus.fd, _I2C_TIMEOUT, max(1, round(timeout / _TIMEOUT_UNIT)))
    except OSError as error:
        bus.close()  # smbus2 leaves the file open if a later step fails
        raise bus_opening_failed(number, error) from error
    except DeviceError:
        bus.close()
        raise
    return bus


def _require_plain_i2c(bus: SMBus, number: int) -> None:
    """Refuse an adapter of a graphics card or a mainboard, which cannot transfer messages."""
    if not bus.funcs & I2cFunc.I2C:
        raise DeviceError(
            f"the adapter of i2c-{number} speaks SMBus alone, and the clusters need plain I2C",
            "wire them to another adapter, and set cluster_node's buses (i2cdetect -l lists them)",
        )


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
        otherwise="check that it is an I2C bus, and doctor's kernel row",
    )


class I2cPort:
    """One chip on a bus, with big-endian registers.

    A transfer that fails twice raises a `BusError` that names the bus, the place on it and the part
    to check.

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
        self._hung = False  # at the last access
        # Messages of ctypes take longer to make than to transfer, so they are kept.
        self._pointers: dict[int, i2c_msg] = {}  # writes of a register's number
        self._answer = i2c_msg.read(address, _REGISTER_SIZE)
        self.where = " ".join(f"0x{address:02X} {place} on {bus_name}".split())

    def read(self, register: int) -> int:
        """Read a register of 16 bits: its pointer, then a repeated start; returns 0..0xFFFF [1]."""
        return self.read_in_a_row(register)[0]

    def read_in_a_row(self, *registers: int) -> list[int]:
        """Read registers of 16 bits whose contents belong together; returns 0..0xFFFF [1] each.

        A transfer that fails begins the row again, so that all come from one pass.
        """
        return self._with_second_try(lambda: [self._read_once(register) for register in registers])

    def write(self, register: int, value: int) -> None:
        """Write a register of 16 bits.

        Args:
            register: Its number, 0..0xFF.
            value: Its new content, 0..0xFFFF [1].
        """
        message = i2c_msg.write(self._address, [register, value >> 8, value & 0xFF])
        self._with_second_try(lambda: self._bus.i2c_rdwr(message))

    def write_byte(self, value: int) -> None:
        """Write one byte, 0..0xFF [1], to a chip without registers."""
        message = i2c_msg.write(self._address, [value])
        self._with_second_try(lambda: self._bus.i2c_rdwr(message))

    def _read_once(self, register: int) -> int:
        pointer = self._pointers.get(register)
        if pointer is None:
            pointer = self._pointers[register] = i2c_msg.write(self._address, [register])
        self._bus.i2c_rdwr(pointer, self._answer)
        return int.from_bytes(self._answer.buf[:_REGISTER_SIZE], "big")

    def _with_second_try(self, access: Callable[[], T]) -> T:
        """Access the chip, at once a second time if a transfer fails.

        Interference costs single transfers, and a second try takes 0.2 ms. A chip that has hung the
        bus before is tried once only, as each try takes the whole timeout.
        """
        try:
            found = self._access(access)
        except BusTimeoutError:
            if self._hung:
                raise
            self._hung = True
            found = self._access(access)
        except BusError:
            found = self._access(access)
        self._hung = False
        return found

    def _access(self, access: Callable[[], T]) -> T:
        try:
            return access()
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
        elif error.errno in {errno.EIO, errno.EPROTO}:  # by controller: a wire, or its adapter
            hint += f" (SDA, SCL, ground) and plug, then the adapter of {self._bus_name}"
        elif error.errno == errno.EAGAIN:
            fact = f"the bus is disturbed at {self.where} (lost arbitration)"
            hint = "check SDA and SCL for interference, and that no other master is on the bus"
        elif error.errno in drivers.GONE:
            kind, fact = BusGoneError, f"the bus is gone at {self.where} ({said})"
            hint = f"check the adapter of {self._bus_name}; it will be reopened automatically"
        elif error.errno in {errno.EOPNOTSUPP, errno.EINVAL}:
            hint = f"the adapter of {self._bus_name} lacks such transfers, use another one"
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
