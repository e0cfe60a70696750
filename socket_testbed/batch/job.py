"""One trial's share of the work, and what came of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeAlias

from socket_testbed.trials.trial import Trial

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
