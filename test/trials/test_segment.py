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


def test_the_longest_range_within_limits_is_found(rng) -> None:
    """It is the longest of all ranges, and the first of those."""
    for count in (1, 2, 7, 40) * 20:
        values = np.cumsum(rng.integers(-2, 3, size=(count, 3)), axis=0).astype(float)
        limits = rng.integers(0, 6, size=3).astype(float)
        ranges = [(i, j) for i in range(count) for j in range(i + 1, count + 1)]
        fitting = [(i, j) for i, j in ranges if (np.ptp(values[i:j], axis=0) <= limits).all()]
        longest = max(fitting, key=lambda r: (r[1] - r[0], -r[0]))
        assert segment.longest_within(values, limits) == longest


def test_plateaus_are_steady_stretches_under_load() -> None:
    """The longest is the first."""
    steps = seconds((15, 90), (60, 280), (25, 200), (20, 90))
    plateaus = segment.find_plateaus(under(steps), SETTINGS)
    assert 15 <= plateaus[0].start <= 20 and 70 <= plateaus[0].end <= 75
    lengths = [plateau.end - plateau.start for plateau in plateaus]
    assert lengths == sorted(lengths, reverse=True)
    assert all(np.ptp(steps[plateau.rows]) == 0.0 for plateau in plateaus)


@pytest.mark.parametrize(
    "load",
    [np.linspace(50, 400, 400), np.linspace(400, 50, 400), np.zeros(400), np.full(2, 280.0)],
    ids=["rising", "falling", "no load", "two samples"],
)
def test_no_plateau_is_found_without_steady_load(load: np.ndarray) -> None:
    assert segment.find_plateaus(under(load), SETTINGS) == []


def test_a_stretch_with_missing_channels_is_no_plateau() -> None:
    samples = under(seconds((80, 280)))
    samples.local_forces[160:240] = samples.position[160:240] = np.nan
    for plateau in segment.find_plateaus(samples, SETTINGS):
        assert plateau.end <= 42 or plateau.start >= 58


# Recorded before 5 s and from 45 s, or before 20 s and from 50 s.
PAUSED = history((0, 90), (10, 90), (12, 280), (60, 280))


def test_loads_placed_in_a_pause_are_known_afterwards() -> None:
    (placed,) = events.find_events(PAUSED[np.r_[:20, 180:240]], SETTINGS)
    assert placed.time == pytest.approx(45.0)


def test_a_plateau_ends_at_a_pause() -> None:
    plateaus = segment.find_plateaus(PAUSED[np.r_[:80, 200:240]], SETTINGS)
    assert plateaus and not any(part.start < 30.0 < part.end for part in plateaus)


HELD = under(np.full(50, 280.0))


def test_a_span_of_seconds_is_taken() -> None:
    assert segment.select_segment(HELD, "5:10.5", SETTINGS).rows == slice(20, 43)


@pytest.mark.parametrize(
    ("text", "kind", "says"),
    [
        ("a:b", ConfigurationError, "T0:T1"),
        ("100:200", TrialError, "0 samples"),
    ],
    ids=["no numbers", "after the end"],
)
def test_a_segment_without_samples_is_refused(text: str, kind: type[Exception], says: str) -> None:
    with refused(kind, says):
        segment.select_segment(HELD, text, SETTINGS)


# Under 280 N from 62 s to 80 s.
LATE = history((0, 90), (60, 90), (62, 280), (80, 280), (82, 90), (90, 90))


def test_a_plateau_is_the_longest_whatever_its_load() -> None:
    assert segment.select_segment(LATE, "plateau", SETTINGS).end < 62.0


@pytest.mark.parametrize("text", ["hold", "auto"])
def test_the_hold_is_the_longest_plateau_under_load(text: str) -> None:
    hold = segment.select_segment(LATE, text, SETTINGS)
    assert hold.kind == "hold" and hold.start > 61.0 and hold.end < 81.0


def test_recorded_events_bound_the_hold() -> None:
    marked = [events.Event("placed", 5.0, "recorded"), events.Event("removed", 55.0, "recorded")]
    assert segment.select_segment(LATE, "hold", SETTINGS, events=lambda: marked).end < 62.0


@pytest.fixture(scope="module")
def moving() -> Samples:
    """A load that moves from 10 s to 50 s between 90 N and 280 N."""
    time = np.arange(0.0, 60.0, 1 / RATE)
    inside = (time > 10) & (time < 50)
    return under(90 + 190 * np.sin(np.pi * (time - 10) / 8) ** 2 * inside)


def test_auto_takes_what_moves_without_a_hold(moving: Samples) -> None:
    part = segment.select_segment(moving, "auto", SETTINGS)
    assert part.kind == "loaded"
    assert part.start == pytest.approx(10.8, abs=0.5) and part.end == pytest.approx(49.2, abs=0.5)


def test_no_hold_is_refused_with_a_hint(moving: Samples) -> None:
    with refused(TrialError, "no hold", "--segment auto"):
        segment.select_segment(moving, "hold", SETTINGS)


# --- plateaus cut where a cluster steps or drifts

STEP = seconds((30, 10), (50, 18))  # [N]


def test_a_step_of_a_cluster_ends_a_plateau() -> None:
    """The newest plateau names it."""
    samples = under(seconds((80, 280)), STEP)
    newest, older = segment.find_newest_plateaus(samples, SETTINGS)
    assert newest.cause == "a.Fz changed by -8.0 N" and older.cause == ""
    assert newest.start >= 29.0 and newest.end == samples.time[-1]


def test_a_step_with_the_load_is_no_cause() -> None:
    for part in segment.find_newest_plateaus(under(seconds((30, 150), (50, 280)), STEP), SETTINGS):
        assert part.cause == ""


def test_a_slip_is_a_step_in_all_directions() -> None:
    slid = under(seconds((80, 280)))
    slid.local_forces[120:] += 0.95 * SETTINGS.cluster_change
    assert segment.find_newest_plateaus(slid, SETTINGS)[0].cause.count(" changed by ") == 3


@pytest.fixture
def gap() -> Samples:
    """A step of a cluster at 30 s, after which it is missing for 16 samples."""
    samples = under(seconds((80, 280)), STEP)
    samples.local_forces[120:136] = np.nan
    return samples


TOLERANT = dataclasses.replace(SETTINGS, missing_fraction=0.5)


def test_a_gap_hides_no_step(gap: Samples) -> None:
    longest, other = segment.find_plateaus(gap, TOLERANT)
    assert longest.start >= 29.0 and other.end <= 31.0 + 16 / RATE


def test_a_left_out_channel_s_step_cuts_nothing(gap: Samples) -> None:
    (whole,) = segment.find_plateaus(gap, TOLERANT, leave_out=("a.Fz",))
    assert whole.end - whole.start > 75.0


_TIME = np.arange(0, 100, 1 / RATE)
_LOAD, _CLUSTER = 200 + 0.5 * _TIME, 10 + 0.2 * _TIME  # [N]; 50 N and 20 N in 100 s


@pytest.mark.parametrize(
    ("samples", "force", "limit", "channel"),
    [
        (under(_LOAD), _LOAD, SETTINGS.force_drift + 2.0, "Fz"),
        (under(_LOAD[::-1]), _LOAD[::-1], SETTINGS.force_drift + 2.0, "Fz"),
        (under(np.full(400, 280.0), _CLUSTER), _CLUSTER, SETTINGS.cluster_drift + 0.5, "a.Fz"),
    ],
    ids=["load", "falling load", "cluster"],
)
def test_drifts_are_cut_where_they_exceed_the_limit(
    samples: Samples, force: np.ndarray, limit: float, channel: str
) -> None:
    """The newest part names it."""
    (newest,) = segment.find_newest_plateaus(samples, SETTINGS)
    assert newest.cause == f"{channel} drifts" and newest.end == samples.time[-1]
    plateaus = segment.find_plateaus(samples, SETTINGS)
    assert plateaus
    for plateau in [*plateaus, newest]:
        assert np.ptp(force[plateau.rows]) <= limit


# --- events found in the load

FINE = 20.0  # [Hz]
_TIMES, _LOADS = (0, 10, 12, 40, 42, 60), (90, 90, 280, 280, 90, 90)  # [s], [N]
HOLD = np.interp(np.arange(0.0, 60.0, 1 / FINE), _TIMES, _LOADS)


def labels(events: list[events.Event]) -> list[str]:
    return [event.label for event in events]


@pytest.mark.parametrize("offset", [0.0, -85.0, 1000.0])
def test_load_events_lie_between_its_two_levels(offset: float) -> None:
    """At 60 % and 40 % of the way between 90 N and 280 N."""
    found = events.find_events(under(HOLD + offset, rate=FINE), SETTINGS)
    assert labels(found) == ["placed", "removed"] and {e.source for e in found} == {"found"}
    assert found[0].time == pytest.approx(10 + 2 * 0.6, abs=0.05)
    assert found[1].time == pytest.approx(40 + 2 * 0.6, abs=0.05)


def test_neither_noise_nor_wrong_values_are_events() -> None:
    samples = under(HOLD, rate=FINE, noise=8.0)
    samples.wrench[500, 5] = 0.0
    samples.wrench[1000, 5] = -900.0
    samples.wrench[220:240] = np.nan
    assert labels(events.find_events(samples, SETTINGS)) == ["placed", "removed"]


@pytest.mark.parametrize("count", [600, 1, 0], ids=["hold", "one sample", "no sample"])
def test_one_level_of_load_has_no_events(count: int) -> None:
    assert events.find_events(under(np.full(count, 280.0), rate=FINE), SETTINGS) == []


@pytest.fixture(scope="module")
def walk() -> list[events.Event]:
    """Events of 20 steps of 1.5 s; the foot bears load half of the time."""
    time = np.arange(0.0, 30.0, 1 / FINE)
    load = 40 + 360 * np.clip(np.sin(2 * np.pi * time / 1.5), 0.0, None)
    return events.find_events(under(load, rate=FINE), SETTINGS)


def test_each_step_of_a_walk_has_its_events(walk: list[events.Event]) -> None:
    assert labels(walk) == ["stance", "placed", "removed", "swing"] * 20


def test_each_step_of_a_walk_is_a_cycle(walk: list[events.Event]) -> None:
    spans = np.array(events.cycle_spans(walk))
    assert len(spans) == 19
    assert np.allclose(np.diff(spans, axis=1), 1.5, atol=0.02)


def test_a_stance_is_half_a_step(walk: list[events.Event]) -> None:
    """10 % and 5 % of the load are passed soon after it begins and before it ends."""
    stances = np.array(events.cycle_spans(walk, "stance:swing"))
    assert np.allclose(np.diff(stances, axis=1), 0.75, atol=0.1)


def test_the_limb_is_loaded_within_a_stance_alone(walk: list[events.Event]) -> None:
    assert events.is_loaded(walk, 0.4) and not events.is_loaded(walk, 1.2)


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


@pytest.mark.parametrize("text", SPANS)
def test_a_span_lies_between_two_events(text: str) -> None:
    assert events.event_span(text, EVENTS) == pytest.approx(SPANS[text])


@pytest.mark.parametrize("text", NO_SPANS)
def test_a_span_without_its_events_is_refused(text: str) -> None:
    says = NO_SPANS[text]
    with refused(ConfigurationError if "two ends" in says else TrialError, says):
        events.event_span(text, EVENTS)


@pytest.mark.parametrize(
    "label",
    ["", "2nd", "a:b", "a#2", "a+5", "push-2", "a\nb", "a" * 100],
    ids=["empty", "digit", "colon", "hash", "plus", "offset", "two lines", "long"],
)
def test_a_label_no_segment_could_name_is_refused(label: str) -> None:
    with refused(ConfigurationError, "label"):
        events.check_label(label)


@pytest.mark.parametrize("label", ["push", "heel-strike 2", "a.b_c"])
def test_a_label_that_a_segment_names_is_taken(label: str) -> None:
    assert events.check_label(label) == label


def test_cycles_lie_between_equal_events() -> None:
    assert events.cycle_spans(EVENTS) == [(11.0, 50.0)]


def test_cycles_lie_between_the_given_events() -> None:
    assert events.cycle_spans(EVENTS, "push:removed") == [(20.0, 41.0)]


# --- events recorded with a trial


def test_neither_outliers_nor_left_out_channels_cut(hold: Path, tmp_path: Path) -> None:
    """An outlier is left out of the fit, has no prediction, and changes no comparison."""
    plateau = Trial(hold).select("plateau", Trial(hold).estimator)
    middle = (plateau.rows.start + plateau.rows.stop) // 2
    trial = st.open_trial(shutil.copytree(hold, tmp_path / "spoilt"))
    samples = trial.samples()
    samples.wrench[middle, 3], samples.position[middle, 0] = 4000.0, 9.0
    samples.local_forces[middle + 1 :, samples.clusters.index("distal")] += 5.0
    assert st.fit(trial).segment != plateau
    fitted = st.fit(trial, leave_out=[f"distal.{axis}" for axis in ("Fx", "Fy", "Fz")])
    assert fitted.segment == st.evaluate(trial, fitted).segment == plateau
    predicted = st.predict(trial, fitted)["Fz [N]"]
    assert predicted.isna().sum() == 1 and predicted.abs().max() < 400.0
    compared = st.compare(hold, trial, segment="25:35").table.query("part == 'wrench'")
    assert compared["difference"].abs().max() < 10.0


@pytest.mark.parametrize("name", ["hold", "auto"])
def test_a_channel_without_values_hides_no_load(name: str, hold: Path) -> None:
    sound, dead = Trial(hold), Trial(hold)
    dead.samples().wrench[:, 3] = np.nan
    assert dead.select(name, dead.estimator) == sound.select(name, sound.estimator)


def test_left_out_clusters_without_values_hide_no_plateau(hold: Path) -> None:
    few = Trial(hold)
    few.samples().local_forces[:, :2] = np.nan
    assert st.fit(few, leave_out=few.samples().channels[6:12]).segment.kind == "plateau"


def test_recorded_events_join_the_found_ones(hold: Path, tmp_path: Path) -> None:
    found = Trial(hold).events()
    assert labels(found) == ["placed", "removed"]
    marks = [("push", 22.0, 22.1), ("step", np.nan, 30.0), ("step", 4e6, 31.0), ("\n", 32.0, 32.0)]
    trial = add_events(hold, tmp_path / "marked", marks, "/lab")
    events = trial.events()
    assert labels(events) == ["placed", "push", "step", "step", "unnamed", "removed"]
    assert [e.time for e in events if e.source == "recorded"] == pytest.approx([22, 30, 31, 32])
    assert [e for e in events if e.source == "found"] == found


def test_a_recorded_event_replaces_a_found_one(hold: Path, tmp_path: Path) -> None:
    placed = add_events(hold, tmp_path / "placed", [("placed", 15.0, 15.0)]).events()
    assert placed[0].time == pytest.approx(15.0) and labels(placed) == ["placed", "removed"]
