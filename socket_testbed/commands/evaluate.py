"""`evaluate`: errors of a model on a segment of a trial, or of every trial of a folder."""

from __future__ import annotations

import argparse
from pathlib import Path

from socket_testbed import api
from socket_testbed.api import Evaluation
from socket_testbed.batch import Row, find_trials
from socket_testbed.commands.options import (
    TrialVerb,
    add_pose_smoothing,
    add_replace,
    add_segment,
    add_trials,
    add_unloaded,
)
from socket_testbed.commands.pressure import pressure_columns, pressure_tables
from socket_testbed.commands.text import error_columns, errors_table, segment_columns, skill_columns
from socket_testbed.errors import ConfigurationError
from socket_testbed.trials.trial import Trial


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
        help="a model that 'fit' wrote; for a folder of trials even the folder of their models",
    )
    add_pose_smoothing(parser, "that of the model's fit")
    parser.add_argument(
        "--pressure", action="store_true", help="add the pressure outputs of the segment's regions"
    )
    parser.add_argument("--json", action="store_true", help="print JSON on standard output")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="ERRORS",
        help="JSON file of the errors; for a folder of trials the folder of such files",
    )
    add_replace(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Evaluate and print."""
    trials = find_trials(options.trial)
    if trials and (options.output is None or options.json):
        raise ConfigurationError(
            f"{options.trial} holds {len(trials)} trials", "give -o FOLDER instead of --json"
        )
    if trials and not options.model.is_dir():
        api.read_model(options.model)  # a wrong one is reported once
    settings = ("segment", "unloaded", "pose_smoothing", "pressure")
    metadata = ("side",) if options.pressure else ()  # the regions depend on the side
    verb = TrialVerb("evaluate", ".errors.json", settings, _evaluate, _row, _show, metadata)
    verb.run(options)


def _evaluate(options: argparse.Namespace, trial: Trial) -> Evaluation:
    found = api.evaluate(
        trial,
        options.model,
        options.segment,
        pose_smoothing=options.pose_smoothing,
        pressure=options.pressure,
    )
    if options.output is not None:
        found.save(options.output)
    return found


def _show(options: argparse.Namespace, found: Evaluation) -> None:
    if options.json:
        print(found.to_json())
        return
    print(f"{found.trial.name}: {found.segment}, {found.samples} samples")
    print(f"model {found.model.model.variant} of {found.model.trial}\n")
    print(errors_table(found.errors))
    if found.in_sample:
        print(
            "\nin-sample where the model was fitted: on another trial its errors may be far larger"
        )
    if found.pressure is not None:
        print(f"\nfrom the force map, not from the model:\n\n{pressure_tables(found.pressure)}")


def _row(found: Evaluation) -> Row:
    return {
        "samples": found.samples,
        **segment_columns(found.segment),
        "model": found.model.trial,
        "variant": found.model.model.variant,
        "theta [-]": found.model.settings.theta,
        "in_sample": "yes" if found.in_sample else "no",
        **error_columns(found.errors, skill_columns(found.errors)),
        **(pressure_columns(found.pressure) if found.pressure is not None else {}),
    }
