"""`report`: the results of a trial as one page with its figures and their data."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from socket_testbed import api
from socket_testbed.api.tradeoff import check_thetas
from socket_testbed.batch import Row
from socket_testbed.commands.arguments import takes
from socket_testbed.commands.models import error_columns
from socket_testbed.commands.options import (
    TrialVerb,
    given,
    on_trials,
    segment_columns,
    typed_command,
)
from socket_testbed.commands.terminal import Progress
from socket_testbed.trials.metadata import FIELDS
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:  # it imports matplotlib, which takes its time
    from socket_testbed.report.results import Results


@takes(
    "commands.options.on_trials",
    "commands.options.open_given",
    "commands.options.draw",
    "write_report",
    "fit",
    without="figure page command variant",  # the paper's variants and the default
)
def report(trial: Path, *, output: Path, thetas: int = 31, **options: Any) -> None:
    """Write a page with a trial's results: figures, errors, data quality.

    Args:
        output: The page, or the folder of the pages of a folder of trials.
    """
    check_thetas(thetas)
    options["command"] = typed_command()
    verb = TrialVerb("report", ".html", _report, _row, _show, FIELDS)
    on_trials(verb, trial, output=output, thetas=thetas, **options)


def _report(trial: Trial, options: Mapping[str, Any]) -> Results:
    alone = options["alone"]
    chosen = given(options, api.write_report, api.fit) | {
        "replace": options["replace"] or not alone,
        "progress": Progress if alone else None,
    }
    return api.write_report(trial, options["output"], **chosen)


def _show(results: Results, options: Mapping[str, Any]) -> None:
    from socket_testbed.report.sections.summary import summarise
    from socket_testbed.report.write import files_folder

    page = options["output"]
    for line in summarise(results):
        print(f"- {line}")
    print(f"\nreport in {page}, its figures and data in {files_folder(page)}")


def _row(results: Results) -> Row:
    row: Row = {
        "samples": int(results.samples[results.segment.rows].complete.sum()),
        **segment_columns(results.segment),
    }
    for label, candidate in results.fitted.items():
        judged = {"_in_sample": candidate.errors, "_held_out": candidate.held_out}
        columns = error_columns(candidate.errors, judged)
        row |= {f"{label} {name}": value for name, value in columns.items()}
    return row
