"""Figures of pressure: force maps, pressure over a segment, and regions over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.figures.style import (
    LINE_STYLES,
    FigureStyle,
    add_legend,
    panels,
    thin,
    thin_band,
)
from socket_testbed.figures.tiles import add_key, pressure_limits, tile_map_figure, value_range
from socket_testbed.geometry.regions import Region, main_regions
from socket_testbed.geometry.socket import HEIGHTS, SECTORS, SocketGeometry
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.pressure import PressureOutputs, Quantity, normal_quantity
from socket_testbed.settings.options import Side
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

_LABEL = "pressure [kPa]"
_MAX_POINTS = 300  # per line
_BAND_OPACITY = 0.18  # [-]
_NUMBER_WIDTH = 0.04  # [-]; space for an event's number, relative to the panel's width


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


def tile_pressures(
    outputs: PressureOutputs, segment: Segment, peak_time: float
) -> dict[str, Quantity]:
    """Mean and peak pressures of the tiles over a segment, (n,) [kPa], by title.

    Args:
        outputs: The outputs over the segment.
        segment: The segment.
        peak_time: Time of the peak since the first sample of the trial [s].
    """
    at_peak = outputs.peak_map
    deviation = 1e-3 * at_peak.normal_pressure_standard_deviation[0]
    mean = outputs.tiles.mean.part(..., 1e-3)
    return {
        f"mean over the {segment.noun}": mean,
        f"at the peak, {peak_time:.2f} s": normal_quantity(
            1e-3 * at_peak.normal_pressure[0], deviation
        ),
    }


def pressure_figure(
    trial: Trial,
    segment: Segment,
    places: tuple[Region, ...],
    outputs: PressureOutputs,
    title: str,
    style: FigureStyle,
) -> Figure:
    """Unrolled maps of the pressure above that of sectors, heights and user regions over time.

    Args:
        trial: The trial.
        segment: The part of the trial that the outputs cover.
        places: The R regions of the outputs.
        outputs: The outputs over the segment.
        title: Title of the figure; empty for none.
        style: Print layout.
    """
    time = np.asarray(trial.samples().time[segment.rows])
    maps = tile_pressures(outputs, segment, float(time[outputs.peak_row]))
    reach = {name: quantity.reach for name, quantity in maps.items()}
    regions = {place.name: places.index(place) for place in main_regions(places)}
    mean = outputs.mean_pressure
    events = [(event.time, event.label) for event in trial.events()]
    return tile_map_figure(
        trial.geometry,
        {name: quantity.value for name, quantity in maps.items()},
        _LABEL,
        title,
        style,
        limits=pressure_limits([quantity.value for quantity in maps.values()], style.limits),
        side=trial.metadata.side,
        reach=reach,
        below=(
            _shape(regions, style)[2],
            lambda part: draw_regions(part, time, mean, regions, events, style),
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
