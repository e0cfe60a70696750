"""Files of the package, outputs that are complete or not there, and requests to the system."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import shutil
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

from socket_testbed.errors import ConfigurationError

RANGE, _LOCAL = "ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"
# Of Fast DDS, whose newer versions read another name.
_PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
_PR_SET_PDEATHSIG = 1
_TEMPORARY = "socket_testbed_"
_NEW = 60.0  # [s]; a folder as new as this may not be held yet

_free: set[Path] = set()  # outputs that were not there before the work


def packaged(folder: str, name: str) -> Path:
    """Path of a file that comes with the package: in the checkout, or where it was installed.

    Args:
        folder: `config` or `msg`.
        name: Name of the file.
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


def refuse_existing(path: Path) -> None:
    """Refuse to write over something."""
    if path.exists():
        raise ConfigurationError(f"{path} exists already", "name another output or remove it")


def local_graph() -> dict[str, str]:
    """Variables that keep a ROS graph on this machine; none where the user's own open it."""
    if os.environ.get(RANGE, _LOCAL) != _LOCAL:
        return {}
    found = {RANGE: _LOCAL}
    if not any(name in os.environ for name in _PROFILES):
        found |= dict.fromkeys(_PROFILES, str(packaged("config", "loopback.xml")))
    return found


def end_with_parent(number: signal.Signals) -> None:
    """Ask the kernel to send this process a signal when its parent ends (Linux)."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)


def hold(folder: Path) -> int:
    """Hold a folder until the descriptor that it returns is closed, or the process ends."""
    descriptor = os.open(folder, os.O_RDONLY)
    with suppress(OSError):  # network drives cannot
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    return descriptor


def is_held(folder: Path) -> bool:
    """Whether a process of this machine holds a folder."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:  # network drives cannot
        return isinstance(error, BlockingIOError)
    finally:
        os.close(descriptor)
    return False


class TemporaryFolder(TemporaryDirectory[str]):
    """A folder until it is cleaned up; those that killed processes have left are removed."""

    def __init__(self) -> None:
        for left in Path(gettempdir()).glob(f"{_TEMPORARY}*"):
            with suppress(OSError):  # another's
                if time.time() - left.stat().st_mtime > _NEW and not is_held(left):
                    shutil.rmtree(left)
        super().__init__(prefix=_TEMPORARY)
        self._held = hold(Path(self.name))

    def cleanup(self) -> None:
        """Remove it."""
        super().cleanup()
        os.close(self._held)


def check_outputs(*paths: Path | None, replace: bool) -> None:
    """Refuse output files before any work: none replaces a file unless that is asked for.

    Args:
        paths: The files; None for one that is not wanted.
        replace: Whether outputs that exist are replaced.
    """
    for path in filter(None, paths):
        if path.is_dir():
            raise ConfigurationError(f"{path} exists already as a folder", "name a file")
        if path.exists() and not replace:
            raise ConfigurationError(
                f"{path} exists already", "name another output, or replace it with --replace"
            )
        _require_parent(path)
        if not replace:
            _free.add(path.resolve())


def check_new_folder(path: Path) -> None:
    """Refuse a folder that exists, or whose parent's parent does not."""
    refuse_existing(path)
    if not path.parent.exists():
        _require_parent(path.parent)


def make_folder(path: Path) -> None:
    """Make a folder, and those above it, unless it exists."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"{path}: cannot be made ({error.strerror})", "name another folder"
        ) from None


def _require_parent(path: Path) -> None:
    """Refuse a path in a folder that does not exist, as mistyped, or that cannot be written."""
    parent, hint = path.parent, "correct the path, or make the folder first"
    if not parent.exists():
        why = f"no such folder as {parent}"
    elif not parent.is_dir():
        why = f"{parent} is not a folder"
    elif not os.access(parent, os.W_OK):
        why, hint = f"no right to write in {parent}", "name another folder"
    else:
        return
    raise ConfigurationError(f"{path}: cannot be written ({why})", hint)


def check_picture(path: Path) -> None:
    """Refuse a file whose suffix names no format of a picture."""
    if path.suffix.lower() not in _PICTURES:
        raise ConfigurationError(
            f"{path}: a picture cannot be a '{path.suffix}' file", "name a .png or .pdf file"
        )


@contextmanager
def atomic_output(path: Path, replace: bool = False) -> Iterator[Path]:
    """Write a file or folder in a folder beside it; it gets its name only when it is complete.

    A file replaces an older one, but for one that was not there at `check_outputs`; a folder must
    not exist yet, unless `replace`. Of several processes that write the same new output the first
    to finish wins. Yields the path to write to, with the same last part, which does not exist.
    """
    path = path.resolve()  # a link stays a link
    _require_parent(path)
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ConfigurationError(f"{path} is not an ordinary file", "name a file for the output")
    try:
        with TemporaryDirectory(
            ".partial", f".{path.name}.", path.parent, ignore_cleanup_errors=True
        ) as staging:
            new = Path(staging) / path.name
            yield new
            if path in _free and path.exists():
                raise FileExistsError(errno.EEXIST, "")
            _free.discard(path)
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
            f"{path}: cannot be written ({error.strerror or error})",
            "check the folder, its permissions and the space left",
        ) from None


def write_text(path: Path, text: str) -> None:
    """Write a text file, complete or not at all."""
    with atomic_output(path) as staging:
        staging.write_text(text, encoding="utf-8")


_PICTURES = (".png", ".pdf")
WIDTHS = (88, 180)  # [mm]; of a figure: a column of a paper, and its page
