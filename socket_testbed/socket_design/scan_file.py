"""Read a scan file (STL, PLY, OBJ) as one sound body in metres, with notes on all repairs.

A half-edge ``h = 3 f + i`` of face f runs from its corner i to its corner i + 1; it starts at
corner ``h`` and is row h of `trimesh.Trimesh.edges`. Throughout, vertices have the shape (V, 3);
faces, shape (F, 3), hold the indices of their three vertices.
"""

from __future__ import annotations

import io
import logging
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from trimesh.geometry import faces_to_edges
from trimesh.graph import connected_component_labels
from trimesh.grouping import group_rows, unique_rows

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.documents import OTHER_FILE_START, other_file
from socket_testbed.errors import ScanError, closest


def plain_mesh(vertices: FloatArray, faces: IntArray) -> trimesh.Trimesh:
    """A mesh of exactly these vertices and faces: trimesh neither merges nor drops any.

    Args:
        vertices: Vertices in any unit and frame, shape (V, 3).
        faces: Indices of the three vertices of each face, shape (F, 3).
    """
    return trimesh.Trimesh(vertices, faces, process=False)


def twin_half_edges(faces: IntArray) -> IntArray:
    """Pairs of half-edges on edges shared by exactly two faces, shape (A, 2), of faces (F, 3)."""
    return group_rows(np.sort(faces_to_edges(faces), axis=1), require_count=2)


def boundary_half_edges(faces: IntArray) -> IntArray:
    """Half-edges on edges of a single face, ascending, shape (B,), of faces (F, 3)."""
    return np.sort(group_rows(np.sort(faces_to_edges(faces), axis=1), require_count=1))


def separate(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Cut a mesh wherever it is not a manifold, and drop unused vertices.

    Faces stay joined across edges shared by exactly two of them. Where more faces meet at an edge,
    or two fans of faces meet only at a vertex, each gets its own vertices, so that every boundary
    vertex occurs once, on one boundary loop. The order of the faces stays.

    Args:
        vertices: Vertices in any unit and frame, shape (V, 3).
        faces: Indices of the three vertices of each face, shape (F, 3).

    Returns:
        The vertices, shape (V', 3), in the unit and frame given, and the faces, shape (F, 3).
    """
    start = faces.ravel()
    one, other = twin_half_edges(faces).T
    same_way = start[one] == start[other]
    one_stop, other_stop = _next_half_edge(one), _next_half_edge(other)
    joined = np.vstack(
        [
            np.column_stack([one, np.where(same_way, other, other_stop)]),
            np.column_stack([one_stop, np.where(same_way, other_stop, other)]),
        ]
    )
    label = connected_component_labels(joined, node_count=len(start))
    _, first = np.unique(label, return_index=True)
    return vertices[start[first]], label.reshape(-1, 3).astype(np.int64)


def wind_alike(faces: IntArray) -> tuple[IntArray, int]:
    """Reverse faces (F, 3) for consistent winding; return them and how many were reversed.

    Each face is two nodes of a graph, original and reversed; matching neighbours are joined. In an
    orientable piece this gives two components; the one with more original faces is kept.
    """
    count = len(faces)
    one, other = twin_half_edges(faces).T
    differ = (faces.ravel()[one] == faces.ravel()[other]) * count
    a, b = one // 3, other // 3
    pairs = np.vstack(
        [np.column_stack([a, b + differ]), np.column_stack([a + count, b + count - differ])]
    )
    label = connected_component_labels(pairs, node_count=2 * count)
    as_is, reverse = label[:count], label[count:]
    votes = np.bincount(as_is, minlength=label.max(initial=-1) + 1)
    flip = votes[as_is] < votes[reverse]
    flip |= (votes[as_is] == votes[reverse]) & (as_is > reverse)
    return np.where(flip[:, None], faces[:, ::-1], faces), int(flip.sum())


def boundary_loops(faces: IntArray) -> list[IntArray]:
    """Indices of the vertices along each boundary loop, in order, of faces (F, 3) from `separate`.

    A loop runs in the direction of the half-edges of its faces; its last vertex joins the first.
    """
    follows = dict(faces_to_edges(faces)[boundary_half_edges(faces)].tolist())
    loops = []
    while follows:
        vertex, after = follows.popitem()
        loop = [vertex]
        while after != loop[0]:
            loop.append(after)
            after = follows.pop(after)
        loops.append(np.array(loop))
    return loops


def loop_length(vertices: FloatArray, loop: IntArray) -> float:
    """Length of a closed loop of vertices, in their unit.

    Args:
        vertices: Vertices of the mesh, shape (V, 3), usually in metres.
        loop: Indices of the vertices along the loop, in order; the last joins the first.
    """
    steps = vertices[np.roll(loop, -1)] - vertices[loop]
    return float(np.linalg.norm(steps, axis=1).sum())


def _next_half_edge(half_edges: IntArray) -> IntArray:
    """The next half-edges in the same faces."""
    return half_edges - half_edges % 3 + (half_edges + 1) % 3


def number_cells(points: FloatArray, size: float) -> IntArray:
    """Index of each point's cell in a cubic grid, by x, then y, then z, shape (P,).

    Only cells with points are numbered, from 0.

    Args:
        points: Points in any unit and frame, shape (P, 3).
        size: Edge of a cell in the unit of the points.
    """
    cell = np.floor(points / size).astype(np.int64)
    x, y, z = (cell - cell.min(axis=0)).T
    return np.unique((x * (y.max() + 1) + y) * (z.max() + 1) + z, return_inverse=True)[1]


_WELD_TOLERANCE = 1e-6  # [-]; relative to the extent of the mesh


def weld(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Merge coincident vertices, to a millionth of the extent of the mesh; drop unused ones.

    Args:
        vertices: Vertices in any unit and frame, shape (V, 3).
        faces: Indices of the three vertices of each face, shape (F, 3).

    Returns:
        The vertices, shape (V', 3), in the unit and frame given, and the faces, shape (F, 3), of
        which merging may leave some without area.
    """
    used, corners = np.unique(faces, return_inverse=True)
    places = vertices[used] - vertices[used].min(axis=0)
    cell = max(_WELD_TOLERANCE * float(places.max()), np.finfo(float).tiny)
    first, cubes = unique_rows(np.round(places / cell).astype(np.int64))
    # Merge neighbours across cell faces.
    close = cKDTree(places[first]).query_pairs(cell, output_type="ndarray")
    label = connected_component_labels(close, node_count=len(first))
    _, welded = np.unique(label, return_index=True)
    kept = vertices[used][first[welded]]
    return kept, label[cubes[corners]].reshape(-1, 3).astype(np.int64)


def fill_holes(
    vertices: FloatArray, faces: IntArray, longest: float
) -> tuple[FloatArray, IntArray, list[float], list[float]]:
    """Close holes with a circumference below a limit by a fan around their middle.

    Args:
        vertices: Vertices, shape (V, 3) [m].
        faces: Indices of the three vertices of each face of a mesh from `separate`, shape (F, 3).
        longest: Circumference from which holes stay open [m].

    Returns:
        Vertices and faces with those of the fans appended, then the circumferences of the closed
        holes and of the open ones [m].
    """
    new_vertices, new_faces = [vertices], [faces]
    closed, left = list[float](), list[float]()
    for loop in boundary_loops(faces):
        around = loop_length(vertices, loop)
        (closed if around < longest else left).append(around)
        if around < longest:
            middle = np.full(len(loop), sum(map(len, new_vertices)))
            new_vertices.append(vertices[loop].mean(axis=0, keepdims=True))
            new_faces.append(np.column_stack([np.roll(loop, -1), loop, middle]))
    return np.vstack(new_vertices), np.vstack(new_faces), closed, left


METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}


@dataclass(frozen=True)
class Scan:
    """One body of a scan file.

    Attributes:
        mesh: The body in the scan's own axes [m]: welded, with consistent winding and one or two
            faces per edge.
        body: Name or number of the body in the file.
        unit: Unit of length of the file, a key of `METRES`.
        unit_source: How the unit was found: `given`, `stated` by the file, or `inferred` from the
            size.
        notes: Remarks for the user, one line per repair and finding.
    """

    mesh: trimesh.Trimesh
    body: str
    unit: str
    unit_source: str
    notes: tuple[str, ...]


def read_scan(path: Path, unit: str | None = None, body: str | None = None) -> Scan:
    """Read one body of an STL, PLY or OBJ file, and repair it as far as possible.

    Args:
        path: The file.
        unit: Unit of length of the file, a key of `METRES`; None for the one that the file states
            or, failing that, the one inferred from the size.
        body: Name (of an object or, without objects, a group of an OBJ) or number of the body; None
            if there is only one.

    Raises:
        ScanError: If the unit is unknown or cannot be inferred, the file is damaged or no surface,
            or it has several bodies and none is chosen.
    """
    if unit not in {None, *METRES}:
        raise ScanError(f"the unit '{unit}' is unknown", closest(str(unit), METRES))
    parts, comment = _load(path)
    notes: list[str] = []
    mesh, names = _clean(path, parts, notes)
    label, faces = _choose_body(path, mesh, names, body, notes)
    size = float(np.ptp(mesh.triangles[faces].reshape(-1, 3), axis=0).max())
    stated = stated_unit(comment)
    found, source = unit or stated, "given" if unit else "stated"
    if found is None:
        found, source = _infer_unit(f"{path}: body {label}", size), "inferred"
    notes.append(f"{source} unit {found}: the body is {size * METRES[found]:.3g} m long")
    if stated and stated != found:
        notes.append(f"the file states the unit {stated}, which is ignored")
    vertices = np.asarray(mesh.vertices) * METRES[found]
    repaired = _repair(vertices, np.asarray(mesh.faces)[faces], notes)
    repaired.metadata["file_name"] = str(path)
    return Scan(repaired, label, found, source, tuple(notes))


_AGAIN = "export the scan again"
_CUT_OFF = "the file is cut off or damaged: copy or export it again"
_MAX_NAMES = 100  # of objects or groups that are read separately
_NUMBER = r"[ \t]+[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|nan|inf)"
_CORNER = r"[ \t]+-?[1-9]\d{0,9}(?:/-?\d*){0,2}"
_COUNTED = ("v", "vt", "vn")  # what a corner's indices number, in this order
_OBJ_LINE = re.compile(
    rf"v(?:{_NUMBER}){{3,8}}|f(?:{_CORNER}){{3,}}", flags=re.IGNORECASE | re.ASCII
)


def _load(path: Path) -> tuple[dict[str, trimesh.Trimesh], str]:
    """The unmodified parts of a scan file by name, and the file's comments.

    Isolates trimesh's readers, which raise or log any error of their parsing.
    """
    kind = path.suffix[1:].lower()
    checks = {"stl": _check_stl, "ply": _check_ply, "obj": _check_obj}
    if kind not in checks:
        raise ScanError(
            f"{path}: '{path.suffix}' is not a supported scan format",
            "export the scan as STL, PLY or OBJ",
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ScanError(f"{path}: cannot be read ({error.strerror})", "check the path") from None
    if other := other_file(data[:OTHER_FILE_START]):
        raise ScanError(f"{path}: {other[0]}", other[1])
    if kind != "ply" and re.match(rb"ply[ \t]*\r?\n", data):
        kind = "ply"
    data = _plain_obj(path, data) if kind == "obj" else data
    comment = checks[kind](path, data)
    named = data if kind == "obj" else b""
    objects, groups = (
        re.findall(rb"^%s[ \t]" % word, named, re.MULTILINE) for word in (b"o", b"g")
    )
    logger = logging.getLogger("trimesh.util")
    logger.disabled = True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # At the first word that is not a number, numpy stops with only a warning.
            warnings.filterwarnings("error", message=".*could not be read to its end")
            scene = trimesh.load_scene(
                io.BytesIO(data),
                file_type=kind,
                process=False,
                skip_materials=True,
                fix_texture=False,
                split_objects=len(objects) <= _MAX_NAMES,
                split_groups=not objects and len(groups) <= _MAX_NAMES,
            )
        parts = {n: m for n, m in reversed(scene.geometry.items()) if len(getattr(m, "faces", ()))}
        valid = all(m.faces.min() >= 0 and m.triangles.size for m in parts.values())
    except Exception:  # such as an index beyond the vertices
        valid = False
    finally:
        logger.disabled = False
    if not valid:
        raise ScanError(f"{path}: is not a valid {kind.upper()} file", _CUT_OFF)
    if not parts:
        raise ScanError(f"{path}: has no faces", "export the surface, not only its points")
    if not objects and not groups:  # the solids of an STL are no bodies
        parts = {"": trimesh.util.concatenate([*parts.values()])}
    return parts, comment


def _check_stl(path: Path, data: bytes) -> str:
    """Refuse an incomplete STL; return its header."""
    # Many binary files also begin with 'solid', so check the length first.
    if len(data) != 84 + 50 * int.from_bytes(data[80:84], "little"):
        words = data.lower()
        vertices, facets = (
            len(re.findall(rb"^\s*" + word, words, re.MULTILINE))
            for word in (b"vertex", b"endfacet")
        )
        whole = words.lstrip().startswith(b"solid") and b"endsolid" in words.rstrip()[-200:]
        if not whole or vertices != 3 * facets:
            raise ScanError(f"{path}: is not a valid STL file", _CUT_OFF)
    return data[:80].decode("ascii", "replace").partition("\n")[0]


def _check_ply(path: Path, data: bytes) -> str:
    """Refuse a text PLY with fewer lines than elements; return its comments."""
    header, _, body = data.partition(b"end_header")
    counts = re.findall(rb"^element \w+ (\d+)", header, re.MULTILINE)
    if b"format ascii" in header and len(body.strip().split(b"\n")) < sum(map(int, counts)):
        raise ScanError(f"{path}: has fewer lines than elements", _CUT_OFF)
    return "\n".join(re.findall(r"^comment(.*)$", header.decode("ascii", "replace"), re.MULTILINE))


def _check_obj(path: Path, data: bytes) -> str:
    """The comments of an OBJ of lines as `_plain_obj` gives them."""
    return "\n".join(re.findall(r"^\s*#(.*)$", data.decode("utf-8", "replace"), re.MULTILINE))


def _plain_obj(path: Path, data: bytes) -> bytes:
    """An OBJ in the words that every reader knows.

    Lines end with a line feed and are not continued, vertices and faces have no comment behind
    them, and indices count from the first vertex, not back from the last one.

    Raises:
        ScanError: A line of a vertex or a face is invalid, or counts back beyond the first vertex.
    """
    text = data.decode("utf-8", "replace").replace("\r\n", "\n").replace("\r", "\n")
    counts = dict.fromkeys(_COUNTED, 0)
    plain: list[str] = []
    for number, line in _whole_lines(text):
        words = line.strip()
        kind = words.split(maxsplit=1)[0] if words else ""
        if kind in {*_COUNTED, "f"}:
            words = words.partition("#")[0].rstrip()
        if kind in {"v", "f"} and not _OBJ_LINE.fullmatch(words):
            raise ScanError(
                f"{path}: line {number} is not a vertex or a face ('{words[:40]}')",
                f"{_AGAIN}, as OBJ with plain indices or as binary STL",
            )
        if kind in counts:
            counts[kind] += 1
        elif kind == "f" and "-" in words:
            corners = [_absolute(corner, counts) for corner in words.split()[1:]]
            if None in corners:
                raise ScanError(
                    f"{path}: line {number} counts back beyond the first vertex ('{words[:40]}')",
                    _CUT_OFF,
                )
            words = " ".join(["f", *filter(None, corners)])
        plain.append(words.rstrip("\\"))  # the reader would join a comment to the next line
    return "\n".join([*plain, ""]).encode()


def _whole_lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines and their numbers, from 1; a line that ends with a backslash is joined to the next."""
    begun, first = "", 0
    for number, line in enumerate(text.split("\n"), start=1):
        first = first if begun else number
        is_comment = not begun and line.lstrip().startswith("#")
        if line.rstrip().endswith("\\") and not is_comment:
            begun += line.rstrip()[:-1] + " "
            continue
        yield first, begun + line
        begun = ""
    if begun:
        yield first, begun


def _absolute(corner: str, counts: dict[str, int]) -> str | None:
    """A corner such as `-1/-1/-1` with indices from the first; None if one is before it."""
    indices = []
    for index, count in zip(corner.split("/"), counts.values(), strict=False):
        value = int(index or 0)
        if value < 0:
            value += count + 1
            if value < 1:
                return None
        indices.append(str(value) if index else "")
    return "/".join(indices)


_MAX_COORDINATE = 1e9  # in any unit, so that squares and products do not overflow


def _clean(
    path: Path, parts: dict[str, trimesh.Trimesh], notes: list[str]
) -> tuple[trimesh.Trimesh, list[str]]:
    """The welded surface of the sound faces, and the name of each face's part."""
    counts = [len(part.faces) for part in parts.values()]
    names = np.repeat(np.array([*parts], dtype=object), counts)
    corners = np.concatenate([part.triangles for part in parts.values()]).reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    finite = (np.abs(corners) < _MAX_COORDINATE).all(axis=1).reshape(-1, 3).all(axis=1)
    _note(notes, (~finite).sum(), "removed {} faces with a corner that is not finite")
    if not finite.any():
        raise ScanError(f"{path}: no face has finite corners", _AGAIN)
    near = finite.copy()
    near[finite] = ~find_specks(corners.reshape(-1, 3, 3)[finite])
    _note(notes, (finite & ~near).sum(), "dropped {} faces of specks or spikes far off the rest")
    vertices, faces = weld(corners, faces[near])
    plain = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    _note(notes, (~plain).sum(), "removed {} faces without area, of fewer than three vertices")
    first = np.zeros(len(faces), dtype=bool)
    first[unique_rows(np.sort(faces, axis=1))[0]] = True
    _note(notes, (plain & ~first).sum(), "removed {} duplicate faces")
    kept = plain & first
    mesh = plain_mesh(vertices, faces[kept])
    if not mesh.area > _MIN_AREA * np.ptp(vertices, axis=0).max() ** 2:
        raise ScanError(f"{path}: no face has an area", f"{_AGAIN}, as a surface")
    return mesh, names[near][kept].tolist()


_MIN_AREA = 1e-6  # [-]; of a surface, over its squared extent
_MIN_BODY_AREA = 0.01  # [-]; over the area of the largest piece
_MAX_GAP = 2.0  # [-]; between pieces of one scan, over the extent of the larger one
_MAX_SPIKES = 10  # faces around a vertex
_SPIKE = 10.0  # [-]; length of a face, over the extent of all others


def find_specks(triangles: FloatArray) -> BoolArray:
    """Faces so far off that the extent of the others would drown in that of all, shape (F,).

    Specks lie beyond a gap, along x, y or z, of twice the extent of the rest, and have less than a
    hundredth of its area. Spikes are at most ten faces, and fewer than half, each ten times as long
    as all the rest: one vertex is wrong.

    Args:
        triangles: Corners of the F faces in any unit and frame, shape (F, 3, 3), all finite.
    """
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    specks = _find_spikes(low, high)
    edges = np.diff(triangles, axis=1)
    areas = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    for _ in range(_MAX_PASSES):
        found = 0
        for axis in range(3):
            rest = np.flatnonzero(~specks)
            far = rest[_beyond_gaps(low[rest], high[rest], areas[rest], axis)]
            specks[far] = True
            found += len(far)
        if not found:
            break
    return specks


_MAX_PASSES = 3  # over the three axes


def _find_spikes(low: FloatArray, high: FloatArray) -> BoolArray:
    """Spikes among faces with these lowest and highest coordinates, shape (F, 3) each."""
    lengths = (high - low).max(axis=1)
    spikes = np.zeros(len(lengths), dtype=bool)
    longest = np.argsort(-lengths, kind="stable")[: min(_MAX_SPIKES, (len(lengths) - 1) // 2)]
    # Without the n longest faces, all the others must be short against each of these.
    for count in range(len(longest), 0, -1):
        spikes[:] = False
        spikes[longest[:count]] = True
        extent = float((high[~spikes].max(axis=0) - low[~spikes].min(axis=0)).max())
        if lengths[longest[count - 1]] > _SPIKE * extent > 0.0:
            return spikes
    return np.zeros(len(lengths), dtype=bool)


def _beyond_gaps(low: FloatArray, high: FloatArray, areas: FloatArray, axis: int) -> BoolArray:
    """Faces of little area beyond a wide gap along an axis, shape (F,).

    Args:
        low: Lowest coordinates of each face, shape (F, 3).
        high: Highest coordinates of each face, shape (F, 3).
        areas: Area of each face, shape (F,).
        axis: The axis, 0 to 2.
    """
    order = np.argsort(low[:, axis], kind="stable")
    reach = np.maximum.accumulate(high[order, axis])
    starts = np.flatnonzero(np.concatenate([[True], low[order[1:], axis] > reach[:-1]]))
    # Segments without a gap: their corners in space, and their areas.
    begin, end = np.minimum.reduceat(low[order], starts), np.maximum.reduceat(high[order], starts)
    sizes = np.add.reduceat(areas[order], starts)
    first = last = int(sizes.argmax())
    while True:  # add the segments near the largest one
        rest = slice(first, last + 1)
        widest = _MAX_GAP * float((end[rest].max(axis=0) - begin[rest].min(axis=0)).max())
        if first > 0 and begin[first, axis] - end[first - 1, axis] <= widest:
            first -= 1
        elif last + 1 < len(starts) and begin[last + 1, axis] - end[last, axis] <= widest:
            last += 1
        else:
            break
    outside = np.ones(len(starts), dtype=bool)
    outside[first : last + 1] = False
    far = np.zeros(len(low), dtype=bool)
    if sizes[outside].sum() < _MIN_BODY_AREA * sizes[~outside].sum():
        far[order] = np.repeat(outside, np.diff(np.append(starts, len(order))))
    return far


def _choose_body(
    path: Path, mesh: trimesh.Trimesh, names: Sequence[str], wanted: str | None, notes: list[str]
) -> tuple[str, IntArray]:
    """Name (or number) and faces of the wanted body, or of the only one.

    Edges of more than two faces do not connect pieces.
    """
    pieces = connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    areas = np.bincount(pieces, mesh.area_faces)
    specks = areas < _MIN_BODY_AREA * areas.max()
    _note(notes, specks[pieces].sum(), "dropped {} faces of pieces too small to be a body")
    bodies = [np.flatnonzero(pieces == piece) for piece in np.flatnonzero(~specks)]
    named = [names[faces[0]] for faces in bodies]
    fits = [i for i, name in enumerate(named) if wanted in {None, name or None}]
    fits = fits or [i for i in range(len(bodies)) if wanted == str(i)]
    if len(fits) == 1:
        return named[fits[0]] or str(fits[0]), bodies[fits[0]]
    sizes = [np.ptp(mesh.triangles[faces].reshape(-1, 3), axis=0) for faces in bodies]
    shown = ", ".join(
        f"{i} {name and repr(name) + ' '}({len(faces)} faces,"
        f" {' x '.join(map('{:.4g}'.format, size))})"
        for i, (name, faces, size) in enumerate(zip(named, bodies, sizes, strict=True))
    )
    if not fits:
        raise ScanError(f"{path}: has no body '{wanted}' among {shown}", "choose one with --body")
    raise ScanError(f"{path}: has {len(fits)} bodies of {shown}", "choose one by number: --body N")


_SOCKET = (0.1, 0.6)  # [m]; to infer the unit
_UNIT_WORDS = {
    prefix + word: short + "m"
    for prefix, short in (("", ""), ("centi", "c"), ("milli", "m"))
    for word in ("meter", "metre", "meters", "metres")
} | {"inch": "in", "inches": "in", "mm": "mm", "cm": "cm"}
# 'units in progress' does not mean inches: the shortest words need a colon.
_STATED = re.compile(
    rf"\bunits?\s*[:=]\s*({'|'.join(_UNIT_WORDS)}|m|in)\b"
    rf"|\bunits?\s+(?:are\s+|in\s+)?({'|'.join(_UNIT_WORDS)})\b"
)


def stated_unit(comment: str) -> str | None:
    """The unit stated in a file's header or comments, as in 'units: mm', or None.

    It is a key of `METRES`.
    """
    found = _STATED.search(comment.lower())
    word = found and (found[1] or found[2])
    return _UNIT_WORDS.get(word, word) if word else None


def _infer_unit(name: str, size: float) -> str:
    """The unit of a body, m or mm, inferred from its largest extent.

    cm and inches are ambiguous: a small model in mm would match them.
    """
    for unit in ("m", "mm"):
        if _SOCKET[0] <= size * METRES[unit] <= _SOCKET[1]:
            return unit
    shown = ", ".join(f"{size * metres:.3g} m in {unit}" for unit, metres in METRES.items())
    raise ScanError(
        f"{name}: its length {size:.4g} is that of a socket, {_SOCKET[0]:g} to {_SOCKET[1]:g} m,"
        f" neither in m nor in mm ({shown})",
        "give its unit with --unit, or export the scan in its real size",
    )


_MAX_HOLE = 0.020  # [m]; circumference of holes to close


def _repair(vertices: FloatArray, faces: IntArray, notes: list[str]) -> trimesh.Trimesh:
    """A body in metres with consistent winding, no crowded edges and no small holes."""
    faces, flipped = wind_alike(faces)
    _note(notes, flipped, "reversed {} faces so that all wind the same way")
    crowded = faces.size - 2 * len(twin_half_edges(faces)) - len(boundary_half_edges(faces))
    _note(notes, crowded, "cut at edges that more than two faces share, {} sides in all")
    vertices, faces = separate(vertices, faces)
    vertices, faces, closed, left = fill_holes(vertices, faces, _MAX_HOLE)
    _note(notes, len(closed), f"small holes closed: {{}}, {_millimetres(closed)} around")
    _note(notes, len(left), f"edges of the surface left open: {{}}, {_millimetres(left)} around")
    return plain_mesh(vertices, faces)


def _note(notes: list[str], count: int, text: str) -> None:
    """Add a note with a count, unless it is zero."""
    if count:
        notes.append(text.format(count))


def _millimetres(lengths: list[float]) -> str:
    return ", ".join(f"{1e3 * length:.0f} mm" for length in sorted(lengths, reverse=True)[:3])


_MAX_FACES = 20_000  # of the surface on a page
_GROWTH = 1.1  # [-]; of the cells for merging vertices, per attempt


def simplify(surface: trimesh.Trimesh) -> trimesh.Trimesh:
    """Merge the vertices in each cell of a cubic grid until at most 20,000 faces remain.

    Vertex clustering (Rossignac and Borrel 1993, doi:10.1007/978-3-642-78114-8_29) needs no
    manifold, so it accepts any scan. The cells grow with every attempt. The surface and the result
    are in the same unit and frame; a surface with few faces is returned unchanged.
    """
    cell = np.sqrt(2.0 * surface.area / _MAX_FACES)
    simplified = surface
    while len(simplified.faces) > _MAX_FACES:
        merged = number_cells(surface.vertices, cell)
        sums = [np.bincount(merged, axis) for axis in surface.vertices.T]
        mean = np.column_stack(sums) / np.bincount(merged)[:, None]
        simplified = plain_mesh(mean, merged[surface.faces])
        simplified.update_faces(simplified.nondegenerate_faces())
        simplified.update_faces(simplified.unique_faces())
        cell *= _GROWTH
    return simplified
