r"""The contact law of the `rigid` variants: tiles that a rigid limb presses on.

With the pose of the limb relative to a reference pose (position c, rotation R_ref), that is its
displacement q - c and its rotation vector phi, the tile at a_i is displaced by

.. math:: u_i = q - c + \phi \times (a_i - c), \qquad v_i = R_i^T u_i, \qquad
          \delta_i = v_i - r_i

with v_i in the tile's own frame {L_i} (z along the inward normal) and r_i its rest displacement,
at which the tile bears nothing. Compression along the normal gates normal and shear alike:

.. math:: F_i = \left( k_x g \delta_x,\; k_y g \delta_y,\; -k_z p \right), \qquad
          p = \frac{\ln(1 + e^{-2 \alpha \delta_z})}{2 \alpha}, \qquad
          g = -\frac{dp}{d\delta_z} = \frac{1}{1 + e^{2 \alpha \delta_z}}

g is the paper's gate; p is its integral, so that a tile never pulls, and its stiffness grows over
the first 1 / alpha of compression as that of a layer that comes into contact bit by bit.

The expected stiffnesses, normal and tangential, are those of the uniform bed that best explains
how the wrench changes with the pose; the expected rest displacement is the mean load over that
bed's stiffness. So no stiffness is assumed. With Q = epsilon I + D'D, D the differences of
neighbours, the prior is :math:`\lambda/(3n) \sum_a (x_a - \bar x_a)^T Q (x_a - \bar x_a)` against
an objective that is 1 where zero is predicted; x_a are the stiffnesses along an axis over their
expected value, with mean 1, and the rest displacements over theirs, with mean 0.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed.arrays import FloatArray
from socket_testbed.identification.contact_law import (
    ContactLaw,
    Loading,
    Sizes,
    gate,
    neighbour_differences,
)
from socket_testbed.settings.identification import IdentificationSettings

OWN = 0.3  # [-]; epsilon: how far a tile may be from the common mean, against its neighbours
_RATIOS = (0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0)  # [-]; of tangential to normal stiffness
_LEAST_SETTLING = 1e-4  # [m]
_SLOPE_RIDGE = 0.003  # [-]; against the variance of the pose
_LEAST_CHANGE = 0.01  # [-]; of the force, against its size, that a slope needs
_LEAST_MOTION = 1e-9  # [m, rad]; less is rounding of a pose that stands still


def relative_pose(pose: FloatArray, reference: FloatArray) -> FloatArray:
    """Displacement and rotation vector since a reference pose, both in {S}.

    Args:
        pose: Position and rotation vector, shape (N, 6) [m, rad].
        reference: The same of the reference, shape (6,) [m, rad].

    Returns:
        ``[q - c, phi]`` with ``R = exp(phi) R_ref``, shape (N, 6) [m, rad]; NaN where the pose is.
    """
    relative = pose - reference
    known = np.isfinite(relative).all(axis=1)
    relative[~known] = np.nan
    if known.any():
        turned = Rotation.from_rotvec(pose[known, 3:]) * Rotation.from_rotvec(-reference[3:])
        relative[known, 3:] = turned.as_rotvec()
    return relative


class RigidLaw(ContactLaw):
    """A rigid limb on tiles: see this module."""

    REFINED = True
    OFFSETS_THROUGHOUT = True
    MOST_ROWS = 500
    GATES = (2,)

    @property
    def frames(self) -> FloatArray:
        """Those of the tiles."""
        return self.rotations

    def motion_map(self) -> FloatArray:
        """Displacements of the tiles' centres on a rigid limb."""
        arms = self.anchors - self.reference_pose[:3]
        turns = np.cross(np.eye(3), arms[:, None]).swapaxes(1, 2)  # columns e_j x arm
        return np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns], axis=2)

    def motion(self, pose: FloatArray) -> FloatArray:
        """Relative poses, shape (N, 6) [m, rad]."""
        return relative_pose(pose, self.reference_pose)

    def columns(self, moved: FloatArray) -> FloatArray:
        """(g delta_x, g delta_y, -p)."""
        opened = gate(moved[:, 2], self.sharpness)
        with np.errstate(invalid="ignore"):  # NaN stays NaN
            pressed = np.logaddexp(0.0, (-2.0 * self.sharpness) * moved[:, 2])
        columns = moved * opened[:, None]
        columns[:, 2] = pressed / (-2.0 * self.sharpness)
        return columns

    def slopes(self, moved: FloatArray) -> dict[tuple[int, int], FloatArray]:
        """Derivatives of the columns."""
        x, y, z = np.moveaxis(moved, 1, 0)
        opened = gate(z, self.sharpness)
        slope = self._gate_slope(opened)
        shear = {(0, 2): slope * x, (1, 2): slope * y}
        return {(axis, axis): opened for axis in range(3)} | shear

    def bends(self, moved: FloatArray) -> dict[tuple[int, int, int], FloatArray]:
        """Second derivatives of the columns."""
        x, y, z = np.moveaxis(moved, 1, 0)
        opened = gate(z, self.sharpness)
        slope = self._gate_slope(opened)
        twist = -2.0 * self.sharpness * slope * (1.0 - 2.0 * opened)
        return {
            (0, 0, 2): slope,
            (0, 2, 2): twist * x,
            (1, 1, 2): slope,
            (1, 2, 2): twist * y,
            (2, 2, 2): slope,
        }

    def _gate_slope(self, opened: FloatArray) -> FloatArray:
        """Derivative of gates by the displacement along the normal, of the same shape [1/m]."""
        return -2.0 * self.sharpness * opened * (1.0 - opened)

    @classmethod
    def sharpness_of(cls, settings: IdentificationSettings) -> float:
        """That of `contact_sharpness`."""
        return settings.contact_sharpness

    @classmethod
    def reference_of(cls, pose: FloatArray, settings: IdentificationSettings) -> FloatArray:
        """The mean pose on SE(3)."""
        rotation = Rotation.from_rotvec(pose[:, 3:]).mean().as_rotvec()
        return np.concatenate([pose[:, :3].mean(axis=0), rotation])

    def sizes(self, settings: IdentificationSettings, loading: Loading) -> Sizes:
        """Sizes as the data show them: see this module."""
        stiffness, rest = self._expect(loading)
        points = len(self.anchors)
        prior = OWN * np.eye(points) + neighbour_differences(points, loading.neighbours)
        weight = loading.zero * settings.prior / (3.0 * points)
        ones = np.ones((6, points))
        upper = np.inf * ones
        return Sizes(
            scale=np.array([*stiffness, rest, rest, rest])[:, None] * ones,
            start=np.repeat([1.0, 0.0], 3)[:, None] * ones,
            springs=stiffness[:, None] * ones[:3],
            lower=np.where(np.arange(6)[:, None] < 3, 0.0, -upper),
            upper=upper,
            prior=weight * np.stack([prior, prior]),
        )

    def _expect(self, loading: Loading) -> tuple[FloatArray, float]:
        """Expected stiffness along x, y, z [N/m] and rest displacement [m]: see the module."""
        best, stiffness = np.inf, np.zeros(3)
        for ratio in _RATIOS:
            along = np.array([ratio, ratio, 1.0])
            normal, miss = self.bed_stiffness(loading, along)
            if miss < best:
                best, stiffness = miss, normal * along
        load, least = self.least_stiffness(loading)
        if stiffness.mean() < least:  # the limb hardly moved
            stiffness = np.full(3, least) if not stiffness.any() else stiffness
            stiffness *= least / stiffness.mean()
        return stiffness, max(load / (len(self.anchors) * float(stiffness.mean())), _LEAST_SETTLING)

    def wrench_offsets(
        self, motion: FloatArray, residual: FloatArray, wrench: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Constant and slope over the pose by ridge regression on the standardised pose.

        No slope along what did not move, and hardly any where the force hardly changed. On a hold
        the limb creeps under one load, and a slope that fits this would cancel the springs.
        """
        mean, spread = motion.mean(axis=0), motion.std(axis=0)
        inverse = 1.0 / np.where(spread > _LEAST_MOTION, spread, np.inf)
        scaled = (motion - mean) * inverse
        force = wrench[:, 3:]
        change = float(np.sqrt(force.var(axis=0).sum()))
        size = float(np.sqrt((force**2).sum(axis=1).mean()))
        ridge = _SLOPE_RIDGE + (_LEAST_CHANGE * size / max(change, 1e-9)) ** 2
        gram = scaled.T @ scaled / len(scaled) + ridge * np.eye(6)
        left = residual - residual.mean(axis=0)
        slope = np.linalg.solve(gram, scaled.T @ left / len(scaled)).T * inverse
        return residual.mean(axis=0) - slope @ mean, slope
