"""Pressure as a lab reads it: outputs of the regions, maps, regions over time, and in 3D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.axis import UNMEASURED, Region
from socket_testbed.geometry.socket import HEIGHTS, SECTORS, SOCKET, SocketGeometry
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.pressure import (
    NORMAL_QUANTILE,
    SHARE,
    THRESHOLD,
    PressureOutputs,
    Quantity,
    columns_of,
    normal_quantity,
    read_column,
)
from socket_testbed.pages.document import (
    axial_force,
    bars,
    cards,
    course,
    data_card,
    measured_pressure,
    moment,
    moments,
    socket_document,
)
from socket_testbed.report.figures.style import (
    DEFAULT_STYLE,
    LINE_STYLES,
    THINNED,
    FigureStyle,
    add_legend,
    style_axes,
    thin,
    thin_band,
)
from socket_testbed.report.figures.tiles import (
    add_key,
    tile_map_figure,
)
from socket_testbed.report.page import Heading, Pictures, ReportFigure, Section
from socket_testbed.report.results import PressureResults, Results
from socket_testbed.report.sections.surface import model_values
from socket_testbed.tables import NOTHING, UNCERTAIN, Table
from socket_testbed.trials.segment import Segment

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
_SPANS = ("plateau", "hold")
_UNIT = "pressure [kPa]"
_MOST_POINTS = 300  # per line
_BAND = 0.18  # [-]; opacity
_NUMBER = 0.04  # [-]; of a panel's width, for the number of an event


def head_section(results: Results) -> Section:
    """The pictures of the socket."""
    described = "Pressure on the unrolled wall of the socket, estimated between the clusters"
    return Section("socket", "", [Pictures(described)])


def page_data(results: Results) -> dict[str, Any]:
    """What the pictures of the socket show."""
    found, geometry, first = results.pressure, results.trial.geometry, results.samples.stamps[0]
    over_trial, tiles = found.over_trial, found.outputs.tiles
    samples, measured = over_trial.samples, measured_pressure(found.outputs.samples, geometry)
    time = 1e-9 * (samples.stamps - first)
    peak = over_trial.series.peak.part((..., -1))
    deviation = (tiles.mean.high - tiles.mean.low) / (2.0 * NORMAL_QUANTILE)
    mean = moment(
        found.peak_time, tiles.mean.value, deviation, tiles.shear.value, measured.mean(axis=0)
    )
    events = [(event.time, event.label) for event in results.events]
    return {
        "socket": socket_document(geometry, found.side),
        "start": found.peak_time,
        "moments": moments(time, over_trial.estimate, samples, geometry),
        "mean": mean | {"time": None, "words": f"mean over {results.segment}"},
        "course": course(time, axial_force(samples, geometry), peak, events),
        "cards": pressure_cards(results),
        "bars": bars(found.places, found.outputs.regions),
        "extras": {
            f"{candidate.label}: {name}": values
            for candidate in results.candidates
            for name, values in model_values(results, candidate).items()
        },
    }


def pressure_cards(results: Results) -> list[dict[str, Any]]:
    """The three cards of the segment."""
    found = results.pressure
    pressure, data = found.outputs.peak_map.normal_pressure[0], data_card(results.data)
    return cards(results.trial.geometry, found.places, found.outputs.regions, pressure, data)


def section(results: Results) -> Section:
    """The section with the outputs in numbers."""
    found = results.pressure
    return Section(
        "pressure",
        "Pressure",
        [
            f"Over {results.segment}. A value whose 95 % interval reaches farther than"
            f" {100.0 * SHARE:g} % of it is called uncertain. In contact:"
            f" above {1e-3 * THRESHOLD:g} kPa; the integrals cover"
            f" {found.outputs.integrated:.1f} s, while in contact. The direction of the shear is"
            " that from proximal about the inward normal. 'socket-testbed pressure' gives the same"
            " numbers, and those of another segment or threshold.",
            *pressure_tables(found),
            *_limb_table(found),
            Heading("How it is estimated"),
            "From the clusters' and the load cell's measurements, without a fitted model: a"
            f" Gaussian process over the socket's surface ({found.outputs.source}). About 95 % of"
            " the true values lie within the intervals. The mean over the segment is as uncertain"
            " as one sample, since what the sensors leave open does not change.",
            _overview(results),
            _force_map(results),
        ],
        {"pressure.csv": regions_frame(found), "pressure_of_regions.csv": _over_time(found)},
    )


def regions_frame(pressure: PressureResults) -> pd.DataFrame:
    """Outputs over the segment with the ends of their intervals, a row per region."""
    names = pd.Index([place.name for place in pressure.places], name="region")
    return pd.DataFrame(columns_of(pressure.outputs.regions, [*_DECIMALS]), index=names)


def pressure_tables(pressure: PressureResults) -> list[Table]:
    """The outputs of the regions, of which the last is the socket, with their intervals."""
    rows = range(len(pressure.places))
    cells = pd.DataFrame(
        {
            title.replace("^2", "\N{SUPERSCRIPT TWO}"): [
                "\n".join(_words(pressure, title, row)) for row in rows
            ]
            for title in _DECIMALS
        },
        index=pd.Index([place.name for place in pressure.places], name="region"),
    )
    below = "by region, the 95 % interval below each value"
    first, second = cells.iloc[:, :_PRESSURES], cells.iloc[:, _PRESSURES:]
    return [
        Table("pressure-regions", f"Pressure and load {below}", first),
        Table("pressure-shear", f"Shear and centre of pressure {below}", second),
    ]


def _limb_table(pressure: PressureResults) -> list[Table]:
    """How the limb sits in the socket, with intervals; none without poses."""
    if pressure.suspension is None:
        return []
    outputs = pressure.suspension.outputs()
    cells = {}
    for title, of in outputs.items():
        known = np.isfinite(of.value)
        uncertain = UNCERTAIN * (not of.certain())
        cells[title] = f"{of.value:.2f} ({of.low:.2f} to {of.high:.2f}{uncertain})" * bool(known)
    column = pd.DataFrame({"over the segment": cells}).replace("", NOTHING)
    return [Table("limb", "Limb in the socket, about the centre of the tiles", column)]


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
    if not np.isfinite([low, high]).all():
        return NOTHING, NOTHING
    uncertain = UNCERTAIN * (not quantity.certain()[row])
    return f"{value:z.{decimals}f}", f"{low:z.{decimals}f} to {high:z.{decimals}f}{uncertain}"


def _overview(results: Results) -> ReportFigure:
    """Pressure over the segment and at its peak, unrolled, and that of the regions over time."""
    geometry, found = results.trial.geometry, results.pressure
    maps, _ = instant_maps(found.outputs, found.time, results.segment.kind)
    values = {f"{name} [kPa]": pressure for name, pressure in maps.items()}
    events = [(event.time, event.label) for event in results.events]
    return ReportFigure(
        "pressure_map",
        f"Pressure on the unrolled socket, {results.segment}. The greyer, the"
        " less certain. Tiles with a cluster are outlined. Below, the mean pressure of sectors,"
        " heights and own regions."
        f" {THINNED}",
        lambda style: pressure_figure(
            geometry,
            found.places,
            found.outputs,
            found.time,
            results.segment,
            events,
            found.side or "",
            "",
            style,
        ),
        "Pressure on the unrolled socket: the mean over the segment, and at its peak; below, that"
        " of the regions over time",
        pd.DataFrame({"tile": geometry.names, **values}),
    )


def _over_time(found: PressureResults) -> pd.DataFrame:
    """Mean pressure of every region over the segment with its interval."""
    mean = found.outputs.mean_pressure()
    return pd.DataFrame(
        {"time [s]": found.time}
        | {
            f"{place.name}.mean pressure{end} [kPa]": 1e-3 * values[:, column]
            for column, place in enumerate(found.places)
            for end, values in (("", mean.value), (" low", mean.low), (" high", mean.high))
        }
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
        f" error. {mean.source}. The greyer, the less certain. Tiles with a cluster are outlined.",
        lambda style: force_map_figure(geometry, mean, results.title("Force map"), style),
        "Normal pressure on the unrolled socket, and its standard deviation below",
        pd.DataFrame(
            {"tile": geometry.names} | {name: 1e-3 * row[0] for name, row in columns.items()}
        ),
    )


def force_map_figure(
    geometry: SocketGeometry,
    estimate: MapEstimate,
    title: str,
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """Normal pressure of the first sample of a force map, and below its standard deviation."""
    pressure = 1e-3 * estimate.normal_pressure[0]
    deviation = 1e-3 * estimate.normal_pressure_standard_deviation[0]
    maps = {"normal pressure": pressure, "its standard deviation": deviation}
    reach = dict(zip(maps, (NORMAL_QUANTILE * deviation, 0.0 * deviation), strict=True))
    return tile_map_figure(geometry, maps, _UNIT, title, style, reach=reach)


def instant_maps(
    outputs: PressureOutputs, time: FloatArray, span: str
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Pressures of the tiles over a span and at its peak, and the reach of their intervals.

    Shapes (n,), in kPa, by what they are.
    """
    at_peak = outputs.peak_map
    found = {
        f"mean over the {span if span in _SPANS else 'segment'}": outputs.tiles.mean,
        f"at the peak, {time[outputs.peak_row]:.2f} s": normal_quantity(
            at_peak.normal_pressure[0], at_peak.normal_pressure_standard_deviation[0]
        ),
    }
    reach = {
        name: 1e-3 * np.maximum(of.high - of.value, of.value - of.low) for name, of in found.items()
    }
    return {name: 1e-3 * of.value for name, of in found.items()}, reach


def pressure_figure(
    geometry: SocketGeometry,
    places: Sequence[Region],
    outputs: PressureOutputs,
    time: FloatArray,
    span: Segment,
    events: Sequence[tuple[float, str]] = (),
    side: str = "",
    title: str = "",
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """Unrolled maps of the pressure, and below them that of sectors, heights and own regions.

    Args:
        geometry: The socket.
        places: Its regions.
        outputs: Their outputs over a span.
        time: Times of its samples since the first sample of the trial, shape (N,) [s].
        span: The span.
        events: Times since the first sample of the trial [s] and labels.
        side: The leg that wears the socket; empty where that is not known.
        title: What is shown.
        style: How it is set.
    """
    maps, reach = instant_maps(outputs, time, span.kind)
    left_out = {
        SOCKET,
        UNMEASURED,
        *(f"{sector} {height}" for sector in SECTORS for height in HEIGHTS),
    }
    regions = {place.name: i for i, place in enumerate(places) if place.name not in left_out}
    mean = outputs.mean_pressure()
    return tile_map_figure(
        geometry,
        maps,
        _UNIT,
        title,
        style,
        from_zero=True,
        side=side,
        reach=reach,
        below=(
            _regions_height(regions, style),
            lambda part: draw_regions(part, time, mean, regions, events, style),
        ),
    )


def group_regions(names: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Heading and names of every panel: sectors, heights, others; at most a name per line style."""
    groups: dict[str, list[str]] = {}
    for name in names:
        heading = "sectors" if name in SECTORS else "heights" if name in HEIGHTS else ""
        groups.setdefault(heading, []).append(name)
    most = len(LINE_STYLES)
    return [
        (heading, group[start : start + most])
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


def draw_regions(
    figure: Figure | SubFigure,
    time: FloatArray,
    mean: Quantity,
    regions: Mapping[str, int],
    events: Sequence[tuple[float, str]],
    style: FigureStyle,
) -> None:
    """Draw the pressure of regions over time with 95 % bands, a panel per kind, and events."""
    groups, (rows, columns, key_columns) = group_regions([*regions]), _shape(regions, style)
    events = sorted(event for event in events if time[0] <= event[0] <= time[-1])
    numbers = {label: i for i, label in enumerate(dict.fromkeys(e[1] for e in events), start=1)}
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for panel, (heading, group) in zip(axes.flat, groups, strict=False):
        for name, line in zip(group, LINE_STYLES, strict=False):
            value, low, high = (
                1e-3 * part[:, regions[name]] for part in (mean.value, mean.low, mean.high)
            )
            edges = thin_band(time, low, high, _MOST_POINTS)
            panel.fill_between(*edges, color=line["color"], alpha=_BAND, linewidth=0.0)
            panel.plot(*thin(time, value, _MOST_POINTS), label=name, **line)
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
