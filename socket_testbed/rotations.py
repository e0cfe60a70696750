"""Rotations as matrices, quaternions (x, y, z, w) and rotation vectors, in numpy alone.

All functions take one rotation or any number of them, and NaN gives NaN. SciPy takes 10 to 20 us
per call, mostly to choose an array library, and a node converts some ten poses per trigger.
"""

from __future__ import annotations

import numpy as np

from socket_testbed.arrays import FloatArray

# The product q r of quaternions is bilinear: entry [a, b, c] is the share of q_a r_b in (q r)_c.
_PRODUCT = np.zeros((4, 4, 4))
for _own, _factors in enumerate(
    (
        ((0, 0, 0, -1), (0, 0, 1, 0), (0, -1, 0, 0), (1, 0, 0, 0)),  # x times x, y, z, w
        ((0, 0, -1, 0), (0, 0, 0, -1), (1, 0, 0, 0), (0, 1, 0, 0)),  # y
        ((0, 1, 0, 0), (-1, 0, 0, 0), (0, 0, 0, -1), (0, 0, 1, 0)),  # z
        ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)),  # w
    )
):
    _PRODUCT[_own] = _factors
_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])

# R v = q v q*: the share of q_a q_b in R_ij, rows 4 a + b, columns 3 i + j, shape (16, 9).
_TURN = np.einsum("ajc,cbi,b->abij", _PRODUCT[:, :3], _PRODUCT[..., :3], _CONJUGATE).reshape(16, 9)
_TURN = 0.5 * (_TURN + _TURN.reshape(4, 4, 9).swapaxes(0, 1).reshape(16, 9))


def _outer(first: FloatArray, second: FloatArray) -> FloatArray:
    """All products of the components of two quaternions, shape (..., 16)."""
    products = first[..., :, None] * second[..., None, :]
    return products.reshape(*products.shape[:-2], 16)


def compose(first: FloatArray, second: FloatArray) -> FloatArray:
    """Quaternions of one rotation after another, shape (..., 4) [-].

    Args:
        first: Quaternions of the outer rotations, shape (..., 4) [-].
        second: Quaternions of the rotations that are applied before them, shape (..., 4) [-].
    """
    return _outer(first, second) @ _PRODUCT.reshape(16, 4)


def inverted(quaternions: FloatArray) -> FloatArray:
    """Unit quaternions of the inverse rotations, shape (..., 4) [-]."""
    return quaternions * _CONJUGATE


def quaternions_to_matrices(quaternions: FloatArray) -> FloatArray:
    """Rotation matrices, shape (..., 3, 3) [-], of quaternions of any length, (..., 4) [-]."""
    products = _outer(quaternions, quaternions)
    squared = products[..., ::5].sum(axis=-1, keepdims=True)
    return (products / squared @ _TURN).reshape(*quaternions.shape[:-1], 3, 3)


def matrices_to_quaternions(matrices: FloatArray) -> FloatArray:
    """Unit quaternions, shape (..., 4) [-], of rotation matrices, shape (..., 3, 3) [-].

    The matrix fixes all products ``q_a q_b``; the row with the largest square gives q best.
    """
    shape = matrices.shape[:-2]
    products = matrices.reshape(*shape, 9) @ _TURN.T + np.eye(4).ravel()
    largest = products[..., ::5].argmax(axis=-1)
    rows = products.reshape(-1, 4)[4 * np.arange(largest.size) + largest.ravel()]
    return (rows / np.sqrt((rows**2).sum(axis=-1, keepdims=True))).reshape(*shape, 4)


def quaternions_to_vectors(quaternions: FloatArray) -> FloatArray:
    """Rotation vectors, at most half a turn, (..., 3) [rad], of quaternions, (..., 4) [-]."""
    axis, real = quaternions[..., :3], quaternions[..., 3:]
    sine = np.sqrt((axis**2).sum(axis=-1, keepdims=True))
    half = np.arctan2(sine, np.abs(real))
    # Without a turn, half / sine is 1 / |q|, which stays exact as long as the division does.
    scale = np.divide(half, sine, out=np.ones_like(sine), where=sine != 0.0)
    return np.where(real < 0.0, -2.0, 2.0) * scale * axis


def vectors_to_quaternions(vectors: FloatArray) -> FloatArray:
    """Unit quaternions, shape (..., 4) [-], of rotation vectors, shape (..., 3) [rad]."""
    half = 0.5 * np.sqrt((vectors**2).sum(axis=-1, keepdims=True))
    return np.concatenate([0.5 * np.sinc(half / np.pi) * vectors, np.cos(half)], axis=-1)
