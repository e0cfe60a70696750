"""Many trials: found in a folder, a job each, done once by their fingerprints."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeAlias

from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.files import atomic_output
from socket_testbed.trials.trial import Trial

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


Cell: TypeAlias = str | int | float | None
Row: TypeAlias = dict[str, Cell]


@dataclass(frozen=True)
class Job:
    """Work on one trial.

    Attributes:
        name: Name of the trial: its path below the folder, such as `s01/hold`.
        trial: The trial.
        output: The file to write.
        files: The files that the result depends on besides the trial's, by what names them to the
            user, such as `--model`.
    """

    name: str
    trial: Trial
    output: Path
    files: Mapping[str, Path] = field(default_factory=dict)


Work: TypeAlias = Callable[[Job], Row]


@dataclass(frozen=True)
class Task:
    """What is done with every trial. It is sent to the workers, so it must be picklable.

    Attributes:
        verb: The verb that does it.
        folder: Folder of the outputs.
        work: Writes a job's output and returns its row of the summary: figures by column names
            that end in their unit, such as `Fx_rmse [N]`; None where there is none.
        settings: What the results depend on besides files, as JSON can hold it.
        again: Whether what is done is done again.
    """

    verb: str
    folder: Path
    work: Work
    settings: Mapping[str, Any] = field(default_factory=dict)
    again: bool = False


class Status(StrEnum):
    """What came of a job."""

    OK = "ok"
    SKIPPED = "skipped"
    FAILED = "failed"
    NOT_REACHED = "not reached"


@dataclass(frozen=True)
class Outcome:
    """What came of a job.

    Attributes:
        name: Name of the trial.
        status: What came of it.
        row: Its figures, by the names of the summary's columns.
        error: The one-line error of a job that failed.
        changed: What an older result differed in, and was therefore done again.
    """

    name: str
    status: Status
    row: Row = field(default_factory=dict)
    error: str | None = None
    changed: tuple[str, ...] = ()


def plan_jobs(
    trials: Mapping[str, Path],
    output: Path,
    suffix: str,
    socket_file: Path | None = None,
    calibration_file: Path | None = None,
    params_file: Path | None = None,
    unloaded: tuple[tuple[float, float], ...] = (),
) -> list[Job]:
    """The jobs of a folder of trials; all paths are absolute, as workers elsewhere need them.

    Args:
        trials: Folders of the trials by their names, as `find_trials` finds them.
        output: Folder of the outputs, which mirrors that of the trials.
        suffix: What ends the name of an output, such as `.json`.
        socket_file: A `socket.yaml` to use instead of each trial's own.
        calibration_file: A `calibration.yaml` to use instead of each trial's own.
        params_file: A `testbed.yaml` to use instead of each trial's own.
        unloaded: Spans without load in every trial, see `Trial`.
    """
    given = {"--geometry": socket_file, "--calibration": calibration_file, "--params": params_file}
    files = {name: path.absolute() for name, path in given.items() if path is not None}
    return [
        Job(
            name=name,
            trial=Trial(
                path.absolute(),
                files.get("--geometry"),
                files.get("--calibration"),
                unloaded=unloaded,
            ),
            output=output.absolute() / f"{name}{suffix}",
            files=files,
        )
        for name, path in trials.items()
    ]


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


_FOLDER = ".done"


@dataclass(frozen=True)
class Record:
    """What was done for a trial.

    Attributes:
        inputs: Fingerprint of what it was made from.
        output: Digest of what was written.
        row: Its figures.
    """

    inputs: dict[str, str]
    output: str
    row: Row


def record_path(task: Task, job: Job) -> Path:
    """Where the record of a job is kept."""
    return task.folder / _FOLDER / task.verb / f"{job.name}.json"


def require_own_folder(task: Task) -> None:
    """Refuse a folder of outputs that is a file or another verb's.

    Raises:
        ConfigurationError: Naming the folder.
    """
    if task.folder.exists() and not task.folder.is_dir():
        raise ConfigurationError(
            f"{task.folder} is no folder", "give a folder for the results of many trials"
        )
    records = task.folder / _FOLDER
    for verb in sorted(records.iterdir()) if records.is_dir() else []:
        if verb.name != task.verb:
            raise ConfigurationError(
                f"{task.folder} holds what '{verb.name}' wrote", "give a folder of its own"
            )


def write_record(record: Record, path: Path) -> None:
    """Write a record."""
    with atomic_output(path) as staging:
        staging.write_text(json.dumps(asdict(record), indent=1, allow_nan=False), encoding="utf-8")


def read_record(path: Path) -> Record | None:
    """The record of a job; None if there is none, or it is torn."""
    try:
        return Record(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def changes(record: Record, inputs: dict[str, str], output: Path) -> tuple[str, ...]:
    """Names of what is not any more as it was recorded; empty if all is done."""
    names = sorted(
        name
        for name in record.inputs.keys() | inputs.keys()
        if record.inputs.get(name) != inputs.get(name)
    )
    if not output.is_file() or file_digest(output) != record.output:
        names.append("the output")
    return tuple(names)
