"""Takes as Motive exports them to CSV, format versions 1.20 to 1.25.

The format is described at docs.optitrack.com (Data Export: CSV): a line of keys and values, the
rows that name the columns, and a line for each frame. A blank cell was not seen.
"""

from __future__ import annotations

import csv
import io
import math
from operator import itemgetter
from pathlib import Path

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.errors import RegistrationError
from socket_testbed.geometry.pose import Pose
from socket_testbed.registration.motive_columns import (
    BODY,
    MARKER,
    POSITION,
    ROTATION,
    SOLVED,
    Columns,
    Part,
    Row,
    error_column,
    read_columns,
)
from socket_testbed.registration.motive_header import MotiveHeader, read_header
from socket_testbed.registration.motive_take import MotiveTake, TrackedBody

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
