r"""The two stages, each as a scaled quadratic program in bounds.

The objective of both stages is

.. math:: \theta J_w + (1 - \theta) J_f + \lambda J_s

with J_w and J_f the weighted squares of the wrench's and the clusters' errors, and J_s the mean
square difference between neighbouring tiles, divided by the expected difference. See
docs/identification.md. The setting `weights` names what weighs the channels:

- `size`: J_w and J_f are means over their channels of the mean square error, divided by the mean
  square of its group of channels (moments, forces, cluster forces): newton metres and newtons
  count alike;
- `noise`: every channel is weighed by 1 / (noise^2 + e^2) with its `channel_noise` and an error e
  for what no spring bed explains: `MODEL_ERROR` of the RMS force, for a moment at the root mean
  square distance of the tiles. A common factor of each group makes predicting zero cost 1, as
  with `size`;
- `raw`: sums of squares in N^2 and (N m)^2 as the paper prints them, with one common factor that
  makes predicting zero cost 2 in J_w + J_f, as with `size`.

Stage 1 finds the rest positions with linear springs of one stiffness. Stage 2 finds the
stiffnesses with the unilateral gate, and with constant offsets in the bias variant. The
offsets are free, so they drop out by centring and are recovered afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray, rms
from socket_testbed.errors import ConfigurationError, IdentificationError
from socket_testbed.files import closest
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.box_qp import BoxQP, BoxSolution
from socket_testbed.identification.contact import ContactModel, wrench_map
from socket_testbed.identification.moments import GatedMoments, Group, Method, Moments, stack
from socket_testbed.identification.noise import (
    ChannelNoise,
    channel_noise,
    smooth_poses,
    smoothing_gain,
)
from socket_testbed.identification.plausibility import (
    LEAST_FORCE,
    LEAST_MOMENT,
    MOST_OUTLIERS,
    find_outliers,
    outlier_notes,
    require_load,
    require_units,
    without_outliers,
)
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples
from socket_testbed.settings.identification import IdentificationSettings

MODEL_ERROR = 0.01  # [-]; of the RMS of the forces
MILLIMETRE = 1e-3  # [m]; scale of the rest positions in Stage 1
KILONEWTON_PER_METRE = 1e3  # [N/m]; scale of the stiffnesses in Stage 2

_GROUPS = (slice(0, 3), slice(3, 6))  # moments, forces
_JITTER = 1e-12  # [-]; keeps a factorisation of a flat problem defined
LEAST_SAMPLES = 12  # [1]; 3 s at the trigger's default rate


@dataclass(frozen=True)
class ClusterChannel:
    """One channel of a cluster's force that is in the objective.

    Attributes:
        cluster: Name of the cluster.
        point: Index of its point of interest.
        axis: Axis of the cluster's frame: 0, 1, 2.
        direction: That axis in {S}, shape (3,) [-].
        rows: Samples in which the channel was measured, shape (N,).
        force: The measured force in those samples [N].
        mean_position: Mean limb position in those samples, shape (3,) [m].
    """

    cluster: str
    point: int
    axis: int
    direction: FloatArray
    rows: BoolArray
    force: FloatArray
    mean_position: FloatArray


@dataclass(frozen=True)
class Objective:
    """The samples of a fit with the weight of each channel, on a socket, by its settings.

    Attributes:
        geometry: Geometry of the socket.
        settings: Settings of the identification.
        samples: The N samples that are used, without outliers, their poses averaged if asked.
        pose_noise: Covariance of the noise of a pose, shape (6, 6) [m^2, m rad, rad^2], to be
            subtracted from what the poses' products give; None for no correction.
        wrench: Measured wrenches, zero where a channel does not count, shape (N, 6)
            [N m, N].
        wrench_counts: Channels of the wrench that are in the objective, shape (6,).
        wrench_shares: Weight of each squared wrench error in J_w, zero where it does not
            count, shape (6,) [1/(N m)^2, 1/N^2].
        channels: Channels of the clusters in the objective.
        channel_shares: Weight of each channel's squared error in J_f, shape (m,) [1/N^2].
        laplacian: Matrix of J_s for one axis, shape (n, n) [-]: see `smoothness_matrix`.
    """

    geometry: SocketGeometry
    settings: IdentificationSettings
    samples: Samples
    pose_noise: FloatArray | None
    wrench: FloatArray
    wrench_counts: BoolArray
    wrench_shares: FloatArray
    channels: tuple[ClusterChannel, ...]
    channel_shares: FloatArray
    laplacian: FloatArray

    @property
    def position(self) -> FloatArray:
        """Limb positions q, shape (N, 3) [m]."""
        return self.samples.position

    @property
    def wrench_weights(self) -> FloatArray:
        """Weight of each squared wrench error, shape (6,) [1/(N m)^2, 1/N^2]."""
        return self.settings.theta * self.wrench_shares

    @property
    def channel_weights(self) -> FloatArray:
        """Weight of each cluster channel's squared error, shape (m,) [1/N^2]."""
        return (1.0 - self.settings.theta) * self.channel_shares

    @property
    def with_bias(self) -> bool:
        """Whether the model has offsets."""
        return self.settings.variant == "stiffness_bias"

    @property
    def reference(self) -> FloatArray:
        """Centre of the box of Stage 1: the mean limb position, shape (3,) [m]."""
        return self.position.mean(axis=0)

    def with_settings(self, **changes: Any) -> Objective:
        """The same samples with another theta, smoothness or variant."""
        return replace(self, settings=replace(self.settings, **changes))


def check_channels(leave_out: tuple[str, ...], names: tuple[str, ...]) -> None:
    """Check that every name is a channel.

    Raises:
        ConfigurationError: With the likely name.
    """
    for name in leave_out:
        if name not in names:
            raise ConfigurationError(f"leave_out: no channel '{name}'", closest(name, names))


def _usable_rows(samples: Samples, wrench_counts: BoolArray) -> BoolArray:
    """Samples with a limb position and every wrench channel that counts, shape (N,).

    Raises:
        IdentificationError: If fewer than `LEAST_SAMPLES` are left, naming what is missing.
    """
    position = np.isfinite(samples.position).all(axis=1)
    measured = np.isfinite(samples.wrench)
    dead = wrench_counts & ~measured.any(axis=0) & (len(samples) > 0)
    for channel in np.flatnonzero(dead).tolist():
        name = WRENCH_CHANNELS[channel]
        raise IdentificationError(
            f"{name} of the load cell has no value in any of the {len(samples)} samples",
            f"leave it out of the objective (--leave-out {name}) or check the load cell",
        )
    rows = np.asarray(position & (measured | ~wrench_counts).all(axis=1))
    if rows.sum() < LEAST_SAMPLES:
        raise IdentificationError(
            f"only {int(rows.sum())} of {len(samples)} samples have a limb position"
            f" ({int(position.sum())}) and a wrench, and a fit needs {LEAST_SAMPLES}",
            "check the markers and the load cell with 'info', or give another segment",
        )
    return rows


def _without_outliers(
    samples: Samples, geometry: SocketGeometry, leave_out: tuple[str, ...]
) -> Samples:
    outliers = find_outliers(samples, geometry, leave_out)
    count = int(outliers.rows.sum())
    if count > MOST_OUTLIERS * len(samples):
        raise IdentificationError(
            f"{count} of {len(samples)} samples are outliers:"
            f" {'; '.join(outlier_notes(samples, outliers))}",
            "check these channels, leave them out (--leave-out), or give another segment",
        )
    return without_outliers(samples, outliers)


def _pose_noise(samples: Samples, settings: IdentificationSettings) -> FloatArray:
    """Covariance of the noise of an averaged pose, shape (6, 6) [m^2, m rad, rad^2].

    Raises:
        IdentificationError: If the samples do not show the noise of the limb position.
    """
    covariance = channel_noise(samples).pose_covariance
    if not np.isfinite(covariance[:3, :3]).all():
        raise IdentificationError(
            f"the noise of the limb position is not known from {len(samples)} samples",
            "give a longer segment, or switch noise_correction off",
        )
    # A rotation that never changes has no noise to subtract.
    return np.nan_to_num(covariance) * smoothing_gain(samples, settings.pose_smoothing)


def build_objective(
    samples: Samples, geometry: SocketGeometry, settings: IdentificationSettings
) -> Objective:
    """Choose, check and normalise the channels of a fit.

    Args:
        samples: Samples; those without a wrench or a limb position are passed over, and so are
            outliers (see `plausibility`).
        geometry: Geometry of the socket.
        settings: Settings of the identification.

    Raises:
        ConfigurationError: For an unknown channel or cluster.
        IdentificationError: If there are too few samples, no value in a channel that counts, no
            load, many outliers, or sizes that no limb in a socket gives.
    """
    check_channels(settings.leave_out, samples.channels)
    counts = np.array([name not in settings.leave_out for name in samples.channels])
    wrench_counts, cluster_counts = counts[:6], counts[6:].reshape(-1, 3)
    _usable_rows(samples, wrench_counts)
    require_units(samples, geometry, settings.leave_out)
    samples = _without_outliers(samples, geometry, settings.leave_out)
    noise = channel_noise(samples) if settings.weights == "noise" else None
    pose_noise = _pose_noise(samples, settings) if settings.noise_correction else None
    samples = smooth_poses(samples, settings.pose_smoothing)
    samples = samples[_usable_rows(samples, wrench_counts)]
    require_load(samples, wrench_counts)
    wrench = np.where(wrench_counts, samples.wrench, 0.0)
    channels = _cluster_channels(samples, geometry, cluster_counts)
    if not wrench_counts.any() and not channels:
        raise IdentificationError("every channel is left out", "leave fewer channels out")

    wrench_shares, channel_shares = _shares(
        samples, geometry, settings.weights, wrench_counts, channels, noise
    )
    return Objective(
        geometry=geometry,
        settings=settings,
        samples=samples,
        pose_noise=pose_noise,
        wrench=wrench,
        wrench_counts=wrench_counts,
        wrench_shares=wrench_shares,
        channels=channels,
        channel_shares=channel_shares,
        laplacian=smoothness_matrix(len(geometry), geometry.neighbours),
    )


def _cluster_channels(
    samples: Samples, geometry: SocketGeometry, counts: BoolArray
) -> tuple[ClusterChannel, ...]:
    channels = []
    for column, cluster in enumerate(samples.clusters):
        if cluster not in geometry.clusters:
            raise ConfigurationError(
                f"cluster '{cluster}' of the samples is on no tile of the socket",
                closest(cluster, geometry.clusters),
            )
        point = geometry.clusters[cluster]
        for axis in np.flatnonzero(counts[column]).tolist():
            force = samples.trusted_forces[:, column, axis]
            rows = np.isfinite(force)
            if rows.sum() < 2:
                names = [f"{cluster}.{LOCAL_CHANNELS[a]}" for a in np.flatnonzero(counts[column])]
                raise IdentificationError(
                    f"{cluster}.{LOCAL_CHANNELS[axis]} has no usable value in any of the"
                    f" {len(samples)} samples",
                    f"check the cluster or leave it out (--leave-out {' '.join(names)})",
                )
            direction = geometry.rotations[point][:, axis]
            mean = samples.position[rows].mean(axis=0)
            channels.append(
                ClusterChannel(cluster, point, axis, direction, rows, force[rows], mean)
            )
    return tuple(channels)


def smoothness_matrix(points: int, neighbours: IntArray) -> FloatArray:
    r"""Matrix of J_s for one axis, :math:`D^T D / e` with D the differences of neighbours.

    Args:
        points: Number n of points of interest.
        neighbours: Pairs of neighbours, shape (e, 2).

    Returns:
        Array of shape (n, n) [-].
    """
    D = np.eye(points)[neighbours[:, 0]] - np.eye(points)[neighbours[:, 1]]
    return D.T @ D / max(len(neighbours), 1)


def _shares(
    samples: Samples,
    geometry: SocketGeometry,
    weights: str,
    wrench_counts: BoolArray,
    channels: tuple[ClusterChannel, ...],
    noise: ChannelNoise | None,
) -> tuple[FloatArray, FloatArray]:
    """Weights of the channels' squared errors: see this module.

    Args:
        samples: Samples of the fit.
        geometry: Geometry of the socket.
        weights: What weighs the channels.
        wrench_counts: Channels of the wrench that are in the objective, shape (6,).
        channels: The m channels of the clusters in the objective.
        noise: Noise of every channel, for the weights `noise`.

    Returns:
        Those of the wrench, shape (6,) [1/(N m)^2, 1/N^2], and of the clusters, shape (m,) [1/N^2].
    """
    least = np.repeat([LEAST_MOMENT, LEAST_FORCE], 3)
    power = np.where(wrench_counts, (samples.wrench**2).mean(axis=0), 0.0)
    local_power = np.array([np.mean(channel.force**2) for channel in channels])
    if weights == "raw":
        factor = 2.0 / max(power.sum() + local_power.sum(), LEAST_FORCE**2)
        return factor * wrench_counts, np.full(len(channels), factor)

    # The mean square of each channel's group, which is at least that of the smallest group.
    moment, force = (
        max(power[g].sum() / max(wrench_counts[g].sum(), 1), least[g][0] ** 2) for g in _GROUPS
    )
    local = max(rms(np.concatenate([c.force for c in channels] or [np.zeros(1)])), LEAST_FORCE)
    if noise is None:
        shares = wrench_counts / np.repeat([moment, force], 3)
        local_shares = np.full(len(channels), 1.0 / local**2)
        return shares / max(wrench_counts.sum(), 1), local_shares / max(len(channels), 1)

    lever = rms(np.linalg.norm(geometry.anchors, axis=1))
    model_error = MODEL_ERROR**2 * force * np.repeat([lever**2, 1.0], 3)
    shares = wrench_counts / (np.nan_to_num(noise.wrench) ** 2 + model_error)
    places = [(samples.clusters.index(c.cluster), c.axis) for c in channels]
    deviations = np.array([noise.local_forces[place] for place in places])
    local_shares = 1.0 / (np.nan_to_num(deviations) ** 2 + (MODEL_ERROR * local) ** 2)
    zero = max(shares @ power, shares @ least**2, _JITTER)
    local_zero = max(local_shares @ local_power, local_shares.sum() * LEAST_FORCE**2, _JITTER)
    return shares / zero, local_shares / local_zero


@dataclass(frozen=True)
class StageTwoMoments:
    """What Stage 2 needs of the data at given rest positions, for any weights.

    Attributes:
        wrench: Moments of the gated displacements of all points and the wrench.
        channels: For each channel of the clusters, stacked, moments of the gated displacement of
            its point, p = 3, and the measured force, m = 1.
    """

    wrench: Moments
    channels: Moments


class StageTwoData:
    """The samples of an objective, from which the moments follow at any rest positions.

    A channel of a cluster without gaps was measured in the same samples as the wrench: both
    come from one product.

    Args:
        objective: The samples.
        sets: How many sets of rest positions are expected.
        method: See `GatedMoments`.
    """

    def __init__(self, objective: Objective, sets: int = 1, method: Method = "auto") -> None:
        complete = np.ones(len(objective.position), dtype=bool)
        every_point = list(range(len(objective.geometry)))
        gathered = [(complete, [*objective.wrench.T], every_point)]
        numbers = {complete.tobytes(): 0}
        self._places: list[tuple[int, int, int]] = []  # of each channel: group, point, target
        for channel in objective.channels:
            number = numbers.setdefault(channel.rows.tobytes(), len(gathered))
            if number == len(gathered):
                gathered.append((channel.rows, [], []))
            _, targets, points = gathered[number]
            if channel.point not in points:
                points.append(channel.point)
            self._places.append((number, points.index(channel.point), len(targets)))
            targets.append(channel.force)
        groups = [
            Group(rows, np.stack(targets, axis=1), points) for rows, targets, points in gathered
        ]
        sharpness = objective.settings.gate_sharpness
        noise = None if objective.pose_noise is None else objective.pose_noise[:3, :3]
        self._moments = GatedMoments(objective.position, sharpness, groups, sets, method, noise)

    def moments(self, rest_positions: FloatArray) -> StageTwoMoments:
        """Moments at rest positions q_r, shape (n, 3) [m]."""
        groups = self._moments.at(rest_positions)
        channels = [
            groups[number].select(slice(3 * point, 3 * point + 3), slice(target, target + 1))
            for number, point, target in self._places
        ]
        return StageTwoMoments(groups[0].select(slice(None), slice(6)), stack(channels))


@dataclass(frozen=True)
class StageTwo:
    """Stage 2 as it is solved, with what explains it.

    Attributes:
        program: The program in the stiffnesses [kN/m], shape (3n,).
        smoothness: Part of the program's P that is the smoothness, of one axis, shape (n, n) [-].
    """

    program: BoxQP
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
        data = P - np.kron(self.smoothness, np.eye(3))[np.ix_(free, free)]
        return float(np.trace(np.linalg.solve(P + _JITTER * np.eye(len(free)), data)))


@dataclass(frozen=True)
class Solution:
    """A model with the certificates of the programs that it solves.

    Attributes:
        model: The contact model.
        determined: Effective number of stiffness directions that the data determine, of 3n [-].
        stage_one: Certified solution of Stage 1.
        stage_two: Certified solution of Stage 2.
        joint: Certified solution of the joint refinement of a `rigid` variant, the
            Karush-Kuhn-Tucker residuals of the objective at the model; None of another.
    """

    model: ContactModel
    determined: float
    stage_one: BoxSolution
    stage_two: BoxSolution
    joint: BoxSolution | None = None


def build_stage_one(objective: Objective) -> BoxQP:
    r"""Stage 1: rest positions for linear springs :math:`F_i = k_0 (q - q_{r,i})`.

    The residual of the wrench is :math:`A q_r - (w_0 - w)` with :math:`A = k_0 C` and
    :math:`w_0 = k_0 C (1 \otimes q)`; only the means of the samples enter. The paper prints
    this residual with the opposite sign of w.

    Returns:
        The program in the offsets ``q_r - q_ref`` [mm] from the mean limb position, shape
        (3n,): see `rest_positions_of`.
    """
    return stage_one_program(objective, *stage_one_terms(objective))


def stage_one_program(objective: Objective, P: FloatArray, q: FloatArray) -> BoxQP:
    """Stage 1 with its terms P, shape (3n, 3n), and q, shape (3n,), which are scaled in place."""
    limit = np.full(len(q), objective.settings.rest_position_limit / MILLIMETRE)
    return _normalised(P, q, -limit, limit, "Stage 1 (rest positions)")


def stage_one_terms(objective: Objective) -> tuple[FloatArray, FloatArray]:
    """Terms P and q of `build_stage_one` before they are normalised: linear in theta."""
    settings, reference = objective.settings, objective.reference
    points = len(objective.geometry)
    k0, scale = settings.initial_stiffness, MILLIMETRE
    mapping = wrench_map(objective.geometry.anchors)

    # Errors as functions of the offsets u [mm]: e = target - (k0 scale) row u.
    weighted = objective.wrench_weights[:, None] * mapping
    at_reference = k0 * mapping @ np.tile(objective.position.mean(axis=0) - reference, points)
    target = at_reference - objective.wrench.mean(axis=0)
    P = (k0 * scale) ** 2 * (mapping.T @ weighted)
    q = -(k0 * scale) * (weighted.T @ target)
    for channel, channel_weight in zip(objective.channels, objective.channel_weights, strict=True):
        offset = channel.mean_position - reference
        local_target = k0 * channel.direction @ offset - channel.force.mean()
        block = slice(3 * channel.point, 3 * channel.point + 3)
        weight = channel_weight * k0 * scale
        outer = np.outer(channel.direction, channel.direction)
        P[block, block] += weight * k0 * scale * outer
        q[block] -= weight * local_target * channel.direction
    _add_smoothness(P, objective, settings.rest_position_difference / scale)
    return P, q


def rest_positions_of(objective: Objective, x: FloatArray) -> FloatArray:
    """Rest positions q_r that a solution of Stage 1 stands for, shape (n, 3) [m]."""
    return objective.reference + MILLIMETRE * x.reshape(-1, 3)


def build_stage_two(objective: Objective, moments: StageTwoMoments) -> StageTwo:
    r"""Stage 2: stiffnesses :math:`k \ge 0` of the gated springs, with or without offsets.

    With :math:`A_w[k] = C\,\mathrm{diag}(s[k])` the quadratic term of the wrench is
    :math:`(C^T W C) \circ (S^T S)`, that of a channel along d at point i is
    :math:`(d d^T) \circ (S_i^T S_i)`. Offsets drop out where S is centred.

    Args:
        objective: The weights.
        moments: Moments of the data at the rest positions.
    """
    with_bias, scale = objective.with_bias, KILONEWTON_PER_METRE
    mapping = wrench_map(objective.geometry.anchors)
    weighted = objective.wrench_weights[:, None] * mapping

    used, local = moments.wrench, moments.channels
    if not with_bias:
        used, local = used.about_zero(), local.about_zero()
    P = mapping.T @ (scale**2 / used.count * weighted)
    P *= used.corrected_gram
    q = -scale / used.count * np.einsum("jc,cj->j", used.cross, weighted)
    along = scale * np.array([c.direction for c in objective.channels]).reshape(-1, 3, 1)
    weights = (objective.channel_weights / local.count)[:, None, None]
    blocks = weights * along * along.swapaxes(1, 2) * local.corrected_gram
    pulls = weights * along * local.cross
    for channel, block, pull in zip(objective.channels, blocks, pulls, strict=True):
        own = slice(3 * channel.point, 3 * channel.point + 3)
        P[own, own] += block
        q[own] -= pull[:, 0]
    smoothness = _add_smoothness(P, objective, objective.settings.stiffness_difference / scale)
    lower, upper = np.zeros(len(q)), np.full(len(q), np.inf)
    factor = _normalisation(P)
    program = _normalised(P, q, lower, upper, "Stage 2 (stiffnesses)")
    return StageTwo(program, factor * smoothness)


def recover_offsets(
    objective: Objective, moments: StageTwoMoments, stiffness: FloatArray
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Offsets that are optimal for given stiffnesses: the mean residuals.

    Returns:
        Offset of the wrench, shape (6,) [N m, N], and of each cluster in its frame, shape
        (3,) [N]; zero for a channel left out and without the bias variant.
    """
    wrench_bias = np.zeros(6)
    force_bias: dict[str, FloatArray] = {}
    if not objective.with_bias:
        return wrench_bias, force_bias
    wrench = moments.wrench
    springs = stiffness.reshape(-1) * wrench.mean
    residual = wrench.target_mean - wrench_map(objective.geometry.anchors) @ springs
    wrench_bias[objective.wrench_counts] = residual[objective.wrench_counts]
    local = moments.channels
    for channel, mean, target in zip(
        objective.channels, local.mean, local.target_mean[:, 0].tolist(), strict=True
    ):
        bias = force_bias.setdefault(channel.cluster, np.zeros(3))
        bias[channel.axis] = target - (mean * stiffness[channel.point]) @ channel.direction
    return wrench_bias, force_bias


def _add_smoothness(P: FloatArray, objective: Objective, difference: float) -> FloatArray:
    """Add the smoothness, for an expected difference, to a term of shape (3n, 3n).

    Returns:
        What was added for each axis, shape (n, n).
    """
    weight = objective.settings.smoothness / (3.0 * difference**2)  # the mean over the axes
    own = weight * objective.laplacian
    by_axis = P.reshape(len(own), 3, len(own), 3)
    for axis in range(3):
        by_axis[:, axis, :, axis] += own
    return own


def _normalised(
    P: FloatArray, q: FloatArray, lower: FloatArray, upper: FloatArray, name: str
) -> BoxQP:
    """A program of terms that are scaled in place."""
    factor = _normalisation(P)
    P *= factor
    q *= factor
    return BoxQP(P, q, lower, upper, name)


def _normalisation(P: FloatArray) -> float:
    """Factor that makes the mean curvature 1, so that KKT residuals mean the same anywhere."""
    curvature = float(np.trace(P)) / len(P)
    return 1.0 / curvature if curvature > 0.0 else 1.0
