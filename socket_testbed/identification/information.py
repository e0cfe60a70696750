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
from scipy.linalg import eigvalsh

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.regions import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.noise import pose_noise, smooth_poses, smoothing_gain
from socket_testbed.samples import FORCES, MOMENTS, Samples, relative_pose

MIN_SPRING_SHARE = 0.5  # [-]; of the load, carried by the springs
MIN_RATIO = 3.0  # [-]; of motion to noise: noise then lowers a stiffness by a tenth
_MIN_NOISE = 1e-9  # [m, rad]; of a noise-free pose
_UNKNOWN_NOISE = 1.0  # [m, rad]; large, so that possible noise does not count as motion
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
    A share may be negative or exceed 1. Shares are NaN without samples.

    Attributes:
        name: The part of the wrench in {S}: `Fz`, `force` or `moment`.
        springs: Share of the springs [-].
        offsets: Share of the offsets: constant, and with `rigid_bias` linear in the pose [-].
        residual: Share not explained by the model [-].
    """

    name: str
    springs: float
    offsets: float
    residual: float


def load_shares(samples: Samples, model: ContactModel) -> tuple[LoadShare, ...]:
    """Shares of Fz, of the force and of the moment carried by the springs of a model.

    Samples without a pose or a channel of the part are ignored; a share without samples is NaN.

    Args:
        samples: Samples with a wrench, their poses averaged as in the fit.
        model: The model; a separate model of the wrench, if it has one, is ignored.
    """
    bed = replace(model, of_wrench=None)
    offsets = np.broadcast_to(bed.offsets(bed.law.motion(samples.pose)), samples.wrench.shape)
    springs = bed.predict(samples.pose, ()) - offsets
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
    """A warning if the springs carry less than `MIN_SPRING_SHARE` of the force; else empty.

    The shares are those of Fz, force and moment, as `load_shares` returns them.
    """
    fz, force, _ = shares
    if not force.springs < MIN_SPRING_SHARE:
        return ""
    return (
        f"the springs bear only {100 * force.springs:.0f} % of the measured force"
        f" ({100 * fz.springs:.0f} % of Fz), the offsets {100 * force.offsets:.0f} %: the model"
        " says little about another load"
    )


@dataclass(frozen=True)
class Excitation:
    """How far one component of the pose moves, compared with its noise.

    Attributes:
        name: The component along an axis of {S}, such as `position z` or `rotation about x`.
        unit: Unit in which the texts state it, `mm` or `mrad`.
        motion: Standard deviation of the motion, noise removed, in [m] or [rad].
        noise: Standard deviation of its noise, in [m] or [rad]; NaN if the samples do not show it.
        advice: How to move it more, in words.
    """

    name: str
    unit: str
    motion: float
    noise: float
    advice: str

    @property
    def sufficient(self) -> bool:
        """Whether the motion is at least `MIN_RATIO` times the noise; no if that is unknown."""
        return self.motion >= MIN_RATIO * self.noise

    def __str__(self) -> str:
        noise = "unknown noise" if math.isnan(self.noise) else f"{1e3 * self.noise:.2g} of noise"
        text = f"{self.name}: {1e3 * self.motion:.2g} {self.unit} of motion, {noise}"
        return text if self.sufficient else f"{text}: {self.advice}"


@dataclass(frozen=True)
class Motion:
    """How the pose moves in some samples.

    Attributes:
        excitations: Excitations of its six components: positions x, y, z, then rotations about
            them.
        directions: Number of independent directions of the pose, 0 to 6, in which it moves at
            least `MIN_RATIO` times the noise.
    """

    excitations: tuple[Excitation, ...]
    directions: int


def measure_motion(samples: Samples, geometry: SocketGeometry, window: float = 0.0) -> Motion:
    """Compare the motion of the limb with the noise of its pose.

    Args:
        samples: N samples, of which the poses matter, not averaged.
        geometry: The socket, whose axis tells which component moves as the limb is loaded.
        window: Centred window over which a fit averages the poses, which lowers the noise [s];
            0: not averaged.
    """
    noise = pose_noise(samples)
    size = np.maximum(np.nan_to_num(noise.deviation, nan=_UNKNOWN_NOISE), _MIN_NOISE)
    covariance = replace(noise, deviation=size).covariance(smoothing_gain(samples, window))
    pose = smooth_poses(samples.centred(), window).pose[samples.has_pose]
    deviation = pose - pose.mean(axis=0)
    spread = np.sqrt(np.diag(covariance))
    spread[np.isnan(noise.deviation)] = math.nan
    moved = (deviation**2).mean(axis=0) - np.nan_to_num(spread) ** 2
    motion = np.sqrt(np.maximum(moved, 0.0))
    axis = int(np.abs(proximal_direction(geometry)).argmax())  # of the socket
    excitations = tuple(
        Excitation(f"{kind} {x}", unit, float(motion[i]), float(spread[i]), advice[i % 3 != axis])
        for i, ((kind, unit, *advice), x) in enumerate(product(_COMPONENTS, "xyz"))
    )
    # Along principal directions relative to the noise.
    ratios = eigvalsh(deviation.T @ deviation / max(len(deviation), 1), covariance)
    return Motion(excitations, int((ratios - 1.0 >= MIN_RATIO**2).sum()))


@dataclass(frozen=True)
class Engagement:
    """The engaged springs of a model over N samples; NaN without a pose.

    Attributes:
        springs: Number of springs of the bed, 3n, in the rigid variants n; those without stiffness
            are included.
        engaged: Number of engaged springs at each sample, shape (N,) [1].
        uncertain: Number of uncertain springs at each sample, shape (N,) [1]; NaN if the pose's
            noise is unknown.
        time_share: Share of the chosen samples with a pose in which each spring is engaged, shape
            (n, 3) along x, y, z of {S}, in the rigid variants (n, 1) [-].
    """

    springs: int
    engaged: FloatArray
    uncertain: FloatArray
    time_share: FloatArray

    def columns(self, prefix: str) -> dict[str, FloatArray]:
        """Number and share of engaged springs, and share of uncertain ones, shape (N,) each.

        The titles hold the units and begin with the prefix.
        """
        return {
            f"{prefix}engaged [1]": self.engaged,
            f"{prefix}engaged_share [-]": self.engaged / self.springs,
            f"{prefix}uncertain_share [-]": self.uncertain / self.springs,
        }


def engagement(
    samples: Samples, model: ContactModel, window: float = 0.0, rows: slice = slice(None)
) -> Engagement:
    """Springs of a model that are engaged at each sample, and each spring's share of the time.

    Args:
        samples: N samples, of which the poses matter, not averaged.
        model: The model with its bed of springs.
        window: Centred window over which the fit averaged the poses [s]; 0: not averaged.
        rows: The samples over which the share of the time is taken.
    """
    relative = relative_pose(samples.pose, model.reference_pose)
    motion = replace(samples, position=relative[:, :3], rotation=relative[:, 3:])
    noise = pose_noise(motion)
    noise.deviation[3:] = np.nan_to_num(noise.deviation[3:])  # a constant rotation has none
    covariance = noise.covariance(smoothing_gain(motion, window))
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
