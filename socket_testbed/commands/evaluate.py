"""`evaluate`: errors of a model on a segment of a trial."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from socket_testbed.commands.errors_table import errors_table
from socket_testbed.commands.options import add_segment, add_trial, trial_of
from socket_testbed.errors import TrialError
from socket_testbed.evaluation import evaluate
from socket_testbed.identification.model_file import StoredModel, errors_document, read_model
from socket_testbed.trials.segment import select_segment
from socket_testbed.trials.synchronise import read_samples
from socket_testbed.trials.trial import Trial


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trial(parser)
    add_segment(parser)
    parser.add_argument(
        "--model", type=Path, required=True, metavar="MODEL", help="a model that 'fit' wrote"
    )
    parser.add_argument("--json", action="store_true", help="print JSON on standard output")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Evaluate and print."""
    trial = trial_of(options)
    stored = read_model(options.model)
    _require_same_socket(trial, stored)
    samples = read_samples(trial)
    segment = select_segment(samples, options.segment, trial.estimator.plateau)
    chosen = samples[segment.rows]
    errors = evaluate(chosen, stored.model, stored.settings.leave_out)
    if options.json:
        report = {
            "trial": trial.name,
            "model": {"trial": stored.trial, "variant": stored.model.variant},
            "segment": {"kind": segment.kind, "start": segment.start, "end": segment.end},
            "samples": int(chosen.complete.sum()),
            "channels": [errors_document(error) for error in errors],
        }
        print(json.dumps(report, indent=1, allow_nan=False))
        return
    print(f"{trial.name}: {segment}, {int(chosen.complete.sum())} samples")
    print(f"model {stored.model.variant} of {stored.trial}\n")
    print(errors_table(errors))


def _require_same_socket(trial: Trial, stored: StoredModel) -> None:
    if not trial.geometry.same_tiles(stored.geometry):
        raise TrialError(
            f"the model was fitted on another socket ({len(stored.geometry)} tiles) than that of"
            f" {trial.path} ({len(trial.geometry)} tiles)",
            "fit a model on a trial of this socket",
        )
