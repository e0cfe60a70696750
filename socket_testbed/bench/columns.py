"""Which column of a table is which quantity, and in which unit: named, never guessed."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from socket_testbed.bench.table import Table
from socket_testbed.documents import closest
from socket_testbed.errors import CalibrationError

NEWTON = "N"  # a stress may be given as the force on the cluster's area

_CAPACITANCE = {"pF": 1.0, "fF": 1e-3, "nF": 1e3}  # [pF]
_STRESS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, NEWTON: 1.0}  # [Pa], [N]
_TIME = {"s": 1.0, "ms": 1e-3}  # [s]

INPUTS = ("c0", "c1", "c2", "c3")
STRESSES = ("normal", "shear_x", "shear_y")
UNITS: dict[str, dict[str, float]] = {
    "time": _TIME,
    "cycle": {},
    **dict.fromkeys(STRESSES, _STRESS),
    **dict.fromkeys(INPUTS, _CAPACITANCE),
}
"""The units of each quantity, with their size in s, Pa (or N) and pF; a cycle has none."""

_SUFFIXES = "|".join(sorted({unit for units in UNITS.values() for unit in units}))
_BRACKETED = re.compile(r"(.*?)[\s_]*[\[(]([^\])]*)[\])]")
_SUFFIXED = re.compile(rf"(.*?)[\s_]+({_SUFFIXES})", flags=re.IGNORECASE)
_SHOWN = 8  # names of a header that an error lists


@dataclass(frozen=True)
class Column:
    """Where a quantity stands in a table.

    Attributes:
        index: The column of the table.
        title: Its name in the header.
        unit: The quantity's unit; empty where it has none.
        scale: Size of the unit in s, pF, Pa or N.
    """

    index: int
    title: str
    unit: str
    scale: float


def split_title(title: str) -> tuple[str, str]:
    """Name and unit of a column: `normal [kPa]`, `normal (kPa)`, `normal_kPa`, `normal kPa`.

    Returns:
        The name and the unit; without a unit, the title and nothing.
    """
    found = _BRACKETED.fullmatch(title) or _SUFFIXED.fullmatch(title)
    return (found[1].strip(), found[2].strip()) if found else (title, "")


def find_columns(
    table: Table,
    required: Sequence[str],
    optional: Sequence[str],
    titles: Mapping[str, str],
    units: Mapping[str, str],
) -> dict[str, Column]:
    """Find quantities in the columns of a table.

    Args:
        table: The table.
        required: Quantities of `UNITS` that must be there.
        optional: Those that may be.
        titles: Names in the header, with or without the unit, of quantities that the header
            does not call by their own names.
        units: Units of quantities, instead of the header's.

    Returns:
        The columns of the quantities that are there.

    Raises:
        CalibrationError: If a quantity is missing, stands twice, shares its column with
            another one, or has no unit or an unknown one.
    """
    places = {name: _find(table, name, titles) for name in (*required, *optional)}
    missing = [name for name in required if places[name] is None]
    if missing:
        raise CalibrationError(
            f"{table.name}: no column for {', '.join(missing)} (its header has {_shown(table)})",
            f"name it with --columns {' '.join(f'{name}=NAME' for name in missing)}",
        )
    columns = {
        name: _column(table, name, index, units)
        for name, index in places.items()
        if index is not None
    }
    lacking = [name for name, column in columns.items() if UNITS[name] and not column.unit]
    if lacking:
        name = lacking[0]
        example = next(iter(UNITS[name]))
        raise CalibrationError(
            f"{table.name}: no unit for {', '.join(lacking)}",
            f"write it into the header, such as '{columns[name].title} [{example}]', or give"
            f" --units {name}={example}",
        )
    _refuse_shared(table, columns)
    return columns


def _find(table: Table, name: str, titles: Mapping[str, str]) -> int | None:
    wanted = titles.get(name)
    if wanted is None:
        matches = [i for i, t in enumerate(table.header) if split_title(t)[0].lower() == name]
    else:
        matches = [i for i, t in enumerate(table.header) if t == wanted.strip()]
        matches = matches or [
            i for i, t in enumerate(table.header) if split_title(t)[0] == wanted.strip()
        ]
        if not matches:
            raise CalibrationError(
                f"{table.name}: no column '{wanted}' for {name} (its header has {_shown(table)})",
                closest(wanted, [title for title in table.header if title]),
            )
    if len(matches) > 1:
        raise CalibrationError(
            f"{table.name}: {name} stands in {len(matches)} columns:"
            f" {', '.join(repr(table.header[i]) for i in matches)}",
            f"rename all but one, or name it with --columns {name}=NAME",
        )
    return matches[0] if matches else None


def _column(table: Table, name: str, index: int, units: Mapping[str, str]) -> Column:
    title = table.header[index]
    written = units.get(name) or split_title(title)[1]
    if not written or not UNITS[name]:
        return Column(index, title, "", 1.0)
    unit = _known_unit(written, UNITS[name])
    if unit is None:
        raise CalibrationError(
            f"{table.name}: {name} is in '{written}', which is no unit of it",
            f"name one of {', '.join(UNITS[name])} in the header or with --units {name}=UNIT",
        )
    return Column(index, title, unit, UNITS[name][unit])


def _known_unit(written: str, known: Collection[str]) -> str | None:
    if written in known:
        return written
    alike = [unit for unit in known if unit.lower() == written.lower()]
    # mPa is a thousandth, not a million: MPa has to be written as it is.
    return alike[0] if alike and alike[0] != "MPa" else None


def _refuse_shared(table: Table, columns: Mapping[str, Column]) -> None:
    owners: dict[int, str] = {}
    for name, column in columns.items():
        if column.index in owners:
            raise CalibrationError(
                f"{table.name}: '{column.title}' is both {owners[column.index]} and {name}",
                "name a column of its own for each with --columns",
            )
        owners[column.index] = name


def _shown(table: Table) -> str:
    named = [f"'{title}'" for title in table.header if title]
    more = ", ..." if len(named) > _SHOWN else ""
    return ", ".join(named[:_SHOWN]) + more
