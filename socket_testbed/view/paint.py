"""What colour a tile has on paper: by its kind, or by its value on a scale that prints in grey."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgba
from matplotlib.figure import Figure

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.view.colours import CLUSTER, EDGE, NO_VALUE, SCALE, TILE
from socket_testbed.view.squares import check_values, covered_tiles, value_range

_DARK = 0.45  # [-]; luminance below which ink is white
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # ITU-R BT.709


@dataclass(frozen=True)
class TilePaint:
    """How the tiles are painted.

    Attributes:
        fills: Fill of each tile, RGBA, shape (n, 4) [-].
        edges: Outline of each tile, RGBA, shape (n, 4) [-].
        widths: Widths of the outlines, shape (n,) [pt].
        scale: The colours' scale; None where they tell kinds, not values.
        unit: Unit of the values.
    """

    fills: FloatArray
    edges: FloatArray
    widths: FloatArray
    scale: ScalarMappable | None
    unit: str

    def ink(self, tile: int) -> str:
        """Colour that is legible on a tile."""
        return "white" if self.fills[tile, :3] @ _LUMINANCE < _DARK else "black"


def paint_tiles(
    geometry: SocketGeometry, values: FloatArray | None = None, unit: str = ""
) -> TilePaint:
    """Paint tiles by their values, or else tiles with and without a cluster in two colours.

    A tile with a cluster has a thick outline, too.

    Args:
        geometry: The socket.
        values: One value a tile in `unit`, shape (n,); NaN, left white, where there is none.
        unit: What the values are, with their unit, such as `pressure [kPa]`.

    Raises:
        ConfigurationError: If the values are not those of these tiles.
    """
    covered = covered_tiles(geometry)
    if values is None:
        fills, scale = _choose(covered, CLUSTER, TILE), None
    else:
        check_values(geometry, values)
        scale = ScalarMappable(Normalize(*value_range(values)), SCALE)
        fills = np.where(np.isnan(values)[:, None], to_rgba(NO_VALUE), scale.to_rgba(values))
    edges = _choose(covered, "black" if values is None else CLUSTER, EDGE)
    return TilePaint(fills, edges, np.where(covered, 1.6, 0.6), scale, unit)


def add_colour_bar(figure: Figure, axes: Sequence[Axes], paint: TilePaint) -> None:
    """Add the colour bar of tiles that are painted by their values, if they are."""
    if paint.scale is not None:
        figure.colorbar(paint.scale, ax=list(axes), label=paint.unit, shrink=0.8, pad=0.01)


def _choose(covered: BoolArray, with_cluster: str, without: str) -> FloatArray:
    return np.where(covered[:, None], to_rgba(with_cluster), to_rgba(without))
