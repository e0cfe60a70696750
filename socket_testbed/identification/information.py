r"""What a trial can say about the contact, and what a longer or livelier one would add.

A stiffness is the change of a force with the pose. The noise of the pose shrinks it: with the
standard deviations :math:`\sigma_m` of the motion and :math:`\sigma_n` of the noise,

.. math:: \hat k / k \approx \frac{\sigma_m^2}{\sigma_m^2 + \sigma_n^2}

(errors in variables: Fuller, Measurement Error Models, 1987, section 1.1). What hardly moves cannot
be told from a constant either: then the offsets bear the load instead of the springs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.evaluation import predict_channels
from socket_testbed.identification.noise import channel_noise, smooth_poses, smoothing_gain
from socket_testbed.samples import Samples

LEAST_SHARE = 0.5  # [-]; of the load, which the springs should bear
LEAST_RATIO = 3.0  # [-]; of motion to noise: noise then shrinks a stiffness by a tenth
_LEAST_NOISE = 1e-9  # [m, rad]; of a pose without any
_UNKNOWN_NOISE = 1.0  # [m, rad]; so large that what may be noise counts as no motion
_AXES = "xyz"


@dataclass(frozen=True)
class LoadShare:
    r"""How a part of the measured wrench divides between springs, offsets and what is left.

    With the measured m and a part v of the prediction, the share of v is the projection
    :math:`\sum_k v_k \cdot m_k / \sum_k m_k \cdot m_k` over the samples; the three add up to 1.

    Attributes:
        name: Fz, force or moment.
        springs: Share of the springs [-].
        offsets: Share of the constant offsets [-].
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
    offsets = np.broadcast_to(model.wrench_bias, samples.wrench.shape)
    springs = predict_channels(model, samples.pose, ()) - offsets
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
    noise = channel_noise(samples)
    gain = smoothing_gain(samples, window) if window > 0.0 else 1.0
    pose = smooth_poses(samples, window).pose
    pose = pose[np.isfinite(pose).all(axis=1)]
    pose = pose - pose.mean(axis=0)
    covariance = pose.T @ pose / max(len(pose), 1)
    spread = np.maximum(noise.pose * np.sqrt(gain), _LEAST_NOISE)
    motion = np.sqrt(np.maximum(np.diag(covariance) - np.nan_to_num(spread) ** 2, 0.0))
    axis = int(np.abs(geometry.rotations[:, :, 0].mean(axis=0)).argmax())
    excitations = tuple(
        Excitation(name, unit, float(motion[i]), float(spread[i]), advice)
        for i, (name, unit, advice) in enumerate(_numbers(axis))
    )
    known = np.nan_to_num(spread, nan=_UNKNOWN_NOISE)
    correlated = noise.pose_correlation * np.outer(known, known)
    ratios = eigh(covariance, correlated, eigvals_only=True) - 1.0
    return Motion(excitations, int(np.sum(ratios >= LEAST_RATIO**2)))


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
