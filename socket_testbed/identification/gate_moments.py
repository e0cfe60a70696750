r"""First and second moments of the gated displacements: all that Stage 2 needs of the data.

With S the N x 3n matrix of the gated displacements and Y any targets, one pass gives the
means and the centred products :math:`S_c^T S_c` and :math:`S_c^T Y_c`. Nothing of size
6N x 3n is ever built: the wrench's quadratic term is :math:`(C^T W C) \circ (S^T S)`.
Centring before the product keeps the digits that a hold would lose afterwards.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.contact import gated_displacement
from socket_testbed.identification.gate_series import GateSeries, chebyshev_degree
from socket_testbed.identification.moments import Moments

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
