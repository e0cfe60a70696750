"""The courses of load, clusters and limb over a trial, and how each follows the others.

A loaded limb presses the wall: over a trial every cluster's normal force and the limb's pose follow
the force along the socket. Beside the load, the limb turns as its moments say and presses the wall
towards which it moves (`limb_motion`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from socket_testbed.arrays import FloatArray, finite_quantile, usual_period
from socket_testbed.geometry.regions import axial_force, proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import plausibility
from socket_testbed.identification.correlation import (
    MIN_LAG_GAIN,
    best_lag,
    clear_delay,
    clear_lag,
    correlation,
)
from socket_testbed.identification.data_finding import LEAST_CHECKED
from socket_testbed.identification.limb_motion import LimbMotion, limb_motion, misfit_of
from socket_testbed.identification.noise import ChannelNoise
from socket_testbed.samples import Samples, force_magnitude

MIN_LOAD_CHANGE = 15.0  # [N]; standard deviation of the load, to compare other sources with it
MIN_COMPARED_LOAD = 15.0  # [N]; to compare the clusters with each other
REVERSED = -0.2  # [-]; correlation with the load below which a sign is reversed; sound >= 0
MAX_LAG = 3.5  # [s]; lag between sources; sound <= 2.8 (stiff tissue creeps)
MAX_POSE_LAG = 0.3  # [s]; of the pose behind the moments; sound <= 0.12
MIN_POSE_FIT = 0.8  # [-]; their correlation with that lag
MAX_CLUSTER_LAG = 0.6  # [s]; of a cluster behind load and indentation
MIN_DELAY_TIME, MIN_DELAY_SAMPLES = 30.0, 100  # [s], [1]; of a trial, to search it for delays
# [-]; of a cluster: share of the variance explained with that delay, and the fall of
# log(1 - share) / 2 by it; sound gains up to 0.36 of delays beyond 0.35 s
MIN_CLUSTER_DELAY = (0.8, 0.5)
# [-]; standard deviation of the clusters' total force over that of the load; the upper limit is
# relative to the clusters' share of the socket's area; sound 0.03 to 0.18, that is up to 3.4
LOCAL_SHARE = (0.001, 10.0)
MAX_BORNE = 20.0  # [-]; usual force on all clusters over the usual load; sound 0.05 to 0.3
MIN_AXES_GAIN = 0.25  # [-]; in correlation of rotation and moment by other axes; sound below 0
MIN_CLEAR_GAIN = 0.1  # [-]; the same where other axes agree as well as while hands push
MIN_AGREEMENT = 0.94  # [-]; of rotation and moment while hands push from all sides
MIN_PUSH = 0.5  # [N m]; standard deviation of a moment beside the load; of sway up to 0.2
# [-]; in the fit of two clusters by exchanging them, while pushed and otherwise; sound <= 0.63
MIN_EXCHANGE_GAIN = (0.4, 1.0)
MIN_SINKING = 0.5  # [-]; cosine between the limb's motion under load and the axis; sound >= 0.996


@dataclass(frozen=True)
class Courses:
    """The courses of load, clusters and limb over a trial's N samples, in which rules find defects.

    The load is the force along the socket, positive under load. A cluster's force is its normal
    force, positive in compression.

    Attributes:
        samples: The samples, without outliers and left-out channels, with rotations since the mean
            attitude.
        geometry: The socket.
        noise: Noise of the samples.
        load_in_doubt: Whether the size of the load is reported already.
    """

    samples: Samples
    geometry: SocketGeometry
    noise: ChannelNoise
    load_in_doubt: bool = False

    @cached_property
    def load(self) -> FloatArray:
        """The load as measured, shape (N,) [N]; NaN where a force of the load cell is missing."""
        return axial_force(self.geometry, self.samples.wrench)

    @cached_property
    def pressing(self) -> FloatArray:
        """The force on each of the c clusters, shape (N, c) [N]; NaN unless its status is OK."""
        return np.asarray(-self.samples.trusted_forces[:, :, 2])

    @cached_property
    def together(self) -> FloatArray:
        """The force on all clusters, missing values interpolated, shape (N,) [N]."""
        total = np.zeros(len(self.samples))
        for column in self.pressing.T:
            total += _filled(column, self.samples.time)
        return total

    @cached_property
    def down(self) -> FloatArray:
        """The limb's position towards the distal end, shape (N,) [m]; NaN where it is missing."""
        return np.asarray(-self.samples.position @ self.proximal)

    @cached_property
    def proximal(self) -> FloatArray:
        """Unit vector along the socket towards its proximal end in {S}, shape (3,) [-]."""
        return proximal_direction(self.geometry)

    @cached_property
    def period(self) -> float:
        """Usual time between samples [s]."""
        return usual_period(self.samples.time)

    @cached_property
    def load_change(self) -> float:
        """Standard deviation of the load [N]; 0 for an unknown load."""
        return float(np.nanstd(self.load)) if np.isfinite(self.load).any() else 0.0

    @cached_property
    def clusters_change(self) -> float:
        """Standard deviation of the force on all clusters [N]."""
        return float(np.nanstd(self.together))

    @cached_property
    def load_is_too_small(self) -> bool:
        """Whether the load changes far less than the force on the clusters."""
        tiles = [self.geometry.clusters[name] for name in self.samples.clusters]
        share = self.geometry.areas[tiles].sum() / self.geometry.areas.sum()
        limit = max(LOCAL_SHARE[1] * share * self.load_change, MIN_LOAD_CHANGE / 3)
        return bool(np.isfinite(self.load).any()) and self.clusters_change > limit

    @cached_property
    def bears_too_little(self) -> bool:
        """Whether the clusters bear many times what the load cell measures."""
        borne = finite_quantile(self.pressing.clip(0.0).sum(axis=1), 0.95)
        force = force_magnitude(self.samples.wrench)
        known = bool(np.isfinite(force).any())
        return known and borne > max(MAX_BORNE * finite_quantile(force, 0.95), MIN_COMPARED_LOAD)

    @cached_property
    def load_shows_others(self) -> bool:
        """Whether the load changes enough to judge others by it, and is not itself in doubt."""
        return self.load_change > MIN_LOAD_CHANGE and not self.load_is_too_small

    @cached_property
    def follows(self) -> FloatArray:
        """Correlation of each cluster with the load as measured, shape (c,) [-]."""
        return np.array([correlation(column, self.load) for column in self.pressing.T])

    @cached_property
    def sign_note(self) -> str | None:
        """Why the wrench looks negated, in words; None if it does not."""
        note = plausibility.sign_note(self.samples, self.geometry)
        opposite = int((self.follows < REVERSED).sum()) if self.load_shows_others else 0
        if note is None and opposite > 1 and 2 * opposite > len(self.follows):
            return "the force on the clusters falls as the load rises"
        return note

    @cached_property
    def sense(self) -> float:
        """Factor that turns a negated load the right way: -1, otherwise 1 [-]."""
        return -1.0 if self.sign_note and np.nansum(self.follows) < 0.0 else 1.0

    @cached_property
    def lags(self) -> dict[str, float]:
        """Delays behind the load by source, of those that are too late or too early [s]."""
        if not self.load_shows_others:
            return {}
        reference = self.sense * self.load
        courses = {"the clusters": self.together, "the limb pose": self.down}
        found = {
            name: clear_lag(reference, course, self.period) for name, course in courses.items()
        }
        limit = max(MAX_LAG, 2.5 * self.period)
        return {name: lag for name, lag in found.items() if abs(lag) > limit}

    @cached_property
    def motion_lags(self) -> dict[str, float]:
        """Delays that the limb's motion beside the load shows, by source, as in `lags` [s].

        They are of the pose behind the moments, or else of single clusters behind load and pose.
        Tissue creeps under the load, hardly beside it, so that they may be short.
        """
        if self.pose_lag:
            return {"the limb pose": self.pose_lag}
        if self.motion is None or self.wrong_axes or self.exchanged or not self.is_long:
            return {}
        motion, period = self.motion, usual_period(self.motion.time)
        found = {}
        for column, name in enumerate(self.samples.clusters):
            causes = motion.causes[:, [0, 1, 2 + column]]
            delay = clear_delay(motion.measured[:, [column]], causes, period, MIN_CLUSTER_DELAY)
            if abs(delay) > max(MAX_CLUSTER_LAG, 2.5 * period):
                found[name] = delay
        if (
            len(found) == len(self.samples.clusters)
            and np.ptp([*found.values()]) <= MAX_CLUSTER_LAG
        ):
            return {"the clusters": float(np.median([*found.values()]))}
        return found

    @cached_property
    def pose_lag(self) -> float:
        """Delay of the limb's motion behind the wrench, beside the load; 0 if it is short [s].

        While hands push around the limb, a delay looks like turned axes: what fits better counts.
        """
        if self.motion is None or not self.is_regular:
            return 0.0
        motion, period = self.motion, usual_period(self.motion.time)
        moment, rotation = motion.moment[:, :2], motion.rotation[:, :2]
        if motion.agreement > 1.0 - MIN_LAG_GAIN:
            return 0.0  # no delay can fit clearly better
        lag, fit, at_once = best_lag(moment, rotation, period)
        gain = max(0.0, motion.axes_of_moment()[1])
        clear = fit > max(at_once + max(gain, MIN_LAG_GAIN), MIN_POSE_FIT)
        if clear and abs(lag) > max(MAX_POSE_LAG, 1.5 * period):
            return lag
        return 0.0

    @cached_property
    def is_long(self) -> bool:
        """Whether the motion is known long and regularly enough to search it for delays."""
        long_enough = float(self.samples.time[-1]) >= MIN_DELAY_TIME - self.period
        return self.is_regular and long_enough and len(self.samples) >= MIN_DELAY_SAMPLES

    @cached_property
    def are_simultaneous(self) -> bool:
        """Whether sources can be compared with the load sample by sample."""
        return self.load_shows_others and not self.lags

    @cached_property
    def motion(self) -> LimbMotion | None:
        """The limb's motion beside the load; None if it is not known, or not at the same times."""
        if self.sign_note or self.lags or self.sinking < MIN_SINKING:
            return None
        return limb_motion(self.samples, self.geometry)

    @cached_property
    def exchanged(self) -> tuple[int, ...]:
        """Columns of clusters, each of which fits the tile of the next; empty if all fit their own.

        A late cluster may fit another's tile, too: what fits better counts.
        """
        if self.motion is None or self.wrong_axes or self.pose_lag:
            return ()
        columns, gain = self.motion.exchanged()
        least = MIN_EXCHANGE_GAIN[0 if self.is_pushed else 1]
        return columns if gain > max(least, *map(self._gain_by_delay, columns)) else ()

    def _gain_by_delay(self, column: int) -> float:
        """How much better a cluster fits its tile with a delay: the fall of log(1 - r^2) / 2 [-].

        It is 0 where delays are not searched for.
        """
        if self.motion is None or not (self.is_pushed and self.is_regular):
            return 0.0
        tile, own = self.motion.indentation[:, column], self.motion.pressing[:, column]
        _, fit, at_once = best_lag(tile, own, usual_period(self.motion.time))
        at_once_misfit, late_misfit = misfit_of(np.array([at_once, fit]))
        return float(at_once_misfit - late_misfit)

    @cached_property
    def is_pushed(self) -> bool:
        """Whether the limb is pushed around so much that its motion beside the load is clear."""
        if self.motion is None or self.motion.agreement < MIN_AGREEMENT:
            return False
        return float(self.motion.moment[:, :2].std(axis=0).max()) > MIN_PUSH

    @cached_property
    def is_regular(self) -> bool:
        """Whether the motion is known at nearly all samples, as a search for delays needs."""
        return self.motion is not None and len(self.motion.time) >= 0.9 * len(self.samples)

    @cached_property
    def wrong_axes(self) -> str:
        """The horizontal axes with which rotation and moment agree, in words; empty as they are."""
        if self.motion is None or self.pose_lag:
            return ""
        name, gain = self.motion.axes_of_moment()
        is_clear = self.motion.agreement + gain > MIN_AGREEMENT
        return name if gain > (MIN_CLEAR_GAIN if is_clear else MIN_AXES_GAIN) else ""

    @cached_property
    def sinking(self) -> float:
        """Cosine between the limb's motion under load and the axis; 1 if it is not known [-]."""
        if not self.are_simultaneous:
            return 1.0
        return _along(self.samples.position, self.sense * self.load, self.proximal)

    @cached_property
    def causes(self) -> FloatArray:
        """Wrench and pose, (N, 12), or without any pose the wrench, (N, 6) [N m, N, m, rad]."""
        samples = self.samples
        posed = samples.has_pose.any()
        return np.hstack([samples.wrench, samples.pose]) if posed else samples.wrench


def _filled(course: FloatArray, time: FloatArray) -> FloatArray:
    """A series of N values with the missing ones interpolated, (N,); zeros if all are missing.

    Times have the shape (N,) [s].
    """
    known = np.isfinite(course)
    return np.interp(time, time[known], course[known]) if known.any() else np.zeros(len(course))


def _along(position: FloatArray, load: FloatArray, proximal: FloatArray) -> float:
    """Cosine of the angle between the limb's motion under load and the distal direction [-].

    From positions (N, 3) [m], loads (N,) [N] and the proximal direction (3,); 1 if too few are
    known.
    """
    known = np.isfinite(position).all(axis=1) & np.isfinite(load)
    if known.sum() < LEAST_CHECKED:
        return 1.0
    moved = (load[known] - load[known].mean()) @ (position[known] - position[known].mean(axis=0))
    return float(-moved @ proximal / max(np.linalg.norm(moved), 1e-12))
