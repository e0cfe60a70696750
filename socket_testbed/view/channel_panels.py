"""Measured against predicted channels, a panel each, with the errors in the panel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from socket_testbed.arrays import FloatArray
from socket_testbed.evaluation import ChannelErrors
from socket_testbed.view.paper import MEASURED_STYLE, MODEL_STYLES, SEGMENT_STYLE, dress, lay_out
from socket_testbed.view.thinning import thin

MOST_POINTS = 2000  # a line
_PANEL = (4.4, 2.75)  # [inch]
_QUANTITIES = {"N m": "moment", "N": "force"}


@dataclass(frozen=True)
class Prediction:
    """What a model says of a channel.

    Attributes:
        label: Name of the model.
        values: Predicted values, shape (N,) [N m or N]; NaN where there is none.
        errors: Its errors over the shaded span.
    """

    label: str
    values: FloatArray
    errors: ChannelErrors


@dataclass(frozen=True)
class Panel:
    """A channel to be drawn.

    Attributes:
        time: Times, shape (N,) [s].
        measured: Measured values, shape (N,) [N m or N]; NaN where there is none.
        predictions: What each model says of it, one at least and three at most.
        span: Start and end of what the errors are taken over [s].
    """

    time: FloatArray
    measured: FloatArray
    predictions: tuple[Prediction, ...]
    span: tuple[float, float]

    @property
    def name(self) -> str:
        """Name of the channel."""
        return self.predictions[0].errors.name

    @property
    def unit(self) -> str:
        """Unit of the channel."""
        return self.predictions[0].errors.unit


def panels_figure(panels: Sequence[Panel], columns: int, title: str = "") -> Figure:
    """A figure of panels over a common time.

    Args:
        panels: The channels, row by row.
        columns: Number of panels in a row.
        title: What is shown; nothing for none.
    """
    rows = -(-len(panels) // columns)
    size = (columns * _PANEL[0], rows * _PANEL[1] + (0.35 if title else 0.0))
    figure = Figure(figsize=size, layout="constrained")
    if title:
        figure.suptitle(title, fontsize=11, parse_math=False)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True)
    for axis, panel in zip(axes.flat, panels, strict=False):
        draw_panel(axis, panel)
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    for column in range(columns):
        last = (len(panels) - 1 - column) // columns
        if last >= 0:
            axes[last, column].set_xlabel("time [s]", fontsize=9)
            axes[last, column].tick_params(labelbottom=True)
    return lay_out(figure)


def draw_panel(axis: Axes, panel: Panel) -> None:
    """Draw a channel with its key above the lines: each model with its errors."""
    axis.axvspan(*panel.span, **SEGMENT_STYLE)
    axis.plot(*thin(panel.time, panel.measured, MOST_POINTS), label="measured", **MEASURED_STYLE)
    for prediction, style in zip(panel.predictions, MODEL_STYLES, strict=False):
        line = thin(panel.time, prediction.values, MOST_POINTS)
        axis.plot(*line, label=_describe(prediction), **style)
    axis.set_ylabel(f"{_QUANTITIES[panel.unit]} [{panel.unit}]", fontsize=9)
    axis.tick_params(labelsize=8.5)
    dress(axis)
    _add_key(axis, panel)


def _add_key(axis: Axes, panel: Panel) -> None:
    left_out = not panel.predictions[0].errors.in_objective
    legend = axis.legend(
        title=panel.name + (" (not in objective)" if left_out else ""),
        loc="lower left",
        bbox_to_anchor=(-0.01, 1.0),
        borderaxespad=0.0,
        frameon=False,
        fontsize=7.2,
        labelspacing=0.2,
        handlelength=1.8,
        alignment="left",
        title_fontproperties={"size": 9.5, "weight": "bold"},
    )
    for text in (legend.get_title(), *legend.get_texts()):
        text.set_parse_math(False)


def _describe(prediction: Prediction) -> str:
    e = prediction.errors
    if e.samples == 0:
        return f"{prediction.label}: no errors, no value in the span"
    digits = 2 if abs(e.skill) < 10.0 else 0
    skill = f"{round(e.skill, digits) + 0.0:.{digits}f}" if isfinite(e.skill) else "none"
    skill = skill.replace("-", "\N{MINUS SIGN}")
    return (
        f"{prediction.label}: RMSE {e.rmse:.2f}, MAE {e.mae:.2f}, \N{GREEK SMALL LETTER SIGMA}"
        f" {e.sigma:.2f} {e.unit}, skill {skill}"
    )
