"""Tiles as they are drawn: surface, squares, colours and axes of {S}."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgba

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.errors import ConfigurationError, ScanError
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.report.figures.style import CLUSTER, EDGE, NO_VALUE, PALE, SCALE, TILE

_LARGEST_SURFACE = 2.0  # [m]; what is larger is in another unit
_GROWTH = 1.1  # [-]; of the cells, from one attempt to the next
_SMALLEST_CELL = 1e-5  # [-]; of the surface's size, so that a cell's number is an int64
_FACES_PER_CELL = 2.0  # [-]; of a triangulation


def drawable_surface(vertices: FloatArray, faces: IntArray, most_faces: int) -> trimesh.Trimesh:
    """A surface that can be drawn: checked, and of no more faces than a drawing can hold.

    Args:
        vertices: Vertices in {S}, shape (v, 3) [m].
        faces: Indices of each face's vertices, shape (f, 3).
        most_faces: Largest number of faces of the result.

    Raises:
        ScanError: If this is no surface, or not in metres.
    """
    vertices, faces = np.asarray(vertices, dtype=float), np.asarray(faces)
    _check(vertices, faces)
    return _simplify(trimesh.Trimesh(vertices, faces, process=False), most_faces)


def _simplify(surface: trimesh.Trimesh, most_faces: int) -> trimesh.Trimesh:
    """Merge the vertices in each cell of a cubic grid, in cells that grow until it suffices.

    Vertex clustering (Rossignac and Borrel 1993, doi:10.1007/978-3-642-78114-8_29), with the
    mean of a cell's vertices, or of those on the rim, for all of them. It needs no manifold,
    so it takes any scan.

    Raises:
        ScanError: If its faces have so little in common that none is left.
    """
    cell = max(
        np.sqrt(_FACES_PER_CELL * surface.area / most_faces),
        _SMALLEST_CELL * float(np.ptp(surface.vertices, axis=0).max()),
    )
    edges = surface.edges_sorted
    rim = np.zeros(len(surface.vertices), dtype=bool)
    rim[edges[trimesh.grouping.group_rows(edges, require_count=1)]] = True
    simplified = surface
    while len(simplified.faces) > most_faces:
        simplified = _merge_within_cells(surface, rim, cell)
        cell *= _GROWTH
    if not len(simplified.faces):
        raise ScanError("the surface's faces do not hang together", "repair the scan")
    return simplified


def _merge_within_cells(surface: trimesh.Trimesh, rim: BoolArray, cell: float) -> trimesh.Trimesh:
    place = ((surface.vertices - surface.vertices.min(axis=0)) / cell).astype(np.int64)
    key = np.ravel_multi_index(tuple(place.T), tuple(place.max(axis=0) + 1))
    _, cell_of_vertex = np.unique(key, return_inverse=True)
    # The rest of a cell at the rim would draw the rim inwards, here more and there less.
    weight = np.where(np.bincount(cell_of_vertex, rim)[cell_of_vertex] > 0, rim, 1.0)
    sums = [np.bincount(cell_of_vertex, weight * axis) for axis in surface.vertices.T]
    mean = np.column_stack(sums) / np.bincount(cell_of_vertex, weight)[:, None]
    faces = cell_of_vertex[surface.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return trimesh.Trimesh(mean, faces[np.sort(first)], process=False)


def _check(vertices: FloatArray, faces: IntArray) -> None:
    for what, array in (("vertices", vertices), ("faces", faces)):
        if array.ndim != 2 or array.shape[1] != 3 or not len(array):
            raise ScanError(
                f"the surface's {what} have the shape {array.shape}", "give one row of three each"
            )
    if not np.issubdtype(faces.dtype, np.integer):
        raise ScanError("the surface's faces are no whole numbers", "give indices of vertices")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ScanError(
            f"a face of the surface has a vertex that is none of the {len(vertices)}",
            "give indices of vertices, from 0",
        )
    if not np.isfinite(vertices).all():
        raise ScanError("a vertex of the surface is not finite", "repair the scan")
    size = float(np.ptp(vertices, axis=0).max())
    if not 0.0 < size <= _LARGEST_SURFACE:
        raise ScanError(f"the surface is {size:g} m long", "give its vertices in m")


# Corners of a square of edge 2 in {L}, counter-clockwise about the inward normal.
_CORNERS = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
_DARK = 0.45  # [-]; luminance below which ink is white
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # ITU-R BT.709


def tile_squares(geometry: SocketGeometry) -> FloatArray:
    """Corners of the tiles' squares in {S}, of edge sqrt(area) around the anchors.

    Returns:
        Corners (-x, -y), (+x, -y), (+x, +y), (-x, +y) of each tile's frame, shape
        (n, 4, 3) [m].
    """
    half_edges = 0.5 * np.sqrt(geometry.areas)
    corners_in_tile = half_edges[:, None, None] * _CORNERS
    tiles_in_socket = Pose(geometry.square_frames()[:, None], geometry.anchors[:, None])
    return tiles_in_socket.apply(corners_in_tile)


def tile_labels(geometry: SocketGeometry) -> list[str]:
    """Names of the tiles, each with its cluster where that has another name."""
    labels = list(geometry.names)
    for cluster, tile in geometry.clusters.items():
        if cluster != labels[tile]:
            labels[tile] += f" ({cluster})"
    return labels


def covered_tiles(geometry: SocketGeometry) -> BoolArray:
    """Which tiles a cluster covers, shape (n,)."""
    covered = np.zeros(len(geometry), dtype=bool)
    covered[list(geometry.clusters.values())] = True
    return covered


def value_range(geometry: SocketGeometry, values: FloatArray) -> tuple[float, float]:
    """Ends of the colour scale: the finite values' range, widened where it is a point.

    Args:
        geometry: The socket.
        values: One value per tile, NaN where there is none; or several such rows, shape (..., n).

    Raises:
        ConfigurationError: If the values are not those of these tiles.
    """
    if values.shape[-1:] != (len(geometry),):
        raise ConfigurationError(
            f"values of the shape {values.shape} do not fit {len(geometry)} tiles",
            "give one value per tile, NaN where there is none",
        )
    if np.isinf(values).any():
        name = geometry.names[int(np.argwhere(np.isinf(values))[0, -1])]
        raise ConfigurationError(
            f"the value of tile '{name}' is infinite", "give a finite value, or NaN for none"
        )
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    if low == high:
        margin = 0.1 * abs(low) or 1.0
        return low - margin, high + margin
    return low, high


@dataclass(frozen=True)
class TilePaint:
    """How the tiles are painted.

    Attributes:
        fills: Fill of each tile, RGBA, shape (n, 4) [-].
        edges: Outline of each tile, RGBA, shape (n, 4) [-].
        widths: Widths of the outlines, shape (n,) [pt].
        labels: What is written on each tile.
        scale: The colours' scale; None where they show kinds, not values.
        hatched: Tiles without a value, or whose value is not determined, shape (n,).
    """

    fills: FloatArray
    edges: FloatArray
    widths: FloatArray
    labels: Sequence[str]
    scale: ScalarMappable | None
    hatched: BoolArray

    def ink(self, tile: int) -> str:
        """Colour that is legible on a tile."""
        return "white" if self.fills[tile, :3] @ _LUMINANCE < _DARK else "black"


def paint_tiles(
    geometry: SocketGeometry,
    values: FloatArray | None = None,
    limits: tuple[float, float] | None = None,
    labels: Sequence[str] | None = None,
    certainty: FloatArray | None = None,
    determined: BoolArray | None = None,
) -> TilePaint:
    """Paint tiles by their values, or else tiles with and without a cluster in two colours.

    A tile with a cluster has a thick outline, too.

    Args:
        geometry: The socket.
        values: One value per tile, shape (n,); NaN, white and hatched, where there is none.
        limits: Ends of the colour scale; None for those of the values.
        labels: What is written on each tile; None for its name.
        certainty: How certain each value is, 0 to 1, shape (n,) [-]: a tile fades to white as it
            falls; None where that is not known.
        determined: Which values are determined, shape (n,): the others are pale and hatched; None
            if all are.

    Raises:
        ConfigurationError: If the values are not those of these tiles.
    """
    covered = covered_tiles(geometry)
    if values is None:
        fills, scale = _choose(covered, CLUSTER, TILE), None
        hatched = np.zeros(len(geometry), dtype=bool)
    else:
        low, high = value_range(geometry, values)
        unknown = np.isnan(values)
        hatched = unknown if determined is None else unknown | ~determined
        scale = ScalarMappable(Normalize(*(limits or (low, high))), SCALE)
        fills = np.where(unknown[:, None], to_rgba(NO_VALUE), scale.to_rgba(values))
        if certainty is None:
            certainty = np.where(hatched, PALE, 1.0)
        white = np.array(to_rgba(NO_VALUE))
        fills = white + certainty[:, None] * (fills - white)
    edges = _choose(covered, "black" if values is None else CLUSTER, EDGE)
    widths = np.where(covered, 1.6, 0.6)
    return TilePaint(fills, edges, widths, labels or tile_labels(geometry), scale, hatched)


def _choose(covered: BoolArray, with_cluster: str, without: str) -> FloatArray:
    return np.where(covered[:, None], to_rgba(with_cluster), to_rgba(without))


AXIS_NAMES = ("x", "y", "z")
_LONGEST = 0.25  # [-]; of the socket's diagonal
_FARTHEST = 0.6  # [-]; likewise, of the origin from the socket
_BELOW = 1.3  # [-]; of the axes' length


@dataclass(frozen=True)
class AxesOfS:
    """The axes of {S} as three arrows.

    Attributes:
        start: Where they start in {S}, shape (3,) [m].
        length: Their length, a round number [m].
        moved: Whether they start elsewhere than in the origin, which is far off.
    """

    start: FloatArray
    length: float
    moved: bool

    def describe(self) -> str:
        """What they are, for a legend."""
        where = ", moved here from the far origin" if self.moved else ""
        return f"axes of {{S}}, {1e3 * self.length:g} mm{where}"


def drawn_bounds(
    geometry: SocketGeometry, surface: trimesh.Trimesh | None = None
) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest coordinates in {S} of the tiles and a surface, shape (3,) each [m]."""
    corners = tile_squares(geometry).reshape(-1, 3)
    if surface is not None:
        corners = np.vstack([corners, surface.bounds])
    return corners.min(axis=0), corners.max(axis=0)


def place_axes(low: FloatArray, high: FloatArray) -> AxesOfS:
    """The axes at the origin; right below the socket where the origin is far from it.

    Args:
        low: Lowest coordinates of the socket in {S}, shape (3,) [m].
        high: Highest coordinates, shape (3,) [m].
    """
    diagonal = float(np.linalg.norm(high - low))
    length = _round_length(_LONGEST * diagonal)
    gap = float(np.linalg.norm(np.clip(0.0, low, high)))
    if gap <= _FARTHEST * diagonal:
        return AxesOfS(np.zeros(3), length, moved=False)
    middle = 0.5 * (low + high)
    return AxesOfS(np.array([middle[0], middle[1], low[2] - _BELOW * length]), length, moved=True)


def _round_length(longest: float) -> float:
    """The longest of 1, 2 or 5 times a power of ten."""
    decade = 10.0 ** np.floor(np.log10(longest))
    return float(decade * max(step for step in (1.0, 2.0, 5.0) if step * decade <= longest))
