r"""Moments of the gated displacements: all that Stage 2 needs of the data.

Every column of S, the gated displacements, is a function of one coordinate of q alone. With
T the Chebyshev polynomials of the three coordinates and B the coefficients of the gate,
:math:`S = T B`: the products :math:`T^T T` and :math:`T^T Y` of the data hold for any rest
positions, and new ones cost nothing in the number of samples.

With S the N x 3n matrix of the gated displacements and Y any targets, one pass gives the
means and the centred products :math:`S_c^T S_c` and :math:`S_c^T Y_c`. Nothing of size
6N x 3n is ever built: the wrench's quadratic term is :math:`(C^T W C) \circ (S^T S)`.
Centring before the product keeps the digits that a hold would lose afterwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.polynomial.chebyshev import chebpts1, chebvander

from socket_testbed.arrays import FloatArray
from socket_testbed.identification.contact import gated_displacement


@dataclass(frozen=True)
class Moments:
    """Moments of N rows of gated displacements S (N, p) and targets Y (N, m).

    Attributes:
        count: Number of rows N.
        mean: Means of S, shape (p,) [m].
        gram: Centred products of S with itself, shape (p, p) [m^2].
        target_mean: Means of Y, shape (m,).
        cross: Centred products of S with Y, shape (p, m).
        target_power: Centred sums of squares of Y, shape (m,).
    """

    count: int
    mean: FloatArray
    gram: FloatArray
    target_mean: FloatArray
    cross: FloatArray
    target_power: FloatArray

    def about_zero(self) -> Moments:
        """The same moments without centring, as a model without offsets needs them."""
        return Moments(
            self.count,
            np.zeros_like(self.mean),
            self.gram + self.count * np.outer(self.mean, self.mean),
            np.zeros_like(self.target_mean),
            self.cross + self.count * np.outer(self.mean, self.target_mean),
            self.target_power + self.count * self.target_mean**2,
        )


_SERIES_BLOCK = 2048  # rows
_PRECISION = 1e-14  # [-]; of the series
_EXPONENTIAL = 40  # multiplications that one takes the time of


def chebyshev_degree(position: FloatArray, sharpness: float) -> int:
    r"""Length of the Chebyshev series that gives the gate to double precision.

    The gate has its poles at the distance :math:`\pi / (2 \alpha)` from the real axis: on
    an interval of half-width h the series converges like :math:`\rho^{-m}` with
    :math:`\rho = y + \sqrt{1 + y^2}`, :math:`y = \pi / (2 \alpha h)` (Trefethen,
    Approximation Theory and Approximation Practice, ch. 8).

    Args:
        position: Limb positions q, shape (N, 3) [m].
        sharpness: Sharpness alpha of the gate [1/m].
    """
    half_width = 0.5 * float(np.ptp(position, axis=0).max())
    if half_width == 0.0:
        return 2
    ratio = math.pi / (2.0 * sharpness * half_width)
    rate = math.asinh(ratio)  # log(ratio + sqrt(1 + ratio^2))
    return min(3 + math.ceil(-math.log(_PRECISION) / rate), 10**6)


class GateSeries:
    """Statistics of samples from which the moments follow for any rest positions.

    Args:
        position: Limb positions q, shape (N, 3) [m].
        sharpness: Sharpness alpha of the gate [1/m].
        targets: Targets Y, shape (N, m).
    """

    def __init__(self, position: FloatArray, sharpness: float, targets: FloatArray) -> None:
        self._sharpness = sharpness
        self._length = chebyshev_degree(position, sharpness)
        low, high = position.min(axis=0), position.max(axis=0)
        self._middle, self._half_width = 0.5 * (low + high), 0.5 * (high - low)
        self._count = len(position)
        self._target_mean = targets.mean(axis=0)
        centred = targets - self._target_mean
        self._target_power = (centred**2).sum(axis=0)
        self._take_products(position, centred)

    def _take_products(self, position: FloatArray, targets: FloatArray) -> None:
        # Products about a row near the mean lose no digits when they are moved to the mean.
        pivot = self._basis(position.mean(axis=0, keepdims=True))[0]
        width = len(pivot)
        total, products = np.zeros(width), np.zeros((width, width))
        cross = np.zeros((width, targets.shape[1]))
        for start in range(0, len(position), _SERIES_BLOCK):
            rows = slice(start, start + _SERIES_BLOCK)
            basis = self._basis(position[rows]) - pivot
            total += basis.sum(axis=0)
            products += basis.T @ basis
            cross += basis.T @ targets[rows]
        products -= np.outer(total, total) / self._count
        self._basis_mean = (pivot + total / self._count).reshape(3, -1)
        self._products = products.reshape(3, width // 3, 3, width // 3)
        self._cross = cross.reshape(3, width // 3, -1)

    def _basis(self, position: FloatArray) -> FloatArray:
        """T_1, T_2, ... of each coordinate, without the constant, shape (N, 3 (length - 1))."""
        scale = np.where(self._half_width > 0.0, self._half_width, 1.0)
        basis = chebvander((position - self._middle) / scale, self._length - 1)[..., 1:]
        return basis.reshape(len(position), -1)

    def moments(self, rest_positions: FloatArray) -> Moments:
        """Moments at rest positions q_r, shape (n, 3) [m], ordered point by point."""
        points = len(rest_positions)
        series = self._series(rest_positions)
        mean = np.empty((points, 3))
        gram = np.empty((points, 3, points, 3))
        cross = np.empty((points, 3, len(self._target_mean)))
        for a in range(3):
            mean[:, a] = series[a, 0] + self._basis_mean[a] @ series[a, 1:]
            cross[:, a] = series[a, 1:].T @ self._cross[a]
            for b in range(a, 3):
                block = series[a, 1:].T @ self._products[a, :, b] @ series[b, 1:]
                gram[:, b, :, a], gram[:, a, :, b] = block.T, block
        return Moments(
            count=self._count,
            mean=mean.reshape(-1),
            gram=gram.reshape(3 * points, 3 * points),
            target_mean=self._target_mean,
            cross=cross.reshape(3 * points, -1),
            target_power=self._target_power,
        )

    def _series(self, rest_positions: FloatArray) -> FloatArray:
        """Coefficients of the gated displacements, shape (3, length, n) [m]."""
        nodes = chebpts1(self._length)
        positions = self._middle + self._half_width * nodes[:, None]
        values = gated_displacement(positions, rest_positions, self._sharpness)
        transform = 2.0 / self._length * chebvander(nodes, self._length - 1).T
        transform[0] *= 0.5
        series = transform @ values.reshape(self._length, -1)
        return series.reshape(self._length, -1, 3).transpose(2, 0, 1)


def series_is_cheaper(position: FloatArray, sharpness: float, points: int) -> bool:
    """Whether a new set of rest positions costs less by the series than by the samples.

    Args:
        position: Limb positions q, shape (N, 3) [m].
        sharpness: Sharpness alpha of the gate [1/m].
        points: Number n of points of interest.
    """
    length = chebyshev_degree(position, sharpness)
    by_series = 6 * points * length * (length + points)
    by_samples = len(position) * points * (9 * points // 2 + 3 * _EXPONENTIAL)
    return by_series < by_samples


Method = Literal["auto", "direct", "chebyshev"]

_BLOCK = 512  # rows; keeps the direct product within the cache at any N
_LARGEST_DEGREE = 400


def gate_moments(
    position: FloatArray,
    rest_positions: FloatArray,
    sharpness: float,
    targets: FloatArray,
    method: Method = "auto",
) -> Moments:
    """Moments of the gated displacements of all points of interest.

    Args:
        position: Limb positions q, shape (N, 3) [m].
        rest_positions: Rest positions q_r, shape (n, 3) [m].
        sharpness: Sharpness alpha of the gate [1/m].
        targets: Targets Y, shape (N, m).
        method: `direct` multiplies the displacements out; `chebyshev` goes through a
            series in each coordinate of q; `auto` takes the cheaper one.

    Returns:
        The moments, with p = 3n columns ordered point by point.
    """
    if method == "auto":
        degree = chebyshev_degree(position, sharpness)
        cheaper = degree <= min(len(rest_positions) // 2, len(position) // 2, _LARGEST_DEGREE)
        method = "chebyshev" if cheaper else "direct"
    if method == "chebyshev":
        return GateSeries(position, sharpness, targets).moments(rest_positions)
    return _direct_moments(position, rest_positions, sharpness, targets)


def _direct_moments(
    position: FloatArray, rest_positions: FloatArray, sharpness: float, targets: FloatArray
) -> Moments:
    columns = 3 * len(rest_positions)
    # The displacement at the mean position is close to the mean displacement: products
    # about it lose no digits when they are moved to the mean itself.
    middle = position.mean(axis=0, keepdims=True)
    pivot = gated_displacement(middle, rest_positions, sharpness).reshape(columns)
    target_mean = targets.mean(axis=0)
    total = np.zeros(columns)
    gram = np.zeros((columns, columns))
    cross = np.zeros((columns, targets.shape[1]))
    for start in range(0, len(position), _BLOCK):
        rows = slice(start, start + _BLOCK)
        block = gated_displacement(position[rows], rest_positions, sharpness)
        block = block.reshape(-1, columns)
        block -= pivot
        total += block.sum(axis=0)
        gram += block.T @ block
        cross += block.T @ (targets[rows] - target_mean)
    count = len(position)
    gram -= np.outer(total, total) / count
    power = ((targets - target_mean) ** 2).sum(axis=0)
    return Moments(count, pivot + total / count, gram, target_mean, cross, power)
