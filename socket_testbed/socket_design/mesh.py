"""Triangle meshes: how triangles hang together, normals and areas, axes of revolution, repairs.

A half-edge ``h = 3 f + i`` of face f runs from its corner i to its corner i + 1; corner ``h`` is
where it starts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from socket_testbed.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Edges:
    """The edges of a mesh by how many faces share them.

    Attributes:
        twins: Pairs of half-edges whose edge exactly two faces share, shape (A, 2).
        boundary: Half-edges whose edge is in one face only, shape (B,).
        crowded: Half-edges whose edge more than two faces share, shape (C,).
    """

    twins: IntArray
    boundary: IntArray
    crowded: IntArray

    @property
    def neighbours(self) -> IntArray:
        """Pairs of faces with a common edge that no third face shares, shape (A, 2)."""
        return self.twins // 3


def match_edges(faces: IntArray) -> Edges:
    """Find which half-edges lie on the same edge.

    Args:
        faces: Vertices of the triangles, shape (F, 3).
    """
    start, stop = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(start, stop), np.maximum(start, stop)
    key = low * (int(faces.max(initial=0)) + 1) + high
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(np.append(first, len(key)))
    twins = first[count == 2]
    crowded = np.repeat(count > 2, count)
    return Edges(
        twins=np.column_stack([order[twins], order[twins + 1]]),
        boundary=np.sort(order[first[count == 1]]),
        crowded=np.sort(order[crowded]),
    )


def label_pieces(count: int, pairs: IntArray) -> IntArray:
    """Number the pieces of a graph in the order of their first nodes, shape (count,).

    Args:
        count: How many nodes there are.
        pairs: Pairs of joined nodes, shape (A, 2).
    """
    graph = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), (count, count))
    labels = connected_components(graph, directed=False)[1]
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]


def separate(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Cut a mesh wherever it is no plain surface, and drop the vertices that no face uses.

    Faces stay joined across edges that exactly two of them share. Where more meet in an edge,
    or where two fans of faces meet in a vertex alone, each gets vertices of its own; so every
    boundary vertex is on one boundary loop, once.

    Args:
        vertices: Shape (V, 3).
        faces: Shape (F, 3).

    Returns:
        The new vertices and faces; the order of the faces stays.
    """
    twins = match_edges(faces).twins
    start = faces.ravel()
    one, other = twins.T
    same_way = start[one] == start[other]
    one_stop, other_stop = next_half_edge(one), next_half_edge(other)
    joined = np.vstack(
        [
            np.column_stack([one, np.where(same_way, other, other_stop)]),
            np.column_stack([one_stop, np.where(same_way, other_stop, other)]),
        ]
    )
    label = label_pieces(len(start), joined)
    _, first = np.unique(label, return_index=True)
    return vertices[start[first]], label.reshape(-1, 3)


def winding_flips(faces: IntArray, twins: IntArray) -> tuple[BoolArray, BoolArray]:
    """Which faces to turn so that neighbours wind the same way, as few as possible a piece.

    The faces are nodes twice, as they are and turned; pairs that fit are joined. In an
    orientable piece the two sets stay apart.

    Args:
        faces: Shape (F, 3).
        twins: Pairs of half-edges on a common edge, shape (A, 2).

    Returns:
        Whether to turn each face, and whether its piece is one-sided (no winding fits),
        each of shape (F,).
    """
    count = len(faces)
    one, other = twins.T
    differ = (faces.ravel()[one] == faces.ravel()[other]) * count
    a, b = one // 3, other // 3
    pairs = np.vstack(
        [np.column_stack([a, b + differ]), np.column_stack([a + count, b + count - differ])]
    )
    label = label_pieces(2 * count, pairs)
    as_is, turned = label[:count], label[count:]
    # The side that holds more faces as they are is kept.
    votes = np.bincount(as_is, minlength=label.max(initial=-1) + 1)
    better = votes[as_is] < votes[turned]
    tie = (votes[as_is] == votes[turned]) & (as_is > turned)
    return better | tie, as_is == turned


def boundary_loops(faces: IntArray, boundary: IntArray) -> list[IntArray]:
    """Boundary loops of a mesh that `separate` has left, each in the order of its half-edges.

    Args:
        faces: Shape (F, 3), wound consistently.
        boundary: Half-edges in one face only.

    Returns:
        The vertices of each loop, each vertex once.
    """
    corners = faces.ravel()
    start, stop = corners[boundary], corners[next_half_edge(boundary)]
    follows = dict(zip(start.tolist(), stop.tolist(), strict=True))
    loops = []
    while follows:
        vertex, after = follows.popitem()
        loop = [vertex]
        while after != loop[0]:
            loop.append(after)
            after = follows.pop(after)
        loops.append(np.array(loop))
    return loops


def next_half_edge(half_edges: IntArray) -> IntArray:
    """The half-edges that follow in the same faces."""
    return half_edges - half_edges % 3 + (half_edges + 1) % 3


@dataclass(frozen=True)
class Surface:
    """Triangles in the scan's axes.

    Attributes:
        vertices: Shape (V, 3) [m].
        faces: Shape (F, 3), wound consistently.
    """

    vertices: FloatArray
    faces: IntArray

    @cached_property
    def edges(self) -> Edges:
        """Which faces share an edge."""
        return match_edges(self.faces)

    @cached_property
    def centres(self) -> FloatArray:
        """Centres of the faces, shape (F, 3) [m]."""
        return self.vertices[self.faces].mean(axis=1)

    @cached_property
    def area_vectors(self) -> FloatArray:
        """Normals times areas, shape (F, 3) [m^2]."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return 0.5 * np.cross(b - a, c - a)

    @cached_property
    def areas(self) -> FloatArray:
        """Areas of the faces, shape (F,) [m^2]."""
        return lengths(self.area_vectors)

    @cached_property
    def normals(self) -> FloatArray:
        """Unit normals, shape (F, 3); zero for a face without area."""
        return self.area_vectors / np.fmax(self.areas, np.finfo(float).tiny)[:, None]

    @property
    def is_watertight(self) -> bool:
        """Whether every edge is shared by exactly two faces."""
        return not len(self.edges.boundary) and not len(self.edges.crowded)

    @cached_property
    def volume(self) -> float:
        """Volume within, positive if the normals point out; of a watertight mesh only [m^3]."""
        return float(np.einsum("ij,ij->", self.centres - self.centres[0], self.area_vectors)) / 3.0

    def flipped(self) -> Surface:
        """The same surface with its normals turned round."""
        return Surface(self.vertices, self.faces[:, ::-1])

    def subset(self, keep: BoolArray) -> Surface:
        """The faces of a mask, on the same vertices."""
        return Surface(self.vertices, self.faces[keep])


def dots(a: FloatArray, b: FloatArray) -> FloatArray:
    """Inner products of N pairs of vectors, shape (N,)."""
    return np.einsum("ij,ij->i", a, b)


def lengths(vectors: FloatArray) -> FloatArray:
    """Lengths of N vectors, shape (N,)."""
    return np.sqrt(dots(vectors, vectors))


def sample_surface(surface: Surface, spacing: float) -> tuple[IntArray, FloatArray]:
    """Points spread over every face, no farther apart than about the spacing.

    A face is cut into k^2 equal triangles, of which the centres are taken.

    Args:
        surface: The surface.
        spacing: Longest edge of a small triangle [m].

    Returns:
        The face of each point, shape (P,), and the points, shape (P, 3) [m].
    """
    corners = surface.vertices[surface.faces]
    longest = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    cuts = np.fmax(np.ceil(longest / spacing), 1).astype(np.int64)
    owners, points = [], []
    for count in np.unique(cuts):
        faces = np.flatnonzero(cuts == count)
        weights = _centres_of_parts(int(count))
        owners.append(np.repeat(faces, len(weights)))
        points.append((weights @ corners[faces]).reshape(-1, 3))
    return np.concatenate(owners), np.concatenate(points)


def _centres_of_parts(count: int) -> FloatArray:
    """Barycentric coordinates of the centres of count^2 equal parts, shape (count^2, 3)."""
    i, j = np.mgrid[:count, :count].reshape(2, -1)
    upright, turned = i + j < count, i + j < count - 1
    two = np.vstack(
        [
            np.column_stack([i[upright], j[upright]]) + 1.0 / 3.0,
            np.column_stack([i[turned], j[turned]]) + 2.0 / 3.0,
        ]
    )
    return np.column_stack([count - two.sum(axis=1), two]) / count


_EXACT = 1e-6  # [-]; misfit of an axis that is as good as exact
_IN_QUESTION = 5.0  # [-]; misfit of an axis that cannot be ruled out, of the best misfit
_ALIKE = 1.3  # [-]; between misfits so close that all axes between theirs fit as well


@dataclass(frozen=True)
class Axis:
    """A line.

    Attributes:
        origin: A point of it, shape (3,) [m].
        direction: Unit vector along it, shape (3,).
    """

    origin: FloatArray
    direction: FloatArray

    def turned(self) -> Axis:
        """The same line in the other direction."""
        return Axis(self.origin, -self.direction)


@dataclass(frozen=True)
class AxisFit:
    """How well a surface is one of revolution about axes of any direction.

    Attributes:
        middle: Middle of the surface, shape (3,) [m].
        moment: Best moment about the middle of an axis a unit direction, shape (3, 3) [m].
        misfits: Mean square misfit of the principal directions, rising, shape (3,) [-].
        directions: The principal directions, one a row, shape (3, 3).
    """

    middle: FloatArray
    moment: FloatArray
    misfits: FloatArray
    directions: FloatArray

    def likely(self) -> list[Axis]:
        """The best axis, and those at right angles to it that cannot be ruled out."""
        limit = _IN_QUESTION * max(float(self.misfits[0]), _EXACT)
        return [self._along(direction) for direction in self.directions[self.misfits <= limit]]

    def near(self, direction: FloatArray) -> Axis:
        """The principal axis near a direction, or that direction where many fit alike.

        Args:
            direction: Unit vector, shape (3,).
        """
        best = int(np.abs(self.directions @ direction).argmax())
        ratio = np.fmax(self.misfits, _EXACT) / max(float(self.misfits[best]), _EXACT)
        alike = self.directions[np.abs(np.log(ratio)) < np.log(_ALIKE)]
        towards = alike.T @ (alike @ direction)
        return self._along(towards / np.linalg.norm(towards))

    @property
    def is_sharp(self) -> bool:
        """Whether the best axis stands out."""
        return float(self.misfits[1]) > _ALIKE * max(float(self.misfits[0]), _EXACT)

    def _along(self, direction: FloatArray) -> Axis:
        return Axis(self.middle + np.cross(direction, self.moment @ direction), direction)


def fit_axis(surface: Surface) -> AxisFit:
    """Fit an axis of revolution to a surface.

    A rotation about the direction c with the moment m moves the point p by c x p + m. It leaves
    a surface of revolution in itself, so ``n . (c x p + m) = 0`` there; that is solved in least
    squares for |c| = 1 (Pottmann and Randrup 1998, Computing 60, 307-322). Neither the sign of
    the normals nor a part of the circumference that is missing matters.
    """
    weights = surface.areas / surface.areas.sum()
    middle = weights @ surface.centres
    points = surface.centres - middle
    scale = max(float(np.sqrt(weights @ (points**2).sum(axis=1))), np.finfo(float).tiny)
    columns = np.hstack([np.cross(points / scale, surface.normals), surface.normals])
    gram = columns.T @ (weights[:, None] * columns)
    moment = -np.linalg.pinv(gram[3:, 3:], rcond=1e-9, hermitian=True) @ gram[3:, :3]
    misfits, directions = np.linalg.eigh(gram[:3, :3] + gram[:3, 3:] @ moment)
    return AxisFit(middle, scale * moment, misfits, directions.T)


_SAME_PLACE = 1e-6  # [-]; of the size of the mesh
_ROUNDS = 10  # of flips; a flip can leave a sliver to its neighbour


def weld(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Make one vertex of all in the same place, to a millionth of the size of the mesh.

    Args:
        vertices: Shape (V, 3), finite where a face uses them.
        faces: Shape (F, 3).

    Returns:
        The vertices that the faces use, and the faces.
    """
    used, corners = np.unique(faces, return_inverse=True)
    places = vertices[used]
    low = places.min(axis=0)
    cell = max(_SAME_PLACE * float((places.max(axis=0) - low).max()), np.finfo(float).tiny)
    x, y, z = np.round((places - low) / cell).astype(np.int64).T  # 21 bits each at most
    _, first, cubes = np.unique((x << 42) | (y << 21) | z, return_index=True, return_inverse=True)
    # Neighbours on the two sides of a cell's face are left.
    close = cKDTree(places[first]).query_pairs(cell, output_type="ndarray")
    label = label_pieces(len(first), close)
    _, welded = np.unique(label, return_index=True)
    return places[first[welded]], label[cubes[corners]].reshape(-1, 3)


def are_finite(vertices: FloatArray, faces: IntArray) -> BoolArray:
    """Whether all corners of a face are finite, shape (F,)."""
    return np.asarray(np.isfinite(vertices[faces]).all(axis=(1, 2)))


def are_triangles(faces: IntArray) -> BoolArray:
    """Whether the corners of a face are three different vertices, shape (F,)."""
    return (faces != np.roll(faces, 1, axis=1)).all(axis=1)


def are_first(faces: IntArray) -> BoolArray:
    """Whether no earlier face has the same corners, whatever its winding, shape (F,)."""
    low, middle, high = np.sort(faces, axis=1).T
    order = np.lexsort((high, middle, low))  # stable: the first stays the first
    ordered = faces[order]
    same = (np.diff(np.sort(ordered, axis=1), axis=0) == 0).all(axis=1)
    first = np.ones(len(faces), bool)
    first[order[1:][same]] = False
    return first


def wind_alike(faces: IntArray) -> tuple[IntArray, int, BoolArray]:
    """Turn faces so that neighbours wind the same way.

    Args:
        faces: Shape (F, 3).

    Returns:
        The faces; how many were turned; which of them no winding fits, shape (F,).
    """
    turn, one_sided = winding_flips(faces, match_edges(faces).twins)
    return np.where(turn[:, None], faces[:, ::-1], faces), int(turn.sum()), one_sided


def fill_holes(
    vertices: FloatArray, faces: IntArray, longest: float
) -> tuple[FloatArray, IntArray, list[float], list[float]]:
    """Close small holes by a fan around their middle.

    Args:
        vertices: Shape (V, 3) [m].
        faces: Shape (F, 3), as `separate` leaves them, wound alike.
        longest: Holes at least this long around stay open [m].

    Returns:
        The vertices; the faces; how long the closed holes were around; how long the open
        ones are [m].
    """
    new_vertices, new_faces = [vertices], [faces]
    closed, left = [], []
    count = len(vertices)
    for loop in boundary_loops(faces, match_edges(faces).boundary):
        around = loop_length(vertices, loop)
        if around >= longest:
            left.append(around)
            continue
        closed.append(around)
        if len(loop) == 3:
            new_faces.append(loop[None, ::-1])
            continue
        new_vertices.append(vertices[loop].mean(axis=0, keepdims=True))
        new_faces.append(np.column_stack([np.roll(loop, -1), loop, np.full(len(loop), count)]))
        count += 1
    return np.vstack(new_vertices), np.vstack(new_faces), closed, left


def loop_length(vertices: FloatArray, loop: IntArray) -> float:
    """How long a loop of vertices is around [m]."""
    steps = vertices[np.roll(loop, -1)] - vertices[loop]
    return float(np.linalg.norm(steps, axis=1).sum())


def flip_slivers(vertices: FloatArray, faces: IntArray) -> tuple[IntArray, int]:
    """Remove faces whose corners lie on one line, without opening a crack.

    Such a face is joined to the neighbour across its longest edge, and both are cut along the
    other diagonal; where there is none it is left out.

    Args:
        vertices: Shape (V, 3).
        faces: Shape (F, 3), wound alike.

    Returns:
        The faces, and how many had no area.
    """
    slivers = are_slivers(vertices, faces)
    found = int(slivers.sum())
    for _ in range(_ROUNDS):
        if not slivers.any():
            break
        faces = _flip(vertices, faces, slivers)
        slivers = are_slivers(vertices, faces)
    return faces[~slivers], found


def are_slivers(vertices: FloatArray, faces: IntArray) -> BoolArray:
    """Whether the height of a face over its longest edge is next to nothing, shape (F,)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    longest = np.linalg.norm([b - a, c - b, a - c], axis=2).max(axis=0)
    double_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    size = np.ptp(vertices, axis=0).max()
    return double_area <= _SAME_PLACE * size * longest


def _flip(vertices: FloatArray, faces: IntArray, slivers: BoolArray) -> IntArray:
    """Flip the longest edge of each sliver that has a neighbour there, no face twice."""
    twin = np.full(3 * len(faces), -1)
    twins = match_edges(faces).twins
    twin[twins] = twins[:, ::-1]
    corners = vertices[faces]
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    flipped = faces.copy()
    touched: set[int] = set()
    for face in np.flatnonzero(slivers).tolist():
        edge = 3 * face + int(lengths[face].argmax())
        across = int(twin[edge])
        if across >= 0 and touched.isdisjoint((face, across // 3)):
            touched |= {face, across // 3}
            start, stop, near = _corners_from(faces, edge)
            far = _corners_from(faces, across)[2]
            flipped[face], flipped[across // 3] = (start, far, near), (far, stop, near)
    return flipped


def _corners_from(faces: IntArray, half_edge: int) -> tuple[int, int, int]:
    """The corners of a face, beginning at a half-edge's start."""
    a, b, c = np.roll(faces[half_edge // 3], -(half_edge % 3)).tolist()
    return a, b, c
