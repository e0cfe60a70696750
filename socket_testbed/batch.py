"""Many trials: found in a folder, worked on in parallel, done once, in one summary table.

On Dask the work is spread by Dask's own client: under joblib's backend for it, a worker that dies
or that lacks a package leaves the caller waiting for ever (joblib 1.6).
"""

from __future__ import annotations

import hashlib
import json
import signal
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from threadpoolctl import threadpool_limits

from socket_testbed.errors import ConfigurationError, TestbedError, TrialError
from socket_testbed.files import (
    Section,
    atomic_output,
    check_new_folder,
    check_outputs,
    load_json,
    make_folder,
)
from socket_testbed.tables import split_unit, write_table
from socket_testbed.trials.bag import is_storage
from socket_testbed.trials.metadata import METADATA_FILE
from socket_testbed.trials.salvage import holds_nothing
from socket_testbed.trials.trial import Trial

SUMMARY = "summary"
_RECORDS = ".done"
_RECORD_KEYS = ("inputs", "output", "row")
_LOCK = ".lock"
_SOLVING = ("numpy", "scipy", "qpsolvers", "osqp")
_PATIENCE = "15s"  # for Dask's scheduler to answer and a worker to be there

Cell: TypeAlias = str | int | float | None
Row: TypeAlias = dict[str, Cell]
T = TypeVar("T")
R = TypeVar("R")
Results: TypeAlias = Generator[tuple[int, R | Exception], None, None]


def is_trial(folder: Path) -> bool:
    """Whether a folder is a bag: it holds a metadata.yaml or a storage file itself.

    A broken bag is a trial all the same: it must show up as failed.
    """
    return (folder / "metadata.yaml").exists() or any(is_storage(file) for file in folder.iterdir())


def find_trials(folder: Path, notify: Callable[[str], None] = lambda note: None) -> dict[str, Path]:
    """Find the trials below a folder, at any depth.

    Hidden folders and the inside of a trial are passed over; links are followed. Recordings that
    hold nothing, because their recorder was killed while it started, are left out.

    Args:
        folder: The folder, or anything else.
        notify: Called with a note on each recording that is left out.

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
        empty = sorted(name for name, path in found.items() if holds_nothing(path))
    except OSError as error:
        raise TrialError(
            f"{error.filename}: cannot be read ({error.strerror})", "check the permissions"
        ) from None
    for name in empty:
        notify(f"{name} is left out: it holds nothing, its recorder was killed while it started")
        del found[name]
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


@dataclass(frozen=True)
class Job:
    """Work on one trial.

    Attributes:
        name: Name of the trial: its path below the folder, such as `s01/hold`.
        trial: The trial.
        output: The file to write.
        files: Files that the result depends on besides the trial's, by the option that names
            them, such as `--model`.
    """

    name: str
    trial: Trial
    output: Path
    files: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True)
class Task:
    """What is done with every trial. It is sent to the workers, so it must be picklable.

    Attributes:
        verb: The verb that does it.
        folder: Folder of the outputs.
        work: Writes a job's output and returns its row of the summary: figures by column names
            that end in their unit, such as `Fx_rmse [N]`; None where there is none.
        settings: What the results depend on besides files, as JSON can hold it.
        again: Whether finished trials are done again.
        replace: Whether files that it did not write are replaced.
        metadata: Fields of the trials' metadata that the results depend on.
    """

    verb: str
    folder: Path
    work: Callable[[Job], Row]
    settings: Mapping[str, Any] = field(default_factory=dict)
    again: bool = False
    replace: bool = False
    metadata: Sequence[str] = ()


class JobStatus(StrEnum):
    """The state of a job at the end."""

    OK = "ok"
    SKIPPED = "skipped"
    FAILED = "failed"
    NOT_REACHED = "not reached"


@dataclass(frozen=True)
class Outcome:
    """The result of a job.

    Attributes:
        name: Name of the trial.
        status: Its state.
        row: Its figures, by the names of the summary's columns.
        error: The one-line error of a job that failed.
        changed: What an older result differed in, and was therefore done again.
    """

    name: str
    status: JobStatus
    row: Row = field(default_factory=dict)
    error: str | None = None
    changed: tuple[str, ...] = ()

    def __str__(self) -> str:
        words = f"{self.name}: {self.status.value}"
        if self.status is JobStatus.FAILED:
            return f"{words}: {self.error}"
        if self.changed:
            words += f" again (changed: {', '.join(self.changed)})"
        for title, value in self.row.items():
            if title.startswith(("mean_", "median_")) and isinstance(value, float):
                name, unit = split_unit(title)
                name = name.replace("_rmse", " RMSE").replace("_", " ")
                words += f", {name} {value:.3f} {unit}".removesuffix(" -")
        return words


def plan_jobs(
    trials: Mapping[str, Path],
    output: Path,
    suffix: str,
    files: Mapping[str, Path | None] | None = None,
    unloaded: tuple[tuple[float, float], ...] = (),
) -> list[Job]:
    """The jobs of a folder of trials; all paths are absolute, as workers elsewhere need them.

    Args:
        trials: Folders of the trials by their names, as `find_trials` finds them.
        output: Folder of the outputs, which mirrors that of the trials.
        suffix: The end of an output's name, such as `.json`.
        files: Files that all results depend on, by the options that name them: `--geometry` and
            `--calibration` replace each trial's own. A folder stands for the file in it that has
            the trial's name, such as `models/s01/hold.json`.
        unloaded: Spans without load in every trial, see `Trial`.
    """
    given = {option: path.absolute() for option, path in (files or {}).items() if path}
    return [
        Job(
            name,
            Trial(
                path.absolute(),
                given.get("--geometry"),
                given.get("--calibration"),
                unloaded=unloaded,
            ),
            output.absolute() / f"{name}{suffix}",
            {
                option: file / f"{name}.json" if file.is_dir() else file
                for option, file in given.items()
            },
        )
        for name, path in trials.items()
    ]


def run_batch(
    task: Task,
    jobs: Sequence[Job],
    pool: Pool,
    report: Callable[[str], None],
    warn: Callable[[str], None],
) -> list[Outcome]:
    """Do a task on every trial, and write the summary table into the task's folder.

    Finished results stay, even when it is interrupted; the summary then names the trials that were
    not reached.

    Args:
        task: What is done with a trial.
        jobs: The trials, by `plan_jobs`.
        pool: Where it is done.
        report: Called with one line per finished trial, and one that names the summary.
        warn: Called with each note on a trial and, at the end, each trial that failed.

    Returns:
        The outcomes of the jobs, in their order.

    Raises:
        ConfigurationError: If the folder of the outputs is not the task's own, another run works
            on it, or the Dask cluster cannot be reached.
        TrialError: At the end, if any trial failed; all others are done.
    """
    task = replace(task, folder=task.folder.absolute())  # a worker may be elsewhere
    _require_own_folder(task)
    outcomes = [Outcome(job.name, JobStatus.NOT_REACHED) for job in jobs]
    done = 0
    with _reserved(task):
        try:
            with closing(spread(partial(execute, task), jobs, pool)) as results:
                for done, (number, result) in enumerate(results, start=1):
                    outcome = (
                        _lost(jobs[number], result) if isinstance(result, Exception) else result
                    )
                    outcomes[number] = outcome
                    report(f"[{done}/{len(jobs)}] {outcome}")
                    if outcome.row.get("notes"):
                        warn(f"note: {outcome.name}: {outcome.row['notes']}")
        finally:
            if done:  # else an older summary stays, as its results do
                metadata = [_metadata_columns(job, warn) for job in jobs]
                _write_summary(outcomes, metadata, task.folder)
    report(f"summary in {task.folder / SUMMARY}.csv and {SUMMARY}.parquet")
    failed = [outcome for outcome in outcomes if outcome.status is JobStatus.FAILED]
    for outcome in failed:
        warn(f"{outcome.name}: {outcome.error}")
    if failed:
        raise TrialError(
            f"{len(failed)} of {len(outcomes)} trials failed",
            "fix them and run it again: finished trials are kept",
        )
    return outcomes


def _require_own_folder(task: Task) -> None:
    """Refuse a folder of outputs that is a file, another verb's, or holds another summary."""
    if task.folder.exists() and not task.folder.is_dir():
        raise ConfigurationError(
            f"{task.folder} is not a folder", "give a folder for the results of many trials"
        )
    if not task.folder.exists():
        check_new_folder(task.folder)
        return
    records = task.folder / _RECORDS
    for verb in sorted(records.iterdir()) if records.is_dir() else []:
        if verb.name != task.verb:
            raise ConfigurationError(
                f"{task.folder} holds what '{verb.name}' wrote", "give a folder of its own"
            )
    if not (records / task.verb).exists():
        check_outputs(*_summaries(task.folder), replace=task.replace)


@contextmanager
def _reserved(task: Task) -> Iterator[None]:
    """Keep other runs of this verb out of the folder; the system forgets it with the process."""
    records = task.folder / _RECORDS / task.verb
    make_folder(records)
    with (records / _LOCK).open("w") as lock:
        try:
            import fcntl

            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigurationError(
                f"another run of '{task.verb}' works on {task.folder}",
                "wait for it, or give a folder of its own",
            ) from None
        except (ImportError, OSError):  # Windows, a network drive without locks
            pass
        yield


def _lost(job: Job, error: Exception) -> Outcome:
    return Outcome(
        job.name,
        JobStatus.FAILED,
        error=f"{job.trial.path}: its worker failed ({_one_line(error)}): check that the worker has"
        " this package and memory enough, or give fewer --jobs",
    )


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _metadata_columns(job: Job, warn: Callable[[str], None]) -> Row:
    """Metadata of a trial as they are now: they may have changed since its result was made."""
    trial = replace(job.trial, notify=lambda note: warn(f"note: {job.name}: {note}"))
    return {**trial.metadata.columns()}


def _write_summary(outcomes: Sequence[Outcome], metadata: Sequence[Row], folder: Path) -> None:
    """Write the table as `summary.csv` and `summary.parquet`, one row per outcome.

    A job that was skipped is `ok`: the table lists the results, not in which run they were made.
    """
    import pandas as pd

    rows = [
        {
            "trial": outcome.name,
            "status": (
                JobStatus.OK if outcome.status is JobStatus.SKIPPED else outcome.status
            ).value,
            "error": outcome.error,
            **stated,
            **outcome.row,
        }
        for outcome, stated in zip(outcomes, metadata, strict=True)
    ]
    table = pd.DataFrame(rows, dtype=object)  # counts stay integers even where one is missing
    for path in _summaries(folder):
        write_table(table, path)


def _summaries(folder: Path) -> list[Path]:
    return [folder / f"{SUMMARY}{suffix}" for suffix in (".csv", ".parquet")]


def execute(task: Task, job: Job) -> Outcome:
    """Do a job unless it is done; an error becomes its outcome, so that the others go on."""
    try:
        return _do_once(task, job)
    except TestbedError as error:
        return Outcome(job.name, JobStatus.FAILED, error=str(error))
    except Exception as error:
        return Outcome(
            job.name,
            JobStatus.FAILED,
            error=f"{job.trial.path}: unexpected {_one_line(error)}: run '{task.verb}' on this"
            " trial alone and report what it says",
        )


def _do_once(task: Task, job: Job) -> Outcome:
    path = record_path(task, job)
    inputs = fingerprint(job, task.settings, task.metadata)
    record = _read_record(path)
    changed: tuple[str, ...] = ()
    if not path.exists():
        make_folder(job.output.parent)
        check_outputs(job.output, replace=task.replace)
    if record is not None and record.output:
        changed = _changes(record, inputs, job.output)
        if not changed and not task.again:
            return Outcome(job.name, JobStatus.SKIPPED, record.row)
        # A result of other inputs must not stay and pass for this one if the work now fails.
        job.output.unlink(missing_ok=True)
        path.unlink()
    # Known as ours from the start: an interruption may leave the output without its record.
    _write_record(path, Record(inputs, "", {}))
    try:
        row = _work(task, job)
    except Exception:
        path.unlink()
        raise
    _write_record(path, Record(inputs, file_digest(job.output), row))
    return Outcome(job.name, JobStatus.OK, row, changed=changed)


def _work(task: Task, job: Job) -> Row:
    start = time.perf_counter()
    notes: dict[str, None] = {}
    trial = replace(job.trial, notify=lambda note: notes.update({note: None}))
    with threadpool_limits(1):  # the cores are for as many trials, not for one's linear algebra
        row = task.work(replace(job, trial=trial))
    elapsed = round(time.perf_counter() - start, 3)
    return {**row, "computing_time [s]": elapsed, "notes": "; ".join(notes) or None}


@dataclass(frozen=True)
class Record:
    """A finished job, as it is kept beside the outputs.

    Attributes:
        inputs: Fingerprint of what it was made from.
        output: Digest of the output; empty while it is being made.
        row: Its figures.
    """

    inputs: dict[str, str]
    output: str
    row: Row


def record_path(task: Task, job: Job) -> Path:
    """Where the record of a job is kept."""
    return task.folder / _RECORDS / task.verb / f"{job.name}.json"


def _read_record(path: Path) -> Record | None:
    """The record of a job; None if there is none, or it is torn."""
    try:
        document = Section(load_json(path, "a record"), str(path)).expect(_RECORD_KEYS)
        inputs, row = document.section("inputs"), document.section("row")
        return Record(
            {name: inputs.text(name) for name in inputs.names()},
            document.text("output"),
            {name: _cell(row.take(name)) for name in row.names()},
        )
    except ConfigurationError:
        return None


def _cell(value: Any) -> Cell:
    if not isinstance(value, Cell):
        raise ConfigurationError("a figure is a list or a mapping", "make the record again")
    return value


def _write_record(path: Path, record: Record) -> None:
    make_folder(path.parent)
    with atomic_output(path) as staging:
        staging.write_text(json.dumps(asdict(record), indent=1, allow_nan=False), encoding="utf-8")


def _changes(record: Record, inputs: dict[str, str], output: Path) -> tuple[str, ...]:
    """Names of what differs from the record; empty if all is done."""
    names = sorted(
        name
        for name in record.inputs.keys() | inputs.keys()
        if record.inputs.get(name) != inputs.get(name)
    )
    if not output.is_file() or file_digest(output) != record.output:
        names.append("the output")
    return tuple(names)


def fingerprint(
    job: Job, settings: Mapping[str, Any], metadata: Sequence[str] = ()
) -> dict[str, str]:
    """What the result of a job depends on, by names for the user.

    Contents count, not times: a copied trial is the same, a file restored with an old date is not.

    Args:
        job: The job.
        settings: What the result depends on besides files.
        metadata: Fields of the trial's metadata that it depends on.

    Raises:
        TrialError: If a file cannot be read.
    """
    trial = job.trial.path
    try:
        files = sorted(
            path
            for path in trial.iterdir()
            if path.is_file() and not path.name.startswith(".") and path.name != METADATA_FILE
        )
    except OSError as error:
        raise _unreadable(trial, error) from None
    stated = job.trial.metadata if metadata else None
    return (
        {f"trial/{path.name}": file_digest(path) for path in files}
        | {f"metadata {name}": json.dumps(getattr(stated, name)) for name in metadata}
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


def _unreadable(path: Path, error: OSError) -> TrialError:
    return TrialError(
        f"{path}: cannot be read ({error.strerror})",
        "check the path and its permissions, even on the machine of the worker",
    )


@cache
def _software() -> dict[str, str]:
    """The package by its sources, since a checkout changes without a new version."""
    package = Path(__file__).resolve().parent
    sources = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        sources.update(f"{path.relative_to(package).as_posix()} {file_digest(path)}\n".encode())
    return {"socket_testbed": sources.hexdigest()} | {name: version(name) for name in _SOLVING}


@dataclass(frozen=True)
class Pool:
    """Where work is done.

    Attributes:
        jobs: Number of processes on this machine; None for one per core, 1 for this process.
        dask: Address of a Dask scheduler, such as `tcp://host:8786`, whose workers do it instead.
    """

    jobs: int | None = None
    dask: str | None = None


def spread(function: Callable[[T], R], items: Sequence[T], pool: Pool) -> Results[R]:
    """Apply a function to every item, in parallel; close it if you leave it early.

    Args:
        function: The function, which raises nothing; it and its results must be picklable.
        items: The items; picklable, too.
        pool: Where it is done.

    Yields:
        The number of an item and its result as they come, or the error its worker ended with.

    Raises:
        ConfigurationError: If Dask is not installed, or no scheduler with a worker answers.
    """
    if pool.dask is not None:
        return _spread_on_dask(function, items, pool.dask)
    return _spread_here(function, items, pool.jobs)


def _spread_here(function: Callable[[T], R], items: Sequence[T], wanted: int | None) -> Results[R]:
    from joblib import cpu_count

    count = min(wanted or cpu_count(), len(items))
    pending = dict(enumerate(items))
    try:
        with _applied(function, pending, count) as results:
            for number, result in results:
                del pending[number]
                yield number, result
    except BrokenProcessPool:
        # One worker that dies, as for want of memory, takes the others' work with it: go on alone.
        for number, item in pending.items():
            try:
                with _applied(function, {number: item}, count) as results:
                    yield from results
            except BrokenProcessPool as error:
                yield number, error


@contextmanager
def _applied(
    function: Callable[[T], R], items: dict[int, T], count: int
) -> Iterator[Generator[tuple[int, R], None, None]]:
    from joblib import Parallel, delayed, parallel_config

    with parallel_config("loky", n_jobs=count, initializer=_leave_interrupts_to_the_caller):
        parallel = Parallel(return_as="generator_unordered")
    results = parallel([delayed(_numbered)(function, *entry) for entry in items.items()])
    try:
        yield results
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # on the work that is given up
            results.close()


def _leave_interrupts_to_the_caller() -> None:
    """In a worker: Ctrl-C reaches the whole process group, and the caller ends its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _numbered(function: Callable[[T], R], number: int, item: T) -> tuple[int, R]:
    return number, function(item)


def _spread_on_dask(function: Callable[[T], R], items: Sequence[T], address: str) -> Results[R]:
    with _client(address) as client:
        from distributed import as_completed

        # The files may have changed since an equal call: the function is not pure.
        futures = [client.submit(function, item, pure=False) for item in items]
        numbers = {future.key: number for number, future in enumerate(futures)}
        try:
            for future in as_completed(futures):
                failed = future.status == "error"
                yield numbers[future.key], future.exception() if failed else future.result()
        finally:
            client.cancel(futures)


@contextmanager
def _client(address: str) -> Iterator[Any]:
    try:
        from distributed import Client
    except ImportError:
        raise ConfigurationError(
            "--dask: Dask is not installed", "run 'pip install -r requirements/dask.txt'"
        ) from None
    try:
        client = Client(address, timeout=_PATIENCE)
    except (OSError, ValueError) as error:
        raise _unreachable(address, error) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError as error:
            raise _unreachable(address, error) from None
        yield client


def _unreachable(address: str, error: Exception) -> ConfigurationError:
    return ConfigurationError(
        f"--dask {address}: no scheduler with a worker answers ({error})",
        "give the address of a running one, such as tcp://host:8786",
    )
