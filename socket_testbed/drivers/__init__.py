"""Drivers, one folder per instrument; they run unchanged on simulated buses.

Each chip or protocol has its own file (`clusters/fdc1004.py`, `load_cell/ads131m0x.py`,
`natnet/messages.py`) with its registers and frames. It checks every answer and raises a
`DeviceError` with a hint. The bus (`I2cBus`, `SpiDevice`, `Lines`) is passed in, so a simulated
chip can replace the hardware: `simulation/devices/` has the other side of each bus under the same
names. Another chip can replace the clusters' FDC1004 (`CapacitiveChip`).

A reader (`clusters/reader.py`, `load_cell/load_cell.py`, `natnet/client.py`) decides when to read,
recovers from failures, and returns the values for a trigger and the instrument's health. It never
raises for a hardware fault. Each has one place that handles faults: `_Bus.handle_fault` (I2C,
including a hanging or missing bus), `ConverterReader._fail` (SPI), `NatNetClient._lose` (network).
A trigger without its edge raises a `DeviceError`.
"""

from __future__ import annotations

import errno

from socket_testbed.errors import DeviceError

OK, WARN, ERROR = 0, 1, 2  # levels of an instrument's health, as in DiagnosticStatus of ROS
RECENT = 0.8  # [s]; how long a fault is reported after it has ended


def opening_failed(
    path: str, error: OSError, group: str, missing: str, otherwise: str
) -> DeviceError:
    """The error for a device file that could not be opened, with the hint that suits its cause.

    Args:
        path: The device file, such as /dev/i2c-1.
        error: What opening it raised; its `errno` tells the cause.
        group: Group of users with access to the file; the hint after a refused permission.
        missing: Hint if there is no such file or device.
        otherwise: Hint for any other cause.
    """
    if error.errno in {errno.EACCES, errno.EPERM}:
        return DeviceError(
            f"{path}: permission denied",
            f"add the user to the group {group} (sudo usermod -aG {group} $USER), then log in"
            " again",
        )
    if error.errno in {errno.ENOENT, errno.ENODEV, errno.ENXIO}:
        return DeviceError(f"there is no {path}", missing)
    return DeviceError(f"{path} cannot be opened ({error.strerror or error})", otherwise)
