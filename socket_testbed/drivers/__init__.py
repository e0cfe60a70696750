"""The drivers, a folder per instrument, unchanged with a simulated bus behind them.

A chip has a file of its own name (`clusters/fdc1004.py`, `load_cell/ads131m0x.py`,
`natnet/messages.py` for a protocol): its registers and frames, every answer checked, a
`DeviceError` with a hint for whatever is wrong. It is given its bus (`I2cBus`, `SpiDevice`,
`Lines`), so that a simulated chip fits behind: `simulation/devices/` has the other side of each
bus under the same names. The clusters' chip can be another one (`CapacitiveChip`).

A reader beside it (`clusters/reader.py`, `load_cell/load_cell.py`, `natnet/client.py`) decides
when to read, starts again after a failure, and gives the values for a trigger and the instrument's
health. It never raises for a fault of the hardware: what one costs is decided in one place each,
`_Bus.note` (I2C, a bus that hangs or is gone included), `ConverterReader._fail` (SPI),
`NatNetClient._lose` (the network); a trigger without its edge is a `DeviceError`.
"""

from __future__ import annotations

import errno

from socket_testbed.errors import DeviceError


def opening_failed(
    path: str, error: OSError, group: str, missing: str, otherwise: str
) -> DeviceError:
    """The error of a device file that could not be opened, and that the members of a group may use.

    Its hint is `missing` if there is no such file.
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
