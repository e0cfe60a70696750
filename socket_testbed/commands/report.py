"""`report`: the results of a trial as one page with its figures and their data."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from socket_testbed import api
from socket_testbed.api.tradeoff import check_thetas
from socket_testbed.batch import Row
from socket_testbed.commands.options import (
    CHOICES,
    TrialVerb,
    add_figure_style,
    add_identification,
    add_pose_smoothing,
    add_replace,
    add_segment,
    add_stage_one,
    add_thetas,
    add_trials,
    add_unloaded,
    choices,
    figure_choices,
)
from socket_testbed.commands.text import Progress, error_columns, segment_columns, skill_columns
from socket_testbed.trials.metadata import FIELDS
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:  # it imports matplotlib, which takes its time
    from socket_testbed.report.results import Results


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trials(parser)
    add_segment(parser)
    add_unloaded(parser)
    add_identification(parser, variant=False)  # the paper's and the default
    add_pose_smoothing(parser)
    add_stage_one(parser)
    add_thetas(parser)
    parser.add_argument(
        "--model", type=Path, metavar="MODEL", help="a model that 'fit' wrote, shown as well"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="REPORT.html",
        help="the page, or the folder of the pages of a folder of trials",
    )
    add_replace(parser)
    add_figure_style(parser, "the figures as files")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Report on a trial, or on every trial of a folder."""
    check_thetas(options.thetas)
    # The command as it was typed, but for where the program lies.
    options.command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    settings = (
        "segment",
        "unloaded",
        *(n for n in CHOICES if n != "variant"),
        "thetas",
        "width",
        "title",
    )
    TrialVerb("report", ".html", settings, _report, _row, _show, FIELDS).run(options)


def _report(options: argparse.Namespace, trial: Trial) -> Results:
    return api.write_report(
        trial,
        options.output,
        options.segment,
        model=options.model,
        thetas=options.thetas,
        command=options.command,
        replace=options.replace or not options.alone,
        progress=Progress if options.alone else None,
        **figure_choices(options),
        **choices(options),
    )


def _show(options: argparse.Namespace, results: Results) -> None:
    from socket_testbed.report.sections.summary import summarise
    from socket_testbed.report.write import files_folder

    for line in summarise(results):
        print(f"- {line}")
    print(f"\nreport in {options.output}, its figures and data in {files_folder(options.output)}")


def _row(results: Results) -> Row:
    row: Row = {
        "samples": int(results.samples[results.segment.rows].complete.sum()),
        **segment_columns(results.segment),
    }
    for label, candidate in results.fitted.items():
        skills = skill_columns(candidate.errors, "_in_sample")
        skills |= skill_columns(candidate.held_out, "_held_out")
        columns = error_columns(candidate.errors, skills)
        row |= {f"{label} {name}": value for name, value in columns.items()}
    return row
