"""A scan file (STL, PLY, OBJ) read as one sound body in metres, with notes of all repairs."""

from __future__ import annotations

import io
import logging
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import trimesh
from trimesh.exchange.ply import load_ply
from trimesh.exchange.stl import load_stl_ascii, load_stl_binary
from trimesh.graph import connected_component_labels
from trimesh.grouping import unique_rows

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import ScanError
from socket_testbed.files import closest, decimal
from socket_testbed.socket_design.mesh import (
    are_slivers,
    boundary_half_edges,
    fill_holes,
    flip_slivers,
    plain_mesh,
    separate,
    twin_half_edges,
    weld,
    wind_alike,
)

_Loaded = TypeVar("_Loaded")

_AGAIN = "export the scan again"
_CUT_OFF = "the file is cut off or damaged: copy or export it again"
_MOST_VERTICES = 2**31
_LARGEST = 1e9  # of a coordinate in any unit; beyond it, squares and products overflow
_STL_HEADER, _STL_FACE = 84, 50  # [bytes]


@dataclass(frozen=True)
class Triangles:
    """The content of a scan file.

    Attributes:
        vertices: Shape (V, 3), in the file's unit; may be not finite, and not welded.
        faces: Indices of existing vertices, shape (F, 3), F > 0.
        comment: The file's header or comments.
        labels: Numbers of the names of each face, -1 for none, shape (F, any).
        names: The names.
    """

    vertices: FloatArray
    faces: IntArray
    comment: str
    labels: IntArray = field(default_factory=lambda: np.empty((0, 0), np.int64))
    names: tuple[str, ...] = ()


def read_triangles(path: Path) -> Triangles:
    """Read the triangles of a scan file.

    Args:
        path: An STL (binary or ASCII), PLY or OBJ file.

    Raises:
        ScanError: If the file is missing, empty, of another kind, damaged, or without faces.
    """
    readers: dict[str, Callable[[Path, bytes], Triangles]]
    readers = {".stl": _read_stl, ".ply": _read_ply, ".obj": _read_obj}
    if path.suffix.lower() not in readers:
        raise ScanError(
            f"{path}: '{path.suffix}' is not a supported scan format",
            "export the scan as STL, PLY or OBJ",
        )
    data = _content(path)
    triangles = readers[path.suffix.lower()](path, data)
    faces, count = triangles.faces, len(triangles.vertices)
    if not len(faces):
        raise ScanError(f"{path}: has no faces", "export the surface, not only its points")
    if faces.min() < 0 or faces.max() >= count:
        wrong = int(((faces < 0) | (faces >= count)).any(axis=1).sum())
        raise ScanError(
            f"{path}: {wrong} faces name vertices that are not among its {count}", _AGAIN
        )
    return triangles


def _content(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ScanError(f"{path}: no such file", "check the path") from None
    except OSError as error:
        raise ScanError(f"{path}: cannot be read ({error.strerror})", "check the file") from None
    if not data.strip():
        raise ScanError(f"{path}: is empty", _AGAIN)
    return data


def _read_stl(path: Path, data: bytes) -> Triangles:
    # Many binary files begin with 'solid', too: the length decides before the words do.
    count = int.from_bytes(data[_STL_HEADER - 4 : _STL_HEADER], "little")
    size = _STL_HEADER + _STL_FACE * count
    if len(data) == size:
        corners = _quietly(path, data, lambda stream: _corners(load_stl_binary(stream)))
        comment = data[:80].decode("ascii", "replace")
    elif b"\0" not in data and data[:200].lstrip().lower().startswith(b"solid"):
        text = data.decode("utf-8", "replace").replace("\r\n", "\n").replace("\r", "\n")
        corners, comment = _text_corners(path, text), text.partition("\n")[0]
    elif b"\0" in data and len(data) > _STL_HEADER:
        raise ScanError(
            f"{path}: has {len(data)} bytes, but its {count} faces take {size}", _CUT_OFF
        )
    else:
        raise _damaged(path)
    return Triangles(corners, np.arange(len(corners)).reshape(-1, 3), comment)


def _text_corners(path: Path, text: str) -> FloatArray:
    """The corners of all facets of a text STL, which must be complete, shape (3 F, 3)."""
    facets = len(re.findall(r"^\s*endfacet\b", text, re.MULTILINE | re.IGNORECASE))
    last = text.rstrip().rpartition("\n")[2].split()
    if not last or last[0].lower() != "endsolid":
        raise ScanError(f"{path}: ends after {facets} faces, without 'endsolid'", _CUT_OFF)
    corners = _quietly(path, text.encode(), lambda stream: _corners(load_stl_ascii(stream)))
    if len(corners) != 3 * facets:
        raise _damaged(path)
    return corners


def _corners(found: dict[str, Any]) -> FloatArray:
    """The corners of the facets of all solids of an STL, shape (3 F, 3)."""
    solids = found["geometry"].values() if "geometry" in found else [found]
    corners = [np.asarray(solid["vertices"], dtype=float) for solid in solids]
    return np.concatenate([np.empty((0, 3)), *corners])


def _read_ply(path: Path, data: bytes) -> Triangles:
    vertices, faces = _quietly(path, data, _load_ply)
    header = data.partition(b"end_header")[0].decode("ascii", "replace")
    # The reader of a text file that is cut off reports nothing.
    for name, have in ("vertex", len(vertices)), ("face", len(faces)):
        stated = re.search(rf"^\s*element\s+{name}\s+(\d+)", header, re.MULTILINE)
        if stated and have < int(stated[1]):
            raise ScanError(
                f"{path}: holds {have} of the {stated[1]} elements '{name}' that it names", _CUT_OFF
            )
    comment = "\n".join(re.findall(r"^\s*comment(.*)$", header, re.MULTILINE))
    return Triangles(vertices, faces, comment)


def _load_ply(stream: io.BytesIO) -> tuple[FloatArray, IntArray]:
    found = load_ply(stream, skip_materials=True, fix_texture=False)
    vertices = np.asarray(found.get("vertices", np.empty((0, 3))), dtype=float)
    polygons = found.get("faces")
    if polygons is None or not np.size(polygons):
        return vertices, np.empty((0, 3), np.int64)
    corners = np.asarray(polygons, dtype=np.int64)
    fan = [corners[:, [0, i, i + 1]] for i in range(1, corners.shape[1] - 1)]
    return vertices, np.concatenate(fan)


class _ObjReader:
    """Reads the lines that make the surface; all others (normals, textures, ...) are skipped.

    A polygon becomes a fan of triangles. A negative index counts back from the last vertex
    before its line. Each face has two labels: the numbers of its object and of its group.
    """

    def __init__(self) -> None:
        self.names: dict[str, int] = {}  # with their numbers
        self.vertices: list[list[float]] = []
        self.faces: list[tuple[int, int, int]] = []
        self.labels: list[tuple[int, int]] = []
        self._object = self._group = -1

    def take(self, line: str) -> None:
        """Read a line; one that makes no sense raises ValueError or IndexError."""
        word, _, rest = line.strip().partition(" ")
        if word == "v":
            x, y, z = map(_coordinate, rest.split()[:3])
            self.vertices.append([x, y, z])
        elif word == "f":
            first, *others = map(self._index, rest.split())
            if len(others) < 2:
                raise ValueError
            self.faces += [(first, b, c) for b, c in pairwise(others)]
            self.labels += [(self._object, self._group)] * (len(others) - 1)
        elif word == "o":
            self._object, self._group = self._number(rest.strip()), -1
        elif word == "g":
            self._group = self._number(rest.strip())

    def _index(self, corner: str) -> int:
        index = int(corner.partition("/")[0])
        index += len(self.vertices) if index < 0 else -1
        if not 0 <= index <= _MOST_VERTICES:
            raise IndexError
        return index

    def _number(self, name: str) -> int:
        return self.names.setdefault(name, len(self.names)) if name else -1


def _coordinate(word: str) -> float:
    """A coordinate; one that is not finite counts, the faces around it are left out."""
    return float(word) if word.lstrip("+-").lower() in {"nan", "inf"} else decimal(word)


def _read_obj(path: Path, data: bytes) -> Triangles:
    if b"\0" in data:
        raise _damaged(path)
    text, reader = data.decode("utf-8", "replace"), _ObjReader()
    for number, line in enumerate(text.replace("\\\n", " ").splitlines(), start=1):
        try:
            reader.take(line)
        except (ValueError, IndexError):
            raise ScanError(
                f"{path}: line {number} is not valid OBJ ('{line.strip()[:40]}')",
                f"{_AGAIN}, as OBJ with plain triangles or as binary STL",
            ) from None
    return Triangles(
        np.array(reader.vertices, dtype=float).reshape(-1, 3),
        np.array(reader.faces, dtype=np.int64).reshape(-1, 3),
        "\n".join(re.findall(r"^\s*#(.*)$", text, re.MULTILINE)),
        np.array(reader.labels, dtype=np.int64).reshape(-1, 2),
        tuple(reader.names),
    )


def _quietly(path: Path, data: bytes, load: Callable[[io.BytesIO], _Loaded]) -> _Loaded:
    """Load with a reader of trimesh, whatever it makes of a damaged file."""
    logger = logging.getLogger("trimesh.util")  # it logs tracebacks
    logger.disabled = True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # numpy stops at the first word that is not a number, and only warns.
            warnings.filterwarnings("error", message=".*could not be read to its end")
            return load(io.BytesIO(data))
    except Exception:  # it raises whatever its parsing meets
        raise _damaged(path) from None
    finally:
        logger.disabled = False


def _damaged(path: Path) -> ScanError:
    kind = path.suffix[1:].upper()
    return ScanError(f"{path}: is not a valid {kind} file", f"{_AGAIN}, as {kind} or as binary STL")


METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}

UnitSource = Literal["given", "stated", "inferred"]

_INFERRED = ("m", "mm")
_SOCKET = (0.1, 0.6)  # [m]; length of what is taken for a socket when the unit is not known
_POSSIBLE = (0.03, 2.0)  # [m]; length of what is believed when the unit is known
_WORDS = {
    prefix + word: short + "m"
    for prefix, short in (("", ""), ("centi", "c"), ("milli", "m"))
    for word in ("meter", "metre", "meters", "metres")
} | {"inch": "in", "inches": "in", "mm": "mm", "cm": "cm"}
# 'units in progress' names no inches: the shortest words count behind a colon only.
_STATED = re.compile(
    rf"\bunits?\s*[:=]\s*({'|'.join(_WORDS)}|m|in)\b"
    rf"|\bunits?\s+(?:are\s+|in\s+)?({'|'.join(_WORDS)})\b"
)


def stated_unit(comment: str) -> str | None:
    """The unit that a file's header or comments name, as in 'units: mm', if they do."""
    found = _STATED.search(comment.lower())
    if not found:
        return None
    word = found[1] or found[2]
    return _WORDS.get(word, word)


def find_unit(
    name: str, size: float, given: str | None, stated: str | None
) -> tuple[str, UnitSource]:
    """The unit of a body's lengths.

    Args:
        name: What names the body in an error.
        size: Its largest extent, in the unknown unit.
        given: The unit that the user gave, if any.
        stated: The unit that the file states, if any.

    Raises:
        ScanError: If the unit makes the body no possible size, or if none was
            given or stated and not exactly one makes it the size of a socket, or one
            that is not inferred: a small model in mm has the length of a socket in cm.
    """
    lengths = {unit: size * metres for unit, metres in METRES.items()}
    known = given or stated
    if known is not None:
        if not _POSSIBLE[0] <= lengths[known] <= _POSSIBLE[1]:
            raise ScanError(
                f"{name}: is {lengths[known]:.3g} m long in {known}, which no socket is",
                f"give its unit with --unit ({', '.join(METRES)})",
            )
        return known, "given" if given else "stated"
    fits = [unit for unit, length in lengths.items() if _SOCKET[0] <= length <= _SOCKET[1]]
    if len(fits) != 1:
        shown = ", ".join(f"{length:.3g} m in {unit}" for unit, length in lengths.items())
        raise ScanError(
            f"{name}: {'more than one' if fits else 'no'} unit makes its length {size:.4g} that of"
            f" a socket, {_SOCKET[0]:g} to {_SOCKET[1]:g} m ({shown})",
            "give its unit with --unit",
        )
    if fits[0] not in _INFERRED:
        raise ScanError(
            f"{name}: its length {size:.4g} is that of a socket in {fits[0]}"
            f" ({lengths[fits[0]]:.3g} m), or of a small model in mm ({lengths['mm']:.3g} m)",
            f"give its unit, likely --unit {fits[0]}, or export the scan in mm",
        )
    return fits[0], "inferred"


def refuse_normalised(name: str, vertices: FloatArray) -> None:
    """Refuse a model that was scaled to the size 1 or 2: its real size is lost.

    Args:
        name: What names the model in an error.
        vertices: Shape (V, 3), in the file's unit.

    Raises:
        ScanError: If the vertices just fill [0, 1], [-0.5, 0.5] or [-1, 1] in their largest extent.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    for start, size in (0.0, 1.0), (-0.5, 1.0), (-1.0, 2.0):
        inside = low.min() > start - 0.01 and high.max() < start + size + 0.01
        if inside and abs(float(np.max(high - low)) - size) < 0.01 * size:
            raise ScanError(
                f"{name}: is a model in normalised units ({size:g} long), its real size is lost",
                "export it in its real size",
            )


_LENGTH = (0.04, 0.7)  # [m]; of the cavity of a socket along its axis
_GIRTH = (0.12, 0.85)  # [m]; of its wall


def refuse_implausible(name: str, length: float, girth: float, unit: str) -> None:
    """Refuse a cavity that is too long, short, wide or narrow for a limb.

    Args:
        name: What names it in an error.
        length: Its length along its axis [m].
        girth: How long it is around [m].
        unit: The unit of the file that gave these lengths.

    Raises:
        ScanError: Naming the unit that would make it a socket, if one does.
    """

    def plausible(scale: float) -> bool:
        sizes = ((length, _LENGTH), (girth, _GIRTH))
        return all(low <= scale * size <= high for size, (low, high) in sizes)

    if plausible(1.0):
        return
    likely = [other for other, metres in METRES.items() if plausible(metres / METRES[unit])]
    hint = "no unit makes it one: export the model in its real size"
    if likely:
        hint = f"its unit is likely {' or '.join(likely)}: give --unit {likely[0]}"
    raise ScanError(
        f"{name}: in {unit} its cavity is {length:.3g} m long and {girth:.3g} m around, which no"
        f" socket is ({_LENGTH[0]:g} to {_LENGTH[1]:g} m and {_GIRTH[0]:g} to {_GIRTH[1]:g} m)",
        hint,
    )


_SPECK = 0.01  # [-]; of the area of the largest piece


@dataclass(frozen=True)
class ScanBody:
    """A connected piece of a scan.

    Attributes:
        index: Its number in the order of the file, from 0.
        names: The names of its object and group, if the file gives any.
        faces: The numbers of its faces, shape (F,).
        extents: Its size along the scan's axes, in the file's unit, shape (3,).
    """

    index: int
    names: tuple[str, ...]
    faces: IntArray
    extents: FloatArray

    @property
    def name(self) -> str:
        """Its first name, or else its number."""
        return self.names[0] if self.names else str(self.index)


def find_bodies(
    mesh: trimesh.Trimesh, labels: IntArray, names: Sequence[str]
) -> tuple[list[ScanBody], IntArray]:
    """Find the bodies of a scan; edges that more than two faces share do not connect.

    Args:
        mesh: All of the scan, in the file's unit.
        labels: Numbers of the names of each face, -1 for none, shape (F, any).
        names: The names.

    Returns:
        The bodies, and the faces of the pieces too small to be one, shape (any,).
    """
    pieces = connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    areas = np.bincount(pieces, mesh.area_faces)
    specks = areas < _SPECK * areas.max()
    order = np.argsort(pieces, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(pieces))[:-1])
    real = [faces for faces, speck in zip(members, specks, strict=True) if not speck]
    bodies = [
        ScanBody(index, _names(labels[faces], names), faces, _extents(mesh.triangles[faces]))
        for index, faces in enumerate(real)
    ]
    return bodies, np.flatnonzero(specks[pieces])


def choose_body(
    file: str, bodies: Sequence[ScanBody], wanted: str | None, metres: float | None
) -> ScanBody:
    """The body that is wanted, or the only one.

    Args:
        file: The file's name, for errors.
        bodies: All bodies.
        wanted: A name or a number, if the user gave one.
        metres: The file's unit, for errors, if it is known [m].

    Raises:
        ScanError: With the list of the bodies, if not exactly one is wanted.
    """
    fits = [body for body in bodies if wanted is None or wanted in body.names]
    if not fits:
        fits = [body for body in bodies if wanted == str(body.index)]
    if len(fits) == 1:
        return fits[0]
    shown = ", ".join(_show(body, metres) for body in bodies)
    count = f"{len(bodies)} bodies" if len(bodies) > 1 else "one body"
    if not fits:
        raise ScanError(
            f"{file}: has no body '{wanted}', but {count}: {shown}", "choose one with --body"
        )
    called = f" called '{wanted}'" if wanted else ""
    raise ScanError(
        f"{file}: has {len(fits)} bodies{called}, of {shown}", "choose one by its number: --body N"
    )


def _show(body: ScanBody, metres: float | None) -> str:
    scale, unit = (1e3 * metres, "mm") if metres else (1.0, "of the file's units")
    size = " x ".join(f"{scale * extent:.4g}" for extent in body.extents)
    called = "".join(f"'{name}' " for name in body.names)
    return f"{body.index} {called}({len(body.faces)} faces, {size} {unit})"


def _names(labels: IntArray, names: Sequence[str]) -> tuple[str, ...]:
    """The names that most of some faces have, shape of the labels (F, any)."""
    found = []
    for column in labels.T:
        usual = int(np.bincount(column + 1).argmax()) - 1
        if usual >= 0 and names[usual] not in found:
            found.append(names[usual])
    return tuple(found)


def _extents(triangles: FloatArray) -> FloatArray:
    """Size of some triangles, shape (F, 3, 3), along the axes, shape (3,)."""
    return np.ptp(triangles.reshape(-1, 3), axis=0)


_SMALL_HOLE = 0.020  # [m]; around


@dataclass(frozen=True)
class Scan:
    """One body of a scan file.

    Attributes:
        mesh: The body in metres and in the scan's own axes: welded, wound alike, without faces
            that have no area; every edge is in one or two faces.
        body: Its name in the file, or its number.
        unit: The unit of the file's lengths.
        unit_source: Whether the unit was given, stated by the file, or inferred from the size.
        notes: One plain line for every repair and finding.
    """

    mesh: trimesh.Trimesh
    body: str
    unit: str
    unit_source: UnitSource
    notes: tuple[str, ...]


def read_scan(path: Path, unit: str | None = None, body: str | None = None) -> Scan:
    """Read one body of an STL, PLY or OBJ file, and repair what can be repaired.

    Args:
        path: The file.
        unit: The unit of its lengths, one of m, cm, mm, in; else stated or inferred.
        body: The name (an object or group of an OBJ) or the number of the body; needed if
            there is more than one.

    Raises:
        ScanError: If the file cannot be read as a surface, or its unit or the body is not clear.
    """
    if unit not in {None, *METRES}:
        raise ScanError(f"the unit '{unit}' is unknown", closest(str(unit), METRES))
    triangles = read_triangles(path)
    notes: list[str] = []
    mesh, labels = _clean(path, triangles, notes)
    refuse_normalised(str(path), np.asarray(mesh.vertices))
    bodies, specks = find_bodies(mesh, labels, triangles.names)
    _note(notes, len(specks), "dropped {} faces of pieces too small to be a body")
    stated = stated_unit(triangles.comment)
    chosen = choose_body(str(path), bodies, body, _show_scale(bodies, unit, stated))
    size = float(chosen.extents.max())
    found, source = find_unit(f"{path}: body {chosen.name}", size, unit, stated)
    notes.append(f"{source} unit {found}: the body is {size * METRES[found]:.3g} m long")
    if stated and stated != found:
        notes.append(f"the file states the unit {stated}, which is passed over")
    vertices = np.asarray(mesh.vertices) * METRES[found]
    faces = np.asarray(mesh.faces)[chosen.faces]
    body_mesh = _repair(f"{path}: body {chosen.name}", vertices, faces, notes)
    body_mesh.metadata["file_name"] = str(path)
    return Scan(body_mesh, chosen.name, found, source, tuple(notes))


def _clean(path: Path, triangles: Triangles, notes: list[str]) -> tuple[trimesh.Trimesh, IntArray]:
    """The welded surface of the sound faces, and their labels."""
    vertices, faces, labels = triangles.vertices, triangles.faces, triangles.labels
    finite = (np.abs(vertices[faces]) < _LARGEST).all(axis=(1, 2))
    _note(notes, (~finite).sum(), "removed {} faces with a corner that is not finite")
    if not finite.any():
        raise ScanError(f"{path}: no face has finite corners", "export the scan again")
    vertices, faces = weld(vertices, faces[finite])
    plain = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    _note(notes, (~plain).sum(), "removed {} faces without area, of fewer than three vertices")
    first = np.zeros(len(faces), dtype=bool)
    first[unique_rows(np.sort(faces, axis=1))[0]] = True
    _note(notes, (plain & ~first).sum(), "removed {} duplicate faces")
    kept = plain & first
    faces = faces[kept]
    if are_slivers(vertices, faces).all():
        raise ScanError(f"{path}: no face has an area", "export the scan again, as a surface")
    labels = labels[finite][kept] if len(labels) else np.empty((len(faces), 0), np.int64)
    return plain_mesh(vertices, faces), labels


def _show_scale(bodies: list[ScanBody], given: str | None, stated: str | None) -> float | None:
    """Metres a unit for the list of the bodies, by the largest of them, if that is clear."""
    try:
        size = max(float(body.extents.max()) for body in bodies)
        return METRES[find_unit("", size, given, stated)[0]]
    except ScanError:
        return None


def _repair(name: str, vertices: FloatArray, faces: IntArray, notes: list[str]) -> trimesh.Trimesh:
    """A body in metres with one winding, no crowded edges, small holes or slivers."""
    faces, flipped, one_sided = wind_alike(faces)
    _note(notes, flipped, "reversed {} faces so that all wind the same way")
    if one_sided.any():
        raise ScanError(
            f"{name}: is one-sided, as a Moebius band is; no winding fits its faces",
            "repair the surface in a mesh editor",
        )
    crowded = faces.size - 2 * len(twin_half_edges(faces)) - len(boundary_half_edges(faces))
    _note(notes, crowded, "cut at edges that more than two faces share, {} sides in all")
    vertices, faces = separate(vertices, faces)
    vertices, faces, closed, left = fill_holes(vertices, faces, _SMALL_HOLE)
    _note(notes, len(closed), f"small holes closed: {{}}, {_millimetres(closed)} around")
    _note(notes, len(left), f"edges of the surface left open: {{}}, {_millimetres(left)} around")
    faces, flat = flip_slivers(vertices, faces)
    if flat:
        notes.append(f"removed {flat} faces without area, of three vertices on a line")
        vertices, faces = separate(vertices, faces)
    return plain_mesh(vertices, faces)


def _note(notes: list[str], count: int, text: str) -> None:
    """Add a note of a count, unless it is zero."""
    if count:
        notes.append(text.format(count))


def _millimetres(lengths: list[float]) -> str:
    return ", ".join(f"{1e3 * length:.0f} mm" for length in sorted(lengths, reverse=True)[:3])
