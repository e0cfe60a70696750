r"""The published contact law: springs along the axes of {S}, moved by the limb's position.

.. math:: F_i = k_i \circ g(\delta_i) \circ \delta_i, \qquad \delta_i = q - q_{r,i}

The gate acts on each axis of {S}. Rest positions are in {S}; a fit counts them from the mean limb
position, about which Stage 1 has a box. The prior is the mean square difference of neighbours.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.identification.contact_law import (
    ContactLaw,
    Loading,
    Sizes,
    gate,
    neighbour_differences,
)
from socket_testbed.settings.identification import IdentificationSettings

_STIFFNESS, _DISTANCE = 1e3, 1e-3  # [N/m, m]; scales of the parameters


class PaperLaw(ContactLaw):
    """The paper's law: see this module."""

    REFINED = False
    OFFSETS_THROUGHOUT = False
    MOST_ROWS = None
    GATES = (0, 1, 2)

    @property
    def frames(self) -> FloatArray:
        """Those of {S}, for every tile."""
        return np.broadcast_to(np.eye(3), (len(self.anchors), 3, 3))

    def motion_map(self) -> FloatArray:
        """Every tile moves with the limb's position."""
        return self.frames

    def motion(self, pose: FloatArray) -> FloatArray:
        """Positions since the reference position, shape (N, 3) [m]."""
        return pose[:, :3] - self.reference_pose[:3]

    def columns(self, moved: FloatArray) -> FloatArray:
        """Gated displacements, axis by axis."""
        return moved * gate(moved, self.sharpness)

    @classmethod
    def sharpness_of(cls, settings: IdentificationSettings) -> float:
        """That of `gate_sharpness`."""
        return settings.gate_sharpness

    @classmethod
    def reference_of(cls, pose: FloatArray, settings: IdentificationSettings) -> FloatArray:
        """The middle q_ref of the box of rest positions: the mean position, unless it is given."""
        middle = settings.reference_position or pose[:, :3].mean(axis=0)
        return np.concatenate([middle, np.zeros(3)])

    def resolved(
        self, settings: IdentificationSettings, loading: Loading
    ) -> IdentificationSettings:
        """With k0 by the slope of the wrench where it is to follow from the samples."""
        if settings.initial_stiffness > 0.0:
            return settings
        slope, least = self.bed_stiffness(loading, np.ones(3))[0], self.least_stiffness(loading)[1]
        return replace(settings, initial_stiffness=max(slope, least))

    def sizes(self, settings: IdentificationSettings, loading: Loading) -> Sizes:
        """Sizes as the settings give them; the smoothness has no centre."""
        points, pairs = len(self.anchors), max(len(loading.neighbours), 1)
        scale = np.repeat([_STIFFNESS, _DISTANCE], 3)[:, None] * np.ones(points)
        limit = settings.rest_position_limit
        differences = neighbour_differences(points, loading.neighbours)
        smooth = settings.smoothness / (3.0 * pairs) * differences  # mean over axes and pairs
        expected = settings.stiffness_difference, settings.rest_position_difference
        weights = [(_STIFFNESS / expected[0]) ** 2, (_DISTANCE / expected[1]) ** 2]
        return Sizes(
            scale=scale,
            start=np.zeros_like(scale),
            springs=np.full((3, points), settings.initial_stiffness),
            lower=np.repeat([0.0, -limit], 3)[:, None] / scale,
            upper=np.repeat([np.inf, limit], 3)[:, None] / scale,
            prior=np.multiply.outer(weights, smooth),
        )

    def stored(self, rest: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rest positions in {S}."""
        return rest.T + self.reference_pose[:3], np.zeros(6)
