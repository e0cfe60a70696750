"""Pressure as a lab reads it: outputs of the regions, maps, regions over time, and in 3D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.geometry.socket import HEIGHTS, SECTORS, SocketGeometry
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.pressure import (
    SHARE,
    THRESHOLD,
    PressureOutputs,
    Quantity,
    of_deviations,
    read_column,
    with_interval,
)
from socket_testbed.report.figures.scene import TileValues, tile_scene
from socket_testbed.report.figures.style import (
    DEFAULT_STYLE,
    LINE_STYLES,
    THINNED,
    FigureStyle,
    add_legend,
    in_style,
    lay_out,
    style_axes,
    thin,
    thin_band,
)
from socket_testbed.report.figures.tiles import (
    add_key,
    certainty_of,
    tile_map_figure,
)
from socket_testbed.report.page import MASKED, NOTHING, Heading, ReportFigure, Section, Table
from socket_testbed.report.results import PressureResults, Results
from socket_testbed.report.sections.surface import scene_values

_DECIMALS = {
    "peak pressure [kPa]": 1,
    "mean pressure [kPa]": 1,
    "contact area [cm^2]": 0,
    "pressure-time integral [kPa s]": 0,
    "share of load [%]": 0,
    "shear [kPa]": 1,
    "shear direction [deg]": 0,
    "centre of pressure x [mm]": 0,
    "centre of pressure y [mm]": 0,
    "centre of pressure z [mm]": 0,
}
_PRESSURES = 5  # columns of the first table by region
_MAP_SHARE = 1.0  # [-]; as `SHARE`, in pictures: what is determined is not zero
_SPANS = ("plateau", "hold")
_UNIT = "pressure [kPa]"
_MOST_POINTS = 300  # per line
_BAND = 0.18  # [-]; opacity
_NUMBER = 0.04  # [-]; of a panel's width, for the number of an event


def section(results: Results) -> Section:
    """The section on pressure."""
    found, geometry = results.pressure, results.trial.geometry
    socket, pressures, shears = pressure_tables(found, geometry)
    sets = {"force map": _scene_pressures(found)} | {
        candidate.label: scene_values(results, candidate) for candidate in results.candidates
    }
    return Section(
        "pressure",
        "Pressure",
        [
            f"Over {results.segment}. A value whose 95 % interval reaches farther than"
            f" {100.0 * SHARE:g} % of it is not determined; its interval stands alone. In contact:"
            f" above {1e-3 * THRESHOLD:g} kPa. 'socket-testbed pressure' gives the same numbers,"
            " and those of another segment or threshold.",
            socket,
            _maps(results),
            Heading("By region"),
            pressures,
            shears,
            _regions(results),
            Heading("In 3D, over time"),
            "The colour scale is that of the chosen values. Tiles without a value are white, and"
            " those whose pressure or shear has an interval that reaches farther than the value"
            " itself; tiles with a cluster are outlined. The axes are those of {S}, the frame of"
            " the load cell.",
            tile_scene(geometry, sets, "The tiles of the socket in the colours of their pressure"),
            Heading("How it is estimated"),
            "From the clusters' and the load cell's measurements, without a fitted model: a"
            f" Gaussian process over the socket's surface ({found.outputs.source}). About 95 % of"
            " the true values lie within the intervals. The mean over the segment is as uncertain"
            " as one sample, since what the sensors leave open does not change.",
            _force_map(results),
        ],
        {"pressure.csv": regions_frame(found)},
    )


def regions_frame(pressure: PressureResults) -> pd.DataFrame:
    """Outputs over the segment with the ends of their intervals, a row per region.

    Values are NaN where they are not determined.
    """
    names = pd.Index([place.name for place in pressure.places], name="region")
    columns: dict[str, FloatArray] = {}
    for title in _DECIMALS:
        columns |= with_interval(title, read_column(pressure.outputs.regions, title), SHARE)
    return pd.DataFrame(columns, index=names)


def pressure_tables(pressure: PressureResults, geometry: SocketGeometry) -> list[Table]:
    """The outputs of the socket, then those of the regions, with their intervals."""
    rows = range(len(pressure.places))
    cells = pd.DataFrame(
        {
            title.replace("^2", "\N{SUPERSCRIPT TWO}"): [
                _words(pressure, title, row) for row in rows
            ]
            for title in _DECIMALS
        },
        index=pd.Index([place.name for place in pressure.places], name="region"),
    )
    socket = pd.DataFrame(
        cells.iloc[-1].tolist(), cells.columns.rename("socket"), ["value", "95 % interval"]
    )
    socket[""] = [_remarks(pressure, geometry).get(title, "") for title in _DECIMALS]
    regions = cells.map("\n".join)
    below = "the 95 % interval below each value"
    return [
        Table(
            "pressure-socket",
            "The socket over the segment",
            socket.drop(index="share of load [%]"),
        ),
        Table(
            "pressure-regions",
            f"Pressure and load by region, {below}",
            regions.iloc[:, :_PRESSURES],
        ),
        Table(
            "pressure-shear",
            f"Shear and centre of pressure by region, {below}",
            regions.iloc[:, _PRESSURES:],
        ),
    ]


def describe_pressure(pressure: PressureResults, geometry: SocketGeometry) -> str:
    """The pressure on the socket in a sentence."""
    parts = []
    for title in [*_DECIMALS][:3]:
        value, interval = _words(pressure, title, -1)
        name, unit = title.removesuffix("]").replace("^2", "\N{SUPERSCRIPT TWO}").split(" [")
        parts.append(f"{name} {value} ({interval}) {unit}")
    where = geometry.names[pressure.peak_tile]
    return (
        f"Pressure over the segment, with 95 % intervals: {'; '.join(parts)}. The peak is on"
        f" {where} at {pressure.peak_time:.2f} s."
    )


def _words(pressure: PressureResults, title: str, row: int) -> tuple[str, str]:
    """An output of a region, and its interval."""
    quantity, decimals = read_column(pressure.outputs.regions, title), _DECIMALS[title]
    value, low, high = (part[row] for part in (quantity.value, quantity.low, quantity.high))
    known = np.isfinite([low, high]).all()
    return (
        f"{value:z.{decimals}f}" if quantity.determined(SHARE)[row] else MASKED,
        f"{low:z.{decimals}f} to {high:z.{decimals}f}" if known else NOTHING,
    )


def _remarks(pressure: PressureResults, geometry: SocketGeometry) -> dict[str, str]:
    """What is to be said of the outputs of the socket."""
    outputs = pressure.outputs
    centre = outputs.regions.centre.value[-1]
    nearest = geometry.names[int(np.linalg.norm(geometry.anchors - centre, axis=1).argmin())]
    return {
        "peak pressure [kPa]": (
            f"on {geometry.names[pressure.peak_tile]} at {pressure.peak_time:.2f} s"
        ),
        "mean pressure [kPa]": "over all tiles and the segment",
        "contact area [cm^2]": (
            f"above {1e-3 * THRESHOLD:g} kPa; all tiles have {1e4 * geometry.areas.sum():.0f}"
        ),
        "pressure-time integral [kPa s]": f"over {outputs.integrated:.1f} s, while in contact",
        "shear [kPa]": "of the mean tangential stress",
        "shear direction [deg]": "from proximal, about the inward normal",
        "centre of pressure x [mm]": f"near {nearest}",
    }


def _scene_pressures(found: PressureResults) -> dict[str, TileValues]:
    """Pressure and shear on the tiles, where they are determined, by the name of the choice."""
    over_trial, tiles = found.over_trial, found.outputs.tiles
    pressures = of_deviations(
        over_trial.normal_pressure, over_trial.normal_pressure_standard_deviation
    )
    shears = of_deviations(over_trial.shear, over_trial.shear_standard_deviation)
    start = int(np.searchsorted(found.instants, found.peak_time))
    return {
        f"{name}, mean over the segment": TileValues(
            f"mean {name} [kPa]", 1e-3 * quantity.masked(_MAP_SHARE)
        )
        for name, quantity in (("pressure", tiles.mean), ("shear", tiles.shear))
    } | {
        f"{name} over the trial": TileValues(
            f"{name} [kPa]", 1e-3 * quantity.masked(_MAP_SHARE), found.instants, start
        )
        for name, quantity in (("pressure", pressures), ("shear", shears))
    }


def _maps(results: Results) -> ReportFigure:
    """Pressure over the segment and at its peak, unrolled."""
    geometry, found = results.trial.geometry, results.pressure
    maps, determined = instant_maps(found.outputs, found.time, _MAP_SHARE, results.segment.kind)
    values = {
        f"{name} [kPa]": np.where(determined[name], pressure, np.nan)
        for name, pressure in maps.items()
    }
    estimates = {f"{name}, estimate [kPa]": pressure for name, pressure in maps.items()}
    marks: dict[str, Any] = {"side": found.side or "", "determined": determined}
    return ReportFigure(
        "pressure_map",
        f"Pressure on the unrolled socket, {results.segment}. Hatched, pale tiles are not"
        " determined: their 95 % interval reaches farther than the value itself. Tiles with a"
        " cluster are outlined.",
        lambda style: tile_map_figure(geometry, maps, _UNIT, "", style, from_zero=True, **marks),
        "Pressure on the unrolled socket: the mean over the segment, and at its peak",
        pd.DataFrame({"tile": geometry.names, **values, **estimates}),
        is_map=True,
    )


def _regions(results: Results) -> ReportFigure:
    """Pressure of the regions over the segment."""
    found, mean = results.pressure, results.pressure.outputs.mean_pressure()
    regions = {place.name: column for column, place in enumerate(found.places)}
    events = [(event.time, event.label) for event in results.events]
    columns = {
        f"{name}.mean pressure{end} [kPa]": 1e-3 * values[:, column]
        for name, column in regions.items()
        for end, values in (("", mean.value), (" low", mean.low), (" high", mean.high))
    }
    return ReportFigure(
        "pressure_of_regions",
        f"Mean pressure of the regions over the segment, with 95 % intervals. {THINNED}",
        lambda style: regions_figure(found.time, mean, regions, events, style),
        "Mean pressure of every region over the segment with its interval",
        pd.DataFrame({"time [s]": found.time, **columns}),
    )


def _force_map(results: Results) -> ReportFigure:
    """The mean force map over the segment with its uncertainty."""
    geometry, outputs = results.trial.geometry, results.pressure.outputs
    mean = outputs.force_map.mean(outputs.samples)
    columns = {
        "pressure [kPa]": mean.normal_pressure,
        "pressure.sd [kPa]": mean.normal_pressure_standard_deviation,
        "shear [kPa]": mean.shear,
        "shear.sd [kPa]": mean.shear_standard_deviation,
    }
    return ReportFigure(
        "force_map",
        "Mean normal pressure over the segment on every tile, and the standard deviation of its"
        f" error. {mean.source}. Pale tiles are uncertain; tiles with a cluster are outlined.",
        lambda style: force_map_figure(geometry, mean, results.title("Force map"), style),
        "Normal pressure on the unrolled socket, and its standard deviation below",
        pd.DataFrame(
            {"tile": geometry.names} | {name: 1e-3 * row[0] for name, row in columns.items()}
        ),
        is_map=True,
    )


def force_map_figure(
    geometry: SocketGeometry,
    estimate: MapEstimate,
    title: str,
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """Normal pressure of the first sample of a force map, and below its standard deviation.

    The pressure fades to white where it is uncertain: see `certainty_of`.

    Args:
        geometry: The socket.
        estimate: The map, such as the mean of a segment.
        title: What is shown.
        style: How it is set.
    """
    pressure = 1e-3 * estimate.normal_pressure[0]
    deviation = 1e-3 * estimate.normal_pressure_standard_deviation[0]
    name = "normal pressure; pale where it is uncertain"
    maps = {name: pressure, "its standard deviation": deviation}
    certainty = {name: certainty_of(pressure, deviation)}
    return tile_map_figure(geometry, maps, _UNIT, title, style, certainty=certainty)


def instant_maps(
    outputs: PressureOutputs, time: FloatArray, share: float, span: str
) -> tuple[dict[str, FloatArray], dict[str, BoolArray]]:
    """Pressures of the tiles over a span and at its peak, the sample with the highest pressure.

    Args:
        outputs: The outputs over the span; its last region is the socket.
        time: Times of its samples since the first sample of the trial, shape (N,) [s].
        share: A value whose interval reaches farther than this share of it is not determined [-].
        span: Kind of the span, such as `plateau`.

    Returns:
        The pressures, shape (n,) [kPa], and which of them are determined, by what they are.
    """
    pressure = outputs.peak_map.normal_pressure[0]
    deviation = outputs.peak_map.normal_pressure_standard_deviation[0]
    at_peak = f"at the peak, {time[outputs.peak_row]:.2f} s"
    mean = f"mean over the {span if span in _SPANS else 'segment'}"
    values = {mean: 1e-3 * outputs.tiles.mean.value, at_peak: 1e-3 * pressure}
    return values, {
        mean: outputs.tiles.mean.determined(share),
        at_peak: of_deviations(pressure, deviation).determined(share),
    }


def pressure_figure(
    geometry: SocketGeometry,
    maps: Mapping[str, FloatArray],
    determined: Mapping[str, BoolArray],
    time: FloatArray,
    mean: Quantity,
    regions: Mapping[str, int],
    events: Sequence[tuple[float, str]] = (),
    side: str = "",
    title: str = "",
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """Unrolled maps of the pressure, and below them the pressure of regions over time.

    Args:
        geometry: The socket.
        maps: Pressures, shape (n,) [kPa], by what they are.
        determined: Which of them are determined, likewise: the others are pale and hatched.
        time: Times since the first sample of the trial, shape (N,) [s].
        mean: Mean pressure of every region, shape (N, r) [Pa].
        regions: Columns of the regions that are drawn over time, by name.
        events: Times since the first sample of the trial [s] and labels.
        side: The leg that wears the socket, `left` or `right`; empty where that is not known.
        title: What is shown.
        style: How it is set.
    """
    marks: dict[str, Any] = {"from_zero": True, "side": side, "determined": determined}
    if regions:
        marks["below"] = (
            _regions_height(regions, style),
            lambda part: _draw_regions(part, time, mean, regions, events, style),
        )
    return tile_map_figure(geometry, maps, _UNIT, title, style, **marks)


@in_style
def regions_figure(
    time: FloatArray,
    mean: Quantity,
    regions: Mapping[str, int],
    events: Sequence[tuple[float, str]] = (),
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """Pressure of regions over time with 95 % bands, four to a panel, events as marks.

    Arguments as in `pressure_figure`.
    """
    figure = style.figure(_regions_height(regions, style))
    _draw_regions(figure, time, mean, regions, events, style)
    return lay_out(figure)


def group_regions(names: Sequence[str]) -> list[tuple[str, dict[str, str]]]:
    """Regions by panel: those of one height together, else as many as there are line styles.

    Args:
        names: Names of the regions, such as `anterior distal`.

    Returns:
        For every panel its heading, such as `distal`, and by the regions' names what they are
        called in it, such as `anterior`.
    """
    groups: dict[str, dict[str, str]] = {}
    for name in names:
        sector, _, height = name.rpartition(" ")
        heading, short = (height, sector) if sector and height in HEIGHTS else ("", name)
        if name in SECTORS or name in HEIGHTS:
            heading = "sectors" if name in SECTORS else "heights"
        groups.setdefault(heading, {})[name] = short
    most = len(LINE_STYLES)
    return [
        (heading, dict([*group.items()][start : start + most]))
        for heading, group in groups.items()
        for start in range(0, len(group), most)
    ]


def _shape(regions: Mapping[str, int], style: FigureStyle) -> tuple[int, int, int]:
    """Rows and columns of panels, and columns of their keys."""
    count = len(group_regions([*regions]))
    columns = min(2 if style.is_narrow else 3, count)
    return -(-count // columns), columns, 1 if style.is_narrow and columns > 1 else 2


def _regions_height(regions: Mapping[str, int], style: FigureStyle) -> float:
    rows, _, key_columns = _shape(regions, style)
    return (62.0 - 6.0 * key_columns) * rows + 12.0


def _draw_regions(
    figure: Figure | SubFigure,
    time: FloatArray,
    mean: Quantity,
    regions: Mapping[str, int],
    events: Sequence[tuple[float, str]],
    style: FigureStyle,
) -> None:
    groups, (rows, columns, key_columns) = group_regions([*regions]), _shape(regions, style)
    events = sorted(event for event in events if time[0] <= event[0] <= time[-1])
    numbers = {label: i for i, label in enumerate(dict.fromkeys(e[1] for e in events), start=1)}
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for panel, (heading, group) in zip(axes.flat, groups, strict=False):
        for (name, short), line in zip(group.items(), LINE_STYLES, strict=False):
            value, low, high = (
                1e-3 * part[:, regions[name]] for part in (mean.value, mean.low, mean.high)
            )
            edges = thin_band(time, low, high, _MOST_POINTS)
            panel.fill_between(*edges, color=line["color"], alpha=_BAND, linewidth=0.0)
            panel.plot(*thin(time, value, _MOST_POINTS), label=short, **line)
        _mark_events(panel, [(at, numbers[label]) for at, label in events])
        style_axes(panel)
        add_legend(panel, title=heading, ncols=key_columns, columnspacing=1.0)
    for panel in axes.flat[len(groups) :]:
        panel.set_visible(False)
    for panel in axes[:, 0]:
        panel.set_ylabel(_UNIT)
    for panel in axes.flat[max(0, len(groups) - columns) : len(groups)]:
        panel.set_xlabel("time [s]")
        panel.tick_params(labelbottom=True)
    labels = ", ".join(f"{number} {label}" for label, number in numbers.items())
    add_key(figure, style, "bands: 95 % intervals", f"events: {labels}" if labels else "")


def _mark_events(axis: Axes, events: Sequence[tuple[float, int]]) -> None:
    """A dotted line per event, with its number where that does not run into the last one."""
    left, right = axis.get_xlim()
    free = left
    for at, number in events:
        axis.axvline(at, color="0.3", linewidth=0.8, linestyle=":")
        if at >= free:
            axis.annotate(
                str(number),
                (at, 1.0),
                (1.5, -1.0),
                xycoords=axis.get_xaxis_transform(),
                textcoords="offset points",
                va="top",
            )
            free = at + _NUMBER * (right - left)
    axis.set_xlim(left, right)
