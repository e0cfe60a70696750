"""A trial on the page: what is shown of an instant is what the verbs say of it."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bags import add_events, rewrite
from support.tabs import LIVE_PAGE, Tab, served
from support.wording import refused

import socket_testbed as st
from socket_testbed.errors import TrialError
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.pages.player import Player
from socket_testbed.samples import Status
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial
from socket_testbed.wire.cdr import stamp_of

MEAN = "mean pressure [kPa]"


@dataclass
class Played:
    """A trial on the page, and what the verbs say of it."""

    trial: Trial
    player: Player
    predicted: np.ndarray
    estimate: MapEstimate

    def row(self, time: float) -> int:
        """The newest sample at a time [s]."""
        return int(np.flatnonzero(self.trial.samples().time <= time + 1e-6)[-1])

    def shown(self, time: float) -> dict[str, Any]:
        """What the page is sent of an instant [s]."""
        sent = json.dumps(self.player.now(time), allow_nan=False)
        found: dict[str, Any] = json.loads(sent)
        return found


@pytest.fixture(scope="module")
def played(hold: Path, hold_model: Path) -> Played:
    trial = st.open_trial(hold)
    predicted = st.predict(trial, hold_model).to_numpy()
    estimate = st.force_map(trial, "all").estimate
    return Played(trial, Player(trial, predicted), predicted, estimate)


at_times = pytest.mark.parametrize(
    "time", [0.0, 59.75, 12.34], ids=["first", "last", "between samples"]
)


@at_times
def test_the_map_shows_the_newest_estimate(time: float, played: Played) -> None:
    row, moment = played.row(time), played.shown(time)["moment"]
    assert moment["time"] == pytest.approx(played.trial.samples().time[row], abs=1e-3)
    estimate = played.estimate
    reach = 1.96 * estimate.normal_pressure_standard_deviation
    np.testing.assert_allclose(
        moment["pressure"], 1e-3 * estimate.normal_pressure[row], atol=5.1e-3
    )
    np.testing.assert_allclose(moment["reach"], 1e-3 * reach[row], atol=5.1e-3)
    np.testing.assert_allclose(moment["shear"], 1e-3 * estimate.shear[row], atol=5.1e-3)


@at_times
def test_the_map_is_greyer_where_intervals_reach_far(time: float, played: Played) -> None:
    moment = played.shown(time)["moment"]
    pressure, reach, grey = (np.array(moment[name]) for name in ("pressure", "reach", "grey"))
    doubt = reach / np.maximum(np.abs(pressure), 5.0) - 1.0
    np.testing.assert_allclose(grey, np.clip(doubt / 1.5, 0.0, 1.0), atol=0.02)


@at_times
def test_the_page_shows_what_clusters_measured(time: float, played: Played) -> None:
    samples, geometry = played.trial.samples(), played.trial.geometry
    tiles = [*geometry.clusters.values()]
    measured = -samples.local_forces[:, :, 2] / geometry.areas[tiles]
    found = played.shown(time)["moment"]["measured"]
    np.testing.assert_allclose(found, 1e-3 * measured[played.row(time)], atol=0.051)


@at_times
def test_the_page_shows_the_wrench_beside_its_prediction(time: float, played: Played) -> None:
    row, shown = played.row(time), played.shown(time)
    wrenches = [played.trial.samples().wrench[row], played.predicted[row, :6]]
    values = [list(map(float, cells[1:])) for cells in shown["wrench"][1:]]
    np.testing.assert_allclose(np.transpose(values), wrenches, atol=5.1e-3)


@at_times
def test_cards_show_the_pressure_of_the_verb(time: float, played: Played) -> None:
    row, shown = played.row(time), played.shown(time)
    at = float(played.trial.samples().time[row])
    span = Segment("span", at, at, slice(row, row + 1))
    found = st.pressure(played.trial, span).regions
    (peak, _, data), bars = shown["cards"], shown["bars"]
    assert peak["value"] == f"{found.loc['socket', 'peak pressure [kPa]']:.1f} kPa"
    assert data["value"] == "good"
    values = {title: [row[0] for row in rows] for title, rows in bars["values"].items()}
    integral = values.pop("pressure-time integral, whole trial [kPa s]")  # at 150 of 240 samples
    over_trial = st.pressure(played.trial, "all").regions["pressure-time integral [kPa s]"]
    np.testing.assert_allclose(integral, over_trial[bars["regions"]], rtol=0.02, atol=1.0)
    assert "contact area [cm^2]" in values
    for title, own in values.items():
        np.testing.assert_allclose(own, found.loc[bars["regions"], title], atol=0.051)


def test_a_peak_under_a_cluster_is_called_measured(played: Played) -> None:
    (peak, *_) = played.shown(12.34)["cards"]
    assert "measured by" in peak["words"]


def test_a_page_opens_at_the_course_s_peak(played: Played) -> None:
    start = played.player.start()
    course = start["course"]
    highest = int(np.argmax(course["peak"]))
    assert start["start"] == pytest.approx(course["time"][highest], abs=1e-3)
    assert np.all(np.diff([course["low"], course["peak"], course["high"]], axis=0) >= 0.0)


def test_a_peak_between_the_drawn_samples_is_found(hold: Path, monkeypatch) -> None:
    monkeypatch.setattr("socket_testbed.pages.player._COURSE_SAMPLES", 3)
    start = Player(st.open_trial(hold)).start()
    assert start["start"] == pytest.approx(st.pressure(hold, "all").peak_time)
    assert len(start["course"]["time"]) == 4


def test_a_peak_that_nothing_measured_is_called_estimated(hold: Path, played: Played) -> None:
    trial = st.open_trial(hold)
    trial.samples().status[:, trial.samples().clusters.index("distal")] = Status.MISSING
    (peak, *_) = Player(trial).now(played.player.start()["start"])["cards"]
    assert peak["words"] == "the distal end, estimated"


@pytest.fixture(scope="module")
def gappy(hold: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The hold without the samples around 26 s."""
    lost = range(*st.open_trial(hold).samples().stamps[[99, 107]].tolist())
    folder = tmp_path_factory.mktemp("gappy")
    return rewrite(hold, folder / "gappy", lambda _, m: None if stamp_of(m) in lost else m)


@pytest.fixture(scope="module")
def marked(gappy: Path, tmp_path_factory: pytest.TempPathFactory) -> Player:
    """The trial with a gap, with an event at 30 s."""
    folder = tmp_path_factory.mktemp("marked")
    return Player(add_events(gappy, folder / "marked", [("push", 30.0, 30.0)]))


def test_events_are_marks(marked: Player) -> None:
    (event,) = [e for e in marked.start()["course"]["events"] if e["label"] == "push"]
    assert event["time"] == pytest.approx(30.0, abs=0.3)


def test_nothing_is_shown_in_a_gap(marked: Player) -> None:
    shown = marked.now(26.2)
    assert "pressure" not in shown["moment"] and shown["cards"][0]["value"] == "none"
    assert "pressure" in marked.now(20.0)["moment"]


def test_no_map_is_given_in_a_gap(gappy: Path) -> None:
    with refused(TrialError, "no sample at 26.2 s"):
        st.force_map(gappy, "all").at(26.2)


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
