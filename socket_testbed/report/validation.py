"""Validation on held-out data, load shares, and information in the pose."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pandas as pd

from socket_testbed.figures.validation import validation_figure
from socket_testbed.identification import validation
from socket_testbed.identification.information import MIN_RATIO
from socket_testbed.report.page import Heading, ReportFigure, Section
from socket_testbed.results.report import Results
from socket_testbed.results.validation import Validation
from socket_testbed.tables import Table

_CAPTIONS: dict[tuple[validation.Question, validation.Test], str] = {
    ("cluster", "left out"): "Force on a left-out cluster, from the others and the wrench",
    ("tiles", "second half"): "Force on the tiles without a sensor, against the simulated truth",
    ("wrench", "second half"): "Wrench from the pose alone, fitted on the other half of the trial",
    ("wrench", "other trial"): "Wrench from the pose alone, fitted on another trial",
    ("wrench", "in-sample"): "Wrench from the pose alone, IN-SAMPLE: on the fitted half",
}
LEGEND = (
    "error: rms error over the rms of the forces, predicting zero gives 1; in"
    f" {', '.join(f'{100 * level:g}' for level in validation.LEVELS)} %: share of values within"
    " these intervals of the estimate; RMSE: mean of three channels; skill: 1 -"
    " RMSE over that of the best constants for these samples, below 0 worse than a constant"
)


def section(results: Results) -> Section:
    """The section on the validation of the estimates."""
    judged: list[Any] = [f"None: {results.no_validation}."]
    if (found := results.validation) is not None:
        title = f"{results.trial.name}: Validation"
        figure = ReportFigure(
            "validation",
            "Left: error of the forces on each left-out cluster, over the root mean square of all"
            " clusters' forces, and on tiles without a sensor if simulated truth is available."
            " Right: share of values within the force map's intervals; on the line, its"
            " uncertainty is correct.",
            lambda style: validation_figure(found.judgements, title, style),
            found.to_dataframe(),
        )
        judged = [
            "Estimates judged on held-out data, against rivals that need no model.",
            f"{LEGEND[0].upper()}{LEGEND[1:]}.",
            figure,
            *judged_tables(found),
        ]
    return Section(
        "validation",
        "Validation",
        [
            *judged,
            Heading("Load shares"),
            "Predictions of springs and offsets projected onto the measured load; with the"
            " residual, they add up to 100 %. A share below zero opposes the load. The share of the"
            " offsets does not transfer to another load.",
            _shares(results),
            Heading("Information in the pose"),
            "Standard deviation of the motion over the segment against that of the noise. In"
            f" {results.motion.directions} of 6 independent directions the motion is"
            f" {MIN_RATIO:g} times the noise or more; elsewhere the noise biases the"
            " stiffnesses towards zero, and the smoothness determines them.",
            [str(excitation) for excitation in results.motion.excitations],
        ],
    )


def judged_tables(found: Validation) -> Iterator[Table]:
    """A table per question and test, a row per predictor: means over the trials.

    With several trials, skills are medians, because a single trial may spoil a mean.
    """
    summary = found.summary()
    counts = summary["judged [1]"]
    several = bool((counts > 1).any())
    for_wrench = {"moment RMSE [N m]": ".3f", "force RMSE [N]": ".2f"}
    for_wrench |= {f"{'median ' * several}{kind} skill [-]": "z.2f" for kind in ("moment", "force")}
    for_forces = dict.fromkeys(["error [-]", *["worst error [-]"] * several], ".2f")
    for level in validation.LEVELS:
        title = f"in {100 * level:g} % [%]"
        summary[title] = 100.0 * summary[f"within {100 * level:g} % [-]"]
        for_forces[title] = ".0f"
    rows = dict([*summary.groupby(level=["question", "test"])])
    for (question, test), caption in _CAPTIONS.items():
        if (question, test) in rows:
            formats = for_wrench if question == "wrench" else for_forces
            if counts.nunique() > 1:  # a variant could not be fitted everywhere
                formats = formats | {"judged [1]": ".0f"}
            frame = rows[question, test].droplevel([0, 1])[[*formats]]
            yield Table(f"{question}-{test}".replace(" ", "-"), caption, frame, formats)


def _shares(results: Results) -> Table:
    columns = {
        (label, f"{part} [%]"): [100.0 * getattr(share, part) for share in found.load_shares()]
        for label, found in results.candidates.items()
        for part in ("springs", "offsets", "residual")
    }
    first = next(iter(results.candidates.values()))
    names = [share.name for share in first.load_shares()]
    frame = pd.DataFrame(columns, index=pd.Index(names, name="measured"))
    formats = dict.fromkeys((title for _, title in columns), "z.0f")
    return Table("shares", "Shares of the measured load over the segment", frame, formats)
