"""Device files under /dev that cannot be opened: the fact and the hint."""

from __future__ import annotations

import errno
import os

from socket_testbed.errors import DeviceError


def opening_failed(
    path: str, error: OSError, group: str, missing: str, otherwise: str
) -> DeviceError:
    """The error of a device file that could not be opened.

    Args:
        path: The device file.
        error: Why it could not be opened.
        group: Group whose members may use it.
        missing: Hint if there is no such file.
        otherwise: Hint if it cannot be opened for another reason.
    """
    if error.errno in {errno.EACCES, errno.EPERM}:
        return DeviceError(
            f"{path}: permission denied",
            f"add the user to the group {group} (sudo usermod -aG {group} $USER), then log in"
            " again",
        )
    if error.errno in {errno.ENOENT, errno.ENODEV, errno.ENXIO}:
        return DeviceError(f"there is no {path}", missing)
    return DeviceError(f"{path} cannot be opened ({reason(error)})", otherwise)


def reason(error: OSError) -> str:
    """The system's text for an error."""
    return os.strerror(error.errno) if error.errno else str(error)
