"""Parameters of the models on the socket's surface, their engaged springs and their offsets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure, SubFigure

from socket_testbed.arrays import FloatArray
from socket_testbed.report.figures.scene import TileValues
from socket_testbed.report.figures.style import (
    BAR_STYLES,
    LINE_STYLES,
    SEGMENT_STYLE,
    THINNED,
    FigureStyle,
    add_legend,
    in_style,
    lay_out,
    style_axes,
    thin,
    wrap,
)
from socket_testbed.report.figures.tiles import tile_map_figure
from socket_testbed.report.page import ReportFigure, Section
from socket_testbed.report.results import Candidate, Results
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, channel_unit
from socket_testbed.settings.identification import BIAS_VARIANTS

_LINES = 68.0  # [mm]; height of two panels over time with their key
_BAR, _BARS_AXIS = 6.0, 14.0  # [mm]
_TITLES = ("moment [N m]", "force [N]", "force on a cluster, in its frame [N]")


def section(results: Results) -> Section:
    """The section on what the models say of the tiles."""
    text = (
        "Also in the 3D scene above. Values of a rigid variant are in the tile's own frame (z along"
        " the inward normal), its rest positions from the reference pose; those of the paper's"
        " variants are in {S}, their rest positions from the mean limb position of the segment. The"
        " offset of a cluster is in the cluster's own frame; the wrench's offset belongs to no"
        " tile."
    )
    return Section(
        "surface",
        "Parameters on the socket's surface",
        [text, *_tile_maps(results), _engaged_springs(results), _offsets(results)],
        {"engaged_tiles.csv": _engaged_tiles(results)},
    )


def scene_values(results: Results, candidate: Candidate) -> dict[str, TileValues]:
    """Parameters of a model on the tiles in 3D, by the name of the choice."""
    model, frame = candidate.model, _frame(candidate)
    kinds = [
        ("stiffness", "N/m", model.stiffness),
        ("rest position", "mm", _rest_offsets(results, candidate)),
    ]
    values = {
        f"{kind} {axis} [{unit}]": TileValues(
            f"{kind} along {axis} of {frame} [{unit}]", of_tiles[:, i]
        )
        for kind, unit, of_tiles in kinds
        for i, axis in enumerate("xyz")
    }
    if model.variant in BIAS_VARIANTS:
        bias = np.full_like(model.stiffness, np.nan)
        for cluster, force in model.force_bias.items():
            bias[model.cluster_points[cluster]] = force
        for i, channel in enumerate(LOCAL_CHANNELS):
            title = f"offset {channel} in the cluster's frame [N]"
            values[f"offset {channel} [N]"] = TileValues(title, bias[:, i])
    return values


def _frame(candidate: Candidate) -> str:
    """The frame of a model's stiffnesses and rest positions."""
    return "the tile's frame" if candidate.model.is_rigid else "{S}"


def _rest_offsets(results: Results, candidate: Candidate) -> FloatArray:
    """Rest positions from the mean limb position, in `_frame`, shape (n, 3) [mm]."""
    if candidate.model.is_rigid:
        return 1e3 * candidate.model.rest_positions
    return 1e3 * (candidate.model.rest_positions - results.mean_position)


def _tile_maps(results: Results) -> Iterator[ReportFigure]:
    """The stiffnesses of every model, and its rest positions unless they are the last one's."""
    shown: FloatArray | None = None
    for candidate in results.candidates:
        model, label, frame = candidate.model, candidate.label, _frame(candidate)
        yield _tile_map(
            results,
            f"tile_stiffness_{label}",
            f"Stiffness of every tile along the axes of {frame}, model {label}",
            model.stiffness,
            ("k", "stiffness", "N/m"),
            frame,
        )
        if shown is not None and np.array_equal(model.rest_positions, shown):
            continue
        shown = model.rest_positions
        shared = candidate.fit is not None and not model.is_rigid
        whose = "the same for the paper's variants" if shared else f"model {label}"
        origin = "reference pose" if model.is_rigid else "mean limb position of the segment"
        yield _tile_map(
            results,
            "rest_positions" if shared else f"rest_positions_{label}",
            f"Rest positions along the axes of {frame} from the {origin}, {whose}",
            _rest_offsets(results, candidate),
            ("q_r", "rest position from the mean limb position", "mm"),
            frame,
        )


def _tile_map(
    results: Results,
    name: str,
    title: str,
    values: FloatArray,
    kind: tuple[str, str, str],
    frame: str,
) -> ReportFigure:
    """Maps of values of the tiles, shape (n, 3), of a symbol, a quantity and a unit, in a frame."""
    symbol, quantity, unit = kind
    geometry = results.trial.geometry
    clusters = {tile: cluster for cluster, tile in geometry.clusters.items()}
    columns = {f"anchor {axis} in S [m]": geometry.anchors[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"{quantity} {axis} [{unit}]": values[:, i] for i, axis in enumerate("xyz")}
    of_clusters = [clusters.get(tile, "") for tile in range(len(geometry))]
    maps = {f"{symbol} along {axis} of {frame}": values[:, i] for i, axis in enumerate("xyz")}
    return ReportFigure(
        name,
        f"{title}; the wall is unrolled and seen from outside. Tiles with a cluster are outlined.",
        lambda style: tile_map_figure(
            geometry, maps, f"{quantity} [{unit}]", f"{results.trial.name}: {title}", style
        ),
        f"{title}: tiles of the unrolled socket in the colours of their values",
        pd.DataFrame({"tile": geometry.names, "cluster": of_clusters, **columns}),
        is_map=True,
    )


def _engaged_springs(results: Results) -> ReportFigure:
    """Which springs of every model are engaged, over time and over the socket."""
    models = {candidate.label: candidate.engagement for candidate in results.candidates}
    counts = "; ".join(
        f"{label} {found.time_share.sum():.0f} of {found.springs}, {found.switching} only at times"
        for label, found in models.items()
    )
    columns = [found.columns(f"{label}.springs.") for label, found in models.items()]
    return ReportFigure(
        "engaged_springs",
        "Springs that are engaged (compressed, with a stiffness above zero), and uncertain ones,"
        " which one standard deviation of the pose's noise can switch. The maps show the share of"
        " the time over the shaded segment in which the springs of a tile are engaged;"
        f" engaged_tiles.csv holds it for each. Engaged on the segment: {counts}. {THINNED}",
        lambda style: _draw_engagement(results, style),
        f"Engaged springs on the unrolled socket, and over time: {counts}",
        results.series({name: of for found in columns for name, of in found.items()}),
        is_map=True,
    )


def _engaged_tiles(results: Results) -> pd.DataFrame:
    """Share of the time on the segment in which each spring is engaged, a row per tile."""
    columns: dict[str, Any] = {"tile": results.trial.geometry.names}
    for candidate in results.candidates:
        axes = ("normal",) if candidate.model.is_rigid else ("x", "y", "z")
        names = [f"{candidate.label}.{axis} engaged [-]" for axis in axes]
        columns |= dict(zip(names, candidate.engagement.time_share.T, strict=True))
    return pd.DataFrame(columns)


def _offsets(results: Results) -> ReportFigure:
    """The offsets of the models that have some."""
    samples = results.samples
    zero = np.zeros(3)
    by_label = {
        label: np.concatenate(
            [model.wrench_bias, *(model.force_bias.get(name, zero) for name in samples.clusters)]
        )
        for label, model in ((c.label, c.model) for c in results.candidates)
        if model.variant in BIAS_VARIANTS
    }
    columns = {f"offset {label} [unit of the row]": values for label, values in by_label.items()}
    units = [channel_unit(name) for name in samples.channels]
    return ReportFigure(
        "offsets",
        "The constant offsets of the models with offsets: of the wrench, and of each cluster in its"
        " own frame. They are added to what the springs predict; a channel that is not in the"
        " objective has none.",
        lambda style: _draw_offsets(samples.channels, by_label, style),
        "Bars of the fitted offset of every channel",
        pd.DataFrame({"channel": samples.channels, "unit": units, **columns}),
    )


def _draw_engagement(results: Results, style: FigureStyle) -> Figure:
    """How long the springs of each tile are engaged; below, their number over time."""
    models = {candidate.label: candidate.engagement for candidate in results.candidates}
    maps = {name: 100.0 * found.time_share.mean(axis=1) for name, found in models.items()}

    def draw_lines(part: SubFigure) -> None:
        axes = part.subplots(2, 1, sharex=True)
        for (name, found), line in zip(models.items(), LINE_STYLES[: len(models)], strict=True):
            for axis, count in zip(axes, (found.engaged, found.uncertain), strict=True):
                share = thin(results.samples.time, 100.0 * count / found.springs)
                axis.plot(*share, label=name, **line)
        for axis, label in zip(axes, ("engaged", "uncertain"), strict=True):
            axis.axvspan(results.segment.start, results.segment.end, **SEGMENT_STYLE)
            axis.set_ylabel(f"{label}\nsprings [%]")
            axis.set_ylim(bottom=0.0)
            style_axes(axis)
        axes[1].set_xlabel("time [s]")
        add_legend(axes[0], ncols=2 if style.is_narrow else 4)

    return tile_map_figure(
        results.trial.geometry,
        maps,
        "share of the time engaged [%]",
        results.title("Engaged springs"),
        style,
        limits=(0.0, 100.0),
        below=(_LINES, draw_lines),
    )


@in_style
def _draw_offsets(
    channels: Sequence[str], offsets: Mapping[str, FloatArray], style: FigureStyle
) -> Figure:
    """Offsets of every channel, a bar per model: moments, forces, the clusters' forces."""
    groups = [[0, 1, 2], [3, 4, 5], [*range(len(WRENCH_CHANNELS), len(channels))]]
    heights = [_BAR * len(indices) + _BARS_AXIS for indices in groups]
    figure = style.figure(sum(heights))
    axes = figure.subplots(3, 1, height_ratios=heights)
    thickness = 0.8 / len(offsets)
    for axis, title, indices in zip(axes, _TITLES, groups, strict=True):
        places = np.arange(len(indices))
        # The first look is that of the model without offsets.
        for number, ((label, values), look) in enumerate(
            zip(offsets.items(), BAR_STYLES[1 : 1 + len(offsets)], strict=True)
        ):
            shift = (number - 0.5 * (len(offsets) - 1)) * thickness
            axis.barh(places + shift, values[indices], thickness, label=label, **look)
        axis.axvline(0.0, color="0.3", linewidth=0.8)
        axis.set_yticks(places, [channels[i] for i in indices], parse_math=False)
        axis.invert_yaxis()
        axis.set_xlabel(wrap(f"offset of the {title}", 0.55 * style.width))
        style_axes(axis)
    add_legend(figure, *axes[0].get_legend_handles_labels(), loc="outside upper center")
    return lay_out(figure)
