"""Events of a trial: recorded and found, spans between them, and cycles."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from support.bags import add_events, copy_configuration

from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import PlateauSettings
from socket_testbed.trials.bag import BagReader, BagWriter
from socket_testbed.trials.events import (
    Event,
    check_label,
    cycle_spans,
    event_span,
    find_events,
    loaded_span,
)
from socket_testbed.trials.layout import encode, message_class
from socket_testbed.trials.segment import select_segment
from socket_testbed.trials.topics import EVENT, match_topics
from socket_testbed.trials.trial import Trial

SETTINGS = PlateauSettings()
RATE = 20.0


def samples_of(load: np.ndarray, noise: float = 0.3, seed: int = 0) -> Samples:
    """Samples with a load [N] over time at 20 Hz; the motion capture and the cluster are steady."""
    rng = np.random.default_rng(seed)
    wrench = rng.normal(0.0, [0.02] * 3 + [noise] * 3, (len(load), 6))
    wrench[:, 5] -= load
    return Samples(
        stamps=np.arange(len(load)) * round(1e9 / RATE),
        position=rng.normal(0.0, 1e-4, (len(load), 3)),
        rotation=np.zeros((len(load), 3)),
        wrench=wrench,
        clusters=("a",),
        local_forces=np.zeros((len(load), 1, 3)),
        status=np.zeros((len(load), 1), dtype=np.uint8),
    )


def history(*corners: tuple[float, float]) -> np.ndarray:
    """A load [N] that is linear between corners of (time [s], load [N])."""
    times, loads = np.array(corners).T
    return np.interp(np.arange(0.0, times[-1], 1 / RATE), times, loads)


HOLD = history((0, 90), (10, 90), (12, 280), (40, 280), (42, 90), (60, 90))


def labels(events: list[Event]) -> list[str]:
    return [event.label for event in events]


# --- events found in the load


def test_the_load_is_placed_and_removed_between_its_two_levels() -> None:
    for offset in (0.0, -85.0, 1000.0):
        found = find_events(samples_of(HOLD + offset), SETTINGS)
        assert labels(found) == ["placed", "removed"] and {e.source for e in found} == {"found"}
        # 60 % and 40 % of the way between 90 N and 280 N.
        assert found[0].time == pytest.approx(10 + 2 * 0.6, abs=0.05)
        assert found[1].time == pytest.approx(40 + 2 * 0.6, abs=0.05)


def test_noise_and_single_wrong_values_are_no_events() -> None:
    samples = samples_of(HOLD, noise=8.0)
    samples.wrench[500, 5] = 0.0
    samples.wrench[1000, 5] = -900.0
    samples.wrench[220:240] = np.nan
    assert labels(find_events(samples, SETTINGS)) == ["placed", "removed"]


def test_one_level_of_load_has_no_events() -> None:
    for load in (0.0, 280.0):
        samples = samples_of(np.full(600, load), noise=2.0)
        assert find_events(samples, SETTINGS) == []
        assert find_events(samples[:1], SETTINGS) == find_events(samples[:0], SETTINGS) == []


def test_steps_of_a_walk_are_as_many_events_and_cycles() -> None:
    time = np.arange(0.0, 30.0, 1 / RATE)
    load = 40 + 360 * np.clip(np.sin(2 * np.pi * time / 1.5), 0.0, None)
    found = find_events(samples_of(load), SETTINGS)
    assert labels(found) == ["placed", "removed"] * 20
    spans = np.array(cycle_spans(found))
    assert len(spans) == 19
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
    "event:placed+5:removed-2": (16.0, 39.0),
    "event:placed+.5:removed-2.25": (11.5, 38.75),
    "event:3:placed": (3.0, 11.0),
    "event:push:60.5": (15.0, 60.5),
    "event:push#2-1:placed#2+1": (19.0, 51.0),
    "event:placed:placed": (11.0, 50.0),  # one cycle: the next after the start
    "event:push:push#1+3": (15.0, 18.0),
    "event:push-1:push+1.5": (14.0, 16.5),  # around one event
    "event:push-off-1:push-off+1": (15.0, 17.0),
}
NO_SPANS = {
    "event:plced:removed": "no event 'plced': did you mean 'placed'? it has",
    "event:tread:removed": "it has placed (2 times), push (2 times), push-off",
    "event:push#3:removed": "no 'push#3': 'push' happens 2 times: give #1 to #2",
    "event:push#0:removed": "no 'push#0'",
    "event:removed:push": "no 'push' is after 41.00 s: the last",
    "event:push+30:removed": "no 'removed' is after 45.00 s: the last",
    "event:placed:9": "ends at 9.00 s, its start is at 11.00 s",
    "event:push": "has no two ends: give event:A:B",
    "event::push": "has no two ends",
    "event:a:b:c": "has no two ends",
}


def test_a_span_between_events_or_what_there_is_instead() -> None:
    for text, span in SPANS.items():
        assert event_span(text, EVENTS) == pytest.approx(span)
    for text, says in NO_SPANS.items():
        with pytest.raises((TrialError, ConfigurationError)) as caught:
            event_span(text, EVENTS)
        assert says in str(caught.value)
        assert isinstance(caught.value, ConfigurationError) == ("two ends" in says)
    with pytest.raises(TrialError, match=r"no event 'push': it has none: mark events"):
        event_span("event:push:9", [])


def test_a_label_can_name_a_segment_or_is_refused() -> None:
    for label in ("push", "heel-strike 2", "Übergang", "a" * 99, "step_1.b"):
        events = [Event(check_label(label), 3.0, "recorded"), Event(label, 7.0, "recorded")]
        assert event_span(f"event:{label}#1+1:{label}-0.5", events) == pytest.approx((4.0, 6.5))
    for label in (
        *("", " ", "2nd", "-a", "a:b", "a#2", "a+5", "push-2", "a-", "a ", "a\nb", "\x1b[2J"),
        "a" * 100,
    ):
        with pytest.raises(ConfigurationError, match="label"):
            check_label(label)


def test_cycles_between_two_events() -> None:
    assert cycle_spans(EVENTS, "push:removed") == [(20.0, 41.0)]
    assert cycle_spans(EVENTS, "placed:removed") == [(11.0, 41.0)]
    assert cycle_spans(EVENTS) == [(11.0, 50.0)]
    with pytest.raises(TrialError, match="did you mean 'push'"):
        cycle_spans(EVENTS, "puhs")


# --- segments by load


def test_the_hold_is_the_longest_plateau_under_load() -> None:
    load = history((0, 90), (60, 90), (62, 280), (80, 280), (82, 90), (90, 90))
    samples = samples_of(load)
    assert select_segment(samples, "plateau", SETTINGS).end < 62.0
    for text in ("hold", "auto"):
        hold = select_segment(samples, text, SETTINGS)
        assert hold.kind == "hold" and hold.start > 61.0 and hold.end < 81.0


def test_auto_takes_what_is_under_load_where_nothing_is_held() -> None:
    time = np.arange(0.0, 60.0, 1 / RATE)
    moving = 90 + 190 * np.sin(np.pi * (time - 10) / 8) ** 2 * ((time > 10) & (time < 50))
    samples = samples_of(moving)
    part = select_segment(samples, "auto", SETTINGS)
    assert part.kind == "loaded"
    assert part.start == pytest.approx(10.8, abs=0.3) and part.end == pytest.approx(49.2, abs=0.3)
    assert loaded_span(samples, SETTINGS) == (part.start, part.end)
    with pytest.raises(TrialError, match=r"no hold .*--segment auto"):
        select_segment(samples, "hold", SETTINGS)


def test_a_trial_without_a_plateau_says_which_segment_would_do() -> None:
    samples = samples_of(history((0, 0), (5, 0), (60, 400), (65, 0), (70, 0)))
    with pytest.raises(TrialError) as caught:
        select_segment(samples, "plateau", SETTINGS)
    text = caught.value.hint.split("--segment ")[1].split()[0]
    part = select_segment(samples, text, SETTINGS)
    assert part.start == pytest.approx(5 + 0.1 * 55, abs=0.3) and 64.0 < part.end < 65.0


def test_a_segment_that_there_is_not_is_refused_with_a_hint() -> None:
    for text in ("plateau", "hold", "auto"):
        with pytest.raises(TrialError, match="give --segment all or --segment T0:T1"):
            select_segment(samples_of(np.zeros(600)), text, SETTINGS)
    with pytest.raises(ConfigurationError, match=r"did you mean 'auto'\?.*event:A:B"):
        select_segment(samples_of(HOLD), "atuo", SETTINGS)


def test_an_event_segment_is_named_by_what_it_lies_between() -> None:
    segment = select_segment(samples_of(HOLD), "event:placed+5:removed-2", SETTINGS)
    assert str(segment) == "event:placed+5:removed-2 16.20 s to 39.15 s"


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


def test_a_recorded_label_replaces_the_found_ones(hold: Path, tmp_path: Path) -> None:
    trial = add_events(hold, tmp_path / "marked", [("placed", 15.0, 15.0)])
    assert str(trial.events()[0]) == "placed at 15.00 s (recorded)"
    assert labels(trial.events()) == ["placed", "removed"]


def test_an_event_topic_of_another_type_is_no_event(hold: Path, tmp_path: Path) -> None:
    other = dataclasses.replace(EVENT, type="std_msgs/msg/String")
    with BagReader(hold) as old, BagWriter(tmp_path / "other") as new:
        for topic, name in match_topics(old.counts, "hold").items():
            new.add_topic(name, topic)
        new.add_topic("/event", other)
        for raw in old.messages():
            new.write(raw.topic, raw.time, raw.data)
        new.write("/event", raw.time, encode(message_class(other.type)("hello"), other.type))
    trial = Trial(copy_configuration(hold, tmp_path / "other"))
    assert {event.source for event in trial.events()} == {"found"}
