"""Bench data of a cluster. Files name their columns and units; nothing is guessed."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.cells import split_title, units_below, without_comments
from socket_testbed.documents import read_text, split_separator
from socket_testbed.drivers.clusters.fdc1004 import PER_PICOFARAD
from socket_testbed.errors import CalibrationError

if TYPE_CHECKING:
    import pandas as pd

_FORCES = {"N": 1.0, "kN": 1e3}  # a stress may be given as a force on the cluster's area
_COUNTS = {
    "counts": 1.0 / PER_PICOFARAD,  # a reading of the FDC1004, of 24 bits
    "counts24": 1.0 / PER_PICOFARAD,  # 24-bit counts, however small or large
    "words": 2.0**8 / PER_PICOFARAD,  # its upper 16 bits, the register MEASn_MSB alone
}
_BITS = {"counts": 24, "words": 16}  # of a reading, with its sign
STRESSES = ("normal", "shear_x", "shear_y")
INPUTS = ("c0", "c1", "c2", "c3")
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "sec": 1.0},
    "cycle": {},
    **{name: {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, **_FORCES} for name in STRESSES},
    **{name: {"pF": 1.0, "fF": 1e-3, "nF": 1e3, **_COUNTS} for name in INPUTS},
}
"""Units of each quantity with their factors to s, Pa (or N) and pF; a cycle has no unit."""

_ALL_UNITS = frozenset(unit for units in UNITS.values() for unit in units)

UNNAMED = -1  # cycle of a row if its file has no cycle column
_SCALE_PERCENTILE = 99.0  # [%]; ignores a few wrong stresses


@dataclass(frozen=True)
class BenchData:
    """Bench data of one cluster, one row per reading.

    Attributes:
        files: Names of the files, without their folders.
        file: Index into `files` of each reading's file, shape (N,).
        line: Line of each reading in its file, from 1, shape (N,).
        time: Time of each reading as in its file, shape (N,) [s]; NaN if the file has no time.
        cycle: Load cycle of each reading, numbered within its file, shape (N,); `UNNAMED` if the
            file names no cycles.
        capacitance: Capacitances by input of the converter (c0 to c3), shape (N, 4) [pF].
        stress: Known normal stress (positive in compression), shear x and shear y along the
            cluster's axes, shape (N, 3) [Pa].
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
        """Select rows."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _ARRAYS})

    @property
    def full_scale(self) -> FloatArray:
        """Largest magnitude of each known stress, shape (3,) [Pa]."""
        return np.abs(self.stress).max(axis=0)

    def place(self, row: int) -> str:
        """File and line of a row, for messages."""
        return f"{self.files[self.file[row]]} line {self.line[row]}"


_ARRAYS = ("file", "line", "time", "cycle", "capacitance", "stress")  # of a BenchData


def scaled_stress(stress: FloatArray) -> FloatArray:
    """Scale stresses (N, 3) [Pa] by their 99th percentiles and clip them to [-1, 1].

    Returns them in the order given, shape (N, 3) [-]. Up to one row in a hundred may be wrong. A
    stress that is hardly ever applied gives zero.
    """
    scale = np.percentile(np.abs(stress), _SCALE_PERCENTILE, axis=0, method="lower")
    return np.clip(stress / np.where(scale > 0.0, scale, np.inf), -1.0, 1.0)


def join_benches(parts: Sequence[BenchData]) -> BenchData:
    """Concatenate the data of several files, in order; `file` then indexes all their `files`."""
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
    offsets = np.cumsum([0, *(len(part.files) for part in parts[:-1])])
    arrays["file"] += np.repeat(offsets, [len(part) for part in parts])
    return BenchData(tuple(name for part in parts for name in part.files), **arrays)


# Readings outside these ranges are not in the stated unit.
_RANGES = {
    "normal": (-1e3, 2e6),  # [Pa]; the load cell's zero may be slightly off
    "shear_x": (-1e6, 1e6),
    "shear_y": (-1e6, 1e6),
    **dict.fromkeys(INPUTS, (0.01, 100.0)),  # [pF]
}
_STEP_RANGE = (1e-3, 60.0)  # [s]; median time between readings
_MAX_FILE_SIZE = 2**27  # [bytes]


def read_bench(
    path: Path, columns: Mapping[str, str], units: Mapping[str, str], area: float | None = None
) -> BenchData:
    """Read a bench file.

    The file has a header and one row per reading, with the columns `normal`, `shear_x`, `shear_y`
    and `c0` to `c3` (the converter's inputs), and optionally `time` and `cycle`. Units are given in
    the header, such as `normal [kPa]`, or in a separate row below it. Columns are separated by
    commas, semicolons or tabs, or as a first line such as `sep=;` states; other columns are
    ignored, as are lines that begin with `#`, `%` or `//`.

    Args:
        path: The file.
        columns: Other titles of the columns, keyed by quantity; empty if all have their usual one.
        units: Units that override the header's, such as `kPa`, keyed by quantity; see `UNITS`.
        area: Area on which a stress given as a force in N or kN acts [m^2]; None if no stress is.

    Raises:
        CalibrationError: If a column, a unit or the area is missing, a value is not a number or
            implausible in its unit, times do not increase, or an input has one value in every row.
    """
    required, optional = (*STRESSES, *INPUTS), ("time", "cycle")
    found = _find_columns(path, required, optional, columns, units, area)
    lines = np.array(found["c0"].cells.index, dtype=np.int64)
    cycle = np.full(len(lines), UNNAMED)
    if "cycle" in found:
        cycle = np.unique(found["cycle"].filled_cells(), return_inverse=True)[1]
    values = {name: found[name].values() for name in required}
    for name in INPUTS:
        if np.ptp(values[name]) == 0.0:
            raise found[name].error(
                f"is {values[name][0] / found[name].scale:g} {found[name].unit} in every row",
                "check the wire of this input, or name its column",
            )
    return BenchData(
        files=(path.name,),
        file=np.zeros(len(lines), dtype=np.int64),
        line=lines,
        time=found["time"].times() if "time" in found else np.full(len(lines), np.nan),
        cycle=cycle.astype(np.int64),
        capacitance=np.column_stack([values[name] for name in INPUTS]),
        stress=np.column_stack([values[name] for name in STRESSES]),
    )


def read_unloaded(path: Path, columns: Mapping[str, str], units: Mapping[str, str]) -> FloatArray:
    """Read `c0` to `c3` of the unloaded cluster, shape (N, 4) [pF]; format as in `read_bench`.

    Args:
        path: The file; columns other than these four are ignored.
        columns: Other titles of the columns, keyed by quantity; empty if all have their usual one.
        units: Units that override the header's, such as `fF`, keyed by quantity; see `UNITS`.

    Raises:
        CalibrationError: If a column or a unit is missing, or a value is not a number or
            implausible in its unit.
    """
    found = _find_columns(path, INPUTS, (), columns, units)
    return np.column_stack([found[name].values() for name in INPUTS])


@dataclass(frozen=True)
class _Column:
    """A quantity's column: its cells as text, indexed by line, its unit and the unit's factor."""

    quantity: str
    file: str
    title: str
    cells: pd.Series
    unit: str = ""
    scale: float = 1.0  # [s, pF or Pa]

    def error(self, fact: str, hint: str) -> CalibrationError:
        return CalibrationError(f"{self.file}: '{self.title}' {fact}", hint)

    def filled_cells(self) -> pd.Series:
        empty = self.cells == ""
        if empty.any():
            raise self.error(f"is empty in line {empty.idxmax()}", "fill the cell or its line")
        return self.cells

    def numbers(self) -> FloatArray:
        """The cells as numbers in the column's unit, shape (N,)."""
        import pandas as pd

        cells = self.filled_cells()
        values = np.asarray(pd.to_numeric(cells.astype(object), errors="coerce"), dtype=np.float64)
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values)))
            raise self.error(
                f"holds '{cells.iloc[row]}' in line {cells.index[row]}, which is not a number",
                "give a number there; units belong in the header",
            )
        return values

    def values(self) -> FloatArray:
        """Stresses [Pa] or capacitances [pF], checked for plausibility, shape (N,)."""
        numbers = self.numbers()
        if self.unit in _BITS:
            self._refuse_foreign_counts(numbers)
        low, high = (limit / self.scale for limit in _RANGES[self.quantity])
        outside = np.flatnonzero((numbers < low) | (numbers > high))
        if len(outside):
            raise self.error(
                f"is {numbers[outside[0]]:g} {self.unit} in line {self.cells.index[outside[0]]},"
                f" outside {low:g} to {high:g} {self.unit}",
                f"check the value, its sign and its unit; --units {self.quantity}=UNIT names"
                " another",
            )
        return numbers * self.scale

    def _refuse_foreign_counts(self, numbers: FloatArray) -> None:
        """Refuse counts that are not signed readings of the FDC1004 with the bits of the unit."""
        bits = _BITS[self.unit]
        largest, row = float(numbers.max()), int(numbers.argmax())
        where = f"{largest:.0f} {self.unit} in line {self.cells.index[row]}"
        if largest >= 2**bits:
            raise self.error(
                f"is {where}, beyond the {bits} bits of a reading",
                "divide by 256 if the register MEASn_LSB was appended with its empty lower byte",
            )
        if largest >= 2 ** (bits - 1):
            negative = (largest - 2**bits) * self.scale
            raise self.error(
                f"is {where}, an unsigned reading of {negative:.3g} pF",
                f"subtract {2**bits} from readings of {2 ** (bits - 1)} and above, and add 3.125 pF"
                " for each step of CAPDAC, so that no capacitance is negative; --units"
                f" {self.quantity}=counts24 takes sums that hold CAPDAC already",
            )
        if self.unit == "counts" and largest < 2**16:
            raise self.error(
                f"is at most {largest:.0f} counts, {largest * self.scale:.2g} pF: likely the upper"
                " 16 bits of the readings",
                f"give --units {self.quantity}=words if they are; counts24 takes them as they are",
            )

    def times(self) -> FloatArray:
        """Increasing times, shape (N,) [s]."""
        numbers = self.numbers()
        steps = np.diff(numbers)
        if (steps <= 0.0).any():
            raise self.error(
                f"does not increase at line {self.cells.index[1:][steps <= 0.0][0]}",
                "give the readings in order, and each run in a separate file",
            )
        median = float(np.median(steps)) if len(steps) else _STEP_RANGE[0] / self.scale
        if not _STEP_RANGE[0] <= median * self.scale <= _STEP_RANGE[1]:
            other = "ms" if self.unit == "s" else "s"
            raise self.error(
                f"has steps of {median:.3g} {self.unit} in the median, implausible for a bench",
                f"correct the header, or give --units time={other} if these are {other}",
            )
        return numbers * self.scale


def _read_cells(path: Path) -> tuple[list[str], pd.DataFrame]:
    """Titles, including units from a row below them, and the cells as text, indexed by line."""
    import pandas as pd  # imported late: every verb imports this module

    text = read_text(path, largest=_MAX_FILE_SIZE).replace("\r\n", "\n").replace("\r", "\n")
    separator, text = split_separator(without_comments(text))
    above = len(text) - len(text.lstrip(" \n"))
    try:
        cells = pd.read_csv(
            io.StringIO(text[above:]),
            sep=separator,
            header=None,
            dtype=str,
            keep_default_na=False,
            skip_blank_lines=False,
        )
    except pd.errors.EmptyDataError:
        cells = pd.DataFrame()
    except pd.errors.ParserError as error:
        fact = str(error).strip().rpartition("error: ")[2].replace("row", "line")
        raise CalibrationError(
            f"{path}: {fact}",
            "give every row as many fields as the header; separate them with ';' if the numbers"
            " have decimal commas",
        ) from None
    cells = cells.fillna("").apply(lambda column: column.str.strip())
    cells.index += 1 + text[:above].count("\n")
    cells = cells[cells.ne("").any(axis=1)]
    if len(cells) < 2:
        raise CalibrationError(
            f"{path}: has no data rows", "give a header, and below it one row per reading"
        )
    titles, cells = cells.iloc[0].tolist(), cells[1:]
    if separator != ",":
        cells = cells.replace(",", ".", regex=True)
    if with_units := units_below(titles, cells.iloc[0].tolist(), _ALL_UNITS):
        titles, cells = with_units, cells[1:]
    if cells.empty:
        raise CalibrationError(
            f"{path}: has no data rows", "give a row per reading below the units"
        )
    return titles, cells


def _find_columns(
    path: Path,
    required: Sequence[str],
    optional: Sequence[str],
    titles: Mapping[str, str],
    units: Mapping[str, str],
    area: float | None = None,
) -> dict[str, _Column]:
    """Find the columns of the quantities in a file."""
    header, cells = _read_cells(path)
    found: dict[str, _Column] = {}
    missing = []
    for name in (*required, *optional):
        matches = _matches(header, name, titles.get(name))
        if len(matches) > 1:
            raise CalibrationError(
                f"{path.name}: {name} is in {len(matches)} columns:"
                f" {', '.join(repr(header[i]) for i in matches)}",
                f"rename all but one, or name it with --columns {name}=NAME",
            )
        if matches:
            found[name] = _Column(name, path.name, header[matches[0]], cells[matches[0]])
        elif name in required or name in titles:
            missing.append(name)
    if missing:
        shown = ", ".join(f"'{title}'" for title in header if title)
        raise CalibrationError(
            f"{path.name}: no column for {', '.join(missing)} (its header has {shown})",
            f"name it with --columns {' '.join(f'{name}=NAME' for name in missing)}",
        )
    return {name: _with_unit(column, units, area) for name, column in found.items()}


def _matches(header: Sequence[str], name: str, wanted: str | None) -> list[int]:
    """Indices of the columns that match a quantity, by its name or the requested title."""
    names = [split_title(title, _ALL_UNITS)[0] for title in header]
    if wanted is None:
        return [i for i, title in enumerate(names) if title.lower() == name]
    exact = [i for i, title in enumerate(header) if title == wanted.strip()]
    return exact or [i for i, title in enumerate(names) if title == wanted.strip()]


def _with_unit(column: _Column, units: Mapping[str, str], area: float | None) -> _Column:
    """The column with the unit from its title, or the one that overrides it.

    A stress may be given as a force on an area [m^2].
    """
    name, known = column.quantity, UNITS[column.quantity]
    written = units.get(name) or split_title(column.title, _ALL_UNITS)[1]
    if not known:
        return column
    if not written:
        raise column.error(
            "has no unit",
            f"write it into the header, such as '{column.title} [{next(iter(known))}]', or give"
            f" --units {name}={next(iter(known))}",
        )
    # mPa means millipascal, so MPa must match exactly.
    alike = [u for u in known if u == written or (u.lower() == written.lower() and u != "MPa")]
    if not alike:
        raise column.error(
            f"is in '{written}', not one of the units of {name}",
            f"name one of {', '.join(known)} in the header or with --units {name}=UNIT",
        )
    unit = alike[0]
    if unit not in _FORCES:
        return replace(column, unit=unit, scale=known[unit])
    if area is None:
        raise column.error(
            f"is a force in {unit}",
            "give the area it acts on with --area, in m^2, or with --geometry",
        )
    return replace(column, unit=unit, scale=known[unit] / area)
