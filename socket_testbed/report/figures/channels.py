"""Measured against predicted channels, a panel each; the trial at a glance; the offsets as bars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.identification.evaluation import ChannelErrors, channel_errors
from socket_testbed.report.figures.style import (
    MEASURED_STYLE,
    MODEL_STYLES,
    SEGMENT_STYLE,
    lay_out,
    style_axes,
    thin,
)
from socket_testbed.samples import WRENCH_CHANNELS

MOST_POINTS = 2000  # per line
_PANEL = (4.4, 2.75)  # [inch]
_QUANTITIES = {"N m": "moment", "N": "force"}


@dataclass(frozen=True)
class Prediction:
    """What a model predicts of a channel.

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
    style_axes(axis)
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


FORCES_FIRST = (3, 4, 5, 0, 1, 2)  # the forces above, the moments below


def wrench_figure(
    time: FloatArray,
    measured: FloatArray,
    predicted: dict[str, FloatArray],
    rows: BoolArray,
    title: str,
) -> Figure:
    """Measured against predicted wrench, a panel per channel, with the errors in the panels.

    Args:
        time: Times, shape (N,) [s].
        measured: Measured wrenches [M; F], shape (N, 6) [N m, N].
        predicted: Predicted wrenches by variant, shape (N, 6) each; NaN before a model.
        rows: Samples that the errors are taken over, shaded, shape (N,).
        title: What is shown.
    """
    span = (float(time[rows][0]), float(time[rows][-1]))
    panels = [
        Panel(
            time,
            measured[:, i],
            tuple(
                Prediction(
                    variant,
                    wrench[:, i],
                    channel_errors(WRENCH_CHANNELS[i], measured[rows, i], wrench[rows, i]),
                )
                for variant, wrench in predicted.items()
            ),
            span,
        )
        for i in FORCES_FIRST
    ]
    return panels_figure(panels, 3, f"{title}; errors over the shaded span")


_OVERVIEW_WIDTH, _LOAD, _DROP_OUTS, _DROP_OUTS_AXIS = 7.0, 1.7, 0.2, 1.2  # [inch]
_BINS = 400  # of the trial's time
_CHOSEN, _OTHER = "0.80", "0.93"  # greys


def overview_figure(
    time: FloatArray,
    wrench: FloatArray,
    plateaus: Sequence[tuple[float, float]],
    chosen: tuple[float, float],
    unusable: Mapping[str, BoolArray],
) -> Figure:
    """The magnitudes of force and moment, and the share of samples that cannot be used.

    Args:
        time: Times of the samples, shape (N,) [s].
        wrench: Measured wrenches [M; F], shape (N, 6) [N m, N].
        plateaus: Starts and ends of the steady stretches [s].
        chosen: Start and end of the segment in use [s].
        unusable: Samples in which a measurement cannot be used, shape (N,), by its name.
    """
    raster = _DROP_OUTS * len(unusable) + _DROP_OUTS_AXIS
    figure = Figure(figsize=(_OVERVIEW_WIDTH, 2.0 * _LOAD + raster), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, height_ratios=(_LOAD, _LOAD, raster))
    for axis, columns, label, colour in (
        (axes[0], slice(3, 6), "force [N]", "#0072B2"),
        (axes[1], slice(0, 3), "moment [N m]", "#D55E00"),
    ):
        for span in plateaus:
            axis.axvspan(*span, color=_OTHER, linewidth=0.0)
        axis.axvspan(*chosen, color=_CHOSEN, linewidth=0.0)
        magnitude = np.linalg.norm(wrench[:, columns], axis=1)
        axis.plot(*thin(time, magnitude, MOST_POINTS), color=colour, linewidth=1.0)
        axis.set_ylabel(f"magnitude of the\n{label}", fontsize=9)
        style_axes(axis)
    _draw_raster(figure, axes[2], time, unusable)
    for axis in axes:
        axis.tick_params(labelsize=9)
    return lay_out(figure)


def _draw_raster(
    figure: Figure, axis: Axes, time: FloatArray, unusable: Mapping[str, BoolArray]
) -> None:
    count = max(1, min(_BINS, len(time) // 2))
    edges = np.linspace(time[0], max(time[-1], time[0] + 1e-3), count + 1)
    bins = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, count - 1)
    triggers = np.bincount(bins, minlength=count)
    lost = [np.bincount(bins, flags, minlength=count) for flags in unusable.values()]
    # Without a trigger nothing was measured at all.
    share = np.where(triggers > 0, np.array(lost) / np.maximum(triggers, 1), 1.0)
    rows = np.arange(len(unusable) + 1) - 0.5
    mesh = axis.pcolormesh(edges, rows, share, cmap="Greys", vmin=0.0, vmax=1.0, rasterized=True)
    axis.set_yticks(range(len(unusable)), list(unusable), fontsize=8.5, parse_math=False)
    axis.invert_yaxis()
    axis.set_xlabel("time [s]", fontsize=9)
    bar = figure.colorbar(mesh, ax=axis, pad=0.01, aspect=12)
    bar.set_label("not usable [-]", fontsize=9)


_OFFSETS_WIDTH, _BAR, _BARS_AXIS = 5.6, 0.24, 0.8  # [inch]
_TITLES = ("moment [N m]", "force [N]", "force on a cluster, in its frame [N]")


def offsets_figure(channels: Sequence[str], offsets: Mapping[str, FloatArray]) -> Figure:
    """Offsets of every channel, a bar per model: moments, forces, the clusters' forces.

    Args:
        channels: Names of the m channels.
        offsets: Offsets by model, shape (m,) each [N m, N]; three models at most.
    """
    count = len(WRENCH_CHANNELS)
    groups = [[0, 1, 2], [3, 4, 5], [*range(count, len(channels))]]
    heights = [_BAR * len(indices) + _BARS_AXIS for indices in groups]
    figure = Figure(figsize=(_OFFSETS_WIDTH, sum(heights)), layout="constrained")
    axes = figure.subplots(3, 1, height_ratios=heights)
    thickness = 0.8 / len(offsets)
    for axis, title, indices in zip(axes, _TITLES, groups, strict=True):
        places = np.arange(len(indices))
        for number, (label, values) in enumerate(offsets.items()):
            shift = (number - 0.5 * (len(offsets) - 1)) * thickness
            # The first colour is that of the model without offsets: it comes last here.
            colour = MODEL_STYLES[(1 + number) % len(MODEL_STYLES)]["color"]
            axis.barh(places + shift, values[indices], thickness, color=colour, label=label)
        axis.axvline(0.0, color="0.3", linewidth=0.8)
        axis.set_yticks(places, [channels[i] for i in indices], fontsize=9, parse_math=False)
        axis.invert_yaxis()
        axis.set_xlabel(f"offset of the {title}", fontsize=9)
        axis.tick_params(axis="x", labelsize=9)
        style_axes(axis)
    if len(offsets) > 1:
        for text in axes[0].legend(frameon=False, fontsize=8).get_texts():
            text.set_parse_math(False)
    return lay_out(figure)
