"""Takes exported by Motive to CSV, format versions 1.20 to 1.25.

The format is described at docs.optitrack.com (Data Export: CSV): a line of keys and values, rows
that name the columns, and a line per frame. A blank cell means not seen.

The name rows are between the header and the row of axes ('Frame, Time, X, Y, Z, ...'). Formats 1.20
and 1.21 have a fixed order: type, name, id, property. Later ones label each row in its second
column, with an additional row 'Parent' since 1.25. Columns without a type, such as the time code,
and those of bones are ignored.

A take that a spreadsheet program saved again is read as well: with semicolons or tabs between the
columns, with decimal commas, with numbers in quotes, and with rows filled up to one width.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.documents import decimal, read_text, split_separator
from socket_testbed.errors import RegistrationError, closest, naming
from socket_testbed.geometry.pose import Pose

_UNNAMED = ("Unlabeled", "Unlabelled")


@dataclass(frozen=True)
class MotiveTake:
    """A take exported by Motive, with N frames.

    Attributes:
        path: The file.
        version: Version of the format, such as 1.23.
        frame_rate: Frame rate of the export [Hz].
        units: Unit of length in the file, as written there, such as `Millimeters`; poses and
            markers of this class are in metres.
        frames: Numbers of the frames as in the file, ascending, shape (N,).
        times: Time of each frame since the start of the take, shape (N,) [s].
        bodies: N poses of each of Motive's rigid bodies in `world`, keyed by its name; NaN in
            frames in which it is not tracked.
        markers: Positions of each measured marker in `world`, shape (N, 3) [m], keyed by its name;
            NaN if occluded.
        solved: Positions at which Motive's rigid bodies expect their markers, in `world`, shape
            (N, 3) [m], keyed by the marker's name; NaN without a pose of the body.
        doubled: Duplicate names among the bodies, markers or solved markers, which are not read.
        notes: Remarks for the user.
    """

    path: Path
    version: str
    frame_rate: float
    units: str
    frames: IntArray
    times: FloatArray
    bodies: dict[str, Pose]
    markers: dict[str, FloatArray]
    solved: dict[str, FloatArray]
    doubled: frozenset[str]
    notes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.frames)

    def body(self, name: str) -> Pose:
        """N poses of a rigid body in `world`, by its name in Motive; NaN if not tracked.

        An unknown name raises a `RegistrationError`.
        """
        if name not in self.bodies:
            raise self._missing("rigid body", name, self.bodies)
        return self.bodies[name]

    def stack(self, names: Collection[str]) -> FloatArray:
        """Measured markers in `world`, shape (N, k, 3) [m], by k names; NaN if occluded.

        An unknown name raises a `RegistrationError`.
        """
        for name in names:
            if name not in self.markers:
                raise self._missing("marker", name, self.markers)
        return np.stack([self.markers[name] for name in names], axis=1)

    def markers_of(self, body: str) -> tuple[str, ...]:
        """Names of the measured markers of a rigid body, those that begin with `BODY:`."""
        self.body(body)
        return tuple(name for name in self.markers if name.startswith(f"{body}:"))

    def _missing(self, what: str, name: str, known: Collection[str]) -> RegistrationError:
        labelled = [word for word in known if not word.startswith(_UNNAMED)]
        fact, hint = f"has no {what} '{name}'", closest(name, labelled)
        if what == "marker" and name in self.solved:
            fact = f"'{name}' is where a rigid body expects a marker, not a measured one"
            hint = "export the take with its markers ('Markers' in Motive's export)"
        elif name in self.doubled:
            fact, hint = f"the name '{name}' occurs twice", "rename one in Motive"
        return RegistrationError(f"{self.path}: {fact}", hint)


_SEPARATOR_NAMES = {";": "semicolons", "\t": "tabs"}
_OLDEST, _NEWEST = 1.2, 1.25  # versions of the format
_METRES = {"meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3}
_AGAIN = "export the take from Motive again"
_WITH_HEADER = "export the take to CSV from Motive, with the header information"
_MAX_FILE_SIZE = 2**28  # [bytes]
_MAX_NUMBER = 1e9  # of any number in a file, frame numbers included
_NORM_TOLERANCE = 1e-3  # [-]; of a quaternion's norm; six decimals are exported

_BODY, _MARKER, _SOLVED = "Rigid Body", "Marker", "Rigid Body Marker"
_Part = tuple[str, str]  # property and axis
_ROTATION: list[_Part] = [("Rotation", axis) for axis in "XYZW"]
_POSITION: list[_Part] = [("Position", axis) for axis in "XYZ"]
_REQUIRED = {_BODY: _ROTATION + _POSITION, _MARKER: _POSITION, _SOLVED: _POSITION}
_FIRST_COLUMN = 2  # after the frame and the time
_TITLE_ROWS = 4
_Columns = dict[tuple[str, str], dict[_Part, int]]  # by type and name


def read_motive_csv(path: Path) -> MotiveTake:
    """Read a take; a truncated last line is skipped with a note.

    Raises:
        RegistrationError: If the path is a folder, or the file is not a complete Motive export with
            rigid bodies or markers, global coordinates and quaternions.
    """
    if path.is_dir():
        raise RegistrationError(
            f"{path}: is a folder; a trial holds the two triads but no landmarks",
            "record a static take with landmark markers in Motive and export it to CSV",
        )
    text = read_text(path, "a take", _MAX_FILE_SIZE)
    with naming(path):
        return _parse(text, path)


def _parse(text: str, path: Path) -> MotiveTake:
    """Parse a take; errors do not name the file."""
    separator, text = split_separator(text)
    header, titles, first = _read_titles(text, separator)
    values, notes = _read_header(header)
    if separator != ",":
        used = _SEPARATOR_NAMES.get(separator, f"'{separator}'")
        notes.append(f"{used} separate its columns: a spreadsheet program has saved it again")
    columns, doubled = _find_columns(titles)
    rows = _read_rows(text, separator, first, len(titles[0]), notes)
    exported = values.get("Total Exported Frames", "")
    if exported.isdecimal() and int(exported) != len(rows):
        notes.append(f"holds {len(rows)} frames, {exported} were exported")
    table = _read_numbers(rows, columns)
    scale = _METRES[values["Length Units"].lower()]

    found: dict[str, dict[str, FloatArray]] = {kind: {} for kind in _REQUIRED}
    for (kind, name), places in columns.items():
        found[kind][name] = scale * table[:, [places[part] for part in _POSITION]]
    bodies = {}
    for name, position in found[_BODY].items():
        quaternion = table[:, [columns[_BODY, name][part] for part in _ROTATION]]
        off = np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) > _NORM_TOLERANCE
        _refuse_rows(off, rows, f"the quaternion of '{name}' is not of length 1")
        bodies[name] = Pose.from_quaternion(position, quaternion)
    return MotiveTake(
        path=path,
        version=values["Format Version"].replace(",", "."),
        frame_rate=_number(values["Export Frame Rate"]),
        units=values["Length Units"],
        frames=table[:, 0].astype(np.int64),
        times=table[:, 1],
        bodies=bodies,
        markers=found[_MARKER],
        solved=found[_SOLVED],
        doubled=doubled,
        notes=tuple(f"{path}: {note}" for note in notes),
    )


def _read_titles(text: str, separator: str) -> tuple[list[str], list[list[str]], int]:
    """The header, the title rows padded to one width, and the number of lines above the data."""
    reader = csv.reader(io.StringIO(text), delimiter=separator, strict=True)
    rows: list[list[str]] = []
    try:
        for cells in reader:
            row = [cell.strip() for cell in cells]
            if not rows and any(row) and row[0] != "Format Version":
                break
            rows += [row] if any(row) else []
            if row[:1] == ["Frame"]:
                break
    except csv.Error as error:
        raise RegistrationError(f"line {reader.line_num} is not CSV ({error})", _AGAIN) from None
    if not rows:
        fact = "is not a Motive export, which begins with 'Format Version'"
        raise RegistrationError(fact, _WITH_HEADER)
    if len(rows) <= _TITLE_ROWS or rows[-1][0] != "Frame":
        fact = "has no rows of types, names, properties and axes above its frames"
        raise RegistrationError(fact, _WITH_HEADER)
    width = max(i + 1 for row in rows[1:] for i, cell in enumerate(row) if cell)
    titles = [(row + [""] * width)[:width] for row in rows[1:]]
    return rows[0], titles, reader.line_num


def _read_header(cells: list[str]) -> tuple[dict[str, str], list[str]]:
    # Pair every cell with the next: a comma in the take's name would shift regular pairs.
    values = dict(pairwise(cells))
    values["Export Frame Rate"] = values.get("Export Frame Rate") or values.get(
        "Capture Frame Rate", ""
    )
    for key in ("Format Version", "Length Units", "Rotation Type", "Export Frame Rate"):
        if not values.get(key):
            raise RegistrationError(f"the header has no '{key}'", _AGAIN)
    version, units = values["Format Version"], values["Length Units"]
    space = values.get("Coordinate Space", "Global")
    rotation, metres = values["Rotation Type"], "metres, centimetres or millimetres"
    for right, fact, hint in (
        (rotation == "Quaternion", f"rotations of the type {rotation}", "export quaternions"),
        (units.lower() in _METRES, f"lengths in '{units}'", f"export {metres}"),
        (space == "Global", f"coordinates in the space '{space}'", "export global coordinates"),
        (
            math.isfinite(_number(version)),
            f"the format version '{version}', which is not a number",
            f"{_AGAIN}: a spreadsheet program has taken it for a date",
        ),
        (_number(version) >= _OLDEST, f"the format version {version}", "use 1.20 to 1.25"),
        (_number(values["Export Frame Rate"]) > 0.0, "no frame rate in its header", _AGAIN),
    ):
        if not right:
            raise RegistrationError(f"has {fact}", hint)
    newer = _number(version) > _NEWEST
    note = f"the format version {version} is not known; read as {_NEWEST}"
    return values, [note] if newer else []


def _find_columns(titles: list[list[str]]) -> tuple[_Columns, frozenset[str]]:
    """Columns of each body or marker by property and axis, and the duplicate names."""
    *names_rows, properties, axes = titles
    labelled = {row[1]: row for row in names_rows}
    kinds, names = labelled.get("Type", titles[0]), labelled.get("Name", titles[1])
    columns: _Columns = {}
    doubled = set()
    for column, (kind, name, meaning, axis) in enumerate(
        zip(kinds, names, properties, axes, strict=True)
    ):
        if column >= _FIRST_COLUMN and (meaning, axis) in _REQUIRED.get(kind, ()):
            parts = columns.setdefault((kind, name), {})
            if (meaning, axis) in parts:
                doubled.add((kind, name))
            parts[meaning, axis] = column
    columns = {key: parts for key, parts in columns.items() if key not in doubled}
    if not columns:
        fact = "has neither rigid bodies nor markers"
        raise RegistrationError(fact, "export rigid bodies and markers from Motive")
    for (kind, name), parts in columns.items():
        for meaning, axis in _REQUIRED[kind]:
            if (meaning, axis) not in parts:
                fact = f"the {kind.lower()} '{name}' has no column {meaning} {axis}"
                raise RegistrationError(fact, "export the take again, with all its columns")
    return columns, frozenset(name for _, name in doubled)


def _read_rows(
    text: str, separator: str, first: int, width: int, notes: list[str]
) -> dict[int, list[str]]:
    """The cells of complete frames by line number."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    rows = {
        number: [cell.strip() for cell in _cells(line, separator, number)]
        for number, line in enumerate(lines[first:], start=first + 1)
        if line.strip(f'{separator} "')
    }
    last = max(rows, default=0)
    # Without a line end, even a last line of full width may lack digits of its last number.
    if rows and (lines[-1] or len(rows[last]) < width):
        notes.append(f"line {last}, the last, is cut short; it is left out")
        del rows[last]
    if not rows:
        raise RegistrationError("holds no frame", _AGAIN)
    for line, row in rows.items():
        if len(row) < width or any(row[width:]):
            fact = f"line {line} has {len(row)} columns, the header {width}"
            raise RegistrationError(fact, _AGAIN)
    return rows


def _read_numbers(rows: dict[int, list[str]], columns: _Columns) -> FloatArray:
    """A table as wide as the file, NaN for blank cells and columns that are not read."""
    titles = {0: "frame", 1: "time"} | {
        column: f"{kind} {name}, {meaning} {axis}".rstrip()
        for (kind, name), parts in columns.items()
        for (meaning, axis), column in parts.items()
    }
    table = np.full((len(rows), max(titles) + 1), np.nan)
    for column, title in titles.items():
        cells = [row[column] for row in rows.values()]
        numbers = table[:, column] = _numbers(cells)
        wrong = ~(np.abs(numbers) < _MAX_NUMBER) & np.array([bool(cell) for cell in cells])
        if wrong.any():
            first = int(np.argmax(wrong))
            fact = f"line {[*rows][first]}, column {column + 1} ({title}) holds '{cells[first]}'"
            raise RegistrationError(fact, f"{_AGAIN}, or put the number there")
    for column in (0, 1):
        rising = np.diff(table[:, column], prepend=-np.inf) > 0.0  # false for a blank cell
        _refuse_rows(~rising, rows, f"the {titles[column]} does not follow the one before")
    return table


def _cells(line: str, separator: str, number: int) -> list[str]:
    """The cells of a line; in quotes, they may hold the separator."""
    if '"' not in line:
        return line.split(separator)
    try:
        return next(csv.reader([line], delimiter=separator, strict=True))
    except csv.Error as error:
        raise RegistrationError(f"line {number} is not CSV ({error})", _AGAIN) from None


_PLAIN = re.compile(r"[-+\d.eE\n]*", flags=re.ASCII)


def _numbers(cells: list[str]) -> FloatArray:
    """The numbers in cells, shape (N,); NaN for those that hold none."""
    if _PLAIN.fullmatch("\n".join(cells)):
        with suppress(ValueError):
            return np.array([cell or "nan" for cell in cells]).astype(np.float64)
    return np.array([_number(cell) for cell in cells])


def _number(cell: str) -> float:
    """The number in a cell, perhaps with a decimal comma; NaN if it holds none."""
    try:
        return decimal(cell if "." in cell else cell.replace(",", "."))
    except ValueError:
        return math.nan


def _refuse_rows(wrong: BoolArray, rows: dict[int, list[str]], fact: str) -> None:
    if wrong.any():
        raise RegistrationError(f"line {[*rows][np.argmax(wrong)]}: {fact}", _AGAIN)
