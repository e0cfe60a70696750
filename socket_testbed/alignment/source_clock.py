"""A source's own clock against that of the recording, from stamps and times of arrival."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray

_BLOCK = 10.0  # [s]; of which the quickest arrivals count
_QUICK = 0.1  # quantile of the delays of arrival that is little disturbed
MAX_OFFSET = 0.5  # [s]; between the clocks, beyond which stamps are not comparable
MAX_CHANGE = 0.004  # [s]; of the offset over the recording
_MAX_DRIFT = 2e-3  # [-]; more is a clock that was set meanwhile
_KEPT = 60.0  # [s] of a clock that is being followed
_REVIEW = 1.0  # [s]; between two reviews of it


@dataclass(frozen=True)
class SourceClock:
    """The clock of a source, a line against that of the recording.

    Attributes:
        start: First stamp, by the source's clock [ns].
        offset: Time of arrival minus stamp at the start, of the quickest messages [s].
        drift: Change of the offset per time [-]; positive if the source's clock is slow.
        duration: Time from the first stamp to the last [s].
        jitter: Usual departure of the arrivals from the line [s].
    """

    start: int
    offset: float
    drift: float
    duration: float
    jitter: float

    @property
    def is_another(self) -> bool:
        """Whether it is not the clock of the recording: set otherwise, or drifting."""
        change = abs(self.drift) * self.duration
        return abs(self.offset) > MAX_OFFSET or change > MAX_CHANGE

    def to_recording(self, stamps: IntArray) -> IntArray:
        """Times on the clock of the recording of stamps of the source, shape (N,) [ns]."""
        since = (stamps - self.start) * 1e-9
        correction = np.round(1e9 * (self.offset + self.drift * since)).astype(np.int64)
        return np.asarray(stamps + correction)

    def __str__(self) -> str:
        drift = 1e6 * self.drift
        return f"{self.offset:+.3f} s behind at first, then {drift:+.0f} us more each second"


def source_clock(stamps: IntArray, arrivals: IntArray) -> SourceClock:
    """The clock of a source from its messages; the quickest of each ten seconds count.

    What all messages need to arrive counts as offset, since nothing tells it from one.

    Args:
        stamps: Stamps by the source's clock, shape (N,) [ns], one or more.
        arrivals: When the recording received them, shape (N,) [ns].
    """
    start = int(stamps[0])
    since = (stamps - start) * 1e-9
    late = (arrivals - stamps) * 1e-9
    duration = float(np.ptp(since))
    blocks = np.floor(since / _BLOCK).astype(np.int64)
    if duration < 3.0 * _BLOCK:
        offset = float(np.quantile(late, _QUICK))
        return SourceClock(start, offset, 0.0, duration, float(np.median(np.abs(late - offset))))
    owns = [blocks == block for block in np.unique(blocks)]

    def quickest(drift: float) -> FloatArray:
        """Of each block the delay that is little disturbed, less the drift so far [s]."""
        level = late - drift * since
        return np.array([np.quantile(level[own], _QUICK) for own in owns])

    middles = np.array([since[own].mean() for own in owns])
    drift = 0.0
    for _ in range(2):  # the drift within a block moves its quickest delays
        drift += _slope(middles, quickest(drift))
    if abs(drift) > _MAX_DRIFT:
        drift = 0.0
    offset = float(np.median(quickest(drift)))
    jitter = float(np.median(np.abs(late - offset - drift * since)))
    return SourceClock(start, offset, drift, duration, jitter)


def _slope(times: FloatArray, values: FloatArray) -> float:
    """Slope of a line through points: the median of all slopes (Theil and Sen)."""
    later, earlier = np.triu_indices(len(times), 1)[::-1]
    return float(np.median((values[later] - values[earlier]) / (times[later] - times[earlier])))


class RunningClock:
    """The clock of a source that is being read, from its newest messages.

    Stamps count as they are unless the clock proves to be another one; then they are corrected by
    the quickest arrivals of the last minute.

    Attributes:
        clock: The clock of the last minute; None before the first message.
        is_another: Whether it is not the clock of the recording: set otherwise, or drifting.
    """

    def __init__(self) -> None:
        self.clock: SourceClock | None = None
        self.is_another = False
        self._parts: list[tuple[IntArray, IntArray]] = []
        self._first: float | None = None  # offset after half a minute [s]
        self._due = 0  # next review [ns]

    def add(self, stamps: IntArray, arrivals: IntArray) -> None:
        """Note some messages, in the order of their arrival.

        Args:
            stamps: Stamps by the source's clock, shape (k,) [ns], one or more.
            arrivals: When they arrived, on the clock of the recording, shape (k,) [ns].
        """
        self._parts.append((stamps, arrivals))
        newest = int(arrivals[-1])
        if self.clock is not None and newest < self._due:
            return
        self._due = newest + round(_REVIEW * 1e9)
        last = float(np.min(arrivals - stamps)) * 1e-9
        if self.clock is not None and abs(last - self._offset(stamps)) > MAX_OFFSET:
            self._parts = [(stamps, arrivals)]  # a clock was set
        joined = [np.concatenate(column) for column in zip(*self._parts, strict=True)]
        kept = joined[1] >= newest - round(_KEPT * 1e9)
        self._parts = [(joined[0][kept], joined[1][kept])]
        self.clock = source_clock(*self._parts[0])
        offset = self._offset(stamps)
        if self._first is None and self.clock.duration >= 0.5 * _KEPT:
            self._first = offset
        changed = self._first is not None and abs(offset - self._first) > MAX_CHANGE
        self.is_another = changed or self.clock.is_another

    def _offset(self, stamps: IntArray) -> float:
        """Time of arrival minus stamp at the last of some stamps (k,) [ns], by the line [s]."""
        assert self.clock is not None
        return float(self.clock.to_recording(stamps[-1:])[0] - stamps[-1]) * 1e-9

    def to_recording(self, stamps: IntArray) -> IntArray:
        """Times on the clock of the recording of stamps of the source, shape (N,) [ns]."""
        if not self.is_another or self.clock is None:
            return stamps
        return self.clock.to_recording(stamps)
