"""Pressure as a lab reads it: maps at the instants that matter, regions over time, a video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Polygon

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.geometry.axis import socket_axis
from socket_testbed.geometry.socket import HEIGHTS, SECTORS, SocketGeometry
from socket_testbed.identification.pressure import (
    PressureOutputs,
    Quantity,
    of_deviations,
)
from socket_testbed.report.figures.style import (
    DEFAULT_STYLE,
    HATCH,
    LABEL,
    LINE_STYLES,
    FigureStyle,
    in_style,
    lay_out,
    style_axes,
    thin,
    thin_band,
)
from socket_testbed.report.figures.tile_maps import (
    HEADING,
    add_bar,
    add_key,
    cluster_key,
    columns_of,
    draw_maps,
    maps_height,
    scales_of,
)
from socket_testbed.report.figures.tiles import TilePaint, paint_tiles, tile_squares
from socket_testbed.report.figures.unrolled import sides_of

_SPANS = ("plateau", "hold")
UNIT = "pressure [kPa]"
_MOST_POINTS = 300  # per line
_LINES = len(LINE_STYLES)  # in a panel, at most
_BAND = 0.18  # [-]; opacity
_NUMBER = 0.04  # [-]; of a panel's width, for the number of an event


@dataclass(frozen=True)
class Band:
    """A quantity over time with its 95 % interval.

    Attributes:
        values: Values, shape (N,) [kPa]; NaN where not determined.
        low: Lower ends, shape (N,) [kPa].
        high: Upper ends, shape (N,) [kPa].
    """

    values: FloatArray
    low: FloatArray
    high: FloatArray


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


def region_bands(mean: Quantity, names: Sequence[str]) -> dict[str, Band]:
    """Mean pressures of regions [Pa] at every sample, by the regions' names in their order."""
    return {
        name: Band(*(1e-3 * part[:, i] for part in (mean.value, mean.low, mean.high)))
        for i, name in enumerate(names)
    }


@in_style
def pressure_maps_figure(
    geometry: SocketGeometry,
    maps: Mapping[str, FloatArray],
    side: str = "",
    title: str = "",
    style: FigureStyle = DEFAULT_STYLE,
    determined: Mapping[str, BoolArray] | None = None,
) -> Figure:
    """Unrolled maps of the pressure side by side, below each other in a column.

    Angle around the socket's axis against height above its distal end. Maps whose ranges are
    alike share their scale.

    Args:
        geometry: The socket.
        maps: Pressures, shape (n,) [kPa], by what they are, such as `mean over the hold`; NaN
            where there is none.
        side: The leg that wears the socket, `left` or `right`; empty where that is not known.
        title: What is shown.
        style: How it is set.
        determined: Which pressures are determined, likewise: the others are pale and hatched.

    Raises:
        ConfigurationError: If the values are not those of these tiles.
    """
    drawing = _Maps(geometry, maps, determined or {}, side, style)
    figure = style.figure(drawing.height)
    drawing.draw(figure, title)
    return lay_out(figure)


class _Maps:
    """Unrolled maps on a figure, or on a part of one."""

    def __init__(
        self,
        geometry: SocketGeometry,
        maps: Mapping[str, FloatArray],
        determined: Mapping[str, BoolArray],
        side: str,
        style: FigureStyle,
    ) -> None:
        self._geometry, self._side, self._style = geometry, side, style
        self._maps, self._determined = maps, determined
        self._columns = columns_of(len(maps), style)
        self._scales = scales_of(geometry, maps, from_zero=True)
        self.height = HEADING + maps_height(geometry, style.width, self._scales, self._columns)

    def draw(self, figure: Figure | SubFigure, title: str) -> None:
        """Draw them."""
        self._style.add_title(figure, title)
        draw_maps(
            figure,
            self._geometry,
            self._maps,
            UNIT,
            self._scales,
            self._columns,
            self._side,
            determined=self._determined,
        )
        note = hatch_note(self._maps, self._determined)
        add_key(figure, self._style, *cluster_key(self._geometry), note)


def hatch_note(maps: Mapping[str, FloatArray], determined: Mapping[str, BoolArray]) -> str:
    """What hatched tiles are; empty where there are none."""
    unknown = any(np.isnan(values).any() for values in maps.values())
    uncertain = any(not known.all() for known in determined.values())
    return "hatched: not determined" if unknown or uncertain else ""


_ELEVATION = np.radians(25.0)
_FRONT, _BACK = np.radians([45.0, 225.0])  # azimuths of the eye
_ROUND = 1.06  # [-]; of a view's size, with what is free around it


class _SolidView:
    """The tiles as seen from obliquely above, in a parallel projection.

    Attributes:
        aspect: Height of the view by its width [-].
    """

    def __init__(self, geometry: SocketGeometry, azimuth: float) -> None:
        """Look from an azimuth from anterior towards left [rad]."""
        around = socket_axis(geometry)
        frame = np.stack([around.anterior, around.left, around.proximal])
        sin, cos = np.sin(azimuth), np.cos(azimuth)
        level = np.array([cos, sin, 0.0])
        right = np.array([-sin, cos, 0.0])
        up = np.cos(_ELEVATION) * np.eye(3)[2] - np.sin(_ELEVATION) * level
        towards = np.cross(right, up)
        squares = 1e3 * (tile_squares(geometry) - around.end) @ frame.T
        self._squares = squares @ np.stack([right, up], axis=1)
        self._order = np.argsort(squares.mean(axis=1) @ towards)  # from the back to the front
        self._azimuth = azimuth
        low, high = self._squares.min(axis=(0, 1)), self._squares.max(axis=(0, 1))
        self._middle, self._half = 0.5 * (low + high), 0.5 * _ROUND * (high - low)
        self.aspect = float(self._half[1] / self._half[0])

    def draw(self, axis: Axes, paint: TilePaint, sides: tuple[str, str, str, str]) -> None:
        """Draw the tiles, the nearer over the farther ones, and the sides that face the eye."""
        for tile in self._order:
            hatch = HATCH if paint.hatched[tile] else None
            square = Polygon(
                self._squares[tile],
                facecolor=paint.fills[tile],
                edgecolor=paint.edges[tile],
                linewidth=paint.widths[tile],
                hatch=hatch,
            )
            axis.add_patch(square)
        for name, angle in zip(sides, np.radians([0.0, 90.0, 180.0, 270.0]), strict=True):
            if np.cos(angle - self._azimuth) > 0.0:
                across = 0.5 + 0.5 * np.sin(angle - self._azimuth)
                axis.annotate(
                    name,
                    (across, 0.0),
                    (0.0, -2.0),
                    "axes fraction",
                    "offset points",
                    ha="center",
                    va="top",
                )
        left, right = self._middle[0] + self._half[0] * np.array([-1.0, 1.0])
        low, high = self._middle[1] + self._half[1] * np.array([-1.0, 1.0])
        axis.set_xlim(left, right)
        axis.set_ylim(low, high)
        axis.set_aspect("equal")
        axis.set_axis_off()


@in_style
def pressure_views_figure(
    geometry: SocketGeometry,
    maps: Mapping[str, FloatArray],
    side: str = "",
    title: str = "",
    style: FigureStyle = DEFAULT_STYLE,
    determined: Mapping[str, BoolArray] | None = None,
) -> Figure:
    """The socket in 3D in the colours of its pressure, each map from in front and from behind.

    Args:
        geometry: The socket.
        maps: As in `pressure_maps_figure`.
        side: The leg that wears the socket, `left` or `right`; empty where that is not known.
        title: What is shown.
        style: How it is set.
        determined: As in `pressure_maps_figure`.

    Raises:
        ConfigurationError: If the values are not those of these tiles.
    """
    determined = determined or {}
    pairs = columns_of(len(maps), style)
    rows = -(-len(maps) // pairs)
    scales = scales_of(geometry, maps, from_zero=True)
    views = [_SolidView(geometry, azimuth) for azimuth in (_FRONT, _BACK)]
    width = (style.width - 15.0) / (2 * pairs)
    figure = style.figure(rows * (0.8 * width * views[0].aspect + 12.0) + HEADING)
    style.add_title(figure, title)
    axes = figure.subplots(rows, 2 * pairs, squeeze=False).reshape(-1, 2)
    common = len(set(scales)) == 1
    for panels, (name, values), limits in zip(axes, maps.items(), scales, strict=False):
        paint = paint_tiles(geometry, values, limits, determined=determined.get(name))
        for panel, view in zip(panels, views, strict=True):
            view.draw(panel, paint, sides_of(side))
        panels[0].set_title(name, loc="left", fontweight="bold", parse_math=False)
        if not common:
            add_bar(figure, paint, list(panels), UNIT, 25.0)
    for panel in axes[len(maps) :].flat:
        panel.set_visible(False)
    if common:
        add_bar(figure, paint, list(axes.flat), UNIT, 25.0 * rows)
    note = hatch_note(maps, determined)
    add_key(figure, style, "tiles with a cluster are outlined", note)
    return lay_out(figure)


@in_style
def regions_figure(
    time: FloatArray,
    regions: Mapping[str, Band],
    events: Sequence[tuple[float, str]] = (),
    title: str = "",
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """Pressure of regions over time with 95 % bands, four to a panel, events as marks.

    Args:
        time: Times since the first sample of the trial, shape (N,) [s].
        regions: What is drawn, by name.
        events: Times since the first sample of the trial [s] and labels.
        title: What is shown.
        style: How it is set.
    """
    drawing = _Regions(time, regions, events, style)
    figure = style.figure(drawing.height)
    drawing.draw(figure, title)
    return lay_out(figure)


class _Regions:
    """Regions over time on a figure, or on a part of one."""

    def __init__(
        self,
        time: FloatArray,
        regions: Mapping[str, Band],
        events: Sequence[tuple[float, str]],
        style: FigureStyle,
    ) -> None:
        self._time, self._regions, self._style = time, regions, style
        self._events = [event for event in events if time[0] <= event[0] <= time[-1]]
        self._groups = group_regions([*regions])
        self._columns = min(2 if style.is_narrow else 3, len(self._groups))
        self._rows = -(-len(self._groups) // self._columns)
        self._key_columns = 1 if style.is_narrow and self._columns > 1 else 2
        self.height = (62.0 - 6.0 * self._key_columns) * self._rows + 12.0

    def draw(self, figure: Figure | SubFigure, title: str) -> None:
        """Draw them."""
        self._style.add_title(figure, title)
        axes = figure.subplots(self._rows, self._columns, squeeze=False, sharex=True, sharey=True)
        for panel, (heading, group) in zip(axes.flat, self._groups, strict=False):
            shown = {short: self._regions[name] for name, short in group.items()}
            draw_regions(panel, self._time, shown, heading, self._events, self._key_columns)
        for panel in axes.flat[len(self._groups) :]:
            panel.set_visible(False)
        for panel in axes[:, 0]:
            panel.set_ylabel(UNIT)
        for column in range(self._columns):
            last = axes[(len(self._groups) - 1 - column) // self._columns, column]
            last.set_xlabel("time [s]")
            last.tick_params(labelbottom=True)
        labels = ", ".join(f"{number} {label}" for label, number in _numbers(self._events).items())
        note = f"events: {labels}" if labels else ""
        add_key(figure, self._style, "bands: 95 % intervals", note)


@in_style
def pressure_figure(
    geometry: SocketGeometry,
    maps: Mapping[str, FloatArray],
    determined: Mapping[str, BoolArray],
    time: FloatArray,
    regions: Mapping[str, Band],
    events: Sequence[tuple[float, str]] = (),
    side: str = "",
    title: str = "",
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """Unrolled maps of the pressure, and below them the pressure of regions over time.

    Arguments as in `pressure_maps_figure` and `regions_figure`.
    """
    above = _Maps(geometry, maps, determined, side, style)
    below = _Regions(time, regions, events, style)
    figure = style.figure(above.height + below.height)
    parts: Any = figure.subfigures(2, 1, height_ratios=(above.height, below.height))
    above.draw(parts[0], title)
    below.draw(parts[1], "")
    return lay_out(figure)


def _numbers(events: Sequence[tuple[float, str]]) -> dict[str, int]:
    """A number per label, from 1 in the order of time."""
    labels = dict.fromkeys(label for _, label in sorted(events))
    return {label: number for number, label in enumerate(labels, start=1)}


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
    return [
        (heading, dict(list(group.items())[start : start + _LINES]))
        for heading, group in groups.items()
        for start in range(0, len(group), _LINES)
    ]


def draw_regions(
    axis: Axes,
    time: FloatArray,
    regions: Mapping[str, Band],
    heading: str = "",
    events: Sequence[tuple[float, str]] = (),
    key_columns: int = 2,
) -> None:
    """Draw regions over time in a panel with their key above; numbers mark the events."""
    for (name, band), line in zip(regions.items(), LINE_STYLES, strict=False):
        edges = thin_band(time, band.low, band.high, _MOST_POINTS)
        axis.fill_between(*edges, color=line["color"], alpha=_BAND, linewidth=0.0)
        axis.plot(*thin(time, band.values, _MOST_POINTS), label=name, **line)
    _mark_events(axis, events)
    style_axes(axis)
    legend = axis.legend(
        title=heading,
        loc="lower left",
        bbox_to_anchor=(-0.01, 1.0),
        ncols=key_columns,
        columnspacing=1.0,
        borderaxespad=0.0,
        alignment="left",
        title_fontproperties={"size": LABEL, "weight": "bold"},
    )
    for text in legend.get_texts():
        text.set_parse_math(False)


def _mark_events(axis: Axes, events: Sequence[tuple[float, str]]) -> None:
    """A dotted line per event, with its number where that does not run into the last one."""
    numbers = _numbers(events)
    left, right = axis.get_xlim()
    free = left
    for at, label in sorted(events):
        if not left <= at <= right:
            continue
        axis.axvline(at, color="0.3", linewidth=0.8, linestyle=":")
        if at >= free:
            axis.annotate(
                str(numbers[label]),
                (at, 1.0),
                (1.5, -1.0),
                xycoords=axis.get_xaxis_transform(),
                textcoords="offset points",
                va="top",
            )
            free = at + _NUMBER * (right - left)
    axis.set_xlim(left, right)
