"""Tiles in colours on paper: the socket's wall unrolled around its axis, and its distal end."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize, to_rgba
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Patch as Swatch
from matplotlib.patheffects import withStroke

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.geometry.axis import SocketAxis, socket_axis, wall_tiles
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.pages.wall import patches
from socket_testbed.report.figures.style import (
    CLUSTER,
    DEFAULT_STYLE,
    EDGE,
    HATCH,
    MM,
    NO_VALUE,
    SCALE,
    SMALL,
    TILE,
    FigureStyle,
    in_style,
    lay_out,
    wrap,
)

_BESIDE = 3.0  # [deg]; free on both sides of the unrolled wall
_ABOVE = 0.03  # [-]; of its height, free above and below
_AROUND = 0.06  # [-]; of the socket's size, free around its distal end
_LEAST_FACING = 0.15  # [-]; cosine; what is seen more edge-on is no square any more
_WALL_SHARE = 3.4  # [-]; width of the wall by that of the distal end
_SMALLEST = 3.0  # [pt]; of a name on a tile
_LONGEST_LINE = 9  # characters
_CHARACTER, _LINE = 0.62, 1.25  # [-]; width of a character, height of a line, by the font's size
_IMAGE_STEP = 0.12  # [-]; between the points of an image, by the tiles' edge
_GREY, _GREYEST = "#969696", 0.85  # of what is uncertain; its share
_GREY_FROM = 2.5  # [-]; reach of an interval by the value, from which it is greyest
_LEAST_SHARE = 0.1  # [-]; of the scale; to which the reach of smaller values is compared
_ALIKE = 2.0  # [-]; ratio of ranges that are still seen on one scale
_AXIS, _BAR = 12.0, 15.0  # [mm]; beside a map: its axis; the bar of colours
_BAR_LABEL = 38.0  # [mm]; longest line beside a bar
_UNDER = 14.0  # [mm]; above and below a map: its name and its axis
HEADING = 12.0  # [mm]; for a title above the maps and a key below

# Corners of a square of edge 2 in {L}, counter-clockwise about the inward normal.
_CORNERS = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
_WORD = 0.62 * len("posterior") * SMALL / 72.0 / MM  # [mm]; width of the longest of the sides
_SHORT = {"anterior": "ant.", "posterior": "post.", "lateral": "lat.", "medial": "med."}
_DEGREES = {angle: f"{angle}°".replace("-", "\N{MINUS SIGN}") for angle in range(-180, 181, 90)}


def tile_squares(geometry: SocketGeometry) -> FloatArray:
    """Corners of the tiles' squares in {S}, of edge sqrt(area), shape (n, 4, 3) [m].

    They are (-x, -y), (+x, -y), (+x, +y), (-x, +y) of each tile's frame.
    """
    corners_in_tile = 0.5 * np.sqrt(geometry.areas)[:, None, None] * _CORNERS
    tiles_in_socket = Pose(geometry.square_frames()[:, None], geometry.anchors[:, None])
    return tiles_in_socket.apply(corners_in_tile)


def tile_labels(geometry: SocketGeometry) -> list[str]:
    """Names of the tiles, each with its cluster where that has another name."""
    labels = list(geometry.names)
    for cluster, tile in geometry.clusters.items():
        if cluster != labels[tile]:
            labels[tile] += f" ({cluster})"
    return labels


def covered_tiles(geometry: SocketGeometry) -> BoolArray:
    """Which tiles a cluster covers, shape (n,)."""
    return np.isin(np.arange(len(geometry)), [*geometry.clusters.values()])


def value_range(geometry: SocketGeometry, values: FloatArray) -> tuple[float, float]:
    """Ends of the colour scale: range of the finite values (..., n), wider where it is a point."""
    if values.shape[-1:] != (len(geometry),):
        raise ConfigurationError(
            f"values of the shape {values.shape} do not fit {len(geometry)} tiles",
            "give one value per tile, NaN where there is none",
        )
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    margin = 0.0 if low < high else 0.1 * abs(low) or 1.0
    return low - margin, high + margin


@dataclass(frozen=True)
class TilePaint:
    """How the tiles are painted."""

    fills: FloatArray  # (n, 4) [-], RGBA
    hatched: BoolArray  # (n,), tiles without a value
    scale: ScalarMappable
    images: Mapping[str, FloatArray] = field(default_factory=dict)  # of the surface, see `_images`


def paint_tiles(
    geometry: SocketGeometry,
    values: FloatArray,
    limits: tuple[float, float] | None = None,
    reach: FloatArray | None = None,
) -> TilePaint:
    """Paint tiles by their values, shape (n,); those without one are white and hatched.

    With the reach of their intervals, (n,), values on all tiles are smooth over the surface.
    """
    scale = ScalarMappable(Normalize(*(limits or value_range(geometry, values))), SCALE)
    unknown = np.isnan(values)
    fills = np.where(unknown[:, None], to_rgba(NO_VALUE), scale.to_rgba(values))
    if reach is None or unknown.any():
        return TilePaint(fills, unknown, scale)
    images = _images(geometry, values, reach, scale)
    return TilePaint(np.zeros_like(fills), unknown, scale, images)


def _images(
    geometry: SocketGeometry, values: FloatArray, reach: FloatArray, scale: ScalarMappable
) -> dict[str, FloatArray]:
    """Values of the tiles, smooth over the surface, by its parts, RGBA, shape (h, w, 4).

    They turn grey as the interval, with a reach (n,) to each side, exceeds the value, as on pages.
    """
    images = {}
    for patch in patches(geometry, _IMAGE_STEP):
        value, doubt = patch.weights @ values, np.maximum(patch.weights @ reach, 0.0)
        doubt = doubt / np.maximum(np.abs(value), _LEAST_SHARE * scale.get_clim()[1]) - 1.0
        grey = _GREYEST * np.clip(doubt / (_GREY_FROM - 1.0), 0.0, 1.0)[..., None]
        image = np.asarray(scale.to_rgba(value))
        image += grey * (np.array(to_rgba(_GREY)) - image)
        image[..., 3] = np.isfinite(patch.points[..., 0])
        images[patch.name] = image
    return images


def _draw_image(
    axis: Axes, geometry: SocketGeometry, paint: TilePaint, name: str, around: SocketAxis
) -> None:
    """Draw the image of a part of the surface, if there is one; the panel stays as it is."""
    limits = axis.get_xlim(), axis.get_ylim()
    for patch in patches(geometry, _IMAGE_STEP) if name in paint.images else []:
        if patch.name != name:
            continue
        x, y = patch.x[[0, -1]], patch.y[[0, -1]]
        if name == "end":  # along y of {S} to the left, x up
            ends = around.end + 1e-3 * (np.outer(-x, around.left) + np.outer(y, around.anterior))
            x, y = 1e3 * ends[:, 1], 1e3 * ends[:, 0]
        axis.imshow(
            paint.images[name],
            extent=(*x, *y),
            origin="lower",
            aspect=axis.get_aspect(),
            zorder=0.5,
            interpolation="bilinear",
        )
    axis.set(xlim=limits[0], ylim=limits[1])


def _draw_unrolled(
    axis: Axes,
    geometry: SocketGeometry,
    paint: TilePaint,
    labels: Sequence[str],
    side: str = "",
) -> None:
    """The wall as one sees it walking around it outside: anterior, left, posterior, right.

    The angle is that around the socket's axis, from anterior towards left. Lengths across are
    true at the tiles' median radius only.
    """
    around = socket_axis(geometry)
    tiles = np.flatnonzero(wall_tiles(geometry, around))
    corners = tile_squares(geometry)
    squares = _unroll(corners[tiles], geometry.anchors[tiles], around)
    heights = 1e3 * around.heights(corners)
    angles = squares[..., 0]
    margin = _ABOVE * np.ptp(heights)
    left, right = min(-180.0, angles.min(initial=0.0)), max(180.0, angles.max(initial=0.0))
    axis.set_xlim(left - _BESIDE, right + _BESIDE)
    axis.set_ylim(heights.min() - margin, heights.max() + margin)
    axis.set_aspect(1.0 / (1e3 * np.radians(1.0) * max(_radius(geometry, around), 1e-3)))
    axis.set_ylabel("height [mm]")
    _name_sides(axis, side)
    _draw_image(axis, geometry, paint, "wall", around)
    _draw_tiles(axis, geometry, paint, labels, tiles, squares)


def _draw_end(
    axis: Axes, geometry: SocketGeometry, paint: TilePaint, labels: Sequence[str]
) -> None:
    """The distal end from inside, along z of {S}: anterior is up, and left on the left."""
    squares = tile_squares(geometry)
    points = squares.reshape(-1, 3)
    low, high = 1e3 * points.min(axis=0), 1e3 * points.max(axis=0)
    margin = _AROUND * (high - low)
    axis.set_xlim(high[1] + margin[1], low[1] - margin[1])
    axis.set_ylim(low[0] - margin[0], high[0] + margin[0])
    axis.set_aspect("equal")
    _draw_image(axis, geometry, paint, "end", socket_axis(geometry))
    facing = geometry.rotations[:, 2, 2] > _LEAST_FACING
    tiles = np.flatnonzero(~wall_tiles(geometry, socket_axis(geometry)) & facing)
    tiles = tiles[np.argsort(geometry.anchors[tiles, 2])]
    _draw_tiles(axis, geometry, paint, labels, tiles, 1e3 * squares[tiles][..., [1, 0]])


def _draw_tiles(
    axis: Axes,
    geometry: SocketGeometry,
    paint: TilePaint,
    labels: Sequence[str],
    tiles: IntArray,
    squares: FloatArray,
) -> None:
    """Draw some tiles, with corners in the panel, shape (m, 4, 2), hatches and labels."""
    covered = covered_tiles(geometry)[tiles]
    edge = to_rgba(EDGE, 0.0 if paint.images else 1.0)
    edges = np.where(covered[:, None], to_rgba(CLUSTER), edge)
    look: dict[str, Any] = {"edgecolors": edges, "linewidths": np.where(covered, 1.6, 0.6)}
    hatch: dict[str, Any] = {"facecolors": "none", "edgecolors": "0.35", "hatch": HATCH}
    axis.add_collection(_polygons(squares, facecolors=paint.fills[tiles], **look))
    hatched = squares[paint.hatched[tiles]]
    axis.add_collection(_polygons(hatched, linewidths=0.0, **hatch), autolim=False)
    for tile, corners in zip(tiles, squares, strict=True):
        _write(axis, labels[tile], corners)


def _write(axis: Axes, label: str, corners: FloatArray) -> None:
    """Write a name inside a tile, as large as fits, unless that is too small; no markup.

    A number of one or two digits is written at full size, legible on any fill.
    """
    words = label.strip() if len(label) <= _LONGEST_LINE else label.replace("_", "_ ")
    lines = textwrap.wrap(words, _LONGEST_LINE, break_long_words=False)
    if not lines:
        return
    width, height = np.ptp(corners, axis=0) * _points_per_unit(axis)
    size = min(width / (_CHARACTER * max(map(len, lines))), height / (_LINE * len(lines)), SMALL)
    look: dict[str, Any] = {"fontsize": size, "linespacing": 1.0}
    if len(label) <= 2:
        outline = withStroke(linewidth=2.0, foreground="white")
        look = {"fontsize": SMALL, "path_effects": [outline]}
    if look["fontsize"] >= _SMALLEST:
        text = "\n".join(lines).replace("_ ", "_")
        x, y = corners.mean(axis=0)
        axis.text(x, y, text, ha="center", va="center", zorder=3, parse_math=False, **look)


def _points_per_unit(axis: Axes) -> FloatArray:
    """Printed size of a unit of the panel's two axes, shape (2,) [pt]."""
    figure = np.array(axis.figure.bbox.size) * 72.0 / axis.figure.dpi
    panel = axis.get_position(original=True).size * figure
    span = np.abs([np.subtract(*axis.get_xlim()), np.subtract(*axis.get_ylim())])
    aspect = axis.get_aspect()
    per_x = min(panel[0] / span[0], panel[1] / (span[1] * aspect))
    return np.array([per_x, per_x * aspect])


def _polygons(corners: FloatArray, **style: Any) -> PolyCollection:
    """Polygons of k corners, shape (m, k, 2); matplotlib makes them faster from an array."""
    array: Any = corners  # its types name sequences only
    return PolyCollection(array, **style)


def _radius(geometry: SocketGeometry, around: SocketAxis) -> float:
    """Median radius of the tiles on the wall, or of all where none is [m]."""
    tiles = wall_tiles(geometry, around)
    radii = around.radii(geometry.anchors)
    return float(np.median(radii[tiles] if tiles.any() else radii))


def _name_sides(axis: Axes, side: str) -> None:
    left, right = {"left": ("lateral", "medial"), "right": ("medial", "lateral")}.get(
        side, ("left", "right")
    )
    names = ["posterior", right, "anterior", left, "posterior"]
    if 90.0 * _points_per_unit(axis)[0] / 72.0 / MM < _WORD:
        names = [_SHORT.get(name, name) for name in names]
    ticks = [f"{degrees}\n{name}" for degrees, name in zip(_DEGREES.values(), names, strict=True)]
    axis.set_xticks([*_DEGREES], ticks)


def _unroll(points: FloatArray, near: FloatArray, around: SocketAxis) -> FloatArray:
    """Angles [deg] and heights [mm] of points in {S}, shape (m, k, 3) [m].

    Each k of them are in the turn of the point near them, shape (m, 3) [m], in +-180 degrees.
    """
    angles = np.degrees(around.angles(points))
    reference = np.degrees(around.angles(near))[:, None]
    turned = reference + (angles - reference + 180.0) % 360.0 - 180.0
    return np.stack([turned, 1e3 * around.heights(points)], axis=-1)


def _scales_of(
    geometry: SocketGeometry, values: Mapping[str, FloatArray], from_zero: bool = False
) -> list[tuple[float, float]]:
    """Ends of the colour scale of every map: the same for those whose ranges are alike."""
    ranges = np.array([value_range(geometry, row) for row in values.values()])
    if from_zero:
        ranges[:, 0] = np.minimum(ranges[:, 0], 0.0)
    spans = np.ptp(ranges, axis=1)
    left = np.ones(len(ranges), dtype=bool)
    while left.any():
        alike = left & (_ALIKE * spans >= spans[left].max())
        ranges[alike] = ranges[alike, 0].min(), ranges[alike, 1].max()
        left &= ~alike
    return [(float(low), float(high)) for low, high in ranges]


def _columns_of(count: int, style: FigureStyle) -> int:
    """Number of maps in a row."""
    return 1 if style.is_narrow else min(2, count)


def _maps_height(
    geometry: SocketGeometry, style: FigureStyle, scales: Sequence[tuple[float, float]]
) -> float:
    """Height that maps need, with a title and a key [mm]."""
    columns = _columns_of(len(scales), style)
    bars = 1 if len(set(scales)) == 1 else columns
    wall = (style.width - _AXIS * columns - _BAR * bars) / columns
    wall *= _WALL_SHARE / (_WALL_SHARE + 1.0)
    around = socket_axis(geometry)
    turn = np.radians(360.0 + 2.0 * _BESIDE) * _radius(geometry, around)
    aspect = np.ptp(around.heights(tile_squares(geometry))) * (1.0 + 2.0 * _ABOVE) / turn
    return HEADING + -(-len(scales) // columns) * (float(wall * aspect) + _UNDER)


def _draw_maps(
    figure: Figure | SubFigure,
    geometry: SocketGeometry,
    values: Mapping[str, FloatArray],
    unit: str,
    scales: Sequence[tuple[float, float]],
    style: FigureStyle,
    *,
    side: str = "",
    notes: Mapping[str, str] | None = None,
    reach: Mapping[str, FloatArray] | None = None,
) -> None:
    """Draw maps of values in rows, with one bar if their scales are the same, and a key below.

    Maps with a `reach` of 95 % intervals, (n,), are smooth over the surface, and grey where these
    exceed the values. Tiles with a cluster have a thick outline and a number, which the key
    explains, with their notes.
    """
    notes, reach = notes or {}, reach or {}
    labels = [""] * len(geometry)
    key = []
    for number, (cluster, tile) in enumerate(geometry.clusters.items(), start=1):
        labels[tile] = str(number)
        key.append(": ".join(filter(None, [f"{number} {cluster}", notes.get(cluster)])))
    columns = _columns_of(len(values), style)
    rows = -(-len(values) // columns)
    axes = figure.subplots(
        rows, 2 * columns, width_ratios=(_WALL_SHARE, 1.0) * columns, squeeze=False
    ).reshape(-1, 2)
    has_end = not wall_tiles(geometry, socket_axis(geometry)).all()
    free = style.width / columns - _AXIS - _BAR
    common = len(set(scales)) == 1
    any_unknown = any_grey = False
    bar: dict[str, Any] = {"label": wrap(unit, _BAR_LABEL), "pad": 0.01}
    for panels, (name, row), limits in zip(axes, values.items(), scales, strict=False):
        paint = paint_tiles(geometry, row, limits, reach.get(name))
        any_grey |= bool(paint.images) and bool(np.any(reach[name]))
        any_unknown |= bool(paint.hatched.any())
        _draw_unrolled(panels[0], geometry, paint, labels, side=side)
        heading = wrap(name, 0.9 * free)  # bold type is wider
        panels[0].set_title(heading, loc="left", fontweight="bold", parse_math=False)
        _draw_end(panels[1], geometry, paint, labels)
        panels[1].set_axis_off()
        panels[1].set_title("distal end" if has_end else "", fontsize=SMALL, y=1.0)
        if not common:
            figure.colorbar(paint.scale, ax=[*panels], aspect=20.0, **bar)
    for panel in axes[len(values) :].flat:
        panel.set_visible(False)
    if common:
        figure.colorbar(paint.scale, ax=[*axes.flat], aspect=25.0 * rows, **bar)
    grey = "the greyer, the less certain" * any_grey
    add_key(figure, style, *key, grey, "hatched: no value" * any_unknown)


def draw_wall(
    axis: Axes,
    geometry: SocketGeometry,
    values: FloatArray,
    unit: str,
    reach: FloatArray | None = None,
    side: str = "",
) -> None:
    """Draw values on the wall, shape (n,), with a bar of colours, into the axes of somebody.

    See `paint_tiles` for the reach of their intervals.
    """
    paint = paint_tiles(geometry, values, reach=reach)
    _draw_unrolled(axis, geometry, paint, [""] * len(geometry), side=side)
    axis.figure.colorbar(paint.scale, ax=axis, label=unit)


def add_key(figure: Figure | SubFigure, style: FigureStyle, *parts: str) -> None:
    """Write what marks mean below a figure, in lines that fit; no markup."""
    text = wrap(", ".join(filter(None, parts)), 0.96 * style.width, SMALL)
    if text:
        figure.supxlabel(text, fontsize=SMALL, parse_math=False)


@in_style
def tile_map_figure(
    geometry: SocketGeometry,
    values: Mapping[str, FloatArray],
    unit: str,
    title: str = "",
    style: FigureStyle = DEFAULT_STYLE,
    *,
    limits: tuple[float, float] | Mapping[str, tuple[float, float]] | None = None,
    from_zero: bool = False,
    below: tuple[float, Callable[[SubFigure], None]] | None = None,
    **marks: Any,
) -> Figure:
    """Tiles by their values in colours that print in grey, a map per set of values.

    Values have shape (n,), NaN, hatched, where there is none. Without `limits`, of all or by name,
    maps whose ranges are alike share a scale, which begins at zero or below if `from_zero`. `below`
    is the height [mm] of what else is drawn, and what draws it; `marks` are as in `_draw_maps`.
    """
    if limits is None:
        scales = _scales_of(geometry, values, from_zero)
    else:
        scales = [limits[n] if isinstance(limits, Mapping) else limits for n in values]
    height, draw = below or (0.0, None)
    heights = _maps_height(geometry, style, scales), height
    figure = style.figure(sum(heights))
    parts: Any = [figure] if draw is None else figure.subfigures(2, 1, height_ratios=heights)
    style.add_title(parts[0], title)
    _draw_maps(parts[0], geometry, values, unit, scales, style, **marks)
    if draw is not None:
        draw(parts[1])
    return lay_out(figure)


@in_style
def socket_figure(geometry: SocketGeometry, title: str = "") -> Figure:
    """The tiles of a socket with their names."""
    figure = FigureStyle(300.0).figure(140.0)
    FigureStyle(300.0).add_title(figure, title)
    wall, end = figure.subplots(1, 2, width_ratios=(_WALL_SHARE, 1.0))
    covered, labels = covered_tiles(geometry), tile_labels(geometry)
    fills = np.where(covered[:, None], to_rgba(CLUSTER), to_rgba(TILE))
    paint = TilePaint(fills, np.zeros_like(covered), ScalarMappable())
    _draw_unrolled(wall, geometry, paint, labels)
    wall.set_title("the wall unrolled, seen from outside")
    _draw_end(end, geometry, paint, labels)
    end.set_title("distal end, seen from +z,\nthrough the opening")
    end.set_xlabel("y of {S} [mm]")
    end.set_ylabel("x of {S} [mm]")
    kinds = {"tile": TILE, "tile with a cluster": CLUSTER}
    handles = [Swatch(facecolor=colour, label=name) for name, colour in kinds.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return lay_out(figure)
