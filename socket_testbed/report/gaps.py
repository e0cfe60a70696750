"""Gaps between the triggers of a trial."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray

_GAP = 1.5  # [-]; of the usual period


@dataclass(frozen=True)
class Gap:
    """A time without triggers.

    Attributes:
        start: Of the last trigger before it, since the first sample [s].
        duration: To the next trigger [s].
    """

    start: float
    duration: float


def usual_period(time: FloatArray) -> float:
    """Median time between triggers [s]; NaN for fewer than two."""
    return float(np.median(np.diff(time))) if len(time) > 1 else float("nan")


def find_gaps(time: FloatArray) -> tuple[Gap, ...]:
    """Times between triggers of more than one and a half usual periods, the longest first.

    Args:
        time: Times of the triggers, rising, shape (N,) [s].
    """
    periods = np.diff(time)
    if not len(periods):
        return ()
    gaps = np.flatnonzero(periods > _GAP * usual_period(time))
    longest_first = gaps[np.argsort(-periods[gaps], kind="stable")]
    return tuple(Gap(float(time[i]), float(periods[i])) for i in longest_first)
