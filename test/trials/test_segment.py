import dataclasses

import numpy as np
import pytest

from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import PlateauSettings
from socket_testbed.trials.segment import (
    find_newest_plateaus,
    find_plateaus,
    longest_within,
    moving_mean,
    select_segment,
)

RATE = 4.0


def samples_of_force(force: np.ndarray, seed: int = 0) -> Samples:
    """Samples with a vertical force [N] over time at 4 Hz and a little noise."""
    rng = np.random.default_rng(seed)
    count = len(force)
    wrench = rng.normal(0.0, [0.02] * 3 + [0.2] * 3, (count, 6))
    wrench[:, 5] -= force
    return Samples(
        stamps=np.arange(count) * round(1e9 / RATE),
        position=rng.normal(0.0, 1e-4, (count, 3)),
        rotation=np.zeros((count, 3)),
        wrench=wrench,
        clusters=("a",),
        local_forces=np.zeros((count, 1, 3)),
        status=np.zeros((count, 1), dtype=np.uint8),
    )


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


def test_the_longest_steady_stretch_wins() -> None:
    samples = samples_of_force(seconds((15, 90), (60, 280), (20, 90)))
    plateaus = find_plateaus(samples, PlateauSettings())
    assert 15 <= plateaus[0].start <= 20 and 70 <= plateaus[0].end <= 75
    lengths = [segment.end - segment.start for segment in plateaus]
    assert lengths == sorted(lengths, reverse=True)


def test_a_plateau_reaches_over_no_change_of_load() -> None:
    steps = seconds((20, 90), (30, 280), (25, 200), (20, 90))
    for segment in find_plateaus(samples_of_force(steps), PlateauSettings()):
        assert np.ptp(steps[segment.rows]) == 0.0


def test_a_ramp_has_no_plateau() -> None:
    samples = samples_of_force(np.linspace(50, 400, 400))
    assert find_plateaus(samples, PlateauSettings()) == []
    with pytest.raises(TrialError, match=r"no plateau.*--segment"):
        select_segment(samples, "plateau", PlateauSettings())


def test_a_slow_drift_is_cut_where_it_exceeds_the_limit() -> None:
    drift = 200 + 0.5 * np.arange(0, 100, 1 / RATE)  # 50 N in 100 s
    settings = PlateauSettings()
    for segment in find_plateaus(samples_of_force(drift), settings):
        assert np.ptp(drift[segment.rows]) <= settings.force_drift + 2.0


def test_an_unloaded_stretch_is_no_plateau() -> None:
    samples = samples_of_force(seconds((100, 0), (20, 280)))
    assert find_plateaus(samples, PlateauSettings())[0].start >= 100


def test_a_stretch_with_many_missing_channels_is_left_out() -> None:
    samples = samples_of_force(seconds((80, 280)))
    samples.local_forces[160:240] = np.nan
    samples.position[160:240] = np.nan
    plateaus = find_plateaus(samples, PlateauSettings())
    for segment in plateaus:
        assert segment.end <= 42 or segment.start >= 58
    lenient = dataclasses.replace(PlateauSettings(), missing_fraction=1.0)
    whole = find_plateaus(samples, lenient)[0]
    assert whole.end - whole.start > 70


def test_few_samples_have_no_plateau() -> None:
    for count in (0, 1, 2, 5):
        assert find_plateaus(samples_of_force(np.full(count, 280.0)), PlateauSettings()) == []


def test_a_span_holds_the_samples_within_its_seconds() -> None:
    samples = samples_of_force(seconds((60, 280)))
    segment = select_segment(samples, "10:20.5", PlateauSettings())
    time = samples[segment.rows].stamps * 1e-9
    assert time[0] == 10.0 and time[-1] == 20.5 and len(time) == 43


def test_a_segment_that_is_none_or_outside_the_trial_is_refused() -> None:
    samples = samples_of_force(np.full(50, 280.0))
    for text in ("10", "a:b", "10:20:30", "plateaux", ""):
        with pytest.raises(ConfigurationError, match="T0:T1"):
            select_segment(samples, text, PlateauSettings())
    with pytest.raises(TrialError, match="0 samples"):
        select_segment(samples, "100:200", PlateauSettings())


def test_the_moving_mean_passes_over_nan_and_keeps_constants() -> None:
    values = np.full((50, 2), 3.0)
    values[10:13, 0] = np.nan
    values[20:45, 1] = np.nan
    mean = moving_mean(values, 7)
    assert np.allclose(mean[:, 0], 3.0)
    assert np.isnan(mean[30, 1]) and mean[0, 1] == pytest.approx(3.0)


# --- changes of a cluster, and the newest stretch


def with_cluster(samples: Samples, force: np.ndarray) -> Samples:
    """The samples with this normal force on their cluster, shape (N,) [N]."""
    local = np.zeros((len(samples), 1, 3))
    local[:, 0, 2] = -force
    return dataclasses.replace(samples, local_forces=local)


@pytest.mark.parametrize("missing", [0, 16])
def test_a_step_of_a_cluster_ends_a_plateau(missing: int) -> None:
    force = seconds((30, 10), (50, 18))
    samples = with_cluster(samples_of_force(seconds((80, 280))), force)
    samples.local_forces[120 : 120 + missing] = np.nan  # a gap hides no step
    settings = dataclasses.replace(PlateauSettings(), missing_fraction=0.5)
    longest, other = find_plateaus(samples, settings)
    assert longest.start >= 29.0 and other.end <= 31.0 + missing / RATE
    (left_out,) = find_plateaus(samples, settings, leave_out=("a.Fz",))
    assert left_out.end - left_out.start > 75.0


def test_a_drift_of_a_cluster_is_cut_where_it_exceeds_the_limit() -> None:
    force = 10 + 0.2 * np.arange(0, 100, 1 / RATE)  # 20 N in 100 s
    settings = PlateauSettings()
    plateaus = find_plateaus(with_cluster(samples_of_force(seconds((100, 280))), force), settings)
    for segment in plateaus:
        assert np.ptp(force[segment.rows]) <= settings.cluster_drift + 0.5
    assert plateaus


def test_a_cluster_out_of_its_range_or_dead_ends_no_plateau() -> None:
    samples = with_cluster(samples_of_force(seconds((80, 280))), seconds((40, 0), (40, 50)))
    samples.status[160:] = 3
    assert find_plateaus(samples, PlateauSettings())[0].end > 75.0
    samples.local_forces[:] = np.nan
    lenient = dataclasses.replace(PlateauSettings(), missing_fraction=0.5)
    assert find_plateaus(samples, lenient)[0].end > 75.0


def test_the_newest_stretches_come_first_and_end_at_their_newest_sample() -> None:
    samples = samples_of_force(seconds((60, 280), (20, 90)))
    newest, older = find_newest_plateaus(samples, PlateauSettings())
    assert newest.start >= 59.0 and newest.end == samples.time[-1]
    assert older.end - older.start > 55.0


def test_of_a_drift_the_newest_part_counts() -> None:
    drift = seconds((60, 200)) + np.maximum(0.0, np.arange(0, 60, 1 / RATE) - 30.0)  # [N]
    samples = samples_of_force(drift)
    longest = find_plateaus(samples, PlateauSettings())[0]
    (newest,) = find_newest_plateaus(samples, PlateauSettings())
    assert longest.end < 45.0 and newest.end == samples.time[-1]
    assert newest.cause == "Fz drifts"
    assert np.ptp(drift[newest.rows]) <= PlateauSettings().force_drift + 2.0


def test_a_stretch_names_the_channel_that_slipped_before_it_and_no_change_of_load() -> None:
    force = seconds((30, 10), (50, 18))
    slipped = with_cluster(samples_of_force(seconds((80, 280))), force)
    newest, older = find_newest_plateaus(slipped, PlateauSettings())
    assert newest.cause == "a.Fz changed by -8.0 N" and older.cause == ""
    loaded = with_cluster(samples_of_force(seconds((30, 150), (50, 280))), force)
    newest, older = find_newest_plateaus(loaded, PlateauSettings())
    assert newest.cause == older.cause == ""


def test_a_stretch_names_the_cluster_that_drifts() -> None:
    force = 10 + 0.2 * np.arange(0, 100, 1 / RATE)  # 20 N in 100 s
    samples = with_cluster(samples_of_force(seconds((100, 280))), force)
    (newest,) = find_newest_plateaus(samples, PlateauSettings())
    assert newest.cause == "a.Fz drifts" and newest.end == samples.time[-1]
