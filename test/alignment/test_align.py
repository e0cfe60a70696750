"""Values at triggers from sources that know none, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from socket_testbed.alignment.align import Aligned, SourceBuffer, align
from socket_testbed.alignment.series import ClusterSeries, PoseSeries, WrenchSeries
from socket_testbed.alignment.triggers import triggers_at
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.samples import Status
from socket_testbed.settings.alignment import SourceSettings

MS = 1_000_000  # [ns]
START = 1_700_000_000_000_000_000  # [ns]
FORCE = [1.0, 2.0, 3.0, 5.0, 9.0, 7.0]  # [N]; at 0, 10, ..., 50 ms
NAN = float("nan")


def times(*milliseconds: float) -> np.ndarray:
    return START + np.round(np.array(milliseconds) * MS).astype(np.int64)


def wrenches(*forces: float, step: float = 10.0) -> WrenchSeries:
    """Wrenches whose six values are 1 to 6 times a force."""
    values = np.outer(forces, np.arange(1.0, 7.0))
    return WrenchSeries(times(*(step * np.arange(len(forces)))), values)


def force(found: Aligned) -> list[float]:
    """The first value of each wrench, of which the others are multiples."""
    np.testing.assert_allclose(found.values, np.outer(found.values[:, 0], np.arange(1.0, 7.0)))
    return found.values[:, 0].tolist()


@pytest.mark.parametrize(
    ("settings", "trigger", "expected"),
    [
        # The line through (-10, 2), (0, 3), (10, 5): its mean 10 / 3 at the middle.
        (SourceSettings(window=0.02), 20.0, 10.0 / 3.0),
        # Through (-12, 2), (-2, 3), (8, 5): the mean 10 / 3 and 0.15 / ms over 2 ms.
        (SourceSettings(window=0.024), 22.0, 10.0 / 3.0 + 0.3),
        (SourceSettings(window=0.0), 22.0, 3.4),
        (SourceSettings(window=0.0), 20.0, 3.0),
        (SourceSettings(window=0.0, delay=0.008), 14.0, 3.4),
        (SourceSettings(window=0.0, delay=-0.008), 30.0, 3.4),
        (SourceSettings(window=0.024, method="mean"), 22.0, 10.0 / 3.0),
        (SourceSettings(method="last"), 22.0, 3.0),
        (SourceSettings(method="last"), 20.0, 3.0),
        (SourceSettings(method="last", delay=0.008), 22.0, 5.0),
        # A single reading in the window: between two readings.
        (SourceSettings(window=0.006), 22.0, 3.4),
    ],
    ids=[
        *("centred", "beside", "between", "at one", "delay", "early", "mean", "last"),
        *("last at one", "last with delay", "short window"),
    ],
)
def test_value_at_a_trigger(settings: SourceSettings, trigger: float, expected: float) -> None:
    found = align(wrenches(*FORCE), times(trigger), settings)
    assert force(found) == pytest.approx([expected])
    assert found.status.tolist() == [Status.OK]


def test_a_line_keeps_up_with_steady_motion() -> None:
    """Without the readings before the trigger a mean would lag by half of the window."""
    steady = wrenches(*np.arange(11.0))
    lost = WrenchSeries(steady.times[[3, 5, 6, 7]], steady.values[[3, 5, 6, 7]])
    settings = SourceSettings(window=0.06, stale=0.02)
    assert force(align(lost, times(50.0), settings)) == pytest.approx([5.0])
    mean = align(lost, times(50.0), replace(settings, method="mean"))
    assert force(mean) == pytest.approx([5.25])


def test_what_went_in_is_told() -> None:
    found = align(wrenches(*FORCE), times(22.0), SourceSettings(window=0.024))
    assert found.count.tolist() == [3]
    np.testing.assert_allclose(found.age, [0.002], atol=1e-9)  # readings at 10, 20 and 30 ms
    np.testing.assert_allclose(found.spread, [0.020])
    # Residuals of 2, 3, 5 about their line are 1/6, -1/3, 1/6, with one degree of freedom.
    np.testing.assert_allclose(found.deviation[0], np.sqrt(1.0 / 6.0) * np.arange(1.0, 7.0))


def test_age_is_corrected_for_the_delay() -> None:
    found = align(wrenches(*FORCE), times(22.0), SourceSettings(method="last", delay=0.005))
    np.testing.assert_allclose(found.age, [0.007], atol=1e-9)  # stamped 20 ms, measured at 15 ms


def test_deviation_about_a_mean() -> None:
    found = align(wrenches(*FORCE), times(20.0), SourceSettings(window=0.02, method="mean"))
    # 2, 3, 5 about 10 / 3: squares 16 / 9, 1 / 9, 25 / 9, with two degrees of freedom.
    assert found.deviation[0, 0] == pytest.approx(np.sqrt(42.0 / 9.0 / 2.0))


@pytest.mark.parametrize(
    ("settings", "trigger"),
    [
        (SourceSettings(), -1.0),
        (SourceSettings(), 51.0),
        (SourceSettings(stale=0.009), 22.0),
        (SourceSettings(method="last"), -1.0),
        (SourceSettings(method="last", stale=0.004), 25.0),
        (SourceSettings(method="mean", window=0.004), 25.0),
        (SourceSettings(delay=0.1), 22.0),
    ],
    ids=["before", "after", "apart", "last before", "last stale", "mean of none", "delay"],
)
def test_too_little_is_missing(settings: SourceSettings, trigger: float) -> None:
    found = align(wrenches(*FORCE), times(trigger), settings)
    assert found.status.tolist() == [Status.MISSING]
    assert np.isnan(found.values).all() and found.count.tolist() == [0]
    assert np.isnan(found.age).all() and np.isnan(found.spread).all()


def test_a_mean_needs_half_its_readings() -> None:
    series = wrenches(*np.ones(20), step=1.0)
    kept = [*range(4), 8, 9, *range(14, 20)]
    series = WrenchSeries(series.times[kept], series.values[kept])
    settings = SourceSettings(method="mean", window=0.004)
    found = align(series, times(2.0, 9.0, 11.5, 16.0), settings)
    assert found.status.tolist() == [0, 0, 2, 0]  # 4, 2, none and 4 readings of 4


def test_readings_with_a_gap_do_not_count() -> None:
    series = wrenches(*FORCE)
    series.values[2, 4] = NAN
    found = align(series, times(22.0), SourceSettings(window=0.0))
    assert force(found) == pytest.approx([2.0 + 0.6 * 3.0])  # between 10 and 30 ms


def test_a_dead_channel_leaves_the_others() -> None:
    series = wrenches(*FORCE)
    series.values[:, 2] = NAN
    found = align(series, times(20.0), SourceSettings(window=0.0))
    np.testing.assert_allclose(found.values, [[3.0, 6.0, NAN, 12.0, 15.0, 18.0]])
    assert found.status.tolist() == [Status.OK]


def test_the_window_follows_the_trigger() -> None:
    found = align(wrenches(*np.arange(60.0)), times(100.0, 140.0, 180.0), SourceSettings())
    assert found.count.tolist() == [5, 5, 5]  # 40 ms of readings every 10 ms
    found = align(wrenches(*np.arange(60.0)), times(250.0), SourceSettings(), period=2.0)
    assert found.count.tolist() == [25]  # 0.25 s at most


def about_z(*degrees: float) -> np.ndarray:
    half = 0.5 * np.radians(degrees)
    return np.column_stack([0.0 * half, 0.0 * half, np.sin(half), np.cos(half)])


def test_a_pose_is_the_mean_of_poses() -> None:
    """Signs and lengths of quaternions are free."""
    turns = about_z(10.0, 20.0, 60.0) * np.array([[1.0], [-1.0], [3.0]])
    places = np.array([[0.0, 1.0, 0.0], [0.0, 2.0, 0.0], [3.0, 6.0, 0.0]])
    series = PoseSeries(times(0.0, 10.0, 20.0), places, turns)
    found = align(series, times(10.0), SourceSettings(window=0.02, method="mean"))
    np.testing.assert_allclose(found.values[0, :3], [1.0, 3.0, 0.0])
    turned = found.values[0, 3:] * np.sign(found.values[0, 6])
    np.testing.assert_allclose(turned, about_z(30.0)[0], atol=1e-12)
    assert found.deviation.shape == (1, 3)


def test_a_pose_between_two_turns_evenly() -> None:
    series = PoseSeries(times(0.0, 10.0), np.zeros((2, 3)), about_z(0.0, 80.0))
    found = align(series, times(2.5), SourceSettings())
    np.testing.assert_allclose(found.values[0, 3:], about_z(20.0)[0], atol=1e-12)


@pytest.mark.parametrize("broken", [0.0, NAN], ids=["zero", "unknown"])
def test_a_pose_without_rotation_does_not_count(broken: float) -> None:
    turns = about_z(0.0, 0.0, 80.0)
    turns[1] = broken
    series = PoseSeries(times(0.0, 10.0, 20.0), np.zeros((3, 3)), turns)
    found = align(series, times(10.0), SourceSettings(window=0.0))
    np.testing.assert_allclose(found.values[0, 3:], about_z(40.0)[0], atol=1e-12)


def test_clusters_are_aligned_each() -> None:
    values = np.arange(24.0).reshape(3, 2, 4)  # [pF]; a reading is 8 above the one before
    values[1, 1] = NAN
    series = ClusterSeries(times(0.0, 50.0, 100.0), ("a", "b"), values)
    found = align(series, times(60.0), SourceSettings(method="last"))
    assert found.values[0, 0].tolist() == [8.0, 9.0, 10.0, 11.0]
    assert found.values[0, 1].tolist() == [4.0, 5.0, 6.0, 7.0]
    np.testing.assert_allclose(found.age, [[0.010, 0.060]])
    assert found.status.tolist() == [[0, 0]]
    found = align(series, times(60.0), SourceSettings(method="last", stale=0.05))
    assert found.status.tolist() == [[0, 2]]
    assert np.isnan(found.values[0, 1]).all()


def test_a_series_without_readings_is_missing() -> None:
    found = align(wrenches(), times(0.0, 1.0), SourceSettings())
    assert found.status.tolist() == [2, 2] and found.values.shape == (2, 6)
    assert align(wrenches(*FORCE), times(), SourceSettings()).values.shape == (0, 6)


@pytest.mark.parametrize("method", ["line", "mean", "last"])
def test_a_buffer_gives_the_same_values(method: str) -> None:
    """Readings are dropped when they are old, and triggers are asked for once they are ready."""
    random = np.random.default_rng(1)
    series = PoseSeries(
        times(*(4.5 * np.arange(2000.0) + random.uniform(0.0, 4.0, 2000))),
        random.normal(size=(2000, 3)),
        random.normal(size=(2000, 4)),
    )
    settings = SourceSettings(method=method, delay=0.013, window=0.03, stale=0.1)
    triggers = times(*np.arange(100.0, 8900.0, 250.0))
    found = align(series, triggers, settings, 0.25)
    buffer = SourceBuffer(settings, PoseSeries(times(), np.empty((0, 3)), np.empty((0, 4))))
    left = [*triggers.tolist()]
    answers = []
    for row in range(2000):
        buffer.add(series.times[row], series.positions[row], series.quaternions[row])
        while left and buffer.ready(left[0], 0.25):
            answers.append(buffer.at(left.pop(0), 0.25))
    assert not left and len(buffer) < 1900
    np.testing.assert_allclose(np.vstack([a.values for a in answers]), found.values, rtol=1e-9)
    np.testing.assert_array_equal(np.hstack([a.count for a in answers]), found.count)


def test_a_buffer_puts_readings_in_their_place() -> None:
    """A late reading goes before the newest; of two with one stamp the later one counts."""
    buffer = SourceBuffer(SourceSettings(), wrenches())
    late = [
        buffer.add(int(times(moment)[0]), np.full(6, value))
        for moment, value in ((5.0, 1.0), (9.0, 2.0), (7.0, 3.0), (5.0, 4.0), (9.0, 5.0))
    ]
    assert late == [0, 0, 2_000_000, 4_000_000, 0]
    np.testing.assert_array_equal(buffer.series.times, times(5.0, 7.0, 9.0))
    assert buffer.series.values[:, 0].tolist() == [4.0, 3.0, 5.0]


def test_triggers_span_what_all_share() -> None:
    sources = {"wrench": wrenches(*np.zeros(101)), "pose": wrenches(*np.zeros(51))}
    found = triggers_at(4.0, sources, {"pose": -0.2})  # 0.2 to 0.7 s of 0 to 1 s
    np.testing.assert_array_equal(found, times(200.0, 450.0, 700.0))


@pytest.mark.parametrize(
    ("shift", "rate", "words"),
    [
        (1500.0, 4.0, "the pose starts 0.5 s after the wrench ends: check the clocks"),
        (900.0, 4.0, "the pose and the wrench share 0.1 s, too little at 4 Hz"),
    ],
    ids=["apart", "little"],
)
def test_triggers_need_a_common_time(shift: float, rate: float, words: str) -> None:
    pose = wrenches(*np.zeros(101))
    moved = WrenchSeries(pose.times + int(shift * MS), pose.values)
    with pytest.raises(TrialError) as error:
        triggers_at(rate, {"the wrench": pose, "the pose": moved})
    assert words in str(error.value)


def test_an_empty_source_is_named() -> None:
    with pytest.raises(TrialError, match="the wrench has no reading: choose another source"):
        triggers_at(4.0, {"the wrench": wrenches()})


@pytest.mark.parametrize(
    ("values", "words"),
    [({"delay": 11.0}, "delay"), ({"method": "nearest"}, "method"), ({"window": NAN}, "window")],
    ids=["delay", "method", "window"],
)
def test_settings_have_limits(values: dict, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        SourceSettings(**values)
