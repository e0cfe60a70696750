"""Tables of text as any program writes them: preambles, comments, titles with units, cells.

Lines that are no part of the table are left blank, so that the numbers of the lines stay.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.documents import SEPARATORS, split_separator
from socket_testbed.errors import ConfigurationError

if TYPE_CHECKING:
    import pandas as pd

# Errors of spreadsheet programs are no comments.
_COMMENT = re.compile(r'[ \t]*"?[ \t]*(?:#(?!N/A|DIV/0!|REF!|VALUE!|NAME\?|NUM!|NULL!)|%|//)')
_NUMBER_FIRST = re.compile(r'[ \t]*"?[-+.]?\d')


def without_comments(text: str) -> str:
    """The text with comment lines left blank.

    Comments begin with `#`, `%` or `//`. The last one above the data is the header, without its
    mark, if the first line of the data begins with a number and has as many columns.

    Args:
        text: The file's text, whose lines end with a line feed.
    """
    lines = text.split("\n")
    comments = [_COMMENT.match(line) for line in lines]
    kept = ["" if comment else line for line, comment in zip(lines, comments, strict=True)]
    first = next((k for k, line in enumerate(kept) if line.strip() and not _is_sep(line)), 0)
    above = [k for k in range(first) if comments[k]]
    if above and _NUMBER_FIRST.match(lines[first]):
        title, mark = lines[above[-1]], comments[above[-1]]
        title = ('"' if mark and '"' in mark[0] else "") + title[
            mark.end() if mark else 0 :
        ].lstrip()
        separator = split_separator(text)[0] if _is_sep(lines[0]) else split_separator(title)[0]
        between = title.count(separator), lines[first].count(separator)
        if between == (0, 0):  # spaces separate them
            between = len(title.split()) - 1, len(lines[first].split()) - 1
        if between[0] == between[1] > 0:
            kept[above[-1]] = title
    return "\n".join(kept)


def _is_sep(line: str) -> bool:
    return split_separator(line)[1] != line


_BRACKETED = re.compile(r"(.*?)[\s_]*[\[(]([^\])]*)[\])]")


@lru_cache(maxsize=8)
def _suffixed(units: frozenset[str]) -> re.Pattern[str]:
    longest_first = sorted(units, key=lambda unit: (-len(unit), unit))
    alternatives = "|".join(re.escape(unit) for unit in longest_first)
    return re.compile(rf"(.*?)[\s_]+({alternatives})", flags=re.IGNORECASE)


def split_title(title: str, units: frozenset[str]) -> tuple[str, str]:
    """Name and unit of a column: `normal [kPa]`, `normal (kPa)`, `normal_kPa`, `normal kPa`.

    Args:
        title: The column's title.
        units: Units that a title may end with, without brackets.
    """
    found = _BRACKETED.fullmatch(title) or _suffixed(units).fullmatch(title)
    return (found[1].strip(), found[2].strip()) if found else (title, "")


def units_below(titles: Sequence[str], row: Sequence[str], units: frozenset[str]) -> list[str]:
    """Titles with the units of the row below them; empty if that row is not one of units.

    Args:
        titles: The titles.
        row: The cells below them, as many.
        units: The units that are known.
    """
    below = [cell.strip("[]()") for cell in row]
    if not set(below) & units or any(re.match(r"[-+.]?\d", cell) for cell in below):
        return []
    named = zip(titles, below, strict=True)
    return [f"{t} [{unit}]" if unit and not split_title(t, units)[1] else t for t, unit in named]


@dataclass(frozen=True)
class TextTable:
    """A table of text, read by columns.

    Attributes:
        above: The lines above the titles, such as a program's header.
        titles: Titles of the columns, with units as in the file; `column 1` and so on without.
        has_titles: Whether the file has them.
        columns: The cells of each column; numbers where all of them are, else text; indexed by
            line from 1.
        notes: What was left out, one line each.
    """

    above: tuple[str, ...]
    titles: tuple[str, ...]
    has_titles: bool
    columns: pd.DataFrame
    notes: tuple[str, ...]

    def numbers(self, column: int) -> FloatArray:
        """The numbers of a column, NaN where a cell is empty, shape (N,).

        Raises:
            ConfigurationError: If a cell holds something else.
        """
        cells = self.columns[column]
        if cells.dtype.kind in "iuf":
            return cells.to_numpy(dtype=np.float64)
        texts = cells.fillna("").astype(str).str.strip()
        import pandas as pd

        values = pd.to_numeric(texts.replace(dict.fromkeys(_MISSING, "nan")), "coerce")
        wrong = values.isna() & ~texts.str.lower().isin(_MISSING)
        if wrong.any():
            line = wrong.idxmax()
            raise ConfigurationError(
                f"line {line}, column '{self.titles[column]}' holds '{texts[line]}'",
                "put a number there, leave the cell empty, or remove the line",
            )
        return np.asarray(values.to_numpy(dtype=np.float64))


_MISSING = ("", "nan", "-nan", "na", "n/a", "#n/a", "none", "null", "-", "--")
_READ_AS_MISSING = sorted({form for word in _MISSING for form in (word, word.upper())} | {"NaN"})
_ONE_WIDTH = (
    "correct or remove that line; separate the columns with ';' if the numbers have decimal commas"
)
_LOOKED_AT = 200  # [lines] from the end, which tell the table's width
_IS_DATA = 2.0 / 3.0  # share of the cells of a row that begin like numbers
_DATA = re.compile(r'\s*"?\s*[-+]?[.,]?\d|\s*"?\s*[-+]?nan\b', flags=re.IGNORECASE)


def read_text_table(text: str, units: frozenset[str], *, starts_after: str = "") -> TextTable:
    """Read a table below any preamble, with the titles directly above its numbers.

    Columns are separated by commas, semicolons, tabs or, if there are none of these, spaces.
    Decimal commas are read where no comma separates the columns. A last line without line end, and
    lines with fewer columns than the others, may be cut within a number, and are left out.

    Args:
        text: The file's text.
        units: Units of a row below the titles.
        starts_after: A line that ends the preamble; empty for none.

    Raises:
        ConfigurationError: If there is no row of numbers, or rows differ in their width.
    """
    lines = without_comments(text.replace("\r\n", "\n").replace("\r", "\n")).split("\n")
    notes = []
    if lines[-1].strip() and any(_DATA.match(line) for line in lines[:-1][-3:]):
        notes.append(f"line {len(lines)}, the last, has no line end, so it may be cut short: it is"
                     " left out")  # fmt: skip
        lines[-1] = ""
    begin = _after(lines, starts_after)
    stated = ""
    if _is_sep(lines[0]):
        stated, lines[0] = split_separator("\n".join(lines[:2]))[0], ""
    filled = [k for k in range(begin, len(lines)) if lines[k].strip()]
    separator = stated or _separator([lines[k] for k in filled[-_LOOKED_AT:]])
    rows = [_split(lines[k], separator) for k in filled[-_LOOKED_AT:]]
    widths = Counter(len(row) for row in rows if _is_data(row, len(row)))
    width = max(widths, key=lambda w: (widths[w], w), default=0)
    first = next((k for k in filled if _is_data(_split(lines[k], separator), width)), None)
    if first is None:
        raise ConfigurationError("holds no row of numbers", "give a row per reading below titles")
    above = [k for k in filled if k < first]
    cells = [_split(lines[k], separator) for k in above[-2:]]
    fitting = [abs(len(row) - width) <= 1 for row in cells]
    titles: list[str] = []
    if cells and _is_data(cells[-1], len(cells[-1])) and len(cells[-1]) > 1:
        fact = f"line {above[-1] + 1} has {len(cells[-1])} columns, others {width}"
        if len(cells[-1]) > width:
            raise ConfigurationError(fact, _ONE_WIDTH)
        notes.append(f"{fact}: it is left out")
    elif fitting and fitting[-1]:
        titles = _padded(cells[-1], width)
        if len(cells) > 1 and fitting[0]:
            titles = units_below(_padded(cells[0], width), titles, units) or titles
    if short := [k for k in filled if k > first and _is_short(lines[k], separator, width)]:
        shown = f"line {short[0] + 1} has" if len(short) == 1 else f"{len(short)} lines have"
        notes.append(f"{shown} fewer columns than the others, and may be cut short: left out")
        for k in short:
            lines[k] = ""
    columns = _read_columns(lines[first:], first, separator, max(width, len(titles)))
    columns.index += first + 1
    blank = {k + 1 for k in range(first, len(lines)) if not lines[k].strip(f'{separator} \t"')}
    columns = columns[~columns.index.isin(blank)]
    has_titles = bool(titles)
    if not has_titles:
        titles = [f"column {number + 1}" for number in columns.columns]
    kept_above = tuple(lines[k] for k in above if k < begin or not has_titles or k < above[-1])
    preamble = tuple(line for line in lines[:begin] if line.strip()) + kept_above
    return TextTable(preamble, tuple(titles), has_titles, columns, tuple(notes))


def _read_columns(lines: Sequence[str], first: int, separator: str, width: int) -> pd.DataFrame:
    """The cells of rows by column; the first row is line `first`, counted from 0."""
    import pandas as pd  # imported late: not for --help

    body = "\n".join(lines)
    if not separator:
        body = re.sub(r"[ \t]+", "\t", "\n".join(line.strip() for line in lines))
    has_comma = any("," in line for line in lines)
    try:
        return pd.read_csv(
            io.StringIO(body),
            sep=separator or "\t",
            header=None,
            names=range(width),
            index_col=False,
            decimal="," if separator != "," and has_comma else ".",
            keep_default_na=False,
            na_values=_READ_AS_MISSING,
            skip_blank_lines=False,
            skipinitialspace=True,
            low_memory=False,
            on_bad_lines="error",
        )
    except pd.errors.ParserError as error:
        fact = re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", str(error))
        shown = str(error).strip().rpartition("error: ")[2]
        if fact:
            shown = f"line {int(fact[2]) + first} has {fact[3]} columns, others {fact[1]}"
        raise ConfigurationError(shown, _ONE_WIDTH) from None


def _after(lines: Sequence[str], mark: str) -> int:
    """Index of the first line below the last one that begins with a mark."""
    if not mark:
        return 0
    return max((k + 1 for k, line in enumerate(lines) if line.startswith(mark)), default=0)


def _separator(lines: Collection[str]) -> str:
    """The separator of rows: one that most have; empty for spaces."""
    for separator in (*SEPARATORS[1:], SEPARATORS[0]):  # a comma may be a decimal comma
        if 2 * sum(separator in line.strip() for line in lines) > len(lines):
            return separator
    return ""


def _split(line: str, separator: str) -> list[str]:
    if not separator:
        return line.split()
    if '"' in line:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]
    return [cell.strip() for cell in line.split(separator)]


def _is_data(cells: Sequence[str], width: int) -> bool:
    """Whether cells are a row of a table that is so wide."""
    filled = [cell for cell in cells if cell]
    numbers = sum(bool(_DATA.match(cell)) for cell in filled)
    return len(cells) == width and bool(filled) and numbers >= _IS_DATA * len(filled)


def _is_short(line: str, separator: str, width: int) -> bool:
    """Whether a line has fewer cells than the table, so that it may be cut within a number."""
    cells = line.count(separator) + 1 if separator else len(line.split())
    return cells < width and bool(line.strip())


def _padded(cells: Sequence[str], width: int) -> list[str]:
    return [*cells, *[""] * (width - len(cells))]
