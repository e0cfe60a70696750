"""`report`, `compare`, `survey` and `view`: pages written or served."""

from __future__ import annotations

import dataclasses
import math
import textwrap
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from socket_testbed import api
from socket_testbed.api.comparison import open_compared
from socket_testbed.api.survey import open_surveyed
from socket_testbed.api.tradeoff import theta_values
from socket_testbed.batch import Row
from socket_testbed.commands import calls
from socket_testbed.commands.calls import takes
from socket_testbed.commands.results import error_columns
from socket_testbed.commands.running import (
    TrialVerb,
    check_files,
    deliver,
    left_out,
    name_and_value,
    on_trials,
    open_all,
    open_given,
    refuse_given,
    report_data,
    segment_columns,
    typed_command,
)
from socket_testbed.commands.terminal import Progress, say, text_of
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import PAGES
from socket_testbed.live.processes import Graph
from socket_testbed.results.comparison import LEGEND
from socket_testbed.results.survey import LEGEND as SURVEY_LEGEND
from socket_testbed.settings.options import (
    ComparisonOptions,
    PriorOptions,
    ReportOptions,
    SensorFiles,
    SurveyOptions,
    TrialFiles,
    given,
)
from socket_testbed.settings.testbed import ViewSettings
from socket_testbed.tables import Table
from socket_testbed.trials.metadata import FIELDS
from socket_testbed.trials.trial import Trial
from socket_testbed.wire.topics import full_namespace

if TYPE_CHECKING:
    from socket_testbed.results.report import Results

_BY_REGION = ("mean pressure", "peak pressure", "share of load")
_MAX_PLACES = 8  # judged places on the terminal
_INTERVAL = 0.2  # [s]; between checks of the time


@takes(calls.Report)
def report(call: calls.Report) -> None:
    """Write a page with a trial's results: figures, errors, data quality."""
    theta_values(call.thetas)  # a wrong number is reported once
    call = dataclasses.replace(call, command=typed_command())
    verb = TrialVerb("report", ".html", _report, _report_row, _show_report, FIELDS)
    on_trials(verb, call)


def _report(trial: Trial, call: calls.Report) -> Results:
    return api.write_report(
        trial,
        call.output,
        **given(call, ReportOptions),
        width=call.width,
        title=call.title,
        command=call.command,
        replace=call.replace or not call.alone,
        progress=Progress if call.alone else None,
    )


def _show_report(results: Results, call: calls.Report) -> None:
    from socket_testbed.report.write import files_folder, summarise

    page = call.output
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


@takes(calls.Compare)
def compare(call: calls.Compare) -> None:
    """Compare trials side by side, with their differences."""
    output = call.output
    page = output if output and output.suffix.lower() in PAGES else None
    check_files(output, replace=call.replace, table=page is None)
    trials = open_all(call.trial or [], call)
    named = _conditions(call.condition)
    conditions = {name: open_all(paths, call) for name, paths in named.items()}
    for each in open_compared(trials, conditions)[0]:  # wrong calls fail before data is read
        report_data(each, leave_out=left_out(each, call))
    found = api.compare(
        *trials, conditions=conditions, **given(call, ComparisonOptions), progress=Progress
    )
    if page is not None:
        api.write_comparison(found, page, typed_command())
    deliver(found, _show_comparison, output=None if page else output, json=call.json)
    if page is not None and not call.json:
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


@takes(calls.Survey)
def survey(call: calls.Survey) -> None:
    """Judge and complete the map of one limb by trials with moved clusters."""
    output = call.output
    page = output if output and output.suffix.lower() in PAGES else None
    kept = output is not None and output.suffix.lower() == ".json"
    check_files(output, call.figure, replace=call.replace, table=page is None and not kept)
    trials = _surveyed(call)
    for each in open_surveyed(trials):  # wrong calls fail before data is read
        report_data(each, leave_out=left_out(each, call))
    found = api.survey(*trials, **given(call, SurveyOptions), progress=Progress)
    if page is not None:
        api.write_survey(found, page, typed_command())
    written = given(call, deliver) | {"output": None if page else output}
    deliver(found, _show_survey, **written)
    if page is not None and not call.json:
        print(f"\nwritten: {page}")


def _surveyed(call: calls.Survey) -> list[Trial]:
    """The trials of a survey, each with its own socket or the one given for it."""
    files = given(call, SensorFiles)
    trials = open_all(call.trial, TrialFiles(**files))
    sockets = [*call.geometry]
    if not sockets:
        return trials
    if len(sockets) != len(trials):
        raise ConfigurationError(
            f"--geometry names {len(sockets)} sockets for {len(trials)} trials",
            "give one for each trial, in their order",
        )
    return [
        each
        for trial, socket in zip(trials, sockets, strict=True)
        for each in open_all([trial.path], TrialFiles(**files, geometry=socket))
    ]


def _show_survey(found: api.Survey) -> None:
    print(f"{found.verdict}\n")
    for line in found.conclusions():
        print(f"- {line}")
    for note in found.notes:
        print(f"note: {note}")
    scores, judged = found.tables()
    farthest = judged.frame.sort_values("difference [N]", ascending=False, kind="stable")
    places = dataclasses.replace(judged, frame=farthest.head(_MAX_PLACES))
    for caption, table in (
        (scores.caption, scores),
        ("places where maps are farthest off", places),
    ):
        print(f"\n{caption}\n\n{text_of(table)}")
    print(f"\n{textwrap.fill(SURVEY_LEGEND, 100)}")


@takes(calls.View)
def view(call: calls.View) -> None:
    """View the running testbed, or play a trial, in a browser: pressure map, wrench, sensors."""
    duration, names = call.duration, tuple(call.allow_host)
    ends = time.monotonic() + (duration or math.inf)
    if call.trial is None:
        _follow(call, ends)
        return
    live = {"namespace": call.namespace, "buttons": call.buttons or None}
    refuse_given(live, "the running testbed", "leave out the trial")
    opened = open_given(call.trial, call)
    report_data(opened)
    found = given(call, PriorOptions)
    with api.view(opened, call.model, host=call.host, port=call.port, names=names, **found) as page:
        say(f"the trial is shown at {page.url}; Ctrl-C ends it")
        with suppress(KeyboardInterrupt):
            while time.monotonic() < ends:
                time.sleep(_INTERVAL)


def _follow(call: calls.View, ends: float) -> None:
    """Serve the page of the running testbed until a time [s]."""
    for_trials = {
        "model": call.model,
        "calibration": call.calibration,
        "load_cell": call.load_cell,
        "tare": call.tare,
        "prior": call.prior,
    }
    refuse_given(for_trials, "a trial", "give the folder of the trial")
    settings = ViewSettings(
        host=call.host, port=call.port, names=tuple(call.allow_host), buttons=call.buttons
    )
    if call.geometry is not None:
        settings = dataclasses.replace(settings, geometry=str(call.geometry.resolve()))
    from socket_testbed.pages.server import listen

    listen(settings.host, settings.port).close()  # fails before any node starts
    namespace = full_namespace(call.namespace or "")
    with Graph() as graph:
        graph.start("view_node", settings, namespace=namespace)
        say("Ctrl-C ends it")
        with suppress(KeyboardInterrupt):
            graph.watch(lambda: time.monotonic() >= ends, say)
