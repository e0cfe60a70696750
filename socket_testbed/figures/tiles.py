"""Printed maps of tiles: the wall of the socket unrolled about its axis, and its distal end."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.figures.scale import GREY, POWER, fixed_end
from socket_testbed.figures.style import (
    DEFAULT_STYLE,
    DIVERGING,
    SCALE,
    SMALL,
    VERMILION,
    FigureStyle,
    Limits,
    in_style,
    lay_out,
    wrap,
)
from socket_testbed.figures.wall import Patch, UnrolledTiles, patches, side_names, unrolled_tiles
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.pressure import greyness
from socket_testbed.settings.options import Side

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure, SubFigure

_TILE = "#A6CBE3"
_EDGE = "#2B5C7D"
_NO_VALUE = "#FFFFFF"
_HATCH = "/////"  # for missing values
_SIDE_MARGIN = 3.0  # [deg]; of the unrolled wall
_WALL_MARGIN = 0.03  # [-]; above and below the wall, relative to its height
_END_MARGIN = 0.06  # [-]; around the distal end, relative to its size
_NEAR_SEAM = 150.0  # [deg]; names of tiles beyond it are moved inside the picture
_END_GAP = 12.0  # [mm]; between the wall and the distal end in one panel
_WALL_SHARE = 3.4  # [-]; width of the wall over that of the distal end
_MIN_FONT = 3.0  # [pt]; of a name on a tile
_LINE_LENGTH = 9  # characters
_CHARACTER, _LINE = 0.62, 1.25  # [-]; character width, line height, over the font size
_IMAGE_STEP = 0.12  # [-]; between the points of an image, over the tiles' edge
_MAX_RANGE_RATIO = 2.0  # [-]; of ranges on a common scale
_AXIS, _BAR = 12.0, 15.0  # [mm]; widths of a map's axis and of a colour bar
_BAR_LABEL = 38.0  # [mm]; maximum line width
_MAP_MARGIN = 14.0  # [mm]; for the name and the axis of a map
_HEADING = 12.0  # [mm]; for a title above the maps and a key below
_WORD = _CHARACTER * len("posterior") * SMALL  # [pt]; width of the longest side name
_SHORT_NAMES = {"anterior": "ant.", "posterior": "post.", "lateral": "lat.", "medial": "med."}


def value_range(values: FloatArray) -> tuple[float, float]:
    """Ends of the colour scale: the range of the finite values, in their unit, of any shape.

    A single value is widened; without any the ends are 0 and 1.
    """
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    margin = 0.0 if low < high else 0.1 * abs(low) or 1.0
    return low - margin, high + margin


def pressure_limits(values: ArrayLike, limits: Limits = (None, None)) -> tuple[float, float]:
    """Ends of the colour scale of pressures [kPa], fixed: one colour is one pressure.

    Args:
        values: All pressures of the figure, of any shape [kPa]; NaN for none.
        limits: Ends that the user chose, None for 0 and for the `fixed_end` of the highest value.
    """
    low = 0.0 if limits[0] is None else limits[0]
    if limits[1] is not None:
        return low, limits[1]
    shown = np.asarray(values, dtype=float)
    high = fixed_end(float(np.max(shown[np.isfinite(shown)], initial=0.0)))
    return low, high if high > low else low + high


@dataclass(frozen=True)
class TilePaint:
    """The n tiles of a socket and their colours.

    Attributes:
        geometry: The socket.
        tiles: Positions of the tiles on the unrolled wall and on the distal end.
        fills: Colours of the tiles, RGBA from 0 to 1, shape (n, 4) [-]; transparent under images.
        hatched: Tiles without a value, shape (n,).
        scale: The colour scale, for a colour bar.
        images: Parts of the surface with their smooth colours, RGBA from 0 to 1, shape (h, w, 4)
            [-]; empty if each tile has one colour.
    """

    geometry: SocketGeometry
    tiles: UnrolledTiles
    fills: FloatArray
    hatched: BoolArray
    scale: ScalarMappable
    images: Sequence[tuple[Patch, FloatArray]] = ()


def paint_tiles(
    geometry: SocketGeometry,
    values: FloatArray,
    limits: tuple[float, float] | None = None,
    reach: FloatArray | None = None,
) -> TilePaint:
    """Colour tiles by their values; those without one are white and hatched.

    Pressures whose intervals are known are drawn smooth over the surface, in the colours and greys
    of the pages; errors and differences, whose limits are symmetric, have diverging colours.

    Args:
        geometry: The socket of n tiles.
        values: Values of the tiles in any unit, with `reach` in kPa, shape (n,); NaN for none.
        limits: Ends of the colour scale in the unit of the values; by default their range.
        reach: Half-widths of the 95 % intervals of pressures, shape (n,) [kPa]; None colours each
            tile evenly, as does a missing value.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, PowerNorm, to_rgba

    tiles, unknown = unrolled_tiles(geometry), np.isnan(values)
    low, high = limits or value_range(values)
    differs = low == -high
    power = POWER if reach is not None and not differs else 1.0
    colours = LinearSegmentedColormap.from_list("diverging", DIVERGING) if differs else SCALE
    scale = ScalarMappable(PowerNorm(power, low, high), colours)
    fills = np.where(unknown[:, None], to_rgba(_NO_VALUE), scale.to_rgba(values))
    if reach is None or unknown.any():
        return TilePaint(geometry, tiles, fills, unknown, scale)
    images = []
    for patch in patches(geometry, _IMAGE_STEP):
        image = np.asarray(scale.to_rgba(np.clip(patch.weights @ values, low, high)))
        grey = np.clip(patch.weights @ greyness(1e3 * values, 1e3 * reach), 0.0, 1.0)
        veil = GREY["greyest"] * grey[..., None]
        image[..., :3] += veil * (np.array(GREY["colour"]) / 255.0 - image[..., :3])
        image[..., 3] = np.isfinite(patch.points[..., 0])
        images.append((patch, image))
    return TilePaint(geometry, tiles, np.zeros_like(fills), unknown, scale, images)


def _measures(tiles: UnrolledTiles) -> tuple[float, float, float]:
    """Heights of the lowest and highest corner, and width of a degree of the wall [mm]."""
    heights = 1e3 * tiles.around.heights(tiles.squares)
    radii = tiles.around.radii(tiles.squares.mean(axis=1))
    radius = np.median(radii[tiles.on_wall] if tiles.on_wall.any() else radii)
    return heights.min(), heights.max(), float(np.radians(1e3 * max(radius, 1e-3)))


def _draw_wall(axis: Axes, paint: TilePaint, labels: Sequence[str], side: Side | None) -> None:
    """Draw the wall as seen from outside: anterior, left, posterior, right.

    Lengths across are true only at the tiles' median radius.
    """
    low, high, width = _measures(paint.tiles)
    angles = paint.tiles.corners[paint.tiles.on_wall, :, 0]
    left, right = min(-180.0, angles.min(initial=0.0)), max(180.0, angles.max(initial=0.0))
    margin = _WALL_MARGIN * (high - low)
    axis.set(xlim=(left - _SIDE_MARGIN, right + _SIDE_MARGIN), ylim=(low - margin, high + margin))
    axis.set(aspect=1.0 / width, ylabel="height [mm]")
    names, ticks = side_names(side), range(-180, 181, 90)
    if 90.0 * _points_per_unit(axis)[0] < _WORD:
        names = [_SHORT_NAMES.get(name, name) for name in names]
    degrees = [f"{angle}°".replace("-", "\N{MINUS SIGN}") for angle in ticks]
    axis.set_xticks([*ticks], list(map("\n".join, zip(degrees, names, strict=True))))
    _draw_part(axis, paint, "wall", labels)


def _draw_end(axis: Axes, paint: TilePaint, labels: Sequence[str]) -> None:
    """Draw the distal end from inside: anterior is up, left is on the left."""
    reach = 1e3 * (1.0 + _END_MARGIN) * paint.tiles.around.radii(paint.tiles.squares).max()
    axis.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    _draw_part(axis, paint, "end", labels)


def _draw_part(axis: Axes, paint: TilePaint, name: str, labels: Sequence[str]) -> None:
    """Draw image, tiles, hatches and labels of the wall or the end."""
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgba

    for patch, image in paint.images:
        if patch.name == name:
            look: dict[str, Any] = {"origin": "lower", "interpolation": "bilinear", "zorder": 0.5}
            look |= {"aspect": axis.get_aspect(), "extent": (*patch.x[[0, -1]], *patch.y[[0, -1]])}
            limits = {"xlim": axis.get_xlim(), "ylim": axis.get_ylim()}
            axis.imshow(image, **look)
            axis.set(**limits)
    tiles = np.flatnonzero(paint.tiles.on_wall == (name == "wall"))
    corners: Any = paint.tiles.corners[tiles]  # matplotlib's types name sequences only
    covered, hatched = paint.geometry.covered[tiles], paint.hatched[tiles]
    edge = to_rgba(_EDGE, 0.0 if paint.images else 1.0)
    edges = np.where(covered[:, None], to_rgba(VERMILION), edge)
    widths = np.where(covered, 1.6, 0.6)
    squares = PolyCollection(
        corners, facecolors=paint.fills[tiles], edgecolors=edges, linewidths=widths
    )
    hatches = PolyCollection(
        corners[hatched], facecolors="none", edgecolors="0.35", hatch=_HATCH, linewidths=0.0
    )
    axis.add_collection(squares)
    axis.add_collection(hatches, autolim=False)
    for tile, square in zip(tiles.tolist(), corners, strict=True):
        _write(axis, labels[tile], square)


def _write(axis: Axes, label: str, corners: FloatArray) -> None:
    """Write a name inside a tile, as large as fits, unless too small; no markup.

    A number of one or two digits is written at full size, legible on any fill.
    """
    broken = label.replace("_", "_ ")
    lines = textwrap.wrap(broken, _LINE_LENGTH, break_long_words=False)
    if not lines:
        return
    look: dict[str, Any] = {"fontsize": SMALL}
    if len(label) <= 2:
        look |= _outlined()
    else:
        width, height = np.ptp(corners, axis=0) * _points_per_unit(axis)
        across, up = _CHARACTER * max(map(len, lines)), _LINE * len(lines)
        look |= {"fontsize": min(width / across, height / up, SMALL), "linespacing": 1.0}
    if look["fontsize"] >= _MIN_FONT:
        text = "\n".join(lines).replace("_ ", "_")
        look |= {"ha": "center", "va": "center", "zorder": 3, "parse_math": False}
        x, y = corners.mean(axis=0)
        axis.text(x, y, text, **look)


def _outlined() -> dict[str, Any]:
    """Look of a text with a white outline, legible on any fill."""
    from matplotlib.patheffects import withStroke

    return {"path_effects": [withStroke(linewidth=2.0, foreground="white")]}


def _points_per_unit(axis: Axes) -> FloatArray:
    """Printed size of one unit of each axis of a panel, shape (2,) [pt]."""
    figure = np.array(axis.figure.bbox.size) * 72.0 / axis.figure.dpi
    panel = axis.get_position(original=True).size * figure
    span = np.abs([np.subtract(*axis.get_xlim()), np.subtract(*axis.get_ylim())])
    aspect = axis.get_aspect()
    per_x = min(panel[0] / span[0], panel[1] / (span[1] * aspect))
    return np.array([per_x, per_x * aspect])


def _scales_of(values: Mapping[str, FloatArray]) -> list[tuple[float, float]]:
    """Colour-scale limits of every map; maps with similar ranges share them."""
    ranges = np.array([value_range(row) for row in values.values()])
    spans = np.ptp(ranges, axis=1)
    left = np.ones(len(ranges), dtype=bool)
    while left.any():
        similar = left & (_MAX_RANGE_RATIO * spans >= spans[left].max())
        ranges[similar] = ranges[similar, 0].min(), ranges[similar, 1].max()
        left &= ~similar
    return [(float(low), float(high)) for low, high in ranges]


def _draw_maps(
    figure: Figure | SubFigure,
    geometry: SocketGeometry,
    values: Mapping[str, FloatArray],
    unit: str,
    scales: Sequence[tuple[float, float]],
    columns: int,
    style: FigureStyle,
    side: Side | None,
    reach: Mapping[str, FloatArray],
) -> None:
    """Draw maps in rows, with a single colour bar if they share a scale, and a key below."""
    labels = [""] * len(geometry)
    key = []
    for number, (cluster, tile) in enumerate(geometry.clusters.items(), start=1):
        labels[tile] = str(number)
        key.append(f"{number} {cluster}")
    rows, shares = -(-len(values) // columns), (_WALL_SHARE, 1.0) * columns
    axes = figure.subplots(rows, 2 * columns, width_ratios=shares, squeeze=False).reshape(-1, 2)
    free = style.width / columns - _AXIS - _BAR
    common = len(set(scales)) == 1
    any_unknown = any_grey = False
    bar: dict[str, Any] = {"label": wrap(unit, _BAR_LABEL), "pad": 0.01}
    for panels, (name, row), limits in zip(axes, values.items(), scales, strict=False):
        paint = paint_tiles(geometry, row, limits, reach.get(name))
        any_grey |= bool(paint.images) and bool(np.any(reach[name]))
        any_unknown |= bool(paint.hatched.any())
        _draw_wall(panels[0], paint, labels, side)
        heading = wrap(name, 0.9 * free)  # bold type is wider
        panels[0].set_title(heading, loc="left", fontweight="bold", parse_math=False)
        _draw_end(panels[1], paint, labels)
        panels[1].set_axis_off()
        has_end = not paint.tiles.on_wall.all()
        panels[1].set_title("distal end" if has_end else "", fontsize=SMALL, y=1.0)
        if not common:
            figure.colorbar(paint.scale, ax=[*panels], aspect=20.0, **bar)
    for panel in axes[len(values) :].flat:
        panel.set_visible(False)
    if common:
        figure.colorbar(paint.scale, ax=[*axes.flat], aspect=25.0 * rows, **bar)
    grey = "the greyer, the less certain" * any_grey
    end = "distal end: anterior up" * has_end
    add_key(figure, style, *key, end, grey, "hatched: no value" * any_unknown)


def draw_wall(
    axis: Axes,
    geometry: SocketGeometry,
    values: FloatArray,
    unit: str,
    reach: FloatArray | None = None,
    side: Side | None = None,
    limits: tuple[float, float] | None = None,
) -> None:
    """Draw values on the wall and the distal end, with a colour bar, into the caller's axes.

    The end is to the right of the wall, at its scale. Clusters are outlined and named.

    Args:
        axis: The axes.
        geometry: The socket of n tiles.
        values: Values of the tiles in any unit, with `reach` in kPa, shape (n,); NaN is hatched.
        unit: Label of the colour bar.
        reach: Half-widths of the 95 % intervals of pressures, shape (n,) [kPa]: they are drawn
            smooth, the greyer, the less certain; None colours each tile evenly.
        side: The leg that wears the socket; None if unknown.
        limits: Ends of the colour scale in the unit of the values; by default their range.
    """
    labels = [""] * len(geometry)
    paint = paint_tiles(geometry, values, limits, reach)
    _draw_wall(axis, paint, labels, side)
    if not paint.tiles.on_wall.all():
        size, (bottom, top), right = _end_size(paint), axis.get_ylim(), axis.get_xlim()[1]
        low, high, width = _measures(paint.tiles)
        x, y = right + (_END_GAP + size) / width, 0.5 * (low + high)
        paint = _beside_wall(paint, x, y, width)
        axis.set_xlim(right=x + size / width + _SIDE_MARGIN)
        axis.set_ylim(min(bottom, y - size), max(top, y + size))
        _draw_part(axis, paint, "end", labels)
        above: dict[str, Any] = {"xytext": (0, 3), "textcoords": "offset points"}
        axis.annotate("distal end", (x, y + size), ha="center", va="bottom", **above)
    for name, tile in geometry.clusters.items():
        x, y = paint.tiles.corners[tile].mean(axis=0)
        inside = "left" if x < -_NEAR_SEAM else "center"
        look: dict[str, Any] = {"ha": inside, "va": "center", "zorder": 3, "parse_math": False}
        look |= _outlined()
        axis.text(x, y, name.replace("_", "_\n"), fontsize=SMALL, color="black", **look)
    axis.figure.colorbar(paint.scale, ax=axis, label=unit)


def _end_size(paint: TilePaint) -> float:
    """Half the width of the distal end with its tiles [mm]."""
    tiles = np.abs(paint.tiles.corners[~paint.tiles.on_wall]).max()
    surface = [np.abs(patch.x).max() for patch, _ in paint.images if patch.name == "end"]
    return float(max(tiles, *surface)) if surface else float(tiles)


def _beside_wall(paint: TilePaint, x: float, y: float, width: float) -> TilePaint:
    """The end's centre moved to a place of the wall [deg, mm], whose degrees have a width [mm]."""
    ends, corners = ~paint.tiles.on_wall, paint.tiles.corners.copy()
    corners[ends] = corners[ends] / [width, 1.0] + [x, y]
    images = [
        (patch if patch.name == "wall" else replace(patch, x=x + patch.x / width, y=y + patch.y), i)
        for patch, i in paint.images
    ]
    return replace(paint, tiles=replace(paint.tiles, corners=corners), images=images)


def add_key(figure: Figure | SubFigure, style: FigureStyle, *parts: str) -> None:
    """Write the key of marks below a figure, wrapped; no markup.

    Args:
        figure: The figure, or a part of one.
        style: Print layout; the key is as wide as its figures.
        parts: Explanations, joined by commas; empty ones are left out.
    """
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
    below: tuple[float, Callable[[SubFigure], None]] | None = None,
    side: Side | None = None,
    reach: Mapping[str, FloatArray] | None = None,
) -> Figure:
    """Maps of tiles coloured by their values, in colours that print well in grey.

    Tiles with a cluster have a thick outline and a number, explained by the key.

    Args:
        geometry: The socket of n tiles.
        values: Values by map name in any unit, with a `reach` in kPa, shape (n,); NaN is hatched.
        unit: Label of the colour bar.
        title: Title of the figure.
        style: Print layout.
        limits: Limits of the scale, for all maps or by name; by default maps with similar ranges
            share a scale.
        below: Height [mm] of a further part below the maps, and the function that draws it.
        side: The leg that wears the socket, if known.
        reach: Half-widths of 95 % intervals by map name, shape (n,) [kPa]: see `paint_tiles`.
    """
    if limits is None:
        scales = _scales_of(values)
    else:
        scales = [limits[n] if isinstance(limits, Mapping) else limits for n in values]
    columns = 1 if style.is_narrow else min(2, len(values))
    bars = 1 if len(set(scales)) == 1 else columns
    width = (style.width - _AXIS * columns - _BAR * bars) / columns * _WALL_SHARE
    low, high, degree = _measures(unrolled_tiles(geometry))
    aspect = (high - low) * (1.0 + 2.0 * _WALL_MARGIN) / (degree * (360.0 + 2.0 * _SIDE_MARGIN))
    each = width / (_WALL_SHARE + 1.0) * aspect + _MAP_MARGIN
    height, draw = below or (0.0, None)
    heights = _HEADING + -(-len(values) // columns) * each, height
    figure = style.figure(sum(heights))
    parts: Any = [figure] if draw is None else figure.subfigures(2, 1, height_ratios=heights)
    style.add_title(parts[0], title)
    _draw_maps(parts[0], geometry, values, unit, scales, columns, style, side, reach or {})
    if draw is not None:
        draw(parts[1])
    return lay_out(figure)


@in_style
def socket_figure(geometry: SocketGeometry, title: str = "") -> Figure:
    """Draw the tiles of a socket with their names, and with clusters of a different name.

    Args:
        geometry: The socket.
        title: Title of the figure; empty for none.
    """
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Patch as Swatch

    style = FigureStyle(300.0)
    figure = style.figure(140.0)
    style.add_title(figure, title)
    labels = [*geometry.names]
    for cluster, tile in geometry.clusters.items():
        labels[tile] += f" ({cluster})" * (cluster != labels[tile])
    paint = paint_tiles(geometry, np.full(len(geometry), np.nan))
    fills = np.where(geometry.covered[:, None], to_rgba(VERMILION), to_rgba(_TILE))
    paint = replace(paint, fills=fills, hatched=np.zeros_like(paint.hatched))
    wall, end = figure.subplots(1, 2, width_ratios=(_WALL_SHARE, 1.0))
    _draw_wall(wall, paint, labels, None)
    wall.set_title("the wall unrolled, seen from outside")
    _draw_end(end, paint, labels)
    end.set(title="distal end, seen through\nthe opening", xlabel="towards right [mm]")
    end.set_ylabel("towards anterior [mm]")
    kinds = {"tile": _TILE, "tile with a cluster": VERMILION}
    handles = [Swatch(facecolor=colour, label=name) for name, colour in kinds.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return lay_out(figure)
