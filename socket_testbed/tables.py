"""Tables in files: data frames whose names hold the units, as CSV, Parquet and MAT."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from socket_testbed.errors import ConfigurationError, closest
from socket_testbed.files import atomic_output

if TYPE_CHECKING:
    import pandas as pd

_LONGEST_NAME = 63  # of a variable in MATLAB


def check_format(path: Path) -> None:
    """Refuse a file whose suffix names no format, before long work."""
    if path.suffix.lower() not in _WRITERS:
        raise ConfigurationError(
            f"{path}: '{path.suffix}' is not a table format", closest(path.suffix, _WRITERS)
        )


def write_table(frame: pd.DataFrame, path: Path) -> None:
    """Write a table in the format that the suffix of its file names; atomic.

    CSV and Parquet files have the titles of the columns, and null where a value is missing; each
    field of a Parquet file has its `unit` in its metadata. A MAT file holds a column vector per
    column, under the name as MATLAB can have it, and a struct `units` of the same names.

    Args:
        frame: The table. Its titles hold the units, such as `distal.Fz [N]`, `-` for a number
            without one; texts and counts have none. A named index is the first column.
        path: The file, `.csv`, `.parquet` or `.mat`; an older one is replaced.
    """
    check_format(path)
    frame = frame if frame.index.name is None else frame.reset_index()
    with atomic_output(path) as staging:
        _WRITERS[path.suffix.lower()](frame, staging)


def split_unit(title: str) -> tuple[str, str]:
    """Name and unit of a column by its title, such as `distal.Fz [N]`; no unit is empty."""
    found = re.fullmatch(r"(.*) \[([^\]]*)\]", title)
    return (found[1], found[2]) if found else (title, "")


def _write_csv(frame: pd.DataFrame, path: Path) -> None:
    from pyarrow import csv

    csv.write_csv(_arrow_table(frame), path)


def _write_parquet(frame: pd.DataFrame, path: Path) -> None:
    from pyarrow import parquet

    parquet.write_table(_arrow_table(frame), path)


def _arrow_table(frame: pd.DataFrame) -> Any:
    import pyarrow

    arrays, fields = [], []
    for title, column in frame.items():
        unit = split_unit(title)[1]
        array = pyarrow.array(column, from_pandas=True)  # NaN becomes null
        if pyarrow.types.is_null(array.type):
            array = array.cast(pyarrow.float64() if unit else pyarrow.string())
        arrays.append(array)
        fields.append(pyarrow.field(title, array.type, metadata={"unit": unit}))
    return pyarrow.table(arrays, schema=pyarrow.schema(fields))


def _write_mat(frame: pd.DataFrame, path: Path) -> None:
    from scipy.io import savemat

    titles = [split_unit(title) for title in frame]
    names = matlab_names([name for name, _ in titles])
    units = [unit for _, unit in titles]
    variables = {n: _plain(column) for n, (_, column) in zip(names, frame.items(), strict=True)}
    variables["units"] = dict(zip(names, units, strict=True))
    savemat(path, variables, long_field_names=True, do_compression=True, oned_as="column")


def _plain(column: pd.Series) -> Any:
    """Values that MATLAB can have: no text is empty, no number is NaN."""
    if column.dtype.kind in "fiub":
        return column.to_numpy()
    if any(isinstance(value, str) for value in column):
        return column.fillna("").to_numpy(dtype=object)
    return column.to_numpy(dtype=float, na_value=float("nan"))


def matlab_names(names: Sequence[str]) -> list[str]:
    """Names as MATLAB can have them: letters, digits, underscores, 63 at most, all different."""
    found = {"units": 0}
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
        plain = plain if plain[:1].isalpha() else f"x{plain}"
        tails = chain([""], map("_{}".format, count(2)))
        possible = (plain[: _LONGEST_NAME - len(tail)] + tail for tail in tails)
        found[next(unique for unique in possible if unique not in found)] = 0
    return [*found][1:]


_WRITERS: dict[str, Callable[[pd.DataFrame, Path], None]] = {
    ".csv": _write_csv,
    ".parquet": _write_parquet,
    ".mat": _write_mat,
}
FORMATS = tuple(_WRITERS)
