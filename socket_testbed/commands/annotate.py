"""`annotate`: states the metadata of trials, and prints them."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from socket_testbed import api
from socket_testbed.commands.options import add_metadata, metadata_of, print_note
from socket_testbed.commands.text import metadata_table


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "trial", type=Path, nargs="+", metavar="TRIAL", help="folder of the trial, or of several"
    )
    add_metadata(parser)
    parser.add_argument(
        "--remove",
        action="append",
        default=[],
        metavar="FIELD",
        help="field to remove, again for more",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """State what is given, in every trial, and print all that is stated."""
    given = dataclasses.asdict(metadata_of(options, options.remove))
    for path in options.trial:
        metadata = api.annotate(
            api.open_trial(path, notify=print_note), **given, remove=options.remove
        )
        if len(options.trial) > 1:
            print(f"{path}:")
        print(metadata_table(metadata))
