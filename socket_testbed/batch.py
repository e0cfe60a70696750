"""Batches of trials: found in a folder, processed in parallel, summarised in one table."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from threadpoolctl import threadpool_limits

from socket_testbed.documents import load_json
from socket_testbed.errors import ConfigurationError, TestbedError, TrialError, option_of
from socket_testbed.files import (
    check_new_folder,
    check_outputs,
    end_with_parent,
    make_folder,
    write_text,
)
from socket_testbed.tables import split_unit, write_table
from socket_testbed.trials.metadata import METADATA_FILE
from socket_testbed.trials.trial import Trial
from socket_testbed.version import __version__

if TYPE_CHECKING:
    import pandas as pd

_RECORDS_FOLDER = ".done"
_DASK_TIMEOUT = "15s"  # for the scheduler to answer and a worker to appear

Row: TypeAlias = dict[str, str | int | float | None]
"""Values by column name; names of numbers end in their unit, such as `Fx_rmse [N]`."""


@dataclass(frozen=True)
class Job:
    """Work on one trial.

    Attributes:
        name: The trial's path below the folder of trials, such as `s01/hold`.
        trial: The trial.
        output: The file to write.
        files: Further input files that the result depends on, by option, such as `model`.
    """

    name: str
    trial: Trial
    output: Path
    files: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True)
class Task:
    """The work to do on every trial. It is sent to the workers, so it must be picklable.

    Attributes:
        verb: Name of the command, such as `fit`.
        folder: Folder of the outputs, of the summary, and of records of finished jobs.
        work: Writes a job's output and returns its summary row: values by column names that end in
            a unit, such as `Fx_rmse [N]`; None for a missing value.
        settings: Settings that affect the results, by name, as JSON can hold them.
        metadata: Fields of the trials' metadata that affect the results.
        again: Whether to repeat finished trials.
        replace: Whether to replace files that an earlier run did not write.
    """

    verb: str
    folder: Path
    work: Callable[[Job], Row]
    settings: Mapping[str, Any] = field(default_factory=dict)
    metadata: Sequence[str] = ()
    again: bool = False
    replace: bool = False


def plan_jobs(
    trials: Mapping[str, Trial], output: Path, suffix: str, files: Mapping[str, Path]
) -> list[Job]:
    """The jobs of a folder of trials; remote workers require absolute paths.

    Args:
        trials: Trials by name, their path below the folder of trials, such as `s01/hold`.
        output: Folder of the outputs, which mirrors that of the trials.
        suffix: Suffix of the outputs, such as `.json`.
        files: Further input files by option, such as `model`; a folder stands for the file in it
            with the trial's name, such as `models/s01/hold.json`.
    """
    return [
        Job(
            name,
            replace(trial, notify=None),  # notes come back with the row
            output / f"{name}{suffix}",
            {opt: file / f"{name}.json" if file.is_dir() else file for opt, file in files.items()},
        )
        for name, trial in trials.items()
    ]


def run_batch(
    task: Task,
    jobs: Sequence[Job],
    report: Callable[[str], None],
    warn: Callable[[str], None],
    processes: int | None = None,
    dask: str | None = None,
) -> None:
    """Run a task on every trial, and write `summary.csv` and `.parquet` into the task's folder.

    Finished results are kept, even on interruption; the summary then lists the trials that were
    not reached.

    Args:
        task: The work to do on each trial.
        jobs: The trials, from `plan_jobs`.
        report: Called with one line per finished trial, and one that names the summary.
        warn: Called with each note on a trial and, at the end, each failed trial.
        processes: Number of processes on this machine; None for one per core, 1 for this process.
        dask: Address of a Dask scheduler, such as `tcp://host:8786`, whose workers run the jobs.

    Raises:
        ConfigurationError: If the folder or its summary may not be written, Dask is not installed,
            or no scheduler with a worker answers.
        TrialError: At the end, if any trial failed.
    """
    task = replace(task, folder=task.folder.absolute())  # workers may be remote
    records = task.folder / _RECORDS_FOLDER / task.verb
    summaries = [task.folder / f"summary{suffix}" for suffix in (".csv", ".parquet")]
    if not task.folder.exists():
        check_new_folder(task.folder)
    elif set(records.parent.glob("*/")) != {records}:  # the summary may be another verb's
        check_outputs(*summaries, replace=task.replace)
    make_folder(records)
    rows: dict[str, Row] = {}
    try:
        with closing(_run_jobs(task, jobs, processes, dask)) as done:
            for name, row in done:
                rows[name] = row
                report(f"[{len(rows)}/{len(jobs)}] {_describe(name, row)}")
                if row.get("notes"):
                    warn(f"note: {name}: {row['notes']}")
    finally:
        if rows:  # otherwise an older summary stays, like its results
            table = _summary([{"trial": job.name, **rows.get(job.name, _PENDING)} for job in jobs])
            for path in summaries:
                write_table(table, path)
    report(f"summary in {summaries[0]} and summary.parquet")
    failed = [name for name in sorted(rows) if rows[name]["status"] == "failed"]
    for name in failed:
        warn(f"{name}: {rows[name]['error']}")
    if failed:
        raise TrialError(
            f"{len(failed)} of {len(rows)} trials failed",
            "fix them and run it again: finished trials are kept",
        )


_PENDING: Row = {"status": "not reached", "error": None}


def _describe(name: str, row: Row) -> str:
    if row["error"]:
        return f"{name}: {row['status']}: {row['error']}"
    words = [f"{name}: {row['status']}"]
    for title, value in row.items():
        if title.startswith(("mean_", "median_")) and isinstance(value, float):
            quantity, unit = split_unit(title)
            quantity = quantity.replace("_rmse", " RMSE").replace("_", " ")
            words.append(f"{quantity} {value:.3f} {unit}".removesuffix(" -"))
    return ", ".join(words)


def _summary(rows: list[Row]) -> pd.DataFrame:
    """The table; a skipped trial is `ok`, because an earlier run produced its result."""
    import pandas as pd

    table = pd.DataFrame(rows, dtype=object)  # keeps counts integers despite missing values
    table["status"] = table["status"].replace("skipped", "ok")
    return table


def _run_job(task: Task, job: Job) -> tuple[str, Row]:
    """Run a job unless it is finished; an error becomes its row, so that the others continue."""
    notes: list[str] = []
    trial = replace(job.trial, notify=notes.append)
    record = task.folder / _RECORDS_FOLDER / task.verb / f"{job.name}.json"
    row: Row = {"status": "ok", "error": None}
    try:
        row |= trial.metadata.columns()
        inputs, old = _inputs(task, job), _read_record(record)
        if not task.again and old[:2] == [inputs, _stamp(job.output)]:
            row |= {"status": "skipped", **old[2]}
            notes += old[3]
        else:
            # The record of an interrupted run is empty; a copied result has another date.
            ours = record.exists() and (not old or old[1][:1] == _stamp(job.output)[:1])
            _remove_older(job.output, record, task.replace or ours)
            start = time.perf_counter()
            with threadpool_limits(1):  # trials run in parallel, one per core
                figures = task.work(replace(job, trial=trial))
            figures = {**figures, "computing_time [s]": round(time.perf_counter() - start, 3)}
            write_text(record, json.dumps([inputs, _stamp(job.output), figures, notes]))
            row |= figures
    except TestbedError as error:
        row |= {"status": "failed", "error": str(error)}
    except Exception as error:
        row |= _failure(job, "unexpected ", error, f": run '{task.verb}' on this trial alone")
    return job.name, row | {"notes": "; ".join(dict.fromkeys(notes)) or None}


def _failure(job: Job, before: str, error: BaseException, after: str) -> Row:
    described = " ".join(f"{type(error).__name__}: {error}".split())
    return {"status": "failed", "error": f"{job.trial.path}: {before}{described}{after}"}


def _inputs(task: Task, job: Job) -> str:
    """Everything a result depends on, as JSON: version, size and date of files, settings."""
    files = [path for path in job.trial.path.iterdir() if path.is_file() and path.name[0] != "."]
    stamps = {path.name: _stamp(path) for path in files if path.name != METADATA_FILE}
    stamps |= {option_of(name): _stamp(file) for name, file in job.files.items()}
    stated = [getattr(job.trial.metadata, name) for name in task.metadata]
    return json.dumps([__version__, stamps, stated, task.settings], sort_keys=True)


def _stamp(path: Path) -> list[int]:
    """Size [byte] and modification time [ns] of a file; empty if it does not exist."""
    if not path.exists():
        return []
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


def _remove_older(output: Path, record: Path, replace: bool) -> None:
    """Remove an older result, so that it cannot pass for this one if the work fails."""
    make_folder(output.parent)
    make_folder(record.parent)
    check_outputs(output, replace=replace)
    record.write_text("")  # marks the output as ours even if the run is interrupted
    output.unlink(missing_ok=True)


def _read_record(path: Path) -> list[Any]:
    """Inputs, output stamp, figures and notes of a finished job; empty if there is none."""
    with suppress(ConfigurationError, TypeError):
        return list(load_json(path, "a record"))
    return []


def _run_jobs(
    task: Task, jobs: Sequence[Job], processes: int | None, dask: str | None
) -> Generator[tuple[str, Row], None, None]:
    """Names and rows of jobs as they finish; closing the generator cancels the others."""
    if processes == 1 and dask is None:
        yield from (_run_job(task, job) for job in jobs)
        return
    from joblib import cpu_count

    with _executor(min(processes or cpu_count(), len(jobs)), dask) as executor:
        futures = {executor.submit(_run_job, task, job): job for job in jobs}
        for future in as_completed(futures):
            job, error = futures[future], future.exception()
            if error is None:
                yield future.result()
            elif isinstance(error, BrokenProcessPool) and len(jobs) > 1:
                # A worker that dies (out of memory, say) breaks the pool for all other jobs.
                yield from _run_jobs(task, [job], processes, dask)
            else:
                hint = "): check that it has this package and enough memory, or give fewer --jobs"
                yield job.name, _failure(job, "its worker failed (", error, hint)


@contextmanager
def _executor(processes: int, dask: str | None) -> Iterator[Executor]:
    """Processes on this machine, or Dask's workers; unfinished work is cancelled on exit."""
    if dask is None:
        from joblib.externals.loky import ProcessPoolExecutor

        pool = ProcessPoolExecutor(processes, initializer=_end_with_caller)
        try:
            yield pool
        finally:
            pool.shutdown(kill_workers=True)
        return
    try:
        from distributed import Client
    except ImportError:
        raise ConfigurationError(
            "--dask: Dask is not installed", "run 'pip install -r requirements/dask.txt'"
        ) from None
    with ExitStack() as stack:
        try:
            client = stack.enter_context(Client(dask, timeout=_DASK_TIMEOUT))
            client.wait_for_workers(1, timeout=_DASK_TIMEOUT)
        except (OSError, ValueError) as error:
            raise ConfigurationError(
                f"--dask {dask}: no scheduler with a worker answers ({error})",
                "give the address of a running one, such as tcp://host:8786",
            ) from None
        # Not pure: the files may have changed since an equal call.
        yield client.get_executor(pure=False)


def _end_with_caller() -> None:
    """In a worker: ignore Ctrl-C, which reaches the process group, and end with the caller."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(signal.SIGKILL)  # even if the caller is killed
