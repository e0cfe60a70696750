"""`pressure`: pressure and shear as a lab reads them, by region and tile."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from socket_testbed import api
from socket_testbed.api import TrialPressure
from socket_testbed.batch import Row, find_trials
from socket_testbed.commands.arguments import ExtendList
from socket_testbed.commands.options import (
    TrialVerb,
    add_figure,
    add_judgement,
    add_replace,
    add_segment,
    add_trials,
    add_unloaded,
    check_figure,
    figure_choices,
)
from socket_testbed.commands.text import number, segment_columns, table
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import check_outputs
from socket_testbed.identification.model_file import finite_or_null
from socket_testbed.identification.pressure import TITLES, interval_end
from socket_testbed.tables import check_format
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    import pandas as pd

_ABREAST = 3  # outputs in a table
_SETTINGS = ("segment", "unloaded", "threshold", "share", "leave_out", "over_time")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trials(parser)
    add_segment(parser)
    add_unloaded(parser)
    add_judgement(parser)
    parser.add_argument(
        "--params", type=Path, metavar="TESTBED.yaml", help="instead of the trial's testbed.yaml"
    )
    parser.add_argument(
        "--leave-out",
        action=ExtendList,
        nargs="+",
        metavar="CHANNEL",
        help="channels that do not count, such as Mz",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="OUT.csv|.parquet|.mat",
        help="table of the regions; for a folder of trials the folder of such tables",
    )
    parser.add_argument(
        "--over-time",
        action="store_true",
        help="write a table of every sample instead: regions and tiles over time",
    )
    add_figure(parser, "FILE", "unrolled maps, mean and at the peak, and regions over time drawn")
    parser.add_argument("--json", action="store_true", help="print JSON on standard output")
    add_replace(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Compute, write and print."""
    trials = find_trials(options.trial)
    if trials and (options.output is None or options.json or options.figure):
        raise ConfigurationError(
            f"{options.trial} holds {len(trials)} trials",
            "give -o FOLDER without --json and --figure, or one trial",
        )
    if options.over_time and options.output is None:
        raise ConfigurationError("--over-time has no output", "name its table with -o FILE.csv")
    if not trials and options.output is not None:
        check_format(options.output)
    check_figure(options)
    check_outputs(options.figure, replace=options.replace)
    verb = TrialVerb("pressure", ".pressure.csv", _SETTINGS, _compute, _row, _show, ("side",))
    verb.run(options)


def _compute(options: argparse.Namespace, trial: Trial) -> TrialPressure:
    found = api.pressure(
        trial,
        options.segment,
        threshold=options.threshold,
        share=options.share,
        params=options.params,
        leave_out=options.leave_out,
    )
    if options.output is not None:
        found.save(options.output, over_time=options.over_time)
    if options.figure is not None:
        found.draw(options.figure, **figure_choices(options))
    return found


def _show(options: argparse.Namespace, found: TrialPressure) -> None:
    if options.json:
        print(found.to_json())
        return
    print(f"{found.trial.name}: {found.segment}, {len(found.time)} samples")
    print(f"{found.outputs.source}\n")
    print(pressure_tables(found))
    for path in filter(None, (options.output, options.figure)):
        print(f"\nwritten: {path}")


def _row(found: TrialPressure) -> Row:
    return {
        "samples": len(found.time),
        **segment_columns(found.segment),
        "threshold [kPa]": found.threshold,
        **pressure_columns(found),
    }


def pressure_tables(found: TrialPressure) -> str:
    """Outputs of the regions, and of the tiles under a cluster, in tables below each other."""
    tiles = found.tiles
    parts = [
        *_tables("region", found.regions),
        *_tables("tile under a cluster", tiles[tiles["cluster"] != ""]),
    ]
    parts.append(
        f"value (95 % interval); not determined: the interval reaches farther from the value than"
        f" {found.share:g} of it\nin contact: above {found.threshold:g} kPa; the integrals cover"
        f" {found.outputs.integrated:.1f} s"
    )
    return "\n".join(parts)


def _tables(label: str, outputs: pd.DataFrame) -> list[str]:
    """Outputs with their intervals, a row per region or tile, some columns a table."""
    known = [title for title in TITLES if title in outputs]
    found = []
    for start in range(0, len(known), _ABREAST):
        titles = known[start : start + _ABREAST]
        rows = [
            [str(name), *(_cell(row, title) for title in titles)]
            for name, row in outputs.iterrows()
        ]
        found.append(table([label, *titles], rows) + "\n")
    return found


def _cell(row: pd.Series, title: str) -> str:
    """A value with its interval, or the interval alone where the value is not determined."""
    low, high = (number(row[interval_end(title, end)], 1) for end in ("low", "high"))
    value = row[title]
    if math.isfinite(value):
        return f"{number(value, 1)} ({low} to {high})"
    return f"not determined ({low} to {high})"


def pressure_columns(found: TrialPressure) -> Row:
    """Outputs of the socket with their intervals, for a summary."""
    socket = found.regions.iloc[-1]
    ends = (interval_end(title, end) for title in TITLES for end in ("low", "high"))
    return {name: finite_or_null(socket[name]) for name in (*TITLES, *ends)}
