"""Page contents as plain data for JSON: the socket, a moment, a course, regions, cards.

Pressures are in kPa, lengths in mm; unknown values are null.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.errors import first_of
from socket_testbed.figures.scale import GREY, POWER
from socket_testbed.figures.wall import Patch, patches, side_names, unrolled_tiles
from socket_testbed.geometry.regions import (
    SECTOR_EDGES,
    Region,
    place_of,
    third_edges,
)
from socket_testbed.geometry.socket import (
    HEIGHTS,
    SECTOR_PARTS,
    SOCKET,
    UNMEASURED,
    SocketGeometry,
)
from socket_testbed.identification.data_finding import DataFinding
from socket_testbed.identification.pressure import (
    Quantity,
    RegionOutputs,
    decimals_of,
    greyness,
    read_column,
)
from socket_testbed.results.pressure_text import interval, number
from socket_testbed.results.stresses import Stresses, TrialCourse
from socket_testbed.samples import WRENCH_CHANNELS, channel_unit
from socket_testbed.settings.options import Side
from socket_testbed.trials.events import Event

_PEAK, _INTEGRAL = "peak pressure [kPa]", "pressure-time integral [kPa s]"
_BAR_TITLES = (
    "mean pressure [kPa]",
    _PEAK,
    "contact area [cm^2]",
    _INTEGRAL,
    "share of load [%]",
    "shear [kPa]",
)
_MAX_MARKS = 20  # per event label
_UNIT = 1.0 / 8192.0  # [-]; unit of the stored weights, 16-bit integers
_CLOSED = [0, 1, 2, 3, 0]  # corners of a square

_NOTHING: Mapping[str, Quantity] = {}

Document = dict[str, Any]


def numbers(values: FloatArray, decimals: int = 2) -> list[Any]:
    """Numbers for JSON, as nested lists.

    Args:
        values: Numbers of any shape with at least one axis.
        decimals: Decimals to round to.

    Returns:
        Lists nested like the axes of the values, None where a value is not finite.
    """
    rounded = np.round(np.asarray(values, dtype=np.float64), decimals).astype(object)
    rounded[~np.isfinite(np.asarray(values, dtype=np.float64))] = None
    return list(rounded.tolist())


def socket_document(geometry: SocketGeometry, side: Side | None = None) -> Document:
    """The socket: surface grids, tiles, clusters and names of its parts.

    Args:
        geometry: The socket of n tiles.
        side: The leg, which turns left and right into medial and lateral; None if unknown.

    Returns:
        `names` of the tiles and `clusters` (tile index by name); `on_wall`, `places` (n, 2) and
        closed `corners` (n, 5, 2) as in `UnrolledTiles` [deg, mm], `squares` (n, 5, 3) in {S} [mm];
        `sides`, the directions from -180 to 180 degrees; `sectors`, the borders of the sectors
        [deg]; `heights`, from distal to proximal, and `thirds`, the edges of these [mm];
        `proximal`, a unit vector in {S}; the user's `regions`; the colour scale; and `patches`.
    """
    tiles = unrolled_tiles(geometry)
    return {
        "names": geometry.names,
        "clusters": dict(geometry.clusters),
        "on_wall": tiles.on_wall.tolist(),
        "places": numbers(tiles.places, 1),
        "corners": numbers(tiles.corners[:, _CLOSED], 1),
        "squares": numbers(1e3 * tiles.squares[:, _CLOSED], 1),
        "sides": side_names(side),
        "sectors": SECTOR_EDGES,
        "heights": list(reversed(HEIGHTS)),
        "thirds": numbers(1e3 * third_edges(geometry), 1),
        "proximal": numbers(tiles.around.proximal, 4),
        "regions": {name: list(map(int, tiles)) for name, tiles in geometry.regions.items()},
        "grey": GREY,
        "power": POWER,
        "patches": [_patch(patch) for patch in patches(geometry)],
    }


def _patch(patch: Patch) -> Document:
    """A grid of the surface [deg, mm]; its weights are 16-bit integers of a `unit`, in base 64."""
    weights = (patch.weights / _UNIT).round().astype("<i2")
    return {
        "name": patch.name,
        "x": numbers(patch.x, 1),
        "y": numbers(patch.y, 1),
        "points": numbers(1e3 * patch.points, 1),
        "unit": _UNIT,
        "weights": base64.b64encode(weights.tobytes()).decode(),
    }


def moment(
    time: float,
    pressure: FloatArray,
    reach: FloatArray,
    shear: FloatArray,
    measured: FloatArray,
    grey: FloatArray | None = None,
    arrows: FloatArray | None = None,
) -> Document:
    """Stresses on n tiles and measured pressures of c clusters at a time, in kPa for the page.

    Args:
        time: Time since the first sample [s].
        pressure: Normal pressure on the tiles, positive in compression, shape (n,) [Pa].
        reach: Half-widths of its 95 % intervals, shape (n,) [Pa].
        shear: Magnitude of the shear on the tiles, shape (n,) [Pa]; empty if it is not shown.
        measured: Measured normal pressure of the clusters, shape (c,) [Pa], NaN where missing;
            empty if it is not shown.
        grey: How grey each tile is drawn, 0 (full colour) to 1, shape (n,) [-]; by default the
            `greyness` of its pressure.
        arrows: Shear on the tiles towards right and up, see `shear_arrows`, shape (n, 2) [Pa]; None
            if it is not shown.

    Returns:
        The keys `time` [s], `pressure`, `reach`, `shear`, `measured` and, if given, `arrows` [kPa],
        and `grey` [-], None where unknown.
    """
    found = {
        "time": round(time, 3),
        "pressure": numbers(1e-3 * pressure, 4),  # the page rounds to one decimal
        "reach": numbers(1e-3 * reach),
        "grey": numbers(greyness(pressure, reach) if grey is None else grey),
        "shear": numbers(1e-3 * shear),
        "measured": numbers(1e-3 * measured, 1),
    }
    return found if arrows is None else found | {"arrows": numbers(1e-3 * arrows)}


def shear_arrows(geometry: SocketGeometry, forces: FloatArray) -> FloatArray:
    """Shear on the tiles as vectors on the page, towards right and up, shape (..., n, 2) [Pa].

    Args:
        geometry: The socket of n tiles.
        forces: Forces on the tiles in {S}, shape (..., n, 3) [N].
    """
    return np.asarray(np.einsum("nai,...ni->...na", arrow_map(geometry), forces))


def arrow_map(geometry: SocketGeometry) -> FloatArray:
    """From forces on the n tiles in {S} to `shear_arrows`, shape (n, 2, 3) [1/m^2]."""
    return np.asarray(unrolled_tiles(geometry).directions / geometry.areas[:, None, None])


def moments(stresses: Stresses, geometry: SocketGeometry) -> list[Document]:
    """A `moment` for each of K moments.

    Args:
        stresses: Stresses at these moments.
        geometry: The socket.
    """
    found = stresses.pressure, stresses.reach, stresses.shear, stresses.measured
    arrows = shear_arrows(geometry, stresses.forces)
    rows = zip(stresses.time.tolist(), *found, strict=True)
    return [moment(*row, None, along) for row, along in zip(rows, arrows, strict=True)]


def wrench_rows(measured: FloatArray, predicted: FloatArray) -> list[list[str]]:
    """Rows of a table of two wrenches, the first one its heading.

    Args:
        measured: Measured wrench [M; F] in {S}, shape (6,) [N m, N]; NaN where missing.
        predicted: Wrench [M; F] in {S} predicted by a model, shape (6,) [N m, N]; NaN without one.

    Returns:
        Rows of the channel with its unit, the measured and the predicted value, as texts with two
        decimals, `none` for NaN.
    """
    rows = [["", "measured", "predicted"]]
    for name, *values in zip(WRENCH_CHANNELS, measured.tolist(), predicted.tolist(), strict=True):
        shown = [f"{value:.2f}" if np.isfinite(value) else "none" for value in values]
        rows.append([f"{name} [{channel_unit(name)}]", *shown])
    return rows


def trial_document(
    geometry: SocketGeometry, side: Side | None, events: Iterable[Event], found: TrialCourse
) -> Document:
    """The socket of a trial, and its course.

    Args:
        geometry: The socket.
        side: The leg; None if unknown.
        events: The events of the trial.
        found: The course of the trial.

    Returns:
        `socket` as in `socket_document` and `course` as in `course`.
    """
    marks = [(event.time, event.label) for event in events]
    return {
        "socket": socket_document(geometry, side),
        "course": course(found.stresses.time, found.force, found.peak, marks),
    }


def course(
    time: FloatArray, force: FloatArray, peak: Quantity, events: Iterable[tuple[float, str]]
) -> Document:
    """Force along the socket and peak pressure of the socket over time.

    Args:
        time: Times of N samples since the first one of the trial, ascending, shape (N,) [s].
        force: Force of the limb along the socket, positive under load, shape (N,) [N].
        peak: Highest pressure of a tile with its 95 % interval, shape (N,) [Pa].
        events: Times [s] and labels of events; a label with more than 20, such as steps, is left
            out.

    Returns:
        `time` [s], `force` [N], `peak` with `low` and `high` [kPa], and `events` with `time` [s]
        and `label`; None where unknown.
    """
    listed = [*events]
    counts = Counter(label for _, label in listed)
    return {
        "time": numbers(time, 3),
        "force": numbers(force, 1),
        "peak": numbers(1e-3 * peak.value),
        "low": numbers(1e-3 * peak.low),
        "high": numbers(1e-3 * peak.high),
        "events": [{"time": t, "label": name} for t, name in listed if counts[name] <= _MAX_MARKS],
    }


def bars(
    places: Sequence[Region], outputs: RegionOutputs, integrals: Mapping[str, Quantity] = _NOTHING
) -> Document:
    """Outputs of the regions except parts of sectors, with 95 % intervals, by title.

    An output that is unknown in all regions is left out, such as the integral at an instant.

    Args:
        places: The R regions.
        outputs: Outputs of these regions, shape (R,).
        integrals: Pressure-time integrals over other spans, shape (R,) [Pa s], by title in kPa s.

    Returns:
        `regions`, the r names shown; `values`, by title with the unit, such as `shear [kPa]`, lists
        of value, low and high, (r, 3); and `decimals` to show, by title.
    """
    shown = [i for i, place in enumerate(places) if place.name not in SECTOR_PARTS]
    found = {title: read_column(outputs, title) for title in _BAR_TITLES}
    found |= {title: quantity.part(..., 1e-3) for title, quantity in integrals.items()}
    values = {
        title: numbers(np.stack([output.value, output.low, output.high], axis=-1)[shown], 6)
        for title, output in found.items()
        if np.isfinite(output.value).any()
    }
    decimals = {title: decimals_of(_INTEGRAL if title in integrals else title) for title in values}
    return {"regions": [places[i].name for i in shown], "values": values, "decimals": decimals}


def cards(
    geometry: SocketGeometry,
    places: Sequence[Region],
    outputs: RegionOutputs,
    pressure: FloatArray,
    measured: FloatArray,
    when: str = "",
    span: str = "",
) -> list[Document]:
    """Cards of the peak, and of the highest pressure away from sensors.

    Args:
        geometry: The socket of n tiles and c clusters.
        places: The R regions, the socket among them.
        outputs: Outputs of these regions, shape (R,).
        pressure: Normal pressure on the tiles, at an instant or the highest of each over the span
            of the outputs, shape (n,) [Pa].
        measured: Measured pressure of the clusters at the peak, in the order of
            `geometry.clusters`, shape (c,) [Pa]; NaN where missing.
        when: Words that end the titles, such as ` at this moment`.
        span: The span of the peak, in words that end its card, such as `in the hold`.

    Returns:
        Cards as in `pressure_card`; the second one only if a tile has no cluster.
    """
    names = [place.name for place in places]
    top = int(pressure.argmax())
    known = zip(geometry.clusters.items(), np.isfinite(measured), strict=True)
    seen = {tile: cluster for (cluster, tile), is_known in known if is_known}
    source = f"measured by {seen[top]}" if top in seen else "estimated"
    words = f"{place_of(geometry, places, top)}, {source}"
    shown = [("Peak", SOCKET, f"{words}, {span}" if span else words)]
    if UNMEASURED in names:
        bare = places[names.index(UNMEASURED)].tiles
        where = place_of(geometry, places, int(bare[pressure[bare].argmax()]))
        shown.append(("Elsewhere", UNMEASURED, f"highest where no sensor is: {where}"))
    found = []
    for title, name, words in shown:
        peak = outputs.peak.part(names.index(name), 1e-3)
        found.append(pressure_card(title + when, peak.value, peak.low, peak.high, words))
    return found


def pressure_card(
    title: str, value: Any, low: Any, high: Any, words: str, sign: str = "-"
) -> Document:
    """Card of a pressure or of a difference, with its interval.

    Args:
        title: Heading of the card.
        value: The pressure or difference [kPa].
        low: Lower end of its 95 % interval [kPa].
        high: Upper end of its 95 % interval [kPa].
        words: A line below the number.
        sign: `+` to show the sign of a positive value, `-` not to.

    Returns:
        The texts `title`, `value`, `interval` and `words`.
    """
    shown = number(_PEAK, value, sign)
    ends = interval(_PEAK, low, high)
    return {"title": title, "value": f"{shown} kPa", "interval": ends, "words": words}


def check_card(findings: Sequence[DataFinding], notes: Sequence[str]) -> Document:
    """Card of the data check, with the notes on a good recording.

    Args:
        findings: Defects of the data, the worst first; empty for good data.
        notes: Notes on the recording; the first one is shown if there is no defect.
    """
    problems = [f"{found.fact}; {found.hint}" for found in findings]
    value = f"check {findings[0].source}" if findings else ""
    good = "nothing implausible in any source"
    return data_card(problems, f"{good}; {first_of(notes)}" if notes else good, value)


def data_card(problems: Sequence[str], good: str, value: str = "check") -> Document:
    """Card of the data: the first problem and the number of others, or words for good data.

    Args:
        problems: Problems in words, the worst first.
        good: The words if there is none.
        value: The large word above a problem.

    Returns:
        The texts `title`, `value` and `words`, and `bad`, true only if there is a problem.
    """
    if not problems:
        return {"title": "Data", "value": "good", "words": good}
    return {"title": "Data", "value": value, "words": first_of(problems), "bad": True}
