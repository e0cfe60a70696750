"""What a result was made from: contents of files, settings and software, as a fingerprint."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from socket_testbed.batch.job import Job
from socket_testbed.errors import TrialError

_SOLVING = ("numpy", "scipy", "qpsolvers", "osqp")


def fingerprint(job: Job, settings: Mapping[str, Any]) -> dict[str, str]:
    """What the result of a job depends on, by names for the user.

    Contents count, not times: a copied trial is the same, a file restored with an old date is not.

    Raises:
        TrialError: If a file cannot be read.
    """
    return (
        {f"trial/{path.name}": file_digest(path) for path in _files_of(job.trial.path)}
        | {name: file_digest(path) for name, path in job.files.items() if path.exists()}
        | {f"setting {name}": json.dumps(value) for name, value in settings.items()}
        | _software()
    )


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content.

    Raises:
        TrialError: If the file cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise _unreadable(path, error) from None


def _files_of(trial: Path) -> list[Path]:
    try:
        return sorted(p for p in trial.iterdir() if p.is_file() and not p.name.startswith("."))
    except OSError as error:
        raise _unreadable(trial, error) from None


def _unreadable(path: Path, error: OSError) -> TrialError:
    return TrialError(
        f"{path}: cannot be read ({error.strerror})",
        "check the path and its permissions, also on the machine of the worker",
    )


@cache
def _software() -> dict[str, str]:
    """The package by its sources, since a checkout changes without a new version."""
    package = Path(__file__).resolve().parents[1]
    sources = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        sources.update(f"{path.relative_to(package).as_posix()} {file_digest(path)}\n".encode())
    return {"socket_testbed": sources.hexdigest()} | {name: version(name) for name in _SOLVING}
