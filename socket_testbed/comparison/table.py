r"""What is compared, side by side: values of every item, and differences to the first.

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
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.model_file import finite_or_null
from socket_testbed.tables import split_unit, write_table

if TYPE_CHECKING:
    import pandas as pd

Kind = Literal["trials", "models", "sockets"]

_VALUES = ("value", "low", "high", "difference", "difference low", "difference high")
COLUMNS = ("part", "name", "quantity", "unit", "item", *_VALUES, "text")
NOT_DETERMINED = "n.d."
LEGEND = (
    "value (95 % interval); n.d.: not determined; *: the interval of the difference excludes 0."
)


def difference_intervals(
    values: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Differences to the first of k items with the ends of their intervals, shape (k, m) each.

    Args:
        values: Values of k items, shape (k, m).
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


@dataclass(frozen=True)
class Compared:
    """A quantity of m things, such as regions, in k items.

    Attributes:
        part: What the things are: `regions`, `tiles`, `channels`.
        names: Names of the things.
        title: The quantity with its unit, such as `peak pressure [kPa]`.
        values: Shape (k, m).
        low: Lower ends of the 95 % intervals, shape (k, m); NaN where there is none.
        high: Upper ends, shape (k, m).
        determined: Where a value counts, shape (k, m); elsewhere its interval stands alone.
        turn: What an angle repeats after; infinite for anything else.
        is_relative: Whether the values are differences to the first item already.
    """

    part: str
    names: Sequence[str]
    title: str
    values: FloatArray
    low: FloatArray
    high: FloatArray
    determined: BoolArray
    turn: float = float("inf")
    is_relative: bool = False

    @classmethod
    def plain(
        cls,
        part: str,
        names: Sequence[str],
        title: str,
        values: FloatArray,
        is_relative: bool = False,
    ) -> Compared:
        """A quantity without intervals."""
        nothing, everywhere = np.full(values.shape, np.nan), np.full(values.shape, True)
        return cls(
            part, names, title, values, nothing, nothing, everywhere, is_relative=is_relative
        )

    def to_dataframe(self, items: Sequence[str]) -> pd.DataFrame:
        """The quantity in the columns of `COLUMNS`, a row per thing and item."""
        import pandas as pd

        difference, lower, upper = difference_intervals(self.values, self.low, self.high)
        if self.is_relative:
            difference[:] = np.nan
        turns = np.zeros(difference.shape)
        if np.isfinite(self.turn):
            turns = self.turn * np.round(difference / self.turn)
        both = self.determined & self.determined[0]
        columns = (
            np.where(self.determined, self.values, np.nan),
            self.low,
            self.high,
            np.where(both, difference - turns, np.nan),
            lower - turns,
            upper - turns,
        )
        count, things = self.values.shape
        name, unit = split_unit(self.title)
        table = {
            "part": self.part,
            "name": np.repeat(np.array(self.names, dtype=object), count),
            "quantity": name,
            "unit": unit,
            "item": np.tile(np.array(items, dtype=object), things),
            **{title: c.T.ravel() for title, c in zip(_VALUES, columns, strict=True)},
        }
        return pd.DataFrame(table).assign(text=None)[[*COLUMNS]]


def texts_table(
    part: str, texts: Mapping[str, Sequence[str]], items: Sequence[str]
) -> pd.DataFrame:
    """What is known in words, in the columns of `COLUMNS`.

    Args:
        part: What it is about.
        texts: A text per item, by what it is.
        items: Names of the items.
    """
    import pandas as pd

    rows = [
        {"part": part, "name": name, "quantity": "", "unit": "", "item": item, "text": text}
        for name, of_items in texts.items()
        for item, text in zip(items, of_items, strict=True)
    ]
    return pd.DataFrame(rows, columns=[*COLUMNS]).astype(dict.fromkeys(_VALUES, float))


def joined(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Tables in the columns of `COLUMNS`, one below the other."""
    import pandas as pd

    return pd.concat([table for table in tables if len(table)], ignore_index=True)


@dataclass(frozen=True, repr=False)
class Comparison:
    """Trials, models or sockets side by side.

    Attributes:
        kind: What is compared.
        items: Their names.
        title: What they are compared over, in words.
        notes: What a reader must know.
        table: Every value, a row per thing, quantity and item, see `to_dataframe`.
        mapped: The quantity of the tiles that is drawn, if all items have the same tiles.
        geometry: Their socket.
        side: The leg that wears it, if that is stated.
    """

    kind: Kind
    items: tuple[str, ...]
    title: str
    notes: tuple[str, ...]
    table: pd.DataFrame
    mapped: Compared | None = None
    geometry: SocketGeometry | None = None
    side: str = ""

    def __repr__(self) -> str:
        names = self.table.groupby("part")["name"].nunique()
        counts = ", ".join(f"{names[p]} {p}" for p in ("regions", "tiles") if p in names)
        return f"Comparison({self.kind} {', '.join(self.items)}; {counts})"

    def to_dataframe(self) -> pd.DataFrame:
        """Every value in long form.

        Columns: `part` (such as `regions`), `name` (such as `anterior proximal`), `quantity` and
        `unit`, `item`, `value` with the ends `low` and `high` of its 95 % interval, `difference`
        to the first item with `difference low` and `difference high`, and `text` of what is no
        number. A value that is not determined is NaN beside its interval.
        """
        return self.table.copy()

    def cells(self, part: str, quantity: str = "") -> pd.DataFrame:
        """A part as a reader sees it: values with intervals, a column per item and difference.

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
            cells[row["item"]] = row["text"] or _cell(row, "value", "low", "high")
            if row["item"] != self.items[0] and (cell := _cell(row, *_VALUES[3:], sign="+")):
                cells[self.difference(row["item"])] = cell
        table = pd.DataFrame.from_dict(found, orient="index").fillna("")
        table.index = pd.MultiIndex.from_tuples(found, names=["name", "quantity"])
        columns = [*self.items, *map(self.difference, self.items[1:])]
        table = table.reindex(columns=[name for name in columns if name in table])
        return table.droplevel("quantity") if quantity else table

    def differing(self, most: int = 10) -> list[str]:
        """Differences of regions whose interval excludes zero, the clearest first, in words.

        The first line counts them all: of intervals of 95 %, one in 20 excludes zero by chance.
        Nothing where no difference has an interval.

        Args:
            most: Number of lines after the first.
        """
        rows = self.table[self.table["part"] == "regions"]
        width = rows["difference high"] - rows["difference low"]
        rows = rows.assign(width=width)[width > 0.0]
        if rows.empty:
            return []
        middle = 0.5 * (rows["difference low"] + rows["difference high"])
        rows = rows.assign(clear=middle.abs() / (0.5 * rows["width"]))
        clear = rows[rows["clear"] > 1.0].sort_values("clear", ascending=False, kind="stable")
        lines = [
            f"{len(clear)} of {len(rows)} intervals of the regions' differences exclude 0; by"
            f" chance alone up to about {0.05 * len(rows):.0f} would"
        ]
        for row in clear.head(most).to_dict("records"):
            cell = _cell(row, *_VALUES[3:], sign="+").removesuffix(" *")
            lines.append(
                f"{self.difference(row['item'])}, {row['name']}: {row['quantity']}"
                f" {cell} {row['unit']}"
            )
        return lines

    def difference(self, item: str) -> str:
        """Name of the column of an item's difference."""
        return f"{item} - {self.items[0]}"

    def document(self) -> dict[str, Any]:
        """The comparison for JSON: the rows of `to_dataframe`, null where there is no value."""
        rows = self.table.to_dict("records")
        return {
            "kind": self.kind,
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


def _cell(row: Mapping[str, Any], value: str, low: str, high: str, sign: str = "") -> str:
    """A value with its interval; the interval alone where the value is not determined."""
    digits = _DIGITS.get(row["unit"], 1)
    number, ends = row[value], (row[low], row[high])
    shown = f"{_rounded(number, digits):{sign}.{digits}f}" if np.isfinite(number) else ""
    if not np.isfinite(ends).all():
        return shown
    interval = " to ".join(f"{_rounded(end, digits):.{digits}f}" for end in ends)
    differs = " *" if sign and (ends[0] > 0.0 or ends[1] < 0.0) else ""
    return f"{shown or NOT_DETERMINED} ({interval}){differs}"


_DIGITS = {"1": 0, "-": 2, "N m": 2, "N/mm": 2}  # behind the point; 1 unless given


def _rounded(value: float, digits: int) -> float:
    return round(value, digits) + 0.0  # no negative zero
