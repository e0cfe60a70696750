"""`compare`: trials, models or sockets side by side."""

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
from socket_testbed.api.compare import PAGES, Comparable
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
from socket_testbed.comparison.table import LEGEND, Kind
from socket_testbed.files import check_outputs
from socket_testbed.tables import check_format, split_unit

_SHOWN = 8  # tiles
_BY_REGION: dict[Kind, tuple[str, ...]] = {
    "trials": ("mean pressure", "peak pressure", "share of load"),
    "models": (),
    "sockets": ("area",),
}
_SHOWN_OF = {"errors": "mean|median", "offsets": "^[MF][xyz]$"}  # names; the others are in a file


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    what = "two or more of one kind; a folder of trials stands for all of them"
    add_trial(parser, what, "+", "TRIAL|MODEL.json|SOCKET.yaml")
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
        *_items(options),
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


def _items(options: argparse.Namespace) -> list[Comparable]:
    notify = cache(print_note)  # a note that several trials have is printed once
    found: list[Comparable] = []
    for path in options.trial:
        if path.is_dir():
            for folder in [*find_trials(path, print_note).values()] or [path]:
                trial = trial_of(argparse.Namespace(**{**vars(options), "trial": folder}))
                found.append(dataclasses.replace(trial, notify=notify))
        else:
            found.append(path)
    return found


def _show(found: Comparison) -> None:
    print(f"{found.kind} {', '.join(found.items)}: {found.title}")
    for note in found.notes:
        print(f"note: {note}")
    for part in dict.fromkeys(found.table["part"]):
        rows = found.cells(part)
        if (found.table.loc[found.table["part"] == part, "text"].notna()).any():
            _print_texts(found, part)
        elif part == "tiles":
            _show_tiles(found)
        elif part == "regions":
            if found.kind != "sockets":
                _print("whole socket", rows.loc[["socket"]].droplevel("name"))
            for quantity in _BY_REGION[found.kind]:
                _print(f"{quantity} by region", found.cells(part, quantity).drop("socket"))
        else:
            shown = rows.index.get_level_values("name").str.contains(_SHOWN_OF.get(part, ""))
            _print(part, rows[shown])
    if differing := found.differing():
        print("\n" + "\n  ".join(differing))
    print(f"\n{LEGEND}")


def _print_texts(found: Comparison, part: str) -> None:
    """What is known in words: once, if it is the same of all."""
    rows = found.table[(found.table["part"] == part) & found.table["text"].notna()]
    print()
    for name, of_items in rows.groupby("name", sort=False):
        texts = dict(zip(of_items["item"], of_items["text"], strict=True))
        if len({*texts.values()}) == 1:
            print(f"{name}: {next(iter(texts.values()))}")
        else:
            print(f"{name}: " + "; ".join(f"{item}: {text}" for item, text in texts.items()))


def _show_tiles(found: Comparison) -> None:
    """The tiles of the largest differences."""
    if found.mapped is None:
        return
    quantity, _ = split_unit(found.mapped.title)
    tiles = found.table[(found.table["part"] == "tiles") & (found.table["quantity"] == quantity)]
    largest = tiles.groupby("name", sort=False)["difference"].agg(lambda d: d.abs().max())
    chosen = largest.dropna().sort_values(ascending=False, kind="stable").index[:_SHOWN]
    if len(chosen):
        title = f"{quantity} of the {len(chosen)} tiles with the largest differences"
        _print(title, found.cells("tiles", quantity).loc[chosen])


def _print(title: str, cells: pd.DataFrame) -> None:
    header = [*(name or "" for name in cells.index.names), *map(str, cells.columns)]
    rows = [
        [*(key if isinstance(key, tuple) else (key,)), *row]
        for key, row in zip(cells.index, cells.itertuples(index=False), strict=True)
    ]
    print(f"\n{title}\n\n{table(header, rows)}")
