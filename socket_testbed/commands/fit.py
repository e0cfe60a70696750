"""`fit`: identify the contact model on a segment of a trial."""

from __future__ import annotations

import argparse
from pathlib import Path

from socket_testbed.commands.errors_table import errors_table
from socket_testbed.commands.options import (
    add_identification,
    add_segment,
    add_trial,
    estimator_settings,
    trial_of,
)
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.model_file import write_model
from socket_testbed.trials.segment import select_segment
from socket_testbed.trials.synchronise import read_samples


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trial(parser)
    add_segment(parser)
    add_identification(parser)
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="MODEL", help="file of the model"
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Fit and write."""
    trial = trial_of(options)
    settings = estimator_settings(options, trial.estimator)
    samples = read_samples(trial)
    segment = select_segment(samples, options.segment, settings.plateau)
    fit = fit_contact_model(samples[segment.rows], trial.geometry, settings.identification)
    identity = {
        "name": trial.name,
        "first_stamp": int(samples.stamps[0]),
        "last_stamp": int(samples.stamps[-1]),
        "samples": len(samples),
    }
    write_model(fit, trial.geometry, identity, str(segment), options.output)

    directions = fit.model.stiffness.size
    print(f"{trial.name}: {segment}, {fit.samples} of {len(samples)} samples")
    print(
        f"variant {fit.model.variant}, theta {settings.identification.theta:g}; the data"
        f" determine {fit.determined:.0f} of {directions} stiffness directions, the smoothness"
        " the others"
    )
    print(fit.status)
    print()
    print(errors_table(fit.errors))
    print(f"\nmodel in {options.output}")
