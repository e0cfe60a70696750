"""Bench data of a cluster, read from files whose columns and units are named, never guessed."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.errors import CalibrationError
from socket_testbed.files import closest, decimal

FORCES = {"N": 1.0, "kN": 1e3}  # a stress may be given as the force on the cluster's area
COUNTS = 2.0**19  # [1/pF] of the converter, an FDC1004
STRESSES = ("normal", "shear_x", "shear_y")
INPUTS = ("c0", "c1", "c2", "c3")
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "sec": 1.0},
    "cycle": {},
    **{name: {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, **FORCES} for name in STRESSES},
    **{name: {"pF": 1.0, "fF": 1e-3, "nF": 1e3, "counts": 1.0 / COUNTS} for name in INPUTS},
}
"""The units of each quantity, with their size in s, Pa (or N) and pF; a cycle has none."""

UNNAMED = -1  # the cycle of a row in a file that names none
_SOUND = 99.0  # [%] of the rows, at least


@dataclass(frozen=True)
class BenchData:
    """Bench data of one cluster, one row per reading.

    Attributes:
        files: Names of the files.
        file: Which of them each row is from, shape (N,).
        line: The line it stands on there, shape (N,).
        time: Time within its file, shape (N,) [s]; NaN where the file has none.
        cycle: Which cycle of its file a row belongs to, shape (N,); `UNNAMED` where the file
            names none.
        capacitance: Capacitances by input of the converter, shape (N, 4) [pF].
        stress: Known normal stress (positive in compression), shear x and shear y in the
            cluster's frame, shape (N, 3) [Pa].
    """

    files: tuple[str, ...]
    file: IntArray
    line: IntArray
    time: FloatArray
    cycle: IntArray
    capacitance: FloatArray
    stress: FloatArray

    def __len__(self) -> int:
        return len(self.file)

    def __getitem__(self, rows: BoolArray | IntArray) -> BenchData:
        """Some of the rows."""
        arrays = {name: getattr(self, name)[rows] for name in _ARRAYS}
        return replace(self, **arrays)

    @property
    def full_scale(self) -> FloatArray:
        """Largest size of each known stress, shape (3,) [Pa]."""
        return np.abs(self.stress).max(axis=0)

    def place(self, row: int) -> str:
        """File and line of a row, in words."""
        return f"{self.files[self.file[row]]} line {self.line[row]}"


_ARRAYS = ("file", "line", "time", "cycle", "capacitance", "stress")  # of a BenchData


def scaled_stress(stress: FloatArray) -> FloatArray:
    """Stresses as parts of the largest ones, from -1 to 1, however wrong one in a hundred is.

    Args:
        stress: Normal stress, shear x and shear y, shape (N, 3) [Pa].

    Returns:
        Parts, shape (N, 3) [-]; zero for a stress that is hardly ever applied.
    """
    scale = np.percentile(np.abs(stress), _SOUND, axis=0, method="lower")
    return np.clip(stress / np.where(scale > 0.0, scale, np.inf), -1.0, 1.0)


def join_benches(parts: Sequence[BenchData]) -> BenchData:
    """Put the data of several files together, in their order."""
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
    offsets = np.cumsum([0, *(len(part.files) for part in parts[:-1])])
    arrays["file"] += np.repeat(offsets, [len(part) for part in parts])
    return BenchData(tuple(name for part in parts for name in part.files), **arrays)


# What a reading can be; beyond it, the unit is not the one that is named.
_CAPACITANCE_RANGE = (0.01, 100.0)  # [pF]
_STRESS_RANGES = {
    "normal": (-1e3, 2e6),  # [Pa]; a load cell's zero may be a little off
    "shear_x": (-1e6, 1e6),
    "shear_y": (-1e6, 1e6),
}
_STEP_RANGE = (1e-3, 60.0)  # [s] between readings, in the median


def read_bench(
    path: Path,
    columns: Mapping[str, str],
    units: Mapping[str, str],
    area: float | None = None,
) -> BenchData:
    """Read a bench file.

    It has a header and a row per reading, with the columns `normal`, `shear_x`, `shear_y` and
    `c0` to `c3` (the converter's inputs), and optionally `time` and `cycle`. Their units
    stand in the header, such as `normal [kPa]`, or in a row of their own below it. Other columns
    are ignored.

    Args:
        path: The file; commas, semicolons or tabs separate its columns.
        columns: Names in the header of quantities that it calls otherwise.
        units: Units of quantities, instead of the header's, see `UNITS`.
        area: Area on which a stress in N acts [m^2].

    Raises:
        CalibrationError: If the file is wrong, naming the line and the column.
    """
    table = read_table(path)
    found = find_columns(table, (*STRESSES, *INPUTS), ("time", "cycle"), columns, units)
    rows = len(table.lines)
    return BenchData(
        files=(table.name,),
        file=np.zeros(rows, dtype=np.int64),
        line=table.lines,
        time=_time(found["time"]) if "time" in found else np.full(rows, np.nan),
        cycle=_cycles(found["cycle"]) if "cycle" in found else np.full(rows, UNNAMED),
        capacitance=np.column_stack([_changing_capacitance(found[name]) for name in INPUTS]),
        stress=np.column_stack([_stress(found[name], area) for name in STRESSES]),
    )


def read_unloaded(path: Path, columns: Mapping[str, str], units: Mapping[str, str]) -> FloatArray:
    """Read the capacitances `c0` to `c3` of the unloaded cluster from a file.

    Args:
        path: The file; see `read_bench`. Its other columns are ignored.
        columns: Names in the header of quantities that it calls otherwise.
        units: Units of quantities, instead of the header's.

    Returns:
        Capacitances by input, shape (N, 4) [pF].

    Raises:
        CalibrationError: If the file is wrong, naming the line and the column.
    """
    found = find_columns(read_table(path), INPUTS, (), columns, units)
    return np.column_stack([found[name].values(*_CAPACITANCE_RANGE) for name in INPUTS])


def _time(column: BenchColumn) -> FloatArray:
    time = column.numbers() * column.scale
    steps = np.diff(time)
    backwards = np.flatnonzero(steps <= 0.0)
    if len(backwards):
        raise CalibrationError(
            f"{column.table.name}: '{column.title}' does not increase at line"
            f" {column.table.lines[backwards[0] + 1]}",
            "give the readings in their order, and each run as a file of its own",
        )
    usual = float(np.median(steps)) if len(steps) else _STEP_RANGE[0]
    if not _STEP_RANGE[0] <= usual <= _STEP_RANGE[1]:
        other = "ms" if column.unit == "s" else "s"
        raise CalibrationError(
            f"{column.table.name}: the steps of '{column.title}' are {usual / column.scale:.3g}"
            f" {column.unit} in the median, which no bench reads at",
            f"correct the header, or give --units time={other} if these are {other}",
        )
    return time


def _cycles(column: BenchColumn) -> IntArray:
    return np.unique(column.texts(), return_inverse=True)[1].astype(np.int64)


def _changing_capacitance(column: BenchColumn) -> FloatArray:
    values = column.values(*_CAPACITANCE_RANGE)
    if np.ptp(values) == 0.0:
        raise CalibrationError(
            f"{column.table.name}: '{column.title}' is {values[0] / column.scale:g} {column.unit}"
            " in every row",
            "check this input's wire, or name the column that holds it",
        )
    return values


def _stress(column: BenchColumn, area: float | None) -> FloatArray:
    if column.unit in FORCES:
        if area is None:
            raise CalibrationError(
                f"{column.table.name}: '{column.title}' is a force in {column.unit}",
                "give the area it acts on with --area, in m^2, or with --geometry",
            )
        column = replace(column, scale=FORCES[column.unit] / area)
    return column.values(*_STRESS_RANGES[column.quantity])


_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", flags=re.ASCII)
_SEPARATORS = "\t;,"


@dataclass(frozen=True)
class BenchTable:
    """The cells of a bench file.

    Attributes:
        name: Name of the file, for errors and reports.
        header: Titles of the columns as the file has them.
        lines: Line of the file that each of the N rows stands on, shape (N,).
        columns: The cells of each column, as text.
        decimal_comma: Whether numbers may have a comma; not where commas separate the cells.
    """

    name: str
    header: tuple[str, ...]
    lines: IntArray
    columns: tuple[tuple[str, ...], ...]
    decimal_comma: bool


@dataclass(frozen=True)
class BenchColumn:
    """The column of a quantity in a table.

    Attributes:
        table: The table.
        quantity: The quantity, one of `UNITS`.
        index: The column of the table.
        unit: The quantity's unit; empty where it has none.
        scale: Size of the unit in s, pF, Pa or N.
    """

    table: BenchTable
    quantity: str
    index: int
    unit: str = ""
    scale: float = 1.0

    @property
    def title(self) -> str:
        """Its title in the header."""
        return self.table.header[self.index]

    def texts(self) -> tuple[str, ...]:
        """The cells as text.

        Raises:
            CalibrationError: If one of them is empty.
        """
        cells = self.table.columns[self.index]
        if "" in cells:
            raise CalibrationError(
                f"{self.table.name}: '{self.title}' is empty in line"
                f" {self.table.lines[cells.index('')]}",
                "fill the cell or remove the line",
            )
        return cells

    def numbers(self) -> FloatArray:
        """The cells as numbers, in the column's unit, shape (N,).

        Raises:
            CalibrationError: If one of them is none.
        """
        values = []
        for cell, line in zip(self.texts(), self.table.lines, strict=True):
            written = cell.replace(",", ".") if self.table.decimal_comma else cell
            try:
                values.append(decimal(written))
            except ValueError:
                raise CalibrationError(
                    f"{self.table.name}: '{self.title}' holds '{cell}' in line {line}, which is no"
                    " number",
                    "give a number there; a unit belongs into the header",
                ) from None
        return np.array(values)

    def values(self, least: float, largest: float) -> FloatArray:
        """The cells as numbers in s, pF or Pa, shape (N,).

        Raises:
            CalibrationError: If one of them is none, or outside of the limits [s, pF or Pa].
        """
        numbers = self.numbers()
        low, high = least / self.scale, largest / self.scale
        outside = np.flatnonzero((numbers < low) | (numbers > high))
        if len(outside):
            raise CalibrationError(
                f"{self.table.name}: '{self.title}' is {numbers[outside[0]]:g} {self.unit} in line"
                f" {self.table.lines[outside[0]]}, outside {low:g} to {high:g} {self.unit}",
                f"check the value, its sign and its unit; --units {self.quantity}=UNIT names"
                " another",
            )
        return numbers * self.scale


def read_table(path: Path) -> BenchTable:
    """Read a table whose cells are separated by commas, semicolons or tabs.

    Lines without any content are left out.

    Raises:
        CalibrationError: If the file cannot be read, has no rows, has a row of another length
            than the header, or repeats the header.
    """
    text = _read_text(path)
    first = text.partition("\n")[0]
    separator = max(_SEPARATORS, key=first.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    header: tuple[str, ...] = ()
    rows: list[tuple[str, ...]] = []
    lines: list[int] = []
    try:
        for cells in reader:
            row = tuple(cell.strip() for cell in cells)
            if not any(row):
                continue
            if not header:
                header = row
                continue
            if not rows and _is_units_row(header, row):
                header = tuple(map(_titled, header, row))
                continue
            _check_row(path.name, header, row, reader.line_num, separator)
            rows.append(row)
            lines.append(reader.line_num)
    except csv.Error as error:
        raise CalibrationError(
            f"{path}: line {reader.line_num} cannot be read as a row ({error})", "correct that line"
        ) from None
    if not rows:
        raise CalibrationError(
            f"{path}: holds no row of data", "give a header and below it a row per reading"
        )
    columns = tuple(zip(*rows, strict=True))
    return BenchTable(path.name, header, np.array(lines, dtype=np.int64), columns, separator != ",")


def _is_units_row(header: tuple[str, ...], row: tuple[str, ...]) -> bool:
    """Whether a row names units, as an MTS export has them below its header."""
    known = {unit for units in UNITS.values() for unit in units}
    cells = {cell.strip("[]()") for cell in row if cell}
    return (
        len(row) == len(header)
        and row != header
        and not any(_NUMBER.fullmatch(cell.replace(",", ".")) for cell in cells)
        and bool(cells & known)
    )


def _titled(title: str, unit: str) -> str:
    """A title with its unit from the row below; its own unit counts more."""
    unit = unit.strip("[]()")
    return f"{title} [{unit}]" if unit and not split_title(title)[1] else title


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise CalibrationError(f"{path}: no such file", "check the path") from None
    except UnicodeDecodeError:
        raise CalibrationError(
            f"{path}: is not UTF-8 text", "save it as CSV (UTF-8) from the spreadsheet"
        ) from None
    except OSError as error:
        raise CalibrationError(
            f"{path}: cannot be read ({error.strerror or error})", "check the file"
        ) from None


def _check_row(
    name: str, header: tuple[str, ...], row: tuple[str, ...], line: int, separator: str
) -> None:
    if row == header:
        raise CalibrationError(
            f"{name}: line {line} repeats the header",
            "put what follows into a file of its own and give both files",
        )
    if len(row) == len(header):
        return
    hint = "give every row as many fields as the header"
    if separator == "," and len(header) < len(row) <= 2 * len(header):
        hint += ", or separate the fields with ';' if the numbers have decimal commas"
    raise CalibrationError(
        f"{name}: line {line} has {len(row)} fields under a header of {len(header)}", hint
    )


_SUFFIXES = "|".join(sorted({unit for units in UNITS.values() for unit in units}))
_BRACKETED = re.compile(r"(.*?)[\s_]*[\[(]([^\])]*)[\])]")
_SUFFIXED = re.compile(rf"(.*?)[\s_]+({_SUFFIXES})", flags=re.IGNORECASE)
_SHOWN = 8  # names of a header that an error lists


def split_title(title: str) -> tuple[str, str]:
    """Name and unit of a column: `normal [kPa]`, `normal (kPa)`, `normal_kPa`, `normal kPa`.

    Returns:
        The name and the unit; without a unit, the title and nothing.
    """
    found = _BRACKETED.fullmatch(title) or _SUFFIXED.fullmatch(title)
    return (found[1].strip(), found[2].strip()) if found else (title, "")


def find_columns(
    table: BenchTable,
    required: Sequence[str],
    optional: Sequence[str],
    titles: Mapping[str, str],
    units: Mapping[str, str],
) -> dict[str, BenchColumn]:
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
        CalibrationError: If a quantity is missing, appears twice, shares its column with
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
        name: _with_unit(BenchColumn(table, name, index), units)
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
    owners: dict[int, str] = {}
    for name, column in columns.items():
        owner = owners.setdefault(column.index, name)
        if owner != name:
            raise CalibrationError(
                f"{table.name}: '{column.title}' is both {owner} and {name}",
                "name a column of its own for each with --columns",
            )
    return columns


def _find(table: BenchTable, name: str, titles: Mapping[str, str]) -> int | None:
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
            f"{table.name}: {name} is in {len(matches)} columns:"
            f" {', '.join(repr(table.header[i]) for i in matches)}",
            f"rename all but one, or name it with --columns {name}=NAME",
        )
    return matches[0] if matches else None


def _with_unit(column: BenchColumn, units: Mapping[str, str]) -> BenchColumn:
    """The column with the unit of its title, or the one that is named instead."""
    known = UNITS[column.quantity]
    written = units.get(column.quantity) or split_title(column.title)[1]
    if not written or not known:
        return column
    # mPa is a thousandth, not a million: MPa has to be written as it is.
    alike = [u for u in known if u == written or (u.lower() == written.lower() and u != "MPa")]
    if not alike:
        raise CalibrationError(
            f"{column.table.name}: {column.quantity} is in '{written}', not one of its units",
            f"name one of {', '.join(known)} in the header or with --units {column.quantity}=UNIT",
        )
    return replace(column, unit=alike[0], scale=known[alike[0]])


def _shown(table: BenchTable) -> str:
    named = [f"'{title}'" for title in table.header if title]
    more = ", ..." if len(named) > _SHOWN else ""
    return ", ".join(named[:_SHOWN]) + more
