"""What stands in which column of Motive's CSV exports.

The rows of names stand between the header and the row of axes ('Frame, Time, X, Y, Z, ...').
Formats 1.20 and 1.21 tell them by their order: type, name, id, property. Later ones say in the
second column what a row holds, with a row 'Parent' besides since 1.25. Columns without a type,
such as the time code, and those of bones are left alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from socket_testbed.errors import RegistrationError

BODY = "Rigid Body"
MARKER = "Marker"
SOLVED = "Rigid Body Marker"

Part = tuple[str, str]  # property and axis
ROTATION: tuple[Part, ...] = tuple(("Rotation", axis) for axis in "XYZW")
POSITION: tuple[Part, ...] = tuple(("Position", axis) for axis in "XYZ")
_ERRORS = (("Error Per Marker", ""), ("Mean Marker Error", ""))  # until 1.21, and since
_NEEDED = {BODY: ROTATION + POSITION, MARKER: POSITION, SOLVED: POSITION}
_FIRST_DATA = 2  # behind the frame and the time
_NAME_ROWS = 4  # the header, types, names and properties

Row = tuple[int, list[str]]  # number of the line and cells


@dataclass(frozen=True)
class Columns:
    """Columns of a take.

    Attributes:
        width: Number of columns.
        things: By type and name, the column of each property and axis.
        doubled: Names that stand twice for a type; they are not among the things.
    """

    width: int
    things: dict[tuple[str, str], dict[Part, int]]
    doubled: frozenset[str]

    def of(self, kind: str) -> Iterator[tuple[str, dict[Part, int]]]:
        """Names of the things of a type, with their columns."""
        return ((name, parts) for (own, name), parts in self.things.items() if own == kind)

    def title(self, column: int) -> str:
        """What names a column in an error."""
        for (kind, name), parts in self.things.items():
            for (meaning, axis), place in parts.items():
                if place == column:
                    return f"column {column + 1} ({kind} {name}, {meaning} {axis}".rstrip() + ")"
        return f"column {column + 1} ({('frame', 'time')[column]})"


def error_column(parts: dict[Part, int]) -> int | None:
    """Column of a body's mean error of a marker, where there is one."""
    return next((parts[part] for part in _ERRORS if part in parts), None)


def read_columns(rows: list[Row], path: Path) -> tuple[Columns, int]:
    """Columns of a file, and which of its rows holds the first frame.

    Raises:
        RegistrationError: If the rows of names are not as Motive writes them.
    """
    axes_row = next((i for i, (_, row) in enumerate(rows) if row[0].strip() == "Frame"), None)
    if axes_row is None or axes_row < _NAME_ROWS:
        raise RegistrationError(
            f"{path}: has no rows of types, names, properties and axes above its frames",
            "export the take again, with the header information",
        )
    names_rows = [row for _, row in rows[1:axes_row]]
    axes = rows[axes_row][1]
    width = max(len(_without_blanks(row)) for row in (*names_rows, axes))
    kinds, names = _types_and_names(names_rows)
    titles = list(zip_longest(kinds, names, names_rows[-1], axes, fillvalue=""))
    things, doubled = _group([tuple(cell.strip() for cell in title) for title in titles[:width]])
    if not things:
        raise RegistrationError(
            f"{path}: has neither rigid bodies nor markers",
            "export rigid bodies and markers from Motive",
        )
    _require_parts(things, path)
    return Columns(width, things, doubled), axes_row + 1


def _types_and_names(rows: list[list[str]]) -> tuple[list[str], list[str]]:
    labelled = {row[1].strip(): row for row in rows if len(row) > 1}
    return labelled.get("Type", rows[0]), labelled.get("Name", rows[1])


def _group(
    titles: list[tuple[str, ...]],
) -> tuple[dict[tuple[str, str], dict[Part, int]], frozenset[str]]:
    """The columns of each thing, and the names of those whose columns stand twice."""
    things: dict[tuple[str, str], dict[Part, int]] = {}
    doubled = set()
    for column, (kind, name, meaning, axis) in enumerate(titles):
        if column < _FIRST_DATA or kind not in _NEEDED:
            continue
        parts = things.setdefault((kind, name), {})
        if (meaning, axis) in parts:
            doubled.add((kind, name))
        parts[meaning, axis] = column
    single = {key: parts for key, parts in things.items() if key not in doubled}
    return single, frozenset(name for _, name in doubled)


def _require_parts(things: dict[tuple[str, str], dict[Part, int]], path: Path) -> None:
    for (kind, name), parts in things.items():
        for meaning, axis in _NEEDED[kind]:
            if (meaning, axis) not in parts:
                raise RegistrationError(
                    f"{path}: the {kind.lower()} '{name}' has no column {meaning} {axis}",
                    "export the take again, with all its columns",
                )


def _without_blanks(row: list[str]) -> list[str]:
    """A row without the blank cells at its end."""
    return row[: max((i + 1 for i, cell in enumerate(row) if cell.strip()), default=0)]
