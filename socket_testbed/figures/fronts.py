"""Pareto fronts of the trade-off between wrench and clusters, drawn."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.figures.style import LINE_STYLES, FigureStyle, in_style, lay_out, style_axes
from socket_testbed.identification.pareto import KNEE, SENSOR_ONLY, WRENCH_ONLY, Front

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MARKS: dict[str, dict[str, Any]] = {
    SENSOR_ONLY: {"marker": "s", "markersize": 6},
    KNEE: {"marker": "*", "markersize": 10},
    WRENCH_ONLY: {"marker": "^", "markersize": 6},
}
_THETA = "\N{GREEK SMALL LETTER THETA}"
_MEANINGS = {SENSOR_ONLY: f" ({_THETA} = 0)", KNEE: "", WRENCH_ONLY: f" ({_THETA} = 1)"}
_HOLLOW: dict[str, Any] = {"linestyle": "none", "markerfacecolor": "white", "markeredgewidth": 1.0}
_DOTS: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 3}
_FAINT = 0.3  # opacity
_MARGIN = 0.08  # [-]; around the solutions
_MIN_ERROR = 1e-8  # [-]; for the logarithmic axes, below the precision of errors
_WIDE_RATIO = 5.0  # [-]; ratio of axis limits above which ticks are at 1, 2, 5
WRENCH_LABEL = "wrench error \N{SQUARE ROOT}J_w [-]"
LOCAL_LABEL = "local error \N{SQUARE ROOT}J_f [-]"
_ASPECT = 0.62  # [-]; height of the panel over its width


@in_style
def pareto_figure(fronts: Iterable[Front], title: str, style: FigureStyle) -> Figure:
    """Draw both normalised errors of at most two fronts on logarithmic axes.

    Dominated solutions are faint; flawed ones are not shown.

    Args:
        fronts: The fronts.
        title: Title of the figure.
        style: Print layout.
    """
    from matplotlib.lines import Line2D
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

    columns = 2 if style.is_narrow else 3
    figure = style.figure(_ASPECT * style.width + 30.0 - 6.0 * columns)
    style.add_title(figure, title)
    axes = figure.subplots()
    for front, line in zip(fronts, LINE_STYLES, strict=False):
        _draw_front(axes, front, line)
    axes.set(xscale="log", yscale="log", xlabel=WRENCH_LABEL, ylabel=LOCAL_LABEL)
    axes.margins(_MARGIN)
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        wide = high / low > _WIDE_RATIO
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)) if wide else MaxNLocator(6))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(NullLocator())
    style_axes(axes)
    marks = [
        Line2D([], [], color="0.3", label=name + _MEANINGS[name], **_HOLLOW, **shape)
        for name, shape in _MARKS.items()
    ]
    faint = Line2D([], [], color="0.3", alpha=_FAINT, label="dominated", **_DOTS)
    handles = [*axes.get_legend_handles_labels()[0], *marks, faint]
    figure.legend(handles=handles, loc="outside lower center", ncols=columns)
    return lay_out(figure)


def _draw_front(axes: Axes, front: Front, style: dict[str, Any]) -> None:
    kept, errors = kept_solutions(front)
    dominated, colour = front.sound & ~front.non_dominated, style["color"]
    axes.plot(*errors[:, kept], label=describe_front(front), **style)
    axes.plot(*errors[:, kept], color=colour, **_DOTS)
    axes.plot(*errors[:, dominated], color=colour, alpha=_FAINT, markeredgewidth=0.0, **_DOTS)
    for name, index in front.marks.items():
        axes.plot(*errors[:, [index]], color=colour, **_HOLLOW, **_MARKS[name])


def kept_solutions(front: Front) -> tuple[IntArray, FloatArray]:
    """Indices of non-dominated solutions along the front, and both errors of all, (2, k)."""
    kept = np.flatnonzero(front.non_dominated)
    kept = kept[np.argsort(front.wrench_error[kept], kind="stable")]
    return kept, np.maximum([front.wrench_error, front.local_error], _MIN_ERROR)


def describe_front(front: Front) -> str:
    """A front's variant and the theta of its knee, in words."""
    knee = front.knee.index
    text = "no knee" if knee is None else f"knee at {_THETA} = {front.theta[knee]:.3g}"
    return f"{front.variant}: {text}"
