"""`report`: the paper's results for a trial, as one page with its figures and their data."""

from __future__ import annotations

import argparse
import shlex
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from socket_testbed.commands.options import add_segment, add_trial, estimator_settings, trial_of
from socket_testbed.commands.text import Progress
from socket_testbed.documents import check_number
from socket_testbed.identification.implausible import implausible_notes
from socket_testbed.identification.model_file import read_model

_MOST_THETAS = 10_001


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trial(parser)
    add_segment(parser)
    _add_settings(parser)
    parser.add_argument(
        "--thetas", type=int, default=101, metavar="N", help="values from 0 to 1 (default: 101)"
    )
    parser.add_argument(
        "--model", type=Path, metavar="MODEL", help="a model that 'fit' wrote, shown as well"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="REPORT.html", help="the page"
    )
    parser.set_defaults(run=run, variant=None)


def _add_settings(parser: argparse.ArgumentParser) -> None:
    """Settings as for `fit`, but for the variant: both are shown."""
    parser.add_argument(
        "--params", type=Path, metavar="TESTBED.yaml", help="instead of the trial's testbed.yaml"
    )
    parser.add_argument(
        "--theta", type=float, help="weight of the wrench against the clusters, 0 to 1"
    )
    parser.add_argument(
        "--smoothness", type=float, help="weight of the smoothness over neighbouring tiles"
    )
    parser.add_argument(
        "--leave-out",
        nargs="+",
        metavar="CHANNEL",
        help="channels to leave out of the objective, such as distal.Fx or Mz",
    )
    parser.add_argument("--solver", help="any solver that qpsolvers finds (default: osqp)")


def run(options: argparse.Namespace) -> None:
    """Compute everything, write the page and its files, and say what was found."""
    # matplotlib and plotly take their time to import.
    from socket_testbed.report.results import compute_results
    from socket_testbed.report.summary import summarise
    from socket_testbed.report.write import check_page_path, files_folder, write_report

    check_page_path(options.output)
    check_number(options.thetas, "--thetas", 2, _MOST_THETAS)
    trial = trial_of(options)
    settings = estimator_settings(options, trial.estimator)
    results = compute_results(
        trial,
        options.segment,
        settings,
        np.linspace(0.0, 1.0, options.thetas),
        None if options.model is None else read_model(options.model),
        Progress("solving for every theta"),
    )
    chosen = results.samples[results.segment.rows]
    leave_out = settings.identification.leave_out
    for note in (*results.bag_notes, *implausible_notes(chosen, trial.geometry, leave_out)):
        print(f"note: {note}", file=sys.stderr)
    drawing = Progress("drawing")
    write_report(results, options.output, _command_line(), datetime.now(UTC), drawing)
    for line in summarise(results):
        print(f"- {line}")
    print(f"\nreport in {options.output}, its figures and data in {files_folder(options.output)}")


def _command_line() -> str:
    """The command line as it was typed, but for where the program lies."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
