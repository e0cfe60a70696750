"""Parts of a trial: a plateau, the part under load, or a span of seconds or between events."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress, groupby, pairwise
from typing import NamedTuple, NoReturn, TypeAlias

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from socket_testbed.arrays import BREAK, FloatArray, IntArray, gaps, runs, usual_period, within
from socket_testbed.documents import check_number, plain, shown
from socket_testbed.errors import ConfigurationError, TrialError, likely
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import PlateauSettings
from socket_testbed.trials.events import (
    Event,
    event_ends,
    event_span,
    find_events,
    is_loaded,
    loaded_span,
)

NAMED = ("plateau", "hold", "auto", "all")  # segments
HINT = f"give {', '.join(NAMED)}, T0:T1 in seconds, or event:A:B"
Span: TypeAlias = tuple[float, float]  # start and end since the trial's first sample [s]


@dataclass(frozen=True)
class Segment:
    """A part of a trial.

    Attributes:
        kind: `plateau`, `hold`, `loaded`, `all`, `span`, or the specification `event:A:B`.
        start: Time of its first sample, since the trial's first sample [s].
        end: Time of its last sample, since the trial's first sample [s].
        rows: Its rows among the trial's samples.
        cause: Why earlier samples are excluded, in words, if a channel slipped or drifted in a
            running trial; otherwise empty.
    """

    kind: str
    start: float
    end: float
    rows: slice
    cause: str = ""

    def __str__(self) -> str:
        return f"{self.kind} {self.start:.2f} s to {self.end:.2f} s"

    def __repr__(self) -> str:
        return f"Segment({self})"

    @property
    def noun(self) -> str:
        """What it is called in a sentence: `plateau`, `hold`, or `segment` for any other kind."""
        return self.kind if self.kind in ("plateau", "hold") else "segment"


def select_segment(
    samples: Samples,
    specification: str,
    settings: PlateauSettings,
    leave_out: tuple[str, ...] = (),
    events: Callable[[], Sequence[Event]] | None = None,
) -> Segment:
    """Select a part of a trial by a specification.

    Args:
        samples: All samples of the trial.
        specification: `plateau`, the longest; `hold`, the longest while the load is placed; `auto`,
            the hold or, failing that, the part under load; `all`; `T0:T1` in seconds since the
            first sample; or `event:A:B` between events, such as `event:placed+5:removed-2`, with
            event labels, `push#2` for the second push, or seconds at either end.
        settings: Criteria for plateaus and loads.
        leave_out: Clusters' channels that plateaus ignore, such as `distal.Fz`.
        events: Returns the events of the trial in the order of their times; not called for `all`
            and `plateau`. None stands for those detected in the load.

    Raises:
        ConfigurationError: If the specification cannot be parsed.
        TrialError: If there is no such part.
    """
    check_specification(specification)
    if len(samples) == 0:
        raise TrialError("the trial holds no sample", "record it again")
    if specification == "all":
        return _segment("all", samples, 0, len(samples))
    if specification == "plateau":
        plateaus = find_plateaus(samples, settings, leave_out)
        return plateaus[0] if plateaus else _no_plateau("plateau", samples, settings)
    known = find_events(samples, settings) if events is None else events()
    if specification in ("hold", "auto"):
        for plateau in find_plateaus(samples, settings, leave_out):
            if is_loaded(known, 0.5 * (plateau.start + plateau.end)):
                return replace(plateau, kind="hold")
        span = loaded_span(samples, settings)
        if specification == "auto" and span is not None:
            return _span(samples, *span, "loaded")
        _no_plateau("hold", samples, settings)
    if specification.startswith("event:"):
        return _span(samples, *event_span(specification, known), specification)
    return _span(samples, *parse_span(specification, "the segment"), "span")


def check_specification(specification: str) -> None:
    """Refuse a specification that selects no part of any trial.

    Args:
        specification: The specification, see `select_segment`.

    Raises:
        ConfigurationError: If it cannot be parsed.
    """
    if specification in NAMED:
        return
    if specification.startswith("event:"):
        event_ends(specification)
    elif ":" in specification:
        parse_span(specification, "the segment")
    else:
        near = likely(specification, NAMED)
        raise ConfigurationError(f"unknown segment '{specification}'", f"{near} {HINT}".strip())


def specification_of(segment: object) -> str:
    """The specification of a segment that was given as a text, as a span or as a `Segment`.

    Args:
        segment: A specification, which is returned as it is; start and end since the first sample,
            as a tuple or list (2,) [s]; or a `Segment`.

    Raises:
        ConfigurationError: If it is anything else, such as None.
    """
    if isinstance(segment, str):
        return segment
    if isinstance(segment, Segment):
        return f"{segment.start}:{segment.end}"
    given = plain(segment)
    if isinstance(given, list) and len(given) == 2:
        start, end = (check_number(each, "the segment's time") for each in given)
        return f"{start}:{end}"
    hint = f"{HINT}, or a span such as (10, 20) [s]"
    raise ConfigurationError(f"the segment is {shown(given)}", hint)


def parse_span(span: str, option: str, others: str = "") -> tuple[float, float]:
    """Start and end of a span given as `T0:T1` [s].

    Args:
        span: The span, such as `12.5:60`.
        option: What errors call it, such as `--tare`.
        others: Ends the hint of errors, with other accepted values, such as `, or none, recorded`.

    Raises:
        ConfigurationError: If it does not have this form, or the start is not before the end.
    """
    try:
        start, end = (float(part) for part in span.split(":"))
    except ValueError:
        start = end = 0.0
    if not start < end:
        hint = f"give seconds as T0:T1, the earlier first, such as 12.5:60{others}"
        raise ConfigurationError(f"{option} is '{span}'", hint)
    return start, end


def first_frames(segment: Segment, samples: Samples, frames: int) -> Segment:
    """The first samples of a segment, as a segment.

    Args:
        segment: The segment.
        samples: All samples of the trial.
        frames: Largest number of samples to keep; 0 for all.
    """
    start, stop = segment.rows.start, segment.rows.stop
    if not 0 < frames < stop - start:
        return segment
    return _segment(segment.kind, samples, start, start + frames)


def _no_plateau(what: str, samples: Samples, settings: PlateauSettings) -> NoReturn:
    if not np.isfinite(samples.wrench).any():
        raise TrialError(
            f"the trial has no wrench, whose force tells a {what}",
            "give --segment all or --segment T0:T1",
        )
    hint = "give --segment all or --segment T0:T1"
    if span := loaded_span(samples, settings):
        hint = f"give --segment {span[0]:.2f}:{span[1]:.2f} (the part under load), --segment auto"
    raise TrialError(
        f"no {what} of {settings.least_duration:g} s or more in the {samples.time[-1]:.1f} s of"
        " the trial",
        f"{hint}, or other limits (plateau.*)",
    )


def _span(samples: Samples, start: float, end: float, kind: str) -> Segment:
    rows = np.flatnonzero(within(samples.time, start, end))
    if len(rows) < 2:
        raise TrialError(
            f"the segment {start:g}:{end:g} s holds {len(rows)} samples",
            f"give seconds within 0:{samples.time[-1]:.1f}",
        )
    return _segment(kind, samples, int(rows[0]), int(rows[-1]) + 1)


def find_plateaus(
    samples: Samples, settings: PlateauSettings, leave_out: tuple[str, ...] = ()
) -> list[Segment]:
    """Find the plateaus of a trial, longest first.

    Three criteria come from the published study: no intended change of load (the means before and
    after a sample agree), a steady mean wrench (small spread over the plateau) and few missing
    channels. Two are added: every cluster's force is steady too, because a constant offset no
    longer describes a cluster that slips or drifts; and the plateau is under load, because it tells
    nothing about the contact otherwise.

    Args:
        samples: All samples of the trial.
        settings: The limits of the criteria [N, N m, s].
        leave_out: Clusters' channels to ignore, such as `distal.Fz`.
    """
    steady = _steadiness(samples, settings, leave_out)
    found = []
    for start, end in steady.runs:
        first, last = longest_within(steady.mean[start:end], steady.limits)
        found.append(_segment("plateau", samples, start + first, start + last))
    lasting = [part for part in found if part.end - part.start >= settings.least_duration]
    return sorted(lasting, key=lambda part: part.start - part.end)


def find_newest_plateaus(
    samples: Samples, settings: PlateauSettings, leave_out: tuple[str, ...] = ()
) -> list[Segment]:
    """Find the plateaus of a running trial, newest first, as in `find_plateaus`.

    If a plateau drifts, its newest part is kept rather than its longest. The cause names the
    channels that drift, or the cluster channels that slipped under a steady wrench.

    Args:
        samples: The samples of the trial so far, or its newest ones.
        settings: The limits of the criteria [N, N m, s].
        leave_out: Clusters' channels to ignore, such as `distal.Fz`.
    """
    steady = _steadiness(samples, settings, leave_out)
    found = []
    for start, end in reversed(steady.runs):
        backwards = steady.mean[start:end][::-1]
        spread = np.maximum.accumulate(backwards) - np.minimum.accumulate(backwards)
        within = spread <= steady.limits  # the spread only grows
        count = int(within.all(axis=1).sum())
        if count < end - start:
            cause = ", ".join(f"{steady.names[i]} drifts" for i in np.flatnonzero(~within[count]))
        else:
            cause = _slips(steady, start, settings)
        found.append(replace(_segment("plateau", samples, end - count, end), cause=cause))
    return [part for part in found if part.end - part.start >= settings.least_duration]


class _Steadiness(NamedTuple):
    """Steady runs of samples, and the data behind them.

    Attributes:
        runs: Half-open ranges of rows without a change of load.
        names: The m channels that must not drift: the wrench's, then the clusters'.
        mean: Moving means of these channels, shape (N, m) [N m, N].
        limits: Largest spread of each channel over a plateau, shape (m,) [N m, N].
        width: Window of the moving mean [samples].
    """

    runs: list[tuple[int, int]]
    names: tuple[str, ...]
    mean: FloatArray
    limits: FloatArray
    width: int


def _steadiness(
    samples: Samples, settings: PlateauSettings, leave_out: tuple[str, ...]
) -> _Steadiness:
    local = samples.trusted_forces.reshape(len(samples), 3 * len(samples.clusters))
    counted = samples.counted(leave_out)
    counts = counted[6:]
    names = (*samples.channels[:6], *compress(samples.channels[6:], counts))
    limits = np.repeat(
        [settings.moment_drift, settings.force_drift, settings.cluster_drift], [3, 3, counts.sum()]
    )
    period = usual_period(samples.stamps) * 1e-9
    width = max(3, round(settings.smoothing / period)) if len(samples) > 1 else 3
    if 2 * width > len(samples):
        return _Steadiness([], names, np.empty((0, len(limits))), limits, width)
    # A channel without any value counts as missing, not as a change of load.
    dead = np.isnan(samples.wrench).all(axis=0)
    wrench = moving_mean(np.where(dead, 0.0, samples.wrench), width)
    clusters = _fill_gaps(moving_mean(np.where(counts, local, 0.0), width))
    change = _differences(wrench, width)
    steady = np.linalg.norm(change[:, :3], axis=1) <= settings.moment_change
    steady &= np.linalg.norm(change[:, 3:], axis=1) <= settings.force_change
    change = _differences(clusters, width).reshape(len(samples), -1, 3)
    steady &= (np.linalg.norm(change, axis=2) <= settings.cluster_change).all(axis=1)
    # Without motion capture no position is missing.
    position = samples.position[:, : 3 * samples.has_pose.any()]
    channels = np.hstack([position, samples.values[:, counted]])
    missing = np.isnan(channels).mean(axis=1, keepdims=True)
    steady &= moving_mean(missing, width)[:, 0] <= settings.missing_fraction
    steady &= np.linalg.norm(wrench[:, 3:], axis=1) >= settings.least_force
    mean = np.hstack([wrench, clusters[:, counts]])
    pauses = gaps(samples.time, BREAK) & (np.diff(samples.time) > settings.smoothing)
    ends = np.flatnonzero(pauses) + 1  # a load that nobody saw is not steady
    found = [
        part
        for start, end in runs(steady).tolist()
        for part in pairwise([start, *ends[(ends > start) & (ends < end)].tolist(), end])
    ]
    return _Steadiness(found, names, mean, limits, width)


def _slips(steady: _Steadiness, start: int, settings: PlateauSettings) -> str:
    """Describe cluster channels that changed before a run while the wrench did not."""
    before = start - 2 * steady.width  # so that the two moving means do not overlap
    if before < 0:
        return ""
    change = steady.mean[start] - steady.mean[before]
    if not (
        np.linalg.norm(change[:3]) <= settings.moment_change
        and np.linalg.norm(change[3:6]) <= settings.force_change
    ):
        return ""
    limit, slipped = settings.cluster_change, []
    for _, group in groupby(range(6, len(change)), lambda i: steady.names[i].rpartition(".")[0]):
        own = [*group]
        if np.linalg.norm(change[own]) > limit:
            slipped += [i for i in own if abs(change[i]) > limit / np.sqrt(3.0)]
    return ", ".join(f"{steady.names[i]} changed by {change[i]:.1f} N" for i in slipped)


def moving_mean(values: FloatArray, width: int) -> FloatArray:
    """Centred moving mean of each column's finite values; the window is truncated at the ends.

    Args:
        values: The values, shape (N, m), in any unit; NaN where unknown.
        width: Window [samples].

    Returns:
        The means, shape (N, m), in the unit of the values; NaN where a window holds no value.
    """
    finite = np.isfinite(values)
    mean = partial(uniform_filter1d, size=width, axis=0, mode="constant")
    share = mean(finite.astype(float))  # [-] of the window
    with np.errstate(invalid="ignore", divide="ignore"):
        total = mean(np.where(finite, values, 0.0))
        return np.where(share > 0.5 / width, total / share, np.nan)


def _fill_gaps(values: FloatArray) -> FloatArray:
    """Fill gaps in each column with the last value before them, or the first value at the start."""
    known = np.isfinite(values)
    last = np.maximum.accumulate(np.where(known, np.arange(len(values))[:, None], 0), axis=0)
    first = values[known.argmax(axis=0), np.arange(values.shape[1])]
    held = np.take_along_axis(values, last, axis=0)
    return np.nan_to_num(np.where(np.isfinite(held), held, first))


def _differences(mean: FloatArray, width: int) -> FloatArray:
    """Mean after each sample minus the mean before it, shape (N, m), from moving means (N, m)."""
    before = mean[np.maximum(np.arange(len(mean)) - (width + 1) // 2, 0)]
    after = mean[np.minimum(np.arange(len(mean)) + (width + 1) // 2, len(mean) - 1)]
    return np.asarray(after - before)


def longest_within(values: FloatArray, limits: FloatArray) -> tuple[int, int]:
    """First of the longest half-open ranges of rows in which no column's spread exceeds its limit.

    A range within the limits contains only ranges within the limits, so the length is found by
    bisection.

    Args:
        values: The values without gaps, shape (N, m).
        limits: Largest spread (maximum minus minimum) of each column, shape (m,), in its unit.

    Returns:
        The first row of the range and the row after its last.
    """
    found, fits, too_long = 0, 0, len(values) + 1
    length = len(values)
    while fits < length < too_long:
        starts = _starts_within(values, limits, length)
        if len(starts):
            found, fits = int(starts[0]), length
        else:
            too_long = length
        length = (fits + too_long) // 2
    return found, found + fits


def _starts_within(values: FloatArray, limits: FloatArray, length: int) -> IntArray:
    """Starts of the ranges of a given length in which every column is within its limit."""
    starts = slice(length // 2, length // 2 + len(values) - length + 1)
    spread = maximum_filter1d(values, length, axis=0) - minimum_filter1d(values, length, axis=0)
    return np.flatnonzero((spread[starts] <= limits).all(axis=1))


def _segment(kind: str, samples: Samples, start: int, end: int) -> Segment:
    time = samples.time
    return Segment(kind, float(time[start]), float(time[end - 1]), slice(start, end))
