"""What estimates are worth on what they have not seen, as a figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from socket_testbed.identification.validation import (
    CLOSED,
    FORCE_MAP,
    INVERSE_DISTANCE,
    LEVELS,
    Judgement,
)
from socket_testbed.report.figures.style import (
    DEFAULT_STYLE,
    MODEL_STYLES,
    FigureStyle,
    in_style,
    lay_out,
    style_axes,
)

_COLOURS = {INVERSE_DISTANCE: "0.75", CLOSED: "0.5", FORCE_MAP: MODEL_STYLES[1]["color"]}
_QUESTIONS = {"cluster": "all clusters", "tiles": "tiles without a sensor"}
_MARKERS = {"cluster": "o", "tiles": "s"}


@in_style
def validation_figure(
    judgements: Sequence[Judgement], title: str, style: FigureStyle = DEFAULT_STYLE
) -> Figure:
    """Draw the errors of forces by left-out cluster, and the coverage of the map's intervals.

    Args:
        judgements: Judgements of one trial, or of several: then their means are drawn.
        title: What is shown.
        style: How it is set.
    """
    narrow = style.is_narrow
    figure = style.figure(130.0 if narrow else 75.0)
    style.add_title(figure, title)
    shape: dict[str, Any] = {"nrows": 2} if narrow else {"ncols": 2, "width_ratios": (3, 2)}
    errors, coverage = figure.subplots(**shape)
    _draw_errors(errors, judgements)
    _draw_coverage(coverage, judgements)
    return lay_out(figure)


def _draw_errors(axes: Axes, judgements: Sequence[Judgement]) -> None:
    found: dict[tuple[str, str], list[float]] = {}
    for j in judgements:
        if j.question in _QUESTIONS and j.predictor in _COLOURS:
            row = j.cluster or _QUESTIONS[j.question]
            found.setdefault((row, j.predictor), []).append(j.error)
    rows = list(dict.fromkeys(row for row, _ in found))
    thickness = 0.8 / len(_COLOURS)
    places = np.arange(len(rows))
    for number, (predictor, colour) in enumerate(_COLOURS.items()):
        shift = (number - 0.5 * (len(_COLOURS) - 1)) * thickness
        widths = [np.mean(found.get((row, predictor), np.nan)) for row in rows]
        axes.barh(places + shift, widths, thickness, color=colour, label=predictor)
    axes.axvline(1.0, color="0.3", linewidth=0.8)
    axes.set_yticks(places, rows, parse_math=False)
    axes.invert_yaxis()
    axes.set_xlabel("error over the rms of the forces [-]\n1: predicting zero")
    style_axes(axes)
    axes.legend()


def _draw_coverage(axes: Axes, judgements: Sequence[Judgement]) -> None:
    levels = 100.0 * np.array(LEVELS)
    axes.plot([40.0, 100.0], [40.0, 100.0], color="0.3", linewidth=0.8)
    for question, label in _QUESTIONS.items():
        coverages = [
            j.coverage
            for j in judgements
            if j.predictor == FORCE_MAP and j.question == question and not j.cluster
        ]
        if coverages:
            axes.plot(
                levels,
                100.0 * np.mean(coverages, axis=0),
                color=_COLOURS[FORCE_MAP],
                marker=_MARKERS[question],
                markerfacecolor="white",
                label=label,
            )
    axes.set_xlabel("stated probability of the interval [%]")
    axes.set_ylabel("values within the force map's\ninterval [%]")
    axes.set_xticks(levels)
    style_axes(axes)
    axes.legend()
