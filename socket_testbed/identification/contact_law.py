r"""The contact law: the motion of the limb makes a force on every tile, by springs.

.. math:: F_i = B_i \, \bigl(k_i \circ s(v_i - r_i)\bigr), \qquad v = J u

with the limb's motion u since a reference pose, the displacement v_i of tile i in the law's own
frame B_i, its rest displacement r_i and stiffnesses k_i. A law defines u, B, J and s, and the sizes
of its parameters; everything else is the same for every law (`problem`). Arrays have the axis of
the frame before the tile. To add a law, derive from `ContactLaw` in a module of its own, and list
its variants in `contact.LAWS` and in `settings.identification`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.settings.identification import IdentificationSettings

_LARGEST_SETTLING = 0.02  # [m]; of a limb under its load; a bed is at least that stiff


def gate(displacement: FloatArray, sharpness: float) -> FloatArray:
    r"""Smooth unilateral gate, :math:`g(d) = 1/2 - 1/2 \tanh(\alpha d) = 1 / (1 + e^{2 \alpha d})`.

    It is in [0, 1] [-] and tends to 1 in compression, d < 0 [m]; alpha is the sharpness [1/m].
    """
    # Far outside the contact the exponential overflows to infinity, where the gate is 0.
    with np.errstate(over="ignore"):
        return np.asarray(1.0 / (1.0 + np.exp((2.0 * sharpness) * displacement)))


def wrench_map(anchors: FloatArray) -> FloatArray:
    r"""Constant map C of the point forces onto the wrench, ``[M; F] = C F``.

    .. math:: C = \begin{bmatrix} [a_1]_\times & \dots & [a_n]_\times \\
                                  I & \dots & I \end{bmatrix}

    For points of application a_i of shape (n, 3) [m] it has the shape (6, 3n) [m, 1].
    """
    n = len(anchors)
    x, y, z = anchors.T
    mapping = np.zeros((6, n, 3))
    mapping[0, :, 1], mapping[0, :, 2] = -z, y
    mapping[1, :, 0], mapping[1, :, 2] = z, -x
    mapping[2, :, 0], mapping[2, :, 1] = -y, x
    for axis in range(3):
        mapping[3 + axis, :, axis] = 1.0
    return mapping.reshape(6, 3 * n)


def neighbour_differences(points: int, neighbours: IntArray) -> FloatArray:
    """Matrix D'D of the differences between neighbours, shape (n, n) [-], by their pairs (e, 2)."""
    D = np.eye(points)[neighbours[:, 0]] - np.eye(points)[neighbours[:, 1]]
    return D.T @ D


@dataclass(frozen=True)
class Loading:
    """The samples from which a law takes the sizes of its parameters."""

    motion: FloatArray  # motions u of the limb, shape (N, m)
    wrench: FloatArray  # measured wrenches, shape (N, 6) [N m, N]
    shares: FloatArray  # weight of each squared wrench error, shape (6,) [1/(N m)^2, 1/N^2]
    neighbours: IntArray  # pairs of neighbouring tiles, shape (e, 2)
    zero: float  # what predicting zero costs in the objective [-]


@dataclass(frozen=True)
class Sizes:
    """Scales, bounds and prior of a law's parameters, a row per parameter of a tile.

    The rows are the stiffnesses along the three axes, then the rest displacements. The prior is
    :math:`(x - x_0)^T Q (x - x_0)` in the scaled parameters x, with the same Q for each axis.
    """

    scale: FloatArray  # what the parameters are divided by, shape (6, n) [N/m, m]
    start: FloatArray  # centre x_0 of the prior, shape (6, n) [-]
    springs: FloatArray  # stiffnesses of the linear springs of Stage 1, shape (3, n) [N/m]
    lower: FloatArray  # lower bounds, shape (6, n) [-]
    upper: FloatArray  # upper bounds, shape (6, n) [-]
    prior: FloatArray  # Q of the stiffnesses and of the rest displacements, shape (2, n, n) [-]


class ContactLaw(ABC):
    """Springs between the limb and the tiles: see this module.

    Args:
        anchors: Points of application a_i, shape (n, 3) [m].
        rotations: Frames {L_i} of the points, R_i maps {L_i} to {S}, shape (n, 3, 3) [-].
        sharpness: Sharpness alpha of the gate [1/m].
        reference_pose: Pose that the motion counts from, shape (6,) [m, rad].
    """

    REFINED: ClassVar[bool]
    """Whether both stages are refined jointly; it takes `slopes` and `bends`."""
    OFFSETS_THROUGHOUT: ClassVar[bool]
    """Whether a variant with offsets has those of the clusters in both stages, and gives the
    wrench what the springs leave of it; otherwise both have constants, in Stage 2 alone."""
    MOST_ROWS: ClassVar[int | None]
    """Samples of a fit; of more, means over equal blocks are fitted."""
    GATES: ClassVar[tuple[int, ...]]
    """The axes of the frames whose displacement a gate reads."""

    def __init__(
        self,
        anchors: FloatArray,
        rotations: FloatArray,
        sharpness: float,
        reference_pose: FloatArray,
    ) -> None:
        self.anchors, self.rotations = anchors, rotations
        self.sharpness, self.reference_pose = sharpness, reference_pose

    @property
    @abstractmethod
    def frames(self) -> FloatArray:
        """The law's frames B_i, which map to {S}, shape (n, 3, 3) [-]."""

    @abstractmethod
    def motion_map(self) -> FloatArray:
        """Displacements of the tiles in {S} per motion, shape (n, 3, m)."""

    @cached_property
    def jacobian(self) -> FloatArray:
        """J from a motion to the displacements, shape (3n, m), a row per axis and tile."""
        turned = np.einsum("nia,nij->anj", self.frames, self.motion_map())
        return turned.reshape(-1, turned.shape[2])

    @cached_property
    def onto(self) -> FloatArray:
        """Map of the forces in the law's frames onto the wrench, shape (6, 3, n) [m, 1]."""
        in_socket = wrench_map(self.anchors).reshape(6, -1, 3)
        return np.einsum("cni,nia->can", in_socket, self.frames)

    def displacements(self, motion: FloatArray) -> FloatArray:
        """Displacements v of the tiles by N motions of the limb, shape (N, 3, n) [m]."""
        return np.asarray((motion @ self.jacobian.T).reshape(len(motion), 3, -1))

    @abstractmethod
    def motion(self, pose: FloatArray) -> FloatArray:
        """Motions u since the reference pose, shape (N, m), by poses (N, 6) [m, rad]."""

    @abstractmethod
    def columns(self, moved: FloatArray) -> FloatArray:
        """Columns s at displacements from rest v - r, both of shape (N, 3, n) [m]."""

    def slopes(self, moved: FloatArray) -> dict[tuple[int, int], FloatArray]:
        """Derivatives of s, shape (N, n) [-], by its axis and that of v; zeros are left out."""
        raise NotImplementedError

    def bends(self, moved: FloatArray) -> dict[tuple[int, int, int], FloatArray]:
        """Second derivatives of s, by its axis and two axes of v in order [1/m]."""
        raise NotImplementedError

    @classmethod
    @abstractmethod
    def sharpness_of(cls, settings: IdentificationSettings) -> float:
        """Sharpness of the gate in a fit [1/m]."""

    @classmethod
    @abstractmethod
    def reference_of(cls, pose: FloatArray, settings: IdentificationSettings) -> FloatArray:
        """Reference pose of a fit to poses of shape (N, 6), shape (6,) [m, rad]."""

    @abstractmethod
    def sizes(self, settings: IdentificationSettings, loading: Loading) -> Sizes:
        """Scales, bounds and prior of the parameters in a fit."""

    def resolved(
        self, settings: IdentificationSettings, loading: Loading
    ) -> IdentificationSettings:
        """The settings of a fit, with a number in place of what is to follow from the samples."""
        return settings

    def bed_stiffness(self, loading: Loading, along: FloatArray) -> tuple[float, float]:
        """Stiffness of the uniform bed that best explains how the wrench changes with the motion.

        Args:
            loading: The samples.
            along: Ratios of the bed's stiffnesses along the axes to it, shape (3,) [-].

        Returns:
            The stiffness, zero at least [N/m], and the weighted squares that it leaves [-].
        """
        slope = np.einsum(
            "can,a,anm->cm", self.onto, along, self.jacobian.reshape(*self.onto.shape[1:], -1)
        )
        moved = loading.motion - loading.motion[0]  # exactly zero where nothing moved
        changes = (moved - moved.mean(axis=0)) @ slope.T
        target = loading.wrench - loading.wrench.mean(axis=0)
        power = float((changes**2).sum(axis=0) @ loading.shares)
        stiffness = max(float((changes * target).sum(axis=0) @ loading.shares), 0.0)
        stiffness /= power or 1.0
        return stiffness, float(((target - stiffness * changes) ** 2).sum(axis=0) @ loading.shares)

    def least_stiffness(self, loading: Loading) -> tuple[float, float]:
        """Mean load [N], and the least stiffness [N/m] of n springs that bear it on 20 mm."""
        load = max(float(np.linalg.norm(loading.wrench[:, 3:].mean(axis=0))), 1.0)
        return load, load / (len(self.anchors) * _LARGEST_SETTLING)

    def stored(self, rest: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rest positions (n, 3) [m] and reference pose (6,) that a model keeps, by r (3, n)."""
        return rest.T.copy(), self.reference_pose

    def wrench_offsets(
        self, motion: FloatArray, residual: FloatArray, wrench: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Constant (6,) and slope (6, 6) over the motion of the wrench's residuals, (N, 6)."""
        return residual.mean(axis=0), np.zeros((6, 6))
