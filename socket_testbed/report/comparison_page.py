"""A comparison as one page that opens offline."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import pandas as pd

from socket_testbed.comparison.table import LEGEND, Comparison
from socket_testbed.files import atomic_output
from socket_testbed.report.figures.comparison import difference_maps, item_maps
from socket_testbed.report.figures.style import svg_of
from socket_testbed.report.page import Table, pairs_table, render
from socket_testbed.tables import split_unit

_HEADINGS = {
    "metadata": "What is stated about the trials",
    "trials": "What was measured, and with what",
    "models": "The models",
    "settings": "Settings that differ",
    "sockets": "The sockets",
    "sizes": "Sizes",
    "regions": "By region",
    "tiles": "Tile by tile",
    "wrench": "Wrench",
    "errors": "Errors of the fits",
    "offsets": "Offsets",
    "clusters": "Clusters",
}
_DIFFERING = "What differs clearly"
_INDEPENDENT = (
    "The interval of a difference takes the errors of both trials as independent, so that their"
    " variances add (Zou & Donner 2008). It covers what the sensors leave open under the prior of"
    " the force map. Errors that both trials share, such as those of the same sensors, cancel in"
    " part: then it is too wide. docs/compare.md states how often it held the true difference."
)


@dataclass(frozen=True)
class Section:
    """A section of the page.

    Attributes:
        name: Its identifier.
        heading: Its title.
        text: What to know of it; empty for nothing.
        tables: Its tables.
        pictures: Its figures as SVG, each with its description.
        is_folded: Whether its tables are shown on demand.
    """

    name: str
    heading: str
    text: str = ""
    tables: tuple[Table, ...] = ()
    pictures: tuple[tuple[str, str], ...] = ()
    is_folded: bool = False


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
    differing = found.differing()
    sections = [*_sections(found), Section("provenance", "Provenance", tables=(table,))]
    text = render(
        "comparison.html",
        title=f"Comparison of {found.kind}: {', '.join(found.items)}",
        subtitle=found.title,
        contents=({"differing": _DIFFERING} if differing else {})
        | {section.name: section.heading for section in sections},
        differing_heading=_DIFFERING,
        notes=found.notes,
        differing=differing,
        sections=sections,
        legend=LEGEND,
    )
    with atomic_output(path) as staging:
        staging.write_text(text, encoding="utf-8")


def _sections(found: Comparison) -> Iterator[Section]:
    parts = list(dict.fromkeys(found.table["part"]))
    socket = None
    if found.kind == "trials" and "regions" in parts:
        table = found.cells("regions").loc["socket"].rename_axis("output")
        socket = Table("socket-table", "Outputs of the socket", table)
        yield Section("socket", "Whole socket", _INDEPENDENT, (socket,))
    yield from _maps(found)
    for part in parts:
        rows = found.table[found.table["part"] == part]
        if part in {"regions", "tiles"}:
            tables = tuple(
                Table(f"{part}-{number}", f"{quantity} [{unit}]", found.cells(part, quantity))
                for number, (quantity, unit) in enumerate(
                    dict.fromkeys(zip(rows["quantity"], rows["unit"], strict=True))
                )
            )
        else:
            table = Table(
                f"{part}-table",
                _HEADINGS[part],
                _one_index(found.cells(part)),
                is_text=bool(rows["text"].notna().any()),
            )
            tables = (table,)
        yield Section(part, _HEADINGS[part], "", tables, is_folded=part == "tiles")


def _maps(found: Comparison) -> Iterator[Section]:
    if found.mapped is None or found.geometry is None:
        return
    name, unit = split_unit(found.mapped.title)
    arguments = (found.geometry, found.mapped, found.items, found.side)
    pictures = (
        (svg_of(item_maps(*arguments)), f"Maps of the {name} of {', '.join(found.items)}"),
        (svg_of(difference_maps(*arguments)), f"Maps of the differences to {found.items[0]}"),
    )
    text = (
        f"The {name} [{unit}] on the unrolled wall and the distal end, on one colour scale, and"
        f" below the differences to {found.items[0]} with zero in the middle of theirs. A tile is"
        " pale where its value is uncertain against the largest ones. Thick outlines: clusters."
    )
    yield Section("maps", "Maps", text, pictures=pictures)


def _one_index(cells: pd.DataFrame) -> pd.DataFrame:
    """The table with `name: quantity` in place of two columns that head its rows."""
    names = [": ".join(filter(None, key)) for key in cells.index]
    return cells.set_axis(pd.Index(names, name=""), axis=0)
