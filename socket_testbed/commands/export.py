"""`export`: synchronised samples of a trial as CSV, Parquet or MAT."""

from __future__ import annotations

import argparse
from pathlib import Path

from socket_testbed import api
from socket_testbed.commands.options import (
    add_replace,
    add_segment,
    add_trial,
    add_unloaded,
    trial_of,
)
from socket_testbed.files import check_outputs


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
    parser.add_argument(
        "--map", action="store_true", help="add the force map: every tile with its uncertainty"
    )
    parser.add_argument(
        "--pressure",
        action="store_true",
        help="add pressure and shear of every region and tile with 95 %% intervals",
    )
    parser.add_argument(
        "--cycles",
        metavar="LABEL",
        help="mean and standard deviation over 0 to 100 %% of a cycle instead of samples: from each"
        " event LABEL, such as placed, to the next; or from A to B with A:B",
    )
    add_replace(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Read and write."""
    check_outputs(options.output, replace=options.replace)
    trial = trial_of(options)
    table = api.export(
        trial,
        options.output,
        options.segment,
        options.model,
        force_map=options.map,
        pressure=options.pressure,
        cycles=options.cycles,
    )
    segment, rows = table.attrs["segment"], table.attrs["rows"]
    print(f"{trial.name}: {segment}, {rows}, {len(table.columns)} columns in {options.output}")
