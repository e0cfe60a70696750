"""`export`: synchronised samples of a trial as CSV, Parquet or MAT."""

from __future__ import annotations

import argparse
from pathlib import Path

from socket_testbed.commands.options import add_segment, add_trial, add_unloaded, trial_of
from socket_testbed.identification.model_file import read_model
from socket_testbed.trials.segment import select_segment
from socket_testbed.trials.synchronise import make_samples, read_measurements
from socket_testbed.trials.tables import check_format, sample_columns, write_table


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trial(parser)
    add_segment(parser, default="all")
    add_unloaded(parser)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT.csv|.parquet|.mat",
        help="file of the samples",
    )
    parser.add_argument(
        "--model", type=Path, metavar="MODEL", help="add the predictions of a model"
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Read and write."""
    check_format(options.output)
    trial = trial_of(options)
    model = None if options.model is None else read_model(options.model, trial.geometry).model
    measured = read_measurements(trial)
    samples = make_samples(trial, measured)
    segment = select_segment(samples, options.segment, trial.estimator.plateau)
    columns = sample_columns(trial, measured, samples, segment, model)
    write_table(columns, options.output)
    count = segment.rows.stop - segment.rows.start
    print(f"{trial.name}: {segment}, {count} samples, {len(columns)} columns in {options.output}")
