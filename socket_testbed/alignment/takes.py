"""Takes of motion capture, exported to tables, as poses with their own times."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed.alignment.series import PoseSeries
from socket_testbed.alignment.table_file import TableFormat, read_clock, table_text, values_of
from socket_testbed.alignment.units import WRITTEN, factor
from socket_testbed.arrays import FloatArray
from socket_testbed.cells import TextTable, read_text_table, split_title
from socket_testbed.documents import split_separator
from socket_testbed.errors import ConfigurationError, closest, listed, naming
from socket_testbed.geometry.marker_bodies import fit_body
from socket_testbed.geometry.pose import Pose
from socket_testbed.socket_design.motive import read_motive_csv

_SECOND = 1_000_000_000  # [ns]
_HEAD = 4096  # [characters]; of a file, in which its program shows
_MARKERS = "Trajectories"  # the part of a Nexus export that is read
_NEXUS = (_MARKERS, "Devices", "Model Outputs", "Segments", "Joints")  # parts that it may have
_NEXUS_HEAD = 5  # [lines] above the rows of a part
_FIRST_MARKER = 2  # after frame and sub-frame
_BODY_COLUMNS = 16  # of a body of a Qualisys export
_PARTS = ("x", "y", "z", "qx", "qy", "qz", "qw")
_TURN = re.compile(
    r"(?P<body>.*?)[ ._/:-]*(?:pose[ ._/:-]*)*(?:orientation|rotation|quaternion|quat|q)[ ._/:-]*"
    r"(?P<axis>[xyzw])",
    re.I,
)
_PLACE = re.compile(
    r"(?P<body>.*?)(?:^|[ ._/:-]+)(?:pose[ ._/:-]*)*(?:(?:position|translation|pos)[ ._/:-]*)?"
    r"(?P<axis>[xyz])",
    re.I,
)
_AGREES = 1e-2  # [-]; of a rotation matrix with angles that are rounded
_MAX_LISTED = 6
_MIN_FITTED = 0.5  # share of the frames with all markers that must fit the body


@dataclass(frozen=True)
class Take:
    """What an export of motion capture holds, N frames.

    Attributes:
        path: The file.
        program: The program that wrote it; empty for a table with columns of poses.
        times: Time of each frame since the start of the take, shape (N,) [s].
        bodies: N poses of each rigid body in `world` by its name; NaN where it is not tracked.
        markers: Positions of each marker in `world` by its name, shape (N, 3) [m]; NaN where
            occluded.
        notes: Remarks for the user.
        is_dated: Whether the times count from 1970.
    """

    path: Path
    program: str
    times: FloatArray
    bodies: dict[str, Pose]
    markers: dict[str, FloatArray]
    notes: tuple[str, ...]
    is_dated: bool = False

    def markers_of(self, body: str) -> tuple[str, ...]:
        """Names of the markers of a body, those that begin with `BODY:`."""
        return tuple(name for name in self.markers if name.startswith(f"{body}:"))

    @property
    def names(self) -> list[str]:
        """Names of the bodies, of rigid bodies and of markers called `BODY:...`."""
        labelled = [
            name.partition(":")[0]
            for name in self.markers
            if ":" in name and not name.startswith(("Unlabeled", "Unlabelled"))
        ]
        return list(dict.fromkeys([*self.bodies, *labelled]))


def is_take(text: str) -> bool:
    """Whether a file's text begins like an export of motion capture that `read_take` knows.

    Args:
        text: The first lines.
    """
    return _reader_of(text) is not None


def read_take(path: Path) -> Take:
    """Read an export of motion capture.

    These are takes of Motive (CSV), trajectories of Vicon Nexus (CSV) and 6DOF data of Qualisys
    Track Manager (TSV).

    Raises:
        RegistrationError: If a take of Motive is not complete.
        ConfigurationError: If another export is not complete, or is no such export.
    """
    read = _reader_of(table_text(path)[:_HEAD])
    if read is None:
        fact = f"{path.name}: is no export of motion capture that is known"
        raise ConfigurationError(fact, "export it from Motive, Vicon Nexus or Qualisys")
    return read(path)


def _reader_of(text: str) -> Callable[[Path], Take] | None:
    start = text.lstrip('\ufeff" \t\r\n')
    if start.startswith("Format Version"):
        return _read_motive
    if re.match(rf"(?:{'|'.join(_NEXUS)})[\t,; ]*[\r\n]", start):
        return _read_nexus
    if start.startswith("NO_OF_FRAMES"):
        return _read_qualisys
    return None


def _read_motive(path: Path) -> Take:
    take = read_motive_csv(path)
    return Take(path, "Motive", take.times, take.bodies, take.markers, take.notes)


def _read_nexus(path: Path) -> Take:
    """Read the part 'Trajectories' of a Nexus export: rate, names, titles, units, frames."""
    with naming(path.name):
        parts = re.split(r"\n[\t,; ]*(?=\n|$)", re.sub(r"\r\n?", "\n", table_text(path)))
        lines = next(
            (part.strip("\n").split("\n") for part in parts if part.strip().startswith(_MARKERS)),
            [],
        )
        if len(lines) < _NEXUS_HEAD + 1:
            fact = f"has no part '{_MARKERS}' with rows"
            raise ConfigurationError(fact, "export the trajectories from Nexus as ASCII")
        separator, _ = split_separator(lines[3])
        rate = _rate(lines[1])
        names = [cell.strip() for cell in lines[2].split(separator)]
        # The row of titles and that of units stay; the last line has an end, as in the file.
        table = read_text_table("\n".join([*lines[3:], ""]), WRITTEN)
        columns = [k for k, name in enumerate(names) if name and k >= _FIRST_MARKER]
        markers = {}
        for column in columns:
            titles = [f"{axis} [mm]" for axis in "XYZ"]
            if list(table.titles[column : column + 3]) != titles:
                fact = f"the columns of '{names[column]}' are {table.titles[column : column + 3]}"
                raise ConfigurationError(fact, "export trajectories as X, Y, Z in mm")
            markers[names[column]] = 1e-3 * np.column_stack(
                [table.numbers(column + axis) for axis in range(3)]
            )
        times = (table.numbers(0) - 1.0) / rate
    return Take(path, "Nexus", times, {}, markers, table.notes)


def _rate(cell: str) -> float:
    try:
        rate = float(re.sub(r"[\t,; ]+$", "", cell))
    except ValueError:
        rate = 0.0
    if rate <= 0.0:
        raise ConfigurationError(f"its rate is '{cell}'", "export it again")
    return rate


def _read_qualisys(path: Path) -> Take:
    """Read 6DOF data: for each body X, Y, Z [mm], three angles, residual, and a rotation matrix.

    The matrix is written by columns; where the angles agree with its transpose instead, by rows.
    """
    with naming(path.name):
        table = read_text_table(table_text(path), WRITTEN)
        header = {
            row[0].strip(): row[1:] for row in (line.split("\t") for line in table.above) if row
        }
        names = [name.strip() for name in header.get("BODY_NAMES", ()) if name.strip()]
        if not names:
            fact = "names no body in its header (BODY_NAMES)"
            raise ConfigurationError(fact, "export 6DOF data from Qualisys, with the header")
        rate = _rate((header.get("FREQUENCY") or [""])[0])
        number = len(table.columns)
        starts = [k for k, t in enumerate(table.titles) if re.fullmatch(r"(.* )?X", t.strip())]
        if len(starts) != len(names):
            fact = f"has {len(starts)} columns X for {len(names)} bodies"
            raise ConfigurationError(fact, "export 6DOF data from Qualisys with titles of columns")
        bodies = {
            name: _qualisys_body(table, start) for name, start in zip(names, starts, strict=True)
        }
    return Take(path, "Qualisys", np.arange(number) / rate, bodies, {}, table.notes)


def _qualisys_body(table: TextTable, start: int) -> Pose:
    """The poses of a body whose columns begin at `start`."""
    titles = [title.strip() for title in table.titles[start : start + _BODY_COLUMNS]]
    wanted = ["Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *(f"Rot[{k}]" for k in range(9))]
    if titles[1:] != wanted:
        fact = f"the columns of '{titles[0]}' are {listed(titles[1:], 16)}"
        raise ConfigurationError(fact, f"export {', '.join(wanted[:6])} and Rot[0] to Rot[8]")
    values = np.column_stack([table.numbers(start + k) for k in range(_BODY_COLUMNS)])
    values[(values[:, 7:] == 0.0).all(axis=1)] = np.nan  # a body that is not seen
    matrices = values[:, 7:].reshape(-1, 3, 3)
    angles = Rotation.from_euler("XYZ", np.nan_to_num(values[:, 3:6]), degrees=True).as_matrix()
    by_column, by_row = np.swapaxes(matrices, 1, 2), matrices
    off = [np.nanmax(np.abs(way - angles), initial=0.0) for way in (by_column, by_row)]
    if min(off) > _AGREES:
        raise ConfigurationError(
            f"the angles of '{titles[0]}' do not agree with its rotation matrix",
            "export with the standard definition of Euler angles of Qualisys",
        )
    rotation = by_column if off[0] <= off[1] else by_row
    return Pose(rotation, 1e-3 * values[:, :3])


def pose_columns(table: TextTable) -> dict[str, dict[str, int]]:
    """Columns x to z and qx to qw of each body in a table, by the body's name.

    Titles are such as `socket.x [mm]` and `socket.qw`, or `/rig/socket/pose.position.x [m]` and
    `/rig/socket/pose.orientation.w`. Bodies without all seven are left out.

    Args:
        table: The table.

    Raises:
        ConfigurationError: If a column is there twice.
    """
    found: dict[str, dict[str, int]] = {}
    for column, title in enumerate(table.titles):
        name, unit = split_title(title, WRITTEN)
        turn, place = _TURN.fullmatch(name), _PLACE.fullmatch(name)
        if turn is None and (place is None or (unit and factor("length", unit) is None)):
            continue
        match = turn or place
        assert match is not None
        body = match["body"].strip(" ._/:-") or "body"
        part = f"q{match['axis']}" if turn else match["axis"]
        own = found.setdefault(body, {})
        if part.lower() in own:
            shown = f"'{table.titles[own[part.lower()]]}' and '{title}'"
            raise ConfigurationError(f"{shown} are both {part} of '{body}'", "rename one")
        own[part.lower()] = column
    return {body: own for body, own in found.items() if len(own) == len(_PARTS)}


def table_take(path: Path, table: TextTable, stated: TableFormat) -> Take:
    """The poses of the bodies of a table, see `pose_columns`.

    Args:
        path: The file.
        table: Its table.
        stated: What its titles do not tell.

    Raises:
        ConfigurationError: If a length or the time has no unit, or quaternions are not of length 1.
    """
    clock = read_clock(table, stated)
    bodies = {}
    for body, columns in pose_columns(table).items():
        places = {axis: columns[axis] for axis in _PARTS[:3]}
        position = values_of(table, places, dict.fromkeys(places, "length"), stated)[clock.kept]
        turn = np.column_stack([table.numbers(columns[part]) for part in _PARTS[3:]])[clock.kept]
        length = np.linalg.norm(turn, axis=1)
        turn[length == 0.0] = np.nan  # not tracked
        if (off := np.abs(length - 1.0) > _AGREES)[length > 0.0].any():
            line = table.columns.index[clock.kept[np.argmax(off & (length > 0.0))]]
            fact = f"line {line}: the quaternion of '{body}' is not of length 1"
            raise ConfigurationError(fact, "give qx, qy, qz, qw of unit quaternions")
        bodies[body] = Pose.from_quaternion(position, turn)
    notes = tuple(f"{path.name}: {note}" for note in (*table.notes, *clock.notes))
    return Take(path, "", clock.times / _SECOND, bodies, {}, notes, clock.is_dated)


def take_poses(take: Take, body: str, reference: FloatArray) -> tuple[PoseSeries, tuple[str, ...]]:
    """Poses of a body of a take, and notes.

    The poses of a rigid body are those of the program that wrote the take. Without one, the markers
    called `BODY:...`, or those that are named one by one, are fitted to the markers of socket.yaml.

    Args:
        take: The take.
        body: The rigid body's name, or the names of markers with commas between them.
        reference: Markers of the body in its own frame, shape (k, 3) [m].

    Raises:
        ConfigurationError: If the take has no such body or markers, or they do not fit the body.
    """
    if body in take.bodies:
        pose = take.bodies[body]
        origin = f"{take.program}'s rigid body" if take.program else "its columns"
        notes = (
            f"{take.path.name}: the pose of '{body}' is that of {origin}: socket.yaml must state"
            " its place",
        )
    else:
        pose = _fitted(take, body, reference)
        notes = (f"{take.path.name}: '{body}' is fitted to the markers of socket.yaml",)
    seen = np.asarray(np.isfinite(pose.translation).all(axis=1))
    if not seen.any():
        raise ConfigurationError(
            f"{take.path.name}: '{body}' is never tracked", "choose another body"
        )
    times = np.round(take.times * _SECOND).astype(np.int64)[seen]
    vectors = pose.vector[seen]
    return PoseSeries(times, vectors[:, :3], vectors[:, 3:], "world"), notes


def _fitted(take: Take, body: str, reference: FloatArray) -> Pose:
    """Poses fitted to markers."""
    names = take.markers_of(body) or tuple(name.strip() for name in body.split(","))
    unknown = [name for name in names if name not in take.markers]
    if unknown:
        known = [*take.names, *take.markers]
        raise ConfigurationError(
            f"{take.path.name}: has no body or marker '{unknown[0]}'", closest(unknown[0], known)
        )
    if len(names) != len(reference):
        raise ConfigurationError(
            f"{take.path.name}: '{body}' has {len(names)} markers"
            f" ({listed(list(names), _MAX_LISTED)}), socket.yaml {len(reference)}",
            "name the markers with commas between them, or give the socket.yaml of this socket",
        )
    observed = np.stack([take.markers[name] for name in names], axis=1)
    pose = fit_body(reference, observed).pose
    complete = np.isfinite(observed).all(axis=(1, 2))
    fits = np.asarray(np.isfinite(pose.translation).all(axis=1))
    if complete.any() and fits[complete].mean() < _MIN_FITTED:
        raise ConfigurationError(
            f"{take.path.name}: the markers of '{body}' do not have the distances of socket.yaml",
            "give the socket.yaml that these markers were registered for",
        )
    return pose
