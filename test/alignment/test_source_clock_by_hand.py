"""A source's clock against that of the recording: when it counts as another, and in words."""

import numpy as np
import pytest

from socket_testbed.alignment.source_clock import SourceClock, source_clock

START = 1_700_000_000_000_000_000  # [ns]


def clock_of(offset: float, drift: float, duration: float = 100.0) -> SourceClock:
    """Of a message each 0.1 s, whose way takes no time: stamps are late by offset and drift [s]."""
    since = np.arange(0.0, duration + 0.05, 0.1)
    stamps = START + np.round(1e9 * since).astype(np.int64)
    return source_clock(stamps, stamps + np.round(1e9 * (offset + drift * since)).astype(np.int64))


@pytest.mark.parametrize(
    ("offset", "drift", "is_another"),
    [
        *[(0.49, 0.0, False), (0.51, 0.0, True), (-0.49, 0.0, False), (-0.51, 0.0, True)],
        *[(0.0, 39e-6, False), (0.0, 41e-6, True), (0.0, -39e-6, False), (0.0, -41e-6, True)],
    ],
    ids=["slow", "too slow", "fast", "too fast", "drifts", "drifts far", "gains", "gains far"],
)
def test_half_a_second_or_four_milliseconds(offset: float, drift: float, is_another: bool) -> None:
    """In 100 s a drift of 40 us/s makes 4 ms."""
    found = clock_of(offset, drift)
    assert found.is_another == is_another
    assert found.duration == pytest.approx(100.0)


@pytest.mark.parametrize(
    ("offset", "drift", "words"),
    [
        (0.3, 120e-6, "+0.300 s behind at first, then +120 us more each second"),
        (-3600.0, -45e-6, "-3600.000 s behind at first, then -45 us more each second"),
    ],
    ids=["slow", "fast"],
)
def test_a_clock_is_told_in_seconds_and_microseconds(
    offset: float, drift: float, words: str
) -> None:
    assert str(clock_of(offset, drift)) == words


@pytest.mark.parametrize("duration", [31.0, 100.0], ids=["three blocks and a part", "ten blocks"])
def test_stamps_are_moved_by_offset_and_drift(duration: float) -> None:
    """After 50 s the offset of 0.3 s has grown by 6 ms."""
    found = clock_of(0.3, 120e-6, duration)
    moved = found.to_recording(np.array([START, START + 50_000_000_000])) - START
    np.testing.assert_allclose(moved, [300_000_000, 50_306_000_000], atol=20_000)


def test_a_clock_that_was_set_meanwhile_has_no_drift() -> None:
    """3 ms in each second is no drift; the offset is that of the middle."""
    found = clock_of(0.0, 3e-3)
    assert found.drift == 0.0 and found.offset == pytest.approx(0.15, abs=0.01)


def test_jitter_is_the_usual_departure_from_the_line() -> None:
    """One message of two arrives 4 ms later than the quickest."""
    since = np.arange(0.0, 100.0, 0.1)
    stamps = START + np.round(1e9 * since).astype(np.int64)
    late = np.where(np.arange(len(since)) % 4 == 0, 0, 4_000_000) + np.round(1e5 * since)
    found = source_clock(stamps, stamps + late.astype(np.int64))
    assert found.jitter == pytest.approx(0.004, abs=1e-4)
    assert found.drift == pytest.approx(1e-4, abs=1e-6)
