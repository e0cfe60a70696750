"""One job executed, in whatever process: skipped if it is done, and never raising."""

from __future__ import annotations

import dataclasses
import time

from threadpoolctl import threadpool_limits

from socket_testbed.batch.inputs import file_digest, fingerprint
from socket_testbed.batch.job import Job, Outcome, Row, Status, Task
from socket_testbed.batch.record import (
    Record,
    changes,
    read_record,
    record_path,
    write_record,
)
from socket_testbed.errors import TestbedError


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
