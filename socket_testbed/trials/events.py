"""Events of a trial: marked while it was recorded, or found in its load; spans between them.

The load is the size of the force on the load cell. The samples are split into two levels of load,
such that the loads within each are as alike as possible (Otsu, IEEE Trans. Syst. Man Cybern. 9
(1979) 62). The load is placed when it rises above 60 % of the way from the lower mean to the upper,
and removed when it falls below 40 %: noise in between makes no event.

Steps are found without marks, too: stance begins when the load rises above 10 % of the way from its
median in the lower level to the upper mean, and swing when it falls below 5 %, where that happens
three times at least, at most 3 s apart.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import median_filter

from socket_testbed.arrays import FloatArray
from socket_testbed.errors import ConfigurationError, TrialError, likely
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import PlateauSettings
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.messages import Reader
from socket_testbed.trials.topics import EVENT, TARE, TRIGGER, match_topics

PLACED, REMOVED = "placed", "removed"
STANCE, SWING = "stance", "swing"
Source = Literal["recorded", "found"]

_RISEN, _FALLEN = 0.6, 0.4  # [-]; of the way from the lower level of load to the upper
_STRUCK, _OFF = 0.1, 0.05  # the same of a step, from the usual load in swing
_STEPS, _STRIDE = 3, 3.0  # of a walk: number at least, time between them at most [s]
_LONGEST_LABEL = 99  # characters
_LABEL = re.compile(r"[^\W\d_](?:[\w. ]|-(?=[^\W\d_]))*")
_NUMBER = r"(?:\d+(?:\.\d*)?|\.\d+)"
_END = re.compile(rf"(?P<label>.+?)(?:#(?P<number>\d+))?(?P<offset>[+-]{_NUMBER})?")
_GRAMMAR = "give event:A:B, such as event:placed+5:removed-2 or event:push#2:80"
_TARED = 1.0  # [s]; around a tare nothing is found in the load
_EDGE = 10.0  # [s]; how far outside the samples a stamp may be


@dataclass(frozen=True)
class Event:
    """A moment of a trial."""

    label: str
    time: float  # since the first sample [s]
    source: Source  # recorded with the trial, or found in its load

    def __str__(self) -> str:
        return f"{self.label} at {self.time:.2f} s ({self.source})"


def check_label(label: str) -> str:
    """Refuse a label that a segment could not name; returns it.

    It begins with a letter. Letters, digits, blanks, `_`, `.`, and hyphens before a letter follow.
    """
    if len(label) > _LONGEST_LABEL:
        raise ConfigurationError(
            f"the label has {len(label)} characters", f"give {_LONGEST_LABEL} at most"
        )
    if not _LABEL.fullmatch(label) or label != label.strip():
        raise ConfigurationError(
            f"{label!r} is no label of an event",
            "begin with a letter; letters, digits, blanks, '_', '.' and hyphens before a letter"
            " may follow, such as 'heel-strike 2'",
        )
    return label


def join_events(recorded: Sequence[Event], found: Sequence[Event]) -> list[Event]:
    """Recorded events, and found ones of other labels, in the order of their times.

    At a tare the load jumps, but nobody placed or removed it.
    """
    known = {event.label for event in recorded}
    tared = [event.time for event in recorded if event.label.partition(" ")[0] == TARE]
    others = [
        event
        for event in found
        if event.label not in known and all(abs(event.time - time) > _TARED for time in tared)
    ]
    return sorted([*recorded, *others], key=lambda event: event.time)


def read_events(bag: BagReader, samples: Samples) -> list[Event]:
    """Read the events that were recorded with a trial; its first sample is the zero of time.

    An event whose stamp is far outside the samples' time, such as zero, counts at the time at which
    it was recorded between the triggers.
    """
    topics = match_topics(bag.counts, str(bag.path))
    name = topics.get(EVENT)
    if name is None or bag.types[name] != EVENT.type or len(samples) == 0:  # or another program's
        return []
    raws = list(bag.messages([name]))
    reader = Reader(EVENT, bag.path)
    found = [reader.read(raw.data) for raw in raws]
    first, last = int(samples.stamps[0]), int(samples.stamps[-1])
    time = np.array([(stamp - first) * 1e-9 for stamp, _ in found])
    apart = (time < -_EDGE) | (time > (last - first) * 1e-9 + _EDGE)
    if apart.any():
        triggers = list(bag.messages([topics[TRIGGER]]))
        reader = Reader(TRIGGER, bag.path)
        stamps = [reader.read(raw.data)[0] - first for raw in triggers]
        recorded, moments = ([raw.time - first for raw in each] for each in (triggers, raws))
        time = np.where(apart, 1e-9 * np.interp(moments, recorded, stamps), time)
    return [
        Event(_printable(label), when, "recorded")
        for (_, label), when in zip(found, time.tolist(), strict=True)
    ]


def _printable(label: str) -> str:
    text = "".join(character if character.isprintable() else " " for character in label)
    return text.strip() or "unnamed"


def find_events(samples: Samples, settings: PlateauSettings) -> list[Event]:
    """Find when the load was placed and removed, from its two levels (see the module).

    The events are `placed` and `removed` in turns, when the load passes the threshold, linear
    between samples; none if its levels differ by less than `least_force`. In a walk there are also
    `stance` and `swing`.
    """
    time, load = _load(samples)
    if len(load) < 2:
        return []
    lower, upper = _levels(load)
    if upper - lower < settings.least_force:
        return []
    risen, fallen = (lower + share * (upper - lower) for share in (_RISEN, _FALLEN))
    events = _passes(time, load, (PLACED, risen), (REMOVED, fallen))
    swing = float(np.median(load[load < 0.5 * (lower + upper)]))
    struck, off = (swing + share * (upper - swing) for share in (_STRUCK, _OFF))
    steps = _passes(time, load, (STANCE, struck), (SWING, off))
    strikes = [step.time for step in steps if step.label == STANCE]
    if len(strikes) >= _STEPS and np.median(np.diff(strikes)) <= _STRIDE:
        events = sorted([*events, *steps], key=lambda event: event.time)
    return events


def _passes(
    time: FloatArray, load: FloatArray, rise: tuple[str, float], fall: tuple[str, float]
) -> list[Event]:
    """When a load rises above one threshold and falls below another, in turns, by its labels."""
    (_, risen), (_, fallen) = rise, fall
    decided = np.flatnonzero((load >= risen) | (load <= fallen))
    above = load[decided] >= risen
    events = []
    for change in np.flatnonzero(above[1:] != above[:-1]) + 1:
        after = decided[change]
        label, threshold = rise if above[change] else fall
        share = (threshold - load[after - 1]) / (load[after] - load[after - 1])
        when = time[after - 1] + share * (time[after] - time[after - 1])
        events.append(Event(label, float(when), "found"))
    return events


def is_loaded(events: Sequence[Event], time: float) -> bool:
    """Whether the load is placed at a time [s], by the events that `find_events` found."""
    changes = [event for event in events if event.label in (PLACED, REMOVED)]
    before = [event for event in changes if event.time <= time]
    if before:
        return before[-1].label == PLACED
    return not changes or changes[0].label == REMOVED


def loaded_span(samples: Samples, settings: PlateauSettings) -> tuple[float, float] | None:
    """Start and end of a trial's part under load since the first sample [s]; None without load.

    A sample is under load above a tenth of the way from the least load to the largest, and above
    `least_force` in any case.
    """
    time, load = _load(samples)
    if len(load) == 0:
        return None
    least, most = float(load.min()), float(load.max())
    rises = most - least >= settings.least_force
    limit = max(settings.least_force, least + 0.1 * (most - least) if rises else 0.0)
    rows = np.flatnonzero(load >= limit)
    return (float(time[rows[0]]), float(time[rows[-1]])) if len(rows) else None


def _load(samples: Samples) -> tuple[FloatArray, FloatArray]:
    """Times [s] and sizes [N] of the known forces, without single values far from both beside."""
    load = np.linalg.norm(samples.wrench[:, 3:], axis=1)
    known = np.isfinite(load)
    return samples.time[known], np.asarray(median_filter(load[known], 3, mode="nearest"))


def _levels(load: FloatArray) -> tuple[float, float]:
    """Means of the two levels of a load of two values at least [N]."""
    ordered = np.sort(load)
    count = np.arange(1, len(load))
    sums = np.cumsum(ordered)
    lower, upper = sums[:-1] / count, (sums[-1] - sums[:-1]) / (len(load) - count)
    best = int(np.argmax(count * (len(load) - count) * (upper - lower) ** 2))
    return float(lower[best]), float(upper[best])


def event_span(specification: str, events: Sequence[Event]) -> tuple[float, float]:
    """Start and end of a segment between events.

    Args:
        specification: `event:A:B`. Each end is a label, as the second occurrence `label#2`, with
            seconds before or after it, `label-2` or `label+5`; or seconds since the first sample.
            Without a number the start is the first occurrence, and the end the first one with
            which it is after the start.
        events: The events in the order of their times.

    Returns:
        Seconds since the first sample.

    Raises:
        ConfigurationError: If the specification cannot be read.
        TrialError: If there is no such event, or the end is not after the start.
    """
    ends = [end.strip() for end in specification.split(":")[1:]]
    if len(ends) != 2 or not all(ends):
        raise ConfigurationError(f"the segment '{specification}' has no two ends", _GRAMMAR)
    start = _moment(ends[0], events, -np.inf)
    end = _moment(ends[1], events, start)
    if not start < end:
        raise TrialError(
            f"the segment '{specification}' ends at {end:.2f} s, its start is at {start:.2f} s",
            "give the earlier end first",
        )
    return start, end


def _moment(end: str, events: Sequence[Event], after: float) -> float:
    """Time of one end of a segment [s], the first after a time unless it is numbered."""
    if re.fullmatch(_NUMBER, end):
        return float(end)
    parts = _END.fullmatch(end)
    assert parts is not None  # it takes anything
    label, offset = parts["label"], float(parts["offset"] or 0.0)
    times = [event.time for event in _labelled(label, events)]
    if parts["number"] is not None:
        number = int(parts["number"])
        if not 1 <= number <= len(times):
            raise TrialError(
                f"the trial has no '{label}#{number}'",
                f"'{label}' happens {_times(len(times))}: give #1 to #{len(times)}",
            )
        return times[number - 1] + offset
    for time in times:
        if time + offset > after:
            return time + offset
    raise TrialError(
        f"no '{end}' is after {after:.2f} s", f"the last '{label}' is at {times[-1]:.2f} s"
    )


def _labelled(label: str, events: Sequence[Event]) -> list[Event]:
    """The events of a label; a TrialError that suggests others if there are none."""
    found = [event for event in events if event.label == label]
    if found:
        return found
    counts = Counter(event.label for event in events)
    listed = ", ".join(f"{name} ({_times(count)})" for name, count in counts.items())
    hint = f"it has {listed}" if counts else "it has none: mark events (mark LABEL), or give T0:T1"
    raise TrialError(f"the trial has no event '{label}'", f"{likely(label, counts)} {hint}".strip())


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def cycle_spans(events: Sequence[Event], by: str = PLACED) -> list[tuple[float, float]]:
    """Starts and ends of the cycles that events delimit.

    Args:
        events: The events in the order of their times.
        by: A label: cycles run from each such event to the next. Or two, `A:B`: from each A to the
            next B, if no other A is between.

    Returns:
        Seconds since the first sample, in their order.
    """
    start, _, end = (part.strip() for part in by.partition(":"))
    end = end or start
    for label in (start, end):
        _labelled(label, events)
    spans: list[tuple[float, float]] = []
    begin: float | None = None
    for event in events:
        if event.label == end and begin is not None:
            spans.append((begin, event.time))
            begin = None
        if event.label == start:
            begin = event.time
    return spans
