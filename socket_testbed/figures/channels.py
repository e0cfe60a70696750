"""Measured and predicted channels over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

from socket_testbed.arrays import FloatArray
from socket_testbed.figures.style import (
    LINE_STYLES,
    MEASURED_STYLE,
    SEGMENT_STYLE,
    FigureStyle,
    add_legend,
    in_style,
    lay_out,
    panels,
    thin,
    wrap,
)
from socket_testbed.identification.channel_errors import ChannelErrors
from socket_testbed.samples import Samples
from socket_testbed.tables import number
from socket_testbed.trials.segment import Segment

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORCES_FIRST = (3, 4, 5, 0, 1, 2)  # channels of the wrench: forces above, moments below

_PANEL_HEIGHT, _KEY_LINE = 30.0, 3.1  # [mm]; panel without its key; line of the key
_NAME_WIDTH = 26.0  # [mm]; longest line of a name above a panel
_QUANTITIES = {"N m": "moment", "N": "force"}

Shown: TypeAlias = tuple[str, FloatArray, Sequence[ChannelErrors]]
"""A model's label, its predictions for all samples, shape (N, 6 + 3c) [N m, N], and its errors."""


@in_style
def wrench_figure(
    samples: Samples,
    segment: Segment,
    models: Sequence[Shown],
    title: str,
    style: FigureStyle,
    channels: Sequence[int] = FORCES_FIRST,
) -> Figure:
    """Measured and predicted channels, by default those of the wrench.

    One panel per channel: three per row of a page, with errors unless titles are off, or two per
    row of a column.

    Args:
        samples: All N samples of a trial with c clusters.
        segment: The part of the trial that is shaded, over which the errors are.
        models: At most four models; whether a channel is in the objective is read from the first.
        title: Title of the figure.
        style: Print layout.
        channels: Indices of the channels among `samples.channels`, 0 to 5 + 3c, in the order of the
            panels; by default forces, then moments.
    """
    across, has_errors = 2 if style.is_narrow else 3, style.titles and not style.is_narrow
    rows = -(-len(channels) // across)
    key = _KEY_LINE * (2.5 + 2 * len(models)) if has_errors else 0.0
    figure = style.figure(rows * (_PANEL_HEIGHT + key) + (12.0 if has_errors else 20.0))
    style.add_title(figure, title)
    axes, measured = panels(figure, len(channels), across), samples.trusted_values
    for axis, channel in zip(axes, channels, strict=True):
        first = models[0][2][channel]
        axis.axvspan(segment.start, segment.end, **SEGMENT_STYLE)
        axis.plot(*thin(samples.time, measured[:, channel]), label="measured", **MEASURED_STYLE)
        for (label, predicted, errors), look in zip(models, LINE_STYLES, strict=False):
            described = _key(label, errors[channel]) if has_errors else label
            axis.plot(*thin(samples.time, predicted[:, channel]), label=described, **look)
        axis.set_ylabel(f"{_QUANTITIES[first.unit]} [{first.unit}]")
        name = first.name + " (not in objective)" * (not first.in_objective)
        if has_errors:
            add_legend(axis, title=name, labelspacing=0.2, handlelength=1.8)
        else:
            axis.set_title(wrap(name, _NAME_WIDTH), loc="left", fontweight="bold", parse_math=False)
    if not has_errors:
        handles, labels = axes[0].get_legend_handles_labels()
        add_legend(figure, handles, labels, loc="outside lower center", ncols=across + 1)
    return lay_out(figure)


def _key(label: str, e: ChannelErrors) -> str:
    if e.samples == 0:
        return f"{label}: no errors,\nno value in the span"
    digits = "z.2f" if abs(e.skill) < 10.0 else "z.0f"
    return (
        f"{label}: RMSE {e.rmse:.2f} {e.unit},\nMAE {e.mae:.2f},"
        f" \N{GREEK SMALL LETTER SIGMA} {e.sigma:.2f}, skill {number(e.skill, digits)}"
    )
