"""Files of the package, all-or-nothing outputs, and requests to the operating system."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import shutil
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

from socket_testbed.errors import ConfigurationError

# The configuration of a testbed, in `config/` and in the folder of each trial
SOCKET_FILE, CALIBRATION_FILE, PARAMETERS_FILE = "socket.yaml", "calibration.yaml", "testbed.yaml"
CONFIGURATION_FILES = (SOCKET_FILE, CALIBRATION_FILE, PARAMETERS_FILE)

TABLES, PICTURES, PAGES = (".csv", ".parquet", ".mat"), (".png", ".pdf", ".svg"), (".html", ".htm")

REPLACE_HINT = "name another output, or replace it with --replace (in Python, replace=True)"

PARENT = "SOCKET_TESTBED_PARENT"  # environment variable: the process that started this one
_PR_SET_PDEATHSIG = 1
_TEMPORARY_PREFIX, _TEMPORARY_MARK = "socket_testbed_", ".temporary"
_MIN_AGE = 60.0  # [s]; a younger folder may not be locked yet

_new_outputs: set[Path] = set()  # outputs that did not exist before the work


def packaged(folder: str, name: str) -> Path:
    """Path of a file of the package, in the checkout or the installation.

    Args:
        folder: The folder, `config` or `msg`.
        name: The file's name in it.

    Raises:
        ConfigurationError: If the file is in neither.
    """
    here = Path(__file__).resolve()
    in_checkout = {"msg": "msg_defs/msg"}.get(folder, folder)
    candidates = [here.parents[1] / in_checkout / name]
    candidates += [parent / "share" / "socket_testbed" / folder / name for parent in here.parents]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise ConfigurationError(
        f"{folder}/{name} of the package is not installed", "install the package again"
    )


def file_or_packaged(given: Path | str | None, name: str) -> Path:
    """The given file or, without one, the package's own.

    Args:
        given: The file; None or an empty text for the package's own.
        name: Name of the package's own file in `config`, such as `socket.yaml`.
    """
    return Path(given) if given else packaged("config", name)


def refuse_existing(path: Path) -> None:
    """Refuse to overwrite anything.

    Raises:
        ConfigurationError: If the path exists.
    """
    if path.exists():
        raise ConfigurationError(f"{path} exists already", "name another output or remove it")


def end_with_parent(number: signal.Signals) -> None:
    """Ask the kernel to send this process a signal when its parent ends (Linux)."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)


def end_with_starter() -> None:
    """End cleanly with the command that started this process, if any."""
    starter = os.environ.get(PARENT)
    if starter is None:
        return
    end_with_parent(signal.SIGTERM)
    if os.getppid() != int(starter):  # it ended before the request to the kernel
        os.kill(os.getpid(), signal.SIGTERM)


# Hints by the kind of error; any other is taken for a disk that is not there any more.
_DISK_HINTS = {
    errno.ENOSPC: "make space",
    errno.EDQUOT: "make space, or raise the quota",
    errno.EFBIG: "use a disk with ext4 or exFAT, as its file system takes no larger file",
    errno.EROFS: "check its file system for errors, and mount it again for writing",
    errno.EACCES: "check the permissions",
    errno.EPERM: "check the permissions",
    errno.EEXIST: "name another folder",
    errno.ENOTDIR: "name another folder, a part of its path is a file",
    errno.ENAMETOOLONG: "give a shorter name",
    errno.EINVAL: "its file system does not take this name, use letters, digits, - and _",
}


def disk_hint(error: OSError) -> str:
    """A hint for an error of a disk.

    Args:
        error: The error, of reading or writing on the disk.
    """
    gone = "check that its disk is connected, and what dmesg says of it"
    return _DISK_HINTS.get(error.errno or 0, gone)


def is_reachable(path: Path) -> bool:
    """Whether a path exists and its disk answers."""
    try:
        return path.exists()
    except OSError:
        return False


def sync(path: Path) -> None:
    """Flush a file or the entries of a folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def hold(folder: Path) -> int:
    """Lock a folder until the returned descriptor is closed or the process ends."""
    descriptor = os.open(folder, os.O_RDONLY)
    with suppress(OSError):  # unsupported on network drives
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    return descriptor


def is_held(folder: Path) -> bool:
    """Whether a process on this machine has locked a folder."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:  # unsupported on network drives
        return isinstance(error, BlockingIOError)
    finally:
        os.close(descriptor)
    return False


class TemporaryFolder(TemporaryDirectory[str]):
    """A temporary folder; creating one also removes those left by killed processes."""

    def __init__(self) -> None:
        for mark in Path(gettempdir()).glob(f"{_TEMPORARY_PREFIX}*/{_TEMPORARY_MARK}"):
            with suppress(OSError):  # another user's
                if time.time() - mark.stat().st_mtime > _MIN_AGE and not is_held(mark.parent):
                    shutil.rmtree(mark.parent)
        super().__init__(prefix=_TEMPORARY_PREFIX)
        (Path(self.name) / _TEMPORARY_MARK).touch()
        self._held = hold(Path(self.name))

    def cleanup(self) -> None:
        """Remove the folder."""
        super().cleanup()
        os.close(self._held)


def check_outputs(*paths: Path | None, replace: bool) -> None:
    """Check output files before any work: an existing file is replaced only on request.

    Args:
        paths: The files; None for an output that is not wanted.
        replace: Whether to replace existing outputs.

    Raises:
        ConfigurationError: If an output exists and is not to be replaced, is a folder, or cannot
            be written where it is wanted.
    """
    for path in filter(None, paths):
        if path.is_dir():
            raise ConfigurationError(f"{path} exists already as a folder", "name a file")
        if path.exists() and not replace:
            raise ConfigurationError(f"{path} exists already", REPLACE_HINT)
        _require_parent(path)
        if replace:
            _new_outputs.discard(path.resolve())
        else:
            _new_outputs.add(path.resolve())


def check_new_folder(path: Path) -> None:
    """Refuse an existing folder, or one whose grandparent is missing.

    Raises:
        ConfigurationError: If the folder exists or cannot be made there.
    """
    refuse_existing(path)
    if not path.parent.exists():
        _require_parent(path.parent)


def make_folder(path: Path) -> None:
    """Create a folder and its parents, unless it exists.

    Raises:
        ConfigurationError: If the folder cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"{path}: cannot be made ({error.strerror})", disk_hint(error)
        ) from None


def _require_parent(path: Path) -> None:
    """Refuse a path whose folder does not exist (a typo, say) or is not writable."""
    parent, hint = path.parent, "correct the path, or make the folder first"
    if not parent.exists():
        why = f"no such folder as {parent}"
    elif not parent.is_dir():
        why = f"{parent} is not a folder"
    elif not os.access(parent, os.W_OK):
        why, hint = f"no permission to write in {parent}", "name another folder"
    else:
        return
    raise ConfigurationError(f"{path}: cannot be written ({why})", hint)


def check_suffix(path: Path, known: Sequence[str], what: str) -> None:
    """Refuse a file whose suffix is not that of a picture, a table, ...

    Args:
        path: The file; capitals in its suffix do not matter.
        known: The suffixes allowed, in small letters with their dot, such as `.csv`.
        what: What the file would hold, such as `table`, for errors.

    Raises:
        ConfigurationError: If the suffix is another one.
    """
    if path.suffix.lower() not in known:
        given = f"'{path.suffix}'" if path.suffix else "a name without a suffix"
        fact = f"{path}: {given} is not the format of a {what}"
        raise ConfigurationError(fact, f"name a {', '.join(known[:-1])} or {known[-1]} file")


@contextmanager
def atomic_output(path: Path, replace: bool = False) -> Iterator[Path]:
    """Write a file or folder next to its final place and rename it once it is complete.

    A file replaces an older one, unless `check_outputs` found none. If several processes write one
    new output, the first to finish wins.

    Args:
        path: The final path; its folder must exist.
        replace: Whether a folder may replace an older one.

    Yields:
        The path to write to: it has the final name, in another folder, and does not exist.

    Raises:
        ConfigurationError: If the output cannot be written there, or another run wrote it
            meanwhile.
    """
    path = path.resolve()  # keep symbolic links
    _require_parent(path)
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ConfigurationError(f"{path} is not an ordinary file", "name a file for the output")
    try:
        with TemporaryDirectory(
            ".partial", f".{path.name}.", path.parent, ignore_cleanup_errors=True
        ) as staging:
            new = Path(staging) / path.name
            yield new
            if path in _new_outputs and path.exists():
                raise FileExistsError(errno.EEXIST, "")
            _new_outputs.discard(path)
            if replace and new.is_dir() and path.is_dir():
                path.replace(Path(staging) / f"older {path.name}")
            new.replace(path)
    except OSError as error:
        if error.errno in {errno.ENOTEMPTY, errno.EEXIST}:
            raise ConfigurationError(
                f"{path} exists already: another run wrote it meanwhile",
                "name another output or remove it",
            ) from None
        raise ConfigurationError(
            f"{path}: cannot be written ({error.strerror or error})", disk_hint(error)
        ) from None


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, in UTF-8.

    Args:
        path: The file; an older one is replaced.
        text: The content.

    Raises:
        ConfigurationError: If the file cannot be written there.
    """
    with atomic_output(path) as staging:
        staging.write_text(text, encoding="utf-8")
