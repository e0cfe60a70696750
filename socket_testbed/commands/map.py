"""`map`: the force on every tile with its uncertainty, sample by sample."""

from __future__ import annotations

import argparse
from pathlib import Path

from socket_testbed import api
from socket_testbed.commands.options import (
    add_figure,
    add_replace,
    add_segment,
    add_trial,
    add_unloaded,
    check_figure,
    figure_choices,
    trial_of,
)
from socket_testbed.commands.text import number, table
from socket_testbed.files import check_outputs
from socket_testbed.tables import check_format

_SHOWN = 8  # tiles


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trial(parser)
    add_segment(parser)
    add_unloaded(parser)
    parser.add_argument(
        "--params", type=Path, metavar="TESTBED.yaml", help="instead of the trial's testbed.yaml"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="MAP.csv|.parquet|.mat",
        help="table of forces, pressure and shear on every tile with standard deviations",
    )
    add_figure(parser, "MAP", "mean pressure and its uncertainty drawn")
    add_replace(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Estimate, write and print."""
    check_format(options.output)
    check_figure(options)
    check_outputs(options.output, options.figure, replace=options.replace)
    trial = trial_of(options)
    found = api.force_map(trial, options.segment, params=options.params)
    found.save(options.output)
    if options.figure is not None:
        found.draw(options.figure, **figure_choices(options))
    summary = found.summary()
    rows = [
        [str(tile), str(row["cluster"]), *(number(value) for value in row[1:])]
        for tile, row in summary.head(_SHOWN).iterrows()
    ]
    print(f"{trial.name}: {found.segment}, {len(found.time)} samples, {len(summary)} tiles")
    print(f"{found.estimate.source}\n")
    print(table(["tile", *summary.columns], rows))
    print(f"\nmeans over the segment, the {len(rows)} highest; sd: standard deviation")
    for path in filter(None, (options.output, options.figure)):
        print(f"written: {path}")
