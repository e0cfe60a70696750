"""Plateaus and events of loads without noise, whose limits and times follow by paper and pencil.

Samples are at 4 Hz; the moving mean over 2 s covers eight of them, four before and three after. A
sample is steady if the means of the eight before it and the eight after it agree.
"""

from dataclasses import replace

import numpy as np
import pytest
from support.problems import make_samples
from support.wording import refused

from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import PlateauSettings
from socket_testbed.trials import events, segment
from socket_testbed.trials.events import Event

SETTINGS = PlateauSettings()
TIME = 0.25 * np.arange(240)  # [s]


def samples(
    fz: np.ndarray | float = -280.0,
    fx: np.ndarray | float = 0.0,
    mx: np.ndarray | float = 0.0,
    my: np.ndarray | float = 0.0,
    cluster: np.ndarray | float = 0.0,
    side: np.ndarray | float = 0.0,
) -> Samples:
    """60 s of a wrench [N m, N] and of one cluster `a`, along its normal and sideways [N]."""
    wrench, force = np.zeros((240, 6)), np.zeros((240, 3))
    wrench[:, 0], wrench[:, 1], wrench[:, 3], wrench[:, 5] = mx, my, fx, fz
    force[:, 2], force[:, 0] = cluster, side
    return make_samples(np.zeros((240, 6)), wrench, {"a": force})


def step(size: float, at: int = 120, before: float = 0.0) -> np.ndarray:
    """A value that steps at a row."""
    return before + size * (np.arange(240) >= at)


def drift(size: float) -> np.ndarray:
    """A value that grows evenly by so much from the first mean to the last.

    Truncated windows average 1.5 and 2 samples inwards, so the means span 235.5 steps.
    """
    return size * np.arange(240) / 235.5


def spans(found: list[segment.Segment]) -> list[tuple[float, float]]:
    return [(round(part.start, 9), round(part.end, 9)) for part in found]


WHOLE = [(0.0, 59.75)]


def test_a_step_of_load_parts_two_plateaus() -> None:
    """28.0 s of the first half and 27.75 s of the second: the longest comes first."""
    found = spans(segment.find_plateaus(samples(fz=step(-190.0, before=-90.0)), SETTINGS))
    assert found == [(0.0, 28.0), (32.0, 59.75)]


# By channel and what is exceeded: a step below and above its limit.
STEPS = {
    "force": ({"fx": 7.9}, {"fx": 8.1}),
    "force in two directions": ({"fx": 5.6, "fz": 5.6}, {"fx": 5.7, "fz": 5.7}),
    "moment": ({"mx": 0.79}, {"mx": 0.81}),
    "moment in two directions": ({"mx": 0.56, "my": 0.56}, {"mx": 0.57, "my": 0.57}),
    "cluster": ({"cluster": 2.9}, {"cluster": 3.1}),
    "cluster in two directions": ({"cluster": 2.1, "side": 2.1}, {"cluster": 2.2, "side": 2.2}),
}


@pytest.mark.parametrize("name", STEPS)
def test_a_change_counts_beyond_its_limit(name: str) -> None:
    """8 N, 0.8 N m, and 3 N on a cluster, as the length of the vector."""
    small, large = (
        samples(**{k: step(v, before=-280.0 if k == "fz" else 0.0) for k, v in sizes.items()})
        for sizes in STEPS[name]
    )
    assert spans(segment.find_plateaus(small, SETTINGS)) == WHOLE
    assert len(segment.find_plateaus(large, SETTINGS)) == 2


DRIFTS = {"fx": 10.0, "mx": 1.0, "cluster": 5.0}  # [N, N m, N]


@pytest.mark.parametrize("name", DRIFTS)
def test_a_drift_counts_beyond_its_limit(name: str) -> None:
    limit = DRIFTS[name]
    within, beyond = (samples(**{name: drift(f * limit)}) for f in (0.99, 1.02))
    assert spans(segment.find_plateaus(within, SETTINGS)) == WHOLE
    (cut,) = segment.find_plateaus(beyond, SETTINGS)
    assert 57.0 < cut.end < 59.75


def test_the_newest_plateau_names_its_drift() -> None:
    moved = samples(fx=drift(14.0), cluster=drift(7.0))
    (newest,) = segment.find_newest_plateaus(moved, SETTINGS)
    assert newest.end == pytest.approx(59.75) and newest.start == pytest.approx(
        60.0 * 4.0 / 14.0, abs=1.0
    )
    assert newest.cause in {"Fx drifts", "a.Fz drifts", "Fx drifts, a.Fz drifts"}


@pytest.mark.parametrize(("load", "found"), [(20.1, WHOLE), (19.9, [])], ids=["loaded", "not"])
def test_a_plateau_is_under_load(load: float, found: list[tuple[float, float]]) -> None:
    """20 N, whatever the direction."""
    assert spans(segment.find_plateaus(samples(fz=0.0, fx=load), SETTINGS)) == found


@pytest.mark.parametrize(("rows", "count"), [(27, 1), (26, 0)], ids=["long enough", "short"])
def test_a_plateau_lasts_five_seconds(rows: int, count: int) -> None:
    """Means of three samples see a step from three samples away: 6 fewer, 21 from 0 s to 5 s."""
    fz = np.zeros(240)
    fz[100 : 100 + rows] = -280.0
    found = segment.find_plateaus(samples(fz=fz), replace(SETTINGS, smoothing=0.75))
    assert spans(found) == [(25.75, 30.75)] * count


@pytest.mark.parametrize(("lost", "count"), [(2, 1), (4, 2)], ids=["two", "four"])
def test_missing_channels_end_a_plateau(lost: int, count: int) -> None:
    """A window of eight samples may lack a fifth of its channels.

    Of twelve channels (position, wrench, cluster) nine are missing: 2 * 9 / (8 * 12) = 0.19.
    """
    gappy = samples()
    gappy.wrench[120 : 120 + lost] = gappy.position[120 : 120 + lost] = np.nan
    assert len(segment.find_plateaus(gappy, SETTINGS)) == count


def test_a_slip_is_named_with_its_size() -> None:
    """Three of eight samples change a mean by 3 N, which is within the limit."""
    newest, older = segment.find_newest_plateaus(samples(cluster=step(-8.0)), SETTINGS)
    assert newest.cause == "a.Fz changed by -8.0 N" and older.cause == ""
    assert spans([newest, older]) == [(31.25, 59.75), (0.0, 28.75)]


@pytest.mark.parametrize("other", [{"fx": 9.0}, {"mx": 0.9}], ids=["force", "moment"])
def test_a_slip_under_a_changed_load_is_none(other: dict[str, float]) -> None:
    moved = samples(cluster=step(-8.0), **{name: step(size) for name, size in other.items()})
    assert [part.cause for part in segment.find_newest_plateaus(moved, SETTINGS)] == ["", ""]


def test_a_segment_is_its_kind_and_seconds() -> None:
    found = segment.select_segment(samples(), "5:10.5", SETTINGS)
    assert str(found) == "span 5.00 s to 10.50 s" and repr(found) == f"Segment({found})"
    assert (found.start, found.end, found.rows) == (5.0, 10.5, slice(20, 43))
    everything = segment.select_segment(samples(), "all", SETTINGS)
    assert (str(everything), everything.rows) == ("all 0.00 s to 59.75 s", slice(0, 240))


def test_the_first_frames_are_kept() -> None:
    own = samples()
    found = segment.select_segment(own, "5:10.5", SETTINGS)
    few = segment.first_frames(found, own, 5)
    assert (few.kind, few.start, few.end, few.rows) == ("span", 5.0, 6.0, slice(20, 25))
    assert segment.first_frames(found, own, 0) is found
    assert segment.first_frames(found, own, 23) is found
    assert segment.first_frames(found, own, 22).rows == slice(20, 42)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("all of it", "unknown segment 'all of it': "),
        (
            "plateu",
            "unknown segment 'plateu': did you mean 'plateau'? give plateau, hold, auto, al",
        ),
        ("10:5", "the segment is '10:5': give seconds as T0:T1, the earlier first, such as 12.5:6"),
        ("5:5", "the segment is '5:5'"),
        ("a:b", "the segment is 'a:b'"),
    ],
)
def test_an_unknown_segment_is_refused(given: str, words: str) -> None:
    with refused(ConfigurationError, words):
        segment.select_segment(samples(), given, SETTINGS)


def test_a_span_needs_two_samples() -> None:
    with refused(TrialError, "the segment 70:80 s holds 0 samples: give seconds within 0:59.8"):
        segment.select_segment(samples(), "70:80", SETTINGS)
    with refused(TrialError, "the segment 59.7:80 s holds 1 samples"):
        segment.select_segment(samples(), "59.7:80", SETTINGS)
    assert segment.select_segment(samples(), "59.5:80", SETTINGS).rows == slice(238, 240)
    with refused(TrialError, "the trial holds no sample: record it again"):
        segment.select_segment(samples()[:0], "all", SETTINGS)


def test_without_a_plateau_the_loaded_part_is_offered() -> None:
    """Under load from row 40 to row 199, and never steady."""
    swinging = np.where(np.arange(240) % 16 < 8, -100.0, -300.0)
    swinging[:40] = swinging[200:] = 0.0
    with refused(
        TrialError,
        "no plateau of 5 s or more in the 59.8 s of the trial: give --segment 10.00:49.75 (the"
        " part under load), --segment auto, or other limits (plateau.*)",
    ):
        segment.select_segment(samples(fz=swinging), "plateau", SETTINGS)
    with refused(TrialError, "no plateau", ": give --segment all or --segment T0:T1, or other"):
        segment.select_segment(samples(fz=0.0), "plateau", SETTINGS)


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("hold", "hold 37.00 s to 59.75 s"),
        ("auto", "hold 37.00 s to 59.75 s"),
        ("plateau", "plateau 0.00 s to 33.00 s"),
    ],
    ids=["hold", "auto", "plateau"],
)
def test_a_hold_is_under_the_placed_load(name: str, shown: str) -> None:
    """The plateau before the rise is longer, but without the load; `auto` takes the hold too."""
    held = samples(fz=step(-190.0, at=140, before=-90.0))
    found = segment.select_segment(held, name, SETTINGS)
    assert str(found) == shown


def test_auto_takes_the_loaded_part_without_a_hold() -> None:
    swinging = np.where(np.arange(240) % 16 < 8, -100.0, -300.0)
    swinging[:40] = swinging[200:] = 0.0
    found = segment.select_segment(samples(fz=swinging), "auto", SETTINGS)
    assert str(found) == "loaded 10.00 s to 49.75 s"
    with refused(TrialError, "no hold of 5 s or more", "give --segment 10.00:49.75"):
        segment.select_segment(samples(fz=swinging), "hold", SETTINGS)


def test_events_delimit_a_segment() -> None:
    marked = [Event("placed", 10.0, "found"), Event("removed", 20.0, "found")]
    found = segment.select_segment(
        samples(), "event:placed+1:removed-0.5", SETTINGS, events=lambda: marked
    )
    assert (found.kind, found.start, found.end) == ("event:placed+1:removed-0.5", 11.0, 19.5)


def test_a_span_s_hint_names_other_values() -> None:
    with refused(ConfigurationError, "--tare is 'x': give", "such as 12.5:60, or none"):
        segment.parse_span("x", "--tare", ", or none")
    assert segment.parse_span("0:1e1", "--tare") == (0.0, 10.0)


# --- parts of it


def test_a_moving_mean_skips_what_is_missing() -> None:
    """Three samples wide, truncated at the ends."""
    values = np.array([[1.0], [2.0], [np.nan], [6.0], [np.nan], [np.nan], [np.nan]])
    found = segment.moving_mean(values, 3)[:, 0]
    np.testing.assert_allclose(found, [1.5, 1.5, 4.0, 6.0, 6.0, np.nan, np.nan])


def test_gaps_are_filled_with_the_last_value() -> None:
    values = np.array([[np.nan, 1.0], [2.0, np.nan], [np.nan, np.nan], [5.0, 3.0]])
    filled = segment._fill_gaps(values)
    np.testing.assert_array_equal(filled, [[2.0, 1.0], [2.0, 1.0], [2.0, 1.0], [5.0, 3.0]])
    assert segment._fill_gaps(np.full((2, 1), np.nan)).tolist() == [[0.0], [0.0]]


# --- events in the load


def loaded(*corners: tuple[float, float]) -> Samples:
    """A load downwards, linear between corners of (time [s], load [N])."""
    times, loads = np.array(corners).T
    return samples(fz=-np.interp(TIME, times, loads))


def test_a_load_is_placed_at_sixty_per_cent() -> None:
    """From 100 N to 300 N between 20 s and 24 s, and back between 40 s and 44 s.

    The mean levels are (nearly) those: the ramps hold few samples on either side.
    """
    found = events.find_events(
        loaded((0, 100), (20, 100), (24, 300), (40, 300), (44, 100), (60, 100)), SETTINGS
    )
    assert [event.label for event in found] == ["placed", "removed"]
    assert found[0].time == pytest.approx(22.4, abs=0.1)
    assert found[1].time == pytest.approx(42.4, abs=0.1)
    assert str(found[0]).startswith("placed at 22.") and str(found[0]).endswith(" s (found)")


@pytest.mark.parametrize(("rise", "count"), [(21.0, 1), (19.0, 0)])
def test_a_small_rise_is_no_event(rise: float, count: int) -> None:
    """The two levels must differ by 20 N."""
    found = events.find_events(samples(fz=step(-rise, before=-100.0)), SETTINGS)
    assert len(found) == count


def test_two_levels_are_the_means_on_either_side() -> None:
    assert events._levels(np.array([1.0, 12.0, 3.0, 10.0, 14.0])) == (2.0, 12.0)


def steps_of(stride: float, count: int) -> list[Event]:
    """Steps of 400 N, at rest before, after and in half of each stride."""
    phase = (TIME - 10.0) / stride
    under = (phase >= 0.0) & (phase < count) & (phase % 1.0 < 0.5)
    return events.find_events(samples(fz=-400.0 * under), SETTINGS)


@pytest.mark.parametrize(
    ("stride", "count", "walks"),
    [(2.0, 3, True), (2.0, 2, False), (3.0, 4, True), (3.5, 4, False)],
    ids=["three", "two", "slow", "too slow"],
)
def test_three_quick_steps_are_a_walk(stride: float, count: int, walks: bool) -> None:
    labels = [event.label for event in steps_of(stride, count)]
    assert labels.count("placed") == labels.count("removed") == count
    assert labels.count("stance") == labels.count("swing") == count * walks


def test_stance_and_swing_have_their_thresholds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ramps of 2 s between 0 and 400 N: at 0.2 s of the rise, 1.9 s into the fall."""
    corners = [(0.0, 0.0), (6.0, 0.0)]
    for start in (6.0, 14.0, 22.0, 30.0, 38.0, 46.0):
        corners += [(start, 0), (start + 2, 400), (start + 4, 400), (start + 6, 0), (start + 8, 0)]
    monkeypatch.setattr(events, "_MAX_STRIDE", 9.0)
    found = events.find_events(loaded(*corners[:-1], (60.0, 0.0)), SETTINGS)
    first = {event.label: event.time for event in reversed(found)}
    assert first["stance"] == pytest.approx(6.2, abs=0.06)
    assert first["swing"] == pytest.approx(11.9, abs=0.06)


def test_a_single_wrong_value_is_no_event() -> None:
    spoilt = samples(fz=step(-190.0, before=-90.0))
    spoilt.wrench[60, 5] = -280.0
    assert [event.time for event in events.find_events(spoilt, SETTINGS)] == [
        pytest.approx(30.0, abs=0.25)
    ]


@pytest.mark.parametrize(
    ("load", "span"),
    [
        (step(200.0, at=40), (10.0, 59.75)),
        (step(19.0, at=40), None),
        (step(0.0, before=50.0), (0.0, 59.75)),
        # From 5 N to 405 N over 60 s: a tenth of the way, 45 N, is reached at 6 s.
        (5.0 + 400.0 * TIME / 59.75, (6.0, 59.75)),
        # From 0 to 100 N: 20 N count, not 10 N.
        (100.0 * TIME / 59.75, (12.0, 59.75)),
    ],
    ids=["step", "small step", "always", "a tenth", "least force"],
)
def test_the_part_under_load(load: np.ndarray, span: tuple[float, float] | None) -> None:
    found = events.loaded_span(samples(fz=-load), SETTINGS)
    assert found == (None if span is None else pytest.approx(span))


PLACED = Event("placed", 10.0, "found"), Event("removed", 20.0, "found")


@pytest.mark.parametrize(
    ("known", "when", "expected"),
    [
        (PLACED, 9.9, False),
        (PLACED, 10.0, True),
        (PLACED, 19.9, True),
        (PLACED, 20.0, False),
        (PLACED[1:], 5.0, True),
        ((), 5.0, True),
        ((Event("push", 1.0, "recorded"),), 5.0, True),
    ],
)
def test_a_load_is_known_between_its_events(
    known: tuple[Event, ...], when: float, expected: bool
) -> None:
    assert events.is_loaded(known, when) is expected


def test_a_tare_drops_what_is_found_near_it() -> None:
    """Within a second; a recorded label also replaces found ones."""
    recorded = [
        Event("tare removed Fz 9 N", 10.0, "recorded"),
        Event("step", 30.0, "recorded"),
        Event("tared", 50.0, "recorded"),
    ]
    times = {"placed": 11.0, "removed": 11.1, "step": 40.0, "swing": 8.9, "stance": 50.0}
    found = [Event(label, when, "found") for label, when in times.items()]
    joined = events.join_events(recorded, found)
    assert [(event.label.split()[0], event.time) for event in joined] == [
        *(("swing", 8.9), ("tare", 10.0), ("removed", 11.1), ("step", 30.0)),
        *(("tared", 50.0), ("stance", 50.0)),
    ]


@pytest.mark.parametrize(
    ("by", "spans"),
    [
        ("a", [(1.0, 3.0), (3.0, 7.0)]),
        ("a:b", [(3.0, 5.0), (7.0, 8.0)]),
        ("b : a", [(5.0, 7.0)]),
    ],
)
def test_cycles_are_from_event_to_event(by: str, spans: list[tuple[float, float]]) -> None:
    """Of two a in a row, the second begins."""
    times = (("a", 1.0), ("a", 3.0), ("b", 5.0), ("a", 7.0), ("b", 8.0))
    marked = [Event(label, when, "recorded") for label, when in times]
    assert events.cycle_spans(marked, by) == spans


def test_a_label_has_ninety_nine_characters_at_most() -> None:
    assert events.check_label("a" * 99) == "a" * 99
    for given in ("a" * 100, "a ", "-a"):
        with refused(ConfigurationError, "is not a label of an event", "99 characters at most"):
            events.check_label(given)
    assert events.check_label("heel-strike 2") == "heel-strike 2"


# --- the stamps of marked events


def ticks(speed: float, count: int = 9) -> list[tuple[float, int]]:
    """Triggers every 0.1 s of this machine, of a clock at a speed [-]; the first at 5 s."""
    return [(100.0 + 0.1 * k, 5_000_000_000 + round(1e8 * speed * k)) for k in range(count)]


@pytest.mark.parametrize(
    ("speed", "found"), [(1.0, 1.0), (0.5, 0.5), (1.09, 1.0), (0.91, 1.0), (1.12, 1.12)]
)
def test_an_unclear_clock_s_speed_is_real_time(speed: float, found: float) -> None:
    assert events.trigger_speed(ticks(speed)) == pytest.approx(found * 1e9)


def test_two_triggers_at_once_tell_no_speed() -> None:
    assert events.trigger_speed([(1.0, 0), (1.019, 10**9)]) == 1e9
    assert events.trigger_speed([(1.0, 0), (1.021, 10**9)]) == pytest.approx(1e9 / 0.021)


def test_a_stamp_is_in_the_triggers_time() -> None:
    """At half the speed, 2 s before the first trigger is 1 s before its stamp."""
    assert events.stamp_by_triggers(98.0, ticks(0.5)) == pytest.approx(4_000_000_000, abs=10)


def test_a_late_trigger_does_not_delay_a_stamp() -> None:
    late = [(when + 0.3 * (k % 3 == 1), stamp) for k, (when, stamp) in enumerate(ticks(1.0))]
    assert events.stamp_by_triggers(100.0, late) == 5_000_000_000
