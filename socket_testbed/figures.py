"""Figures for a paper: light, legible, units on every axis, and told apart in grey."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.evaluation import channel_errors, channel_unit
from socket_testbed.samples import WRENCH_CHANNELS

# Okabe & Ito's colours differ in lightness, too, and every line has its own dashes.
_STYLES = (
    {"color": "#D55E00", "linestyle": (0, (4, 1.5)), "linewidth": 1.1},
    {"color": "#0072B2", "linestyle": "-", "linewidth": 1.1},
)
_MEASURED = {"color": "0.72", "linewidth": 2.4}


def wrench_figure(
    time: FloatArray,
    measured: FloatArray,
    predicted: dict[str, FloatArray],
    rows: BoolArray,
    title: str,
    path: Path,
) -> None:
    """Measured against predicted wrench, a panel a channel, with the errors in the panels.

    Args:
        time: Times, shape (N,) [s].
        measured: Measured wrenches [M; F], shape (N, 6) [N m, N].
        predicted: Predicted wrenches by variant, shape (N, 6) each; NaN before a model.
        rows: Samples that the errors are taken over, shaded, shape (N,).
        title: What is shown.
        path: File to write; its suffix says the format.
    """
    figure = Figure(figsize=(10.0, 6.2), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True)
    figure.suptitle(f"{title}; errors over the shaded span", fontsize=11)
    order = [3, 4, 5, 0, 1, 2]  # the forces above, the moments below
    for axis, channel in zip(axes.flat, order, strict=True):
        name = WRENCH_CHANNELS[channel]
        axis.plot(time, measured[:, channel], label="measured", **_MEASURED)
        lines = []
        for (variant, wrench), style in zip(predicted.items(), _STYLES, strict=False):
            label = f"predicted, {variant}"
            axis.plot(time, wrench[:, channel], label=label, **style)
            errors = channel_errors(name, measured[rows, channel], wrench[rows, channel])
            lines.append(f"{variant}: RMSE {errors.rmse:.2f} {channel_unit(name)}")
        axis.set_ylabel(f"${name[0]}_{name[1]}$ [{channel_unit(name)}]")
        axis.axvspan(time[rows][0], time[rows][-1], color="0.95", linewidth=0.0)
        axis.grid(color="0.9")
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
        _leave_room(axis)
        axis.text(0.02, 0.98, "\n".join(lines), transform=axis.transAxes, va="top", fontsize=7.5)
    for axis in axes[1]:
        axis.set_xlabel("time [s]")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    with mpl.rc_context({"pdf.fonttype": 42}):
        figure.savefig(path, dpi=150)


def _leave_room(axis: mpl.axes.Axes) -> None:
    """Room above the lines for the text in the panel."""
    low, high = axis.get_ylim()
    if np.isfinite([low, high]).all():
        axis.set_ylim(low, high + 0.28 * (high - low))
