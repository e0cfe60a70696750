r"""The two stages of the identification, each as a scaled quadratic program with bounds.

Stage 1 finds the rest positions with linear springs of one stiffness; Stage 2 the
stiffnesses with the unilateral gate, and with constant offsets in the bias variant. The
offsets are free, so they drop out by centring and are recovered afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.contact import gated_displacement, wrench_map
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.box_qp import BoxQP
from socket_testbed.identification.gate_moments import gate_moments
from socket_testbed.identification.moments import Moments
from socket_testbed.identification.objective import Objective, smoothness_matrix
from socket_testbed.settings import IdentificationSettings

_JITTER = 1e-12  # [-]; keeps a factorisation of a flat problem defined

MILLIMETRE = 1e-3  # [m]; scale of the rest positions in Stage 1
KILONEWTON_PER_METRE = 1e3  # [N/m]; scale of the stiffnesses in Stage 2


@dataclass(frozen=True)
class StageTwoMoments:
    """What Stage 2 needs of the data at given rest positions, whatever the weights.

    Attributes:
        wrench: Moments of the gated displacements of all points and the wrench.
        channels: For each channel of the clusters, moments of the gated displacement of its
            point, p = 3, and the measured force, m = 1.
    """

    wrench: Moments
    channels: tuple[Moments, ...]


@dataclass(frozen=True)
class StageTwo:
    """Stage 2 as it is solved, with what explains it.

    Attributes:
        program: The program in the stiffnesses [kN/m], shape (3n,).
        moments: What it was made of.
        smoothness: Part of the program's P that is the smoothness, shape (3n, 3n) [-].
    """

    program: BoxQP
    moments: StageTwoMoments
    smoothness: FloatArray

    def determined_directions(self, x: FloatArray) -> float:
        r"""Effective number of parameters that the data determine, of 3n [-].

        :math:`\mathrm{tr}(P^{-1} P_{data})` over the stiffnesses off their bound (Hastie,
        Tibshirani & Friedman, The Elements of Statistical Learning, 7.6).
        """
        free = np.flatnonzero(x > 0.0)
        if len(free) == 0:
            return 0.0
        P = self.program.P[np.ix_(free, free)]
        data = P - self.smoothness[np.ix_(free, free)]
        return float(np.trace(np.linalg.solve(P + _JITTER * np.eye(len(free)), data)))


def stage_one_reference(objective: Objective) -> FloatArray:
    """Reference q_ref of the box of Stage 1: the mean limb position, shape (3,) [m]."""
    return objective.position.mean(axis=0)


def build_stage_one(
    objective: Objective, geometry: SocketGeometry, settings: IdentificationSettings
) -> BoxQP:
    r"""Stage 1: rest positions for linear springs :math:`F_i = k_0 (q - q_{r,i})`.

    The residual of the wrench is :math:`A q_r - (w_0 - w)` with :math:`A = k_0 C` and
    :math:`w_0 = k_0 C (1 \otimes q)`; only the means of the samples enter. The paper prints
    this residual with the sign of w mirrored.

    Returns:
        The program in the offsets ``q_r - q_ref`` [mm], shape (3n,).
    """
    points = len(geometry)
    k0, scale = settings.initial_stiffness, MILLIMETRE
    reference = stage_one_reference(objective)
    mapping = wrench_map(geometry.anchors)

    # Errors as functions of the offsets u [mm]: e = target - (k0 scale) row u.
    weighted = objective.wrench_weights[:, None] * mapping
    at_reference = k0 * mapping @ np.tile(objective.position.mean(axis=0) - reference, points)
    target = at_reference - objective.wrench.mean(axis=0)
    P = (k0 * scale) ** 2 * (mapping.T @ weighted)
    q = -(k0 * scale) * (weighted.T @ target)
    for channel in objective.channels:
        offset = channel.mean_position - reference
        local_target = k0 * channel.direction @ offset - channel.force.mean()
        block = slice(3 * channel.point, 3 * channel.point + 3)
        weight = objective.channel_weight * k0 * scale
        outer = np.outer(channel.direction, channel.direction)
        P[block, block] += weight * k0 * scale * outer
        q[block] -= weight * local_target * channel.direction
    smoothness = _smoothness(objective, geometry, settings.rest_position_difference / scale)
    P += smoothness
    limit = np.full(3 * points, settings.rest_position_limit / scale)
    factor = _normalisation(P)
    return BoxQP(factor * P, factor * q, -limit, limit, "Stage 1 (rest positions)")


def stage_two_moments(
    objective: Objective, settings: IdentificationSettings, rest_positions: FloatArray
) -> StageTwoMoments:
    """Take the moments of the data, in one pass over the samples.

    Args:
        objective: The samples.
        settings: Settings of the identification.
        rest_positions: Rest positions q_r, shape (n, 3) [m].
    """
    sharpness = settings.gate_sharpness
    wrench = gate_moments(objective.position, rest_positions, sharpness, objective.wrench)
    points = sorted({channel.point for channel in objective.channels})
    on_tiles = gated_displacement(objective.position, rest_positions[points], sharpness)
    channels = tuple(
        _moments_of(on_tiles[channel.rows, points.index(channel.point)], channel.force)
        for channel in objective.channels
    )
    return StageTwoMoments(wrench, channels)


def build_stage_two(
    objective: Objective,
    geometry: SocketGeometry,
    settings: IdentificationSettings,
    rest_positions: FloatArray,
) -> StageTwo:
    """Stage 2 at given rest positions q_r, shape (n, 3) [m]: see `assemble_stage_two`."""
    moments = stage_two_moments(objective, settings, rest_positions)
    return assemble_stage_two(objective, geometry, settings, moments)


def assemble_stage_two(
    objective: Objective,
    geometry: SocketGeometry,
    settings: IdentificationSettings,
    moments: StageTwoMoments,
) -> StageTwo:
    r"""Stage 2: stiffnesses :math:`k \ge 0` of the gated springs, with or without offsets.

    With :math:`A_w[k] = C\,\mathrm{diag}(s[k])` the quadratic term of the wrench is
    :math:`(C^T W C) \circ (S^T S)`, that of a channel along d at point i is
    :math:`(d d^T) \circ (S_i^T S_i)`. Offsets drop out where S is centred.

    Args:
        objective: The weights.
        geometry: Geometry of the socket.
        settings: Settings of the identification.
        moments: Moments of the data at the rest positions.
    """
    with_bias = settings.variant == "stiffness_bias"
    scale = KILONEWTON_PER_METRE
    mapping = wrench_map(geometry.anchors)
    weighted = objective.wrench_weights[:, None] * mapping

    used = moments.wrench if with_bias else moments.wrench.about_zero()
    P = (mapping.T @ weighted) * used.gram
    P *= scale**2 / used.count
    q = -scale / used.count * np.einsum("jc,cj->j", used.cross, weighted)
    for channel, centred in zip(objective.channels, moments.channels, strict=True):
        used = centred if with_bias else centred.about_zero()
        along = scale * channel.direction
        weight = objective.channel_weight / used.count
        block = slice(3 * channel.point, 3 * channel.point + 3)
        P[block, block] += weight * np.outer(along, along) * used.gram
        q[block] -= weight * along * used.cross[:, 0]
    smoothness = _smoothness(objective, geometry, settings.stiffness_difference / scale)
    lower, upper = np.zeros(len(q)), np.full(len(q), np.inf)
    P += smoothness
    factor = _normalisation(P)
    program = BoxQP(factor * P, factor * q, lower, upper, "Stage 2 (stiffnesses)")
    return StageTwo(program, moments, factor * smoothness)


def recover_offsets(
    objective: Objective,
    geometry: SocketGeometry,
    settings: IdentificationSettings,
    stage: StageTwo,
    stiffness: FloatArray,
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Offsets that are optimal for given stiffnesses: the mean residuals.

    Returns:
        Offset of the wrench, shape (6,) [N m, N], and of each cluster in its frame, shape
        (3,) [N]; zero for a channel left out and without the bias variant.
    """
    wrench_bias = np.zeros(6)
    force_bias: dict[str, FloatArray] = {}
    if settings.variant != "stiffness_bias":
        return wrench_bias, force_bias
    wrench = stage.moments.wrench
    springs = stiffness.reshape(-1) * wrench.mean
    residual = wrench.target_mean - wrench_map(geometry.anchors) @ springs
    wrench_bias[objective.wrench_counts] = residual[objective.wrench_counts]
    for channel, means in zip(objective.channels, stage.moments.channels, strict=True):
        bias = force_bias.setdefault(channel.cluster, np.zeros(3))
        predicted = (means.mean * stiffness[channel.point]) @ channel.direction
        bias[channel.axis] = means.target_mean[0] - predicted
    return wrench_bias, force_bias


def _moments_of(s: FloatArray, force: FloatArray) -> Moments:
    """Moments of gated displacements of one point, shape (N, 3), and a force, shape (N,)."""
    mean, target_mean = s.mean(axis=0), force.mean()
    s, force = s - mean, force - target_mean
    return Moments(
        count=len(s),
        mean=mean,
        gram=s.T @ s,
        target_mean=np.array([target_mean]),
        cross=(s.T @ force)[:, None],
        target_power=np.array([force @ force]),
    )


def _smoothness(objective: Objective, geometry: SocketGeometry, difference: float) -> FloatArray:
    """Quadratic term of the smoothness, shape (3n, 3n), for an expected difference."""
    weight = objective.smoothness / (3.0 * difference**2)  # the mean over the three axes
    points = len(geometry)
    laplacian = weight * smoothness_matrix(points, geometry.neighbours)
    P = np.zeros((points, 3, points, 3))
    for axis in range(3):
        P[:, axis, :, axis] = laplacian
    return P.reshape(3 * points, 3 * points)


def _normalisation(P: FloatArray) -> float:
    """Factor that makes the mean curvature 1, so that KKT residuals mean the same anywhere."""
    curvature = float(np.trace(P)) / len(P)
    return 1.0 / curvature if curvature > 0.0 else 1.0
