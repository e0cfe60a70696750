"""Sockets side by side: sizes, regions, and how far apart their tiles are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from socket_testbed.comparison.table import Compared, Comparison, joined, texts_table
from socket_testbed.geometry.axis import socket_axis
from socket_testbed.geometry.regions import all_regions
from socket_testbed.geometry.socket import SocketGeometry

_FAR = "distance to the first [mm]"


def compare_sockets(sockets: Sequence[SocketGeometry], names: tuple[str, ...]) -> Comparison:
    """Lay sockets side by side.

    Args:
        sockets: The sockets.
        names: What they are called.
    """
    first = sockets[0]
    alike = all(socket.same_tiles(first) for socket in sockets)
    notes = ["all have the same tiles at the same places"] if alike else []
    parts = [
        *_sizes(sockets),
        *_areas(sockets),
        *_apart("clusters", sockets, [socket.clusters for socket in sockets]),
        *_apart("tiles", sockets, [{n: i for i, n in enumerate(s.names)} for s in sockets]),
    ]
    texts = {
        "source": [socket.source or "not stated" for socket in sockets],
        "registration": [socket.registration or "none: nominal" for socket in sockets],
        "clusters": [
            ", ".join(f"{n} on {s.names[i]}" for n, i in s.clusters.items()) or "none"
            for s in sockets
        ],
    }
    return Comparison(
        kind="sockets",
        items=names,
        title=f"tiles, areas, regions and clusters of {len(sockets)} sockets",
        notes=tuple(notes),
        table=joined(
            [texts_table("sockets", texts, names), *(part.to_dataframe(names) for part in parts)]
        ),
    )


def _sizes(sockets: Sequence[SocketGeometry]) -> list[Compared]:
    """Numbers of the sockets as such."""
    nearest = [
        np.linalg.norm(s.anchors[:, None] - sockets[0].anchors, axis=2).min(axis=1) for s in sockets
    ]
    figures = {
        "tiles [1]": [len(s) for s in sockets],
        "clusters [1]": [len(s.clusters) for s in sockets],
        "area [cm^2]": [1e4 * s.areas.sum() for s in sockets],
        "mean area of a tile [cm^2]": [1e4 * s.areas.mean() for s in sockets],
        "height of the tiles' centres [mm]": [
            1e3 * np.ptp(socket_axis(s).heights(s.anchors)) for s in sockets
        ],
    }
    apart = {
        "mean distance to the nearest tile of the first [mm]": [1e3 * d.mean() for d in nearest],
        "largest distance to the nearest tile of the first [mm]": [1e3 * d.max() for d in nearest],
    }
    return [
        Compared.plain("sizes", ["socket"], title, np.array(values, dtype=float)[:, None], relative)
        for of_kind, relative in ((figures, False), (apart, True))
        for title, values in of_kind.items()
    ]


def _areas(sockets: Sequence[SocketGeometry]) -> list[Compared]:
    """Tiles and area of every region that one of the sockets has."""
    regions = [{region.name: region.tiles for region in all_regions(s)} for s in sockets]
    names = list(dict.fromkeys(name for of_socket in regions for name in of_socket))
    nothing = np.zeros(0, dtype=np.int64)
    tiles = [[of_socket.get(name, nothing) for name in names] for of_socket in regions]
    counts = np.array([[len(t) for t in of_socket] for of_socket in tiles], dtype=float)
    areas = [
        [1e4 * s.areas[t].sum() for t in of_socket]
        for s, of_socket in zip(sockets, tiles, strict=True)
    ]
    return [
        Compared.plain("regions", names, "tiles [1]", counts),
        Compared.plain("regions", names, "area [cm^2]", np.array(areas)),
    ]


def _apart(
    part: str, sockets: Sequence[SocketGeometry], places: Sequence[Mapping[str, int]]
) -> list[Compared]:
    """Area of what all sockets have by name, and where it is against the first's."""
    names = [name for name in places[0] if all(name in others for others in places)]
    if not names:
        return []
    tiles = [[of_socket[name] for name in names] for of_socket in places]
    first, at = sockets[0], tiles[0]
    distance, angle, area = [], [], []
    for socket, chosen in zip(sockets, tiles, strict=True):
        apart = socket.anchors[chosen] - first.anchors[at]
        distance.append(1e3 * np.linalg.norm(apart, axis=1))
        along = (socket.rotations[chosen, :, 2] * first.rotations[at, :, 2]).sum(axis=1)
        angle.append(np.degrees(np.arccos(np.clip(along, -1.0, 1.0))))
        area.append(1e4 * socket.areas[chosen])
    return [
        Compared.plain(part, names, "area [cm^2]", np.array(area)),
        Compared.plain(part, names, _FAR, np.array(distance), is_relative=True),
        Compared.plain(part, names, "angle to the first [deg]", np.array(angle), is_relative=True),
    ]
