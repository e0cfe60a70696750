"""Bench data of a cluster, read from files whose columns and units are named, never guessed."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.documents import read_text
from socket_testbed.errors import CalibrationError

if TYPE_CHECKING:
    import pandas as pd

_FORCES = {"N": 1.0, "kN": 1e3}  # a stress may be given as the force on the cluster's area
_COUNTS = 2.0**19  # [1/pF] of the converter, an FDC1004
STRESSES = ("normal", "shear_x", "shear_y")
INPUTS = ("c0", "c1", "c2", "c3")
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "sec": 1.0},
    "cycle": {},
    **{name: {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, **_FORCES} for name in STRESSES},
    **{name: {"pF": 1.0, "fF": 1e-3, "nF": 1e3, "counts": 1.0 / _COUNTS} for name in INPUTS},
}
"""The units of each quantity, with their size in s, Pa (or N) and pF; a cycle has none."""

UNNAMED = -1  # the cycle of a row in a file that names none
_SOUND = 99.0  # [%] of the rows, at least


@dataclass(frozen=True)
class BenchData:
    """Bench data of one cluster, one row per reading."""

    files: tuple[str, ...]
    file: IntArray  # (N,); index into `files`
    line: IntArray  # (N,); of its file
    time: FloatArray  # (N,) [s]; within its file, NaN where that has none
    cycle: IntArray  # (N,); of its file, `UNNAMED` where that names none
    capacitance: FloatArray  # (N, 4) [pF]; by input of the converter
    stress: FloatArray  # (N, 3) [Pa]; normal (positive in compression), shear x, shear y

    def __len__(self) -> int:
        return len(self.file)

    def __getitem__(self, rows: BoolArray | IntArray) -> BenchData:
        """Some of the rows."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _ARRAYS})

    @property
    def full_scale(self) -> FloatArray:
        """Largest size of each known stress, shape (3,) [Pa]."""
        return np.abs(self.stress).max(axis=0)

    def place(self, row: int) -> str:
        """File and line of a row, in words."""
        return f"{self.files[self.file[row]]} line {self.line[row]}"


_ARRAYS = ("file", "line", "time", "cycle", "capacitance", "stress")  # of a BenchData


def scaled_stress(stress: FloatArray) -> FloatArray:
    """Stresses (N, 3) [Pa] as parts of the largest ones, however wrong one in a hundred is.

    The parts are from -1 to 1; zero for a stress that is hardly ever applied.
    """
    scale = np.percentile(np.abs(stress), _SOUND, axis=0, method="lower")
    return np.clip(stress / np.where(scale > 0.0, scale, np.inf), -1.0, 1.0)


def join_benches(parts: Sequence[BenchData]) -> BenchData:
    """Put the data of several files together, in their order."""
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
    offsets = np.cumsum([0, *(len(part.files) for part in parts[:-1])])
    arrays["file"] += np.repeat(offsets, [len(part) for part in parts])
    return BenchData(tuple(name for part in parts for name in part.files), **arrays)


# Readings outside these ranges have another unit than the one that is named.
_RANGES = {
    "normal": (-1e3, 2e6),  # [Pa]; a load cell's zero may be a little off
    "shear_x": (-1e6, 1e6),
    "shear_y": (-1e6, 1e6),
    **dict.fromkeys(INPUTS, (0.01, 100.0)),  # [pF]
}
_STEP_RANGE = (1e-3, 60.0)  # [s] between readings, in the median
_LARGEST_FILE = 2**27  # [bytes]


def read_bench(
    path: Path, columns: Mapping[str, str], units: Mapping[str, str], area: float | None = None
) -> BenchData:
    """Read a bench file.

    It has a header and a row per reading, with the columns `normal`, `shear_x`, `shear_y` and
    `c0` to `c3` (the converter's inputs), and optionally `time` and `cycle`. Their units
    stand in the header, such as `normal [kPa]`, or in a row of their own below it; commas,
    semicolons or tabs separate the columns. Others are ignored. `columns` names quantities that
    the header calls otherwise, `units` (see `UNITS`) count instead of the header's, and a stress in
    N acts on an area [m^2].
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
                "check this input's wire, or name the column that holds it",
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
    """Read `c0` to `c3` of the unloaded cluster, shape (N, 4) [pF]: see `read_bench`."""
    found = _find_columns(path, INPUTS, (), columns, units)
    return np.column_stack([found[name].values() for name in INPUTS])


@dataclass(frozen=True)
class _Column:
    """A quantity's column: its cells as text by their lines, its unit and the unit's size."""

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
                "give a number there; a unit belongs into the header",
            )
        return values

    def values(self) -> FloatArray:
        """Stresses [Pa] or capacitances [pF] that can be, shape (N,)."""
        numbers = self.numbers()
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

    def times(self) -> FloatArray:
        """Increasing times, shape (N,) [s]."""
        numbers = self.numbers()
        steps = np.diff(numbers)
        if (steps <= 0.0).any():
            raise self.error(
                f"does not increase at line {self.cells.index[1:][steps <= 0.0][0]}",
                "give the readings in their order, and each run as a file of its own",
            )
        usual = float(np.median(steps)) if len(steps) else _STEP_RANGE[0] / self.scale
        if not _STEP_RANGE[0] <= usual * self.scale <= _STEP_RANGE[1]:
            other = "ms" if self.unit == "s" else "s"
            raise self.error(
                f"has steps of {usual:.3g} {self.unit} in the median, which no bench reads at",
                f"correct the header, or give --units time={other} if these are {other}",
            )
        return numbers * self.scale


def _read_cells(path: Path) -> tuple[list[str], pd.DataFrame]:
    """The titles, with the units of a row below them, and the cells as text by their lines."""
    import pandas as pd  # only to read; this module is imported by every verb

    text = read_text(path, largest=_LARGEST_FILE)
    above = len(text) - len(text.lstrip())
    first = text[above:].partition("\n")[0]
    separator = max("\t;,", key=first.count)
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
            f"{path}: holds no row of data", "give a header and below it a row per reading"
        )
    titles, cells = cells.iloc[0].tolist(), cells[1:]
    if separator != ",":
        cells = cells.replace(",", ".", regex=True)
    below = [cell.strip("[]()") for cell in cells.iloc[0]]
    if set(below) & _ALL_UNITS and not any(re.match(r"[-+.]?\d", cell) for cell in below):
        named = zip(titles, below, strict=True)
        titles = [f"{t} [{unit}]" if unit and not _split(t)[1] else t for t, unit in named]
        cells = cells[1:]
    return titles, cells


_ALL_UNITS = {unit for units in UNITS.values() for unit in units}
_BRACKETED = re.compile(r"(.*?)[\s_]*[\[(]([^\])]*)[\])]")
_SUFFIXED = re.compile(rf"(.*?)[\s_]+({'|'.join(sorted(_ALL_UNITS))})", flags=re.IGNORECASE)


def _split(title: str) -> tuple[str, str]:
    """Name and unit of a column: `normal [kPa]`, `normal (kPa)`, `normal_kPa`, `normal kPa`."""
    found = _BRACKETED.fullmatch(title) or _SUFFIXED.fullmatch(title)
    return (found[1].strip(), found[2].strip()) if found else (title, "")


def _find_columns(
    path: Path,
    required: Sequence[str],
    optional: Sequence[str],
    titles: Mapping[str, str],
    units: Mapping[str, str],
    area: float | None = None,
) -> dict[str, _Column]:
    """The columns of the quantities that a file has."""
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
    """The columns that may be a quantity's, by its name or the title that is wanted."""
    if wanted is None:
        return [i for i, title in enumerate(header) if _split(title)[0].lower() == name]
    exact = [i for i, title in enumerate(header) if title == wanted.strip()]
    return exact or [i for i, title in enumerate(header) if _split(title)[0] == wanted.strip()]


def _with_unit(column: _Column, units: Mapping[str, str], area: float | None) -> _Column:
    """The column with the unit of its title, or the one that is named instead.

    A stress may be given as a force on an area [m^2].
    """
    name, known = column.quantity, UNITS[column.quantity]
    written = units.get(name) or _split(column.title)[1]
    if not known:
        return column
    if not written:
        raise column.error(
            "has no unit",
            f"write it into the header, such as '{column.title} [{next(iter(known))}]', or give"
            f" --units {name}={next(iter(known))}",
        )
    # mPa is a thousandth, not a million: MPa has to be written as it is.
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
