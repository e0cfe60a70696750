"""The triangles of STL, PLY and OBJ files, as they stand there."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from trimesh.exchange.ply import load_ply
from trimesh.exchange.stl import load_stl_ascii, load_stl_binary

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import ScanError
from socket_testbed.scans.obj import ObjReader

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
