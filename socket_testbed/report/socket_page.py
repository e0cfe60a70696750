"""A page with the interior surface of a socket and its tiles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh

from socket_testbed.files import atomic_output
from socket_testbed.geometry.axis import socket_axis
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.pages.document import numbers, socket_document
from socket_testbed.report.page import Pictures, Section, render
from socket_testbed.tables import pairs_table

_MOST_FACES = 20_000  # of the surface on a page
_GROWTH = 1.1  # [-]; of the cells in which vertices are merged, from one attempt to the next


def write_socket_page(
    surface: trimesh.Trimesh,
    geometry: SocketGeometry,
    path: Path,
    title: str,
    facts: Sequence[tuple[str, str]],
) -> None:
    """Write a page with the interior surface of a socket in {S} [m] and its tiles, in one file."""
    heights = 1e3 * socket_axis(geometry).heights(geometry.anchors)
    seen = simplify(surface)
    data = {
        "socket": socket_document(geometry)
        | {"surface": {"points": numbers(1e3 * seen.vertices, 1), "faces": seen.faces.tolist()}},
        "moments": [{"time": 0.0, "words": f"{len(geometry)} tiles"}],
        "start": 0.0,
        "kinds": ["tiles"],
        "extras": {
            "area [mm^2]": {"values": numbers(1e6 * geometry.areas), "unit": "mm²"},
            "height [mm]": {"values": numbers(heights), "unit": "mm"},
        },
    }
    described = "The interior surface of the socket with its tiles"
    parts = [
        Pictures(described, has_mean=False, has_course=False),
        pairs_table("facts", "The socket and its tiles", facts),
    ]
    page = render(
        title,
        "lengths in mm in {S}, the frame of the load cell",
        {"": [Section("socket", "", parts)]},
        data,
    )
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
