"""Takes as Motive exports them to CSV, format versions 1.20 to 1.25.

The rows of names stand between the header and the row of axes ('Frame, Time, X, Y, Z, ...').
Formats 1.20 and 1.21 order them: type, name, id, property. Later ones name in the second
column what a row holds, with a row 'Parent' besides since 1.25. Columns without a type,
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
from pathlib import Path

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import RegistrationError
from socket_testbed.files import closest, decimal
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
        doubled: Names that occur twice among the bodies, markers or solved markers; what has
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
                f"{self.path}: the name '{name}' occurs twice", "rename one in Motive"
            )
        labelled = [word for word in known if not word.startswith(_UNNAMED)]
        return RegistrationError(f"{self.path}: has no {what} '{name}'", closest(name, labelled))


_OLDEST, _NEWEST = 1.2, 1.25
_METRES = {"meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3}
_AGAIN = "export the take from Motive again"


@dataclass(frozen=True)
class MotiveHeader:
    """The header of a take.

    Attributes:
        version: Version of the format.
        frame_rate: Frame rate of the export [Hz].
        units: Unit of length, as written.
        scale: Unit of length [m].
        exported: Number of frames that were exported; None where the header does not state it.
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
            f"{path}: is not a Motive export, which begins with 'Format Version'",
            "export the take to CSV from Motive, with the header information",
        )
    # A comma in the name of the take shifts the pairs: what follows a key is its value.
    values = dict(pairwise(cells))
    for key in ("Format Version", "Length Units", "Rotation Type"):
        if not values.get(key):
            raise RegistrationError(f"{path}: the header has no '{key}'", _AGAIN)
    version, units = values["Format Version"], values["Length Units"]
    space = values.get("Coordinate Space", "Global")
    kind, too_old = values["Rotation Type"], not _header_number(version) >= _OLDEST
    for wrong, what, hint in (
        (kind != "Quaternion", f"rotations of the type {kind}", "export quaternions"),
        (
            units.lower() not in _METRES,
            f"lengths in '{units}'",
            "export metres, centimetres or millimetres",
        ),
        (
            space != "Global",
            f"coordinates in the space '{space}'",
            "export global (world) coordinates",
        ),
        (
            too_old,
            f"the format version {version}",
            "export the take from a newer Motive (format 1.20 to 1.25)",
        ),
    ):
        if wrong:
            raise RegistrationError(f"{path}: has {what}", hint)
    rates = [_header_number(values.get(f"{rate} Frame Rate", "")) for rate in ("Export", "Capture")]
    rate = next((rate for rate in rates if 0.0 < rate < math.inf), None)
    if rate is None:
        raise RegistrationError(f"{path}: the header has no frame rate", _AGAIN)
    unknown = f"{path}: the format version {version} is not known; read as {_NEWEST}"
    exported = values.get("Total Exported Frames", "")
    return MotiveHeader(
        version=version,
        frame_rate=rate,
        units=units,
        scale=_METRES[units.lower()],
        exported=int(exported) if exported.isdecimal() else None,
        notes=(unknown,) if _header_number(version) > _NEWEST else (),
    )


def _header_number(text: str) -> float:
    try:
        return decimal(text)
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
class TakeColumns:
    """Columns of a take.

    Attributes:
        width: Number of columns.
        things: By type and name, the column of each property and axis.
        doubled: Names that occur twice for a type; they are not among the things.
    """

    width: int
    things: dict[tuple[str, str], dict[Part, int]]
    doubled: frozenset[str]

    def of(self, kind: str) -> Iterator[tuple[str, dict[Part, int]]]:
        """Names of the things of a type, with their columns."""
        return ((name, parts) for (own, name), parts in self.things.items() if own == kind)

    def read(self) -> list[int]:
        """All columns that are read: the frame, the time, and those of the things."""
        return sorted({0, 1}.union(*(parts.values() for parts in self.things.values())))

    def title(self, column: int) -> str:
        """What names a column in an error."""
        for (kind, name), parts in self.things.items():
            for (meaning, axis), place in parts.items():
                if place == column:
                    return f"column {column + 1} ({kind} {name}, {meaning} {axis}".rstrip() + ")"
        return f"column {column + 1} ({('frame', 'time')[column]})"


def read_columns(rows: list[Row], path: Path) -> tuple[TakeColumns, int]:
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
    title_rows = [[cell.strip() for cell in row] for _, row in rows[1 : axes_row + 1]]
    *names_rows, properties, axes = title_rows
    labelled = {row[1]: row for row in (*names_rows, properties) if len(row) > 1}
    kinds = labelled.get("Type", title_rows[0])
    names = labelled.get("Name", title_rows[1])
    width = max(i + 1 for row in title_rows for i, cell in enumerate(row) if cell)
    things: dict[tuple[str, str], dict[Part, int]] = {}
    doubled = set()
    titles = list(zip_longest(kinds, names, properties, axes, fillvalue=""))
    for column, (kind, name, meaning, axis) in enumerate(titles[:width]):
        if column < _FIRST_DATA or kind not in _NEEDED:
            continue
        parts = things.setdefault((kind, name), {})
        if (meaning, axis) in parts:
            doubled.add((kind, name))
        parts[meaning, axis] = column
    things = {key: parts for key, parts in things.items() if key not in doubled}
    if not things:
        raise RegistrationError(
            f"{path}: has neither rigid bodies nor markers",
            "export rigid bodies and markers from Motive",
        )
    for (kind, name), parts in things.items():
        for meaning, axis in _NEEDED[kind]:
            if (meaning, axis) not in parts:
                raise RegistrationError(
                    f"{path}: the {kind.lower()} '{name}' has no column {meaning} {axis}",
                    "export the take again, with all its columns",
                )
    return TakeColumns(width, things, frozenset(name for _, name in doubled)), axes_row + 1


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
    ended = text.endswith(("\n", "\r"))
    frames, notes = _complete_frames(rows[first:], columns, ended, header, path)
    table = _read_numbers(frames, columns, path)
    _require_order(table, frames, path)
    _require_unit_quaternions(columns, table, frames, path)

    def positions(parts: dict[Part, int]) -> FloatArray:
        return header.scale * table[:, [parts[part] for part in POSITION]]

    def body(parts: dict[Part, int]) -> TrackedBody:
        quaternion = table[:, [parts[part] for part in ROTATION]]
        errors = [header.scale * table[:, parts[part]] for part in _ERRORS if part in parts]
        return TrackedBody(
            Pose.from_quaternion(positions(parts), quaternion),
            errors[0] if errors else np.full(len(table), np.nan),
        )

    return MotiveTake(
        path=path,
        version=header.version,
        frame_rate=header.frame_rate,
        units=header.units,
        frames=table[:, 0].astype(np.int64),
        times=table[:, 1],
        bodies={name: body(parts) for name, parts in columns.of(BODY)},
        markers={name: positions(parts) for name, parts in columns.of(MARKER)},
        solved={name: positions(parts) for name, parts in columns.of(SOLVED)},
        doubled=columns.doubled,
        notes=(*header.notes, *notes),
    )


def _read_text(path: Path) -> str:
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise RegistrationError(f"{path}: no such file", "check the path") from None
    except UnicodeDecodeError:
        raise RegistrationError(f"{path}: is not UTF-8 text", _AGAIN) from None
    except OSError as error:
        raise RegistrationError(
            f"{path}: cannot be read ({error.strerror})", "check the file"
        ) from None
    if not text.strip():
        raise RegistrationError(f"{path}: is empty", _AGAIN)
    return text


def _split(text: str, path: Path) -> list[Row]:
    """The lines that hold something, with their numbers."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        return [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
    except csv.Error as error:
        raise RegistrationError(
            f"{path}: line {reader.line_num} is not CSV ({error})", _AGAIN
        ) from None


def _complete_frames(
    rows: list[Row], columns: TakeColumns, ended: bool, header: MotiveHeader, path: Path
) -> tuple[list[Row], list[str]]:
    """The rows of complete frames, and notes on what is missing."""
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


def _read_numbers(rows: list[Row], columns: TakeColumns, path: Path) -> FloatArray:
    """A table as wide as the file, NaN where a cell is blank or in a column that is not read."""
    read = columns.read()
    table = np.full((len(rows), columns.width), np.nan)
    for i, (line, row) in enumerate(rows):
        column = 0
        try:
            table[i, read] = [_number(row[column := place]) for place in read]
        except ValueError:
            raise RegistrationError(
                f"{path}: line {line}, {columns.title(column)} holds '{row[column]}'",
                f"{_AGAIN}, or put the number there",
            ) from None
    return table


def _number(cell: str) -> float:
    if not cell:
        return math.nan
    number = decimal(cell)
    if not abs(number) < _LARGEST:
        raise ValueError
    return number


def _require_order(table: FloatArray, rows: list[Row], path: Path) -> None:
    for column, what in enumerate(("frame", "time")):
        rising = np.diff(table[:, column], prepend=-np.inf) > 0.0
        if not rising.all():  # a blank cell does not follow anything either
            raise RegistrationError(
                f"{path}: line {rows[int(np.argmin(rising))][0]}: the {what} does not follow the"
                " one before",
                _AGAIN,
            )


def _require_unit_quaternions(
    columns: TakeColumns, table: FloatArray, rows: list[Row], path: Path
) -> None:
    for name, parts in columns.of(BODY):
        length = np.linalg.norm(table[:, [parts[part] for part in ROTATION]], axis=1)
        off = np.abs(length - 1.0) > _UNIT_LENGTH
        if off.any():
            raise RegistrationError(
                f"{path}: line {rows[int(np.argmax(off))][0]}: the quaternion of '{name}' has the"
                f" length {length[off][0]:.3g}",
                _AGAIN,
            )
