"""Finding the cavity of a surface: the spine that its inner wall is seen from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from socket_testbed.errors import ScanError
from socket_testbed.scans.axis import Axis, fit_axis
from socket_testbed.scans.sight import Samples, Sight, look, spread_samples
from socket_testbed.scans.spine import Spine, lay_spine
from socket_testbed.scans.surface import Surface
from socket_testbed.scans.wall import main_piece

_SOLID = 0.5  # [-]; share of directions in which a cavity sees the front of something first
_LEAST_WALL = 0.05  # [-]; area of the wall of a cavity, of that of the surface
_FLAT = 0.95  # [-]; area of the caps that close a wall, of its own
_CLEARLY_OPEN = 0.1  # [-]; net opening, of a section of the cavity


@dataclass(frozen=True)
class Cavity:
    """A surface with its normals into the cavity, as its spine sees it.

    Attributes:
        surface: The surface.
        samples: Points on all of its faces.
        spine: The spine.
        sight: What it sees.
    """

    surface: Surface
    samples: Samples
    spine: Spine
    sight: Sight

    @cached_property
    def wall(self) -> Surface:
        """The largest piece of what is seen from its front."""
        return self.surface.subset(main_piece(self.surface, self.sight.seen))

    @cached_property
    def net_opening(self) -> float:
        """Area of the openings in the direction of the spine [m^2].

        The area vectors of a closed surface add up to nothing, so those of the wall, which
        point inwards, add up to those of the caps that would close it, turned outwards. An
        opening at the spine's beginning counts against one at its end; one at its side not.
        """
        return float(self.wall.area_vectors.sum(axis=0) @ self.spine.axis.direction)

    @property
    def has_clear_end(self) -> bool:
        """Whether one of its ends is clearly more open than the other."""
        return abs(self.net_opening) > _CLEARLY_OPEN * np.pi * self.spine.radius**2

    @property
    def has_wall(self) -> bool:
        """Whether what is seen from its front is large and not flat."""
        area = float(self.wall.areas.sum())
        caps = float(np.linalg.norm(self.wall.area_vectors.sum(axis=0)))
        return area > _LEAST_WALL * float(self.surface.areas.sum()) and caps < _FLAT * area

    def along(self, axis: Axis, open_above: bool = False) -> Cavity:
        """The same cavity seen from another axis; see `lay_spine`."""
        spine = lay_spine(axis, self.wall, open_above)
        return Cavity(self.surface, self.samples, spine, look(self.surface, self.samples, spine))

    def refined(self) -> Cavity:
        """The same cavity seen from the axis of its wall alone."""
        return self.along(fit_axis(self.wall).near(self.spine.axis.direction))


def find_cavity(name: str, surface: Surface) -> Cavity:
    """Find the cavity of a surface.

    Args:
        name: What names the surface in an error.
        surface: Wound alike; if it is watertight, with its normals out of the material.

    Raises:
        ScanError: If it has none.
    """
    samples = spread_samples(surface)
    likeliest = None
    for axis in fit_axis(surface).likely():
        cavity = _see(surface, samples, axis)
        cavity = cavity.refined() if cavity.has_wall else cavity
        if cavity.has_wall and cavity.sight.front_share > _SOLID:
            likeliest = likeliest or cavity
            # A shallow oval cup is nearly round about its long side, too; but both ends of that
            # axis are closed.
            if cavity.has_clear_end:
                return cavity
    if likeliest is None:
        raise ScanError(
            f"{name}: has no cavity, it is solid or flat",
            "scan the inside of the socket, or cut a closed model open at the brim",
        )
    return likeliest


def _see(surface: Surface, samples: Samples, axis: Axis) -> Cavity:
    spine = lay_spine(axis, surface)
    sight = look(surface, samples, spine)
    if sight.front_share < _SOLID and not surface.is_watertight:
        surface = surface.flipped()  # an open surface may be wound either way
        sight = look(surface, samples, spine)
    return Cavity(surface, samples, spine, sight)
