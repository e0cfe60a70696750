r"""The objective of a fit: weighted channels, and programs in a law's parameters.

With the scaled parameters x of a contact law (stiffnesses, rest displacements), six per tile, the
objective is

.. math:: \theta J_w + (1 - \theta) J_f + (x - x_0)^T Q (x - x_0)

with J_w and J_f, the weighted squared errors of the wrench and the clusters, and the prior of the
law (`contact.Sizes`). The setting `weights` selects the weighting of the channels:

- `size`: J_w and J_f are means over their channels of the mean square error, divided by the mean
  square of the group of channels (moments, forces, cluster forces), so that newton metres and
  newtons have equal weight;
- `noise`: each channel has the weight 1 / (noise^2 + e^2) with its `channel_noise` and a model
  error e that no spring bed explains: `MODEL_ERROR` of the RMS force, for a moment at the root mean
  square distance of the tiles. A common factor per group makes the cost of predicting zero 1, as
  with `size`;
- `raw`: sums of squares in N^2 and (N m)^2 as printed in the paper, with one common factor that
  makes the cost of predicting zero 2 in J_w + J_f, as with `size`.

Forces are linear in the stiffnesses, so

- Stage 1, with linear springs of the expected stiffnesses, is a quadratic program in the rest
  displacements that depends on the samples' means only;
- Stage 2, at these rest displacements, is one in the stiffnesses. With S the N x 3n matrix of the
  columns, the wrench's quadratic term is :math:`(C^T W C) \circ (S^T S)`, with C the map of the
  forces onto the wrench, so no array of size 6N x 3n is needed. Offsets are free constants; they
  drop out by centring and are recovered from the residuals;
- some laws then refine both jointly (`ContactLaw.REFINED`).
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from socket_testbed.arrays import BoolArray, FloatArray, IntArray, rms
from socket_testbed.errors import IdentificationError
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import plausibility
from socket_testbed.identification.contact import ContactModel, Loading, law_of
from socket_testbed.identification.noise import ChannelNoise, channel_noise, smooth_poses
from socket_testbed.identification.solver import BoxQP
from socket_testbed.samples import WRENCH_CHANNELS, Samples, local_channels, refuse_unknown_channels
from socket_testbed.settings.identification import BIAS_VARIANTS, IdentificationSettings

MODEL_ERROR = 0.01  # [-]; of the RMS of the forces
MIN_SAMPLES = 12  # [1]; 3 s at the trigger's default rate
_BLOCK = 512  # samples; keeps products within the cache for any N
_JITTER = 1e-12  # [-]; regularises flat problems


@dataclass(frozen=True)
class ClusterChannel:
    """One channel of a cluster's force in the objective.

    Attributes:
        cluster: Name of the cluster.
        point: Index of the tile under the cluster.
        axis: Axis of the frame {L} of the cluster's tile: 0, 1 or 2.
        direction: Unit vector along that axis, shape (3,) [-], in {S}; in a `Problem` in the frame
            of its law.
        measured: Measured force along it, shape (N,) [N]; NaN if missing or not trusted. In
            a `Problem` the rows are means over blocks of samples.
        weight: Weight of its mean square error in a `Problem` [1/N^2]; 0 outside of one.
    """

    cluster: str
    point: int
    axis: int
    direction: FloatArray
    measured: FloatArray
    weight: float = 0.0

    @cached_property
    def rows(self) -> BoolArray:
        """Rows in which the channel was measured, shape (N,)."""
        return np.isfinite(self.measured)

    @cached_property
    def force(self) -> FloatArray:
        """The measured force without missing values, one for each of the `rows` [N]."""
        return self.measured[self.rows]


@dataclass(frozen=True)
class Objective:
    """The samples of a fit with the weight of each channel.

    Attributes:
        geometry: The socket.
        settings: Settings of the fit.
        samples: The N samples in use, without outliers, all with a pose and with the wrench's
            channels in the objective; poses are averaged as the settings say.
        wrench: Measured wrenches [M; F] in {S}, shape (N, 6) [N m, N]; 0 for channels that are not
            in the objective.
        wrench_counts: Channels of the wrench in the objective, shape (6,).
        wrench_shares: Weights of the squared errors of the wrench in J_w, shape (6,)
            [1/(N m)^2, 1/N^2]; 0 for channels that are not in the objective.
        channels: The m channels of the clusters in the objective.
        channel_shares: Weights of their squared errors in J_f, shape (m,) [1/N^2].
    """

    geometry: SocketGeometry
    settings: IdentificationSettings
    samples: Samples
    wrench: FloatArray
    wrench_counts: BoolArray
    wrench_shares: FloatArray
    channels: tuple[ClusterChannel, ...]
    channel_shares: FloatArray

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels in the objective, the wrench's first."""
        left_out = self.settings.leave_out
        return tuple(name for name in self.samples.channels if name not in left_out)

    def with_settings(self, **changes: Any) -> Objective:
        """The objective with another theta, smoothness or variant.

        Weights, channels and samples stay: settings from which they follow must not change.
        """
        return replace(self, settings=replace(self.settings, **changes))

    def part(self, rows: IntArray) -> Objective:
        """The objective on the samples of some indices, shape (k,), with its weights."""
        channels = tuple(replace(c, measured=c.measured[rows]) for c in self.channels)
        samples, wrench = self.samples[rows], self.wrench[rows]
        return replace(self, samples=samples, wrench=wrench, channels=channels)


def check_parts(samples: Samples, who: str, wrench: bool = False) -> None:
    """Check that a trial, or a part of one, has limb positions, and the wrench if a task needs it.

    Args:
        samples: The samples of the trial or part.
        who: The task in a sentence, such as `a fit`.
        wrench: Whether it needs the wrench.

    Raises:
        IdentificationError: If none of the samples has one of these.
    """
    parts = {
        "limb position": (not samples.has_pose.any(), "the poses of socket and pylon"),
        "wrench": (wrench and not np.isfinite(samples.wrench).any(), "the load cell"),
    }
    lacking = {name: source for name, (is_lacking, source) in parts.items() if is_lacking}
    if lacking and len(samples):
        raise IdentificationError(
            f"none of the {len(samples)} samples has a {' or a '.join(lacking)}, which {who} needs",
            f"record {' and '.join(lacking.values())}, or give another segment; 'pressure' and"
            " 'map' do without (--segment all)",
        )


def _usable_rows(samples: Samples, wrench_counts: BoolArray) -> BoolArray:
    """Samples with a limb pose and every wrench channel of the objective, shape (N,).

    `wrench_counts` marks these channels, shape (6,).
    """
    check_parts(samples, "a fit", wrench=bool(wrench_counts.any()))
    measured = np.isfinite(samples.wrench)
    dead = wrench_counts & ~measured.any(axis=0) & (len(samples) > 0)
    for channel in np.flatnonzero(dead).tolist():
        name = WRENCH_CHANNELS[channel]
        raise IdentificationError(
            f"{name} of the load cell has no value in any of the {len(samples)} samples",
            f"leave it out of the objective (--leave-out {name}) or check the load cell",
        )
    rows = np.asarray(samples.has_pose & (measured | ~wrench_counts).all(axis=1))
    if rows.sum() < MIN_SAMPLES:
        raise IdentificationError(
            f"only {int(rows.sum())} of {len(samples)} samples have a limb position"
            f" ({int(samples.has_pose.sum())}) and a wrench, and a fit needs {MIN_SAMPLES}",
            "check the markers and the load cell with 'info', or give another segment",
        )
    return rows


def build_objective(
    samples: Samples, geometry: SocketGeometry, settings: IdentificationSettings
) -> Objective:
    """Select and normalise the channels of a fit.

    Skips samples without a wrench or a limb position. Values are believed: see
    `checked.CheckedSamples.part` for samples that may hold outliers or another unit.

    Args:
        samples: Samples of a loaded segment, outliers as NaN.
        geometry: The socket, which has the clusters of the samples.
        settings: Settings of the fit.

    Raises:
        IdentificationError: If the samples are too few or hold no load, or if no channel is left.
        ConfigurationError: If a channel to leave out, or a cluster, does not exist.
    """
    refuse_unknown_channels(settings.leave_out, samples.channels)
    counts = samples.counted(settings.leave_out)
    wrench_counts, cluster_counts = counts[:6], counts[6:].reshape(-1, 3)
    _usable_rows(samples, wrench_counts)
    noise = channel_noise(samples) if settings.weights == "noise" else None
    samples = smooth_poses(samples, settings.pose_smoothing)
    samples = samples[_usable_rows(samples, wrench_counts)]
    plausibility.require_load(samples, wrench_counts)
    wrench = np.where(wrench_counts, samples.wrench, 0.0)
    channels = _cluster_channels(samples, geometry, cluster_counts)
    if not wrench_counts.any() and not channels:
        raise IdentificationError("every channel is left out", "leave fewer channels out")
    none = np.zeros(0)
    objective = Objective(geometry, settings, samples, wrench, wrench_counts, none, channels, none)
    wrench_shares, channel_shares = _shares(objective, noise)
    return replace(objective, wrench_shares=wrench_shares, channel_shares=channel_shares)


def _cluster_channels(
    samples: Samples, geometry: SocketGeometry, counts: BoolArray
) -> tuple[ClusterChannel, ...]:
    """The channels of the clusters in the objective, which `counts` marks, shape (c, 3)."""
    geometry.require(samples.clusters, "the samples")
    channels = []
    for column, cluster in enumerate(samples.clusters):
        point = geometry.clusters[cluster]
        for axis in np.flatnonzero(counts[column]).tolist():
            force = samples.trusted_forces[:, column, axis]
            if np.isfinite(force).sum() < 2:
                names = compress(local_channels(cluster), counts[column])
                raise IdentificationError(
                    f"{local_channels(cluster)[axis]} has fewer than 2 usable values in the"
                    f" {len(samples)} samples",
                    f"check the cluster or leave it out (--leave-out {' '.join(names)})",
                )
            direction = geometry.rotations[point][:, axis]
            channels.append(ClusterChannel(cluster, point, axis, direction, force))
    return tuple(channels)


def group_sizes(values: FloatArray) -> list[float]:
    """RMS of the moments [N m], the forces [N] and the cluster forces [N], with lower limits.

    The values are those of all channels, shape (N, 6 + 3c) [N m, N]; NaN if missing.
    """
    groups = values[:, :3], values[:, 3:6], values[:, 6:]
    least = plausibility.MIN_MOMENT, plausibility.MIN_FORCE, plausibility.MIN_FORCE
    return [max(rms(group, 0.0), low) for group, low in zip(groups, least, strict=True)]


def _shares(objective: Objective, noise: ChannelNoise | None) -> tuple[FloatArray, FloatArray]:
    """Weights of squared errors of the wrench, (6,), and of m channels of clusters, (m,).

    They are `Objective.wrench_shares` and `Objective.channel_shares`. The noise is given only for
    the weights `noise`.
    """
    channels, wrench_counts = objective.channels, objective.wrench_counts
    least = np.repeat([plausibility.MIN_MOMENT, plausibility.MIN_FORCE], 3)
    power = (objective.wrench**2).mean(axis=0)
    local_power = np.array([np.mean(channel.force**2) for channel in channels])
    if objective.settings.weights == "raw":
        factor = 2.0 / max(power.sum() + local_power.sum(), plausibility.MIN_FORCE**2)
        return factor * wrench_counts, np.full(len(channels), factor)

    counted = objective.samples.without(objective.settings.leave_out)
    moment, force, local = group_sizes(counted.trusted_values)
    if noise is None:
        shares = wrench_counts / np.repeat([moment**2, force**2], 3)
        local_shares = np.full(len(channels), 1.0 / local**2)
        return shares / max(wrench_counts.sum(), 1), local_shares / max(len(channels), 1)

    lever = rms(np.linalg.norm(objective.geometry.anchors, axis=1))
    model_error = (MODEL_ERROR * force) ** 2 * np.repeat([lever**2, 1.0], 3)
    shares = wrench_counts / (np.nan_to_num(noise.wrench) ** 2 + model_error)
    clusters = objective.samples.clusters
    deviations = np.array([noise.local_forces[clusters.index(c.cluster), c.axis] for c in channels])
    local_shares = 1.0 / (np.nan_to_num(deviations) ** 2 + (MODEL_ERROR * local) ** 2)
    zero = max(shares @ power, shares @ least**2, _JITTER)
    local_zero = max(
        local_shares @ local_power, local_shares.sum() * plausibility.MIN_FORCE**2, _JITTER
    )
    return shares / zero, local_shares / local_zero


@dataclass(frozen=True)
class Moments:
    """Means and centred mean products of N rows of columns S (N, p) and targets Y (N, m).

    Columns are those of a contact law [m], targets the wrench [N m, N] or a force of a cluster [N].

    Attributes:
        mean: Means of S, shape (p,) [m].
        gram: Centred mean products of S with itself, shape (p, p) [m^2].
        target_mean: Means of Y, shape (m,) [N m, N].
        target_variance: Variances of Y, shape (m,) [(N m)^2, N^2].
        cross: Centred mean products of S with Y, shape (p, m) [N m^2, N m].
    """

    mean: FloatArray
    gram: FloatArray
    target_mean: FloatArray
    target_variance: FloatArray
    cross: FloatArray

    def products(self, centred: bool) -> tuple[FloatArray, FloatArray]:
        """`gram` (p, p) and `cross` (p, m), centred (for a model with offset) or about zero."""
        if centred:
            return self.gram, self.cross
        gram = self.gram + np.outer(self.mean, self.mean)
        return gram, self.cross + np.outer(self.mean, self.target_mean)

    def rmse(self, gains: FloatArray, with_offset: bool) -> FloatArray:
        """RMSE of the predictions S g of the targets, shape (m,) [N m, N].

        It is as precise as the square root of the rounding of the targets' variances.

        Args:
            gains: Coefficients g, shape (p, m) [N, N/m].
            with_offset: Whether the predictions have the best constant offsets.
        """
        explained = 2.0 * (self.cross * gains).sum(axis=0) - (gains * (self.gram @ gains)).sum(
            axis=0
        )
        square = np.maximum(self.target_variance - explained, 0.0)
        if not with_offset:
            square += (self.target_mean - self.mean @ gains) ** 2
        return np.asarray(np.sqrt(square))


@dataclass(frozen=True)
class Terms:
    """Derivatives of half the objective by the scaled parameters (6, n), flattened.

    Attributes:
        gradient: Gradient of data and prior, shape (6n,) [-].
        gauss_newton: Gauss-Newton matrix of the data, without the prior, shape (6n, 6n) [-].
        curvature: Errors times second derivatives of the law, shape (6n, 6n) [-]; with it the
            Gauss-Newton matrix is the Hessian of the data.
    """

    gradient: FloatArray
    gauss_newton: FloatArray
    curvature: FloatArray


@dataclass(frozen=True)
class _ForceDerivatives:
    """Nonzero derivatives of the forces on n tiles by the tile's own scaled parameters, in N rows.

    Attributes:
        places: For each of P derivatives the axis of the force in the law's frame and the row of
            the parameter: stiffnesses are 0 to 2, rest displacements 3 to 5.
        values: The derivatives, shape (N, P, n) [N].
    """

    places: tuple[tuple[int, int], ...]
    values: FloatArray


class Problem:
    """The objective as a function of the scaled parameters, shape (6, n) [-].

    The rows of the parameters are the stiffnesses along the axes of the law's frames, then the rest
    displacements along them, divided by their scales (`contact.Sizes`).

    Attributes:
        objective: The samples and the weights of the channels.
        settings: The settings, with the numbers that follow from the samples.
        law: The contact law at the reference pose of the samples.
        channels: The m channels of the clusters, in the law's frames and with their weights; rows
            are means over blocks of samples (`ContactLaw.MAX_ROWS`).
        prior: Quadratic term of the prior of all parameters, flattened, shape (6n, 6n) [-].
        start: Centre of the law's prior, shape (6, n) [-].
        lower: Lower bounds of the parameters, shape (6, n) [-]; minus infinity for none.
        upper: Upper bounds of the parameters, shape (6, n) [-]; infinity for none.
    """

    def __init__(self, objective: Objective) -> None:
        settings, geometry, pose = objective.settings, objective.geometry, objective.samples.pose
        kind = law_of(settings.variant)
        sharpness, reference = getattr(settings, kind.SHARPNESS), kind.reference_of(pose, settings)
        self.law = law = kind(geometry.anchors, geometry.rotations, sharpness, reference)
        self._with_offsets = settings.variant in BIAS_VARIANTS
        size = -(-len(pose) // law.MAX_ROWS) if law.MAX_ROWS else 1
        self._motion = _block_means(law.motion(pose), size)
        self._wrench = _block_means(objective.wrench, size)
        self.channels = [  # averaged over blocks of samples, in the law's frames
            replace(
                channel,
                direction=channel.direction @ law.frames[channel.point],
                measured=_block_means(channel.measured, size),
            )
            for channel in objective.channels
        ]
        self._weigh(objective)

    def at(self, theta: float) -> Problem:
        """The same problem at another theta, 0 to 1 [-]."""
        found = copy(self)
        found._weigh(self.objective.with_settings(theta=theta))
        return found

    def _weigh(self, objective: Objective) -> None:
        """Weights of the channels by theta, and what the law makes of them: scales and prior."""
        self.objective = objective
        settings, geometry, law = objective.settings, objective.geometry, self.law
        self._weights = settings.theta * objective.wrench_shares
        shares = (1.0 - settings.theta) * objective.channel_shares
        self.channels = [
            replace(channel, weight=float(share))
            for channel, share in zip(self.channels, shares, strict=True)
        ]
        zero = float(self._weights @ (self._wrench**2).mean(axis=0))
        zero += sum(c.weight * float(np.mean(c.force**2)) for c in self.channels)
        shares = objective.wrench_shares
        loading = Loading(self._motion, self._wrench, shares, geometry.neighbours, zero)
        sizes = law.sizes(settings, loading)
        self._scale = sizes.scale
        # Quadratic terms of the prior of stiffnesses and of rest displacements, (3n, 3n) each [-].
        self._spread = [np.kron(np.eye(3), prior) for prior in sizes.prior]
        self.prior = block_diag(*self._spread)
        self._springs, self.start = sizes.springs, sizes.start
        if settings.initial_stiffness == 0.0 and not law.REFINED:
            settings = replace(settings, initial_stiffness=float(sizes.springs[0, 0]))
        self.settings = settings
        self.lower = np.repeat([0.0, -sizes.limit], 3)[:, None] / self._scale
        self.upper = np.repeat([np.inf, sizes.limit], 3)[:, None] / self._scale

    def stage_one(self) -> BoxQP:
        r"""Stage 1: scaled rest displacements, (3n,), for linear springs of the expected stiffness.

        The residual of the wrench is :math:`A r - (w_0 - w)` with :math:`w_0 = A v`. The paper
        prints this residual with the opposite sign of w.
        """
        law, scale, points = self.law, self._scale[3:], self.start.shape[1]
        stiffness = self._springs
        mean = self._motion.mean(axis=0, keepdims=True)
        pulled = stiffness * law.displacements(mean)[0]
        row = -(stiffness * scale * law.onto).reshape(6, -1)
        target = self._wrench.mean(axis=0) - law.onto.reshape(6, -1) @ pulled.reshape(-1)
        P = self._spread[1] + (row.T * self._weights) @ row
        q = -(row.T * self._weights) @ target
        for channel in () if self._with_offsets and law.OFFSETS_THROUGHOUT else self.channels:
            point, direction = channel.point, channel.direction
            gain = -(stiffness * scale)[:, point] * direction
            mean = self._motion[channel.rows].mean(axis=0, keepdims=True)
            pulled = stiffness[:, point] * law.displacements(mean)[0, :, point]
            miss = channel.force.mean() - direction @ pulled
            own = point + points * np.arange(3)
            P[np.ix_(own, own)] += channel.weight * np.outer(gain, gain)
            q[own] -= channel.weight * gain * miss
        bounds = self.lower[3:].reshape(-1), self.upper[3:].reshape(-1)
        return _normalised(P, q, *bounds, "Stage 1 (rest positions)")

    def moments(self, x: FloatArray) -> list[Moments]:
        """Moments of the data at the rest displacements of the scaled parameters x, (6, n) [-].

        First those of all columns with the wrench (p = 3n, m = 6), then for each channel of the
        clusters those of its tile's columns with its force (p = 3, m = 1).
        """
        rest = (x * self._scale)[3:]
        # First about the columns of the mean motion, which are close to their means, then shifted
        # to the means: otherwise a hold would lose precision.
        pivot = self._columns(self._motion.mean(axis=0, keepdims=True), rest)[0]
        target_mean = self._wrench.mean(axis=0)
        size = rest.size
        total, gram, cross = np.zeros(size), np.zeros((size, size)), np.zeros((size, 6))
        channels = [np.empty((len(self._motion), 3)) for _ in self.channels]
        for rows in self._blocks():
            columns = self._columns(self._motion[rows], rest)
            for own, channel in zip(channels, self.channels, strict=True):
                own[rows] = columns[:, channel.point :: rest.shape[1]]
            columns -= pivot
            total += columns.sum(axis=0)
            gram += columns.T @ columns
            cross += columns.T @ (self._wrench[rows] - target_mean)
        count = len(self._motion)
        shift = total / count
        wrench = Moments(
            mean=pivot + shift,
            gram=gram / count - np.outer(shift, shift),
            target_mean=target_mean,
            target_variance=self._wrench.var(axis=0),
            cross=cross / count,
        )
        local = (
            _moments(own[channel.rows], channel.force[:, None])
            for own, channel in zip(channels, self.channels, strict=True)
        )
        return [wrench, *local]

    def stage_two(self, moments: list[Moments]) -> BoxQP:
        """Stage 2: scaled stiffnesses, shape (3n,), at the rest displacements of the moments."""
        P, q = self._stiffness_terms(moments)
        P += self._spread[0]
        q -= self._spread[0] @ self.start[:3].reshape(-1)
        bounds = self.lower[:3].reshape(-1), self.upper[:3].reshape(-1)
        return _normalised(P, q, *bounds, "Stage 2 (stiffnesses)")

    def _stiffness_terms(self, moments: list[Moments]) -> tuple[FloatArray, FloatArray]:
        """Quadratic and linear term of the data in the stiffnesses, (3n, 3n) and (3n,) [-]."""
        scale, points = self._scale[:3].reshape(-1), self.start.shape[1]
        onto = self.law.onto.reshape(6, -1)
        weighted = self._weights[:, None] * onto
        centred = self._with_offsets and not self.law.OFFSETS_THROUGHOUT
        gram, cross = moments[0].products(centred)
        P = (onto.T @ weighted) * gram
        q = -np.einsum("jc,cj->j", cross, weighted)
        for channel, channel_moments in zip(self.channels, moments[1:], strict=True):
            gram, cross = channel_moments.products(self._with_offsets)
            own = channel.point + points * np.arange(3)
            outer = np.outer(channel.direction, channel.direction)
            P[np.ix_(own, own)] += channel.weight * outer * gram
            q[own] -= channel.weight * channel.direction * cross[:, 0]
        return P * np.outer(scale, scale), q * scale

    def determined_directions(self, x: FloatArray, moments: list[Moments]) -> float:
        r"""Effective number of stiffnesses determined by the data, of 3n [-].

        :math:`\mathrm{tr}(P^{-1} P_{data})` over the stiffnesses off their bound (Hastie,
        Tibshirani & Friedman, The Elements of Statistical Learning, 7.6).

        Args:
            x: Scaled parameters, shape (6, n) [-].
            moments: Moments of the data at their rest displacements, as `moments` returns them.
        """
        free = np.flatnonzero(x[:3] > self.lower[:3])
        if len(free) == 0:
            return 0.0
        data = self._stiffness_terms(moments)[0][np.ix_(free, free)]
        P = data + self._spread[0][np.ix_(free, free)]
        P += _JITTER / _normalisation(P) * np.eye(len(free))
        return float(np.trace(np.linalg.solve(P, data)))

    def rmse(self, x: FloatArray, moments: list[Moments]) -> FloatArray:
        """RMSE of the channels in the objective, the wrench's first, shape (m,) [N m, N].

        They follow from the moments, without a prediction; offsets are constants.

        Args:
            x: Scaled parameters, shape (6, n) [-].
            moments: Moments of the data at their rest displacements, as `moments` returns them.
        """
        stiffness = (x * self._scale)[:3]
        gains = (self.law.onto * stiffness).reshape(6, -1).T
        wrench = moments[0].rmse(gains, self._with_offsets)[self.objective.wrench_counts]
        local = [
            own.rmse((channel.direction * stiffness[:, channel.point])[:, None], self._with_offsets)
            for channel, own in zip(self.channels, moments[1:], strict=True)
        ]
        return np.concatenate([wrench, *local])

    def _blocks(self) -> Iterator[slice]:
        """Blocks of rows, to bound the memory."""
        return (slice(start, start + _BLOCK) for start in range(0, len(self._motion), _BLOCK))

    def _columns(self, motion: FloatArray, rest: FloatArray) -> FloatArray:
        """Columns S, shape (N, 3n) [m], at rest displacements of shape (3, n) [m]."""
        moved = self.law.displacements(motion) - rest
        return self.law.columns(moved).reshape(len(motion), -1)

    def residuals(self, x: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        """Measured less predicted values of the springs at x, shape (6, n) [-], without offsets.

        Those of the wrench have the shape (N, 6) [N m, N], those of each channel of the clusters
        one value for each of its `rows` [N].
        """
        stiffness, rest = (x * self._scale).reshape(2, 3, -1)
        points = [channel.point for channel in self.channels]
        onto = self.law.onto.reshape(6, -1).T
        wrench = np.empty_like(self._wrench)
        at_points = np.empty((len(wrench), 3, len(points)))
        for rows in self._blocks():
            springs = stiffness.reshape(-1) * self._columns(self._motion[rows], rest)
            wrench[rows] = self._wrench[rows] - springs @ onto
            at_points[rows] = springs.reshape(len(springs), 3, -1)[:, :, points]
        local = [
            channel.force - at_points[channel.rows, :, k] @ channel.direction
            for k, channel in enumerate(self.channels)
        ]
        return wrench, local

    def value(self, x: FloatArray) -> float:
        """Half the objective of a refined law at x, shape (6, n) [-], as in a quadratic program."""
        wrench, local = self.residuals(x)
        data = float(self._weights @ (wrench**2).mean(axis=0))
        for channel, residual in zip(self.channels, local, strict=True):
            data += channel.weight * float(self._centred(residual) @ residual) / len(residual)
        away = (x - self.start).reshape(-1)
        return 0.5 * (data + float(away @ self.prior @ away))

    def _centred(self, values: FloatArray) -> FloatArray:
        """Values (N, ...) less their mean over the rows if the model has offsets."""
        return values - values.mean(axis=0) if self._with_offsets else values

    def evaluate(self, x: FloatArray) -> Terms:
        """Derivatives of the objective of a refined law at x, shape (6, n) [-]."""
        stiffness, rest = (x * self._scale).reshape(2, 3, -1)
        moved = self.law.displacements(self._motion) - rest
        forces = self._force_derivatives(stiffness, moved)
        wrench, local = self.residuals(x)
        errors = self._errors_on_tiles(wrench, local)
        products = self._wrench_products(forces)
        for channel in self.channels:
            products[:, channel.point, :, channel.point] += self._channel_products(forces, channel)
        return Terms(
            gradient=self._gradient(x, forces, errors),
            gauss_newton=products.reshape(x.size, x.size),
            curvature=self._curvature(stiffness, moved, errors),
        )

    def _force_derivatives(self, stiffness: FloatArray, moved: FloatArray) -> _ForceDerivatives:
        """Derivatives at stiffnesses (3, n) [N/m] and displacements from rest (N, 3, n) [m]."""
        columns = self.law.columns(moved)
        found = {(axis, axis): columns[:, axis] for axis in range(3)}
        for (axis, along), slope in self.law.slopes(moved).items():
            found[axis, 3 + along] = -stiffness[axis] * slope
        values = np.stack(list(found.values()), axis=1)
        values *= self._scale[[parameter for _, parameter in found]]
        return _ForceDerivatives(places=tuple(found), values=values)

    def _wrench_products(self, forces: _ForceDerivatives) -> FloatArray:
        """Gauss-Newton matrix of the wrench, (6, n, 6, n) [-].

        It is the mean product of two derivatives of forces, times the weighted product of what a
        unit of both forces does to the wrench.
        """
        rows, pairs, points = forces.values.shape
        columns = forces.values.reshape(rows, pairs * points)
        means = (columns.T @ columns).reshape(pairs, points, pairs, points) / rows
        onto = self.law.onto
        unit = np.einsum("can,cbm->anbm", onto, self._weights[:, None, None] * onto)
        products = np.zeros((6, points, 6, points))
        for a, (axis, parameter) in enumerate(forces.places):
            for b, (other_axis, other_parameter) in enumerate(forces.places):
                added = means[a, :, b] * unit[axis, :, other_axis]
                products[parameter, :, other_parameter] += added
        return products

    def _channel_products(self, forces: _ForceDerivatives, channel: ClusterChannel) -> FloatArray:
        """Gauss-Newton matrix of a cluster's channel in its tile's parameters, shape (6, 6) [-]."""
        rows = len(channel.force)
        slopes = np.zeros((rows, 6))  # of the channel's force
        for k, (axis, parameter) in enumerate(forces.places):
            values = forces.values[channel.rows, k, channel.point]
            slopes[:, parameter] += channel.direction[axis] * values
        slopes = self._centred(slopes)
        return np.asarray(channel.weight / rows * (slopes.T @ slopes))

    def _errors_on_tiles(self, wrench: FloatArray, local: list[FloatArray]) -> FloatArray:
        """Derivatives of half the squared errors by the tiles' forces, shape (N, 3, n) [1/N].

        The residuals are those of `residuals`.
        """
        weighted = self._weights[:, None, None] * self.law.onto
        errors = -np.tensordot(wrench, weighted, axes=1) / len(wrench)
        for channel, residual in zip(self.channels, local, strict=True):
            missed = channel.weight / len(residual) * self._centred(residual)
            errors[channel.rows, :, channel.point] -= missed[:, None] * channel.direction
        return np.asarray(errors)

    def _gradient(self, x: FloatArray, forces: _ForceDerivatives, errors: FloatArray) -> FloatArray:
        """Gradient of data and prior by the scaled parameters, shape (6n,) [-]."""
        gradient = (self.prior @ (x - self.start).reshape(-1)).reshape(x.shape)
        for k, (axis, parameter) in enumerate(forces.places):
            gradient[parameter] += np.einsum("tn,tn->n", forces.values[:, k], errors[:, axis])
        return np.asarray(gradient.reshape(-1))

    def _curvature(
        self, stiffness: FloatArray, moved: FloatArray, errors: FloatArray
    ) -> FloatArray:
        """Second derivatives of the law times the errors on the tiles, (6n, 6n) [-].

        There is a block per tile, as a force depends on its own tile's parameters only.
        """
        points = stiffness.shape[1]
        block = np.zeros((6, 6, points))
        for (axis, along), slope in self.law.slopes(moved).items():
            block[axis, 3 + along] -= (errors[:, axis] * slope).sum(axis=0)
        for (axis, along, other), bend in self.law.bends(moved).items():
            block[3 + along, 3 + other] += stiffness[axis] * (errors[:, axis] * bend).sum(axis=0)
        block += np.triu(np.ones((6, 6)), 1).T[:, :, None] * block.transpose(1, 0, 2)
        block *= self._scale[:, None] * self._scale[None]
        full = np.zeros((6, points, 6, points))
        full[:, np.arange(points), :, np.arange(points)] = block.transpose(2, 0, 1)
        return full.reshape(6 * points, 6 * points)

    def model(self, x: FloatArray) -> ContactModel:
        """The contact model with the scaled parameters x, shape (6, n) [-]."""
        objective, law = self.objective, self.law
        geometry = objective.geometry
        stiffness, rest = (x * self._scale).reshape(2, 3, -1)
        bias, slope = np.zeros(6), np.zeros((6, 6))
        force_bias: dict[str, FloatArray] = {}
        if self._with_offsets:
            wrench, local = self.residuals(x)
            left = np.where(objective.wrench_counts, wrench, 0.0)
            bias, slope = law.wrench_offsets(self._motion, left, self._wrench)
            for channel, residual in zip(self.channels, local, strict=True):
                offsets = force_bias.setdefault(channel.cluster, np.zeros(3))
                offsets[channel.axis] = residual.mean()
        rest_positions, reference = law.stored(rest)
        return ContactModel(
            variant=objective.settings.variant,
            names=geometry.names,
            anchors=geometry.anchors,
            rotations=geometry.rotations,
            stiffness=stiffness.T.copy(),
            rest_positions=rest_positions,
            sharpness=law.sharpness,
            wrench_bias=bias,
            force_bias=force_bias,
            cluster_points={name: geometry.clusters[name] for name in objective.samples.clusters},
            reference_pose=reference,
            wrench_slope=slope,
        )


def _block_means(values: FloatArray, size: int) -> FloatArray:
    """Means of the finite values (N, ...) over blocks of `size` rows; NaN without any."""
    if size == 1:
        return values
    starts = np.arange(0, len(values), size)
    known = np.isfinite(values)
    total = np.add.reduceat(np.where(known, values, 0.0), starts, axis=0)
    count = np.add.reduceat(known.astype(np.float64), starts, axis=0)
    return np.where(count > 0.0, total / np.maximum(count, 1.0), np.nan)


def _moments(columns: FloatArray, targets: FloatArray) -> Moments:
    """Moments of columns (N, p) and targets (N, m)."""
    mean, target_mean = columns.mean(axis=0), targets.mean(axis=0)
    S, Y = columns - mean, targets - target_mean
    return Moments(
        mean=mean,
        gram=S.T @ S / len(S),
        target_mean=target_mean,
        target_variance=(Y**2).mean(axis=0),
        cross=S.T @ Y / len(S),
    )


def _normalised(
    P: FloatArray, q: FloatArray, lower: FloatArray, upper: FloatArray, name: str
) -> BoxQP:
    """A program scaled by `_normalisation`."""
    factor = _normalisation(P)
    return BoxQP(factor * P, factor * q, lower, upper, name)


def _normalisation(P: FloatArray) -> float:
    """Factor that makes the mean curvature 1, so that KKT residuals are comparable."""
    curvature = float(np.trace(P)) / len(P)
    return 1.0 / curvature if curvature > 0.0 else 1.0
