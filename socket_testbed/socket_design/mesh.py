"""Triangle meshes: how triangles hang together, samples, axes of revolution, repairs.

A half-edge ``h = 3 f + i`` of face f runs from its corner i to its corner i + 1; corner ``h`` is
where it starts. It is row h of `trimesh.Trimesh.edges`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from trimesh.geometry import faces_to_edges
from trimesh.graph import connected_component_labels
from trimesh.grouping import group_rows

from socket_testbed.arrays import BoolArray, FloatArray, IntArray


def plain_mesh(vertices: FloatArray, faces: IntArray) -> trimesh.Trimesh:
    """A mesh of exactly these vertices, shape (V, 3), and faces, shape (F, 3)."""
    return trimesh.Trimesh(vertices, faces, process=False)


def twin_half_edges(faces: IntArray) -> IntArray:
    """Pairs of half-edges whose edge exactly two faces share, shape (A, 2).

    Args:
        faces: Vertices of the triangles, shape (F, 3).
    """
    return group_rows(np.sort(faces_to_edges(faces), axis=1), require_count=2)


def boundary_half_edges(faces: IntArray) -> IntArray:
    """Half-edges whose edge is in one face only, shape (B,).

    Args:
        faces: Vertices of the triangles, shape (F, 3).
    """
    return np.sort(group_rows(np.sort(faces_to_edges(faces), axis=1), require_count=1))


def separate(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Cut a mesh wherever it is not a plain surface, and drop the vertices that no face uses.

    Faces stay joined across edges that exactly two of them share. Where more meet in an edge,
    or where two fans of faces meet in a vertex alone, each gets vertices of its own; so every
    boundary vertex is on one boundary loop, once.

    Args:
        vertices: Shape (V, 3).
        faces: Shape (F, 3).

    Returns:
        The new vertices and faces; the order of the faces stays.
    """
    start = faces.ravel()
    one, other = twin_half_edges(faces).T
    same_way = start[one] == start[other]
    one_stop, other_stop = next_half_edge(one), next_half_edge(other)
    joined = np.vstack(
        [
            np.column_stack([one, np.where(same_way, other, other_stop)]),
            np.column_stack([one_stop, np.where(same_way, other_stop, other)]),
        ]
    )
    label = connected_component_labels(joined, node_count=len(start))
    _, first = np.unique(label, return_index=True)
    return vertices[start[first]], label.reshape(-1, 3).astype(np.int64)


def wind_alike(faces: IntArray) -> tuple[IntArray, int, BoolArray]:
    """Reverse faces so that neighbours wind the same way, as few as possible per piece.

    The faces are nodes twice, as they are and reversed; pairs that fit are joined. In an
    orientable piece the two sets stay apart.

    Args:
        faces: Shape (F, 3).

    Returns:
        The faces; how many were reversed; which of them no winding fits, as their piece is
        one-sided, shape (F,).
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
    # The side that holds more faces as they are is kept.
    votes = np.bincount(as_is, minlength=label.max(initial=-1) + 1)
    flip = votes[as_is] < votes[reverse]
    flip |= (votes[as_is] == votes[reverse]) & (as_is > reverse)
    return np.where(flip[:, None], faces[:, ::-1], faces), int(flip.sum()), as_is == reverse


def boundary_loops(faces: IntArray) -> list[IntArray]:
    """Boundary loops of a mesh that `separate` has left, each in the order of its half-edges.

    Args:
        faces: Shape (F, 3), wound consistently.

    Returns:
        The vertices of each loop, each vertex once.
    """
    boundary = boundary_half_edges(faces)
    start, stop = faces.ravel()[boundary], faces.ravel()[next_half_edge(boundary)]
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


def loop_length(vertices: FloatArray, loop: IntArray) -> float:
    """How long a loop of vertices is around [m]."""
    steps = vertices[np.roll(loop, -1)] - vertices[loop]
    return float(np.linalg.norm(steps, axis=1).sum())


def next_half_edge(half_edges: IntArray) -> IntArray:
    """The half-edges that follow in the same faces."""
    return half_edges - half_edges % 3 + (half_edges + 1) % 3


def area_vectors(mesh: trimesh.Trimesh) -> FloatArray:
    """Normals of the faces times their areas, shape (F, 3) [m^2]."""
    return 0.5 * np.asarray(mesh.triangles_cross)


def sample_surface(mesh: trimesh.Trimesh, spacing: float) -> tuple[IntArray, FloatArray]:
    """Points spread over every face, no farther apart than about the spacing.

    Each face is cut into k^2 equal triangles, of which the centres are taken.

    Args:
        mesh: The surface [m].
        spacing: Longest edge of a small triangle [m].

    Returns:
        The face of each point, shape (P,), and the points, shape (P, 3) [m].
    """
    corners = np.asarray(mesh.triangles)
    longest = _edge_lengths(corners).max(axis=1)
    cuts = np.fmax(np.ceil(longest / spacing), 1).astype(np.int64)
    owners, points = [], []
    for count in np.unique(cuts):
        faces = np.flatnonzero(cuts == count)
        weights = _centres_of_parts(int(count))
        owners.append(np.repeat(faces, len(weights)))
        points.append((weights @ corners[faces]).reshape(-1, 3))
    return np.concatenate(owners), np.concatenate(points)


def number_cells(points: FloatArray, size: float) -> IntArray:
    """Number the cells of a cubic grid that hold points, by x, then y, then z.

    Args:
        points: Shape (P, 3) [m].
        size: Edge of a cell [m].

    Returns:
        The number of the cell of each point, shape (P,).
    """
    return np.unique(cell_keys(points, size), return_inverse=True)[1]


def cell_keys(points: FloatArray, size: float) -> IntArray:
    """A number of its own for each cell of a cubic grid, rising by x, then y, then z.

    Args:
        points: Shape (P, 3) [m].
        size: Edge of a cell [m].

    Returns:
        The number of the cell of each point, shape (P,).
    """
    cell = np.floor(points / size).astype(np.int64)
    x, y, z = (cell - cell.min(axis=0)).T
    return (x * (y.max() + 1) + y) * (z.max() + 1) + z


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


def fit_axis(mesh: trimesh.Trimesh) -> AxisFit:
    """Fit an axis of revolution to a surface.

    A rotation about the direction c with the moment m moves the point p by c x p + m. It leaves
    a surface of revolution in itself, so ``n . (c x p + m) = 0`` there; that is solved in least
    squares for |c| = 1 (Pottmann and Randrup 1998, Computing 60, 307-322). Neither the sign of
    the normals nor a part of the circumference that is missing matters.
    """
    weights = mesh.area_faces / mesh.area
    normals, centres = np.asarray(mesh.face_normals), np.asarray(mesh.triangles_center)
    middle = weights @ centres
    points = centres - middle
    scale = max(float(np.sqrt(weights @ (points**2).sum(axis=1))), np.finfo(float).tiny)
    columns = np.hstack([np.cross(points / scale, normals), normals])
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
    label = connected_component_labels(close, node_count=len(first))
    _, welded = np.unique(label, return_index=True)
    return places[first[welded]], label[cubes[corners]].reshape(-1, 3).astype(np.int64)


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
    for loop in boundary_loops(faces):
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
    triangles = vertices[faces]
    longest = _edge_lengths(triangles).max(axis=1)
    double_area = np.linalg.norm(trimesh.triangles.cross(triangles), axis=1)
    size = np.ptp(vertices, axis=0).max()
    return double_area <= _SAME_PLACE * size * longest


def _edge_lengths(triangles: FloatArray) -> FloatArray:
    """Lengths of the half-edges of triangles, shape (F, 3)."""
    return np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)


def _flip(vertices: FloatArray, faces: IntArray, slivers: BoolArray) -> IntArray:
    """Flip the longest edge of each sliver that has a neighbour there, no face twice."""
    twin = np.full(3 * len(faces), -1)
    twins = twin_half_edges(faces)
    twin[twins] = twins[:, ::-1]
    lengths = _edge_lengths(vertices[faces])
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
