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
    BAR_STYLES,
    DEFAULT_STYLE,
    LABEL,
    MEASURED_STYLE,
    MODEL_STYLES,
    SEGMENT_STYLE,
    FigureStyle,
    in_style,
    lay_out,
    style_axes,
    thin,
    wrap,
)
from socket_testbed.samples import WRENCH_CHANNELS

MOST_POINTS = 1000  # per line
_PANEL, _KEY_LINE = 34.0, 3.1  # [mm]; height of a panel without its key; of a line of the key
_WIDE = 80.0  # [mm]; of a panel that takes a model and its errors in two lines
_NAME = 26.0  # [mm]; longest line of a name above a panel
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


@in_style
def panels_figure(
    panels: Sequence[Panel],
    columns: int,
    title: str = "",
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """A figure of panels over a common time, each with its errors or, without titles, without.

    Args:
        panels: The channels, in groups of `columns`: a row of a page, or a column of two.
        columns: Number of panels in a group, 3 or 1.
        title: What is shown; nothing for none.
        style: How it is set.
    """
    groups = -(-len(panels) // columns)
    if not style.is_narrow:
        places = [divmod(i, columns) for i in range(len(panels))]
    elif style.titles:
        places = [(i, 0) for i in range(len(panels))]
    else:  # two groups side by side
        places = [
            (columns * (i // columns // 2) + i % columns, i // columns % min(2, groups))
            for i in range(len(panels))
        ]
    rows, across = (1 + np.max(places, axis=0)).tolist()
    lines = 2 if style.width / across >= _WIDE else 3
    models = max(len(panel.predictions) for panel in panels)
    key = _KEY_LINE * (2.5 + lines * models) if style.titles else 0.0
    figure = style.figure(rows * (_PANEL + key) + 12.0)
    style.add_title(figure, title)
    axes = figure.subplots(rows, across, squeeze=False, sharex=True)
    for panel, place in zip(panels, places, strict=True):
        draw_panel(axes[place], panel, lines if style.titles else 0)
    for place in {*np.ndindex(rows, across)} - {*places}:
        axes[place].set_visible(False)
    for column in range(across):
        last = axes[max(row for row, of in places if of == column), column]
        last.set_xlabel("time [s]")
        last.tick_params(labelbottom=True)
    if not style.titles:
        fullest = max(axes.flat, key=lambda axis: len(axis.get_legend_handles_labels()[0]))
        legend = figure.legend(
            *fullest.get_legend_handles_labels(), loc="outside lower center", ncols=across + 1
        )
        for text in legend.get_texts():
            text.set_parse_math(False)
    return lay_out(figure)


def draw_panel(axis: Axes, panel: Panel, lines: int) -> None:
    """Draw a channel, above it its name and a key: each model with its errors.

    Args:
        axis: The panel.
        panel: What is drawn.
        lines: Of a model in the key, 2 or 3; 0 for no key.
    """
    axis.axvspan(*panel.span, **SEGMENT_STYLE)
    axis.plot(*thin(panel.time, panel.measured, MOST_POINTS), label="measured", **MEASURED_STYLE)
    for prediction, style in zip(panel.predictions, MODEL_STYLES, strict=False):
        line = thin(panel.time, prediction.values, MOST_POINTS)
        axis.plot(*line, label=_describe(prediction, lines), **style)
    axis.set_ylabel(f"{_QUANTITIES[panel.unit]} [{panel.unit}]")
    style_axes(axis)
    left_out = not panel.predictions[0].errors.in_objective
    name = panel.name + (" (not in objective)" if left_out else "")
    if lines:
        _add_key(axis, name)
    else:
        axis.set_title(wrap(name, _NAME), loc="left", fontweight="bold", parse_math=False)


def _add_key(axis: Axes, name: str) -> None:
    legend = axis.legend(
        title=name,
        loc="lower left",
        bbox_to_anchor=(-0.01, 1.0),
        borderaxespad=0.0,
        labelspacing=0.2,
        handlelength=1.8,
        alignment="left",
        title_fontproperties={"size": LABEL, "weight": "bold"},
    )
    for text in (legend.get_title(), *legend.get_texts()):
        text.set_parse_math(False)


def _describe(prediction: Prediction, lines: int) -> str:
    e = prediction.errors
    if not lines:
        return prediction.label
    separator = ":\n" if lines == 3 else ": "
    if e.samples == 0:
        return f"{prediction.label}{separator}no errors,\nno value in the span"
    digits = 2 if abs(e.skill) < 10.0 else 0
    skill = f"{round(e.skill, digits) + 0.0:.{digits}f}" if isfinite(e.skill) else "none"
    skill = skill.replace("-", "\N{MINUS SIGN}")
    return (
        f"{prediction.label}{separator}RMSE {e.rmse:.2f}, MAE {e.mae:.2f},\n"
        f"\N{GREEK SMALL LETTER SIGMA} {e.sigma:.2f} {e.unit}, skill {skill}"
    )


FORCES_FIRST = (3, 4, 5, 0, 1, 2)  # the forces above, the moments below


def wrench_figure(
    time: FloatArray,
    measured: FloatArray,
    predicted: dict[str, FloatArray],
    rows: BoolArray,
    title: str,
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """Measured against predicted wrench, a panel per channel, with the errors in the panels.

    Args:
        time: Times, shape (N,) [s].
        measured: Measured wrenches [M; F], shape (N, 6) [N m, N].
        predicted: Predicted wrenches by variant, shape (N, 6) each; NaN before a model.
        rows: Samples that the errors are taken over, shaded, shape (N,).
        title: What is shown.
        style: How it is set.
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
    return panels_figure(panels, 3, f"{title}; errors over the shaded span", style)


_LOAD, _DROP_OUTS, _DROP_OUTS_AXIS = 36.0, 4.5, 16.0  # [mm]
_BINS = 400  # of the trial's time
_CHOSEN, _OTHER = "0.80", "0.93"  # greys


@in_style
def overview_figure(
    time: FloatArray,
    wrench: FloatArray,
    plateaus: Sequence[tuple[float, float]],
    chosen: tuple[float, float],
    unusable: Mapping[str, BoolArray],
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """The magnitudes of force and moment, and the share of samples that cannot be used.

    Args:
        time: Times of the samples, shape (N,) [s].
        wrench: Measured wrenches [M; F], shape (N, 6) [N m, N].
        plateaus: Starts and ends of the steady stretches [s].
        chosen: Start and end of the segment in use [s].
        unusable: Samples in which a measurement cannot be used, shape (N,), by its name.
        style: How it is set.
    """
    raster = _DROP_OUTS * len(unusable) + _DROP_OUTS_AXIS
    figure = style.figure(2.0 * _LOAD + raster)
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
        axis.set_ylabel(f"magnitude of the\n{label}")
        style_axes(axis)
    _draw_raster(figure, axes[2], time, unusable)
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
    axis.set_yticks(range(len(unusable)), list(unusable), parse_math=False)
    axis.invert_yaxis()
    axis.set_xlabel("time [s]")
    bar = figure.colorbar(mesh, ax=axis, pad=0.01, aspect=12)
    bar.set_label("not usable [-]")


_BAR, _BARS_AXIS = 6.0, 14.0  # [mm]
_TITLES = ("moment [N m]", "force [N]", "force on a cluster, in its frame [N]")


@in_style
def offsets_figure(
    channels: Sequence[str],
    offsets: Mapping[str, FloatArray],
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """Offsets of every channel, a bar per model: moments, forces, the clusters' forces.

    Args:
        channels: Names of the m channels.
        offsets: Offsets by model, shape (m,) each [N m, N]; three models at most.
        style: How it is set.
    """
    count = len(WRENCH_CHANNELS)
    groups = [[0, 1, 2], [3, 4, 5], [*range(count, len(channels))]]
    heights = [_BAR * len(indices) + _BARS_AXIS for indices in groups]
    figure = style.figure(sum(heights))
    axes = figure.subplots(3, 1, height_ratios=heights)
    thickness = 0.8 / len(offsets)
    for axis, title, indices in zip(axes, _TITLES, groups, strict=True):
        places = np.arange(len(indices))
        for number, (label, values) in enumerate(offsets.items()):
            shift = (number - 0.5 * (len(offsets) - 1)) * thickness
            # The first look is that of the model without offsets: it comes last here.
            look = BAR_STYLES[(1 + number) % len(BAR_STYLES)]
            axis.barh(places + shift, values[indices], thickness, label=label, **look)
        axis.axvline(0.0, color="0.3", linewidth=0.8)
        axis.set_yticks(places, [channels[i] for i in indices], parse_math=False)
        axis.invert_yaxis()
        axis.set_xlabel(wrap(f"offset of the {title}", 0.55 * style.width))
        style_axes(axis)
    if len(offsets) > 1:
        legend = figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center")
        for text in legend.get_texts():
            text.set_parse_math(False)
    return lay_out(figure)
