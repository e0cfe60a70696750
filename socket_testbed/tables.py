"""Tables: data frames with units in their column names, for display and as CSV, Parquet, MAT."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from itertools import chain, count, groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from socket_testbed.files import TABLES, atomic_output, check_suffix

if TYPE_CHECKING:
    import pandas as pd

_MAX_NAME_LENGTH = 63  # of a variable in MATLAB
NOTHING = "\N{EN DASH}"  # in a cell without a value
UNCERTAIN = ", uncertain"  # after a wide interval


def number(value: float, spec: str = ".3g") -> str:
    """Format a number for display; a dash if it is not finite.

    Args:
        value: The number, in the unit in which it is shown.
        spec: Format as in Python's `format`, by default three significant digits.
    """
    return f"{value:{spec}}" if math.isfinite(value) else NOTHING


def duration_text(seconds: float) -> str:
    """A duration [s] in whole seconds, such as 0:01:30."""
    return str(timedelta(seconds=int(seconds)))


@dataclass(frozen=True)
class Table:
    """A table of a page: the frame's index heads the rows; columns may be grouped.

    Attributes:
        name: Identifier on the page, such as `pressure-regions`.
        caption: Text above the table.
        frame: The cells. Titles of columns include the unit, such as `peak [kPa]`; columns with
            two levels of titles are grouped by the first. Numbers are shown as they are, so that
            their unit is that of the title.
        formats: Formats of numbers as in Python's `format`, by the title of a column or, for
            columns without one, by the title of a group; all others have three decimals.
        is_text: Whether cells hold running text, which wraps.
    """

    kind: ClassVar = "table"
    name: str
    caption: str
    frame: pd.DataFrame
    formats: Mapping[str, str] = field(default_factory=dict)
    is_text: bool = False

    @property
    def columns(self) -> list[tuple[str, str, bool]]:
        """Group, title and whether numeric, for each column."""
        labels = [label if isinstance(label, tuple) else ("", label) for label in self.frame]
        numeric = (kind.kind in "iuf" for kind in self.frame.dtypes)
        return [(*label, is_number) for label, is_number in zip(labels, numeric, strict=True)]

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Title and number of columns of each run of grouped columns; empty without groups."""
        names = [group for group, *_ in self.columns]
        return [(name, len([*run])) for name, run in groupby(names)] if any(names) else []

    @property
    def rows(self) -> Iterator[tuple[str, tuple[str, ...]]]:
        """The heading and the cells of each row, numbers as text."""
        columns = []
        for (group, title, is_number), (_, cells) in zip(
            self.columns, self.frame.items(), strict=True
        ):
            spec = self.formats.get(title) or self.formats.get(group, "z.3f")
            columns.append([number(cell, spec) for cell in cells] if is_number else cells)
        return zip(self.frame.index, zip(*columns, strict=True), strict=True)


def pairs_table(name: str, caption: str, pairs: Sequence[tuple[str, str]]) -> Table:
    """A table of names and their values as text.

    Args:
        name: Identifier of the table on a page.
        caption: Text above the table.
        pairs: Name and value of each row, in the order of the table.
    """
    import pandas as pd

    frame = pd.DataFrame([*pairs], columns=["name", "value"]).set_index("name")
    return Table(name, caption, frame, is_text=True)


def write_table(frame: pd.DataFrame, path: Path) -> None:
    """Write a table atomically, in the format of the file's suffix.

    CSV and Parquet files keep the column titles and store missing values as null; the fields of a
    Parquet file have their `unit` in the metadata. A MAT file holds a vector per column, under a
    valid MATLAB name, and a struct `units` with the same names.

    Args:
        frame: The table. Titles include the units, such as `distal.Fz [N]`, `-` for dimensionless
            numbers; text and counts have none. A named index becomes the first column.
        path: The file, `.csv`, `.parquet` or `.mat`; an existing one is replaced.

    Raises:
        ConfigurationError: If the suffix is another one, or the file cannot be written there.
    """
    check_suffix(path, TABLES, "table")
    frame = frame if frame.index.name is None else frame.reset_index()
    with atomic_output(path) as staging:
        write = _write_mat if path.suffix.lower() == ".mat" else _write_arrow
        write(frame, staging)


def split_unit(title: str) -> tuple[str, str]:
    """Split a title such as `distal.Fz [N]` into name and unit; the unit may be empty."""
    found = re.fullmatch(r"(.*) \[([^\]]*)\]", title)
    return (found[1], found[2]) if found else (title, "")


def stacked(columns: Mapping[str, Sequence[Any]], rows: int) -> pd.DataFrame:
    """A long table of m blocks of equal length, one below the other.

    Args:
        columns: By column name, either a value for each block, m texts; or an array of the values
            of all blocks, shape (rows, m), in the unit that its column or `unit` names; or, of
            shape (rows,), values that repeat in each block.
        rows: Number of rows of a block.
    """
    import numpy as np
    import pandas as pd

    blocks = max(len(values) for values in columns.values() if isinstance(values, list))
    made = {}
    for name, values in columns.items():
        if isinstance(values, list):
            made[name] = np.repeat(np.array(values, dtype=object), rows)
        elif np.ndim(values) == 1:
            made[name] = np.tile(values, blocks)
        else:
            made[name] = np.asarray(values).T.ravel()
    return pd.DataFrame(made)


def _write_arrow(frame: pd.DataFrame, path: Path) -> None:
    import pyarrow
    from pyarrow import csv, parquet

    arrays, fields = [], []
    for title, column in frame.items():
        unit = split_unit(title)[1]
        array = pyarrow.array(column, from_pandas=True)  # NaN becomes null
        if pyarrow.types.is_null(array.type):
            array = array.cast(pyarrow.float64() if unit else pyarrow.string())
        arrays.append(array)
        fields.append(pyarrow.field(title, array.type, metadata={"unit": unit}))
    table = pyarrow.table(arrays, schema=pyarrow.schema(fields))
    write = csv.write_csv if path.suffix.lower() == ".csv" else parquet.write_table
    write(table, path)


def _write_mat(frame: pd.DataFrame, path: Path) -> None:
    from scipy.io import savemat

    titles = [split_unit(title) for title in frame]
    names = matlab_names([name for name, _ in titles])
    units = [unit for _, unit in titles]
    variables = {n: _plain(column) for n, (_, column) in zip(names, frame.items(), strict=True)}
    variables["units"] = dict(zip(names, units, strict=True))
    savemat(path, variables, long_field_names=True, do_compression=True, oned_as="column")


def _plain(column: pd.Series) -> Any:
    """Values for MATLAB: missing text is empty, missing numbers are NaN."""
    if column.dtype.kind in "fiub":
        return column.to_numpy()
    if any(isinstance(value, str) for value in column):
        return column.fillna("").to_numpy(dtype=object)
    return column.to_numpy(dtype=float, na_value=float("nan"))


def matlab_names(names: Sequence[str]) -> list[str]:
    """Unique valid MATLAB names: letters, digits, underscores, at most 63 characters."""
    found = {"units": 0}
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
        plain = plain if plain[:1].isalpha() else f"x{plain}"
        tails = chain([""], map("_{}".format, count(2)))
        possible = (plain[: _MAX_NAME_LENGTH - len(tail)] + tail for tail in tails)
        found[next(unique for unique in possible if unique not in found)] = 0
    return [*found][1:]
