r"""The gated displacements of many samples as Chebyshev series of one coordinate each.

The range of each coordinate of the limb position is divided into panels. The gate has its poles at
the distance :math:`\pi / (2 \alpha)` from the real axis: on a panel of half-width h its series
converges like :math:`\rho^{-m}` with :math:`\rho = y + \sqrt{1 + y^2}`,
:math:`y = \pi / (2 \alpha h)` (Trefethen, Approximation Theory and Approximation Practice, ch. 8).
On panels of at most twice the poles' distance, 40 terms give double precision.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.polynomial.chebyshev import chebpts1, chebvander

from socket_testbed.arrays import FloatArray, IntArray

_BLOCK = 2000  # samples at a time; keeps their polynomials within the cache
_PRECISION = 1e-14  # [-]; of the series


class GateSeries:
    """Panels of the three coordinates, and the polynomials of samples in them.

    Args:
        position: Limb positions q, shape (N, 3) [m], which span the panels.
        sharpness: Sharpness alpha of the gate [1/m].

    Attributes:
        panels: Number of panels of each coordinate, shape (3,).
        length: Number m of terms in a panel, the constant included.
    """

    def __init__(self, position: FloatArray, sharpness: float) -> None:
        poles = math.pi / (2.0 * sharpness)
        half_width = 0.5 * np.ptp(position, axis=0)
        self.panels: IntArray = np.maximum(np.ceil(half_width / poles), 1.0).astype(np.int64)
        self._low, self._half_width = position.min(axis=0), half_width / self.panels
        widest = float(self._half_width.max())
        terms = -math.log(_PRECISION) / math.asinh(poles / widest) if widest > 0.0 else 0.0
        self.length = 3 + math.ceil(terms)

    @property
    def terms(self) -> int:
        """Number of terms of all panels."""
        return self.length * int(self.panels.sum())

    @property
    def cells(self) -> float:
        """Number of cells, which are the combinations of panels."""
        return float(np.prod(self.panels.astype(np.float64)))

    @property
    def transform(self) -> FloatArray:
        """Map of the values at the nodes of a panel onto its coefficients, shape (m, m) [-]."""
        nodes = chebpts1(self.length)
        transform = 2.0 / self.length * chebvander(nodes, self.length - 1).T
        transform[0] *= 0.5
        return np.asarray(transform)

    def nodes(self, axis: int) -> FloatArray:
        """Nodes of the panels of a coordinate, shape (panels, m) [m]."""
        middles = self._low[axis] + self._half_width[axis] * (2 * np.arange(self.panels[axis]) + 1)
        return np.asarray(middles[:, None] + self._half_width[axis] * chebpts1(self.length))

    def by_cell(
        self, position: FloatArray, targets: FloatArray
    ) -> Iterator[tuple[list[int], IntArray, FloatArray]]:
        """The samples cell by cell, which is by the panels of all coordinates.

        Args:
            position: Limb positions q within the panels, shape (N, 3) [m].
            targets: Values to go with them, shape (N, t).

        Yields:
            The panel of each coordinate, the indices of the r samples, and a row for each of
            their polynomials and targets, shape (3m + t, r).
        """
        scale = np.where(self._half_width > 0.0, self._half_width, 1.0)
        panel = ((position - self._low) / (2.0 * scale)).astype(np.int64)
        panel = np.minimum(panel, self.panels - 1)
        cells = np.ravel_multi_index(tuple(panel.T), tuple(self.panels))
        order = np.argsort(cells.astype(np.min_scalar_type(cells.max())), kind="stable")
        values = np.empty((3 * self.length + targets.shape[1], _BLOCK))
        for start in range(0, len(order), _BLOCK):
            rows = order[start : start + _BLOCK]
            middle = self._low + self._half_width * (2 * panel[rows] + 1)
            of = values[:, : len(rows)]
            of[3 * self.length :] = targets[rows].T
            self._evaluate(((position[rows] - middle) / scale).T, of)
            changes = np.flatnonzero(np.diff(cells[rows])) + 1
            for first, end in zip([0, *changes], [*changes, len(rows)], strict=True):
                yield panel[rows[first]].tolist(), rows[first:end], of[:, first:end]

    def _evaluate(self, local: FloatArray, values: FloatArray) -> None:
        """Chebyshev polynomials in place, in half the time of numpy's `chebvander`."""
        T = values[: 3 * self.length].reshape(3, self.length, -1)
        T[:, 0], T[:, 1] = 1.0, local
        twice = 2.0 * local
        for k in range(2, self.length):
            np.multiply(T[:, k - 1], twice, out=T[:, k])
            T[:, k] -= T[:, k - 2]
