"""`compare`: trials side by side."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd

from socket_testbed import api
from socket_testbed.api import Comparison
from socket_testbed.api.comparison import LEGEND, PAGES
from socket_testbed.commands.arguments import takes
from socket_testbed.commands.options import given, open_all, print_note, typed_command
from socket_testbed.commands.terminal import Progress, table
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import check_outputs
from socket_testbed.tables import check_format

_BY_REGION = ("mean pressure", "peak pressure", "share of load")


@takes("compare", "commands.options.open_given", "files.check_outputs")
def compare(
    trial: list[Path] | None = None,
    *,
    condition: Iterable[str] = (),
    output: Path | None = None,
    json: bool = False,
    replace: bool = False,
    **options: Any,
) -> None:
    """Lay trials side by side, with their differences.

    Args:
        trial: Two or more trials; a folder of trials stands for all of them.
        condition: Instead, the repeated trials of a condition, such as gel=trials/gel1,trials/gel2.
        output: A page (.html), or a table (.csv, .parquet) of every value and difference.
        json: Print JSON on standard output.
    """
    page = output if output and output.suffix.lower() in PAGES else None
    if output is not None and page is None:
        check_format(output)
    check_outputs(output, replace=replace)
    notify = cache(print_note)
    trials = open_all(trial or [], options, notify)
    conditions = {
        name: open_all(paths, options, notify) for name, paths in _conditions(condition).items()
    }
    found = api.compare(
        *trials, conditions=conditions, **given(options, api.compare), progress=Progress
    )
    if page is not None:
        api.write_comparison(found, page, typed_command())
    elif output is not None:
        found.save(output)
    if json:
        print(found.to_json())
        return
    _show(found)
    if output is not None:
        print(f"written: {output}")


def _conditions(words: Iterable[str]) -> dict[str, list[Path]]:
    """Paths by the names of conditions."""
    found: dict[str, list[Path]] = {}
    for word in words:
        name, _, paths = word.partition("=")
        if not name or not paths:
            raise ConfigurationError(
                f"--condition {word}: no NAME=TRIAL", "write it such as gel=trials/gel1,trials/gel2"
            )
        found.setdefault(name, []).extend(map(Path, filter(None, paths.split(","))))
    return found


def _show(found: Comparison) -> None:
    print(f"{found.kind} {', '.join(found.items)}: {found.title}")
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
    if "limb" in set(found.table["part"]):
        _print("limb in the socket", found.cells("limb").droplevel("name"))
    _print("wrench", found.cells("wrench"))
    print("\n" + "\n  ".join(found.differing()))
    print(f"\n{LEGEND}")


def _print(title: str, cells: pd.DataFrame) -> None:
    header = [*(name or "" for name in cells.index.names), *cells.columns]
    rows = cells.reset_index().astype(str).to_numpy().tolist()
    print(f"\n{title}\n\n{table(list(map(str, header)), rows)}")
