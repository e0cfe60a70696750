r"""Prediction of the wrench from the limb's pose, and from where the limb has been.

A linear regression on the pose comes first. What it leaves is a Gaussian process with a squared
exponential covariance (Rasmussen & Williams, Gaussian Processes for Machine Learning, 2006,
sections 2.2 and 5.4.1) over 24 features of the motion u, standardised by its spread in the fit:

- u itself;
- its play: the position of a body that u drags along with a backlash of +- 0.3, and one of +- 1
  (the play operator of hysteresis: Visintin, Differential Models of Hysteresis, 1994, section
  III.2). It remembers the direction of the last motion, as a tissue that sticks and slips does;
- u less its mean over the last 20 s, which follows the creep of a tissue.

Means over the past weigh a pose of the age t by :math:`e^{-t/\tau}`. They need no pose later than
the one at hand, so that a live prediction equals the offline one. The memory is empty at the first
pose and after a break (`arrays.BREAK`); it then fills with the poses that follow.

Sticking and creep differ from limb to limb. The process is used unless its error on held-out blocks
of the samples of the fit exceeds that of the regression alone by more than 5 %.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from socket_testbed.arrays import BREAK, FloatArray, IntArray, evenly
from socket_testbed.samples import GROUPS, Samples, relative_pose

REGRESSION = "linear regression on the pose"
MEMORY = "linear regression on the pose with memory of its past"
FEATURES = 24  # [1]; of a motion: itself, two plays, and its distance from its mean
PLAYS = (0.3, 1.0)  # [-]; half-widths of the backlash, in standard deviations of the motion
MAX_SUPPORT = 300  # [1]; samples on which the process rests
_RECENT, _LASTING = 0.35, 10.0  # [s]; mean ages of the poses in a window of 0.7 s and of 20 s
_LENGTHS = (1.0, 2.0, 4.0, 8.0)  # [-]; of the process, in standard deviations of a feature
_NOISES = (0.1, 0.3, 0.5, 0.7, 0.9)  # [-]; share of the noise in the process's variance
_BLOCKS = 4  # held out in turn
_LEAST_IN_BLOCK = 10  # [samples]
_MAX_WORSE = 1.05  # [-]; error of the process over that of the regression, to be used
_RUN = 128  # [samples]; joined at once, in the cache
_STEPS = 21  # steps between samples that show the usual one
_CHUNK = 4096  # samples; memory grows with samples times support points
_RANK = 1e-10  # [-]; smallest singular value of the standardised poses, relative to the largest
_MIN_SPREAD = 1e-12  # [-]; spread of a constant component of the pose, relative to its magnitude


def regress_wrench(samples: Samples, motion: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Regress the wrench linearly on the limb's motion, by least squares.

    If the motions lack rank, the solution has minimum norm in standardised motions.

    Args:
        samples: N samples, with every pose and a wrench without gaps in a channel; the poses show
            which components of the motion are constant.
        motion: Their displacements and rotations since a reference pose, in {S}, shape (N, 6)
            [m, rad].

    Returns:
        The slope, shape (6, 6), a row per channel [N m, N per m, rad], and the wrench at zero
        motion, shape (6,) [N m, N]. A channel with a missing value has a constant of NaN.
    """
    mean, constant = motion.mean(axis=0), samples.wrench.mean(axis=0)
    spread = _spread(samples, motion)
    known = np.nan_to_num(samples.wrench - constant)
    slope = np.linalg.lstsq((motion - mean) / spread, known, rcond=_RANK)[0].T / spread
    return slope, constant - slope @ mean


def _spread(samples: Samples, motion: FloatArray) -> FloatArray:
    """Standard deviations of the motion's components, infinite for constant ones, (6,) [m, rad]."""
    spread = motion.std(axis=0)
    return np.where(spread > _MIN_SPREAD * np.abs(samples.pose).max(axis=0), spread, np.inf)


def relative_error(missed: FloatArray, wrench: FloatArray) -> float:
    """Relative error of the moments plus that of the forces, over their standard deviations [-].

    Args:
        missed: Predicted less measured wrenches [M; F], shape (N, 6) [N m, N].
        wrench: The measured wrenches [M; F], shape (N, 6) [N m, N].
    """
    rmse, change = np.sqrt(np.mean(missed**2, axis=0)), wrench.std(axis=0)
    parts = ((rmse[part].sum(), change[part].sum()) for part in GROUPS)
    return float(sum(error / max(size, 1e-9) for error, size in parts))


class PoseTrail:
    """Follows the limb from sample to sample, and tells where it has been: see the module.

    It keeps two running means, two plays and the newest steps between samples.

    Args:
        scale: Standard deviations of the motion in the fit, shape (6,) [m, rad]; infinite for a
            component that did not move.
    """

    def __init__(self, scale: FloatArray) -> None:
        self._scale = scale
        self._ages = np.array([_RECENT, _LASTING])  # [s]
        self._widths = np.array(PLAYS)[:, None]
        self._steps: deque[int] = deque(maxlen=_STEPS)  # [ns]
        self._last: int | None = None  # [ns]; None without a past
        self._sums = np.zeros((2, 7))  # over the past: of weighted motions, and of weights
        self._plays = np.zeros((2, 6))

    def add(self, stamps: IntArray, motions: FloatArray) -> FloatArray:
        """Features of the next motions, shape (N, 24) [-].

        A sample that comes a little late, after newer ones, counts as simultaneous with the newest.

        Args:
            stamps: Times of the samples since the epoch, shape (N,) [ns].
            motions: Displacements and rotations since the reference pose, shape (N, 6) [m, rad].
        """
        # What does not rest on the sample before is computed for all samples at once.
        moved = motions / self._scale
        steps = self._time_steps(stamps)
        kept = np.exp(-1e-9 * steps[:, None] / self._ages)  # 0 where the memory is empty
        weighed = np.column_stack([moved, np.ones(len(moved))])
        sums = _kept_sums(self._sums, kept[:, :, None], weighed[:, None])
        recent, lasting = np.moveaxis(sums[..., :6] / sums[..., 6:], 1, 0)
        fresh = np.isinf(steps)[:, None, None]
        reach = np.where(fresh, 0.0, self._widths)  # without a past a play is where the limb is
        plays = _dragged(self._plays, recent[:, None] - reach, recent[:, None] + reach)
        if len(moved):
            self._sums, self._plays = sums[-1], plays[-1]
        return np.hstack([moved, plays.reshape(-1, 12), moved - lasting])

    def _time_steps(self, stamps: IntArray) -> FloatArray:
        """Times from the samples before, shape (N,), as `_step` gives them."""
        first = int(self._last is None)  # row of the first step that is known
        before = stamps[:1] if first else np.array([self._last])
        steps = np.diff(np.concatenate([before, stamps]))
        known = [*self._steps, *steps[first:].tolist()]
        # Nearly always: in order and without a break.
        if len(stamps) and known and min(known) > 0 and max(known) <= BREAK * min(known):
            self._steps.extend(steps[first:][-_STEPS:].tolist())
            self._last = int(stamps[-1])
            return np.concatenate([np.full(first, np.inf), steps[first:]])
        return np.array([self._step(stamp) for stamp in stamps.tolist()])

    def _step(self, stamp: int) -> float:
        """Time from the sample before, 0 or more [ns]; infinite if the memory is empty."""
        if self._last is None or self._breaks(stamp - self._last):
            self._last = stamp
            return math.inf
        step = max(stamp - self._last, 0)
        self._last += step
        return step

    def _breaks(self, step: int) -> bool:
        """Whether a step [ns] is a break, judged by the steps before it and itself."""
        if step > 0:
            self._steps.append(step)
        if not self._steps or abs(step) <= BREAK * min(self._steps):
            return False  # quick, as for nearly all steps
        ordered = sorted(self._steps)  # numpy's median takes 30 times as long for so few
        usual = 0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])
        return abs(step) > BREAK * usual


def _kept_sums(before: FloatArray, kept: FloatArray, added: FloatArray) -> FloatArray:
    """Sums of which a share is kept at each of N steps, after which something is added.

    Two steps in a row are one that keeps the product of their shares: steps are joined to runs of
    2, 4, 8, ... (Hillis & Steele, Data Parallel Algorithms, 1986).

    Args:
        before: The sums before the first step, shape (2, 7).
        kept: Share that is kept at each step, shape (N, 2, 1) [-].
        added: What is added at each step, shape (N, 1, 7).

    Returns:
        The sums after each step, shape (N, 2, 7).
    """
    sums = np.empty((len(kept), *before.shape))
    for start in range(0, len(kept), _RUN):
        rows = slice(start, start + _RUN)
        share, total = kept[rows].copy(), sums[rows]
        total[:] = added[rows]
        total[0] += share[0] * before
        for width in _doubled(len(total)):
            total[width:] = share[width:] * total[:-width] + total[width:]
            share[width:] = share[width:] * share[:-width]
        before = total[-1]
    return sums


def _dragged(before: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Positions of bodies that are pushed between a lower and an upper end at each of N steps.

    Two pushes in a row are one, whose ends are those of the first as the second one pushes them:
    see `_kept_sums`.

    Args:
        before: Positions before the first step, shape (2, 6) [-].
        low: Lower ends, shape (N, 2, 6) [-].
        high: Upper ends, shape (N, 2, 6) [-].

    Returns:
        The positions after each step, shape (N, 2, 6) [-].
    """
    positions = np.empty_like(low)
    for start in range(0, len(low), _RUN):
        rows = slice(start, start + _RUN)
        least, most = low[rows].copy(), high[rows].copy()
        for width in _doubled(len(least)):
            own_low, own_high = least[width:].copy(), most[width:].copy()
            least[width:] = least[:-width].clip(own_low, own_high)
            most[width:] = most[:-width].clip(own_low, own_high)
        positions[rows] = before.clip(least, most)
        before = positions[rows][-1]
    return positions


def _doubled(size: int) -> Iterator[int]:
    """1, 2, 4, ... below a size."""
    width = 1
    while width < size:
        yield width
        width *= 2


@dataclass(frozen=True)
class MotionMemory:
    """The Gaussian process of what the regression leaves: see the module.

    Attributes:
        scale: Standard deviations of the motion in the fit, shape (6,) [m, rad]; infinite for
            a component that did not move.
        centre: Means of the features in the fit, shape (24,) [-].
        spread: Standard deviations of the features in the fit, shape (24,) [-]; infinite for a
            constant one.
        support: Standardised features of the m samples that the process rests on, shape (m, 24)
            [-].
        left: What the regression leaves of their wrenches [M; F] in {S}, shape (m, 6) [N m, N].
        length: Length over which the process varies, in standard deviations of a feature [-].
        noise: Share of the noise in the process's variance, 0 to 1 [-].
        deviation: Standard deviations of the process with its noise, shape (6,) [N m, N].
        widening: Factors of the stated standard deviations, by which they meet the errors on
            held-out blocks, 1 or more, shape (6,) [-].
    """

    scale: FloatArray
    centre: FloatArray
    spread: FloatArray
    support: FloatArray
    left: FloatArray
    length: float
    noise: float
    deviation: FloatArray
    widening: FloatArray

    def features(
        self, motion: FloatArray, stamps: IntArray | None, trail: PoseTrail | None = None
    ) -> FloatArray:
        """Standardised features of motions, shape (N, 24) [-]; NaN where a motion is NaN.

        Args:
            motion: Displacements and rotations since the reference pose, shape (N, 6) [m, rad].
            stamps: Times of the samples since the epoch, ascending, shape (N,) [ns]; None for
                motions that have no past.
            trail: What went before, which the samples are added to; None for nothing.
        """
        found = np.full((len(motion), FEATURES), np.nan)
        known = np.flatnonzero(np.isfinite(motion).all(axis=1))
        if stamps is None:
            moved = motion[known] / self.scale
            found[known] = np.hstack([moved, moved, moved, 0.0 * moved])
        else:
            trail = trail or PoseTrail(self.scale)
            found[known] = trail.add(stamps[known], motion[known])
        return (found - self.centre) / self.spread

    def mean(self, features: FloatArray) -> FloatArray:
        """What the process adds to the regression, shape (N, 6) [N m, N], at features (N, 24)."""
        found = [self._covariance(some) @ self._weights for some in _chunks(features)]
        return np.concatenate(found)

    def deviations(self, features: FloatArray) -> FloatArray:
        """Standard deviations of a measured wrench, shape (N, 6) [N m, N], at features (N, 24)."""
        shares = []
        for some in _chunks(features):
            covariance = self._covariance(some)
            explained = ((covariance @ self._precision) * covariance).sum(axis=1)
            shares.append(np.maximum(1.0 - explained, self.noise))
        return np.sqrt(np.concatenate(shares))[:, None] * (self.widening * self.deviation)

    def _covariance(self, features: FloatArray) -> FloatArray:
        """Correlations with the support points, shape (N, m) [-]."""
        apart = square_distances(features, self.support)
        return np.asarray((1.0 - self.noise) * np.exp(apart / (-2.0 * self.length**2)))

    @cached_property
    def _precision(self) -> FloatArray:
        """Inverse of the support points' correlations with noise, shape (m, m) [-]."""
        total = self._covariance(self.support) + self.noise * np.eye(len(self.support))
        return np.asarray(np.linalg.inv(total))

    @cached_property
    def _weights(self) -> FloatArray:
        """Weights of the support points, shape (m, 6) [N m, N]."""
        return self._precision @ self.left


def square_distances(one: FloatArray, other: FloatArray) -> FloatArray:
    """Squared distances between the points of two sets, shape (N, M) [-].

    Args:
        one: N points, shape (N, d) [-].
        other: M points, shape (M, d) [-].
    """
    found = (one**2).sum(axis=1)[:, None] + (other**2).sum(axis=1) - 2.0 * (one @ other.T)
    return np.asarray(np.maximum(found, 0.0))


def _chunks(features: FloatArray) -> Iterator[FloatArray]:
    """The features (N, 24) in parts of bounded size, at least one."""
    for start in range(0, max(len(features), 1), _CHUNK):
        yield features[start : start + _CHUNK]


@dataclass(frozen=True)
class WrenchModel:
    """Predicts the wrench from the limb's pose and, with memory, from its past: see the module.

    Attributes:
        reference_pose: Pose of the limb in {S} where the motion is zero, position and rotation
            vector, shape (6,) [m, rad].
        slope: Slope of the wrench [M; F] in {S} over displacement and rotation since the reference
            pose, shape (6, 6), a row per channel [N m, N per m, rad].
        constant: Wrench [M; F] in {S} at the reference pose, shape (6,) [N m, N].
        deviation: Standard deviations of the regression's errors on held-out blocks, shape (6,)
            [N m, N]; NaN if unknown.
        memory: What the regression leaves; None for the regression alone.
    """

    reference_pose: FloatArray
    slope: FloatArray
    constant: FloatArray
    deviation: FloatArray
    memory: MotionMemory | None = None

    @property
    def name(self) -> str:
        """What it is, in words."""
        return REGRESSION if self.memory is None else MEMORY

    def trail(self) -> PoseTrail | None:
        """An empty trail, for predictions sample by sample; None without memory."""
        return None if self.memory is None else PoseTrail(self.memory.scale)

    def predict(
        self,
        pose: FloatArray,
        stamps: IntArray | None = None,
        trail: PoseTrail | None = None,
    ) -> FloatArray:
        """Wrenches [M; F] at the load cell in {S}, shape (N, 6) [N m, N]; NaN without a pose.

        Args:
            pose: Poses of the limb in {S}, position and rotation vector, shape (N, 6) [m, rad].
            stamps: Times of the poses since the epoch, ascending, shape (N,) [ns], from which the
                memory follows; None for poses that have no past.
            trail: What went before, which the poses are added to; None for nothing.
        """
        motion = relative_pose(pose, self.reference_pose)
        wrench = self.constant + motion @ self.slope.T
        if self.memory is not None:
            wrench += self.memory.mean(self.memory.features(motion, stamps, trail))
        return np.asarray(wrench)

    def deviations(self, pose: FloatArray, stamps: IntArray | None = None) -> FloatArray:
        """Standard deviations of measured wrenches from the predicted ones, (N, 6) [N m, N].

        Args:
            pose: Poses of the limb in {S}, position and rotation vector, shape (N, 6) [m, rad].
            stamps: Times of the poses since the epoch, ascending, shape (N,) [ns]; None for poses
                that have no past.
        """
        motion = relative_pose(pose, self.reference_pose)
        if self.memory is not None:
            return self.memory.deviations(self.memory.features(motion, stamps))
        found = np.tile(self.deviation, (len(pose), 1))
        found[np.isnan(motion[:, 0])] = np.nan
        return found


def fit_wrench(samples: Samples) -> tuple[WrenchModel, str]:
    """Fit a regression on the pose, with memory unless that loses on held-out blocks.

    Args:
        samples: N samples in ascending time with every pose and a complete wrench.

    Returns:
        The predictor, and in words why it is this one.
    """
    reference = np.append(samples.position.mean(axis=0), samples.attitude)
    motion = relative_pose(samples.pose, reference)
    slope, constant = regress_wrench(samples, motion)
    left = samples.wrench - constant - motion @ slope.T
    plain = WrenchModel(reference, slope, constant, left.std(axis=0))
    rows = evenly(len(samples), MAX_SUPPORT)
    least = _BLOCKS * _LEAST_IN_BLOCK
    if len(rows) < least:
        return plain, f"a memory of the past needs {least} samples, and there are {len(rows)}"
    memory = _fit_memory(samples, motion, left, rows)
    thinned, moved = samples[rows], motion[rows]
    missed, missed_with, scaled = _held_out(thinned, moved, memory)
    known = np.isfinite(thinned.wrench).all(axis=1)
    alone = relative_error(missed[known], thinned.wrench[known])
    error = relative_error(missed_with[known], thinned.wrench[known])
    plain = replace(plain, deviation=np.sqrt(np.mean(missed**2, axis=0)))
    change = 100.0 * (error / max(alone, 1e-12) - 1.0)
    compared = f"on held-out blocks memory changes the error by {change:+.0f} %"
    if not error <= _MAX_WORSE * alone:
        return plain, compared
    widening = np.maximum(np.sqrt(np.mean(scaled**2, axis=0)), 1.0)
    memory = replace(memory, widening=widening)
    return replace(plain, memory=memory), compared


def _fit_memory(
    samples: Samples, motion: FloatArray, left: FloatArray, rows: IntArray
) -> MotionMemory:
    """The process with the length and the noise of the largest marginal likelihood on grids.

    The variance of each channel is at its maximum-likelihood value (Rasmussen & Williams, 2006,
    section 5.4.1).

    Args:
        samples: N samples in ascending time, with every pose.
        motion: Their displacements and rotations since the reference pose, shape (N, 6) [m, rad].
        left: What the regression leaves of their wrenches, shape (N, 6) [N m, N].
        rows: Indices of the m support points, shape (m,).
    """
    scale, ones = _spread(samples, motion), np.ones(6)
    blank = MotionMemory(
        scale, np.zeros(FEATURES), np.ones(FEATURES), left[:0], left[:0], 1.0, 1.0, ones, ones
    )
    features = blank.features(motion, samples.stamps)
    centre, spread = features.mean(axis=0), features.std(axis=0)
    spread[spread <= _MIN_SPREAD] = np.inf
    support = np.round((features[rows] - centre) / spread, 6)  # as precise as any pose
    targets, count = left[rows], len(rows)
    sizes = targets.std(axis=0)
    sizes[sizes == 0.0] = 1.0
    apart = square_distances(support, support)
    best: tuple[float, float, float, FloatArray] | None = None
    for length in _LENGTHS:
        values, vectors = np.linalg.eigh(np.exp(apart / (-2.0 * length**2)))
        power = (vectors.T @ (targets / sizes)) ** 2
        for noise in _NOISES:
            total = (1.0 - noise) * np.maximum(values, 0.0) + noise
            variance = np.maximum((power / total[:, None]).sum(axis=0) / count, 1e-12)
            evidence = -0.5 * (count * np.log(variance).sum() + 6.0 * np.log(total).sum())
            if best is None or evidence > best[0]:
                best = float(evidence), length, noise, np.sqrt(variance) * sizes
    assert best is not None
    _, length, noise, deviation = best
    return MotionMemory(scale, centre, spread, support, targets, length, noise, deviation, ones)


def _held_out(
    samples: Samples, motion: FloatArray, memory: MotionMemory
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors on consecutive blocks, each predicted by a fit to the others.

    Args:
        samples: The m samples that the memory rests on.
        motion: Their displacements and rotations since the reference pose, shape (m, 6) [m, rad].
        memory: The process, whose length and noise are kept.

    Returns:
        Predicted less measured wrenches of the regression alone, then with memory, shape (m, 6)
        [N m, N], and the latter over the standard deviations that the process states [-].
    """
    missed, missed_with, scaled = np.empty((3, len(samples), 6))
    for block in np.array_split(np.arange(len(samples)), _BLOCKS):
        rest = np.setdiff1d(np.arange(len(samples)), block)
        slope, constant = regress_wrench(samples[rest], motion[rest])
        errors = constant + motion @ slope.T - samples.wrench
        part = replace(memory, support=memory.support[rest], left=-errors[rest])
        missed[block] = errors[block]
        missed_with[block] = errors[block] + part.mean(memory.support[block])
        scaled[block] = missed_with[block] / part.deviations(memory.support[block])
    return missed, missed_with, scaled
