"""The SPI bus, as the kernel offers it in /dev/spidevN.M."""

from __future__ import annotations

import importlib
import re
from typing import Any, Protocol

from socket_testbed.errors import ConfigurationError, DeviceError

_MODE = 1  # the clock idles low, data are latched on its falling edge


class SpiDevice(Protocol):
    """What a driver uses of `spidev.SpiDev`."""

    def xfer2(self, data: list[int], /) -> list[int]:
        """Exchange bytes, with the chip selected from the first to the last."""
        ...

    def close(self) -> None:
        """Give the bus back."""
        ...


def check_device(device: str) -> tuple[int, int]:
    """Bus and chip select of a device's name 'N.M'.

    Raises:
        ConfigurationError: If it is no such name.
    """
    match = re.fullmatch(r"(\d+)\.(\d+)", device)
    if match is None:
        raise ConfigurationError(
            f"device is '{device}'", "give bus and chip select as N.M, such as 0.0"
        )
    return int(match[1]), int(match[2])


def open_spi(device: str, clock: float) -> SpiDevice:
    """Open a device in SPI mode 1.

    Args:
        device: Bus and chip select, 'N.M' of /dev/spidevN.M.
        clock: Clock of the bus [Hz].

    Raises:
        ConfigurationError: If the device's name is malformed.
        DeviceError: If it cannot be opened.
    """
    bus, select = check_device(device)
    path = f"/dev/spidev{bus}.{select}"
    try:
        # Imported late: there is no wheel of it for aarch64, and simulations need none.
        library: Any = importlib.import_module("spidev")
    except ImportError:
        raise DeviceError(
            f"{path}: the Python module spidev is not installed",
            "install python3-spidev (apt) or requirements/hardware.txt",
        ) from None
    spi = library.SpiDev()
    try:
        spi.open(bus, select)
        spi.mode = _MODE
        spi.max_speed_hz = int(clock)
    except OSError as error:
        spi.close()
        raise _cannot_open(path, error) from None
    opened: SpiDevice = spi
    return opened


def _cannot_open(path: str, error: OSError) -> DeviceError:
    if isinstance(error, FileNotFoundError):
        return DeviceError(
            f"{path} does not exist",
            "enable SPI (dtparam=spi=on in config.txt) or set load_cell_node's device",
        )
    if isinstance(error, PermissionError):
        return DeviceError(
            f"{path}: permission denied",
            "add the user to the group spi (sudo usermod -aG spi $USER) and log in again",
        )
    return DeviceError(
        f"{path}: cannot be opened ({error.strerror or error})",
        "check that nothing else uses it, and load_cell_node's spi_clock",
    )
