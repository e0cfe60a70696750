"""Traces of a page: the surface, the tiles, their neighbours, and the axes of {S}; in mm."""

from __future__ import annotations

import html
from typing import Any

import numpy as np
import plotly.graph_objects as go

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.view.axes_of_s import AXIS_NAMES, AxesOfS
from socket_testbed.view.colours import AXES, CLUSTER, EDGE, NO_VALUE, PROXIMAL, SCALE, TILE, VEIL
from socket_testbed.view.squares import (
    check_values,
    covered_tiles,
    proximal_direction,
    tile_labels,
    tile_squares,
    value_range,
)
from socket_testbed.view.surface import Surface

# Two triangles a square would meet at a seam; four around its centre also let the pointer
# find the tile wherever it is on it.
_FAN = np.array([[4, 0, 1], [4, 1, 2], [4, 2, 3], [4, 3, 0]])
_UNSHADED = {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0}
_HEAD = 0.25  # [-]; of an arrow's length
_LABEL_AT = 0.8  # [-]; likewise, from its start


def surface_trace(surface: Surface) -> go.Mesh3d:
    """The interior surface, which one sees through."""
    i, j, k = surface.faces.astype(np.int32).T
    return go.Mesh3d(
        **_coordinates(surface.vertices),
        **{"i": i, "j": j, "k": k},
        color=VEIL,
        opacity=0.3,
        hoverinfo="skip",
        name="interior surface",
        showlegend=True,
    )


def tile_traces(
    geometry: SocketGeometry, values: FloatArray | None = None, unit: str = ""
) -> list[Any]:
    """The tiles as filled squares with outlines, each with its facts under the pointer.

    Without values, tiles with and without a cluster have two colours; with them, all are on
    one colour scale that prints in grey, and the clusters are told by their outlines.
    A surface that is drawn with them should start hidden: its veil would change their colours.

    Args:
        geometry: The socket.
        values: One value a tile in `unit`, shape (n,); NaN, left white, where there is none.
        unit: What the values are, with their unit, such as `pressure [kPa]`.

    Raises:
        ConfigurationError: If the values are not those of these tiles.
    """
    if values is not None:
        check_values(geometry, values)
    covered = covered_tiles(geometry)
    facts = _tile_facts(geometry, values, unit)
    if values is None:
        fills = [
            _filled(geometry, ~covered, facts, "tiles", color=TILE),
            _filled(geometry, covered, facts, "tiles with a cluster", color=CLUSTER),
        ]
    else:
        missing = np.isnan(values)
        fills = [
            _filled(geometry, ~missing, facts, "tiles", **_coloured(values[~missing], unit)),
            _filled(geometry, missing, facts, "tiles without a value", color=NO_VALUE),
        ]
    around_cluster = "black" if values is None else CLUSTER
    outlines = [
        _outlines(geometry, ~covered, "outlines", color=EDGE, width=3),
        _outlines(geometry, covered, "outlines of the clusters", color=around_cluster, width=6),
    ]
    return [trace for trace in (*fills, *outlines) if trace is not None]


def cluster_names(geometry: SocketGeometry) -> list[dict[str, Any]]:
    """Annotations with the names of the clusters, each with an arrow to its tile."""
    return [
        {
            **dict(zip(AXIS_NAMES, (1e3 * geometry.anchors[tile]).tolist(), strict=True)),
            "text": _escape(name),
            "ax": 0,
            "ay": -32,
            "arrowhead": 6,
            "arrowsize": 0.7,
            "arrowwidth": 1.5,
            "bgcolor": "rgba(255, 255, 255, 0.85)",
            "bordercolor": CLUSTER,
            "borderpad": 2,
        }
        for name, tile in geometry.clusters.items()
    ]


def neighbour_trace(geometry: SocketGeometry) -> go.Scatter3d:
    """Lines between neighbouring tiles, hidden until they are chosen in the legend."""
    return go.Scatter3d(
        **_lines(geometry.anchors[geometry.neighbours]),
        mode="lines",
        line={"color": "#555555", "width": 2},
        hoverinfo="skip",
        name="neighbours",
        visible="legendonly",
    )


def axes_traces(axes: AxesOfS) -> list[Any]:
    """The axes of {S} as three named arrows, one entry of the legend."""
    traces = []
    for direction, name, colour in zip(np.eye(3), AXIS_NAMES, AXES, strict=True):
        arrow = axes.start, axes.start + axes.length * direction
        traces += _arrow(*arrow, name, colour, axes.describe(), shown=name == "x")
    return traces


def proximal_traces(geometry: SocketGeometry, length: float) -> list[Any]:
    """The proximal direction as an arrow above the tiles; nothing where they do not tell it.

    Args:
        geometry: The socket.
        length: Of the arrow [m].
    """
    direction = proximal_direction(geometry)
    if direction is None:
        return []
    middle = geometry.anchors.mean(axis=0)
    reach = ((geometry.anchors - middle) @ direction).max()
    start = middle + (reach + 0.5 * length) * direction
    return _arrow(start, start + length * direction, "proximal", PROXIMAL, "proximal direction")


def _filled(
    geometry: SocketGeometry, chosen: BoolArray, facts: list[str], name: str, **paint: Any
) -> go.Mesh3d | None:
    if not chosen.any():
        return None
    squares = tile_squares(geometry)[chosen]
    points = np.concatenate([squares, geometry.anchors[chosen][:, None]], axis=1)
    i, j, k = (_FAN + 5 * np.arange(len(squares))[:, None, None]).reshape(-1, 3).T
    return go.Mesh3d(
        **_coordinates(points.reshape(-1, 3)),
        **{"i": i, "j": j, "k": k},
        **paint,
        lighting=_UNSHADED,
        text=[facts[tile] for tile in np.flatnonzero(chosen) for _ in range(5)],
        hovertemplate="%{text}<extra></extra>",
        hoverlabel={"bgcolor": "white", "bordercolor": EDGE, "font": {"color": "black"}},
        name=name,
        showlegend=True,
        legendgroup=name,
    )


def _coloured(values: FloatArray, unit: str) -> dict[str, Any]:
    low, high = value_range(values)
    return {
        "intensity": np.repeat(values, 5),
        "cmin": low,
        "cmax": high,
        "colorscale": SCALE,
        "colorbar": {
            "title": {"text": _escape(unit), "side": "right"},
            "thickness": 14,
            "len": 0.7,
        },
    }


def _tile_facts(geometry: SocketGeometry, values: FloatArray | None, unit: str) -> list[str]:
    """What the pointer tells of each tile."""
    facts = []
    for tile, label in enumerate(tile_labels(geometry)):
        lines = [
            f"<b>{_escape(label)}</b>",
            f"anchor {_vector(1e3 * geometry.anchors[tile], 1)} mm",
            f"area {1e6 * geometry.areas[tile]:.1f} mm²",
            f"inward normal {_vector(geometry.rotations[tile, :, 2], 3)}",
        ]
        if values is not None:
            value = "none" if np.isnan(values[tile]) else f"{values[tile]:.4g}"
            lines.insert(1, f"{_escape(unit)}: {value}")
        facts.append("<br>".join(lines))
    return facts


def _outlines(
    geometry: SocketGeometry, chosen: BoolArray, name: str, **line: Any
) -> go.Scatter3d | None:
    if not chosen.any():
        return None
    return go.Scatter3d(
        **_lines(tile_squares(geometry)[chosen][:, [0, 1, 2, 3, 0]]),
        mode="lines",
        line=line,
        hoverinfo="skip",
        name=name,
        showlegend=False,
    )


def _arrow(
    start: FloatArray, tip: FloatArray, text: str, colour: str, name: str, shown: bool = True
) -> list[Any]:
    shared = {"legendgroup": name, "name": name, "hoverinfo": "skip"}
    shaft = go.Scatter3d(
        **_coordinates(np.array([start, tip])),
        mode="lines",
        line={"color": colour, "width": 6},
        showlegend=shown,
        **shared,
    )
    label = go.Scatter3d(
        **_coordinates((start + _LABEL_AT * (tip - start))[None]),
        mode="text",
        text=[f" {text}"],
        textposition="middle right",
        textfont={"color": colour, "size": 16},
        showlegend=False,
        **shared,
    )
    u, v, w = 1e3 * (tip - start)
    head = go.Cone(
        **_coordinates(tip[None]),
        **{"u": [u], "v": [v], "w": [w]},
        anchor="tip",
        sizemode="raw",
        sizeref=_HEAD,
        colorscale=[[0, colour], [1, colour]],
        showscale=False,
        **shared,
    )
    return [shaft, head, label]


def _lines(polylines: FloatArray) -> dict[str, FloatArray]:
    """Coordinates [mm] of polylines of shape (m, k, 3) [m], with gaps between them."""
    gaps = np.full((len(polylines), 1, 3), np.nan)
    return _coordinates(np.concatenate([polylines, gaps], axis=1).reshape(-1, 3))


def _coordinates(points: FloatArray) -> dict[str, FloatArray]:
    """Coordinates [mm] of points of shape (m, 3) [m]; single precision makes a page small."""
    return dict(zip(AXIS_NAMES, (1e3 * points).astype(np.float32).T, strict=True))


def _vector(components: FloatArray, decimals: int) -> str:
    return "(" + ", ".join(f"{c + 0.0:.{decimals}f}" for c in components) + ")"


def _escape(text: str) -> str:
    """Text that is no markup under the pointer, which knows no other entities."""
    return html.escape(text, quote=False)
