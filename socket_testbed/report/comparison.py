"""The page of a comparison: cards, maps of trials and differences, and tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed.geometry.socket import SOCKET
from socket_testbed.identification.differences import DIFFERENCE, SAME_LIMB, VALUE, is_clear
from socket_testbed.pages.document import moment, pressure_card, socket_document
from socket_testbed.report.page import Maps, Section, origin_table, write_page
from socket_testbed.results.comparison import LEGEND, MAPPED, Comparison
from socket_testbed.tables import Table

_HEADINGS = {
    "metadata": "Metadata of the trials",
    "trials": "Segments, sources and calibrations",
    "regions": "By region",
    "tiles": "Tile by tile",
    "limb": "Limb in the socket",
    "wrench": "Wrench",
}
_INDEPENDENT = (
    "Intervals of differences treat the errors of two limbs as independent, so that their variances"
    f" add, and those of one subject in one socket as correlated ({SAME_LIMB:g}), so that they"
    " partly cancel (Zou & Donner 2008). They cover the uncertainty left by the sensors under the"
    " prior of the force map. docs/compare.md reports their coverage."
)
_MAPS = (
    "Mean pressure on the unrolled wall and the distal end, on a common scale; the greyer, the less"
    " certain. Differences have their own scale, centred on zero, and are grey where the 95 %"
    " interval includes zero. Outlined: clusters."
)


def write_comparison(found: Comparison, path: Path, command: str) -> None:
    """Write a comparison as one page that opens offline, or replace it.

    Args:
        found: The comparison.
        path: The page, ending in `.html`.
        command: The command that made the page, for the record.
    """
    count, *clearest = found.differing()
    data, titles = _map_data(found)
    cells = found.cells("regions").loc["socket"].rename_axis("output")
    parts = {name: _tables(found, name) for name in dict.fromkeys(found.table["part"])}
    numbers = [Section(name, _HEADINGS[name], parts.pop(name)) for name in MAPPED if name in parts]
    socket = Table("socket-table", "Outputs of the socket", cells)
    groups = {
        "": [
            *([Section("maps", "", [Maps(titles, _MAPS)])] if titles else []),
            Section("differing", "Differences", [[*clearest, f"{count}."]]),
            *([Section("notes", "Notes", [found.notes])] if found.notes else []),
            Section("socket", "Whole socket", [socket]),
        ],
        "Numbers": [Section("intervals", "Intervals", [_INDEPENDENT, LEGEND]), *numbers],
        "Data": [
            *(Section(name, _HEADINGS[name], tables) for name, tables in parts.items()),
            Section("provenance", "Provenance", [origin_table(command)]),
        ],
    }
    title = f"Comparison of trials: {', '.join(found.items)}"
    write_page(path, title, found.title, groups, data | {"cards": _cards(found)})


def _cards(found: Comparison) -> list[dict[str, Any]]:
    """Each trial's own peak, then differences of peak and mean pressure from the first trial."""
    table, shown = found.table, []
    rows = table[(table["part"] == "regions") & (table["name"] == SOCKET)]
    segments = table[(table["part"] == "trials") & (table["name"] == "segment")]
    spans = dict(zip(segments["item"], segments["text"], strict=True))
    for row in rows[rows["quantity"] == "peak pressure"].to_dict("records"):
        item = row["item"]
        mean = f"mean of {len(found.conditions[item])} trials, " * (len(found.conditions[item]) > 1)
        peak, low, high = (row[name] for name in VALUE)
        shown.append(pressure_card(f"Peak, {item}", peak, low, high, mean + spans[item]))
    others = rows[rows["item"] != found.items[0]]
    for quantity in ("peak pressure", "mean pressure"):
        for row in others[others["quantity"] == quantity].to_dict("records"):
            by, low, high = (row[name] for name in DIFFERENCE)
            title = f"{quantity.capitalize()}, {found.difference_title(row['item'])}"
            words = "a clear difference" if is_clear(low, high) else "no clear difference"
            shown.append(pressure_card(title, by, low, high, words, "+"))
    return shown


def _map_data(found: Comparison) -> tuple[dict[str, Any], dict[str, str]]:
    """Maps of the trials on a common scale, of the differences on another, and their titles."""
    if found.geometry is None:
        return {}, {}
    pressures, change = map(found.tile_pressures, (VALUE, DIFFERENCE))
    values, differences = pressures.value, change.value
    names = [*found.items, *map(found.difference_title, found.items[1:])]
    greys = [*[None] * len(values), *(1.0 * ~is_clear(change.low, change.high)[1:])]
    reaches = [*pressures.reach, *change.reach[1:]]
    both = zip([*values, *differences[1:]], reaches, greys, strict=True)
    limit = float(np.abs(differences[1:]).max()) or 1.0
    nothing = np.zeros(0)
    maps: list[dict[str, Any]] = [
        {
            "box": f"map-{number}",
            "moment": moment(0.0, 1e3 * value, 1e3 * reach, nothing, nothing, grey)
            | {"highest": "highest"},
            "range": None if grey is None else limit,
            "diverging": grey is not None,
        }
        for number, (value, reach, grey) in enumerate(both)
    ]
    data = {
        "socket": socket_document(found.geometry, found.side),
        "maps": maps,
        "scale": float(values.max()),
    }
    return data, {entry["box"]: name for entry, name in zip(maps, names, strict=True)}


def _tables(found: Comparison, part: str) -> list[Table]:
    rows = found.table[found.table["part"] == part]
    if part in MAPPED:
        titles = rows[["quantity", "unit"]].drop_duplicates().itertuples(index=False)
        return [
            Table(f"{part}-{number}", f"{name} [{unit}]", found.cells(part, name))
            for number, (name, unit) in enumerate(titles)
        ]
    cells = found.cells(part)
    cells.index = [": ".join(filter(None, names)) for names in cells.index]
    is_text = bool(rows["text"].notna().any())
    return [Table(f"{part}-table", _HEADINGS[part], cells, is_text=is_text)]
