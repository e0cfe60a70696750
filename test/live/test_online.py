import numpy as np
import pytest

from socket_testbed.live.estimator import Sample, SampleWindow, StampSynchroniser


def sample(stamp: int) -> Sample:
    return Sample(stamp, np.zeros(3), np.zeros(6), np.zeros((2, 3)), np.zeros(2, dtype=np.uint8))


def test_measurements_of_a_stamp_come_together_whatever_their_order() -> None:
    rng = np.random.default_rng(0)
    arrivals = [(kind, stamp) for kind in "abc" for stamp in range(50)]
    rng.shuffle(arrivals)
    synchroniser = StampSynchroniser(("a", "b", "c"), pending=50)
    complete = {}
    for kind, stamp in arrivals:
        entry = synchroniser.add(kind, int(stamp), f"{kind}{stamp}")
        if entry is not None:
            complete[int(stamp)] = entry
    assert complete == {s: {k: f"{k}{s}" for k in "abc"} for s in range(50)}
    assert synchroniser.incomplete == 0


def test_nothing_is_matched_by_nearest() -> None:
    synchroniser = StampSynchroniser(("a", "b"), pending=10)
    assert synchroniser.add("a", 1_000_000_000, 0) is None
    assert synchroniser.add("b", 1_000_000_001, 0) is None


def test_what_stays_incomplete_is_counted_and_forgotten() -> None:
    synchroniser = StampSynchroniser(("a", "b"), pending=3)
    for stamp in range(10):
        synchroniser.add("a", stamp, None)
    assert synchroniser.incomplete == 7
    assert synchroniser.add("b", 0, None) is None  # too late
    assert synchroniser.add("b", 9, None) is not None


def test_clear_forgets_what_is_pending() -> None:
    synchroniser = StampSynchroniser(("a", "b"), pending=3)
    synchroniser.add("a", 1, None)
    synchroniser.clear()
    assert synchroniser.add("b", 1, None) is None


def test_the_window_keeps_its_duration_in_the_order_of_stamps() -> None:
    window = SampleWindow(("p", "q"), duration=2.0)
    for seconds in (0.0, 1.0, 3.0, 2.5):
        window.add(sample(round(seconds * 1e9)))
    assert (window.samples().stamps * 1e-9).tolist() == [1.0, 2.5, 3.0]


def test_a_long_window_holds_what_a_list_would() -> None:
    rng = np.random.default_rng(0)
    window, stamps = SampleWindow(("p", "q"), duration=3.0), []
    for k in range(2000):
        stamp = round(k * 1e7 * (1.0 + (k > 700)))  # at 100 Hz, then at 50 Hz
        entry = Sample(
            stamp,
            rng.normal(size=3),
            np.full(6, float(stamp)),
            rng.normal(size=(2, 3)),
            np.array([k % 4, 0], dtype=np.uint8),
        )
        window.add(entry)
        stamps = [s for s in [*stamps, stamp] if s >= stamp - 3_000_000_000]
        assert len(window) == len(stamps)
    samples = window.samples()
    assert samples.stamps.tolist() == stamps
    assert samples.wrench[:, 0].tolist() == stamps
    assert samples.status[-1].tolist() == [1999 % 4, 0]
    window.clear()
    assert len(window) == len(window.samples()) == 0


@pytest.mark.parametrize("count", [0, 1, 5])
def test_the_shapes_of_a_window_hold_for_any_number(count: int) -> None:
    window = SampleWindow(("p", "q"), duration=2.0)
    for stamp in range(count):
        window.add(sample(stamp))
    samples = window.samples()
    assert samples.position.shape == (count, 3)
    assert samples.local_forces.shape == (count, 2, 3)
    assert samples.status.shape == (count, 2)
