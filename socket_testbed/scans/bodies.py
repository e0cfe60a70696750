"""The bodies of a scan file: its connected pieces, their names, and the choice of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import ScanError
from socket_testbed.scans.surface import Surface
from socket_testbed.scans.topology import label_pieces

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
