"""A scan file (STL, PLY, OBJ) read as one sound body in metres, with notes of all repairs."""

from __future__ import annotations

import io
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

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import ScanError
from socket_testbed.files import closest
from socket_testbed.socket_design.mesh import (
    Surface,
    are_finite,
    are_first,
    are_slivers,
    are_triangles,
    fill_holes,
    flip_slivers,
    label_pieces,
    match_edges,
    separate,
    weld,
    wind_alike,
)

_MEND = "export the scan again, as OBJ with plain triangles or as binary STL"


class ObjReader:
    """Reads the lines that make the surface; all others (normals, textures, ...) pass by.

    A polygon is cut into a fan of triangles. A negative index counts back from the last vertex
    before its line.

    Args:
        path: The file, for errors.

    Attributes:
        names: Names of the objects and groups, in the order of the file.
    """

    def __init__(self, path: Path) -> None:
        self.names: list[str] = []
        self._path = path
        self._vertices: list[tuple[float, float, float]] = []
        self._faces: list[tuple[int, int, int]] = []
        self._labels: list[tuple[int, int]] = []
        self._object = self._group = -1

    def read(self, text: str) -> tuple[FloatArray, IntArray, IntArray]:
        """Read a whole file.

        Args:
            text: Its content.

        Returns:
            Vertices, shape (V, 3); faces, shape (F, 3); the numbers of the name of each face's
            object and of its group, -1 for none, shape (F, 2).

        Raises:
            ScanError: If a line cannot be understood, or a face names a vertex that is not there.
        """
        for number, line in enumerate(text.replace("\\\n", " ").splitlines(), start=1):
            word, _, rest = line.strip().partition(" ")
            try:
                self._take(word, rest)
            except (ValueError, IndexError):
                raise ScanError(
                    f"{self._path}: line {number} is no valid OBJ ('{line.strip()[:40]}')", _MEND
                ) from None
        return (
            np.array(self._vertices, dtype=float).reshape(-1, 3),
            np.array(self._faces, dtype=np.int64).reshape(-1, 3),
            np.array(self._labels, dtype=np.int64).reshape(-1, 2),
        )

    def _take(self, word: str, rest: str) -> None:
        if word == "v":
            x, y, z = map(float, rest.split()[:3])
            self._vertices.append((x, y, z))
        elif word == "f":
            corners = [self._index(corner) for corner in rest.split()]
            if len(corners) < 3:
                raise ValueError
            for b, c in pairwise(corners[1:]):
                self._faces.append((corners[0], b, c))
                self._labels.append((self._object, self._group))
        elif word == "o":
            self._object, self._group = self._number(rest.strip()), -1
        elif word == "g":
            self._group = self._number(rest.strip())

    def _index(self, corner: str) -> int:
        index = int(corner.partition("/")[0])
        index += len(self._vertices) if index < 0 else -1
        if index < 0:
            raise IndexError
        return index

    def _number(self, name: str) -> int:
        if not name:
            return -1
        if name not in self.names:
            self.names.append(name)
        return self.names.index(name)


_Loaded = TypeVar("_Loaded")

_AGAIN = "export the scan again"
_CUT_OFF = "the file is cut off or damaged: copy or export it again"
_STL_HEADER, _STL_FACE = 84, 50  # [bytes]


@dataclass(frozen=True)
class Triangles:
    """The content of a scan file.

    Attributes:
        vertices: Shape (V, 3), in the file's unit; may be not finite, and not welded.
        faces: Indices of existing vertices, shape (F, 3), F > 0.
        comment: What the file says of itself in words.
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
    readers: dict[str, Callable[[Path, bytes], Triangles]] = {
        ".stl": _read_stl,
        ".ply": _read_ply,
        ".obj": _read_obj,
    }
    if path.suffix.lower() not in readers:
        raise ScanError(
            f"{path}: '{path.suffix}' is no kind of scan that can be read",
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
    said = int.from_bytes(data[_STL_HEADER - 4 : _STL_HEADER], "little")
    whole = _STL_HEADER + _STL_FACE * said
    if len(data) == whole:
        corners = _quietly(path, data, lambda stream: _corners(load_stl_binary(stream)))
        comment = data[:80].decode("ascii", "replace")
    elif b"\0" not in data and data[:200].lstrip().lower().startswith(b"solid"):
        text = data.decode("utf-8", "replace").replace("\r\n", "\n").replace("\r", "\n")
        corners, comment = _text_corners(path, text), text.partition("\n")[0]
    elif b"\0" in data and len(data) > _STL_HEADER:
        raise ScanError(
            f"{path}: has {len(data)} bytes, but its {said} faces take {whole}", _CUT_OFF
        )
    else:
        raise _damaged(path)
    return Triangles(corners, np.arange(len(corners)).reshape(-1, 3), comment)


def _text_corners(path: Path, text: str) -> FloatArray:
    """The corners of all facets of an STL in words, whole or not at all, shape (3 F, 3)."""
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
    # A text that is cut off is read up to there without a word.
    for name, have in ("vertex", len(vertices)), ("face", len(faces)):
        said = re.search(rf"^\s*element\s+{name}\s+(\d+)", header, re.MULTILINE)
        if said and have < int(said[1]):
            raise ScanError(
                f"{path}: holds {have} of the {said[1]} elements '{name}' that it names", _CUT_OFF
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


def _read_obj(path: Path, data: bytes) -> Triangles:
    if b"\0" in data:
        raise _damaged(path)
    text = data.decode("utf-8", "replace")
    reader = ObjReader(path)
    vertices, faces, labels = reader.read(text)
    comment = "\n".join(re.findall(r"^\s*#(.*)$", text, re.MULTILINE))
    return Triangles(vertices, faces, comment, labels, tuple(reader.names))


def _quietly(path: Path, data: bytes, load: Callable[[io.BytesIO], _Loaded]) -> _Loaded:
    """Load with a reader of trimesh, whatever it makes of a damaged file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # numpy stops at the first word that is no number, and only warns.
            warnings.filterwarnings("error", message=".*could not be read to its end")
            return load(io.BytesIO(data))
    except Exception:  # it raises whatever its parsing meets
        raise _damaged(path) from None


def _damaged(path: Path) -> ScanError:
    kind = path.suffix[1:].upper()
    return ScanError(
        f"{path}: is no {kind} file that can be read", f"{_AGAIN}, as {kind} or as binary STL"
    )


METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}

Source = Literal["given", "stated", "inferred"]

_SOCKET = (0.1, 0.6)  # [m]; length of what is taken for a socket unasked
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
    """The unit that a file's own words name, as in 'units: mm', if they do.

    Args:
        comment: Header or comments of the file.
    """
    found = _STATED.search(comment.lower())
    if not found:
        return None
    word = found[1] or found[2]
    return _WORDS.get(word, word)


def check_unit(unit: str) -> None:
    """Refuse a unit that is none.

    Raises:
        ScanError: If the unit is not one of `METRES`.
    """
    if unit not in METRES:
        raise ScanError(f"the unit '{unit}' is unknown", closest(unit, METRES))


def find_unit(name: str, size: float, given: str | None, stated: str | None) -> tuple[str, Source]:
    """The unit of a body's lengths.

    Args:
        name: What names the body in an error.
        size: Its largest extent, in the unknown unit.
        given: The unit that the user gave, if any.
        stated: The unit that the file states, if any.

    Raises:
        ScanError: If the unit makes the body no possible size, or if none was
            given or stated and not exactly one makes it the size of a socket.
    """
    known = given or stated
    if known is None:
        return _infer(name, size), "inferred"
    length = size * METRES[known]
    if not _POSSIBLE[0] <= length <= _POSSIBLE[1]:
        raise ScanError(
            f"{name}: is {length:.3g} m long in {known}, which no socket is",
            f"give its unit with --unit ({', '.join(METRES)})",
        )
    return known, "given" if given else "stated"


def refuse_normalised(name: str, vertices: FloatArray) -> None:
    """Refuse a model that was scaled to the size 1 or 2: its real size is lost.

    Args:
        name: What names the model in an error.
        vertices: Shape (V, 3), in the file's unit.

    Raises:
        ScanError: If the vertices just fill [0, 1] or [-1, 1] in their largest extent.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    for start, size in (0.0, 1.0), (-0.5, 1.0), (-1.0, 2.0):
        inside = low.min() > start - 0.01 and high.max() < start + size + 0.01
        if inside and abs(float(np.max(high - low)) - size) < 0.01 * size:
            raise ScanError(
                f"{name}: is a model in normalised units ({size:g} long), its real size is lost",
                "export it in its real size",
            )


def _infer(name: str, size: float) -> str:
    lengths = {unit: size * metres for unit, metres in METRES.items()}
    fits = [unit for unit, length in lengths.items() if _SOCKET[0] <= length <= _SOCKET[1]]
    if len(fits) == 1:
        return fits[0]
    shown = ", ".join(f"{length:.3g} m in {unit}" for unit, length in lengths.items())
    why = "more than one unit makes" if fits else "no unit makes"
    raise ScanError(
        f"{name}: {why} its length {size:.4g} that of a socket, {_SOCKET[0]:g} to {_SOCKET[1]:g} m"
        f" ({shown})",
        "give its unit with --unit",
    )


_SPECK = 0.01  # [-]; of the area of the largest piece


@dataclass(frozen=True)
class Body:
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
    surface: Surface, labels: IntArray, names: Sequence[str]
) -> tuple[list[Body], IntArray]:
    """Find the bodies of a scan; edges that more than two faces share do not connect.

    Args:
        surface: All of the scan, in the file's unit.
        labels: Numbers of the names of each face, -1 for none, shape (F, any).
        names: The names.

    Returns:
        The bodies, and the faces of the pieces too small to be one, shape (any,).
    """
    pieces = label_pieces(len(surface.faces), surface.edges.neighbours)
    areas = np.bincount(pieces, surface.areas)
    specks = areas < _SPECK * areas.max()
    order = np.argsort(pieces, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(pieces))[:-1])
    real = [faces for faces, speck in zip(members, specks, strict=True) if not speck]
    bodies = [
        Body(index, _names(labels[faces], names), faces, _extents(surface, faces))
        for index, faces in enumerate(real)
    ]
    return bodies, np.flatnonzero(specks[pieces])


def choose_body(
    file: str, bodies: Sequence[Body], wanted: str | None, metres: float | None
) -> Body:
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


def _show(body: Body, metres: float | None) -> str:
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


def _extents(surface: Surface, faces: IntArray) -> FloatArray:
    return np.ptp(surface.vertices[surface.faces[faces].ravel()], axis=0)


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
    unit_source: Source
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
    if unit is not None:
        check_unit(unit)
    triangles = read_triangles(path)
    notes: list[str] = []
    surface, labels = _clean(path, triangles, notes)
    refuse_normalised(str(path), surface.vertices)
    bodies, specks = find_bodies(surface, labels, triangles.names)
    _note(notes, len(specks), "dropped {} faces of pieces too small to be a body")
    stated = stated_unit(triangles.comment)
    chosen = choose_body(str(path), bodies, body, _show_scale(bodies, unit, stated))
    size = float(chosen.extents.max())
    found, source = find_unit(f"{path}: body {chosen.name}", size, unit, stated)
    notes.append(f"{source} unit {found}: the body is {size * METRES[found]:.3g} m long")
    if stated and stated != found:
        notes.append(f"the file states the unit {stated}, which is passed over")
    vertices, faces = surface.vertices * METRES[found], surface.faces[chosen.faces]
    mesh = _mend(f"{path}: body {chosen.name}", vertices, faces, notes)
    mesh.metadata["file_name"] = str(path)
    return Scan(mesh, chosen.name, found, source, tuple(notes))


def _clean(path: Path, triangles: Triangles, notes: list[str]) -> tuple[Surface, IntArray]:
    """The welded surface of the sound faces, and their labels."""
    vertices, faces, labels = triangles.vertices, triangles.faces, triangles.labels
    finite = are_finite(vertices, faces)
    _note(notes, (~finite).sum(), "removed {} faces with a corner that is not finite")
    if not finite.any():
        raise ScanError(f"{path}: no face has finite corners", "export the scan again")
    vertices, faces = weld(vertices, faces[finite])
    plain = are_triangles(faces)
    _note(notes, (~plain).sum(), "removed {} faces without area, of fewer than three vertices")
    first = are_first(faces)
    _note(notes, (plain & ~first).sum(), "removed {} duplicate faces")
    kept = plain & first
    surface = Surface(vertices, faces[kept])
    if are_slivers(vertices, surface.faces).all():
        raise ScanError(f"{path}: no face has an area", "export the scan again, as a surface")
    return surface, labels[finite][kept] if len(labels) else np.empty((int(kept.sum()), 0), int)


def _show_scale(bodies: list[Body], given: str | None, stated: str | None) -> float | None:
    """Metres a unit for the list of the bodies, by the largest of them, if that is clear."""
    try:
        size = max(float(body.extents.max()) for body in bodies)
        return METRES[find_unit("", size, given, stated)[0]]
    except ScanError:
        return None


def _mend(name: str, vertices: FloatArray, faces: IntArray, notes: list[str]) -> trimesh.Trimesh:
    """A body in metres with one winding, no crowded edges, small holes or slivers."""
    faces, turned, one_sided = wind_alike(faces)
    _note(notes, turned, "turned {} faces so that all wind the same way")
    if one_sided.any():
        raise ScanError(
            f"{name}: is one-sided, as a Moebius band is; no winding fits its faces",
            "repair the surface in a mesh editor",
        )
    crowded = len(match_edges(faces).crowded)
    _note(notes, crowded, "cut at edges that more than two faces share, {} sides in all")
    vertices, faces = separate(vertices, faces)
    vertices, faces, closed, left = fill_holes(vertices, faces, _SMALL_HOLE)
    _note(notes, len(closed), f"small holes closed: {{}}, {_millimetres(closed)} around")
    _note(notes, len(left), f"edges of the surface left open: {{}}, {_millimetres(left)} around")
    faces, flat = flip_slivers(vertices, faces)
    if flat:
        notes.append(f"removed {flat} faces without area, of three vertices on a line")
        vertices, faces = separate(vertices, faces)
    return trimesh.Trimesh(vertices, faces, process=False)


def _note(notes: list[str], count: int, text: str) -> None:
    """Add a note of a count, unless it is zero."""
    if count:
        notes.append(text.format(count))


def _millimetres(lengths: list[float]) -> str:
    return ", ".join(f"{1e3 * length:.0f} mm" for length in sorted(lengths, reverse=True)[:3])
