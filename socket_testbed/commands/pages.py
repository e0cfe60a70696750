"""`report`, `compare` and `view`: pages written or served."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from socket_testbed import api
from socket_testbed.api.comparison import LEGEND, open_compared
from socket_testbed.api.tradeoff import theta_values
from socket_testbed.batch import Row
from socket_testbed.commands.arguments import takes
from socket_testbed.commands.options import (
    TrialVerb,
    check_files,
    deliver,
    given,
    name_and_value,
    on_trials,
    open_all,
    open_given,
    refuse_given,
    report_data,
    segment_columns,
    typed_command,
)
from socket_testbed.commands.results import error_columns
from socket_testbed.commands.terminal import Progress, say, text_of
from socket_testbed.documents import check_number
from socket_testbed.files import PAGES
from socket_testbed.live.processes import Graph
from socket_testbed.settings.testbed import ViewSettings
from socket_testbed.tables import Table
from socket_testbed.trials.metadata import FIELDS
from socket_testbed.trials.trial import Trial
from socket_testbed.wire.topics import full_namespace

if TYPE_CHECKING:
    from socket_testbed.report.results import Results  # slow: it imports matplotlib

_BY_REGION = ("mean pressure", "peak pressure", "share of load")
_INTERVAL = 0.2  # [s]; between checks of the time


@takes(
    "commands.options.on_trials",
    "commands.options.draw",
    "write_report",
    "fit",
    without="figure page command variant",  # the paper's variants and the default
)
def report(trial: Path, *, output: Path, **options: Any) -> None:
    """Write a page with a trial's results: figures, errors, data quality.

    Args:
        output: The page, or the folder of the pages of a folder of trials.
    """
    theta_values(options["thetas"])  # a wrong number is reported once
    options["command"] = typed_command()
    verb = TrialVerb("report", ".html", _report, _report_row, _show_report, FIELDS)
    on_trials(verb, trial, output=output, **options)


def _report(trial: Trial, options: Mapping[str, Any]) -> Results:
    alone = options["alone"]
    chosen = given(options, api.write_report, api.fit) | {
        "replace": options["replace"] or not alone,
        "progress": Progress if alone else None,
    }
    return api.write_report(trial, options["output"], **chosen)


def _show_report(results: Results, options: Mapping[str, Any]) -> None:
    from socket_testbed.report.write import files_folder, summarise

    page = options["output"]
    for line in summarise(results):
        print(f"- {line}")
    print(f"\nreport in {page}, its figures and data in {files_folder(page)}")


def _report_row(results: Results) -> Row:
    complete = int(results.samples[results.segment.rows].has_pose_and_wrench.sum())
    row = segment_columns(complete, results.segment)
    for label, candidate in results.fitted.items():
        judged = {"_in_sample": candidate.errors, "_held_out": candidate.held_out}
        columns = error_columns(candidate.errors, judged)
        row |= {f"{label} {name}": value for name, value in columns.items()}
    return row


@takes("compare", "commands.options.deliver", without="figure width title")
def compare(
    trial: list[Path] | None = None,
    *,
    condition: Iterable[str] = (),
    output: Path | None = None,
    **options: Any,
) -> None:
    """Compare trials side by side, with their differences.

    Args:
        trial: Two or more trials; a folder of trials stands for all of them.
        condition: Instead, the repeated trials of a condition, such as gel=trials/gel1,trials/gel2.
        output: A page (.html), or a table (.csv, .parquet) of all values and differences.
    """
    page = output if output and output.suffix.lower() in PAGES else None
    check_files(output, replace=options["replace"], table=page is None)
    trials = open_all(trial or [], options)
    conditions = {name: open_all(paths, options) for name, paths in _conditions(condition).items()}
    for each in open_compared(trials, conditions)[0]:  # wrong calls fail before data is read
        report_data(each)
    found = api.compare(
        *trials, conditions=conditions, **given(options, api.compare), progress=Progress
    )
    if page is not None:
        api.write_comparison(found, page, typed_command())
    deliver(found, _show_comparison, output=None if page else output, **options)
    if page is not None and not options["json"]:
        print(f"\nwritten: {page}")


def _conditions(words: Iterable[str]) -> dict[str, list[Path]]:
    found: dict[str, list[Path]] = {}
    for word in words:
        name, paths = name_and_value(word, "--condition", "gel=trials/gel1,trials/gel2")
        found.setdefault(name, []).extend(map(Path, filter(None, paths.split(","))))
    return found


def _show_comparison(found: api.Comparison) -> None:
    print(f"{found.kind} {', '.join(found.items)}: {found.title}")
    for note in found.notes:
        print(f"note: {note}")
    _print("whole socket", found.cells("regions").loc[["socket"]].droplevel("name"))
    for quantity in _BY_REGION:
        _print(f"{quantity} by region", found.cells("regions", quantity).drop("socket"))
    if "limb" in set(found.table["part"]):
        _print("limb in the socket", found.cells("limb").droplevel("name"))
    _print("wrench", found.cells("wrench").reset_index("quantity"))
    print()
    texts = found.table[found.table["text"].notna()]
    for (_, name), rows in texts.groupby(["part", "name"], sort=False):
        several = rows["item"] + ": " + rows["text"]
        same = rows["text"].nunique() == 1
        print(f"{name}: " + (rows["text"].iloc[0] if same else "; ".join(several)))
    print("\n" + "\n  ".join(found.differing()))
    print(f"\n{LEGEND}")


def _print(title: str, cells: pd.DataFrame) -> None:
    print(f"\n{title}\n\n{text_of(Table('', '', cells))}")


@takes("commands.options.open_given", "view", without="unloaded names")
def view(
    trial: Path | None = None,
    *,
    namespace: str | None = None,
    duration: float | None = None,
    host: str = ViewSettings.host,
    port: int = ViewSettings.port,
    allow_host: Iterable[str] = (),
    buttons: bool = False,
    model: Path | None = None,
    **options: Any,
) -> None:
    """View the running testbed, or play a trial, in a browser: pressure map, wrench, sensors.

    Args:
        trial: Folder of a trial to play; without one the running testbed is shown.
        namespace: Namespace of the running testbed (default: /).
        duration: Stop after this time [s].
        allow_host: As `names` in `view`.
        model: A model written by 'fit', to show its predicted wrench.
        buttons: Allow the buttons (tare, record, ...) even where other machines see the page.
    """
    if duration is not None:
        check_number(duration, "--duration", 0.1, 1e6)
    ends = time.monotonic() + (duration or math.inf)
    served: dict[str, Any] = {"host": host, "port": port, "names": tuple(allow_host)}
    if trial is None:
        options["model"] = model
        _follow(ViewSettings(**served, buttons=buttons), namespace, ends, options)
        return
    live = {"namespace": namespace, "buttons": buttons or None}
    refuse_given(live, "the running testbed", "leave out the trial")
    opened = open_given(trial, **options)
    report_data(opened)
    with api.view(opened, model, **served) as page:
        say(f"the trial is shown at {page.url}; Ctrl-C ends it")
        with suppress(KeyboardInterrupt):
            while time.monotonic() < ends:
                time.sleep(_INTERVAL)


def _follow(
    settings: ViewSettings, namespace: str | None, ends: float, options: Mapping[str, Any]
) -> None:
    """Serve the page of the running testbed until a time [s]."""
    for_trials = {name: options[name] for name in ("model", "calibration", "load_cell", "tare")}
    refuse_given(for_trials, "a trial", "give the folder of the trial")
    if options["geometry"] is not None:
        settings = dataclasses.replace(settings, geometry=str(options["geometry"].resolve()))
    from socket_testbed.pages.server import listen

    listen(settings.host, settings.port).close()  # fails before any node starts
    with Graph() as graph:
        graph.start("view_node", settings, namespace=full_namespace(namespace or ""))
        say("Ctrl-C ends it")
        with suppress(KeyboardInterrupt):
            graph.watch(lambda: time.monotonic() >= ends, say)
