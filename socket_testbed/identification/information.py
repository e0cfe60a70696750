r"""What a trial can say about the contact, and what a longer or livelier one would add.

A stiffness is the change of a force with the pose. The noise of the pose shrinks it: with the
standard deviations :math:`\sigma_m` of the motion and :math:`\sigma_n` of the noise,

.. math:: \hat k / k \approx \frac{\sigma_m^2}{\sigma_m^2 + \sigma_n^2}

(errors in variables: Fuller, Measurement Error Models, 1987, section 1.1). What hardly moves cannot
be told from a constant either: then the offsets bear the load instead of the springs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigh

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.contact_law import wrench_map
from socket_testbed.identification.evaluation import predict_channels
from socket_testbed.identification.noise import (
    ChannelNoise,
    channel_noise,
    smooth_poses,
    smoothing_gain,
)
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import BIAS_VARIANTS

LEAST_SHARE = 0.5  # [-]; of the load, which the springs should bear
LEAST_RATIO = 3.0  # [-]; of motion to noise: noise then shrinks a stiffness by a tenth
_LEAST_NOISE = 1e-9  # [m, rad]; of a pose without any
_UNKNOWN_NOISE = 1.0  # [m, rad]; so large that what may be noise counts as no motion
_MOST_SAMPLES = 300  # of a segment, whose derivatives are taken
_RANK = 1e-9  # [-]; smallest singular value of poses that move
_DRAWS = 200  # of the pose's noise
_AXES = "xyz"


@dataclass(frozen=True)
class LoadShare:
    r"""How a part of the measured wrench divides between springs, offsets and what is left.

    With the measured m and a part v of the prediction, the share of v is the projection
    :math:`\sum_k v_k \cdot m_k / \sum_k m_k \cdot m_k` over the samples; the three add up to 1.

    Attributes:
        name: Fz, force or moment.
        springs: Share of the springs [-].
        offsets: Share of the offsets: constant, and with `rigid_bias` linear in the pose [-].
        residual: Share that the model leaves [-].
    """

    name: str
    springs: float
    offsets: float
    residual: float


def load_shares(samples: Samples, model: ContactModel) -> tuple[LoadShare, ...]:
    """Shares of Fz, of the force and of the moment that the springs of a model bear.

    Args:
        samples: Samples with the poses that the model predicts from. Those without a pose or a
            channel of the part do not count; a share without any is NaN.
        model: The model.
    """
    alone = replace(model, wrench_bias=np.zeros(6), wrench_slope=np.zeros((6, 6)))
    springs = predict_channels(alone, samples.pose, ())
    offsets = predict_channels(model, samples.pose, ()) - springs
    found = []
    for name, part in (("Fz", slice(5, 6)), ("force", slice(3, 6)), ("moment", slice(0, 3))):
        measured = samples.wrench[:, part]
        rows = np.isfinite(measured + springs[:, part]).all(axis=1)
        power = float(np.sum(measured[rows] ** 2))
        borne, constant = (
            float(np.sum(values[rows, part] * measured[rows])) / power if power > 0.0 else math.nan
            for values in (springs, offsets)
        )
        found.append(LoadShare(name, borne, constant, 1.0 - borne - constant))
    return tuple(found)


def share_warning(shares: tuple[LoadShare, ...]) -> str:
    """A warning where the springs bear less than half of the force; else empty."""
    fz, force, _ = shares
    if not force.springs < LEAST_SHARE:
        return ""
    return (
        f"the springs bear only {100 * force.springs:.0f} % of the measured force"
        f" ({100 * fz.springs:.0f} % of Fz), the offsets {100 * force.offsets:.0f} %: the model"
        " says little about another load"
    )


def known_directions(
    samples: Samples, model: ContactModel, accuracy: float, window: float = 0.0
) -> float:
    r"""Effective number of stiffness directions that the data show despite all noise, of 3n [-].

    With the derivatives J_k of all channels of sample k by the stiffnesses, and the noise
    :math:`\Sigma` of the channels, to which the model adds what it makes of the pose's noise,

    .. math:: \mathrm{tr}\bigl((H + \kappa^{-2} I)^{-1} H\bigr), \qquad
              H = \sum_k J_k^T \Sigma^{-1} J_k

    counts a direction as known whose standard deviation is below kappa. J_k is taken without what
    the model's offsets could explain of it (`LoadShare`), and at the poses without the directions
    in which their motion is not `LEAST_RATIO` times their noise.

    Args:
        samples: Samples of the fit.
        model: The model, whose forces are linear in its stiffnesses.
        accuracy: Standard deviation kappa that counts as known [N/m].
        window: Window over which the poses are averaged [s].

    Returns:
        The number; NaN where the samples do not show the noise of the wrench.
    """
    noise, spread = _noise(samples, window)
    rows = np.flatnonzero(samples.complete)
    if not len(rows) or not np.isfinite(noise.wrench).all():
        return math.nan
    chosen = rows[np.linspace(0, len(rows) - 1, min(len(rows), _MOST_SAMPLES)).astype(np.int64)]
    pose = smooth_poses(samples, window).pose[chosen]
    middle = pose.mean(axis=0)
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(6), spread, _DRAWS)
    sent = predict_channels(model, middle + drawn, samples.clusters).std(axis=0)
    deviations = np.hypot(np.nan_to_num(noise.values, nan=np.inf), sent)
    basis, inverse = _moving_directions(pose - middle, spread)
    moved = middle + (pose - middle) @ basis @ inverse
    gram = _information(moved, model, samples.clusters, deviations)
    known = np.linalg.eigvalsh(gram) * len(rows) / len(pose) * accuracy**2
    return float(np.sum(known / (1.0 + known)))


def _noise(samples: Samples, window: float) -> tuple[ChannelNoise, FloatArray]:
    """Noise of the channels, and the covariance of the averaged poses' noise, shape (6, 6)."""
    noise = channel_noise(samples)
    gain = smoothing_gain(samples, window)
    spread = np.maximum(np.nan_to_num(noise.pose, nan=_UNKNOWN_NOISE), _LEAST_NOISE)
    return noise, gain * noise.pose_correlation * np.outer(spread, spread)


def _moving_directions(deviation: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions of the pose in which the motion is `LEAST_RATIO` times the noise, d of them.

    Args:
        deviation: Poses about their mean, shape (N, 6).
        noise: Covariance of their noise, shape (6, 6).

    Returns:
        The map of poses to the motion along them, shape (6, d), and its inverse, shape (d, 6).
    """
    covariance = deviation.T @ deviation / max(len(deviation), 1)
    ratios, vectors = eigh(covariance, noise)
    chosen = ratios - 1.0 >= LEAST_RATIO**2
    return vectors[:, chosen], np.linalg.inv(vectors)[chosen]


def _information(
    pose: FloatArray,
    model: ContactModel,
    clusters: tuple[str, ...],
    deviations: FloatArray,
) -> FloatArray:
    """Sum of J' Sigma^-1 J over the poses, shape (3n, 3n) [m^2/N^2]."""
    count = len(model.anchors)
    mapping = wrench_map(model.anchors).reshape(6, count, 3)
    columns = np.zeros((len(pose), 6 + 3 * len(clusters), count, 3))
    for axis, unit in enumerate(np.eye(3)):
        springs = replace(
            model, stiffness=np.tile(unit, (count, 1)), wrench_bias=np.zeros(6), force_bias={}
        )
        forces = springs.forces(pose)
        columns[:, :6, :, axis] = np.einsum("wni,kni->kwn", mapping, forces)
        local = springs.cluster_forces(pose)
        for number, cluster in enumerate(clusters):
            place = slice(6 + 3 * number, 9 + 3 * number)
            columns[:, place, model.cluster_points[cluster], axis] = local[cluster]
    if model.variant in BIAS_VARIANTS:
        columns -= columns.mean(axis=0)
    if model.wrench_slope.any():
        linear = pose - pose.mean(axis=0)
        weights = np.linalg.pinv(linear, rcond=_RANK)
        columns[:, :6] -= np.tensordot(linear @ weights, columns[:, :6], axes=1)
    scaled = (columns.reshape(*columns.shape[:2], -1) / deviations[:, None]).reshape(-1, 3 * count)
    return np.asarray(scaled.T @ scaled)


@dataclass(frozen=True)
class Excitation:
    """How far one number of the pose moves, against its noise.

    Attributes:
        name: Such as position z or rotation about x, along the axes of {S}.
        unit: mm or mrad.
        motion: Standard deviation of the motion, without the noise's share [m, rad].
        noise: Standard deviation of its noise [m, rad]; NaN where the samples do not show it.
        advice: What would move it more.
    """

    name: str
    unit: str
    motion: float
    noise: float
    advice: str

    @property
    def sufficient(self) -> bool:
        """Whether the motion is `LEAST_RATIO` times the noise."""
        return self.motion >= LEAST_RATIO * self.noise

    def __str__(self) -> str:
        noise = "unknown noise" if math.isnan(self.noise) else f"{1e3 * self.noise:.2g} of noise"
        text = f"{self.name}: {1e3 * self.motion:.2g} {self.unit} of motion, {noise}"
        return text if self.sufficient else f"{text}: {self.advice}"


@dataclass(frozen=True)
class Motion:
    """How the pose moves in some samples.

    Attributes:
        excitations: Its six numbers, positions first.
        directions: Number of independent directions of the six-dimensional pose in which the
            motion is `LEAST_RATIO` times the noise.
    """

    excitations: tuple[Excitation, ...]
    directions: int


def measure_motion(samples: Samples, geometry: SocketGeometry, window: float = 0.0) -> Motion:
    """Compare the motion of the limb with the noise of its pose.

    Args:
        samples: Samples of a trial or segment.
        geometry: Geometry of the socket; the x axes of its tiles point to the proximal end.
        window: Window over which the poses are averaged [s].
    """
    noise, covariance = _noise(samples, window)
    pose = smooth_poses(samples, window).pose
    pose = pose[np.isfinite(pose).all(axis=1)]
    deviation = pose - pose.mean(axis=0)
    spread = np.sqrt(np.diag(covariance))
    motion = np.sqrt(np.maximum((deviation**2).mean(axis=0) - spread**2, 0.0))
    spread[np.isnan(noise.pose)] = math.nan
    axis = int(np.abs(geometry.rotations[:, :, 0].mean(axis=0)).argmax())
    excitations = tuple(
        Excitation(name, unit, float(motion[i]), float(spread[i]), advice)
        for i, (name, unit, advice) in enumerate(_numbers(axis))
    )
    return Motion(excitations, _moving_directions(deviation, covariance)[0].shape[1])


def _numbers(axis: int) -> list[tuple[str, str, str]]:
    """Name, unit and advice of each number of the pose, for a socket along one axis of {S}."""
    along, across = "load and unload the limb", "push from the sides"
    twist, tilt = "twist the limb in the socket", "push from the sides, high and low"
    positions = [
        (f"position {x}", "mm", along if i == axis else across) for i, x in enumerate(_AXES)
    ]
    rotations = [
        (f"rotation about {x}", "mrad", twist if i == axis else tilt) for i, x in enumerate(_AXES)
    ]
    return positions + rotations
