"""Trade-off between wrench and clusters: Pareto fronts of the paper's variants."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.figures.style import (
    LINE_STYLES,
    PAGE_LINES,
    FigureStyle,
    in_style,
    lay_out,
    style_axes,
)
from socket_testbed.identification.pareto import (
    FIGURES,
    KNEE,
    SENSOR_ONLY,
    WRENCH_ONLY,
    Front,
    front_table,
)
from socket_testbed.pages.document import numbers
from socket_testbed.report.page import ReportFigure, Section
from socket_testbed.results.report import Results
from socket_testbed.tables import Table

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
_WRENCH_LABEL = "wrench error \N{SQUARE ROOT}J_w [-]"
_LOCAL_LABEL = "local error \N{SQUARE ROOT}J_f [-]"
_ASPECT = 0.62  # [-]; height of the panel over its width


def section(results: Results) -> Section:
    """The section on the fronts, or the reason for their absence."""
    if not results.fronts:
        return Section("fronts", "Pareto fronts", [f"None: {results.no_fronts}."])
    fronts, lines = [*results.fronts.values()], {}
    for front, style in zip(fronts, PAGE_LINES[1:], strict=False):
        kept, errors = _kept(front)
        x, y = numbers(errors[:, kept], 6)
        lines[_describe(front)] = {"x": x, "y": y, "style": style}
    figure = ReportFigure(
        "pareto",
        "Normalised error of the clusters against that of the wrench, for theta from 0 to 1. Errors"
        " are the square roots of the terms of the objective; predicting zero gives 1. Dominated"
        " solutions are faint.",
        lambda style: pareto_figure(fronts, results.title("Trade-off"), style),
        front_table(fronts),
        {
            "dots": True,
            "log": True,
            "over": _WRENCH_LABEL,
            "panels": [{"title": _LOCAL_LABEL, "lines": lines}],
        },
    )
    verdicts = [f"{front.variant}: {front.knee.verdict}." for front in fronts]
    return Section("fronts", "Pareto fronts", [verdicts, figure, marks_table(fronts)])


def _kept(front: Front) -> tuple[IntArray, FloatArray]:
    """Indices of non-dominated solutions along the front, and both errors of all, (2, k)."""
    kept = np.flatnonzero(front.non_dominated)
    kept = kept[np.argsort(front.wrench_error[kept], kind="stable")]
    return kept, np.maximum([front.wrench_error, front.local_error], _MIN_ERROR)


def marks_table(fronts: Iterable[Front]) -> Table:
    """The marked solutions of each front, three rows each: sensor-only, knee and wrench-only.

    The table is indexed by `variant`. Its columns are `solution`, `theta [-]`, both normalised
    errors [-], the paper's mean and median RMSE [N m, N], and a `remark`. Numbers are NaN where a
    front has no such solution; the remark then says why, otherwise whether it is dominated.
    """
    columns = [*FIGURES.values()][:-1]  # without the residual
    rows = []
    for front in fronts:
        table = front.to_dataframe()
        for name in (SENSOR_ONLY, KNEE, WRENCH_ONLY):
            row: dict[str, Any] = {"variant": front.variant, "solution": name}
            index = front.marks.get(name)
            if index is None:
                flaw = front.flaws[0 if name == SENSOR_ONLY else -1]
                row |= dict.fromkeys(columns, np.nan) | {"remark": "none" if name == KNEE else flaw}
            else:
                remark = "" if front.non_dominated[index] else "dominated"
                row |= table.loc[index, columns].to_dict() | {"remark": remark}
            rows.append(row)
    formats = {"theta [-]": ".3g", "wrench error [-]": ".4f", "local error [-]": ".4f"}
    caption = "The marked solutions of each front, with RMSE of the channels in the objective"
    return Table("marks", caption, pd.DataFrame(rows).set_index("variant"), formats)


@in_style
def pareto_figure(fronts: Iterable[Front], title: str, style: FigureStyle) -> Figure:
    """Draw both normalised errors of at most two fronts on logarithmic axes.

    Dominated solutions are faint; flawed ones are not shown.

    Args:
        fronts: The fronts.
        title: Title of the figure.
        style: Print layout.
    """
    columns = 2 if style.is_narrow else 3
    figure = style.figure(_ASPECT * style.width + 30.0 - 6.0 * columns)
    style.add_title(figure, title)
    axes = figure.subplots()
    for front, line in zip(fronts, LINE_STYLES, strict=False):
        _draw_front(axes, front, line)
    axes.set(xscale="log", yscale="log", xlabel=_WRENCH_LABEL, ylabel=_LOCAL_LABEL)
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
    kept, errors = _kept(front)
    dominated, colour = front.sound & ~front.non_dominated, style["color"]
    axes.plot(*errors[:, kept], label=_describe(front), **style)
    axes.plot(*errors[:, kept], color=colour, **_DOTS)
    axes.plot(*errors[:, dominated], color=colour, alpha=_FAINT, markeredgewidth=0.0, **_DOTS)
    for name, index in front.marks.items():
        axes.plot(*errors[:, [index]], color=colour, **_HOLLOW, **_MARKS[name])


def _describe(front: Front) -> str:
    knee = front.knee.index
    text = "no knee" if knee is None else f"knee at {_THETA} = {front.theta[knee]:.3g}"
    return f"{front.variant}: {text}"
