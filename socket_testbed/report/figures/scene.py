"""3D scenes of a socket, on a page of their own or in a report; lengths in mm in {S}."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import trimesh
from markupsafe import Markup

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.files import atomic_output
from socket_testbed.geometry.axis import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.report.figures.style import (
    AXES,
    CLUSTER,
    EDGE,
    FONT,
    NO_VALUE,
    PROXIMAL,
    SCALE,
    TILE,
    VEIL,
)
from socket_testbed.report.figures.tiles import (
    AXIS_NAMES,
    AxesOfS,
    covered_tiles,
    drawable_surface,
    drawn_bounds,
    place_axes,
    tile_labels,
    tile_squares,
    value_range,
)
from socket_testbed.report.page import render

# Two triangles per square would meet at a seam; four around its centre also let the pointer
# find the tile wherever it is on it.
_FAN = np.array([[4, 0, 1], [4, 1, 2], [4, 2, 3], [4, 3, 0]])
_UNSHADED = {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0}
_HEAD = 0.25  # [-]; of an arrow's length
_LABEL_AT = 0.8  # [-]; likewise, from its start
_MOST_FACES = 60_000
# Beside a narrow scene there is no space for it.
_COLOUR_BAR_HEIGHT = 0.15  # [-]; of the picture
_COLOUR_BAR = {"orientation": "h", "y": 0.0, "yanchor": "bottom", "thickness": 12, "len": 0.8}


def surface_trace(surface: trimesh.Trimesh) -> go.Mesh3d:
    """The interior surface, which one sees through."""
    veil = {"color": VEIL, "opacity": 0.3, "hoverinfo": "skip"}
    return _mesh(surface.vertices, surface.faces, "interior surface", **veil)


def tile_traces(
    geometry: SocketGeometry, values: FloatArray | None = None, unit: str = ""
) -> list[Any]:
    """The tiles as filled squares with outlines, each with its facts under the pointer.

    Without values, tiles with and without a cluster have two colours; with them, all are on
    one colour scale that prints in grey, and outlines show the clusters.
    A surface that is drawn with them should start hidden: its veil would change their colours.

    Args:
        geometry: The socket.
        values: One value per tile in `unit`, shape (n,); NaN, left white, where there is none.
        unit: What the values are, with their unit, such as `pressure [kPa]`.

    Raises:
        ConfigurationError: If the values are not those of these tiles.
    """
    covered = covered_tiles(geometry)
    if values is None:
        around_cluster = "black"
        kinds = [
            ("tiles", ~covered, {"color": TILE}),
            ("tiles with a cluster", covered, {"color": CLUSTER}),
        ]
    else:
        around_cluster = CLUSTER
        missing = np.isnan(values)
        kinds = [
            ("tiles", ~missing, _coloured(geometry, values, unit)),
            ("tiles without a value", missing, {"color": NO_VALUE}),
        ]
    facts = _tile_facts(geometry, values, unit)
    traces = [
        *(_filled(geometry, chosen, facts, name, paint) for name, chosen, paint in kinds),
        _outlines(geometry, ~covered, "outlines", EDGE, 3),
        _outlines(geometry, covered, "outlines of the clusters", around_cluster, 6),
    ]
    return [trace for trace in traces if trace is not None]


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
    lines = geometry.anchors[geometry.neighbours]
    return _lines(lines, "#555555", 2, name="neighbours", visible="legendonly")


def axes_traces(axes: AxesOfS) -> list[Any]:
    """The axes of {S} as three named arrows, one entry of the legend."""
    traces = []
    for direction, name, colour in zip(np.eye(3), AXIS_NAMES, AXES, strict=True):
        arrow = axes.start, axes.start + axes.length * direction
        traces += _arrow(*arrow, name, colour, axes.describe(), shown=name == "x")
    return traces


def proximal_traces(geometry: SocketGeometry, length: float) -> list[Any]:
    """The proximal direction as an arrow above the tiles.

    Args:
        geometry: The socket.
        length: Of the arrow [m].
    """
    direction = proximal_direction(geometry)
    middle = geometry.anchors.mean(axis=0)
    reach = ((geometry.anchors - middle) @ direction).max()
    start = middle + (reach + 0.5 * length) * direction
    return _arrow(start, start + length * direction, "proximal", PROXIMAL, "proximal direction")


def _filled(
    geometry: SocketGeometry, chosen: BoolArray, facts: list[str], name: str, paint: dict[str, Any]
) -> go.Mesh3d | None:
    if not chosen.any():
        return None
    squares = tile_squares(geometry)[chosen]
    points = np.concatenate([squares, geometry.anchors[chosen][:, None]], axis=1)
    return _mesh(
        points.reshape(-1, 3),
        (_FAN + 5 * np.arange(len(squares))[:, None, None]).reshape(-1, 3),
        name,
        **paint,
        lighting=_UNSHADED,
        text=[facts[tile] for tile in np.flatnonzero(chosen) for _ in range(5)],
        hovertemplate="%{text}<extra></extra>",
        hoverlabel={"bgcolor": "white", "bordercolor": EDGE, "font": {"color": "black"}},
        legendgroup=name,
    )


def _coloured(geometry: SocketGeometry, values: FloatArray, unit: str) -> dict[str, Any]:
    low, high = value_range(geometry, values)
    return {
        "intensity": np.repeat(values[~np.isnan(values)], 5),
        "cmin": low,
        "cmax": high,
        "colorscale": SCALE,
        "colorbar": _COLOUR_BAR | {"title": {"text": _escape(unit), "side": "top"}},
    }


def _tile_facts(geometry: SocketGeometry, values: FloatArray | None, unit: str) -> list[str]:
    """What the pointer shows of each tile."""
    facts = []
    for tile, label in enumerate(tile_labels(geometry)):
        lines = [f"<b>{_escape(label)}</b>"]
        if values is None:
            lines += [
                f"anchor {_vector(1e3 * geometry.anchors[tile], 1)} mm",
                f"area {1e6 * geometry.areas[tile]:.1f} mm²",
                f"inward normal {_vector(geometry.rotations[tile, :, 2], 3)}",
            ]
        else:  # a page holds many sets of values, each with the facts of every tile
            value = "none" if np.isnan(values[tile]) else f"{values[tile]:.4g}"
            lines.append(f"{_escape(unit)}: {value}")
        facts.append("<br>".join(lines))
    return facts


def _outlines(
    geometry: SocketGeometry, chosen: BoolArray, name: str, colour: str, width: int
) -> go.Scatter3d | None:
    if not chosen.any():
        return None
    squares = tile_squares(geometry)[chosen][:, [0, 1, 2, 3, 0]]
    return _lines(squares, colour, width, name=name, showlegend=False)


def _arrow(
    start: FloatArray, tip: FloatArray, text: str, colour: str, name: str, shown: bool = True
) -> list[Any]:
    group = {"legendgroup": name, "name": name}
    shaft = _lines(np.array([[start, tip]]), colour, 6, showlegend=shown, **group)
    shared = {**group, "hoverinfo": "skip"}
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


def _lines(polylines: FloatArray, colour: str, width: int, **more: Any) -> go.Scatter3d:
    """Polylines of shape (m, k, 3) [m], with gaps between them."""
    gaps = np.full((len(polylines), 1, 3), np.nan)
    points = np.concatenate([polylines, gaps], axis=1).reshape(-1, 3)[:-1]
    line = {"color": colour, "width": width}
    return go.Scatter3d(**_coordinates(points), mode="lines", line=line, hoverinfo="skip", **more)


def _mesh(points: FloatArray, faces: IntArray, name: str, **more: Any) -> go.Mesh3d:
    """Triangles between points, shape (m, 3) [m]."""
    corners = dict(zip("ijk", faces.astype(np.int32).T, strict=True))
    return go.Mesh3d(**_coordinates(points), **corners, name=name, showlegend=True, **more)


def _coordinates(points: FloatArray) -> dict[str, FloatArray]:
    """Coordinates [mm] of points of shape (m, 3) [m]; single precision makes a page small."""
    return dict(zip(AXIS_NAMES, (1e3 * points).astype(np.float32).T, strict=True))


def _vector(components: FloatArray, decimals: int) -> str:
    return "(" + ", ".join(f"{c + 0.0:.{decimals}f}" for c in components) + ")"


def _escape(text: str) -> str:
    """Text that is no markup under the pointer, which knows no other entities."""
    return html.escape(text, quote=False)


_EYE = np.array([1.1, 0.86, 0.3])  # of the diagonal: anterior, left and above
_CENTRE = np.array([0.0, 0.0, -0.06])  # likewise: the nearest edge of the box hangs lowest
# The viewer's own list holds a button that sends the chart away.
_BUTTONS = ["toImage", "zoom3d", "pan3d", "orbitRotation", "resetCameraDefault3d"]
_AXIS = {
    "backgroundcolor": "white",
    "gridcolor": "#DDDDDD",
    "zerolinecolor": "#999999",
    "showspikes": False,
}


def _scene_html(
    traces: Sequence[Any],
    geometry: SocketGeometry,
    name: str,
    lowest: float = 0.0,
    legend: Mapping[str, Any] | None = None,
) -> Markup:
    """The HTML of a scene in {S}, in mm, with the viewer inlined; it escapes every name.

    Args:
        traces: What is drawn.
        geometry: The socket, whose clusters are named.
        name: Its id in the page.
        lowest: Share of the height below the scene [-].
        legend: Where the legend is; None for none.
    """
    scene: dict[str, Any] = {
        f"{axis}axis": {"title": {"text": f"{axis} [mm]"}, **_AXIS} for axis in AXIS_NAMES
    }
    scene |= {
        "aspectmode": "data",
        "domain": {"y": [lowest, 1.0]},
        "camera": _camera(traces),
        "annotations": cluster_names(geometry),
    }
    layout = {
        "scene": scene,
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "showlegend": legend is not None,
        "legend": legend or {},
        "font": {"family": FONT, "size": 13},
        "paper_bgcolor": "white",
    }
    page = go.Figure([*traces], layout).to_html(
        full_html=False,
        include_plotlyjs=True,
        div_id=name,
        config={"responsive": True, "displaylogo": False, "modeBarButtons": [_BUTTONS]},
    )
    return Markup(page)


def _camera(traces: Sequence[Any]) -> dict[str, Any]:
    """A camera that sees everything, in the viewer's unit: the geometric mean of the edges."""
    drawn = np.hstack([[trace.x, trace.y, trace.z] for trace in traces])
    edges = np.nanmax(drawn, axis=1) - np.nanmin(drawn, axis=1)
    diagonal = np.linalg.norm(edges) / np.exp(np.log(edges).mean())
    return {
        name: dict(zip(AXIS_NAMES, (diagonal * place).tolist(), strict=True))
        for name, place in (("eye", _EYE), ("center", _CENTRE))
    }


def socket_page(
    vertices: FloatArray,
    faces: IntArray,
    geometry: SocketGeometry,
    path: Path,
    title: str,
    facts: Sequence[tuple[str, str]],
) -> None:
    """Write a page with the interior surface of a socket and its tiles, in one file.

    Args:
        vertices: Vertices of the interior surface in {S}, shape (v, 3) [m].
        faces: Indices of each face's vertices, shape (f, 3).
        geometry: The socket.
        path: File to write or replace.
        title: Heading of the page.
        facts: Rows of the table beside the picture: what, and how much with its unit.

    Raises:
        ScanError: If this is no surface, or not in metres.
        ConfigurationError: If the file cannot be written.
    """
    surface = drawable_surface(vertices, faces, _MOST_FACES)
    axes = place_axes(*drawn_bounds(geometry, surface))
    traces = [
        surface_trace(surface),
        *tile_traces(geometry),
        neighbour_trace(geometry),
        *axes_traces(axes),
        *proximal_traces(geometry, axes.length),
    ]
    legend = {"orientation": "h", "yref": "container", "y": 0, "yanchor": "bottom"}
    scene = _scene_html(traces, geometry, "socket", legend=legend)
    page = render("socket.html", title=title, facts=facts, scene=scene)
    with atomic_output(path) as output:
        output.write_text(page, encoding="utf-8")


def value_scene(
    geometry: SocketGeometry, values: Mapping[str, tuple[FloatArray, str]]
) -> tuple[Markup, dict[str, list[bool]]]:
    """A scene with the tiles in the colours of the first set of values.

    Args:
        geometry: The socket.
        values: One value per tile, shape (n,), NaN where there is none, and what they are
            with their unit, by a key.

    Returns:
        The HTML of the scene with the viewer itself, whose id is `scene`; and for each set of
        values by its key, whether each trace is shown.

    Raises:
        ConfigurationError: If the values are not those of these tiles.
    """
    axes = place_axes(*drawn_bounds(geometry))
    shared = [*axes_traces(axes), *proximal_traces(geometry, axes.length)]
    traces, owner = list(shared), [""] * len(shared)
    for key, (tiles, unit) in values.items():
        own = tile_traces(geometry, tiles, unit)
        traces += own
        owner += [key] * len(own)
    visible = {key: [name in ("", key) for name in owner] for key in values}
    for trace, shown in zip(traces, visible[next(iter(values))], strict=True):
        trace.visible = shown
    return _scene_html(traces, geometry, "scene", lowest=_COLOUR_BAR_HEIGHT), visible
