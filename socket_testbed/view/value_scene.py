"""Values of the tiles in 3D, one set of them at a time, for a page; lengths in mm in {S}."""

from __future__ import annotations

import html
from collections.abc import Mapping
from dataclasses import dataclass

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.view.axes_of_s import place_axes
from socket_testbed.view.scene import scene_html
from socket_testbed.view.squares import tile_squares
from socket_testbed.view.traces import axes_traces, proximal_traces, tile_traces

SCENE_ID = "scene"

# Beside a narrow scene there is no room for it.
_COLOUR_BAR = {"orientation": "h", "y": 0.0, "yanchor": "bottom", "thickness": 12, "len": 0.8}
_SCENE_ABOVE = [0.15, 1.0]  # [-]; of the height


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
    geometry: SocketGeometry, values: Mapping[str, tuple[FloatArray, str]]
) -> ValueScene:
    """A scene with the tiles in the colours of the first set of values.

    Args:
        geometry: The socket.
        values: One value a tile, shape (n,), NaN where there is none, and what they are
            with their unit, by a key.

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
    picture = scene_html(traces, geometry, SCENE_ID, domain={"y": _SCENE_ABOVE})
    return ValueScene(picture, visible)
