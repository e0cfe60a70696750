"""A folder of trials worked on: in parallel, what is done skipped, with a summary at the end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial

from socket_testbed.batch.execute import execute
from socket_testbed.batch.job import Job, Outcome, Status, Task
from socket_testbed.batch.pool import Pool, spread
from socket_testbed.batch.record import require_own_folder
from socket_testbed.batch.summary import main_figures, write_summary
from socket_testbed.errors import TrialError


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
            "mend them and run it again, what is done is kept",
        )
