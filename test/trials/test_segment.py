"""Plateaus, holds and other segments of a trial by its load; events, and cycles between them."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.bags import add_events
from support.problems import make_samples
from support.wording import refused

import socket_testbed as st
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import PlateauSettings
from socket_testbed.trials import events, segment
from socket_testbed.trials.trial import Trial

RATE = 4.0
SETTINGS = PlateauSettings()


def under(load: np.ndarray, cluster=0.0, rate=RATE, noise=0.2) -> Samples:
    """Samples at a rate [Hz] under a vertical load [N] with noise [N], and of a cluster's own."""
    rng, count = np.random.default_rng(0), len(load)
    wrench = rng.normal(0.0, [0.02] * 3 + [noise] * 3, (count, 6))
    wrench[:, 5] -= load
    pose, forces = rng.normal(0.0, 1e-4, (count, 3)), np.zeros((count, 3))
    forces[:, 2] -= cluster
    samples = make_samples(pose, wrench, {"a": forces})
    return dataclasses.replace(samples, stamps=np.arange(count) * round(1e9 / rate))


def seconds(*parts: tuple[float, float]) -> np.ndarray:
    """A force history from (duration [s], force [N]) parts."""
    return np.concatenate([np.full(round(d * RATE), f) for d, f in parts])


def history(*corners: tuple[float, float]) -> Samples:
    """Samples under a load [N] that is linear between corners of (time [s], load [N])."""
    times, loads = np.array(corners).T
    return under(np.interp(np.arange(0.0, times[-1], 1 / RATE), times, loads))


def test_the_longest_range_within_limits_is_that_of_all_ranges(rng) -> None:
    for count in (1, 2, 7, 40) * 20:
        values = np.cumsum(rng.integers(-2, 3, size=(count, 3)), axis=0).astype(float)
        limits = rng.integers(0, 6, size=3).astype(float)
        ranges = [(i, j) for i in range(count) for j in range(i + 1, count + 1)]
        fitting = [(i, j) for i, j in ranges if (np.ptp(values[i:j], axis=0) <= limits).all()]
        longest = max(fitting, key=lambda r: (r[1] - r[0], -r[0]))
        assert segment.longest_within(values, limits) == longest


def test_plateaus_are_steady_stretches_under_load_the_longest_first() -> None:
    steps = seconds((15, 90), (60, 280), (25, 200), (20, 90))
    plateaus = segment.find_plateaus(under(steps), SETTINGS)
    assert 15 <= plateaus[0].start <= 20 and 70 <= plateaus[0].end <= 75
    lengths = [plateau.end - plateau.start for plateau in plateaus]
    assert lengths == sorted(lengths, reverse=True)
    assert all(np.ptp(steps[plateau.rows]) == 0.0 for plateau in plateaus)
    for force in (np.linspace(50, 400, 400), np.zeros(400), np.full(2, 280.0)):
        assert segment.find_plateaus(under(force), SETTINGS) == []
    # A stretch with many missing channels is left out.
    samples = under(seconds((80, 280)))
    samples.local_forces[160:240] = samples.position[160:240] = np.nan
    for plateau in segment.find_plateaus(samples, SETTINGS):
        assert plateau.end <= 42 or plateau.start >= 58


def test_nothing_is_said_of_the_load_in_a_pause_of_the_recording() -> None:
    samples = history((0, 90), (10, 90), (12, 280), (60, 280))
    (placed,) = events.find_events(samples[np.r_[:20, 180:240]], SETTINGS)
    assert placed.time == pytest.approx(45.0)  # when it is known to be loaded
    plateaus = segment.find_plateaus(samples[np.r_[:80, 200:240]], SETTINGS)
    assert plateaus and not any(part.start < 30.0 < part.end for part in plateaus)


def test_a_span_of_seconds_is_taken_and_an_unknown_segment_refused_with_a_hint() -> None:
    held = under(np.full(50, 280.0))
    assert segment.select_segment(held, "5:10.5", SETTINGS).rows == slice(20, 43)
    with refused(ConfigurationError, "T0:T1"):
        segment.select_segment(held, "a:b", SETTINGS)
    with refused(TrialError, "0 samples"):
        segment.select_segment(held, "100:200", SETTINGS)


def test_the_hold_is_the_longest_plateau_under_load_and_auto_takes_what_moves_without_one() -> None:
    samples = history((0, 90), (60, 90), (62, 280), (80, 280), (82, 90), (90, 90))
    assert segment.select_segment(samples, "plateau", SETTINGS).end < 62.0
    for text in ("hold", "auto"):
        hold = segment.select_segment(samples, text, SETTINGS)
        assert hold.kind == "hold" and hold.start > 61.0 and hold.end < 81.0
    marked = [events.Event("placed", 5.0, "recorded"), events.Event("removed", 55.0, "recorded")]
    assert segment.select_segment(samples, "hold", SETTINGS, events=lambda: marked).end < 62.0
    time = np.arange(0.0, 60.0, 1 / RATE)
    moving = 90 + 190 * np.sin(np.pi * (time - 10) / 8) ** 2 * ((time > 10) & (time < 50))
    part = segment.select_segment(under(moving), "auto", SETTINGS)
    assert part.kind == "loaded"
    assert part.start == pytest.approx(10.8, abs=0.5) and part.end == pytest.approx(49.2, abs=0.5)
    with refused(TrialError, "no hold", "--segment auto"):
        segment.select_segment(under(moving), "hold", SETTINGS)


def test_a_step_of_a_cluster_ends_a_plateau_and_the_newest_names_it() -> None:
    missing, force = 16, seconds((30, 10), (50, 18))
    samples = under(seconds((80, 280)), force)
    newest, older = segment.find_newest_plateaus(samples, SETTINGS)
    assert newest.cause == "a.Fz changed by -8.0 N" and older.cause == ""
    assert newest.start >= 29.0 and newest.end == samples.time[-1]
    for part in segment.find_newest_plateaus(under(seconds((30, 150), (50, 280)), force), SETTINGS):
        assert part.cause == ""  # the load changed, too
    slid = under(seconds((80, 280)))
    slid.local_forces[120:] += 0.95 * SETTINGS.cluster_change  # in three directions at once
    assert segment.find_newest_plateaus(slid, SETTINGS)[0].cause.count(" changed by ") == 3
    samples.local_forces[120 : 120 + missing] = np.nan  # a gap hides no step
    settings = dataclasses.replace(SETTINGS, missing_fraction=0.5)
    longest, other = segment.find_plateaus(samples, settings)
    assert longest.start >= 29.0 and other.end <= 31.0 + missing / RATE
    (left_out,) = segment.find_plateaus(samples, settings, leave_out=("a.Fz",))
    assert left_out.end - left_out.start > 75.0


def test_a_drift_is_cut_where_it_exceeds_the_limit_and_the_newest_part_names_it() -> None:
    time = np.arange(0, 100, 1 / RATE)
    load, cluster = 200 + 0.5 * time, 10 + 0.2 * time  # 50 N and 20 N in 100 s
    for samples, force, limit, channel in (
        (under(load), load, SETTINGS.force_drift + 2.0, "Fz"),
        (under(np.full(400, 280.0), cluster), cluster, SETTINGS.cluster_drift + 0.5, "a.Fz"),
    ):
        (newest,) = segment.find_newest_plateaus(samples, SETTINGS)
        assert newest.cause == f"{channel} drifts" and newest.end == samples.time[-1]
        plateaus = segment.find_plateaus(samples, SETTINGS)
        assert plateaus
        for plateau in (*plateaus, newest):
            assert np.ptp(force[plateau.rows]) <= limit


# --- events found in the load

FINE = 20.0  # [Hz]
_TIMES, _LOADS = (0, 10, 12, 40, 42, 60), (90, 90, 280, 280, 90, 90)  # [s], [N]
HOLD = np.interp(np.arange(0.0, 60.0, 1 / FINE), _TIMES, _LOADS)


def labels(events: list[events.Event]) -> list[str]:
    return [event.label for event in events]


def test_the_load_is_placed_and_removed_between_its_two_levels() -> None:
    for offset in (0.0, -85.0, 1000.0):
        found = events.find_events(under(HOLD + offset, rate=FINE), SETTINGS)
        assert labels(found) == ["placed", "removed"] and {e.source for e in found} == {"found"}
        # 60 % and 40 % of the way between 90 N and 280 N.
        assert found[0].time == pytest.approx(10 + 2 * 0.6, abs=0.05)
        assert found[1].time == pytest.approx(40 + 2 * 0.6, abs=0.05)


def test_noise_wrong_values_and_one_level_of_load_are_no_events() -> None:
    samples = under(HOLD, rate=FINE, noise=8.0)
    samples.wrench[500, 5] = 0.0
    samples.wrench[1000, 5] = -900.0
    samples.wrench[220:240] = np.nan
    assert labels(events.find_events(samples, SETTINGS)) == ["placed", "removed"]
    for count in (600, 1, 0):
        assert events.find_events(under(np.full(count, 280.0), rate=FINE), SETTINGS) == []


def test_steps_of_a_walk_are_as_many_events_and_cycles() -> None:
    time = np.arange(0.0, 30.0, 1 / FINE)
    load = 40 + 360 * np.clip(np.sin(2 * np.pi * time / 1.5), 0.0, None)
    found = events.find_events(under(load, rate=FINE), SETTINGS)
    assert labels(found) == ["stance", "placed", "removed", "swing"] * 20
    spans = np.array(events.cycle_spans(found))
    assert len(spans) == 19
    assert np.allclose(np.diff(spans, axis=1), 1.5, atol=0.02)
    # The foot bears load half of the time; 10 % and 5 % of it are passed soon after that.
    stances = np.array(events.cycle_spans(found, "stance:swing"))
    assert np.allclose(np.diff(stances, axis=1), 0.75, atol=0.1)
    assert events.is_loaded(found, 0.4) and not events.is_loaded(found, 1.2)


# --- spans between events

_LABELS = ("placed", "push", "push-off", "push", "removed", "placed")
_MOMENTS = (11.0, 15.0, 16.0, 20.0, 41.0, 50.0)
EVENTS = [events.Event(*of, "found") for of in zip(_LABELS, _MOMENTS, strict=True)]
SPANS = {
    "event:placed:removed": (11.0, 41.0),
    "event:placed+.5:removed-2.25": (11.5, 38.75),
    "event:3:placed": (3.0, 11.0),
    "event:push#2-1:placed#2+1": (19.0, 51.0),
    "event:placed:placed": (11.0, 50.0),  # one cycle: the next after the start
    "event:push-off-1:push-off+1": (15.0, 17.0),
}
NO_SPANS = {
    "event:plced:removed": "no event 'plced': did you mean 'placed'? it has",
    "event:push#3:removed": "no 'push#3': 'push' happens 2 times: give #1 to #2",
    "event:removed:push": "no 'push' is after 41.00 s: the last",
    "event:placed:9": "ends at 9.00 s, its start is at 11.00 s",
    "event:push": "does not have two ends: give event:A:B",
}


def test_a_span_or_cycles_between_events_or_what_there_is_instead() -> None:
    for text, span in SPANS.items():
        assert events.event_span(text, EVENTS) == pytest.approx(span)
    for text, says in NO_SPANS.items():
        with refused(ConfigurationError if "two ends" in says else TrialError, says):
            events.event_span(text, EVENTS)
    for label in ("", "2nd", "a:b", "a#2", "a+5", "push-2", "a\nb", "a" * 100):
        with refused(ConfigurationError, "label"):
            events.check_label(label)
    assert events.cycle_spans(EVENTS, "push:removed") == [(20.0, 41.0)]
    assert events.cycle_spans(EVENTS) == [(11.0, 50.0)]


# --- events recorded with a trial


def test_neither_an_outlier_nor_a_channel_left_out_of_the_fit_cuts_a_segment(hold, tmp_path):
    plateau = Trial(hold).select("plateau", Trial(hold).estimator)
    middle = (plateau.rows.start + plateau.rows.stop) // 2
    trial = st.open_trial(shutil.copytree(hold, tmp_path / "spoilt"))
    samples = trial.samples()
    samples.wrench[middle, 3], samples.position[middle, 0] = 4000.0, 9.0
    samples.local_forces[middle + 1 :, samples.clusters.index("distal")] += 5.0
    assert st.fit(trial).segment != plateau
    fitted = st.fit(trial, leave_out=[f"distal.{axis}" for axis in ("Fx", "Fy", "Fz")])
    assert fitted.segment == st.evaluate(trial, fitted).segment == plateau
    predicted = st.predict(trial, fitted)["Fz [N]"]  # nor does an outlier give a number
    assert predicted.isna().sum() == 1 and predicted.abs().max() < 400.0
    compared = st.compare(hold, trial, segment="25:35").table.query("part == 'wrench'")
    assert compared["difference"].abs().max() < 10.0


def test_a_channel_without_any_value_hides_no_load_and_left_out_clusters_no_plateau(hold):
    sound, dead, few = (Trial(hold) for _ in range(3))
    dead.samples().wrench[:, 3] = np.nan
    for name in ("hold", "auto"):
        assert dead.select(name, dead.estimator) == sound.select(name, sound.estimator)
    few.samples().local_forces[:, :2] = np.nan
    assert st.fit(few, leave_out=few.samples().channels[6:12]).segment.kind == "plateau"


def test_recorded_and_found_events_are_in_one_list(hold: Path, tmp_path: Path) -> None:
    found = Trial(hold).events()
    assert labels(found) == ["placed", "removed"]
    marks = [("push", 22.0, 22.1), ("step", np.nan, 30.0), ("step", 4e6, 31.0), ("\n", 32.0, 32.0)]
    trial = add_events(hold, tmp_path / "marked", marks, "/lab")
    events = trial.events()
    assert labels(events) == ["placed", "push", "step", "step", "unnamed", "removed"]
    assert [e.time for e in events if e.source == "recorded"] == pytest.approx([22, 30, 31, 32])
    assert [e for e in events if e.source == "found"] == found
    placed = add_events(hold, tmp_path / "placed", [("placed", 15.0, 15.0)]).events()
    # Instead of the found one.
    assert placed[0].time == pytest.approx(15.0) and labels(placed) == ["placed", "removed"]
