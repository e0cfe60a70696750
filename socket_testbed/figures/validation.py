"""Errors of estimates on held-out data, and coverage of their intervals, drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from socket_testbed.figures.style import LINE_STYLES, FigureStyle, in_style, lay_out, style_axes
from socket_testbed.identification import validation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = {
    validation.INVERSE_DISTANCE: "0.75",
    validation.CLOSED: "0.5",
    validation.FORCE_MAP: LINE_STYLES[1]["color"],
}
_QUESTIONS: dict[validation.Question, str] = {
    "cluster": "all clusters",
    "tiles": "tiles without a sensor",
}
_MARKERS: dict[validation.Question, str] = {"cluster": "o", "tiles": "s"}


@in_style
def validation_figure(
    judgements: Sequence[validation.Judgement], title: str, style: FigureStyle
) -> Figure:
    """Draw force errors by left-out cluster, and the coverage of the map's intervals.

    For several trials, means are drawn.

    Args:
        judgements: The judgements of one trial or of several.
        title: Title of the figure.
        style: Print layout.
    """
    narrow = style.is_narrow
    figure = style.figure(130.0 if narrow else 75.0)
    style.add_title(figure, title)
    shape: dict[str, Any] = {"nrows": 2} if narrow else {"ncols": 2, "width_ratios": (3, 2)}
    errors, coverage = figure.subplots(**shape)
    _draw_errors(errors, judgements)
    _draw_coverage(coverage, judgements)
    return lay_out(figure)


def _draw_errors(axes: Axes, judgements: Sequence[validation.Judgement]) -> None:
    rows = [
        (judged.cluster or _QUESTIONS[judged.question], judged.predictor, judged.error)
        for judged in judgements
        if judged.question in _QUESTIONS
    ]
    found = pd.DataFrame(rows, columns=["row", "predictor", "error"])
    errors = found.pivot_table("error", "row", "predictor", sort=False).reindex(columns=[*_COLOURS])
    thickness = 0.8 / len(_COLOURS)
    places = np.arange(len(errors))
    for i, (predictor, colour) in enumerate(_COLOURS.items()):
        shifted = places + (i - 0.5 * (len(_COLOURS) - 1)) * thickness
        axes.barh(shifted, errors[predictor], thickness, color=colour, label=predictor)
    axes.axvline(1.0, color="0.3", linewidth=0.8)
    axes.set_yticks(places, errors.index, parse_math=False)
    axes.invert_yaxis()
    axes.set_xlabel("error over the rms of the forces [-]\n1: predicting zero")
    style_axes(axes)
    axes.legend()


def _draw_coverage(axes: Axes, judgements: Sequence[validation.Judgement]) -> None:
    levels = 100.0 * np.array(validation.LEVELS)
    axes.plot([40.0, 100.0], [40.0, 100.0], color="0.3", linewidth=0.8)
    judged = [j for j in judgements if j.predictor == validation.FORCE_MAP and not j.cluster]
    for question, label in _QUESTIONS.items():
        coverages = [j.coverage for j in judged if j.question == question]
        if coverages:
            shares = 100.0 * np.mean(coverages, axis=0)
            look = {"color": _COLOURS[validation.FORCE_MAP], "markerfacecolor": "white"}
            axes.plot(levels, shares, marker=_MARKERS[question], label=label, **look)
    axes.set_xlabel("stated probability of the interval [%]")
    axes.set_ylabel("values within the force map's\ninterval [%]")
    axes.set_xticks(levels)
    style_axes(axes)
    axes.legend()
