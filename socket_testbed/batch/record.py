"""Records of what is done: an output's inputs, its content and its row of the summary."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from socket_testbed.batch.inputs import file_digest
from socket_testbed.batch.job import Job, Row, Task
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import whole_output

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
    with whole_output(path) as staging:
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
