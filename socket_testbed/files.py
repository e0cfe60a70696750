"""Files that come with the package, and outputs that are whole or not there."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from socket_testbed.errors import ConfigurationError


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
    """Refuse to write over something.

    Raises:
        ConfigurationError: If the path exists.
    """
    if path.exists():
        raise ConfigurationError(f"{path} exists already", "name another output or remove it")


@contextmanager
def whole_output(path: Path) -> Iterator[Path]:
    """Write an output under another name beside it; it gets its name only when it is whole.

    A file replaces an older one; a folder must not exist yet.

    Args:
        path: The output, a file or a folder.

    Yields:
        The path to write to, with the same last part, in a folder that did not exist.

    Raises:
        ConfigurationError: If the output cannot be written.
    """
    path = path.resolve()  # a link stays a link
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ConfigurationError(f"{path} is no ordinary file", "name a file for the output")
    staging = path.parent / f".{path.name}.partial"
    try:
        shutil.rmtree(staging, ignore_errors=True)
        staging.mkdir(parents=True)
        yield staging / path.name
        (staging / path.name).replace(path)
    except OSError as error:
        raise ConfigurationError(
            f"{path}: cannot be written ({error.strerror or error})",
            "check the folder, its permissions and the space left",
        ) from None
    finally:
        shutil.rmtree(staging, ignore_errors=True)
