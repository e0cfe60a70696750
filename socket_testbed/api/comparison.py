r"""Trials side by side: values of every trial, and differences to the first.

The interval of a difference :math:`x_1 - x_0` comes from the intervals :math:`[l, u]` of both
values, whose errors are taken as independent:

.. math:: \left[ d - \sqrt{(x_1 - l_1)^2 + (u_0 - x_0)^2},\;
          d + \sqrt{(u_1 - x_1)^2 + (x_0 - l_0)^2} \right]

so that variances add, and a skew interval stays skew (Zou & Donner, Construction of confidence
limits about effect measures, Statistics in Medicine 27, 2008).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from socket_testbed.api.result import Result, records
from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.files import atomic_output
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.tables import split_unit

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from socket_testbed.report.figures.style import FigureStyle
    from socket_testbed.report.page import Section

_VALUE = ("value", "low", "high")
_DIFFERENCE = ("difference", "difference low", "difference high")
_VALUES = (*_VALUE, *_DIFFERENCE)
COLUMNS = ("part", "name", "quantity", "unit", "item", *_VALUES, "text")
LEGEND = (
    "value (95 % interval); n.d.: not determined; *: the interval of the difference excludes 0."
)
_MEAN = "mean pressure [kPa]"
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
_MAPS = (
    "On the unrolled wall and the distal end; each set of maps has one colour scale, that of the"
    " differences with zero in its middle. A tile is pale where its value is uncertain against the"
    " largest ones. Thick outlines: clusters."
)
_DIGITS = {"1": 0, "-": 2, "N m": 2}  # behind the point; 1 unless given


def difference_intervals(
    values: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Differences to the first of k trials with the ends of their intervals, shape (k, m) each.

    NaN in the first row.
    """
    below, above = np.maximum(values - low, 0.0), np.maximum(high - values, 0.0)
    difference = values - values[0]
    ends = difference - np.hypot(below, above[0]), difference + np.hypot(above, below[0])
    for row in (difference, *ends):
        row[0] = np.nan
    return difference, *ends


def values_table(
    part: str,
    names: Sequence[str],
    title: str,
    items: Sequence[str],
    values: FloatArray,
    low: FloatArray | None = None,
    high: FloatArray | None = None,
    determined: BoolArray | None = None,
) -> pd.DataFrame:
    """A quantity of m things, such as regions, in k trials, in the columns of `COLUMNS`.

    Args:
        part: Kind of the things, such as `regions`.
        names: Names of the things.
        title: The quantity with its unit, such as `peak pressure [kPa]`; degrees repeat after 360.
        items: Names of the trials.
        values: Shape (k, m).
        low: Lower ends of the 95 % intervals, shape (k, m); None where there is none.
        high: Upper ends, likewise.
        determined: Where a value counts, shape (k, m); elsewhere its interval stands alone.
    """
    import pandas as pd

    low, high = (np.full(values.shape, np.nan) if end is None else end for end in (low, high))
    determined = np.full(values.shape, True) if determined is None else determined
    difference, lower, upper = difference_intervals(values, low, high)
    name, unit = split_unit(title)
    turns = 360.0 * np.round(difference / 360.0) if unit == "deg" else 0.0
    columns = (
        np.where(determined, values, np.nan),
        low,
        high,
        np.where(determined & determined[0], difference - turns, np.nan),
        lower - turns,
        upper - turns,
    )
    table = {
        "part": part,
        "name": np.repeat(np.array(names, dtype=object), len(values)),
        "quantity": name,
        "unit": unit,
        "item": np.tile(np.array(items, dtype=object), len(names)),
        **{column: of.T.ravel() for column, of in zip(_VALUES, columns, strict=True)},
    }
    return pd.DataFrame(table).assign(text=None)[[*COLUMNS]]


def texts_table(
    part: str, texts: Mapping[str, Sequence[str]], items: Sequence[str]
) -> pd.DataFrame:
    """Texts of every trial by their names, in the columns of `COLUMNS`."""
    import pandas as pd

    rows = [
        {"part": part, "name": name, "quantity": "", "unit": "", "item": item, "text": text}
        for name, of_items in texts.items()
        for item, text in zip(items, of_items, strict=True)
    ]
    return pd.DataFrame(rows, columns=[*COLUMNS]).astype(dict.fromkeys(_VALUES, float))


@dataclass(frozen=True, repr=False)
class Comparison(Result):
    """Trials side by side."""

    items: tuple[str, ...]  # names of the trials
    title: str  # what they are compared over
    notes: tuple[str, ...]  # what a reader must know
    table: pd.DataFrame  # see `to_dataframe`
    geometry: SocketGeometry | None  # None: sockets differ, or regions alone are compared
    pressures: FloatArray  # (k, n) [kPa], means of the tiles
    deviations: FloatArray  # (k, n) [kPa], their standard deviations
    side: str = ""  # the leg that wears the socket, if that is stated

    def __repr__(self) -> str:
        names = self.table.groupby("part")["name"].nunique()
        counts = ", ".join(f"{names[p]} {p}" for p in ("regions", "tiles") if p in names)
        return f"Comparison(trials {', '.join(self.items)}; {counts})"

    def to_dataframe(self) -> pd.DataFrame:
        """Every value in long form.

        Columns: `part` (such as `regions`), `name` (such as `anterior proximal`), `quantity` and
        `unit`, `item` (the trial), `value` with the ends `low` and `high` of its 95 % interval,
        `difference` to the first trial with `difference low` and `difference high`, and `text` of
        what is no number. A value that is not determined is NaN beside its interval.
        """
        return self.table.copy()

    def cells(self, part: str, quantity: str = "") -> pd.DataFrame:
        """A part as a reader sees it: values with intervals, a column per trial and difference.

        Args:
            part: The part, such as `regions`.
            quantity: One quantity, indexed by the names; empty for all, indexed by both.
        """
        import pandas as pd

        rows = self.table[self.table["part"] == part]
        if quantity:
            rows = rows[rows["quantity"] == quantity]
        found: dict[tuple[str, str], dict[str, str]] = {}
        for row in rows.to_dict("records"):
            what = f"{row['quantity']} [{row['unit']}]" if row["unit"] else row["quantity"]
            cells = found.setdefault((row["name"], what), {})
            cells[row["item"]] = row["text"] or _cell(row, _VALUE)
            if row["item"] != self.items[0] and not row["text"]:
                cells[self._difference(row["item"])] = _cell(row, _DIFFERENCE)
        table = pd.DataFrame.from_dict(found, orient="index").fillna("")
        table.index = pd.MultiIndex.from_tuples(found, names=["name", "quantity"])
        columns = [*self.items, *map(self._difference, self.items[1:])]
        table = table.reindex(columns=[name for name in columns if name in table])
        return table.droplevel("quantity") if quantity else table

    def differing(self, most: int = 10) -> list[str]:
        """Differences of regions whose interval excludes zero, the clearest first, in words.

        The first line counts them all: of intervals of 95 %, one in 20 excludes zero by chance.

        Args:
            most: Number of lines after the first.
        """
        rows = self.table[self.table["part"] == "regions"]
        low, high = rows["difference low"], rows["difference high"]
        rows = rows.assign(clear=(low + high).abs() / (high - low))[high > low]
        clear = rows[rows["clear"] > 1.0].sort_values("clear", ascending=False, kind="stable")
        lines = [
            f"{len(clear)} of {len(rows)} intervals of the regions' differences exclude 0; by"
            f" chance alone up to about {0.05 * len(rows):.0f} would"
        ]
        for row in clear.head(most).to_dict("records"):
            cell = _cell(row, _DIFFERENCE).removesuffix(" *")
            what = f"{self._difference(row['item'])}, {row['name']}: {row['quantity']}"
            lines.append(f"{what} {cell} {row['unit']}")
        return lines

    def _difference(self, item: str) -> str:
        """Name of the column of a trial's difference."""
        return f"{item} - {self.items[0]}"

    def document(self) -> dict[str, Any]:
        """The comparison for JSON: the rows of `to_dataframe`, null where there is no value."""
        return {
            "kind": "trials",
            "items": list(self.items),
            "title": self.title,
            "notes": list(self.notes),
            "rows": records(self.table),
        }

    def _figure(self, style: FigureStyle) -> Figure:
        """Maps of the mean pressure on one colour scale."""
        if self.geometry is None:
            return super()._figure(style)
        from socket_testbed.report.figures.tiles import certainty_of, tile_map_figure

        low, high = min(float(self.pressures.min()), 0.0), float(self.pressures.max())
        certainty = map(certainty_of, self.pressures, self.deviations)
        return tile_map_figure(
            self.geometry,
            dict(zip(self.items, self.pressures, strict=True)),
            _MEAN,
            style=style,
            limits=(low, high),
            side=self.side,
            certainty=dict(zip(self.items, certainty, strict=True)),
        )

    def _differences(self, style: FigureStyle) -> Figure:
        """Maps of the differences to the first trial, with zero in the middle of one scale."""
        from socket_testbed.report.figures.tiles import certainty_of, tile_map_figure

        differences = self.pressures[1:] - self.pressures[0]
        spread = np.hypot(self.deviations[1:], self.deviations[0])
        most = float(np.abs(differences).max()) or 1.0
        names = [self._difference(item) for item in self.items[1:]]
        assert self.geometry is not None
        return tile_map_figure(
            self.geometry,
            dict(zip(names, differences, strict=True)),
            f"difference in {_MEAN}",
            style=style,
            limits=(-most, most),
            side=self.side,
            certainty=dict(zip(names, map(certainty_of, differences, spread), strict=True)),
        )

    def write_page(self, path: Path, command: str) -> None:
        """Write the comparison as one page that opens offline; an older one is replaced.

        Args:
            path: The page.
            command: What made it, for the record.

        Raises:
            ConfigurationError: If it cannot be written.
        """
        # matplotlib takes its time to import.
        from socket_testbed.report.page import Bullets, Section, pairs_table, render

        made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        origin = [("page made", made), ("command", command)]
        table = pairs_table("provenance-table", "What the page was made with", origin)
        sections = [
            Section("notes", "Notes", [Bullets(self.notes, "notes"), LEGEND]),
            *self._sections(),
            Section("provenance", "Provenance", [table]),
        ]
        text = render(f"Comparison of trials: {', '.join(self.items)}", self.title, sections)
        with atomic_output(path) as staging:
            staging.write_text(text, encoding="utf-8")

    def _sections(self) -> Iterator[Section]:
        from socket_testbed.report.page import Bullets, Folded, ReportFigure, Section, Table

        count, *clearest = self.differing()
        yield Section("differing", "Clear differences", [f"{count}.", Bullets(clearest)])
        cells = self.cells("regions").loc["socket"].rename_axis("output")
        socket = Table("socket-table", "Outputs of the socket", cells)
        yield Section("socket", "Whole socket", [_INDEPENDENT, socket])
        if self.geometry is not None:
            figures = [
                ReportFigure("", f"{shown}.", draw, f"{shown}: {', '.join(names)}", is_map=True)
                for shown, draw, names in (
                    ("Maps of the mean pressure", self._figure, self.items),
                    (f"Differences to {self.items[0]}", self._differences, self.items[1:]),
                )
            ]
            yield Section("maps", "Maps", [_MAPS, *figures])
        for part in dict.fromkeys(self.table["part"]):
            rows = self.table[self.table["part"] == part]
            if part in {"regions", "tiles"}:
                titles = rows[["quantity", "unit"]].drop_duplicates().itertuples(index=False)
                tables = [
                    Table(f"{part}-{number}", f"{name} [{unit}]", self.cells(part, name))
                    for number, (name, unit) in enumerate(titles)
                ]
            else:
                cells = self.cells(part)
                cells.index = [": ".join(filter(None, names)) for names in cells.index]
                is_text = bool(rows["text"].notna().any())
                tables = [Table(f"{part}-table", _HEADINGS[part], cells, is_text=is_text)]
            shown = [Folded("Show the tables", tables)] if part == "tiles" else tables
            yield Section(part, _HEADINGS[part], shown)


def _cell(row: Mapping[str, Any], columns: Sequence[str]) -> str:
    """A value or difference with its interval; the interval alone where it is not determined."""
    digits, sign = _DIGITS.get(row["unit"], 1), "+" if columns == _DIFFERENCE else ""
    value, low, high = (row[name] for name in columns)
    shown = f"{value:{sign}z.{digits}f}" if np.isfinite(value) else ""
    if not np.isfinite([low, high]).all():
        return shown
    differs = " *" if sign and (low > 0.0 or high < 0.0) else ""
    return f"{shown or 'n.d.'} ({low:z.{digits}f} to {high:z.{digits}f}){differs}"
