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

A device file is locked by the program that opens it: two programs on one bus would read each
other's values, as selecting a cluster and reading it are two transfers.
"""

from __future__ import annotations

import errno
import fcntl
import grp
import os
import stat
from contextlib import suppress
from pathlib import Path

from socket_testbed.errors import DeviceError

OK, WARN, ERROR = 0, 1, 2  # levels of an instrument's health, as in DiagnosticStatus of ROS
RECENT = 0.8  # [s]; how long a fault is reported after it has ended

# The device, its driver or its adapter is not there (any more):
GONE = frozenset({errno.ENODEV, errno.ENOENT, errno.EBADF, errno.ESHUTDOWN})

_LOCKS = Path("/proc/locks")
_PROCESSES = Path("/proc")
_PACKAGE, _NODES, _VERBS = "socket_testbed", "socket_testbed.nodes", "socket-testbed"
_MAX_COMMAND = 60  # [characters]


class DeviceBusyError(DeviceError):
    """Another program uses the device.

    Args:
        name: Name of the device, such as i2c-1.
        user: Who uses it, such as "process 1234, socket-testbed run"; empty if unknown.
    """

    def __init__(self, name: str, user: str = "") -> None:
        by = f" ({user})" if user else ""
        hint = "end it first (Ctrl-C, or systemctl stop if it is a service)"
        super().__init__(f"another program uses {name}{by}", hint)


def lock_device(file: int, name: str) -> None:
    """Lock an open device file against other programs of this testbed until it is closed.

    Args:
        file: Its file descriptor.
        name: Name of the device, such as i2c-1.

    Raises:
        DeviceBusyError: Another program has locked it.
        OSError: The file cannot be locked.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise DeviceBusyError(name, described(_lock_holder(file))) from None


def _lock_holder(file: int) -> int:
    """The process that has locked an open file; 0 if it is unknown."""
    found = os.fstat(file)
    place = f"{os.major(found.st_dev):02x}:{os.minor(found.st_dev):02x}:{found.st_ino}"
    with suppress(OSError, ValueError):
        for line in _LOCKS.read_text().splitlines():
            words = line.split()  # such as 1: FLOCK ADVISORY WRITE 1234 00:06:85 0 EOF
            if words[1:2] == ["FLOCK"] and words[5:6] == [place]:
                return max(int(words[4]), 0)
    return 0


def described(process: int) -> str:
    """A process in words, with the command that started it; empty for 0.

    Args:
        process: Its number; that of a node is replaced by the command that runs the testbed.
    """
    if not process:
        return ""
    command = _command(process)
    if command[:1] == [_NODES]:
        # A node is named by the command that the user has typed, which ends it as well.
        starter = _starter(process)
        if (typed := _command(starter))[:1] in ([_VERBS], [_PACKAGE]):
            process, command = starter, [_VERBS, *typed[1:]]
    if not command:
        return f"process {process}"
    words = " ".join(command)
    short = words if len(words) <= _MAX_COMMAND else f"{words[:_MAX_COMMAND]}..."
    return f"process {process}, {short}"


def _command(process: int) -> list[str]:
    """The command of a process without its folder, and without Python if that runs it."""
    words: list[str] = []
    with suppress(OSError):
        given = (_PROCESSES / str(process) / "cmdline").read_bytes().split(b"\0")
        words = [word.decode(errors="replace") for word in given if word]
    if words and Path(words[0]).name.startswith("python"):
        words = [word for k, word in enumerate(words) if k and (k > 1 or word != "-m")]
    return [Path(words[0]).name, *words[1:]] if words else []


def _starter(process: int) -> int:
    """The parent of a process; 0 if it is unknown."""
    with suppress(OSError, ValueError, IndexError):
        # The name of the program, in brackets, may hold spaces.
        text = (_PROCESSES / str(process) / "stat").read_text()
        return int(text.rpartition(")")[2].split()[1])
    return 0


def opening_failed(
    path: str, error: OSError, group: str, missing: str, otherwise: str
) -> DeviceError:
    """The error for a device file that could not be opened, with the hint that suits its cause.

    Args:
        path: The device file, such as /dev/i2c-1.
        error: What opening it raised; its `errno` tells the cause.
        group: Group that the distribution gives such files; the hint after a refused permission
            names the group of this file, if it can be read.
        missing: Hint if there is no such file or device.
        otherwise: Hint for any other cause.
    """
    if error.errno in {errno.EACCES, errno.EPERM}:
        return not_permitted(path, group)
    if error.errno in GONE | {errno.ENXIO}:
        return DeviceError(f"there is no {path}", missing)
    return DeviceError(f"{path} cannot be opened ({error.strerror or error})", otherwise)


def not_permitted(path: str, group: str) -> DeviceError:
    """The error for a device file that this user may not open, with the group that may.

    Args:
        path: The device file.
        group: Group that the distribution gives such files, if this file's cannot be read.
    """
    own = group
    with suppress(OSError, KeyError):
        found = Path(path).stat()
        own = grp.getgrgid(found.st_gid).gr_name
        needed = stat.S_IRGRP | stat.S_IWGRP
        if own == "root" or found.st_mode & needed != needed:
            return DeviceError(
                f"{path}: permission denied, and its group {own} may not use it",
                f'give it to a group with the udev rule KERNEL=="{Path(path).name}",'
                f' GROUP="{group}", MODE="0660" (docs/hardware.md)',
            )
    return DeviceError(
        f"{path}: permission denied",
        f"add the user to the group {own} (sudo usermod -aG {own} $USER), then log in again",
    )
