"""A page that shows a socket with its tiles, to be turned with the mouse; it needs no network."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from string import Template

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.files import whole_output
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.view.axes_of_s import drawn_bounds, place_axes
from socket_testbed.view.scene import FONT, POLICY, scene_html
from socket_testbed.view.surface import Surface, drawable_surface
from socket_testbed.view.traces import (
    axes_traces,
    neighbour_trace,
    proximal_traces,
    surface_trace,
    tile_traces,
)

_MOST_FACES = 60_000

_PAGE = Template("""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="$policy">
<title>$title</title>
<style>
body { margin: 0 auto; padding: 1rem; max-width: 100rem; font: 1rem/1.45 $font;
  color: #222; background: #fff; }
h1 { margin: 0 0 0.75rem; font-size: 1.35rem; overflow-wrap: anywhere; }
p { margin: 0.75rem 0 0; font-size: 0.9rem; color: #555; }
table { border-collapse: collapse; width: 100%; font-size: 0.95rem; }
th, td { padding: 0.3rem 0.75rem 0.3rem 0; border-bottom: 1px solid #ddd; text-align: left;
  vertical-align: top; overflow-wrap: anywhere; font-variant-numeric: tabular-nums; }
th { font-weight: 600; white-space: nowrap; }
#scene { height: min(75vh, 140vw); min-height: 26rem; }
@media (min-width: 60rem) {
  main { display: grid; grid-template-columns: 20rem 1fr; gap: 1.5rem; }
  #scene { height: calc(100vh - 5.5rem); }
}
</style>
</head>
<body>
<h1>$title</h1>
<main>
<section>
<table>
$facts
</table>
<p>Drag to turn, scroll or pinch to zoom; point at a tile for its name, anchor, area and normal.
Choose in the legend what is shown. Lengths are in mm in {S}, the frame of the load cell.</p>
</section>
<div id="scene">$scene</div>
</main>
</body>
</html>
""")


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
    page = _PAGE.substitute(
        title=html.escape(title),
        font=FONT,
        policy=POLICY,
        facts="\n".join(
            f'<tr><th scope="row">{html.escape(name)}</th><td>{html.escape(value)}</td></tr>'
            for name, value in facts
        ),
        scene=_scene(surface, geometry),
    )
    with whole_output(path) as output:
        output.write_text(page, encoding="utf-8")


def _scene(surface: Surface, geometry: SocketGeometry) -> str:
    """The turning picture with the viewer itself, as HTML."""
    low, high = drawn_bounds(surface, geometry)
    axes = place_axes(low, high)
    traces = [
        surface_trace(surface),
        *tile_traces(geometry),
        neighbour_trace(geometry),
        *axes_traces(axes),
        *proximal_traces(geometry, axes.length),
    ]
    legend = {"orientation": "h", "yref": "container", "y": 0, "yanchor": "bottom"}
    return scene_html(traces, geometry, "socket", legend=legend)
