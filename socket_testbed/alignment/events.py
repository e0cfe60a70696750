"""Events that several sources see, such as a tap on the socket, to bring their clocks together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.alignment.align import Series
from socket_testbed.alignment.series import PoseSeries, WrenchSeries
from socket_testbed.arrays import FloatArray
from socket_testbed.errors import TrialError

_MIN_HEIGHT = 10.0  # [-]; of a tap, in usual changes from reading to reading
_ALIKE = 1.0 / 3.0  # height of another rise that could be the tap too, per that of the highest
_APART = 0.3  # [s]; rises closer than this are one event
_ONSET = 3.0  # [-]; where a tap begins, in usual changes
_RISE = 0.05  # [s]; longest time from the beginning of a tap to its steepest change
_MIN_READINGS = 20


@dataclass(frozen=True)
class Tap:
    """When a source saw a tap.

    Attributes:
        time: Middle between the last reading before it and the first one in it [ns].
        error: Half the time between these readings [s].
        height: Its largest change from reading to reading, in usual changes [-].
    """

    time: int
    error: float
    height: float


def find_tap(series: Series, span: tuple[float, float] | None = None) -> Tap:
    """The one sharp rise of a source: a tap, a knock or a drop.

    The change from a reading to the next, over its time and over all components scaled by their
    usual change, is highest in a tap. A second rise of a third of that, more than 0.3 s away, could
    be it as well, and is refused.

    Args:
        series: What the source measured; of a wrench the forces count, of a pose the position.
        span: Seconds since its first reading in which to look; None for all of it.

    Raises:
        TrialError: If there is no tap, or several rises are alike.
    """
    values = _moved(series)
    known = np.isfinite(values).all(axis=1)
    times, values = series.times[known], values[known]
    since = (times - series.times[0]) * 1e-9
    if span is not None:
        inside = (since >= span[0]) & (since <= span[1])
        times, values, since = times[inside], values[inside], since[inside]
    if len(times) < _MIN_READINGS:
        raise TrialError(
            f"holds {len(times)} readings where a tap is looked for", "look in a longer span"
        )
    changes = np.abs(np.diff(values, axis=0))
    usual = np.median(changes, axis=0)
    least = np.maximum(changes.mean(axis=0), 1e-12 * np.abs(values).max(axis=0))
    scaled = changes / np.where(usual > 0.0, usual, np.where(least > 0.0, least, 1.0))
    height = np.sqrt(np.mean(scaled**2, axis=1))
    quiet = float(np.median(height)) or 1.0
    height /= quiet
    highest = float(height.max())
    if highest < _MIN_HEIGHT:
        raise TrialError(
            f"sees no tap: its sharpest change is {highest:.2g} times the usual one",
            "tap harder, while nothing else moves, or state the offset",
        )
    sharp = np.flatnonzero(height >= _ALIKE * highest)
    first = int(sharp[0])
    if (later := sharp[since[sharp] - since[first] > _APART]).size:
        raise TrialError(
            f"sees several sharp rises, at {since[first]:.2f} s and {since[later[0]]:.2f} s of its"
            " own time",
            "state the seconds in which each source sees one tap only, with --tap T0:T1",
        )
    begin = first
    while begin > 0 and height[begin - 1] >= _ONSET and since[first] - since[begin - 1] <= _RISE:
        begin -= 1
    before, after = int(times[begin]), int(times[begin + 1])
    return Tap((before + after) // 2, 0.5e-9 * (after - before), highest)


def _moved(series: Series) -> FloatArray:
    """The values in which a tap is looked for, shape (N, k)."""
    if isinstance(series, WrenchSeries):
        return series.values[:, 3:]
    if isinstance(series, PoseSeries):
        return series.positions
    values = series.values.reshape(len(series.times), -1)
    return values[:, np.isfinite(values).any(axis=0)]
