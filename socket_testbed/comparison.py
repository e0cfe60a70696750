r"""Trials side by side: values of every trial, and differences to the first.

The interval of a difference :math:`x_1 - x_0` comes from the intervals :math:`[l, u]` of both
values, whose errors are taken as independent:

.. math:: \left[ d - \sqrt{(x_1 - l_1)^2 + (u_0 - x_0)^2},\;
          d + \sqrt{(u_1 - x_1)^2 + (x_0 - l_0)^2} \right]

so that variances add, and a skew interval stays skew (Zou & Donner, Construction of confidence
limits about effect measures, Statistics in Medicine 27, 2008).
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.model_file import finite_or_null
from socket_testbed.tables import split_unit, write_table

if TYPE_CHECKING:
    import pandas as pd

_VALUE = ("value", "low", "high")
_DIFFERENCE = ("difference", "difference low", "difference high")
_VALUES = (*_VALUE, *_DIFFERENCE)
COLUMNS = ("part", "name", "quantity", "unit", "item", *_VALUES, "text")
LEGEND = (
    "value (95 % interval); n.d.: not determined; *: the interval of the difference excludes 0."
)
_DIGITS = {"1": 0, "-": 2, "N m": 2}  # behind the point; 1 unless given


def difference_intervals(
    values: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Differences to the first of k trials with the ends of their intervals, shape (k, m) each.

    Args:
        values: Values of k trials, shape (k, m).
        low: Lower ends of their intervals, shape (k, m).
        high: Upper ends of their intervals, shape (k, m).

    Returns:
        Differences, lower and upper ends; NaN in the first row.
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
        part: What the things are, such as `regions`.
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
class Comparison:
    """Trials side by side.

    Attributes:
        items: Names of the trials.
        title: What they are compared over, in words.
        notes: What a reader must know.
        table: Every value, a row per thing, quantity and trial, see `to_dataframe`.
        geometry: Their socket; None where their sockets differ or regions alone are compared.
        pressures: Mean pressures of the tiles, shape (k, n) [kPa], for the maps.
        deviations: Their standard deviations, shape (k, n) [kPa].
        side: The leg that wears it, if that is stated.
    """

    items: tuple[str, ...]
    title: str
    notes: tuple[str, ...]
    table: pd.DataFrame
    geometry: SocketGeometry | None
    pressures: FloatArray
    deviations: FloatArray
    side: str = ""

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
        rows = self.table.to_dict("records")
        return {
            "kind": "trials",
            "items": list(self.items),
            "title": self.title,
            "notes": list(self.notes),
            "rows": [{name: finite_or_null(value) for name, value in row.items()} for row in rows],
        }

    def to_json(self) -> str:
        """The comparison as JSON."""
        return json.dumps(self.document(), indent=1, allow_nan=False)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the table of `to_dataframe` as `.csv` or `.parquet`; an older file is replaced.

        Raises:
            ConfigurationError: If the suffix is no format or the file cannot be written.
        """
        write_table(self.table, Path(path))


def _cell(row: Mapping[str, Any], columns: Sequence[str]) -> str:
    """A value or difference with its interval; the interval alone where it is not determined."""
    digits, sign = _DIGITS.get(row["unit"], 1), "+" if columns == _DIFFERENCE else ""
    value, low, high = (row[name] for name in columns)
    shown = f"{value:{sign}z.{digits}f}" if np.isfinite(value) else ""
    if not np.isfinite([low, high]).all():
        return shown
    differs = " *" if sign and (low > 0.0 or high < 0.0) else ""
    return f"{shown or 'n.d.'} ({low:z.{digits}f} to {high:z.{digits}f}){differs}"
