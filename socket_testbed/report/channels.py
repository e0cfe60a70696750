"""Measured against predicted wrench and local forces; their errors, and those of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from socket_testbed.arrays import FloatArray
from socket_testbed.identification.fit import (
    ChannelErrors,
    summarise_errors,
)
from socket_testbed.identification.pareto import THEIRS, beside_published
from socket_testbed.report.page import Heading, ReportFigure, Section, line_chart
from socket_testbed.report.results import Results
from socket_testbed.report.style import (
    LINE_STYLES,
    MEASURED_STYLE,
    SEGMENT_STYLE,
    THINNED,
    FigureStyle,
    add_legend,
    in_style,
    lay_out,
    panels,
    thin,
    wrap,
)
from socket_testbed.samples import WRENCH_CHANNELS, Samples, channel_unit
from socket_testbed.settings.identification import PAPER_VARIANTS
from socket_testbed.tables import Table, number
from socket_testbed.trials.segment import Segment

_PANEL, _KEY_LINE = 34.0, 3.1  # [mm]; height of a panel without its key; of a line of the key
_WIDE = 80.0  # [mm]; of a panel that takes a model and its errors in two lines
_NAME = 26.0  # [mm]; longest line of a name above a panel
_QUANTITIES = {"N m": "moment", "N": "force"}
_FORCES_FIRST = (3, 4, 5, 0, 1, 2)  # the forces above, the moments below
_MEASURES = {"RMSE": "rmse", "MAE": "mae", "sigma": "sigma", "skill [-]": "skill"}
_SUMMARIES = {
    "mean of the moments in the objective": ("N m", "moment_rmse"),
    "mean of the forces in the objective": ("N", "force_rmse"),
    "median of the local forces in the objective": ("N", "local_rmse"),
}


def wrench_section(results: Results) -> Section:
    """The section on the wrench."""
    figure = _channels(results, "wrench", "Measured and predicted wrench", _FORCES_FIRST)
    return Section("wrench", "Wrench", [figure])


def local_section(results: Results) -> Section:
    """The section on the local forces."""
    local = range(len(WRENCH_CHANNELS), len(results.samples.channels))
    title = "Measured and predicted forces in the clusters' frames"
    return Section("local", "Local forces", [_channels(results, "local_forces", title, local)])


def paper_section(results: Results) -> Section:
    """The section that lays the trial beside the paper."""
    frame = beside_published(
        {variant: results.fitted[variant].errors for variant in PAPER_VARIANTS},
        results.fronts,
        results.samples[results.segment.rows],
        results.settings.identification,
    )
    caption = "The figures of the paper, for its variants; 'paper' computes them with its settings"
    table = Table("paper", caption, frame, {THEIRS: ".2f"})
    return Section("paper-section", "This trial and the paper", [table])


def errors_section(results: Results) -> Section:
    """The section on the errors of every model, over the segment and over the rest."""
    parts = [
        "In-sample: errors over the segment that the variants were fitted to. Sigma is the standard"
        " deviation of the residual; skill is 1 - RMSE / RMSE of the best constant: 1 is perfect, 0"
        " no better than the channel's mean over these samples.",
        _errors(
            results,
            "errors",
            "Errors over the segment (in-sample), in the unit of the channel",
            [candidate.errors for candidate in results.candidates],
        ),
    ]
    held_out = [candidate.held_out for candidate in results.candidates]
    if all(held_out):
        caption = "Errors over the rest of the trial (held-out), in the unit of the channel"
        parts += [
            Heading("Held-out: the rest of the trial"),
            "Samples of the same trial outside the segment, which the variants have not seen: other"
            " loads and the changes between them, but the same session, so no substitute for"
            " another trial.",
            _errors(results, "held-out", caption, held_out),
        ]
    every = pd.DataFrame(
        {
            "model": candidate.label,
            "samples of": part,
            "channel": error.name,
            "unit of RMSE, MAE, sigma": error.unit,
            "in objective": int(error.in_objective),
            "samples [1]": error.samples,
            **{title: getattr(error, field) for title, field in _MEASURES.items()},
        }
        for candidate in results.candidates
        for part, errors in (("segment", candidate.errors), ("rest", candidate.held_out))
        for error in errors
    )
    return Section("errors-section", "Errors", parts, {"errors.csv": every})


def _errors(
    results: Results, name: str, caption: str, errors: Sequence[Sequence[ChannelErrors]]
) -> Table:
    """Errors of every model, a row per channel, and below them what the paper quotes."""
    rows = {
        of_channel[0].name: [
            of_channel[0].unit,
            *(getattr(error, field) for error in of_channel for field in _MEASURES.values()),
            _remark(results, of_channel),
        ]
        for of_channel in zip(*errors, strict=True)
    }
    summaries = [summarise_errors(of_model) for of_model in errors]
    none = [np.nan] * 3
    for title, (unit, field) in _SUMMARIES.items():
        cells = [cell for summary in summaries for cell in (getattr(summary, field), *none)]
        rows[title] = [unit, *cells, ""]
    skills = [cell for summary in summaries for cell in (*none, summary.skill)]
    rows["median of all in the objective"] = ["-", *skills, ""]
    frame = pd.DataFrame.from_dict(rows, orient="index").rename_axis("channel")
    labels = [(candidate.label, title) for candidate in results.candidates for title in _MEASURES]
    frame.columns = pd.MultiIndex.from_tuples([("", "unit"), *labels, ("", "remark")])
    return Table(name, caption, frame)


def _remark(results: Results, errors: Sequence[ChannelErrors]) -> str:
    """Which models' fits did not see a channel."""
    pairs = zip(results.candidates, errors, strict=True)
    left_out = [candidate.label for candidate, error in pairs if not error.in_objective]
    if len(left_out) in (0, len(errors)):
        return "not in objective" if left_out else ""
    return f"not in objective of {', '.join(left_out)}"


Shown: TypeAlias = tuple[str, FloatArray, Sequence[ChannelErrors]]
"""A model's label, what it predicts for all samples, (N, 6 + 3c), and its errors."""


def _channels(results: Results, name: str, title: str, channels: Sequence[int]) -> ReportFigure:
    samples, measured = results.samples, results.samples.trusted_values
    columns: dict[str, FloatArray] = {}
    charts = []
    for i in channels:
        channel, unit = samples.channels[i], channel_unit(samples.channels[i])
        predicted = {c.label: c.predicted[:, i] for c in results.candidates}
        columns[f"{channel} measured [{unit}]"] = measured[:, i]
        for label, values in predicted.items():
            columns[f"{channel} predicted {label} [{unit}]"] = values
        lines = {"measured": measured[:, i]} | predicted
        charts.append({"title": f"{channel} [{unit}]", "lines": lines})
    models = [(c.label, c.predicted, c.errors) for c in results.candidates]
    heading = results.title(title)
    return ReportFigure(
        name,
        f"{title}, {results.segment}; the errors in the panels are over the shaded segment, to"
        f" which the variants were fitted (in-sample). {THINNED}",
        lambda style: wrench_figure(samples, results.segment, models, heading, style, channels),
        results.series(columns),
        line_chart(samples.time, charts),
    )


@in_style
def wrench_figure(
    samples: Samples,
    segment: Segment,
    models: Sequence[Shown],
    title: str,
    style: FigureStyle,
    channels: Sequence[int] = _FORCES_FIRST,
) -> Figure:
    """Measured against predicted channels, those of the wrench unless others are given.

    Each has a panel, three in a row of a page, with its errors unless there are no titles.
    """
    across = 3 if not style.is_narrow else 1 if style.titles else 2
    rows = -(-len(channels) // across)
    lines = (2 if style.width / across >= _WIDE else 3) if style.titles else 0
    key = _KEY_LINE * (2.5 + lines * len(models)) if style.titles else 0.0
    figure = style.figure(rows * (_PANEL + key) + (12.0 if style.titles else 20.0))
    style.add_title(figure, title)
    axes, measured = panels(figure, len(channels), across), samples.trusted_values
    for axis, channel in zip(axes, channels, strict=True):
        first = models[0][2][channel]
        axis.axvspan(segment.start, segment.end, **SEGMENT_STYLE)
        axis.plot(*thin(samples.time, measured[:, channel]), label="measured", **MEASURED_STYLE)
        for (label, predicted, errors), look in zip(models, LINE_STYLES, strict=False):
            described = _describe(label, errors[channel], lines)
            axis.plot(*thin(samples.time, predicted[:, channel]), label=described, **look)
        axis.set_ylabel(f"{_QUANTITIES[first.unit]} [{first.unit}]")
        name = first.name + " (not in objective)" * (not first.in_objective)
        if lines:
            add_legend(axis, title=name, labelspacing=0.2, handlelength=1.8)
        else:
            axis.set_title(wrap(name, _NAME), loc="left", fontweight="bold", parse_math=False)
    if not lines:
        handles, labels = axes[0].get_legend_handles_labels()
        add_legend(figure, handles, labels, loc="outside lower center", ncols=across + 1)
    return lay_out(figure)


def _describe(label: str, e: ChannelErrors, lines: int) -> str:
    if not lines:
        return label
    separator = ":\n" if lines == 3 else ": "
    if e.samples == 0:
        return f"{label}{separator}no errors,\nno value in the span"
    digits = "z.2f" if abs(e.skill) < 10.0 else "z.0f"
    return (
        f"{label}{separator}RMSE {e.rmse:.2f}, MAE {e.mae:.2f},\n"
        f"\N{GREEK SMALL LETTER SIGMA} {e.sigma:.2f} {e.unit}, skill {number(e.skill, digits)}"
    )
