"""`validate`: estimates judged on what they have not seen, beside simple rivals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd

from socket_testbed import api
from socket_testbed.commands.arguments import takes
from socket_testbed.commands.options import check_files, draw, given, open_all
from socket_testbed.commands.text import Progress, number, table

_ERRORS = {"error [-]": 2}
_SEVERAL_ERRORS = _ERRORS | {"worst error [-]": 2}
_COVERAGE = {"50 %": "within 50 % [-]", "80 %": "within 80 % [-]", "95 %": "within 95 % [-]"}
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


@takes(
    "commands.options.open_given",
    "validate",
    "fit",
    "commands.options.draw",
    "files.check_outputs",
    without="unloaded segment variant frames initial_stiffness",
)
def validate(
    trial: list[Path],
    *,
    output: Path | None = None,
    figure: Path | None = None,
    json: bool = False,
    replace: bool = False,
    **options: Any,
) -> None:
    """Judge estimates on data they have not seen, beside simple rivals.

    Args:
        trial: Trials, or folders of trials, of one socket.
        output: Table with a row per trial, for a study.
        figure: Draw the errors by cluster and the coverage of the intervals.
        json: Print JSON on standard output.
    """
    check_files(output, figure, replace=replace)
    found = api.validate(
        *open_all(trial, options), **given(options, api.validate, api.fit), progress=Progress
    )
    if output is not None:
        found.save(output)
    draw(found, figure, **options)
    if json:
        print(found.to_json())
        return
    if len(found.trials) == 1:
        print(f"{found.trials[0]}: the part under load, in two halves")
    else:
        print(
            f"{len(found.trials)} trials, means over them; models fitted on {len(found.fitted)}:"
            f" {', '.join(found.fitted)}"
        )
    tables = dict([*found.summary().groupby(level=["question", "test"])])
    for question, test, heading in _HEADINGS:
        if (question, test) in tables:
            rows = tables[question, test].droplevel([0, 1])
            print(f"\n{heading}\n\n{_table(rows, question)}")
    print(f"\n{_LEGEND}")
    for path in filter(None, (output, figure)):
        print(f"\nwritten: {path}")


def _table(rows: pd.DataFrame, question: str) -> str:
    counts = rows["judged [1]"]
    several = bool((counts > 1).any())
    if question == "wrench":
        digits, shares = _RMSE | (_MEDIANS if several else _SKILL), {}
    else:
        digits, shares = _SEVERAL_ERRORS if several else _ERRORS, _COVERAGE
    columns = {title: [number(v, n) for v in rows[title]] for title, n in digits.items()}
    for title, share in shares.items():
        columns[title] = [number(100.0 * value, 0) for value in rows[share]]
    if counts.nunique() > 1:  # a variant could not be fitted everywhere
        columns["judged"] = [f"{count:.0f}" for count in counts]
    cells = [[str(name), *row] for name, *row in zip(rows.index, *columns.values(), strict=True)]
    return table(["predictor", *columns], cells)
