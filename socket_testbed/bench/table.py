"""A table of numbers with a header, from a text file: what is wrong has a line and a column."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import CalibrationError

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", flags=re.ASCII)
_SEPARATORS = "\t;,"


@dataclass(frozen=True)
class Table:
    """The cells of a file, column by column.

    Attributes:
        name: Name of the file, for errors and reports.
        header: Names of the columns as the file has them.
        lines: Line of the file that each of the N rows stands on, shape (N,).
        columns: The cells of each column, as text.
        decimal_comma: Whether numbers may have a comma; not where commas separate the cells.
    """

    name: str
    header: tuple[str, ...]
    lines: IntArray
    columns: tuple[tuple[str, ...], ...]
    decimal_comma: bool

    def __len__(self) -> int:
        return len(self.lines)

    def texts(self, column: int) -> tuple[str, ...]:
        """The cells of a column as text.

        Raises:
            CalibrationError: If one of them is empty.
        """
        for line, cell in zip(self.lines, self.columns[column], strict=True):
            if not cell:
                raise CalibrationError(
                    f"{self.name}: '{self.header[column]}' is empty in line {line}",
                    "fill the cell or remove the line",
                )
        return self.columns[column]

    def numbers(self, column: int) -> FloatArray:
        """The cells of a column as numbers, shape (N,).

        Raises:
            CalibrationError: If one of them is none.
        """
        cells = self.texts(column)
        if self.decimal_comma:
            cells = tuple(cell.replace(",", ".") for cell in cells)
        for row, cell in enumerate(cells):
            if not _NUMBER.fullmatch(cell):
                raise CalibrationError(
                    f"{self.name}: '{self.header[column]}' holds '{self.columns[column][row]}' in"
                    f" line {self.lines[row]}, which is no number",
                    "give a number there; a unit belongs into the header",
                )
        return np.array([float(cell) for cell in cells])


def read_table(path: Path) -> Table:
    """Read a table whose cells are separated by commas, semicolons or tabs.

    Lines without any content are left out.

    Raises:
        CalibrationError: If the file cannot be read, has no rows, has a row of another length
            than the header, or repeats the header.
    """
    text = _read_text(path)
    first = text.partition("\n")[0]
    separator = max(_SEPARATORS, key=first.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    header: tuple[str, ...] = ()
    rows, lines = [], []
    try:
        for cells in reader:
            row = tuple(cell.strip() for cell in cells)
            if not any(row):
                continue
            if not header:
                header = row
                continue
            _check_row(path.name, header, row, reader.line_num, separator)
            rows.append(row)
            lines.append(reader.line_num)
    except csv.Error as error:
        raise CalibrationError(
            f"{path}: line {reader.line_num} is no row of a table ({error})", "mend that line"
        ) from None
    if not rows:
        raise CalibrationError(
            f"{path}: holds no row of data", "give a header and below it a row a reading"
        )
    columns = tuple(zip(*rows, strict=True))
    return Table(path.name, header, np.array(lines, dtype=np.int64), columns, separator != ",")


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise CalibrationError(f"{path}: no such file", "check the path") from None
    except UnicodeDecodeError:
        raise CalibrationError(
            f"{path}: is no UTF-8 text", "save it as CSV (UTF-8) from the spreadsheet"
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
    mend = "give every row as many fields as the header"
    if separator == "," and len(header) < len(row) <= 2 * len(header):
        mend += ", or separate the fields with ';' if the numbers have decimal commas"
    raise CalibrationError(
        f"{name}: line {line} has {len(row)} fields under a header of {len(header)}", mend
    )
