"""`fit`: identify the contact model on a segment of a trial, or of every trial of a folder."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from threadpoolctl import threadpool_limits

from socket_testbed.batch.jobs import Job, Row, Task, find_trials, plan_jobs
from socket_testbed.batch.run import certificate_columns, error_columns, run_batch, segment_columns
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
from socket_testbed.commands.text import errors_table
from socket_testbed.identification.fit import Fit, fit_contact_model, implausible_notes
from socket_testbed.identification.model_file import write_model
from socket_testbed.samples import Samples
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.segment import Segment, select_segment
from socket_testbed.trials.synchronise import parse_unloaded, read_samples
from socket_testbed.trials.trial import Trial

_SETTINGS = ("segment", "unloaded", "variant", "theta", "smoothness", "leave_out", "solver")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trials(parser)
    add_segment(parser)
    add_unloaded(parser)
    add_identification(parser)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="MODEL",
        help="file of the model, or the folder of the models of a folder of trials",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Fit and write."""
    trials = find_trials(options.trial)
    if trials:
        _fit_many(options, trials)
    else:
        _fit_one(options)


def _fit_one(options: argparse.Namespace) -> None:
    trial = trial_of(options)
    samples, segment, fit = _fit(options, trial, options.output)
    directions = fit.model.stiffness.size
    print(f"{trial.name}: {segment}, {fit.samples} of {len(samples)} samples")
    print(
        f"variant {fit.model.variant}, theta {fit.settings.theta:g}; the data determine"
        f" {fit.determined:.0f} of {directions} stiffness directions, the smoothness the others"
    )
    print(fit.status)
    print()
    print(errors_table(fit.errors))
    print(f"\nmodel in {options.output}")


def _fit_many(options: argparse.Namespace, trials: Mapping[str, Path]) -> None:
    options = absolute_paths(options)
    estimator_settings(options, EstimatorSettings())  # what is wrong for all is told once
    jobs = plan_jobs(
        trials,
        options.output,
        ".json",
        options.geometry,
        options.calibration,
        options.params,
        parse_unloaded(options.unloaded or []),
    )
    settings = {name: getattr(options, name) for name in _SETTINGS}
    task = Task("fit", options.output, partial(_fit_job, options), settings, options.again)
    run_batch(task, jobs, pool_of(options), say, warn)


def _fit_job(options: argparse.Namespace, job: Job) -> Row:
    _, segment, fit = _fit(options, job.trial, job.output)
    return {
        "samples": fit.samples,
        **segment_columns(segment),
        "variant": fit.model.variant,
        "theta [-]": fit.settings.theta,
        **certificate_columns(fit),
        **error_columns(fit.errors),
    }


def _fit(options: argparse.Namespace, trial: Trial, output: Path) -> tuple[Samples, Segment, Fit]:
    """Fit a trial and write the model; what there is to know of the trial is told."""
    settings = estimator_settings(options, trial.estimator)
    samples = read_samples(trial)
    segment = select_segment(samples, options.segment, settings.plateau)
    chosen = samples[segment.rows]
    if trial.tell is not None:
        left_out = settings.identification.leave_out
        for note in implausible_notes(chosen, trial.geometry, left_out):
            trial.tell(note)
    # With more threads a sum is rounded otherwise: the same trial is to give the same model on
    # every machine, alone and among others. These programs are small, and no slower for it.
    with threadpool_limits(1):
        fit = fit_contact_model(chosen, trial.geometry, settings.identification)
    identity = {
        "name": trial.name,
        "first_stamp": int(samples.stamps[0]),
        "last_stamp": int(samples.stamps[-1]),
        "samples": len(samples),
        "unloaded": [list(span) for span in trial.unloaded],
    }
    write_model(fit, trial.geometry, identity, str(segment), output)
    return samples, segment, fit
