"""Events of a trial: marked during the recording, or detected in the load.

The load is the magnitude of the force on the load cell. The samples are split into two load levels
by minimising the variance within each (Otsu, IEEE Trans. Syst. Man Cybern. 9 (1979) 62). The load
is placed when it rises above 60 % of the way from the lower mean to the upper, and removed when it
falls below 40 %; hysteresis rejects noise.

Steps are also detected: stance begins when the load rises above 10 % of the way from its median in
the lower level to the upper mean, and swing when it falls below 5 %. This needs at least three
steps, in the median at most 3 s apart.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.ndimage import median_filter

from socket_testbed.arrays import BREAK, FloatArray, IntArray, gaps
from socket_testbed.errors import ConfigurationError, TrialError, likely
from socket_testbed.samples import Samples, force_magnitude
from socket_testbed.settings.identification import PlateauSettings
from socket_testbed.trials.bag import BagReader
from socket_testbed.wire.messages import Reader
from socket_testbed.wire.topics import EVENT, TARE, TRIGGER, Topic, match_topics

PLACED, REMOVED = "placed", "removed"
STANCE, SWING = "stance", "swing"
Source = Literal["recorded", "found"]

_RISE_SHARE, _FALL_SHARE = 0.6, 0.4  # [-]; of the way between the two load levels
_STANCE_SHARE, _SWING_SHARE = 0.1, 0.05  # [-]; from the median swing load
_MIN_STEPS, _MAX_STRIDE = 3, 3.0  # of a walk; the stride is the median time [s]
_MAX_LABEL = 99  # [characters]
_LABEL = re.compile(r"[^\W\d_](?:[\w. ]|-(?=[^\W\d_]))*")
_NUMBER = r"(?:\d+(?:\.\d*)?|\.\d+)"
_END = re.compile(rf"(?P<label>.+?)(?:#(?P<number>\d+))?(?P<offset>[+-]{_NUMBER})?")
_GRAMMAR = "give event:A:B, such as event:placed+5:removed-2 or event:push#2:80"
_TARE_MARGIN = 1.0  # [s]; no event is detected this close to a tare
_STAMP_MARGIN = 10.0  # [s]; maximum distance of an event's stamp from the samples


@dataclass(frozen=True)
class Event:
    """A labelled moment in a trial.

    Attributes:
        label: What happened, such as `placed`; several events may share a label.
        time: When, since the trial's first sample [s]; negative before it.
        source: `recorded` with the trial, or `found` in its load.
    """

    label: str
    time: float
    source: Source

    def __str__(self) -> str:
        return f"{self.label} at {self.time:.2f} s ({self.source})"


def check_label(label: str) -> str:
    """Refuse a label that a segment specification could not name; returns it.

    It begins with a letter. Letters, digits, blanks, `_`, `.`, and hyphens before a letter follow.

    Raises:
        ConfigurationError: If it does not have this form, ends with a blank, or is longer than 99
            characters.
    """
    if len(label) > _MAX_LABEL or not _LABEL.fullmatch(label) or label != label.strip():
        raise ConfigurationError(
            f"{label!r} is not a label of an event",
            "begin with a letter; letters, digits, blanks, '_', '.' and hyphens before a letter"
            f" may follow, such as 'heel-strike 2', {_MAX_LABEL} characters at most",
        )
    return label


def join_events(recorded: Sequence[Event], found: Sequence[Event]) -> list[Event]:
    """Recorded events, and detected ones with other labels, in the order of their times.

    The load also jumps at a tare, so detected events within 1 s of a recorded tare are dropped.

    Args:
        recorded: Events marked during the recording; all are kept.
        found: Events detected in the load, see `find_events`; those whose label was also recorded
            are dropped.
    """
    known = {event.label for event in recorded}
    tared = [event.time for event in recorded if event.label.partition(" ")[0] == TARE]
    others = [
        event
        for event in found
        if event.label not in known and all(abs(event.time - time) > _TARE_MARGIN for time in tared)
    ]
    return sorted([*recorded, *others], key=lambda event: event.time)


def read_events(bag: BagReader, stamps: IntArray, notify: Callable[[str], None]) -> list[Event]:
    """Read the events recorded with a trial, in recording order; empty if none was recorded.

    If a stamp is more than 10 s outside the samples' times, such as zero, the time when the event
    was recorded between the triggers is used. An event that cannot be decoded is left out.

    Args:
        bag: The trial's open bag.
        stamps: Stamps of all samples of the trial since the epoch, shape (N,) [ns]; times count
            from the first one.
        notify: Called with a note on each event that is left out.
    """
    topics = match_topics(bag.types, str(bag.path))
    name = topics.get(EVENT)
    if name is None or bag.types[name] != EVENT.type or len(stamps) == 0:  # or another program's
        return []
    moments, found = _decoded(bag, name, EVENT, notify)
    first, last = int(stamps[0]), int(stamps[-1])
    time = np.array([(stamp - first) * 1e-9 for stamp, _ in found])
    apart = (time < -_STAMP_MARGIN) | (time > (last - first) * 1e-9 + _STAMP_MARGIN)
    if apart.any():
        recorded, triggers = _decoded(bag, topics[TRIGGER], TRIGGER, notify)
        triggered = [stamp - first for stamp, _ in triggers]
        own, theirs = ([at - first for at in each] for each in (moments, recorded))
        time = np.where(apart, 1e-9 * np.interp(own, theirs, triggered), time)
    return [
        Event(_printable(label), when, "recorded")
        for (_, label), when in zip(found, time.tolist(), strict=True)
    ]


def _decoded(
    bag: BagReader, name: str, topic: Topic, notify: Callable[[str], None]
) -> tuple[list[int], list[tuple[int, Any]]]:
    """When the messages of a topic were recorded, since the epoch [ns], and what each holds.

    A message that cannot be decoded is left out with a note, so that no other is lost.
    """
    reader = Reader(topic, bag.path)
    recorded: list[int] = []
    found: list[tuple[int, Any]] = []
    for raw in bag.messages([name]):
        try:
            found.append(reader.read(raw.data))
        except TrialError as error:
            notify(f"{error}: left out")
        else:
            recorded.append(raw.time)
    return recorded, found


def _printable(label: str) -> str:
    text = "".join(character if character.isprintable() else " " for character in label)
    return text.strip() or "unnamed"


def find_events(samples: Samples, settings: PlateauSettings) -> list[Event]:
    """Detect when the load was placed and removed, from its two levels (see the module).

    Events `placed` and `removed` alternate, at threshold crossings interpolated between samples,
    or at the first sample after a pause; none if the levels differ by less than `least_force`.
    Walking also gives `stance` and `swing`.

    Args:
        samples: All samples of the trial, of which the forces on the load cell are read; those
            without a force are skipped.
        settings: Limits, of which only `least_force` [N] is read.

    Returns:
        The events in the order of their times.
    """
    time, load = _load(samples)
    if len(load) < 2:
        return []
    lower, upper = _levels(load)
    if upper - lower < settings.least_force:
        return []
    risen, fallen = (lower + share * (upper - lower) for share in (_RISE_SHARE, _FALL_SHARE))
    events = _crossings(time, load, (PLACED, risen), (REMOVED, fallen))
    swing = float(np.median(load[load < 0.5 * (lower + upper)]))
    struck, off = (swing + share * (upper - swing) for share in (_STANCE_SHARE, _SWING_SHARE))
    steps = _crossings(time, load, (STANCE, struck), (SWING, off))
    strikes = [step.time for step in steps if step.label == STANCE]
    if len(strikes) >= _MIN_STEPS and np.median(np.diff(strikes)) <= _MAX_STRIDE:
        events = sorted([*events, *steps], key=lambda event: event.time)
    return events


def _crossings(
    time: FloatArray, load: FloatArray, rise: tuple[str, float], fall: tuple[str, float]
) -> list[Event]:
    """Events where a load rises above one threshold and falls below another, alternately."""
    (_, risen), (_, fallen), unseen = rise, fall, gaps(time, BREAK)
    decided = np.flatnonzero((load >= risen) | (load <= fallen))
    above = load[decided] >= risen
    events = []
    for change in np.flatnonzero(above[1:] != above[:-1]) + 1:
        after = decided[change]
        label, threshold = rise if above[change] else fall
        share = (threshold - load[after - 1]) / (load[after] - load[after - 1])
        share = 1.0 if unseen[after - 1] else share  # it is known from that sample on
        when = time[after - 1] + share * (time[after] - time[after - 1])
        events.append(Event(label, float(when), "found"))
    return events


def is_loaded(events: Sequence[Event], time: float) -> bool:
    """Whether the load is placed at some time of a trial.

    Args:
        events: The trial's events in the order of their times; only `placed` and `removed` are
            read. Without any, the load counts as placed; before the first one, as the opposite of
            what that event brings.
        time: Since the trial's first sample [s].
    """
    changes = [event for event in events if event.label in (PLACED, REMOVED)]
    before = [event for event in changes if event.time <= time]
    if before:
        return before[-1].label == PLACED
    return not changes or changes[0].label == REMOVED


def loaded_span(samples: Samples, settings: PlateauSettings) -> tuple[float, float] | None:
    """Start and end of the part under load, since the first sample [s]; None without load.

    A sample is under load if its load reaches a tenth of the range from the minimum to the maximum,
    and `least_force`.

    Args:
        samples: All samples of the trial, of which the forces on the load cell are read; those
            without a force are skipped.
        settings: Limits, of which only `least_force` [N] is read.
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
    """Times [s] and magnitudes [N] of the known forces, without single-sample outliers."""
    load = force_magnitude(samples.wrench)
    known = np.isfinite(load)
    return samples.time[known], np.asarray(median_filter(load[known], 3, mode="nearest"))


def _levels(load: FloatArray) -> tuple[float, float]:
    """Means of the two levels of a load with at least two values [N]."""
    ordered = np.sort(load)
    count = np.arange(1, len(load))
    sums = np.cumsum(ordered)
    lower, upper = sums[:-1] / count, (sums[-1] - sums[:-1]) / (len(load) - count)
    best = int(np.argmax(count * (len(load) - count) * (upper - lower) ** 2))
    return float(lower[best]), float(upper[best])


def event_span(specification: str, events: Sequence[Event]) -> tuple[float, float]:
    """Start and end of a segment `event:A:B` between events of a trial.

    Each end is a label, optionally with an occurrence, `label#2`, and an offset in seconds,
    `label-2` or `label+5`; or seconds since the first sample. Without a number, the start is the
    first occurrence, and the end the first occurrence after the start.

    Args:
        specification: The segment, such as `event:placed+5:removed-2`.
        events: The trial's events in the order of their times.

    Returns:
        Start and end since the trial's first sample [s].

    Raises:
        ConfigurationError: If the specification does not have two ends.
        TrialError: If there is no such event or the end is not after the start.
    """
    first, last = event_ends(specification)
    start = _moment(first, events, -np.inf)
    end = _moment(last, events, start)
    if not start < end:
        raise TrialError(
            f"the segment '{specification}' ends at {end:.2f} s, its start is at {start:.2f} s",
            "give the earlier end first",
        )
    return start, end


def event_ends(specification: str) -> tuple[str, str]:
    """The two ends of a segment `event:A:B`, such as `placed+5` and `removed-2`.

    Args:
        specification: The segment.

    Raises:
        ConfigurationError: If it does not have two ends.
    """
    ends = [end.strip() for end in specification.split(":")[1:]]
    if len(ends) != 2 or not all(ends):
        raise ConfigurationError(f"the segment '{specification}' does not have two ends", _GRAMMAR)
    return ends[0], ends[1]


def _moment(end: str, events: Sequence[Event], after: float) -> float:
    """Time of one end of a segment [s]; the first after a given time unless it is numbered."""
    if re.fullmatch(_NUMBER, end):
        return float(end)
    parts = _END.fullmatch(end)
    assert parts is not None  # matches any text
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
    """The events with a label; a TrialError that suggests others if there are none."""
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
    """Starts and ends of cycles between events, since the trial's first sample [s].

    Args:
        events: The trial's events in the order of their times.
        by: One label, for cycles that run from each such event to the next; or two, `A:B`, for
            cycles from each A to the next B, unless another A lies between.
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


# --- stamps of events that are marked live

REAL_TIME = 1e9  # [ns/s]
_SPEED_TOLERANCE = 0.1  # [-]; a smaller deviation from real time is noise
_NEAR = 0.02  # [s]; triggers nearer to each other give no speed


def stamp_by_triggers(called: float, triggers: Sequence[tuple[float, int]]) -> int:
    """Convert a time on the monotonic clock [s] to a stamp in trigger time since the epoch [ns].

    The triggers' clock may run at another speed. A busy machine delays triggers and none arrives
    early, so the least delayed trigger gives the offset between the clocks.

    Args:
        called: The time on the monotonic clock [s].
        triggers: Arrival on the monotonic clock [s] and stamp since the epoch [ns] of each trigger,
            at least one.
    """
    arrivals, stamps = (np.array(values) for values in zip(*triggers, strict=True))
    ahead = np.round(trigger_speed(triggers) * (called - arrivals)).astype(np.int64)
    return int((stamps + ahead).max())


def trigger_speed(triggers: Sequence[tuple[float, int]]) -> float:
    """Speed of the triggers' clock [ns/s]; exactly real time (1e9) if within a tenth of it.

    Takes arrival on the monotonic clock [s] and stamp since the epoch [ns] of each trigger, at
    least one.

    The slope of the upper hull of stamps over arrivals at the mean arrival: of all lines that no
    trigger is early on, that of the least total delay (Moon, Skelly and Towsley, 1999).
    """
    arrivals, stamps = (np.array(values) for values in zip(*triggers, strict=True))
    passed, middle = arrivals - arrivals[:, None], arrivals.mean()
    across = (arrivals[:, None] <= middle) & (arrivals > middle) & (passed >= _NEAR)
    if not across.any():
        return REAL_TIME
    first, last = np.nonzero(across)
    speeds = (stamps[last] - stamps[first]) / passed[across]
    highest = (stamps[first] - stamps[0] + speeds * (middle - arrivals[first])).argmax()
    speed = float(speeds[highest])
    return REAL_TIME if abs(speed - REAL_TIME) < _SPEED_TOLERANCE * REAL_TIME else speed
