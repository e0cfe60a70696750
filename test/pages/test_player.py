"""A trial on the page: what is shown of an instant is what the verbs say of it."""

from __future__ import annotations

import http.client
import json
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from support import HANGS
from support.bags import add_events, rewrite
from support.wording import refused

import socket_testbed as st
from socket_testbed.errors import TestbedError
from socket_testbed.pages.player import Player
from socket_testbed.trials.segment import Segment


@pytest.fixture(scope="module")
def played(hold: Path, hold_model: Path) -> Player:
    return Player(st.open_trial(hold), st.read_model(hold_model))


def test_an_instant_is_that_of_the_verbs(played: Player, hold: Path, hold_model: Path) -> None:
    trial = st.open_trial(hold)
    samples, estimate = trial.samples(), st.force_map(trial, "all").estimate
    predicted = st.predict(trial, hold_model).to_numpy()
    for time in (0.0, 12.34, 59.75):
        row = int(np.flatnonzero(samples.time <= time + 1e-6)[-1])
        shown = json.loads(json.dumps(played.now(time), allow_nan=False))
        moment = shown["moment"]
        assert moment["time"] == pytest.approx(samples.time[row], abs=1e-3)
        for name, known in (
            ("pressure", estimate.normal_pressure),
            ("deviation", estimate.normal_pressure_standard_deviation),
            ("shear", estimate.shear),
        ):
            np.testing.assert_allclose(moment[name], 1e-3 * known[row], atol=5.1e-3)
        np.testing.assert_allclose(shown["wrench"][0], samples.wrench[row], atol=5.1e-3)
        np.testing.assert_allclose(shown["wrench"][1], predicted[row, :6], atol=5.1e-3)
        tiles = [*trial.geometry.clusters.values()]
        measured = -samples.local_forces[row, :, 2] / trial.geometry.areas[tiles]
        np.testing.assert_allclose(moment["measured"], 1e-3 * measured, atol=0.051)


def test_cards_bars_and_course_are_those_of_pressure(played: Player, hold: Path) -> None:
    trial = st.open_trial(hold)
    at, start = 15.0, played.start()
    row = int(np.flatnonzero(trial.samples().time <= at + 1e-6)[-1])
    found = st.pressure(trial, Segment("span", at, at, slice(row, row + 1))).regions
    shown = played.now(at)
    peak, elsewhere, data = shown["cards"]
    for card, region in ((peak, "socket"), (elsewhere, "unmeasured wall")):
        row = found.loc[region]
        assert card["value"] == f"{row['peak pressure [kPa]']:.1f} kPa"
        low, high = (row[f"peak pressure {end} [kPa]"] for end in ("low", "high"))
        assert card["interval"] == f"{low:.1f} to {high:.1f}"
    assert "measured by" in peak["words"] and data["value"] == "good"
    bars = shown["bars"]
    assert bars["regions"][-1] == "socket" and "anterior proximal" not in bars["regions"]
    for title, rows in bars["values"].items():
        values = [row[0] for row in rows]
        np.testing.assert_allclose(values, found.loc[bars["regions"], title], atol=0.051)
    course = start["course"]
    highest = int(np.argmax(course["peak"]))
    assert start["start"] == pytest.approx(course["time"][highest], abs=1e-3)
    assert all(low <= value <= high for low, value, high in zip(
        course["low"], course["peak"], course["high"], strict=True
    ))  # fmt: skip


def test_events_are_marks_and_nothing_is_shown_in_a_gap(hold: Path, tmp_path: Path) -> None:
    count = 0

    def spoil(topic: str, message):
        nonlocal count
        count += topic == "/trigger"
        return None if 100 <= count < 108 else message

    path = rewrite(hold, tmp_path / "gappy", spoil)
    played = Player(add_events(path, tmp_path / "marked", [("push", 30.0, 30.0)]))
    (event,) = [e for e in played.start()["course"]["events"] if e["label"] == "push"]
    assert event["time"] == pytest.approx(30.0, abs=0.3)
    shown = played.now(26.2)
    assert "pressure" not in shown["moment"] and shown["cards"][0]["value"] == "none"
    assert "pressure" in played.now(20.0)["moment"]
    with refused(TestbedError, "cannot tare", "running testbed"):
        played.act("tare", {})


def test_a_trial_s_page_may_be_called_by_further_names(hold: Path) -> None:
    with st.view(st.open_trial(hold), names=("lab-pi",)) as page:
        assert page.url in repr(page)
        address = urlsplit(page.url)
        for name, status in (("lab-pi", 200), ("elsewhere", 403)):
            connection = http.client.HTTPConnection("127.0.0.1", address.port, timeout=HANGS)
            connection.request("GET", "/start", headers={"Host": f"{name}:{address.port}"})
            assert connection.getresponse().status == status
            connection.close()
