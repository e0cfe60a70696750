"""`report`: the paper's results for a trial, as one page with its figures and their data."""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from socket_testbed.batch.jobs import Job, Row, Task, find_trials, plan_jobs
from socket_testbed.batch.run import error_columns, run_batch, segment_columns
from socket_testbed.commands.options import (
    absolute_paths,
    add_identification,
    add_segment,
    add_trials,
    add_unloaded,
    estimator_settings,
    pool_of,
    say,
    trial_of,
    warn,
)
from socket_testbed.commands.text import Progress
from socket_testbed.files import check_number
from socket_testbed.identification.fit import implausible_notes
from socket_testbed.identification.model_file import read_model
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.synchronise import parse_unloaded
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:  # it imports matplotlib, which takes its time
    from socket_testbed.report.results import Results

_SETTINGS = ("segment", "unloaded", "theta", "smoothness", "leave_out", "solver", "thetas")
_MOST_THETAS = 10_001


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trials(parser)
    add_segment(parser)
    add_unloaded(parser)
    add_identification(parser, variant=False)  # both are shown
    parser.add_argument(
        "--thetas", type=int, default=101, metavar="N", help="values from 0 to 1 (default: 101)"
    )
    parser.add_argument(
        "--model", type=Path, metavar="MODEL", help="a model that 'fit' wrote, shown as well"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="REPORT.html",
        help="the page, or the folder of the pages of a folder of trials",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Report on a trial, or on every trial of a folder."""
    check_number(options.thetas, "--thetas", 2, _MOST_THETAS)
    trials = find_trials(options.trial)
    if trials:
        _report_many(options, trials)
    else:
        _report_one(options)


def _report_one(options: argparse.Namespace) -> None:
    """Compute everything, write the page and its files, and say what was found."""
    # matplotlib and plotly take their time to import.
    from socket_testbed.report.summary import summarise
    from socket_testbed.report.write import check_page_path, files_folder, write_report

    check_page_path(options.output)
    trial = trial_of(options)
    results = _compute(options, trial, Progress("solving for every theta"))
    _tell(results)
    write_report(results, options.output, _command_line(), datetime.now(UTC), Progress("drawing"))
    for line in summarise(results):
        print(f"- {line}")
    print(f"\nreport in {options.output}, its figures and data in {files_folder(options.output)}")


def _report_many(options: argparse.Namespace, trials: Mapping[str, Path]) -> None:
    options = absolute_paths(options)
    estimator_settings(options, EstimatorSettings())  # what is wrong for all is told once
    jobs = plan_jobs(
        trials,
        options.output,
        ".html",
        options.geometry,
        options.calibration,
        options.params,
        parse_unloaded(options.unloaded or []),
    )
    if options.model is not None:
        jobs = [replace(job, files={**job.files, "--model": options.model}) for job in jobs]
    settings = {name: getattr(options, name) for name in _SETTINGS}
    work = partial(_report_job, options, _command_line())
    task = Task("report", options.output, work, settings, options.again)
    run_batch(task, jobs, pool_of(options), say, warn)


def _report_job(options: argparse.Namespace, command: str, job: Job) -> Row:
    from socket_testbed.report.write import files_folder, write_report

    results = _compute(options, job.trial)
    _tell(results)
    # What an earlier run made of it is replaced once there is something to replace it by.
    job.output.unlink(missing_ok=True)
    shutil.rmtree(files_folder(job.output), ignore_errors=True)
    write_report(results, job.output, command, datetime.now(UTC))
    row: Row = {
        "samples": int(results.samples[results.segment.rows].complete.sum()),
        **segment_columns(results.segment),
    }
    for label, candidate in results.fitted.items():
        row |= {f"{label} {name}": value for name, value in error_columns(candidate.errors).items()}
    return row


def _compute(
    options: argparse.Namespace, trial: Trial, progress: Progress | None = None
) -> Results:
    from socket_testbed.report.results import compute_results

    settings = estimator_settings(options, trial.estimator)
    thetas = np.linspace(0.0, 1.0, options.thetas)
    model = None if options.model is None else read_model(options.model)
    # As in `fit`: one thread, so that the same trial gives the same numbers everywhere.
    with threadpool_limits(1):
        return compute_results(trial, options.segment, settings, thetas, model, progress)


def _tell(results: Results) -> None:
    """What there is to know of the trial."""
    tell = results.trial.tell or (lambda _: None)
    chosen = results.samples[results.segment.rows]
    leave_out = results.settings.identification.leave_out
    for note in implausible_notes(chosen, results.trial.geometry, leave_out):
        tell(note)
    for note in results.bag_notes:
        tell(note)


def _command_line() -> str:
    """The command line as it was typed, but for where the program lies."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
