"""The contact law: unilateral tri-axial springs between the limb and the socket.

Every force is the one that the limb applies to the socket. All quantities are in the
frame of the load cell, {S}, unless a name says otherwise. A wrench is ordered [M; F].
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.identification.gate_series import GateSeries
from socket_testbed.identification.rigid_bed import (
    displacement_map,
    force_changes,
    relative_pose,
    spring_displacements,
)
from socket_testbed.settings.identification import RIGID_VARIANTS, Variant

_FEW = 100  # samples, for which a series never pays


def gate(displacement: FloatArray, sharpness: float) -> FloatArray:
    r"""Smooth unilateral gate, :math:`g(d) = 1/2 - 1/2 \tanh(\alpha d)`.

    Args:
        displacement: Displacement d [m], any shape.
        sharpness: Sharpness alpha of the gate [1/m].

    Returns:
        Gate values in [0, 1] [-], 1 in compression (d < 0), of the same shape.
    """
    return 0.5 - 0.5 * np.tanh(sharpness * displacement)


def gated_displacement(
    position: FloatArray, rest_positions: FloatArray, sharpness: float
) -> FloatArray:
    r"""Gated displacement :math:`s = g(\delta) \circ \delta`, :math:`\delta_i = q - q_{r,i}`.

    Computed as :math:`\delta / (1 + e^{2 \alpha \delta})`, the same gate without a tanh.

    Args:
        position: Limb positions q, shape (N, 3) [m].
        rest_positions: Rest positions q_r, shape (n, 3) [m].
        sharpness: Sharpness alpha of the gate [1/m].

    Returns:
        Gated displacements, shape (N, n, 3) [m].
    """
    displacement = position[:, None, :] - rest_positions[None, :, :]
    growth = (2.0 * sharpness) * displacement
    # Far outside the contact the exponential overflows to infinity, where s is 0.
    with np.errstate(over="ignore"):
        np.exp(growth, out=growth)
    growth += 1.0
    displacement /= growth
    return displacement


def gated_sums(
    position: FloatArray, rest_positions: FloatArray, sharpness: float, weights: FloatArray
) -> FloatArray:
    """Sums of the gated displacements of all points, with weights.

    Along each coordinate they are functions of that coordinate alone: of many samples they are
    taken from their Chebyshev series, to double precision.

    Args:
        position: Limb positions q, shape (N, 3) [m].
        rest_positions: Rest positions q_r, shape (n, 3) [m].
        sharpness: Sharpness alpha of the gate [1/m].
        weights: Weights of the m sums, shape (m, n, 3).

    Returns:
        Array of shape (N, m).
    """
    series = GateSeries(position, sharpness) if len(position) > _FEW else None
    if series is None or series.terms > len(position):
        gated = gated_displacement(position, rest_positions, sharpness)
        return np.asarray(gated.reshape(len(position), -1) @ weights.reshape(len(weights), -1).T)
    coefficients = []
    for axis in range(3):
        nodes, rest = series.nodes(axis)[..., None], rest_positions[:, axis, None]
        gated = gated_displacement(nodes.reshape(-1, 1), rest, sharpness)[..., 0]
        values = (gated @ weights[:, :, axis].T).reshape(*nodes.shape[:2], -1)
        coefficients.append(series.transform @ values)
    sums = np.empty((len(position), len(weights)))
    for cell, rows, polynomials in series.by_cell(position, np.empty((len(position), 0))):
        of_cell = [of[panel] for of, panel in zip(coefficients, cell, strict=True)]
        sums[rows] = polynomials.T @ np.vstack(of_cell)
    return sums


def gated_slope(position: FloatArray, rest_positions: FloatArray, sharpness: float) -> FloatArray:
    r"""Slope of the gated displacement, :math:`ds/dq = g(\delta) + \delta\, g'(\delta)`.

    With the gate's own slope, :math:`g' = -2 \alpha g (1 - g)`.

    Args:
        position: Limb positions q, shape (N, 3) [m].
        rest_positions: Rest positions q_r, shape (n, 3) [m].
        sharpness: Sharpness alpha of the gate [1/m].

    Returns:
        Slopes per axis, shape (N, n, 3) [-].
    """
    displacement = position[:, None, :] - rest_positions[None, :, :]
    gates = gate(displacement, sharpness)
    return np.asarray(gates * (1.0 - 2.0 * sharpness * displacement * (1.0 - gates)))


def wrench_map(anchors: FloatArray) -> FloatArray:
    r"""Constant map C of the point forces onto the wrench, ``[M; F] = C F``.

    .. math:: C = \begin{bmatrix} [a_1]_\times & \dots & [a_n]_\times \\
                                  I & \dots & I \end{bmatrix}

    Args:
        anchors: Points of application a_i, shape (n, 3) [m].

    Returns:
        Array of shape (6, 3n); the moment rows are in m, the force rows in 1.
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


@dataclass(frozen=True)
class ContactModel:
    """A bed of unilateral tri-axial springs, with the constant offsets of the sensors.

    The paper's variants read the position of the limb alone: see `gated_displacement`. The rigid
    variants read its pose and work in the tiles' frames: see `rigid_bed`.

    Attributes:
        variant: The law, and which offsets the model has.
        names: Names of the n points of interest.
        anchors: Points of application a_i, shape (n, 3) [m].
        rotations: Frames {L_i} of the points, R_i maps {L_i} to {S}, shape (n, 3, 3) [-].
        stiffness: Stiffness k_i along x, y, z of {S} (rigid: of {L_i}), shape (n, 3) [N/m].
        rest_positions: Rest positions q_r,i in {S} (rigid: rest displacements r_i in {L_i} since
            the reference pose), shape (n, 3) [m].
        sharpness: Sharpness alpha of the gate [1/m].
        wrench_bias: Offset b_w of the wrench, shape (6,) [N m, N].
        force_bias: Offset b_f of each cluster's force in the cluster's frame, by the
            name of the cluster, shape (3,) each [N].
        cluster_points: Index of the point of interest under each cluster, by its name.
        reference_pose: Pose that the rigid variants count displacements from, shape (6,)
            [m, rad].
        wrench_slope: What `rigid_bias` adds to the wrench per relative pose, shape (6, 6)
            [N m, N per m, rad].
        parameter_factor: Factor of the covariance of the stiffnesses and rest displacements of the
            rigid variants, shape (6, n, r) [N/m, m]; r = 0 where it is unknown.
    """

    variant: Variant
    names: tuple[str, ...]
    anchors: FloatArray
    rotations: FloatArray
    stiffness: FloatArray
    rest_positions: FloatArray
    sharpness: float
    wrench_bias: FloatArray
    force_bias: dict[str, FloatArray]
    cluster_points: dict[str, int]
    reference_pose: FloatArray = field(default_factory=lambda: np.zeros(6))
    wrench_slope: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    parameter_factor: FloatArray = field(default_factory=lambda: np.zeros((6, 0, 0)))

    @property
    def is_rigid(self) -> bool:
        """Whether the model reads the limb's rotation and works in the tiles' frames."""
        return self.variant in RIGID_VARIANTS

    def forces(self, pose: FloatArray) -> FloatArray:
        """Forces F_i + b_i on the socket at the points of interest.

        Args:
            pose: Poses of the limb, position q and rotation vector, shape (N, 6) [m, rad]; the
                paper's variants read the position alone.

        Returns:
            Forces in {S}, shape (N, n, 3) [N]; NaN where the pose is NaN.
        """
        return self._spring_forces(self._motion(pose)) + self._bias_in_socket_frame()

    def wrench(self, pose: FloatArray) -> FloatArray:
        """Wrench ``C F + b_w`` at the load cell, in `rigid_bias` with its slope over the pose.

        The offsets of the clusters belong to the clusters' sensors: they are no part of
        the wrench.

        Args:
            pose: Poses of the limb, position q and rotation vector, shape (N, 6) [m, rad]; the
                paper's variants read the position alone.

        Returns:
            Wrenches [M; F] in {S}, shape (N, 6) [N m, N].
        """
        motion = self._motion(pose)
        return self._wrench_of(motion, self._bed_wrench(motion))

    def predict(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Wrenches and forces in one pass: see `wrench` and `forces`."""
        motion = self._motion(pose)
        springs = self._spring_forces(motion)
        wrench = self._wrench_of(motion, springs.reshape(len(pose), -1) @ self._wrench_map.T)
        return wrench, springs + self._bias_in_socket_frame()

    def _wrench_of(self, motion: FloatArray, springs: FloatArray) -> FloatArray:
        """The wrench of the springs with the offsets, shape (N, 6) [N m, N]."""
        wrench = springs + self.wrench_bias
        if self.variant == "rigid_bias":
            wrench += motion @ self.wrench_slope.T
        return wrench

    def _bed_wrench(self, motion: FloatArray) -> FloatArray:
        """Wrench of the springs alone, without their single forces, shape (N, 6) [N m, N]."""
        count, mapping = len(motion), self._wrench_map.reshape(6, -1, 3)
        if self.is_rigid:
            moved = (motion @ self._displacement_map.T).reshape(count, -1, 3)
            gated = spring_displacements(moved, self.rest_positions, self.sharpness)
            weights = np.matmul(self.rotations.transpose(0, 2, 1), mapping[..., None])[..., 0]
            return np.asarray(
                gated.reshape(count, -1) @ (weights * self.stiffness).reshape(6, -1).T
            )
        known = np.isfinite(motion).all(axis=1)
        wrench = np.full((count, 6), np.nan)
        wrench[known] = gated_sums(
            motion[known], self.rest_positions, self.sharpness, mapping * self.stiffness
        )
        return wrench

    def bed_forces(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        r"""Forces of the springs alone, with a factor of their covariance: a rigid variant's.

        The parameters' uncertainty, :math:`\Sigma = U U^T`, moves the forces by
        :math:`J(pose) U` to first order; the covariance of the forces is that times its transpose.

        Args:
            pose: Poses of the limb, shape (N, 6) [m, rad].

        Returns:
            Forces in {S} without the offsets of sensors, shape (N, n, 3) [N], and the factor,
            shape (N, n, 3, r) [N].
        """
        motion = self._motion(pose)
        moved = (motion @ self._displacement_map.T).reshape(len(pose), -1, 3)
        parameters = (self.stiffness.T, self.rest_positions.T, self.sharpness)
        changed = force_changes(moved, *parameters, self.parameter_factor)
        return self._spring_forces(motion), np.matmul(self.rotations, changed)

    def cluster_forces(self, pose: FloatArray) -> dict[str, FloatArray]:
        """Forces on the clusters, each in its cluster's frame, shape (N, 3) each [N]."""
        springs = self._spring_forces(self._motion(pose), list(self.cluster_points.values()))
        no_bias = np.zeros(3)
        return {
            name: springs[:, column] @ self.rotations[point] + self.force_bias.get(name, no_bias)
            for column, (name, point) in enumerate(self.cluster_points.items())
        }

    def _motion(self, pose: FloatArray) -> FloatArray:
        """What the law reads of poses: the relative pose in a rigid variant, or the position."""
        return relative_pose(pose, self.reference_pose) if self.is_rigid else pose[:, :3]

    def _spring_forces(
        self, motion: FloatArray, points: list[int] | slice = slice(None)
    ) -> FloatArray:
        """Forces of the springs at some points in {S}, shape (N, points, 3) [N]."""
        stiffness, rest = self.stiffness[points], self.rest_positions[points]
        if not self.is_rigid:
            return stiffness * gated_displacement(motion, rest, self.sharpness)
        moved = (motion @ self._displacement_map.T).reshape(len(motion), -1, 3)[:, points]
        local = stiffness * spring_displacements(moved, rest, self.sharpness)
        return np.matmul(self.rotations[points], local[..., None])[..., 0]

    @cached_property
    def _displacement_map(self) -> FloatArray:
        return displacement_map(self.anchors, self.rotations, self.reference_pose[:3])

    @cached_property
    def _wrench_map(self) -> FloatArray:
        return wrench_map(self.anchors)

    def _bias_in_socket_frame(self) -> FloatArray:
        bias = np.zeros_like(self.anchors)
        for name, force in self.force_bias.items():
            point = self.cluster_points[name]
            bias[point] = self.rotations[point] @ force
        return bias
