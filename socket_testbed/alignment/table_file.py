"""A table of another laboratory as a file: its text, what is stated of it, and its times."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from socket_testbed.alignment.units import WRITTEN, common_factor
from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.cells import TextTable, read_text_table, split_title
from socket_testbed.documents import read_text
from socket_testbed.errors import ConfigurationError, listed

MAX_FILE_SIZE = 2**29  # [bytes]
_SECOND = 1_000_000_000  # [ns]
_LABVIEW, _LABVIEW_END = "LabVIEW Measurement", "***End_of_Header***"
_TIMES = frozenset(
    {"time", "t", "timestamp", "timestamps", "time stamp", "stamp", "header.stamp", "__time"}
    | {"%time", "x_value", "elapsed", "elapsed time", "relative time", "time of day", "zeit"}
    | {"datetime", "date time", "date/time", "date_time", "utc", "epoch", "unix time"}
    | {"seconds", "secs", "sec", "s", "millis", "ms", "micros", "us"}
)
_DATES = frozenset(("date", "datum", "day"))
_OF_TITLE = {"x_value": "s"}  # unit of a column whose program defines it
_ISO = re.compile(r"\d{4}-\d{2}-\d{2}(?:[T _]\d{1,2}:\d{2}.*)?")
_GERMAN = re.compile(r"\d{1,2}\.\d{1,2}\.\d{4}(?: .*)?")
_CLOCK = re.compile(r"\d{1,2}:\d{2}(?::\d{2}(?:\.\d*)?)?")
_STEPS = (5e-5, 60.0)  # [s]; a median step outside has another unit
_DATED = (9e8, 4e9)  # [s] since 1970, from 1998 to 2096
_MAX_TITLES = 12  # in an error


@dataclass(frozen=True)
class TableFormat:
    """What a user states of a table, because its titles do not.

    Attributes:
        columns: Titles of columns by what they hold: `time`, `Fx` to `Mz`, or a channel such as
            `distal.0`.
        units: Units by quantity: time, force, moment, capacitance, stress or length; they
            override those of the titles.
        rate: Rate of the rows of a table without times, or whose times do not count [Hz]; None if
            they count.
        names: Clusters of a table whose titles do not name them, in its order.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    rate: float | None = None
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Clock:
    """The clock of a table.

    Attributes:
        times: Times of the rows, ascending, shape (N,) [ns]; since 1970 if they are dated, else as
            in the file.
        kept: Rows of the file that they are of, shape (N,).
        is_dated: Whether they tell the date.
        notes: What was assumed or left out, one line each.
    """

    times: IntArray
    kept: IntArray
    is_dated: bool
    notes: tuple[str, ...] = ()


def table_text(path: Path) -> str:
    """The text of a table in UTF-8, UTF-16 with its mark, or else Windows-1252.

    Raises:
        ConfigurationError: If the file cannot be read, or holds no text.
    """
    text = read_text(path, "a table", MAX_FILE_SIZE, ("utf-8-sig", "utf-16", "cp1252"))
    if "\0" in text:
        raise ConfigurationError(f"{path}: is not a table of text", "save it as CSV")
    return text


def read_table(path: Path) -> TextTable:
    """Read the table of a file.

    Raises:
        ConfigurationError: If it has no rows of numbers, or several parts.
    """
    text = table_text(path)
    if not text.lstrip().startswith(_LABVIEW):
        return read_text_table(text, WRITTEN)
    if text.count(_LABVIEW_END) > 2:
        raise ConfigurationError(
            "holds several segments of measurements",
            "save each in a file of its own ('One segment' in LabVIEW's Write To Measurement File)",
        )
    return _labview(read_text_table(text, WRITTEN, starts_after=_LABVIEW_END))


def _labview(table: TextTable) -> TextTable:
    """The table with the units that LabVIEW's header states in its row `Y_Unit_Label`."""
    rows = [re.split(r"[\t,;]", line) for line in table.above]
    units = next((row[1:] for row in rows if row[0] == "Y_Unit_Label"), [])
    titles = list(table.titles)
    for column, unit in enumerate(units, start=1):
        if unit.strip() and column < len(titles) and not split_title(titles[column], WRITTEN)[1]:
            titles[column] = f"{titles[column]} [{unit.strip()}]"
    return TextTable(table.above, tuple(titles), table.has_titles, table.columns, table.notes)


def labview_rate(table: TextTable) -> float | None:
    """Rate that LabVIEW's header states for a table without times [Hz]; None if it has none."""
    for line in table.above:
        key, *cells = re.split(r"[\t;]", line)
        if key == "Delta_X" and cells:
            try:
                step = float(cells[0].replace(",", "."))
            except ValueError:
                return None
            return 1.0 / step if step > 0.0 else None
    return None


def named_column(table: TextTable, title: str, what: str) -> int:
    """Index of the column that a user names by its title, with or without its unit.

    Args:
        table: The table.
        title: The title.
        what: What it holds, for errors.

    Raises:
        ConfigurationError: If there is none, or several.
    """
    wanted = title.strip()
    found = [k for k, own in enumerate(table.titles) if own == wanted] or [
        k for k, own in enumerate(table.titles) if split_title(own, WRITTEN)[0] == wanted
    ]
    if len(found) != 1:
        fact = f"{len(found) or 'no'} columns are called '{wanted}', named for {what}"
        raise ConfigurationError(fact, f"name one of {shown_titles(table)}")
    return found[0]


def has_column(table: TextTable, title: str) -> bool:
    """Whether a table has a column of that title, with or without its unit.

    Args:
        table: The table.
        title: The title.
    """
    return bool(title) and any(title in (own, split_title(own, WRITTEN)[0]) for own in table.titles)


def shown_titles(table: TextTable) -> str:
    """The titles of a table in one line, for errors; those beyond a dozen are only counted."""
    return listed([f"'{title}'" for title in table.titles if title], _MAX_TITLES)


def time_columns(table: TextTable, stated: TableFormat) -> list[int]:
    """Indices of the column of times, or of dates and times of day; empty if there is none.

    Args:
        table: The table.
        stated: What its titles do not tell.

    Raises:
        ConfigurationError: If several columns may be it.
    """
    if has_column(table, stated.columns.get("time", "")):
        return [named_column(table, stated.columns["time"], "time")]
    if not table.has_titles:
        return []
    names = [split_title(title, WRITTEN)[0].lower() for title in table.titles]
    dates = [k for k, name in enumerate(names) if name in _DATES]
    times = [k for k, name in enumerate(names) if name in _TIMES]
    if len(times) > 1:
        shown = ", ".join(f"'{table.titles[k]}'" for k in times)
        fact = f"{shown} may each be the time"
        raise ConfigurationError(fact, "name it with --columns time=NAME")
    if len(dates) == 1 and len(times) == 1 and table.columns[times[0]].dtype.kind not in "iuf":
        return [dates[0], times[0]]
    return times or dates[:1]


def read_clock(table: TextTable, stated: TableFormat) -> Clock:
    """The times of a table's rows.

    A column of times has numbers with a unit, dates with times (2024-05-05 12:00:01.5, or
    5.5.2024 12:00:01), or times of day. Numbers of seconds since 1970 are dated. Dates without a
    zone are taken as UTC. Without such a column, or if a rate is stated, rows follow at that rate.

    Args:
        table: The table.
        stated: What its titles do not tell.

    Raises:
        ConfigurationError: If there are no times, they lack a unit, do not ascend, or are
            implausible in their unit.
    """
    columns = time_columns(table, stated)
    number = len(table.columns)
    every = np.arange(number)
    if stated.rate is not None or not columns or _is_blank(table, columns[-1]):
        rate = stated.rate or labview_rate(table)
        if rate is None:
            raise ConfigurationError(
                f"no column holds the time ({shown_titles(table)})",
                "name it with --columns time=NAME, or give the rate of the rows with --row-rate",
            )
        times = np.round(every * (_SECOND / rate)).astype(np.int64)
        unused = [table.titles[k] for k in columns if not _is_blank(table, k)]
        notes = tuple(f"the times of '{title}' do not count: a rate is stated" for title in unused)
        return Clock(times, every, False, notes)
    title = table.titles[columns[-1]]
    cells = table.columns[columns[-1]]
    if cells.dtype.kind in "iuf" or not _are_dates(table, columns):
        return _of_numbers(table, columns[-1], stated)
    texts = [table.columns[k].fillna("").astype(str).str.strip() for k in columns]
    times, is_dated, notes = _of_texts(" ".join(row) for row in zip(*texts, strict=True))
    if (wrong := np.flatnonzero(times < 0)).size:
        line = table.columns.index[wrong[0]]
        raise ConfigurationError(
            f"line {line}, column '{title}' holds '{cells.loc[line]}'",
            "give the time as 2024-05-05 12:00:01.5 or in seconds",
        )
    return _ascending(table, title, times, every, is_dated, notes)


def _is_blank(table: TextTable, column: int) -> bool:
    return bool(table.columns[column].isna().all())


def _are_dates(table: TextTable, columns: list[int]) -> bool:
    cells = table.columns[columns[0]].dropna().astype(str)
    first = cells.iloc[0].strip() if len(cells) else ""
    return bool(re.match(r"\d{1,4}[-./:]\d{1,2}[-./:]", first) or _CLOCK.match(first))


def _of_numbers(table: TextTable, column: int, stated: TableFormat) -> Clock:
    title = table.titles[column]
    name, unit = split_title(title, WRITTEN)
    own = _OF_TITLE.get(name.lower(), "")
    if name.lower() in WRITTEN and name.lower() not in ("t", "m"):
        own = name.lower()
    scale = common_factor("time", [stated.units.get("time", ""), unit, own], title)
    values = table.numbers(column)
    if (lacking := np.flatnonzero(np.isnan(values))).size:
        line = table.columns.index[lacking[0]]
        raise ConfigurationError(f"line {line} has no time", "give it, or remove the line")
    cells = table.columns[column]
    per = round(scale * _SECOND)
    if cells.dtype.kind in "iu" and per >= 1:
        times = cells.to_numpy(dtype=np.int64) * per  # exact
    else:
        whole = np.floor(values)
        times = whole.astype(np.int64) * per + np.round((values - whole) * per).astype(np.int64)
    first = times[0] / _SECOND if len(times) else 0.0
    dated = _DATED[0] < first < _DATED[1]
    every = np.arange(len(times))
    clock = _ascending(table, title, times, every, bool(dated), ())
    step = float(np.median(np.diff(clock.times))) / _SECOND if len(clock.times) > 1 else _STEPS[0]
    if not _STEPS[0] <= step <= _STEPS[1]:
        raise ConfigurationError(
            f"column '{title}' has steps of {step / scale:.3g} in the median, {step:.3g} s in its"
            " unit, which no sensor has",
            "give the true unit with --units time=UNIT",
        )
    return clock


def _of_texts(texts: object) -> tuple[IntArray, bool, tuple[str, ...]]:
    """Times [ns] of dates and times as text, -1 for others; whether dated; and notes."""
    import pandas as pd

    series = pd.Series(list(texts)).str.replace(",", ".")  # type: ignore[call-overload]
    first = series.iloc[0]
    if _CLOCK.fullmatch(first):
        whole = series.str.count(":").map({1: "00:"}).fillna("") + series
        spans = pd.to_timedelta(whole, errors="coerce")
        return _in_nanoseconds(spans), False, ()
    if _GERMAN.fullmatch(first):
        dates = pd.to_datetime(series, dayfirst=True, errors="coerce", utc=True, format="mixed")
    elif _ISO.fullmatch(first):
        usable = series.str.replace("_", " ")
        dates = pd.to_datetime(usable, errors="coerce", utc=True, format="ISO8601")
    else:
        raise ConfigurationError(
            f"the date '{first}' may have day or month first", "write it as 2024-05-31 12:00:01.5"
        )
    zoned = re.search(r"(Z|[+-]\d{2}:?\d{2})$", first)
    notes = () if zoned else ("its dates have no zone, and are taken as UTC",)
    return _in_nanoseconds(dates - pd.Timestamp(0, tz="UTC")), True, notes


def _in_nanoseconds(spans: object) -> IntArray:
    values = np.asarray(spans, dtype="timedelta64[ns]")
    return np.where(np.isnat(values), -1, values.astype(np.int64))


def _ascending(
    table: TextTable,
    title: str,
    times: IntArray,
    rows: IntArray,
    is_dated: bool,
    notes: tuple[str, ...],
) -> Clock:
    """The times without repeated ones; of rows with one time the last counts."""
    back = np.flatnonzero(np.diff(times) < 0)
    if back.size:
        line = table.columns.index[back[0] + 1]
        fall = (times[back[0]] - times[back[0] + 1]) / _SECOND
        raise ConfigurationError(
            f"line {line}, column '{title}' goes back by {fall:.3g} s",
            "a restart of the device, or a counter that overflowed: cut the file there",
        )
    again = np.flatnonzero(np.diff(times) == 0)
    if again.size:
        notes = (*notes, f"of {again.size} rows with the time of the next the last counts")
    kept = np.delete(rows, again)
    return Clock(times[kept], kept, is_dated, notes)


def values_of(
    table: TextTable, columns: Mapping[str, int], quantity: Mapping[str, str], stated: TableFormat
) -> FloatArray:
    """Numbers of columns in SI, or pF, shape (N, k); NaN where a cell is empty.

    Args:
        table: The table.
        columns: Index of each column, by what it holds.
        quantity: What each measures, a key of `UNITS`, by what it holds.
        stated: Units that override those of the titles.

    Raises:
        ConfigurationError: If a unit is missing or unknown, or a cell holds no number.
    """
    found = []
    for name, column in columns.items():
        title, kind = table.titles[column], quantity[name]
        units = [stated.units.get(kind, ""), split_title(title, WRITTEN)[1]]
        found.append(common_factor(kind, units, title) * table.numbers(column))
    return np.column_stack(found)


def unread(values: FloatArray) -> BoolArray:
    """Rows that hold nothing, shape (N,), of values (N, k)."""
    return np.asarray(np.isnan(values).all(axis=1))
