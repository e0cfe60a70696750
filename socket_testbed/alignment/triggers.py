"""Triggers for sources that know none: at a rate, over the time that all sources share."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from socket_testbed.alignment.align import Series
from socket_testbed.arrays import IntArray
from socket_testbed.errors import TrialError

_SECOND = 1_000_000_000  # [ns]
_MIN_TRIGGERS = 2


def triggers_at(
    rate: float, sources: Mapping[str, Series], delays: Mapping[str, float] | None = None
) -> IntArray:
    """Uniform triggers over the common span of some sources, shape (N,) [ns].

    Args:
        rate: Their rate [Hz].
        sources: What each source measured, by its name in errors; one or more.
        delays: Delay of each source's stamps behind the measurement, by name [s]; 0 where it is
            left out.

    Raises:
        TrialError: If a source has no reading, or the sources share less than two triggers.
    """
    spans: dict[str, tuple[int, int]] = {}
    for name, series in sources.items():
        if not len(series.times):
            raise TrialError(f"{name} has no reading", "choose another source, or leave it out")
        delay = round((delays or {}).get(name, 0.0) * _SECOND)
        spans[name] = int(series.times[0]) - delay, int(series.times[-1]) - delay
    late = max(spans, key=lambda name: spans[name][0])
    early = min(spans, key=lambda name: spans[name][1])
    start, end = spans[late][0], spans[early][1]
    count = int((end - start) * 1e-9 * rate) + 1 if end > start else 0
    if count < _MIN_TRIGGERS:
        shared = (end - start) * 1e-9
        fact = f"{late} and {early} share {shared:.3g} s, too little at {rate:g} Hz"
        if late == early:
            fact = f"{late} lasts {shared:.3g} s, too little at {rate:g} Hz"
            raise TrialError(fact, "give a higher rate, or a longer recording")
        if shared < 0.0:
            fact = f"{late} starts {-shared:.3g} s after {early} ends"
        raise TrialError(fact, "check the clocks of both, or state the delay of one")
    return start + np.round(np.arange(count) * (_SECOND / rate)).astype(np.int64)
