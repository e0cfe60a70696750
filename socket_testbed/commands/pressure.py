"""`pressure`: pressure and shear as a lab reads them, by region and tile."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from socket_testbed import api
from socket_testbed.api import TrialPressure
from socket_testbed.api.pressure import TITLES, interval_end
from socket_testbed.commands.options import (
    add_replace,
    add_segment,
    add_trial,
    add_unloaded,
    trial_of,
)
from socket_testbed.commands.text import number, table
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import check_outputs
from socket_testbed.tables import check_format

if TYPE_CHECKING:
    import pandas as pd

_COLUMNS = 3  # of a table


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trial(parser)
    add_segment(parser)
    add_unloaded(parser)
    parser.add_argument(
        "--threshold",
        type=float,
        default=5.0,
        metavar="KPA",
        help="pressure above which a tile is in contact (default: 5)",
    )
    parser.add_argument(
        "--share",
        type=float,
        default=0.5,
        help="a value is not determined if its 95 %% interval reaches farther than this share of it"
        " (default: 0.5)",
    )
    parser.add_argument(
        "--params", type=Path, metavar="TESTBED.yaml", help="instead of the trial's testbed.yaml"
    )
    parser.add_argument(
        "--leave-out", nargs="+", metavar="CHANNEL", help="channels that do not count, such as Mz"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="OUT.csv|.parquet|.mat",
        help="table of the regions; with --over-time of every sample",
    )
    parser.add_argument(
        "--over-time", action="store_true", help="write the regions at every sample instead"
    )
    parser.add_argument("--json", action="store_true", help="print JSON on standard output")
    add_replace(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Compute, write and print."""
    if options.over_time and options.output is None:
        raise ConfigurationError("--over-time has no output", "name its table with -o FILE.csv")
    if options.output is not None:
        check_format(options.output)
    check_outputs(options.output, replace=options.replace)
    found = api.pressure(
        trial_of(options),
        options.segment,
        threshold=options.threshold,
        share=options.share,
        params=options.params,
        leave_out=options.leave_out,
    )
    if options.output is not None:
        found.save(options.output, over_time=options.over_time)
    if options.json:
        print(found.to_json())
        return
    _show(found)
    if options.output is not None:
        print(f"written: {options.output}")


def _show(found: TrialPressure) -> None:
    print(f"{found.trial.name}: {found.segment}, {len(found.map.time)} samples")
    print(f"{found.map.estimate.source}\n")
    regions = found.regions
    for start in range(0, len(TITLES), _COLUMNS):
        titles = TITLES[start : start + _COLUMNS]
        rows = [
            [str(name), *(_cell(row, title) for title in titles)]
            for name, row in regions.iterrows()
        ]
        print(table(["region", *titles], rows) + "\n")
    print(
        f"value (95 % interval); not determined: the interval reaches farther than"
        f" {found.share:g} of the value. In contact: above {found.threshold:g} kPa."
    )


def _cell(row: pd.Series, title: str) -> str:
    """A value with its interval, or the interval alone where the value is not determined."""
    low, high = (number(row[interval_end(title, end)], 1) for end in ("low", "high"))
    value = row[title]
    if math.isfinite(value):
        return f"{number(value, 1)} ({low} to {high})"
    return f"not determined ({low} to {high})"
