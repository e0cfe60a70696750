"""A trial that is played: what the page shows of an instant is what the verbs say of it."""

import dataclasses
import http.client
import shutil
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from support import HANGS
from support.bags import add_events, rewrite
from support.clocks import FakeClock
from support.wording import refused

import socket_testbed as st
from socket_testbed.errors import TestbedError
from socket_testbed.identification.pressure import read_column
from socket_testbed.samples import Status
from socket_testbed.viewer import player as playing
from socket_testbed.viewer.player import Player
from socket_testbed.viewer.source import Playback


def test_the_position_follows_play_pause_seek_and_speed() -> None:
    watch = FakeClock()
    playback = Playback(60.0, watch)
    watch.now += 5.0
    assert playback.position == 0.0 and not playback.playing
    playback.play()
    watch.now += 2.0
    assert playback.position == pytest.approx(2.0)
    playback.set_speed(5.0)
    watch.now += 2.0
    assert playback.position == pytest.approx(12.0)
    playback.pause()
    watch.now += 2.0
    assert playback.position == pytest.approx(12.0) and not playback.playing
    playback.seek(70.0)
    assert playback.position == 60.0
    playback.seek(-1.0)
    playback.play()
    watch.now += 100.0
    assert playback.position == 60.0 and not playback.playing
    playback.play()  # again from the start
    assert playback.position == 0.0 and playback.playing


def test_playing_waits_for_what_is_being_read() -> None:
    watch = FakeClock()
    playback = Playback(10.0, watch)
    playback.limit(10.0, 60.0, [])
    playback.seek(50.0)
    playback.play()
    watch.now += 20.0
    assert playback.position == 10.0 and playback.playing
    playback.limit(60.0, 60.0, [(12.0, "push")])
    watch.now += 3.0
    assert playback.position == pytest.approx(13.0)
    assert playback.events == [(12.0, "push")]


@pytest.fixture(scope="module")
def played(hold: Path, hold_model: Path) -> Player:
    return Player(st.open_trial(hold), st.read_model(hold_model))


def test_an_instant_is_that_of_the_verbs(played: Player, hold: Path) -> None:
    """Of the newest sample: measured, predicted, mapped, posed."""
    trial = st.open_trial(hold)
    samples, estimate = trial.samples(), st.force_map(trial, "all").estimate
    assert played._model is not None
    predicted = st.predict(trial, played._model).to_numpy()
    for time in (0.0, 12.34, 59.75):
        row = int(np.flatnonzero(samples.time <= time + 1e-6)[-1])
        played.playback.seek(time)
        instant = played.instant()
        assert instant.stamp == samples.stamps[row]
        np.testing.assert_array_equal(instant.wrench, samples.wrench[row])
        assert instant.map is not None
        for name in ("forces", "normal_pressure", "normal_pressure_standard_deviation", "shear"):
            found, known = getattr(instant.map, name)[0], getattr(estimate, name)[row]
            np.testing.assert_allclose(found, known, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(instant.predicted, predicted[row, :6], rtol=1e-9, atol=1e-9)
        assert instant.socket_in_world is not None and instant.limb_in_world is not None
        limb = instant.socket_in_world.inverse() @ instant.limb_in_world
        np.testing.assert_allclose(limb.translation, samples.position[row], atol=1e-9)
        np.testing.assert_allclose(limb.rotation_vector(), samples.rotation[row], atol=1e-9)


def test_the_wrenches_are_those_of_the_last_30_seconds(played: Player, hold: Path) -> None:
    samples = st.open_trial(hold).samples()
    for position, start in ((45.0, 15.0), (20.0, -1.0)):
        played.playback.seek(position)
        time, measured, predicted = played.wrenches()
        rows = (samples.time > start) & (samples.time <= position + 1e-6)
        np.testing.assert_array_equal(time, samples.time[rows])
        np.testing.assert_array_equal(measured, samples.wrench[rows])
        assert np.isfinite(predicted).all()


def test_regions_are_those_of_pressure_and_are_drawn_once_a_second(hold: Path) -> None:
    watch = FakeClock()
    played = Player(st.open_trial(hold), now=watch)
    found = st.pressure(st.open_trial(hold), "10:20")
    row = int(np.argmin(np.abs(found.map.time - 15.0)))
    played.playback.seek(15.0)
    now = played.regions()
    assert now is not None and now.time == pytest.approx(15.0)
    assert [p.name for p in now.places] == [p.name for p in found.places]
    for title in ("peak pressure [kPa]", "mean pressure [kPa]", "contact area [cm^2]"):
        ours, theirs = (read_column(of, title) for of in (now.outputs, found.outputs.series))
        np.testing.assert_allclose(ours.value, theirs.value[row], rtol=1e-6)
        np.testing.assert_allclose(ours.high, theirs.high[row], rtol=1e-6)
    played.playback.seek(30.0)
    assert played.regions() is now
    watch.now += 1.0
    later = played.regions()
    assert later is not None and later.time == pytest.approx(30.0)


@pytest.fixture(scope="module")
def gappy(hold: Path, tmp_path_factory: pytest.TempPathFactory) -> Player:
    """The hold with events, without triggers from 20 s to 24 s, and without a cluster from 40 s."""
    folder = tmp_path_factory.mktemp("gappy")
    first = int(st.open_trial(hold).samples().stamps[0])

    def change(topic: str, message: Any) -> Any:
        stamp = message.header.stamp
        time = (stamp.sec * 10**9 + stamp.nanosec - first) * 1e-9
        if 20.1 < time < 24.0:
            return None
        if topic.endswith("clusters/capacitance") and time >= 40.0:
            gone = dataclasses.replace(
                message.clusters[3],
                capacitance=np.full(4, np.nan),
                status=np.full(4, Status.MISSING, dtype=np.uint8),
            )
            return dataclasses.replace(message, clusters=[*message.clusters[:3], gone])
        return message

    rewrite(hold, folder / "changed", change)
    trial = add_events(folder / "changed", folder / "trial", [("cough", 12.5, 12.5)])
    return Player(trial)


def test_what_is_missing_is_said_in_words(gappy: Player) -> None:
    gappy.playback.seek(10.0)
    states = {state.name: state for state in gappy.sensors()}
    assert {state.level for state in states.values()} == {0}
    assert states["load cell"].rate == pytest.approx(4.0)
    assert states["load cell"].age == 0.0
    gappy.playback.seek(45.0)
    states = {state.name: state for state in gappy.sensors()}
    distal, instant = states["distal"], gappy.instant()
    assert distal.words == "missing; without a value at 80 of 225 triggers"
    assert distal.age == pytest.approx(5.25)
    assert (distal.level, states["mid_anterior"].level) == (1, 0)
    assert instant.map is not None and ", distal" not in instant.map.source


def test_events_are_marks_and_nothing_is_shown_in_a_gap(gappy: Player) -> None:
    events = [(round(time, 6), label) for time, label in gappy.playback.events]
    assert events[0][1] == "placed" and events[1] == (12.5, "cough")
    gappy.playback.seek(22.0)
    instant = gappy.instant()
    assert instant.map is None and np.isnan(instant.wrench).all()
    assert instant.time == 22.0
    assert {state.words.split(";")[0] for state in gappy.sensors()} == {"not triggered for 2.0 s"}


def test_a_trial_opens_before_all_of_it_is_read(hold, tmp_path, monkeypatch) -> None:
    path = tmp_path / "trial"
    shutil.copytree(hold, path)
    with monkeypatch.context() as patch:
        patch.setattr(playing, "_AT_ONCE", 40)
        patch.setattr(Player, "_read_on", lambda self: None)
        player, damaged = Player(st.open_trial(hold)), Player(st.open_trial(path))
    assert player.playback.duration == pytest.approx(60.0, abs=1.0)
    player.playback.seek(50.0)
    assert 5.0 < player.playback.position < 15.0
    assert player.instant().map is not None
    assert "the rest is being read" in player.sensors()[0].words
    player._read_on()
    player.playback.seek(50.0)
    assert player.instant().time == 50.0
    assert all("read" not in state.words for state in player.sensors())
    assert player.playback.duration == pytest.approx(59.75)
    next(path.glob("*.mcap")).write_bytes(b"")
    damaged._read_on()
    assert damaged.sensors()[0].words.startswith("only the first 10 s are read")
    assert damaged.instant().map is not None


def test_a_model_of_another_socket_is_refused(hold: Path, hold_model: Path) -> None:
    model = st.read_model(hold_model)
    other = dataclasses.replace(model.geometry, anchors=model.geometry.anchors + 0.01)
    with refused(TestbedError, "another socket"):
        Player(st.open_trial(hold), dataclasses.replace(model, geometry=other))


def test_a_trial_s_page_may_be_called_by_further_names(hold: Path) -> None:
    with st.view(st.open_trial(hold), names=("lab-laptop",)) as page:
        for name, status in (("lab-laptop", 200), ("attacker.example", 403)):
            connection = http.client.HTTPConnection(urlsplit(page.url).netloc, timeout=HANGS)
            connection.request("GET", "/", headers={"Host": f"{name}:{urlsplit(page.url).port}"})
            assert connection.getresponse().status == status
            connection.close()
