"""Errors of a model on the samples of its fit, from their moments alone."""

from __future__ import annotations

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.contact import wrench_map
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.moments import Moments
from socket_testbed.identification.objective import Objective
from socket_testbed.identification.stages import StageTwoMoments


def mean_square_residuals(moments: Moments, rows: FloatArray, with_offset: bool) -> FloatArray:
    """Mean squares of the residuals ``Y - S rows^T``, of each target.

    They are differences of larger sums: a residual counts as known to 1e-8 of the spread of
    its target.

    Args:
        moments: Moments of N rows of gated displacements S (N, p) and targets Y (N, m).
        rows: What each target is predicted by, shape (m, p) [unit of the target over m].
        with_offset: Whether each target has the constant offset that suits it best.

    Returns:
        Array of shape (m,), in squares of the targets' units.
    """
    explained = np.einsum("jp,jp->j", rows @ moments.gram, rows)
    common = np.einsum("jp,pj->j", rows, moments.cross)
    squares = (moments.target_power - 2.0 * common + explained) / moments.count
    squares = np.maximum(squares, 0.0)
    if not with_offset:
        squares += (moments.target_mean - rows @ moments.mean) ** 2
    return squares


def channel_mean_squares(
    objective: Objective,
    geometry: SocketGeometry,
    moments: StageTwoMoments,
    stiffness: FloatArray,
    with_bias: bool,
) -> tuple[FloatArray, FloatArray]:
    """Mean square errors of the channels over the samples of the objective.

    Args:
        objective: The samples; those of a channel left out are zeros.
        geometry: Geometry of the socket.
        moments: Moments of the data at the model's rest positions.
        stiffness: Stiffnesses, shape (n, 3) [N/m].
        with_bias: Whether the model has the offsets that suit it best.

    Returns:
        Those of the wrench, shape (6,) [(N m)^2, N^2], and of the clusters' channels in the
        objective, shape (m,) [N^2].
    """
    rows = wrench_map(geometry.anchors) * stiffness.reshape(-1)
    wrench = mean_square_residuals(moments.wrench, rows, with_bias)
    local = [
        mean_square_residuals(
            channel_moments, (channel.direction * stiffness[channel.point])[None], with_bias
        )
        for channel, channel_moments in zip(objective.channels, moments.channels, strict=True)
    ]
    return wrench, np.concatenate(local)
