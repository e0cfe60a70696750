"""Values of the tiles in 3D, one set of them at a time, for a page; lengths in mm in {S}."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.view.axes_of_s import AXIS_NAMES, place_axes
from socket_testbed.view.squares import tile_squares
from socket_testbed.view.traces import axes_traces, cluster_names, proximal_traces, tile_traces

SCENE_ID = "scene"

_EYE = np.array([1.1, 0.86, 0.3])  # of the diagonal: anterior, left and above
_CENTRE = np.array([0.0, 0.0, -0.06])  # likewise: the nearest edge of the box hangs lowest
# Beside a narrow scene there is no room for it.
_COLOUR_BAR = {"orientation": "h", "y": 0.0, "yanchor": "bottom", "thickness": 12, "len": 0.8}
_SCENE_ABOVE = [0.15, 1.0]  # [-]; of the height
_BUTTONS = ["toImage", "zoom3d", "pan3d", "orbitRotation", "resetCameraDefault3d"]


@dataclass(frozen=True)
class ValueScene:
    """A picture that turns under the mouse, and which of its traces show what.

    Attributes:
        html: The picture with the viewer itself.
        visible: For each set of values by its key, whether each trace is shown.
    """

    html: str
    visible: dict[str, list[bool]]


def value_scene(
    geometry: SocketGeometry, values: Mapping[str, tuple[FloatArray, str]], font: str
) -> ValueScene:
    """A scene with the tiles in the colours of the first set of values.

    Args:
        geometry: The socket.
        values: One value a tile, shape (n,), NaN where there is none, and what they are
            with their unit, by a key.
        font: Families of the letters, as in CSS.

    Raises:
        ConfigurationError: If the values are not those of these tiles.
    """
    corners = tile_squares(geometry).reshape(-1, 3)
    axes = place_axes(corners.min(axis=0), corners.max(axis=0))
    shared = [*axes_traces(axes), *proximal_traces(geometry, axes.length)]
    traces, owner = list(shared), [""] * len(shared)
    for key, (tiles, unit) in values.items():
        own = tile_traces(geometry, tiles, unit)
        for trace in own:
            if getattr(trace, "intensity", None) is not None:
                trace.colorbar = _COLOUR_BAR | {
                    "title": {"text": html.escape(unit, quote=False), "side": "top"}
                }
        traces += own
        owner += [key] * len(own)
    visible = {key: [name in ("", key) for name in owner] for key in values}
    for trace, shown in zip(traces, visible[next(iter(values))], strict=True):
        trace.visible = shown
    figure = go.Figure(traces, _layout(traces, geometry, font))
    picture = figure.to_html(
        full_html=False,
        include_plotlyjs=True,
        div_id=SCENE_ID,
        config={"responsive": True, "displaylogo": False, "modeBarButtons": [_BUTTONS]},
    )
    return ValueScene(picture, visible)


def _layout(traces: Sequence[Any], geometry: SocketGeometry, font: str) -> dict[str, Any]:
    scene: dict[str, Any] = {
        f"{name}axis": {
            "title": {"text": f"{name} [mm]"},
            "backgroundcolor": "white",
            "gridcolor": "#DDDDDD",
            "zerolinecolor": "#999999",
            "showspikes": False,
        }
        for name in AXIS_NAMES
    }
    scene |= {
        "aspectmode": "data",
        "domain": {"y": _SCENE_ABOVE},
        "camera": _camera(traces),
        "annotations": cluster_names(geometry),
    }
    return {
        "scene": scene,
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "showlegend": False,
        "font": {"family": font, "size": 13},
        "paper_bgcolor": "white",
    }


def _camera(traces: Sequence[Any]) -> dict[str, Any]:
    """A camera that sees everything, in the viewer's unit: the geometric mean of the edges."""
    drawn = np.hstack([[trace.x, trace.y, trace.z] for trace in traces])
    edges = np.nanmax(drawn, axis=1) - np.nanmin(drawn, axis=1)
    diagonal = np.linalg.norm(edges) / np.exp(np.log(edges).mean())
    return {
        name: dict(zip(AXIS_NAMES, (diagonal * place).tolist(), strict=True))
        for name, place in (("eye", _EYE), ("center", _CENTRE))
    }
