r"""Contact of limb and socket: laws that map motion to forces, and models built on them.

Forces are those of the limb on the socket. All quantities are in the frame of the load cell, {S},
unless stated otherwise. A wrench is ordered [M; F]. A contact law reads

.. math:: F_i = B_i \, \bigl(k_i \circ s(v_i - r_i)\bigr), \qquad v = J u

with the limb's motion u since a reference pose, the displacement v_i of tile i in the law's own
frame B_i, its rest displacement r_i and stiffnesses k_i. A law defines u, B, J and s, and the
scales of its parameters; `problem` does the rest for any law. In arrays the frame's axis precedes
the tile. To add a law, derive from `ContactLaw`, and list its variants in `LAWS` and in
`settings.identification`; outside the package, `register_law` does both.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from inspect import isabstract
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.identification.wrench import PoseTrail, WrenchModel
from socket_testbed.samples import relative_pose
from socket_testbed.settings.identification import IdentificationSettings, add_variant

_CHUNK = 512  # samples of a prediction at once, whose springs then stay in the cache
_MAX_SETTLING = 0.02  # [m]; limit for a loaded limb, which bounds the bed's stiffness below


def gate(displacement: FloatArray, sharpness: float) -> FloatArray:
    r"""Smooth unilateral gate, :math:`g(d) = 1/2 - 1/2 \tanh(\alpha d) = 1 / (1 + e^{2 \alpha d})`.

    It tends to 1 in compression and to 0 away from the wall.

    Args:
        displacement: Displacements d from rest, of any shape [m]; negative in compression.
        sharpness: Sharpness alpha [1/m].

    Returns:
        The gates, within 0 to 1, of the shape of the displacements [-]; NaN for NaN.
    """
    found = np.array(displacement, dtype=np.float64)
    found *= 2.0 * sharpness  # in place: fits of long trials spend much of their time here
    # Far outside the contact the exponential overflows to infinity, where the gate is 0.
    with np.errstate(over="ignore"):
        np.exp(found, out=found)
    found += 1.0
    return np.divide(1.0, found, out=found)


def relative_change(force: FloatArray) -> float:
    """Standard deviation of forces, shape (N, 3) [N], over their RMS [-]; 0 without force."""
    change, size = np.sqrt(force.var(axis=0).sum()), np.sqrt((force**2).sum(axis=1).mean())
    return float(change / size) if size else 0.0


def wrench_map(anchors: FloatArray) -> FloatArray:
    r"""Constant map C of the point forces onto the wrench, ``[M; F] = C F``.

    .. math:: C = \begin{bmatrix} [a_1]_\times & \dots & [a_n]_\times \\
                                  I & \dots & I \end{bmatrix}

    For points of application a_i in {S}, shape (n, 3) [m], it has the shape (6, 3n): the rows of
    the moment are in m, those of the force have no unit. Columns run over x, y, z of each point.
    """
    moments = np.cross(anchors[:, None], np.eye(3))  # a_i x e_j
    return np.vstack([moments.reshape(-1, 3).T, np.tile(np.eye(3), len(anchors))])


def rigid_motions(arms: FloatArray) -> FloatArray:
    """Displacements of points by a small translation, then rotation, of a body, (n, 3, 6) [-, m].

    The arms from the centre of rotation to the points have the shape (n, 3) [m]. By virtual work
    the displacements are the transpose of `wrench_map`.
    """
    return np.roll(wrench_map(arms).reshape(6, -1, 3), 3, axis=0).transpose(1, 2, 0)


def neighbour_differences(points: int, neighbours: IntArray) -> FloatArray:
    """Matrix D'D of the differences between neighbours, shape (n, n) [-].

    Args:
        points: The number n of tiles.
        neighbours: Indices of the two tiles of each pair of neighbours, shape (e, 2); D has a row
            for each.
    """
    D = np.eye(points)[neighbours[:, 0]] - np.eye(points)[neighbours[:, 1]]
    return D.T @ D


@dataclass(frozen=True)
class Loading:
    """The samples from which a law derives the scales of its parameters.

    The N rows are the samples of a fit, or means over blocks of them (`ContactLaw.MAX_ROWS`).

    Attributes:
        motion: Motions u of the limb in {S}, shape (N, m) [m] or [m, rad]: see `ContactLaw.motion`.
        wrench: Measured wrenches [M; F] in {S}, shape (N, 6) [N m, N]; 0 for channels that are not
            in the objective.
        shares: Weight of each squared error of the wrench in J_w (see `problem`), shape (6,)
            [1/(N m)^2, 1/N^2]; 0 for channels that are not in the objective.
        neighbours: Indices of the two tiles of each pair of neighbours, shape (e, 2).
        zero: Objective of predicting zero, without the prior [-].
    """

    motion: FloatArray
    wrench: FloatArray
    shares: FloatArray
    neighbours: IntArray
    zero: float


@dataclass(frozen=True)
class Sizes:
    """Scales, bounds and prior of a law's parameters, a row per parameter of a tile.

    The six rows are the stiffnesses along the three axes of the law's frame, then the rest
    displacements along them. The prior is :math:`(x - x_0)^T Q (x - x_0)` in the scaled parameters
    x; all three axes share one Q.

    Attributes:
        scale: Divisors that scale the parameters, shape (6, n) [N/m, m].
        start: Centre x_0 of the prior, shape (6, n) [-].
        springs: Stiffnesses of the linear springs of Stage 1 along the axes, shape (3, n) [N/m].
        limit: Largest size of a rest displacement along an axis [m]; infinite for none.
        prior: Q of the stiffnesses, then of the rest displacements, shape (2, n, n) [-].
    """

    scale: FloatArray
    start: FloatArray
    springs: FloatArray
    limit: float
    prior: FloatArray


@dataclass
class ContactLaw(ABC):
    """Springs between the limb and the tiles: see the module.

    Attributes:
        anchors: Points of application a_i, the tiles' centres in {S}, shape (n, 3) [m].
        rotations: Frames {L_i} of the tiles, shape (n, 3, 3) [-]; R_i maps {L_i} to {S}, its
            columns are x (proximal), y and z (inward normal).
        sharpness: Sharpness alpha of the gate [1/m].
        reference_pose: Pose of the limb in {S} where the motion is zero: position and rotation
            vector, shape (6,) [m, rad].
        IN_TILES: Whether stiffnesses and rest displacements are along the tiles' axes; otherwise
            they are along those of {S}, and rest positions are those of the limb.
        REFINED: Whether both stages are refined jointly, which requires `slopes` and `bends`.
        OFFSETS_THROUGHOUT: Whether a variant with offsets has those of the clusters in both stages,
            and fits the wrench's offset to the residual of the springs; otherwise both are
            constants of Stage 2.
        MAX_ROWS: Most rows of a fit, above which it averages over equal blocks of samples; None
            for no limit.
        GATES: Axes of the law's frames along which displacements are gated, of 0, 1, 2.
        SHARPNESS: Name of the setting that gives the sharpness.
    """

    anchors: FloatArray
    rotations: FloatArray
    sharpness: float
    reference_pose: FloatArray

    IN_TILES: ClassVar[bool] = False
    REFINED: ClassVar[bool] = False
    OFFSETS_THROUGHOUT: ClassVar[bool] = False
    MAX_ROWS: ClassVar[int | None] = None
    GATES: ClassVar[tuple[int, ...]]
    SHARPNESS: ClassVar[str]

    @property
    def frames(self) -> FloatArray:
        """The law's frames B_i, which map to {S}: the tiles' or {S} itself, shape (n, 3, 3) [-]."""
        axes = np.broadcast_to(np.eye(3), self.rotations.shape)
        return self.rotations if self.IN_TILES else axes

    @abstractmethod
    def motion_map(self) -> FloatArray:
        """Displacements of the tiles in {S} per unit of motion, shape (n, 3, m) [-] or [-, m]."""

    @cached_property
    def jacobian(self) -> FloatArray:
        """J from a motion to the displacements in the law's frames, shape (3n, m) [-] or [-, m].

        The rows are the n tiles along the first axis, then along the second and third.
        """
        turned = np.einsum("nia,nij->anj", self.frames, self.motion_map())
        return turned.reshape(-1, turned.shape[2])

    @cached_property
    def onto(self) -> FloatArray:
        """Map of the forces in the law's frames onto the wrench [M; F] in {S}, (6, 3, n) [m, -].

        The axes are the wrench's channels, the axes of the law's frame and the tiles.
        """
        in_socket = wrench_map(self.anchors).reshape(6, -1, 3)
        return np.einsum("cni,nia->can", in_socket, self.frames)

    def displacements(self, motion: FloatArray) -> FloatArray:
        """Displacements v of the tiles in the law's frames, shape (N, 3, n) [m].

        The N motions of the limb have the shape (N, m): see `motion`.
        """
        return np.asarray((motion @ self.jacobian.T).reshape(len(motion), 3, -1))

    @abstractmethod
    def motion(self, pose: FloatArray) -> FloatArray:
        """Motions u of the limb since the reference pose, along the axes of {S}, shape (N, m).

        Poses are positions and rotation vectors in {S}, shape (N, 6) [m, rad]. Motions are
        displacements [m], in the rigid variants followed by rotations [rad].
        """

    @abstractmethod
    def columns(self, moved: FloatArray) -> FloatArray:
        """Columns s of the stiffnesses at displacements from rest v - r, shape (N, 3, n) [m] each.

        A column times its stiffness is a force on the socket along an axis of the law's frame.
        """

    def slopes(self, moved: FloatArray) -> dict[tuple[int, int], FloatArray]:
        """Nonzero derivatives of the columns s by the displacements v, shape (N, n) [-] each.

        Keys are the axis of s and that of v; displacements from rest have the shape (N, 3, n) [m].
        """
        raise NotImplementedError

    def bends(self, moved: FloatArray) -> dict[tuple[int, int, int], FloatArray]:
        """Nonzero second derivatives of the columns s, shape (N, n) [1/m] each.

        Keys are the axis of s and two ascending axes of v; displacements from rest have the shape
        (N, 3, n) [m].
        """
        raise NotImplementedError

    @classmethod
    @abstractmethod
    def reference_of(cls, pose: FloatArray, settings: IdentificationSettings) -> FloatArray:
        """Reference pose of a fit in {S}, position and rotation vector, shape (6,) [m, rad].

        Args:
            pose: Poses of the limb in the fit, shape (N, 6) [m, rad].
            settings: Settings of the fit, which may state a `reference_position`.
        """

    @abstractmethod
    def sizes(self, settings: IdentificationSettings, loading: Loading) -> Sizes:
        """Scales, bounds and prior of the parameters in a fit.

        Args:
            settings: Settings of the fit.
            loading: Its motions and wrenches, from which expected stiffnesses follow.
        """

    def bed_stiffness(self, loading: Loading, along: FloatArray) -> tuple[float, float]:
        """Stiffness of the uniform bed that best explains how the wrench changes with the motion.

        Args:
            loading: Motions and wrenches; their means do not matter.
            along: Ratios of the stiffnesses along the three axes of the law's frame to the
                stiffness of the bed, shape (3,) [-].

        Returns:
            The stiffness, 0 or more [N/m], and the sum over the rows of the squared residuals times
            `Loading.shares` [-].
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

    def min_stiffness(self, loading: Loading) -> tuple[float, float]:
        """Mean load [N], and the stiffness [N/m] at which n springs carry it within 20 mm.

        The load is the magnitude of the loading's mean force, 1 N or more.
        """
        load = max(float(np.linalg.norm(loading.wrench[:, 3:].mean(axis=0))), 1.0)
        return load, load / (len(self.anchors) * _MAX_SETTLING)

    def stored(self, rest: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rest positions and reference pose of a `ContactModel`, (n, 3) [m] and (6,) [m, rad].

        The rest displacements r are in the law's frames, shape (3, n) [m].
        """
        if self.IN_TILES:
            return rest.T.copy(), self.reference_pose
        return rest.T + self.reference_pose[:3], np.zeros(6)

    def wrench_offsets(
        self, motion: FloatArray, residual: FloatArray, wrench: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Offset of the wrench that the springs leave: a constant, without slope.

        Args:
            motion: Motions of the limb, shape (N, m): see `motion`.
            residual: Measured wrench less that of the springs, in {S}, shape (N, 6) [N m, N]; 0 for
                channels that are not in the objective.
            wrench: Measured wrench in {S}, shape (N, 6) [N m, N]; 0 for channels that are not in
                the objective.

        Returns:
            The constant, shape (6,) [N m, N], and its slope over the motion, shape (6, 6), with
            a row per channel [N m, N per m, rad].
        """
        return residual.mean(axis=0), np.zeros((6, 6))


_STIFFNESS, _DISTANCE = 1e3, 1e-3  # [N/m, m]; scales of the parameters


class PaperLaw(ContactLaw):
    r"""The published law: springs along the axes of {S}, driven by the limb's position.

    .. math:: F_i = k_i \circ g(\delta_i) \circ \delta_i, \qquad \delta_i = q - q_{r,i}

    The gate acts on each axis of {S}. Rest positions are in {S}; a fit measures them from the mean
    limb position, the centre of the box of Stage 1. The prior is the mean square difference of
    neighbours.
    """

    GATES = (0, 1, 2)
    SHARPNESS = "gate_sharpness"

    def motion_map(self) -> FloatArray:
        """Every tile moves with the limb's position: unit matrices, shape (n, 3, 3) [-]."""
        return self.frames

    def motion(self, pose: FloatArray) -> FloatArray:
        """Positions in {S} since the reference position, shape (N, 3) [m].

        The poses have the shape (N, 6) [m, rad]; their rotations do not matter.
        """
        return pose[:, :3] - self.reference_pose[:3]

    def columns(self, moved: FloatArray) -> FloatArray:
        """Gated displacements along x, y, z of {S}, from ungated ones, (N, 3, n) [m] each."""
        return moved * gate(moved, self.sharpness)

    @classmethod
    def reference_of(cls, pose: FloatArray, settings: IdentificationSettings) -> FloatArray:
        """Centre q_ref of the box of rest positions in {S}, shape (6,) [m, rad]; no rotation.

        Args:
            pose: Poses of the limb in the fit, shape (N, 6) [m, rad], whose mean position is the
                centre unless the settings state one.
            settings: Settings of the fit; `reference_position` is the centre if it is not empty.
        """
        middle = settings.reference_position or pose[:, :3].mean(axis=0)
        return np.concatenate([middle, np.zeros(3)])

    def sizes(self, settings: IdentificationSettings, loading: Loading) -> Sizes:
        """Sizes from the settings; the smoothness has no centre.

        Args:
            settings: Settings of the fit, with its limits and expected differences of neighbours.
            loading: Motions and wrenches of the fit. If the settings have no k0, it follows from
                the slope of the wrench over the motion.
        """
        stiffness = settings.initial_stiffness or max(
            self.bed_stiffness(loading, np.ones(3))[0], self.min_stiffness(loading)[1]
        )
        points, pairs = len(self.anchors), max(len(loading.neighbours), 1)
        scale = np.repeat([_STIFFNESS, _DISTANCE], 3)[:, None] * np.ones(points)
        differences = neighbour_differences(points, loading.neighbours)
        smooth = settings.smoothness / (3.0 * pairs) * differences  # mean over axes and pairs
        expected = settings.stiffness_difference, settings.rest_position_difference
        weights = [(_STIFFNESS / expected[0]) ** 2, (_DISTANCE / expected[1]) ** 2]
        return Sizes(
            scale=scale,
            start=np.zeros_like(scale),
            springs=np.full((3, points), stiffness),
            limit=settings.rest_position_limit,
            prior=np.multiply.outer(weights, smooth),
        )


MEAN_WEIGHT = 0.3  # [-]; epsilon: weight of the common mean, relative to the neighbours
_SHEAR_RATIOS = (0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0)  # [-]; of tangential to normal stiffness
_MIN_SETTLING = 1e-4  # [m]
_SLOPE_RIDGE = 0.003  # [-]; relative to the variance of the pose
_MIN_CHANGE = 0.01  # [-]; of the force, relative to its RMS, for a slope
_MIN_MOTION = 1e-9  # [m, rad]; less is rounding of a constant pose


class RigidLaw(ContactLaw):
    r"""The law of the `rigid` variants: a rigid limb presses on the tiles.

    With the limb's displacement q - c and rotation vector phi since a reference pose (position c,
    rotation R_ref), the tile at a_i is displaced by

    .. math:: u_i = q - c + \phi \times (a_i - c), \qquad v_i = R_i^T u_i, \qquad
              \delta_i = v_i - r_i

    with v_i in the tile's frame {L_i} (z along the inward normal) and the rest displacement r_i,
    at which the tile is unloaded. Compression along the normal gates normal and shear alike:

    .. math:: F_i = \left( k_x g \delta_x,\; k_y g \delta_y,\; -k_z p \right), \qquad
              p = \frac{\ln(1 + e^{-2 \alpha \delta_z})}{2 \alpha}, \qquad
              g = -\frac{dp}{d\delta_z} = \frac{1}{1 + e^{2 \alpha \delta_z}}

    g is the paper's gate. As p is its integral, a tile never pulls, and its stiffness rises over
    the first 1 / alpha of compression, like that of a layer that comes into contact gradually.

    No stiffness is assumed: the expected normal and tangential stiffnesses are those of the uniform
    bed that best explains how the wrench changes with the pose; the expected rest displacement is
    the mean load over that bed's stiffness. With Q = epsilon I + D'D, D the differences of
    neighbours, the prior is
    :math:`\lambda/(3n) \sum_a (x_a - \bar x_a)^T Q (x_a - \bar x_a)`, in an objective that is 1
    for a prediction of zero; x_a are the stiffnesses along an axis, divided by their expected
    value, with mean 1, and the rest displacements along it, divided by theirs, with mean 0.
    """

    IN_TILES = True
    REFINED = True
    OFFSETS_THROUGHOUT = True
    MAX_ROWS = 500
    GATES = (2,)
    SHARPNESS = "contact_sharpness"

    def motion_map(self) -> FloatArray:
        """Displacements of the tiles' centres in {S}, moved with the limb, (n, 3, 6) [-, m]."""
        return rigid_motions(self.anchors - self.reference_pose[:3])

    def motion(self, pose: FloatArray) -> FloatArray:
        """Displacements and rotations since the reference pose in {S}, shape (N, 6) [m, rad].

        The poses have the shape (N, 6) [m, rad]: see `relative_pose`.
        """
        return relative_pose(pose, self.reference_pose)

    def columns(self, moved: FloatArray) -> FloatArray:
        """(g delta_x, g delta_y, -p) in the tiles' frames, from delta, (N, 3, n) [m] each."""
        opened = gate(moved[:, 2], self.sharpness)
        with np.errstate(invalid="ignore"):  # NaN stays NaN
            pressed = np.logaddexp(0.0, (-2.0 * self.sharpness) * moved[:, 2])
        columns = moved * opened[:, None]
        columns[:, 2] = pressed / (-2.0 * self.sharpness)
        return columns

    def slopes(self, moved: FloatArray) -> dict[tuple[int, int], FloatArray]:
        """Derivatives of the columns, shape (N, n) [-] each, at displacements (N, 3, n) [m]."""
        opened, slope = self._opened(moved)
        shear = {(axis, 2): slope * moved[:, axis] for axis in (0, 1)}
        return {(axis, axis): opened for axis in range(3)} | shear

    def bends(self, moved: FloatArray) -> dict[tuple[int, int, int], FloatArray]:
        """Second derivatives of the columns, (N, n) [1/m] each, at displacements (N, 3, n) [m]."""
        opened, slope = self._opened(moved)
        twist = -2.0 * self.sharpness * slope * (1.0 - 2.0 * opened)
        shear = {(axis, 2, 2): twist * moved[:, axis] for axis in (0, 1)}
        return {(axis, axis, 2): slope for axis in range(3)} | shear

    def _opened(self, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The gates [-] and their derivatives by the displacement along the normal [1/m]."""
        opened = gate(moved[:, 2], self.sharpness)
        return opened, -2.0 * self.sharpness * opened * (1.0 - opened)

    @classmethod
    def reference_of(cls, pose: FloatArray, settings: IdentificationSettings) -> FloatArray:
        """The mean position and the mean rotation in {S}, shape (6,) [m, rad].

        Args:
            pose: Poses of the limb in the fit, shape (N, 6) [m, rad].
            settings: Settings of the fit; no setting matters here.
        """
        rotation = Rotation.from_rotvec(pose[:, 3:]).mean().as_rotvec()
        return np.concatenate([pose[:, :3].mean(axis=0), rotation])

    def sizes(self, settings: IdentificationSettings, loading: Loading) -> Sizes:
        """Sizes from the data: see the class.

        Args:
            settings: Settings of the fit, of which `prior` weighs the prior.
            loading: Motions and wrenches of the fit.
        """
        stiffness, rest = self._expect(loading)
        points = len(self.anchors)
        prior = MEAN_WEIGHT * np.eye(points) + neighbour_differences(points, loading.neighbours)
        weight = loading.zero * settings.prior / (3.0 * points)
        ones = np.ones((6, points))
        return Sizes(
            scale=np.array([*stiffness, rest, rest, rest])[:, None] * ones,
            start=np.repeat([1.0, 0.0], 3)[:, None] * ones,
            springs=stiffness[:, None] * ones[:3],
            limit=np.inf,
            prior=weight * np.stack([prior, prior]),
        )

    def _expect(self, loading: Loading) -> tuple[FloatArray, float]:
        """Expected stiffness along x, y, z [N/m] and rest displacement [m]: see the class."""
        beds = [np.array([ratio, ratio, 1.0]) for ratio in _SHEAR_RATIOS]
        found = [self.bed_stiffness(loading, along) for along in beds]
        best = int(np.argmin([miss for _, miss in found]))
        stiffness = found[best][0] * beds[best]
        load, least = self.min_stiffness(loading)
        if stiffness.mean() < least:  # the limb hardly moved
            stiffness = stiffness if stiffness.any() else np.ones(3)
            stiffness *= least / stiffness.mean()
        return stiffness, max(load / (len(self.anchors) * float(stiffness.mean())), _MIN_SETTLING)

    def wrench_offsets(
        self, motion: FloatArray, residual: FloatArray, wrench: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Constant and slope over the pose by ridge regression on the standardised pose.

        The slope is zero along components that did not move, and small if the force hardly changed:
        in a hold the limb creeps under constant load, and fitting that would cancel the springs.

        Args:
            motion: Displacements and rotations since the reference pose, shape (N, 6) [m, rad].
            residual: Measured wrench less that of the springs, in {S}, shape (N, 6) [N m, N]; 0 for
                channels that are not in the objective.
            wrench: Measured wrench in {S}, shape (N, 6) [N m, N], whose force shows how much the
                load changed.

        Returns:
            The constant, shape (6,) [N m, N], and the slope over the motion, shape (6, 6), with
            a row per channel [N m, N per m, rad].
        """
        mean, spread = motion.mean(axis=0), motion.std(axis=0)
        inverse = 1.0 / np.where(spread > _MIN_MOTION, spread, np.inf)
        scaled, left = (motion - mean) * inverse, residual - residual.mean(axis=0)
        ridge = _SLOPE_RIDGE + (_MIN_CHANGE / max(relative_change(wrench[:, 3:]), 1e-9)) ** 2
        gram = scaled.T @ scaled / len(scaled) + ridge * np.eye(6)
        slope = np.linalg.solve(gram, scaled.T @ left / len(scaled)).T * inverse
        return residual.mean(axis=0) - slope @ mean, slope


LAWS: dict[str, type[ContactLaw]] = {
    "stiffness": PaperLaw,
    "stiffness_bias": PaperLaw,
    "rigid": RigidLaw,
    "rigid_bias": RigidLaw,
}
"""The law of each variant; `register_law` adds others."""


def register_law(variant: str, law: type[ContactLaw], offsets: bool = False) -> None:
    """Make a contact law of one's own a variant, until Python ends.

    `st.fit` then takes the variant by its name, and models of it are saved, read, evaluated and
    compared by `st.validate` like any other. A model's file names its law but does not hold it:
    whatever reads the file registers the law first, so that live nodes and the command line, which
    know the package's laws alone, refuse it.

    Args:
        variant: Name of the variant, such as `hardening`; a name registered before gets this law.
        law: The class of the law, derived from `contact.ContactLaw` or one of its laws.
        offsets: Whether constant offsets of the wrench and the clusters are fitted, too.

    Raises:
        ConfigurationError: The name is one of the package's or none, or the law is not a complete
            `ContactLaw`.

    >>> from socket_testbed.identification.contact import RigidLaw
    >>> class Sharp(RigidLaw):
    ...     SHARPNESS = "gate_sharpness"  # 2000 /m, not 1000 /m
    >>> st.register_law("sharp", Sharp)
    >>> st.fit(st.open_trial("trials/hold"), variant="sharp")
    TrialFit(sharp on hold, plateau ... s, theta 0.5; mean moment RMSE ... N)
    """
    if not (isinstance(law, type) and issubclass(law, ContactLaw)) or isabstract(law):
        lacking = ", ".join(sorted(getattr(law, "__abstractmethods__", ()))) or "its methods"
        raise ConfigurationError(
            f"the law of '{variant}' is no complete ContactLaw",
            f"derive a class from it that defines {lacking}",
        )
    add_variant(variant, offsets)
    LAWS[variant] = law


def law_of(variant: str) -> type[ContactLaw]:
    """The law of a variant.

    Raises:
        ConfigurationError: If it is neither of the package nor registered.
    """
    if variant not in LAWS:
        hint = "name one of the package's, or register its law first, with st.register_law"
        raise ConfigurationError(f"the contact law '{variant}' is unknown", hint)
    return LAWS[variant]


@dataclass(frozen=True)
class ContactModel:
    """A bed of unilateral tri-axial springs, with the constant offsets of the sensors.

    Attributes:
        variant: The law, `stiffness` as published or `rigid` by the limb's pose; with `_bias` the
            model has offsets. Or the name of a law of `register_law`.
        names: Names of the n tiles (points of interest).
        anchors: Points of application a_i, the tiles' centres in {S}, shape (n, 3) [m].
        rotations: Frames {L_i} of the tiles, shape (n, 3, 3) [-]; R_i maps {L_i} to {S}, its
            columns are x (proximal), y and z (inward normal).
        stiffness: Stiffnesses k_i along x, y, z of {S}, in the rigid variants of {L_i}, shape
            (n, 3) [N/m].
        rest_positions: Rest positions q_r,i of the limb in {S}, in the rigid variants rest
            displacements r_i of the tiles in {L_i} since the reference pose, shape (n, 3) [m].
        sharpness: Sharpness alpha of the gate [1/m].
        wrench_bias: Offset b_w of the wrench [M; F] in {S}, shape (6,) [N m, N]; 0 without offsets.
        force_bias: Offset b_f of the force on a cluster in its tile's frame {L}, shape (3,) [N], by
            the cluster's name; no entry without offset.
        cluster_points: Index of the tile under each cluster, by the cluster's name.
        reference_pose: Pose of the limb in {S} from which the rigid variants measure displacements,
            position and rotation vector, shape (6,) [m, rad]; 0 in the paper's variants.
        wrench_slope: Slope of the wrench in {S} over displacement and rotation since the reference
            pose with `rigid_bias`, shape (6, 6), a row per channel [N m, N per m, rad]; otherwise
            0.
        of_wrench: Separate predictor of the wrench, if it predicts unseen samples better than this
            bed: a regression on the pose, with or without memory. None if this bed predicts the
            wrench.
    """

    variant: str
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
    of_wrench: WrenchModel | None = None

    @property
    def frame(self) -> str:
        """Frame of the stiffnesses and rest positions, in words."""
        return "the tile's frame" if self.law.IN_TILES else "{S}"

    def forces(self, pose: FloatArray) -> FloatArray:
        """Forces F_i + b_i on the socket at the n points of interest, in {S}, shape (N, n, 3) [N].

        A pose of the limb holds its position q and rotation vector in {S}, shape (N, 6) [m, rad];
        the paper's variants use the position only. NaN where a pose is NaN.
        """
        return self._forces(self._springs(self.law.motion(pose)))

    def _forces(self, springs: FloatArray) -> FloatArray:
        """Forces at the n points in {S}, (N, n, 3) [N], of springs, (N, 3, n) [N]."""
        forces = np.einsum("nab,tbn->tna", self.law.frames, springs)
        for name, bias in self.force_bias.items():
            point = self.cluster_points[name]
            forces[:, point] += self.rotations[point] @ bias
        return forces

    def wrench(
        self,
        pose: FloatArray,
        stamps: IntArray | None = None,
        trail: PoseTrail | None = None,
    ) -> FloatArray:
        """Wrenches ``C F + b_w`` [M; F] at the load cell in {S}, shape (N, 6) [N m, N].

        `rigid_bias` adds a slope over the pose. The clusters' offsets are those of their sensors
        and do not enter the wrench. A separate predictor, if the model has one, replaces all this.

        Args:
            pose: Poses of the limb: position q and rotation vector in {S}, shape (N, 6) [m, rad].
            stamps: Times of the poses since the epoch, ascending, shape (N,) [ns], which a
                predictor with memory needs; None for poses that have no past.
            trail: What went before, which the poses are added to; None for nothing.
        """
        if self.of_wrench is not None:
            return self.of_wrench.predict(pose, stamps, trail)
        motion = self.law.motion(pose)
        return self._bed_wrench(motion, self._springs(motion))

    def wrench_and_forces(
        self, pose: FloatArray, stamps: IntArray, trail: PoseTrail | None
    ) -> tuple[FloatArray, FloatArray]:
        """What `wrench` and `forces` return, at little more than the cost of one.

        Args:
            pose: Poses of the limb: position q and rotation vector in {S}, shape (N, 6) [m, rad].
            stamps: Times of the poses since the epoch, ascending, shape (N,) [ns].
            trail: What went before, which the poses are added to; None for nothing.

        Returns:
            Wrenches [M; F] in {S}, shape (N, 6) [N m, N], and forces at the n points of interest in
            {S}, shape (N, n, 3) [N].
        """
        motion = self.law.motion(pose)
        springs = self._springs(motion)
        if self.of_wrench is not None:
            return self.of_wrench.predict(pose, stamps, trail), self._forces(springs)
        return self._bed_wrench(motion, springs), self._forces(springs)

    def offsets(self, motion: FloatArray) -> FloatArray:
        """Offsets of the wrench [M; F] in {S} that add to the springs, (N, 6) or (6,) [N m, N].

        They are the constant, and with `rigid_bias` a slope over the motions of the limb since the
        reference pose, shape (N, m): see `ContactLaw.motion`.
        """
        if self.wrench_slope.any():
            return np.asarray(self.wrench_bias + motion @ self.wrench_slope.T)
        return self.wrench_bias

    def cluster_forces(self, pose: FloatArray) -> dict[str, FloatArray]:
        """Forces on the clusters, by name, each in its tile's frame {L}, shape (N, 3) [N].

        A pose of the limb holds its position q and rotation vector in {S}, shape (N, 6) [m, rad].
        """
        springs = self._springs(self.law.motion(pose), [*self.cluster_points.values()])
        forces = self._local_forces(springs, [*self.cluster_points])
        return dict(zip(self.cluster_points, forces, strict=True))

    def trail(self) -> PoseTrail | None:
        """An empty trail, for predictions sample by sample; None if the past does not matter."""
        return None if self.of_wrench is None else self.of_wrench.trail()

    def predict(
        self,
        pose: FloatArray,
        clusters: Sequence[str],
        stamps: IntArray | None = None,
        trail: PoseTrail | None = None,
    ) -> FloatArray:
        """Every channel in the order of `channel_names`, shape (N, 6 + 3c) [N m, N].

        The wrench [M; F] in {S} precedes the force on each of the c clusters in its frame {L}.

        Args:
            pose: Poses of the limb: position and rotation vector in {S}, shape (N, 6) [m, rad];
                where one is NaN, so are the predictions.
            clusters: Names of the clusters, in the order of their channels.
            stamps: Times of the poses since the epoch, ascending, shape (N,) [ns], which a
                predictor of the wrench with memory needs; None for poses that have no past.
            trail: What went before, which the poses are added to; None for nothing.

        Raises:
            ConfigurationError: If the model does not have one of the clusters.
        """
        missing = [name for name in clusters if name not in self.cluster_points]
        if missing:
            raise ConfigurationError(
                f"the model has no cluster {', '.join(missing)}",
                "fit a model on a trial that has it",
            )
        predicted = np.empty((len(pose), 6 + 3 * len(clusters)))
        points = [self.cluster_points[name] for name in clusters]
        trail = trail or self.trail()
        for start in range(0, len(pose), _CHUNK):
            rows = slice(start, start + _CHUNK)
            motion = self.law.motion(pose[rows])
            if self.of_wrench is None:
                springs = self._springs(motion)
                wrench, springs = self._bed_wrench(motion, springs), springs[:, :, points]
            else:
                times = None if stamps is None else stamps[rows]
                wrench = self.of_wrench.predict(pose[rows], times, trail)
                springs = self._springs(motion, points)
            predicted[rows] = np.hstack([wrench, *self._local_forces(springs, clusters)])
        return predicted

    def gate_displacements(
        self, pose: FloatArray, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Displacements delta at the springs' gates, with their standard deviations.

        Args:
            pose: Poses of the limb: position and rotation vector in {S}, shape (N, 6) [m, rad].
            noise: Covariance of the noise of position and rotation since the reference pose, along
                the axes of {S}, shape (6, 6) [m^2, m rad, rad^2].

        Returns:
            The displacements from rest along x, y, z of {S}, shape (N, n, 3), or in the rigid
            variants along each tile's inward normal, (N, n, 1) [m]: negative in compression,
            infinite without stiffness. Then their standard deviations by the noise, shape (n, 3) or
            (n, 1) [m].
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
        kind = law_of(self.variant)
        return kind(self.anchors, self.rotations, self.sharpness, self.reference_pose)

    def _springs(self, motion: FloatArray, points: list[int] | slice = slice(None)) -> FloatArray:
        """Forces of the springs at some points in the law's frames, shape (N, 3, points) [N]."""
        moved = self.law.displacements(motion)[:, :, points] - self.rest_positions[points].T
        return self.stiffness[points].T * self.law.columns(moved)

    def _bed_wrench(self, motion: FloatArray, springs: FloatArray) -> FloatArray:
        """Wrenches (N, 6) [N m, N] of springs (N, 3, n) [N] with the offsets at the motions."""
        onto = self.law.onto.reshape(6, -1).T
        return springs.reshape(len(motion), -1) @ onto + self.offsets(motion)

    def _local_forces(self, springs: FloatArray, clusters: Sequence[str]) -> list[FloatArray]:
        """Forces on clusters in their frames {L}, (N, 3) [N] each, of springs (N, 3, c) [N]."""
        points, no_bias = [self.cluster_points[name] for name in clusters], np.zeros(3)
        forces = np.einsum("nab,tbn->tna", self.law.frames[points], springs)
        return [
            forces[:, column] @ self.rotations[point] + self.force_bias.get(name, no_bias)
            for column, (name, point) in enumerate(zip(clusters, points, strict=True))
        ]
