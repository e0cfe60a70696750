"""Contact models: a bed of springs by a contact law, with the constant offsets of the sensors.

Every force is the one that the limb applies to the socket. All quantities are in the
frame of the load cell, {S}, unless a name says otherwise. A wrench is ordered [M; F].
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.identification.contact_law import LAWS, ContactLaw, RigidLaw
from socket_testbed.settings.identification import Variant


@dataclass(frozen=True)
class ContactModel:
    """A bed of unilateral tri-axial springs, with the constant offsets of the sensors.

    The paper's variants read the position of the limb alone (`PaperLaw`). The rigid variants read
    its pose and work in the tiles' frames (`RigidLaw`).
    """

    variant: Variant  # the law, and which offsets the model has
    names: tuple[str, ...]  # names of the n points of interest
    anchors: FloatArray  # points of application a_i, shape (n, 3) [m]
    rotations: FloatArray  # frames {L_i} of the points, R_i maps {L_i} to {S}, shape (n, 3, 3) [-]
    # stiffness k_i along x, y, z of {S} (rigid: of {L_i}), shape (n, 3) [N/m]
    stiffness: FloatArray
    # rest positions q_r,i in {S} (rigid: rest displacements r_i in {L_i} since the reference pose),
    # shape (n, 3) [m]
    rest_positions: FloatArray
    sharpness: float  # sharpness alpha of the gate [1/m]
    wrench_bias: FloatArray  # offset b_w of the wrench, shape (6,) [N m, N]
    # offset b_f of each cluster's force in the cluster's frame, by the name of the cluster, shape
    # (3,) each [N]
    force_bias: dict[str, FloatArray]
    cluster_points: dict[str, int]  # index of the point of interest under each cluster, by its name
    # pose that the rigid variants count displacements from, shape (6,) [m, rad]
    reference_pose: FloatArray = field(default_factory=lambda: np.zeros(6))
    # what `rigid_bias` adds to the wrench per relative pose, shape (6, 6) [N m, N per m, rad]
    wrench_slope: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    # the model that the wrench is taken from where this bed's springs predict unseen samples worse:
    # one of another sharpness, or a linear regression, which has no springs
    of_wrench: ContactModel | None = None

    @property
    def is_rigid(self) -> bool:
        """Whether the model reads the limb's rotation and works in the tiles' frames."""
        return isinstance(self.law, RigidLaw)

    def forces(self, pose: FloatArray) -> FloatArray:
        """Forces F_i + b_i on the socket at the n points of interest, in {S}, shape (N, n, 3) [N].

        A pose of the limb holds its position q and rotation vector, shape (N, 6) [m, rad]; the
        paper's variants read the position alone. NaN where a pose is NaN.
        """
        forces = self._spring_forces(self._springs(self.law.motion(pose)))
        for name, bias in self.force_bias.items():
            point = self.cluster_points[name]
            forces[:, point] += self.rotations[point] @ bias
        return forces

    def wrench(self, pose: FloatArray) -> FloatArray:
        """Wrenches ``C F + b_w`` [M; F] at the load cell in {S}, shape (N, 6) [N m, N].

        Poses are as in `forces`; `rigid_bias` adds a slope over the pose. The offsets of the
        clusters belong to the clusters' sensors: they are no part of it.
        """
        if self.of_wrench is not None:
            return self.of_wrench.wrench(pose)
        motion = self.law.motion(pose)
        springs = self._springs(motion).reshape(len(motion), -1)
        wrench = springs @ self.law.onto.reshape(6, -1).T + self.wrench_bias
        if self.wrench_slope.any():
            wrench += motion @ self.wrench_slope.T
        return np.asarray(wrench)

    def cluster_forces(self, pose: FloatArray) -> dict[str, FloatArray]:
        """Forces on the clusters, each in its cluster's frame, shape (N, 3) each [N]."""
        points = list(self.cluster_points.values())
        forces = self._spring_forces(self._springs(self.law.motion(pose), points), points)
        no_bias = np.zeros(3)
        return {
            name: forces[:, column] @ self.rotations[point] + self.force_bias.get(name, no_bias)
            for column, (name, point) in enumerate(self.cluster_points.items())
        }

    def gate_displacements(
        self, pose: FloatArray, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Displacements delta that the gates of the springs read, with their standard deviations.

        Poses have the shape (N, 6) [m, rad], the covariance of their noise (6, 6).

        Returns:
            Displacements along x, y, z of {S}, shape (N, n, 3), in the rigid variants along each
            tile's inward normal, shape (N, n, 1) [m]: negative in compression, infinite without
            stiffness. Standard deviations of the noise, shape (n, 3) or (n, 1) [m].
        """
        law, axes = self.law, list(self.law.GATES)
        motion, stiff = law.motion(pose), self.stiffness > 0.0
        if len(axes) < 3:
            stiff = np.asarray(stiff.any(axis=1, keepdims=True))
        moved = (law.displacements(motion) - self.rest_positions.T)[:, axes].swapaxes(1, 2)
        rows = law.jacobian.reshape(3, len(self.names), -1)[axes]
        size = rows.shape[2]
        variance = np.einsum("anj,jk,ank->na", rows, noise[:size, :size], rows)
        return np.where(stiff, moved, np.inf), np.sqrt(variance)

    @cached_property
    def law(self) -> ContactLaw:
        """The contact law at the model's reference pose."""
        kind = LAWS[self.variant]
        return kind(self.anchors, self.rotations, self.sharpness, self.reference_pose)

    def _springs(self, motion: FloatArray, points: list[int] | slice = slice(None)) -> FloatArray:
        """Forces of the springs at some points in the law's frames, shape (N, 3, points) [N]."""
        moved = self.law.displacements(motion)[:, :, points] - self.rest_positions[points].T
        return self.stiffness[points].T * self.law.columns(moved)

    def _spring_forces(
        self, springs: FloatArray, points: list[int] | slice = slice(None)
    ) -> FloatArray:
        """The same in {S}, shape (N, points, 3) [N]."""
        return np.einsum("nab,tbn->tna", self.law.frames[points], springs)
