"""A folder of trials worked on: in parallel, what is done skipped, with a summary at the end."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

from threadpoolctl import threadpool_limits

from socket_testbed.batch.jobs import (
    Cell,
    Job,
    Outcome,
    Record,
    Row,
    Status,
    Task,
    changes,
    file_digest,
    fingerprint,
    read_record,
    record_path,
    require_own_folder,
    write_record,
)
from socket_testbed.batch.pool import Pool, spread
from socket_testbed.errors import TestbedError, TrialError
from socket_testbed.identification.evaluation import ChannelErrors, summarise_errors
from socket_testbed.identification.fit import Fit
from socket_testbed.identification.model_file import finite_or_null
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.tables import Column, write_table

NAME = "summary"
MEANS = {
    "mean moment RMSE": "mean_moment_rmse [N m]",
    "mean force RMSE": "mean_force_rmse [N]",
    "median local RMSE": "median_local_rmse [N]",
}


def segment_columns(segment: Segment) -> Row:
    """The segment of a trial."""
    return {
        "segment": segment.kind,
        "segment_start [s]": segment.start,
        "segment_end [s]": segment.end,
    }


def error_columns(errors: Sequence[ChannelErrors]) -> Row:
    """The means and the median that the paper quotes, then the errors of every channel."""
    summary = summarise_errors(errors)
    means = (summary.moment_rmse, summary.force_rmse, summary.local_rmse)
    row: Row = dict(zip(MEANS.values(), means, strict=True))
    for error in errors:
        row |= {
            f"{error.name}_rmse [{error.unit}]": error.rmse,
            f"{error.name}_mae [{error.unit}]": error.mae,
            f"{error.name}_sigma [{error.unit}]": error.sigma,
            f"{error.name}_skill [-]": error.skill,
        }
    return {name: finite_or_null(value) for name, value in row.items()}


def certificate_columns(fit: Fit) -> Row:
    """How well both stages are solved, the worse of them, in scaled units."""
    certificates = (fit.stage_one.certificate, fit.stage_two.certificate)
    return {
        "kkt_residual [-]": max(c.stationarity for c in certificates),
        "duality_gap [-]": max(c.gap for c in certificates),
    }


def main_figures(row: Row) -> str:
    """The means and the median of a row in words."""
    return ", ".join(
        f"{words} {value:.3f} {_unit(name)}"
        for words, name in MEANS.items()
        if isinstance(value := row.get(name), float)
    )


def write_summary(outcomes: Sequence[Outcome], folder: Path) -> tuple[Path, Path]:
    """Write the table as `summary.csv` and `summary.parquet`, a row an outcome.

    A job that was skipped is `ok`: the table says what there is, not in which run it was made.

    Returns:
        The paths of both files.

    Raises:
        ConfigurationError: If they cannot be written.
    """
    rows = [_full_row(outcome) for outcome in outcomes]
    names = dict.fromkeys(name for row in rows for name in row)
    columns = [_column(name, [row.get(name) for row in rows]) for name in names]
    paths = folder / f"{NAME}.csv", folder / f"{NAME}.parquet"
    for path in paths:
        write_table(columns, path)
    return paths


def _full_row(outcome: Outcome) -> Row:
    status = Status.OK if outcome.status is Status.SKIPPED else outcome.status
    return {
        "trial": outcome.name,
        "status": status.value,
        "error": outcome.error,
        **outcome.row,
    }


def _column(title: str, cells: list[Cell]) -> Column:
    unit = _unit(title)
    return Column(title.removesuffix(f" [{unit}]"), unit, cells)


def _unit(title: str) -> str:
    return title.partition(" [")[2].removesuffix("]")


def execute(task: Task, job: Job) -> Outcome:
    """Do a job unless it is done; an error becomes its outcome, so that the others go on."""
    try:
        return _do_once(task, job)
    except TestbedError as error:
        return Outcome(job.name, Status.FAILED, error=str(error))
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return Outcome(
            job.name,
            Status.FAILED,
            error=f"{job.trial.path}: unexpected {reason}: run '{task.verb}' on this trial alone"
            " and report what it says",
        )


def _do_once(task: Task, job: Job) -> Outcome:
    path = record_path(task, job)
    inputs = fingerprint(job, task.settings)
    record = read_record(path)
    changed: tuple[str, ...] = ()
    if record is not None:
        changed = changes(record, inputs, job.output)
        if not changed and not task.again:
            return Outcome(job.name, Status.SKIPPED, record.row)
        # A result of other inputs must not stay and pass for this one if the work now fails.
        job.output.unlink(missing_ok=True)
        path.unlink()
    row = _work(task, job)
    write_record(Record(inputs, file_digest(job.output), row), path)
    return Outcome(job.name, Status.OK, row, changed=changed)


def _work(task: Task, job: Job) -> Row:
    start = time.perf_counter()
    notes: dict[str, None] = {}
    trial = dataclasses.replace(job.trial, tell=lambda note: notes.update({note: None}))
    with threadpool_limits(1):  # the cores are for as many trials, not for one's linear algebra
        row = task.work(dataclasses.replace(job, trial=trial))
    elapsed = round(time.perf_counter() - start, 3)
    return {**row, "computing_time [s]": elapsed, "notes": "; ".join(notes) or None}


def run_batch(
    task: Task,
    jobs: Sequence[Job],
    pool: Pool,
    tell: Callable[[str], None],
    warn: Callable[[str], None],
) -> list[Outcome]:
    """Do a task on every trial, and write the summary table into the task's folder.

    What is finished stays, also when it is interrupted; the summary then says which trials were
    not reached.

    Args:
        task: What is done with a trial.
        jobs: The trials, by `plan_jobs`.
        pool: Where it is done.
        tell: Called with a line a finished trial, and one that names the summary.
        warn: Called with each note on a trial and, at the end, each trial that failed.

    Returns:
        What came of the jobs, in their order.

    Raises:
        ConfigurationError: If the folder of the outputs is not the task's own, or the Dask cluster
            cannot be reached.
        TrialError: At the end, if any trial failed; all others are done.
    """
    task = replace(task, folder=task.folder.absolute())  # a worker may be elsewhere
    require_own_folder(task)
    outcomes = [Outcome(job.name, Status.NOT_REACHED) for job in jobs]
    done = 0
    try:
        with closing(spread(partial(execute, task), jobs, pool)) as results:
            for done, (number, result) in enumerate(results, start=1):
                outcome = _lost(jobs[number], result) if isinstance(result, Exception) else result
                outcomes[number] = outcome
                tell(f"[{done}/{len(jobs)}] {describe(outcome)}")
                if outcome.row.get("notes"):
                    warn(f"note: {outcome.name}: {outcome.row['notes']}")
    finally:
        if done:  # else an older summary stays, as its results do
            paths = write_summary(outcomes, task.folder)
    tell(f"summary in {paths[0]} and {paths[1].name}")
    _raise_failures(outcomes, warn)
    return outcomes


def describe(outcome: Outcome) -> str:
    """What came of a job, in a line."""
    words = f"{outcome.name}: {outcome.status.value}"
    if outcome.status is Status.FAILED:
        return f"{words}: {outcome.error}"
    if outcome.changed:
        words += f" again (changed: {', '.join(outcome.changed)})"
    figures = main_figures(outcome.row)
    return f"{words}, {figures}" if figures else words


def _lost(job: Job, error: Exception) -> Outcome:
    reason = " ".join(f"{type(error).__name__}: {error}".split())
    return Outcome(
        job.name,
        Status.FAILED,
        error=f"{job.trial.path}: its worker failed ({reason}): check that the worker has this"
        " package and memory enough, or give fewer --jobs",
    )


def _raise_failures(outcomes: Sequence[Outcome], warn: Callable[[str], None]) -> None:
    failed = [outcome for outcome in outcomes if outcome.status is Status.FAILED]
    for outcome in failed:
        warn(f"{outcome.name}: {outcome.error}")
    if failed:
        raise TrialError(
            f"{len(failed)} of {len(outcomes)} trials failed",
            "fix them and run it again: finished trials are kept",
        )
