"""Which faces a cavity sees from its spine, and which lie hidden behind them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.scans.spine import Spine
from socket_testbed.scans.surface import Surface, dots, lengths, sample_surface

_FINENESS = 100  # samples along the side of a square of the surface's area
_NO_DEPTH = 1e-9  # [m]; a point on the spine has a direction, too
_GRAZING = 0.2  # [-]; cosine below which a face is seen from neither side


@dataclass(frozen=True)
class Sight:
    """What is seen of every face.

    Attributes:
        facing: Cosine between the normal of a face and the direction to the spine, shape (F,).
        seen: Faces whose front is the first thing in its direction, shape (F,).
        hidden: Faces whose back is turned to the spine behind the front of another, shape (F,).
        front_share: Share of the directions with anything in them whose first thing is a front.
    """

    facing: FloatArray
    seen: BoolArray
    hidden: BoolArray
    front_share: float


@dataclass(frozen=True)
class Samples:
    """Points on the faces of a surface.

    Attributes:
        owners: The face of each point, shape (P,).
        points: Shape (P, 3) [m].
        spacing: How far apart they are at most, about [m].
    """

    owners: IntArray
    points: FloatArray
    spacing: float

    def majority(self, votes: BoolArray) -> BoolArray:
        """Faces with more than half of their points in favour, shape (F,)."""
        return 2 * np.bincount(self.owners, votes) > np.bincount(self.owners)


def spread_samples(surface: Surface) -> Samples:
    """Points on a surface, close enough together for its shape as a whole."""
    spacing = float(np.sqrt(surface.areas.sum())) / _FINENESS
    return Samples(*sample_surface(surface, spacing), spacing)


def look(surface: Surface, samples: Samples, spine: Spine) -> Sight:
    """Look around from the spine.

    Args:
        surface: The surface; the normals of a shell point out of its material.
        samples: Points on all of its faces.
        spine: From where to look.
    """
    rays = samples.points - spine.feet(samples.points)
    depth = np.fmax(lengths(rays), _NO_DEPTH)
    facing = -dots(surface.normals[samples.owners], rays) / depth
    # Every direction is a point of the capsule around the spine: no poles, no seam.
    capsule = samples.points + rays * (spine.radius / depth - 1.0)[:, None]
    cell = _cells(capsule - spine.axis.origin, samples.spacing)
    front, back = facing > _GRAZING, facing < -_GRAZING
    first_front = _nearest(cell, depth, front)
    first_back = _nearest(cell, depth, back)
    any_seen = np.isfinite(np.fmin(first_front, first_back))
    return Sight(
        facing=-_cosine(surface, spine),
        seen=samples.majority(front & (depth <= first_back[cell] + samples.spacing)),
        hidden=samples.majority(back & (first_front[cell] < depth)),
        front_share=float((first_front < first_back).sum() / max(any_seen.sum(), 1)),
    )


def _cosine(surface: Surface, spine: Spine) -> FloatArray:
    rays = surface.centres - spine.feet(surface.centres)
    return dots(surface.normals, rays) / np.fmax(lengths(rays), _NO_DEPTH)


def _cells(points: FloatArray, size: float) -> IntArray:
    """Numbers of the cubes that the points are in, shape (P,)."""
    cube = np.round(points / size).astype(np.int64)
    cube -= cube.min(axis=0)
    x, y, z = cube.T
    width = cube.max(axis=0) + 1
    return np.unique((x * width[1] + y) * width[2] + z, return_inverse=True)[1]


def _nearest(cell: IntArray, depth: FloatArray, chosen: BoolArray) -> FloatArray:
    """Smallest depth of the chosen points a cell, shape (cells,); infinite where none is."""
    nearest = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(nearest, cell[chosen], depth[chosen])
    return nearest
