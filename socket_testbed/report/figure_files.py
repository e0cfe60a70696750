"""The figures of a report: each with its caption, its picture on the page, and its data as CSV."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.evaluation import ChannelErrors, trusted_values
from socket_testbed.identification.front import write_fronts
from socket_testbed.report.figures.channels import (
    MOST_POINTS,
    Panel,
    Prediction,
    bias_figure,
    overview_figure,
    panels_figure,
)
from socket_testbed.report.figures.pareto import pareto_figure
from socket_testbed.report.figures.socket_picture import tile_map_figure
from socket_testbed.report.figures.style import save_figure, svg_of
from socket_testbed.report.page import figure, picture
from socket_testbed.report.results import Candidate, Results, unusable
from socket_testbed.samples import WRENCH_CHANNELS, channel_unit

_CHUNK = 10_000  # rows; a trial of an hour is not held as text


def write_channels(results: Results, channels: Sequence[int], path: Path) -> None:
    """Write channels over time: measured, and predicted by every model.

    Args:
        results: The results.
        channels: Which of the samples' channels, by index.
        path: File to write.
    """
    measured = trusted_values(results.samples)
    columns: dict[str, FloatArray] = {}
    for i in channels:
        name = results.samples.channels[i]
        unit = channel_unit(name)
        columns[f"{name} measured [{unit}]"] = measured[:, i]
        for candidate in results.candidates:
            columns[f"{name} predicted {candidate.label} [{unit}]"] = candidate.predicted[:, i]
    _write_series(results, columns, path)


def write_overview(results: Results, unusable: Mapping[str, BoolArray], path: Path) -> None:
    """Write the magnitudes of the measured force and moment, and what cannot be used when."""
    wrench = results.samples.wrench
    columns = {
        "force magnitude [N]": np.linalg.norm(wrench[:, 3:], axis=1),
        "moment magnitude [N m]": np.linalg.norm(wrench[:, :3], axis=1),
    }
    columns |= {f"{name} not usable [-]": 1.0 * flags for name, flags in unusable.items()}
    _write_series(results, columns, path)


def write_tiles(geometry: SocketGeometry, columns: Mapping[str, FloatArray], path: Path) -> None:
    """Write values of the tiles, a row a tile.

    Args:
        geometry: The socket.
        columns: Values, shape (n,) each, by their header.
        path: File to write.
    """
    clusters = {tile: name for name, tile in geometry.clusters.items()}
    table = np.column_stack([geometry.anchors, *columns.values()])
    header = ["tile", "cluster", *(f"anchor {axis} in S [m]" for axis in "xyz"), *columns]
    rows = (
        [geometry.names[i], clusters.get(i, ""), *map(_cell, row)]
        for i, row in enumerate(table.tolist())
    )
    _write(path, header, rows)


def write_offsets(channels: Sequence[str], offsets: Mapping[str, FloatArray], path: Path) -> None:
    """Write the constant offsets of the sensors, a row a channel."""
    header = ["channel", "unit", *(f"offset {label} [unit of the row]" for label in offsets)]
    rows = (
        [name, channel_unit(name), *(_cell(float(values[i])) for values in offsets.values())]
        for i, name in enumerate(channels)
    )
    _write(path, header, rows)


def write_errors(candidates: Sequence[Candidate], path: Path) -> None:
    """Write the errors of every model, over the segment and the rest, a row a channel."""
    header = ["model", "samples of", "channel", "unit of RMSE, MAE, sigma", "in objective"]
    header += ["samples [1]", "RMSE", "MAE", "sigma", "skill [-]"]
    rows = (
        [candidate.label, part, *_errors(error)]
        for candidate in candidates
        for part, errors in (("segment", candidate.errors), ("rest", candidate.held_out))
        for error in errors
    )
    _write(path, header, rows)


def write_residuals(candidates: Sequence[Candidate], path: Path) -> None:
    """Write what the residuals have in common, a row a model and channel."""
    header = ["model", "channel", "samples [1]", "lag-1 autocorrelation [-]"]
    header += ["decorrelation time [s]", "effective samples [1]"]
    rows = (
        [
            candidate.label,
            error.name,
            str(common.samples),
            *map(_cell, (common.lag_one, common.decorrelation, common.effective)),
        ]
        for candidate in candidates
        for error, common in zip(candidate.errors, candidate.residuals, strict=True)
    )
    _write(path, header, rows)


def offsets_of(model: ContactModel, clusters: Sequence[str]) -> FloatArray:
    """Constant offsets of the wrench, then of each cluster in its frame, shape (6 + 3c,)."""
    zero = np.zeros(3)
    return np.concatenate([model.wrench_bias, *(model.force_bias.get(c, zero) for c in clusters)])


def _write_series(results: Results, columns: Mapping[str, FloatArray], path: Path) -> None:
    header = ["stamp [ns]", "time [s]", "in segment", *columns]
    _write(path, header, _series(results, [*columns.values()]))


def _series(results: Results, columns: Sequence[FloatArray]) -> Iterator[list[str]]:
    samples, inside = results.samples, results.in_segment
    time = samples.time
    for start in range(0, len(samples), _CHUNK):
        rows = slice(start, start + _CHUNK)
        stamps, flags = samples.stamps[rows].tolist(), inside[rows].tolist()
        values = np.column_stack([time[rows], *(column[rows] for column in columns)]).tolist()
        for stamp, flag, (when, *cells) in zip(stamps, flags, values, strict=True):
            yield [str(stamp), _cell(when), str(int(flag)), *map(_cell, cells)]


def _errors(error: ChannelErrors) -> list[str]:
    figures = (error.rmse, error.mae, error.sigma, error.skill)
    place = [error.name, error.unit, str(int(error.in_objective)), str(error.samples)]
    return [*place, *map(_cell, figures)]


def _write(path: Path, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(header)
        writer.writerows(rows)


def _cell(value: float) -> str:
    return f"{value:.10g}" if math.isfinite(value) else ""


PICTURES = (".pdf", ".png")
_AXES = "xyz"
_ORDER = (3, 4, 5, 0, 1, 2)  # the forces above, the moments below
_THINNED = (
    f"Lines of more than {MOST_POINTS} samples are drawn by the lowest and highest value of equally"
    " many, so every peak shows; the CSV holds all."
)


@dataclass(frozen=True)
class ReportFigure:
    """A figure of the report.

    Attributes:
        name: Name of its files.
        caption: What is to be seen.
        pictures: Pictures for the page, as SVG, each with what it shows in words.
        layout: How they are laid out on the page: `panels`, `wide` or `single`.
        save: Writes the whole figure; the suffix says the format.
        write_data: Writes its data as CSV.
    """

    name: str
    caption: str
    pictures: tuple[tuple[str, str], ...]
    layout: str
    save: Callable[[Path], None]
    write_data: Callable[[Path], None]

    def write(self, folder: Path) -> None:
        """Write the figure and its data."""
        for suffix in PICTURES:
            self.save(folder / f"{self.name}{suffix}")
        self.write_data(folder / f"{self.name}.csv")

    def to_html(self, folder: str) -> str:
        """The figure for the page, with links to its files in a folder beside it."""
        files = [f"{folder}/{self.name}{suffix}" for suffix in (*PICTURES, ".csv")]
        pictures = [picture(svg, alt) for svg, alt in self.pictures]
        return figure(pictures, self.caption, files, self.layout)


def overview(results: Results) -> ReportFigure:
    """The trial at a glance."""
    samples, lacking = results.samples, unusable(results.samples)
    drawn = overview_figure(
        samples.time,
        samples.wrench,
        [(part.start, part.end) for part in results.plateaus],
        (results.segment.start, results.segment.end),
        lacking,
    )
    caption = (
        "The measured load over the trial, with the plateaus in light and the segment in use in"
        " darker grey; below, the share of samples in which a measurement could not be used"
        f" (missing, saturated or out of range). {_THINNED}"
    )
    alt = "Magnitudes of the measured force and moment over time, and drop-outs by measurement"
    data = partial(write_overview, results, lacking)
    return _single("overview", caption, drawn, alt, data)


def channel_figures(results: Results) -> tuple[ReportFigure, ReportFigure]:
    """The wrench and the local forces, a panel a channel."""
    local = range(len(WRENCH_CHANNELS), len(results.samples.channels))
    return (
        _channels(results, "wrench", "Measured and predicted wrench", _ORDER),
        _channels(
            results, "local_forces", "Measured and predicted forces in the clusters' frames", local
        ),
    )


def pareto(results: Results, scratch: Path) -> ReportFigure:
    """The fronts of both variants.

    Args:
        results: The results, with fronts.
        scratch: Folder for a file that is not kept.
    """
    fronts = [*results.fronts.values()]
    title = _title(results, "Trade-off").replace("$", r"\$")  # a name is no mathematics
    draw = partial(pareto_figure, fronts, title)
    on_page = scratch / "pareto.svg"
    draw(on_page)
    svg = on_page.read_text(encoding="utf-8")
    on_page.unlink()
    caption = (
        "Normalised error of the clusters against that of the wrench over theta; both are the"
        " square roots of the terms of the objective, 1 stands for predicting zero. Dominated"
        " solutions are faint."
    )
    alt = "Pareto fronts of both variants with the sensor-only, knee and wrench-only solutions"
    data = partial(write_fronts, fronts)
    return ReportFigure("pareto", caption, ((svg, alt),), "wide", draw, data)


def tile_figures(results: Results) -> list[ReportFigure]:
    """The stiffnesses of every model, and its rest positions unless they are the last one's."""
    figures = []
    shown: FloatArray | None = None
    for candidate in results.candidates:
        figures.append(_stiffness(results, candidate))
        rest = candidate.model.rest_positions
        if shown is None or not np.array_equal(rest, shown):
            figures.append(_rest_positions(results, candidate))
        shown = rest
    return figures


def offsets(results: Results) -> ReportFigure:
    """The offsets of the models that have some."""
    samples = results.samples
    by_label = {
        candidate.label: offsets_of(candidate.model, samples.clusters)
        for candidate in results.candidates
        if candidate.model.variant == "stiffness_bias"
    }
    drawn = bias_figure(samples.channels, by_label)
    caption = (
        "The constant offsets of the variant stiffness_bias: of the wrench, and of each cluster in"
        " its own frame. They are added to what the springs predict; a channel that is not in"
        " the objective has none."
    )
    alt = "Bars of the fitted offset of every channel"
    data = partial(write_offsets, samples.channels, by_label)
    return _single("offsets", caption, drawn, alt, data)


def rest_offsets(results: Results, candidate: Candidate) -> FloatArray:
    """Rest positions from the mean limb position of the segment, in {S}, shape (n, 3) [mm]."""
    return 1e3 * (candidate.model.rest_positions - results.mean_position)


def _stiffness(results: Results, candidate: Candidate) -> ReportFigure:
    stiffness, label = candidate.model.stiffness, candidate.label
    caption = (
        f"Stiffness of every tile along the axes of {{S}}, model {label}, on one scale; the wall is"
        " unrolled and seen from outside. Tiles with a cluster are outlined."
    )
    return _tiles(
        results, f"tile_stiffness_{label}", caption, f"Stiffness, model {label}", stiffness,
        ("k", "stiffness", "N/m"),
    )  # fmt: skip


def _rest_positions(results: Results, candidate: Candidate) -> ReportFigure:
    by_variant = candidate.fit is not None
    whose = "the same for both variants" if by_variant else f"model {candidate.label}"
    name = "rest_positions" if by_variant else f"rest_positions_{candidate.label}"
    caption = (
        f"Rest positions along the axes of {{S}} from the mean limb position of the segment"
        f" ({whose}): where a tile would begin to press."
    )
    values = rest_offsets(results, candidate)
    kind = ("q_r", "rest position from the mean limb position", "mm")
    return _tiles(results, name, caption, f"Rest positions, {whose}", values, kind)


def _tiles(
    results: Results,
    name: str,
    caption: str,
    title: str,
    values: FloatArray,
    kind: tuple[str, str, str],
) -> ReportFigure:
    """Maps of values of the tiles, shape (n, 3), of a symbol, a quantity and a unit."""
    symbol, quantity, unit = kind
    geometry = results.trial.geometry
    rows = {f"{symbol} along {axis} of {{S}}": values[:, i] for i, axis in enumerate(_AXES)}
    columns = {f"{quantity} {axis} [{unit}]": values[:, i] for i, axis in enumerate(_AXES)}
    drawn = tile_map_figure(
        geometry, rows, f"{quantity} [{unit}]", f"{results.trial.name}: {title}"
    )
    alt = f"{title}: tiles of the unrolled socket in the colours of their values"
    data = partial(write_tiles, geometry, columns)
    return _single(name, caption, drawn, alt, data, "wide")


def _channels(results: Results, name: str, title: str, channels: Sequence[int]) -> ReportFigure:
    panels = [_panel(results, i) for i in channels]
    whole = panels_figure(panels, 3, _title(results, title))
    held = "over the shaded segment, to which the variants were fitted (in-sample)"
    return ReportFigure(
        name=name,
        caption=f"{title}, {results.segment}; the errors in the panels are {held}. {_THINNED}",
        pictures=tuple((svg_of(panels_figure([panel], 1)), _panel_alt(panel)) for panel in panels),
        layout="panels",
        save=partial(save_figure, whole),
        write_data=partial(write_channels, results, channels),
    )


def _panel(results: Results, channel: int) -> Panel:
    samples = results.samples
    return Panel(
        time=samples.time,
        measured=trusted_values(samples)[:, channel],
        predictions=tuple(
            Prediction(c.label, c.predicted[:, channel], c.errors[channel])
            for c in results.candidates
        ),
        span=(results.segment.start, results.segment.end),
    )


def _panel_alt(panel: Panel) -> str:
    errors = ", ".join(
        f"{p.label} RMSE {p.errors.rmse:.3g} {panel.unit}" for p in panel.predictions
    )
    return f"{panel.name} [{panel.unit}] over time, measured and predicted: {errors}"


def _title(results: Results, what: str) -> str:
    return f"{results.trial.name}: {what}, {results.segment}"


def _single(
    name: str,
    caption: str,
    drawn: Figure,
    alt: str,
    data: Callable[[Path], None],
    layout: str = "single",
) -> ReportFigure:
    return ReportFigure(
        name, caption, ((svg_of(drawn), alt),), layout, partial(save_figure, drawn), data
    )
