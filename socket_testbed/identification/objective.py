r"""The channels of a fit and their weights.

The objective of both stages is

.. math:: \theta J_w + (1 - \theta) J_f + \lambda J_s

with J_w and J_f the weighted squares of the wrench's and the clusters' errors, and J_s the mean
square difference between neighbouring tiles, divided by the expected difference. See
docs/identification.md and `problem`. The setting `weights` names what weighs the channels:

- `size`: J_w and J_f are means over their channels of the mean square error, divided by the mean
  square of its group of channels (moments, forces, cluster forces): newton metres and newtons
  count alike;
- `noise`: every channel is weighed by 1 / (noise^2 + e^2) with its `channel_noise` and an error e
  for what no spring bed explains: `MODEL_ERROR` of the RMS force, for a moment at the root mean
  square distance of the tiles. A common factor of each group makes predicting zero cost 1, as
  with `size`;
- `raw`: sums of squares in N^2 and (N m)^2 as the paper prints them, with one common factor that
  makes predicting zero cost 2 in J_w + J_f, as with `size`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray, rms
from socket_testbed.errors import ConfigurationError, IdentificationError, closest
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.noise import (
    ChannelNoise,
    channel_noise,
    smooth_poses,
)
from socket_testbed.identification.plausibility import (
    LEAST_FORCE,
    LEAST_MOMENT,
    MOST_OUTLIERS,
    find_outliers,
    outlier_notes,
    require_load,
    require_units,
)
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples
from socket_testbed.settings.identification import IdentificationSettings

MODEL_ERROR = 0.01  # [-]; of the RMS of the forces

_GROUPS = (slice(0, 3), slice(3, 6))  # moments, forces
_JITTER = 1e-12  # [-]; keeps a factorisation of a flat problem defined
LEAST_SAMPLES = 12  # [1]; 3 s at the trigger's default rate


@dataclass(frozen=True)
class ClusterChannel:
    """One channel of a cluster's force that is in the objective."""

    cluster: str
    point: int  # index of its point of interest
    axis: int  # axis of the cluster's frame: 0, 1, 2
    direction: FloatArray  # that axis in {S}, shape (3,) [-]
    measured: FloatArray  # the measured force, NaN where there is none, shape (N,) [N]
    weight: float = 0.0  # weight of its mean square error in a `Problem` [1/N^2]

    @cached_property
    def rows(self) -> BoolArray:
        """Samples in which the channel was measured, shape (N,)."""
        return np.isfinite(self.measured)

    @cached_property
    def force(self) -> FloatArray:
        """The measured force in those samples [N]."""
        return self.measured[self.rows]


@dataclass(frozen=True)
class Objective:
    """The samples of a fit with the weight of each channel, on a socket, by its settings."""

    geometry: SocketGeometry
    settings: IdentificationSettings
    samples: Samples  # the N samples that are used, without outliers, their poses averaged if asked
    # measured wrenches, zero where a channel does not count, shape (N, 6) [N m, N]
    wrench: FloatArray
    wrench_counts: BoolArray  # channels of the wrench that are in the objective, shape (6,)
    wrench_shares: FloatArray  # weight of squared errors in J_w, or 0, (6,) [1/(N m)^2, 1/N^2]
    channels: tuple[ClusterChannel, ...]  # channels of the clusters in the objective
    channel_shares: FloatArray  # weight of each channel's squared error in J_f, shape (m,) [1/N^2]

    def with_settings(self, **changes: Any) -> Objective:
        """The same samples with another theta, smoothness or variant."""
        return replace(self, settings=replace(self.settings, **changes))

    def part(self, rows: IntArray) -> Objective:
        """The same objective by some of the samples, whose indices are given."""
        channels = tuple(replace(c, measured=c.measured[rows]) for c in self.channels)
        samples, wrench = self.samples[rows], self.wrench[rows]
        return replace(self, samples=samples, wrench=wrench, channels=channels)


def check_channels(leave_out: tuple[str, ...], names: tuple[str, ...]) -> None:
    """Check that every name is a channel."""
    for name in leave_out:
        if name not in names:
            raise ConfigurationError(f"leave_out: no channel '{name}'", closest(name, names))


def _usable_rows(samples: Samples, wrench_counts: BoolArray) -> BoolArray:
    """Samples with a limb position and every wrench channel that counts, shape (N,)."""
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


def build_objective(
    samples: Samples, geometry: SocketGeometry, settings: IdentificationSettings
) -> Objective:
    """Choose, check and normalise the channels of a fit.

    Outliers (see `plausibility`) and samples without a wrench or a limb position are skipped.
    """
    check_channels(settings.leave_out, samples.channels)
    counts = np.array([name not in settings.leave_out for name in samples.channels])
    wrench_counts, cluster_counts = counts[:6], counts[6:].reshape(-1, 3)
    _usable_rows(samples, wrench_counts)
    require_units(samples, geometry, settings.leave_out)
    outliers = find_outliers(samples, geometry, settings.leave_out)
    count = int(outliers.rows.sum())
    if count > MOST_OUTLIERS * len(samples):
        raise IdentificationError(
            f"{count} of {len(samples)} samples are outliers:"
            f" {'; '.join(outlier_notes(samples, outliers))}",
            "check these channels, leave them out (--leave-out), or give another segment",
        )
    samples = outliers.taken_from(samples)
    noise = channel_noise(samples) if settings.weights == "noise" else None
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
        wrench=wrench,
        wrench_counts=wrench_counts,
        wrench_shares=wrench_shares,
        channels=channels,
        channel_shares=channel_shares,
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
            if np.isfinite(force).sum() < 2:
                names = [f"{cluster}.{LOCAL_CHANNELS[a]}" for a in np.flatnonzero(counts[column])]
                raise IdentificationError(
                    f"{cluster}.{LOCAL_CHANNELS[axis]} has no usable value in any of the"
                    f" {len(samples)} samples",
                    f"check the cluster or leave it out (--leave-out {' '.join(names)})",
                )
            direction = geometry.rotations[point][:, axis]
            channels.append(ClusterChannel(cluster, point, axis, direction, force))
    return tuple(channels)


def _shares(
    samples: Samples,
    geometry: SocketGeometry,
    weights: str,
    wrench_counts: BoolArray,
    channels: tuple[ClusterChannel, ...],
    noise: ChannelNoise | None,
) -> tuple[FloatArray, FloatArray]:
    """Weights of squared errors of the wrench (6,) and of m channels of clusters: see the module.

    The noise is given for the weights `noise` alone.
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
