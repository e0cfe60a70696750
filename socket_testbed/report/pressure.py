"""Pressure in the report: pictures, outputs of the regions, maps, and regions over time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.regions import main_regions
from socket_testbed.geometry.socket import HEIGHTS, SECTORS, SocketGeometry
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.pressure import (
    SHARE,
    TITLES,
    PressureOutputs,
    Quantity,
    decimals_of,
    normal_quantity,
    read_column,
    with_interval,
)
from socket_testbed.pages import document
from socket_testbed.report.models import model_values
from socket_testbed.report.page import Heading, Pictures, ReportFigure, Section
from socket_testbed.report.results import Results
from socket_testbed.report.style import (
    LINE_STYLES,
    FigureStyle,
    add_legend,
    panels,
    thin,
    thin_band,
)
from socket_testbed.report.tiles import add_key, pressure_limits, tile_map_figure, value_range
from socket_testbed.settings.options import Side
from socket_testbed.tables import Table, split_unit
from socket_testbed.trials.pressure import SegmentPressure, by_place, cells, limb_cells

_SENTENCE = ["peak pressure [kPa]", "mean pressure [kPa]", "contact area [cm^2]"]
_NAMED_SEGMENTS = ("plateau", "hold")
_SPANS = {"loaded": "while loaded", "all": "in the trial"}  # by the kind of a segment
_LABEL = "pressure [kPa]"
_MAX_POINTS = 300  # per line
_BAND_OPACITY = 0.18  # [-]
_NUMBER_WIDTH = 0.04  # [-]; space for an event's number, relative to the panel's width


def head_section(results: Results) -> Section:
    """The pictures of the socket."""
    described = "Pressure on the unrolled wall of the socket, estimated between the clusters"
    return Section("socket", "", [Pictures(described)])


def page_data(results: Results) -> dict[str, Any]:
    """Data of the cards and the pictures of the socket, as plain data for JSON.

    The keys are those of `pages.document.trial_document`; `start`, the time of the peak [s];
    `moments` and `mean` (over the segment, without a time), `cards`, `bars`; and `extras`, the
    models' parameters on the tiles, each with `values` and `unit`.
    """
    found, trial, over_trial = results.pressure, results.trial, results.over_trial
    outputs, tiles, geometry = found.outputs, found.outputs.tiles, results.trial.geometry
    time = 1e-9 * (over_trial.samples.stamps - results.samples.stamps[0])
    measured = pd.DataFrame(document.measured_pressure(outputs.samples, geometry))
    means = tiles.mean.value, tiles.mean.reach, tiles.shear.value, measured.mean().to_numpy()
    arrows = document.shear_arrows(geometry, outputs.force_map.mean(outputs.samples).forces[0])
    mean = document.moment(found.peak_time, *means, arrows=arrows)
    moments = document.moments(time, over_trial, geometry)
    at_peak = moments[int(np.abs(time - found.peak_time).argmin())]
    at_peak["words"] = f"at {found.peak_time:.2f} s, the peak {_span(found)}"
    return document.trial_document(trial, over_trial, time) | {
        "start": found.peak_time,
        "moments": moments,
        "mean": mean | {"time": None, "words": f"mean over {found.segment}", "highest": "highest"},
        "cards": [
            *document.cards(
                geometry,
                found.places,
                outputs.regions,
                tiles.peak.value,
                measured.loc[outputs.peak_row],
                span=_span(found) + _highest(found, over_trial, time),
            ),
            document.check_card(results.data, results.bag_notes),
        ],
        "bars": document.bars(found.places, outputs.regions),
        "extras": {
            f"{candidate.label}: {name}": values
            for candidate in results.candidates
            for name, values in model_values(results, candidate).items()
        },
    }


def _span(found: SegmentPressure) -> str:
    """The segment in words, such as `in the hold`."""
    kind = found.segment.kind
    return _SPANS.get(kind, f"in the {kind if kind in _NAMED_SEGMENTS else 'segment'}")


def _highest(found: SegmentPressure, over_trial: PressureOutputs, time: FloatArray) -> str:
    """The highest pressure of the trial [kPa] and its time, if it is not that of the segment.

    The times since the first sample of the trial are those of the samples of `over_trial` [s].
    """
    title = "peak pressure [kPa]"
    number = f"{{:.{decimals_of(title)}f}}".format
    own, highest = (
        number(float(read_column(outputs.regions, title).value[-1]))
        for outputs in (found.outputs, over_trial)
    )
    when = time[over_trial.peak_row]
    return "" if own == highest else f"; highest of the trial {highest} at {when:.0f} s"


def section(results: Results) -> Section:
    """The section with the numerical outputs."""
    found = results.pressure
    names = [place.name for place in found.places]
    pressure = with_interval("mean pressure [kPa]", found.outputs.mean_pressure().part(..., 1e-3))
    over_time = pd.DataFrame({"time [s]": found.time} | by_place(names, pressure))
    mean = found.outputs.force_map.mean(found.outputs.samples)
    return Section(
        "pressure",
        "Pressure",
        [
            f"Over {found.segment}. A value is marked uncertain if its 95 % interval reaches"
            f" farther than {100.0 * SHARE:g} % of it; {found.contact}. Shear direction is"
            " measured from proximal about the inward normal. 'socket-testbed pressure' gives the"
            " same numbers, also for other segments and thresholds.",
            *_tables(found),
            Heading("Estimation"),
            "From the measurements of clusters and load cell, without a fitted model: a Gaussian"
            f" process over the socket's surface ({found.outputs.source}). How many"
            " true values of simulated limbs lie within the intervals is in docs/pressure.md; over"
            " a whole hold they are fewer for areas and time integrals. The mean over the segment"
            " is as uncertain as a single sample: the sensors leave the same uncertainty in each.",
            _overview(results),
        ],
        {
            "pressure.csv": found.regions,
            "pressure_of_regions.csv": over_time,
            "force_map.csv": mean.by_tile(results.trial.geometry),
        },
    )


def _tables(found: SegmentPressure) -> Iterator[Table]:
    """Outputs of the regions, the last one the socket, and of the limb in the socket."""
    shown = cells([place.name for place in found.places], found.outputs.regions, "{}\n{}")
    shown = shown.rename(columns=_printed).rename_axis("region")
    below = "by region, the 95 % interval below each value"
    shear = TITLES.index("shear [kPa]")
    first, second = shown.iloc[:, :shear], shown.iloc[:, shear:]
    yield Table("pressure-regions", f"Pressure and load {below}", first)
    yield Table("pressure-shear", f"Shear and centre of pressure {below}", second)
    if found.suspension is not None:
        column = pd.DataFrame({"over the segment": limb_cells(found.suspension)})
        yield Table("limb", "Limb in the socket, about the centre of the tiles", column)


def describe_pressure(found: SegmentPressure) -> str:
    """The pressure on the socket in a sentence."""
    socket = cells([place.name for place in found.places], found.outputs.regions).iloc[-1]
    parts = []
    for title, value in socket[_SENTENCE].items():
        name, unit = split_unit(_printed(title))
        parts.append(f"{name} {value} {unit}")
    peak = found.outputs.peak_map.normal_pressure[0].argmax()
    return (
        f"Pressure over the segment, with 95 % intervals: {'; '.join(parts)}. The peak is on"
        f" {found.trial.geometry.names[peak]} at {found.peak_time:.2f} s."
    )


def _printed(title: str) -> str:
    return title.replace("^2", "\N{SUPERSCRIPT TWO}")


def _overview(results: Results) -> ReportFigure:
    """Unrolled pressure over the segment and at its peak, and regional pressure over time."""
    found = results.pressure
    values = {f"{name} [kPa]": quantity.value for name, quantity in _maps(found).items()}
    return ReportFigure(
        "pressure_map",
        f"Pressure on the unrolled socket, {found.segment}, and at its peak. The greyer, the"
        " less certain. Tiles with a cluster are outlined. Below, the mean pressure of sectors,"
        " heights and user-defined regions, thinned without losing a peak;"
        " pressure_of_regions.csv holds all samples.",
        lambda style: pressure_figure(found, "", style),
        pd.DataFrame({"tile": results.trial.geometry.names, **values}),
    )


def force_map_figure(
    geometry: SocketGeometry,
    estimate: MapEstimate,
    title: str,
    style: FigureStyle,
    side: Side | None,
) -> Figure:
    """Normal pressure of the first sample of a force map, and its standard deviation, in kPa.

    Args:
        geometry: The socket.
        estimate: The map, whose first sample is drawn.
        title: Title of the figure.
        style: Print layout.
        side: The leg that wears the socket; None if unknown.
    """
    pressure = 1e-3 * estimate.normal_pressure[0]
    deviation = 1e-3 * estimate.normal_pressure_standard_deviation[0]
    maps = {"normal pressure": pressure, "its standard deviation": deviation}
    reach = dict(zip(maps, (1e-3 * estimate.pressure_reach[0], 0.0 * deviation), strict=True))
    limits = pressure_limits(pressure, style.limits), value_range(deviation)
    return tile_map_figure(
        geometry,
        maps,
        _LABEL,
        title,
        style,
        limits=dict(zip(maps, limits, strict=True)),
        side=side,
        reach=reach,
    )


def _maps(found: SegmentPressure) -> dict[str, Quantity]:
    """Mean and peak pressures of the tiles over a segment, (n,) [kPa], by title."""
    at_peak, kind = found.outputs.peak_map, found.segment.kind
    deviation = 1e-3 * at_peak.normal_pressure_standard_deviation[0]
    mean = found.outputs.tiles.mean.part(..., 1e-3)
    return {
        f"mean over the {kind if kind in _NAMED_SEGMENTS else 'segment'}": mean,
        f"at the peak, {found.peak_time:.2f} s": normal_quantity(
            1e-3 * at_peak.normal_pressure[0], deviation
        ),
    }


def pressure_figure(found: SegmentPressure, title: str, style: FigureStyle) -> Figure:
    """Unrolled maps of the pressure above that of sectors, heights and user regions over time.

    Args:
        found: The pressure outputs over a segment.
        title: Title of the figure; empty for none.
        style: Print layout.
    """
    maps = _maps(found)
    reach = {name: quantity.reach for name, quantity in maps.items()}
    regions = {place.name: found.places.index(place) for place in main_regions(found.places)}
    mean = found.outputs.mean_pressure()
    events = [(event.time, event.label) for event in found.trial.events()]
    return tile_map_figure(
        found.trial.geometry,
        {name: quantity.value for name, quantity in maps.items()},
        _LABEL,
        title,
        style,
        limits=pressure_limits([quantity.value for quantity in maps.values()], style.limits),
        side=found.trial.metadata.side,
        reach=reach,
        below=(
            _shape(regions, style)[2],
            lambda part: draw_regions(part, found.time, mean, regions, events, style),
        ),
    )


def group_regions(names: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Heading and names of every panel: sectors, heights, others; one name per line style."""
    groups: dict[str, list[str]] = {}
    for name in names:
        heading = "sectors" if name in SECTORS else "heights" if name in HEIGHTS else ""
        groups.setdefault(heading, []).append(name)
    size = len(LINE_STYLES)
    return [
        (heading, group[start : start + size])
        for heading, group in groups.items()
        for start in range(0, len(group), size)
    ]


def _shape(regions: Mapping[str, int], style: FigureStyle) -> tuple[int, int, float]:
    """Panels per row, columns of their keys, and total height [mm]."""
    count = len(group_regions([*regions]))
    across = min(2 if style.is_narrow else 3, count)
    key_columns = 1 if style.is_narrow and across > 1 else 2
    return across, key_columns, (62.0 - 6.0 * key_columns) * -(-count // across) + 12.0


def draw_regions(
    figure: Figure | SubFigure,
    time: FloatArray,
    mean: Quantity,
    regions: Mapping[str, int],
    events: Sequence[tuple[float, str]],
    style: FigureStyle,
) -> None:
    """Draw the pressure of regions over time with 95 % bands and events, a panel per kind.

    Args:
        figure: The figure, or a part of one, without axes.
        time: Times of N samples since the first one of the trial, ascending, shape (N,) [s].
        mean: Mean pressure of R regions with its 95 % interval, shape (N, R) [Pa].
        regions: Names of the regions drawn, with their columns in `mean`.
        events: Times [s] and labels of the trial's events; those outside of `time` are not drawn.
        style: Print layout.
    """
    groups, (across, key_columns, _) = group_regions([*regions]), _shape(regions, style)
    events = sorted(event for event in events if time[0] <= event[0] <= time[-1])
    numbers = {label: i for i, label in enumerate(dict.fromkeys(e[1] for e in events), start=1)}
    axes = panels(figure, len(groups), across, sharey=True)
    for number, (panel, (heading, group)) in enumerate(zip(axes, groups, strict=True)):
        for name, line in zip(group, LINE_STYLES, strict=False):
            value, low, high = (
                1e-3 * part[:, regions[name]] for part in (mean.value, mean.low, mean.high)
            )
            edges = thin_band(time, low, high, _MAX_POINTS)
            panel.fill_between(*edges, color=line["color"], alpha=_BAND_OPACITY, linewidth=0.0)
            panel.plot(*thin(time, value, _MAX_POINTS), label=name, **line)
        _mark_events(panel, [(at, numbers[label]) for at, label in events])
        add_legend(panel, title=heading, ncols=key_columns, columnspacing=1.0)
        panel.set_ylabel(_LABEL if number % across == 0 else "")
    labels = ", ".join(f"{number} {label}" for label, number in numbers.items())
    add_key(figure, style, "bands: 95 % intervals", f"events: {labels}" if labels else "")


def _mark_events(axis: Axes, events: Sequence[tuple[float, int]]) -> None:
    """A dotted line per event, numbered where that does not overlap the previous number."""
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
            free = at + _NUMBER_WIDTH * (right - left)
    axis.set_xlim(left, right)
