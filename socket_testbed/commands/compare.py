"""`compare`: trials side by side."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys
from functools import cache
from pathlib import Path

import pandas as pd

from socket_testbed import api
from socket_testbed.api import Comparison
from socket_testbed.api.compare import PAGES
from socket_testbed.api.comparison import LEGEND
from socket_testbed.batch import find_trials
from socket_testbed.commands.options import (
    add_judgement,
    add_replace,
    add_segment,
    add_trial,
    add_unloaded,
    print_note,
    trial_of,
)
from socket_testbed.commands.text import Progress, table
from socket_testbed.files import check_outputs
from socket_testbed.tables import check_format
from socket_testbed.trials.trial import Trial

_BY_REGION = ("mean pressure", "peak pressure", "share of load")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trial(parser, "two or more; a folder of trials stands for all of them", "+")
    add_segment(parser)
    add_unloaded(parser)
    add_judgement(parser)
    parser.add_argument(
        "--by-region",
        action="store_true",
        help="compare by region alone, even trials of different sockets",
    )
    parser.add_argument(
        "--params", type=Path, metavar="TESTBED.yaml", help="instead of each trial's testbed.yaml"
    )
    parser.add_argument("--json", action="store_true", help="print JSON on standard output")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="OUT.html|.csv|.parquet",
        help="a page, or a table of every value and difference",
    )
    add_replace(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Compare, write and print."""
    is_page = options.output is not None and options.output.suffix.lower() in PAGES
    if options.output is not None and not is_page:
        check_format(options.output)
    check_outputs(options.output, replace=options.replace)
    found = api.compare(
        *_trials(options),
        segment=options.segment,
        threshold=options.threshold,
        share=options.share,
        by_region=options.by_region,
        params=options.params,
        progress=Progress,
    )
    if is_page:
        command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
        api.write_comparison(found, options.output, command)
    elif options.output is not None:
        found.save(options.output)
    if options.json:
        print(found.to_json())
        return
    _show(found)
    if options.output is not None:
        print(f"written: {options.output}")


def _trials(options: argparse.Namespace) -> list[Trial]:
    notify = cache(print_note)  # a note that several trials have is printed once
    paths = [
        trial
        for path in options.trial
        for trial in [*find_trials(path, print_note).values()] or [path]
    ]
    trials = [trial_of(argparse.Namespace(**{**vars(options), "trial": path})) for path in paths]
    return [dataclasses.replace(trial, notify=notify) for trial in trials]


def _show(found: Comparison) -> None:
    print(f"trials {', '.join(found.items)}: {found.title}")
    for note in found.notes:
        print(f"note: {note}")
    print()
    texts = found.table[found.table["text"].notna()]
    for (_, name), of_items in texts.groupby(["part", "name"], sort=False):
        several = of_items["item"] + ": " + of_items["text"]
        alike = of_items["text"].nunique() == 1
        print(f"{name}: " + (of_items["text"].iloc[0] if alike else "; ".join(several)))
    _print("whole socket", found.cells("regions").loc[["socket"]].droplevel("name"))
    for quantity in _BY_REGION:
        _print(f"{quantity} by region", found.cells("regions", quantity).drop("socket"))
    _print("wrench", found.cells("wrench"))
    print("\n" + "\n  ".join(found.differing()))
    print(f"\n{LEGEND}")


def _print(title: str, cells: pd.DataFrame) -> None:
    header = [*(name or "" for name in cells.index.names), *map(str, cells.columns)]
    rows = [
        [*(key if isinstance(key, tuple) else (key,)), *row]
        for key, row in zip(cells.index, cells.itertuples(index=False), strict=True)
    ]
    print(f"\n{title}\n\n{table(header, rows)}")
