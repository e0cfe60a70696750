"""A comparison of trials as one page that opens offline, with maps on common colour scales."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.comparison import LEGEND, Comparison
from socket_testbed.files import atomic_output
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.report.figures.tiles import certainty_of, tile_map_figure
from socket_testbed.report.page import (
    Bullets,
    Folded,
    ReportFigure,
    Section,
    Table,
    pairs_table,
    render,
)

_HEADINGS = {
    "metadata": "Metadata of the trials",
    "trials": "Segments, sources and calibrations",
    "regions": "By region",
    "tiles": "Tile by tile",
    "wrench": "Wrench",
}
_INDEPENDENT = (
    "The interval of a difference takes the errors of both trials as independent, so that their"
    " variances add (Zou & Donner 2008). It covers what the sensors leave open under the prior of"
    " the force map. Errors that both trials share, such as those of the same sensors, cancel in"
    " part: then it is too wide. docs/compare.md states how often it held the true difference."
)


def write_page(found: Comparison, path: Path, command: str, made: datetime) -> None:
    """Write the page; an older one is replaced.

    Args:
        found: The comparison.
        path: The page.
        command: What made it, for the record.
        made: When.

    Raises:
        ConfigurationError: If it cannot be written.
    """
    origin = [
        ("page made", made.astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")),
        ("command", command),
    ]
    table = pairs_table("provenance-table", "What the page was made with", origin)
    notes = Section("notes", "Notes", [Bullets(found.notes, "notes"), LEGEND])
    sections = [notes, *_sections(found), Section("provenance", "Provenance", [table])]
    text = render(f"Comparison of trials: {', '.join(found.items)}", found.title, sections)
    with atomic_output(path) as staging:
        staging.write_text(text, encoding="utf-8")


def _sections(found: Comparison) -> Iterator[Section]:
    differing = found.differing()
    if differing:
        yield Section(
            "differing", "Clear differences", [f"{differing[0]}.", Bullets(differing[1:])]
        )
    cells = found.cells("regions").loc["socket"].rename_axis("output")
    socket = Table("socket-table", "Outputs of the socket", cells)
    yield Section("socket", "Whole socket", [_INDEPENDENT, socket])
    if found.geometry is not None:
        yield _maps(found, found.geometry)
    for part in dict.fromkeys(found.table["part"]):
        rows = found.table[found.table["part"] == part]
        if part in {"regions", "tiles"}:
            titles = rows[["quantity", "unit"]].drop_duplicates().itertuples(index=False)
            tables = [
                Table(f"{part}-{number}", f"{name} [{unit}]", found.cells(part, name))
                for number, (name, unit) in enumerate(titles)
            ]
        else:
            cells = found.cells(part)
            cells.index = [": ".join(filter(None, names)) for names in cells.index]
            is_text = bool(rows["text"].notna().any())
            tables = [Table(f"{part}-table", _HEADINGS[part], cells, is_text=is_text)]
        shown = [Folded("Show the tables", tables)] if part == "tiles" else tables
        yield Section(part, _HEADINGS[part], shown)


def _maps(found: Comparison, geometry: SocketGeometry) -> Section:
    """Mean pressures on one colour scale, and their differences with zero in the middle of one."""
    first, *others = found.items
    differences = found.pressures[1:] - found.pressures[0]
    spread = np.hypot(found.deviations[1:], found.deviations[0])
    most = float(np.abs(differences).max()) or 1.0
    scale = min(float(found.pressures.min()), 0.0), float(found.pressures.max())
    pressures = dict(zip(found.items, found.pressures, strict=True))
    named = {f"{item} - {first}": values for item, values in zip(others, differences, strict=True)}
    unit = "mean pressure [kPa]"
    figures = [
        _map_figure(geometry, found.side, shown, deviations, title, limits, described)
        for shown, deviations, title, limits, described in (
            (pressures, found.deviations, unit, scale, "Maps of the mean pressure"),
            (named, spread, f"difference in {unit}", (-most, most), f"Differences to {first}"),
        )
    ]
    text = (
        "The mean pressure [kPa] on the unrolled wall and the distal end, on one colour scale, and"
        f" below the differences to {first} with zero in the middle of theirs. A tile is pale"
        " where its value is uncertain against the largest ones. Thick outlines: clusters."
    )
    return Section("maps", "Maps", [text, *figures])


def _map_figure(
    geometry: SocketGeometry,
    side: str,
    maps: Mapping[str, FloatArray],
    deviations: FloatArray,
    unit: str,
    limits: tuple[float, float],
    described: str,
) -> ReportFigure:
    """A map per set of values on one colour scale; pale where a value is uncertain."""
    certainty = {
        name: certainty_of(values, deviation)
        for (name, values), deviation in zip(maps.items(), deviations, strict=True)
    }
    return ReportFigure(
        name="",
        caption=f"{described}.",
        draw=lambda style: tile_map_figure(
            geometry,
            maps,
            unit,
            style=style,
            limits=limits,
            side=side,
            certainty=certainty,
        ),
        description=f"{described}: {', '.join(maps)}",
        is_map=True,
    )
