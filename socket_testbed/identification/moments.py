r"""First and second moments of the gated displacements: all that Stage 2 needs of the data.

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

from socket_testbed.arrays import FloatArray
from socket_testbed.contact import gated_displacement

Method = Literal["auto", "direct", "chebyshev"]

_BLOCK = 512  # rows; keeps the direct product within the cache at any N
_PRECISION = 1e-14  # [-]; of the Chebyshev series
_LARGEST_DEGREE = 400


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
    degree = chebyshev_degree(position, sharpness)
    if method == "auto":
        cheaper = degree <= min(len(rest_positions) // 2, len(position) // 2, _LARGEST_DEGREE)
        method = "chebyshev" if cheaper else "direct"
    if method == "chebyshev":
        return _chebyshev_moments(position, rest_positions, sharpness, targets, degree)
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


def _chebyshev_moments(
    position: FloatArray,
    rest_positions: FloatArray,
    sharpness: float,
    targets: FloatArray,
    length: int,
) -> Moments:
    points = len(rest_positions)
    low, high = position.min(axis=0), position.max(axis=0)
    middle, half_width = 0.5 * (low + high), 0.5 * (high - low)
    scaled = (position - middle) / np.where(half_width > 0.0, half_width, 1.0)

    basis = _chebyshev_basis(scaled, length)  # (3, length - 1, N), without the constant
    basis_mean = basis.mean(axis=2)
    basis -= basis_mean[:, :, None]
    flat = basis.reshape(-1, len(position))
    target_mean = targets.mean(axis=0)
    centred = targets - target_mean
    products = (flat @ flat.T).reshape(3, length - 1, 3, length - 1)
    target_products = (flat @ centred).reshape(3, length - 1, -1)

    angles = np.pi * (np.arange(length) + 0.5) / length
    nodes = middle + half_width * np.cos(angles)[:, None]
    values = gated_displacement(nodes, rest_positions, sharpness)  # (length, n, 3)
    transform = 2.0 / length * np.cos(np.outer(np.arange(length), angles))
    transform[0] *= 0.5
    series = np.einsum("kp,pna->akn", transform, values, optimize=True)

    mean = np.empty((points, 3))
    gram = np.empty((points, 3, points, 3))
    cross = np.empty((points, 3, targets.shape[1]))
    for a in range(3):
        mean[:, a] = series[a, 0] + basis_mean[a] @ series[a, 1:]
        cross[:, a] = series[a, 1:].T @ target_products[a]
        for b in range(3):
            gram[:, a, :, b] = series[a, 1:].T @ products[a, :, b] @ series[b, 1:]
    columns = 3 * points
    return Moments(
        len(position),
        mean.reshape(columns),
        gram.reshape(columns, columns),
        target_mean,
        cross.reshape(columns, -1),
        (centred**2).sum(axis=0),
    )


def _chebyshev_basis(scaled: FloatArray, length: int) -> FloatArray:
    """Polynomials T_1 .. T_(length - 1) of coordinates in [-1, 1], shape (3, length - 1, N)."""
    basis = np.empty((length, *scaled.T.shape))
    basis[0] = 1.0
    basis[1] = scaled.T
    for k in range(2, length):
        basis[k] = 2.0 * scaled.T * basis[k - 1] - basis[k - 2]
    return np.ascontiguousarray(basis[1:].swapaxes(0, 1))
