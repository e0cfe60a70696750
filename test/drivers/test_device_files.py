"""Device files that another program holds or that this user may not open, named in one line."""

import errno
import fcntl
import grp
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
from support.wording import refused

from socket_testbed import drivers
from socket_testbed.drivers import DeviceBusyError
from socket_testbed.errors import DeviceError

# Command lines of a process 20 with the parent 10, and how both are named
RUN = ["/opt/st/.venv/bin/python", "/opt/st/.venv/bin/socket-testbed", "run", "--record", "a"]
NODE = ["/opt/st/.venv/bin/python3.12", "-m", "socket_testbed.nodes", "cluster_node", "--ros-args"]
COMMANDS = {
    "node": (RUN, NODE, "process 10, socket-testbed run --record a"),
    "module": (
        ["python3", "-m", "socket_testbed", "run"],
        NODE,
        "process 10, socket-testbed run",
    ),
    "spare": (
        RUN,
        ["python", "-m", "socket_testbed.nodes", "spare"],
        "process 10, socket-testbed run --record a",
    ),
    "launched": (
        ["/usr/bin/python3", "/opt/ros/jazzy/bin/ros2", "launch"],
        NODE,
        "process 20, socket_testbed.nodes cluster_node --ros-args",
    ),
    "doctor": (
        ["bash"],
        ["python", "/opt/st/bin/socket-testbed", "doctor"],
        "process 20, socket-testbed doctor",
    ),
    "foreign": (["bash"], ["/usr/bin/i2cdetect", "-y", "1"], "process 20, i2cdetect -y 1"),
    "kernel": (["bash"], [], "process 20"),
}


@pytest.mark.parametrize("case", COMMANDS)
def test_a_process_is_named_by_what_was_typed(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parent, own, words = COMMANDS[case]
    for number, command in ((10, parent), (20, own)):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "cmdline").write_bytes(b"".join(word.encode() + b"\0" for word in command))
        (folder / "stat").write_text(f"{number} (a name) with) S 10 20 20 0")
    monkeypatch.setattr(drivers, "_PROCESSES", tmp_path)
    assert drivers.described(20) == words


def test_a_process_that_has_ended_has_its_number() -> None:
    assert drivers.described(2**22 + 1) == "process 4194305" and drivers.described(0) == ""


def test_a_long_command_is_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "20").mkdir()
    (tmp_path / "20" / "cmdline").write_bytes(b"a" * 100)
    monkeypatch.setattr(drivers, "_PROCESSES", tmp_path)
    assert drivers.described(20) == f"process 20, {'a' * 60}..."


@pytest.mark.parametrize(
    "text",
    ["", "1: POSIX ADVISORY WRITE 5 {place} 0 EOF\n", "1: FLOCK ADVISORY WRITE x {place} 0 EOF\n"],
    ids=["empty", "another kind", "no number"],
)
def test_an_unknown_holder_has_no_name(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = (os.open(tmp_path / "i2c-1", os.O_RDWR | os.O_CREAT) for _ in range(2))
    found = os.fstat(first)
    place = f"{os.major(found.st_dev):02x}:{os.minor(found.st_dev):02x}:{found.st_ino}"
    locks = tmp_path / "locks"
    locks.write_text(text.format(place=place))
    monkeypatch.setattr(drivers, "_LOCKS", locks)
    fcntl.flock(first, fcntl.LOCK_EX)
    with refused(DeviceBusyError, "another program uses i2c-1: end it first"):
        drivers.lock_device(second, "i2c-1")
    os.close(first)
    drivers.lock_device(second, "i2c-1")
    os.close(second)


def test_the_group_of_a_file_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "i2c-1"
    path.touch(0o660)
    path.chmod(0o660)
    monkeypatch.setattr(grp, "getgrgid", lambda gid: SimpleNamespace(gr_name="plugdev"))
    with refused(DeviceError, "group plugdev (sudo usermod -aG plugdev $USER)"):
        raise drivers.opening_failed(str(path), PermissionError(errno.EACCES, "x"), "i2c", "", "")


@pytest.mark.parametrize(("group", "mode"), [("root", 0o660), ("plugdev", 0o600)], ids=str)
def test_a_group_that_does_not_help_is_not_named(
    group: str, mode: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "i2c-1"
    path.touch()
    path.chmod(mode)
    monkeypatch.setattr(grp, "getgrgid", lambda gid: SimpleNamespace(gr_name=group))
    with refused(DeviceError, "may not use it", 'udev rule KERNEL=="i2c-1", GROUP="i2c"'):
        raise drivers.not_permitted(str(path), "i2c")
