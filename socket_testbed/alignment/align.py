"""One alignment of sources that know no trigger, live and offline.

For each trigger the readings of a source in a window around it give one value; nothing is matched
by nearest. `align` does so for a whole series, `SourceBuffer` for a source that is still being
read, by the same function.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from socket_testbed.alignment.series import ClusterSeries, PoseSeries, WrenchSeries
from socket_testbed.arrays import BoolArray, FloatArray, IntArray, StatusArray, line_weights
from socket_testbed.arrays import usual_period as median_step
from socket_testbed.geometry.pose import weighted_pose
from socket_testbed.samples import Status
from socket_testbed.settings.alignment import USUAL_STALE, SourceSettings

Series: TypeAlias = WrenchSeries | PoseSeries | ClusterSeries
"""What a source measured, of any kind."""

_SECOND = 1_000_000_000  # [ns]
_MIN_COMPLETE = 0.5  # share of the usual readings in a window that a mean needs
_MAX_GATHERED = 1_000_000  # values at once; bounds the memory
_KEPT = 3.0  # [s] of readings in a buffer, beside its delay, window and limit


@dataclass(frozen=True)
class Aligned:
    """The values of a source at N triggers, and the readings from which they were made.

    A vector is a wrench, a pose or the values of one cluster; (N, ...) is (N,) for a wrench or a
    pose, and (N, C) for C clusters. `age`, `spread` and `deviation` are NaN without a value.

    Attributes:
        values: Wrenches, shape (N, 6) [N m, N], poses as `Pose.vector`, shape (N, 7) [m, -], or
            values of the clusters, shape (N, C, 4) [pF] or (N, C, 3) [Pa]; NaN where too few
            readings are near the trigger.
        status: `Status` of each vector, OK or MISSING, shape (N, ...).
        count: Number of readings that went into each vector, shape (N, ...).
        age: Time from their middle to the trigger, corrected for the delay, shape (N, ...) [s].
        spread: Time from the first to the last of them, shape (N, ...) [s].
        deviation: Their standard deviation about the line or mean, in the units of the values; NaN
            for fewer than three readings. Of a pose, that of its position alone, shape (N, 3) [m].
    """

    values: FloatArray
    status: StatusArray
    count: IntArray
    age: FloatArray
    spread: FloatArray
    deviation: FloatArray

    def part(self, row: int) -> Aligned:
        """The values at one trigger, given its row, with N = 1."""
        return Aligned(*(getattr(self, own.name)[row : row + 1] for own in fields(self)))


def align(
    series: Series,
    triggers: IntArray,
    settings: SourceSettings,
    period: float | None = None,
) -> Aligned:
    """The values of a source at triggers.

    With the method `line` a value is that of a least-squares line through the readings in the
    window, at the trigger, as the drivers of load cell and motion capture do it; of a pose, the
    mean on SE(3) carried to the trigger by the mean velocity. With few readings in the window,
    where the line would be noisier, it is interpolated between the two readings around the trigger.
    `mean` needs half the usual readings in the window, `last` one before the trigger that is not
    stale. A reading of a vector counts if all its components do that ever have a value.

    Args:
        series: What the source measured.
        triggers: Times of the triggers on the source's clock, ascending, shape (N,) [ns].
        settings: Delay, window and method.
        period: Period of the trigger, for a window that follows it [s]; None for the median step
            of `triggers`.
    """
    if period is None:
        step = median_step(triggers)
        period = 1e-9 * step if np.isfinite(step) else 0.0
    window = settings.span(period)
    vectors = _vectors(series)
    shape = (len(triggers), vectors.shape[1])
    status = np.full(shape, Status.MISSING, np.uint8)
    count = np.zeros(shape, np.int64)
    age, spread = np.full((2, *shape), np.nan)
    values = np.full((*shape, vectors.shape[2]), np.nan)
    is_pose = isinstance(series, PoseSeries)
    deviation = values[..., :3].copy() if is_pose else values.copy()
    for columns, rows in _complete(vectors):
        times = series.times[rows]
        own = vectors[rows][:, columns]
        for part, chosen in _chosen(times, triggers, settings, window, own[:1].size):
            place = np.ix_(part, columns)
            readings = own[chosen.index]
            if is_pose:
                values[place] = weighted_pose(readings[:, :, 0], chosen.weights)[:, None]
            else:
                values[place] = np.einsum("nm,nmgk->ngk", chosen.weights, readings)
            status[place] = Status.OK
            count[place] = chosen.count[:, None]
            age[place], spread[place] = -chosen.middle[:, None], chosen.spread[:, None]
            deviation[place] = _deviations(chosen, readings[..., :3] if is_pose else readings)
    if isinstance(series, ClusterSeries):
        return Aligned(values, status, count, age, spread, deviation)
    return Aligned(
        values[:, 0], status[:, 0], count[:, 0], age[:, 0], spread[:, 0], deviation[:, 0]
    )


def _vectors(series: Series) -> FloatArray:
    """The vectors of a series, shape (N, g, k); poses with unit quaternions, NaN if unknown."""
    if isinstance(series, ClusterSeries):
        return series.values
    if isinstance(series, WrenchSeries):
        return series.values[:, None]
    length = np.linalg.norm(series.quaternions, axis=1, keepdims=True)
    unit = np.divide(
        series.quaternions, length, out=np.full(series.quaternions.shape, np.nan), where=length > 0
    )
    return np.hstack([series.positions, unit])[:, None]


def _complete(vectors: FloatArray) -> Iterator[tuple[IntArray, BoolArray]]:
    """Vectors that are complete in the same readings, as columns (c,), and these readings (N,)."""
    known = np.isfinite(vectors)
    complete: BoolArray = np.all(known | ~known.any(axis=0), axis=2) & np.any(known, axis=2)
    alike: dict[bytes, list[int]] = {}
    for column, rows in enumerate(complete.T):
        alike.setdefault(rows.tobytes(), []).append(column)
    for columns in alike.values():
        if (rows := complete[:, columns[0]]).any():
            yield np.array(columns), rows


@dataclass(frozen=True)
class _Chosen:
    """The readings of n triggers that have a value, padded to m each.

    Attributes:
        index: Rows of the readings, shape (n, m).
        offsets: Their times since the trigger, shape (n, m) [s]; NaN for padding.
        weights: Their weights, shape (n, m) [-]; 0 for padding.
        is_line: Whether a line is fitted, of a slope, not a constant.
    """

    index: IntArray
    offsets: FloatArray
    weights: FloatArray
    is_line: bool

    @property
    def count(self) -> IntArray:
        """Number of readings, shape (n,)."""
        return np.asarray(np.isfinite(self.offsets).sum(axis=1))

    @property
    def middle(self) -> FloatArray:
        """Mean time of the readings since the trigger, shape (n,) [s]."""
        return np.asarray(np.nanmean(self.offsets, axis=1))

    @property
    def spread(self) -> FloatArray:
        """Time from the first reading to the last, shape (n,) [s]."""
        return np.asarray(np.nanmax(self.offsets, axis=1) - np.nanmin(self.offsets, axis=1))


def _chosen(
    times: IntArray, triggers: IntArray, settings: SourceSettings, window: float, width: int
) -> Iterator[tuple[IntArray, _Chosen]]:
    """Rows of the triggers that have a value, and their readings, in parts.

    Args:
        times: Times of the readings by the source's stamps, ascending, shape (M,) [ns].
        triggers: Times of the triggers, ascending, shape (N,) [ns].
        settings: Delay, method and limit.
        window: Span centred on a trigger [s].
        width: Number of values of a reading.
    """
    if len(times) == 0 or len(triggers) == 0:
        return
    moments = triggers + round(settings.delay * _SECOND)
    usual = 1e-9 * float(np.nan_to_num(median_step(times)))
    limit = _longest_gap(settings, usual)
    before = np.searchsorted(times, moments, "right") - 1
    if settings.method == "last":
        old = (moments - times[np.maximum(before, 0)]) * 1e-9
        rows = np.flatnonzero((before >= 0) & (old <= limit))
        yield from _parts(rows, before[rows], before[rows] + 1, times, moments, width, False)
        return
    half = round(0.5 * window * _SECOND)
    first = np.searchsorted(times, moments - half, "left")
    last = np.searchsorted(times, moments + half, "right")
    if settings.method == "mean":
        enough = np.maximum(1.0, _MIN_COMPLETE * window / usual) if usual > 0.0 else 1.0
        rows = np.flatnonzero(last - first >= enough)
        yield from _parts(rows, first[rows], last[rows], times, moments, width, False)
        return
    after = np.searchsorted(times, moments, "left")
    between = (before >= 0) & (after < len(times))
    gap = (times[np.minimum(after, len(times) - 1)] - times[np.maximum(before, 0)]) * 1e-9
    rows = np.flatnonzero(between & (gap <= limit))
    before, after, first, last = before[rows], after[rows], first[rows], last[rows]
    yield from _lines((rows, before, after, first, last), times, moments, width)


def _longest_gap(settings: SourceSettings, usual: float) -> float:
    """Longest distance between the readings around a trigger, for a usual step of them [s]."""
    return settings.stale if settings.stale >= 0 else max(USUAL_STALE[0], USUAL_STALE[1] * usual)


def _lines(
    choice: tuple[IntArray, ...], times: IntArray, moments: IntArray, width: int
) -> Iterator[tuple[IntArray, _Chosen]]:
    """Lines through windows, or between two readings where a line would be noisier.

    The choice has the rows of the triggers, the readings around each, and the first reading of the
    window and the one after its last, shape (n,) each.
    """
    rows, before, after, first, last = choice
    share = _between(times[before], times[after], moments[rows])
    noise = share**2 + (1.0 - share) ** 2
    interpolated = np.ones(len(rows), dtype=bool)
    wide = np.flatnonzero(last - first >= 2)
    place = np.full(len(moments), -1)
    place[rows] = np.arange(len(rows))
    for own, chosen in _parts(rows[wide], first[wide], last[wide], times, moments, width, True):
        variance = np.einsum("nm,nm->n", chosen.weights, chosen.weights)
        quiet = variance <= noise[place[own]] + 1e-12
        interpolated[place[own[quiet]]] = False
        if quiet.any():
            parts = chosen.index[quiet], chosen.offsets[quiet], chosen.weights[quiet]
            yield own[quiet], _Chosen(*parts, True)
    left = np.flatnonzero(interpolated)
    for part in _split(left, 2 * width):
        index = np.column_stack([before[part], after[part]])
        since = times[index] - moments[rows[part], None]
        offsets = 1e-9 * since.astype(np.float64)
        weights = np.column_stack([1.0 - share[part], share[part]])
        exact = index[:, 0] == index[:, 1]  # a reading at the trigger itself
        offsets[exact, 1] = np.nan
        yield rows[part], _Chosen(index, offsets, weights, True)


def _between(start: IntArray, end: IntArray, moments: IntArray) -> FloatArray:
    """Share of the way from a start to an end at which a moment is, (n,) [-]; 0 if they agree."""
    gap = (end - start).astype(np.float64)
    return np.divide(moments - start, gap, out=np.zeros(len(gap)), where=gap > 0.0)


def _split(rows: IntArray, width: int) -> Iterator[IntArray]:
    """Parts of some rows so that each gathers a bounded number of values."""
    step = max(1, _MAX_GATHERED // max(width, 1))
    for start in range(0, len(rows), step):
        yield rows[start : start + step]


def _parts(
    rows: IntArray,
    first: IntArray,
    end: IntArray,
    times: IntArray,
    moments: IntArray,
    width: int,
    is_line: bool,
) -> Iterator[tuple[IntArray, _Chosen]]:
    """The readings from `first` up to `end` of each trigger in `rows`, with their weights."""
    most = int((end - first).max(initial=0))
    for part in _split(np.arange(len(rows)), most * width):
        index = first[part, None] + np.arange(int((end - first)[part].max()))
        inside = index < end[part, None]
        index = np.where(inside, index, first[part, None])
        offsets = 1e-9 * (times[index] - moments[rows[part], None]).astype(np.float64)
        offsets[~inside] = np.nan
        weights = line_weights(offsets) if is_line else inside / inside.sum(axis=1, keepdims=True)
        yield rows[part], _Chosen(index, offsets, weights, is_line)


def _deviations(chosen: _Chosen, readings: FloatArray) -> FloatArray:
    """Standard deviation of readings (n, m, g, k) about their line or mean, shape (n, g, k)."""
    inside = np.isfinite(chosen.offsets)
    freedom = chosen.count - (2 if chosen.is_line else 1)
    usable = (chosen.count >= 3)[:, None, None]
    share = inside / chosen.count[:, None]
    mean = np.einsum("nm,nmgk->ngk", share, readings)
    left = np.where(inside[:, :, None, None], readings - mean[:, None], 0.0)
    total = np.einsum("nmgk,nmgk->ngk", left, left)
    if chosen.is_line:
        centred = np.where(inside, chosen.offsets - chosen.middle[:, None], 0.0)
        slope = np.einsum("nm,nmgk->ngk", centred, left)
        squares = np.maximum(np.einsum("nm,nm->n", centred, centred), 1e-30)[:, None, None]
        total = np.maximum(total - slope**2 / squares, 0.0)
    variance = total / np.maximum(freedom, 1)[:, None, None]
    return np.where(usable, np.sqrt(variance), np.nan)


class SourceBuffer:
    """The newest readings of a source, for triggers while it is being read.

    A node adds readings as they arrive, and asks for a trigger once `ready` says so, or once it
    gives up waiting.

    Args:
        settings: Delay, window, method and limit of the source. They may be reassigned.
        empty: A series of the source without readings, which gives its kind, frame and clusters.
        keep: Span of readings to keep at least [s].
    """

    def __init__(self, settings: SourceSettings, empty: Series, keep: float = 0.0) -> None:
        self.settings = settings
        self._keep = max(_KEPT, keep)
        self._series = empty
        self._columns: list[NDArray[np.float64]] = [values[:0] for values in _columns(empty)]
        self._times: IntArray = np.empty(0, np.int64)
        self._number = 0

    def __len__(self) -> int:
        return self._number

    @property
    def series(self) -> Series:
        """The kept readings, oldest first; a view that later readings may overwrite."""
        rows = slice(0, self._number)
        return _made(self._series, self._times[rows], [own[rows] for own in self._columns])

    def add(self, time: int, *values: FloatArray) -> int:
        """Add a reading in its place; of two with one stamp, the later one counts.

        Args:
            time: Its stamp on the source's clock [ns].
            values: A wrench [M; F], shape (6,) [N m, N]; a position [m] and a quaternion
                x, y, z, w [-]; or the values of the clusters, shape (C, 4) [pF] or (C, 3) [Pa].

        Returns:
            How much older it is than the newest reading [ns]; 0 for the newest.
        """
        if self._number == len(self._times):
            self._make_space(time)
        place, end = self._number, self._number
        late = 0
        if end and time <= self._times[end - 1]:
            late = int(self._times[end - 1]) - time
            place = int(np.searchsorted(self._times[:end], time, "left"))
        again = place < end and self._times[place] == time
        if place < end and not again:
            for column in (self._times, *self._columns):
                column[place + 1 : end + 1] = column[place:end].copy()
        self._times[place] = time
        for column, value in zip(self._columns, values, strict=True):
            column[place] = value
        self._number += not again
        return late

    def _make_space(self, time: int) -> None:
        """Drop what is too old for any trigger, and double the space if that is little."""
        settings = self.settings
        reach = (
            self._keep + abs(settings.delay) + max(settings.window, 0.0) + max(settings.stale, 0.0)
        )
        old = int(np.searchsorted(self._times[: self._number], time - round(reach * _SECOND)))
        kept = slice(old, self._number)
        space = max(64, len(self._times), 2 * (self._number - old))
        for place, column in enumerate(self._columns):
            self._columns[place] = np.empty((space, *column.shape[1:]))
            self._columns[place][: self._number - old] = column[kept]
        times = np.empty(space, np.int64)
        times[: self._number - old] = self._times[kept]
        self._times, self._number = times, self._number - old

    @property
    def step(self) -> float:
        """Usual step between the kept readings [s]; NaN for fewer than two."""
        return 1e-9 * median_step(self._times[: self._number])

    @property
    def rate(self) -> float:
        """Mean rate of the kept readings [Hz]; NaN for fewer than two."""
        duration = 1e-9 * float(np.ptp(self._times[: self._number])) if self._number else 0.0
        return (self._number - 1) / duration if duration > 0.0 else float("nan")

    @property
    def newest(self) -> int:
        """Stamp of the newest reading [ns]; 0 without any."""
        return int(self._times[self._number - 1]) if self._number else 0

    def latest(self, trigger: int, period: float) -> int:
        """The time after which a first reading cannot give a value at a trigger any more [ns].

        Args:
            trigger: Time of the trigger on the source's clock [ns].
            period: Period of the trigger [s].
        """
        gap = _longest_gap(self.settings, float(np.nan_to_num(self.step)))
        return self._end(trigger, period) + round(gap * _SECOND)

    def _end(self, trigger: int, period: float) -> int:
        """The end of the window around a trigger, by the source's stamps [ns]."""
        settings = self.settings
        return trigger + round((settings.delay + 0.5 * settings.span(period)) * _SECOND)

    def ready(self, trigger: int, period: float) -> bool:
        """Whether later readings cannot change the value at a trigger.

        Args:
            trigger: Time of the trigger on the source's clock [ns].
            period: Period of the trigger [s].
        """
        return bool(self._number) and self.newest > self._end(trigger, period)

    def at(self, triggers: int | IntArray, period: float) -> Aligned:
        """The values at triggers from the readings so far, as `align` gives them.

        Args:
            triggers: Time of a trigger, or of several, ascending, shape (N,), on the source's
                clock [ns].
            period: Period of the trigger [s].
        """
        return align(self.series, np.atleast_1d(triggers), self.settings, period)


def _columns(series: Series) -> list[FloatArray]:
    """The arrays of a series beside its times."""
    if isinstance(series, PoseSeries):
        return [series.positions, series.quaternions]
    return [series.values]


def _made(like: Series, times: IntArray, columns: list[FloatArray]) -> Series:
    """A series of the kind, frame and clusters of another one, with other readings."""
    if isinstance(like, PoseSeries):
        positions, quaternions = columns
        return PoseSeries(times, positions, quaternions, like.frame)
    (values,) = columns
    if isinstance(like, WrenchSeries):
        return WrenchSeries(times, values, like.frame)
    return ClusterSeries(times, like.clusters, values)
