"""The tiles of a socket in 3D, on a page; lengths in mm in {S}."""

from __future__ import annotations

import base64
import gzip
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import plotly.graph_objects as go
import trimesh
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.files import atomic_output
from socket_testbed.geometry.axis import proximal_direction, socket_axis
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.report.figures.style import (
    AXES,
    CLUSTER,
    EDGE,
    FONT,
    NO_VALUE,
    PROXIMAL,
    SCALE,
    VEIL,
    svg_of,
)
from socket_testbed.report.figures.tiles import (
    covered_tiles,
    socket_figure,
    tile_labels,
    tile_map_figure,
    tile_squares,
    value_range,
)
from socket_testbed.report.page import Section, pairs_table, render
from socket_testbed.tables import split_unit

# Two triangles per square would meet at a seam; four around its centre also let the pointer
# find the tile wherever it is on it. scene.js picks the tiles with and without a value.
_FAN = np.array([[4, 0, 1], [4, 1, 2], [4, 2, 3], [4, 3, 0]])
_UNSHADED = {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0}
_MOST_FACES = 60_000  # of an interior surface
_GROWTH = 1.1  # [-]; of the cells in which vertices are merged, from one attempt to the next
_ARROW = 0.05  # [m]; length of the axes
_DIGITS, _DIGITS_OVER_TIME = 9, 4  # of a value on the page
_COLOUR_BAR = {"orientation": "h", "y": 0.0, "yanchor": "bottom", "thickness": 12, "len": 0.8}
_BELOW = 0.15  # [-]; of the picture's height, below the scene: for the bar of colours
_EYE = np.array([1.1, 0.86, 0.3])  # of the diagonal: anterior, left and above
_CENTRE = np.array([0.0, 0.0, -0.06])  # likewise: the nearest edge of the box hangs lowest
_AXIS = {
    "backgroundcolor": "white",
    "gridcolor": "#DDDDDD",
    "zerolinecolor": "#999999",
    "showspikes": False,
}


@dataclass(frozen=True)
class TileValues:
    """Values that colour the tiles of a scene, at one instant or several."""

    title: str  # with the unit, such as `pressure [kPa]`
    values: FloatArray  # (n,) or (k, n); NaN, left white, where there is none
    times: FloatArray | None = None  # (k,) [s], since the first sample
    start: int = 0  # the instant that is shown first

    def document(self, geometry: SocketGeometry) -> dict[str, Any]:
        """The values for the page; null where there is none."""
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


@dataclass(frozen=True)
class Scene:
    """A scene as the page shows it."""

    kind: ClassVar = "scene"
    description: str
    figure: Markup  # traces and layout, as JSON
    viewer: Markup  # its code, compressed by gzip, in base64
    still: str  # the picture in its place as SVG
    choices: Sequence[str]  # names of the sets of values
    values: Mapping[str, Any]  # facts on the tiles, and the sets, by their names


def tile_scene(
    geometry: SocketGeometry,
    sets: Mapping[str, Mapping[str, TileValues]],
    description: str,
    surface: trimesh.Trimesh | None = None,
) -> Scene:
    """A scene with the tiles in the colours of values that the page's reader chooses.

    Args:
        geometry: The socket.
        sets: Values by what they are of, and there by what they are; the first are shown first.
        description: What is to be seen, in words.
        surface: The interior surface in {S} [m]; None where it is not known.
    """
    first = next(iter(next(iter(sets.values())).values()))
    if surface is None:
        rows = {split_unit(first.title)[0]: np.atleast_2d(first.values)[0]}
        still = tile_map_figure(geometry, rows, first.title)
    else:
        still = socket_figure(geometry, surface)
    return Scene(
        description=description,
        figure=_figure(geometry, surface),
        viewer=_viewer(),
        still=svg_of(still),
        choices=[*sets],
        values={
            "names": _tile_facts(geometry),
            "sets": {
                source: {name: values.document(geometry) for name, values in of_source.items()}
                for source, of_source in sets.items()
            },
        },
    )


def socket_page(
    surface: trimesh.Trimesh,
    geometry: SocketGeometry,
    path: Path,
    title: str,
    facts: Sequence[tuple[str, str]],
) -> None:
    """Write a page with the interior surface of a socket in {S} [m] and its tiles, in one file."""
    heights = 1e3 * socket_axis(geometry).heights(geometry.anchors)
    sets = {
        "tiles": {
            "area": TileValues("area [mm^2]", 1e6 * geometry.areas),
            "height": TileValues("height above the distal end [mm]", heights),
        }
    }
    described = "The interior surface of the socket with its tiles, in 3D"
    scene = tile_scene(geometry, sets, described, simplify(surface))
    parts = [scene, pairs_table("facts", "The socket and its tiles", facts)]
    page = render(title, "Lengths in mm in {S}, the frame of the load cell", [
        Section("socket", "The socket", parts)
    ])  # fmt: skip
    with atomic_output(path) as output:
        output.write_text(page, encoding="utf-8")


def simplify(surface: trimesh.Trimesh, most_faces: int = _MOST_FACES) -> trimesh.Trimesh:
    """Merge the vertices in each cell of a cubic grid, in cells that grow until it suffices.

    Vertex clustering (Rossignac and Borrel 1993, doi:10.1007/978-3-642-78114-8_29) needs no
    manifold, so it takes any scan.
    """
    cell = np.sqrt(2.0 * surface.area / most_faces)
    simplified = surface
    while len(simplified.faces) > most_faces:
        place = np.floor(surface.vertices / cell)
        merged = np.unique(place, axis=0, return_inverse=True)[1].ravel()
        sums = [np.bincount(merged, axis) for axis in surface.vertices.T]
        mean = np.column_stack(sums) / np.bincount(merged)[:, None]
        simplified = trimesh.Trimesh(mean, merged[surface.faces], process=False)
        simplified.update_faces(simplified.nondegenerate_faces())
        simplified.update_faces(simplified.unique_faces())
        cell *= _GROWTH
    return simplified


@cache
def _viewer() -> Markup:
    """plotly.js as it comes with plotly, compressed: the browser unpacks it."""
    return Markup(base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode())


def _figure(geometry: SocketGeometry, surface: trimesh.Trimesh | None) -> Markup:
    """Traces and layout of a scene as JSON in which every name is escaped.

    The first two traces are all tiles, to be filled on one colour scale that prints in grey, or
    left white: the page chooses which of them have a value.
    """
    colours = {"colorscale": SCALE, "colorbar": _COLOUR_BAR | {"title": {"side": "top"}}}
    covered = covered_tiles(geometry)
    outlines = tile_squares(geometry)[:, [0, 1, 2, 3, 0]]
    direction = proximal_direction(geometry)
    middle = geometry.anchors.mean(axis=0)
    top = middle + (((geometry.anchors - middle) @ direction).max() + 0.5 * _ARROW) * direction
    arrows = {name: (np.zeros(3), axis) for name, axis in zip("xyz", np.eye(3), strict=True)}
    colour_of = dict(zip("xyz", AXES, strict=True)) | {"proximal": PROXIMAL}
    traces = [
        _tiles(geometry, **colours),
        _tiles(geometry, color=NO_VALUE),
        _lines(outlines[~covered], EDGE, 3),
        _lines(outlines[covered], CLUSTER, 6),
        *(
            _lines(np.array([[start, start + _ARROW * way]]), colour_of[name], 6, f" {name}")
            for name, (start, way) in (arrows | {"proximal": (top, direction)}).items()
        ),
    ]
    if surface is not None:
        veil = {"color": VEIL, "opacity": 0.3, "hoverinfo": "skip"}
        traces.append(_mesh(surface.vertices, surface.faces, **veil))
    scene: dict[str, Any] = {
        f"{axis}axis": {"title": {"text": f"{axis} [mm]"}, **_AXIS} for axis in "xyz"
    }
    scene |= {
        "aspectmode": "data",
        "dragmode": "turntable",
        "domain": {"y": [_BELOW, 1.0]},
        "camera": _camera(traces),
        "annotations": _cluster_names(geometry),
    }
    layout = {
        "scene": scene,
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "showlegend": False,
        "font": {"family": FONT, "size": 13, "color": "#222222"},
        "paper_bgcolor": "rgba(0, 0, 0, 0)",
    }
    document = go.Figure(traces, {"template": "none", **layout}).to_json()
    return Markup(document.replace("<", "\\u003c"))


def _camera(traces: Sequence[Any]) -> dict[str, Any]:
    """A camera that sees everything, in the viewer's unit: the geometric mean of the edges."""
    drawn = np.hstack([[trace.x, trace.y, trace.z] for trace in traces])
    edges = np.nanmax(drawn, axis=1) - np.nanmin(drawn, axis=1)
    diagonal = np.linalg.norm(edges) / np.exp(np.log(edges).mean())
    return {
        name: dict(zip("xyz", (diagonal * place).tolist(), strict=True))
        for name, place in (("eye", _EYE), ("center", _CENTRE))
    }


def _cluster_names(geometry: SocketGeometry) -> list[dict[str, Any]]:
    """Annotations with the names of the clusters, each with an arrow to its tile."""
    look: dict[str, Any] = {"ax": 0, "ay": -32, "arrowhead": 6, "arrowsize": 0.7}
    look |= {"arrowwidth": 1.5, "borderpad": 2, "bordercolor": CLUSTER}
    look["bgcolor"] = "rgba(255, 255, 255, 0.85)"
    return [
        {**dict(zip("xyz", (1e3 * geometry.anchors[tile]).tolist(), strict=True)), **look}
        | {"text": _escape(name)}
        for name, tile in geometry.clusters.items()
    ]


def _tile_facts(geometry: SocketGeometry) -> list[str]:
    """Facts on each tile, shown under the pointer."""
    return [
        f"<b>{_escape(label)}</b><br>anchor {_vector(1e3 * geometry.anchors[tile], 1)} mm"
        f"<br>inward normal {_vector(geometry.rotations[tile, :, 2], 3)}"
        for tile, label in enumerate(tile_labels(geometry))
    ]


def _tiles(geometry: SocketGeometry, **paint: Any) -> go.Mesh3d:
    squares = tile_squares(geometry)
    points = np.concatenate([squares, geometry.anchors[:, None]], axis=1)
    return _mesh(
        points.reshape(-1, 3),
        (_FAN + 5 * np.arange(len(squares))[:, None, None]).reshape(-1, 3),
        **paint,
        lighting=_UNSHADED,
        hovertemplate="%{text}<extra></extra>",
        hoverlabel={"bgcolor": "white", "bordercolor": EDGE, "font": {"color": "black"}},
    )


def _lines(polylines: FloatArray, colour: str, width: int, name: str = "") -> go.Scatter3d:
    """Polylines of shape (m, k, 3) [m], with gaps between them; the last point has a name."""
    gaps = np.full((len(polylines), 1, 3), np.nan)
    points = np.concatenate([polylines, gaps], axis=1).reshape(-1, 3)[:-1]
    look: dict[str, Any] = {
        "line": {"color": colour, "width": width},
        "mode": "lines",
        "hoverinfo": "skip",
    }
    if name:
        text = [""] * (len(points) - 1) + [name]
        look |= {"mode": "lines+text", "text": text, "textfont": {"color": colour, "size": 16}}
    return go.Scatter3d(**_coordinates(points), **look)


def _mesh(points: FloatArray, faces: IntArray, **more: Any) -> go.Mesh3d:
    """Triangles between points, shape (m, 3) [m]."""
    corners = dict(zip("ijk", faces.astype(np.int32).T, strict=True))
    return go.Mesh3d(**_coordinates(points), **corners, **more)


def _coordinates(points: FloatArray) -> dict[str, FloatArray]:
    """Coordinates [mm] of points of shape (m, 3) [m]; single precision makes a page small."""
    return dict(zip("xyz", (1e3 * points).astype(np.float32).T, strict=True))


def _vector(components: FloatArray, decimals: int) -> str:
    return "(" + ", ".join(f"{c + 0.0:.{decimals}f}" for c in components) + ")"


def _escape(text: str) -> str:
    """Text that is no markup under the pointer, which knows no other entities."""
    return html.escape(text, quote=False)
