"""`validate`: estimates judged on what they have not seen, beside simple rivals."""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

from socket_testbed import api
from socket_testbed.api import Validation
from socket_testbed.batch import find_trials
from socket_testbed.commands.options import (
    add_figure,
    add_identification,
    add_pose_smoothing,
    add_replace,
    add_trial,
    check_figure,
    choices,
    figure_choices,
    print_note,
    trial_of,
)
from socket_testbed.commands.text import Progress, number, table
from socket_testbed.files import check_outputs
from socket_testbed.tables import check_format

_ERROR, _WORST = "error [-]", "worst error [-]"
_COVERAGE = ("within 50 % [-]", "within 80 % [-]", "within 95 % [-]")
_RMSE = {"moment RMSE [N m]": 3, "force RMSE [N]": 2}
_SKILL = {"moment skill [-]": 2, "force skill [-]": 2}
_MEDIANS = {f"median {title}": digits for title, digits in _SKILL.items()}  # of several trials
_HEADINGS = (
    ("cluster", "left out", "Force on a cluster that was left out, from the others and the wrench"),
    ("tiles", "second half", "Force on the tiles without a sensor, against the simulated truth"),
    ("wrench", "second half", "Wrench from the pose alone, fitted on the other half of the trial"),
    ("wrench", "other trial", "Wrench from the pose alone, fitted on another trial"),
    ("wrench", "in-sample", "Wrench from the pose alone, IN-SAMPLE: on the half that was fitted"),
)
_LEGEND = (
    "error: rms error over the rms of the forces, 1 is predicting zero; 50, 80, 95 %: share of the"
    "\nvalues within these intervals of the estimate; RMSE: mean of three channels; skill: 1 - RMSE"
    "\nover that of the constants that fit these samples best, below 0 worse than a constant"
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trial(parser, "folders of the trials, or folders of trials, of one socket", "+")
    add_identification(parser, variant=False)  # all are judged
    add_pose_smoothing(parser)
    add_figure(parser, "FILE", "errors by cluster and coverage of the intervals drawn")
    parser.add_argument("--json", action="store_true", help="print JSON on standard output")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="OUT.csv|.parquet",
        help="table with a row per trial, for a study",
    )
    add_replace(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Validate, write and print."""
    if options.output is not None:
        check_format(options.output)
    check_figure(options)
    check_outputs(options.output, options.figure, replace=options.replace)
    trials = [
        trial_of(argparse.Namespace(**{**vars(options), "trial": path}))
        for folder in options.trial
        for path in [*find_trials(folder, print_note).values()] or [folder]
    ]
    found = api.validate(*trials, progress=Progress, **choices(options))
    if options.output is not None:
        found.save(options.output)
    if options.figure is not None:
        found.draw(options.figure, **figure_choices(options))
    if options.json:
        print(found.to_json())
        return
    print(_title(found))
    tables = dict([*found.summary().groupby(level=["question", "test"])])
    for question, test, heading in _HEADINGS:
        if (question, test) in tables:
            rows = tables[question, test].droplevel([0, 1])
            print(f"\n{heading}\n\n{_table(rows, question)}")
    print(f"\n{_LEGEND}")
    for path in filter(None, (options.output, options.figure)):
        print(f"\nwritten: {path}")


def _title(found: Validation) -> str:
    if len(found.trials) == 1:
        return f"{found.trials[0]}: the part under load, in two halves"
    return (
        f"{len(found.trials)} trials, means over them; models fitted on {len(found.fitted)}:"
        f" {', '.join(found.fitted)}"
    )


def _table(rows: pd.DataFrame, question: str) -> str:
    if question == "wrench":
        several = bool((rows["judged [1]"] > 1).any())
        titles = _RMSE | (_MEDIANS if several else _SKILL)
        header = ["predictor", *titles]
        cells = [
            [number(row[title], digits) for title, digits in titles.items()]
            for _, row in rows.iterrows()
        ]
    else:
        several = bool((rows["judged [1]"] > 1).any())
        header = ["predictor", _ERROR, *([_WORST] if several else []), "50 %", "80 %", "95 %"]
        cells = [
            [number(row[title], 2) for title in (_ERROR, *([_WORST] if several else []))]
            + [number(100.0 * row[title], 0) for title in _COVERAGE]
            for _, row in rows.iterrows()
        ]
    counts = rows["judged [1]"]
    if counts.nunique() > 1:  # a variant could not be fitted everywhere
        header.append("judged")
        cells = [[*row, f"{count:.0f}"] for row, count in zip(cells, counts, strict=True)]
    return table(header, [[str(name), *row] for name, row in zip(rows.index, cells, strict=True)])
