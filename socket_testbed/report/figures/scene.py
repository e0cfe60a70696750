"""3D scenes of a socket, on a page of their own or in a report; lengths in mm in {S}."""

from __future__ import annotations

import base64
import gzip
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import trimesh
from markupsafe import Markup
from matplotlib.figure import Figure
from plotly.offline import get_plotlyjs

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.files import atomic_output
from socket_testbed.geometry.axis import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.report.figures.socket_picture import SIDES, draw_view, frame_view
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
    svg_of,
)
from socket_testbed.report.figures.tiles import (
    AXIS_NAMES,
    AxesOfS,
    covered_tiles,
    drawable_surface,
    drawn_bounds,
    paint_tiles,
    place_axes,
    tile_labels,
    tile_squares,
    value_range,
)
from socket_testbed.report.page import pairs_table, render

# Two triangles per square would meet at a seam; four around its centre also let the pointer
# find the tile wherever it is on it.
_FAN = np.array([[4, 0, 1], [4, 1, 2], [4, 2, 3], [4, 3, 0]])
_UNSHADED = {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0}
_HEAD = 0.25  # [-]; of an arrow's length
_LABEL_AT = 0.8  # [-]; likewise, from its start
_MOST_FACES = 60_000
# Beside a narrow scene there is no space for it.
_COLOUR_BAR_HEIGHT = 0.15  # [-]; of the picture
_DIGITS = 9  # of a value on the page
_DIGITS_OVER_TIME = 4
_STILL = (9.0, 4.2)  # [inch]
_COLOUR_BAR = {"orientation": "h", "y": 0.0, "yanchor": "bottom", "thickness": 12, "len": 0.8}


def surface_trace(surface: trimesh.Trimesh) -> go.Mesh3d:
    """The interior surface, which one sees through."""
    veil = {"color": VEIL, "opacity": 0.3, "hoverinfo": "skip"}
    return _mesh(surface.vertices, surface.faces, "interior surface", **veil)


def tile_traces(geometry: SocketGeometry) -> list[Any]:
    """The tiles as filled squares with outlines, each with its facts under the pointer.

    Tiles with and without a cluster have two colours.

    Args:
        geometry: The socket.
    """
    covered = covered_tiles(geometry)
    facts = _tile_facts(geometry)
    kinds = [("tiles", ~covered, TILE), ("tiles with a cluster", covered, CLUSTER)]
    filled = [
        _filled(geometry, chosen, name, color=colour, text=_repeated(facts, chosen))
        for name, chosen, colour in kinds
        if chosen.any()
    ]
    return [*filled, *_outlines(geometry, "black")]


@dataclass(frozen=True)
class TileValues:
    """Values that colour the tiles of a scene.

    Attributes:
        title: What they are, with their unit, such as `pressure [kPa]`.
        values: One value per tile, shape (n,); NaN, left white, where there is none. Or such a
            row for every instant, shape (k, n).
        times: The instants since the first sample, shape (k,) [s]; None for a single row.
        start: Index of the instant that is shown first.
    """

    title: str
    values: FloatArray
    times: FloatArray | None = None
    start: int = 0

    def document(self, geometry: SocketGeometry) -> dict[str, Any]:
        """What the page needs of them; null stands for no value.

        Raises:
            ConfigurationError: If the values are not those of these tiles.
        """
        low, high = value_range(geometry, self.values)
        digits = _DIGITS if self.times is None else _DIGITS_OVER_TIME
        return {
            "unit": _escape(self.title),
            "low": low,
            "high": high,
            "start": self.start,
            "times": None if self.times is None else self.times.round(2).tolist(),
            "values": [
                [None if np.isnan(value) else float(f"{value:.{digits}g}") for value in row]
                for row in np.atleast_2d(self.values)
            ],
        }


def value_traces(geometry: SocketGeometry) -> list[Any]:
    """All tiles twice, to be filled on one colour scale that prints in grey, or left white.

    The page chooses which of them have a value, and colours those. Outlines show the clusters.

    Args:
        geometry: The socket.
    """
    every = np.ones(len(geometry), dtype=bool)
    scale = {"colorscale": SCALE, "colorbar": _COLOUR_BAR | {"title": {"side": "top"}}}
    return [
        _filled(geometry, every, "tiles", **scale),
        _filled(geometry, every, "tiles without a value", color=NO_VALUE),
        *_outlines(geometry, CLUSTER),
    ]


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


def _filled(geometry: SocketGeometry, chosen: BoolArray, name: str, **paint: Any) -> go.Mesh3d:
    squares = tile_squares(geometry)[chosen]
    points = np.concatenate([squares, geometry.anchors[chosen][:, None]], axis=1)
    return _mesh(
        points.reshape(-1, 3),
        (_FAN + 5 * np.arange(len(squares))[:, None, None]).reshape(-1, 3),
        name,
        **paint,
        lighting=_UNSHADED,
        hovertemplate="%{text}<extra></extra>",
        hoverlabel={"bgcolor": "white", "bordercolor": EDGE, "font": {"color": "black"}},
        legendgroup=name,
    )


def _repeated(facts: list[str], chosen: BoolArray) -> list[str]:
    """What the pointer shows at the five points of every chosen tile."""
    return [facts[tile] for tile in np.flatnonzero(chosen) for _ in range(5)]


def _tile_facts(geometry: SocketGeometry) -> list[str]:
    """What the pointer shows of each tile."""
    return [
        f"<b>{_escape(label)}</b><br>anchor {_vector(1e3 * geometry.anchors[tile], 1)} mm"
        f"<br>area {1e6 * geometry.areas[tile]:.1f} mm²"
        f"<br>inward normal {_vector(geometry.rotations[tile, :, 2], 3)}"
        for tile, label in enumerate(tile_labels(geometry))
    ]


def _outlines(geometry: SocketGeometry, around_cluster: str) -> list[go.Scatter3d]:
    covered = covered_tiles(geometry)
    squares = tile_squares(geometry)[:, [0, 1, 2, 3, 0]]
    kinds = [
        ("outlines", ~covered, EDGE, 3),
        ("outlines of the clusters", covered, around_cluster, 6),
    ]
    return [
        _lines(squares[chosen], colour, width, name=name, showlegend=False)
        for name, chosen, colour, width in kinds
        if chosen.any()
    ]


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
_AXIS = {
    "backgroundcolor": "white",
    "gridcolor": "#DDDDDD",
    "zerolinecolor": "#999999",
    "showspikes": False,
}


@dataclass(frozen=True)
class Scene:
    """A scene as the template `viewer` shows it.

    Attributes:
        description: What is to be seen, in words.
        figure: Traces and layout, as JSON.
        viewer: The viewer's code, compressed by gzip, in base64.
        still: The picture in its place as SVG.
        choices: Names of the sets of values that the page offers; empty where the tiles have none.
        values: Names of the tiles, and the sets, by their names; None for none.
    """

    description: str
    figure: Markup
    viewer: Markup
    still: str
    choices: Sequence[str]
    values: Mapping[str, Any] | None


@cache
def _viewer() -> Markup:
    """plotly.js as it comes with plotly, compressed: the browser unpacks it."""
    return Markup(base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode())


def _figure(
    traces: Sequence[Any],
    geometry: SocketGeometry,
    lowest: float = 0.0,
    legend: Mapping[str, Any] | None = None,
) -> Markup:
    """Traces and layout of a scene in {S}, in mm, as JSON in which every name is escaped.

    Args:
        traces: What is drawn.
        geometry: The socket, whose clusters are named.
        lowest: Share of the height below the scene [-].
        legend: Where the legend is; None for none.
    """
    scene: dict[str, Any] = {
        f"{axis}axis": {"title": {"text": f"{axis} [mm]"}, **_AXIS} for axis in AXIS_NAMES
    }
    scene |= {
        "aspectmode": "data",
        "dragmode": "turntable",
        "domain": {"y": [lowest, 1.0]},
        "camera": _camera(traces),
        "annotations": cluster_names(geometry),
    }
    layout = {
        "scene": scene,
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "showlegend": legend is not None,
        "legend": legend or {},
        "font": {"family": FONT, "size": 13, "color": "#222222"},
        "paper_bgcolor": "rgba(0, 0, 0, 0)",
    }
    document = go.Figure([*traces], {"template": "none", **layout}).to_json()
    return Markup(document.replace("<", "\\u003c"))


def _still(geometry: SocketGeometry, values: FloatArray | None = None, title: str = "") -> str:
    """The tiles from four sides, as SVG; in the colours of their values if there are some."""
    paint = paint_tiles(geometry, values)
    figure = Figure(figsize=_STILL, layout="constrained")
    axes = figure.subplots(1, len(SIDES), sharey=True)
    for axis, view in zip(axes, SIDES, strict=True):
        frame_view(axis, view, *drawn_bounds(geometry))
        draw_view(axis, view, geometry, paint, np.arange(len(geometry)))
        axis.label_outer()
    if paint.scale is not None:
        bar = figure.colorbar(paint.scale, ax=[*axes], orientation="horizontal", aspect=40)
        bar.set_label(title, parse_math=False)
    return svg_of(figure)


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
    page = render(
        "socket.html",
        title=title,
        facts=pairs_table("facts", "The socket and its tiles", facts),
        scene=Scene(
            description="The interior surface of the socket with its tiles, in 3D",
            figure=_figure(traces, geometry, legend=legend),
            viewer=_viewer(),
            still=_still(geometry),
            choices=(),
            values=None,
        ),
    )
    with atomic_output(path) as output:
        output.write_text(page, encoding="utf-8")


def value_scene(
    geometry: SocketGeometry, sets: Mapping[str, Mapping[str, TileValues]], description: str
) -> Scene:
    """A scene with the tiles in the colours of values that the page's reader chooses.

    Args:
        geometry: The socket.
        sets: Values by what they are of, and there by what they are; the first are shown first.
        description: What is to be seen, in words.

    Raises:
        ConfigurationError: If the values are not those of these tiles.
    """
    axes = place_axes(*drawn_bounds(geometry))
    traces = [
        *value_traces(geometry),
        *axes_traces(axes),
        *proximal_traces(geometry, axes.length),
    ]
    documents = {
        source: {name: values.document(geometry) for name, values in of_source.items()}
        for source, of_source in sets.items()
    }
    first = next(iter(next(iter(sets.values())).values()))
    return Scene(
        description=description,
        figure=_figure(traces, geometry, lowest=_COLOUR_BAR_HEIGHT),
        viewer=_viewer(),
        still=_still(geometry, np.atleast_2d(first.values)[0], first.title),
        choices=[*sets],
        values={"names": [_escape(label) for label in tile_labels(geometry)], "sets": documents},
    )
