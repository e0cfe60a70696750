"""Cycles of a trial against series whose mean and spread over a cycle are known."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.bags import add_events

import socket_testbed as st
from socket_testbed.trials.trial import Trial

STEPS = np.array([5.0, 8.0, 11.5, 14.0, 17.0, 20.0, 40.0, 43.0])  # [s]; a pause of 20 s


@pytest.fixture(scope="module")
def walk(hold: Path, tmp_path_factory: pytest.TempPathFactory) -> Trial:
    """The hold with marked steps, each with a push-off 1.8 s later."""
    marks = [("step", at, at) for at in STEPS] + [("off", at + 1.8, at + 1.8) for at in STEPS]
    path = tmp_path_factory.mktemp("walk") / "walk"
    add_events(hold, path, sorted(marks, key=lambda mark: mark[2]))
    return st.open_trial(path)


def series(spans: np.ndarray, rate: float = 200.0) -> pd.DataFrame:
    """A sine and a ramp over each cycle; each sine is higher by one than that before it."""
    time = np.arange(0.0, 60.0, 1 / rate)
    cycle = np.clip(np.searchsorted(spans[:, 0], time, side="right") - 1, 0, len(spans) - 1)
    phase = (time - spans[cycle, 0]) / np.diff(spans, axis=1)[cycle, 0]
    columns = {"sine [kPa]": np.sin(np.pi * phase) ** 2 + cycle, "ramp [-]": phase}
    return pd.DataFrame(columns, index=pd.Index(time, name="time [s]"))


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    """The series over the steps, without 20 to 40 % of the second ramp."""
    table = series(np.column_stack([STEPS[:-1], STEPS[1:]]))
    table.loc[8.7:9.4, "ramp [-]"] = np.nan
    return table


def test_mean_over_cycles_is_known(walk: Trial, table: pd.DataFrame) -> None:
    """And so is the standard deviation."""
    cycles = st.cycles(walk, table, by="step")
    assert len(cycles) == 6 and cycles.left_out == 1 and cycles.titles == (*table,)
    assert str(cycles).endswith("; 1 left out, longer than twice the median")
    np.testing.assert_allclose(cycles.durations, [3, 3.5, 2.5, 3, 3, 3])
    found = cycles.to_dataframe()
    percent = found.index.to_numpy()
    assert found.index.name == "cycle [%]" and len(found) == 101
    inner = slice(1, -1)  # at its ends a cycle meets its neighbour
    offsets = np.array([0, 1, 2, 3, 4, 6])  # the pause is number 5
    expected = np.sin(np.pi * percent / 100) ** 2 + offsets.mean()
    assert np.allclose(found["sine mean [kPa]"].iloc[inner], expected[inner], atol=2e-4)
    assert np.allclose(found["sine sd [kPa]"].iloc[inner], offsets.std(ddof=1), atol=2e-4)
    assert np.allclose(found["ramp mean [-]"].iloc[inner], percent[inner] / 100, atol=1e-3)
    assert found["ramp n [-]"].min() == 5 and (found["sine n [-]"] == 6).all()


def test_no_line_is_drawn_across_a_gap(walk: Trial, table: pd.DataFrame) -> None:
    torn = table[(table.index < 15.0) | (table.index > 15.9)]
    assert st.cycles(walk, torn, by="step").to_dataframe()["sine n [-]"].min() == 5


def test_two_cycles_make_no_band(walk: Trial, table: pd.DataFrame) -> None:
    two = st.cycles(walk, table, by="step", segment="4:12")
    assert len(two) == 2
    assert np.isnan(two.deviation).all() and np.isfinite(two.mean).all()


def test_cycles_between_two_events_end_at_the_second(walk: Trial) -> None:
    notes: list[str] = []
    trial = st.open_trial(walk.path, notify=notes.append)
    found = st.cycles(trial, ["Fz", "distal.Fx [N]"], by="step:off", segment="0:30")
    assert found.titles == ("Fz [N]", "distal.Fx [N]")  # named with or without the unit
    assert len(found) == 6 and np.allclose(found.durations, 1.8)
    samples = walk.samples()
    expected = np.interp(STEPS[:6], samples.time, samples.wrench[:, 5])
    assert np.allclose(found.curves[:, 0, 0], expected)
    assert any("has 8 samples" in note and "higher rate" in note for note in notes)
