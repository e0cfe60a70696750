"""Events of a trial: recorded and found, spans between them, and cycles."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from support.bags import add_events, copying
from support.loads import samples_of
from support.wording import refused

from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.settings.identification import PlateauSettings
from socket_testbed.trials.layout import encode, message_class
from socket_testbed.trials.segment import (
    Event,
    check_label,
    cycle_spans,
    event_span,
    find_events,
    is_loaded,
)
from socket_testbed.trials.topics import EVENT
from socket_testbed.trials.trial import Trial

SETTINGS = PlateauSettings()
RATE = 20.0


_TIMES, _LOADS = (0, 10, 12, 40, 42, 60), (90, 90, 280, 280, 90, 90)  # [s], [N]
HOLD = np.interp(np.arange(0.0, 60.0, 1 / RATE), _TIMES, _LOADS)


def labels(events: list[Event]) -> list[str]:
    return [event.label for event in events]


# --- events found in the load


def test_the_load_is_placed_and_removed_between_its_two_levels() -> None:
    for offset in (0.0, -85.0, 1000.0):
        found = find_events(samples_of(HOLD + offset, RATE), SETTINGS)
        assert labels(found) == ["placed", "removed"] and {e.source for e in found} == {"found"}
        # 60 % and 40 % of the way between 90 N and 280 N.
        assert found[0].time == pytest.approx(10 + 2 * 0.6, abs=0.05)
        assert found[1].time == pytest.approx(40 + 2 * 0.6, abs=0.05)


def test_noise_wrong_values_and_one_level_of_load_are_no_events() -> None:
    samples = samples_of(HOLD, RATE, noise=8.0)
    samples.wrench[500, 5] = 0.0
    samples.wrench[1000, 5] = -900.0
    samples.wrench[220:240] = np.nan
    assert labels(find_events(samples, SETTINGS)) == ["placed", "removed"]
    level = samples_of(np.full(600, 280.0), RATE, noise=2.0)
    for few in (level, level[:1], level[:0]):
        assert find_events(few, SETTINGS) == []


def test_steps_of_a_walk_are_as_many_events_and_cycles() -> None:
    time = np.arange(0.0, 30.0, 1 / RATE)
    load = 40 + 360 * np.clip(np.sin(2 * np.pi * time / 1.5), 0.0, None)
    found = find_events(samples_of(load, RATE), SETTINGS)
    assert labels(found) == ["stance", "placed", "removed", "swing"] * 20
    spans = np.array(cycle_spans(found))
    assert len(spans) == 19
    # The foot bears load half of the time; 10 % and 5 % of it are passed soon after that.
    stances = np.array(cycle_spans(found, "stance:swing"))
    assert np.allclose(np.diff(stances, axis=1), 0.75, atol=0.1)
    assert np.allclose(np.diff(np.array(cycle_spans(found, "stance")), axis=1), 1.5, atol=0.02)
    assert is_loaded(found, 0.4) and not is_loaded(found, 1.2)
    assert np.allclose(np.diff(spans, axis=1), 1.5, atol=0.02)
    assert np.allclose(spans[1:, 0], spans[:-1, 1])


# --- spans between events

EVENTS = [
    Event("placed", 11.0, "found"),
    Event("push", 15.0, "recorded"),
    Event("push-off", 16.0, "recorded"),
    Event("push", 20.0, "recorded"),
    Event("removed", 41.0, "found"),
    Event("placed", 50.0, "found"),
]


SPANS = {
    "event:placed:removed": (11.0, 41.0),
    "event:placed+.5:removed-2.25": (11.5, 38.75),
    "event:3:placed": (3.0, 11.0),
    "event:push:60.5": (15.0, 60.5),
    "event:push#2-1:placed#2+1": (19.0, 51.0),
    "event:placed:placed": (11.0, 50.0),  # one cycle: the next after the start
    "event:push:push#1+3": (15.0, 18.0),
    "event:push-off-1:push-off+1": (15.0, 17.0),
}
NO_SPANS = {
    "event:plced:removed": "no event 'plced': did you mean 'placed'? it has",
    "event:push#3:removed": "no 'push#3': 'push' happens 2 times: give #1 to #2",
    "event:removed:push": "no 'push' is after 41.00 s: the last",
    "event:placed:9": "ends at 9.00 s, its start is at 11.00 s",
    "event:push": "has no two ends: give event:A:B",
    "event:a:b:c": "has no two ends",
}


def test_a_span_or_cycles_between_events_or_what_there_is_instead() -> None:
    for text, span in SPANS.items():
        assert event_span(text, EVENTS) == pytest.approx(span)
    for text, says in NO_SPANS.items():
        with refused(ConfigurationError if "two ends" in says else TrialError, says):
            event_span(text, EVENTS)
    with refused(TrialError, "no event 'push': it has none: mark events"):
        event_span("event:push:9", [])
    assert cycle_spans(EVENTS, "push:removed") == [(20.0, 41.0)]
    assert cycle_spans(EVENTS) == [(11.0, 50.0)]
    with refused(TrialError, "did you mean 'push'"):
        cycle_spans(EVENTS, "puhs")


def test_a_label_can_name_a_segment_or_is_refused() -> None:
    for label in ("push", "heel-strike 2", "Übergang", "a" * 99, "step_1.b"):
        events = [Event(check_label(label), 3.0, "recorded"), Event(label, 7.0, "recorded")]
        assert event_span(f"event:{label}#1+1:{label}-0.5", events) == pytest.approx((4.0, 6.5))
    for label in (
        "",
        " ",
        "2nd",
        "-a",
        "a:b",
        "a#2",
        "a+5",
        "push-2",
        "a-",
        "a ",
        "a\nb",
        "a" * 100,
    ):
        with refused(ConfigurationError, "label"):
            check_label(label)


# --- events recorded with a trial


def test_recorded_and_found_events_are_in_one_list(hold: Path, tmp_path: Path) -> None:
    found = Trial(hold).events()
    assert labels(found) == ["placed", "removed"]
    marks = [("push", 22.0, 22.1), ("step", np.nan, 30.0), ("step", 4e6, 31.0), ("\n", 32.0, 32.0)]
    trial = add_events(hold, tmp_path / "marked", marks, "/lab")
    events = trial.events()
    assert labels(events) == ["placed", "push", "step", "step", "unnamed", "removed"]
    assert [e.time for e in events if e.source == "recorded"] == pytest.approx([22, 30, 31, 32])
    assert [e for e in events if e.source == "found"] == found
    trial = add_events(hold, tmp_path / "placed", [("placed", 15.0, 15.0)])
    assert str(trial.events()[0]) == "placed at 15.00 s (recorded)"  # instead of the found one
    assert labels(trial.events()) == ["placed", "removed"]
    # A topic of that name may be another program's.
    other = dataclasses.replace(EVENT, type="std_msgs/msg/String")
    with copying(hold, tmp_path / "other") as (old, new):
        new.add_topic("/event", other)
        for raw in old.messages():
            new.write(raw.topic, raw.time, raw.data)
        new.write("/event", raw.time, encode(message_class(other.type)("hello"), other.type))
    assert {event.source for event in Trial(tmp_path / "other").events()} == {"found"}
