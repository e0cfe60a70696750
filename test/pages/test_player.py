"""A trial on the page: what is shown of an instant is what the verbs say of it."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.bags import add_events, rewrite
from support.tabs import LIVE_PAGE, Tab, served
from support.wording import refused

import socket_testbed as st
from socket_testbed.errors import TrialError
from socket_testbed.pages.player import Player
from socket_testbed.samples import Status
from socket_testbed.trials.cdr import stamp_of
from socket_testbed.trials.segment import Segment

MEAN = "mean pressure [kPa]"


def test_an_instant_is_that_of_the_verbs(hold: Path, hold_model: Path) -> None:
    trial = st.open_trial(hold)
    played = Player(trial, st.predict(trial, hold_model).to_numpy())
    samples, estimate = trial.samples(), st.force_map(trial, "all").estimate
    predicted, tiles = st.predict(trial, hold_model).to_numpy(), [*trial.geometry.clusters.values()]
    measured = -samples.local_forces[:, :, 2] / trial.geometry.areas[tiles]
    for time in (0.0, 59.75, 12.34):
        row = int(np.flatnonzero(samples.time <= time + 1e-6)[-1])
        shown = json.loads(json.dumps(played.now(time), allow_nan=False))
        moment = shown["moment"]
        assert moment["time"] == pytest.approx(samples.time[row], abs=1e-3)
        reach = 1.96 * estimate.normal_pressure_standard_deviation
        known = {"pressure": estimate.normal_pressure, "reach": reach, "shear": estimate.shear}
        for name, values in known.items():
            np.testing.assert_allclose(moment[name], 1e-3 * values[row], atol=5.1e-3)
        pressure, reach, grey = (np.array(moment[name]) for name in ("pressure", "reach", "grey"))
        doubt = reach / np.maximum(np.abs(pressure), 5.0) - 1.0
        np.testing.assert_allclose(grey, np.clip(doubt / 1.5, 0.0, 1.0), atol=0.02)
        np.testing.assert_allclose(moment["measured"], 1e-3 * measured[row], atol=0.051)
        wrenches = [samples.wrench[row], predicted[row, :6]]
        values = [list(map(float, cells[1:])) for cells in shown["wrench"][1:]]
        np.testing.assert_allclose(np.transpose(values), wrenches, atol=5.1e-3)
    span = Segment("span", time, time, slice(row, row + 1))
    found = st.pressure(trial, span).regions
    (peak, _, data), bars = shown["cards"], shown["bars"]
    assert peak["value"] == f"{found.loc['socket', 'peak pressure [kPa]']:.1f} kPa"
    assert "measured by" in peak["words"] and data["value"] == "good"
    for title, rows in bars["values"].items():
        values = [row[0] for row in rows]
        np.testing.assert_allclose(values, found.loc[bars["regions"], title], atol=0.051)
    start, course = played.start(), played.start()["course"]
    highest = int(np.argmax(course["peak"]))
    assert start["start"] == pytest.approx(course["time"][highest], abs=1e-3)
    assert np.all(np.diff([course["low"], course["peak"], course["high"]], axis=0) >= 0.0)


def test_a_page_opens_at_the_peak_between_the_drawn_samples(hold: Path, monkeypatch) -> None:
    monkeypatch.setattr("socket_testbed.pages.player._COURSE_SAMPLES", 3)
    start = Player(st.open_trial(hold)).start()
    assert start["start"] == pytest.approx(st.pressure(hold, "all").peak_time)
    assert len(start["course"]["time"]) == 4
    trial = st.open_trial(hold)
    trial.samples().status[:, trial.samples().clusters.index("distal")] = Status.MISSING
    (peak, *_) = Player(trial).now(start["start"])["cards"]
    assert "distal, estimated" in peak["words"]  # its cluster measured nothing


def test_events_are_marks_and_nothing_is_shown_in_a_gap(hold: Path, tmp_path: Path) -> None:
    lost = range(*st.open_trial(hold).samples().stamps[[99, 107]].tolist())
    path = rewrite(hold, tmp_path / "gappy", lambda _, m: None if stamp_of(m) in lost else m)
    played = Player(add_events(path, tmp_path / "marked", [("push", 30.0, 30.0)]))
    (event,) = [e for e in played.start()["course"]["events"] if e["label"] == "push"]
    assert event["time"] == pytest.approx(30.0, abs=0.3)
    with refused(TrialError, "no sample at 26.2 s"):
        st.force_map(path, "all").at(26.2)
    shown = played.now(26.2)
    assert "pressure" not in shown["moment"] and shown["cards"][0]["value"] == "none"
    assert "pressure" in played.now(20.0)["moment"]


def test_page_opens_at_the_peak_and_jumps(hold: Path) -> None:
    player = Player(st.open_trial(hold))
    tab = Tab(LIVE_PAGE, served(player))
    peak = player.start()["start"]
    for time in (peak, peak - 5.0):
        shown = player.now(time)
        assert tab.text("#when") == f"at {shown['moment']['time']:.2f} s"
        assert tab.texts("strong")[:3] == [card["value"] for card in shown["cards"]]
        assert f"<b>peak {max(shown['moment']['pressure']):.1f}</b>" in tab.picture("#map").notes
        assert tab.rows("#wrench") == shown["wrench"]
        assert tab.texts(".said")[0].startswith(f"{shown['bars']['values'][MEAN][0][0]:.1f} (")
        tab.press("ArrowLeft")
        tab.wait(0.2)
