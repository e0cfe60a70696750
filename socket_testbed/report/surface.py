"""Parameters of the models on the socket's surface, their engaged springs and their offsets."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure, SubFigure

from socket_testbed.arrays import FloatArray
from socket_testbed.pages.document import numbers
from socket_testbed.report.page import ReportFigure, Section
from socket_testbed.report.results import Candidate, Results
from socket_testbed.report.style import (
    LINE_STYLES,
    SEGMENT_STYLE,
    THINNED,
    FigureStyle,
    add_legend,
    panels,
    thin,
)
from socket_testbed.report.tiles import tile_map_figure
from socket_testbed.samples import channel_unit
from socket_testbed.settings.identification import BIAS_VARIANTS
from socket_testbed.tables import Table, split_unit

_LINES = 68.0  # [mm]; height of two panels over time with their key


def section(results: Results) -> Section:
    """The section on what the models say of the tiles."""
    text = (
        "The map at the top of the page shows them, too. Values of a rigid variant are in the"
        " tile's own frame (z along the inward normal), its rest positions from the"
        " reference pose; those of the paper's"
        " variants are in {S}, their rest positions from the mean limb position of the segment. The"
        " offset of a cluster is in the cluster's own frame; the wrench's offset belongs to no"
        " tile. A channel that is not in the objective has no offset."
    )
    offsets = _offsets(results)
    shown = Table("offsets", "Constant offsets, added to what the springs predict", offsets)
    return Section(
        "surface",
        "Parameters on the socket's surface",
        [text, *_tile_maps(results), _engaged_springs(results), shown],
        {"engaged_tiles.csv": _engaged_tiles(results), "offsets.csv": offsets},
    )


def model_values(results: Results, candidate: Candidate) -> dict[str, dict[str, Any]]:
    """Parameters of a model on the tiles for the map, by their names."""
    model, frame = candidate.model, _frame(candidate)
    kinds = [
        ("stiffness", "N/m", model.stiffness),
        ("rest position", "mm", _rest_offsets(results, candidate)),
    ]
    return {
        f"{kind} along {axis} of {frame} [{unit}]": {"values": numbers(of), "unit": unit}
        for kind, unit, values in kinds
        for axis, of in _by_axis(values)
    }


def _frame(candidate: Candidate) -> str:
    """The frame of a model's stiffnesses and rest positions."""
    return "the tile's frame" if candidate.model.is_rigid else "{S}"


def _rest_offsets(results: Results, candidate: Candidate) -> FloatArray:
    """Rest positions from the mean limb position, in `_frame`, shape (n, 3) [mm]."""
    if candidate.model.is_rigid:
        return 1e3 * candidate.model.rest_positions
    mean = np.nanmean(results.samples.position[results.segment.rows], axis=0)
    return 1e3 * (candidate.model.rest_positions - mean)


def _tile_maps(results: Results) -> Iterator[ReportFigure]:
    """The stiffnesses of every model, and its rest positions unless they are the last one's."""
    shown: FloatArray | None = None
    for candidate in results.candidates:
        model, label = candidate.model, candidate.label
        name, title = f"tile_stiffness_{label}", f"Stiffness of every tile, model {label}"
        yield _tile_map(results, candidate, name, title, model.stiffness, "k", "stiffness [N/m]")
        if shown is None or not np.array_equal(model.rest_positions, shown):
            shown = model.rest_positions
            shared = candidate.fit is not None and not model.is_rigid
            name = "rest_positions" if shared else f"rest_positions_{label}"
            whose = "the same for the paper's variants" if shared else f"model {label}"
            values, title = _rest_offsets(results, candidate), f"Rest positions, {whose}"
            origin = "reference pose" if model.is_rigid else "mean limb position"
            quantity = f"rest position from the {origin} [mm]"
            yield _tile_map(results, candidate, name, title, values, "q_r", quantity)


def _tile_map(
    results: Results,
    candidate: Candidate,
    name: str,
    title: str,
    values: FloatArray,
    symbol: str,
    quantity: str,
) -> ReportFigure:
    """Maps of values of the tiles along x, y, z, shape (n, 3), of a symbol and a quantity."""
    geometry, frame = results.trial.geometry, _frame(candidate)
    clusters = {tile: cluster for cluster, tile in geometry.clusters.items()}
    described, unit = split_unit(quantity)
    columns = {f"anchor {axis} in S [m]": of for axis, of in _by_axis(geometry.anchors)}
    columns |= {f"{described} {axis} [{unit}]": of for axis, of in _by_axis(values)}
    of_tiles = [clusters.get(tile, "") for tile in range(len(geometry))]
    maps = {f"{symbol} along {axis} of {frame}": of for axis, of in _by_axis(values)}
    heading = f"{results.trial.name}: {title}"
    return ReportFigure(
        name,
        f"{title}, along the axes of {frame}; the wall is unrolled and seen from outside. Tiles"
        " with a cluster are outlined.",
        lambda style: tile_map_figure(geometry, maps, quantity, heading, style),
        pd.DataFrame({"tile": geometry.names, "cluster": of_tiles, **columns}),
    )


def _by_axis(values: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """Columns of an array, shape (n, 3), with their axes."""
    return zip("xyz", values.T, strict=True)


def _engaged_springs(results: Results) -> ReportFigure:
    """Which springs of every model are engaged, over time and over the socket."""
    models = {candidate.label: candidate.engagement for candidate in results.candidates}
    maps = {name: 100.0 * found.time_share.mean(axis=1) for name, found in models.items()}
    columns = [found.columns(f"{label}.springs.") for label, found in models.items()]

    def draw_lines(part: SubFigure) -> None:
        for axis, kind in zip(panels(part, 2, 1), ("engaged", "uncertain"), strict=True):
            for (name, found), line in zip(models.items(), LINE_STYLES, strict=False):
                share = 100.0 * getattr(found, kind) / found.springs
                axis.plot(*thin(results.samples.time, share), label=name, **line)
            axis.axvspan(results.segment.start, results.segment.end, **SEGMENT_STYLE)
            axis.set_ylabel(f"{kind}\nsprings [%]")
            axis.set_ylim(bottom=0.0)
        add_legend(part.axes[0], ncols=2)

    def draw(style: FigureStyle) -> Figure:
        return tile_map_figure(
            results.trial.geometry,
            maps,
            "share of the time engaged [%]",
            results.title("Engaged springs"),
            style,
            limits=(0.0, 100.0),
            below=(_LINES, draw_lines),
        )

    return ReportFigure(
        "engaged_springs",
        "Springs that are engaged (compressed, with a stiffness above zero), and uncertain ones,"
        " which one standard deviation of the pose's noise can switch. The maps show the share of"
        " the time over the shaded segment in which the springs of a tile are engaged;"
        f" engaged_tiles.csv holds it for each. {THINNED}",
        draw,
        results.series({name: of for found in columns for name, of in found.items()}),
    )


def _engaged_tiles(results: Results) -> pd.DataFrame:
    """Share of the time on the segment in which each spring is engaged, a row per tile."""
    columns: dict[str, Any] = {"tile": results.trial.geometry.names}
    for candidate in results.candidates:
        axes = ("normal",) if candidate.model.is_rigid else ("x", "y", "z")
        names = [f"{candidate.label}.{axis} engaged [-]" for axis in axes]
        columns |= dict(zip(names, candidate.engagement.time_share.T, strict=True))
    return pd.DataFrame(columns)


def _offsets(results: Results) -> pd.DataFrame:
    """The offsets of every channel, a column per model that has some."""
    samples, zero = results.samples, np.zeros(3)
    columns = {
        f"offset {label} [unit of the row]": np.concatenate(
            [model.wrench_bias, *(model.force_bias.get(name, zero) for name in samples.clusters)]
        )
        for label, model in ((c.label, c.model) for c in results.candidates)
        if model.variant in BIAS_VARIANTS
    }
    units = [channel_unit(name) for name in samples.channels]
    index = pd.Index(samples.channels, name="channel")
    return pd.DataFrame({"unit": units, **columns}, index=index)
