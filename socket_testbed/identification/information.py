r"""How well the limb's motion in a trial determines the contact.

A stiffness is the change of a force with the pose. Noise of the pose biases it towards zero: with
the standard deviations :math:`\sigma_m` of the motion and :math:`\sigma_n` of the noise,

.. math:: \hat k / k \approx \frac{\sigma_m^2}{\sigma_m^2 + \sigma_n^2}

(errors in variables: Fuller, Measurement Error Models, 1987, section 1.1). Without motion, a spring
also cannot be told from a constant, so the offsets carry the load instead.

A spring is engaged at a sample if its gate exceeds 1/2, i.e. :math:`\delta < 0`, and its
stiffness is positive. The paper's law has a spring along each axis of {S} for every tile, the
rigid variants one per tile, gated along its inward normal. Noise of the pose spreads
:math:`\delta` by the standard deviation :math:`\sigma`: a spring with :math:`|\delta| < \sigma` is
uncertain. Errors of the fitted rest positions are ignored.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.linalg import eigh

from socket_testbed.arrays import FloatArray, evenly
from socket_testbed.geometry.regions import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import ContactModel, relative_pose, wrench_map
from socket_testbed.identification.noise import (
    ChannelNoise,
    channel_noise,
    smooth_poses,
    smoothing_gain,
)
from socket_testbed.samples import FORCES, MOMENTS, Samples, turned
from socket_testbed.settings.identification import BIAS_VARIANTS

MIN_SPRING_SHARE = 0.5  # [-]; of the load, carried by the springs
MIN_RATIO = 3.0  # [-]; of motion to noise: noise then lowers a stiffness by a tenth
_MIN_NOISE = 1e-9  # [m, rad]; of a noise-free pose
_UNKNOWN_NOISE = 1.0  # [m, rad]; large, so that possible noise does not count as motion
_MAX_SAMPLES = 300  # of a segment, for derivatives
_RANK = 1e-9  # [-]; smallest singular value of moving poses
_DRAWS = 200  # of the pose's noise
# Position and rotation: name, unit, and how to move it more, along the socket and across.
_COMPONENTS = (
    ("position", "mm", "load and unload the limb", "push from the sides"),
    ("rotation about", "mrad", "twist the limb in the socket", "push from the sides, high and low"),
)
_BLOCK = 4096  # samples at once, to bound the memory


@dataclass(frozen=True)
class LoadShare:
    r"""How a part of the measured wrench divides between springs, offsets and residual.

    With the measured m and a part v of the prediction, the share of v is the projection
    :math:`\sum_k v_k \cdot m_k / \sum_k m_k \cdot m_k` over the samples; the three add up to 1.
    """

    name: str  # Fz, force or moment
    springs: float  # share of the springs [-]
    offsets: float  # share of the offsets: constant, and with `rigid_bias` linear in the pose [-]
    residual: float  # share not explained by the model [-]


def load_shares(samples: Samples, model: ContactModel) -> tuple[LoadShare, ...]:
    """Shares of Fz, of the force and of the moment carried by the springs of a model.

    Samples without a pose or a channel of the part are ignored; a share without samples is NaN.
    """
    bed = replace(model, of_wrench=None)
    alone = replace(bed, wrench_bias=np.zeros(6), wrench_slope=np.zeros((6, 6)))
    springs = alone.predict(samples.pose, ())
    offsets = bed.predict(samples.pose, ()) - springs
    found = []
    for name, part in (("Fz", slice(5, 6)), ("force", FORCES), ("moment", MOMENTS)):
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
    """A warning if the springs carry less than half of the force; else empty."""
    fz, force, _ = shares
    if not force.springs < MIN_SPRING_SHARE:
        return ""
    return (
        f"the springs bear only {100 * force.springs:.0f} % of the measured force"
        f" ({100 * fz.springs:.0f} % of Fz), the offsets {100 * force.offsets:.0f} %: the model"
        " says little about another load"
    )


def known_directions(
    samples: Samples, model: ContactModel, accuracy: float, window: float = 0.0
) -> float:
    r"""Effective number of stiffness directions observable despite all noise, of 3n [-].

    With the derivatives J_k of all channels of sample k by the stiffnesses, and the noise
    :math:`\Sigma` of the channels, including the pose's noise propagated through the model,

    .. math:: \mathrm{tr}\bigl((H + \kappa^{-2} I)^{-1} H\bigr), \qquad
              H = \sum_k J_k^T \Sigma^{-1} J_k

    counts the directions with a standard deviation below the accuracy kappa [N/m]. From J_k the
    part that the model's offsets could explain is removed (`LoadShare`). The poses are averaged
    over a window [s] and projected on the directions in which they move `MIN_RATIO` times their
    noise. NaN if the samples do not determine the noise of the wrench.
    """
    noise, spread = _noise(samples, window)
    attitude, samples = samples.attitude, samples.centred()

    def absolute(pose: FloatArray) -> FloatArray:
        return np.hstack([pose[:, :3], turned(pose[:, 3:], attitude)])

    rows = np.flatnonzero(samples.has_pose_and_wrench)
    if not len(rows) or not np.isfinite(noise.wrench).all():
        return math.nan
    chosen = rows[evenly(len(rows), _MAX_SAMPLES)]
    pose = smooth_poses(samples, window).pose[chosen]
    middle = pose.mean(axis=0)
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(6), spread, _DRAWS)
    sent = model.predict(absolute(middle + drawn), samples.clusters).std(axis=0)
    deviations = np.hypot(np.nan_to_num(noise.values, nan=np.inf), sent)
    basis, inverse = _moving_directions(pose - middle, spread)
    moved = middle + (pose - middle) @ basis @ inverse
    gram = _information(absolute(moved), model, samples.clusters, deviations)
    known = np.linalg.eigvalsh(gram) * len(rows) / len(pose) * accuracy**2
    return float(np.sum(known / (1.0 + known)))


def _noise(samples: Samples, window: float) -> tuple[ChannelNoise, FloatArray]:
    """Noise of the channels, and the covariance of the averaged poses' noise, shape (6, 6)."""
    noise = channel_noise(samples)
    spread = np.maximum(np.nan_to_num(noise.pose, nan=_UNKNOWN_NOISE), _MIN_NOISE)
    return noise, replace(noise, pose=spread).pose_covariance(smoothing_gain(samples, window))


def _moving_directions(deviation: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Map of poses to the motion along d directions, (6, d), and its inverse, (d, 6).

    Along these, poses (N, 6) move `MIN_RATIO` times their noise about their mean.
    """
    covariance = deviation.T @ deviation / max(len(deviation), 1)
    ratios, vectors = eigh(covariance, noise)
    chosen = ratios - 1.0 >= MIN_RATIO**2
    return vectors[:, chosen], np.linalg.inv(vectors)[chosen]


def _information(
    pose: FloatArray, model: ContactModel, clusters: tuple[str, ...], deviations: FloatArray
) -> FloatArray:
    """Sum of J' Sigma^-1 J over the poses, shape (3n, 3n) [m^2/N^2]."""
    count = len(model.anchors)
    mapping = wrench_map(model.anchors).reshape(6, count, 3)
    columns = np.zeros((len(pose), 6 + 3 * len(clusters), count, 3))
    for axis, unit in enumerate(np.eye(3)):
        springs = replace(model, stiffness=np.tile(unit, (count, 1)), force_bias={})
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
    """How far one component of the pose moves, compared with its noise."""

    name: str  # such as position z or rotation about x, along the axes of {S}
    unit: str  # mm or mrad
    motion: float  # standard deviation of the motion, noise removed [m, rad]
    noise: float  # standard deviation of its noise [m, rad]; NaN if the samples do not show it
    advice: str  # how to move it more

    @property
    def sufficient(self) -> bool:
        """Whether the motion is at least `MIN_RATIO` times the noise."""
        return self.motion >= MIN_RATIO * self.noise

    def __str__(self) -> str:
        noise = "unknown noise" if math.isnan(self.noise) else f"{1e3 * self.noise:.2g} of noise"
        text = f"{self.name}: {1e3 * self.motion:.2g} {self.unit} of motion, {noise}"
        return text if self.sufficient else f"{text}: {self.advice}"


@dataclass(frozen=True)
class Motion:
    """How the pose moves in some samples."""

    excitations: tuple[Excitation, ...]  # of its six components, positions first
    directions: int  # independent directions that move `MIN_RATIO` times the noise


def measure_motion(samples: Samples, geometry: SocketGeometry, window: float = 0.0) -> Motion:
    """Compare the motion of the limb with the noise of its pose, averaged over a window [s]."""
    noise, covariance = _noise(samples, window)
    pose = smooth_poses(samples.centred(), window).pose[samples.has_pose]
    deviation = pose - pose.mean(axis=0)
    spread = np.sqrt(np.diag(covariance))
    spread[np.isnan(noise.pose)] = math.nan
    moved = (deviation**2).mean(axis=0) - np.nan_to_num(spread) ** 2
    motion = np.sqrt(np.maximum(moved, 0.0))
    axis = int(np.abs(proximal_direction(geometry)).argmax())  # of the socket
    excitations = tuple(
        Excitation(f"{kind} {x}", unit, float(motion[i]), float(spread[i]), advice[i % 3 != axis])
        for i, ((kind, unit, *advice), x) in enumerate(product(_COMPONENTS, "xyz"))
    )
    return Motion(excitations, _moving_directions(deviation, covariance)[0].shape[1])


@dataclass(frozen=True)
class Engagement:
    """The engaged springs of a model over N samples; NaN without a pose."""

    springs: int  # number of springs of the bed, those without stiffness included
    engaged: FloatArray  # number of engaged springs, shape (N,) [1]
    uncertain: FloatArray  # number of uncertain ones, (N,) [1]; NaN if the pose's noise is unknown
    time_share: FloatArray  # of each spring's engagement, (n, 3), in the rigid variants (n, 1) [-]

    def columns(self, prefix: str) -> dict[str, FloatArray]:
        """Number and share of engaged springs, and share of uncertain ones, shape (N,) each."""
        return {
            f"{prefix}engaged [1]": self.engaged,
            f"{prefix}engaged_share [-]": self.engaged / self.springs,
            f"{prefix}uncertain_share [-]": self.uncertain / self.springs,
        }


def engagement(
    samples: Samples, model: ContactModel, window: float = 0.0, rows: slice = slice(None)
) -> Engagement:
    """Springs of a model that are engaged at each sample, and each spring's share of the rows.

    The N samples are raw; their poses are averaged over the window of the fit [s].
    """
    relative = relative_pose(samples.pose, model.reference_pose)
    motion = replace(samples, position=relative[:, :3], rotation=relative[:, 3:])
    noise = channel_noise(motion)
    noise.pose[3:] = np.nan_to_num(noise.pose[3:])  # a constant rotation has none
    covariance = noise.pose_covariance(smoothing_gain(motion, window))
    pose = smooth_poses(samples, window).pose
    known = samples.has_pose
    chosen = np.zeros(len(pose), dtype=bool)
    chosen[rows] = known[rows]
    engaged, uncertain, times = [], [], []
    for first in range(0, len(pose), _BLOCK):
        block = slice(first, first + _BLOCK)
        displacement, deviation = model.gate_displacements(pose[block], covariance)
        pressed = displacement < 0.0
        engaged.append(pressed.sum(axis=(1, 2)))
        uncertain.append((np.abs(displacement) < deviation).sum(axis=(1, 2)))
        times.append(pressed[chosen[block]].sum(axis=0))
    return Engagement(
        springs=deviation.size,
        engaged=np.where(known, np.concatenate(engaged), np.nan),
        uncertain=np.where(known & np.isfinite(deviation).all(), np.concatenate(uncertain), np.nan),
        time_share=np.sum(times, axis=0) / max(int(chosen.sum()), 1),
    )
