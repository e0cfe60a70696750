"""A tap in signals of which it is known."""

import numpy as np
import pytest
from support.wording import refused

from socket_testbed.alignment.align import Series
from socket_testbed.alignment.events import find_tap
from socket_testbed.alignment.series import ClusterSeries, PoseSeries, WrenchSeries
from socket_testbed.errors import TrialError

TAP = 4.321  # [s]


def bump(time: np.ndarray, at: float = TAP, span: float = 0.1) -> np.ndarray:
    """A tap of height 1: a rise within 10 ms, then a decay."""
    since = time - at
    return np.where(since < 0.0, 0.0, np.minimum(since / 0.01, 1.0) * np.exp(-since / span))


def sources(taps: tuple[float, ...] = (TAP,), seed: int = 0) -> dict[str, Series]:
    """A cell at 500 Hz, a body at 120 Hz and a cluster at 20 Hz that see taps and slow pushes."""
    random = np.random.default_rng(seed)
    found: dict[str, Series] = {}
    for name, rate, size, noise in (
        ("wrench", 500.0, 60.0, 0.2), ("pose", 120.0, 2e-3, 2e-5), ("cluster", 20.0, 0.05, 1e-4)
    ):  # fmt: skip
        time = np.arange(0.0, 30.0, 1.0 / rate)
        stamps = np.round(1e9 * time).astype(np.int64)
        pushes = 0.3 * np.sin(0.5 * (time - 10.0)) * (time > 10.0)
        course = size * (sum(bump(time, at) for at in taps) + pushes)
        values = course[:, None] * [0.2, 0.3, 1.0] + random.normal(0.0, noise, (len(time), 3))
        if name == "wrench":
            found[name] = WrenchSeries(stamps, np.hstack([0.0 * values, values]))
        elif name == "pose":
            turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))
            found[name] = PoseSeries(stamps, values, turns)
        else:
            found[name] = ClusterSeries(stamps, ("distal",), values[:, None, :])
    return found


@pytest.mark.parametrize(
    ("name", "step"), [("wrench", 0.002), ("pose", 1.0 / 120.0), ("cluster", 0.05)]
)
def test_a_tap_is_found_within_its_error(name: str, step: float) -> None:
    tap = find_tap(sources()[name])
    assert tap.error == pytest.approx(0.5 * step, rel=1e-3)
    assert abs(1e-9 * tap.time - TAP) <= tap.error + 0.002


@pytest.mark.parametrize("seed", range(5))
def test_the_offset_of_two_clocks(seed: int) -> None:
    own = sources(seed=seed)
    cell, body = find_tap(own["wrench"]), find_tap(own["pose"])
    assert abs(1e-9 * (cell.time - body.time)) <= cell.error + body.error


@pytest.mark.parametrize("name", ["wrench", "pose", "cluster"])
def test_two_taps_are_refused_until_a_span_is_stated(name: str) -> None:
    series = sources((TAP, 6.7))[name]
    with refused(TrialError, "several sharp rises, at 4.3", "--tap T0:T1"):
        find_tap(series)
    second = find_tap(series, (5.5, 30.0))
    assert abs(1e-9 * second.time - 6.7) <= second.error + 0.002


@pytest.mark.parametrize("name", ["wrench", "pose", "cluster"])
def test_no_tap_is_no_event(name: str) -> None:
    with refused(TrialError, "sees no tap"):
        find_tap(sources(())[name])


def test_a_span_without_readings() -> None:
    with refused(TrialError, "holds 0 readings"):
        find_tap(sources()["pose"], (40.0, 50.0))


def test_missing_readings_do_not_matter() -> None:
    """A body that is not seen for a while, not at the tap."""
    whole = sources()["pose"]
    positions = whole.positions.copy()
    positions[1000:1200] = np.nan
    tap = find_tap(PoseSeries(whole.times, positions, whole.quaternions))
    assert abs(1e-9 * tap.time - TAP) <= tap.error + 0.002


def test_coarse_readings_have_a_tap_too() -> None:
    """Readings in steps of 1 N, most equal to the ones before."""
    whole = sources()["wrench"]
    values = np.round(whole.values)
    tap = find_tap(WrenchSeries(whole.times, values))
    assert abs(1e-9 * tap.time - TAP) <= 0.005
