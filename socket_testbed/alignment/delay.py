"""Delay of a source against the load that it feels, with its interval."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from socket_testbed.alignment.align import Series, align
from socket_testbed.alignment.series import ClusterSeries, PoseSeries, WrenchSeries
from socket_testbed.arrays import UPPER_QUANTILE, FloatArray, IntArray
from socket_testbed.errors import TrialError
from socket_testbed.geometry.pose import Pose
from socket_testbed.settings.alignment import SourceSettings

_SECOND = 1_000_000_000  # [ns]
_GRID = 0.01  # [s]
_BAND = 0.3, 5.0  # [Hz]; creep is slower, noise quicker
_EDGE = 2.0  # [s]; at either end, which the filter disturbs
_BLOCK = 4.0  # [s]; blocks are left out in turn for the interval
_MIN_BLOCKS = 4
_LONGEST_GAP = 10.0  # [s]; in the readings
_RIDGE = 1e-6  # of the largest variance, below which a direction does not count
_LONGEST = 0.5  # [s]; delay that is looked for, either way
_NEAR = 4  # steps either side of the best one through which a curve is laid
_FINE = 100  # parts of a step
_MAX_HALF = 0.5  # of the longest delay; a wider interval is no answer


@dataclass(frozen=True)
class Delay:
    """Delay of a source behind the load.

    Attributes:
        delay: By how much its stamps are later than those of the load [s]; negative if earlier.
        low: Lower end of the 95 % interval [s].
        high: Upper end of the 95 % interval [s].
        agreement: Share of the source's quick changes that the load explains with that delay, from
            0 to 1 [-].
    """

    delay: float
    low: float
    high: float
    agreement: float

    @property
    def reversed(self) -> Delay:
        """Delay of the load behind the source."""
        return Delay(-self.delay, -self.high, -self.low, self.agreement)

    def later(self, seconds: float) -> Delay:
        """This delay behind another one, as a delay behind the measurement.

        Args:
            seconds: Delay behind the measurement of that which this one is behind [s].
        """
        ends = self.delay + seconds, self.low + seconds, self.high + seconds
        return Delay(*ends, self.agreement)

    def __str__(self) -> str:
        return f"{1e3 * self.delay:.1f} ms ({1e3 * self.low:.1f} to {1e3 * self.high:.1f} ms)"


def find_delay(
    load: WrenchSeries,
    source: PoseSeries | ClusterSeries,
    socket: PoseSeries | None = None,
) -> Delay:
    """Delay of poses or clusters behind the load that moves or presses them.

    Between 0.3 and 5 Hz the source follows the load linearly, with a phase that friction adds at
    all frequencies alike (the load's Hilbert transform); a delay adds a phase that grows with the
    frequency. The delay with the least generalised variance of what the load leaves unexplained is
    the estimate, which is that of maximum likelihood; its interval is that of a jackknife over
    blocks of four seconds. Push briskly from all sides for a minute, once or twice a second: slow
    pushes leave the interval wide.

    Args:
        load: The wrench; about a minute of pushing.
        source: The pose of the limb's body, or the clusters.
        socket: The pose of the socket's body, in which that of the limb is taken; None for a socket
            at rest.

    Raises:
        TrialError: If they share too little time, have a long gap, or the load does not tell the
            delay.
    """
    from scipy import signal  # slow to import

    every = [load, source] if socket is None else [load, source, socket]
    grid = _common_times([series.times for series in every])
    forces = _band(_on_grid(load, grid), "the load")
    turned = np.imag(signal.hilbert(forces, axis=0))
    moved = _band(_motion(source, socket, grid), "the source")
    edge = round(_EDGE / _GRID)
    inner = slice(edge, len(grid) - edge)
    sums = _sums(
        _uncorrelated(np.hstack([forces, turned])[inner]),
        _uncorrelated(moved[inner]),
        round(_LONGEST / _GRID),
    )
    total = tuple(blocks.sum(axis=0) for blocks in sums)
    delay, agreement = _best(*total)
    number = len(sums[0])
    left_out = np.array(
        [_best(*(t - own[row] for t, own in zip(total, sums, strict=True)))[0]
         for row in range(number)]
    )  # fmt: skip
    error = np.sqrt((number - 1) / number * np.sum((left_out - left_out.mean()) ** 2))
    half = float(stdtrit(number - 1, UPPER_QUANTILE) * error)
    if abs(delay) >= _LONGEST - _NEAR * _GRID or half > _MAX_HALF * _LONGEST:
        raise TrialError(
            f"the load does not tell the delay ({1e3 * delay:.0f} +- {1e3 * half:.0f} ms)",
            "push briskly from all sides for a minute, or state the delay",
        )
    return Delay(delay, delay - half, delay + half, agreement)


def _common_times(times: list[IntArray]) -> IntArray:
    """A grid of times that all sources share, shape (N,) [ns]."""
    start = max(int(own[0]) if len(own) else 0 for own in times)
    end = min(int(own[-1]) if len(own) else 0 for own in times)
    shared = max(0.0, (end - start) * 1e-9)
    least = _MIN_BLOCKS * _BLOCK + 2.0 * (_LONGEST + _EDGE)
    if shared < least:
        raise TrialError(
            f"the load and the source share {shared:.3g} s, and a delay needs {least:.3g} s",
            "record a minute of pushing, or state the delay",
        )
    return np.arange(start, end, round(_GRID * _SECOND), dtype=np.int64)


def _on_grid(series: Series, grid: IntArray) -> FloatArray:
    """Values of a series on a grid of times, shape (N, k), gaps interpolated."""
    found = align(series, grid, SourceSettings(stale=_LONGEST_GAP), _GRID).values
    return found.reshape(len(grid), -1)


def _motion(
    source: PoseSeries | ClusterSeries, socket: PoseSeries | None, grid: IntArray
) -> FloatArray:
    """What the load moves: position and rotation of the limb, or values of the clusters (N, k)."""
    values = _on_grid(source, grid)
    if isinstance(source, ClusterSeries):
        return values
    pose = Pose.from_vector(values)
    if socket is not None:
        pose = Pose.from_vector(_on_grid(socket, grid)).inverse() @ pose
    turned = Pose(np.swapaxes(pose.rotation[:1], 1, 2) @ pose.rotation, pose.translation)
    return np.hstack([pose.translation, turned.rotation_vector()])


def _band(values: FloatArray, name: str) -> FloatArray:
    """The quick changes of those columns that are known throughout and change, shape (N, k)."""
    from scipy import signal  # slow to import

    values = values[:, np.isfinite(values).all(axis=0)]
    values = values[:, np.ptp(values, axis=0) > 0.0] if values.size else values
    if not values.shape[1]:
        raise TrialError(
            f"{name} does not change, or has a gap of over {_LONGEST_GAP:g} s",
            "push for a minute, or state the delay",
        )
    sections = signal.butter(2, _BAND, "bandpass", fs=1.0 / _GRID, output="sos")
    return np.asarray(signal.sosfiltfilt(sections, values - values.mean(axis=0), axis=0))


def _uncorrelated(values: FloatArray) -> FloatArray:
    """Uncorrelated combinations of unit variance of scaled columns, shape (N, r)."""
    scaled = values / values.std(axis=0)
    variances, axes = np.linalg.eigh(scaled.T @ scaled / len(scaled))
    kept = variances > _RIDGE * variances[-1]
    return np.asarray(scaled @ (axes[:, kept] / np.sqrt(variances[kept])))


def _sums(
    load: FloatArray, moved: FloatArray, reach: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sums of products by block, of the load, and with and of what is moved some steps later.

    Their shapes are (b, i, i), (b, 2 r + 1, i, j) and (b, 2 r + 1, j, j), with a reach of r steps.
    """
    inner = np.arange(reach, len(load) - reach)
    parts = np.array_split(inner, max(_MIN_BLOCKS, round(len(inner) * _GRID / _BLOCK)))
    lags = range(-reach, reach + 1)
    own = np.array([load[part].T @ load[part] for part in parts])
    both = np.array([[load[part].T @ moved[part + lag] for lag in lags] for part in parts])
    later = np.array([[moved[part + lag].T @ moved[part + lag] for lag in lags] for part in parts])
    return own, both, later


def _best(own: FloatArray, both: FloatArray, later: FloatArray) -> tuple[float, float]:
    """The delay [s] that leaves least unexplained, and the share it explains [-].

    Between steps the sums of products are interpolated, which is exact enough for values in a band.
    """
    from scipy.interpolate import make_interp_spline  # 0.1 s, which a recorded trial need not wait

    unexplained = _log_unexplained(own, both, later)
    reach = len(unexplained) // 2
    best = min(max(int(unexplained.argmin()), _NEAR), 2 * reach - _NEAR)
    near = np.arange(best - _NEAR, best + _NEAR + 1)
    fine = np.linspace(best - 1.0, best + 1.0, 2 * _FINE + 1)
    curves = [make_interp_spline(near, sums[near], k=5)(fine) for sums in (both, later)]
    unexplained = _log_unexplained(own, *curves)
    row = int(unexplained.argmin())
    share = 1.0 - float(np.exp(unexplained[row] / later.shape[-1]))
    return _GRID * float(fine[row] - reach), share


def _log_unexplained(own: FloatArray, both: FloatArray, later: FloatArray) -> FloatArray:
    """Logarithm of the share of the generalised variance that the load leaves, by lag, (l,)."""
    left = later - np.swapaxes(both, 1, 2) @ np.linalg.solve(own, both)
    return np.asarray(np.linalg.slogdet(left)[1] - np.linalg.slogdet(later)[1])
