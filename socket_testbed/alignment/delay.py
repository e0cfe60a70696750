"""Delay of a source against the load that it feels, with its interval."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from socket_testbed.alignment.align import Series, align
from socket_testbed.alignment.series import ClusterSeries, PoseSeries, WrenchSeries
from socket_testbed.arrays import FloatArray
from socket_testbed.errors import TrialError
from socket_testbed.geometry.pose import Pose
from socket_testbed.settings.alignment import SourceSettings

_SECOND = 1_000_000_000  # [ns]
_GRID = 0.01  # [s]
_SLOW = 1.0  # [s]; of a moving mean that is subtracted: creep and friction lag behind slow loads
_BLOCK = 4.0  # [s]; whose delays are compared for the interval
_MIN_BLOCKS = 4
_RIDGE = 1e-3  # of the largest variance, below which a direction does not count
_LEVEL = 0.975  # quantile of a 95 % interval


@dataclass(frozen=True)
class Delay:
    """Delay of a source behind the load.

    Attributes:
        delay: By how much its stamps are later than those of the load [s]; negative if earlier.
        low: Lower end of the 95 % interval [s].
        high: Upper end of the 95 % interval [s].
        agreement: Share of the source's quick changes that the load explains with that delay [-].
    """

    delay: float
    low: float
    high: float
    agreement: float

    def __str__(self) -> str:
        return f"{1e3 * self.delay:.1f} ms ({1e3 * self.low:.1f} to {1e3 * self.high:.1f})"


def find_delay(
    load: WrenchSeries,
    source: PoseSeries | ClusterSeries,
    socket: PoseSeries | None = None,
    longest: float = 0.5,
) -> Delay:
    """Delay of poses or clusters behind the load that moves or presses them.

    The source follows the load linearly over a second: its quick changes are those of the wrench,
    in some combination, a delay later. The delay with the highest share of explained variance is
    refined by a parabola; its interval is that of a jackknife over blocks of four seconds. Push and
    let go from all sides for a minute: creep and friction make slow loads look late.

    Args:
        load: The wrench; about a minute of pushing.
        source: The pose of the limb's body, or the clusters.
        socket: The pose of the socket's body, in which that of the limb is taken; None for a socket
            at rest.
        longest: Longest delay that is looked for, either way [s].

    Raises:
        TrialError: If both share too little time, or the best delay is the longest.
    """
    times = [series.times for series in (load, source)]
    start, end = max(own[0] for own in times), min(own[-1] for own in times)
    least = _MIN_BLOCKS * _BLOCK + 2.0 * longest
    if (end - start) * 1e-9 < least:
        raise TrialError(
            f"the load and the source share {max(0.0, (end - start) * 1e-9):.3g} s, and a delay"
            f" needs {least:.3g} s",
            "record a minute of pushing, or state the delay",
        )
    grid = np.arange(start, end, round(_GRID * _SECOND), dtype=np.int64)
    forces = _quick(_on_grid(load, grid))
    moved = _quick(_motion(source, socket, grid))
    reach = round(longest / _GRID)
    blocks = _covariances(_whitened(forces), _whitened(moved), reach)
    total = blocks.sum(axis=0)
    best, agreement = _peak(total)
    if abs(best) >= reach - 1:
        raise TrialError(
            f"no delay up to {longest:g} s fits the load", "look further, or push for longer"
        )
    left_out = np.array([_peak(total - block)[0] for block in blocks])
    number = len(blocks)
    error = np.sqrt((number - 1) / number * np.sum((left_out - left_out.mean()) ** 2))
    half = float(stats.t.ppf(_LEVEL, number - 1) * error * _GRID)
    delay = best * _GRID
    return Delay(delay, delay - half, delay + half, agreement)


def _on_grid(series: Series, grid: np.ndarray) -> FloatArray:
    """Values of a series on a grid of times, shape (N, k), gaps interpolated."""
    found = align(series, grid, SourceSettings(stale=10.0), _GRID).values
    return found.reshape(len(grid), -1)


def _motion(
    source: PoseSeries | ClusterSeries, socket: PoseSeries | None, grid: np.ndarray
) -> FloatArray:
    """What the load moves: position and rotation of the limb, or values of the clusters (N, k)."""
    values = _on_grid(source, grid)
    if isinstance(source, ClusterSeries):
        return values[:, np.isfinite(values).all(axis=0)]
    pose = Pose.from_vector(values)
    if socket is not None:
        pose = Pose.from_vector(_on_grid(socket, grid)).inverse() @ pose
    turned = Pose(np.swapaxes(pose.rotation[:1], 1, 2) @ pose.rotation, pose.translation)
    return np.hstack([pose.translation, turned.rotation_vector()])


def _quick(values: FloatArray) -> FloatArray:
    """Values less their moving mean over a second, shape (N, k); unknown ones are 0."""
    width = round(_SLOW / _GRID) | 1
    values = np.nan_to_num(values - np.nanmean(values, axis=0))
    weights = np.hanning(width + 2)[1:-1]
    weights /= weights.sum()
    smooth = [np.convolve(np.pad(own, width // 2, mode="edge"), weights, "valid")
              for own in values.T]  # fmt: skip
    return np.asarray(values - np.column_stack(smooth))


def _whitened(values: FloatArray) -> FloatArray:
    """Uncorrelated combinations of unit variance of scaled columns, shape (N, r)."""
    scaled = values / np.maximum(values.std(axis=0), 1e-30)
    variances, axes = np.linalg.eigh(scaled.T @ scaled / len(scaled))
    kept = variances > _RIDGE * variances[-1]
    return np.asarray(scaled @ (axes[:, kept] / np.sqrt(variances[kept])))


def _covariances(load: FloatArray, moved: FloatArray, reach: int) -> FloatArray:
    """Covariances of the load with what is moved some steps later, by block, (b, 2 r + 1, i, j)."""
    inner = np.arange(reach, len(load) - reach)
    parts = np.array_split(inner, max(_MIN_BLOCKS, round(len(inner) * _GRID / _BLOCK)))
    lags = range(-reach, reach + 1)
    return np.array(
        [[load[part].T @ moved[part + lag] / len(inner) for lag in lags] for part in parts]
    )


def _peak(covariances: FloatArray) -> tuple[float, float]:
    """The lag [steps] of the largest squared covariance, and its share of that possible [-]."""
    power = np.sum(covariances**2, axis=(1, 2))
    reach = len(power) // 2
    best = int(power.argmax())
    share = float(power[best] / min(covariances.shape[1:]))
    if not 0 < best < len(power) - 1:
        return float(best - reach), share
    before, at, after = power[best - 1 : best + 2]
    bend = before - 2.0 * at + after
    return best - reach + (0.5 * (before - after) / bend if bend < 0.0 else 0.0), share
