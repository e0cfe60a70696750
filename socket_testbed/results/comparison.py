"""Trials or conditions side by side: every value, and the differences from the first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from socket_testbed.errors import ConfigurationError, closest
from socket_testbed.figures.style import FigureStyle
from socket_testbed.figures.tiles import pressure_limits, tile_map_figure
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.differences import DIFFERENCE, VALUE, VALUES, is_clear
from socket_testbed.identification.pressure import Quantity
from socket_testbed.results.pressure_text import number
from socket_testbed.results.result import Result, records
from socket_testbed.settings.options import Side
from socket_testbed.tables import NOTHING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_DIFFERING = 10  # in words
_LEAST = 1  # decimals of differences, their ends and spreads
COLUMNS = ("part", "name", "quantity", "unit", "item", *VALUES, "text")
MAPPED = ("regions", "tiles")  # parts of the table computed from the force map
FELT = ("peak pressure", "mean pressure", "shear", "contact area", "pressure-time integral")
"""Quantities that the limb feels."""
LEGEND = "value (95 % interval); *: the interval of the difference excludes 0."


@dataclass(frozen=True, repr=False)
class Comparison(Result):
    """Trials or conditions side by side, with differences from the first.

    Attributes:
        conditions: Names of the trials by condition, the reference first; without conditions each
            trial is its own.
        title: Segment, contact threshold and, for repeated trials, the smallest detectable
            differences, in words.
        notes: Remarks for the reader, such as differing loads or regions that are not compared.
        table: Every value in long form, see `to_dataframe`.
        geometry: The first trial's socket, whose n tiles are compared; None if only regions are.
        side: The leg that wears the socket; None if it is not stated or differs between trials.
    """

    _SCALED = True

    conditions: Mapping[str, Sequence[str]]
    title: str
    notes: tuple[str, ...]
    table: pd.DataFrame
    geometry: SocketGeometry | None
    side: Side | None = None

    def __repr__(self) -> str:
        names = self.table.groupby("part")["name"].nunique()
        counts = ", ".join(f"{names[p]} {p}" for p in MAPPED if p in names)
        return f"Comparison({self.kind} {', '.join(self.items)}; {counts})"

    @property
    def items(self) -> tuple[str, ...]:
        """Names of the conditions, or of the trials; the first one is the reference."""
        return tuple(self.conditions)

    @property
    def kind(self) -> str:
        """`trials` or `conditions`: what the `items` are."""
        single = all([name] == [*trials] for name, trials in self.conditions.items())
        return "trials" if single else "conditions"

    def to_dataframe(self) -> pd.DataFrame:
        """Every value in long form, a row per output and item; no named index.

        Columns; numbers are in the `unit` of the row:

        - `part`: `metadata` and `trials` (texts), `regions`, `tiles`, `limb` or `wrench`;
        - `name`: the region, tile or wrench channel, such as `anterior proximal`; for a text what
          it states, such as `segment`; empty for the limb;
        - `quantity`, `unit`: such as `peak pressure` and `kPa`; empty for a text;
        - `item`: the trial or condition;
        - `value`, `low`, `high`: its value, or the mean of its trials, with the ends of the 95 %
          interval;
        - `difference`, `difference low`, `difference high`: from the first item;
        - `text`: of an entry without a number, otherwise None.

        Conditions with several trials add the `spread` between donnings (a standard deviation)
        with its `degrees of freedom`, and the smallest `detectable` difference.

        Numbers are NaN in rows with a text, differences for the first item, and interval ends for
        the wrench, which is exact, unless trials are repeated. An open end of an interval of the
        limb is infinite.
        """
        return self.table.copy()

    def cells(self, part: str, quantity: str = "") -> pd.DataFrame:
        """A part as formatted text: values with intervals, a column per trial and difference.

        Args:
            part: The part, such as `regions`.
            quantity: One quantity, such as `peak pressure`; empty for all of them.

        Returns:
            A row per name and quantity, indexed by `name` and `quantity` (with its unit), or by
            `name` for one quantity. Columns: the items, then each difference, such as
            `walk - hold`, marked with `*` if its interval excludes 0; for repeated trials also
            `spread` and `detectable`. A cell is empty where there is no number, and a dash where an
            interval is open.

        Raises:
            ConfigurationError: The comparison has no such part or quantity.
        """
        rows = self.table[self.table["part"] == part]
        if not len(rows):
            fact = f"the comparison has no part '{part}'"
            raise ConfigurationError(fact, closest(str(part), {*self.table["part"]}))
        if quantity and quantity not in {*rows["quantity"]}:
            fact = f"{part} have no quantity '{quantity}'"
            raise ConfigurationError(fact, closest(str(quantity), {*rows["quantity"]}))
        if quantity:
            rows = rows[rows["quantity"] == quantity]
        found: dict[tuple[str, str], dict[str, str]] = {}
        for row in rows.to_dict("records"):
            title = f"{row['quantity']} [{row['unit']}]" if row["unit"] else row["quantity"]
            cells = found.setdefault((row["name"], title), {})
            cells[row["item"]] = row["text"] or _cell(row, VALUE)
            if row["item"] != self.items[0] and not row["text"]:
                cells[self.difference_title(row["item"])] = _cell(row, DIFFERENCE)
                if np.isfinite(row.get("detectable", np.nan)):
                    cells["spread"] = _number(row, "spread")
                    cells["detectable"] = _number(row, "detectable")
        table = pd.DataFrame.from_dict(found, orient="index").fillna("")
        table.index = pd.MultiIndex.from_tuples(found, names=["name", "quantity"])
        columns = [*self.items, *map(self.difference_title, self.items[1:]), "spread", "detectable"]
        table = table.reindex(columns=[name for name in columns if name in table])
        return table.droplevel("quantity") if quantity else table

    def differing(self) -> list[str]:
        """Differences of regions whose interval excludes zero, in words.

        What the limb feels comes first (`FELT`: pressure, contact and shear), then the share of the
        load, directions and centres; of each kind the clearest. The first line counts them: one in
        20 of 95 % intervals excludes zero by chance.
        """
        rows = self.table[self.table["part"] == "regions"]
        low, high = rows["difference low"], rows["difference high"]
        rows = rows.assign(clear=(low + high).abs() / (high - low))[high > low]
        clear = rows[is_clear(rows["difference low"], rows["difference high"])]
        clear = clear.assign(felt=clear["quantity"].isin(FELT))
        clear = clear.sort_values(["felt", "clear"], ascending=False, kind="stable")
        lines = [
            f"{len(clear)} of {len(rows)} intervals of the regions' differences exclude 0; by"
            f" chance alone up to about {0.05 * len(rows):.0f} would"
        ]
        for row in clear.head(_MOST_DIFFERING).to_dict("records"):
            by, *ends = (abs(row[name]) for name in DIFFERENCE)
            low, high = sorted(ends)
            way = "lower" if row["difference"] < 0.0 else "higher"
            unit = "percentage points" if row["unit"] == "%" else row["unit"]
            lines.append(
                f"{row['name']}: {row['quantity']} {_shown(row, by)} {unit} {way} in"
                f" {row['item']} than in {self.items[0]} ({_shown(row, low)} to"
                f" {_shown(row, high)})"
            )
        return lines

    def difference_title(self, item: str) -> str:
        """Column name of an item's difference from the first item, such as `walk - hold`."""
        return f"{item} - {self.items[0]}"

    def document(self) -> dict[str, Any]:
        """The comparison for JSON.

        Returns:
            `kind`, the `items`, `conditions` (the names of their trials, if given), `title`,
            `notes`, and `rows` as in `to_dataframe`, None where there is no value.
        """
        return {
            "kind": "trials",  # also if they are grouped by conditions
            "items": list(self.items),
            **({"conditions": self.conditions} if self.kind == "conditions" else {}),
            "title": self.title,
            "notes": list(self.notes),
            "rows": records(self.table),
        }

    def _figure(self, style: FigureStyle) -> Figure:
        """Maps of the mean pressure on the fixed colour scale."""
        if self.geometry is None:
            return super()._figure(style)
        pressures = self.tile_pressures(VALUE)
        return tile_map_figure(
            self.geometry,
            dict(zip(self.items, pressures.value, strict=True)),
            "mean pressure [kPa]",
            style=style,
            limits=pressure_limits(pressures.value, style.limits),
            side=self.side,
            reach=dict(zip(self.items, pressures.reach, strict=True)),
        )

    def tile_pressures(self, columns: Sequence[str]) -> Quantity:
        """Mean pressures of the n tiles by item, or their differences from the first item.

        The comparison must be tile by tile, that is not by region.

        Args:
            columns: Columns of `to_dataframe` with the value and the lower and upper end of its
                interval: `("value", "low", "high")`, or those of the difference.

        Returns:
            The values with their intervals, shape (k, n) [kPa], for k items in their order and the
            tiles in the socket's order; differences of the first item are NaN.
        """
        rows = self.table.query("part == 'tiles' and quantity == 'mean pressure'")
        value, low, high = (
            rows[name].to_numpy().reshape(-1, len(self.items)).T for name in columns
        )
        return Quantity(value, low, high, np.abs(value))


def _cell(row: Mapping[str, Any], columns: Sequence[str]) -> str:
    """A value or difference with its interval."""
    sign = "+" if columns == DIFFERENCE else "-"
    value, low, high = (row[name] for name in columns)
    shown = _number(row, columns[0], sign) if np.isfinite(value) else ""
    if np.isnan([low, high]).any():
        return shown
    if not np.isfinite([low, high]).all():
        return NOTHING
    differs = " *" if sign == "+" and is_clear(low, high) else ""
    return f"{shown} ({_number(row, columns[1])} to {_number(row, columns[2])}){differs}"


def _number(row: Mapping[str, Any], column: str, sign: str = "-") -> str:
    return _shown(row, row[column], sign, 0 if column in VALUE else _LEAST)


def _shown(row: Mapping[str, Any], value: float, sign: str = "-", least: int = _LEAST) -> str:
    """A number of a row, in its unit; by default with the decimals of a difference."""
    return number(f"{row['quantity']} [{row['unit']}]", value, sign, least)
