r"""The noise of every channel, estimated from a trial itself, and smoothing of poses.

The estimate uses only the fast content of a channel. With samples at equal intervals, the third
difference

.. math:: d_k = y_{k+3} - 3 y_{k+2} + 3 y_{k+1} - y_k

removes motion that is locally quadratic in time, and turns white noise of standard deviation
:math:`\sigma` into :math:`\sqrt{20}\,\sigma` (for the principle: Rice, Annals of Statistics 12,
1984). A motion with period T at the sampling interval h keeps :math:`(2 \pi h / T)^3` of its
amplitude: 0.3 % for 11 s at 4 Hz. Motion from sample to sample, such as a person's sway at 4 Hz,
cannot be told from noise and counts as noise.

Differences beyond `CUT` times the spread estimated from their median are discarded: steps, single
outliers and swapped markers. So are differences across a gap or a missing value.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from socket_testbed.arrays import (
    TOLERANCE,
    BoolArray,
    FloatArray,
    IntArray,
    gaps,
    rms,
    robust_deviation,
)
from socket_testbed.samples import Samples, turned
from socket_testbed.settings.identification import ForceMapSettings

MIN_DIFFERENCES = 12  # [1]; of a channel, for an estimate
CUT = 3.0  # [-]; largest magnitude of a difference, in standard deviations
_GAIN = math.sqrt(20.0)  # [-]; root sum of squares of a third difference's weights
# Standard deviation of a standard normal variable within +-CUT [-]
_WITHIN = math.erf(CUT / math.sqrt(2.0))
_TRUNCATED = math.sqrt(1.0 - CUT * math.sqrt(2.0 / math.pi) * math.exp(-0.5 * CUT**2) / _WITHIN)
_QUANTISED = math.sqrt(1.0 / 12.0)  # [-]; standard deviation of rounding, in steps
_ROUNDING = 1e-12  # [-]; smallest step of a channel, relative to its largest value
_DEFINITE = 1.0 - 1e-6  # [-]; largest correlation of two components


@dataclass(frozen=True)
class PoseNoise:
    """Noise of the pose of one sample: position and small rotations about x, y, z of {S}.

    Attributes:
        deviation: Standard deviations, shape (6,) [m, rad]; NaN where it cannot be estimated.
        correlation: Correlation of the components, which share markers, shape (6, 6) [-]; the unit
            matrix if it cannot be estimated.
    """

    deviation: FloatArray
    correlation: FloatArray

    def covariance(self, gain: float) -> FloatArray:
        """Covariance of the noise of averaged poses in {S}, shape (6, 6) [m^2, m rad, rad^2].

        The gain is the share of the variance that averaging leaves, 1 without [-]:
        see `smoothing_gain`.
        """
        return gain * self.correlation * np.outer(self.deviation, self.deviation)


@dataclass(frozen=True)
class ChannelNoise:
    """Standard deviation of the noise of one sample; NaN where it cannot be estimated.

    Attributes:
        wrench: Noise of the wrench [M; F] in {S}, shape (6,) [N m, N].
        local_forces: Noise of the force on each of the c clusters in its tile's frame, shape
            (c, 3) [N].
        pose: Noise of the limb's position and of its small rotations about x, y, z of {S}, shape
            (6,) [m, rad].
    """

    wrench: FloatArray
    local_forces: FloatArray
    pose: FloatArray

    @property
    def values(self) -> FloatArray:
        """Noise in the order of `Samples.channels`, shape (6 + 3c,) [N m, N]."""
        return np.concatenate([self.wrench, self.local_forces.reshape(-1)])


def channel_noise(samples: Samples) -> ChannelNoise:
    """Estimate the noise of every channel of N samples from its third differences: see the module.

    Forces whose status is not OK are ignored. The noise is NaN for a constant channel or one with
    fewer than `MIN_DIFFERENCES` usable differences.
    """
    sensors = deviations(samples.trusted_values, ~gaps(samples.stamps))
    return ChannelNoise(
        wrench=sensors[:6],
        local_forces=sensors[6:].reshape(-1, 3),
        pose=pose_noise(samples).deviation,
    )


def pose_noise(samples: Samples) -> PoseNoise:
    """Estimate the noise of the pose alone, as `channel_noise` does, and its correlation."""
    usual = ~gaps(samples.stamps)
    pose = samples.centred().pose
    deviation = deviations(pose, usual)
    return PoseNoise(deviation, _correlation(pose, _without_gap(usual), deviation))


def deviations(values: FloatArray, usual: BoolArray) -> FloatArray:
    """Noise of k channels, in their units, shape (k,); NaN where it cannot be estimated.

    Args:
        values: The channels, shape (N, k).
        usual: Which of the steps between samples are of the usual length, shape (N - 1,).
    """
    regular = _without_gap(usual)
    return np.array([_deviation(y, regular) for y in values.T])


def _without_gap(usual: BoolArray) -> BoolArray:
    """Which groups of four samples hold no gap, (max(N - 3, 0),), from (N - 1,) usual steps."""
    return np.asarray(usual[:-2] & usual[1:-1] & usual[2:])


def _differences(values: FloatArray, regular: BoolArray) -> FloatArray:
    """Normalised third differences, NaN across a gap, shape (max(N - 3, 0), ...)."""
    found = np.diff(values, 3, axis=0) / _GAIN
    found[~regular] = np.nan
    return np.asarray(found)


def _deviation(values: FloatArray, regular: BoolArray) -> float:
    """Standard deviation of the noise of one channel, from its N values."""
    sizes = np.abs(_differences(values, regular))
    sizes = sizes[np.isfinite(sizes)]
    if len(sizes) < MIN_DIFFERENCES:
        return float("nan")
    rough = float(robust_deviation(sizes))
    found = _deviation_within(sizes, rough)
    # Only coarse values show their rounding. Successive ones bound its step, without sorting all.
    known = values[np.isfinite(values)]
    if 0.0 < _QUANTISED * _smallest(np.abs(np.diff(known)), known) <= min(rough, found):
        return found
    rounding = _QUANTISED * _smallest(np.diff(np.unique(known)), known)
    if rounding == 0.0:  # a constant
        return float("nan")
    return max(_deviation_within(sizes, max(rough, rounding)), rounding)


def _deviation_within(sizes: FloatArray, rough: float) -> float:
    """Standard deviation from the sizes, (k,), of those differences within `CUT` rough ones."""
    kept = sizes[sizes <= CUT * rough]
    return float(np.sqrt(np.mean(kept**2))) / _TRUNCATED


def _smallest(differences: FloatArray, values: FloatArray) -> float:
    """Smallest of some differences of values (N,) that is no rounding; 0 without any."""
    beyond = differences[differences > _ROUNDING * np.abs(values).max(initial=0.0)]
    return float(beyond.min()) if len(beyond) else 0.0


def _correlation(pose: FloatArray, regular: BoolArray, deviation: FloatArray) -> FloatArray:
    """Correlation of the noise of the pose's components, shape (6, 6) [-]."""
    scaled = _differences(pose, regular) / deviation
    scaled = scaled[(np.abs(scaled) <= CUT).all(axis=1)]  # none where a component is NaN
    if len(scaled) < MIN_DIFFERENCES:
        return np.eye(6)
    products = scaled.T @ scaled
    size = np.sqrt(np.diag(products))
    # Not quite 1 where components are proportional, as of a hinge: the covariance stays definite.
    return np.asarray(_DEFINITE * products / np.outer(size, size) + (1.0 - _DEFINITE) * np.eye(6))


def measurement_errors(
    samples: Samples, noise: FloatArray, settings: ForceMapSettings
) -> FloatArray:
    r"""Standard deviation of each cluster's measurement error, shape (c, 3) [N].

    .. math:: \sqrt{\max(\sigma_{noise}, \sigma_{offset})^2 + (\sigma_{gain} f_{rms})^2}

    with the force map's uncertainty of the offset (including typical noise) and of the gain, and
    the RMS f_rms of the channel.

    Args:
        samples: Samples with c clusters, over which the RMS is taken.
        noise: Noise of each channel in the clusters' frames, shape (c, 3) [N]; NaN if unknown.
        settings: Prior of the force map, with the uncertainties.
    """
    forces = samples.trusted_forces
    sizes = np.empty(noise.shape)
    for cluster, axis in np.ndindex(noise.shape):
        sizes[cluster, axis] = rms(forces[:, cluster, axis])
    offset = np.fmax(noise, settings.cluster_error)
    return np.hypot(offset, settings.cluster_gain_error * np.nan_to_num(sizes))


def smooth_poses(samples: Samples, window: float) -> Samples:
    """The samples with each pose replaced by the mean of the poses in a window around it.

    The window is centred, so the mean does not lag: near a gap, and near the first and last sample,
    it is shorter on both sides. Missing poses stay missing.

    Args:
        samples: N samples in ascending time.
        window: Width of the window [s]; 0 leaves the poses as they are.
    """
    known = samples.has_pose
    if window == 0.0 or not known.any():
        return samples
    pose = np.where(known[:, None], samples.centred().pose, 0.0)
    first, end = _windows(samples, window)
    mean = np.full(pose.shape, np.nan)
    mean[known] = _sums(pose, first, end)[known] / _sums(known, first, end)[known, None]
    return replace(samples, position=mean[:, :3], rotation=turned(mean[:, 3:], samples.attitude))


def smoothing_gain(samples: Samples, window: float) -> float:
    """Mean share of white noise's variance left by `smooth_poses`, above 0 and up to 1 [-].

    Args:
        samples: N samples in ascending time, of which the stamps and the missing poses matter.
        window: Width of the window [s]; 0 gives 1.
    """
    known = samples.has_pose
    if window == 0.0 or not known.any():
        return 1.0
    return float(np.mean(1.0 / _sums(known, *_windows(samples, window))[known]))


def _windows(samples: Samples, window: float) -> tuple[IntArray, IntArray]:
    """The first sample of the window around each sample, and the one after its last, (N,) each."""
    time = samples.time
    run = np.concatenate([[0], np.cumsum(gaps(samples.stamps))])  # of samples between gaps
    start = time[np.searchsorted(run, run, "left")]
    stop = time[np.searchsorted(run, run, "right") - 1]
    reach = np.minimum(0.5 * window, np.minimum(time - start, stop - time)) + TOLERANCE
    first = np.searchsorted(time, time - reach, "left")
    return first, np.searchsorted(time, time + reach, "right")


def _sums(values: FloatArray | BoolArray, first: IntArray, end: IntArray) -> FloatArray:
    """Sums of the rows of values from `first` to before `end`, shape (N, ...)."""
    total = np.cumsum(values, axis=0, dtype=np.float64)
    total = np.concatenate([np.zeros_like(total[:1]), total])
    return np.asarray(total[end] - total[first])
