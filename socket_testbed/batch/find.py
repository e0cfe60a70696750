"""Trials in a folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from socket_testbed.errors import TrialError

_STORAGE = (".mcap", ".db3")


def is_trial(folder: Path) -> bool:
    """Whether a folder is a bag: it holds a metadata.yaml or a storage file itself.

    A bag that is broken is a trial all the same, so that it is missed by nobody.
    """
    return (folder / "metadata.yaml").exists() or any(
        file.suffix in _STORAGE for file in folder.iterdir()
    )


def find_trials(folder: Path) -> dict[str, Path]:
    """Find the trials below a folder, at any depth.

    Hidden folders and what lies within a trial are passed over; links are followed.

    Args:
        folder: The folder, or anything else.

    Returns:
        The trials' folders in the order of their names, which are their paths below the folder,
        such as `s01/hold`. Empty if the folder is a trial itself or no folder.

    Raises:
        TrialError: If a folder cannot be read.
    """
    try:
        if not folder.is_dir() or is_trial(folder):
            return {}
        found = {path.relative_to(folder).as_posix(): path for path in _walk(folder, ())}
    except OSError as error:
        raise TrialError(
            f"{error.filename}: cannot be read ({error.strerror})", "check the permissions"
        ) from None
    return dict(sorted(found.items()))


def _walk(folder: Path, above: tuple[Path, ...]) -> Iterator[Path]:
    real = folder.resolve()
    if real in above:  # a link leads back
        return
    for path in folder.iterdir():
        if path.name.startswith(".") or not path.is_dir():
            continue
        if is_trial(path):
            yield path
        else:
            yield from _walk(path, (*above, real))
