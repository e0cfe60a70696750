"""Averages around a trigger that belong to its time, whatever moves meanwhile."""

from __future__ import annotations

import numpy as np

from socket_testbed.arrays import FloatArray

_LONGEST = 0.25  # [s]; of the default


def averaging_span(wanted: float, period: float) -> float:
    """Span around a trigger to average over [s].

    Args:
        wanted: The setting [s]; negative for the trigger's period, 0.25 s at most.
        period: Period of the trigger [s]; 0 if it is not known yet.
    """
    return wanted if wanted >= 0.0 else min(period, _LONGEST)


def line_weights(offsets: FloatArray) -> FloatArray:
    """Weights that make of n values the value at offset 0 of their least-squares line.

    With offsets that are even about 0 it is the mean. With others, as where some values are
    missing, the mean would lag behind a steady motion; the line does not.

    Args:
        offsets: Times of the values from the time that is asked for, shape (n,) [s].

    Returns:
        Weights, shape (n,) [-]; their sum of squares is the variance of the result for values of
        variance 1.
    """
    if len(offsets) == 0:
        return offsets
    mean = offsets.mean()
    centred = offsets - mean
    spread = float(centred @ centred)
    weights = np.full(len(offsets), 1.0 / len(offsets))
    return weights - centred * (mean / spread) if spread > 0.0 else weights
