"""Triangles of a Wavefront OBJ file, with the names of its objects and groups."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import ScanError

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
