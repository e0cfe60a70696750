"""Takes as Motive exports them to CSV, format versions 1.20 to 1.25.

The rows of names stand between the header and the row of axes ('Frame, Time, X, Y, Z, ...').
Formats 1.20 and 1.21 tell them by their order: type, name, id, property. Later ones say in the
second column what a row holds, with a row 'Parent' besides since 1.25. Columns without a type,
such as the time code, and those of bones are left alone.

The format is described at docs.optitrack.com (Data Export: CSV): a line of keys and values, the
rows that name the columns, and a line for each frame. A blank cell was not seen.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise, zip_longest
from operator import itemgetter
from pathlib import Path

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import RegistrationError
from socket_testbed.files import closest
from socket_testbed.geometry.pose import Pose

_UNNAMED = ("Unlabeled", "Unlabelled")


@dataclass(frozen=True)
class TrackedBody:
    """A rigid body as Motive tracked it over N frames.

    Attributes:
        pose: Poses of Motive's body frame in `world`; NaN where the body was not tracked.
        error: Motive's mean error of a marker, shape (N,), taken to metres with the unit of
            the positions; NaN where it was not exported.
    """

    pose: Pose
    error: FloatArray


@dataclass(frozen=True)
class MotiveTake:
    """A take that Motive exported, N frames of it.

    Attributes:
        path: File of the take.
        version: Version of the format.
        frame_rate: Frame rate of the export [Hz].
        units: Unit of length in the file, as written there; all below is in metres.
        frames: Frame numbers, shape (N,).
        times: Times since the start of the take, shape (N,) [s].
        bodies: Rigid bodies by name.
        markers: Measured markers by name, in `world`, shape (N, 3) [m]; NaN where occluded.
        solved: Markers where Motive's rigid bodies expect them, likewise.
        doubled: Names that stand twice among the bodies, markers or solved markers; what has
            such a name is not read.
        notes: What a person should know of the file.
    """

    path: Path
    version: str
    frame_rate: float
    units: str
    frames: IntArray
    times: FloatArray
    bodies: dict[str, TrackedBody]
    markers: dict[str, FloatArray]
    solved: dict[str, FloatArray]
    doubled: frozenset[str]
    notes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.frames)

    def body(self, name: str) -> TrackedBody:
        """A rigid body.

        Raises:
            RegistrationError: If the take does not have it.
        """
        if name not in self.bodies:
            raise self._missing("rigid body", name, self.bodies)
        return self.bodies[name]

    def stack(self, names: Iterable[str]) -> FloatArray:
        """Measured markers in `world`, shape (N, k, 3) [m]; NaN where occluded.

        Raises:
            RegistrationError: If the take does not have one of them, or only as a solved
                marker: that is where a rigid body expects it, not where it was seen.
        """
        return np.stack([self._marker(name) for name in names], axis=1)

    def markers_of(self, body: str) -> tuple[str, ...]:
        """Names of the measured markers of a rigid body.

        Raises:
            RegistrationError: If the take does not have the body.
        """
        self.body(body)
        return tuple(name for name in self.markers if name.startswith(f"{body}:"))

    def _marker(self, name: str) -> FloatArray:
        if name in self.markers:
            return self.markers[name]
        if name in self.solved:
            raise RegistrationError(
                f"{self.path}: '{name}' is where a rigid body expects a marker, not a measured one",
                "export the take with its markers ('Markers' in Motive's export)",
            )
        raise self._missing("marker", name, self.markers)

    def _missing(self, what: str, name: str, known: Collection[str]) -> RegistrationError:
        if name in self.doubled:
            return RegistrationError(
                f"{self.path}: the name '{name}' stands twice", "rename one in Motive"
            )
        labelled = [word for word in known if not word.startswith(_UNNAMED)]
        return RegistrationError(f"{self.path}: has no {what} '{name}'", closest(name, labelled))


_OLDEST, _NEWEST = 1.2, 1.25
_METRES = {"meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3}
_HEADER_HINT = "export the take from Motive again"


@dataclass(frozen=True)
class MotiveHeader:
    """What the header says of a take.

    Attributes:
        version: Version of the format.
        frame_rate: Frame rate of the export [Hz].
        units: Unit of length, as written.
        scale: Unit of length [m].
        exported: Number of frames that were exported; None where it is not said.
        notes: What a person should know of it.
    """

    version: str
    frame_rate: float
    units: str
    scale: float
    exported: int | None
    notes: tuple[str, ...]


def read_header(cells: list[str], path: Path) -> MotiveHeader:
    """Read the header.

    Raises:
        RegistrationError: If this is no header of Motive, or one of a file that is not read here.
    """
    cells = [cell.strip() for cell in cells]
    if cells[0] != "Format Version":
        raise RegistrationError(
            f"{path}: is no export of Motive, which begins with 'Format Version'",
            "export the take to CSV from Motive, with the header information",
        )
    # A comma in the name of the take shifts the pairs: what follows a key is its value.
    values = dict(pairwise(cells))
    for key in ("Format Version", "Length Units", "Rotation Type"):
        if not values.get(key):
            raise RegistrationError(f"{path}: the header has no '{key}'", _HEADER_HINT)
    _require_conventions(values, path)
    units = values["Length Units"]
    exported = values.get("Total Exported Frames", "")
    return MotiveHeader(
        version=values["Format Version"],
        frame_rate=_frame_rate(values, path),
        units=units,
        scale=_METRES[units.lower()],
        exported=int(exported) if exported.isdecimal() else None,
        notes=_version_notes(values["Format Version"], path),
    )


def _require_conventions(values: dict[str, str], path: Path) -> None:
    if values["Rotation Type"] != "Quaternion":
        raise RegistrationError(
            f"{path}: has rotations of the type {values['Rotation Type']}", "export quaternions"
        )
    if values["Length Units"].lower() not in _METRES:
        raise RegistrationError(
            f"{path}: has lengths in '{values['Length Units']}'",
            "export metres, centimetres or millimetres",
        )
    space = values.get("Coordinate Space", "Global")
    if space != "Global":
        raise RegistrationError(
            f"{path}: has coordinates in the space '{space}'", "export global (world) coordinates"
        )


def _version_notes(version: str, path: Path) -> tuple[str, ...]:
    number = _header_number(version)
    if not number >= _OLDEST:
        raise RegistrationError(
            f"{path}: has the format version {version}",
            "export the take from a newer Motive (format 1.20 to 1.25)",
        )
    if number > _NEWEST:
        return (f"{path}: the format version {version} is not known; read as {_NEWEST}",)
    return ()


def _frame_rate(values: dict[str, str], path: Path) -> float:
    for key in ("Export Frame Rate", "Capture Frame Rate"):
        rate = _header_number(values.get(key, ""))
        if 0.0 < rate < math.inf:
            return rate
    raise RegistrationError(f"{path}: the header has no frame rate", _HEADER_HINT)


def _header_number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


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


_AGAIN = "export the take from Motive again"
_LARGEST = 1e9  # nothing that Motive writes is larger, frame numbers included
_UNIT_LENGTH = 1e-3  # [-]; the quaternions have six decimals


def read_motive_csv(path: Path) -> MotiveTake:
    """Read a take; a last line that was cut short is left out, with a note.

    Raises:
        RegistrationError: If the file is missing or anything in it is not as it must be.
    """
    text = _read_text(path)
    rows = _split(text, path)
    header = read_header(rows[0][1], path)
    columns, first = read_columns(rows, path)
    frames, notes = _whole_frames(rows[first:], columns, text.endswith(("\n", "\r")), header, path)
    table = _read_numbers(frames, columns, path)
    _require_order(table, frames, path)
    bodies = {name: _read_body(parts, table, header.scale) for name, parts in columns.of(BODY)}
    _require_unit_quaternions(columns, table, frames, path)
    return MotiveTake(
        path=path,
        version=header.version,
        frame_rate=header.frame_rate,
        units=header.units,
        frames=table[:, 0].astype(np.int64),
        times=table[:, 1],
        bodies=bodies,
        markers={name: _take(table, p, POSITION, header.scale) for name, p in columns.of(MARKER)},
        solved={name: _take(table, p, POSITION, header.scale) for name, p in columns.of(SOLVED)},
        doubled=columns.doubled,
        notes=(*header.notes, *notes),
    )


def _read_text(path: Path) -> str:
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise RegistrationError(f"{path}: no such file", "check the path") from None
    except UnicodeDecodeError:
        raise RegistrationError(f"{path}: is no UTF-8 text", _AGAIN) from None
    except OSError as error:
        raise RegistrationError(
            f"{path}: cannot be read ({error.strerror})", "check the file"
        ) from None
    if not text.strip():
        raise RegistrationError(f"{path}: is empty", _AGAIN)
    return text


def _split(text: str, path: Path) -> list[Row]:
    """The lines that hold something, with their numbers."""
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        return [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
    except csv.Error as error:
        raise RegistrationError(
            f"{path}: line {reader.line_num} is no CSV ({error})", _AGAIN
        ) from None


def _whole_frames(
    rows: list[Row], columns: Columns, ended: bool, header: MotiveHeader, path: Path
) -> tuple[list[Row], list[str]]:
    """The rows of whole frames, and notes on what is missing."""
    notes = []
    # Without its line end even a last line of full width may lack digits of its last number.
    if rows and (not ended or len(rows[-1][1]) < columns.width):
        notes.append(f"{path}: line {rows[-1][0]}, the last, is cut short; it is left out")
        rows = rows[:-1]
    if not rows:
        raise RegistrationError(f"{path}: holds no frame", _AGAIN)
    for line, row in rows:
        if len(row) < columns.width or any(row[columns.width :]):
            raise RegistrationError(
                f"{path}: line {line} has {len(row)} columns, the header {columns.width}", _AGAIN
            )
    if header.exported not in {None, len(rows)}:
        notes.append(f"{path}: holds {len(rows)} frames, {header.exported} were exported")
    return rows, notes


def _read_numbers(rows: list[Row], columns: Columns, path: Path) -> FloatArray:
    """A table as wide as the file, NaN where a cell is blank or in a column that is not read."""
    read = sorted({0, 1}.union(*(parts.values() for parts in columns.things.values())))
    pick = itemgetter(*read)
    table = np.full((len(rows), columns.width), np.nan)
    for i, (line, row) in enumerate(rows):
        try:
            table[i, read] = [_number(cell) for cell in pick(row)]
        except ValueError:
            wrong = next(column for column in read if not _is_number(row[column]))
            raise RegistrationError(
                f"{path}: line {line}, {columns.title(wrong)} holds '{row[wrong]}'",
                f"{_AGAIN}, or put the number there",
            ) from None
    return table


def _number(cell: str) -> float:
    if not cell:
        return math.nan
    number = float(cell)
    if not abs(number) < _LARGEST:
        raise ValueError
    return number


def _is_number(cell: str) -> bool:
    try:
        _number(cell)
    except ValueError:
        return False
    return True


def _require_order(table: FloatArray, rows: list[Row], path: Path) -> None:
    for column, what in enumerate(("frame", "time")):
        rising = np.diff(table[:, column], prepend=-np.inf) > 0.0
        if not rising.all():  # a blank cell does not follow anything either
            raise RegistrationError(
                f"{path}: line {rows[int(np.argmin(rising))][0]}: the {what} does not follow the"
                " one before",
                _AGAIN,
            )


def _take(
    table: FloatArray, parts: dict[Part, int], wanted: tuple[Part, ...], scale: float
) -> FloatArray:
    return scale * table[:, [parts[part] for part in wanted]]


def _read_body(parts: dict[Part, int], table: FloatArray, scale: float) -> TrackedBody:
    quaternion = _take(table, parts, ROTATION, 1.0)
    error = error_column(parts)
    return TrackedBody(
        Pose.from_quaternion(_take(table, parts, POSITION, scale), quaternion),
        np.full(len(table), np.nan) if error is None else scale * table[:, error],
    )


def _require_unit_quaternions(
    columns: Columns, table: FloatArray, rows: list[Row], path: Path
) -> None:
    for name, parts in columns.of(BODY):
        length = np.linalg.norm(_take(table, parts, ROTATION, 1.0), axis=1)
        off = np.abs(length - 1.0) > _UNIT_LENGTH
        if off.any():
            raise RegistrationError(
                f"{path}: line {rows[int(np.argmax(off))][0]}: the quaternion of '{name}' has the"
                f" length {length[off][0]:.3g}",
                _AGAIN,
            )
