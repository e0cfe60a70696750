"""A picture that turns under the mouse, for a page: axes, camera, buttons and the viewer itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.view.axes_of_s import AXIS_NAMES
from socket_testbed.view.traces import cluster_names

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif"
# The policy lets the browser load nothing at all; the viewer compiles its shaders' code.
POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline';"
    " script-src 'unsafe-inline' 'unsafe-eval'"
)

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


def scene_html(
    traces: Sequence[Any],
    geometry: SocketGeometry,
    name: str,
    domain: Mapping[str, Any] | None = None,
    legend: Mapping[str, Any] | None = None,
) -> str:
    """The HTML of a scene in {S}, in mm, with the viewer inlined.

    Args:
        traces: What is drawn.
        geometry: The socket, whose clusters are named.
        name: Its id in the page.
        domain: Which part of the picture the scene takes; None for all of it.
        legend: Where the legend is; None for none.
    """
    scene: dict[str, Any] = {
        f"{axis}axis": {"title": {"text": f"{axis} [mm]"}, **_AXIS} for axis in AXIS_NAMES
    }
    scene |= {
        "aspectmode": "data",
        "domain": domain or {},
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
    return go.Figure([*traces], layout).to_html(
        full_html=False,
        include_plotlyjs=True,
        div_id=name,
        config={"responsive": True, "displaylogo": False, "modeBarButtons": [_BUTTONS]},
    )


def _camera(traces: Sequence[Any]) -> dict[str, Any]:
    """A camera that sees everything, in the viewer's unit: the geometric mean of the edges."""
    drawn = np.hstack([[trace.x, trace.y, trace.z] for trace in traces])
    edges = np.nanmax(drawn, axis=1) - np.nanmin(drawn, axis=1)
    diagonal = np.linalg.norm(edges) / np.exp(np.log(edges).mean())
    return {
        name: dict(zip(AXIS_NAMES, (diagonal * place).tolist(), strict=True))
        for name, place in (("eye", _EYE), ("center", _CENTRE))
    }
