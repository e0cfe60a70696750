"""What the page shows, as plain data for JSON: the socket, a moment, a course, regions, cards.

Pressures are in kPa, lengths in mm; what is not known is null.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.axis import (
    UNMEASURED,
    Region,
    Side,
    proximal_direction,
    socket_axis,
    wall_tiles,
)
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import HEIGHTS, PARTS_OF_SECTORS, SOCKET, SocketGeometry
from socket_testbed.identification.data_check import Finding
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.pressure import Quantity, RegionOutputs, read_column
from socket_testbed.pages.wall import patches
from socket_testbed.samples import Samples

BARS = ("mean pressure [kPa]", "peak pressure [kPa]", "share of load [%]", "shear [kPa]")
"""Outputs that are drawn as bars."""
_MOST_MARKS = 20
_WEIGHT = 1.0 / 8192.0  # [-]; unit of the stored weights
_SIDES = {"left": ("lateral", "medial"), "right": ("medial", "lateral"), None: ("left", "right")}
# Corners of a square of edge 1, counter-clockwise about the inward normal, and closed.
_SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0]]) / 2.0

Document = dict[str, Any]


def numbers(values: FloatArray, decimals: int = 2) -> list[Any]:
    """Numbers of any shape for JSON, null for those that are not finite."""
    rounded = np.round(np.asarray(values, dtype=np.float64), decimals).astype(object)
    rounded[~np.isfinite(np.asarray(values, dtype=np.float64))] = None
    return list(rounded.tolist())


def socket_document(geometry: SocketGeometry, side: Side | None = None) -> Document:
    """The socket: its surface on grids, its tiles, its clusters and what its parts are called."""
    around = socket_axis(geometry)
    squares = Pose(geometry.square_frames()[:, None], geometry.anchors[:, None]).apply(
        np.sqrt(geometry.areas)[:, None, None] * _SQUARE
    )
    on_wall = wall_tiles(geometry, around)
    places = np.column_stack(
        [np.degrees(around.angles(geometry.anchors)), 1e3 * around.heights(geometry.anchors)]
    )
    corners = np.stack([around.angles(squares), 1e3 * around.heights(squares)], axis=-1)
    turned = np.degrees(corners[..., 0]) - places[:, :1]
    corners[..., 0] = places[:, :1] + (turned + 180.0) % 360.0 - 180.0
    flat = np.array([-around.left, around.anterior])
    places[~on_wall] = 1e3 * (geometry.anchors[~on_wall] - around.end) @ flat.T
    corners[~on_wall] = 1e3 * (squares[~on_wall] - around.end) @ flat.T
    left, right = _SIDES[side]
    return {
        "names": geometry.names,
        "clusters": dict(geometry.clusters),
        "on_wall": on_wall.tolist(),
        "places": numbers(places, 1),
        "corners": numbers(corners, 1),
        "squares": numbers(1e3 * squares, 1),
        "sides": ["posterior", right, "anterior", left, "posterior"],
        "heights": list(reversed(HEIGHTS)),
        "proximal": numbers(around.proximal, 4),
        "regions": {name: list(map(int, tiles)) for name, tiles in geometry.regions.items()},
        "patches": [
            {
                "name": patch.name,
                "x": numbers(patch.x, 1),
                "y": numbers(patch.y, 1),
                "points": numbers(1e3 * patch.points, 1),
                "weights": _packed(patch.weights),
            }
            for patch in patches(geometry)
        ],
    }


def _packed(weights: FloatArray) -> str:
    """Weights as 16 bit integers of `_WEIGHT`, little-endian, in base64."""
    return base64.b64encode((weights / _WEIGHT).round().astype("<i2").tobytes()).decode()


def moment(
    time: float,
    pressure: FloatArray,
    deviation: FloatArray,
    shear: FloatArray,
    measured: FloatArray,
) -> Document:
    """The tiles at a time [s], shape (n,) [Pa], and what the clusters measured, (c,) [Pa]."""
    return {
        "time": round(time, 3),
        "pressure": numbers(1e-3 * pressure),
        "deviation": numbers(1e-3 * deviation),
        "shear": numbers(1e-3 * shear),
        "measured": numbers(1e-3 * measured, 1),
    }


def moments(
    time: FloatArray, estimate: MapEstimate, samples: Samples, geometry: SocketGeometry
) -> list[Document]:
    """The map at N times [s], and what the clusters measured."""
    measured = measured_pressure(samples, geometry)
    return [
        moment(
            float(at),
            estimate.normal_pressure[row],
            estimate.normal_pressure_standard_deviation[row],
            estimate.shear[row],
            measured[row],
        )
        for row, at in enumerate(time)
    ]


def measured_pressure(samples: Samples, geometry: SocketGeometry) -> FloatArray:
    """Pressure that every cluster of the socket measured, NaN where it did not, (N, c) [Pa]."""
    found = np.full((len(samples), len(geometry.clusters)), np.nan)
    for column, (name, tile) in enumerate(geometry.clusters.items()):
        if name in samples.clusters:
            forces = samples.trusted_forces[:, samples.clusters.index(name), 2]
            found[:, column] = -forces / geometry.areas[tile]
    return found


def axial_force(samples: Samples, geometry: SocketGeometry) -> FloatArray:
    """Compressive force along the socket, shape (N,) [N]."""
    return np.asarray(-samples.wrench[:, 3:] @ proximal_direction(geometry))


def course(
    time: FloatArray, force: FloatArray, peak: Quantity, events: Iterable[tuple[float, str]]
) -> Document:
    """Force along the socket (N,) [N] and the socket's peak pressure (N,) [Pa] over time [s].

    Events of a label that is there too often, such as steps, are no marks.
    """
    listed = [*events]
    often = Counter(label for _, label in listed)
    return {
        "time": numbers(time, 3),
        "force": numbers(force, 1),
        "peak": numbers(1e-3 * peak.value),
        "low": numbers(1e-3 * peak.low),
        "high": numbers(1e-3 * peak.high),
        "events": [{"time": at, "label": of} for at, of in listed if often[of] <= _MOST_MARKS],
    }


def bars(places: Sequence[Region], outputs: RegionOutputs) -> Document:
    """Outputs of the regions with their 95 % intervals, by their titles, less parts of sectors."""
    shown = [i for i, place in enumerate(places) if place.name not in PARTS_OF_SECTORS]
    found = {}
    for title in BARS:
        of = read_column(outputs, title)
        columns = (of.value, of.low, of.high)
        found[title] = numbers(np.stack(columns, axis=-1)[shown], 1)
    return {"regions": [places[i].name for i in shown], "values": found}


def cards(
    geometry: SocketGeometry,
    places: Sequence[Region],
    outputs: RegionOutputs,
    pressure: FloatArray,
    data: Document,
) -> list[Document]:
    """The three cards: the peak, the highest pressure where nothing is measured, the data.

    Args:
        geometry: The socket.
        places: Its R regions.
        outputs: Their outputs.
        pressure: Pressure on the tiles at the peak, shape (n,) [Pa].
        data: The third card, see `data_card`.
    """
    clusters = {tile: name for name, tile in geometry.clusters.items()}
    names = [place.name for place in places]
    peak = int(pressure.argmax())
    how = f"measured by {clusters[peak]}" if peak in clusters else "estimated"
    words = f"{part_of(places, peak)}, {how}"
    found = [_card("Peak", outputs.peak, names.index(SOCKET), words)]
    if UNMEASURED in names:
        row = names.index(UNMEASURED)
        bare = places[row].tiles
        words = f"highest where no sensor is: {part_of(places, int(bare[pressure[bare].argmax()]))}"
        found.append(_card("Elsewhere", outputs.peak, row, words))
    return [*found, data]


def _card(title: str, of: Quantity, row: int, words: str) -> Document:
    value, low, high = (f"{1e-3 * ends[row]:.1f}" for ends in (of.value, of.low, of.high))
    return {
        "title": title,
        "value": f"{value} kPa",
        "interval": f"{low} to {high}",
        "words": words,
    }


def data_card(findings: Sequence[Finding]) -> Document:
    """The card of a trial's data."""
    if not findings:
        return {"title": "Data", "value": "good", "words": "nothing implausible in any source"}
    first, more = findings[0], len(findings) - 1
    words = f"{first.fact}; {first.hint}" + f" (and {more} more)" * bool(more)
    return {"title": "Data", "value": f"look at {first.source}", "words": words, "bad": True}


def part_of(places: Sequence[Region], tile: int) -> str:
    """The smallest anatomical region of a tile, in words."""
    inside = [p for p in places if tile in p.tiles and p.name not in (SOCKET, UNMEASURED)]
    return min(inside, key=lambda place: len(place.tiles)).name if inside else SOCKET
