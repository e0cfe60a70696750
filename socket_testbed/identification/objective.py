r"""What the two stages share: which channels count, how they are normalised, smoothness.

The objective of both stages is

.. math:: \theta J_w + (1 - \theta) J_f + \lambda J_s

with J_w and J_f the mean squares of the wrench's and the clusters' errors, each divided by
the size of its group of channels (moments, forces, cluster forces) so that newton metres and
newtons count alike, and J_s the mean square difference between neighbouring tiles, divided
by the difference that one expects. See docs/identification.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.documents import closest
from socket_testbed.errors import ConfigurationError, IdentificationError
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples
from socket_testbed.settings import IdentificationSettings

_LEAST_MOMENT = 0.1  # [N m]; a channel group smaller than this is normalised by it
_LEAST_FORCE = 1.0  # [N]


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
    """The samples of a fit, with the weight of each channel.

    Attributes:
        rows: Which of the samples given are used.
        position: Limb positions q, shape (N, 3) [m].
        wrench: Measured wrenches, zero where a channel does not count, shape (N, 6)
            [N m, N].
        wrench_counts: Channels of the wrench that are in the objective, shape (6,).
        wrench_shares: Weight of each squared wrench error in J_w, zero where it does not
            count, shape (6,) [1/(N m)^2, 1/N^2].
        channels: Channels of the clusters in the objective.
        channel_share: Weight of each squared cluster error in J_f [1/N^2].
        theta: Weight of J_w against J_f [-].
        smoothness: Weight lambda of J_s [-].
    """

    rows: BoolArray
    position: FloatArray
    wrench: FloatArray
    wrench_counts: BoolArray
    wrench_shares: FloatArray
    channels: tuple[ClusterChannel, ...]
    channel_share: float
    theta: float
    smoothness: float

    @property
    def wrench_weights(self) -> FloatArray:
        """Weight of each squared wrench error, shape (6,) [1/(N m)^2, 1/N^2]."""
        return self.theta * self.wrench_shares

    @property
    def channel_weight(self) -> float:
        """Weight of each squared cluster error [1/N^2]."""
        return (1.0 - self.theta) * self.channel_share


def check_channels(leave_out: tuple[str, ...], names: tuple[str, ...]) -> None:
    """Refuse a name that is no channel.

    Raises:
        ConfigurationError: Naming the likely one.
    """
    for name in leave_out:
        if name not in names:
            raise ConfigurationError(f"leave_out: no channel '{name}'", closest(name, names))


def channels_in_objective(
    samples: Samples, leave_out: tuple[str, ...]
) -> tuple[BoolArray, BoolArray]:
    """Which channels of the wrench, shape (6,), and of the clusters, shape (c, 3), count.

    Raises:
        ConfigurationError: For a name that is no channel.
    """
    names = samples.channels
    check_channels(leave_out, names)
    counted = np.array([name not in leave_out for name in names])
    return counted[:6], counted[6:].reshape(-1, 3)


def usable_rows(samples: Samples, wrench_counts: BoolArray) -> BoolArray:
    """Samples with a limb position and every wrench channel that counts, shape (N,).

    Raises:
        IdentificationError: If fewer than two are left, naming what is missing.
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
    if rows.sum() < 2:
        raise IdentificationError(
            f"only {int(rows.sum())} of {len(samples)} samples have a limb position"
            f" ({int(position.sum())}) and a wrench",
            "check the markers and the load cell with 'info', or give another segment",
        )
    return rows


def build_objective(
    samples: Samples, geometry: SocketGeometry, settings: IdentificationSettings
) -> Objective:
    """Choose, check and normalise the channels of a fit.

    Args:
        samples: Samples; those without a wrench or a limb position are passed over.
        geometry: Geometry of the socket.
        settings: Settings of the identification.

    Raises:
        ConfigurationError: For an unknown channel or cluster.
        IdentificationError: If there are no samples, or no value in a channel that counts.
    """
    wrench_counts, cluster_counts = channels_in_objective(samples, settings.leave_out)
    rows = usable_rows(samples, wrench_counts)
    samples = samples[rows]
    wrench = np.where(wrench_counts, samples.wrench, 0.0)
    channels = _cluster_channels(samples, geometry, cluster_counts)
    if not wrench_counts.any() and not channels:
        raise IdentificationError("every channel is left out", "leave fewer channels out")

    moment = max(_rms(wrench[:, :3][:, wrench_counts[:3]]), _LEAST_MOMENT)
    force = max(_rms(wrench[:, 3:][:, wrench_counts[3:]]), _LEAST_FORCE)
    weights = wrench_counts / np.repeat([moment, force], 3) ** 2
    local = max(_rms(np.concatenate([c.force for c in channels] or [np.zeros(1)])), _LEAST_FORCE)
    return Objective(
        rows=rows,
        position=samples.position,
        wrench=wrench,
        wrench_counts=wrench_counts,
        wrench_shares=weights / max(int(wrench_counts.sum()), 1),
        channels=channels,
        channel_share=1.0 / (local**2 * max(len(channels), 1)),
        theta=settings.theta,
        smoothness=settings.smoothness,
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
    r"""Matrix of J_s: :math:`D^T D / e` for one axis, the graph's Laplacian over its edges.

    Args:
        points: Number n of points of interest.
        neighbours: Pairs of neighbours, shape (e, 2).

    Returns:
        Array of shape (n, n) [-].
    """
    laplacian = np.zeros((points, points))
    a, b = neighbours.T
    np.add.at(laplacian, (a, a), 1.0)
    np.add.at(laplacian, (b, b), 1.0)
    np.add.at(laplacian, (a, b), -1.0)
    np.add.at(laplacian, (b, a), -1.0)
    return laplacian / max(len(neighbours), 1)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0
