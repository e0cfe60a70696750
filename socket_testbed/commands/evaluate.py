"""`evaluate`: errors of a model on a segment of a trial, or of every trial of a folder."""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from socket_testbed.batch.jobs import Job, Row, Task, find_trials, plan_jobs
from socket_testbed.batch.run import error_columns, run_batch, segment_columns
from socket_testbed.commands.options import (
    absolute_paths,
    add_segment,
    add_trials,
    add_unloaded,
    pool_of,
    say,
    trial_of,
    warn,
)
from socket_testbed.commands.text import errors_table
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import atomic_output
from socket_testbed.identification.evaluation import ChannelErrors, evaluate
from socket_testbed.identification.fit import implausible_notes
from socket_testbed.identification.model_file import StoredModel, errors_document, read_model
from socket_testbed.trials.segment import Segment, select_segment
from socket_testbed.trials.synchronise import parse_unloaded, read_samples
from socket_testbed.trials.trial import Trial


@dataclasses.dataclass(frozen=True)
class _Evaluation:
    """A model judged on a segment of a trial."""

    trial: Trial
    stored: StoredModel
    segment: Segment
    samples: int
    errors: tuple[ChannelErrors, ...]

    def document(self) -> dict[str, Any]:
        return {
            "trial": self.trial.name,
            "model": {"trial": self.stored.trial, "variant": self.stored.model.variant},
            "segment": {
                "kind": self.segment.kind,
                "start": self.segment.start,
                "end": self.segment.end,
            },
            "samples": self.samples,
            "channels": [errors_document(error) for error in self.errors],
        }


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trials(parser)
    add_segment(parser)
    add_unloaded(parser)
    parser.add_argument(
        "--model",
        type=Path,
        required=True,
        metavar="MODEL",
        help="a model that 'fit' wrote; for a folder of trials also the folder of their models",
    )
    parser.add_argument("--json", action="store_true", help="print JSON on standard output")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="ERRORS",
        help="JSON file of the errors; for a folder of trials the folder of such files",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Evaluate and print."""
    trials = find_trials(options.trial)
    if trials:
        _evaluate_many(options, trials)
    else:
        _evaluate_one(options)


def _evaluate_one(options: argparse.Namespace) -> None:
    trial = trial_of(options)
    found = _evaluate(trial, options.model, options.segment)
    if options.output is not None:
        _write(found, options.output)
    if options.json:
        print(json.dumps(found.document(), indent=1, allow_nan=False))
        return
    print(f"{trial.name}: {found.segment}, {found.samples} samples")
    print(f"model {found.stored.model.variant} of {found.stored.trial}\n")
    print(errors_table(found.errors))
    if found.stored.trial == trial.name:
        print(
            "\nin-sample where the model was fitted: on another trial its errors may be far larger"
        )


def _evaluate_many(options: argparse.Namespace, trials: Mapping[str, Path]) -> None:
    if options.output is None or options.json:
        raise ConfigurationError(
            f"{options.trial} holds {len(trials)} trials", "give -o FOLDER instead of --json"
        )
    options = absolute_paths(options)
    if not options.model.is_dir():
        read_model(options.model)  # a wrong one is told once
    jobs = [
        dataclasses.replace(job, files={**job.files, "--model": _model_of(job.name, options.model)})
        for job in plan_jobs(
            trials,
            options.output,
            ".errors.json",
            options.geometry,
            options.calibration,
            unloaded=parse_unloaded(options.unloaded or []),
        )
    ]
    work = partial(_evaluate_job, options.segment)
    settings = {"segment": options.segment, "unloaded": options.unloaded}
    task = Task("evaluate", options.output, work, settings, options.again)
    run_batch(task, jobs, pool_of(options), say, warn)


def _model_of(name: str, model: Path) -> Path:
    """The trial's own model where a folder of models is given, else the one on all trials."""
    return model / f"{name}.json" if model.is_dir() else model


def _evaluate_job(segment: str, job: Job) -> Row:
    found = _evaluate(job.trial, job.files["--model"], segment)
    _write(found, job.output)
    return {
        "samples": found.samples,
        **segment_columns(found.segment),
        "model": found.stored.trial,
        "variant": found.stored.model.variant,
        "theta [-]": found.stored.settings.theta,
        **error_columns(found.errors),
    }


def _write(found: _Evaluation, path: Path) -> None:
    with atomic_output(path) as staging:
        staging.write_text(
            json.dumps(found.document(), indent=1, allow_nan=False), encoding="utf-8"
        )


def _evaluate(trial: Trial, model: Path, specification: str) -> _Evaluation:
    stored = read_model(model, trial.geometry)
    samples = read_samples(trial)
    segment = select_segment(samples, specification, trial.estimator.plateau)
    chosen = samples[segment.rows]
    left_out = stored.settings.leave_out
    if trial.tell is not None:
        for note in implausible_notes(chosen, trial.geometry, left_out):
            trial.tell(note)
        if bool(trial.unloaded) != bool(stored.unloaded):
            fitted = "with" if stored.unloaded else "without"
            trial.tell(f"the model was fitted {fitted} --unloaded: its offsets are others")
    errors = evaluate(chosen, stored.model, left_out)
    return _Evaluation(trial, stored, segment, int(chosen.complete.sum()), errors)
