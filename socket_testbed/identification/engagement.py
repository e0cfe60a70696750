r"""Which springs of a contact model are engaged, and how sure that is.

A spring is engaged at a sample if its gate exceeds 1/2, so that :math:`\delta < 0`, and its
stiffness is above zero. The paper's law has a spring along each axis of {S} for every tile, the
rigid variants one per tile, gated along its inward normal, with a stiffness along any axis.

Noise of the pose moves :math:`\delta` by the standard deviation :math:`\sigma`. A spring is engaged
with the probability :math:`\Phi(-\delta / \sigma)`, and uncertain where that lies between 16 and
84 %: :math:`|\delta| < \sigma`, so that one standard deviation can switch it. The rest positions
are taken as they were fitted; their own error is no part of this.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.noise import pose_covariance, smooth_poses
from socket_testbed.identification.rigid_law import relative_pose
from socket_testbed.samples import Samples

_BLOCK = 4096  # samples at once, which bounds the memory


@dataclass(frozen=True)
class Engagement:
    """The engaged springs of a model over N samples; NaN without a pose.

    Attributes:
        springs: Number of springs of the bed, those without stiffness included.
        engaged: Number of engaged springs, shape (N,) [1].
        uncertain: Number of uncertain springs, shape (N,) [1]; NaN where the samples do not show
            the noise of the pose.
        time_share: Share of the time in which each spring is engaged, shape (n, 3), in the rigid
            variants (n, 1) [-].
    """

    springs: int
    engaged: FloatArray
    uncertain: FloatArray
    time_share: FloatArray

    @property
    def switching(self) -> int:
        """Number of springs that are engaged at some of the samples of `time_share` only [1]."""
        return int(((self.time_share > 0.0) & (self.time_share < 1.0)).sum())

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
    """Which springs of a model are engaged, sample by sample, and how long each is.

    Args:
        samples: N samples of a trial or segment as measured, in the order of their stamps.
        model: The model.
        window: Window over which the poses are averaged [s], as in the model's fit.
        rows: The samples that `Engagement.time_share` is taken over.
    """
    relative = relative_pose(samples.pose, model.reference_pose)
    motion = replace(samples, position=relative[:, :3], rotation=relative[:, 3:])
    noise = pose_covariance(motion, window)
    pose = smooth_poses(samples, window).pose
    known = np.asarray(np.isfinite(pose).all(axis=1))
    chosen = np.zeros(len(pose), dtype=bool)
    chosen[rows] = known[rows]
    engaged, uncertain, times = [], [], []
    for first in range(0, len(pose), _BLOCK):
        block = slice(first, first + _BLOCK)
        displacement, deviation = model.gate_displacements(pose[block], noise)
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
