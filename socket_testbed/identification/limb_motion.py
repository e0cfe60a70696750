r"""How the limb's motion in the socket agrees with the wrench and with the clusters, axis by axis.

The limb turns about the axis of the moment that turns it, and presses the wall towards which it
moves: a bed of springs is positive definite. So over a trial

- the rotation follows the moment about the centre of the socket, both horizontal. Turned, exchanged
  or mirrored axes of either show as another orientation that fits better (`AXES`);
- the force on each cluster follows the indentation of its own tile by the moving limb. If two
  clusters are exchanged, each fits the other's tile.

What follows the load along the socket, and a constant drift, are taken off all courses first: the
load presses every cluster, wherever it is, and tissue and sensors creep. Correlations in the sense
of this module are of the remaining courses. The horizontal force is not used: a stiff limb may even
move against it, since its moment turns the limb.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.pose import about_z
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.samples import MOMENTS, Samples

# Horizontal axes as others may have them: what an error does to the vector (x, y).
_TURNS = [angle for angle in range(-165, 181, 15) if abs(angle) >= 30]  # [deg]
AXES: dict[str, FloatArray] = {
    **{f"turned by {angle} degrees": about_z(np.radians(angle))[:2, :2] for angle in _TURNS},
    "exchanged": np.array([[0.0, 1.0], [1.0, 0.0]]),
    "exchanged and both reversed": np.array([[0.0, -1.0], [-1.0, 0.0]]),
    "left-handed (y reversed)": np.array([[1.0, 0.0], [0.0, -1.0]]),
    "left-handed (x reversed)": np.array([[-1.0, 0.0], [0.0, 1.0]]),
}
NEGATED = "turned by 180 degrees"
MIRRORED = ("exchanged", "left-handed (y reversed)", "left-handed (x reversed)")
OPPOSITE = {  # what the other of two vectors has, if the first one has the axes
    **{name: name for name in AXES},
    **{f"turned by {a} degrees": f"turned by {-a} degrees" for a in _TURNS if a != 180},
}
_CIRCLE_GAIN = 0.4  # [-]; in fit, by three or more exchanged clusters over the best two
LEAST_MOTION = 30  # samples with a pose, a wrench and all clusters
_ROUNDING = 1e-9  # [-]; relative to the largest value of a course
_CERTAIN = 0.999  # [-]; largest correlation, so that a perfect one stays finite


@dataclass(frozen=True)
class LimbMotion:
    """Courses of the limb, the moment and the clusters, without what follows the load; N samples.

    Attributes:
        time: Times of the samples, shape (N,) [s].
        shift: Displacement of the limb at the centre of the socket, in {S}, shape (N, 3) [m].
        rotation: Small rotations of the limb about x, y, z of {S}, shape (N, 3) [rad].
        moment: Moment about the centre of the socket, in {S}, shape (N, 3) [N m].
        pressing: Normal force on each of the c clusters, positive in compression, (N, c) [N].
        arms: Lever arms of the clusters' tiles for rotations, that is (a - centre) x outward
            normal, shape (c, 3) [m].
        outward: Outward normals of the clusters' tiles, shape (c, 3) [-].
        measured: Normal forces on the clusters with what follows the load, shape (N, c) [N].
        causes: Times [s], the load along z of {S} [N] and, with what follows the load, the motion
            of the limb into each cluster's tile [m], shape (N, 2 + c).
    """

    time: FloatArray
    shift: FloatArray
    rotation: FloatArray
    moment: FloatArray
    pressing: FloatArray
    arms: FloatArray
    outward: FloatArray
    measured: FloatArray
    causes: FloatArray

    @property
    def agreement(self) -> float:
        """Correlation of the horizontal rotation with the horizontal moment [-].

        It is 0.94 and more where hands push from all sides, less on holds and ramps.
        """
        return _alike(self.rotation[:, :2], self.moment[:, :2])

    def axes_of_moment(self) -> tuple[str, float]:
        """The horizontal axes, of `AXES`, with which the rotation fits the moment best.

        Returns:
            Their description, and how much better they fit than the axes as they are: the gain in
            correlation [-], negative if the latter fit best.
        """
        turned, moment = self.rotation[:, :2], self.moment[:, :2]
        products = moment.T @ turned
        size = np.sqrt((turned**2).sum() * (moment**2).sum())  # axes change no length
        found = {
            name: float((products * axes).sum() / size) if size > 0.0 else 0.0
            for name, axes in AXES.items()
        }
        best = max(found, key=lambda name: found[name])
        return best, found[best] - self.agreement

    def axes_misfit(self, axes: FloatArray | None = None) -> float:
        """How badly the clusters fit the limb's motion: the mean of log(1 - r^2) / 2 [-].

        Args:
            axes: An error of the pose's horizontal axes that is undone first, of `AXES`, shape
                (2, 2) [-]; None for the pose as it is.
        """
        shift, rotation = self.shift.copy(), self.rotation.copy()
        if axes is not None:
            shift[:, :2] = shift[:, :2] @ axes
            rotation[:, :2] = rotation[:, :2] @ axes
        found = self._follows(shift, rotation)
        return float(misfit_of(np.diag(found)).mean())

    def exchanged(self) -> tuple[tuple[int, ...], float]:
        """The clusters whose forces fit each other's tiles best, if they were exchanged.

        Returns:
            The columns of two clusters, or of several in a circle, each of which fits the tile of
            the next one and the last that of the first; and the gain in fit: the fall of
            log(1 - r^2) / 2, summed over them [-], negative if each fits its own tile better. At
            least two clusters are needed.
        """
        misfit = misfit_of(self._follows(self.shift, self.rotation))
        gains = {
            (i, j): float(misfit[i, i] + misfit[j, j] - misfit[i, j] - misfit[j, i])
            for i, j in combinations(range(len(misfit)), 2)
        }
        pair = max(gains, key=lambda pair: gains[pair])
        most = float((np.diag(misfit) - misfit.min(axis=1)).sum())  # that any circle gains
        if most <= gains[pair] + _CIRCLE_GAIN:
            return pair, gains[pair]
        from scipy.optimize import linear_sum_assignment  # 0.1 s, seldom needed

        for circle in _circles(linear_sum_assignment(misfit)[1].tolist()):
            following = [*circle[1:], circle[0]]
            gain = float(misfit[circle, circle].sum() - misfit[circle, following].sum())
            if len(circle) > len(pair) and gain > gains[pair] + _CIRCLE_GAIN:
                return tuple(circle), gain
        return pair, gains[pair]

    def _follows(self, shift: FloatArray, rotation: FloatArray) -> FloatArray:
        """Correlation of each cluster's force with the indentation of each one's tile, (c, c)."""
        tiles = self._indentation(shift, rotation).T
        return np.array(
            [[_alike(force[:, None], tile[:, None]) for tile in tiles] for force in self.pressing.T]
        )

    @property
    def indentation(self) -> FloatArray:
        """Motion of the limb into the tile of each cluster, shape (N, c) [m]."""
        return self._indentation(self.shift, self.rotation)

    def _indentation(self, shift: FloatArray, rotation: FloatArray) -> FloatArray:
        return np.asarray(shift @ self.outward.T + rotation @ self.arms.T)


def limb_motion(samples: Samples, geometry: SocketGeometry) -> LimbMotion | None:
    """The courses of a trial.

    Args:
        samples: The samples, with rotations since the mean attitude.
        geometry: The socket, which has the clusters of the samples.

    Returns:
        The courses, or None with too few complete samples, fewer than two clusters or a moment
        that stands still.
    """
    pressing = -samples.trusted_forces[:, :, 2]
    seen = np.asarray(np.isfinite(pressing).any(axis=0))
    known = np.isfinite(samples.wrench).all(axis=1) & samples.has_pose
    known &= np.isfinite(pressing[:, seen]).all(axis=1)
    if known.sum() < LEAST_MOTION or seen.sum() < len(seen) or len(seen) < 2:
        return None
    samples, pressing = samples[known], pressing[known]
    centre = geometry.anchors.mean(axis=0)
    moment, force = samples.wrench[:, MOMENTS], samples.wrench[:, 3:]
    rotation = samples.rotation - samples.rotation.mean(axis=0)
    origin = samples.position.mean(axis=0)
    shift = samples.position - origin + np.cross(rotation, centre - origin)
    if not np.ptp(moment[:, :2], axis=0).all():  # a dead channel, which says nothing about axes
        return None
    tiles = [geometry.clusters[name] for name in samples.clusters]
    outward = -geometry.rotations[tiles, :, 2]
    arms = np.cross(geometry.anchors[tiles] - centre, outward)
    known_causes = np.column_stack([np.ones(len(samples)), samples.time, force[:, 2]])
    indentation = shift @ outward.T + rotation @ arms.T
    return LimbMotion(
        time=samples.time,
        shift=_left_of(shift, known_causes),
        rotation=_left_of(rotation, known_causes),
        moment=_left_of(moment - np.cross(centre, force), known_causes),
        pressing=_left_of(pressing, known_causes),
        arms=arms,
        outward=outward,
        measured=pressing,
        causes=np.hstack([known_causes[:, 1:], indentation]),
    )


def mirrored_forces(samples: Samples) -> tuple[str, float, float]:
    """The mirrored horizontal axes with which the forces would fit the moments best.

    A force across the load cell's axis at the height h has the moment h z x F. Whatever the height
    and its sign, forces in mirrored axes fit no height.

    Args:
        samples: Samples with a wrench; what is linear in the load and in time is taken off.

    Returns:
        The axes, of `MIRRORED`; the correlation of forces and moments with them, and as they are
        [-]. Zeros with too few samples.
    """
    moment, force = _across(samples)
    fits = {name: abs(_alike(moment, _quarter_turn(force @ AXES[name]))) for name in MIRRORED}
    best = max(fits, key=lambda name: fits[name])
    return best, fits[best], abs(_alike(moment, _quarter_turn(force)))


def height_of_forces(samples: Samples) -> tuple[float, float]:
    """The height above the load cell at which horizontal forces have their moments.

    Args:
        samples: As in `mirrored_forces`.

    Returns:
        The size of the height [m], and the correlation of moments and forces [-]. Zeros with too
        few samples.
    """
    moment, force = _across(samples)
    size = np.sqrt((force**2).sum())
    height = float(np.sqrt((moment**2).sum()) / size) if size > 0.0 else 0.0
    return height, abs(_alike(moment, _quarter_turn(force)))


def _across(samples: Samples) -> tuple[FloatArray, FloatArray]:
    """Horizontal moments and forces beside the load, (N, 2) each [N m, N]; none if too few."""
    known = np.isfinite(samples.wrench).all(axis=1)
    if known.sum() < LEAST_MOTION:
        return np.empty((0, 2)), np.empty((0, 2))
    wrench = samples.wrench[known]
    causes = np.column_stack([np.ones(len(wrench)), samples.time[known], wrench[:, 5]])
    left = _left_of(wrench, causes)
    return left[:, :2], left[:, 3:5]


def _quarter_turn(vectors: FloatArray) -> FloatArray:
    """Horizontal vectors v, (N, 2), turned about z by 90 degrees: z x v."""
    return np.column_stack([-vectors[:, 1], vectors[:, 0]])


def _circles(places: list[int]) -> list[list[int]]:
    """The circles of a permutation with more than one member, the longest first.

    Args:
        places: The place of each of the members 0 to n - 1.
    """
    left, found = {*range(len(places))}, []
    while left:
        circle = [min(left)]
        while places[circle[-1]] != circle[0]:
            circle.append(places[circle[-1]])
        left -= {*circle}
        found.append(circle)
    return sorted((each for each in found if len(each) > 1), key=len, reverse=True)


def _left_of(courses: FloatArray, causes: FloatArray) -> FloatArray:
    """What of some courses (N, k) is not linear in others (N, m); zero if it is only rounding."""
    scaled = causes / np.maximum(np.abs(causes).max(axis=0), 1e-12)
    left = courses - scaled @ np.linalg.lstsq(scaled, courses, rcond=None)[0]
    return np.where(left.std(axis=0) > _ROUNDING * np.abs(courses).max(axis=0), left, 0.0)


def _alike(one: FloatArray, other: FloatArray) -> float:
    """Correlation of two courses of vectors with mean zero, (N, k) each [-]; 0 if one is still."""
    size = np.sqrt((one**2).sum() * (other**2).sum())
    return float((one * other).sum() / size) if size > 0.0 else 0.0


def misfit_of(correlation: FloatArray) -> FloatArray:
    """Logarithm of the part that correlations leave unexplained: log(1 - r^2) / 2 [-].

    Args:
        correlation: The correlations, of any shape; negative ones leave all of it [-].
    """
    return np.asarray(0.5 * np.log(1.0 - np.clip(correlation, 0.0, _CERTAIN) ** 2))
