"""Plateaus, holds and other segments of a trial by its load."""

import dataclasses

import numpy as np
import pytest
from support.loads import samples_of

from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import PlateauSettings
from socket_testbed.trials.segment import (
    find_newest_plateaus,
    find_plateaus,
    longest_within,
    select_segment,
)

RATE = 4.0
SETTINGS = PlateauSettings()


def samples_of_force(force: np.ndarray) -> Samples:
    """Samples with a vertical force [N] over time at 4 Hz and a little noise."""
    return samples_of(force, RATE)


def test_the_longest_range_within_limits_is_that_of_all_ranges() -> None:
    rng = np.random.default_rng(0)
    for count in (1, 2, 7, 40) * 20:
        values = np.cumsum(rng.integers(-2, 3, size=(count, 3)), axis=0).astype(float)
        limits = rng.integers(0, 6, size=3).astype(float)
        ranges = [(i, j) for i in range(count) for j in range(i + 1, count + 1)]
        fitting = [(i, j) for i, j in ranges if (np.ptp(values[i:j], axis=0) <= limits).all()]
        assert longest_within(values, limits) == max(fitting, key=lambda r: (r[1] - r[0], -r[0]))


def seconds(*parts: tuple[float, float]) -> np.ndarray:
    """A force history from (duration [s], force [N]) parts."""
    return np.concatenate([np.full(round(d * RATE), f) for d, f in parts])


def test_the_longest_steady_stretch_wins_and_none_reaches_over_a_change_of_load() -> None:
    steps = seconds((15, 90), (60, 280), (25, 200), (20, 90))
    plateaus = find_plateaus(samples_of_force(steps), SETTINGS)
    assert 15 <= plateaus[0].start <= 20 and 70 <= plateaus[0].end <= 75
    lengths = [segment.end - segment.start for segment in plateaus]
    assert lengths == sorted(lengths, reverse=True)
    assert all(np.ptp(steps[segment.rows]) == 0.0 for segment in plateaus)


def test_a_stretch_with_many_missing_channels_is_left_out() -> None:
    samples = samples_of_force(seconds((80, 280)))
    samples.local_forces[160:240] = np.nan
    samples.position[160:240] = np.nan
    plateaus = find_plateaus(samples, SETTINGS)
    for segment in plateaus:
        assert segment.end <= 42 or segment.start >= 58
    lenient = dataclasses.replace(SETTINGS, missing_fraction=1.0)
    whole = find_plateaus(samples, lenient)[0]
    assert whole.end - whole.start > 70


def test_a_ramp_a_limb_without_load_and_few_samples_have_no_plateau() -> None:
    held = [np.full(count, 280.0) for count in (0, 1, 2, 5)]
    for force in (np.linspace(50, 400, 400), np.zeros(400), *held):
        assert find_plateaus(samples_of_force(force), SETTINGS) == []


def test_a_span_of_seconds_is_taken_and_an_unknown_segment_refused_with_a_hint() -> None:
    held = samples_of_force(np.full(50, 280.0))
    assert select_segment(held, "5:10.5", SETTINGS).rows == slice(20, 43)
    for text in ("10", "a:b", "10:20:30", ""):
        with pytest.raises(ConfigurationError, match="T0:T1"):
            select_segment(held, text, SETTINGS)
    with pytest.raises(TrialError, match="0 samples"):
        select_segment(held, "100:200", SETTINGS)
    for text in ("plateau", "hold", "auto"):
        with pytest.raises(TrialError, match="give --segment all or --segment T0:T1"):
            select_segment(samples_of_force(np.zeros(120)), text, SETTINGS)


def history(*corners: tuple[float, float]) -> Samples:
    """Samples under a load [N] that is linear between corners of (time [s], load [N])."""
    times, loads = np.array(corners).T
    return samples_of_force(np.interp(np.arange(0.0, times[-1], 1 / RATE), times, loads))


def test_the_hold_is_the_longest_plateau_under_load() -> None:
    samples = history((0, 90), (60, 90), (62, 280), (80, 280), (82, 90), (90, 90))
    assert select_segment(samples, "plateau", SETTINGS).end < 62.0
    for text in ("hold", "auto"):
        hold = select_segment(samples, text, SETTINGS)
        assert hold.kind == "hold" and hold.start > 61.0 and hold.end < 81.0


def test_auto_takes_the_part_under_load_where_nothing_is_held() -> None:
    time = np.arange(0.0, 60.0, 1 / RATE)
    moving = 90 + 190 * np.sin(np.pi * (time - 10) / 8) ** 2 * ((time > 10) & (time < 50))
    samples = samples_of_force(moving)
    part = select_segment(samples, "auto", SETTINGS)
    assert part.kind == "loaded"
    assert part.start == pytest.approx(10.8, abs=0.5) and part.end == pytest.approx(49.2, abs=0.5)
    with pytest.raises(TrialError, match=r"no hold .*--segment auto"):
        select_segment(samples, "hold", SETTINGS)
    events = select_segment(samples, "event:placed+5:removed-2", SETTINGS)
    assert str(events).startswith("event:placed+5:removed-2 ")


def test_a_trial_without_a_plateau_says_which_segment_would_do() -> None:
    samples = history((0, 0), (5, 0), (60, 400), (65, 0), (70, 0))
    with pytest.raises(TrialError, match="no plateau") as caught:
        select_segment(samples, "plateau", SETTINGS)
    text = caught.value.hint.split("--segment ")[1].split()[0]
    part = select_segment(samples, text, SETTINGS)
    assert part.start == pytest.approx(5 + 0.1 * 55, abs=0.5) and 64.0 < part.end < 65.0


# --- changes of a cluster, and the newest stretch


def with_cluster(samples: Samples, force: np.ndarray) -> Samples:
    """The samples with this normal force on their cluster, shape (N,) [N]."""
    local = np.zeros((len(samples), 1, 3))
    local[:, 0, 2] = -force
    return dataclasses.replace(samples, local_forces=local)


def test_a_step_of_a_cluster_ends_a_plateau() -> None:
    missing, force = 16, seconds((30, 10), (50, 18))
    samples = with_cluster(samples_of_force(seconds((80, 280))), force)
    samples.local_forces[120 : 120 + missing] = np.nan  # a gap hides no step
    settings = dataclasses.replace(SETTINGS, missing_fraction=0.5)
    longest, other = find_plateaus(samples, settings)
    assert longest.start >= 29.0 and other.end <= 31.0 + missing / RATE
    (left_out,) = find_plateaus(samples, settings, leave_out=("a.Fz",))
    assert left_out.end - left_out.start > 75.0


def test_a_drift_is_cut_where_it_exceeds_the_limit_and_the_newest_part_names_it() -> None:
    time = np.arange(0, 100, 1 / RATE)
    load, cluster = 200 + 0.5 * time, 10 + 0.2 * time  # 50 N and 20 N in 100 s
    loaded = samples_of_force(load)
    pressed = with_cluster(samples_of_force(np.full(400, 280.0)), cluster)
    for samples, force, limit, channel in (
        (loaded, load, SETTINGS.force_drift + 2.0, "Fz"),
        (pressed, cluster, SETTINGS.cluster_drift + 0.5, "a.Fz"),
    ):
        (newest,) = find_newest_plateaus(samples, SETTINGS)
        assert newest.cause == f"{channel} drifts" and newest.end == samples.time[-1]
        plateaus = find_plateaus(samples, SETTINGS)
        assert plateaus
        for segment in (*plateaus, newest):
            assert np.ptp(force[segment.rows]) <= limit


def test_a_cluster_out_of_its_range_or_dead_ends_no_plateau() -> None:
    samples = with_cluster(samples_of_force(seconds((80, 280))), seconds((40, 0), (40, 50)))
    samples.status[160:] = 3
    assert find_plateaus(samples, SETTINGS)[0].end > 75.0
    samples.local_forces[:] = np.nan
    lenient = dataclasses.replace(SETTINGS, missing_fraction=0.5)
    assert find_plateaus(samples, lenient)[0].end > 75.0


def test_a_stretch_names_the_channel_that_slipped_before_it_and_no_change_of_load() -> None:
    force = seconds((30, 10), (50, 18))
    slipped = with_cluster(samples_of_force(seconds((80, 280))), force)
    newest, older = find_newest_plateaus(slipped, SETTINGS)
    assert newest.cause == "a.Fz changed by -8.0 N" and older.cause == ""
    assert newest.start >= 29.0 and newest.end == slipped.time[-1]
    loaded = with_cluster(samples_of_force(seconds((30, 150), (50, 280))), force)
    newest, older = find_newest_plateaus(loaded, SETTINGS)
    assert newest.cause == older.cause == ""
