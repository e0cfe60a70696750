"""Maps of the socket side by side: a value per tile and item, and the differences to the first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from socket_testbed.arrays import FloatArray
from socket_testbed.comparison.table import Compared
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.pressure import NORMAL_QUANTILE
from socket_testbed.report.figures.style import DEFAULT_STYLE, FigureStyle, in_style, lay_out
from socket_testbed.report.figures.tile_maps import (
    HEADING,
    add_key,
    certainty_of,
    cluster_key,
    columns_of,
    draw_maps,
    maps_height,
)
from socket_testbed.tables import split_unit


def item_maps(
    geometry: SocketGeometry,
    mapped: Compared,
    items: Sequence[str],
    side: str = "",
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """A map per item on one colour scale; pale where a value is uncertain.

    Args:
        geometry: The socket.
        mapped: The quantity of the tiles.
        items: Names of the items.
        side: The leg that wears the socket, `left` or `right`; empty where that is not known.
        style: How it is set.
    """
    deviations = (mapped.high - mapped.low) / (2.0 * NORMAL_QUANTILE)
    low, high = min(float(mapped.values.min()), 0.0), float(mapped.values.max())
    named = dict(zip(items, mapped.values, strict=True))
    return _maps(geometry, named, deviations, mapped.title, (low, high), side, style)


def difference_maps(
    geometry: SocketGeometry,
    mapped: Compared,
    items: Sequence[str],
    side: str = "",
    style: FigureStyle = DEFAULT_STYLE,
) -> Figure:
    """A map per difference to the first item, zero in the middle of one colour scale.

    Args:
        geometry: The socket.
        mapped: The quantity of the tiles.
        items: Names of the items.
        side: As in `item_maps`.
        style: How it is set.
    """
    deviations = (mapped.high - mapped.low) / (2.0 * NORMAL_QUANTILE)
    differences = mapped.values[1:] - mapped.values[0]
    most = float(np.abs(differences).max()) or 1.0
    named = {
        f"{item} - {items[0]}": difference
        for item, difference in zip(items[1:], differences, strict=True)
    }
    name, unit = split_unit(mapped.title)
    title = f"difference in {name} [{unit}]"
    spread = np.hypot(deviations[1:], deviations[0])
    return _maps(geometry, named, spread, title, (-most, most), side, style)


@in_style
def _maps(
    geometry: SocketGeometry,
    named: Mapping[str, FloatArray],
    deviations: FloatArray,
    unit: str,
    limits: tuple[float, float],
    side: str,
    style: FigureStyle,
) -> Figure:
    columns, scales = columns_of(len(named), style), [limits] * len(named)
    figure = style.figure(maps_height(geometry, style.width, scales, columns) + HEADING)
    certainty = None
    if np.isfinite(deviations).all():
        certainty = {
            name: certainty_of(values, deviation)
            for (name, values), deviation in zip(named.items(), deviations, strict=True)
        }
    draw_maps(figure, geometry, named, unit, scales, columns, side, certainty)
    add_key(figure, style, *cluster_key(geometry))
    return lay_out(figure)
